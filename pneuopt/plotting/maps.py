"""Studies: metrics over one axis as lines, over two as maps of equal cells."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.plotting.canvas import BLUE, MAX_PLOT_COLUMNS, RED, axes_grid, axis_label, note_omissions
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.studies.outcome import INTERRUPTED_CASE

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

MAX_NUMBERED_CELLS = 12
"""Cells along an axis up to which each has room for its number; with more, numbers overlap."""
LABELS_PER_LONG_AXIS = 6
"""Labels along an axis of more cells than that: more overlap, fewer are hard to read between."""
COLOUR_MAP = "viridis_r"


def plot_map(table: "pd.DataFrame", axes: Mapping[str, str], metrics: Mapping[str, str]) -> "Figure":
    """Metrics of a study over its axes: lines over one, maps over two, a cell a case; what failed is marked.

    Parameters
    ----------
    table : DataFrame
        As of `sweep` over a `grid`: a column an axis and a metric, and "error".
    axes : mapping of str to str
        One or two columns, and the unit in which they are: the first runs to the right, the second up.
    metrics : mapping of str to str
        Up to three columns, and their units.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If there are more axes, or a column is not in the table.
    """
    require(len(axes) in (1, 2), f"a study is drawn over one or two axes, this has {len(axes)}: {', '.join(axes)}")
    require(len(metrics) > 0, "no metric to draw")
    check_names("column", [*axes, *metrics, "error"], [str(c) for c in table])
    shown = dict(list(metrics.items())[:MAX_PLOT_COLUMNS])
    width = min(10.0, 1.5 + 4.0 * len(shown))
    figure, (row,) = axes_grid(1, len(shown), [3.4], width=width)
    labels = [axis_label(name, unit) for name, unit in axes.items()]
    draw = _draw_lines if len(axes) == 1 else _draw_map
    for panel, (metric, unit) in zip(row, shown.items(), strict=True):
        draw(panel, table, axes, metric)
        panel.set_title(axis_label(metric, unit), fontsize=10)
        panel.set_xlabel(labels[0])
    if len(axes) == 2:
        row[0].set_ylabel(labels[1])
    note_omissions(figure, len(shown), len(metrics), "metrics")
    return figure


def _draw_lines(panel: "Axes", table: "pd.DataFrame", axes: Mapping[str, str], metric: str) -> None:
    (name,) = axes
    ordered = table.sort_values(name)
    x, y = (ordered[column].to_numpy(dtype=float) for column in (name, metric))
    panel.plot(x, y, "o-", color=BLUE, ms=5)
    missing = ~np.isfinite(y)
    for at, error in zip(x[missing], ordered["error"][missing], strict=True):
        panel.axvline(at, color=RED, lw=1.0, ls=":")
        panel.text(
            at,
            0.5,
            _failure_word(metric, error),
            transform=panel.get_xaxis_transform(),
            color=RED,
            rotation=90,
            ha="right",
            va="center",
        )


def _draw_map(panel: "Axes", table: "pd.DataFrame", axes: Mapping[str, str], metric: str) -> None:
    x, y = (np.unique(table[name].to_numpy(dtype=float)) for name in axes)
    values, errors = np.full((len(y), len(x)), np.nan), np.full((len(y), len(x)), "", dtype=object)
    place = [np.searchsorted(v, table[name].to_numpy(dtype=float)) for v, name in zip((x, y), axes, strict=True)]
    values[place[1], place[0]] = table[metric].to_numpy(dtype=float)
    errors[place[1], place[0]] = table["error"].to_numpy()
    panel.set_facecolor("0.92")
    mesh = panel.pcolormesh(np.ma.masked_invalid(values), cmap=COLOUR_MAP)
    panel.figure.colorbar(mesh, ax=panel, pad=0.02)
    panel.grid(False)
    for ticks, at in ((panel.set_xticks, x), (panel.set_yticks, y)):
        every = 1 if len(at) <= MAX_NUMBERED_CELLS else -(-len(at) // LABELS_PER_LONG_AXIS)
        ticks(np.arange(0, len(at), every) + 0.5, [f"{v:.3g}" for v in at[::every]])
    if max(len(x), len(y)) <= MAX_NUMBERED_CELLS:
        _number_cells(panel, mesh, values, errors, metric)


def _number_cells(panel: "Axes", mesh: "QuadMesh", values: Array, errors: NDArray[np.object_], metric: str) -> None:
    """Each cell's figure, or what became of it, in black or white as the cell is light or dark."""
    for (j, i), value in np.ndenumerate(values):
        known = bool(np.isfinite(value))
        text = f"{value:.3g}" if known else _failure_word(metric, str(errors[j, i]))
        red, green, blue, _ = mesh.to_rgba(np.array([value]))[0]
        light = 0.3 * red + 0.59 * green + 0.11 * blue > 0.5
        colour = RED if not known else "black" if light else "white"
        panel.text(i + 0.5, j + 0.5, text, ha="center", va="center", fontsize=8, color=colour)


def _failure_word(metric: str, error: str) -> str:
    if error:
        return "failed" if error != INTERRUPTED_CASE else error
    return "never" if metric == "SettlingTime" else "none"
