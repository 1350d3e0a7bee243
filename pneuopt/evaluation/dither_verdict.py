"""`judge_dither`: whether a dither is useful: the loop's metrics with and without it, and what the dither moves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite, isnan
from typing import TYPE_CHECKING, NamedTuple

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Step, as_steps
from pneuopt.evaluation.dither_effect import DitherEffect, dither_effect, explain_effect, format_with_prefix
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import METRICS
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd

# Amplitude of the loop "without" dither, as a share of the judged one: at zero its means would not be read over the
# same periods; a much larger one would act as a dither.
NEGLIGIBLE_AMPLITUDE = 1e-9


class Usefulness(Enum):
    """Verdict on a dither."""

    USEFUL = "useful"
    USELESS = "useless"
    HARMFUL = "harmful"


class Criterion(NamedTuple):
    """A criterion on dithers: a metric's label and the least change that counts, relative to its value or absolute."""

    label: str
    min_change: float
    relative: bool


CRITERIA: Mapping[str, Criterion] = {  # where some improve and others do not, the first that changes decides
    "LimitCycleAmplitude": Criterion("limit cycle", 0.02, relative=False),  # [fraction of the step]
    "SettlingTime": Criterion("settling time", 0.05, relative=True),
    "SteadyStateError": Criterion("steady-state error", 0.5, relative=False),  # [%]
    "IAE": Criterion("integral of the error", 0.05, relative=True),
    "Overshoot": Criterion("overshoot", 1.0, relative=False),  # [%]
}
PRICE_METRICS = {
    "Ripple": "ripple",
    "AirUse": "air consumption",
    "ValveTravel": "valve travel",
    "PeakControl": "largest command",
}


@dataclass(frozen=True, eq=False)
class DitherVerdict:
    """Verdict of `judge_dither`: as text, the verdict in the first line and a reason in each further line.

    Attributes
    ----------
    usefulness : Usefulness
    reasons : tuple of str
        What decided, the price and the mechanism, a sentence each.
    table : DataFrame
        A row for each metric of `evaluate`, columns "without" and "with": the worst over the references.
    effect : DitherEffect
    baseline : str
        What "without" stands for: the same gains, or a design of its own.
    unit : str
        Unit of the command.
    """

    usefulness: Usefulness
    reasons: tuple[str, ...]
    table: "pd.DataFrame"
    effect: DitherEffect
    baseline: str
    unit: str

    def __str__(self) -> str:
        dither = f"the dither of {self.effect.amplitude:.4g} {self.unit} at {self.effect.frequency:.4g} Hz"
        head = f"{dither} is {self.usefulness.value}, against {self.baseline}"
        return "\n".join([head, *(f"  {reason}" for reason in self.reasons)])


def judge_dither(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    without: ParameterSet | None = None,
    band: float = 0.02,
) -> DitherVerdict:
    """Evaluate a loop with and without its dither, and say whether the dither is useful, and why.

    A metric counts as better or worse where it changes by more than this: settling time and integral of the absolute
    error by 5 %, steady-state error by 0.5 % of the step, overshoot by 1 %, a limit cycle's amplitude by 2 %. Where
    some improve and others do not, the first of limit cycle, settling time, steady-state error, integral, overshoot
    decides. A dither that swings the signal by more than the step is harmful, whatever the mean over its period does.

    Parameters
    ----------
    loop : ClosedLoop
    references : Step or sequence of Step
    parameters : ParameterSet
        Values of the design with dither, whose amplitude is positive.
    without : ParameterSet, optional
        Values of the design to compare with, whose dither is switched off. By default the same gains, which shows what
        the dither changes; the gains of a tuning without dither show whether a dither is needed at all.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    DitherVerdict

    Raises
    ------
    InputError
        If there is no dither to judge.
    ConvergenceError
        If a simulation stops.
    """
    check_closed_loop(loop)
    check_parameters(parameters)
    steps = as_steps(references)
    full = loop.complete(parameters)
    require(loop.dither is not None, "there is no dither to judge: ClosedLoop(plant, pid, Dither())")
    require(full.value(DITHER_AMPLITUDE) > 0, "there is no dither to judge: dither.amplitude is 0")
    plain = full if without is None else full | without
    plain = plain.with_bounds({DITHER_AMPLITUDE: (0.0, plain[DITHER_AMPLITUDE].upper)})
    plain = plain.with_values(
        {
            DITHER_AMPLITUDE: NEGLIGIBLE_AMPLITUDE * full.value(DITHER_AMPLITUDE),
            DITHER_FREQUENCY: full.value(DITHER_FREQUENCY),
        }
    )
    table = _compare_designs(loop, steps, plain, full, band)
    effect = dither_effect(loop, steps[0], full)
    sizes = [abs(s.size) for s in steps]
    swing = float(table["with"]["Ripple"]) if isnan(effect.speed) else 2 * effect.speed
    size = format_with_prefix(swing, loop.feedback.unit)
    coarse = [f"worse: the dither swings {loop.feedback.name} by {size}, more than the step itself"]
    coarse = coarse if swing > min(sizes) else []
    usefulness, found = _weigh_changes(table, max(sizes), loop, coarse)
    rival = "the same gains without it" if without is None else "a design of its own without it"
    return DitherVerdict(
        usefulness, (*found, *explain_effect(loop, effect, full)), table, effect, rival, loop.command.unit
    )


def _compare_designs(
    loop: ClosedLoop, steps: Sequence[Step], plain: ParameterSet, full: ParameterSet, band: float
) -> "pd.DataFrame":
    """Worst metrics over the references, without and with dither; a loop that never settles takes infinitely long."""
    import pandas as pd

    columns = {}
    for name, given in {"without": plain, "with": full}.items():
        found = evaluate(loop, steps, given, band=band)
        found.loc["SettlingTime"] = found.loc["SettlingTime"].fillna(inf)
        columns[name] = found.max(axis=1)
    return pd.DataFrame(columns)


def _weigh_changes(
    table: "pd.DataFrame", size: float, loop: ClosedLoop, objections: list[str]
) -> tuple[Usefulness, tuple[str, ...]]:
    """Verdict and its reasons, from the changes of the metrics and the objections that are known beforehand."""
    reasons, signs = [*objections], [-1] * len(objections)
    for metric, (words, least, relative) in CRITERIA.items():
        before, after = (float(table[c][metric]) for c in ("without", "with"))
        room = least * max(before, after) if relative else least * (size if "Limit" in metric else 1.0)
        if before == after or not (abs(after - before) > room or isfinite(before) != isfinite(after)):
            continue
        signs.append(1 if after < before else -1)
        change = (
            f"{words} {_format_metric(metric, before, loop)} without, {_format_metric(metric, after, loop)} with it"
        )
        reasons.append(f"{'better' if after < before else 'worse'}: {change}")
    if not signs:
        kept = ("SettlingTime", "SteadyStateError")
        figures = [f"{CRITERIA[m].label} {_format_metric(m, float(table['with'][m]), loop)}" for m in kept]
        reasons.append(f"nothing changes: {', '.join(figures)}")
    reasons.append("price: " + ", ".join(_price_clause(n, table, loop) for n in PRICE_METRICS if n in table.index))
    verdict = Usefulness.USELESS if not signs else Usefulness.USEFUL if signs[0] > 0 else Usefulness.HARMFUL
    return verdict, tuple(reasons)


def _price_clause(metric: str, table: "pd.DataFrame", loop: ClosedLoop) -> str:
    before, after = (_format_metric(metric, float(table[c][metric]), loop) for c in ("without", "with"))
    return f"{PRICE_METRICS[metric]} {after} (without {before})"


def _format_metric(metric: str, value: float, loop: ClosedLoop) -> str:
    if metric == "SettlingTime" and value == inf:
        return "never"
    if metric == "LimitCycleAmplitude" and value == 0:
        return "none"
    if metric in ("Ripple", "LimitCycleAmplitude"):
        return format_with_prefix(value, loop.feedback.unit)
    return f"{value:.3g} {METRICS[metric].shown_unit(loop.command.unit, loop.feedback.unit)}".rstrip()
