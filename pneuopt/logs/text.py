"""Reader of logs as text: columns apart by comma, semicolon, tab or white space, with decimal point or comma."""

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pneuopt.logs.table import EMPTY_CELL, LogTable, check_cells
from pneuopt.logs.tolerances import MAX_HEAD_ROWS, MIN_BLOCK_ROWS
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.units import is_unit

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?")
"""A number with a decimal point, or a whole one."""
TOA5 = "TOA5"
"""The first cell of the files of Campbell Scientific's loggers: names, units and processing in rows 2, 3 and 4."""

MISSING = ("", "NaN", "nan", "NAN")
"""Cells of a missing sample: empty, or as MATLAB, Python and Campbell's loggers write it."""
_DELIMITERS = (";", "\t", ",", " ")
_COMMENT = re.compile(r"\s*(?:#|%|//|!)+\s*")
_BRACKETS = re.compile(r"\[\s*(.*?)\s*\]|\(\s*(.*?)\s*\)")


def read_delimited(path: Path, raw: bytes) -> LogTable:
    """Read a text file of which a row names the columns: UTF-8, UTF-16 with its mark, or Windows-1252.

    An empty cell or NaN is a missing sample. One decimal mark holds for all columns that are read. Above the names may
    stand metadata, below them a row of units (`find_layout`). Rows have the numbers that an editor shows.
    """
    return read_text(path, decode(path, raw))


def read_text(path: Path, text: str) -> LogTable:
    """Read the text of such a file."""
    block, layout = find_block(path, text)
    return block_table(block, layout)


def find_block(path: Path, text: str) -> "tuple[TextBlock, Layout]":
    """The samples of such a text as cells, and how its rows are to be read."""
    lines = text.rstrip("\n ").split("\n")
    require(any(lines), f"{path}: row 1 is empty; it has to name the columns", LogError)

    def split(delimiter: str) -> list[list[str]]:
        return [split_cells(line, delimiter, f"{path}: row {i}") for i, line in enumerate(lines[:MAX_HEAD_ROWS], 1)]

    # the first that gives names and samples below them; else the first that the first line holds
    usual = next((d for d in _DELIMITERS[:-1] if d in lines[0]), ",")
    delimiter = next((d for d in _DELIMITERS if has_table(split(d))), usual)
    rows = split(delimiter)
    if rows[0][0] == TOA5 and len(rows) > 4:
        head = ("rows 1, 3 and 4 are read as the head of a TOA5 file",)
        layout = Layout(_names(rows[1]), _units(_names(rows[1]), rows[2]), 4, head)
    else:
        layout = find_layout(rows, str(path))
    names, start = layout.names, layout.start
    first = rows[start] if start < len(rows) else []
    stamps = frozenset(name for name, cell in zip(names, first, strict=False) if name and is_stamp(cell))
    return TextBlock(path, names, lines[start:], delimiter, start + 1, stamps), layout


def block_table(block: "TextBlock", layout: "Layout") -> LogTable:
    """The table of such samples."""
    return LogTable(block.path, block.names, block.first_row, block.columns, layout.units, block.stamps, layout.remarks)


def decode(path: Path, raw: bytes) -> str:
    """The text of a file, its lines apart by a line feed; a `LogError` if it is no text."""
    if raw[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        text = raw.decode("utf-16", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252", errors="replace")
    require("\0" not in text, f"{path}: not a text file; export the log as CSV in UTF-8", LogError)
    return text.replace("\r\n", "\n").replace("\r", "\n")


class Layout(NamedTuple):
    """How the rows of a log are to be read."""

    names: list[str]
    units: dict[str, str]  # by name, of those columns for which a row below the names says one
    start: int  # index of the first row of samples
    remarks: tuple[str, ...]  # the rows that are skipped


def find_layout(rows: Sequence[Sequence[str]], where: str) -> Layout:
    """Find the names, the units and the first sample in the cells of a file's rows, at least of its first ones.

    The samples begin with the first row of the usual width whose first cell is a number or a time stamp, below names,
    units, empty rows and comments; else below the first row that may be names: none that may be a sample is skipped.
    """
    width = _usual_width(rows)
    first = next((i for i, row in enumerate(rows) if _is_sample(row, width)), None)
    head = _find_names(rows, len(rows) if first is None else first, width, first is None)
    if head is None:
        raise _missing_names(rows, first or 0, where)
    units_row = head + 1 if head + 1 < len(rows) and is_unit_row(rows[head + 1], len(rows[head])) else None
    below = head + 1 if units_row is None else head + 2
    between = rows[below:first]
    start = below if first is None or not all(_is_no_row(row) for row in between) else first
    require(start < len(rows), f"{where}: a header, but no samples", LogError)
    values = [i for i, row in enumerate(rows[:head]) if len(row) > 1 and _is_value(row[0])]
    if len(values) >= MIN_BLOCK_ROWS:  # what may be another block of samples, of another width, is not skipped
        span = f"{values[0] + 1} to {values[-1] + 1}"
        raise LogError(
            f"{where}: rows {span} hold numbers, but other columns than the rows below; make two files of it"
        )
    names = _names(rows[head])
    units = {} if units_row is None else _units(names, rows[units_row])
    return Layout(names, units, start, _remarks(rows, head, units_row))


def has_table(rows: Sequence[Sequence[str]]) -> bool:
    """Whether there are samples, and above them names of as many columns."""
    width = _usual_width(rows)
    first = next((i for i, row in enumerate(rows) if _is_sample(row, width)), None)
    head = None if first is None else _find_names(rows, first, width, False)
    return head is not None and abs(len(rows[head]) - width) < 2


def is_unit_row(row: Sequence[str], width: int) -> bool:
    """Whether at least half of the cells, which are as many as the names, are units, in brackets or without."""
    cells = [cell for cell in row if cell]
    known = sum(plain_unit(cell) is not None for cell in cells)
    return abs(len(row) - width) < 2 and known > 0 and 2 * known >= len(cells)


def plain_unit(cell: str) -> str | None:
    """The unit that a cell holds: "[mm]" is "mm", "Seconds" is "second"; None where it is none."""
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
    last = may_name[-1]
    plain = [i for i in may_name if not _COMMENT.match(rows[i][0])]
    units = {i: sum(bool(_BRACKETS.search(cell)) for cell in rows[i]) for i in (last, *plain[-1:])}
    if plain and units[last] <= units[plain[-1]]:  # a comment is the row of names only if it has more units
        last = plain[-1]
    above = last - 1
    named_above = above >= 0 and abs(len(rows[above]) - len(rows[last])) < 2 and not _is_value(rows[above][0])
    return above if named_above and any(rows[above]) and is_unit_row(rows[last], len(rows[above])) else last


def _is_header(row: Sequence[str]) -> bool:
    return len(_names(row)) > 1 and any(row) and not any(map(_is_value, row))


def _names(row: Sequence[str]) -> list[str]:
    names = [_COMMENT.sub("", row[0], count=1), *row[1:]] if row else []
    return names[:-1] if names and not names[-1] else names


def _units(names: Sequence[str], row: Sequence[str]) -> dict[str, str]:
    texts = [_COMMENT.sub("", row[0], count=1), *row[1:]]
    return {name: plain_unit(text) or text for name, text in zip(names, texts, strict=False) if name and text}


def _remarks(rows: Sequence[Sequence[str]], head: int, units: int | None) -> tuple[str, ...]:
    remarks = []
    above = [i for i in range(head) if any(rows[i])]
    if above:
        first, last = (next(cell for cell in rows[i] if cell)[:30] for i in (above[0], above[-1]))
        shown = f"{first!r} to {last!r}" if len(above) > 1 else repr(first)
        span = f"rows 1 to {head} are" if head > 1 else "row 1 is"
        remarks.append(f"{span} skipped as metadata: {shown}")
    if units is not None:
        remarks.append(f"row {units + 1} is read as the units of the columns")
    return tuple(remarks)


def _missing_names(rows: Sequence[Sequence[str]], first: int, where: str) -> LogError:
    """Say which row should name the columns, and why it does not."""
    index = next((i for i in range(first - 1, -1, -1) if not _is_blank(rows[i])), 0)
    row = rows[index] if rows else []
    value = next((cell for cell in row if _is_value(cell)), "")
    place = f"{where}: row {index + 1}"
    if not any(row):
        return LogError(f"{place} is empty; it has to name the columns")
    if value:
        return LogError(f"{place} holds the number {value[:40]!r}, not a column's name; name the columns above it")
    return LogError(f"{where}: one column only; put ',', ';' or a tab between columns")


_UNIT_SEPARATOR = "\x1f"  # ASCII's own
_WORD = re.compile(r"(?:[#%!/]+\s*)?\S+(?:\s*\[[^\]]*\]|\s*\([^)]*\))?")  # a name keeps its unit in brackets


@dataclass(frozen=True)
class TextBlock:
    """The samples of a log as text, a row a line."""

    path: Path
    names: Sequence[str]
    lines: Sequence[str]
    delimiter: str  # " " stands for any white space
    first_row: int  # the number of the first line
    stamps: frozenset[str] = frozenset()  # columns of time stamps

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Read the named columns (n,); time stamps as seconds from the first."""
        check_cells(self.path, len(self.lines), len(names))
        even = _equal_rows(self)
        found = dict[str, Array]()
        for name in (name for name in names if name in self.stamps):
            cells = [_row_cells(even, k)[self.names.index(name)] for k in range(len(self.lines))]
            found[name] = seconds_from_first(cells, self.path, name, self.first_row)
        used = [self.names.index(name) for name in names if name not in found]
        parsed = (_parse_with_decimal(even, used, decimal) for decimal in ".,") if used else iter([{}])
        numbers = next((columns for columns in parsed if columns is not None), None)
        if numbers is None:
            raise _number_error(even, used)
        return {name: found[name] if name in found else numbers[self.names.index(name)] for name in names}


def mend_cells(block: TextBlock, used: Sequence[str]) -> tuple[TextBlock, dict[str, list[int]]]:
    """Empty rows of another length than the header and cells of columns `used` that hold no number; both are listed."""
    width, changes = len(block.names), dict[str, list[int]]()
    cells = [split_cells(line, block.delimiter) for line in block.lines]
    cells = [row[:-1] if len(row) == width + 1 and not row[-1] else row for row in cells]
    numbers = [i for i, name in enumerate(block.names) if name in used and name not in block.stamps]
    commas = sum("," in row[i] for row in cells if len(row) == width for i in numbers)
    points = sum("." in row[i] for row in cells if len(row) == width for i in numbers)
    for k, row in enumerate(cells):
        if len(row) != width:
            changes.setdefault(f"left out, for the row has not {width} cells", []).append(k + block.first_row)
            cells[k] = [""] * width
            continue
        for i in numbers:
            text = row[i].replace(",", ".") if commas > points else row[i]
            if row[i] not in MISSING and not NUMBER.fullmatch(text):
                what = f"cell of {block.names[i]!r} emptied, for it holds no number"
                changes.setdefault(what, []).append(k + block.first_row)
                row[i] = ""
    lines = [_UNIT_SEPARATOR.join(cell.replace(_UNIT_SEPARATOR, " ") for cell in row) for row in cells]
    return replace(block, lines=lines, delimiter=_UNIT_SEPARATOR), changes


def split_cells(line: str, delimiter: str, where: str = "") -> list[str]:
    """The cells of one line, without quotes and white space around them."""
    if delimiter == " ":
        return [match[0] for match in _WORD.finditer(line)] or [""]
    if '"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=False), [""])
    except csv.Error:
        raise LogError(f"{where}: a cell has more than {csv.field_size_limit()} characters; cut it") from None
    return [cell.strip() for cell in cells]


def _equal_rows(block: TextBlock) -> TextBlock:
    """Rows with as many fields as the header, without the delimiter at their end that some programs write.

    Where a cell is quoted, cells are set apart by a character that no cell holds, and quotes dropped, so that no quote
    can swallow the next line.
    """
    width, mark = len(block.names), block.delimiter
    even = list(block.lines)
    if mark == " " or any('"' in line for line in even):
        rows = [split_cells(line, mark, f"{block.path}: row {i}") for i, line in enumerate(even, block.first_row)]
        mark = _UNIT_SEPARATOR
        even = [mark.join(cell.replace(mark, " ") for cell in cells) for cells in rows]
    for i, line in enumerate(even):
        n = line.count(mark) + 1
        if n == width + 1 and line.rstrip(" ").endswith(mark):
            even[i] = line.rstrip(" ")[:-1]
        elif n != width:
            row = f"{block.path}: row {i + block.first_row}"
            if block.lines[i].count('"') % 2:
                raise LogError(f'{row}: a quote (") is opened and not closed; mend the row')
            doubt = block.delimiter == "," and n > width
            remedy = "is ',' the decimal mark, too? Then export with ';'" if doubt else "mend or delete the row"
            raise LogError(f"{row} has {n} {'field' if n == 1 else 'fields'}, the header {width}; {remedy}")
    return replace(block, lines=even, delimiter=mark)


def _row_cells(block: TextBlock, row: int) -> list[str]:
    return [cell.strip() for cell in block.lines[row].split(block.delimiter)]


def _parse_with_decimal(block: TextBlock, used: Sequence[int], decimal: str) -> dict[int, Array] | None:
    import pandas as pd

    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(block.lines)),
            sep=block.delimiter,
            decimal=decimal,
            header=None,
            names=list(range(len(block.names))),
            usecols=sorted(used),
            dtype=np.float64,
            na_values=list(MISSING),
            keep_default_na=False,
            quoting=csv.QUOTE_NONE,
            skipinitialspace=True,
            skip_blank_lines=False,
        )
    except ValueError:
        return None
    numbers = {i: frame[i].to_numpy() for i in used}
    require(len(frame) == len(block.lines), f"{block.path}: rows are lost; export the log as CSV anew", LogError)
    for i, column in numbers.items():
        doubtful = np.flatnonzero(~np.isfinite(column))
        if any(_row_cells(block, row)[i] not in MISSING for row in doubtful.tolist()):
            return None
    return numbers


def _number_error(block: TextBlock, used: Sequence[int]) -> LogError:
    """Name the first cell that is not a number."""
    rows = [_row_cells(block, k) for k in range(len(block.lines))]
    decimal = (
        "," if any(NUMBER.fullmatch(row[i].replace(",", ".")) and "," in row[i] for row in rows for i in used) else "."
    )
    for k, row in enumerate(rows):
        for i in used:
            cell = row[i]
            mended = cell.replace(",", ".") if decimal == "," and "." not in cell else cell
            is_number = NUMBER.fullmatch(mended) and np.isfinite(float(mended))
            if cell not in MISSING and not (is_number and (decimal == "." or "." not in cell)):
                return LogError(
                    f"{block.path}: row {k + block.first_row}, column {block.names[i]!r}: {cell[:40]!r} is not a "
                    f"number (decimal mark {decimal!r}); {EMPTY_CELL}"
                )
    return LogError(f"{block.path}: cannot be read as numbers; export it as CSV")


_STAMP = re.compile(
    r"(?:(?P<date>\d{4}([-/.])\d\d?\2\d\d?|\d\d?([-/.])\d\d?\3(?:\d{4}|\d\d))(?:[T,_]\s*|\s+))?"
    r"(?P<h>\d\d?):(?P<m>\d\d)(?::(?P<s>\d\d)(?:[.,:](?P<f>\d{1,9}))?)?"
    r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?(?:\s*(?P<zone>Z|[+-]\d\d(?::?\d\d)?))?"
)
_EXAMPLE = "2026-03-12T10:00:00.000"


def is_stamp(cell: str) -> bool:
    """Whether a cell is a time of day, with its date or without."""
    return _STAMP.fullmatch(cell) is not None


def seconds_from_first(cells: Sequence[str], path: Path | str, name: str, first_row: int) -> Array:
    """Read a column of stamps as seconds from the first (n,), exact to 1 ns; NaN where one is empty.

    Without dates, a leap back by more than half a day is midnight.
    """
    matches = [_STAMP.fullmatch(cell) for cell in cells]
    places = [f"{path}: row {first_row + k}, column {name!r}" for k in range(len(cells))]
    bad = next((k for k, cell in enumerate(cells) if cell and matches[k] is None), None)
    if bad is not None:
        raise LogError(f"{places[bad]}: {cells[bad][:40]!r} is not a time stamp; write it as {_EXAMPLE}")
    month_first = _month_first([m for m in matches if m], f"{path}: column {name!r}")
    days: dict[str, int] = {}
    moments: list[int | None] = []
    for k, match in enumerate(matches):
        moments.append(_nanoseconds(match, days, month_first, places[k]) if match else None)
    if not days:
        day, shift, last = 86400 * 10**9, 0, None
        for k, moment in enumerate(moments):
            if moment is not None:
                shift += day if last is not None and moment + day // 2 < last else 0
                last, moments[k] = moment, moment + shift
    start = next((moment for moment in moments if moment is not None), 0)
    return np.array([np.nan if m is None else (m - start) / 1e9 for m in moments])


def _month_first(matches: Sequence[re.Match[str]], place: str) -> bool:
    """Whether 3/12/2026 is the 12th of March, by what is possible; either will do where the date stays the same."""
    texts = {m["date"]: bool(m["half"]) for m in matches if re.match(r"\d\d?[-/]", m["date"] or "")}
    parts = [[int(n) for n in re.split("[-/]", text)] for text in texts]
    if any(first > 12 for first, _, _ in parts):
        return False
    if any(texts.values()) or any(second > 12 for _, second, _ in parts):
        return True
    require(len(texts) < 2, f"{place}: {next(iter(texts), '')!r} may be two days; write dates as 2026-03-12", LogError)
    return False


def _nanoseconds(match: re.Match[str], days: dict[str, int], month_first: bool, place: str) -> int:
    """The moment of a stamp; `days` holds the numbers of the dates that were read."""
    text = match["date"] or ""
    if text and text not in days:
        parts = [int(part) for part in re.split("[-/.]", text)]
        if re.match(r"\d{4}", text):
            year, month, day = parts
        elif "." in text or not month_first:
            day, month, year = parts
        else:
            month, day, year = parts
        try:
            days[text] = date(year + 2000 * (year < 100), month, day).toordinal()
        except ValueError:
            raise LogError(f"{place}: {text!r} is no date; write it as 2026-03-12") from None
    hour, minute, second = int(match["h"]), int(match["m"]), int(match["s"] or 0)
    half = (match["half"] or "").lower()
    fits = hour < (13 if half else 25) and minute < 60 and second < 61
    require(fits, f"{place}: {match[0]!r} is no time of day; write it as {_EXAMPLE}", LogError)
    hour = hour % 12 + 12 * (half == "p") if half else hour
    zone = (match["zone"] or "Z").replace(":", "").replace("Z", "+0000").ljust(5, "0")
    shift = (int(zone[1:3]) * 60 + int(zone[3:5])) * (-1 if zone[0] == "-" else 1)
    fraction = int((match["f"] or "0").ljust(9, "0"))
    return (((days.get(text, 0) * 24 + hour) * 60 + minute - shift) * 60 + second) * 10**9 + fraction
