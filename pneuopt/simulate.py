"""`simulate`: tight integration of a plant or a loop, which shares nothing with the optimiser but the equations.

The ODE is integrated by LSODA to 1e-10, stiff or not; inputs are held, and the integration restarts only where one
changes or where a sampled controller acts. The controller's exact update runs at each sample.
"""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import integrate

from pneuopt.codegen import compiled
from pneuopt.control.loop import ClosedLoop
from pneuopt.errors import ConvergenceError, check_known, require
from pneuopt.parameters import ParameterSet
from pneuopt.system import System, names, vector
from pneuopt.trajectories import Trajectory

Array = NDArray[np.float64]
MOST_STEPS = 200_000
Update = Callable[..., tuple[Array, ...]]


def simulate(
    model: System | ClosedLoop,
    inputs: Trajectory,
    parameters: ParameterSet,
    *,
    initial: Mapping[str, float] | ArrayLike | None = None,
    t_out: ArrayLike | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Trajectory:
    """Integrate a model over its inputs.

    Parameters
    ----------
    model : System or ClosedLoop
        A loop with a sampled PID takes its samples at ``inputs.t[0]`` plus whole sample times.
    inputs : Trajectory
        A column an input of the model, held from each of its instants to the next; others are not read.
    parameters : ParameterSet
        A missing one keeps the model's default.
    initial : mapping of state to value, or array of shape (n_states,), optional
        Absent states start at zero; by default a plant starts at zero and a loop at rest (`ClosedLoop.initial`).
    t_out : array_like, shape (n,), optional
        Instants to report [s], within the inputs' time; by default those of the inputs.
    rtol, atol : float
        Tolerances of a step; atol is relative to each state's nominal value.

    Returns
    -------
    Trajectory
        States and outputs; at a sample, after the controller's update; at a change of input, with the new one.

    Raises
    ------
    InputError
        If an input is missing or NaN, an instant lies outside, or a state starts outside its physical range.
    ConvergenceError
        If the integration stops; the message gives the time and the state, `solution` is the trajectory so far.

    Examples
    --------
    >>> from pneuopt.models.linear import FirstOrder
    >>> plant = FirstOrder().system()
    >>> run = simulate(plant, Trajectory([0.0, 0.1], {"valve_voltage": [1.0, 1.0]}), plant.parameters)
    >>> round(run["speed"][-1].item(), 6)
    0.632121
    """
    system, update, sample_time = _pieces(model)
    u, grid = _held(system, inputs), _instants(t_out, inputs.t)
    x, p = _start(model, system, parameters, initial), vector(system.parameters, parameters)
    slack = _slack(inputs.t)
    breaks, is_sample = _breaks(inputs.t, u, sample_time, slack)
    rows = u[np.searchsorted(inputs.t, breaks + slack, side="right") - 1]
    run, done = _Run(system, p, grid, rtol, atol), 0
    for begin, end, row, acts in zip(breaks, [*breaks[1:], np.inf], rows, is_sample, strict=True):
        run.restart(begin, update(begin, x, row, p)[0] if acts and update is not None else x, row)
        until = int(np.searchsorted(grid, end - slack))
        for t in grid[done:until]:
            run.advance(t)
            run.record()
        if until == len(grid):
            break
        x, done = run.advance(end), until
    return run.trajectory()


class _Run:
    """SciPy's integrator on the compiled right-hand side (it restarts in microseconds), and what it has recorded."""

    def __init__(self, system: System, p: Array, grid: Array, rtol: float, atol: float) -> None:
        self._system, self._p, self._grid, self._ode = system, p, grid, compiled(system.ode)
        self._origin = grid[0]  # a log may begin at 1.7e9 s, where time itself is coarse
        self._u = np.zeros(len(system.inputs))
        self._states, self._outputs = list[Array](), list[Array]()
        scale = np.array([q.nominal for q in system.states])
        options: dict[str, Any] = {"name": "lsoda", "rtol": rtol, "atol": atol * scale, "nsteps": MOST_STEPS}
        self._integrator = integrate.ode(self._rate).set_integrator(**options)

    def _rate(self, t: float, x: Array) -> Array:
        return self._ode(self._origin + t, x, self._u, self._p)[0]

    def restart(self, t: float, x: Array, u: Array) -> None:
        """Begin anew at t from x under the input u."""
        self._u = u
        self._integrator.set_initial_value(x, t - self._origin)

    def advance(self, t: float) -> Array:
        """The state at t."""
        before, start = self._integrator.t, np.array(self._integrator.y)
        if t - self._origin <= before or not self._system.states:
            return start
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            x = np.array(self._integrator.integrate(t - self._origin))
        if not (self._integrator.successful() and np.all(np.isfinite(x))):
            self._fail(self._origin + before, start)
        return x

    def record(self) -> None:
        """Keep the state and the output where the integrator stands."""
        x = np.array(self._integrator.y)
        self._states.append(x)
        self._outputs.append(self._ode(self._origin + self._integrator.t, x, self._u, self._p)[1])

    def trajectory(self) -> Trajectory:
        """What was recorded so far."""
        n = len(self._states)
        states, outputs = np.reshape(self._states, (n, -1)).T, np.reshape(self._outputs, (n, -1)).T
        columns = dict(zip(names(self._system.states), states, strict=True))
        columns |= dict(zip(names(self._system.outputs), outputs, strict=True))
        return Trajectory(self._grid[:n], columns)

    def _fail(self, t: float, x: Array) -> None:
        state = ", ".join(f"{q.name} {v:.6g} {q.unit}" for q, v in zip(self._system.states, x, strict=True))
        raise ConvergenceError(
            f"the simulation stopped after t = {t:.9g} s, where {state}: the model is not defined there, escapes to "
            "infinity or is too stiff; check the parameters, or loosen rtol",
            self.trajectory() if self._states else None,
        )


def _pieces(model: System | ClosedLoop) -> tuple[System, Update | None, float | None]:
    """The ODE between two samples, the update at a sample, the sample time."""
    if isinstance(model, System):
        return model, None, None
    if model.pid.sample_time is None:
        return model.system(), None, None
    return model.held(), compiled(model.update), model.pid.sample_time


def _held(system: System, inputs: Trajectory) -> Array:
    u = inputs.matrix(names(system.inputs))
    for q, column in zip(system.inputs, u.T, strict=True):
        k = int(np.argmin(np.isfinite(column)))
        good = bool(np.isfinite(column[k]))
        require(good, f"input {q.name!r} is {column[k]:g} at t = {inputs.t[k]:g} s; a simulation needs every sample")
    return u


def _instants(t_out: ArrayLike | None, t: Array) -> Array:
    """The instants to report, within the inputs' time."""
    if t_out is None:
        return t
    grid, slack = np.array(t_out, dtype=float, ndmin=1), _slack(t)
    require(grid.size > 0 and bool(np.all(np.diff(grid) > 0)), "t_out must be instants that increase strictly")
    inside = t[0] - slack <= grid[0] and grid[-1] <= t[-1] + slack
    require(bool(inside), f"t_out runs from {grid[0]:g} to {grid[-1]:g} s, the inputs from {t[0]:g} to {t[-1]:g} s")
    return grid


def _slack(t: Array) -> float:
    """Instants closer than this are one [s]."""
    return float(max(1e-6 * np.min(np.diff(t), initial=1.0), 4 * np.spacing(np.abs(t).max())))


def _breaks(t: Array, u: Array, sample_time: float | None, slack: float) -> tuple[Array, NDArray[np.bool_]]:
    """Where the integration restarts (at the start, where an input changes, at each sample), and which are samples."""
    changes = t[np.append(True, np.any(u[1:] != u[:-1], axis=1))]
    if sample_time is None:
        return changes, np.zeros(len(changes), dtype=bool)
    count = (changes - t[0]) / sample_time
    between = changes[np.abs(count - np.round(count)) * sample_time > slack]
    samples = t[0] + sample_time * np.arange(int((t[-1] - t[0] + slack) / sample_time) + 1)
    order = np.argsort(np.concatenate([samples, between]))
    return np.concatenate([samples, between])[order], order < len(samples)


def _start(
    model: System | ClosedLoop,
    system: System,
    parameters: ParameterSet,
    initial: Mapping[str, float] | ArrayLike | None,
) -> Array:
    if initial is None:
        x = np.zeros(len(system.states)) if isinstance(model, System) else model.initial(parameters)
    elif isinstance(initial, Mapping):
        check_known("state", initial, names(system.states), "initial")
        x = np.array([initial.get(q.name, 0.0) for q in system.states], dtype=float)
    else:
        x = np.array(initial, dtype=float)
        require(
            x.shape == (len(system.states),), f"initial has shape {x.shape}, the model has {len(system.states)} states"
        )
    for q, value in zip(system.states, x, strict=True):
        require(
            q.lower <= value <= q.upper,
            f"{q.name} starts at {value:g} {q.unit}, outside [{q.lower:g}, {q.upper:g}]; give it in `initial`",
        )
    return x
