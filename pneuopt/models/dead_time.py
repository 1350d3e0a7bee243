"""`delay_line`, `pade_delay`: a plant's dead time as states, a Padé approximant of order 1 to 5.

The states form a lossless ladder and keep the input's unit and size at every dead time, so that the dead time is an
ordinary, differentiable parameter. Its fastest pole is at 2, 3.5, 5.1, 6.8, 8.5 over the dead time (orders 1 to 5), and
RK4 steps of h are stable for dead times above 0.72, 1.22, 1.87, 2.57, 3.26 h, the lower limit. At zero the approximant
is singular; order 0 leaves it out.
"""

import casadi as ca
import numpy as np
from scipy import signal

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Quantity

MAX_PADE_ORDER = 5  # the greatest order whose stability limit is known (see above)


def delay_line(source: Quantity, order: int) -> tuple[Quantity, ...]:
    """The states of an input's dead time; none of order 0."""
    valid = isinstance(order, int) and 0 <= order <= MAX_PADE_ORDER
    require(valid, f"pade_order must be 0 to {MAX_PADE_ORDER}, got {order}", ModelError)
    return tuple(Quantity(f"{source.name}_delay_{k}", source.unit, 2 * source.nominal) for k in range(1, order + 1))


def pade_delay(u: ca.SX, x: list[ca.SX], dead_time: ca.SX) -> tuple[ca.SX, list[ca.SX]]:
    """Padé approximant [n/n] of a delay as an LC ladder, by Lambert's continued fraction of tanh(s/2).

    ``exp(-s) = (1 - tanh(s/2)) / (1 + tanh(s/2))`` is, but for its sign, the reflection of a wave u from inductors and
    capacitors of 1 / (2 (2k - 1)) in turn; with v the voltage at the port, the delayed wave is u - v.
    """
    if not x:
        return u, []
    along, across = sum(x[0::2], ca.SX(0)), sum(x[1::2], ca.SX(0))
    voltage, current = (across, 2 * u - across) if len(x) % 2 == 0 else (2 * u - along, along)
    rates = []
    for k in range(1, len(x) + 1):
        passed = sum(x[k % 2 : k - 1 : 2], ca.SX(0))
        rates.append(2 * (2 * k - 1) / dead_time * ((current if k % 2 == 0 else voltage) - passed))
    return u - voltage, rates


def delay_states(u: Array, step: float, order: int, dead_time: float) -> Array:
    """The states along an input that is held over each step, from rest at its first value.

    Parameters
    ----------
    u : ndarray, shape (n,)
    step : float
        [s]
    order : int
        At least 1.
    dead_time : float
        [s]

    Returns
    -------
    ndarray, shape (n, order)
        In the input's unit.
    """
    x, source = ca.SX.sym("x", order), ca.SX.sym("u")
    _, rates = pade_delay(source, ca.vertsplit(x), ca.SX(dead_time))
    slopes = [np.array(ca.DM(ca.jacobian(ca.vertcat(*rates), symbol))) for symbol in (x, source)]
    A, B, *_ = signal.cont2discrete((slopes[0], slopes[1], np.eye(order), np.zeros((order, 1))), step)
    rest = np.linalg.solve(np.eye(order) - A, B[:, 0]) * u[0]
    states = np.empty((len(u), order))
    states[0] = rest
    for k in range(1, len(u)):
        states[k] = A @ states[k - 1] + B[:, 0] * u[k - 1]
    return states
