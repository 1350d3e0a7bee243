"""`judge_dither` and `judge_compensators`: whether what is added to a command against friction is useful, and why.

The loop's responses with it and a rival's without it are compared, each continued until it is plain how it ends, ripple
included (`DitheredEnding`). `dither_effect` adds what a dither moves, by harmonic balance of the plant.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf, isfinite, isnan, nan, pi
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from pneuopt.control.averaging import ripple
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.hooks import Axis, FinalElement, Rest
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.certificate import Ending, continue_response
from pneuopt.evaluation.evaluate import CaseEvaluation, evaluate_cases
from pneuopt.evaluation.metric import Band, band_share, describe_ripple, entry_for_good, measure_ripple, period_mean
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.response import command_range
from pneuopt.evaluation.tolerances import (
    FINAL_PERIODS,
    MAX_RIPPLE_SHARE,
    MIN_CURE,
    MIN_CYCLES,
    MIN_LOOSENING_FORCE,
    TAIL_SHARE,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet, check_parameters
from pneuopt.quantities.report import Report, Tone, report_verdict
from pneuopt.quantities.results import Result

if TYPE_CHECKING:
    import pandas as pd


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


class DitherCriterion(NamedTuple):
    """A criterion on dithers: a metric's label and the changes of which the larger counts, absolute and relative."""

    label: str
    absolute: float
    relative: float
    counts_in_hunting: bool = True


CRITERIA: Mapping[str, DitherCriterion] = {  # where some improve and others do not, the first that changes decides
    "RemainingError": DitherCriterion("largest error in the end, ripple included", 0.5, 0.05),  # [%]
    "SettlingTimeRaw": DitherCriterion("settling time, ripple included", 0.0, 0.05),
    "SettlingTime": DitherCriterion("settling time of the mean", 0.0, 0.05),
    "SteadyStateError": DitherCriterion("error of the mean in the end", 0.5, 0.0),  # [%]
    "IAE": DitherCriterion("integral of the error", 0.0, 0.05, counts_in_hunting=False),
    "Overshoot": DitherCriterion("overshoot", 1.0, 0.0, counts_in_hunting=False),  # [%]
}
NO_RIVAL = "gains tuned without dither may do as well: none were compared (tune_without_dither finds them)"
PRICE_METRICS = {
    "Ripple": "ripple",
    "AirUse": "air consumption",
    "ValveTravel": "valve travel",
    "PeakControl": "largest command",
}


@dataclass(frozen=True)
class DitherEffect:
    """Amplitudes that a dither causes, by harmonic balance of the nonlinear plant; NaN where they are not known."""

    amplitude: float  # [command's unit]
    frequency: float  # [Hz]
    spool: float = nan  # of the final element's moving part, a valve's spool [half travels]
    valve_gain: float = nan  # ratio of the spool's amplitude to the command's, which the valve's lag reduces [1]
    force: float = nan  # on a body held fast at rest [the axis's unit of force]
    speed: float = nan  # of a body that moves at the reference's final speed [its speed's unit]
    travel: float = nan  # of that body [its speed's unit times s]
    drive_frequency: float = nan  # natural frequency of the load on the air in the chambers, without friction [Hz]


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
    before, after = (_read_endings(loop, steps, p, band) for p in (plain, full))
    effect = dither_effect(loop, steps[0], full, speed=after[0].speed)
    axis, signal, objections = loop.plant.axis or Axis(), loop.feedback, list[str]()
    moving = {axis.speed: effect.speed, axis.position: effect.travel}.get(signal.name, nan)
    for step, ending in zip(steps, after, strict=True):  # the swing in the end, or while the body moves
        swing, size = max(ending.ripple, 0.0 if isnan(moving) else 2 * moving), abs(step.nominal_size)
        if swing >= MAX_RIPPLE_SHARE * size:
            swings = f"{signal.name} by {format_with_prefix(swing, signal.unit)} from peak to peak"
            objections.append(f"worse: the dither swings {swings}, {100 * swing / size:.0f} % of the step")
    found = _compare(before, after, objections, is_tuned=without is not None)
    reasons = (*found.reasons, *explain_effect(loop, effect, full))
    return DitherVerdict(found.usefulness, reasons, found.table, effect, found.baseline, loop.command.unit)


@dataclass(frozen=True, eq=False, repr=False)
class CompensatorVerdict(Result):
    """Verdict of `judge_compensators`: as text, the verdict in the first line and a reason in each further line.

    Attributes
    ----------
    usefulness : Usefulness
    reasons : tuple of str
        What decided, the price, and how the loops end, a sentence each.
    table : DataFrame
        As that of a `DitherVerdict`: a row for each metric, columns "without" and "with".
    baseline : str
        What "without" stands for: the same gains, or gains tuned without the compensators.
    names : tuple of str
        Of the compensators, as in a tuning's file.
    """

    usefulness: Usefulness
    reasons: tuple[str, ...]
    table: "pd.DataFrame"
    baseline: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        parts = " and ".join(f"the {name.replace('_', ' ')}" for name in self.names)
        head = f"{parts} {'are' if len(self.names) > 1 else 'is'} {self.usefulness.value}, against {self.baseline}"
        return "\n".join([head, *(f"  {reason}" for reason in self.reasons)])

    def summary(self) -> Report:
        """The verdict, then a reason a line."""
        return report_verdict(str(self), VERDICT_TONES[self.usefulness])


def judge_compensators(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    without: ParameterSet | None = None,
    band: Band = 0.02,
) -> CompensatorVerdict:
    """Evaluate a loop with its compensators and a rival without them, and say whether they are useful, and why.

    The criteria are those of `judge_dither`, in the same order. A dither that the loop has besides is in both.

    Parameters
    ----------
    loop : ClosedLoop
    references : Reference or sequence of Reference
    parameters : ParameterSet
        Values of the design with the compensators.
    without : ParameterSet, optional
        The rival: values tuned without them. By default the same gains, which are tuned for the compensators, so that
        the verdict is "useful with these gains" at best.
    band : float
        Half width of the settling band, a fraction of the step.

    Raises
    ------
    InputError
        If there is no compensator to judge.
    ConvergenceError
        If a simulation stops.
    """
    check_closed_loop(loop)
    check_parameters(parameters)
    require(bool(loop.compensators), "there is nothing to judge: ClosedLoop(plant, pid, compensators=(Knocker(),))")
    steps, full, bare = as_references(references), loop.complete(parameters), replace(loop, compensators=())
    plain = (full if without is None else full | without).select(bare.parameters)
    before, after = (_read_endings(one, steps, p, band) for one, p in ((bare, plain), (loop, full)))
    sections = tuple(c.section for c in loop.compensators)
    return CompensatorVerdict(*_compare(before, after, [], is_tuned=without is not None), sections)


@dataclass(frozen=True, eq=False)
class DitheredEnding:
    """Ending of a response, its dither's ripple included."""

    # Those of `evaluate`, with the settling times and the error of the continued response, infinite where it never
    # settles, and RemainingError, the largest error of the signal itself over the last cycles [% of the step].
    metrics: dict[str, float]
    ending: Ending
    ripple: float  # peak to peak of its dither's ripple in the end [measured unit]
    speed: float | None  # the largest mean speed of a positioned body [its unit]; None where the reference is a speed
    ripple_note: str | None  # sentence where only the mean settles

    def describe(self, which: str) -> Iterator[str]:
        """Sentences on an ending that a table of metrics does not show; `which` is "with" or "without" the dither."""
        response, cycle = self.ending.response, self.ending.cycle
        if cycle is not None:
            yield f"{which} it the loop ends in {cycle.describe(response.loop.feedback.unit)}"
        if self.ripple_note is not None:
            yield self.ripple_note
        if response.contact and self.ending.hunts:
            until = f"{response.t[-1]:.3g} s after the step"
            yield f"{which} it the response is judged until {until}: {response.contact}"


class _Comparison(NamedTuple):
    """A design and its rival: the verdict, its reasons, the worst metrics of each, and what the rival is."""

    usefulness: Usefulness
    reasons: tuple[str, ...]
    table: "pd.DataFrame"
    baseline: str


def _compare(
    before: Sequence[DitheredEnding], after: Sequence[DitheredEnding], objections: list[str], *, is_tuned: bool
) -> _Comparison:
    """Compare endings over the references; a rival that is not tuned leaves "useful with these gains" at best."""
    import pandas as pd

    designs = {"without": before, "with": after}
    table = pd.DataFrame({n: pd.DataFrame([e.metrics for e in endings]).max() for n, endings in designs.items()})
    hunts, narrowest = any(e.ending.hunts for e in after), min(e.ending.band for e in after)
    usefulness, changes = _weigh_changes(table, narrowest, after[0].ending.response.loop, objections, hunts=hunts)
    notes = [note for which, endings in designs.items() for e in endings for note in e.describe(which)]
    if is_tuned:
        return _Comparison(usefulness, (*changes, *dict.fromkeys(notes)), table, "gains tuned without it")
    usefulness = Usefulness.HELPS_THESE_GAINS if usefulness is Usefulness.USEFUL else usefulness
    return _Comparison(usefulness, (*changes, *dict.fromkeys([*notes, NO_RIVAL])), table, "the same gains without it")


def _weigh_changes(
    table: "pd.DataFrame", band: float, loop: ClosedLoop, objections: list[str], *, hunts: bool
) -> tuple[Usefulness, tuple[str, ...]]:
    """Verdict and its reasons, from objections known beforehand and the metrics' changes, in hunting of some only."""
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
    prices = []
    for metric, name in ((n, name) for n, name in PRICE_METRICS.items() if n in table.index):
        shown = [_format_metric(metric, float(table[c][metric]), loop) for c in ("with", "without")]
        prices.append(f"{name} {shown[0]} (without {shown[1]})")
    reasons.append("price: " + ", ".join(prices))
    verdict = Usefulness.USELESS if not signs else Usefulness.USEFUL if signs[0] > 0 else Usefulness.HARMFUL
    return verdict, tuple(reasons)


def _format_metric(metric: str, value: float, loop: ClosedLoop) -> str:
    if metric == "RemainingError":
        return f"{value:.3g} %"
    if metric in ("SettlingTime", "SettlingTimeRaw") and value == inf:
        return "never"
    if metric == "Ripple":
        return format_with_prefix(value, loop.feedback.unit)
    return f"{value:.3g} {METRICS[metric].shown_unit(loop.command.unit, loop.feedback.unit)}".rstrip()


def _read_endings(
    loop: ClosedLoop, steps: Sequence[Reference], parameters: ParameterSet, band: Band
) -> list[DitheredEnding]:
    """Endings of a loop's responses, one for each reference."""
    return [read_ending(found, band) for found in evaluate_cases(loop, steps, parameters, band=band)]


def read_ending(found: CaseEvaluation, band: Band) -> DitheredEnding:
    """Continue a response until it stands, shows whether it hunts or meets a limit, and read how it ends."""
    share, size = band_share(band, found.case.reference), abs(found.case.reference.nominal_size)
    response = continue_response(found, share)
    ending, judged = Ending(response, share, found.case.label), response.before_contact
    begin, mean = begin_of_end(ending), np.abs(response.error)
    t, raw = response.t[judged], np.abs(response.signal[judged] - response.reference.final) / size
    errors = {
        "RemainingError": 100 * float(raw[t >= begin].max()),
        "SteadyStateError": 100 * float(mean[response.times >= begin].max()),
    }
    settled = {
        "SettlingTime": _settling_time(ending, found.metrics["SettlingTime"], response.times, mean),
        "SettlingTimeRaw": _settling_time(ending, found.metrics["SettlingTimeRaw"], t, raw),
    }
    swing = 0.0
    if response.period is not None:
        signal, k = response.signal[None], len(response.times)
        means = period_mean(response.t, signal, response.reference.initial, response.period, response.times)
        swing = float(measure_ripple(response.times, signal[:, :k] - means, response.period)[0])
    metrics, note = {**found.metrics, **errors, **settled}, describe_ripple(found.metrics, size, share)
    axis, run, fastest = found.loop.plant.axis, found.response, None  # the largest mean speed within the horizon
    if axis is not None and found.loop.feedback.name == axis.position and axis.speed in run:
        speed, period = run[axis.speed], found.loop.dither_period(found.parameters)
        if period is not None and period <= run.t[-1] - run.t[0]:
            at = run.t[run.t <= run.t[-1] - period / 2]
            speed = period_mean(run.t, speed[None], float(speed[0]), period, at)[0]
        fastest = float(speed[np.abs(speed).argmax()])
    return DitheredEnding(metrics, ending, swing, fastest, note)


def begin_of_end(ending: Ending) -> float:
    """Instant from which the error counts as the one in the end: that of the last cycles of a loop that hunts [s].

    It lies before the last instant at which a mean over the dither's period is known.
    """
    end, cycle = float(ending.response.times[-1]), ending.cycle
    if cycle is not None:
        return end - MIN_CYCLES / cycle.frequency
    if ending.stands or ending.drifts:
        return end - max(TAIL_SHARE * end, FINAL_PERIODS * (ending.response.period or 0.0))
    return end / 2


def _settling_time(ending: Ending, within_horizon: float, t: Array, error: Array) -> float:
    """Settling time within the horizon unless the continuation refutes it; else its own; infinite for never [s]."""
    holds = isfinite(within_horizon) and not ending.leaves(t, error)
    return within_horizon if holds else entry_for_good(t, ending.is_inside(error))


def dither_effect(
    loop: ClosedLoop, reference: Reference, parameters: ParameterSet, *, speed: float | None = None
) -> DitherEffect:
    """Amplitudes that the dither causes: the motion and, behind a final element, its travel and force.

    Parameters
    ----------
    loop : ClosedLoop
    reference : Reference
        The body is held at its start.
    parameters : ParameterSet
        Values with the dither's amplitude and frequency.
    speed : float, optional
        Speed at which the body moves [its unit]; by default the reference's final value where the loop feeds back a
        speed, and otherwise the step's size over the time that is left to make it.
    """
    full = loop.complete(parameters)
    found = DitherEffect(full.value(DITHER_AMPLITUDE), full.value(DITHER_FREQUENCY))
    axis = loop.plant.axis or Axis()
    moves, held = _operating_points(loop, axis, reference, speed)
    moving = _state_harmonics(loop, loop.plant, full, _try_rest(loop.plant, full, moves))
    if axis.speed in moving:
        swing = abs(moving[axis.speed])
        found = replace(found, speed=swing, travel=swing / (2 * pi * found.frequency))
    if axis.final_element is None:
        return found
    return _add_effect_at_rest(found, loop, axis, axis.final_element, held, full)


def describe_swing(
    loop: ClosedLoop, references: Sequence[Reference], parameters: ParameterSet, band: Band
) -> str | None:
    """Sentence for a dither that moves the measured signal out of the settling band; None for others."""
    full, step = loop.complete(parameters), min(references, key=lambda r: abs(r.nominal_size))
    if loop.dither_period(full) is None:
        return None
    moves, _ = _operating_points(loop, loop.plant.axis or Axis(), step, None)
    moving = _state_harmonics(loop, loop.plant, full, _try_rest(loop.plant, full, moves))
    share = band_share(band, step)
    swing, half = abs(moving.get(loop.feedback.name, 0.0)), share * abs(step.nominal_size)
    if swing <= half:
        return None
    signal, command = loop.feedback, loop.command
    amplitude, frequency = full.value(DITHER_AMPLITUDE), full.value(DITHER_FREQUENCY)
    swings, allowed = (format_with_prefix(v, signal.unit) for v in (swing, half))
    return (
        f"the given dither of {amplitude:.3g} {command.unit} at {frequency:.4g} Hz swings the {signal.name} by "
        f"+-{swings}, beyond the settling band of +-{allowed} (+-{100 * share:.3g} % of step {step.label}): only the "
        f"mean over its period can settle; lower {DITHER_AMPLITUDE}, raise {DITHER_FREQUENCY}, or widen the band"
    )


def explain_effect(loop: ClosedLoop, effect: DitherEffect, parameters: ParameterSet) -> tuple[str, ...]:
    """Sentences on why the dither acts as it does: clipping, lag and dead zone, static friction, motion."""
    p, e, sentences = parameters, effect, list[str]()
    axis = loop.plant.axis or Axis()
    element = axis.final_element
    low, high, whose = command_range(loop, p)
    least, most = (p.value(DITHER_OFFSET) + side * p.value(DITHER_AMPLITUDE) for side in (-1, 1))
    if least < low or most > high:
        reached = f"offset and amplitude alone reach {least:.3g} to {most:.3g} {loop.command.unit}"
        ends = f"{whose} ends at {low:.3g} and {high:.3g} {loop.command.unit}"
        sentences.append(f"{reached}, and {ends}: the peaks are cut")
    if element is not None and not isnan(e.valve_gain):
        dead = p.value(element.dead_zone)
        lag = f" at {p.value(element.bandwidth):.3g} Hz bandwidth" if element.bandwidth in p else ""
        zone = f", {'beyond' if e.spool > dead else 'within'} its dead zone of {dead:.3g}" if dead > 0 else ""
        follows = f"the {element.moving_part} follows {100 * e.valve_gain:.0f} % of the dither{lag}"
        sentences.append(f"{follows} and swings by +-{e.spool:.2g} of its half travel{zone}")
    static = next((p.value(f"friction.{n}") for n in ("static", "coulomb") if f"friction.{n}" in p), nan)
    if not isnan(e.force):
        against = "" if isnan(static) else f" against a static friction of {static:.3g} {axis.force}"
        weak = ": too little to loosen it" if e.force < MIN_LOOSENING_FORCE * static else ""
        force = format_with_prefix(e.force, axis.force)
        sentences.append(f"the force on a {axis.noun} at rest swings by +-{force}{against}{weak}")
    if not isnan(e.speed):
        unit = next(q.unit for q in loop.plant.states if q.name == axis.speed)
        speed, travel = format_with_prefix(e.speed, unit), format_with_prefix(e.travel, unit.removesuffix("/s"))
        sentences.append(f"a moving {axis.noun} swings by +-{speed} and +-{travel}")
    if element is not None and not isnan(e.drive_frequency):
        ratio = e.frequency / e.drive_frequency
        natural = f"the {e.drive_frequency:.3g} Hz at which the load swings on the {element.medium}"
        sentences.append(f"the dither's {e.frequency:.3g} Hz are {ratio:.2g} times {natural}")
    return tuple(sentences)


def format_with_prefix(value: float, unit: str) -> str:
    """Value with its unit and an SI prefix that avoids leading zeros.

    Examples
    --------
    >>> format_with_prefix(0.00076, "N"), format_with_prefix(6.4e-11, "m"), format_with_prefix(12.1, "N")
    ('0.76 mN', '0.064 nm', '12 N')
    """
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "u"), (1e9, "n")):
        if abs(value) * factor >= 0.1 or prefix == "n" or value == 0:
            break
    return f"{value * factor:.2g} {prefix}{unit}"


def _operating_points(
    loop: ClosedLoop, axis: Axis, reference: Reference, speed: float | None
) -> tuple[dict[str, float], dict[str, float]]:
    """Known values of the plant where the body moves, half way of a step in position, and where it is held."""
    if loop.feedback.name == axis.position:
        half = (reference.initial + reference.final) / 2
        fast = reference.size / (reference.horizon - reference.at) if speed is None else speed
        return {axis.position: half, axis.speed: fast}, {axis.position: reference.origin, **reference.start}
    start = {n: v for n, v in reference.start.items() if n == axis.position}
    fast = (reference.final or reference.initial) if speed is None else speed
    return {axis.speed: fast, **start}, {axis.speed: reference.origin, **reference.start}


def _add_effect_at_rest(
    found: DitherEffect,
    loop: ClosedLoop,
    axis: Axis,
    element: FinalElement,
    known: Mapping[str, float],
    full: ParameterSet,
) -> DitherEffect:
    """Add what the dither moves where the body is held at rest: the final element, and the force behind it."""
    plant, rest = loop.plant, _try_rest(loop.plant, full, known)
    t, x, u, p = (ca.SX.sym(n, plant.ode.size1_in(k)) for k, n in enumerate("txup"))
    xdot, y = plant.ode(t, x, u, p)
    clamped = [n in (axis.position, axis.speed) or n.startswith("friction.") for n in names(plant.states)]
    rates = ca.vertcat(*(ca.SX(0) if c else xdot[k] for k, c in enumerate(clamped)))
    ode = ca.Function("ode", [t, x, u, p], [rates, y], ["t", "x", "u", "p"], ["xdot", "y"])
    held = _state_harmonics(loop, replace(plant, ode=ode), full, rest)
    if rest is None or not held:
        return found
    command = found.amplitude / full.value(element.limit)
    spool = abs(held[element.stroke]) if element.stroke in held else min(1.0, command)
    linear = plant.linearise(np.array([*rest.states.values()]), rest.inputs, full)
    row = dict(zip(linear.states, linear.A[linear.states.index(axis.speed)], strict=True))
    force = full.value(axis.inertia) * abs(sum(row[n] * held[n] for n in element.pushing))
    kept = [linear.states.index(n) for n in (axis.speed, *element.pushing)]
    block = linear.A[np.ix_(kept, kept)]
    block[0, 0] = 0.0  # without friction
    rate = float(np.abs(np.linalg.eigvals(block)).max())
    return replace(found, spool=spool, valve_gain=spool / command, force=float(force), drive_frequency=rate / (2 * pi))


def _try_rest(plant: System, p: ParameterSet, known: Mapping[str, float]) -> Rest | None:
    """Rest or steady motion of the plant with these values; None where there is none."""
    if plant.rest_hook is None:
        return None
    try:
        return plant.rest_hook(p, known)
    except (InputError, ConvergenceError):
        return None


def _state_harmonics(loop: ClosedLoop, plant: System, p: ParameterSet, rest: Rest | None) -> dict[str, complex]:
    """First harmonics of the states about a rest; empty where the harmonic balance does not converge."""
    assert loop.dither is not None
    at = None if rest is None else {**rest.states, **rest.inputs}
    try:
        return ripple(plant, p, at=at, actuated=loop.command.name, waveform=loop.dither.waveform)
    except ConvergenceError:
        return {}
