"""`judge_dither`: whether a dither is useful: the loop's metrics with and without it, and what the dither moves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf, isfinite, isnan, nan, pi
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from pneuopt.control.averaging import ripple
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Step, as_steps
from pneuopt.dynamics.hooks import Axis, FinalElement, Rest
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.response import command_range
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd

# Amplitude of the loop "without" dither, as a share of the judged one: at zero its means would not be read over the
# same periods; a much larger one would act as a dither.
NEGLIGIBLE_AMPLITUDE = 1e-9
# Share of the static friction below which a dither's force on a body at rest is said not to loosen it: the
# command gives the rest of the force, so a dither may loosen with less than all of it; lower promises too much.
MIN_LOOSENING_FORCE = 0.5


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


@dataclass(frozen=True)
class DitherEffect:
    """Amplitudes that a dither causes, by harmonic balance of the nonlinear plant; NaN where they are not known.

    Attributes
    ----------
    amplitude, frequency : float
        [command's unit], [Hz]
    spool : float
        Amplitude of the final element's moving part, a valve's spool [half travels].
    valve_gain : float
        Ratio of the spool's amplitude to the command's, which the valve's lag reduces [1].
    force : float
        Amplitude of the force on a body held fast at rest [the axis's unit of force].
    speed, travel : float
        Amplitudes of a body that moves at the reference's final speed [its speed's unit], [that times s].
    drive_frequency : float
        Natural frequency of the load on the element's medium, the air in the chambers, without friction [Hz].
    """

    amplitude: float
    frequency: float
    spool: float = nan
    valve_gain: float = nan
    force: float = nan
    speed: float = nan
    travel: float = nan
    drive_frequency: float = nan


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
    size = _format_with_prefix(swing, loop.feedback.unit)
    coarse = [f"worse: the dither swings {loop.feedback.name} by {size}, more than the step itself"]
    coarse = coarse if swing > min(sizes) else []
    usefulness, found = _weigh_changes(table, max(sizes), loop, coarse)
    rival = "the same gains without it" if without is None else "a design of its own without it"
    return DitherVerdict(
        usefulness, (*found, *explain_effect(loop, effect, full)), table, effect, rival, loop.command.unit
    )


def dither_effect(loop: ClosedLoop, reference: Step, parameters: ParameterSet) -> DitherEffect:
    """Amplitudes that the dither causes: the motion and, behind a final element, its travel and force.

    Parameters
    ----------
    loop : ClosedLoop
    reference : Step
        The body moves at its final value, and is held at its start.
    parameters : ParameterSet
        Values with the dither's amplitude and frequency.
    """
    full = loop.complete(parameters)
    found = DitherEffect(full.value(DITHER_AMPLITUDE), full.value(DITHER_FREQUENCY))
    axis = loop.plant.axis or Axis()
    moving = _state_harmonics(loop, loop.plant, full, _try_rest(loop.plant, full, {axis.speed: reference.final}))
    if axis.speed in moving:
        speed = abs(moving[axis.speed])
        found = replace(found, speed=speed, travel=speed / (2 * pi * found.frequency))
    if axis.final_element is None:
        return found
    return _add_effect_at_rest(found, loop, axis, axis.final_element, reference, full)


def explain_effect(loop: ClosedLoop, effect: DitherEffect, parameters: ParameterSet) -> tuple[str, ...]:
    """Sentences on why the dither acts as it does: clipping, lag and dead zone, static friction, motion.

    Parameters
    ----------
    loop : ClosedLoop
    effect : DitherEffect
    parameters : ParameterSet
        Every parameter of the loop.
    """
    p, e, sentences = parameters, effect, list[str]()
    sentences += _describe_clipping(loop, p)
    axis = loop.plant.axis or Axis()
    if axis.final_element is not None and not isnan(e.valve_gain):
        sentences.append(_describe_final_element(axis.final_element, e, p))
    static = next((p.value(f"friction.{n}") for n in ("static", "coulomb") if f"friction.{n}" in p), nan)
    if not isnan(e.force):
        against = "" if isnan(static) else f" against a static friction of {static:.3g} {axis.force}"
        weak = ": too little to loosen it" if e.force < MIN_LOOSENING_FORCE * static else ""
        force = _format_with_prefix(e.force, axis.force)
        sentences.append(f"the force on a {axis.noun} at rest swings by +-{force}{against}{weak}")
    if not isnan(e.speed):
        unit = next(q.unit for q in loop.plant.states if q.name == axis.speed)
        speed, travel = _format_with_prefix(e.speed, unit), _format_with_prefix(e.travel, unit.removesuffix("/s"))
        sentences.append(f"a moving {axis.noun} swings by +-{speed} and +-{travel}")
    if axis.final_element is not None and not isnan(e.drive_frequency):
        ratio = e.frequency / e.drive_frequency
        natural = f"the {e.drive_frequency:.3g} Hz at which the load swings on the {axis.final_element.medium}"
        sentences.append(f"the dither's {e.frequency:.3g} Hz are {ratio:.2g} times {natural}")
    return tuple(sentences)


def _add_effect_at_rest(
    found: DitherEffect, loop: ClosedLoop, axis: Axis, element: FinalElement, reference: Step, full: ParameterSet
) -> DitherEffect:
    """Add what the dither moves where the body is held at rest: the final element, and the force behind it."""
    rest = _try_rest(loop.plant, full, {axis.speed: reference.initial, **reference.start})
    held = _state_harmonics(loop, _clamp_body(loop.plant, axis), full, rest)
    if rest is None or not held:
        return found
    command = found.amplitude / full.value(element.limit)
    spool = abs(held[element.stroke]) if element.stroke in held else min(1.0, command)
    linear = loop.plant.linearise(np.array([*rest.states.values()]), rest.inputs, full)
    row = dict(zip(linear.states, linear.A[linear.states.index(axis.speed)], strict=True))
    force = full.value(axis.inertia) * abs(sum(row[n] * held[n] for n in element.pushing))
    kept = [linear.states.index(n) for n in (axis.speed, *element.pushing)]
    block = linear.A[np.ix_(kept, kept)]
    block[0, 0] = 0.0  # without friction
    rate = float(np.abs(np.linalg.eigvals(block)).max())
    return replace(found, spool=spool, valve_gain=spool / command, force=float(force), drive_frequency=rate / (2 * pi))


def _describe_final_element(element: FinalElement, e: DitherEffect, p: ParameterSet) -> str:
    """Sentence on how far the final element follows the dither, and on its dead zone."""
    dead = p.value(element.dead_zone)
    lag = f" at {p.value(element.bandwidth):.3g} Hz bandwidth" if element.bandwidth in p else ""
    zone = f", {'beyond' if e.spool > dead else 'within'} its dead zone of {dead:.3g}" if dead > 0 else ""
    follows = f"the {element.moving_part} follows {100 * e.valve_gain:.0f} % of the dither{lag}"
    return f"{follows} and swings by +-{e.spool:.2g} of its half travel{zone}"


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
        return _format_with_prefix(value, loop.feedback.unit)
    return f"{value:.3g} {METRICS[metric].shown_unit(loop.command.unit, loop.feedback.unit)}".rstrip()


def _format_with_prefix(value: float, unit: str) -> str:
    """Value with its unit and an SI prefix that avoids leading zeros.

    Examples
    --------
    >>> _format_with_prefix(0.00076, "N"), _format_with_prefix(6.4e-11, "m"), _format_with_prefix(12.1, "N")
    ('0.76 mN', '0.064 nm', '12 N')
    """
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "u"), (1e9, "n")):
        if abs(value) * factor >= 0.1 or prefix == "n" or value == 0:
            break
    return f"{value * factor:.2g} {prefix}{unit}"


def _describe_clipping(loop: ClosedLoop, p: ParameterSet) -> list[str]:
    """Sentence where offset and amplitude alone exceed the limits of command or final element; none otherwise."""
    low, high, whose = command_range(loop, p)
    least, most = (p.value(DITHER_OFFSET) + side * p.value(DITHER_AMPLITUDE) for side in (-1, 1))
    if low <= least and most <= high:
        return []
    unit = loop.command.unit
    return [
        f"offset and amplitude alone reach {least:.3g} to {most:.3g} {unit}, and {whose} ends at {low:.3g} and "
        f"{high:.3g} {unit}: the peaks are cut"
    ]


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


def _clamp_body(plant: System, axis: Axis) -> System:
    """The plant with its body clamped: position, speed and friction states have no rate."""
    t, x, u, p = (ca.SX.sym(n, plant.ode.size1_in(k)) for k, n in enumerate("txup"))
    xdot, y = plant.ode(t, x, u, p)
    clamped = [n in (axis.position, axis.speed) or n.startswith("friction.") for n in names(plant.states)]
    rates = ca.vertcat(*(ca.SX(0) if c else xdot[k] for k, c in enumerate(clamped)))
    return replace(plant, ode=ca.Function("ode", [t, x, u, p], [rates, y], ["t", "x", "u", "p"], ["xdot", "y"]))
