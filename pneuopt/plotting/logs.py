"""Logs as they were read, each channel over time, and the signals that contradict each other in a doctor's finding."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.doctor import LogFinding
from pneuopt.logs.experiment import Experiment
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    ORANGE,
    PLOT_UNITS,
    RED,
    STYLE,
    axes_grid,
    axis_label,
    note_omissions,
    plot_unit,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure


def plot_logs(experiments: Sequence[Experiment]) -> "Figure":
    """The channels of logs, a row a channel, a column a log.

    Returns
    -------
    Figure
        Of the first three logs.
    """
    shown = experiments[: STYLE.columns]
    every = dict.fromkeys(n for e in shown for n in e.trajectory)
    channels = [*(n for n in CHANNELS if n in every), *(n for n in every if n not in CHANNELS)]
    figure, grid = axes_grid(len(channels), len(shown), [1.5] * len(channels), sharex="col")
    for column, experiment in enumerate(shown):
        for row, channel in enumerate(channels):
            axes = grid[row][column]
            log = experiment.trajectory
            if channel in log:
                t, y = _envelope(log.t, plot_unit([experiment], channel)[0] * log[channel])
                axes.plot(t, y, color=BLUE, lw=0.9)
            else:
                axes.text(0.5, 0.5, "not logged", transform=axes.transAxes, ha="center", va="center", color=GREY)
            if column == 0:
                axes.set_ylabel(axis_label(channel.replace("_", "\n", 1), plot_unit(shown, channel)[1]), fontsize=9)
        grid[0][column].set_title(experiment.name, fontsize=9)
        grid[-1][column].set_xlabel("time [s]")
    note_omissions(figure, len(shown), len(experiments), "logs")
    return figure


def _envelope(t: Array, y: Array) -> tuple[Array, Array]:
    """The curve with the least and the largest sample of each stretch, so that no short event is lost."""
    stretch = -(-2 * t.size // STYLE.points)
    if stretch < 2 or t.size < STYLE.points:
        return t, y
    whole = t.size - t.size % stretch
    blocks = y[:whole].reshape(-1, stretch)
    filled = np.where(np.isnan(blocks), np.inf, blocks)
    low, high = filled.argmin(axis=1), np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    at = np.sort(np.concatenate([low, high]) + np.tile(np.arange(0, whole, stretch), 2))
    return t[at], y[at]


COLOURS = (BLUE, ORANGE, GREY, RED)


def plot_finding(finding: LogFinding) -> "Figure":
    """The signals that show a finding, shaded where they contradict each other, in the whole log and enlarged.

    Parameters
    ----------
    finding : LogFinding
        From `examine_logs`, or the `finding` of a `LogError`.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If the finding has no evidence.
    """
    from matplotlib.patches import Patch

    shown = finding.evidence
    if shown is None:
        raise InputError(f"the finding {finding.check!r} has no signals to be drawn")
    whole = float(shown.t[0]), float(shown.t[-1])
    views = {"whole log": whole}
    if shown.view[1] - shown.view[0] < STYLE.zoom_share * (whole[1] - whole[0]):
        views["enlarged"] = shown.view
    figure, grid = axes_grid(len(shown.panels), len(views), [2.1] * len(shown.panels), sharex="col")
    for column, (label, view) in enumerate(views.items()):
        for number, panel in enumerate(shown.panels):
            axes = grid[number][column]
            factor, _ = PLOT_UNITS.get(panel.unit, (1.0, ""))
            inside = np.flatnonzero((shown.t >= view[0]) & (shown.t <= view[1]))
            part = inside[:: max(1, inside.size // STYLE.points)]
            for colour, (name, curve) in zip(COLOURS[number:], panel.curves.items(), strict=False):
                axes.plot(shown.t[part], factor * curve[part], color=colour, lw=1.1, label=name)
            axes.set_xlim(*view)
            if not shown.contradiction.all():
                between = axes.get_xaxis_transform()
                axes.fill_between(
                    shown.t, 0, 1, where=shown.contradiction, transform=between, color=RED, alpha=0.15, lw=0
                )
            if column == 0:
                unit = PLOT_UNITS.get(panel.unit, (1.0, panel.unit))[1]
                name = next(iter(panel.curves)) if len(panel.curves) == 1 else ""
                text = axis_label("\n".join(textwrap.wrap(name, STYLE.label_letters)), unit)
                axes.set_ylabel(text.strip(), fontsize=9)
        grid[0][column].set_title(label, fontsize=9, color=GREY)
        grid[-1][column].set_xlabel("time [s]")
    title = f"{finding.log}: {finding.message}" if finding.log else finding.message
    figure.suptitle("\n".join(textwrap.wrap(title, STYLE.title_letters)), fontsize=9, ha="left", x=0.01)
    several = [row[0] for row, panel in zip(grid, shown.panels, strict=True) if len(panel.curves) > 1]
    handles: list[Artist] = [line for axes in several for line in axes.get_legend_handles_labels()[0]]
    if not shown.contradiction.all():
        handles.append(Patch(color=RED, alpha=0.15, label=shown.label))
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure
