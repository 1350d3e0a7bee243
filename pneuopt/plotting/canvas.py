"""What every figure shares: axes, colours, a legend outside, and the way to a file."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting.texts import mend_texts
from pneuopt.quantities.errors import require
from pneuopt.quantities.output import write_bytes
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Figure  # noqa: PLC0414 - rooms above name the type, and no more of matplotlib

FIGURE_SUFFIXES = ("png", "pdf", "svg")
GREY, BLUE, ORANGE, RED = "0.55", "#1f6fb2", "#e07b00", "#c0392b"
PLOT_UNITS = {"m": (1e3, "mm"), "Pa(a)": (1e-5, "bar(a)")}
"""SI units that would give an axis many zeros, with the factor and the unit that are drawn in their place."""
MAX_PLOT_COLUMNS = 3
"""Columns of axes beside each other: more cannot be read at 1000 pixels, fewer leave logs out."""
MAX_PLOT_POINTS = 4000
"""Points of a measured line or cloud: more make a vector figure slow to open, fewer hide short events."""
NORMAL_QUANTILE_95 = 1.96
"""Half width of a band that holds 95 % of a normal distribution [standard deviations]."""


def save_figure(figure: "Figure", path: str | Path, *, dpi: int = 150) -> None:
    """Write a figure whole or not at all, in the format of the file's suffix.

    Parameters
    ----------
    figure : Figure
    path : str or Path
        Ends in .png, .pdf or .svg.
    dpi : int
        Pixels an inch of a .png.

    Raises
    ------
    InputError
        If the suffix is another one, or the file cannot be written.
    """
    check_figure_path(path)
    mend_texts(figure)
    content = io.BytesIO()
    figure.savefig(content, format=Path(path).suffix.lower().removeprefix("."), dpi=dpi)
    write_bytes(path, content.getvalue())


def check_figure_path(path: str | Path) -> None:
    """Raise `InputError` unless a figure can be written in the format of the file's suffix."""
    suffix = Path(path).suffix.lower().removeprefix(".")
    require(
        suffix in FIGURE_SUFFIXES,
        f"{path}: a figure is written as {', '.join('.' + s for s in FIGURE_SUFFIXES)}; name it so",
    )


def common_channels(runs: Sequence[Trajectory], experiments: Sequence[Experiment]) -> list[str]:
    """Channels that a log and its run both have, the usual ones first."""
    both = dict.fromkeys(n for run, e in zip(runs, experiments, strict=True) for n in run if n in e.trajectory)
    return [*(n for n in CHANNELS if n in both), *(n for n in both if n not in CHANNELS)]


def plot_unit(experiments: Sequence[Experiment], channel: str) -> tuple[float, str]:
    """By what a channel's SI values are multiplied in a figure, and the unit that its axis shows."""
    unit = next((unit for e in experiments if (unit := e.unit(channel))), "")
    return PLOT_UNITS.get(unit, (1.0, unit))


def axes_grid(
    rows: int, columns: int, heights: Sequence[float], *, sharex: Literal["col"] | bool = False, width: float = 10.0
) -> tuple["Figure", list[list["Axes"]]]:
    """A figure of `width` by the sum of `heights` [inch], and its axes, a list a row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 0.9 + sum(heights)), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=sharex, squeeze=False, height_ratios=heights)
    for axes in grid.flat:
        axes.grid(True, alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, [list(row) for row in grid]


def axis_label(name: str, unit: str) -> str:
    """Name and unit of an axis, the name alone where there is no unit."""
    return name if unit in ("", "1") else f"{name} [{unit}]"


def legend_above(figure: "Figure", *sources: "Axes", columns: int = 4) -> None:
    """Put one legend for all axes outside of them, where it hides nothing."""
    from matplotlib.lines import Line2D

    pairs = [pair for axes in sources for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    if not pairs:
        return
    handles, labels = zip(*pairs, strict=True)
    legend = figure.legend(handles, labels, loc="outside upper center", ncols=min(columns, len(labels)), frameon=False)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):  # a cloud's faint dots would not be seen
            handle.set(alpha=1.0, markersize=5)


def note_omissions(figure: "Figure", shown: int, available: int, what: str) -> None:
    """Write in the corner how many of the available items a figure shows, where it leaves some out."""
    if shown < available:
        figure.text(0.995, 0.005, f"{shown} of {available} {what}", ha="right", fontsize=8, color=GREY)


def finish_columns(figure: "Figure", grid: Sequence[Sequence["Axes"]], available: int, what: str) -> "Figure":
    """Label the first column's axes only, put the legend above, note the columns left out; returns the figure."""
    for row in grid:
        for axes in row[1:]:
            axes.set_ylabel("")
    legend_above(figure, grid[0][0])
    note_omissions(figure, len(grid[0]), available, what)
    return figure
