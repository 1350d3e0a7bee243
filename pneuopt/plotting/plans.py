"""Experiments over time: a planned one, within its limits, and estimates tracked over the dates of their logs."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pneuopt.experiments.design import ExperimentDesign
from pneuopt.identification.tracking import Tracking
from pneuopt.plotting.canvas import (
    BLUE,
    GREY,
    ORANGE,
    PLOT_UNITS,
    RED,
    STYLE,
    axes_grid,
    axis_label,
    legend_above,
    note_omissions,
)
from pneuopt.plotting.tolerances import MAX_PANELS, MAX_PLOT_CHANNELS, NORMAL_QUANTILE_95, SHOWN_LIMIT_SHARE
from pneuopt.quantities.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_experiment(design: ExperimentDesign) -> "Figure":
    """The excitation, the signals with limits as the estimates predict them, and the intervals before and after.

    Returns
    -------
    Figure
        A panel the excitation, and one each signal that has a limit; several runs follow one another. Then half the
        95 % interval of each free parameter, over its value: before, where logs are in hand, and after.
    """
    signals = [n for n in dict.fromkeys((design.channel, *design.limits)) if n in design.runs[0]][:MAX_PLOT_CHANNELS]
    heights = [1.3] * len(signals) + [0.6 + STYLE.parameter_height * len(design.table)]
    figure, grid = axes_grid(len(heights), 1, heights, width=8.0)
    *panels, last = (row[0] for row in grid)
    for panel, name in zip(panels, signals, strict=True):
        _draw_signal(panel, design, name)
        if panel is not panels[-1]:
            panel.sharex(panels[-1])
            panel.tick_params(labelbottom=False)
    panels[-1].set_xlabel("time [s], one run after the other" if len(design.runs) > 1 else "time [s]")
    _draw_intervals(last, design)
    legend_above(figure, panels[0], last)
    figure.align_ylabels(panels)
    return figure


def _draw_signal(panel: "Axes", design: ExperimentDesign, name: str) -> None:
    """A signal over all runs, with those of its limits that it comes near."""
    factor, unit = PLOT_UNITS.get(design.units[name], (1.0, design.units[name]))
    begin, lowest, highest = 0.0, np.inf, -np.inf
    for run in design.runs:
        values = factor * run[name]
        colour = ORANGE if name == design.channel else BLUE
        label = ("what is played" if name == design.channel else None) if begin == 0 else None
        panel.plot(begin + run.t, values, color=colour, lw=0.8, label=label)
        if begin:
            panel.axvline(begin, color=GREY, lw=0.8)
        begin += float(run.t[-1] + run.t[1])
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
    room = SHOWN_LIMIT_SHARE * (highest - lowest)
    for end in design.limits.get(name, ()):
        if lowest - room <= factor * end <= highest + room:
            panel.axhline(factor * end, color=RED, ls="--", lw=0.8)
    panel.set_ylabel(axis_label(name.replace("_", "\n"), unit))


def _draw_intervals(panel: "Axes", design: ExperimentDesign) -> None:
    """A line a parameter: half its interval before and after, in percent of its value."""
    from matplotlib import ticker

    ticks: Any = ticker  # its locators have no types
    table = design.table
    size = np.abs(table["value"].to_numpy(dtype=float))
    places = np.arange(len(table))

    def percent(column: str) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(100 * NORMAL_QUANTILE_95 * table[column].to_numpy(dtype=float) / size)

    before, after = percent("stderr_before"), percent("stderr_after")
    panel.hlines(places, after, before, color=GREY, lw=1)
    if np.isfinite(before).any():
        panel.plot(before, places, "o", color=GREY, ms=5, label="95 % now")
    panel.plot(after, places, "o", color=BLUE, ms=5, label="95 % with the planned log")
    panel.set_xscale("log")
    panel.xaxis.set_major_locator(ticks.LogLocator(subs=STYLE.decade_ticks, numticks=8))
    panel.xaxis.set_minor_locator(ticks.NullLocator())
    panel.xaxis.set_major_formatter(ticks.FuncFormatter(lambda value, _: f"{value:g}"))
    for place in places[size == 0]:
        panel.text(0.01, place, "its value is 0", transform=panel.get_yaxis_transform(), color=GREY, va="center")
    asked = table["target"].to_numpy(dtype=bool)
    names = [f"{n} (asked)" if wanted else str(n) for n, wanted in zip(table.index, asked, strict=True)]
    panel.set_yticks(places, names)
    panel.set_ylim(len(table) - 0.5, -0.5)
    panel.set_xlabel("half of the 95 % interval, of the value [%]")


def plot_tracking(tracking: Tracking) -> "Figure":
    """Estimates with their intervals over dates, their line with its band, and where a drift was first seen.

    Returns
    -------
    Figure
        A panel a parameter, those that drift first.
    """
    from matplotlib import dates

    library: Any = dates  # its locators have no types

    order = tracking.table.assign(calm=tracking.table["alarm"].isna()).sort_values(["calm", "p"]).index.tolist()
    shown = order[:MAX_PANELS]
    figure, grid = axes_grid(len(shown), 1, [2.2] * len(shown), sharex="col", width=8.0)
    for (panel,), name in zip(grid, shown, strict=True):
        history, row = tracking.history.loc[name], tracking.table.loc[name]
        value = history["value"].to_numpy(dtype=float)
        ends = [value - history["ci_low"].to_numpy(dtype=float), history["ci_high"].to_numpy(dtype=float) - value]
        panel.errorbar(history.index, value, yerr=ends, fmt="o", color=BLUE, ms=4, capsize=2, label="a log's, 95 %")
        panel.fill_between(
            history.index, history["line_low"], history["line_high"], color=ORANGE, alpha=0.25, label="its 95 % band"
        )
        panel.plot(history.index, history["line"], color=ORANGE, label="line through all")
        if pd.notna(row["alarm"]):
            panel.axvline(row["alarm"], color=RED, ls="--", label="drift seen")
        low, high = row["percent_a_week_low"], row["percent_a_week_high"]
        panel.set_title(f"{name}: {row['percent_a_week']:.2g} % a week ({low:.2g} to {high:.2g})", fontsize=10)
        panel.set_ylabel(axis_label("estimate", str(row["unit"])))
    last, locator = grid[-1][0], library.AutoDateLocator(maxticks=8)
    last.xaxis.set_major_locator(locator)
    last.xaxis.set_major_formatter(library.ConciseDateFormatter(locator))
    legend_above(figure, grid[0][0])
    note_omissions(figure, len(shown), len(order), "parameters")
    return figure
