"""A dead time: states that approximate it for simulation, by Padé, and the response of the delay itself for margins.

The states of a dead time form a lossless ladder and keep the input's unit and size at every dead time, so that the
dead time is an ordinary, differentiable parameter. Its fastest pole is at 2, 3.5, 5.1, 6.8, 8.5 over the dead time
(orders 1 to 5), and RK4 steps of h are stable for dead times above 0.72, 1.22, 1.87, 2.57, 3.26 h, the lower limit.
At zero the approximant is singular; order 0 leaves it out.

Its phase is the delay's to 1e-3 rad up to .23, .95, 2, 3.2 and 4.5 rad of orders 1 to 5, and up to 15 rad of order 12,
with which certificates are simulated. Its gain is one at every frequency, as the delay's, so that the quotient of the
two (`delay_over_pade`) turns a response by what the approximant lacks in phase.
"""

from functools import lru_cache
from math import factorial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.dynamics.tolerances import MAX_PADE_ORDER
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Quantity


def check_pade_order(order: int) -> None:
    """Refuse an order with which no search can run."""
    valid = isinstance(order, int) and 0 <= order <= MAX_PADE_ORDER
    require(valid, f"pade_order must be 0 to {MAX_PADE_ORDER}, got {order}", ModelError)


def delay_line(source: Quantity, order: int) -> tuple[Quantity, ...]:
    """The states of an input's dead time; none of order 0."""
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


@lru_cache(maxsize=8)
def pade_matrices(order: int) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of `pade_delay` at a dead time of 1 s; those of another are A and B over it."""
    x, u = ca.SX.sym("x", order), ca.SX.sym("u")
    late, rates = pade_delay(u, ca.vertsplit(x) if order else [], ca.SX(1))
    parts = [ca.jacobian(f, z) for f in (ca.vertcat(*rates), late) for z in (x, u)]
    A, B, C, D = (np.array(ca.DM(part)).reshape(part.shape) for part in parts)
    return A, B, C, D


def delay_over_pade(
    omega: Array, dead_time: ArrayLike, order: int, sample_time: float | None = None
) -> NDArray[np.complex128]:
    """``e^(-jw dead_time)`` over its Padé approximant of an order; dead times [s] and frequencies broadcast.

    Of a system that is sampled, in the form of ``z = (1 + s h/2)/(1 - s h/2)``, the approximant is one of s, and omega
    is that of s; the delay's frequency is then ``2/h atan(omega h/2)``.

    Examples
    --------
    >>> turned = delay_over_pade(np.array([1.0, 5.0]), 1.0, 2)
    >>> np.round(np.degrees(np.angle(turned)), 2).tolist(), np.round(np.abs(turned), 9).tolist()
    ([-0.07, -59.62], [1.0, 1.0])
    """
    w = omega if sample_time is None else 2 / sample_time * np.arctan(omega * sample_time / 2)
    s, late = 1j * omega * np.asarray(dead_time), np.exp(-1j * w * np.asarray(dead_time))
    n = order
    below = [
        factorial(2 * n - k) * factorial(n) / factorial(2 * n) / factorial(k) / factorial(n - k) for k in range(n + 1)
    ]
    bottom = np.polyval(below[::-1], s)
    return np.asarray(late * bottom / bottom.conj())
