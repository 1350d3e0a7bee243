"""`dither_effect`: what a dither moves, by harmonic balance of the nonlinear plant, and why it acts as it does."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan, nan, pi

import casadi as ca
import numpy as np

from pneuopt.control.averaging import ripple
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.hooks import Axis, FinalElement, Rest
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.response import command_range
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet

# Share of the static friction below which a dither's force on a body at rest is said not to loosen it: the
# command gives the rest of the force, so a dither may loosen with less than all of it; lower promises too much.
MIN_LOOSENING_FORCE = 0.5


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
    """Sentence for a dither that moves the measured signal out of the settling band; None for others.

    Parameters
    ----------
    loop : ClosedLoop
    references : sequence of Reference
    parameters : ParameterSet
        Values with the dither's amplitude and frequency.
    band : float or Tolerance
        Half width of the settling band, a fraction of the step or in the measured unit.
    """
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


def _operating_points(
    loop: ClosedLoop, axis: Axis, reference: Reference, speed: float | None
) -> tuple[dict[str, float], dict[str, float]]:
    """What is known of the plant where the body moves, half way of a step in position, and where it is held."""
    if loop.feedback.name == axis.position:
        half = (reference.initial + reference.final) / 2
        fast = reference.size / (reference.horizon - reference.at) if speed is None else speed
        return {axis.position: half, axis.speed: fast}, {axis.position: reference.origin, **reference.start}
    start = {n: v for n, v in reference.start.items() if n == axis.position}
    fast = (reference.final or reference.initial) if speed is None else speed
    return {axis.speed: fast, **start}, {axis.speed: reference.origin, **reference.start}


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
        force = format_with_prefix(e.force, axis.force)
        sentences.append(f"the force on a {axis.noun} at rest swings by +-{force}{against}{weak}")
    if not isnan(e.speed):
        unit = next(q.unit for q in loop.plant.states if q.name == axis.speed)
        speed, travel = format_with_prefix(e.speed, unit), format_with_prefix(e.travel, unit.removesuffix("/s"))
        sentences.append(f"a moving {axis.noun} swings by +-{speed} and +-{travel}")
    if axis.final_element is not None and not isnan(e.drive_frequency):
        ratio = e.frequency / e.drive_frequency
        natural = f"the {e.drive_frequency:.3g} Hz at which the load swings on the {axis.final_element.medium}"
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


def _add_effect_at_rest(
    found: DitherEffect,
    loop: ClosedLoop,
    axis: Axis,
    element: FinalElement,
    known: Mapping[str, float],
    full: ParameterSet,
) -> DitherEffect:
    """Add what the dither moves where the body is held at rest: the final element, and the force behind it."""
    rest = _try_rest(loop.plant, full, known)
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
