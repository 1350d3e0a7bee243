"""Which tolerances matter: Sobol's indices, and a design's derivatives beside them, as bars, a panel a figure."""

from typing import TYPE_CHECKING

import numpy as np

from pneuopt.plotting.canvas import BLUE, GREY, MAX_PLOT_COLUMNS, ORANGE, axes_grid, legend_above, note_omissions
from pneuopt.quantities.arrays import Array
from pneuopt.studies.local_sensitivity import LocalSensitivity
from pneuopt.studies.sensitivity import Sensitivity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INCHES_AN_AXIS = 0.42
"""Height of an axis' two bars [inch]: less and their names touch, more and ten axes do not fit a page."""


def plot_sensitivity(found: Sensitivity, local: LocalSensitivity | None = None) -> "Figure":
    """Total and first index of each axis with their 95 % intervals; the axis that matters most stands on top.

    Parameters
    ----------
    found : Sensitivity
    local : LocalSensitivity, optional
        Of a design on the same axes: its shares are a third bar, which agrees with an axis' share by itself where the
        figure is linear over the whole box.

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
    bars = 2 if local is None else 3
    height, thick = INCHES_AN_AXIS * bars / 2, 0.74 / bars
    picture, (row,) = axes_grid(1, len(shown), [0.8 + height * len(order)], width=width)
    places = np.arange(len(order)) - thick * (bars - 1) / 2
    for panel, figure in zip(row, shown, strict=True):
        own = table.loc[figure].loc[order]
        for k, index, colour, label in (
            (0, "total", BLUE, "with what it does by way of others"),
            (1, "first", GREY, "by itself"),
        ):
            value, low, high = (own[f"{index}{end}"].to_numpy(dtype=float) for end in ("", "_low", "_high"))
            spread = np.nan_to_num(np.abs([value - low, high - value]))
            panel.barh(
                places + k * thick, value, 0.95 * thick, xerr=spread, color=colour, label=label, ecolor="k", capsize=2
            )
        if local is not None:
            shares = _local_shares(local, str(figure), order)
            panel.barh(places + 2 * thick, shares, 0.95 * thick, color=ORANGE, label="by its slope at the design")
        panel.set_yticks(np.arange(len(order)), order if panel is row[0] else [""] * len(order))
        panel.set_xlim(0.0, max(1.0, panel.get_xlim()[1]))  # one scale, so that panels compare, and a constant's is 0
        panel.set_title(str(figure), fontsize=10)
        panel.set_xlabel("share of its variance [1]")
        panel.invert_yaxis()
    legend_above(picture, row[0])
    note_omissions(picture, len(shown), len(figures), "figures")
    return picture


def _local_shares(local: LocalSensitivity, figure: str, axes: list[str]) -> Array:
    """Shares of a figure by axis; none where the design has no such figure, or no such axis."""
    rows = [local.table["share"].get((figure, axis), np.nan) for axis in axes]
    return np.asarray(np.nan_to_num(np.array(rows, dtype=float)))
