"""Fits and predictions beside their logs; the friction that the logs imply."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from pneuopt.derived import propagated
from pneuopt.errors import require
from pneuopt.experiments import CHANNELS, Experiment, differentiate
from pneuopt.parameters import ParameterSet
from pneuopt.plotting.canvas import BLUE, GREY, MOST_COLUMNS, ORANGE, SCALED, axes_grid, legend_above, shown_of
from pneuopt.system import System, names, vector
from pneuopt.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Pairs = Sequence[tuple[Trajectory, Trajectory]]
BAND = 1.96  # standard deviations, 95 %
SLOPE_SAMPLES = 20  # of a local derivative
MOST_POINTS = 4000  # of a measured line or cloud


class Fitted(Protocol):
    """What a figure needs of an identification's result."""

    @property
    def parameters(self) -> ParameterSet:
        """All parameters, the free ones as found."""
        ...

    @property
    def trajectories(self) -> Mapping[str, Trajectory]:
        """Fitted states and outputs of each log."""
        ...

    @property
    def estimates(self) -> "pd.DataFrame":
        """A row a free parameter."""
        ...

    @property
    def covariance(self) -> "pd.DataFrame":
        """Of the estimates."""
        ...


def plot_fit(result: Fitted, experiments: Sequence[Experiment]) -> "Figure":
    """Measured beside fitted, and the residuals, a column a log.

    Parameters
    ----------
    result : Fitted
        An `IdentificationResult`, say.
    experiments : sequence of Experiment
        Those that it was made from, in the same order. Windows of one log (`split`) share a column.

    Returns
    -------
    Figure
    """
    return plot_prediction(list(result.trajectories.values()), experiments, label="fitted")


def plot_prediction(runs: Sequence[Trajectory], experiments: Sequence[Experiment], *, label: str) -> "Figure":
    """Measured beside fitted or predicted, and the residuals, a column a log; at most three, spread over all.

    Parameters
    ----------
    runs : sequence of Trajectory
        One an experiment.
    experiments : sequence of Experiment
    label : str
        What the runs are: "fitted", "predicted".

    Returns
    -------
    Figure
    """
    require(len(runs) == len(experiments) > 0, f"{len(runs)} runs do not match {len(experiments)} experiments")
    logs = _by_log(runs, experiments)
    shown = [list(logs)[k] for k in sorted({round(k) for k in np.linspace(0, len(logs) - 1, MOST_COLUMNS)})]
    channels = [
        n for n in CHANNELS if any(n in e.trajectory and n in r for r, e in zip(runs, experiments, strict=True))
    ]
    require(bool(channels), "the runs and the logs have no channel in common")
    figure, grid = axes_grid(2 * len(channels), len(shown), [2.2, 1.0] * len(channels), sharex="col")
    for column, name in enumerate(shown):
        for row, channel in enumerate(channels):
            _compare(grid[2 * row][column], grid[2 * row + 1][column], logs[name], channel, label)
        grid[0][column].set_title(name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    for lines in grid:
        for axes in lines[1:]:
            axes.set_ylabel("")
    legend_above(figure, grid[0][0])
    shown_of(figure, len(shown), len(logs), "logs")
    return figure


def plot_friction(system: System, result: Fitted, experiments: Sequence[Experiment]) -> "Figure":
    """The friction force that the logs imply against speed, with the fitted curve and its 95 % band on top.

    For a `MotionDrive` the force as measured, offset and pressure and all. For a `ForceDrive` the force less load and
    mass times acceleration, each derivative a local slope of the log: of the fit, only the load is in the points. Where
    the motion reverses there are none, for a slope taken across the jump is none.

    Parameters
    ----------
    system : System
        Without internal friction states: the curve is that of steady motion.
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
    require(has_friction_map(system), "a friction map is drawn for a ForceDrive or a MotionDrive without bristles")
    imposed = not system.states
    figure, ((axes,),) = axes_grid(1, 1, [4.2], width=7.0)
    clouds = [_imposed(e) if imposed else _implied(e, result.parameters) for e in experiments]
    speed, force = (np.concatenate(part) for part in zip(*clouds, strict=True))
    every = max(1, len(speed) // MOST_POINTS)
    axes.plot(speed[::every], force[::every], ".", color=GREY, ms=2.5, alpha=0.6, label="from the logs")
    if imposed:
        fitted = np.concatenate([run["force"] for run in result.trajectories.values()])
        axes.plot(speed[::every], fitted[::every], ".", color=BLUE, ms=2.5, label="fitted")
    else:
        grid = _speeds(speed)
        _curve(axes, system, result, grid)
    low, high = np.nanpercentile(force, [0.5, 99.5])
    axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    axes.set(xlabel="speed [m/s]", ylabel="force [N]" if imposed else "friction force [N]")
    legend_above(figure, axes)
    return figure


def _curve(axes: "Axes", system: System, result: Fitted, grid: Array) -> None:
    """The fitted curve, and how far the estimates' covariance lets it move; no band where it does not say."""
    shared = [n for n in result.covariance.index if n in result.parameters]

    def friction(values: Mapping[str, float]) -> Array:
        moved = {n: replace(result.parameters[n], value=values[n], lower=-math.inf, upper=math.inf) for n in shared}
        return _steady_friction(system, result.parameters | ParameterSet(moved), grid)

    force, spread = propagated(result, friction)
    if np.isfinite(spread).all():
        low, high = force - BAND * spread, force + BAND * spread
        axes.fill_between(grid, low, high, color=BLUE, alpha=0.3, lw=0, label="95 % band")
    axes.plot(grid, force, color=BLUE, lw=1.2, label="fitted")


def has_friction_map(system: System) -> bool:
    """Whether `plot_friction` can draw it: speed in and force out, or force in and a speed without other states."""
    states, inputs = names(system.states), names(system.inputs)
    imposed = not states and "speed" in inputs and names(system.outputs) == ("force",)
    return imposed or (set(states) == {"position", "speed"} and inputs == ("force",))


def _by_log(runs: Sequence[Trajectory], experiments: Sequence[Experiment]) -> Mapping[str, Pairs]:
    """Pairs of measured and computed, by log; windows "name@0", "name@1" belong to "name"."""
    logs: dict[str, list[tuple[Trajectory, Trajectory]]] = {}
    for number, (run, experiment) in enumerate(zip(runs, experiments, strict=True), 1):
        name = experiment.name.partition("@")[0] or f"log {number}"
        logs.setdefault(name, []).append((experiment.trajectory, run))
    return logs


def _compare(top: "Axes", bottom: "Axes", pairs: Pairs, channel: str, label: str) -> None:
    factor, unit = SCALED.get(CHANNELS[channel], (1.0, CHANNELS[channel]))
    for number, (measured, run) in enumerate(pairs):
        if channel not in measured or channel not in run:
            continue
        first = number == 0
        every = max(1, len(measured) * len(pairs) // MOST_POINTS)
        t, y = measured.t[::every], factor * measured[channel][::every]
        top.plot(t, y, ".", color=GREY, ms=3, label="measured" if first else None)
        top.plot(run.t, factor * run[channel], color=BLUE, lw=1.2, label=label if first else None)
        bottom.plot(t, y - factor * run[channel][::every], ".", color=ORANGE, ms=1.5)
    top.set_ylabel(f"{channel} [{unit}]")
    bottom.set_ylabel(f"measured\n- {label} [{unit}]", fontsize=8)
    bottom.axhline(0, color=GREY, lw=0.8)


def _imposed(experiment: Experiment) -> tuple[Array, Array]:
    return experiment.trajectory["speed"], experiment.trajectory["force"]


def _implied(experiment: Experiment, parameters: ParameterSet) -> tuple[Array, Array]:
    """Speed and the force that neither load nor acceleration explain."""
    log = experiment.trajectory
    p = parameters.with_values({n: v for n, v in experiment.conditions.items() if n in parameters})
    speed = log["speed"] if "speed" in log else _slope(log.t, log["position"])
    force = log["force"] - p.value("load.force") - p.value("load.mass") * _slope(log.t, speed)
    if "load.stiffness" in p:
        force = force - p.value("load.stiffness") * (log["position"] - p.value("load.rest_position"))
    reverses = np.convolve(np.abs(np.diff(np.sign(speed), prepend=np.nan)) > 0, np.ones(2 * SLOPE_SAMPLES), "same")
    return speed, np.where(reverses > 0, np.nan, force)


def _slope(t: Array, y: Array) -> Array:
    window = SLOPE_SAMPLES * float(np.median(np.diff(t)))
    return differentiate(Experiment(Trajectory(t, {"position": y})), window=window).trajectory["speed"]


def _speeds(speed: Array) -> Array:
    """A grid over the range, dense around zero."""
    low, high = float(np.nanmin(speed)), float(np.nanmax(speed))
    near = np.geomspace(1e-4, 1.0, 120) * max(-low, high)
    grid = np.unique(np.concatenate([np.linspace(low, high, 200), near, -near]))
    return grid[(grid >= low) & (grid <= high)]


def _steady_friction(system: System, parameters: ParameterSet, speeds: Array) -> Array:
    """The force that the equations lose at each speed: without a driving force, friction alone brakes the mass."""
    p, state = vector(system.parameters, parameters), names(system.states)
    rest = parameters.value("load.rest_position") if "load.rest_position" in parameters else 0.0
    rates = [system.ode(0, [v if n == "speed" else rest for n in state], [0.0], p)[0] for v in speeds]
    acceleration = np.array([float(rate[state.index("speed")]) for rate in rates])
    return -parameters.value("load.mass") * acceleration - parameters.value("load.force")
