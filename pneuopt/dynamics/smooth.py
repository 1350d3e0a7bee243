"""`SmoothIntegration`: a smooth plant integrated by LSODA; `LimitMonitor` watches its validity limits.

A sampled loop restarts LSODA at each sample, with the work arrays that it had (`WorkArrays`): SciPy 1.17 never frees
those that a run has seen, a megabyte for each second that is simulated at 1 kHz. `stick_slip` holds the integrator for
Karnopp's friction.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any, NoReturn, Protocol

import numpy as np
from scipy import integrate

from pneuopt.dynamics.compiled.functions import compile_function, compile_held_rate, compile_rate, compile_rows
from pneuopt.dynamics.hooks import Contact
from pneuopt.dynamics.system import Ramp, System, names
from pneuopt.dynamics.tolerances import LIMIT_CHECK_PERIOD, MAX_INTERNAL_STEPS, ROUNDING_STEP
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

ODEINT_SUCCESS = "Integration successful."  # what SciPy says of an integration that reached all instants


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
        warnings.simplefilter("ignore", integrate.ODEintWarning)
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

    def follow(self, run: Integration, instants: Array, recorded: int, *, stops: bool) -> Array:
        """Advance a run that was just restarted through instants, recorded at so many, to the state at the last.

        With `stops` the run ends before the first recorded one by which a limit was met.
        """
        t, places = self._with_checks(instants)
        x = run.advance_along(t) if isinstance(run, SmoothIntegration) else None
        if not isinstance(run, SmoothIntegration) or x is None:  # one instant after the other, to where it may fail
            here = np.empty(0)
            for k, instant in enumerate(instants.tolist()):
                here = self.advance(run, instant)
                if k < recorded and stops and self._contacts:
                    break
                if k < recorded:
                    run.record()
            return here
        kept = places[:recorded]
        if stops and ((crossed := self._crossings(x)[1].any(axis=1)).any() or self._contacts):
            kept = kept[kept < (0 if self._contacts else crossed.argmax())]
            places = places[: len(kept) + 1]
        seen = x[: places[-1] + 1]
        room, crossed = self._crossings(seen)
        for k in np.flatnonzero(crossed.any(axis=1)).tolist():
            if k:
                self._t, self._values, self._room = t[k - 1], x[k - 1, self._indices], room[k - 1]
            self.observe(t[k], x[k])
        self._t, self._values, self._room = t[places[-1]], seen[-1, self._indices], room[-1]
        run.record_along(t[kept], x[kept])
        return np.array(x[-1])

    def _with_checks(self, instants: Array) -> tuple[Array, Indices]:
        """The instants and those between them at which the limits are checked, and the places of the former."""
        if len(self._contacts) == len(self._limited):
            return instants, np.arange(len(instants))
        begins = np.concatenate([[self._t], instants[:-1]])
        more = np.maximum(np.ceil((instants - begins) / LIMIT_CHECK_PERIOD).astype(int) - 1, 0)
        places = np.cumsum(more + 1) - 1
        back = places.repeat(more + 1) - np.arange(places[-1] + 1)  # checks up to the next instant
        t = begins.repeat(more + 1) + (more.repeat(more + 1) + 1 - back) * LIMIT_CHECK_PERIOD
        t[places] = instants
        return t, places

    def _crossings(self, x: Array) -> tuple[Array, Mask]:
        """The room up to each limit at the next states, shape (n, n_limits), and which limits they cross."""
        room = self._sides * (self._limits - x[:, self._indices])
        return room, (np.vstack([self._room, room[:-1]]) > 0) & (room <= 0)

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
        self._system, self._grid, self._blocks = system, grid, list[Array]()
        self._columns = (*names(system.states), *names(system.outputs), *flags)

    def add(self, x: Array, y: Array, *flags: float) -> None:
        """Append a row."""
        self._blocks.append(np.concatenate([x, y, flags])[None])

    def add_rows(self, x: Array, y: Array) -> None:
        """Append rows, from states and outputs of shapes (n, n_states) and (n, n_outputs)."""
        self._blocks.append(np.hstack([x, y]))

    def trajectory(self) -> Trajectory:
        """The rows so far."""
        rows = np.concatenate([np.empty((0, len(self._columns))), *self._blocks])
        return Trajectory(self._grid[: len(rows)], dict(zip(self._columns, rows.T, strict=True)))

    def fail(self, t: float, x: Array) -> NoReturn:
        """Raise `ConvergenceError`: the integration stopped at t in state x."""
        state = ", ".join(f"{q.name} {v:.6g} {q.unit}" for q, v in zip(self._system.states, x, strict=True))
        raise ConvergenceError(
            f"the simulation stopped after t = {t:.9g} s, where {state}: the model is not defined there, escapes to "
            "infinity or is too stiff; check the parameters, or loosen rtol",
            self.trajectory() if self._blocks else None,
        )


class SmoothIntegration:
    """An integration of a smooth plant by SciPy's LSODA on the compiled right-hand side; restarts take microseconds."""

    def __init__(self, system: System, p: Array, grid: Array, rtol: float, atol: float) -> None:
        self._system, self._p = system, p
        self._ode, self._state_rate = compile_function(system.ode), compile_rate(system.ode)
        self._origin = grid[0]  # a log may begin at 1.7e9 s, where time itself is coarse
        self._inputs = Ramp(0.0, np.zeros(len(system.inputs)))
        self._record = Recorder(system, grid)
        atols = atol * np.array([q.nominal for q in system.states])
        self._tolerances: dict[str, Any] = {"rtol": rtol, "atol": atols}
        options: dict[str, Any] = {"name": "lsoda", "nsteps": MAX_INTERNAL_STEPS, **self._tolerances}
        self._integrator: Any = integrate.ode(self._rate).set_integrator(**options)
        self._begin: tuple[float, Array] | None = None  # of a restart from which nothing was advanced
        self._work = WorkArrays()

    @cached_property
    def _hold(self) -> Callable[[float, Array, Array], Callable[[float, Array], Array]]:
        return compile_held_rate(self._system.ode)

    @cached_property
    def _ode_rows(self) -> Callable[..., tuple[Array, ...]]:
        return compile_rows(self._system.ode)

    def _rate(self, t: float, x: Array) -> Array:
        return self._state_rate(self._origin + t, x, self._inputs.at(t), self._p)

    def restart(self, t: float, x: Array, u: Array, slope: Array | None = None) -> None:
        """See `Integration`."""
        self._inputs = Ramp(t - self._origin, u, slope)
        self._begin = t - self._origin, x

    def advance(self, t: float) -> Array:
        """See `Integration`."""
        self._start()
        before, start = self._integrator.t, np.array(self._integrator.y)
        if t - self._origin - before <= ROUNDING_STEP * np.spacing(abs(t)) or not self._system.states:
            return start
        x = np.array(self._integrator.integrate(t - self._origin))
        if not (self._integrator.successful() and np.all(np.isfinite(x))):
            self._record.fail(self._origin + before, start)
        return x

    def advance_along(self, t: Array) -> Array | None:
        """The states at instants after a restart, shape (n, n_states): what `advance` says, in one call of LSODA.

        The integration stays at the restart. None where it fails on the way, or two instants are one but for rounding.
        """
        assert self._begin is not None
        (begin, x), until = self._begin, t - self._origin
        is_same = np.diff(until, prepend=begin) <= ROUNDING_STEP * np.spacing(np.abs(t))
        if is_same[1:].any():
            return None
        later = until[int(is_same[0]) :]
        if not (len(later) and self._system.states):
            return np.tile(x, (len(t), 1))
        is_held = self._inputs.slope is None
        rows, told = integrate.odeint(
            self._hold(self._origin, self._inputs.u, self._p) if is_held else self._rate,
            x,
            np.append(begin, later),
            tfirst=True,
            full_output=True,
            mxstep=MAX_INTERNAL_STEPS,
            **self._tolerances,
        )
        good = told["message"] == ODEINT_SUCCESS and np.all(np.isfinite(rows))
        return np.asarray(rows[len(rows) - len(t) :]) if good else None

    def outputs(self) -> Array:
        """See `Integration`."""
        self._start()
        t = self._integrator.t
        return self._ode(self._origin + t, self._integrator.y, self._inputs.at(t), self._p)[1]

    def record(self) -> None:
        """See `Integration`."""
        y = self.outputs()
        self._record.add(np.array(self._integrator.y), y)

    def record_along(self, t: Array, x: Array) -> None:
        """Keep states of `advance_along`, shape (n, n_states), and the outputs there."""
        if len(t):
            u = self._inputs.at((t - self._origin)[:, None])
            self._record.add_rows(x, self._ode_rows(t[:, None], x, u, self._p)[1])

    def trajectory(self) -> Trajectory:
        """See `Integration`."""
        return self._record.trajectory()

    def _start(self) -> None:
        """Give LSODA the state of the last restart."""
        if self._begin is None:
            return
        begin, x = self._begin
        self._integrator.set_initial_value(x, begin)
        self._begin = None
        if self._system.states:  # without any SciPy takes another integrator, which is never run
            self._work.give_to(self._integrator)


class WorkArrays:
    """The work arrays of an integration, one pair for all its restarts."""

    def __init__(self) -> None:
        self._kept = list[Array]()

    def give_to(self, solver: Any) -> None:
        """Let SciPy's LSODA, just restarted, work in these; one without these private names keeps its own."""
        integrator: Any = getattr(getattr(solver, "_lsoda_solver", solver), "_integrator", None)
        fresh = [getattr(integrator, name, None) for name in ("rwork", "iwork")]
        handed = getattr(integrator, "call_args", [])[4:6]
        if len(handed) != len(fresh) or any(a is None or a is not b for a, b in zip(fresh, handed, strict=True)):
            return
        self._kept = self._kept or handed
        for own, new in zip(self._kept, fresh, strict=True):
            own[:] = new
        integrator.call_args[4:6] = integrator.rwork, integrator.iwork = self._kept
