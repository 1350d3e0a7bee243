"""How the metrics of a study are distributed over its cases: of samples, corners or a table, which have no map."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.requirements import METRICS, larger_is_better
from pneuopt.plotting.canvas import BLUE, GREY, MAX_PLOT_COLUMNS, axes_grid, axis_label, note_omissions
from pneuopt.quantities.errors import check_names, require

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKED_SHARE = 0.95
"""Share of the cases whose bound is marked [1]: a larger one hangs on the last few of a hundred samples."""


def plot_distribution(table: "pd.DataFrame", metrics: Mapping[str, str]) -> "Figure":
    """The share of the cases that keep a bound over the bound, a panel a metric; the bound that 95 % keep is marked.

    A case that failed, or has no figure, keeps no bound: the curve ends below 1.

    Parameters
    ----------
    table : DataFrame
        As of `sweep` or `evaluate_batch`: a row a case, a column a metric, and "error".
    metrics : mapping of str to str
        Up to three columns, and their units.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If there is no metric, or one is not in the table.
    """
    require(len(metrics) > 0, "no metric to draw")
    check_names("column", [*metrics, "error"], [str(c) for c in table])
    shown = dict(list(metrics.items())[:MAX_PLOT_COLUMNS])
    figure, (row,) = axes_grid(1, len(shown), [3.2], width=min(10.0, 1.5 + 3.6 * len(shown)))
    for panel, (metric, unit) in zip(row, shown.items(), strict=True):
        _draw_shares(panel, table, metric)
        panel.set_xlabel(axis_label(metric, unit))
        panel.set_ylim(0.0, 1.02)
    row[0].set_ylabel(f"share of the {len(table)} cases [1]")
    note_omissions(figure, len(shown), len(metrics), "metrics")
    return figure


def _draw_shares(panel: "Axes", table: "pd.DataFrame", metric: str) -> None:
    known = table.loc[(table["error"] == "") & table[metric].notna(), metric].to_numpy(dtype=float)
    values = np.sort(known[np.isfinite(known)])
    at_least = metric in METRICS and larger_is_better(metric)
    values = values[::-1] if at_least else values
    shares = np.arange(1, len(values) + 1) / len(table)
    without = len(table) - len(values)
    panel.set_title(f"{without} without a figure" if without else "", fontsize=10)
    if not len(values):
        return
    panel.step([values[0], *values], [0.0, *shares], where="post", color=BLUE)
    k = int(np.searchsorted(shares, MARKED_SHARE - 1e-9))
    if k < len(values):
        panel.plot([values[k]] * 2, [0.0, shares[k]], color=GREY, linestyle="--")
        side = "at least" if at_least else "at most"
        label = f"{100 * MARKED_SHARE:g} % {side} {values[k]:.4g}"
        panel.annotate(label, (values[k], 0.03), xytext=(-3, 0), textcoords="offset points", ha="right", fontsize=8)
