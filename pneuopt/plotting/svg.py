"""`to_svg`: a figure as an SVG element that stands within a page of HTML, the same letters for the same figure."""

import io
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.plotting.texts import mend_texts, replace_unprintable

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

MAX_VECTOR_MARKERS = 400
"""Markers of a cloud that are drawn as vectors: of more an image is made, as they would fill megabytes."""
RASTER_DPI = 200
"""Resolution of clouds that become an image [1/inch]: lower blurs in print, higher makes the page large."""
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
    from matplotlib.text import Text

    mend_texts(figure)
    texts = [artist for artist in figure.findobj(Text) if isinstance(artist, Text)]
    for artist in figure.findobj(_is_large_cloud):
        artist.set_rasterized(True)
    formulas = any(text.get_parse_math() and text.get_text().count("$") > 1 for text in texts)
    content = io.BytesIO()
    with rc_context({"svg.hashsalt": HASH_SALT, "svg.fonttype": "path" if formulas else "none"}):
        figure.savefig(
            content, format="svg", transparent=True, dpi=RASTER_DPI, metadata={"Date": None, "Creator": None}
        )
    return _as_element(content.getvalue(), name, alt)


def _is_large_cloud(artist: "Artist") -> bool:
    from matplotlib.collections import PathCollection
    from matplotlib.lines import Line2D

    if isinstance(artist, Line2D):
        return (
            artist.get_marker() not in ("", " ", "None", "none", None)
            and np.size(artist.get_xdata()) > MAX_VECTOR_MARKERS
        )
    return isinstance(artist, PathCollection) and len(np.asarray(artist.get_offsets())) > MAX_VECTOR_MARKERS


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
        element.attrib = {key.rpartition("}")[2]: _mend_value(key, v, name) for key, v in element.attrib.items()}
        element.attrib |= {"id": f"{name}-{own}"} if own in used else {}
    width = float(root.attrib.pop("width").removesuffix("pt"))
    for key in ("height", "version"):
        root.attrib.pop(key, None)
    root.attrib |= {"role": "img", "aria-label": replace_unprintable(alt), "style": f"max-width:{width:.0f}pt"}
    return ET.tostring(root, encoding="unicode")


def _mend_value(key: str, value: str, name: str) -> str:
    """An attribute with its marks renamed, and coordinates to a hundredth of a point, which no printer shows."""
    if key == "d":
        return " ".join(_LONG_NUMBER.sub(lambda found: f"{float(found[0]):.2f}", value).split())
    if key == "style" or key.endswith("href") or key == "clip-path":
        return _REFERENCE.sub(rf"\1{name}-\2", value)
    return value
