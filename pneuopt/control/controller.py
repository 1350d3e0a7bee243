"""What a controller computes beside its PID, and all that it computes at a sample: one law for loops and exports."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, NamedTuple, Protocol

import casadi as ca

from pneuopt.control.compensators import Compensator, Instant, compensate
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import GainSchedule, schedule_gains
from pneuopt.control.pid import BAD_SAMPLES, PID, Form, parallel_gains
from pneuopt.control.reset_integral import reset_integral
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder, SensedSignal, SensorLag, Signals
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, with_prefix, without_prefix
from pneuopt.quantities.unit_algebra import difference_unit, unit_ratio

MIN_FEEDFORWARD_TIME = 1e-6  # [s]; below, the loop is too stiff to integrate; above, fast leads are refused


@dataclass(frozen=True)
class Feedforward:
    """A set-point lead: ``u_ff = gain (r - r_f)``, ``d(r_f)/dt = (r - r_f)/time``, added to the PID's command.

    A step R of the reference adds ``gain R e^(-t/time)``: a push that the controller need not wait for its error's
    integral to give. It sees the reference alone, so the loop's margins do not change, and at rest it adds nothing.

    With a sampled PID it is computed with it, h = `PID.sample_time` (backward Euler, the suffix _ marks the previous
    sample): ``r_f = (time r_f_ + h r)/(time + h)``.

    Parameters
    ----------
    time : float
        Default of the parameter "feedforward.time" [s].
    """

    time: float = 0.05

    def __post_init__(self) -> None:
        require(
            MIN_FEEDFORWARD_TIME <= self.time < inf,
            f"Feedforward: time must be at least {MIN_FEEDFORWARD_TIME:g} s, got {self.time:g} s",
        )

    def parameters(self, input_unit: str, output_unit: str) -> ParameterSet:
        """The gain [output_unit/input_unit], zero by default, and the time [s].

        Examples
        --------
        >>> [(n, p.unit) for n, p in Feedforward().parameters("m/s", "V").items()]
        [('gain', 'V*s/m'), ('time', 's')]
        """
        gain = Parameter(
            0.0, unit_ratio(output_unit, input_unit), meaning="command per jump of the reference, which decays again"
        )
        return ParameterSet(
            {
                "gain": gain,
                "time": Parameter(self.time, "s", lower=MIN_FEEDFORWARD_TIME, meaning="time constant of that decay"),
            }
        )

    def states(self, measured: Quantity) -> tuple[Quantity, ...]:
        """The filtered reference r_f, as "filter"."""
        return (Quantity("filter", measured.unit, measured.nominal),)

    def rates(self, x: Symbols, r: ca.SX, p: Symbols) -> tuple[dict[str, ca.SX], ca.SX]:
        """The continuous law: d(r_f)/dt, and u_ff [output unit]."""
        lead = r - x["filter"]
        return {"filter": lead / p["time"]}, p["gain"] * lead

    def update(self, x: Symbols, r: ca.SX, p: Symbols, elapsed: ca.SX | float) -> tuple[dict[str, ca.SX], ca.SX]:
        """The sampled law at a sample, `elapsed` [s] after the last good one: the next r_f, and u_ff [output unit]."""
        slow = (p["time"] * x["filter"] + elapsed * r) / (p["time"] + elapsed)
        return {"filter": slow}, p["gain"] * (r - slow)


POSITION_GAIN = 10.0  # [1/s] default: a small one creeps in, one near the speed loop's own bandwidth swings


@dataclass(frozen=True)
class PositionLoop:
    """``v_r = Kp (r - y) + weight reference_speed``: the reference of the speed that the PID then controls.

    r and y are the position wanted and the position measured. With a weight of 1 a motion at constant speed is followed
    without an error, with 0 it trails by its speed over Kp. It has no integral: that of a PI of the speed lets no error
    rest, and two integrals in series swing. It is proportional, so there is nothing to start, and nothing to wind up
    beside the PID's integral.

    K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006, section 12.4 (cascade control).
    """

    section: ClassVar[str] = "position_loop"

    def parameters(self, position_unit: str, speed_unit: str) -> ParameterSet:
        """The gain [1/s] and the weight of the reference's speed [1].

        Examples
        --------
        >>> [(n, p.value, p.unit) for n, p in PositionLoop().parameters("m", "m/s").items()]
        [('Kp', 10.0, '1/s'), ('weight', 1.0, '1')]
        """
        gain = unit_ratio(speed_unit, difference_unit(position_unit))
        return ParameterSet(
            {
                "Kp": Parameter(POSITION_GAIN, gain, lower=0.0, meaning="speed per error of the position"),
                "weight": Parameter(1.0, "1", lower=0.0, meaning="weight of the reference's speed"),
            }
        )

    def set_point(self, reference: Any, speed: Any, position: Any, p: Any) -> Any:
        """The PID's reference v_r, from the reference, its speed, the position measured and the own parameters."""
        return p["Kp"] * (reference - position) + p["weight"] * speed


ERROR = "error"
"""Beside the inputs of a cascade's inner controller: the error of the outer one."""


class CommandParts(Protocol):
    """The parts of a `ClosedLoop` that make its command."""

    @property
    def pid(self) -> PID:
        """The controller, which says whether the parts are sampled."""
        ...

    @property
    def dither(self) -> Dither | None:
        """The last to add."""
        ...

    @property
    def feedforward(self) -> Feedforward | None:
        """The first to add."""
        ...

    @property
    def compensators(self) -> tuple[Compensator, ...]:
        """They add between the two."""
        ...

    @property
    def outer(self) -> PositionLoop | None:
        """The outer loop of a cascade."""
        ...


def pid_reference(parts: CommandParts, u: Mapping[str, Any], position: Any, p: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs as the PID and its compensators see them: a cascade's reference is a speed, and `ERROR` a position's.

    Parameters
    ----------
    parts : ClosedLoop
    u, p : mapping of str to casadi.SX
        The loop's inputs and parameters.
    position : casadi.SX
        What the loop is judged by, as the controller sees it.
    """
    if parts.outer is None:
        return dict(u)
    own = without_prefix(p, parts.outer.section)
    speed = parts.outer.set_point(u["reference"], u.get(REFERENCE_SPEED, 0.0), position, own)
    return {**u, "reference": speed, ERROR: u["reference"] - position}


def added_command(
    parts: CommandParts, t: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
) -> tuple[Signals, ca.SX]:
    """What feedforward, compensators and dither, in this order, add to the PID's command.

    Parameters
    ----------
    parts : ClosedLoop
    t : casadi.SX
    x, u, p : mapping of str to casadi.SX
        The loop's states, inputs as `pid_reference` gives them, and parameters.
    measured : casadi.SX
        The measured signal, as the controller sees it.
    y : mapping of str to casadi.SX
        The plant's outputs that compensators read.

    Returns
    -------
    moved : dict
        The rates of the parts' states, or with a sampled PID their next values.
    added : casadi.SX
        [the command's unit]
    """
    moved, terms = added_terms(parts, t, x, u, measured, y, p)
    return moved, terms["dither"] + (terms["feedforward"] + terms["compensation"])


def added_terms(
    parts: CommandParts, t: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
) -> tuple[Signals, Signals]:
    """The terms of `added_command`, "feedforward", "compensation" and "dither", in place of their sum."""
    moved, lead = _feedforward_terms(parts, x, u, p)
    bent = ca.SX(0)
    if parts.compensators:
        v = parts.pid.output(without_prefix(x, "pid"), u["reference"], measured, without_prefix(p, "pid"))
        rates = {n: u[n] for n in (REFERENCE_SPEED, REFERENCE_ACCELERATION) if n in u}
        error = u.get(ERROR, u["reference"] - measured)
        h = parts.pid.sample_time
        seen = Instant(t, u["reference"], measured, v + lead, h, rates, y, error, _elapsed_time(parts, x))
        own, bent = compensate(parts.compensators, seen, x, p)
        moved = moved | own
    return moved, {"feedforward": lead, "compensation": bent, "dither": _dither_command(parts, t, p)}


def _dither_command(parts: CommandParts, t: ca.SX, p: Symbols) -> ca.SX:
    """What the controller itself adds."""
    if parts.dither is None:
        return ca.SX(0)
    own = without_prefix(p, "dither")
    sampled_apart = parts.dither.analogue and parts.pid.sample_time is not None
    return own["offset"] if sampled_apart else own["offset"] + parts.dither.wave(t, own)


def _feedforward_terms(parts: CommandParts, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
    """The feedforward's state, its rate or with a sampled PID its next value, and what it adds to the command."""
    if parts.feedforward is None:
        return {}, ca.SX(0)
    own = (without_prefix(x, "feedforward"), u["reference"], without_prefix(p, "feedforward"))
    elapsed = _elapsed_time(parts, x)
    moved, added = parts.feedforward.rates(*own) if elapsed is None else parts.feedforward.update(*own, elapsed)
    return with_prefix(moved, "feedforward"), added


def _elapsed_time(parts: CommandParts, x: Symbols) -> ca.SX | float | None:
    """The time since the last good sample [s]; None of a continuous PID."""
    return None if parts.pid.sample_time is None else parts.pid.elapsed_time(without_prefix(x, "pid"))


LARGEST_SIGNAL = 1e30
"""A signal beyond it, or that compares with nothing, is no number: larger than any reading, a literal everywhere."""
_COUNT = f"pid.{BAD_SAMPLES}"


class ControllerParts(CommandParts, Protocol):
    """The parts of a `ClosedLoop` that are computed at a sample."""

    @property
    def sensor(self) -> SensorLag | Encoder | None:
        """Through which the controller sees the measured signal."""
        ...

    @property
    def feedback(self) -> Quantity:
        """The plant's output that the loop is judged by, and an outer loop controls."""
        ...

    @property
    def schedule(self) -> GainSchedule | None:
        """Gains that change with the position."""
        ...

    @property
    def sensed_signal(self) -> SensedSignal:
        """What the sensor reads."""
        ...


class ControllerUpdate(NamedTuple):
    """What is computed at a sample, by name.

    Attributes
    ----------
    states : dict of str to casadi.SX
        The states of sensor, PID, feedforward and compensators after the sample, by the loop's names.
    terms : dict of str to casadi.SX
        What the command is made of: "error", "proportional", "integral" (before back-calculation), "derivative",
        "feedforward", "compensation", "dither", and their sum before the clip, "unlimited"; the gains of this instant,
        "Kp_parallel" and so on; and the signals as they are computed with, "reference_read" for instance.
    """

    states: Signals
    terms: Signals


def controller_update(
    loop: ControllerParts, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols
) -> ControllerUpdate:
    """What a sampled controller computes at a sample.

    A sample is bad where any signal that the controller reads is no number, or beyond `LARGEST_SIGNAL`. At a bad sample
    all states stay as they are, and with them the output; `PID.hold` counts it, and gives the safe output once
    fault_samples have been bad in a row. The next good sample goes on from those states if there were fewer, with what
    takes a difference or filters counting the time since the last good one; else it begins anew as at a start, from
    the output that was sent last. Time, and a dither with it, goes on.

    Parameters
    ----------
    loop : ClosedLoop
        With a sample time.
    t : casadi.SX
        [s]
    x, u, p : mapping of str to casadi.SX
        The loop's states, inputs (the "reference", and its rates where a part uses them) and parameters.
    y : mapping of str to casadi.SX
        The plant's outputs: the measured one, or what an `Encoder` counts, and those that compensators read.
    """
    is_good = _signals_are_good(loop, x, u, y)
    count = ca.if_else(is_good, 0, x[_COUNT] + 1)
    good = count <= 0  # read where it is needed; the condition above is computed once
    seen = _good_signals(loop, good, x, u, y)
    found = _law(loop, t, *seen, p)
    held = {**x, **with_prefix(loop.pid.hold(without_prefix(x, "pid"), count, without_prefix(p, "pid")), "pid")}
    after = _choose(good, found.states, held) | {_COUNT: count}
    read = {f"{n}_read": v for own in seen[1:] for n, v in own.items()}
    return ControllerUpdate(after, read | found.terms)


def controller_readings(parts: ControllerParts) -> set[str]:
    """The plant's outputs that a controller reads beside what its PID controls."""
    used = {n for part in parts.compensators for n in part.reads(parts.sensed_signal)}
    if not isinstance(parts.sensor, Encoder):  # which has the position itself
        used |= {parts.feedback.name} if parts.outer else set()
        used |= {parts.schedule.position} - {parts.sensed_signal.measured.name} if parts.schedule else set()
    return used


def begin_controller(
    parts: ControllerParts, u: Mapping[str, Any], measured: Any, y: Mapping[str, Any], command: Any, p: Symbols
) -> Signals:
    """The first states, sensor apart, from what the actuator has got so far [output unit], by the loop's names.

    Parameters
    ----------
    parts : ClosedLoop
    u : mapping of str to casadi.SX
        The inputs as `pid_reference` gives them.
    measured : casadi.SX
        As the PID sees it.
    y : mapping of str to casadi.SX
        The plant's outputs that compensators read.
    command : casadi.SX
    p : mapping of str to casadi.SX
        The loop's parameters, with the gains of this instant.
    """
    unit = Quantity("command", "1")
    pid = parts.pid.start(u["reference"], measured, command, without_prefix(p, "pid"))
    begun: Signals = {f"pid.{q.name}": v for q, v in zip(parts.pid.states(unit, unit), pid, strict=True)}
    if parts.feedforward is not None:
        begun["feedforward.filter"] = u["reference"]
    for part in parts.compensators:
        known = Instant(ca.SX(0), u["reference"], measured, command, parts.pid.sample_time, {}, y)
        own = zip(part.states(parts.sensed_signal, unit), part.start(parts.sensed_signal, known), strict=True)
        begun |= {f"{part.section}.{q.name}": v for q, v in own}
    return begun


def signals_are_good(values: list[Any]) -> ca.SX:
    """Whether each of these is a number: the positive form, as what is none compares false."""
    good: ca.SX = abs(values[0]) <= LARGEST_SIGNAL
    for value in values[1:]:
        good = ca.logic_and(good, abs(value) <= LARGEST_SIGNAL)
    return good


def _read_names(loop: ControllerParts, u: Symbols) -> tuple[set[str], set[str], set[str]]:
    """Which states, inputs and outputs of the plant are signals that the controller reads."""
    inputs = {"reference", REFERENCE_SPEED, REFERENCE_ACCELERATION} & set(u)
    readings = controller_readings(loop)
    if isinstance(loop.sensor, SensorLag):
        return {"sensor.reading"}, inputs, readings
    own = loop.sensor.position if loop.sensor else loop.sensed_signal.measured.name
    return set(), inputs, readings | {own}


def _signals_are_good(loop: ControllerParts, x: Symbols, u: Symbols, y: Symbols) -> ca.SX:
    read = zip((x, u, y), _read_names(loop, u), strict=True)
    return signals_are_good([v for of, own in read for n, v in of.items() if n in own])


def _good_signals(
    loop: ControllerParts, good: ca.SX, x: Symbols, u: Symbols, y: Symbols
) -> tuple[Signals, Signals, Signals]:
    """States, inputs and outputs with a number in place of a bad sample's signals: no operation sees what is none.

    The number is any but 0, with which CasADi would put products of the signals into the choice.
    """
    states, inputs, outputs = _read_names(loop, u)

    def read(of: Symbols, own: set[str]) -> Signals:
        return {n: ca.if_else(good, v, 1) if n in own else v for n, v in of.items()}

    return read(x, states), read(u, inputs), read(y, outputs)


def _choose(condition: ca.SX, values: Signals, others: Symbols) -> Signals:
    """Values where a condition holds, else the others of the same names."""
    return {n: ca.if_else(condition, v, others[n]) for n, v in values.items()}


def _law(loop: ControllerParts, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols) -> ControllerUpdate:
    """The states after a good sample."""
    anew = x[_COUNT] >= p["pid.fault_samples"]
    x, seen = _read_sensor(loop, anew, x, y, p)
    measured = seen["reading"] if seen else y[loop.sensed_signal.measured.name]
    p = dict(schedule_gains(loop, p, measured, seen, y))
    position = measured if loop.outer is None else seen["count"] if "count" in seen else y[loop.feedback.name]
    inner = pid_reference(loop, u, position, p)
    x = {**x, **_begin_anew(loop, anew, x, inner, measured, y, p)}
    x = {**x, **_reset(loop, without_prefix(x, "pid"), u["reference"] - position, without_prefix(p, "pid"))}
    moved, added = added_command(loop, t, x, inner, measured, y, p)
    arguments = without_prefix(x, "pid"), inner["reference"], measured
    own = without_prefix(p, "pid")
    kept = {} if isinstance(loop.sensor, SensorLag) else with_prefix(seen, "sensor")
    after = kept | with_prefix(loop.pid.update(*arguments, added, own), "pid") | moved
    terms = loop.pid.terms(*arguments, own) | added_terms(loop, t, x, inner, measured, y, p)[1]
    gains = zip(Form.PARALLEL.gains, parallel_gains(loop.pid.form, own), strict=True)
    terms |= {f"{n}_parallel": value for n, value in gains}
    sum_before_clip = loop.pid.output(*arguments, own) + added
    return ControllerUpdate(after, {"error": inner["reference"] - measured, **terms, "unlimited": sum_before_clip})


def _read_sensor(loop: ControllerParts, anew: ca.SX, x: Symbols, y: Symbols, p: Symbols) -> tuple[Signals, Signals]:
    """The loop's states, those of an encoder at rest where it begins anew; and the sensor's after the sample."""
    if loop.sensor is None:
        return {**x}, {}
    on, own = loop.sensed_signal, without_prefix(p, "sensor")
    if isinstance(loop.sensor, Encoder):
        x = {**x, **_choose(anew, with_prefix(loop.sensor.rest(y, on, own), "sensor"), x)}
    elapsed = loop.pid.elapsed_time(without_prefix(x, "pid"))
    return {**x}, loop.sensor.update(without_prefix(x, "sensor"), y, on, own, elapsed)


def _begin_anew(
    loop: ControllerParts, anew: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
) -> Signals:
    """The states with which the law begins where it begins anew, and as they are elsewhere.

    But for what was sent, which stays, and the count, on which nothing depends where nothing has changed.
    """
    begun = begin_controller(loop, u, measured, y, loop.pid.sent(without_prefix(x, "pid")), p)
    kept = ("pid.command", "pid.pending", _COUNT)
    return _choose(anew, {n: v for n, v in begun.items() if n not in kept}, x)


def _reset(loop: ControllerParts, x: Symbols, error: ca.SX, p: Symbols) -> Signals:
    """The PID's states that a reset changes before its law is computed."""
    return with_prefix(reset_integral(x, error, p), "pid") if loop.pid.reset else {}
