"""Logs as they were read: each channel over time."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    MAX_PLOT_COLUMNS,
    MAX_PLOT_POINTS,
    axes_grid,
    axis_label,
    note_omissions,
    plot_unit,
)
from pneuopt.quantities.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_logs(experiments: Sequence[Experiment]) -> "Figure":
    """The channels of logs, a row a channel, a column a log.

    Parameters
    ----------
    experiments : sequence of Experiment

    Returns
    -------
    Figure
        Of the first three logs.
    """
    shown = experiments[:MAX_PLOT_COLUMNS]
    every = dict.fromkeys(n for e in shown for n in e.trajectory)
    channels = [*(n for n in CHANNELS if n in every), *(n for n in every if n not in CHANNELS)]
    figure, grid = axes_grid(len(channels), len(shown), [1.5] * len(channels), sharex="col")
    for column, experiment in enumerate(shown):
        for row, channel in enumerate(channels):
            axes = grid[row][column]
            _draw(axes, experiment, channel)
            if column == 0:
                axes.set_ylabel(axis_label(channel.replace("_", "\n", 1), plot_unit(shown, channel)[1]), fontsize=9)
        grid[0][column].set_title(experiment.name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    note_omissions(figure, len(shown), len(experiments), "logs")
    return figure


def _draw(axes: "Axes", experiment: Experiment, channel: str) -> None:
    """A channel over time; of more points than can be seen, the least and the largest of each stretch."""
    log = experiment.trajectory
    if channel not in log:
        axes.text(0.5, 0.5, "not logged", transform=axes.transAxes, ha="center", va="center", color=GREY)
        return
    t, y = _envelope(log.t, plot_unit([experiment], channel)[0] * log[channel])
    axes.plot(t, y, color=BLUE, lw=0.9)


def _envelope(t: Array, y: Array) -> tuple[Array, Array]:
    """The curve with the least and the largest sample of each stretch, so that no short event is lost."""
    stretch = -(-2 * t.size // MAX_PLOT_POINTS)
    if stretch < 2 or t.size < MAX_PLOT_POINTS:
        return t, y
    whole = t.size - t.size % stretch
    blocks = y[:whole].reshape(-1, stretch)
    filled = np.where(np.isnan(blocks), np.inf, blocks)
    low, high = filled.argmin(axis=1), np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    at = np.sort(np.concatenate([low, high]) + np.tile(np.arange(0, whole, stretch), 2))
    return t[at], y[at]
