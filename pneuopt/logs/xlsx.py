"""Reader of Excel's workbooks (.xlsx): the first sheet with names and samples; needs openpyxl, the extra `xlsx`."""

import io
import zipfile
from collections.abc import Sequence, Set
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.budget import MAX_BYTES, MAX_COLUMNS, check_cells
from pneuopt.logs.columns import MAX_MAGNITUDE
from pneuopt.logs.layout import MAX_HEAD_ROWS, find_layout, has_table
from pneuopt.logs.libraries import foreign_code, import_extra
from pneuopt.logs.stamps import is_stamp, seconds_from_first
from pneuopt.logs.table import EMPTY_CELL, Table
from pneuopt.logs.text_cells import MISSING
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

MAX_SHEET_ROWS = 2**20
"""Rows of a sheet [1]: Excel's own bound."""
MAX_EMPTY_ROWS = 10_000
"""Empty rows one after another [1]: a single stray cell far below makes a million, which take seconds."""
MAX_DAYS = 2958466
"""Days of a date [1]: Excel's last, in the year 9999; more overflow as seconds."""
_SHOWN_DATE = "0:00:00"  # what a date looks like where only its being one counts


class _Date(float):
    """A cell in days that Excel shows as a date or a time."""


def read_table(path: Path, raw: bytes) -> Table:
    """Read a workbook; rows have Excel's numbers.

    An empty cell is a missing sample; a formula counts by its last value. Above the names may stand metadata, below
    them a row of units. Dates and times are read to the microsecond, as Excel keeps them.
    """
    openpyxl = import_extra("openpyxl", "openpyxl", path, "an Excel workbook", "xlsx")
    with foreign_code(path, "an Excel workbook"):
        sheets = _read_sheets(path, raw, openpyxl)
    shown = {title: [[_show(cell) for cell in row] for row in rows[:MAX_HEAD_ROWS]] for title, rows in sheets.items()}
    title = next((title for title, rows in shown.items() if has_table(rows)), next(iter(sheets), ""))
    require(any(shown.values()), f"{path}: no sheet holds cells; it has to name the columns in a row", LogError)
    layout = find_layout(shown[title], str(path))
    rows = [*sheets[title][layout.start :]]
    first = shown[title][layout.start] if layout.start < len(shown[title]) else []
    stamps = frozenset(name for name, cell in zip(layout.names, first, strict=False) if name and is_stamp(cell))
    read = partial(_read_columns, _Sheet(path, layout.names, rows, layout.start + 1, stamps))
    others = (f"sheet {title!r} is read, of {len(sheets)}",) if len(sheets) > 1 else ()
    return Table(path, layout.names, layout.start + 1, read, layout.units, stamps, layout.remarks + others)


class _Sheet(NamedTuple):
    """The samples of a sheet."""

    path: Path
    names: Sequence[str]
    rows: Sequence[Sequence[Any]]
    first_row: int
    stamps: frozenset[str]


def _read_sheets(path: Path, raw: bytes, openpyxl: Any) -> dict[str, list[list[Any]]]:
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        size = sum(member.file_size for member in archive.infolist())
    require(size <= MAX_BYTES, f"{path}: holds {size / 2**20:.0f} MiB of cells; export it as CSV", LogError)
    book = openpyxl.load_workbook(io.BytesIO(raw), read_only=True, data_only=True)
    # openpyxl rounds dates to milliseconds; as numbers they keep all digits.
    date_styles = book._date_formats | book._timedelta_formats
    book._date_formats.clear()
    book._timedelta_formats.clear()
    return {sheet.title: _read_cells(path, sheet, date_styles) for sheet in book.worksheets}


def _read_cells(path: Path, sheet: Any, date_styles: Set[int]) -> list[list[Any]]:
    sheet.reset_dimensions()  # which some programs write wrong
    rows: list[list[Any]] = []
    width = empty = 0
    for row in sheet.iter_rows():
        width = max(width, len(row))
        empty = 0 if row else empty + 1
        require(
            empty <= MAX_EMPTY_ROWS, f"{path}: {empty} rows are empty; delete them, or what is below them", LogError
        )
        rows.append([_Date(cell.value) if _is_date(cell, date_styles) else cell.value for cell in row])
        require(
            len(rows) <= MAX_SHEET_ROWS and width <= MAX_COLUMNS, f"{path}: the sheet is too large; cut it", LogError
        )
        check_cells(path, len(rows), width)
    while rows and all(cell is None for cell in rows[-1]):
        rows.pop()
    return [_without_tail(row) for row in rows]


def _is_date(cell: Any, date_styles: Set[int]) -> bool:
    # not by the cell's own `is_date`, which searches the style's text again for each cell: a quarter of the time
    return cell.data_type == "n" and cell.value is not None and cell._style_id in date_styles


def _without_tail(row: list[Any]) -> list[Any]:
    while row and row[-1] is None:
        row.pop()
    return row


def _show(cell: Any) -> str:
    if isinstance(cell, _Date):
        return _SHOWN_DATE
    return "" if cell is None else str(cell).strip()


def _read_columns(sheet: _Sheet, names: Sequence[str]) -> dict[str, Array]:
    width = len(sheet.names)
    for i, row in enumerate(sheet.rows, sheet.first_row):
        require(len(row) <= width, f"{sheet.path}: row {i} has {len(row)} cells, the header {width}; mend it", LogError)
    return {name: _column(sheet, name) for name in names}


def _column(sheet: _Sheet, name: str) -> Array:
    i = sheet.names.index(name)
    cells = [row[i] if i < len(row) else None for row in sheet.rows]
    if name in sheet.stamps and not isinstance(cells[0], _Date):
        return seconds_from_first([_show(cell) for cell in cells], sheet.path, name, sheet.first_row)
    numbers = np.array([_number(sheet, name, k, cell) for k, cell in enumerate(cells)])
    return _seconds(sheet, name, numbers) if name in sheet.stamps else numbers


def _number(sheet: _Sheet, name: str, index: int, cell: Any) -> float:
    if cell is None or (isinstance(cell, str) and cell.strip() in MISSING):
        return np.nan
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    place = f"{sheet.path}: row {index + sheet.first_row}, column {name!r}"
    require(is_number, f"{place}: {str(cell)[:40]!r} is not a number; {EMPTY_CELL}", LogError)
    return float(cell) if not abs(cell) > MAX_MAGNITUDE else np.inf  # which is refused


def _seconds(sheet: _Sheet, name: str, days: Array) -> Array:
    """Seconds from the first; a time of day leaps back at midnight. A double holds today's date to 0.6 us."""
    wrong = np.flatnonzero(np.abs(days) > MAX_DAYS)
    if wrong.size:
        place = f"{sheet.path}: row {wrong[0] + sheet.first_row}, column {name!r}"
        raise LogError(f"{place}: {days[wrong[0]]:.6g} is no date of Excel; write a date with its time, or a number")
    known = days[np.isfinite(days)]
    if known.max(initial=0.0) <= 1:
        days = days + np.cumsum(np.diff(days, prepend=days[:1]) < -0.5)
    return np.asarray(np.round((days - (known[0] if known.size else 0.0)) * 86400, 6))
