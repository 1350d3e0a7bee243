"""`ClosedLoop`: a plant, a PID and a dither, as a `System` or a `DiscreteSystem` for the solvers.

Where the parts meet: the reference r and the measured output y, or what a sensor shows of it, enter the PID,
feedforward, compensators and dither are added to its command, the sum is clipped, and the result, the output "control",
drives the actuated input.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from operator import or_
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.control.compensation import (
    Compensator,
    check_compensators,
    check_values,
    compensation_function,
)
from pneuopt.control.dither import Dither
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.forms import ParallelForm, parallel_gains
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop_equations import continuous_rates, held_rates
from pneuopt.control.loop_start import start_state
from pneuopt.control.pid import PID
from pneuopt.control.position_loop import PositionLoop
from pneuopt.control.sampled import controller_readings, controller_update
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED, Encoder, SensedSignal, SensorLag
from pneuopt.control.sensor import Signals
from pneuopt.control.wiring import check_algebraic_loop, check_cascade, evaluate_plant, select_signal
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.runnable import PlantField
from pneuopt.dynamics.system import (
    DiscreteSystem,
    Motion,
    System,
    define,
    discretise,
    names,
    stack,
    symbols,
)
from pneuopt.quantities.arguments import check_argument
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity, without_prefix
from pneuopt.quantities.unit_algebra import unit_ratio


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
