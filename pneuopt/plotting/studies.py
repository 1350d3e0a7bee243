"""Studies: metrics over one axis as lines, over two as maps; Pareto fronts; distributions over cases without axes.

Which tolerances matter is drawn as bars: Sobol's indices, and a design's derivatives beside them. Experiments are drawn
over time: a planned one, within its limits, and estimates tracked over the dates of their logs.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pneuopt.evaluation.requirements import METRICS, larger_is_better
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
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.studies.executors import INTERRUPTED_CASE
from pneuopt.studies.sensitivity import LocalSensitivity, Sensitivity

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
    require(
        0 < len(axes) <= STYLE.map_axes,
        f"a study is drawn over one or two axes, this has {len(axes)}: {', '.join(axes)}",
    )
    require(len(metrics) > 0, "no metric to draw")
    check_names("column", [*axes, *metrics, "error"], [str(c) for c in table])
    shown = dict(list(metrics.items())[: STYLE.columns])
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
        across, word = panel.get_xaxis_transform(), _failure_word(metric, error)
        panel.text(at, 0.5, word, transform=across, color=RED, rotation=90, ha="right", va="center")


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
        every = 1 if len(at) <= STYLE.numbered_cells else -(-len(at) // STYLE.labels_of_long_axis)
        ticks(np.arange(0, len(at), every) + 0.5, [f"{v:.3g}" for v in at[::every]])
    if max(len(x), len(y)) <= STYLE.numbered_cells:
        for (j, i), value in np.ndenumerate(values):
            finite = bool(np.isfinite(value))
            text = f"{value:.3g}" if finite else _failure_word(metric, str(errors[j, i]))
            red, green, blue, _ = mesh.to_rgba(np.array([value]))[0]
            light = 0.3 * red + 0.59 * green + 0.11 * blue > 0.5  # then black letters can be read, else white ones
            colour = RED if not finite else "black" if light else "white"
            panel.text(i + 0.5, j + 0.5, text, ha="center", va="center", fontsize=8, color=colour)


def _failure_word(metric: str, error: str) -> str:
    if error:
        return "failed" if error != INTERRUPTED_CASE else error
    return "never" if metric == "SettlingTime" else "none"


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
    shown = dict(list(metrics.items())[: STYLE.columns])
    figure, (row,) = axes_grid(1, len(shown), [3.2], width=min(10.0, 1.5 + 3.6 * len(shown)))
    for panel, (metric, unit) in zip(row, shown.items(), strict=True):
        figures = table.loc[(table["error"] == "") & table[metric].notna(), metric].to_numpy(dtype=float)
        values = np.sort(figures[np.isfinite(figures)])
        at_least = metric in METRICS and larger_is_better(metric)
        values = values[::-1] if at_least else values
        shares = np.arange(1, len(values) + 1) / len(table)
        without = len(table) - len(values)
        panel.set_title(f"{without} without a figure" if without else "", fontsize=10)
        panel.set_xlabel(axis_label(metric, unit))
        panel.set_ylim(0.0, 1.02)
        if len(values):
            panel.step([values[0], *values], [0.0, *shares], where="post", color=BLUE)
        k = int(np.searchsorted(shares, STYLE.marked_share - 1e-9))
        if k < len(values):
            panel.plot([values[k]] * 2, [0.0, shares[k]], color=GREY, linestyle="--")
            label = f"{100 * STYLE.marked_share:g} % {'at least' if at_least else 'at most'} {values[k]:.4g}"
            place = (values[k], 0.03)
            panel.annotate(label, place, xytext=(-3, 0), textcoords="offset points", ha="right", fontsize=8)
    row[0].set_ylabel(f"share of the {len(table)} cases [1]")
    note_omissions(figure, len(shown), len(metrics), "metrics")
    return figure


def plot_sensitivity(indices: Sensitivity, local: LocalSensitivity | None = None) -> "Figure":
    """Total and first index of each axis with their 95 % intervals; the axis that matters most stands on top.

    Parameters
    ----------
    indices : Sensitivity
        Of the figures to draw, a panel each.
    local : LocalSensitivity, optional
        Of a design on the same axes: its shares are a third bar, which agrees with an axis' share by itself where the
        figure is linear over the whole box.

    Returns
    -------
    Figure
        Of the first three figures that were told about; it says if there are more.
    """
    figures = list(indices.figures.index)
    shown = figures[: STYLE.columns]
    table = indices.table
    order = table["total"].groupby(level="axis").max().sort_values(ascending=False).index.tolist()
    width = 2.2 + 2.6 * len(shown)
    bars = 2 if local is None else 3
    height, thick = STYLE.bars_height * bars / 2, 0.74 / bars
    picture, (row,) = axes_grid(1, len(shown), [0.8 + height * len(order)], width=width)
    places = np.arange(len(order)) - thick * (bars - 1) / 2
    for panel, figure in zip(row, shown, strict=True):
        rows_of_figure = table.loc[figure].loc[order]
        for k, index, colour, label in (
            (0, "total", BLUE, "with what it does by way of others"),
            (1, "first", GREY, "by itself"),
        ):
            value, low, high = (rows_of_figure[f"{index}{end}"].to_numpy(dtype=float) for end in ("", "_low", "_high"))
            spread = np.nan_to_num(np.abs([value - low, high - value]))
            panel.barh(
                places + k * thick, value, 0.95 * thick, xerr=spread, color=colour, label=label, ecolor="k", capsize=2
            )
        if local is not None:
            # none where the design has no such figure, or no such axis
            rows = [local.table["share"].get((str(figure), axis), np.nan) for axis in order]
            shares = np.nan_to_num(np.array(rows, dtype=float))
            panel.barh(places + 2 * thick, shares, 0.95 * thick, color=ORANGE, label="by its slope at the design")
        panel.set_yticks(np.arange(len(order)), order if panel is row[0] else [""] * len(order))
        panel.set_xlim(0.0, max(1.0, panel.get_xlim()[1]))  # one scale, so that panels compare, and a constant's is 0
        panel.set_title(str(figure), fontsize=10)
        panel.set_xlabel("share of its variance [1]")
        panel.invert_yaxis()
    legend_above(picture, row[0])
    note_omissions(picture, len(shown), len(figures), "figures")
    return picture


def plot_experiment(design: ExperimentDesign) -> "Figure":
    """The excitation, the signals with limits as the estimates predict them, and the intervals before and after.

    Returns
    -------
    Figure
        A panel the excitation, and one each signal that has a limit; several runs follow one another. Then half the
        95 % interval of each free parameter, over its value: before, where logs are in hand, and after.
    """
    signals = [n for n in dict.fromkeys((design.channel, *design.limits)) if n in design.runs[0]][: STYLE.channels]
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
    room = STYLE.limit_share * (highest - lowest)
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
            return np.asarray(100 * STYLE.deviations_of_95_percent * table[column].to_numpy(dtype=float) / size)

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
    shown = order[: STYLE.panels]
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
