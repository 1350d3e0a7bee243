"""Fits and predictions beside their logs."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    MAX_PLOT_COLUMNS,
    MAX_PLOT_POINTS,
    ORANGE,
    axes_grid,
    common_channels,
    finish_columns,
    plot_unit,
)
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Pairs = Sequence[tuple[Trajectory, Trajectory]]


def plot_fit(result: IdentificationResult, experiments: Sequence[Experiment]) -> "Figure":
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
    logs = _group_by_log(runs, experiments)
    shown = [list(logs)[k] for k in sorted({round(k) for k in np.linspace(0, len(logs) - 1, MAX_PLOT_COLUMNS)})]
    channels = common_channels(runs, experiments)
    require(bool(channels), "the runs and the logs have no channel in common")
    figure, grid = axes_grid(2 * len(channels), len(shown), [2.2, 1.0] * len(channels), sharex="col")
    for column, name in enumerate(shown):
        for row, channel in enumerate(channels):
            pair, shown_in = (grid[2 * row][column], grid[2 * row + 1][column]), plot_unit(experiments, channel)
            _draw_comparison(pair, logs[name], channel, label, shown_in)
        grid[0][column].set_title(name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    return finish_columns(figure, grid, len(logs), "logs")


def _group_by_log(runs: Sequence[Trajectory], experiments: Sequence[Experiment]) -> Mapping[str, Pairs]:
    """Pairs of measured and computed, by log; windows "name@0", "name@1" belong to "name"."""
    logs: dict[str, list[tuple[Trajectory, Trajectory]]] = {}
    for number, (run, experiment) in enumerate(zip(runs, experiments, strict=True), 1):
        name = experiment.name.partition("@")[0] or f"log {number}"
        logs.setdefault(name, []).append((experiment.trajectory, run))
    return logs


def _draw_comparison(
    axes: tuple["Axes", "Axes"], pairs: Pairs, channel: str, label: str, shown_in: tuple[float, str]
) -> None:
    (top, bottom), (factor, unit) = axes, shown_in
    for number, (measured, run) in enumerate(pairs):
        if channel not in measured or channel not in run:
            continue
        first = number == 0
        every = max(1, len(measured) * len(pairs) // MAX_PLOT_POINTS)
        t, y = measured.t[::every], factor * measured[channel][::every]
        top.plot(t, y, ".", color=GREY, ms=3, label="measured" if first else None)
        top.plot(run.t, factor * run[channel], color=BLUE, lw=1.2, label=label if first else None)
        bottom.plot(t, y - factor * run[channel][::every], ".", color=ORANGE, ms=1.5)
    top.set_ylabel(f"{channel} [{unit}]")
    bottom.set_ylabel(f"measured\n- {label} [{unit}]", fontsize=8)
    bottom.axhline(0, color=GREY, lw=0.8)
