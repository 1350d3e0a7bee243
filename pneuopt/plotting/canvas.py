"""What every figure shares: colours, sizes (`STYLE`), axes, a legend outside, and the way to a file or a page.

Names from files and logs are drawn as they are, whatever their letters mean to matplotlib (`mend_texts`). `to_svg`
gives an SVG element that stands within a page of HTML, the same letters for the same figure.
"""

import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.errors import require
from pneuopt.quantities.output import write_bytes
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Figure  # noqa: PLC0414 - cli and report name it from here


FIGURE_SUFFIXES = ("png", "pdf", "svg")
GREY, BLUE, ORANGE, RED = "0.55", "#1f6fb2", "#e07b00", "#c0392b"
PLOT_UNITS = {"m": (1e3, "mm"), "Pa(a)": (1e-5, "bar(a)")}
"""SI units that would give an axis many zeros, with the factor and the unit that are drawn in their place."""


@dataclass(frozen=True)
class Style:
    """What figures show, and sizes in them: lengths in inches on paper, texts in points."""

    columns: int = 3  # of axes beside each other: more cannot be read at 1000 pixels, fewer leave logs out
    channels: int = 4  # below each other: more cannot be read, fewer leave channels out
    panels: int = 6  # parameters that are drawn: more do not fit a page, and those with an alarm come first
    map_axes: int = 2  # axes up to which a study has a map: of more no figure can be read
    numbered_cells: int = 12  # along an axis up to which each has room for its number; with more, numbers overlap
    points: int = 4000  # of a measured line or cloud: more make a vector figure slow to open, fewer hide short events
    vector_markers: int = 400  # of a cloud drawn as vectors: more would fill megabytes, so that an image is made
    correlation_lag: int = 40  # largest lag of a correlation [samples]: more crowd the axis, fewer hide slow dynamics
    deviations_of_95_percent: float = 1.96  # half width of a band that holds 95 % of a normal distribution
    slope_samples: int = 20  # of a local derivative: fewer leave noise, more round off fast motion
    zoom_share: float = 0.6  # of a log [1] from which it is drawn once, not whole and enlarged
    least_sensitivity: float = 0.03  # that is drawn [1]: lower flattens the peak, higher cuts the slope off
    limit_share: float = 0.35  # of a panel's range [1] within which a limit is drawn: a farther one squeezes the signal
    marked_share: float = 0.95  # of the cases, whose bound is marked: a larger one hangs on the last few of 100
    raster_dpi: int = 200  # of clouds that become an image [1/inch]: lower blurs in print, higher makes the page large
    title_letters: int = 118  # a line of a title at 10 inches
    label_letters: int = 24  # a line of a label beside an axis
    labels_of_long_axis: int = 6  # where cells are too many to have a label each
    parameter_height: float = 0.24  # of a parameter's line: less and their names touch
    bars_height: float = 0.42  # of an axis' two bars
    decade_ticks: tuple[float, ...] = (1.0, 2.0, 5.0)  # numbers of each decade on a logarithmic axis
    # of the block diagram
    block_height: float = 0.62
    circle_radius: float = 0.12
    arrow_length: float = 0.3  # without a label
    block_text: float = 9.0
    small_text: float = 8.0  # beside an arrow or below a block
    letter_width: float = 0.064  # beside an arrow: with less, labels overlap; with more, arrows are long
    legend_letter_width: float = 0.055  # in running text: with less, lines run off the figure
    margin: float = 0.15
    source_height: float = 1.2  # of what is added, above the forward path
    sensor_height: float = -1.45
    wire_height: float = -1.15  # of the feedback without a sensor
    pid_width: float = 2.1
    source_width: float = 1.5
    small_width: float = 0.8
    plant_width: float = 1.7
    compensator_width: float = 1.15
    output_spacing: float = 0.32  # between the outputs of a plant: closer, their labels overlap
    frame: float = 0.12  # between the controller and the frame around it
    branch: float = 0.15  # from an arrow's begin to where it divides


STYLE = Style()


def save_figure(figure: "Figure", path: str | Path, *, dpi: int = 150) -> None:
    """Write a figure whole or not at all, in the format of the file's suffix.

    Parameters
    ----------
    figure : Figure
        Its texts are mended where no file can hold them.
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
    known = ", ".join(f".{s}" for s in FIGURE_SUFFIXES)
    require(suffix in FIGURE_SUFFIXES, f"{path}: a figure is written as {known}; name it so")


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


_UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def mend_texts(figure: "Figure") -> None:
    """Replace letters that no file of a figure can hold, and read no formula in what is none."""
    from matplotlib.mathtext import MathTextParser
    from matplotlib.text import Text

    for artist in figure.findobj(Text):
        assert isinstance(artist, Text)
        words = replace_unprintable(artist.get_text())
        artist.set_text(words)
        if words.count("$") > 1 and artist.get_parse_math():
            try:
                for line in words.split("\n"):
                    MathTextParser("path").parse(line)
            except ValueError:
                artist.set_parse_math(False)


def replace_unprintable(text: str) -> str:
    """A text with a replacement character for each letter that neither XML nor UTF-8 can hold."""
    return _UNPRINTABLE.sub("\ufffd", text)


HASH_SALT = "pneuopt"
"""What matplotlib mixes into the names of marks: without it they are random, and no two pages are the same."""
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_REFERENCE = re.compile(r"(^#|url\(#)([\w.-]+)")


def to_svg(figure: "Figure", name: str, alt: str) -> str:
    """An SVG element for a page: no date, no random name, no style that reaches beyond it, text that can be searched.

    Letters stay text, but for figures with formulas, whose letters become paths, as no reader need have their font.

    Parameters
    ----------
    figure : Figure
        Its clouds of many markers become images.
    name : str
        What marks of this figure begin with, so that no two figures of a page share one: "figure1".
    alt : str
        What the figure shows, for those who do not see it.

    Returns
    -------
    str
    """
    from matplotlib import rc_context
    from matplotlib.collections import PathCollection
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

    mend_texts(figure)
    texts = [artist for artist in figure.findobj(Text) if isinstance(artist, Text)]
    for artist in figure.findobj():
        size = 0
        if isinstance(artist, Line2D) and artist.get_marker() not in ("", " ", "None", "none", None):
            size = np.size(artist.get_xdata())
        elif isinstance(artist, PathCollection):
            size = len(np.asarray(artist.get_offsets()))
        if size > STYLE.vector_markers:
            artist.set_rasterized(True)
    formulas = any(text.get_parse_math() and text.get_text().count("$") > 1 for text in texts)
    content = io.BytesIO()
    with rc_context({"svg.hashsalt": HASH_SALT, "svg.fonttype": "path" if formulas else "none"}):
        figure.savefig(
            content, format="svg", transparent=True, dpi=STYLE.raster_dpi, metadata={"Date": None, "Creator": None}
        )
    return _as_element(content.getvalue(), name, alt)


def _as_element(document: bytes, name: str, alt: str) -> str:
    """The root element, without what only a file of its own needs, its marks renamed."""
    root = ET.fromstring(document)
    parents = [parent for parent in root.iter() if len(parent)]
    for parent in parents:
        for child in list(parent):
            if child.tag.rpartition("}")[2] in ("metadata", "style"):
                parent.remove(child)
    used = {
        mark for element in root.iter() for value in element.attrib.values() for _, mark in _REFERENCE.findall(value)
    }
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        own = element.attrib.pop("id", "")
        attributes = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
        for key, value in attributes.items():
            if key == "d":  # coordinates to a hundredth of a point, which no printer shows
                attributes[key] = " ".join(_LONG_NUMBER.sub(lambda found: f"{float(found[0]):.2f}", value).split())
            elif key in ("style", "href", "clip-path"):
                attributes[key] = _REFERENCE.sub(rf"\1{name}-\2", value)
        element.attrib = attributes | ({"id": f"{name}-{own}"} if own in used else {})
    width = float(root.attrib.pop("width").removesuffix("pt"))
    for key in ("height", "version"):
        root.attrib.pop(key, None)
    root.attrib |= {"role": "img", "aria-label": replace_unprintable(alt), "style": f"max-width:{width:.0f}pt"}
    return ET.tostring(root, encoding="unicode")
