"""Rest and steady motion of a `PneumaticDrive`: spool position and pressures at which only the position changes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from pneuopt.models.pneumatic.chamber import MIN_CHAMBER_PRESSURE
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet

BALANCE_RATES = ("pressure_a", "pressure_b", "speed")
MAX_COMPRESSION_RATIO = 20.0  # largest chamber pressure over supply pressure [1] that is searched in steady motion


@dataclass(frozen=True, eq=False)
class MotionBalance:
    """Rates of a drive at a position [m] and speed [m/s] as functions of spool position and pressures.

    Attributes
    ----------
    function : casadi.Function
        ``(position, speed, spool, pressure_a, pressure_b, p) -> (BALANCE_RATES; states)``.
    """

    function: ca.Function
    p: Array
    position: float
    speed: float

    def rates(self, spool: float, a: float, b: float) -> tuple[float, float, float]:
        """Rates of both pressures [Pa/s] and of the speed [m/s^2]."""
        rate_a, rate_b, acceleration = self._evaluate(spool, a, b)[0].tolist()
        return rate_a, rate_b, acceleration

    def states(self, spool: float, a: float, b: float) -> list[float]:
        """States of the drive."""
        found: list[float] = self._evaluate(spool, a, b)[1].tolist()
        return found

    @cached_property
    def _evaluate(self) -> Callable[[float, float, float], list[Array]]:
        """The function on buffers of its own: a call costs 6 us instead of 70, and a rest takes hundreds of them."""
        buffer, run = self.function.buffer()
        inputs: list[Array] = [np.array([v]) for v in (self.position, self.speed, 0.0, 0.0, 0.0)]
        inputs.append(np.array(self.p, dtype=float))
        results: list[Array] = [np.zeros(self.function.size1_out(i)) for i in range(2)]
        setters: tuple[tuple[Any, list[Array]], ...] = ((buffer.set_arg, inputs), (buffer.set_res, results))
        for setter, arrays in setters:
            for i, array in enumerate(arrays):
                setter(i, array.data)

        def evaluate(spool: float, a: float, b: float) -> list[Array]:
            inputs[2][0], inputs[3][0], inputs[4][0] = spool, a, b
            run()
            return results

        evaluate.keep_alive = buffer  # type: ignore[attr-defined]
        return evaluate


def solve_steady_motion(glide: MotionBalance, p: ParameterSet, pressure_b: float | None) -> tuple[list[float], float]:
    """States and valve voltage at which only the position changes.

    Parameters
    ----------
    p : ParameterSet
        All parameters of the drive.
    pressure_b : float, optional
        Pressure that a closed valve has trapped [Pa(a)]; chamber a balances it.

    Raises
    ------
    InputError
        If no spool position balances the load, or there is no such motion.
    """
    if glide.speed:
        _check_motion(p, glide.speed, pressure_b)
    if pressure_b is None:
        spool, a, b = _solve_balance(glide, p)
    else:
        spool, a, b = 0.0, _balance_pressure_a(glide, p, pressure_b), pressure_b
    return glide.states(spool, a, b), p.value("valve.centre") + spool * p.value("valve.span")


def _check_motion(p: ParameterSet, speed: float, pressure_b: float | None) -> None:
    verdict = f"no steady motion at speed = {speed:g} m/s: "
    require(pressure_b is None, verdict + "trapped air (pressure_b) holds a drive still; give only one of the two")
    spring = p.value("load.stiffness") if "load.stiffness" in p else 0.0
    require(spring == 0, verdict + f"load.stiffness = {spring:g} N/m pulls more the farther it goes; start at rest")


def _solve_balance(glide: MotionBalance, p: ParameterSet) -> tuple[float, float, float]:
    """Spool position and pressures at which nothing changes, by nested root searches on functions with one zero each.

    In motion a chamber may exceed the supply pressure: the piston compresses the air that the spool throttles.
    """
    low, high, rates = p.value("ambient.pressure"), p.value("supply.pressure"), glide.rates
    if glide.speed:
        low, high = MIN_CHAMBER_PRESSURE, MAX_COMPRESSION_RATIO * high

    def pressures(spool: float) -> tuple[float, float]:
        def pressure_b_at(a: float) -> float:
            return _zero_crossing_or_end(lambda pressure_b_at: rates(spool, a, pressure_b_at)[1], low, high)

        if p.value("cylinder.leak") == 0:
            return _zero_crossing_or_end(lambda a: rates(spool, a, low)[0], low, high), pressure_b_at(low)
        a = _zero_crossing_or_end(lambda a: rates(spool, a, pressure_b_at(a))[0], low, high)
        return a, pressure_b_at(a)

    def acceleration_at(spool: float) -> float:
        return rates(spool, *pressures(spool))[2]

    mass = p.value("load.mass")
    ends = [acceleration_at(end) * mass for end in (-1.0, 1.0)]
    what = f"no steady motion at speed = {glide.speed:g} m/s" if glide.speed else "no equilibrium exists"
    require(
        ends[0] <= 0 <= ends[1],
        f"{what}: beyond {'friction and ' if glide.speed else ''}load the cylinder pushes with {ends[0]:.4g} to "
        f"{ends[1]:.4g} N at supply.pressure = {p.value('supply.pressure'):g} Pa(a), never with 0; "
        f"lower the {'speed or the ' if glide.speed else ''}load, raise the supply or the bore",
    )
    spool = 0.0 if abs(acceleration_at(0.0)) * mass < 1e-9 else _brent_root(acceleration_at, -1.0, 1.0)
    a, pressure_b_at = pressures(spool)
    inside = not glide.speed or (low < min(a, pressure_b_at) and max(a, pressure_b_at) < high)
    require(
        inside,
        f"{what}: a chamber would need {a if low < pressure_b_at < high else pressure_b_at:g} Pa(a); lower the speed",
    )
    return spool, a, pressure_b_at


def _balance_pressure_a(glide: MotionBalance, p: ParameterSet, b: float) -> float:
    """Pressure in chamber a that balances pressure b; the force is linear in it."""
    require(
        b > MIN_CHAMBER_PRESSURE,
        f"pressure_b = {b:g} Pa is no absolute pressure of a chamber; give more than {MIN_CHAMBER_PRESSURE:g} Pa",
    )
    low, high = p.value("ambient.pressure"), p.value("supply.pressure")
    at_low, at_high = (glide.rates(0.0, a, b)[2] for a in (low, high))
    a = low - at_low * (high - low) / (at_high - at_low)
    require(
        a > MIN_CHAMBER_PRESSURE,
        f"no equilibrium exists: beside pressure_b = {b:g} Pa chamber a would need {a:g} Pa; give more",
    )
    return a


def _zero_crossing_or_end(rate: Callable[[float], float], low: float, high: float) -> float:
    """Pressure at which its rate falls through zero; an end of the range where it does not."""
    if rate(high) >= 0:
        return high
    return low if rate(low) <= 0 else _brent_root(rate, low, high)


def _brent_root(function: Callable[[float], float], low: float, high: float) -> float:
    return float(brentq(function, low, high, xtol=1e-14 * (high - low), rtol=1e-15))
