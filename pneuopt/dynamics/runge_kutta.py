"""The classical Runge-Kutta step of fourth order (RK4), symbolically."""

from collections.abc import Callable

import casadi as ca

# |lambda h| of a search's steps, dimensionless. RK4 is unstable above 2.78, and rates change within a search; below, a
# stiff plant takes more steps than it needs.
RK4_MAX_H_LAMBDA = 2.0


def rk4(rate: Callable[[ca.SX, ca.SX], ca.SX], t: ca.SX, h: ca.SX, x: ca.SX) -> ca.SX:
    """One step of ``dx/dt = rate(t, x)``; stable for h < 2.78/|lambda|.

    Parameters
    ----------
    t, h : SX
        Instant and step [s].
    x : SX
        A vector, or a matrix of which each column is a state or a sensitivity.

    Returns
    -------
    SX
        x at t + h.
    """
    k1 = rate(t, x)
    k2 = rate(t + h / 2, x + h / 2 * k1)
    k3 = rate(t + h / 2, x + h / 2 * k2)
    k4 = rate(t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
