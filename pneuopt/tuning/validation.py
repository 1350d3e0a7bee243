"""`validate_design`: a design on plants that no search has used: on how many it holds, what breaks, what would help.

`PlantTrial` simulates designs on plants, for this and for `harden`, which chooses among designs on others.
"""

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
from pneuopt.evaluation.plants import ExpectedPlants
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
from pneuopt.tuning.tolerances import HIGH_SHARE

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
        Limits with which the same gains hold, a sentence each; computed from these plants.
    units : mapping of str to str
        The metrics' units.
    """

    figures: "pd.DataFrame"
    plants: "pd.DataFrame"
    certified: "pd.DataFrame"
    broken: Mapping[str, tuple[str, ...]]
    varied: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
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
    def is_robust(self) -> bool:
        """Whether it holds on 95 of 100 plants."""
        return self.held >= HIGH_SHARE * self.count

    @property
    def verdict(self) -> str:
        """On how many plants it holds, in a sentence."""
        found = f"holds on {self.held} of {self.count} plants"
        if self.broken or not self.count:
            return found
        return f"{found}: with 95 % confidence on at least {100 * 0.05 ** (1 / self.count):.3g} % of all such plants"

    @property
    def sentence(self) -> str:
        """The verdict, and what breaks on the other plants."""
        breaks = (f"{w} breaks on {n}" if w in METRICS else f"it {w} on {n}" for w, n in self.breaks.items())
        return f"{self.verdict}: {', '.join(breaks)}" if self.broken else self.verdict

    @property
    def breaks(self) -> Mapping[str, int]:
        """By limit or defect: on how many plants it breaks, the most frequent first."""
        words = [w for found in self.broken.values() for w in found]
        return {w: words.count(w) for w in sorted(set(words), key=lambda w: (-words.count(w), w))}

    def summary(self) -> Report:
        """On how many plants the design holds, the figures on them, and what would help."""
        return report_validation(self)


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
        `tolerances` with a count, or `expected_plants`.
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
    trial = PlantTrial(loop, steps, Space(full, ()), expected.scenarios, spec, accept)
    by_case = trial.by_case(np.zeros(0))
    shown = [name for name in METRICS if name in spec.metric_names]
    values, worst = worst_figures(by_case, trial.plants, steps, shown)
    breaks = trial.find_breaks(values)
    certified, findings = _certify(loop, full, spec, expected.scenarios, steps, list(dict.fromkeys(worst.values())))
    for plant, words in findings:
        own = [w for w in words if Defect(w) not in accept and w not in breaks[plant]]
        breaks[plant] = (*own, *breaks[plant])
    broken = {n: found for n, found in breaks.items() if found}
    return DesignValidation(
        _figures(values.loc[shown], worst, certified, spec),
        values.loc[shown].T,
        certified.loc[shown],
        broken,
        expected.sentences,
        advise(loop, spec, values.T, broken, certified),
        metric_units(loop),
    )


def report_validation(found: DesignValidation) -> Report:
    """On how many plants a design holds, what these differ by, the figures on them, and what would help."""
    rows = []
    for row in found.figures.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [metric_cell(metric, row[n]) for n in ("median", "p95", "certified")]
        limit = "" if math.isnan(row["limit"]) else format_number(row["limit"], 4)
        rows.append((metric, *figures, limit, str(row["violations"]), found.units.get(metric, "")))
    figures_heads = number_columns("median", "95 %", "worst", "limit", "broken by")
    table = Table((*text_columns("new plants"), *figures_heads, *text_columns("unit")), tuple(rows))
    verdict = Line(found.sentence, Tone.DOUBTFUL if found.broken else Tone.GOOD)
    lead = Line(f"tried on {found.count} plants that no search has seen, each off by")
    return Report((verdict, lead, *(Line(text, indent=2) for text in found.varied), table, *map(Line, found.advice)))


class PlantTrial:
    """Simulate designs on plants, compiled; those on which the loop has no rest stand apart.

    The point (n,) of a design are the gains of a space.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        steps: Sequence[Reference],
        space: Space,
        scenarios: Scenarios,
        spec: Specification,
        accept: Collection[Defect] = (),
    ) -> None:
        self.steps, self.spec, self.accept = steps, spec, accept
        self.restless = list[str]()
        try:
            self.simulator = Simulator(loop, steps, space, scenarios, spec)
        except (ConvergenceError, InputError):
            for n, values in scenarios.items():
                try:
                    for step in steps:
                        TuningCase(step, n, values).initial(loop, space.parameters)
                except (ConvergenceError, InputError):
                    self.restless.append(n)
            left = {n: values for n, values in scenarios.items() if n not in self.restless}
            if not self.restless or not left:
                raise
            self.simulator = Simulator(loop, steps, space, left, spec)
        self.plants = [n for n in scenarios if n not in self.restless]

    def by_case(self, point: Array) -> "pd.DataFrame":
        """The metrics of each case, a column a case."""
        import pandas as pd

        rows = self.simulator.table(point, self.spec)
        found = pd.DataFrame({case.label: row for case, row in zip(self.simulator.cases, rows, strict=True)})
        return found.loc[[n for n in METRICS if n in (*self.spec.metric_names, *LANE_DEFECTS)]]

    def find_breaks(self, values: "pd.DataFrame") -> dict[str, tuple[str, ...]]:
        """What breaks on each plant, by its metrics, a column a plant."""
        by_plant = {str(n): {str(m): float(v) for m, v in row.items()} for n, row in values.to_dict().items()}
        found = {n: find_breaks(row, self.spec, self.accept) for n, row in by_plant.items()}
        return found | dict.fromkeys(self.restless, (NO_REST,))


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


def worst_figures(
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
            "median": _quantile(given, metric, 0.5),
            "p95": _quantile(given, metric, HIGH_SHARE),
            "worst": float(given[order[-1]]),
            "worst_plant": str(values.columns[order[-1]]),
            "certified": float(certified[case].to_dict()[metric]),
            "limit": limits.get(metric, math.nan),
            "violations": int(np.sum(breaks.get(metric, ~np.isfinite(given)))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _quantile(values: Array, metric: str, share: float) -> float:
    """The value of a metric that such a share of the plants is as good as or better than."""
    return float(values[_rank_order(values, metric)[math.ceil(len(values) * share) - 1]])


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
) -> tuple[str, ...]:
    """With which limits the same gains hold on the plants that work, and on how many no limit helps."""
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
    return (*sentences, *([f"no relaxed limit helps on {count}, where the loop fails"] if lost else []))
