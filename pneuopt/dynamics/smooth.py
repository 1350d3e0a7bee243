"""`SmoothIntegration`: a smooth plant integrated by LSODA; `LimitMonitor` watches its validity limits.

`stick_slip` holds the integrator for Karnopp's friction.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, Protocol

import numpy as np
from scipy import integrate

from pneuopt.dynamics.compiled.functions import compile_function, compile_rate
from pneuopt.dynamics.hooks import Contact
from pneuopt.dynamics.ramps import Ramp
from pneuopt.dynamics.system import System, names
from pneuopt.dynamics.work_arrays import WorkArrays
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

MAX_INTERNAL_STEPS = 200_000  # LSODA steps between two instants; below, stiff plants stop early; above, it hangs long
# [s] between two checks of the validity limits. Above, a short contact with an end stop is missed; below, simulation is
# slower.
LIMIT_CHECK_PERIOD = 1e-3


class Integration(Protocol):
    """An integration under way: restarted where an input jumps, advanced from instant to instant, recorded at some."""

    def restart(self, t: float, x: Array, u: Array, slope: Array | None = None) -> None:
        """Begin anew at t from x under the input u, which is held, or rises from there on."""
        ...

    def advance(self, t: float) -> Array:
        """The state at t, not before the last instant."""
        ...

    def outputs(self) -> Array:
        """The outputs where the integration stands."""
        ...

    def record(self) -> None:
        """Keep the states and the outputs where the integration stands."""
        ...

    def trajectory(self) -> Trajectory:
        """What was recorded so far."""
        ...


@contextmanager
def without_solver_warnings() -> Iterator[None]:
    """Mute LSODA while an integration is under way: why it stops is told by an error of ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


class LimitMonitor:
    """Checks the plant's validity limits along a run, also between the instants that are recorded.

    The states of `plant` come first in the state vectors.
    """

    def __init__(self, plant: System, parameters: ParameterSet, t: float, x: Array) -> None:
        full = plant.parameters | parameters.select(n for n in parameters if n in plant.parameters)
        self._limited, self._contacts = plant.validity_limits, dict[int, Contact]()
        self._indices = [names(plant.states).index(limit.state) for limit in self._limited]
        self._states = [plant.states[k] for k in self._indices]
        self._limits = np.array([limit.limit(full) for limit in self._limited])
        self._sides = np.array([limit.side for limit in self._limited])
        self._t, self._values = t, x[self._indices]
        self._room = self._sides * (self._limits - self._values)

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The first contact with each limit, in order of time."""
        return tuple(sorted(self._contacts.values(), key=lambda contact: contact.t))

    @contextmanager
    def report_contacts(self) -> Iterator[None]:
        """Add the contacts so far to the message of a run that stops."""
        try:
            yield
        except ConvergenceError as error:
            if not self._contacts:
                raise
            met = "; ".join(map(str, self.contacts))
            raise ConvergenceError(f"{error}. Before that, {met}", error.solution) from None

    def advance(self, run: Integration, t: float) -> Array:
        """Advance the run to t, with a check every `LIMIT_CHECK_PERIOD` on the way."""
        if not self._limited:
            return run.advance(t)
        if len(self._contacts) < len(self._limited):
            begin = self._t
            for k in range(1, math.ceil((t - begin) / LIMIT_CHECK_PERIOD)):
                self.observe(begin + k * LIMIT_CHECK_PERIOD, run.advance(begin + k * LIMIT_CHECK_PERIOD))
        x = run.advance(t)
        self.observe(t, x)
        return x

    def observe(self, t: float, x: Array) -> None:
        """Note each limit that was crossed since the last call."""
        before, values, room_before = self._values, x[self._indices], self._room
        self._room = self._sides * (self._limits - values)
        for k in np.flatnonzero((room_before > 0) & (self._room <= 0)) if self._room.min(initial=1.0) <= 0 else ():
            part = (self._limits[k] - before[k]) / (values[k] - before[k])
            at, rate = self._t + part * (t - self._t), (values[k] - before[k]) / (t - self._t)
            found = Contact(float(at), float(self._limits[k]), float(rate), self._states[k], self._limited[k])
            self._contacts.setdefault(int(k), found)
        self._t, self._values = t, values


class Recorder:
    """Collects states, outputs and flags, a row for each instant of the grid."""

    def __init__(self, system: System, grid: Array, flags: Sequence[str] = ()) -> None:
        self._system, self._grid, self._rows = system, grid, list[Array]()
        self._columns = (*names(system.states), *names(system.outputs), *flags)

    def add(self, x: Array, y: Array, *flags: float) -> None:
        """Append a row."""
        self._rows.append(np.concatenate([x, y, flags]))

    def trajectory(self) -> Trajectory:
        """The rows so far."""
        n = len(self._rows)
        columns = np.reshape(self._rows, (n, len(self._columns))).T
        return Trajectory(self._grid[:n], dict(zip(self._columns, columns, strict=True)))

    def fail(self, t: float, x: Array) -> NoReturn:
        """Raise `ConvergenceError`: the integration stopped at t in state x."""
        state = ", ".join(f"{q.name} {v:.6g} {q.unit}" for q, v in zip(self._system.states, x, strict=True))
        raise ConvergenceError(
            f"the simulation stopped after t = {t:.9g} s, where {state}: the model is not defined there, escapes to "
            "infinity or is too stiff; check the parameters, or loosen rtol",
            self.trajectory() if self._rows else None,
        )


class SmoothIntegration:
    """An integration of a smooth plant by SciPy's LSODA on the compiled right-hand side; restarts take microseconds."""

    def __init__(self, system: System, p: Array, grid: Array, rtol: float, atol: float) -> None:
        self._system, self._p = system, p
        self._ode, self._state_rate = compile_function(system.ode), compile_rate(system.ode)
        self._origin = grid[0]  # a log may begin at 1.7e9 s, where time itself is coarse
        self._inputs = Ramp(0.0, np.zeros(len(system.inputs)))
        self._record = Recorder(system, grid)
        scale = np.array([q.nominal for q in system.states])
        options: dict[str, Any] = {"name": "lsoda", "rtol": rtol, "atol": atol * scale, "nsteps": MAX_INTERNAL_STEPS}
        self._integrator: Any = integrate.ode(self._rate).set_integrator(**options)
        self._work = WorkArrays()

    def _rate(self, t: float, x: Array) -> Array:
        return self._state_rate(self._origin + t, x, self._inputs.at(t), self._p)

    def restart(self, t: float, x: Array, u: Array, slope: Array | None = None) -> None:
        """See `Integration`."""
        self._inputs = Ramp(t - self._origin, u, slope)
        self._integrator.set_initial_value(x, t - self._origin)
        if self._system.states:  # without any SciPy takes another integrator, which is never run
            self._work.give_to(self._integrator._integrator)

    def advance(self, t: float) -> Array:
        """See `Integration`."""
        before, start = self._integrator.t, np.array(self._integrator.y)
        if t - self._origin - before <= 8 * np.spacing(abs(t)) or not self._system.states:
            return start  # LSODA refuses a step of rounding's size
        x = np.array(self._integrator.integrate(t - self._origin))
        if not (self._integrator.successful() and np.all(np.isfinite(x))):
            self._record.fail(self._origin + before, start)
        return x

    def outputs(self) -> Array:
        """See `Integration`."""
        t = self._integrator.t
        return self._ode(self._origin + t, self._integrator.y, self._inputs.at(t), self._p)[1]

    def record(self) -> None:
        """See `Integration`."""
        self._record.add(np.array(self._integrator.y), self.outputs())

    def trajectory(self) -> Trajectory:
        """See `Integration`."""
        return self._record.trajectory()
