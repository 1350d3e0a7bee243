"""`validate_design`: a design on plants that no search has used: on how many it holds, what breaks, what would help."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.loop import ClosedLoop, add_disturbances, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.evaluation.certificate import Defect, certificate
from pneuopt.evaluation.evaluate import metric_cell, metric_units
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.plants import CorrelatedParameters, ExpectedPlants
from pneuopt.evaluation.requirements import METRICS, metric_name, requirement_values, user_limit
from pneuopt.evaluation.response import TuningCase
from pneuopt.evaluation.scenarios import Scenarios, apply_scenario
from pneuopt.evaluation.specification import Objective, Specification, specify
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet, check_parameters
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result
from pneuopt.tuning.relaxation import round_outwards
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class DesignValidation(Result):
    """A design on new plants; prints its `summary()`.

    Attributes
    ----------
    figures : DataFrame
        A row a requirement, in the units of `TuningResult.certified`: "median", "p95" (95 of 100 plants do better) and
        "worst" by the compiled simulation; "worst_plant", and "certified", that plant's figure by the independent
        simulation; "limit", NaN without; "violations", the number of plants that break it, or that never settle. A
        figure is NaN where the response never settles.
    plants : DataFrame
        A row a plant, a column a metric, the worst over the references; by the compiled simulation.
    certified : DataFrame
        A row a metric, a column a case that is the worst for a requirement; by the independent simulation.
    broken : mapping of str to tuple of str
        By plant, without those on which the design holds: defects ("never settles", "unstable", of the worst plants
        all that a certificate finds; "has no rest"), then the limits that it breaks.
    varied : tuple of str
        What the plants differ by.
    advice : tuple of str
        What would help, a sentence each; computed from these plants.
    suggested : tuple of CorrelatedParameters
        What of it to tune over.
    units : mapping of str to str
        The metrics' units.
    """

    figures: "pd.DataFrame"
    plants: "pd.DataFrame"
    certified: "pd.DataFrame"
    broken: Mapping[str, tuple[str, ...]]
    varied: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    suggested: tuple[CorrelatedParameters, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of plants."""
        return len({*map(str, self.plants.index), *self.broken})

    @property
    def held(self) -> int:
        """Number of plants on which every limit holds, the response settles and the loop is stable."""
        return self.count - len(self.broken)

    @property
    def verdict(self) -> str:
        """On how many plants it holds, in a sentence."""
        found = f"holds on {self.held} of {self.count} plants"
        if self.broken or not self.count:
            return found
        return f"{found}: with 95 % confidence on at least {100 * 0.05 ** (1 / self.count):.3g} % of all such plants"

    @property
    def breaks(self) -> Mapping[str, int]:
        """By limit or defect: on how many plants it breaks, the most frequent first."""
        words = [w for found in self.broken.values() for w in found]
        return {w: words.count(w) for w in sorted(set(words), key=lambda w: (-words.count(w), w))}

    def summary(self) -> Report:
        """On how many plants the design holds, the figures on them, and what would help."""
        return report_validation_verdict(self) + report_validation(self)


def validate_design(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: Objective,
    subject_to: Sequence[Requirement] = (),
    scenarios: Scenarios | ExpectedPlants,
    accept: Collection[Defect] = (),
) -> DesignValidation:
    """Simulate a design on new plants: all compiled, the worst case of each requirement by the independent simulation.

    Parameters
    ----------
    loop, references, minimise, subject_to
        As for `tune`.
    parameters : ParameterSet
        The design's, a `TuningResult.parameters` for example.
    scenarios : mapping of str to mapping, or ExpectedPlants
        The plants, or tolerances of the gains: of `samples` or `draws` with another seed than the search had,
        `tolerances` with a count, or `expected_plants`, with which the advice says what to tune over.
    accept : collection of Defect
        Defects that do not count.

    Returns
    -------
    DesignValidation

    Raises
    ------
    InputError
        If there is no scenario, or parameters, scenarios and requirements do not fit together.
    ConvergenceError
        If the loop rests on none of the plants, or the independent simulation stops.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import Overshoot, SettlingTime
    >>> from pneuopt.evaluation.scenarios import samples
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> design = loop.parameters.with_values({"pid.Kp": 5.0, "pid.Ki": 50.0})
    >>> plants = samples(design, {"plant.gain": 0.2}, 50, seed=1)
    >>> found = validate_design(
    ...     loop, Step(1.0), design, minimise=SettlingTime(), subject_to=[Overshoot(0.01)], scenarios=plants
    ... )
    >>> int(found.figures.loc["Overshoot", "violations"]), found.held
    (0, 50)
    """
    expected = scenarios if isinstance(scenarios, ExpectedPlants) else ExpectedPlants(scenarios, ())
    message = "no new plants; draw some: scenarios=samples(parameters, {'load.mass': 0.3}, 100)"
    require(len(expected.scenarios) > 0, message)
    spec = minimise if isinstance(minimise, Specification) and not subject_to else specify(minimise, subject_to)
    check_closed_loop(loop)
    check_parameters(parameters)
    steps = as_references(references)
    loop = add_disturbances(loop, steps)
    full = loop.complete(parameters).select(loop.parameters)
    ends = {f"{a.label} {side}": v for a in expected.axes for side, v in (("low", a.low), ("high", a.high))}
    by_case, restless = _simulate_plants(loop, steps, full, spec, {**expected.scenarios, **ends})
    restless = [n for n in restless if n in expected.scenarios]
    shown = [name for name in METRICS if name in spec.metric_names]
    values, worst = _worst_figures(by_case, [n for n in expected.scenarios if n not in restless], steps, shown)
    by_plant = {str(n): {str(m): float(v) for m, v in row.items()} for n, row in values.to_dict().items()}
    breaks = {n: find_breaks(row, spec, accept) for n, row in by_plant.items()} | dict.fromkeys(restless, (NO_REST,))
    certified, findings = _certify(loop, full, spec, expected.scenarios, steps, list(dict.fromkeys(worst.values())))
    for plant, words in findings:
        own = [w for w in words if Defect(w) not in accept and w not in breaks[plant]]
        breaks[plant] = (*own, *breaks[plant])
    broken = {n: found for n, found in breaks.items() if found}
    sides = {a: [f"[{a.label} {side}]" for side in ("low", "high")] for a in expected.axes}
    axes = {a: by_case[[c for c in by_case if str(c).endswith(tuple(ends))]] for a, ends in sides.items()}
    advice, suggested = advise(loop, spec, values.T, broken, certified, axes)
    return DesignValidation(
        _figures(values.loc[shown], worst, certified, spec),
        values.loc[shown].T,
        certified.loc[shown],
        broken,
        expected.sentences,
        advice,
        suggested,
        metric_units(loop),
    )


def report_validation_verdict(found: DesignValidation) -> Report:
    """On how many plants a design holds, and what breaks on the others."""
    breaks = ", ".join(
        f"{word} breaks on {count}" if word in METRICS else f"it {word} on {count}"
        for word, count in found.breaks.items()
    )
    text = f"{found.verdict}: {breaks}" if breaks else found.verdict
    return Report((Line(text, Tone.DOUBTFUL if found.broken else Tone.GOOD),))


def report_validation(found: DesignValidation) -> Report:
    """What the plants differ by, the figures on them, and what would help."""
    rows = []
    for row in found.figures.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [metric_cell(metric, row[n]) for n in ("median", "p95", "certified")]
        limit = "" if math.isnan(row["limit"]) else format_number(row["limit"], 4)
        rows.append((metric, *figures, limit, str(row["violations"]), found.units.get(metric, "")))
    figures_heads = number_columns("median", "95 %", "worst", "limit", "broken by")
    table = Table((*text_columns("new plants"), *figures_heads, *text_columns("unit")), tuple(rows))
    lead = Line(f"tried on {found.count} plants that no search has seen, each off by")
    lines = list[str]()  # [scenarios.corners] "load.mass" = "5 %"
    for kind, is_gain in (("corners", False), ("tolerances", True)):
        keys = [f'"{n}" = "{100 * a.share:.2g} %"' for a in found.suggested if a.is_gain is is_gain for n in a.names]
        lines += [f"[scenarios.{kind}] {', '.join(keys)}"] if keys else []
    suggestion = f"to do so, add to the tuning's file: {'; '.join(lines)}"
    advice = (*found.advice, *([suggestion] if found.suggested else []))
    return Report((lead, *(Line(text, indent=2) for text in found.varied), table, *map(Line, advice)))


def _simulate_plants(
    loop: ClosedLoop, steps: Sequence[Reference], parameters: ParameterSet, spec: Specification, scenarios: Scenarios
) -> tuple["pd.DataFrame", list[str]]:
    """The metrics of each case by compiled simulation, a column a case, and the plants that have no rest."""
    import pandas as pd

    space, restless = Space(parameters, ()), list[str]()
    try:
        simulator = Simulator(loop, steps, space, scenarios, spec)
    except (ConvergenceError, InputError):
        for n, values in scenarios.items():
            try:
                for step in steps:
                    TuningCase(step, n, values).initial(loop, parameters)
            except (ConvergenceError, InputError):
                restless.append(n)
        left = {n: values for n, values in scenarios.items() if n not in restless}
        if not restless or not left:
            raise
        simulator = Simulator(loop, steps, space, left, spec)
    rows = simulator.table(np.zeros(0), spec)
    found = pd.DataFrame({case.label: row for case, row in zip(simulator.cases, rows, strict=True)})
    return found.loc[[n for n in METRICS if n in (*spec.metric_names, *LANE_DEFECTS)]], restless


def _certify(
    loop: ClosedLoop,
    parameters: ParameterSet,
    spec: Specification,
    scenarios: Scenarios,
    steps: Sequence[Reference],
    worst: Sequence[str],
) -> tuple["pd.DataFrame", list[tuple[str, list[str]]]]:
    """The metrics of some cases by the independent simulation, a column a case, and the defects of their plants."""
    import pandas as pd

    every = {case.label: case for n, v in scenarios.items() for case in (TuningCase(step, n, v) for step in steps)}
    metrics, defects = {}, []
    for label in worst:
        case = every[label]
        plant = apply_scenario(parameters, case.values)
        found = certificate(loop, case.reference, plant, band=spec.band, envelope=spec.envelope)
        metrics[label] = found.metrics.iloc[:, 0]
        defects.append((case.scenario, [finding.defect.value for finding in found.findings]))
    return pd.DataFrame(metrics), defects


def _worst_figures(
    by_case: "pd.DataFrame", plants: Sequence[str], steps: Sequence[Reference], shown: Sequence[str]
) -> tuple["pd.DataFrame", dict[str, str]]:
    """The worst of each plant's metrics over its references, a column a plant, and the worst case of those shown.

    NaN is the worst.
    """
    import pandas as pd

    columns = {str(label): number for number, label in enumerate(by_case)}
    own = np.array([[columns[TuningCase(step, plant).label] for step in steps] for plant in plants])
    table = by_case.to_numpy(dtype=float)[:, own]
    rows = {
        str(n): [row[_rank_order(row, str(n))[-1]] for row in found]
        for n, found in zip(by_case.index, table, strict=True)
    }
    cases = dict[str, str]()
    for n in shown:
        labels = [TuningCase(step, plants[_rank_order(np.array(rows[n]), n)[-1]]).label for step in steps]
        cases[n] = labels[int(_rank_order(by_case.loc[n, labels].to_numpy(dtype=float), n)[-1])]
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(plants)), cases


def _rank_order(values: Array, metric: str) -> NDArray[np.intp]:
    """Indices from the best to the worst value of a metric; NaN is the worst."""
    cost = METRICS[metric].requirement_value(values)
    return np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")


def _figures(
    values: "pd.DataFrame", worst: Mapping[str, str], certified: "pd.DataFrame", spec: Specification
) -> "pd.DataFrame":
    """The table `DesignValidation.figures`."""
    import pandas as pd

    limits = {metric_name(q): q.metric.factor * (user_limit(q) or math.nan) for q in spec.limits}
    given_rows = {str(n): row.to_numpy(dtype=float) for n, row in values.iterrows()}
    breaks = {metric_name(q): ~(share <= 0) for q, share in spec.excess(requirement_values(given_rows)).items()}
    rows = {}
    for metric, case in worst.items():
        given = given_rows[metric]
        order = _rank_order(given, metric)
        rows[metric] = {
            "median": _quantile(given, metric, 50.0),
            "p95": _quantile(given, metric, 95.0),
            "worst": float(given[order[-1]]),
            "worst_plant": str(values.columns[order[-1]]),
            "certified": float(certified[case].to_dict()[metric]),
            "limit": limits.get(metric, math.nan),
            "violations": int(np.sum(breaks.get(metric, ~np.isfinite(given)))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _quantile(values: Array, metric: str, percent: float) -> float:
    """The value of a metric that so many percent of the plants are as good as or better than."""
    return float(values[_rank_order(values, metric)[math.ceil(len(values) * percent / 100) - 1]])


# Defects that the lanes of a simulation show, by the metric that has no finite figure then.
LANE_DEFECTS = {"SettlingTime": Defect.NEVER_SETTLES, "MaxSensitivity": Defect.UNSTABLE}
NO_REST = "has no rest"  # of a plant on which the loop cannot wait for its step
DEFECT_WORDS = frozenset({NO_REST, *(defect.value for defect in Defect)})


def find_breaks(row: Mapping[str, float], spec: Specification, accept: Collection[Defect] = ()) -> tuple[str, ...]:
    """What breaks on a plant by its metrics: defects that are not accepted, then limits by the metric's name."""
    defects = {n: defect.value for n, defect in LANE_DEFECTS.items() if not math.isfinite(row[n])}
    limits = [metric_name(q) for q in spec.violations(requirement_values(row))]
    named = [word for word in defects.values() if Defect(word) not in accept]
    return (*named, *(n for n in limits if n not in defects))


def advise(
    loop: ClosedLoop,
    spec: Specification,
    plants: "pd.DataFrame",
    broken: Mapping[str, tuple[str, ...]],
    certified: "pd.DataFrame",
    axes: Mapping[CorrelatedParameters, "pd.DataFrame"],
    most: int = 3,
) -> tuple[tuple[str, ...], tuple[CorrelatedParameters, ...]]:
    """Advice where a design breaks on plants: limits that hold with the same gains, and what to tune over.

    `axes` are the metrics with one thing that varies alone at its low and its high end, a column each.
    """
    if not broken:
        return (), ()
    lost = [n for n, found in broken.items() if DEFECT_WORDS & set(found)]
    sound = plants.loc[[n for n in plants.index if n not in lost]]
    own, texts = [str(c) for c in certified if not str(c).endswith(tuple(f"[{n}]" for n in lost))], list[str]()
    for q in (q for q in spec.limits if any(metric_name(q) in broken.get(str(n), ()) for n in sound.index)):
        metric, least = q.metric, q.metric.sense is Sense.AT_LEAST
        worst = max([*sound[metric.name], *certified[own].T[metric.name]], key=metric.requirement_value)
        value, asked = round_outwards(worst, upwards=not least), metric.factor * (user_limit(q) or 0.0)
        unit = metric.shown_unit(loop.command.unit, loop.feedback.unit)
        texts.append(f"{metric.name} {'>=' if least else '<='} {value:g} {unit}".strip() + f" (now {asked:.4g})")
    sentences = [f"with {' and '.join(texts)} these gains hold on {len(sound)} of {len(plants)}"] if texts else []
    count = f"{len(lost)} plant{'s' if len(lost) > 1 else ''}"
    sentences += [f"no relaxed limit helps on {count}, where the loop fails"] if lost else []
    worst = dict[CorrelatedParameters, float]()
    for a, found in axes.items():
        ends = [{str(n): v for n, v in row.items()} for row in found.to_dict().values()]
        works = ends and all(math.isfinite(row[n]) for row in ends for n in LANE_DEFECTS)  # it rests and settles
        shares = [share for row in ends for share in spec.excess(requirement_values(row)).values()] if works else []
        worst[a] = max(shares, default=-math.inf) if works else math.inf
    order = sorted(worst, key=lambda a: -worst[a])
    alone = [a for a in order if worst[a] > 0]
    reason = "what breaks it most, each alone" if alone else "nothing breaks it alone, most is done by"
    suggested = tuple((alone or order)[:most])
    names = " and ".join(a.label for a in suggested)
    remedy = f"{reason}: {names}; tune over that too" if names else "tune over such plants: add them to the scenarios"
    return (*sentences, remedy), suggested
