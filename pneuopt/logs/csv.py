"""Reader of logs as text: columns apart by comma, semicolon or tab, with decimal point or comma."""

import csv
import io
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")


def read_table(path: Path) -> Table:
    """Read a text file whose first row names the columns.

    Parameters
    ----------
    path : Path
        UTF-8 or Windows-1252. An empty cell is a missing sample. One decimal mark holds for all columns that are read.

    Returns
    -------
    Table
        Its first sample stands in row 2, as in a spreadsheet.

    Raises
    ------
    LogError
        If the file is not text, or its rows are not of one length.
    """
    text = _decode(path)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\n ").split("\n")
    require(bool(lines[0].strip()), f"{path}: row 1 is empty; it has to name the columns", LogError)
    delimiter = next((d for d in ";\t," if len(_cells(lines[0], d)) > 1), "")
    require(bool(delimiter), f"{path}: one column only; put ',', ';' or a tab between columns", LogError)
    header = _cells(lines[0], delimiter)
    header = header[:-1] if not header[-1] else header
    for name in header:
        require(not _NUMBER.fullmatch(name), f"{path}: row 1 holds the number {name!r}, not a column's name", LogError)
    require(len(lines) > 1, f"{path}: a header, but no samples", LogError)
    return Table(path, header, 2, partial(_parse_columns, _TextLog(path, header, lines[1:], delimiter)))


class _TextLog(NamedTuple):
    """A log as text: `lines[0]` is row 2 of the file."""

    path: Path
    header: list[str]
    lines: list[str]
    delimiter: str


def _decode(path: Path) -> str:
    raw = path.read_bytes()
    require(b"\0" not in raw, f"{path}: not a text file; export the log as CSV in UTF-8", LogError)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])]


def _parse_columns(log: _TextLog, names: Sequence[str]) -> dict[str, Array]:
    log = log._replace(lines=_equal_rows(log))
    used = [log.header.index(name) for name in names]
    for decimal in (".", ","):
        numbers = _parse_with_decimal(log, used, decimal)
        if numbers is not None:
            return {log.header[i]: column for i, column in numbers.items()}
    raise _number_error(log, used)


def _equal_rows(log: _TextLog) -> list[str]:
    """Rows with as many fields as the header, without the delimiter at their end that some programs write."""
    path, header, lines, delimiter = log
    width = len(header)
    quoted = any('"' in line for line in lines)
    counts = [len(_cells(line, delimiter)) if quoted else line.count(delimiter) + 1 for line in lines]
    if all(n == width for n in counts):
        return lines
    even = list(lines)
    for i, (line, n) in enumerate(zip(lines, counts, strict=True)):
        if n == width + 1 and line.rstrip(" ").endswith(delimiter):
            even[i] = line.rstrip(" ")[:-1]
        elif n != width:
            doubt = delimiter == "," and n > width
            remedy = "is ',' the decimal mark, too? Then export with ';'" if doubt else "mend or delete the row"
            fields = "field" if n == 1 else "fields"
            raise LogError(f"{path}: row {i + 2} has {n} {fields}, the header {width}; {remedy}")
    return even


def _parse_with_decimal(log: _TextLog, used: Sequence[int], decimal: str) -> dict[int, Array] | None:
    import pandas as pd

    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(log.lines)),
            sep=log.delimiter,
            decimal=decimal,
            header=None,
            names=list(range(len(log.header))),
            usecols=sorted(used),
            dtype=np.float64,
            na_values=[""],
            keep_default_na=False,
            skipinitialspace=True,
            skip_blank_lines=False,
        )
    except ValueError:
        return None
    numbers = {i: frame[i].to_numpy() for i in used}
    for i, column in numbers.items():
        doubtful = np.flatnonzero(~np.isfinite(column))
        if any(_cells(log.lines[row], log.delimiter)[i] for row in doubtful):
            return None
    return numbers


def _number_error(log: _TextLog, used: Sequence[int]) -> LogError:
    """Name the first cell that is not a number."""
    rows = [_cells(line, log.delimiter) for line in log.lines]
    decimal = (
        "," if any(_NUMBER.fullmatch(row[i].replace(",", ".")) and "," in row[i] for row in rows for i in used) else "."
    )
    for k, row in enumerate(rows):
        for i in used:
            mended = row[i].replace(",", ".") if decimal == "," and "." not in row[i] else row[i]
            if row[i] and (not _NUMBER.fullmatch(mended) or (decimal == "," and "." in row[i])):
                return LogError(
                    f"{log.path}: row {k + 2}, column {log.header[i]!r}: {row[i]!r} is not a number "
                    f"(decimal mark {decimal!r}); leave the cell empty if the sample is missing"
                )
    return LogError(f"{log.path}: cannot be read as numbers; export it as CSV")
