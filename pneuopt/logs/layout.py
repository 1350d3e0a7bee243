"""Where a log's samples begin: the rows above them are metadata, one that names the columns, and one of their units."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from pneuopt.logs.stamps import is_stamp
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.units import is_unit

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?")
"""A number with a decimal point, or a whole one."""
MAX_HEAD_ROWS = 1000
"""Rows above the samples [1]: more take seconds to look through; data loggers write up to a few hundred."""
MIN_BLOCK_ROWS = 4
"""Rows above the names that begin with a number [1] and count as samples: fewer refuse metadata, more lose samples."""
TOA5 = "TOA5"
"""The first cell of the files of Campbell Scientific's loggers: names, units and processing in rows 2, 3 and 4."""

_COMMENT = re.compile(r"\s*(?:#|%|//|!)+\s*")
_BRACKETS = re.compile(r"\[\s*(.*?)\s*\]|\(\s*(.*?)\s*\)")


class Layout(NamedTuple):
    """How the rows of a log are to be read.

    Attributes
    ----------
    names : list of str
        Of the columns.
    units : dict of str to str
        By name, of those columns for which a row below the names says one.
    start : int
        Index of the first row of samples.
    remarks : tuple of str
        The rows that are skipped.
    """

    names: list[str]
    units: dict[str, str]
    start: int
    remarks: tuple[str, ...]


def find_layout(rows: Sequence[Sequence[str]], where: str, first_row: int = 1) -> Layout:
    """Find the names, the units and the first sample.

    The samples begin with the first row of the usual width whose first cell is a number or a time stamp. The nearest
    row above it without a number names the columns. Between them may stand a row of units, empty rows and comments.
    Where another row stands there, or none begins with a number, the samples begin below the first row that may be
    names: no row that may be a sample is skipped.

    Parameters
    ----------
    rows : sequence of sequence of str
        The cells of the file's rows, at least of its first ones.
    where : str
        The file, for messages.
    first_row : int
        The number that messages give to the first row.

    Raises
    ------
    LogError
        If no row names the columns, or there is no sample.
    """
    width = _usual_width(rows)
    first = next((i for i, row in enumerate(rows) if _is_sample(row, width)), None)
    head = _find_names(rows, len(rows) if first is None else first, width, first is None)
    if head is None:
        raise _missing_names(rows, first or 0, where, first_row)
    units_row = head + 1 if head + 1 < len(rows) and is_unit_row(rows[head + 1], len(rows[head])) else None
    below = head + 1 if units_row is None else head + 2
    between = rows[below:first]
    start = below if first is None or not all(_is_no_row(row) for row in between) else first
    require(start < len(rows), f"{where}: a header, but no samples", LogError)
    _check_blocks(rows[:head], where, first_row)
    names = _names(rows[head])
    units = {} if units_row is None else _units(names, rows[units_row])
    return Layout(names, units, start, _remarks(rows, head, units_row, first_row))


def toa5_layout(rows: Sequence[Sequence[str]]) -> Layout:
    """The layout of a file of Campbell Scientific's loggers."""
    names = _names(rows[1])
    return Layout(names, _units(names, rows[2]), 4, ("rows 1, 3 and 4 are read as the head of a TOA5 file",))


def has_table(rows: Sequence[Sequence[str]]) -> bool:
    """Whether there are samples, and above them names of as many columns."""
    width = _usual_width(rows)
    first = next((i for i, row in enumerate(rows) if _is_sample(row, width)), None)
    head = None if first is None else _find_names(rows, first, width, False)
    return head is not None and abs(len(rows[head]) - width) < 2


def is_unit_row(row: Sequence[str], width: int) -> bool:
    """Whether at least half of the cells, which are as many as the names, are units, in brackets or without.

    Examples
    --------
    >>> is_unit_row(["(s)", "Volt", "", "-"], 4), is_unit_row(["time", "valve"], 2)
    (True, False)
    """
    cells = [cell for cell in row if cell]
    known = sum(plain_unit(cell) is not None for cell in cells)
    return abs(len(row) - width) < 2 and known > 0 and 2 * known >= len(cells)


def plain_unit(cell: str) -> str | None:
    """The unit that a cell holds: "[mm]" is "mm", "Seconds" is "second"; None where it is none.

    Examples
    --------
    >>> plain_unit("[mm]"), plain_unit("Seconds"), plain_unit("valve")
    ('mm', 'second', None)
    """
    match = _BRACKETS.fullmatch(cell)
    bare = (match[1] or match[2] or "") if match else cell
    word = bare.casefold().rstrip("s.")
    return next((text for text in (bare, word) if text and (text == bare or len(word) > 3) and is_unit(text)), None)


def _usual_width(rows: Sequence[Sequence[str]]) -> int:
    widths = Counter(len(row) for row in rows if len(row) > 1)
    return widths.most_common(1)[0][0] if widths else 1


def _is_sample(row: Sequence[str], width: int) -> bool:
    first = next((cell for cell in row if cell), "")
    return len(row) == width > 1 and _is_value(first)


def _is_value(cell: str) -> bool:
    return bool(NUMBER.fullmatch(cell.replace(",", "."))) or is_stamp(cell)


def _is_blank(row: Sequence[str]) -> bool:
    return not any(row) or bool(_COMMENT.match(row[0]))


def _is_no_row(row: Sequence[str]) -> bool:
    """An empty line or a comment; a row of empty cells is one of missing samples, and so are numbers after a mark."""
    if row in ([], [""]):
        return True
    return bool(_COMMENT.match(row[0])) and not (_COMMENT.fullmatch(row[0]) and any(map(_is_value, row[1:])))


def _find_names(rows: Sequence[Sequence[str]], first: int, width: int, downwards: bool) -> int | None:
    """The row of the names: the last of the usual width above the samples, and not the one of their units."""
    may_name = [i for i in range(first) if abs(len(rows[i]) - width) < 2 and _is_header(rows[i])]
    if not may_name:
        near = [i for i in range(first) if not _is_blank(rows[i])]
        return near[-1] if near and _is_header(rows[near[-1]]) else None
    if downwards:
        return may_name[0]
    last = _skip_comments(rows, may_name)
    above = last - 1
    named_above = above >= 0 and abs(len(rows[above]) - len(rows[last])) < 2 and not _is_value(rows[above][0])
    return above if named_above and any(rows[above]) and is_unit_row(rows[last], len(rows[above])) else last


def _skip_comments(rows: Sequence[Sequence[str]], may_name: Sequence[int]) -> int:
    """The last row that may name the columns; a comment does so if it says more units than the uncommented above it."""
    last = may_name[-1]
    plain = [i for i in may_name if not _COMMENT.match(rows[i][0])]
    if not plain or _count_units(rows[last]) > _count_units(rows[plain[-1]]):
        return last
    return plain[-1]


def _count_units(row: Sequence[str]) -> int:
    return sum(bool(_BRACKETS.search(cell)) for cell in row)


def _is_header(row: Sequence[str]) -> bool:
    return len(_names(row)) > 1 and any(row) and not any(map(_is_value, row))


def _names(row: Sequence[str]) -> list[str]:
    names = [_COMMENT.sub("", row[0], count=1), *row[1:]] if row else []
    return names[:-1] if names and not names[-1] else names


def _units(names: Sequence[str], row: Sequence[str]) -> dict[str, str]:
    texts = [_COMMENT.sub("", row[0], count=1), *row[1:]]
    return {name: plain_unit(text) or text for name, text in zip(names, texts, strict=False) if name and text}


def _check_blocks(above: Sequence[Sequence[str]], where: str, first_row: int) -> None:
    """Refuse to skip what may be another block of samples, of another width."""
    values = [i for i, row in enumerate(above) if len(row) > 1 and _is_value(row[0])]
    if len(values) >= MIN_BLOCK_ROWS:
        first, last = values[0] + first_row, values[-1] + first_row
        raise LogError(
            f"{where}: rows {first} to {last} hold numbers, but other columns than the rows below; make two files of it"
        )


def _remarks(rows: Sequence[Sequence[str]], head: int, units: int | None, first_row: int) -> tuple[str, ...]:
    remarks = []
    above = [i for i in range(head) if any(rows[i])]
    if above:
        first, last = (next(cell for cell in rows[i] if cell)[:30] for i in (above[0], above[-1]))
        shown = f"{first!r} to {last!r}" if len(above) > 1 else repr(first)
        span = f"rows {first_row} to {head + first_row - 1} are" if head > 1 else f"row {first_row} is"
        remarks.append(f"{span} skipped as metadata: {shown}")
    if units is not None:
        remarks.append(f"row {units + first_row} is read as the units of the columns")
    return tuple(remarks)


def _missing_names(rows: Sequence[Sequence[str]], first: int, where: str, first_row: int) -> LogError:
    """Say which row should name the columns, and why it does not."""
    index = next((i for i in range(first - 1, -1, -1) if not _is_blank(rows[i])), 0)
    row = rows[index] if rows else []
    value = next((cell for cell in row if _is_value(cell)), "")
    place = f"{where}: row {index + first_row}"
    if not any(row):
        return LogError(f"{place} is empty; it has to name the columns")
    if value:
        return LogError(f"{place} holds the number {value[:40]!r}, not a column's name; name the columns above it")
    return LogError(f"{where}: one column only; put ',', ';' or a tab between columns")
