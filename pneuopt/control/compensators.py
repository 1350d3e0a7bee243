"""Compensators: parts that add to the PID's command, feedforward or feedback of their own; a new one is written here.

They act in the order in which the loop has them, each on the command of those before it, after feedforward and before
dither and clip: what they add counts for the limits, and back-calculation unwinds it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from math import inf
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, runtime_checkable

import casadi as ca

from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, SensedSignal, Signals
from pneuopt.control.tolerances import (
    FALL_EXPONENT,
    LEAST_DIVISOR,
    LEAST_RISE,
    LEAST_WAY,
    MIN_FILTER_TIME,
    PULSE_SHARE,
    RISE_EXPONENT,
    SHORTEST_TIME,
    STANDSTILL_SHARE,
)
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, with_prefix, without_prefix
from pneuopt.quantities.units import difference_unit, unit_ratio


@dataclass(frozen=True)
class ControllerSnapshot:
    """What a compensator sees at an instant."""

    t: Any  # [s]
    reference: Any
    measured: Any
    command: Any  # so far, by the parts before
    sample_time: float | None  # [s], None of a continuous controller
    rates: Mapping[str, Any] = field(default_factory=dict)  # the motion inputs that the part uses
    readings: Mapping[str, Any] = field(default_factory=dict)  # the plant's outputs
    error: Any = 0.0  # of what the loop is judged by, in a cascade the position; a rest, where parts start, has none
    elapsed: Any = None  # [s] since the last good sample, over which differences are taken


@runtime_checkable
class Compensator(Protocol):
    """A frozen dataclass that adds to the command.

    Attributes
    ----------
    section : str
        Its section in a tuning's file, and the prefix of its parameters and states.
    size : str
        The parameter that is zero by default, with which it adds nothing.
    acts_always : bool
        Whether it is a function of the present command and signals, which the loop's rest and its linearisation
        include; a pulse is not, and is left out of them, as a dither is.
    without_gradient : tuple of str
        Parameters on which the response does not depend smoothly.

    A part with states is linear in them and in the signals that it remembers: `start` gives those of a loop at rest.
    """

    section: ClassVar[str]
    size: ClassVar[str]
    acts_always: ClassVar[bool]
    without_gradient: ClassVar[tuple[str, ...]]

    def check(self, on: SensedSignal, axis: Axis | None) -> None:
        """Raise `ModelError` where it does not fit the loop's signal, its plant or its sample time."""

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Its parameters for a signal and a command's unit; a value outside their bounds cannot run."""

    def reads(self, on: SensedSignal) -> tuple[str, ...]:
        """Outputs of the plant that it reads beside the loop's own signal."""

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """Rates of the reference that it uses: names of the loop's inputs."""

    def states(self, on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """What it remembers."""

    def start(self, on: SensedSignal, seen: ControllerSnapshot) -> list[Any]:
        """The states in a loop whose signals have been constant so far, or with a sampled PID since the last sample."""

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states' rates, or with a sampled PID their next values, and what it adds to the command."""


def check_compensators(given: object, on: SensedSignal, axis: Axis | None) -> None:
    """Refuse what is no tuple of compensators, two of one kind, and one that does not fit the loop."""
    parts = given if isinstance(given, tuple) else (given,)
    whole = isinstance(given, tuple) and all(isinstance(c, Compensator) and not isinstance(c, type) for c in parts)
    require(whole, f"compensators is a tuple of parts such as (Knocker(),), got {given!r}", ModelError)
    for n, part in enumerate(parts):
        same = any(part.section == other.section for other in parts[:n])
        require(not same, f"compensators has {type(part).__name__} twice; leave one out", ModelError)
        part.check(on, axis)
        absent = ", ".join(n for n in part.reads(on) if n not in on.outputs)
        had = f"the plant's outputs are {', '.join(on.outputs)}"
        told = f"{type(part).__name__} reads {absent}, which the plant does not have: {had}; leave it out"
        require(not absent, told, ModelError)


def check_values(
    compensators: Sequence[Compensator], known: ParameterSet, value: Mapping[str, float], count: float
) -> None:
    """Refuse a value beyond its part's bounds, and a tolerance that `count` of the sensor cannot tell from zero."""
    prefixes = tuple(f"{c.section}." for c in compensators)
    for name, q in known.items():
        runs = not name.startswith(prefixes) or q.lower <= value[name] <= q.upper
        require(runs, f"{name} must lie within [{q.lower:g}, {q.upper:g}] {q.unit}, got {value[name]:g}")
    for part in compensators:
        name = f"{part.section}.tolerance"
        if name in value and value[f"{part.section}.{part.size}"] > 0:
            told = f"{name} {value[name]:g} {known[name].unit} lies within a count of the sensor, {count:g}"
            require(value[name] > count, f"{told}: no error could be told from it; take at least {2 * count:g}")


def compensate(
    compensators: Sequence[Compensator], seen: ControllerSnapshot, x: Symbols, p: Symbols
) -> tuple[Signals, ca.SX]:
    """What compensators add, one after the other, to the command, and their states as `Compensator.act` has them."""
    moved, added = Signals(), ca.SX(0)
    for part in compensators:
        now = replace(seen, command=seen.command + added)
        own, more = part.act(now, without_prefix(x, part.section), without_prefix(p, part.section))
        moved, added = moved | with_prefix(own, part.section), added + more
    return moved, added


@dataclass(frozen=True)
class Knocker:
    """Pulses of one amplitude and width, a period apart, each in the direction in which the PID's command moves.

    At the onset t_k of a pulse ``s = tanh((u_c(t_k) - u_c(t_(k-1)))/smoothing)``, u_c the command of the PID and of
    the compensators before; for the width from there on ``amplitude s`` is added, then nothing until the next onset.
    So it knocks while the integral winds up against stiction, and is quiet once the command rests. Its signal u_c is
    the controller's, without the pulses. Onsets are whole periods from time zero; width and period are rounded to
    samples, at least one; a width of a period or more joins the pulses.

    T. Hägglund, A friction compensator for pneumatic control valves, J. Process Control 12 (2002) 897-904 (and US
    patent 6285913), with the sign in place of the smooth one. It is computed by a sampled controller, which therefore
    it needs. Its pulses are left out of the loop's rest and of its margins, as a dither is; nothing averages over them.
    """

    section: ClassVar[str] = "knocker"
    size: ClassVar[str] = "amplitude"
    acts_always: ClassVar[bool] = False
    without_gradient: ClassVar[tuple[str, ...]] = ("width", "period")

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a continuous controller."""
        told = "a Knocker is computed once a sample: give the PID a sample_time, such as PID(sample_time=1e-3)"
        require(on.sample_time is not None, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Amplitude, zero by default, and the change of the command that decides a direction [unit]; times [s].

        Examples
        --------
        >>> found = Knocker().parameters(SensedSignal(Quantity("speed", "m/s"), {}, 1e-3), "V")
        >>> [(n, p.value, p.unit) for n, p in found.items()]
        [('amplitude', 0.0, 'V'), ('width', 0.002, 's'), ('period', 0.01, 's'), ('smoothing', 0.01, 'V')]
        """
        change = "change of the command that decides a pulse's direction"
        return ParameterSet(
            {
                "amplitude": Parameter(0.0, unit, lower=0.0, meaning="height of the pulses"),
                "width": Parameter(2 * on.h, "s", lower=on.h, meaning="length of a pulse"),
                "period": Parameter(10 * on.h, "s", lower=on.h, meaning="time from pulse to pulse"),
                "smoothing": Parameter(0.01, unit, lower=LEAST_DIVISOR, meaning=change),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, _on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """The command and the direction at the last onset."""
        return replace(command, name="command"), Quantity("direction", "1")

    def start(self, _on: SensedSignal, seen: ControllerSnapshot) -> list[Any]:
        """The command so far, and no direction."""
        return [seen.command, 0.0]

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states after a sample, and the pulse [the command's unit]."""
        h = seen.sample_time or 1.0
        sample = ca.floor(seen.t / h + 0.5)
        width, period = (ca.fmax(1.0, ca.floor(p[n] / h + 0.5)) for n in ("width", "period"))
        phase = sample - period * ca.floor(sample / period)
        direction = ca.tanh((seen.command - x["command"]) / p["smoothing"])
        begins = phase < 1
        now = {
            "command": ca.if_else(begins, seen.command, x["command"]),
            "direction": ca.if_else(begins, direction, x["direction"]),
        }
        return now, p["amplitude"] * now["direction"] * (phase < width)


class Direction(Enum):
    """Whose direction counts: the reference's, which adds no feedback, or the measured speed's, which is feedback."""

    REFERENCE = "reference"
    MEASURED = "measured"


@dataclass(frozen=True)
class FrictionFeedforward:
    """``u_f = level tanh(v/smoothing)``: what Coulomb friction takes, v the speed wanted or the speed measured.

    The level is a command: of a force the Coulomb friction itself, of a valve the voltage that moves the drive just so
    far as to slip. The reference's direction is known without noise and leaves the loop as it was, but pushes a
    reference of zero nowhere; the measured one follows every reversal, and is positive feedback with the gain
    level/smoothing at rest, which the margins count: more than the friction's own slope there, and the loop hunts.
    In a loop of the position the reference's direction is that of the input "reference_speed".
    H. Olsson, K. J. Åström, C. Canudas de Wit, M. Gäfvert & P. Lischinsky, Friction models and friction compensation,
    Eur. J. Control 4 (1998) 176-195, section 5.

    Parameters
    ----------
    direction : Direction
        Whose sign counts: that of the reference's motion, or of the measured speed.
    """

    direction: Direction = Direction.REFERENCE
    section: ClassVar[str] = "friction_feedforward"
    size: ClassVar[str] = "level"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        known = ", ".join(str(d) for d in Direction)
        require(
            isinstance(self.direction, Direction),
            f"FrictionFeedforward: direction is one of {known}, got {self.direction!r}",
        )

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse the measured direction in a loop whose PID sees a position, which has no direction of motion."""
        told = "FrictionFeedforward: a PID of the position measures no direction of motion; take Direction.REFERENCE"
        require(self.direction is Direction.REFERENCE or on.order != 0, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The level [unit], zero by default, and the speed within which the sign turns over [measured unit].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in FrictionFeedforward().parameters(on, "V").items()]
        [('level', 'V'), ('smoothing', 'm/s')]
        """
        turn = "speed within which the added command turns its sign"
        return ParameterSet(
            {
                "level": Parameter(0.0, unit, lower=0.0, meaning="command that Coulomb friction takes"),
                "smoothing": Parameter(1e-3, on.speed_unit, lower=LEAST_DIVISOR, meaning=turn),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The reference's speed where it is a position and its direction counts."""
        return on.speed_input if self.direction is Direction.REFERENCE else ()

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: ControllerSnapshot) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: ControllerSnapshot, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and u_f [the command's unit]."""
        wanted = seen.rates.get(REFERENCE_SPEED, seen.reference)
        speed = seen.measured if self.direction is Direction.MEASURED else wanted
        return {}, p["level"] * ca.tanh(speed / p["smoothing"])


@dataclass(frozen=True)
class DeadZoneInverse:
    """``u = v + width tanh(v/smoothing)``: beyond its edge a valve with that dead zone answers v as if it had none.

    Its slope ``1 + width/smoothing (1 - tanh^2(v/smoothing))`` multiplies the loop's gain: 1 outside, 1 +
    width/smoothing at v = 0, where the dead zone's own slope is next to nothing. Margins count it at their operating
    point. A width beyond the true one makes the loop swing about zero; a smoothing well below the noise in v makes the
    spool chatter. G. Tao & P. V. Kokotović, Adaptive control of systems with actuator and sensor nonlinearities
    (Wiley 1996), have the inverse without the smoothing, and how to adapt its width.
    """

    section: ClassVar[str] = "dead_zone_inverse"
    size: ClassVar[str] = "width"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, _on: SensedSignal, _axis: Axis | None) -> None:
        """It fits any loop."""

    def parameters(self, _on: SensedSignal, unit: str) -> ParameterSet:
        """Half the dead zone's width, zero by default, and the command within which the sign turns over [unit]."""
        turn = "command within which what is added turns its sign"
        return ParameterSet(
            {
                "width": Parameter(0.0, unit, lower=0.0, meaning="half the valve's dead zone, added to the command"),
                "smoothing": Parameter(0.02, unit, lower=LEAST_DIVISOR, meaning=turn),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: ControllerSnapshot) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: ControllerSnapshot, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and what it adds [the command's unit]."""
        return {}, p["width"] * ca.tanh(seen.command / p["smoothing"])


@dataclass(frozen=True)
class ImpulsiveControl:
    """Short pulses towards the reference while the error stands still outside a tolerance, and nothing within it.

    A body that sticks outside the tolerance breaks away under an integral with the whole fall from static to Coulomb
    friction to spare, and goes too far. A pulse ends by itself, whatever the body does: its way goes to zero as its
    peak comes down to the breakaway force. When the reference has come to rest and the error e has stood still for
    `pause`, pulse k begins, with the peak ::

        P_1 = amplitude,    P_k = P_(k-1) min(most, (|e|/(2 way))^g)

    where way is that of the pulse before, towards its target and at least .06 tolerance, and g is .05 where the peak
    rises and .15 where it falls: the peak grows until the body moves, and then so that a pulse takes away half of the
    error. It grows by `growth` at most, and where a pulse with the peak C has moved the body further than that, to the
    same side of the reference, by ``max(1.02, sqrt(C/P_(k-1)))`` from then on: half of the gap to C, since near the
    breakaway force a slightly higher peak moves the body many times as far. At sample j of the
    ``n = width/h max(1, P/limit)`` samples of a pulse, the command is changed by ``sign(e) min(P, limit) s`` with
    ``s = sin(2 pi (j + 1/2)/n)``, the half below zero times `brake`: a valve's command is the rate of the force, which
    so rises and falls again. Where the command is a force, brake has to be 0. A reference that moves ends a pulse, and
    the next rest begins with `amplitude` again.

    Standstill is an error that changes by less than a fifth of the tolerance. It is counted in samples, so the PID has
    to be a sampled one. The pulses are left out of the loop's rest and of its margins, as a knocker's are.

    S. Yang & M. Tomizuka, Adaptive pulse width control for precise positioning under the influence of stiction and
    Coulomb friction, ASME J. Dyn. Syst. Meas. Control 110 (1988) 221-227, adapt the width of pulses to their way.
    R. Kased & T. Singh, High precision point-to-point maneuvering of an experimental structure subject to friction via
    adaptive impulsive control, State University of New York at Buffalo, compare it with a height that adapts.
    """

    section: ClassVar[str] = "impulsive_control"
    size: ClassVar[str] = "amplitude"
    acts_always: ClassVar[bool] = False
    without_gradient: ClassVar[tuple[str, ...]] = ("width", "pause", "tolerance", "limit")

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a continuous controller."""
        told = "an ImpulsiveControl counts samples: give the PID a sample_time, such as PID(sample_time=1e-3)"
        require(on.sample_time is not None, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Amplitude, zero by default, and limit [unit], times [s], the tolerance [error's unit], and ratios.

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, 1e-3, cascade=True)
        >>> [(n, p.unit) for n, p in ImpulsiveControl().parameters(on, "V").items()][:5]
        [('amplitude', 'V'), ('limit', 'V'), ('width', 's'), ('pause', 's'), ('tolerance', 'm')]
        """

        def above(least: float, value: float, unit: str, meaning: str) -> Parameter:
            return Parameter(value, unit, lower=least, meaning=meaning)

        return ParameterSet(
            {
                "amplitude": above(0.0, 0.0, unit, "peak of the first pulse"),
                "limit": above(LEAST_DIVISOR, inf, unit, "peak beyond which pulses grow longer, not higher"),
                "width": above(on.h, 0.018, "s", "length of a pulse"),
                "pause": above(on.h, 0.016, "s", "standstill before a pulse"),
                "tolerance": above(1e-12, 1e-4, on.error_unit, "error within which none comes"),
                "growth": above(1.0, 1.1, "1", "factor by which the peak grows from pulse to pulse at most"),
                "brake": above(0.0, 0.6, "1", "height of a pulse's second half over that of its first"),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The speed of a position's reference, which tells whether it rests."""
        return on.speed_input

    def states(self, on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """The error that has stood, for how many samples; the pulse, its length, peak, error before; the ceiling."""
        error = Quantity("error", on.error_unit)
        return (
            error,
            *(Quantity(n, "1") for n in ("standing", "phase", "length")),
            replace(command, name="peak"),
            replace(error, name="before"),
            replace(command, name="ceiling"),
        )

    def start(self, _on: SensedSignal, _seen: ControllerSnapshot) -> list[Any]:
        """No pulse so far."""
        return [0.0] * 7

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states after a sample, and the pulse [the command's unit]."""
        h, e = seen.sample_time or 1.0, seen.error
        width, pause = (ca.fmax(1.0, ca.floor(p[n] / h + 0.5)) for n in ("width", "pause"))
        rests = ca.fabs(seen.rates.get(REFERENCE_SPEED, 0.0)) <= 0
        quiet = ca.logic_and(rests, x["phase"] + 1 >= x["length"])
        stays = ca.logic_and(quiet, ca.fabs(e - x["error"]) < STANDSTILL_SHARE * p["tolerance"])
        standing = ca.if_else(stays, x["standing"] + 1, 0)
        fires = ca.logic_and(standing >= pause, ca.fabs(e) > p["tolerance"])
        last = ca.if_else(rests, x["peak"], 0)
        known = ca.if_else(rests, x["ceiling"], 0)
        next_peak, ceiling = _next_peak(e, last, x["before"], known, p)
        peak = ca.if_else(fires, next_peak, last)
        longer = ca.fmax(1.0, ca.fabs(peak) / p["limit"])
        length = ca.if_else(fires, ca.floor(width * longer + 0.5), ca.if_else(rests, x["length"], 0))
        phase = ca.if_else(fires, 0, ca.fmin(x["phase"] + 1, length))
        wave = ca.sin(2 * ca.pi * (phase + 0.5) / ca.fmax(length, 1.0))
        now = {
            "error": ca.if_else(stays, x["error"], e),
            "standing": ca.if_else(fires, 0, standing),
            "phase": phase,
            "length": length,
            "peak": peak,
            "before": ca.if_else(fires, e, x["before"]),
            "ceiling": ca.if_else(fires, ceiling, known),
        }
        acts = ca.logic_and(phase < length, p["amplitude"] > 0)
        return now, ca.if_else(acts, peak / longer * ca.fmax(wave, p["brake"] * wave), 0)


def _next_peak(e: Any, last: Any, before: Any, ceiling: Any, p: Symbols) -> tuple[ca.SX, ca.SX]:
    """A pulse's signed peak at the error e, and the ceiling from then on: the last peak that went too far, or 0."""
    way = ca.fmax((before - e) * ca.if_else(last < 0, -1, 1), LEAST_WAY * p["tolerance"])
    ratio = ca.fmax(PULSE_SHARE * ca.fabs(e), LEAST_WAY * p["tolerance"]) / way
    size, turns = ca.fabs(last), last * e < 0
    known = ca.if_else(turns, 0, ca.if_else(ratio < 1, size, ceiling))
    halfway = ca.fmax(ca.sqrt(known / ca.fmax(size, LEAST_DIVISOR)), LEAST_RISE)
    most = ca.if_else(known > 0, ca.fmin(p["growth"], halfway), p["growth"])
    factor = ca.fmin(most, ca.exp(ca.if_else(ratio > 1, RISE_EXPONENT, FALL_EXPONENT) * ca.log(ratio)))
    found = ca.if_else(size <= 0, p["amplitude"], size * factor)
    return ca.if_else(e < 0, -found, found), known


@dataclass(frozen=True)
class MotionFeedforward:
    """``u_m = speed v_r + acceleration a_r``: what an axis takes to follow a reference of speed v_r, acceleration a_r.

    A valve that lets a piston move with the speed G u [m/s] at the command u takes ``speed = 1/G``; the acceleration's
    gain makes up for the lag until the chambers have filled. Both see the reference alone, so margins do not change.
    A loop of the position has the inputs "reference_speed" and "reference_acceleration" for them, one of the speed the
    latter, its reference being the speed. A step has neither rate: there the part adds nothing.

    The usual feedforward of a servo axis: K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006, chapter 5.
    """

    section: ClassVar[str] = "motion_feedforward"
    size: ClassVar[str] = "speed"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a loop of neither position nor speed."""
        told = f"MotionFeedforward follows a motion, and {on.measured.name!r} is neither a position nor a speed"
        require(on.order is not None, f"{told}; leave it out", ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gains on speed and acceleration, zero by default.

        Examples
        --------
        >>> on = SensedSignal(Quantity("position", "m"), {}, None, order=0)
        >>> [(n, p.unit) for n, p in MotionFeedforward().parameters(on, "V").items()]
        [('speed', 'V*s/m'), ('acceleration', 'V*s^2/m')]
        """
        speed = on.speed_unit
        return ParameterSet(
            {
                "speed": Parameter(0.0, unit_ratio(unit, speed), meaning="command per speed of the reference"),
                "acceleration": Parameter(
                    0.0,
                    unit_ratio(f"{unit}*s", speed),
                    meaning="command per acceleration of the reference",
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, on: SensedSignal) -> tuple[str, ...]:
        """The reference's acceleration, and where it is a position its speed."""
        return (*on.speed_input, REFERENCE_ACCELERATION)

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """None."""
        return ()

    def start(self, _on: SensedSignal, _seen: ControllerSnapshot) -> list[Any]:
        """No states."""
        return []

    def act(self, seen: ControllerSnapshot, _x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """No states, and u_m [the command's unit]."""
        speed = seen.rates.get(REFERENCE_SPEED, seen.reference)
        return {}, p["speed"] * speed + p["acceleration"] * seen.rates[REFERENCE_ACCELERATION]


PRESSURES = ("pressure_a", "pressure_b")


@dataclass(frozen=True)
class PressureFeedback:
    """High-passed feedback of ``d = p_a - p_b``: ``u_p = -gain (d - slow)`` with ``d(slow)/dt = (d - slow)/time``.

    The differential pressure is the piston's acceleration but for friction and load, and comes without differentiating
    an encoder: the usual third state of a servo-pneumatic axis beside position and speed. The high-pass takes away what
    holds a load, so that the rest stays where it was; time is long against the piston's swing, and a very long one is
    the plain state feedback about the pressures of the start.

    With a sampled PID, h its sample time: ``slow = (time slow_ + h d)/(time + h)``, the suffix _ the sample before.

    J. Wang, J. Pu & P. Moore, A practical control strategy for servo-pneumatic actuator systems, Control Eng. Practice
    7 (1999) 1483-1488, have acceleration feedback for the same purpose.
    """

    section: ClassVar[str] = "pressure_feedback"
    size: ClassVar[str] = "gain"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, _on: SensedSignal, _axis: Axis | None) -> None:
        """It fits any loop whose plant has the pressures."""

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gain, zero by default, and the high-pass's time constant [s].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in PressureFeedback().parameters(on, "V").items()]
        [('gain', 'V/Pa'), ('time', 's')]
        """
        gain = unit_ratio(unit, difference_unit(_pressure_quantity(on).unit))
        return ParameterSet(
            {
                "gain": Parameter(0.0, gain, meaning="command taken back per differential pressure"),
                "time": Parameter(
                    0.1, "s", lower=SHORTEST_TIME, meaning="time in which a steady pressure is forgotten"
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Both chambers' pressures."""
        return PRESSURES

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """The slow part of the differential pressure."""
        return (Quantity("slow", difference_unit(_pressure_quantity(on).unit), 1e5),)

    def start(self, _on: SensedSignal, seen: ControllerSnapshot) -> list[Any]:
        """The pressures so far are the slow part."""
        return [_differential_pressure(seen)]

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The slow part's rate or next value, and u_p [the command's unit]."""
        d, h, time = _differential_pressure(seen), seen.elapsed, p["time"]
        if h is None:
            return {"slow": (d - x["slow"]) / time}, p["gain"] * (x["slow"] - d)
        slow = (time * x["slow"] + h * d) / (time + h)
        return {"slow": slow}, p["gain"] * (slow - d)


def _differential_pressure(seen: ControllerSnapshot) -> Any:
    a, b = (seen.readings[n] for n in PRESSURES)
    return a - b


def _pressure_quantity(on: SensedSignal) -> Quantity:
    """The pressure's signal; a list of keys knows no plant."""
    return on.outputs.get(PRESSURES[0], Quantity(PRESSURES[0], "Pa(a)"))


@dataclass(frozen=True)
class AccelerationFeedback:
    """Feedback ``u_a = -gain a`` of the signal's filtered derivative a: of a speed the first, of a position the second.

    Each derivative is ``(s - f)/filter`` with ``df/dt = (s - f)/filter``; with a sampled PID, h its sample time,
    ``f = (filter f_ + h s)/(filter + h)``, the suffix _ the sample before (backward Euler). It damps a piston on its
    air where no pressures are measured; counts of an encoder of the position are divided by filter squared.

    J. Wang, J. Pu & P. Moore, A practical control strategy for servo-pneumatic actuator systems, Control Eng. Practice
    7 (1999) 1483-1488.
    """

    section: ClassVar[str] = "acceleration_feedback"
    size: ClassVar[str] = "gain"
    acts_always: ClassVar[bool] = True
    without_gradient: ClassVar[tuple[str, ...]] = ()

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a PID of neither position nor speed."""
        told = f"AccelerationFeedback differentiates a motion, and {on.measured.name!r} is neither position nor speed"
        require(on.order is not None, f"{told}; leave it out", ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """The gain, zero by default, and the filter's time constant [s].

        Examples
        --------
        >>> on = SensedSignal(Quantity("speed", "m/s"), {}, None)
        >>> [(n, p.unit) for n, p in AccelerationFeedback().parameters(on, "V").items()]
        [('gain', 'V*s^2/m'), ('filter', 's')]
        """
        return ParameterSet(
            {
                "gain": Parameter(
                    0.0, unit_ratio(f"{unit}*s", on.speed_unit), meaning="command taken back per acceleration"
                ),
                "filter": Parameter(
                    5e-3, "s", lower=MIN_FILTER_TIME, meaning="time constant of each derivative's filter"
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing beside the loop's own signal."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """What each derivative subtracts: the filtered speed, and before it, of a position, the filtered position."""
        speed = Quantity("speed", on.speed_unit)
        return (Quantity("position", on.measured.unit, on.measured.nominal), speed) if on.order == 0 else (speed,)

    def start(self, on: SensedSignal, seen: ControllerSnapshot) -> list[Any]:
        """The measured signal so far; a position has stood still."""
        return [seen.measured, 0.0] if on.order == 0 else [seen.measured]

    def act(self, seen: ControllerSnapshot, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states' rates or next values, and u_a [the command's unit]."""
        moved, signal, h, time = Signals(), seen.measured, seen.elapsed, p["filter"]
        fed_back = ca.SX(0)
        for name, before in x.items():
            now = before if h is None else (time * before + h * signal) / (time + h)
            fed_back = (now - signal) / time
            signal = (signal - now) / time
            moved[name] = signal if h is None else now
        return moved, p["gain"] * fed_back


Kind = (
    type[MotionFeedforward]
    | type[PressureFeedback]
    | type[AccelerationFeedback]
    | type[FrictionFeedforward]
    | type[Knocker]
    | type[ImpulsiveControl]
    | type[DeadZoneInverse]
)
_KINDS: tuple[Kind, ...] = (
    *(MotionFeedforward, PressureFeedback, AccelerationFeedback),
    *(FrictionFeedforward, Knocker, ImpulsiveControl, DeadZoneInverse),
)

# A file's compensators act in this order: the one that inverts the valve comes last, where it sees all but the dither.
COMPENSATORS: Mapping[str, Kind] = MappingProxyType({part.section: part for part in _KINDS})
