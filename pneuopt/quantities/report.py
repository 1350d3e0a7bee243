"""Sentences and tables, as text of any width and as HTML; results, notebooks and the shell show the same one.

No line breaks inside a word or a number. A table that is too wide breaks its cells between words, or has each row's
name on a line of its own, and where that is not enough it goes on below, with its first column again.
"""

import html
import math
import re
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import zip_longest

USUAL_WIDTH = 80
"""Columns of text where there is no terminal that says how wide it is."""
TIED = "\u00a0"
"""A blank at which no line ends, as between a relation and its number; text shows a blank."""
GUTTER, _INDENT = "  ", "    "
_HTML_COLOURS = {"GOOD": "color:#1a7f37", "DOUBTFUL": "color:#9a6700", "BAD": "color:#cf222e"}


class Tone(Enum):
    """How a line is to be taken; a terminal and a notebook show it by colour and weight."""

    PLAIN = "plain"
    HEADING = "heading"
    GOOD = "good"
    DOUBTFUL = "doubtful"
    BAD = "bad"


@dataclass(frozen=True)
class Line:
    """A sentence, or a verdict."""

    text: str
    tone: Tone = Tone.PLAIN
    indent: int = 0  # blanks before it; where it goes on in a second line, two more


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    heading: str  # it may have lines of its own
    is_text: bool = False  # its cells stand left; numbers stand right


@dataclass(frozen=True)
class Table:
    """Rows of cells, the first of which names its row."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Report:
    """Sentences and tables, one below the other.

    Parameters
    ----------
    parts : tuple of Line or Table

    Examples
    --------
    >>> columns = (*text_columns("parameter"), *number_columns("value"))
    >>> table = Table(columns, (("load.mass", "5"), ("load.force", "12.5")))
    >>> for line in Report((Line("converged"), table)).to_text(40).splitlines():
    ...     print(line.rstrip())
    converged
    <BLANKLINE>
    parameter   value
    ─────────────────
    load.mass       5
    load.force   12.5
    """

    parts: tuple[Line | Table, ...] = ()

    def __add__(self, other: "Report") -> "Report":
        return Report((*self.parts, *other.parts))

    def __bool__(self) -> bool:
        return bool(self.parts)

    def __repr__(self) -> str:
        return self.to_text()

    def _repr_html_(self) -> str:
        return self.to_html()

    def lines(self, width: int | None = USUAL_WIDTH, *, sentences: int | None = None) -> Iterator[tuple[str, Tone]]:
        """Each line of text with its tone.

        Parameters
        ----------
        width : int or None
            Columns at most, but for words that are longer; None: as wide as it is.
        sentences : int, optional
            Columns of sentences, where they differ: 0 leaves each in one piece, as a program reads it.
        """
        for part in self.parts:
            if isinstance(part, Line):
                own = width if sentences is None else sentences
                text = " " * part.indent + part.text
                wrapped = wrap_words(text, own, " " * (part.indent + 2)) if own else [text]
                yield from ((_plain(line), part.tone) for line in wrapped)
            else:
                yield "", Tone.PLAIN
                yield from _table_lines(part, width)
                yield "", Tone.PLAIN

    def to_text(self, width: int | None = None) -> str:
        """The text in so many columns; by default those of the terminal, or 80 where there is none."""
        columns = shutil.get_terminal_size((USUAL_WIDTH, 24)).columns if width is None else width
        return "\n".join(text for text, _ in self.lines(columns))

    def to_html(self) -> str:
        """A fragment of HTML, as a notebook shows it."""
        parts = []
        for part in self.parts:
            if isinstance(part, Line):
                weight = "" if part.tone is Tone.PLAIN else f"font-weight:bold;{_HTML_COLOURS.get(part.tone.name, '')}"
                parts.append(f'<p style="margin:0 0 0 {part.indent}ch;{weight}">{html.escape(part.text)}</p>')
                continue
            head = "".join(_cell_to_html("th", c.heading, c) for c in part.columns)
            rows = (zip(row, part.columns, strict=True) for row in part.rows)
            body = "".join(f"<tr>{''.join(_cell_to_html('td', t, c) for t, c in row)}</tr>" for row in rows)
            parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
        return f"<div>{''.join(parts)}</div>"


def text_columns(*headings: str) -> tuple[Column, ...]:
    """Columns of text."""
    return tuple(Column(heading, is_text=True) for heading in headings)


def number_columns(*headings: str) -> tuple[Column, ...]:
    """Columns of numbers."""
    return tuple(Column(heading) for heading in headings)


def report_verdict(text: str, tone: Tone) -> Report:
    """A verdict in its first line, and a reason in each further line."""
    head, *reasons = text.splitlines()
    return Report((Line(head, tone), *(Line(reason.strip(), indent=2) for reason in reasons)))


def format_number(value: float, digits: int) -> str:
    """A number for a table, "-" where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}g}"


def wrap_words(text: str, width: int, indent: str = "") -> list[str]:
    """Lines that end between words; a word that is longer than the width has a line of its own."""
    lines = textwrap.wrap(text, max(width, 1), subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


def _table_lines(table: Table, width: int | None) -> Iterator[tuple[str, Tone]]:
    """The table as it is, or in the way that takes the fewest lines: with broken cells, or each name on its own line.

    Where neither is narrow enough it goes on below, with its first column again.
    """
    whole = _natural_widths(table)
    if width is None or _total(whole) <= width:
        yield from _beside_lines(table, whole)
        return
    apart = _select_columns(table, range(1, len(table.columns)))
    beside, below = _narrow(table, width), _narrow(apart, width - len(_INDENT))
    if beside is not None and (below is None or _height(table, beside) <= _height(apart, below) + len(table.rows)):
        yield from _beside_lines(table, beside)
    elif below is not None:
        heading = table.columns[0].heading.replace("\n", " ")
        yield from ((_plain(text), Tone.HEADING) for text in wrap_words(heading, width))
        yield from ((_INDENT + text, Tone.HEADING) for text in _heading_lines(apart, below))
        yield "─" * (len(_INDENT) + _total(below)), Tone.PLAIN
        for named, row in zip(table.rows, apart.rows, strict=True):
            yield from ((_plain(text), Tone.PLAIN) for text in wrap_words(named[0], width))
            yield from ((_INDENT + text, Tone.PLAIN) for text in _row_lines(apart, row, below))
    else:
        least = _least_widths(table)
        panels: list[list[int]] = [[0]]
        for k in range(1, len(least)):
            if len(panels[-1]) > 1 and _total([least[i] for i in (*panels[-1], k)]) > width:
                panels.append([0])
            panels[-1].append(k)
        for number, chosen in enumerate(panels):
            if number:
                yield "", Tone.PLAIN
            panel = _select_columns(table, chosen)
            yield from _beside_lines(panel, _narrow(panel, width) or _least_widths(panel))


def _beside_lines(table: Table, widths: Sequence[int]) -> Iterator[tuple[str, Tone]]:
    yield from ((text, Tone.HEADING) for text in _heading_lines(table, widths))
    yield "─" * _total(widths), Tone.PLAIN
    for row in table.rows:
        yield from ((text, Tone.PLAIN) for text in _row_lines(table, row, widths))


def _select_columns(table: Table, chosen: Sequence[int]) -> Table:
    rows = tuple(tuple(row[k] for k in chosen) for row in table.rows)
    return Table(tuple(table.columns[k] for k in chosen), rows)


def _narrow(table: Table, width: int) -> list[int] | None:
    """Widths of columns that fit, by breaking the cells first that cost the fewest lines; None: there are none."""
    widths, least = _natural_widths(table), _least_widths(table)
    if not widths or _total(least) > width:
        return None
    while _total(widths) > width:
        tried = []  # the widths with one column narrower by the least that is possible
        for k in (k for k in range(len(widths)) if widths[k] > least[k]):
            texts = (line for cell in _column_texts(table, k) for line in cell.split("\n"))
            own = max(len(line) for text in texts for line in wrap_words(text, widths[k] - 1))
            tried.append([*widths[:k], own, *widths[k + 1 :]])
        lines, before = _height(table, widths), _total(widths)
        widths = min(tried, key=lambda w: (_height(table, w) - lines) / (before - _total(w)))
    return widths


def _height(table: Table, widths: Sequence[int]) -> int:
    """The number of lines of a table."""
    heads = (
        sum(len(wrap_words(line, w)) for line in c.heading.split("\n"))
        for c, w in zip(table.columns, widths, strict=True)
    )
    rows = (max(len(wrap_words(cell, w)) for cell, w in zip(row, widths, strict=True)) for row in table.rows)
    return max(heads) + sum(rows)


def _heading_lines(table: Table, widths: Sequence[int]) -> Iterator[str]:
    cells = [
        [text for line in column.heading.split("\n") for text in wrap_words(line, w)]
        for column, w in zip(table.columns, widths, strict=True)
    ]
    height = max(map(len, cells))
    yield from _align(table, [[""] * (height - len(own)) + own for own in cells], widths)


def _row_lines(table: Table, row: Sequence[str], widths: Sequence[int]) -> Iterator[str]:
    yield from _align(table, [wrap_words(cell, w) for cell, w in zip(row, widths, strict=True)], widths)


def _align(table: Table, cells: Sequence[Sequence[str]], widths: Sequence[int]) -> Iterator[str]:
    """The lines of a row of cells that have one or several lines each."""
    for texts in zip_longest(*cells, fillvalue=""):
        aligned = zip(texts, table.columns, widths, strict=True)
        parts = (text.ljust(w) if column.is_text else text.rjust(w) for text, column, w in aligned)
        yield _plain(GUTTER.join(parts).rstrip())


def _natural_widths(table: Table) -> list[int]:
    every = range(len(table.columns))
    return [max(len(text) for cell in _column_texts(table, k) for text in cell.split("\n")) for k in every]


def _least_widths(table: Table) -> list[int]:
    """The longest word of each column."""
    every = range(len(table.columns))
    words = ([word for cell in _column_texts(table, k) for word in re.split("[ \n]", cell)] for k in every)
    return [max(map(len, own), default=0) for own in words]


def _column_texts(table: Table, k: int) -> list[str]:
    return [table.columns[k].heading, *(row[k] for row in table.rows)]


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + len(GUTTER) * (len(widths) - 1)


def _plain(text: str) -> str:
    return text.replace(TIED, " ")


def _cell_to_html(tag: str, text: str, column: Column) -> str:
    side = "left" if column.is_text else "right"
    return f'<{tag} style="text-align:{side}">{html.escape(text).replace(chr(10), "<br>")}</{tag}>'
