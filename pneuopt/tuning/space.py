"""`Space`: the box in which the candidates of a tuning lie, their rounding, and the RK4 steps that they need."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.response import SAMPLES_A_DITHER_PERIOD, command_range, highest_dither_frequency
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet

# RK4 steps between two samples, at most. A lower limit refuses stiff loops that could be run; with a higher one a
# search whose bounds let a filter get too fast takes hours instead of naming them.
MAX_LOOP_SUBSTEPS = 100
# Distance from a bound, a fraction of the range, within which a gain is rounded to the bound. A larger one moves gains
# that matter; below a solver's tolerance an unused derivative time is printed as 1e-9 s.
BOUND_DISTANCE = 1e-6
# Rounded points around a design that are simulated, at most: 5^4, all that differ by two last places or less in four
# gains. Fewer miss roundings that keep the limits; each more costs a simulation.
MAX_ROUNDING_POINTS = 625


@dataclass(frozen=True, eq=False)
class Space:
    """The free parameters of a tuning, as a box.

    Parameters
    ----------
    parameters : ParameterSet
        Every parameter of the loop; the free ones span the box.
    names : tuple of str
        Those of the free ones that have an effect.
    """

    parameters: ParameterSet
    names: tuple[str, ...]

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper bounds, shape (n, 2)."""
        return np.array([[self.parameters[n].lower, self.parameters[n].upper] for n in self.names]).reshape(-1, 2)

    @cached_property
    def start(self) -> Array:
        """The given values, shape (n,)."""
        return np.array([self.parameters.value(n) for n in self.names])

    def parameters_at(self, point: Array) -> ParameterSet:
        """The loop's parameters with the free ones at `point`."""
        return self.parameters.with_values(dict(zip(self.names, np.clip(point, *self.bounds.T).tolist(), strict=True)))

    def from_unit(self, unit: Array) -> Array:
        """Map numbers between 0 and 1 to points, shape (..., n): along the range, or its logarithm where flagged."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        tiny = np.where(log, low, 1.0)
        drawn: Array = np.where(log, tiny * (np.where(log, up, 1.0) / tiny) ** unit, low + (up - low) * unit)
        return np.clip(drawn, low, up)

    def to_unit(self, point: Array) -> Array:
        """Map points to numbers between 0 and 1: the inverse of `from_unit`."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        safe = np.where(log, [low, up, point], 1.0)
        share: Array = np.where(
            log, np.log(safe[2] / safe[0]) / np.log(safe[1] / safe[0] + ~log), (point - low) / (up - low)
        )
        return share

    def from_unit_slope(self, points: Array) -> Array:
        """The derivative of `from_unit` at points, shape (..., n)."""
        low, up = self.bounds.T
        log = np.array([self.parameters[n].log for n in self.names], dtype=bool)
        ratio = np.where(log, up, 1.0) / np.where(log, low, 1.0)
        return np.asarray(np.where(log, points * np.log(ratio), up - low))

    def corners(self) -> Array:
        """Every corner of the box and the start, shape (2**n + 1, n)."""
        return np.array([*itertools.product(*self.bounds), self.start])

    def vectors(self, points: Array) -> Array:
        """Every parameter's value at each point, shape (m, n_parameters)."""
        rows = np.tile([p.value for p in self.parameters.values()], (len(points), 1))
        rows[:, [list(self.parameters).index(n) for n in self.names]] = np.clip(points, *self.bounds.T)
        return rows

    def round_point(self, point: Array, digits: int) -> Array:
        """Round a point to so many significant digits, within the bounds, shape (n,); close to a bound it is the bound.

        Examples
        --------
        >>> from pneuopt.quantities.parameters import Parameter
        >>> gains = ParameterSet({"pid.Kp": Parameter(0.39661, "1", 0.0, 1.0, free=True)})
        >>> space = Space(gains, ("pid.Kp",))
        >>> space.round_point(space.start, 4).item(), space.neighbours(np.array([0.3966]), 4).ravel().tolist()
        (0.3966, [0.3965, 0.3967])
        """
        found = np.array(point)
        for k, (value, (low, up)) in enumerate(zip(point.tolist(), self.bounds.tolist(), strict=True)):
            at = next((b for b in (low, up) if abs(value - b) <= BOUND_DISTANCE * (up - low)), None)
            if at is not None and not self.parameters[self.names[k]].log:
                found[k] = at
                continue
            rounded = (_round_digits(value + n * _last_place(value, digits), digits) for n in (0, -1, 1))
            found[k] = next((v for v in rounded if low <= v <= up), value)
        return found

    def neighbours(self, rounded: Array, digits: int) -> Array:
        """The points that differ from a rounded one by a last place in one coordinate, shape (m, n) with m <= 2 n."""
        found = []
        for k, (value, (low, up)) in enumerate(zip(rounded.tolist(), self.bounds, strict=True)):
            sides = (_round_digits(value + n * _last_place(value, digits), digits) for n in (-1, 1)) if value else ()
            found += [np.where(np.arange(len(rounded)) == k, v, rounded) for v in sides if low <= v <= up]
        return np.reshape(found, (-1, len(rounded)))

    def neighbourhood(self, rounded: Array, digits: int) -> Array:
        """The points that differ from a rounded one by up to two last places in every coordinate, shape (m, n).

        Where they are more than `MAX_ROUNDING_POINTS`, that many are drawn at random.

        Examples
        --------
        >>> from pneuopt.quantities.parameters import Parameter
        >>> space = Space(ParameterSet({"pid.Kp": Parameter(0.4, "1", 0.0, 0.4001, free=True)}), ("pid.Kp",))
        >>> space.neighbourhood(space.start, 4).ravel().tolist()
        [0.3998, 0.3999, 0.4, 0.4001]
        """
        n, sides = len(rounded), np.arange(-2, 3)
        few = len(sides) ** n <= MAX_ROUNDING_POINTS
        drawn = np.random.default_rng(0).integers(-2, 3, (MAX_ROUNDING_POINTS, n))
        offsets = np.array(list(itertools.product(sides, repeat=n))) if few else np.unique(drawn, axis=0)
        places = np.array([_last_place(value, digits) for value in rounded.tolist()])
        points = [[_round_digits(v, digits) for v in row] for row in (rounded + offsets * places).tolist()]
        low, up = self.bounds.T
        return np.array([point for point in points if np.all((point >= low) & (point <= up))]).reshape(-1, n)


def _last_place(value: float, digits: int) -> float:
    """The value of a one in the last of so many significant digits; 0 for a value of 0."""
    return float(10.0 ** (np.floor(np.log10(abs(value))) - digits + 1)) if value else 0.0


def _round_digits(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def search_space(loop: ClosedLoop, parameters: ParameterSet) -> Space:
    """Check the free parameters and span a `Space` by their bounds, over every parameter of the loop.

    Raises
    ------
    InputError
        If nothing is free, something is free that is not the controller's (dither, feedforward and compensators
        included), or a bound is missing.
    """
    full = loop.complete(parameters).select(loop.parameters)
    free = tuple(n for n in parameters.free_names if n in loop.parameters)
    require(len(free) > 0, 'nothing is free; mark what may be tuned: parameters.freed("pid.K*", "dither.offset")')
    divisors = {"dither.frequency", *(f"pid.{n}" for n in loop.pid.positive_parameters)}
    for n in free:
        require(
            n.partition(".")[0] in loop.tunable_sections,
            f"{n} is free, but tune changes the controller and the dither only; use parameters.fixed({n!r})",
        )
        told = f"{n} is free, but it says what a machine does in a fault; use parameters.fixed({n!r})"
        require(n.removeprefix("pid.") not in loop.pid.fixed_parameters, told)
        p = full[n]
        require(
            bool(np.isfinite([p.lower, p.upper]).all()) and p.lower < p.upper,
            f"{n} is free within [{p.lower:g}, {p.upper:g}] {p.unit}: it needs two finite bounds, "
            f"parameters.with_bounds({{{n!r}: (lower, upper)}}), or fix it",
        )
        require(n not in divisors or p.lower > 0, f"{n}: its lower bound must be positive, got {p.lower:g} {p.unit}")
        if n == "dither.amplitude":
            _check_amplitude(loop, full)
        require(
            not p.log or p.lower > 0, f"{n}: a log parameter needs a positive lower bound, got {p.lower:g} {p.unit}"
        )
    return Space(full, free)


def whole_space(loop: ClosedLoop, parameters: ParameterSet) -> Space:
    """Every parameter of the loop, none of them to be changed."""
    return Space(loop.complete(parameters).select(loop.parameters), ())


def clip_level(loop: ClosedLoop, p: ParameterSet) -> float:
    """The largest size of a command that the controller's own limits let through [its unit]; inf without limits."""
    return max(abs(p.value("pid.lower")), abs(p.value("pid.upper"))) if loop.pid.limits else float("inf")


def _check_amplitude(loop: ClosedLoop, p: ParameterSet) -> None:
    """Refuse an amplitude's bound with which dither alone, around any offset, exceeds the command's range."""
    (low, high, whose), most = command_range(loop, p), p["dither.amplitude"].upper
    unit = p["dither.amplitude"].unit
    require(
        2 * most <= high - low,
        f"dither.amplitude may reach {most:g} {unit}, but {whose} ends at {low:g} and {high:g} {unit}, which cuts the "
        f"peaks of more than {(high - low) / 2:g} {unit}; lower its upper bound",
    )


def dither_resolution_rate(loop: ClosedLoop, parameters: ParameterSet) -> float:
    """The rate [1/s] at which RK4 steps resolve an analogue dither between two samples; 0 for any other dither."""
    between = loop.dither is not None and loop.dither.analogue and loop.pid.sample_time is not None
    return RK4_MAX_H_LAMBDA * SAMPLES_A_DITHER_PERIOD * highest_dither_frequency(loop, parameters) if between else 0.0


def fastest_eigenvalue(loop: ClosedLoop, p: Array, states: Sequence[Array]) -> Array:
    """The size of the loop's largest eigenvalue over some states [1/s], for each row of parameters, shape (m,)."""
    system = loop.system() if loop.pid.sample_time is None else loop.hold_system()
    x, q = ca.SX.sym("x", len(system.states)), ca.SX.sym("p", len(system.parameters))
    rates = system.ode(0, x, np.zeros(len(system.inputs)), q)[0]
    slope = ca.Function("slope", [x, q], [ca.densify(ca.jacobian(rates, x))])
    rows, n = len(states) * len(p), x.numel()
    found = slope.map(rows)(np.tile(np.array(states), (len(p), 1)).T, np.repeat(p, len(states), axis=0).T)
    A = found.full().reshape(n, rows, n).transpose(1, 0, 2)
    sizes = np.abs(np.linalg.eigvals(A)).max(axis=1, initial=0.0)
    return np.asarray(sizes.reshape(len(p), len(states)).max(axis=1))


def rk4_substeps(rate: float, h: float) -> int:
    """The number of RK4 steps in a sample of length h [s] with which a mode of this rate [1/s] is integrated stably.

    Raises
    ------
    InputError
        If that takes too many; the message names the remedy.
    """
    k = int(np.ceil(rate * h / RK4_MAX_H_LAMBDA))
    require(
        k <= MAX_LOOP_SUBSTEPS,
        f"within the bounds the loop has a mode as fast as {rate:.3g} 1/s, which takes {k} steps in {h:.3g} s, at most "
        f"{MAX_LOOP_SUBSTEPS}; narrow the gains' bounds (raise the lower one of pid.Tf), smooth the friction, "
        "or shorten h",
    )
    return max(1, k)
