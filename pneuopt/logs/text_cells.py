"""Cells of text as numbers: one row a line, one decimal mark, and the first cell that is no number named."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pneuopt.logs.budget import check_cells
from pneuopt.logs.layout import NUMBER
from pneuopt.logs.stamps import seconds_from_first
from pneuopt.logs.table import EMPTY_CELL
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

MISSING = ("", "NaN", "nan", "NAN")
"""Cells of a missing sample: empty, or as MATLAB, Python and Campbell's loggers write it."""
_UNIT_SEPARATOR = "\x1f"  # ASCII's own
_WORD = re.compile(r"(?:[#%!/]+\s*)?\S+(?:\s*\[[^\]]*\]|\s*\([^)]*\))?")  # a name keeps its unit in brackets


@dataclass(frozen=True)
class TextBlock:
    """The samples of a log as text.

    Attributes
    ----------
    names : sequence of str
        Of the columns.
    lines : sequence of str
        A row each; " " as the delimiter stands for any white space.
    first_row : int
        The number of the first line.
    stamps : frozenset of str
        Columns of time stamps.
    """

    path: Path
    names: Sequence[str]
    lines: Sequence[str]
    delimiter: str
    first_row: int
    stamps: frozenset[str] = frozenset()

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Read the named columns; time stamps as seconds from the first.

        Raises
        ------
        LogError
            If a row has another length than the header, or a cell is not a number.
        """
        check_cells(self.path, len(self.lines), len(names))
        even = _equal_rows(self)
        found = {name: even.stamp_column(name) for name in names if name in self.stamps}
        used = [self.names.index(name) for name in names if name not in found]
        numbers = _numbers(even, used) if used else {}
        return {name: found[name] if name in found else numbers[self.names.index(name)] for name in names}

    def stamp_column(self, name: str) -> Array:
        """Seconds from the first stamp."""
        i = self.names.index(name)
        cells = [_row_cells(self, k)[i] for k in range(len(self.lines))]
        return seconds_from_first(cells, self.path, name, self.first_row)


def mend_cells(block: TextBlock, used: Sequence[str]) -> tuple[TextBlock, dict[str, list[int]]]:
    """Leave out rows of another length than the header, and empty the cells of columns that hold no number.

    Parameters
    ----------
    used : sequence of str
        The columns whose cells have to be numbers.

    Returns
    -------
    block : TextBlock
        With a row a line still: one that is left out has empty cells.
    changes : dict of str to list of int
        What was done, with the numbers of the rows.
    """
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
    """The cells of one line, without quotes and white space around them.

    Examples
    --------
    >>> split_cells('0,1; "a;b" ;3" pipe', ";")
    ['0,1', 'a;b', '3" pipe']
    """
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
            raise _width_error(block, i, n)
    return replace(block, lines=even, delimiter=mark)


def _width_error(block: TextBlock, index: int, n: int) -> LogError:
    width, row = len(block.names), f"{block.path}: row {index + block.first_row}"
    if block.lines[index].count('"') % 2:
        return LogError(f'{row}: a quote (") is opened and not closed; mend the row')
    doubt = block.delimiter == "," and n > width
    remedy = "is ',' the decimal mark, too? Then export with ';'" if doubt else "mend or delete the row"
    return LogError(f"{row} has {n} {'field' if n == 1 else 'fields'}, the header {width}; {remedy}")


def _row_cells(block: TextBlock, row: int) -> list[str]:
    return [cell.strip() for cell in block.lines[row].split(block.delimiter)]


def _numbers(block: TextBlock, used: Sequence[int]) -> dict[int, Array]:
    for decimal in (".", ","):
        numbers = _parse_with_decimal(block, used, decimal)
        if numbers is not None:
            return numbers
    raise _number_error(block, used)


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
