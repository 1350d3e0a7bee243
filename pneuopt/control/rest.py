"""Where a loop rests, or moves steadily: the equilibrium of plant and controller, without dither and clip."""

from collections.abc import Mapping
from typing import Protocol

import casadi as ca
import numpy as np

from pneuopt.control.command import CommandParts, pid_reference
from pneuopt.control.gain_schedule import ScheduledParts, schedule_gains
from pneuopt.control.pid import integrates
from pneuopt.control.sensor import Signals
from pneuopt.control.wiring import JoinedSignals, evaluate_plant
from pneuopt.dynamics.system import FRICTION_DIRECTION, Symbols, System, define, names, parameter_vector
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity

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
