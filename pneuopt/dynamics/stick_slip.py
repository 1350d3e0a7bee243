"""`StickSlipIntegration`: a plant under Karnopp's friction, integrated from event to event; `simulate` chooses it.

While the moving mass slides, its friction keeps one sign, and the model is smooth: the standstill is a root of the
speed on the integrator's own interpolant. While it sticks, the speed is exactly 0, and the rest of the plant runs on.
It stays stuck while the acceleration that it would have if it slid is <= 0 forwards and >= 0 backwards; that test
needs neither the masses nor the forces of the plant. An end stop is a force of the plant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Any

import casadi as ca
import numpy as np
from scipy import integrate, optimize

from pneuopt.dynamics.compiled.functions import compile_function, compile_rate
from pneuopt.dynamics.smooth import Recorder, WorkArrays
from pneuopt.dynamics.system import FRICTION_DIRECTION, Ramp, System, names
from pneuopt.dynamics.tolerances import MAX_EVENTS, MAX_INTERNAL_STEPS, ROOT_PROBES_PER_STEP
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, ModelError, require
from pneuopt.quantities.trajectories import Trajectory


class EventKind(Enum):
    """What happens at an event."""

    BREAK_AWAY = "breaks away"
    STANDSTILL = "sticks"
    REVERSAL = "reverses"


@dataclass(frozen=True)
class Event:
    """A change between sticking and sliding."""

    t: float  # when [s]
    kind: EventKind
    direction: int  # of the motion afterwards: 1, -1, or 0 where the mass sticks


class StickSlipIntegration:
    """An `Integration` that locates break-aways and standstills; it also records a column "stuck", 0 or 1."""

    def __init__(self, system: System, p: Array, grid: Array, rtol: float, atol: float) -> None:
        message = "Karnopp's friction needs a plant with a state 'speed' and a parameter 'friction.direction'"
        require("speed" in names(system.states) and FRICTION_DIRECTION in system.parameters, message, ModelError)
        self._speed = names(system.states).index("speed")
        self._direction = list(system.parameters).index(FRICTION_DIRECTION)
        self._origin = grid[0]  # a log may begin at 1.7e9 s, where time itself is coarse
        self._end = 1.001 * (grid[-1] - grid[0]) + 1e-3  # LSODA derives its first step from it
        self._p = {d: self._with_direction(p, d) for d in (-1, 0, 1)}
        self._ode, self._state_rate = compile_function(system.ode), compile_rate(system.ode)
        self._accelerations = compile_function(_acceleration_function(system, self._speed, self._direction))
        atols = atol * np.array([q.nominal for q in system.states])
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atols}
        self._standstill_speed = 10 * atols[self._speed]  # rounding must not end a motion that has just begun
        self._mode: int | None = None
        self._solver: Any
        self._work = WorkArrays()
        self._event_time, self._last_indicator = inf, 0.0
        self._dense: Callable[[float], Array] | None = None
        self._record = Recorder(system, grid, ("stuck",))
        self._events, self._steps = list[Event](), 0  # steps since the last event, or instant asked for

    @property
    def events(self) -> tuple[Event, ...]:
        """The events up to now."""
        return tuple(self._events)

    def restart(self, t: float, x: Array, u: Array, slope: Array | None = None) -> None:
        """See `Integration`."""
        self._inputs = Ramp(t - self._origin, u, slope)
        if abs(x[self._speed]) > self._standstill_speed:
            self._begin_mode(t - self._origin, x, int(np.sign(x[self._speed])))
        else:
            x = self._with_zero_speed(x)
            self._begin_mode(t - self._origin, x, self._breakaway_direction(t - self._origin, x))

    def advance(self, t: float) -> Array:
        """See `Integration`."""
        until, self._steps = t - self._origin, 0
        while self._event_time <= until or self._solver.t < until:
            if self._event_time > until:
                self._step()
                continue
            at, x = self._event_time, self._state_at(self._event_time)
            if self._mode:
                x = self._with_zero_speed(x)
                self._begin_mode(at, x, self._breakaway_direction(at, x))
            else:
                forward, backward = self._breakaway_accelerations(at, x)
                self._begin_mode(at, x, 1 if forward > -backward else -1)
        self._now, self._x = until, self._state_at(until)
        return self._x

    def outputs(self) -> Array:
        """See `Integration`."""
        t, x, p = self._now, self._x, self._p[self._mode or 0]
        if self._mode == 0:  # friction balances the rest at a direction between -1 and 1
            forward, backward = self._breakaway_accelerations(t, x)

            def acceleration(direction: float) -> float:
                directed = self._with_direction(p, direction)
                return float(self._state_rate(self._origin + t, x, self._inputs.at(t), directed)[self._speed])

            balances = forward < 0 < backward
            direction = optimize.brentq(acceleration, -1.0, 1.0) if balances else np.sign(forward + backward)
            return self._ode(self._origin + t, x, self._inputs.at(t), self._with_direction(p, float(direction)))[1]
        return self._ode(self._origin + t, x, self._inputs.at(t), p)[1]

    def record(self) -> None:
        """See `Integration`."""
        self._record.add(self._x, self.outputs(), float(self._mode == 0))

    def trajectory(self) -> Trajectory:
        """See `Integration`."""
        return self._record.trajectory()

    def _begin_mode(self, t: float, x: Array, mode: int) -> None:
        """Restart the solver at t in this mode: 0 sticks, 1 and -1 slide."""
        before = self._mode if self._mode is not None else mode * int(x[self._speed] != 0)
        if mode != before:
            self._steps = 0
            kind = EventKind.STANDSTILL if mode == 0 else EventKind.BREAK_AWAY if before == 0 else EventKind.REVERSAL
            self._events.append(Event(float(self._origin + t), kind, mode))
            require(
                len(self._events) <= MAX_EVENTS,
                f"{MAX_EVENTS} changes between sticking and sliding by t = {self._origin + t:.9g} s: the loop "
                "chatters; simulate a shorter time, or mend the gains",
                ConvergenceError,
            )
        self._mode, self._event_time, self._dense = mode, inf, None
        self._now, self._x = t, x
        self._solver = integrate.LSODA(self._rate, t, x, self._end, **self._options)
        self._work.give_to(self._solver)
        self._last_indicator = self._mode_indicator(t, x)

    def _rate(self, t: float, x: Array) -> Array:
        """Rate of the state; while stuck, the speed's entry is its rate without friction, for the step size to heed."""
        at_rest = x if self._mode else self._with_zero_speed(x)
        return self._state_rate(self._origin + t, at_rest, self._inputs.at(t), self._p[self._mode or 0])

    def _step(self) -> None:
        t, x = self._solver.t, np.array(self._solver.y)
        self._solver.step()
        self._dense = None
        self._steps += 1
        too_many = self._steps > MAX_INTERNAL_STEPS
        if too_many or self._solver.t <= t or not np.isfinite(self._solver.y).all():
            self._record.fail(self._origin + t, x if self._mode else self._with_zero_speed(x))
        # whether the mode certainly lasts through the step, by a cheap test
        begin, end = self._solver.t_old, self._solver.t
        before, self._last_indicator = self._last_indicator, self._mode_indicator(end, self._solver.y)
        if self._mode:
            lasts = self._mode * self._solver.y[self._speed] > 0 and not before < 0 < self._last_indicator
        else:
            values = (before, self._event_function((begin + end) / 2), self._last_indicator)
            lasts = 2 * max(values) < min(values)
        self._event_time = inf if lasts else _first_root(self._event_function, begin, end)

    def _mode_indicator(self, t: float, x: Array) -> float:
        """What `_step` compares at a step's ends: sliding, the gain of speed; stuck, `_event_function`."""
        return float(self._mode * self._rate(t, x)[self._speed]) if self._mode else self._event_function(t)

    def _event_function(self, t: float) -> float:
        """Positive where the mode has ended."""
        x = self._state_at(t)
        if self._mode:
            return float(-self._mode * x[self._speed] - self._standstill_speed)
        forward, backward = self._breakaway_accelerations(t, x)
        return max(forward, -backward)

    def _breakaway_direction(self, t: float, x: Array) -> int:
        """The direction in which a mass at rest breaks away; 0 if it sticks."""
        forward, backward = self._breakaway_accelerations(t, x)
        message = f"the static friction is negative at t = {self._origin + t:.9g} s; check its pressure coefficients"
        require(forward <= backward, message, ModelError)
        return 1 if forward > 0 else -1 if backward < 0 else 0

    def _breakaway_accelerations(self, t: float, x: Array) -> tuple[float, float]:
        """Accelerations that a mass at rest would have if it slid forwards, and backwards [m/s^2]."""
        forward, backward = self._accelerations(self._origin + t, x, self._inputs.at(t), self._p[0])[0]
        return float(forward), float(backward)

    def _state_at(self, t: float) -> Array:
        """The state at an instant of the last step, at its begin where rounding puts the instant before the first."""
        if t >= self._solver.t or self._solver.t_old is None:
            x = np.array(self._solver.y)
        else:
            self._dense = self._dense or self._solver.dense_output()
            x = self._dense(t)
        return x if self._mode else self._with_zero_speed(x)

    def _with_zero_speed(self, x: Array) -> Array:
        at_rest = np.array(x)
        at_rest[self._speed] = 0.0
        return at_rest

    def _with_direction(self, p: Array, direction: float) -> Array:
        directed = np.array(p)
        directed[self._direction] = direction
        return directed


def _acceleration_function(system: System, speed: int, direction: int) -> ca.Function:
    """``(t, x, u, p) -> (a_forward, a_backward)``: the speed's rate with either sign of the friction."""
    t, x, u, p = (ca.SX.sym(k, system.ode.size1_in(i)) for i, k in enumerate("txup"))
    rates = []
    for sign in (1, -1):
        directed = ca.SX(p)
        directed[direction] = sign
        rates.append(system.ode(t, x, u, directed)[0][speed])
    return ca.Function("pushes", [t, x, u, p], [ca.vertcat(*rates)])


def _first_root(f: Callable[[float], float], begin: float, end: float) -> float:
    """Where f first turns positive on a step, by a few points or at a maximum between them; infinity if it does not."""
    t = np.linspace(begin, end, ROOT_PROBES_PER_STEP + 1)
    values = np.array([f(at) for at in t])
    if not np.any(values[1:] > 0):
        k = 1 + int(np.argmax(values[1:-1]))
        if not values[k] > max(values[0], values[-1]) + 1e-9 * np.ptp(values):
            return inf
        top = optimize.minimize_scalar(lambda at: -f(at), bounds=(t[k - 1], t[k + 1]), method="bounded").x
        t, values = np.array([t[k - 1], top]), np.array([values[k - 1], f(top)])
        if not values[1] > 0:
            return inf
    k = 1 + int(np.argmax(values[1:] > 0))
    if values[k - 1] >= 0:
        return float(t[k - 1])
    return float(optimize.brentq(f, t[k - 1], t[k], xtol=1e-15))
