"""The friction that the logs imply over speed, with the fitted curve and its band."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.identification.propagation import propagate_intervals
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment, differentiate
from pneuopt.plotting.canvas import BLUE, GREY, MAX_PLOT_POINTS, axes_grid, legend_above
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SLOPE_SAMPLES = 20  # of a local derivative


def plot_friction(system: System, result: IdentificationResult, experiments: Sequence[Experiment]) -> "Figure":
    """The friction force that the logs imply against speed, with the fitted curve and its 95 % band on top.

    For a `MotionDrive` the force as measured, offset and pressure and all. For a drive with a mass what pushes it (the
    logged force or pressures, less the load) less mass times acceleration. The acceleration is the fitted run's and
    the local slope of what the log deviates from it: so the points of a perfect fit lie on its friction at any speed,
    where a slope of the log itself would round off fast motion, and a misfit slower than the slope's window is seen
    whole. Where the motion reverses there are none, for a slope taken across the jump is none. The curve is that of
    steady motion, at the median of the pressures, and of the size of a logged force, for laws that depend on them.

    Parameters
    ----------
    system : System
    result : Fitted
    experiments : sequence of Experiment
        Those that it was made from, in the same order.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If the system is neither (`has_friction_map`).
    """
    require(has_friction_map(system), "a friction map is drawn for a drive with a mass, or for a MotionDrive")
    imposed, axis = not system.states, system.axis or Axis()
    figure, ((axes,),) = axes_grid(1, 1, [4.2], width=7.0)
    clouds = [
        _rig_points(e) if imposed else _drive_points(system, result, e, name)
        for name, e in zip(result.trajectories, experiments, strict=True)
    ]
    speed, force = (np.concatenate(part) for part in zip(*clouds, strict=True))
    every = max(1, len(speed) // MAX_PLOT_POINTS)
    axes.plot(speed[::every], force[::every], ".", color=GREY, ms=2.5, alpha=0.6, label="from the logs")
    if imposed:
        fitted = np.concatenate([run["force"] for run in result.trajectories.values()])
        axes.plot(speed[::every], fitted[::every], ".", color=BLUE, ms=2.5, label="fitted")
    else:
        _draw_curve(axes, system, result, experiments, _speed_grid(speed))
    low, high = np.nanpercentile(force, [0.5, 99.5])
    axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    speed_unit = next(q.unit for q in (*system.states, *system.inputs) if q.name == axis.speed)
    pushes = "force" if axis.force == "N" else "torque"
    axes.set(
        xlabel=f"speed [{speed_unit}]",
        ylabel=f"{pushes} [{axis.force}]" if imposed else f"friction {pushes} [{axis.force}]",
    )
    legend_above(figure, axes)
    return figure


def has_friction_map(system: System) -> bool:
    """Whether `plot_friction` can draw it: speed in and force out, or a mass that moves."""
    imposed = not system.states and "speed" in names(system.inputs) and names(system.outputs) == ("force",)
    return imposed or system.axis is not None


def friction_force(system: System, run: Trajectory, parameters: ParameterSet) -> Array:
    """The friction force on the load along a simulated run, shape (n,) [N].

    Parameters
    ----------
    system : System
        With a friction map, and a mass.
    run : Trajectory
        Its states and inputs.
    parameters : ParameterSet
    """
    seen, axis = {n: run[n] for n in names(system.states)}, _moving_axis(system)
    idle = {n: np.zeros(len(run)) for n in seen if n == axis.speed or n.startswith("friction.")}
    inputs = {n: run[n] for n in names(system.inputs)}
    moves, free = (_state_rates(system, parameters, x, inputs)[axis.speed] for x in (seen, {**seen, **idle}))
    return np.asarray(parameters.value(axis.inertia) * (free - moves))


def _moving_axis(system: System) -> Axis:
    assert system.axis is not None, "has_friction_map comes first"
    return system.axis


def _rig_points(experiment: Experiment) -> tuple[Array, Array]:
    return experiment.trajectory["speed"], experiment.trajectory["force"]


def _drive_points(
    system: System, result: IdentificationResult, experiment: Experiment, name: str
) -> tuple[Array, Array]:
    """Speed, and what pushes the mass without accelerating it."""
    log, run, axis = experiment.trajectory, result.trajectories[name], _moving_axis(system)
    found = {str(n): float(v) for n, v in result.estimates["value"].items()}
    own = {n.partition("[")[0]: v for n, v in found.items() if n.endswith(f"[{name}]")}
    known = {n: v for n, v in experiment.conditions.items() if n in result.parameters}
    parameters = result.parameters.with_values({**own, **known})
    deviation = {n: log[n] - run[n] for n in (axis.speed, axis.position) if n in log}
    if axis.speed not in deviation:
        deviation[axis.speed] = _smooth_derivative(log.t, deviation[axis.position])
    speed = run[axis.speed] + deviation[axis.speed]
    states, inputs = names(system.states), {q: log[q] for q in names(system.inputs)}
    seen = {n: log[n] if n in log else run[n] for n in states}
    idle = {n: np.zeros(len(log)) for n in seen if n == axis.speed or n.startswith("friction.")}
    pushed, moves = (
        _state_rates(system, parameters, x, inputs)[axis.speed] for x in ({**seen, **idle}, {n: run[n] for n in states})
    )
    force = parameters.value(axis.inertia) * (pushed - moves - _smooth_derivative(log.t, deviation[axis.speed]))
    reverses = np.convolve(np.abs(np.diff(np.sign(speed), prepend=np.nan)) > 0, np.ones(2 * SLOPE_SAMPLES), "same")
    return speed, np.where(reverses > 0, np.nan, force)


def _draw_curve(
    axes: "Axes", system: System, result: IdentificationResult, experiments: Sequence[Experiment], grid: Array
) -> None:
    """The fitted curve, and how far the estimates' covariance lets it move; no band where it does not say."""
    shared = [n for n in result.covariance.index if n in result.parameters]
    usual = {
        n: float(np.median(np.concatenate([run[n] for run in result.trajectories.values()])))
        for n in names(system.states)
    }
    logs = [e.trajectory for e in experiments]
    usual |= {n: float(np.nanmedian(np.abs(np.concatenate([q[n] for q in logs])))) for n in names(system.inputs)}

    def friction(values: Mapping[str, float]) -> Array:
        moved = {n: replace(result.parameters[n], value=values[n], lower=-math.inf, upper=math.inf) for n in shared}
        return _steady_friction(system, result.parameters | ParameterSet(moved), usual, grid)

    force, intervals = propagate_intervals(result, friction)
    if np.isfinite(intervals).all():
        axes.fill_between(grid, *intervals.T, color=BLUE, alpha=0.3, lw=0, label="95 % band")
    axes.plot(grid, force, color=BLUE, lw=1.2, label="fitted")


def _steady_friction(system: System, parameters: ParameterSet, usual: Mapping[str, float], speeds: Array) -> Array:
    """The friction force at a steady speed, with the bristles at their deflection for that speed.

    A bristle's rate is linear in its deflection: two points tell where it is zero.
    """
    axis, usual_columns = _moving_axis(system), {n: np.full(len(speeds), value) for n, value in usual.items()}
    inputs = {n: usual_columns[n] for n in names(system.inputs)}
    still = {n: usual_columns[n] for n in names(system.states)} | {axis.speed: np.zeros(len(speeds))}
    bristles = {s.name: s.nominal for s in system.states if s.name.startswith("friction.")}
    still |= {n: np.zeros(len(speeds)) for n in bristles}
    moving, bent = {**still, axis.speed: speeds}, {n: np.full(len(speeds), size) for n, size in bristles.items()}
    straight = _state_rates(system, parameters, moving, inputs)
    other = _state_rates(system, parameters, {**moving, **bent}, inputs)
    ends = {n: size * straight[n] / (straight[n] - other[n]) for n, size in bristles.items()}
    rest, steady = (_state_rates(system, parameters, x, inputs)[axis.speed] for x in (still, {**moving, **ends}))
    return np.asarray(parameters.value(axis.inertia) * (rest - steady))


def _state_rates(
    system: System, parameters: ParameterSet, x: Mapping[str, Array], u: Mapping[str, Array]
) -> dict[str, Array]:
    """The states' rates at many points at once."""
    count = len(next(iter(x.values())))
    given = [np.array([part[q.name] for q in group]) for part, group in ((x, system.states), (u, system.inputs))]
    p = np.tile(parameter_vector(system.parameters, parameters)[:, None], (1, count))
    found = system.ode.map(count)(np.zeros((1, count)), *given, p)[0].full()
    return dict(zip(names(system.states), np.asarray(found), strict=True))


def _smooth_derivative(t: Array, y: Array) -> Array:
    window = SLOPE_SAMPLES * float(np.median(np.diff(t)))
    return differentiate(Experiment(Trajectory(t, {"position": y})), window=window).trajectory["speed"]


def _speed_grid(speed: Array) -> Array:
    """A grid over the range, dense around zero."""
    low, high = float(np.nanmin(speed)), float(np.nanmax(speed))
    near = np.geomspace(1e-4, 1.0, 120) * max(-low, high)
    grid = np.unique(np.concatenate([np.linspace(low, high, 200), near, -near]))
    return np.asarray(grid[(grid >= low) & (grid <= high) & (grid != 0)])
