"""`judge_dither`: whether a dither is useful: the loop's metrics with and without it, and what the dither moves."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite, isnan, nan
from typing import TYPE_CHECKING, NamedTuple

from pneuopt.control.dither import DITHER_AMPLITUDE
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.hooks import Axis
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.dither_effect import DitherEffect, dither_effect, explain_effect, format_with_prefix
from pneuopt.evaluation.dithered_ending import DitheredEnding, read_ending
from pneuopt.evaluation.evaluate import evaluate_cases
from pneuopt.evaluation.requirements import METRICS
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report, Tone, report_verdict
from pneuopt.quantities.shown import Result

if TYPE_CHECKING:
    import pandas as pd

# Share by which a dither has to reduce the error of a loop that goes on hunting, to count as better: with less, one
# that shakes a hunting loop a little is useful; with more, no dither is that does not cure it.
MIN_CURE = 0.5
# Ripple from peak to peak, a share of the step, from which a dither is harmful whatever else it does: above, the motion
# goes to and fro instead of along the step; far below, a dither that cures hunting as large is refused.
MAX_RIPPLE_SHARE = 0.5


class Usefulness(Enum):
    """Verdict on a dither."""

    USEFUL = "useful"
    HELPS_THESE_GAINS = "useful with these gains"
    USELESS = "useless"
    HARMFUL = "harmful"


VERDICT_TONES = {
    Usefulness.USEFUL: Tone.GOOD,
    Usefulness.HELPS_THESE_GAINS: Tone.DOUBTFUL,
    Usefulness.USELESS: Tone.DOUBTFUL,
    Usefulness.HARMFUL: Tone.BAD,
}


class Criterion(NamedTuple):
    """A criterion on dithers: a metric's label and the changes of which the larger counts, absolute and relative."""

    label: str
    absolute: float
    relative: float
    counts_in_hunting: bool = True


CRITERIA: Mapping[str, Criterion] = {  # where some improve and others do not, the first that changes decides
    "RemainingError": Criterion("largest error in the end, ripple included", 0.5, 0.05),  # [%]
    "SettlingTimeRaw": Criterion("settling time, ripple included", 0.0, 0.05),
    "SettlingTime": Criterion("settling time of the mean", 0.0, 0.05),
    "SteadyStateError": Criterion("error of the mean in the end", 0.5, 0.0),  # [%]
    "IAE": Criterion("integral of the error", 0.0, 0.05, counts_in_hunting=False),
    "Overshoot": Criterion("overshoot", 1.0, 0.0, counts_in_hunting=False),  # [%]
}
NO_RIVAL = "gains tuned without dither may do as well: none were compared (tune_without_dither finds them)"
PRICE_METRICS = {
    "Ripple": "ripple",
    "AirUse": "air consumption",
    "ValveTravel": "valve travel",
    "PeakControl": "largest command",
}


@dataclass(frozen=True, eq=False, repr=False)
class DitherVerdict(Result):
    """Verdict of `judge_dither`: as text, the verdict in the first line and a reason in each further line.

    Attributes
    ----------
    usefulness : Usefulness
    reasons : tuple of str
        What decided, the price and the mechanism, a sentence each.
    table : DataFrame
        A row for each metric of `evaluate`, columns "without" and "with": the worst over the references. Settling times
        and errors are those of the continued response, infinite where it never settles; RemainingError is the largest
        error over the last cycles, ripple included [% of the step].
    effect : DitherEffect
    baseline : str
        What "without" stands for: the same gains, or gains tuned without dither.
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

    def summary(self) -> Report:
        """The verdict, then a reason a line."""
        return report_verdict(str(self), VERDICT_TONES[self.usefulness])


def judge_dither(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    without: ParameterSet | None = None,
    band: Band = 0.02,
) -> DitherVerdict:
    """Evaluate a loop with its dither and a rival without one, and say whether the dither is useful, and why.

    Responses are continued beyond their horizons until they stand or show at least three cycles of their hunting, or
    the stroke ends (`continue_response`). The signal itself counts, with the ripple: first its largest error over the
    last cycles, as far as it exceeds the settling band, then its settling time, then the mean's settling time and
    error, the integral of the absolute error and the overshoot. Where some improve and others do not, the first that
    changes decides; a change counts from 0.5 % of the step for errors, 1 % for the overshoot, and 5 % of the rest. A
    dither with which the loop hunts has to halve the error to be useful. One that ripples by half the step or more,
    from peak to peak, is harmful whatever else it does.

    Parameters
    ----------
    loop : ClosedLoop
    references : Reference or sequence of Reference
    parameters : ParameterSet
        Values of the design with dither, whose amplitude is positive.
    without : ParameterSet, optional
        The rival: values tuned without dither (`tune_without_dither`); its dither is switched off. By default the same
        gains, which are tuned for the dither, so that the verdict is "useful with these gains" at best.
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
    steps = as_references(references)
    full = loop.complete(parameters)
    require(loop.dither is not None, "there is no dither to judge: ClosedLoop(plant, pid, Dither())")
    require(full.value(DITHER_AMPLITUDE) > 0, "there is no dither to judge: dither.amplitude is 0")
    plain = full if without is None else full | without
    plain = plain.with_bounds({DITHER_AMPLITUDE: (0.0, plain[DITHER_AMPLITUDE].upper)})
    plain = plain.with_values({DITHER_AMPLITUDE: 0.0})
    before, after = (read_endings(loop, steps, p, band) for p in (plain, full))
    table = worst_metrics(before, after)
    effect = dither_effect(loop, steps[0], full, speed=after[0].speed)
    objections = [
        text for step, found in zip(steps, after, strict=True) for text in _object_to_swing(step, found, effect)
    ]
    hunts, narrowest = any(e.ending.hunts for e in after), min(band_share(band, r) for r in steps)
    usefulness, changes = weigh_changes(table, narrowest, loop, objections, hunts=hunts)
    notes = [n for which, endings in (("without", before), ("with", after)) for e in endings for n in e.describe(which)]
    rival = "gains tuned without it"
    if without is None:
        usefulness = Usefulness.HELPS_THESE_GAINS if usefulness is Usefulness.USEFUL else usefulness
        rival, notes = "the same gains without it", [*notes, NO_RIVAL]
    reasons = (*changes, *dict.fromkeys(notes), *explain_effect(loop, effect, full))
    return DitherVerdict(usefulness, reasons, table, effect, rival, loop.command.unit)


def read_endings(
    loop: ClosedLoop, steps: Sequence[Reference], parameters: ParameterSet, band: Band
) -> list[DitheredEnding]:
    """How a loop's response to each reference ends."""
    return [read_ending(found, band) for found in evaluate_cases(loop, steps, parameters, band=band)]


def worst_metrics(before: Sequence[DitheredEnding], after: Sequence[DitheredEnding]) -> "pd.DataFrame":
    """Worst metrics over the references, without and with dither."""
    import pandas as pd

    designs = {"without": before, "with": after}
    return pd.DataFrame({n: pd.DataFrame([e.metrics for e in endings]).max() for n, endings in designs.items()})


def _object_to_swing(reference: Reference, found: DitheredEnding, effect: DitherEffect) -> Iterator[str]:
    """Objection to a dither that swings the signal by a large part of the step, in the end or while the body moves."""
    loop = found.ending.course.loop
    signal, axis = loop.feedback, loop.plant.axis or Axis()
    moving = {axis.speed: effect.speed, axis.position: effect.travel}.get(signal.name, nan)
    swing, size = max(found.ripple, 0.0 if isnan(moving) else 2 * moving), abs(reference.nominal_size)
    if swing >= MAX_RIPPLE_SHARE * size:
        text = f"worse: the dither swings {signal.name} by {format_with_prefix(swing, signal.unit)} from peak to peak"
        yield f"{text}, {100 * swing / size:.0f} % of the step"


def weigh_changes(
    table: "pd.DataFrame", band: float, loop: ClosedLoop, objections: list[str], *, hunts: bool
) -> tuple[Usefulness, tuple[str, ...]]:
    """Verdict and its reasons, from the objections that are known beforehand and the changes of the metrics.

    Of a loop that hunts with the dither only settling and errors count.
    """
    reasons, signs = [*objections], [-1] * len(objections)
    for metric, criterion in CRITERIA.items():
        if hunts and not criterion.counts_in_hunting:
            continue
        least = 100 * band if metric == "RemainingError" else 0.0  # inside the band no error counts
        before, after = (max(least, float(table[c][metric])) for c in ("without", "with"))
        share = MIN_CURE if hunts and after < before else criterion.relative
        room = max(criterion.absolute, share * max(before, after))
        if before == after or (isfinite(before) == isfinite(after) and abs(after - before) <= room):
            continue
        signs.append(1 if after < before else -1)
        shown = [_format_metric(metric, float(table[c][metric]), loop) for c in ("without", "with")]
        word = "better" if after < before else "worse"
        reasons.append(f"{word}: {criterion.label} {shown[0]} without, {shown[1]} with it")
    if not signs:
        kept = ("RemainingError",) if hunts else ("SettlingTimeRaw", "SteadyStateError")
        figures = [f"{CRITERIA[m].label} {_format_metric(m, float(table['with'][m]), loop)}" for m in kept]
        reasons.append(f"nothing changes: {'it still hunts, ' if hunts else ''}{', '.join(figures)}")
    reasons.append("price: " + ", ".join(_price_clause(n, table, loop) for n in PRICE_METRICS if n in table.index))
    verdict = Usefulness.USELESS if not signs else Usefulness.USEFUL if signs[0] > 0 else Usefulness.HARMFUL
    return verdict, tuple(reasons)


def _price_clause(metric: str, table: "pd.DataFrame", loop: ClosedLoop) -> str:
    before, after = (_format_metric(metric, float(table[c][metric]), loop) for c in ("without", "with"))
    return f"{PRICE_METRICS[metric]} {after} (without {before})"


def _format_metric(metric: str, value: float, loop: ClosedLoop) -> str:
    if metric == "RemainingError":
        return f"{value:.3g} %"
    if metric in ("SettlingTime", "SettlingTimeRaw") and value == inf:
        return "never"
    if metric == "Ripple":
        return format_with_prefix(value, loop.feedback.unit)
    return f"{value:.3g} {METRICS[metric].shown_unit(loop.command.unit, loop.feedback.unit)}".rstrip()
