"""Integration steps, symbolically: the classical Runge-Kutta step (`rk4`), and one that is implicit in one state.

Regularised friction on a light mass makes the rate of the speed depend on the speed a thousand times as steeply as on
anything else: an explicit step then has to be a thousandth of what the motion asks for. A scalar equation a stage takes
that away (`partitioned_step`). The method is the L-stable ARS(2,3,2) of second order, source: Ascher, Ruuth and
Spiteri, Applied Numerical Mathematics 25 (1997) 151-167, section 2.5, whose implicit half integrates the one state, and
whose explicit half the others.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import casadi as ca

from pneuopt.dynamics.tolerances import MIN_SLOPE, SOLVER_ITERATIONS


def rk4(rate: Callable[[ca.SX, ca.SX], ca.SX], t: ca.SX, h: ca.SX, x: ca.SX) -> ca.SX:
    """One step of ``dx/dt = rate(t, x)``, a column each state or sensitivity; stable for h < 2.78/|lambda|."""
    k1 = rate(t, x)
    k2 = rate(t + h / 2, x + h / 2 * k1)
    k3 = rate(t + h / 2, x + h / 2 * k2)
    k4 = rate(t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)


DIAGONAL = 1 - 1 / math.sqrt(2)
"""The implicit half's diagonal [1], which makes it L-stable."""
LAST_STAGE_START = -2 * math.sqrt(2) / 3
"""Weight [1] of the first stage in the explicit half's last one."""

Rate = Callable[[ca.SX, ca.SX], ca.SX]


class OwnRate(NamedTuple):
    """The rate of the implicit state as a function of that state alone, and what it does to all rates."""

    position: int  # of the implicit state among the states
    value: Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]]  # ``(t, x) -> (its rate, its slope over the state itself)``
    column: Callable[[ca.SX, ca.SX], ca.SX]  # ``(t, x) -> d(all rates)/d(this state)``


def partitioned_step(rate: Rate, own: OwnRate, t: ca.SX, h: ca.SX, z: ca.SX) -> ca.SX:
    """One step of ``dx/dt = f(t, x)`` and of its sensitivities: z holds the states, then a column each sensitivity.

    `rate` is ``(t, z) -> dz/dt``: the first column f, the others linear in the sensitivities.
    """
    first = rate(t, z)
    middle, middle_slope = _stage(rate, own, t, h, z + h * DIAGONAL * first, z[own.position, :])
    explicit = z + h * (LAST_STAGE_START * first + (1 - LAST_STAGE_START) * middle_slope)
    begin = z[own.position, :]
    # (V - v)/(h DIAGONAL) is the middle stage's rate, of which the last one holds 1 - DIAGONAL
    known = begin + (1 - DIAGONAL) / DIAGONAL * (middle[own.position, :] - begin)
    last, last_slope = _stage(rate, own, t, h, explicit, known, guess=middle[own.position, 0], share=1.0)
    after = z + h * ((1 - DIAGONAL) * middle_slope + DIAGONAL * last_slope)
    after[own.position, :] = last[own.position, :]
    return after


def _stage(
    rate: Rate,
    own: OwnRate,
    t: ca.SX,
    h: ca.SX,
    explicit: ca.SX,
    known: ca.SX,
    guess: ca.SX | None = None,
    share: float = DIAGONAL,
) -> tuple[ca.SX, ca.SX]:
    """A stage at `share` of the step: states and sensitivities, and their rates.

    `known` is what the implicit row is before its own rate, times h DIAGONAL, is added; `explicit` the other rows.
    """
    row, step, at = own.position, h * DIAGONAL, t + share * h
    x = ca.SX(explicit[:, 0])

    def residual(value: ca.SX) -> tuple[ca.SX, ca.SX]:
        there = ca.SX(x)
        there[row] = value
        found, slope = own.value(at, there)
        return value - known[0] - step * found, 1 - step * slope

    x[row] = solve_scalar(residual, known[0] if guess is None else guess)
    stage = ca.SX(explicit)
    stage[:, 0], stage[row, 1:] = x, 0
    found = rate(at, stage)
    if z_columns := explicit.size2() - 1:
        column, slope = own.column(at, x), own.value(at, x)[1]
        moved = (known[1:] + step * found[row, 1:]) / (1 - step * slope)
        stage[row, 1:] = moved
        found = found + ca.horzcat(ca.SX(x.numel(), 1), ca.mtimes(column, ca.reshape(moved, 1, z_columns)))
    return stage, found


def solve_scalar(residual: Callable[[ca.SX], tuple[ca.SX, ca.SX]], guess: ca.SX) -> ca.SX:
    """The root of an increasing function by Newton's method, halved where that leaves what encloses the root.

    Its slope is `MIN_SLOPE` at least, on average from the guess on. Zero is tried next where it may lie between:
    friction is steepest at rest, from where Newton's method takes no step too far.
    """
    value, slope = residual(guess)
    far = guess - value / MIN_SLOPE
    low, high = ca.fmin(guess, far), ca.fmax(guess, far)
    point = ca.if_else(ca.logic_and(low < 0, high > 0), ca.SX(0), guess - value / slope)
    point = ca.fmin(ca.fmax(point, low), high)
    for _ in range(SOLVER_ITERATIONS):
        value, slope = residual(point)
        low, high = ca.if_else(value < 0, point, low), ca.if_else(value < 0, high, point)
        newton = point - value / slope
        is_inside = ca.logic_and(newton >= low, newton <= high)
        point = ca.if_else(is_inside, newton, 0.5 * (low + high))
    return point
