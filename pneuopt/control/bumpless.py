"""`bumpless_transfer`: new gains on a running loop, its integral set so that the command does not jump."""

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.controller import invert_increasing
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import integrates
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.system import names, stack, symbols
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet


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
        shares = [_distance_share(loop, state, p, reference) for p in (old, new)]
        state[order.index("pid.transfer")] += shares[0] - shares[1]
    state[integral] += wanted - _next_command(loop, state, new, reference)
    if loop.compensators:  # they bend the command: the integral is sought that gives the one wanted
        is_integral, x_new = np.array(order) == "pid.integral", state.copy()

        def commands(integrals: Array) -> Array:
            return np.array([_next_command(loop, np.where(is_integral, i, x_new), new, reference) for i in integrals])

        state[integral] = invert_increasing(commands, np.array([wanted]))[0]
    return state


def _distance_share(loop: ClosedLoop, x: Array, parameters: ParameterSet, reference: float) -> float:
    """The part of the next command that is due to the distance from the set point, Kp b (r - y) as the PID sees it."""
    t, state, u = ca.SX.sym("t"), symbols(loop.states), symbols(loop.inputs)
    p: Signals = {n: ca.SX.sym(n) for n in loop.parameters}
    y = loop.evaluate_plant(t, state, u, p, ca.SX(0))[1]
    terms = loop.controller.update(t, state, u, y, p).terms
    of = ca.Function("share", [t, *map(stack, (state, u, p))], [terms["Kp_parallel"] * p["pid.b"] * terms["error"]])
    given = np.zeros(len(loop.inputs))
    given[0] = reference
    return float(of(0.0, x, given, loop.parameter_vector(parameters)))


def _next_command(loop: ClosedLoop, x: Array, parameters: ParameterSet, reference: float) -> float:
    """The next command that is computed, before the limits; at t = 0, where a dither's wave is zero."""
    free = replace(loop, pid=replace(loop.pid, limits=False))
    u, p = np.zeros(len(loop.inputs)), free.parameter_vector(parameters)
    u[0] = reference
    if loop.pid.sample_time is None:
        return float(free.system().ode(0.0, x, u, p)[1][-1])
    held = "pid.pending" if loop.pid.delay else "pid.command"
    return float(free.update(0.0, x, u, p)[names(loop.states).index(held)])
