"""Pareto fronts: one requirement over another, a point a certified design."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pneuopt.plotting.canvas import BLUE, RED, axes_grid, axis_label, legend_above
from pneuopt.quantities.errors import check_names, require

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def plot_front(table: "pd.DataFrame", requirements: Mapping[str, str]) -> "Figure":
    """The first requirement over the second; limits at which no design was certified are marked.

    Parameters
    ----------
    table : DataFrame
        Of `pareto_front`.
    requirements : mapping of str to str
        Its two requirements, the first one first, and their units.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        If these are not two columns of the table.
    """
    require(len(requirements) == 2, f"a front has two requirements, got {', '.join(requirements) or 'none'}")
    check_names("column", [*requirements, "limit", "error"], [str(c) for c in table])
    (first, up), (second, along) = requirements.items()
    figure, ((axes,),) = axes_grid(1, 1, (3.4,), width=6.5)
    axes.plot(table[second].to_numpy(), table[first].to_numpy(), "o-", color=BLUE, ms=5, label="certified designs")
    failed = table.loc[table["error"] != "", "limit"].dropna()
    for k, limit in enumerate(failed):
        axes.axvline(float(limit), color=RED, lw=1.0, ls=":", label=None if k else "no design certified")
    axes.set(xlabel=axis_label(second, along), ylabel=axis_label(first, up))
    legend_above(figure, axes)
    return figure
