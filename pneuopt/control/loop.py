"""`ClosedLoop`: a plant, a PID and a dither, as a `System` or a `DiscreteSystem` for the solvers.

Where the parts meet: the reference r and the measured output y, or what a sensor shows of it, enter the PID,
feedforward, compensators and dither are added to its command, the sum is clipped, and the result, the output "control",
drives the actuated input.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from math import inf
from operator import or_
from typing import Any, Protocol

import casadi as ca
import numpy as np

from pneuopt.control.compensators import (
    Compensator,
    Instant,
    check_compensators,
    check_values,
    compensation_function,
    uncompensated_command,
)
from pneuopt.control.controller import (
    CommandParts,
    Feedforward,
    PositionLoop,
    added_command,
    controller_readings,
    controller_update,
    pid_reference,
)
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import GainSchedule, ScheduledParts, schedule_gains
from pneuopt.control.pid import PID, ParallelForm, integrates, parallel_gains
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder, SensedSignal, SensorLag, Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.runnable import PlantField
from pneuopt.dynamics.system import (
    FRICTION_DIRECTION,
    DiscreteSystem,
    Motion,
    Symbols,
    System,
    define,
    discretise,
    names,
    parameter_vector,
    stack,
    symbols,
)
from pneuopt.quantities.arguments import check_argument
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, ModelError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, Quantity, with_prefix, without_prefix
from pneuopt.quantities.unit_algebra import unit_ratio


def evaluate_plant(
    plant: System, actuated: str, t: ca.SX, x: Symbols, u: Symbols, p: Symbols, command: ca.SX
) -> tuple[Signals, Signals]:
    """Rates and outputs of the plant under a command."""
    driven = {**u, actuated: command}
    xs, us = (ca.vertcat(*(v[n] for n in names(q))) for v, q in ((x, plant.states), (driven, plant.inputs)))
    xdot, y = plant.ode(t, xs, us, ca.vertcat(*(p[n] for n in plant.parameters)))
    states, outputs = names(plant.states), names(plant.outputs)
    return {n: xdot[k] for k, n in enumerate(states)}, {n: y[k] for k, n in enumerate(outputs)}


def select_signal(kind: str, name: str | None, known: Sequence[Quantity], usual: str | None) -> Quantity:
    """The signal of that name, by default the usual one or the only one.

    Raises
    ------
    ModelError
        If there are several; `UnknownNameError` if there is none of that name.
    """
    by_name = {q.name: q for q in known}
    if name is None:
        name = usual if usual in by_name else next(iter(by_name)) if len(by_name) == 1 else None
    field = "actuated" if kind == "input" else "measured"
    require(name is not None, f"the plant has the {kind}s {', '.join(by_name) or 'none'}; choose {field}=", ModelError)
    check_names(kind, [str(name)], by_name, f"ClosedLoop {field}")
    return by_name[str(name)]


def check_algebraic_loop(plant: System, command: str, output: str) -> None:
    """Refuse an algebraic loop: an output that depends on the command without any lag."""
    t, x, u = (ca.SX.sym(k, plant.ode.size1_in(i)) for i, k in enumerate("txu"))
    y = plant.ode(t, x, u, ca.SX.sym("p", plant.ode.size1_in(3)))[1]
    j, i = names(plant.inputs).index(command), names(plant.outputs).index(output)
    require(
        ca.jacobian(y[i], u[j]).nnz() == 0,
        f"algebraic loop: output {output!r} depends on input {command!r} without any lag; "
        "measure another output, or give the plant an actuator or a sensor with a lag",
        ModelError,
    )


class JoinedSignals(Protocol):
    """The signals of a `ClosedLoop` at which plant and controller meet."""

    @property
    def plant(self) -> System:
        """Without the controller."""
        ...

    @property
    def command(self) -> Quantity:
        """The plant's input that the controller drives."""
        ...

    @property
    def feedback(self) -> Quantity:
        """The plant's output that is fed back, by which the loop is judged."""
        ...

    @property
    def pid_signal(self) -> Quantity:
        """The plant's output that the PID controls."""
        ...


class CascadedLoop(JoinedSignals, Protocol):
    """What of a `ClosedLoop` decides whether it can be a cascade."""

    @property
    def outer(self) -> object:
        """The outer loop."""
        ...

    @property
    def feedforward(self) -> object:
        """The feedforward of the reference's jumps."""
        ...


def check_cascade(loop: CascadedLoop) -> None:
    """Refuse an outer loop of anything but the axis's position, and a feedforward of its jumps."""
    if loop.outer is None:
        return
    position = (loop.plant.axis or Axis()).position
    told = f"a PositionLoop controls the {position}, this loop {loop.feedback.name!r}; take measured={position!r}"
    require(loop.feedback.name == position, told, ModelError)
    check_algebraic_loop(loop.plant, loop.command.name, position)
    told = "a Feedforward is of jumps of what the PID follows, in a cascade a speed; take MotionFeedforward"
    require(loop.feedforward is None, told, ModelError)


def check_initial_command(command: float, value: Mapping[str, float], unit: str) -> None:
    """Refuse a start that takes a command beyond the limits."""
    low, high = value.get("pid.lower", -inf), value.get("pid.upper", inf)
    require(
        low <= command <= high,
        f"the loop cannot start at rest: it needs a command of {command:g} {unit}, the limits are {low:g} and {high:g}",
    )


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant under feedback.

    Parameters
    ----------
    plant : drive or System
        Held as its system, whose command, and so the loop's, is the deviation from the valve's centre.
    pid : PID
    dither : Dither, optional
    actuated : str, optional
        The plant's input that the controller drives; by default its only one. Others stay inputs of the loop.
    measured : str, optional
        The plant's output that is fed back; by default "speed", or the only one.
    sensor : SensorLag or Encoder, optional
        Through which the controller sees it. What the loop is judged by is the output itself.
    feedforward : Feedforward, optional
        What a change of the reference adds to the PID's command.
    compensators : tuple of Compensator
        What is added to the command, in the order in which they act: `Knocker`, `FrictionFeedforward`,
        `DeadZoneInverse`, `ImpulsiveControl`, `MotionFeedforward`, `PressureFeedback`, `AccelerationFeedback`.
    outer : PositionLoop, optional
        Makes the loop a cascade: it is judged by the position, whose error sets the speed that the PID controls.
    schedule : GainSchedule, optional
        Gains that change with the position and the load.

    Raises
    ------
    ModelError
        If the input or output is ambiguous or unknown, if the measured output depends on the command without any lag
        (an algebraic loop), if the sensor or a compensator does not fit, or if names collide.
    InputError
        If the dither cannot be sampled.
    """

    plant: PlantField = PlantField()  # noqa: RUF009 - the field, no default
    pid: PID  # type: ignore[misc]  # mypy takes the field before it for a default
    dither: Dither | None = None
    actuated: str | None = None
    measured: str | None = None
    sensor: SensorLag | Encoder | None = None
    feedforward: Feedforward | None = None
    compensators: tuple[Compensator, ...] = ()
    outer: PositionLoop | None = None
    schedule: GainSchedule | None = None

    def __post_init__(self) -> None:
        if self.sensor is not None:
            self.sensor.check(self.sensed_signal)
        if not isinstance(self.sensor, SensorLag):
            check_algebraic_loop(
                self.plant, self.command.name, self.pid_signal.name if self.sensor is None else self.sensor.position
            )
        check_cascade(self)
        reserved = {"reference": names(self.plant.inputs), "control": names(self.plant.outputs)}
        for name, taken in reserved.items():
            require(name not in taken, f"the plant has a signal {name!r} of its own; rename it", ModelError)
        doubled = isinstance(self.sensor, SensorLag) and "sensor.lag" in self.plant.parameters
        require(not doubled, "the plant has a sensor.lag of its own; leave sensor= out", ModelError)
        check_compensators(self.compensators, self.sensed_signal, self.plant.axis)
        for name in self.readings:
            check_algebraic_loop(self.plant, self.command.name, name)
        twice = [q.name for q in self.motion_inputs if q.name in names(self.plant.inputs)]
        require(not twice, f"the plant has inputs {', '.join(twice)} of its own; rename them", ModelError)
        own = self.parameters  # raises where a part cannot be built: a dither beyond the Nyquist frequency, say
        if self.schedule:
            self.schedule.check(own)

    def __repr__(self) -> str:
        model = self.system() if self.pid.sample_time is None else self.discrete()
        return repr(model).replace(type(model).__name__, "ClosedLoop", 1)

    @property
    def loop(self) -> "ClosedLoop":
        """The loop itself, as `Rig.loop` is the loop behind a rig's sensors."""
        return self

    @cached_property
    def command(self) -> Quantity:
        """The plant's input that the controller drives."""
        return select_signal("input", self.actuated, self.plant.inputs, None)

    @cached_property
    def feedback(self) -> Quantity:
        """The plant's output that is fed back."""
        usual = (self.plant.axis or Axis()).position if self.outer else "speed"
        return select_signal("output", self.measured, self.plant.outputs, usual)

    @property
    def pid_signal(self) -> Quantity:
        """The plant's output that the PID controls."""
        if self.outer is None:
            return self.feedback
        speed = (self.plant.axis or Axis()).speed
        return select_signal("output", speed, self.plant.outputs, None)

    @cached_property
    def parameters(self) -> ParameterSet:
        """Those of the plant, "pid.*", "dither.*", "sensor.*", "feedforward.*" and the compensators', all defaults."""
        h, measured, unit = self.pid.sample_time, self.pid_signal.unit, self.command.unit
        parts = {
            "pid": self.pid.parameters(measured, unit, self.feedback.unit),
            "dither": self.dither.parameters(unit, h) if self.dither else ParameterSet(),
            "sensor": self.sensor.parameters(self.sensed_signal) if self.sensor else ParameterSet(),
            "feedforward": self.feedforward.parameters(measured, unit) if self.feedforward else ParameterSet(),
            **{c.section: c.parameters(self.sensed_signal, unit) for c in self.compensators},
        }
        if self.outer:
            parts[self.outer.section] = self.outer.parameters(self.feedback.unit, measured)
        if self.schedule:
            parts["schedule"] = self.schedule.plant_parameters(self.plant)
        return reduce(or_, (own.with_prefix(name) for name, own in parts.items()), self.plant.parameters)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The plant's, the sensor's ("sensor.reading"), the controller's ("pid.*", "feedforward.filter") and so on."""
        parts = {
            "sensor": self.sensor.states(self.sensed_signal) if self.sensor else (),
            "pid": self.pid.states(self.pid_signal, self.command),
            "feedforward": self.feedforward.states(self.feedback) if self.feedforward else (),
            **{c.section: c.states(self.sensed_signal, self.command) for c in self.compensators},
        }
        own = (replace(q, name=f"{name}.{q.name}") for name, quantities in parts.items() for q in quantities)
        return (*self.plant.states, *own)

    @property
    def tunable_sections(self) -> tuple[str, ...]:
        """Prefixes of the parameters that a tuning may change: the controller's, not the sensor's or the plant's."""
        outer = (self.outer.section,) if self.outer else ()
        return ("pid", *outer, "dither", "feedforward", *(c.section for c in self.compensators), "schedule")

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The reference, its rates that a compensator uses, then the plant's inputs that no controller drives."""
        reference = replace(self.feedback, name="reference")
        return (reference, *self.motion_inputs, *(q for q in self.plant.inputs if q.name != self.command.name))

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
        """The plant's outputs that the controller reads beside what its PID controls, in the plant's order."""
        used = controller_readings(self)
        return tuple(n for n in names(self.plant.outputs) if n in used)

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """The plant's, then "control": what the actuator gets."""
        return (*self.plant.outputs, replace(self.command, name="control"))

    @property
    def is_composed(self) -> bool:
        """Whether more than a PID of one signal is fed back, so that the loop is linearised by `ComposedLoops`."""
        on = self.sensed_signal
        return bool(self.outer or self.schedule) or any(
            part.acts_always and part.states(on, self.command) for part in self.compensators
        )

    def system(self) -> System:
        """The loop as one ODE, with a continuous PID.

        Raises
        ------
        ModelError
            If the PID is sampled: use `discrete`, or `hold_system` and `update`.
        """
        h = self.pid.sample_time
        require(
            h is None,
            f"a loop sampled every {h} s is no ODE; use discrete(), or hold_system() between samples",
            ModelError,
        )
        return define(self.states, self.inputs, self.outputs, self.parameters, partial(continuous_rates, self))

    def hold_system(self) -> System:
        """Between two samples of a sampled PID: the plant runs on the held command, the controller's states rest.

        An analogue dither is in here, as a function of time; a sampled one is part of the held command.
        """
        require(self.pid.sample_time is not None, "a continuous loop holds nothing; use system()", ModelError)
        return define(self.states, self.inputs, self.outputs, self.parameters, partial(held_rates, self))

    @cached_property
    def update(self) -> ca.Function:
        """What a sampled PID does at a sample: ``(t, x, u, p) -> x`` with the loop's states, inputs and parameters."""
        require(self.pid.sample_time is not None, "a continuous loop has no update; use system()", ModelError)
        t, x, u = ca.SX.sym("t"), symbols(self.states), symbols(self.inputs)
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        y = evaluate_plant(self.plant, self.command.name, t, x, u, p, ca.SX(0))[1]
        after = stack({**x, **controller_update(self, t, x, u, y, p).states})
        return ca.Function("update", [t, *map(stack, (x, u, p))], [after], ["t", "x", "u", "p"], ["x_after"])

    def discrete(self, substeps: int = 1) -> DiscreteSystem:
        """The loop as a sampled step of RK4; its inputs are held from sample to sample.

        Parameters
        ----------
        substeps : int
            RK4 steps a sample; with a sampled PID, the plant's on the held command.
        """
        if self.pid.sample_time is None:
            return discretise(self.system(), substeps)
        return replace(discretise(self.hold_system(), substeps), update=self.update, sample_time=self.pid.sample_time)

    def motion(self) -> Motion:
        """See `Runnable`."""
        if self.pid.sample_time is None:
            return Motion(self.system())
        return Motion(self.hold_system(), self.update, self.pid.sample_time)

    def rest_state(self, parameters: ParameterSet, outputs: Mapping[str, float] | None = None) -> Array:
        """See `Runnable`: `initial` without outputs; with them, zeros where the plant has no `rest_hook`."""
        if outputs is None:
            return self.initial(parameters)
        if self.plant.rest_hook is None:
            return np.zeros(len(self.states))
        command = self.plant.rest_hook(parameters, outputs).inputs.get(self.command.name, 0.0)
        return self.initial(parameters, self.plant.rest_state(parameters, outputs), command=command)

    def check(self, parameters: ParameterSet) -> None:
        """Refuse values that no loop can run with, whatever their bounds: `InputError` names the parameter."""
        self.plant.check(parameters)
        value = dict(zip(self.parameters, self.parameter_vector(parameters), strict=True))
        h = self.pid.sample_time
        if self.dither:
            self.dither.check(value["dither.frequency"], h)
        if self.feedforward:
            time = value["feedforward.time"]
            require(time > 0, f"feedforward.time must be positive, got {time:g} s; without it set its gain to zero")
        if self.schedule:
            self.schedule.check_values(without_prefix(value, "schedule"))
        check_values(self.compensators, self.parameters, value, self.count_size(parameters))
        Tf = float(self.gains(list(value.values()))[3])
        self.pid.check({**without_prefix(value, "pid"), "Tf": Tf}, self.command.unit)

    def complete(self, parameters: ParameterSet) -> ParameterSet:
        """A set with every parameter of the loop: the given ones, and the loop's defaults for those that are missing.

        The loop's come first, in the order of `ClosedLoop.parameters`; what else `parameters` holds follows.
        """
        return self.parameters | parameters

    def parameter_vector(self, parameters: ParameterSet) -> Array:
        """The vector p of `parameters` in the loop's order; a missing one keeps the loop's default."""
        return np.array([parameters.value(n) if n in parameters else q.value for n, q in self.parameters.items()])

    @cached_property
    def gains(self) -> ca.Function:
        """``p -> [Kp, Ki, Kd, Tf]`` of the parallel form, which is what runs, from the parameters of any `Form`."""
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        return ca.Function("gains", [stack(p)], [ca.vertcat(*parallel_gains(self.pid.form, without_prefix(p, "pid")))])

    @cached_property
    def compensation(self) -> ca.Function:
        """The compensators that act always, and their slopes: see `compensation_function`."""
        return compensation_function(self, self.sensed_signal, self.command)

    def parallel_form(self, parameters: ParameterSet) -> ParallelForm:
        """The gains in the parallel form, from the parameters of any `Form`."""
        return ParallelForm(*self.gains(self.parameter_vector(parameters)).full().ravel().tolist())

    def sensor_lag(self, p: Array) -> Any:
        """The sensor's time constant in the loop linearised [s]; p of shape (n_parameters,) or (n_parameters, m)."""
        value = without_prefix(dict(zip(self.parameters, p, strict=True)), "sensor")
        return self.sensor.time_constant(self.sensed_signal, value) if self.sensor else 0.0

    def count_size(self, parameters: ParameterSet) -> float:
        """What one count of the sensor changes its reading by [feedback's unit]; 0 of a sensor without counts."""
        if self.sensor is None:
            return 0.0
        value = dict(zip(self.parameters, self.parameter_vector(parameters).tolist(), strict=True))
        on = replace(self.sensed_signal, measured=self.feedback)
        return self.sensor.count_size(on, without_prefix(value, "sensor"))

    @property
    def dead_time(self) -> float:
        """Of the loop linearised [s]: half a sample for the hold, and the computing delay."""
        return (0.5 + self.pid.delay) * (self.pid.sample_time or 0.0)

    def dither_period(self, parameters: ParameterSet) -> float | None:
        """The time over which averages and ripple are taken [s] (`Dither.period`); None without dither."""
        value = dict(zip(self.parameters, self.parameter_vector(parameters), strict=True))
        if self.dither is None or value["dither.amplitude"] == 0:
            return None
        return self.dither.period(value["dither.frequency"], self.pid.sample_time)

    def initial(
        self,
        parameters: ParameterSet,
        x_plant: Sequence[float] | Array | None = None,
        *,
        reference: float = 0.0,
        command: float = 0.0,
        start: Mapping[str, float] | None = None,
    ) -> Array:
        """The loop at rest, or in steady motion, before dither is switched on.

        Parameters
        ----------
        parameters : ParameterSet
        x_plant : array_like, shape (n_plant_states,), optional
            The plant's state. Without it the closed loop is solved for its equilibrium at `reference`, other inputs 0;
            a plant that knows its rest stands there, or moves steadily, and the controller takes over the command that
            keeps it so. A position on which nothing depends may move on.
        reference : float
            The reference so far [unit of the measured signal].
        command : float
            With `x_plant`: the command so far, which the controller takes over without a bump [unit of the command].
        start : mapping of str to float, optional
            Without `x_plant`: what else is known of the plant, by name, as for `Step`.

        Returns
        -------
        ndarray, shape (n_states,)

        Raises
        ------
        ConvergenceError
            If the closed loop has no equilibrium there (a spring that a motion loads, say); give `x_plant`.
        InputError
            If a value cannot run (`check`), the plant cannot move so, the command lies beyond the controller's limits,
            or `start` names what this plant does not start from.
        """
        self.check(parameters)
        return start_state(self, parameters, x_plant, reference, command, start or {})

    @cached_property
    def sensed_signal(self) -> SensedSignal:
        """What the sensor reads."""
        axis = self.plant.axis or Axis()
        order = {axis.position: 0, axis.speed: 1}.get(self.pid_signal.name, None if self.plant.axis else 1)
        outputs = {q.name: q for q in self.plant.outputs}
        return SensedSignal(self.pid_signal, outputs, self.pid.sample_time, order, cascade=bool(self.outer))


def check_closed_loop(loop: object) -> None:
    """Raise `InputError` where `loop` is no `ClosedLoop`, but a drive, say."""
    check_argument("loop", loop, ClosedLoop, "a ClosedLoop, such as ClosedLoop(drive, PID())")


def add_disturbances(loop: ClosedLoop, references: Iterable[Reference]) -> ClosedLoop:
    """Give the plant an input for each disturbance of the references, named by `disturbance_input`.

    A parameter becomes its value plus that input, an input of the plant likewise; so 0 is the plant as it was.

    Raises
    ------
    UnknownNameError
        If a disturbance is neither a parameter nor an input of the plant.
    """
    wanted = dict.fromkeys(n for reference in references for n in reference.disturbance)
    new = [n for n in wanted if disturbance_input(n) not in names(loop.plant.inputs)]
    known = [*names(loop.plant.inputs), *loop.plant.parameters]
    check_names("parameter or input of the plant", new, known, "disturbance")
    if not new:
        return loop
    plant = _add_plant_disturbances(loop.plant, new)
    return replace(loop, plant=plant, actuated=loop.command.name, measured=loop.feedback.name)


def _add_plant_disturbances(plant: System, wanted: list[str]) -> System:
    u, p = (ca.SX.sym(n, plant.ode.size1_in(i)) for i, n in ((2, "u"), (3, "p")))
    t, x, d = ca.SX.sym("t"), ca.SX.sym("x", plant.ode.size1_in(1)), ca.SX.sym("d", len(wanted))
    inputs, parameters = list(names(plant.inputs)), list(plant.parameters)
    us, ps = ca.SX(u), ca.SX(p)
    for k, n in enumerate(wanted):
        if n in inputs:
            us[inputs.index(n)] += d[k]
        else:
            ps[parameters.index(n)] += d[k]

    def wrap(function: ca.Function) -> ca.Function:
        arguments, given = [t, x, ca.vertcat(u, d), p], ["t", "x", "u", "p"]
        found = function.call([t, x, us, ps])  # a list, whatever the number of outputs
        return ca.Function(function.name(), arguments, found, given, list(function.name_out()))

    units = {q.name: q.unit for q in plant.inputs} | {n: q.unit for n, q in plant.parameters.items()}
    more = tuple(Quantity(disturbance_input(n), units[n]) for n in wanted)
    meter = None if plant.meter is None else wrap(plant.meter)
    return replace(plant, inputs=(*plant.inputs, *more), ode=wrap(plant.ode), meter=meter)


def continuous_rates(loop: "ClosedLoop", t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
    """Rates and outputs of a loop with a continuous PID."""
    shown = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, ca.SX(0))[1]
    seen = x["sensor.reading"] if loop.sensor else shown[loop.pid_signal.name]
    p = schedule_gains(loop, p, seen, {}, shown)
    u = pid_reference(loop, u, shown[loop.feedback.name], p)
    moved, added = added_command(loop, t, x, u, seen, shown, p)
    rates, command = loop.pid.rates(without_prefix(x, "pid"), u["reference"], seen, added, without_prefix(p, "pid"))
    xdot, y = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, command)
    own = with_prefix(rates, "pid") | moved | _sensor_rates(loop, x, y, p)
    return xdot | own, y | {"control": command}


def held_rates(loop: "ClosedLoop", t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
    """Rates and outputs of a loop with a sampled PID while its command is held."""
    command = x["pid.command"]
    if loop.dither and loop.dither.analogue:
        command = loop.pid.clip(command + loop.dither.wave(t, without_prefix(p, "dither")), without_prefix(p, "pid"))
    xdot, y = evaluate_plant(loop.plant, loop.command.name, t, x, u, p, command)
    held = tuple(f"{n}." for n in loop.tunable_sections)
    own = {n: ca.SX(0) for n in x if n.startswith(held)} | _sensor_rates(loop, x, y, p)
    return xdot | own, y | {"control": command}


def _sensor_rates(loop: "ClosedLoop", x: Symbols, y: Symbols, p: Symbols) -> Signals:
    if loop.sensor is None:
        return {}
    own = without_prefix(x, "sensor"), y, loop.sensed_signal, without_prefix(p, "sensor")
    return with_prefix(loop.sensor.rates(*own), "sensor")


def start_state(
    loop: "ClosedLoop",
    parameters: ParameterSet,
    x_plant: Sequence[float] | Array | None,
    reference: float,
    command: float,
    start: Mapping[str, float],
) -> Array:
    """The state of `ClosedLoop.initial`, which tells of the arguments; shape (n_states,)."""
    parameters = set_sliding_direction(loop, loop.complete(parameters), reference)
    p = loop.parameter_vector(parameters)
    value = dict(zip(loop.parameters, p, strict=True))
    if x_plant is None:
        x, command = find_rest(loop, parameters, reference, start)
    else:
        x, shape = np.asarray(x_plant, dtype=float), (len(loop.plant.states),)
        require(x.shape == shape, f"x_plant has shape {x.shape}, the plant's state has {shape}")
    check_initial_command(command, value, loop.command.unit)
    shown = loop.plant.ode(0, x, np.zeros(len(loop.plant.inputs)), [value[n] for n in loop.plant.parameters])[1]
    y = dict(zip(names(loop.plant.outputs), shown.full().ravel().tolist(), strict=True))
    sensor = loop.sensor.start(y, loop.sensed_signal, without_prefix(value, "sensor")) if loop.sensor else []
    seen = sensor[0] if sensor else y[loop.pid_signal.name]
    value = dict(schedule_gains(loop, value, seen, {}, y))
    p = np.array([float(v) for v in value.values()])
    wanted = float(pid_reference(loop, {"reference": reference}, y[loop.feedback.name], value)["reference"])
    v = float(uncompensated_command(loop, p, wanted, seen, command, [y[n] for n in loop.readings])[0])
    own = [float(state) for state in loop.pid.start(wanted, seen, v, without_prefix(value, "pid"))]
    known = Instant(0.0, wanted, seen, v, loop.pid.sample_time, {}, y)
    others = [float(remembered) for part in loop.compensators for remembered in part.start(loop.sensed_signal, known)]
    return np.concatenate([x, sensor, own, [reference] if loop.feedforward else [], others])


INTEGRAL_STATE = "pid.integral"


class WiredLoop(CommandParts, JoinedSignals, ScheduledParts, Protocol):
    """What of a `ClosedLoop` its equilibrium depends on."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The reference, then the plant's other inputs."""
        ...

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """The plant's, then the control."""
        ...

    @property
    def parameters(self) -> ParameterSet:
        """The plant's and the controller's."""
        ...

    @property
    def gains(self) -> ca.Function:
        """``p -> [Kp, Ki, Kd, Tf]`` of the parallel form."""
        ...

    @property
    def readings(self) -> tuple[str, ...]:
        """The outputs of the plant that compensators read."""
        ...

    @property
    def compensation(self) -> ca.Function:
        """``(command, reference, measured, readings, p) -> compensated`` command, and its slopes."""
        ...


def find_rest(
    loop: WiredLoop, parameters: ParameterSet, reference: float, start: Mapping[str, float]
) -> tuple[Array, float]:
    """The plant's state and the command, at rest or in steady motion.

    A plant with a `rest_hook` gives them. Otherwise they are the equilibrium of plant and controller; a state that
    neither the rates nor the measured output depend on, such as the position of an axis under speed control, is left
    out and may keep moving.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
    reference : float
        [unit of the measured signal]
    start : mapping of str to float
        What else is known of the plant.

    Raises
    ------
    ConvergenceError
        If there is no equilibrium.
    InputError
        If the plant refuses, or does not start from what `start` names.
    """
    plant, measured = loop.plant, loop.feedback.name
    require(measured not in start, f"start: {measured!r} is what the loop controls; give it as initial=")
    if plant.rest_hook is not None:
        try:
            rest = plant.rest_hook(parameters, {measured: reference, **start})
        except ConvergenceError as error:
            raise _no_rest(loop, reference, error) from None
        return np.array([rest.states.get(n, 0.0) for n in names(plant.states)]), rest.inputs.get(loop.command.name, 0.0)
    free = unobservable_states(plant, measured)
    others = ", ".join(sorted(start.keys() - free))
    require(not others, f"start: this plant cannot start from {others}, only from {', '.join(free) or 'its rest'}")
    system = _rest_system(loop, free, parameters)
    guess = {measured: reference} if measured in names(system.states) else {}
    try:
        x = system.equilibrium({"reference": reference}, parameters, guess)
    except ConvergenceError as error:
        raise _no_rest(loop, reference, error) from None
    found = {**start, **dict(zip(names(system.states), x.tolist(), strict=True))}
    u = [reference] + [0.0] * (len(system.inputs) - 1)
    command = float(system.ode(0, x, u, parameter_vector(system.parameters, parameters))[1][-1])
    return np.array([found.get(n, 0.0) for n in names(plant.states)]), command


def set_sliding_direction(loop: WiredLoop, parameters: ParameterSet, reference: float) -> ParameterSet:
    """Set the direction in which Karnopp's friction already slides where the plant moves at the start.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Every parameter of the loop.
    reference : float
        The speed so far [m/s, or rad/s].
    """
    if loop.feedback.name != "speed" or FRICTION_DIRECTION not in loop.parameters:
        return parameters
    return parameters.with_values({FRICTION_DIRECTION: float(np.sign(reference))})


def unobservable_states(plant: System, measured: str) -> tuple[str, ...]:
    """States on which no rate and not the measured output depends."""
    t, x, u, p = (ca.SX.sym(k, plant.ode.size1_in(i)) for i, k in enumerate("txup"))
    xdot, y = plant.ode(t, x, u, p)
    what = ca.vertcat(xdot, y[names(plant.outputs).index(measured)])
    matters = ca.which_depends(what, x, 1)
    return tuple(n for n, counts in zip(names(plant.states), matters, strict=True) if not counts)


def _no_rest(loop: WiredLoop, reference: float, error: ConvergenceError) -> ConvergenceError:
    where = f"{loop.feedback.name} {reference:g} {loop.feedback.unit}"
    message = f"the loop neither rests nor moves steadily at {where}: {error}, or give x_plant"
    return ConvergenceError(message, error.solution)


def _rest_system(loop: WiredLoop, free: tuple[str, ...], parameters: ParameterSet) -> System:
    """The loop with the integral as its controller's only state, and without the plant's free ones."""
    plant, acts = loop.plant, integrates(float(loop.gains(parameter_vector(loop.parameters, parameters))[1]))
    integral = [Quantity(INTEGRAL_STATE, loop.command.unit, loop.command.nominal)] if acts else []
    states = [*(q for q in plant.states if q.name not in free), *integral]

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
        moving = {n: x.get(n, ca.SX(0)) for n in names(plant.states)}
        shown = evaluate_plant(plant, loop.command.name, t, moving, u, p, ca.SX(0))[1]
        y, read = shown[loop.pid_signal.name], ca.vertcat(*(shown[n] for n in loop.readings))
        p = schedule_gains(loop, p, y, {}, shown)
        r = pid_reference(loop, u, shown[loop.feedback.name], p)["reference"]
        every = ca.vertcat(*p.values())
        gains = loop.gains(every)
        command = gains[0] * (p["pid.b"] * r - y) + x.get(INTEGRAL_STATE, 0.0)
        command = loop.compensation(command, r, y, read, every)[0]
        rates, outputs = evaluate_plant(plant, loop.command.name, t, moving, u, p, command)
        rates |= {INTEGRAL_STATE: gains[1] * (r - y)}
        return {n: rates[n] for n in x}, outputs | {"control": command}

    return define(states, loop.inputs, loop.outputs, loop.parameters, rhs)
