"""Diagnosis of a fit: its residuals, their correlations and distribution; the correlation of its estimates."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.statistics import correlation, ljung_box
from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    MAX_PLOT_POINTS,
    NORMAL_QUANTILE_95,
    ORANGE,
    RED,
    axes_grid,
    common_channels,
    note_omissions,
    plot_unit,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_CORRELATION_LAG = 40
"""Largest lag of a correlation [samples]: more crowd the axis, fewer hide slow dynamics."""
MAX_PLOT_CHANNELS = 4
"""Channels below each other: more cannot be read, fewer leave channels out."""
MAX_NUMBERED_PARAMETERS = 12
"""Parameters up to which each cell has room for its number; with more, numbers overlap."""


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
    shown = channels[:MAX_PLOT_CHANNELS]
    figure, grid = axes_grid(len(shown), 4, [2.4] * len(shown), width=13.0)
    for (over_time, own, crossed, spread), channel in zip(grid, shown, strict=True):
        _draw_over_time(over_time, pairs, channel)
        _draw_autocorrelation(own, pairs, channel)
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

    Parameters
    ----------
    result : IdentificationResult

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If no estimate has a standard deviation.
    """
    covariance = result.covariance
    known = np.isfinite(np.diag(covariance.to_numpy()))
    require(bool(known.any()), "no estimate has a standard deviation, so that there is no correlation to draw")
    names = [str(n) for n in covariance.index[known]]
    values, count = correlation(covariance.to_numpy()[np.ix_(known, known)]), len(names)
    side = max(3.2, min(8.0, 0.62 * count))
    figure, ((axes,),) = axes_grid(1, 1, [side], width=side + 3.0)
    image = axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
    figure.colorbar(image, ax=axes, pad=0.02, shrink=0.9)
    axes.grid(False)
    axes.set_xticks(range(count), names, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(count), names, fontsize=8)
    if count <= MAX_NUMBERED_PARAMETERS:
        for (row, column), value in np.ndenumerate(values):
            colour = "white" if abs(value) > 0.6 else "black"
            axes.text(column, row, _format_correlation(value), ha="center", va="center", fontsize=8, color=colour)
    axes.set_title("correlation of the estimates", fontsize=10)
    note_omissions(figure, count, len(covariance), "estimates have a standard deviation")
    return figure


def _format_correlation(value: float) -> str:
    """Two digits, but never a 1.00 that is none."""
    return f"{value:.2f}" if abs(value) < 0.995 or abs(value) > 1 - 1e-9 else f"{math.trunc(1e4 * value) / 1e4:.4f}"


def _channel_residuals(pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> list[tuple[Trajectory, Array]]:
    return [
        (e.trajectory, e.trajectory[channel] - run[channel])
        for run, e in pairs
        if channel in e.trajectory and channel in run
    ]


def _draw_over_time(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    factor, unit = plot_unit([e for _, e in pairs], channel)
    found = _channel_residuals(pairs, channel)
    every = max(1, sum(len(log) for log, _ in found) // MAX_PLOT_POINTS)
    for number, (log, e) in enumerate(found):
        colour = (BLUE, ORANGE)[number % 2] if len(found) <= 4 else BLUE
        axes.plot(log.t[::every], factor * e[::every], ".", color=colour, ms=1.5)
    axes.axhline(0, color=GREY, lw=0.8)
    axes.set_ylabel(f"{channel} [{unit}]")


def _draw_autocorrelation(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    found = [e for _, e in _channel_residuals(pairs, channel)]
    rho = _mean_correlogram([_correlogram(e, e) for e in found])
    axes.vlines(range(1, len(rho)), 0, rho[1:], color=BLUE, lw=1.4)
    _draw_band(axes, found)
    p = [ljung_box(e)[1] for e in found]
    known = [q for q in p if math.isfinite(q)]
    message = (
        f"Ljung-Box p {_format_probability(min(known))}" + (f" (least of {len(known)})" if len(known) > 1 else "")
        if known
        else ""
    )
    axes.text(0.98, 0.03, message, transform=axes.transAxes, ha="right", va="bottom", fontsize=8)
    _set_symmetric_limits(axes, rho[1:])


def _draw_crosscorrelation(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    found = _channel_residuals(pairs, channel)
    outputs = {n for run, _ in pairs for n in run}
    logged = dict.fromkeys([*CHANNELS, *(n for log, _ in found for n in log)])
    inputs = [n for n in logged if n not in outputs and any(n in log for log, _ in found)]
    every = []
    for name, colour in zip(inputs, (BLUE, ORANGE, RED), strict=False):
        rho = _mean_correlogram([_correlogram(e, log[name]) for log, e in found if name in log])
        axes.plot(range(len(rho)), rho, color=colour, lw=1.2, label=name)
        every.append(rho)
    _draw_band(axes, [e for _, e in found])
    if inputs:
        axes.legend(fontsize=8, frameon=False, loc="upper right")
        _set_symmetric_limits(axes, np.concatenate(every))


def _draw_distribution(axes: "Axes", pairs: Sequence[tuple[Trajectory, Experiment]], channel: str) -> None:
    """Residuals over their noise, beside the normal distribution that they should have."""
    scaled = np.concatenate(
        [
            (e.trajectory[channel] - run[channel]) / e.noise.get(channel, math.nan)
            for run, e in pairs
            if channel in e.trajectory and channel in run
        ]
    )
    label = "residual / noise"
    if not np.isfinite(scaled).any():  # no noise is declared: the residuals' own deviation
        scaled = np.concatenate([e for _, e in _channel_residuals(pairs, channel)])
        scaled, label = scaled / np.nanstd(scaled), "residual / its deviation"
    scaled = scaled[np.isfinite(scaled)]
    edge = max(4.0, float(np.quantile(np.abs(scaled), 0.999)))
    axes.hist(np.clip(scaled, -edge, edge), bins=60, range=(-edge, edge), density=True, color=BLUE, alpha=0.5)
    x = np.linspace(-edge, edge, 200)
    axes.plot(x, np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi), color=ORANGE, lw=1.2)
    axes.set_yticks([])
    axes.set_xlabel(label)


def _correlogram(e: Array, other: Array) -> Array:
    """Correlation of residuals with another column 0 to `MAX_CORRELATION_LAG` samples before; NaN if constant."""
    known = np.isfinite(e) & np.isfinite(other)
    a, b = (np.where(known, v - np.mean(v[known]), 0.0) if known.any() else np.zeros(len(v)) for v in (e, other))
    size = math.sqrt(float(a @ a) * float(b @ b))
    lags = min(MAX_CORRELATION_LAG, len(e) - 2) + 1
    return np.array([a[k:] @ b[: len(b) - k] for k in range(lags)]) / size if size > 0 else np.full(lags, np.nan)


def _mean_correlogram(rows: Sequence[Array]) -> Array:
    n = min(len(row) for row in rows)
    finite = [row[:n] for row in rows if np.isfinite(row[:n]).all()]
    return np.mean(finite, axis=0) if finite else np.zeros(n)


def _draw_band(axes: "Axes", residuals: Sequence[Array]) -> None:
    width = NORMAL_QUANTILE_95 / math.sqrt(sum(int(np.isfinite(e).sum()) for e in residuals))
    axes.axhspan(-width, width, color=GREY, alpha=0.25, lw=0)
    axes.axhline(0, color=GREY, lw=0.8)


def _set_symmetric_limits(axes: "Axes", rho: Array) -> None:
    edge = min(1.05, max(0.2, 1.3 * float(np.max(np.abs(rho), initial=0.0))))
    axes.set_ylim(-edge, edge)


def _format_probability(p: float) -> str:
    return f"{p:.2g}" if p >= 1e-4 else "< 1e-4"
