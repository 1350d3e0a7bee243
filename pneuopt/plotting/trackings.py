"""Condition tracking: each log's estimates over their dates, the line through them, and the alarm."""

from typing import TYPE_CHECKING, Any

import pandas as pd

from pneuopt.identification.tracking import Tracking
from pneuopt.plotting.canvas import BLUE, ORANGE, RED, axes_grid, axis_label, legend_above, note_omissions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_PANELS = 6
"""Parameters that are drawn: more do not fit a page, and those with an alarm come first."""


def plot_tracking(found: Tracking) -> "Figure":
    """Estimates with their intervals over dates, their line with its band, and where a drift was first seen.

    Parameters
    ----------
    found : Tracking

    Returns
    -------
    Figure
        A panel a parameter, those that drift first.
    """
    from matplotlib import dates

    library: Any = dates  # its locators have no types

    order = found.table.assign(calm=found.table["alarm"].isna()).sort_values(["calm", "p"]).index.tolist()
    shown = order[:MAX_PANELS]
    figure, grid = axes_grid(len(shown), 1, [2.2] * len(shown), sharex="col", width=8.0)
    for (panel,), name in zip(grid, shown, strict=True):
        own, row = found.history.loc[name], found.table.loc[name]
        value = own["value"].to_numpy(dtype=float)
        ends = [value - own["ci_low"].to_numpy(dtype=float), own["ci_high"].to_numpy(dtype=float) - value]
        panel.errorbar(own.index, value, yerr=ends, fmt="o", color=BLUE, ms=4, capsize=2, label="a log's, 95 %")
        panel.fill_between(
            own.index, own["line_low"], own["line_high"], color=ORANGE, alpha=0.25, label="its 95 % band"
        )
        panel.plot(own.index, own["line"], color=ORANGE, label="line through all")
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
