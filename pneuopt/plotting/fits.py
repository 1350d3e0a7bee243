"""Fits beside their logs: prediction, residuals and their correlations, correlation of the estimates, friction map."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.identification.profiles import propagate_intervals
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.statistics import correlation, ljung_box
from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiment import Experiment, differentiate
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    STYLE,
    axes_grid,
    common_channels,
    finish_columns,
    legend_above,
    note_omissions,
    plot_unit,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_fit(result: IdentificationResult, experiments: Sequence[Experiment]) -> "Figure":
    """Measured beside fitted, and the residuals, a column a log.

    Parameters
    ----------
    result : IdentificationResult
        Its trajectories are drawn.
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
        In the same order; windows of one log (`split`) share a column.
    label : str
        What the runs are: "fitted", "predicted".

    Returns
    -------
    Figure
    """
    require(len(runs) == len(experiments) > 0, f"{len(runs)} runs do not match {len(experiments)} experiments")
    logs: dict[str, list[tuple[Trajectory, Trajectory]]] = {}  # windows "name@0", "name@1" belong to "name"
    for number, (run, experiment) in enumerate(zip(runs, experiments, strict=True), 1):
        log = experiment.name.partition("@")[0] or f"log {number}"
        logs.setdefault(log, []).append((experiment.trajectory, run))
    shown = [list(logs)[k] for k in sorted({round(k) for k in np.linspace(0, len(logs) - 1, STYLE.columns)})]
    channels = common_channels(runs, experiments)
    require(bool(channels), "the runs and the logs have no channel in common")
    figure, grid = axes_grid(2 * len(channels), len(shown), [2.2, 1.0] * len(channels), sharex="col")
    for column, name in enumerate(shown):
        for row, channel in enumerate(channels):
            top, bottom, pairs = grid[2 * row][column], grid[2 * row + 1][column], logs[name]
            factor, unit = plot_unit(experiments, channel)
            for number, (measured, run) in enumerate(pairs):
                if channel not in measured or channel not in run:
                    continue
                first = number == 0
                every = max(1, len(measured) * len(pairs) // STYLE.points)
                t, y = measured.t[::every], factor * measured[channel][::every]
                top.plot(t, y, ".", color=GREY, ms=3, label="measured" if first else None)
                if f"{channel}_low" in run:
                    low, high = (factor * run[f"{channel}_{end}"] for end in ("low", "high"))
                    shade: dict[str, Any] = {"color": BLUE, "alpha": 0.2, "lw": 0}
                    top.fill_between(run.t, low, high, label="95 % band" if first else None, **shade)
                    bottom.fill_between(run.t, (low - high) / 2, (high - low) / 2, **shade)
                top.plot(run.t, factor * run[channel], color=BLUE, lw=1.2, label=label if first else None)
                bottom.plot(t, y - factor * run[channel][::every], ".", color=ORANGE, ms=1.5)
            top.set_ylabel(f"{channel} [{unit}]")
            bottom.set_ylabel(f"measured\n- {label} [{unit}]", fontsize=8)
            bottom.axhline(0, color=GREY, lw=0.8)
        grid[0][column].set_title(name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    return finish_columns(figure, grid, len(logs), "logs")


def plot_residuals(runs: Sequence[Trajectory], experiments: Sequence[Experiment]) -> "Figure":
    """Residuals of each channel: over time, against themselves, against the inputs, and their distribution.

    Parameters
    ----------
    runs : sequence of Trajectory
        Fitted or predicted, one an experiment.
    experiments : sequence of Experiment
        Correlations are taken within each, then averaged; the band is what 95 % of white residuals stay in.

    Returns
    -------
    Figure
    """
    require(len(runs) == len(experiments) > 0, f"{len(runs)} runs do not match {len(experiments)} experiments")
    pairs = list(zip(runs, experiments, strict=True))
    channels = common_channels(runs, experiments)
    require(bool(channels), "the runs and the logs have no channel in common")
    shown = channels[: STYLE.channels]
    figure, grid = axes_grid(len(shown), 4, [2.4] * len(shown), width=13.0)
    for (over_time, auto, crossed, spread), channel in zip(grid, shown, strict=True):
        factor, unit = plot_unit([e for _, e in pairs], channel)
        residuals = _channel_residuals(pairs, channel)
        every = max(1, sum(len(e) for _, e in residuals) // STYLE.points)
        for number, (log, e) in enumerate(residuals):
            colour = (BLUE, ORANGE)[number % 2] if len(residuals) <= 4 else BLUE
            over_time.plot(log.trajectory.t[::every], factor * e[::every], ".", color=colour, ms=1.5)
        over_time.axhline(0, color=GREY, lw=0.8)
        over_time.set_ylabel(f"{channel} [{unit}]")
        _draw_autocorrelation(auto, pairs, channel)
        _draw_crosscorrelation(crossed, pairs, channel)
        _draw_distribution(spread, pairs, channel)
    for axes, title in zip(
        grid[0], ("residuals", "autocorrelation", "correlation with inputs", "distribution"), strict=True
    ):
        axes.set_title(title, fontsize=10)
    for axes, label in zip(grid[-1], ("time [s]", "lag [samples]", "lag [samples]"), strict=False):
        axes.set_xlabel(label)
    note_omissions(figure, len(shown), len(channels), "channels")
    return figure


def plot_correlation(result: IdentificationResult) -> "Figure":
    """The correlation of the estimates: a cell a pair, 1 or -1 where only a combination of both is identifiable.

    Raises
    ------
    InputError
        If no estimate has a standard deviation.
    """
    covariance = result.covariance
    finite = np.isfinite(np.diag(covariance.to_numpy()))
    require(bool(finite.any()), "no estimate has a standard deviation, so that there is no correlation to draw")
    names = [str(n) for n in covariance.index[finite]]
    values, count = correlation(covariance.to_numpy()[np.ix_(finite, finite)]), len(names)
    side = max(3.2, min(8.0, 0.62 * count))
    figure, ((axes,),) = axes_grid(1, 1, [side], width=side + 3.0)
    image = axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
    figure.colorbar(image, ax=axes, pad=0.02, shrink=0.9)
    axes.grid(False)
    axes.set_xticks(range(count), names, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(count), names, fontsize=8)
    if count <= STYLE.numbered_cells:
        for (row, column), value in np.ndenumerate(values):
            colour = "white" if abs(value) > 0.6 else "black"
            nearly_one = 0.995 <= abs(value) <= 1 - 1e-9  # two digits, but never a 1.00 that is none
            text = f"{math.trunc(1e4 * value) / 1e4:.4f}" if nearly_one else f"{value:.2f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    axes.set_title("correlation of the estimates", fontsize=10)
    note_omissions(figure, count, len(covariance), "estimates have a standard deviation")
    return figure


def _channel_residuals(pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> list[tuple[Experiment, Array]]:
    return [(e, e.trajectory[channel] - run[channel]) for run, e in pairs if channel in e.trajectory and channel in run]


def _draw_autocorrelation(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    residuals = [e for _, e in _channel_residuals(pairs, channel)]
    rho = _mean_correlogram([_correlogram(e, e) for e in residuals])
    axes.vlines(range(1, len(rho)), 0, rho[1:], color=BLUE, lw=1.4)
    _draw_band(axes, residuals)
    p = [ljung_box(e)[1] for e in residuals]
    finite = [q for q in p if math.isfinite(q)]
    message = ""
    if finite:
        least = f"{min(finite):.2g}" if min(finite) >= 1e-4 else "< 1e-4"
        message = f"Ljung-Box p {least}" + (f" (least of {len(finite)})" if len(finite) > 1 else "")
    axes.text(0.98, 0.03, message, transform=axes.transAxes, ha="right", va="bottom", fontsize=8)
    _set_symmetric_limits(axes, rho[1:])


def _draw_crosscorrelation(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    residuals = [(log.trajectory, e) for log, e in _channel_residuals(pairs, channel)]
    outputs = {n for run, _ in pairs for n in run}
    logged = dict.fromkeys([*CHANNELS, *(n for log, _ in residuals for n in log)])
    inputs = [n for n in logged if n not in outputs and any(n in log for log, _ in residuals)]
    every = []
    for name, colour in zip(inputs, (BLUE, ORANGE, RED), strict=False):
        rho = _mean_correlogram([_correlogram(e, log[name]) for log, e in residuals if name in log])
        axes.plot(range(len(rho)), rho, color=colour, lw=1.2, label=name)
        every.append(rho)
    _draw_band(axes, [e for _, e in residuals])
    if inputs:
        axes.legend(fontsize=8, frameon=False, loc="upper right")
        _set_symmetric_limits(axes, np.concatenate(every))


def _draw_distribution(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    """Residuals over their noise, beside the normal distribution that they should have."""
    residuals = _channel_residuals(pairs, channel)
    scaled = np.concatenate([e / log.noise.get(channel, math.nan) for log, e in residuals])
    label = "residual / noise"
    if not np.isfinite(scaled).any():  # no noise is declared: the residuals' own deviation
        scaled = np.concatenate([e for _, e in residuals])
        scaled, label = scaled / np.nanstd(scaled), "residual / its deviation"
    scaled = scaled[np.isfinite(scaled)]
    edge = max(4.0, float(np.quantile(np.abs(scaled), 0.999)))
    axes.hist(np.clip(scaled, -edge, edge), bins=60, range=(-edge, edge), density=True, color=BLUE, alpha=0.5)
    x = np.linspace(-edge, edge, 200)
    axes.plot(x, np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi), color=ORANGE, lw=1.2)
    axes.set_yticks([])
    axes.set_xlabel(label)


def _correlogram(e: Array, other: Array) -> Array:
    """Correlation of residuals with another column 0 to `STYLE.correlation_lag` samples before; NaN if constant."""
    finite = np.isfinite(e) & np.isfinite(other)
    a, b = (np.where(finite, v - np.mean(v[finite]), 0.0) if finite.any() else np.zeros(len(v)) for v in (e, other))
    size = math.sqrt(float(a @ a) * float(b @ b))
    lags = min(STYLE.correlation_lag, len(e) - 2) + 1
    return np.array([a[k:] @ b[: len(b) - k] for k in range(lags)]) / size if size > 0 else np.full(lags, np.nan)


def _mean_correlogram(rows: Sequence[Array]) -> Array:
    n = min(len(row) for row in rows)
    finite = [row[:n] for row in rows if np.isfinite(row[:n]).all()]
    return np.mean(finite, axis=0) if finite else np.zeros(n)


def _draw_band(axes: "Axes", residuals: Sequence[Array]) -> None:
    width = STYLE.deviations_of_95_percent / math.sqrt(sum(int(np.isfinite(e).sum()) for e in residuals))
    axes.axhspan(-width, width, color=GREY, alpha=0.25, lw=0)
    axes.axhline(0, color=GREY, lw=0.8)


def _set_symmetric_limits(axes: "Axes", rho: Array) -> None:
    edge = min(1.05, max(0.2, 1.3 * float(np.max(np.abs(rho), initial=0.0))))
    axes.set_ylim(-edge, edge)


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
        A drive's with a mass, or a rig's.
    result : IdentificationResult
        Its fit.
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
        (e.trajectory["speed"], e.trajectory["force"]) if imposed else _drive_points(system, result, e, name)
        for name, e in zip(result.trajectories, experiments, strict=True)
    ]
    speed, force = (np.concatenate(part) for part in zip(*clouds, strict=True))
    every = max(1, len(speed) // STYLE.points)
    axes.plot(speed[::every], force[::every], ".", color=GREY, ms=2.5, alpha=0.6, label="from the logs")
    if imposed:
        fitted = np.concatenate([run["force"] for run in result.trajectories.values()])
        axes.plot(speed[::every], fitted[::every], ".", color=BLUE, ms=2.5, label="fitted")
    else:
        _draw_curve(axes, system, result, experiments, speed)
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
        Those of the run.
    """
    seen, axis = {n: run[n] for n in names(system.states)}, _moving_axis(system)
    idle = {n: np.zeros(len(run)) for n in seen if n == axis.speed or n.startswith("friction.")}
    inputs = {n: run[n] for n in names(system.inputs)}
    moves, free = (_state_rates(system, parameters, x, inputs)[axis.speed] for x in (seen, {**seen, **idle}))
    return np.asarray(parameters.value(axis.inertia) * (free - moves))


def _moving_axis(system: System) -> Axis:
    assert system.axis is not None, "has_friction_map comes first"
    return system.axis


def _drive_points(
    system: System, result: IdentificationResult, experiment: Experiment, name: str
) -> tuple[Array, Array]:
    """Speed, and what pushes the mass without accelerating it."""
    log, run, axis = experiment.trajectory, result.trajectories[name], _moving_axis(system)
    estimates = {str(n): float(v) for n, v in result.estimates["value"].items()}
    of_log = {n.partition("[")[0]: v for n, v in estimates.items() if n.endswith(f"[{name}]")}
    conditions = {n: v for n, v in experiment.conditions.items() if n in result.parameters}
    parameters = result.parameters.with_values({**of_log, **conditions})
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
    reverses = np.convolve(
        np.abs(np.diff(np.sign(speed), prepend=np.nan)) > 0, np.ones(2 * STYLE.slope_samples), "same"
    )
    return speed, np.where(reverses > 0, np.nan, force)


def _draw_curve(
    axes: "Axes", system: System, result: IdentificationResult, experiments: Sequence[Experiment], speed: Array
) -> None:
    """The fitted curve over the range of speeds, and how far the estimates' covariance lets it move, if it says so."""
    low, high = float(np.nanmin(speed)), float(np.nanmax(speed))
    near = np.geomspace(1e-4, 1.0, 120) * max(-low, high)  # dense around zero
    grid = np.unique(np.concatenate([np.linspace(low, high, 200), near, -near]))
    grid = grid[(grid >= low) & (grid <= high) & (grid != 0)]
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
    """Friction force at steady speeds; bristles have the deflection at which their rate, linear in it, is zero."""
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
    arguments = [np.array([part[q.name] for q in group]) for part, group in ((x, system.states), (u, system.inputs))]
    p = np.tile(parameter_vector(system.parameters, parameters)[:, None], (1, count))
    rates = system.ode.map(count)(np.zeros((1, count)), *arguments, p)[0].full()
    return dict(zip(names(system.states), np.asarray(rates), strict=True))


def _smooth_derivative(t: Array, y: Array) -> Array:
    window = STYLE.slope_samples * float(np.median(np.diff(t)))
    return differentiate(Experiment(Trajectory(t, {"position": y})), window=window).trajectory["speed"]
