"""`Controller`: everything of a loop but its plant, from the reference and the measurement to the command.

The signals' way, which `Controller.rates` follows in continuous time and `Controller.update` from sample to sample::

    reference ---> outer loop ---> PID ---> + feedforward ---> + compensators ---> + dither ---> limits ---> command
                        ^           ^
    measurement ---> sensor --------+       (a schedule sets the gains of each instant)

A `ClosedLoop` joins a controller to its plant, an export writes it for another machine; both run this one law.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from math import inf
from operator import or_
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.compensators import Compensator, ControllerSnapshot, check_compensators, check_values, compensate
from pneuopt.control.dither import DITHER_OFFSET, Dither
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.pid import BAD_SAMPLES, PID, Form, ParallelForm, parallel_gains
from pneuopt.control.reset_integral import reset_integral
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder, SensedSignal, SensorLag, Signals
from pneuopt.control.tolerances import LARGEST_SIGNAL, MAX_BISECTIONS, MAX_DOUBLINGS, SHORTEST_TIME
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols, stack
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, with_prefix, without_prefix
from pneuopt.quantities.units import difference_unit, unit_ratio

ERROR = "error"  # beside the inputs of a cascade's inner controller: the error of the outer one
_COUNT = f"pid.{BAD_SAMPLES}"


@dataclass(frozen=True)
class PlantSignals:
    """What a controller knows of a plant: the input that it drives, the output that it is judged by, and the others."""

    command: Quantity
    feedback: Quantity
    outputs: Mapping[str, Quantity]
    axis: Axis | None = None  # what the outputs of an axis are called
    load_unit: str = "1"  # of the axis's mass or inertia


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
            SHORTEST_TIME <= self.time < inf,
            f"Feedforward: time must be at least {SHORTEST_TIME:g} s, got {self.time:g} s",
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
                "time": Parameter(self.time, "s", lower=SHORTEST_TIME, meaning="time constant of that decay"),
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
                "Kp": Parameter(10.0, gain, lower=0.0, meaning="speed per error of the position"),
                "weight": Parameter(1.0, "1", lower=0.0, meaning="weight of the reference's speed"),
            }
        )

    def set_point(self, reference: Any, speed: Any, position: Any, p: Any) -> Any:
        """The PID's reference v_r, from the reference, its speed, the position measured and the own parameters."""
        return p["Kp"] * (reference - position) + p["weight"] * speed


class ControllerUpdate(NamedTuple):
    """The states after a sample, sensor included, and the terms of the command, by name.

    Terms are "error", "proportional", "integral" (before back-calculation), "derivative", "feedforward",
    "compensation", "dither", and "unlimited", their sum before the limits; the gains of this instant, "Kp_parallel"
    and so on; and the signals as they are computed with, "reference_read" for instance.
    """

    states: Signals
    terms: Signals


@dataclass(frozen=True, eq=False)
class Controller:
    """A PID and all that acts beside it; its parts are those of `ClosedLoop`.

    Its methods take states, inputs, outputs and parameters, numbers or symbols, by their names in a loop ("pid.Kp").
    """

    pid: PID
    signals: PlantSignals
    dither: Dither | None = None
    sensor: SensorLag | Encoder | None = None
    feedforward: Feedforward | None = None
    compensators: tuple[Compensator, ...] = ()
    outer: PositionLoop | None = None
    schedule: GainSchedule | None = None

    def __post_init__(self) -> None:
        if self.sensor is not None:
            self.sensor.check(self.sensed_signal)
        if self.outer is not None:
            position = (self.signals.axis or Axis()).position
            other = f"a PositionLoop controls the {position}, this loop {self.feedback.name!r}"
            require(self.feedback.name == position, f"{other}; take measured={position!r}", ModelError)
            jumps = "a Feedforward is of jumps of what the PID follows, in a cascade a speed; take MotionFeedforward"
            require(self.feedforward is None, jumps, ModelError)
        check_compensators(self.compensators, self.sensed_signal, self.signals.axis)
        parameters = self.parameters  # raises where a part cannot be built: a dither beyond Nyquist's frequency, say
        if self.schedule:
            self.schedule.check(parameters)

    def rates(self, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The law of a continuous controller: the rates of its states, the sensor's apart, and its command."""
        measured = x["sensor.reading"] if self.sensor else y[self.pid_signal.name]
        p = self.schedule_gains(p, measured, {}, y)
        u = self.inner_inputs(u, y[self.feedback.name], p)
        part_rates, _, added = self._added_to_command(t, x, u, measured, y, p)
        pid = without_prefix(x, "pid"), u["reference"], measured, added, without_prefix(p, "pid")
        pid_rates, command = self.pid.rates(*pid)
        return with_prefix(pid_rates, "pid") | part_rates, command

    def sensor_rates(self, x: Symbols, y: Symbols, p: Symbols) -> Signals:
        """The rates of the sensor's states between samples."""
        if self.sensor is None:
            return {}
        reading = without_prefix(x, "sensor"), y, self.sensed_signal, without_prefix(p, "sensor")
        return with_prefix(self.sensor.rates(*reading), "sensor")

    def update(self, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols) -> ControllerUpdate:
        """What a sampled controller computes at a sample, from the loop's states and inputs and the plant's outputs.

        A sample is bad where a signal that the controller reads is no number, or beyond `LARGEST_SIGNAL`. At a bad
        sample all states stay as they are, and with them the output; `PID.hold` counts it, and gives the safe output
        once fault_samples have been bad in a row. The next good sample goes on from those states if there were fewer,
        with what takes a difference or filters counting the time since the last good one; else it begins anew as at a
        start, from the output that was sent last. Time, and a dither with it, goes on.
        """
        states_read, outputs_read = set[str](), set(self.readings)
        if isinstance(self.sensor, SensorLag):
            states_read.add("sensor.reading")
        else:
            outputs_read.add(self.sensor.position if self.sensor else self.pid_signal.name)
        inputs_read = {"reference", REFERENCE_SPEED, REFERENCE_ACCELERATION}
        signals = (x, states_read), (u, inputs_read), (y, outputs_read)
        is_good = signals_are_good([v for group, read in signals for n, v in group.items() if n in read])
        count = ca.if_else(is_good, 0, x[_COUNT] + 1)
        good = count <= 0  # read where it is needed; the condition above is computed once
        # In place of a bad sample's signals stands a number, so that no operation sees what is none: any but 0, with
        # which CasADi would put products of the signals into the choice.
        x_read, u_read, y_read = (
            {n: ca.if_else(good, v, 1) if n in read else v for n, v in group.items()} for group, read in signals
        )
        law = self._sampled_law(t, x_read, u_read, y_read, p)
        held = {**x, **with_prefix(self.pid.hold(without_prefix(x, "pid"), count, without_prefix(p, "pid")), "pid")}
        states = _choose(good, law.states, held) | {_COUNT: count}
        return ControllerUpdate(states, {f"{n}_read": v for n, v in (*u_read.items(), *y_read.items())} | law.terms)

    def _sampled_law(self, t: ca.SX, x: Symbols, u: Symbols, y: Symbols, p: Symbols) -> ControllerUpdate:
        """The law at a good sample, along the signals' way."""
        anew = x[_COUNT] >= p["pid.fault_samples"]

        # What the controller sees of the plant; an encoder that begins anew stands still.
        x, seen = {**x}, Signals()
        if self.sensor is not None:
            reading = y, self.sensed_signal, without_prefix(p, "sensor")
            if isinstance(self.sensor, Encoder):
                x |= _choose(anew, with_prefix(self.sensor.rest(*reading), "sensor"), x)
            elapsed = self.pid.elapsed_time(without_prefix(x, "pid"))
            seen = self.sensor.update(without_prefix(x, "sensor"), *reading, elapsed)
        measured = seen["reading"] if seen else y[self.pid_signal.name]
        position = measured if self.outer is None else seen["count"] if "count" in seen else y[self.feedback.name]

        # The gains of this instant, and what the PID shall follow: the reference, or what an outer loop makes of it.
        p = dict(self.schedule_gains(p, measured, seen, y))
        inner = self.inner_inputs(u, position, p)
        gains = without_prefix(p, "pid")

        # Where the PID goes on from: its states, those of a start after too many bad samples, or a reset integral.
        begun = self.start(inner, measured, y, self.pid.sent(without_prefix(x, "pid")), p)
        kept = ("pid.command", "pid.pending", _COUNT)  # what was sent stays; the count matters at bad samples alone
        x = {**x, **_choose(anew, {n: v for n, v in begun.items() if n not in kept}, x)}
        if self.pid.reset:
            x |= with_prefix(reset_integral(without_prefix(x, "pid"), u["reference"] - position, gains), "pid")

        # The command: the PID's own, and what is added to it, limited.
        part_states, part_terms, added = self._added_to_command(t, x, inner, measured, y, p)
        pid = without_prefix(x, "pid"), inner["reference"], measured
        states = with_prefix(self.pid.update(*pid, added, gains), "pid") | part_states
        if not isinstance(self.sensor, SensorLag):  # whose reading moves between samples, by `sensor_rates`
            states = with_prefix(seen, "sensor") | states
        terms = {"error": inner["reference"] - measured, **self.pid.terms(*pid, gains), **part_terms}
        terms |= {
            f"{n}_parallel": gain
            for n, gain in zip(Form.PARALLEL.gains, parallel_gains(self.pid.form, gains), strict=True)
        }
        return ControllerUpdate(states, terms | {"unlimited": self.pid.output(*pid, gains) + added})

    def _added_to_command(
        self, t: ca.SX, x: Symbols, u: Symbols, measured: ca.SX, y: Symbols, p: Symbols
    ) -> tuple[Signals, Signals, ca.SX]:
        """What feedforward, compensators and dither add to the PID's command: their states, each term, the sum."""
        h = self.pid.sample_time
        elapsed = None if h is None else self.pid.elapsed_time(without_prefix(x, "pid"))
        states, lead, compensation, wave = Signals(), ca.SX(0), ca.SX(0), ca.SX(0)
        if self.feedforward is not None:
            part, jump = self.feedforward, (without_prefix(x, "feedforward"), u["reference"])
            feedforward_p = without_prefix(p, "feedforward")
            law = part.rates(*jump, feedforward_p) if elapsed is None else part.update(*jump, feedforward_p, elapsed)
            states, lead = with_prefix(law[0], "feedforward"), law[1]
        if self.compensators:
            v = self.pid.output(without_prefix(x, "pid"), u["reference"], measured, without_prefix(p, "pid"))
            rates = {n: u[n] for n in (REFERENCE_SPEED, REFERENCE_ACCELERATION) if n in u}
            error = u.get(ERROR, u["reference"] - measured)
            seen = ControllerSnapshot(t, u["reference"], measured, v + lead, h, rates, y, error, elapsed)
            compensator_states, compensation = compensate(self.compensators, seen, x, p)
            states |= compensator_states
        if self.dither is not None:
            dither_p = without_prefix(p, "dither")
            wave = dither_p["offset"]
            if h is None or not self.dither.analogue:  # else a generator behind the controller adds it
                wave = wave + self.dither.wave(t, dither_p)
        return states, {"feedforward": lead, "compensation": compensation, "dither": wave}, wave + (lead + compensation)

    def start(
        self, u: Mapping[str, Any], measured: Any, y: Mapping[str, Any], command: Any, p: Mapping[str, Any]
    ) -> dict[str, Any]:
        """The first states, sensor apart, with which the controller goes on from a command [its unit] without a bump.

        The inputs are those of `inner_inputs`, the command the PID's own, and the gains those of this instant.
        """
        unit = Quantity("command", "1")
        pid = self.pid.start(u["reference"], measured, command, without_prefix(p, "pid"))
        begun = {f"pid.{q.name}": v for q, v in zip(self.pid.states(unit, unit), pid, strict=True)}
        if self.feedforward is not None:
            begun["feedforward.filter"] = u["reference"]
        for part in self.compensators:
            seen = ControllerSnapshot(0.0, u["reference"], measured, command, self.pid.sample_time, {}, y)
            first = zip(part.states(self.sensed_signal, unit), part.start(self.sensed_signal, seen), strict=True)
            begun |= {f"{part.section}.{q.name}": v for q, v in first}
        return begun

    def rest_states(
        self, parameters: ParameterSet, y: Mapping[str, float], reference: float, command: float
    ) -> list[float]:
        """The states with which it goes on from a command and the plant's outputs at rest, or in steady motion."""
        value: Mapping[str, Any] = self.values(parameters)
        sensor = list[float]()
        if self.sensor:
            sensor = self.sensor.start(y, self.sensed_signal, without_prefix(value, "sensor"))
        seen = sensor[0] if sensor else y[self.pid_signal.name]
        value = self.schedule_gains(value, seen, {}, y)
        wanted = float(self.inner_inputs({"reference": reference}, y[self.feedback.name], value)["reference"])
        p = np.array([float(v) for v in value.values()])
        v = float(self.uncompensated_command(p, wanted, seen, command, [y[n] for n in self.readings])[0])
        return [*sensor, *map(float, self.start({"reference": wanted}, seen, y, v, value).values())]

    def inner_inputs(self, u: Mapping[str, Any], position: Any, p: Mapping[str, Any]) -> dict[str, Any]:
        """The inputs as PID and compensators see them: a cascade's reference is a speed, and `ERROR` a position's."""
        if self.outer is None:
            return dict(u)
        outer_p = without_prefix(p, self.outer.section)
        speed = self.outer.set_point(u["reference"], u.get(REFERENCE_SPEED, 0.0), position, outer_p)
        return {**u, "reference": speed, ERROR: u["reference"] - position}

    def schedule_gains(
        self, p: Mapping[str, Any], measured: Any, seen: Mapping[str, Any], y: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """The loop's parameters with the gains of this instant; `seen` are the sensor's states after reading."""
        if self.schedule is None:
            return p
        if self.schedule.position == self.pid_signal.name:
            return self.schedule.set_gains(p, measured)
        return self.schedule.set_gains(p, seen["count"] if "count" in seen else y[self.schedule.position])

    @property
    def command(self) -> Quantity:
        """The plant's input that it drives."""
        return self.signals.command

    @property
    def feedback(self) -> Quantity:
        """The plant's output that the loop is judged by, and an outer loop controls."""
        return self.signals.feedback

    @cached_property
    def pid_signal(self) -> Quantity:
        """The plant's output that the PID controls."""
        if self.outer is None:
            return self.feedback
        speed = (self.signals.axis or Axis()).speed
        check_names("output", [speed], self.signals.outputs, "ClosedLoop measured")
        return self.signals.outputs[speed]

    @cached_property
    def sensed_signal(self) -> SensedSignal:
        """What the sensor reads."""
        axis = self.signals.axis or Axis()
        order = {axis.position: 0, axis.speed: 1}.get(self.pid_signal.name, None if self.signals.axis else 1)
        return SensedSignal(
            self.pid_signal, self.signals.outputs, self.pid.sample_time, order, cascade=bool(self.outer)
        )

    @cached_property
    def parameters(self) -> ParameterSet:
        """Those of its parts: "pid.*", "dither.*", "sensor.*", "feedforward.*" and so on, all defaults."""
        on, measured, unit = self.sensed_signal, self.pid_signal.unit, self.command.unit
        parts = {
            "pid": self.pid.parameters(measured, unit, self.feedback.unit),
            "dither": self.dither.parameters(unit, self.pid.sample_time) if self.dither else ParameterSet(),
            "sensor": self.sensor.parameters(on) if self.sensor else ParameterSet(),
            "feedforward": self.feedforward.parameters(measured, unit) if self.feedforward else ParameterSet(),
            **{c.section: c.parameters(on, unit) for c in self.compensators},
        }
        if self.outer:
            parts[self.outer.section] = self.outer.parameters(self.feedback.unit, measured)
        if self.schedule:
            outputs, position = self.signals.outputs, self.schedule.position
            check_names("output", [position], outputs, "GainSchedule: position")
            parts["schedule"] = self.schedule.parameters(outputs[position].unit, self.signals.load_unit)
        return reduce(or_, (part.with_prefix(section) for section, part in parts.items()), ParameterSet())

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The sensor's ("sensor.reading"), the PID's ("pid.*"), "feedforward.filter" and the compensators'."""
        parts = {
            "sensor": self.sensor.states(self.sensed_signal) if self.sensor else (),
            "pid": self.pid.states(self.pid_signal, self.command),
            "feedforward": self.feedforward.states(self.feedback) if self.feedforward else (),
            **{c.section: c.states(self.sensed_signal, self.command) for c in self.compensators},
        }
        return tuple(replace(q, name=f"{name}.{q.name}") for name, quantities in parts.items() for q in quantities)

    @property
    def tunable_sections(self) -> tuple[str, ...]:
        """Prefixes of the parameters that a tuning may change: not the sensor's."""
        outer = (self.outer.section,) if self.outer else ()
        return ("pid", *outer, "dither", "feedforward", *(c.section for c in self.compensators), "schedule")

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The reference, then its rates that a compensator uses."""
        return (replace(self.feedback, name="reference"), *self.motion_inputs)

    @property
    def motion_inputs(self) -> tuple[Quantity, ...]:
        """Of "reference_speed" and "reference_acceleration" those that a compensator uses."""
        on = self.sensed_signal
        units = {REFERENCE_SPEED: on.speed_unit, REFERENCE_ACCELERATION: unit_ratio(on.speed_unit, "s")}
        used = {n for part in self.compensators for n in part.motion_inputs(on)}
        used |= {REFERENCE_SPEED} if self.outer else set()
        return tuple(Quantity(n, unit) for n, unit in units.items() if n in used)

    @cached_property
    def readings(self) -> tuple[str, ...]:
        """The plant's outputs that it reads beside what its PID controls, in the plant's order."""
        used = {n for part in self.compensators for n in part.reads(self.sensed_signal)}
        if not isinstance(self.sensor, Encoder):  # which has the position itself
            used |= {self.feedback.name} if self.outer else set()
            used |= {self.schedule.position} - {self.pid_signal.name} if self.schedule else set()
        return tuple(n for n in self.signals.outputs if n in used)

    @property
    def is_composed(self) -> bool:
        """Whether more than a PID of one signal is fed back, so that the loop is linearised by `ComposedLoops`."""
        on = self.sensed_signal
        remembers = any(part.states(on, self.command) for part in self.acting_always)
        return bool(self.outer or self.schedule) or remembers

    @property
    def acting_always(self) -> tuple[Compensator, ...]:
        """The compensators that count in a loop's rest and margins."""
        return tuple(c for c in self.compensators if c.acts_always)

    def check(self, parameters: ParameterSet) -> None:
        """Refuse values that no controller can run with, whatever their bounds: `InputError` names the parameter."""
        value = self.values(parameters)
        if self.dither:
            self.dither.check(value["dither.frequency"], self.pid.sample_time)
        if self.feedforward:
            time = value["feedforward.time"]
            require(time > 0, f"feedforward.time must be positive, got {time:g} s; without it set its gain to zero")
        if self.schedule:
            self.schedule.check_values(without_prefix(value, "schedule"))
        check_values(self.compensators, self.parameters, value, self.sensor_resolution(parameters))
        self.pid.check({**without_prefix(value, "pid"), "Tf": self.parallel_form(parameters).Tf}, self.command.unit)

    def complete(self, parameters: ParameterSet) -> ParameterSet:
        """A set with every parameter of the controller: the given ones, and its defaults for those that are missing."""
        return self.parameters | parameters

    def parameter_vector(self, parameters: ParameterSet) -> Array:
        """The vector p of `parameters` in the controller's order; a missing one keeps its default."""
        return np.array([parameters.value(n) if n in parameters else q.value for n, q in self.parameters.items()])

    def values(self, parameters: ParameterSet) -> dict[str, float]:
        """The values of its own parameters by name; a missing one keeps its default."""
        return dict(zip(self.parameters, self.parameter_vector(parameters).tolist(), strict=True))

    @cached_property
    def gains(self) -> ca.Function:
        """``p -> [Kp, Ki, Kd, Tf]`` of the parallel form, which is what runs, from the parameters of any `Form`."""
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        return ca.Function("gains", [stack(p)], [ca.vertcat(*parallel_gains(self.pid.form, without_prefix(p, "pid")))])

    def parallel_form(self, parameters: ParameterSet) -> ParallelForm:
        """The gains in the parallel form, from the parameters of any `Form`."""
        return ParallelForm(*self.gains(self.parameter_vector(parameters)).full().ravel().tolist())

    def sensor_lag(self, p: Mapping[str, Any]) -> Any:
        """The sensor's time constant in the loop linearised [s]; its parameters are numbers or arrays."""
        return self.sensor.time_constant(self.sensed_signal, without_prefix(p, "sensor")) if self.sensor else 0.0

    def sensor_resolution(self, parameters: ParameterSet) -> float:
        """What one count of the sensor changes its reading by [feedback's unit]; 0 of a sensor without counts."""
        if self.sensor is None:
            return 0.0
        on = replace(self.sensed_signal, measured=self.feedback)
        return self.sensor.reading_resolution(on, without_prefix(self.values(parameters), "sensor"))

    @property
    def dead_time(self) -> float:
        """Of the loop linearised [s]: half a sample for the hold, and the computing delay."""
        return (0.5 + self.pid.delay) * (self.pid.sample_time or 0.0)

    def dither_period(self, parameters: ParameterSet) -> float | None:
        """The time over which averages and ripple are taken [s] (`Dither.period`); None without dither."""
        value = self.values(parameters)
        if self.dither is None or value["dither.amplitude"] == 0:
            return None
        return self.dither.period(value["dither.frequency"], self.pid.sample_time)

    @cached_property
    def compensation(self) -> ca.Function:
        """``(command, reference, measured, readings, p) -> [compensated, slope, feedback]`` of what acts always.

        Under constant signals and a reference at rest; the slopes are to the PID's command and to the measured signal.
        """
        v, r, y = (ca.SX.sym(n) for n in ("command", "reference", "measured"))
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        shown: Signals = {n: ca.SX.sym(n) for n in self.readings}
        on, made = self.sensed_signal, v
        for part in self.acting_always:
            rates = dict.fromkeys(part.motion_inputs(on), ca.SX(0))
            seen = ControllerSnapshot(ca.SX(0), r, y, made, None, rates, shown)
            names = (q.name for q in part.states(on, self.command))
            x = dict(zip(names, map(ca.SX, part.start(on, seen)), strict=True))
            made = made + part.act(seen, x, without_prefix(p, part.section))[1]
        slopes = (ca.densify(ca.jacobian(made, signal)) for signal in (v, y))
        return ca.Function("compensation", [v, r, y, stack(shown), stack(p)], [made, *slopes])

    def uncompensated_command(
        self, p: Array, reference: Any, measured: Any, command: ArrayLike, readings: ArrayLike = ()
    ) -> Array:
        """The PID's command, shape (m,), of which the compensators that act always make another one, shape (m,).

        Parameters p have shape (n_parameters,) or (n_parameters, m) in the controller's order, readings likewise.
        """
        wanted = np.atleast_1d(np.asarray(command, dtype=float))
        if not self.acting_always:
            return wanted
        shown = np.asarray(readings, dtype=float)
        return invert_increasing(lambda v: self._evaluate_compensation(p, reference, measured, v, shown)[0], wanted)

    def compensation_slopes(self, p: Array, measured: ArrayLike, command: ArrayLike) -> tuple[Array, Array]:
        """Derivatives of the compensated command to the PID's command and to the measured signal, shape (m,) each.

        At a steady operating point without dither: the reference equals the measured signal, shape (m,), and the
        command, shape (m,), is what the actuator gets, the dither's offset included.
        """
        order = list(self.parameters)
        offset = p[order.index(DITHER_OFFSET)] if DITHER_OFFSET in order else 0.0
        v = self.uncompensated_command(p, measured, measured, np.asarray(command) - offset)
        _, slope, feedback = self._evaluate_compensation(p, measured, measured, v)
        return slope, feedback

    def _evaluate_compensation(
        self, p: Array, reference: Any, measured: Any, v: Array, readings: ArrayLike = ()
    ) -> list[Array]:
        """What `compensation` gives for m points at once, shape (m,) each."""
        rows = [np.broadcast_to(a, v.shape)[None] for a in (v, reference, measured)]
        shown = np.asarray(readings, dtype=float)
        rows.append(np.broadcast_to(shown[:, None] if shown.ndim == 1 else shown, (len(self.readings), len(v))))
        given = p if np.ndim(p) > 1 else np.repeat(np.reshape(p, (-1, 1)), len(v), axis=1)
        return [np.asarray(found, dtype=float).ravel() for found in self.compensation(*rows, given)]


def signals_are_good(values: list[Any]) -> ca.SX:
    """Whether each of these is a number: the positive form, as what is none compares false."""
    good: ca.SX = abs(values[0]) <= LARGEST_SIGNAL
    for value in values[1:]:
        good = ca.logic_and(good, abs(value) <= LARGEST_SIGNAL)
    return good


def _choose(condition: ca.SX, values: Signals, others: Symbols) -> Signals:
    """Values where a condition holds, else the others of the same names."""
    return {n: ca.if_else(condition, v, others[n]) for n, v in values.items()}


def invert_increasing(function: Callable[[Array], Array], wanted: Array) -> Array:
    """Where an increasing function of shape (m,) takes the values wanted, entry by entry, by bisection.

    Examples
    --------
    >>> invert_increasing(lambda v: v**3, np.array([8.0, 0.0, -1.0])).round(12).tolist()
    [2.0, 0.0, -1.0]
    """
    reach = np.ones_like(wanted)
    for _ in range(MAX_DOUBLINGS):
        outside = (function(wanted - reach) > wanted) | (function(wanted + reach) < wanted)
        if not outside.any():
            break
        reach[outside] *= 2
    low, high = wanted - reach, wanted + reach
    for _ in range(MAX_BISECTIONS):
        middle = (low + high) / 2
        above = function(middle) > wanted
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.asarray(low)
