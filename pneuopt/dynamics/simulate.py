"""`simulate`: tight integration of a plant or a loop, which shares nothing with the optimiser but the equations.

The ODE is integrated by LSODA to 1e-10, stiff or not; inputs are held, or run linearly from sample to sample where
`intersample` says so. The integration restarts only where an input or a slope changes, or where a sampled controller
acts. The controller's exact update runs at each sample. A plant with Karnopp's friction sticks and slips between events
that are located (`stick_slip`).
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.dynamics.compiled.functions import compile_function
from pneuopt.dynamics.hooks import Contact
from pneuopt.dynamics.runnable import HasSystem, Runnable, as_runnable
from pneuopt.dynamics.smooth import Integration, LimitMonitor, SmoothIntegration, without_solver_warnings
from pneuopt.dynamics.stick_slip import Event, StickSlipIntegration
from pneuopt.dynamics.system import FRICTION_DIRECTION, System, names, parameter_vector, slopes
from pneuopt.dynamics.tolerances import MAX_STEPS, SECONDS_A_STEP
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ModelError, PhysicsWarning, check_names, require
from pneuopt.quantities.parameters import (
    Intersample,
    ParameterSet,
    Quantity,
    check_argument,
    check_number,
    check_parameters,
)
from pneuopt.quantities.trajectories import Trajectory

REST_COORDINATE = "position"  # the state that `initial` may give alone: the plant then rests there


@dataclass(frozen=True, eq=False)
class StickSlipResult:
    """What `simulate_stick_slip` returns.

    Attributes
    ----------
    trajectory : Trajectory
        States and outputs, and "stuck", 1 where the moving mass sticks.
    events : tuple of Event
        Break-aways, standstills and reversals, in order; none for how the run begins.
    """

    trajectory: Trajectory
    events: tuple[Event, ...]


def simulate(
    model: Runnable | HasSystem,
    inputs: Trajectory,
    parameters: ParameterSet,
    *,
    initial: Mapping[str, float] | ArrayLike | None = None,
    t_out: ArrayLike | None = None,
    intersample: Mapping[str, Intersample] | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-12,
    max_steps: float = MAX_STEPS,
) -> Trajectory:
    """Integrate a model over its inputs.

    Parameters
    ----------
    model : drive, System, ClosedLoop or another Runnable
        A loop with a sampled PID takes its samples at ``inputs.t[0]`` plus whole
        sample times.
    inputs : Trajectory
        A column an input of the model, held from each of its instants to the next, unless `intersample` says otherwise;
        others are not read.
    parameters : ParameterSet
        A missing one keeps the model's default.
    initial : mapping of state to value, or array of shape (n_states,), optional
        By default a plant that knows its rest starts there, another at zero, and a loop at rest (`ClosedLoop.initial`).
        States absent from a mapping are as at rest, a drive's at the position given, {"position": 0.05}; zero where the
        plant knows no rest.
    t_out : array_like, shape (n,), optional
        Instants to report [s], within the inputs' time; by default those of the inputs.
    intersample : mapping of str to Intersample, optional
        By input, whether it is held or runs linearly to the next instant, as a measured force; absent ones are held.
    rtol, atol : float
        Tolerances of a step; atol is relative to each state's nominal value.
    max_steps : float
        Samples of a loop with a sampled PID that are refused as too many.

    Returns
    -------
    Trajectory
        States and outputs; at a sample, after the controller's update; at a change of input, with the new one. With
        Karnopp's friction also "stuck", 0 or 1.

    Raises
    ------
    InputError
        If an input is missing or NaN, an instant lies outside, hardware is impossible, a state starts outside its
        physical range, or a loop would take more samples than `max_steps`.
    ConvergenceError
        If the integration stops; the message gives the time and the state, `solution` is the trajectory so far.

    Warns
    -----
    PhysicsWarning
        If the plant reaches a validity limit, such as an end stop: when, where, and what the response is from there.

    Examples
    --------
    >>> from pneuopt.models.linear import FirstOrder
    >>> plant = FirstOrder().system()
    >>> run = simulate(plant, Trajectory([0.0, 0.1], {"valve_voltage": [1.0, 1.0]}), plant.parameters)
    >>> round(run["speed"][-1].item(), 6)
    0.632121
    """
    _check_samples(as_runnable(model, "model"), inputs, max_steps)
    run, met = _integrate(model, inputs, parameters, initial, t_out, (rtol, atol), intersample=intersample)
    warn_contacts(met)
    return run.trajectory()


def simulate_stick_slip(
    model: Runnable | HasSystem,
    inputs: Trajectory,
    parameters: ParameterSet,
    *,
    initial: Mapping[str, float] | ArrayLike | None = None,
    t_out: ArrayLike | None = None,
    intersample: Mapping[str, Intersample] | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-12,
    max_steps: float = MAX_STEPS,
) -> StickSlipResult:
    """Integrate a model with Karnopp's friction, and report its events; parameters and errors as for `simulate`.

    Examples
    --------
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Coulomb
    >>> from pneuopt.models.friction import Karnopp
    >>> drive = ForceDrive(Karnopp(Coulomb())).system()
    >>> push = Trajectory([0.0, 0.1, 0.2, 0.9], {"force": [29.0, 65.0, 29.0, 29.0]})
    >>> run = simulate_stick_slip(drive, push, drive.parameters)
    >>> [(round(e.t, 4), e.kind.value) for e in run.events]
    [(0.1, 'breaks away'), (0.4364, 'sticks')]
    """
    _check_samples(as_runnable(model, "model"), inputs, max_steps)
    run, met = _integrate(model, inputs, parameters, initial, t_out, (rtol, atol), intersample=intersample)
    if not isinstance(run, StickSlipIntegration):
        raise ModelError("the model has no Karnopp friction, say ForceDrive(Karnopp(Stribeck())); take simulate")
    warn_contacts(met)
    return StickSlipResult(run.trajectory(), run.events)


def continue_simulation(
    model: Runnable | HasSystem,
    inputs: Trajectory,
    parameters: ParameterSet,
    initial: Array,
    *,
    t_out: ArrayLike | None = None,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> tuple[Trajectory, tuple[Contact, ...]]:
    """Continue a run from where `simulate` ended, its controller having acted; also returns a contact that ends it."""
    run, met = _integrate(model, inputs, parameters, initial, t_out, (rtol, atol), continues=True)
    return run.trajectory(), met


def contacts(trajectory: Trajectory, model: Runnable | HasSystem, parameters: ParameterSet) -> tuple[Contact, ...]:
    """The validity limits that a response reaches, such as an end stop, found between the trajectory's instants.

    Parameters
    ----------
    trajectory : Trajectory
        With the plant's states.
    model : drive, System, ClosedLoop or another Runnable

    Returns
    -------
    tuple of Contact
        The first of each kind, in order of time; a response that begins in a stop has not run into it.

    Examples
    --------
    >>> from pneuopt.models.pneumatic.drive import PneumaticDrive
    >>> drive = PneumaticDrive().system()
    >>> run = Trajectory([0.0, 0.1], {q.name: [q.nominal, q.nominal] for q in drive.states})
    >>> run = run.with_columns({"position": [0.18, 0.22]})
    >>> print(str(contacts(run, drive, drive.parameters)[0]).partition(";")[0])
    the piston reached the front end stop (position 199.9 mm) at t = 0.04975 s with 0.4 m/s
    """
    plant = as_runnable(model, "model").plant
    rows = trajectory.matrix(names(plant.states))
    watch = LimitMonitor(plant, parameters, trajectory.t[0], rows[0])
    for t, row in zip(trajectory.t, rows, strict=True):
        watch.observe(t, row)
    return watch.contacts


def warn_contacts(met: Sequence[Contact]) -> None:
    """Give a `PhysicsWarning` for each contact, in the name of the caller's caller."""
    for contact in met:
        warnings.warn(str(contact), PhysicsWarning, stacklevel=3)


def new_integration(system: System, p: Array, grid: Array, rtol: float, atol: float) -> Integration:
    """The integration that a plant needs; it records at the instants of `grid` [s]."""
    return (StickSlipIntegration if FRICTION_DIRECTION in system.parameters else SmoothIntegration)(
        system, p, grid, rtol, atol
    )


def _check_samples(model: Runnable, inputs: Trajectory, max_steps: float) -> None:
    """Refuse a sampled loop whose samples over the inputs' time are more than a budget."""
    check_argument("inputs", inputs, Trajectory, "a Trajectory; a log's is its .trajectory")
    check_number("max_steps", max_steps, "a number of samples, as 1e7; math.inf for no limit")
    sample_time, duration = model.motion().sample_time, float(inputs.t[-1] - inputs.t[0])
    count = duration / sample_time if sample_time else 0.0
    require(
        count <= max_steps,
        f"{duration:g} s of samples every {sample_time or 0.0:g} s are {count:.2g} samples, about "
        f"{count * SECONDS_A_STEP / 60:.2g} minutes, more than {max_steps:.2g}; lengthen the sample time, shorten "
        "the inputs, or raise max_steps",
    )


def _integrate(
    model: Runnable | HasSystem,
    inputs: Trajectory,
    parameters: ParameterSet,
    initial: Mapping[str, float] | ArrayLike | None,
    t_out: ArrayLike | None,
    tolerances: tuple[float, float],
    *,
    intersample: Mapping[str, Intersample] | None = None,
    continues: bool = False,
) -> tuple[Integration, tuple[Contact, ...]]:
    model = as_runnable(model, "model")
    check_argument("inputs", inputs, Trajectory, "a Trajectory; a log's is its .trajectory")
    check_parameters(parameters)
    for name, value, least in zip(("rtol", "atol"), tolerances, (1e-14, 1e-30), strict=True):
        check_number(name, value, f"a tolerance from {least:g} to 1", least=least, most=1.0)
    motion = model.motion()
    system, update = motion.system, compile_function(motion.update) if motion.update is not None else None
    u, grid = input_rows(system.inputs, inputs), _report_times(t_out, inputs.t)
    x = np.array(initial, dtype=float) if continues else initial_state(model, parameters, initial)
    p = parameter_vector(system.parameters, parameters)
    slack = _time_tolerance(inputs.t)
    linear = _linear_inputs(system.inputs, intersample or {})
    slope = slopes(inputs.t, u, linear)
    breaks, is_sample = _restart_times(inputs.t, np.where(linear, slope, u), motion.sample_time, slack)
    is_sample[0] &= not continues
    at_sample = np.searchsorted(inputs.t, breaks + slack, side="right") - 1
    rows = u[at_sample] + slope[at_sample] * (breaks - inputs.t[at_sample])[:, None]
    rising = slope[at_sample] if linear.any() else [None] * len(breaks)
    run, done = new_integration(system, p, grid, *tolerances), 0
    watch = LimitMonitor(model.plant, parameters, inputs.t[0], x)
    with watch.report_contacts(), without_solver_warnings():
        for at, end, row, rise, acts in zip(breaks, [*breaks[1:], np.inf], rows, rising, is_sample, strict=True):
            run.restart(at, update(at, x, row, p)[0] if acts and update is not None else x, row, rise)
            until = int(np.searchsorted(grid, end - slack))
            is_last = until == len(grid)
            instants = grid[done:until] if is_last else np.append(grid[done:until], end)
            x = watch.follow(run, instants, until - done, stops=continues)
            if is_last or (continues and watch.contacts):
                break
            done = until
    return run, watch.contacts


def _linear_inputs(inputs: Sequence[Quantity], intersample: Mapping[str, Intersample]) -> Mask:
    """Which of a model's inputs run linearly."""
    check_argument("intersample", intersample, Mapping, "a mapping, as {'force': Intersample.LINEAR}")
    check_names("input", intersample, names(inputs), "intersample")
    for name, kind in intersample.items():
        check_argument(f"intersample[{name!r}]", kind, Intersample, "Intersample.HELD or Intersample.LINEAR")
    return np.array([intersample.get(n) is Intersample.LINEAR for n in names(inputs)], dtype=bool)


def input_rows(wanted: Sequence[Quantity], inputs: Trajectory) -> Array:
    """The inputs as rows, one an instant; a missing value is an error."""
    u = inputs.matrix(names(wanted))
    for q, column in zip(wanted, u.T, strict=True):
        k = int(np.argmin(np.isfinite(column)))
        good = bool(np.isfinite(column[k]))
        require(good, f"input {q.name!r} is {column[k]:g} at t = {inputs.t[k]:g} s; a simulation needs every sample")
    return u


def _report_times(t_out: ArrayLike | None, t: Array) -> Array:
    """The instants to report, within the inputs' time."""
    if t_out is None:
        return t
    grid, slack = np.array(t_out, dtype=float, ndmin=1), _time_tolerance(t)
    require(grid.size > 0 and bool(np.all(np.diff(grid) > 0)), "t_out must be instants that increase strictly")
    inside = t[0] - slack <= grid[0] and grid[-1] <= t[-1] + slack
    require(bool(inside), f"t_out runs from {grid[0]:g} to {grid[-1]:g} s, the inputs from {t[0]:g} to {t[-1]:g} s")
    return grid


def _time_tolerance(t: Array) -> float:
    """Time difference below which two instants count as one [s]."""
    return float(max(1e-6 * np.min(np.diff(t), initial=1.0), 4 * np.spacing(np.abs(t).max())))


def _restart_times(t: Array, u: Array, sample_time: float | None, slack: float) -> tuple[Array, Mask]:
    """Instants of restarts, at the start, changes of u (held inputs, slopes of others), samples; which are samples."""
    changes = t[np.append(True, np.any(u[1:] != u[:-1], axis=1))]
    if sample_time is None:
        return changes, np.zeros(len(changes), dtype=bool)
    count = (changes - t[0]) / sample_time
    between = changes[np.abs(count - np.round(count)) * sample_time > slack]
    samples = t[0] + sample_time * np.arange(int((t[-1] - t[0] + slack) / sample_time) + 1)
    order = np.argsort(np.concatenate([samples, between]))
    return np.concatenate([samples, between])[order], order < len(samples)


def initial_state(model: Runnable, parameters: ParameterSet, initial: Mapping[str, float] | ArrayLike | None) -> Array:
    """The state from which `simulate` starts; `InputError` where the plant cannot be there."""
    states, plant = model.states, model.plant
    if initial is None:
        x = model.rest_state(parameters)
    elif isinstance(initial, Mapping):
        check_names("state", initial, names(states), "initial")
        held = {n: float(v) for n, v in initial.items() if n == REST_COORDINATE}
        base = model.rest_state(parameters, held) if initial.keys() < set(names(states)) else np.zeros(len(states))
        x = np.array([initial.get(q.name, value) for q, value in zip(states, base, strict=True)], dtype=float)
    else:
        x = np.array(initial, dtype=float)
        require(x.shape == (len(states),), f"initial has shape {x.shape}, the model has {len(states)} states")
    for q, value in zip(states, x, strict=True):
        require(
            q.lower <= value <= q.upper,
            f"{q.name} starts at {value:g} {q.unit}, outside [{q.lower:g}, {q.upper:g}]; give it in `initial`",
        )
    plant.check(parameters, dict(zip(names(plant.states), x.tolist(), strict=False)))
    return x
