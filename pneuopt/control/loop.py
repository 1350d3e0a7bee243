"""`ClosedLoop`: a plant and its controller as one `System` or `DiscreteSystem` for the solvers, and where it rests.

The plant's outputs go to the controller, whose command, the loop's output "control", drives the plant's actuated input.
`ClosedLoop.system` wires the two in continuous time; with a sampled controller `ClosedLoop.hold_system` is the plant on
a held command, and `ClosedLoop.update` what happens at a sample. What the controller computes stands in `Controller`.

`bumpless_transfer`: new gains on a running loop, its integral set so that the command does not jump.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.compensators import Compensator
from pneuopt.control.controller import Controller, Feedforward, PlantSignals, PositionLoop, invert_increasing
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.pid import PID, ParallelForm, integrates
from pneuopt.control.reference import Reference, disturbance_input
from pneuopt.control.sensor import Encoder, SensorLag, Signals
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
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, ModelError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, Quantity, check_argument, without_prefix

INTEGRAL_STATE = "pid.integral"


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant under feedback.

    Parameters
    ----------
    plant : drive or System
        Held as its system, whose command, and so the loop's, is the deviation from the valve's centre.
    pid : PID
        Its law, gains and limits; whether it is sampled.
    dither : Dither, optional
        An oscillation that is added to the command.
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
        of = self.controller  # raises where its parts fit neither the signals nor one another
        if not isinstance(self.sensor, SensorLag):
            position = of.pid_signal.name if self.sensor is None else self.sensor.position
            check_algebraic_loop(self.plant, self.command.name, position)
        for name in ((self.feedback.name,) if self.outer else ()) + of.readings:
            check_algebraic_loop(self.plant, self.command.name, name)
        reserved = {"reference": names(self.plant.inputs), "control": names(self.plant.outputs)}
        for name, taken in reserved.items():
            require(name not in taken, f"the plant has a signal {name!r} of its own; rename it", ModelError)
        doubled = isinstance(self.sensor, SensorLag) and "sensor.lag" in self.plant.parameters
        require(not doubled, "the plant has a sensor.lag of its own; leave sensor= out", ModelError)
        twice = [q.name for q in of.motion_inputs if q.name in names(self.plant.inputs)]
        require(not twice, f"the plant has inputs {', '.join(twice)} of its own; rename them", ModelError)

    def __repr__(self) -> str:
        model = self.system() if self.pid.sample_time is None else self.discrete()
        return repr(model).replace(type(model).__name__, "ClosedLoop", 1)

    @property
    def loop(self) -> "ClosedLoop":
        """The loop itself, as `Rig.loop` is the loop behind a rig's sensors."""
        return self

    @cached_property
    def controller(self) -> Controller:
        """Everything of the loop but the plant."""
        axis, outputs = self.plant.axis, self.plant.outputs
        usual = (axis or Axis()).position if self.outer else "speed"
        inertia = (axis or Axis()).inertia
        signals = PlantSignals(
            select_signal("input", self.actuated, self.plant.inputs, None),
            select_signal("output", self.measured, outputs, usual),
            {q.name: q for q in outputs},
            axis,
            self.plant.parameters[inertia].unit if inertia in self.plant.parameters else "1",
        )
        own = (self.dither, self.sensor, self.feedforward, self.compensators, self.outer, self.schedule)
        return Controller(self.pid, signals, *own)

    @property
    def command(self) -> Quantity:
        """The plant's input that the controller drives."""
        return self.controller.command

    @property
    def feedback(self) -> Quantity:
        """The plant's output that is fed back."""
        return self.controller.feedback

    @property
    def pid_signal(self) -> Quantity:
        """The plant's output that the PID controls."""
        return self.controller.pid_signal

    @property
    def readings(self) -> tuple[str, ...]:
        """The plant's outputs that the controller reads beside what its PID controls, in the plant's order."""
        return self.controller.readings

    @property
    def motion_inputs(self) -> tuple[Quantity, ...]:
        """Of "reference_speed" and "reference_acceleration" those that a compensator uses."""
        return self.controller.motion_inputs

    @property
    def is_composed(self) -> bool:
        """Whether more than a PID of one signal is fed back, so that the loop is linearised by `ComposedLoops`."""
        return self.controller.is_composed

    @property
    def dead_time(self) -> float:
        """Of the loop linearised [s]: half a sample for the hold, and the computing delay."""
        return self.controller.dead_time

    @cached_property
    def parameters(self) -> ParameterSet:
        """Those of the plant, "pid.*", "dither.*", "sensor.*", "feedforward.*" and the compensators', all defaults."""
        return self.plant.parameters | self.controller.parameters

    @property
    def states(self) -> tuple[Quantity, ...]:
        """The plant's, the sensor's ("sensor.reading"), the controller's ("pid.*", "feedforward.filter") and so on."""
        return (*self.plant.states, *self.controller.states)

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """The reference, its rates that a compensator uses, then the plant's inputs that no controller drives."""
        return (*self.controller.inputs, *(q for q in self.plant.inputs if q.name != self.command.name))

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """The plant's, then "control": what the actuator gets."""
        return (*self.plant.outputs, replace(self.command, name="control"))

    def system(self) -> System:
        """The loop as one ODE, with a continuous PID.

        Raises
        ------
        ModelError
            If the PID is sampled: use `discrete`, or `hold_system` and `update`.
        """
        h, of = self.pid.sample_time, self.controller
        sampled = f"a loop sampled every {h} s is no ODE; use discrete(), or hold_system() between samples"
        require(h is None, sampled, ModelError)

        def rates(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
            no_command = ca.SX(0)  # what the controller measures does not depend on its command
            measured = self.evaluate_plant(t, x, u, p, no_command)[1]
            controller_rates, command = of.rates(t, x, u, measured, p)
            plant_rates, y = self.evaluate_plant(t, x, u, p, command)
            return plant_rates | controller_rates | of.sensor_rates(x, y, p), y | {"control": command}

        return define(self.states, self.inputs, self.outputs, self.parameters, rates)

    def hold_system(self) -> System:
        """Between two samples of a sampled PID: the plant runs on the held command, the controller's states rest.

        An analogue dither is in here, as a function of time; a sampled one is part of the held command.
        """
        require(self.pid.sample_time is not None, "a continuous loop holds nothing; use system()", ModelError)
        at_rest = tuple(f"{section}." for section in self.controller.tunable_sections)

        def rates(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
            command = x["pid.command"]
            if self.dither and self.dither.analogue:
                wave = self.dither.wave(t, without_prefix(p, "dither"))
                command = self.pid.clip(command + wave, without_prefix(p, "pid"))
            plant_rates, y = self.evaluate_plant(t, x, u, p, command)
            controller_rates = {n: ca.SX(0) for n in x if n.startswith(at_rest)}
            sensor_rates = self.controller.sensor_rates(x, y, p)
            return plant_rates | controller_rates | sensor_rates, y | {"control": command}

        return define(self.states, self.inputs, self.outputs, self.parameters, rates)

    @cached_property
    def update(self) -> ca.Function:
        """What a sampled PID does at a sample: ``(t, x, u, p) -> x`` with the loop's states, inputs and parameters."""
        require(self.pid.sample_time is not None, "a continuous loop has no update; use system()", ModelError)
        t, x, u = ca.SX.sym("t"), symbols(self.states), symbols(self.inputs)
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        measured = self.evaluate_plant(t, x, u, p, ca.SX(0))[1]
        after = stack({**x, **self.controller.update(t, x, u, measured, p).states})
        return ca.Function("update", [t, *map(stack, (x, u, p))], [after], ["t", "x", "u", "p"], ["x_after"])

    def evaluate_plant(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols, command: ca.SX) -> tuple[Signals, Signals]:
        """Rates and outputs of the plant under a command."""
        plant, driven = self.plant, {**u, self.command.name: command}
        xs, us = (ca.vertcat(*(v[n] for n in names(q))) for v, q in ((x, plant.states), (driven, plant.inputs)))
        xdot, y = plant.ode(t, xs, us, ca.vertcat(*(p[n] for n in plant.parameters)))
        states, outputs = names(plant.states), names(plant.outputs)
        return {n: xdot[k] for k, n in enumerate(states)}, {n: y[k] for k, n in enumerate(outputs)}

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
        self.controller.check(parameters)

    def complete(self, parameters: ParameterSet) -> ParameterSet:
        """A set with every parameter of the loop: the given ones, and the loop's defaults for those that are missing.

        The loop's come first, in the order of `ClosedLoop.parameters`; what else `parameters` holds follows.
        """
        return self.parameters | parameters

    def parameter_vector(self, parameters: ParameterSet) -> Array:
        """The vector p of `parameters` in the loop's order; a missing one keeps the loop's default."""
        return np.array([parameters.value(n) if n in parameters else q.value for n, q in self.parameters.items()])

    def controller_part(self, p: Array) -> Array:
        """The controller's rows of p, shape (n_parameters,) or (n_parameters, m), in the controller's order."""
        order = {n: k for k, n in enumerate(self.parameters)}
        return p[[order[n] for n in self.controller.parameters]]

    @cached_property
    def gains(self) -> ca.Function:
        """``p -> [Kp, Ki, Kd, Tf]`` of the parallel form, which is what runs, from the parameters of any `Form`."""
        p: Signals = {n: ca.SX.sym(n) for n in self.parameters}
        own = stack({n: p[n] for n in self.controller.parameters})
        return ca.Function("gains", [stack(p)], [self.controller.gains(own)])

    def parallel_form(self, parameters: ParameterSet) -> ParallelForm:
        """The gains in the parallel form, from the parameters of any `Form`."""
        return self.controller.parallel_form(parameters)

    def sensor_lag(self, p: Array) -> Any:
        """The sensor's time constant in the loop linearised [s]; p of shape (n_parameters,) or (n_parameters, m)."""
        return self.controller.sensor_lag(dict(zip(self.parameters, p, strict=True)))

    def dither_period(self, parameters: ParameterSet) -> float | None:
        """The time over which averages and ripple are taken [s] (`Dither.period`); None without dither."""
        return self.controller.dither_period(parameters)

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
            A missing one has the loop's default.
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
            In the order of `states`.

        Raises
        ------
        ConvergenceError
            If the closed loop has no equilibrium there (a spring that a motion loads, say); give `x_plant`.
        InputError
            If a value cannot run (`check`), the plant cannot move so, the command lies beyond the controller's limits,
            or `start` names what this plant does not start from.
        """
        self.check(parameters)
        parameters = set_sliding_direction(self, self.complete(parameters), reference)
        value = dict(zip(self.parameters, self.parameter_vector(parameters), strict=True))
        if x_plant is None:
            x, command = find_rest(self, parameters, reference, start or {})
        else:
            x, shape = np.asarray(x_plant, dtype=float), (len(self.plant.states),)
            require(x.shape == shape, f"x_plant has shape {x.shape}, the plant's state has {shape}")
        low, high = value.get("pid.lower", -inf), value.get("pid.upper", inf)
        told = f"the loop cannot start at rest: it needs a command of {command:g} {self.command.unit}"
        require(low <= command <= high, f"{told}, the limits are {low:g} and {high:g}")
        shown = self.plant.ode(0, x, np.zeros(len(self.plant.inputs)), [value[n] for n in self.plant.parameters])[1]
        y = dict(zip(names(self.plant.outputs), shown.full().ravel().tolist(), strict=True))
        return np.concatenate([x, self.controller.rest_states(parameters, y, reference, command)])


def check_closed_loop(loop: object) -> None:
    """Raise `InputError` where `loop` is no `ClosedLoop`, but a drive, say."""
    check_argument("loop", loop, ClosedLoop, "a ClosedLoop, such as ClosedLoop(drive, PID())")


def add_disturbances(loop: ClosedLoop, references: Iterable[Reference]) -> ClosedLoop:
    """Give the plant an input for each disturbance of the references; it adds to that parameter or input."""
    wanted = dict.fromkeys(n for reference in references for n in reference.disturbance)
    plant, inputs, parameters = loop.plant, list(names(loop.plant.inputs)), list(loop.plant.parameters)
    new = [n for n in wanted if disturbance_input(n) not in inputs]
    check_names("parameter or input of the plant", new, [*inputs, *parameters], "disturbance")
    if not new:
        return loop
    u, p = (ca.SX.sym(n, plant.ode.size1_in(i)) for i, n in ((2, "u"), (3, "p")))
    t, x, d = ca.SX.sym("t"), ca.SX.sym("x", plant.ode.size1_in(1)), ca.SX.sym("d", len(new))
    us, ps = ca.SX(u), ca.SX(p)
    for k, n in enumerate(new):
        if n in inputs:
            us[inputs.index(n)] += d[k]
        else:
            ps[parameters.index(n)] += d[k]

    def wrap(function: ca.Function) -> ca.Function:
        arguments, given = [t, x, ca.vertcat(u, d), p], ["t", "x", "u", "p"]
        found = function.call([t, x, us, ps])  # a list, whatever the number of outputs
        return ca.Function(function.name(), arguments, found, given, list(function.name_out()))

    units = {q.name: q.unit for q in plant.inputs} | {n: q.unit for n, q in plant.parameters.items()}
    more = tuple(Quantity(disturbance_input(n), units[n]) for n in new)
    meter = None if plant.meter is None else wrap(plant.meter)
    disturbed = replace(plant, inputs=(*plant.inputs, *more), ode=wrap(plant.ode), meter=meter)
    return replace(loop, plant=disturbed, actuated=loop.command.name, measured=loop.feedback.name)


def select_signal(kind: str, name: str | None, known: Sequence[Quantity], usual: str | None) -> Quantity:
    """The signal of that name, by default the usual one or the only one."""
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


def find_rest(
    loop: ClosedLoop, parameters: ParameterSet, reference: float, start: Mapping[str, float]
) -> tuple[Array, float]:
    """The plant's state and the command, at rest or in steady motion; `start` is what else is known of the plant.

    Without a `rest_hook` they are the equilibrium of plant and controller, less states on which neither rates nor the
    measured output depend, such as the position of an axis under speed control: those may keep moving.
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


def set_sliding_direction(loop: ClosedLoop, parameters: ParameterSet, reference: float) -> ParameterSet:
    """Set the direction in which Karnopp's friction already slides where the reference is a speed [m/s, rad/s]."""
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


def _no_rest(loop: ClosedLoop, reference: float, error: ConvergenceError) -> ConvergenceError:
    where = f"{loop.feedback.name} {reference:g} {loop.feedback.unit}"
    message = f"the loop neither rests nor moves steadily at {where}: {error}, or give x_plant"
    return ConvergenceError(message, error.solution)


def _rest_system(loop: ClosedLoop, free: tuple[str, ...], parameters: ParameterSet) -> System:
    """The loop with the integral as its controller's only state, and without the plant's free ones."""
    plant, of = loop.plant, loop.controller
    acts = integrates(of.parallel_form(parameters).Ki)
    integral = [Quantity(INTEGRAL_STATE, loop.command.unit, loop.command.nominal)] if acts else []
    states = [*(q for q in plant.states if q.name not in free), *integral]

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Signals, Signals]:
        moving = {n: x.get(n, ca.SX(0)) for n in names(plant.states)}
        shown = loop.evaluate_plant(t, moving, u, p, ca.SX(0))[1]
        y, read = shown[of.pid_signal.name], ca.vertcat(*(shown[n] for n in of.readings))
        p = of.schedule_gains(p, y, {}, shown)
        r = of.inner_inputs(u, shown[of.feedback.name], p)["reference"]
        own = ca.vertcat(*(p[n] for n in of.parameters))
        gains = of.gains(own)
        command = gains[0] * (p["pid.b"] * r - y) + x.get(INTEGRAL_STATE, 0.0)
        command = of.compensation(command, r, y, read, own)[0]
        rates, outputs = loop.evaluate_plant(t, moving, u, p, command)
        rates |= {INTEGRAL_STATE: gains[1] * (r - y)}
        return {n: rates[n] for n in x}, outputs | {"control": command}

    return define(states, loop.inputs, loop.outputs, loop.parameters, rhs)


def bumpless_transfer(
    loop: ClosedLoop, x: ArrayLike, old: ParameterSet, new: ParameterSet, *, reference: float = 0.0
) -> Array:
    """The state from which a running loop goes on with new gains as if nothing had happened (bumpless transfer).

    The next command that the new gains give, before the clip, is the one that the old gains would have given. What
    differs is taken by the integral, ``I' = I + Kp (b r - y) + D - Kp' (b' r - y) - D'``, each with what it adds by
    itself (feedforward, dither's offset), and where c changes, the error that the derivative remembers moves with it.
    With compensators, which bend the command, the integral is sought that gives the same sum. A sampled controller
    keeps what is due to the distance from the set point, ``(Kp b - Kp' b') (r - y)``, in its transfer, which passes
    with Tt as after a start (`PID`).

    Parameters
    ----------
    loop : ClosedLoop
        Whose gains change while it runs.
    x : array_like, shape (n_states,)
        The running loop's state: a sampled one's between two samples, as at the end of a simulation.
    old, new : ParameterSet
        A missing parameter has the loop's default.
    reference : float
        At this instant [unit of the measured signal].

    Returns
    -------
    ndarray, shape (n_states,)
        The state with which the new gains begin.

    Raises
    ------
    InputError
        If new gains cannot run, or the state has another shape.

    Examples
    --------
    A loop at rest at 1 m/s stays there with twice the gain, which its state as it was would have pushed:

    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID(1e-3, limits=False))
    >>> old = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 9.0, "pid.b": 0.5})
    >>> new = old.with_values({"pid.Kp": 4.0})
    >>> before = loop.initial(old, reference=1.0)
    >>> after = bumpless_transfer(loop, before, old, new, reference=1.0)
    >>> command = names(loop.states).index("pid.command")
    >>> [float(loop.update(0, x, [1.0], loop.parameter_vector(new))[command]) for x in (before, after)]
    [0.0, 1.0]
    """
    loop.check(new)
    order, state = names(loop.states), np.array(x, dtype=float)
    require(state.shape == (len(order),), f"x has shape {state.shape}, the loop has {len(order)} states")
    remembered = order.index("pid.filter" if loop.pid.sample_time is None else "pid.previous_error")
    c, c_new = (loop.parameter_vector(p)[list(loop.parameters).index("pid.c")] for p in (old, new))
    wanted = _next_command(loop, state, old, reference)
    if loop.outer is None:  # the speed that a cascade's PID has been given is not known here
        state[remembered] += (c_new - c) * reference
    integral = order.index("pid.integral")
    if loop.pid.sample_time is not None and integrates(loop.parallel_form(new).Ki):
        # the part of the next command that is due to the distance from the set point, as the PID sees it
        t, x_now, u = ca.SX.sym("t"), symbols(loop.states), symbols(loop.inputs)
        p: Signals = {n: ca.SX.sym(n) for n in loop.parameters}
        terms = loop.controller.update(t, x_now, u, loop.evaluate_plant(t, x_now, u, p, ca.SX(0))[1], p).terms
        due = terms["Kp_parallel"] * p["pid.b"] * terms["error"]
        share = ca.Function("share", [t, *map(stack, (x_now, u, p))], [due])
        given = [reference] + [0.0] * (len(loop.inputs) - 1)
        before, after = (float(share(0.0, state, given, loop.parameter_vector(each))) for each in (old, new))
        state[order.index("pid.transfer")] += before - after
    state[integral] += wanted - _next_command(loop, state, new, reference)
    if loop.compensators:  # they bend the command: the integral is sought that gives the one wanted
        is_integral, x_new = np.array(order) == "pid.integral", state.copy()

        def commands(integrals: Array) -> Array:
            return np.array([_next_command(loop, np.where(is_integral, i, x_new), new, reference) for i in integrals])

        state[integral] = invert_increasing(commands, np.array([wanted]))[0]
    return state


def _next_command(loop: ClosedLoop, x: Array, parameters: ParameterSet, reference: float) -> float:
    """The next command that is computed, before the limits; at t = 0, where a dither's wave is zero."""
    free = replace(loop, pid=replace(loop.pid, limits=False))
    u, p = np.zeros(len(loop.inputs)), free.parameter_vector(parameters)
    u[0] = reference
    if loop.pid.sample_time is None:
        return float(free.system().ode(0.0, x, u, p)[1][-1])
    held = "pid.pending" if loop.pid.delay else "pid.command"
    return float(free.update(0.0, x, u, p)[names(loop.states).index(held)])
