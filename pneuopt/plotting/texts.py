"""`mend_texts`: names from files and logs in figures, drawn as they are, whatever their letters mean to matplotlib."""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text

_UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def mend_texts(figure: "Figure") -> None:
    """Replace letters that no file of a figure can hold, and read no formula in what is none."""
    from matplotlib.text import Text

    for artist in figure.findobj(Text):
        if isinstance(artist, Text):
            _mend_text(artist)


def replace_unprintable(text: str) -> str:
    """A text with a replacement character for each letter that neither XML nor UTF-8 can hold."""
    return _UNPRINTABLE.sub("\ufffd", text)


def _mend_text(text: "Text") -> None:
    """Take names from files as they are: replace what XML cannot hold, and read no formula in what is none."""
    from matplotlib.mathtext import MathTextParser

    words = replace_unprintable(text.get_text())
    text.set_text(words)
    if words.count("$") > 1 and text.get_parse_math():
        try:
            for line in words.split("\n"):
                MathTextParser("path").parse(line)
        except ValueError:
            text.set_parse_math(False)
