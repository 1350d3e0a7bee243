"""`controller_update`: what a sampled controller computes at a sample, without a plant around it.

A `ClosedLoop` joins it to its plant, an export writes it for another machine: there is one law.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import casadi as ca

from pneuopt.control.command import CommandParts, added_command, added_terms, pid_reference
from pneuopt.control.compensation import Instant
from pneuopt.control.forms import Form, parallel_gains
from pneuopt.control.gain_schedule import GainSchedule, schedule_gains
from pneuopt.control.pid import BAD_SAMPLES
from pneuopt.control.reset_integral import reset_integral
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder, SensedSignal, SensorLag
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.parameters import Quantity, with_prefix, without_prefix

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
