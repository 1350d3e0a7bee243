"""Which tolerances matter: Sobol's indices as bars with the error of the sampling, a panel a figure."""

from typing import TYPE_CHECKING

import numpy as np

from pneuopt.plotting.canvas import BLUE, GREY, MAX_PLOT_COLUMNS, axes_grid, legend_above, note_omissions
from pneuopt.studies.sensitivity import Sensitivity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INCHES_AN_AXIS = 0.42
"""Height of an axis' two bars [inch]: less and their names touch, more and ten axes do not fit a page."""


def plot_sensitivity(found: Sensitivity) -> "Figure":
    """Total and first index of each axis with their 95 % intervals; the axis that matters most stands on top.

    Parameters
    ----------
    found : Sensitivity

    Returns
    -------
    Figure
        Of the first three figures that were told about; it says if there are more.
    """
    figures = list(found.figures.index)
    shown = figures[:MAX_PLOT_COLUMNS]
    table = found.table
    order = table["total"].groupby(level="axis").max().sort_values(ascending=False).index.tolist()
    width = 2.2 + 2.6 * len(shown)
    picture, (row,) = axes_grid(1, len(shown), [0.8 + INCHES_AN_AXIS * len(order)], width=width)
    places = np.arange(len(order))
    for panel, figure in zip(row, shown, strict=True):
        own = table.loc[figure].loc[order]
        for shift, index, colour, label in (
            (-0.19, "total", BLUE, "with what it does by way of others"),
            (0.19, "first", GREY, "by itself"),
        ):
            value, low, high = (own[f"{index}{end}"].to_numpy(dtype=float) for end in ("", "_low", "_high"))
            spread = np.nan_to_num(np.abs([value - low, high - value]))
            panel.barh(places + shift, value, 0.36, xerr=spread, color=colour, label=label, ecolor="k", capsize=2)
        panel.set_yticks(places, order if panel is row[0] else [""] * len(order))
        panel.set_xlim(0.0, max(1.0, panel.get_xlim()[1]))  # one scale, so that panels compare, and a constant's is 0
        panel.set_title(str(figure), fontsize=10)
        panel.set_xlabel("share of its variance [1]")
        panel.invert_yaxis()
    legend_above(picture, row[0])
    note_omissions(picture, len(shown), len(figures), "figures")
    return picture
