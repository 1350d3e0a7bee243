"""A log's CSV file as columns of SI numbers, one a channel; whatever is wrong with it is named by row and column."""

import csv
import difflib
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnitError, UnknownNameError, check_names, require
from pneuopt.quantities.units import read_value, si_conversion

CHANNELS: Mapping[str, str] = {
    "time": "s",
    "valve_voltage": "V",
    "force": "N",
    "position": "m",
    "speed": "m/s",
    "pressure_a": "Pa(a)",
    "pressure_b": "Pa(a)",
    "supply_pressure": "Pa(a)",
    "speed_reference": "m/s",
    "position_reference": "m",
}
"""The channels of a log and their SI units."""

MIN_SAMPLES = 10
"""Samples that a log has at least."""

_SYNONYMS = {"t": "time", "velocity": "speed", "displacement": "position", "voltage": "valve_voltage"}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_BRACKETED_UNIT = re.compile(r"(.+?)\s*\[\s*(.*?)\s*\]|(.+?)\s+\((.+)\)")


def read_columns(path: Path, raw: bytes, entries: Mapping[str, Any] | None, where: str) -> dict[str, Array]:
    """Read the channels of a CSV file.

    Parameters
    ----------
    path : Path
        For messages only.
    raw : bytes
        The file.
    entries : mapping, optional
        Channel to column, as in a sidecar's [columns]; None: the header says it.
    where : str
        Where the entries come from, for messages.

    Returns
    -------
    dict of str to ndarray, each of shape (n,)
        In SI units, "time" among them, strictly increasing; NaN where a sample is missing.

    Raises
    ------
    LogError, UnitError, UnknownNameError
        If the file cannot be understood beyond doubt.
    """
    table = _read_table(path, raw)
    found = _columns_from_header(table) if entries is None else _columns_from_entries(table, entries, where)
    require("time" in found, f'{path}: no time; name a column "time [s]", or say which in a sidecar', LogError)
    require(len(found) > 1, f"{path}: no channel but time; known: {', '.join(CHANNELS)}", LogError)
    numbers = _parse_numbers(table, [column.place for column in found.values()])
    values = {channel: c.factor * numbers[c.place] + c.offset for channel, c in found.items()}
    _check_samples(table, found, values)
    return values


class _Table(NamedTuple):
    """A log as text: `lines[0]` is row 2 of the file."""

    path: Path
    header: list[str]
    lines: list[str]
    delimiter: str


class _Column(NamedTuple):
    """Where a channel stands, and ``si = factor * raw + offset``."""

    place: int
    factor: float
    offset: float


def _read_table(path: Path, raw: bytes) -> _Table:
    require(b"\0" not in raw, f"{path}: not a text file; export the log as CSV in UTF-8", LogError)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\n ").split("\n")
    require(bool(lines[0].strip()), f"{path}: row 1 is empty; it has to name the columns", LogError)
    delimiter = next((d for d in ";\t," if len(_cells(lines[0], d)) > 1), "")
    require(bool(delimiter), f"{path}: one column only; put ',', ';' or a tab between columns", LogError)
    header = _cells(lines[0], delimiter)
    header = header[:-1] if not header[-1] else header
    for name in filter(None, header):
        require(header.count(name) == 1, f"{path}: two columns are named {name!r}; rename one", LogError)
        require(not _NUMBER.fullmatch(name), f"{path}: row 1 holds the number {name!r}, not a column's name", LogError)
    require(len(lines) > 1, f"{path}: a header, but no samples", LogError)
    return _Table(path, header, _check_field_counts(path, lines[1:], len(header), delimiter), delimiter)


def _check_field_counts(path: Path, lines: list[str], width: int, delimiter: str) -> list[str]:
    """Check that every row has as many fields as the header; a trailing delimiter is dropped."""
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


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])]


def _columns_from_header(table: _Table) -> dict[str, _Column]:
    """Columns whose header names a channel and its unit; one that nearly does is an error."""
    found: dict[str, _Column] = {}
    for name in filter(None, table.header):
        channel, unit = _split_channel(name)
        if not channel:
            _check_misspelling(table.path, name)
            continue
        where = f"{table.path}: column {name!r}"
        require(channel not in found, f"{where}: {channel!r} has another column; name one in a sidecar", LogError)
        try:
            found[channel] = _resolve_column(table, channel, {"column": name, "unit": unit} if unit else name, where)
        except UnitError as error:
            raise UnitError(f"{error} (or list the columns to use in a sidecar)") from None
    return found


def _split_channel(name: str) -> tuple[str, str]:
    """Split "position [mm]" or "position_mm" into channel and unit; ("", "") if it names no channel."""
    bare, unit = _split_unit(name)
    plain = bare.casefold().replace(" ", "_")
    if plain in CHANNELS:
        return plain, unit
    for channel in sorted(CHANNELS, key=len, reverse=True):
        if plain.startswith(channel + "_") and not unit:
            return channel, bare[len(channel) + 1 :]
    return "", ""


def _split_unit(name: str) -> tuple[str, str]:
    match = _BRACKETED_UNIT.fullmatch(name)
    return (match[1] or match[3], match[2] or match[4] or "") if match else (name, "")


def _check_misspelling(path: Path, name: str) -> None:
    bare, unit = _split_unit(name)
    parts = bare.casefold().replace(" ", "_").split("_")
    for n in range(len(parts), 0 if not unit else len(parts) - 1, -1):
        head = "_".join(parts[:n])
        near = difflib.get_close_matches(head, CHANNELS, n=1, cutoff=0.85) or [_SYNONYMS.get(head, "")]
        require(
            not near[0],
            f"{path}: column {name!r} looks like the channel {near[0]!r}; write it so, or list the columns to use "
            "in a sidecar",
            LogError,
        )


def _columns_from_entries(table: _Table, entries: Mapping[str, Any], where: str) -> dict[str, _Column]:
    check_names("channel", entries, CHANNELS, where)
    return {channel: _resolve_column(table, channel, entry, f"{where}.{channel}") for channel, entry in entries.items()}


def _resolve_column(table: _Table, channel: str, entry: Any, where: str) -> _Column:
    said = dict(entry) if isinstance(entry, Mapping) else {"column": entry}
    check_names("key", said, ("column", "unit", "centre", "scale"), where)
    require(isinstance(said.get("column"), str), f'{where}: say which column: {{ column = "U valve" }}', LogError)
    name = said["column"]
    bare, unit = _split_unit(name)
    if name not in table.header:
        name = bare
    if name not in table.header:
        raise UnknownNameError("column", said["column"], filter(None, table.header), where)
    unit = str(said.get("unit") or unit or _split_channel(name)[1])
    require(bool(unit), f'{where}: no unit; write "{bare} [{CHANNELS[channel]}]", or unit = "..."', UnitError)
    raw_centre = read_value(said["centre"], unit, where=f"{where}.centre") if "centre" in said else 0.0
    factor, offset = _column_scaling(unit, said.get("scale"), CHANNELS[channel], where)
    return _Column(table.header.index(name), factor, offset - factor * raw_centre)


def _column_scaling(unit: str, scale: str | float | None, target: str, where: str) -> tuple[float, float]:
    if scale is None:
        return si_conversion(unit, target, where=where)
    # A sensor's "1 bar(g)/V" says where the pressure counts from; the gain itself is a difference.
    level = re.search(r"\([ag]\)", f"{unit} {scale}")
    require(
        bool(level) or "(" not in target,
        f'{where}.scale: {scale!r} does not say from where the pressure counts; write "2 bar(g)/V" or "2 bar(a)/V"',
        UnitError,
    )
    bare, bare_target = (re.sub(r"\([ag]\)", "", text) for text in (unit, target))
    gain = read_value(re.sub(r"\([ag]\)", "", str(scale)), f"({bare_target})/({bare})", where=f"{where}.scale")
    return gain, si_conversion(bare_target + (level[0] if level else ""), target, where=f"{where}.scale")[1]


def _parse_numbers(table: _Table, used: Sequence[int]) -> dict[int, Array]:
    for decimal in (".", ","):
        numbers = _parse_with_decimal(table, used, decimal)
        if numbers is not None:
            return numbers
    raise _number_error(table, used)


def _parse_with_decimal(table: _Table, used: Sequence[int], decimal: str) -> dict[int, Array] | None:
    import pandas as pd

    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(table.lines)),
            sep=table.delimiter,
            decimal=decimal,
            header=None,
            names=list(range(len(table.header))),
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
        if any(_cells(table.lines[row], table.delimiter)[i] for row in doubtful):
            return None
    return numbers


def _number_error(table: _Table, used: Sequence[int]) -> LogError:
    """Name the first cell that is not a number."""
    rows = [_cells(line, table.delimiter) for line in table.lines]
    decimal = (
        "," if any(_NUMBER.fullmatch(row[i].replace(",", ".")) and "," in row[i] for row in rows for i in used) else "."
    )
    for k, row in enumerate(rows):
        for i in used:
            mended = row[i].replace(",", ".") if decimal == "," and "." not in row[i] else row[i]
            if row[i] and (not _NUMBER.fullmatch(mended) or (decimal == "," and "." in row[i])):
                return LogError(
                    f"{table.path}: row {k + 2}, column {table.header[i]!r}: {row[i]!r} is not a number "
                    f"(decimal mark {decimal!r}); leave the cell empty if the sample is missing"
                )
    return LogError(f"{table.path}: cannot be read as numbers; export it as CSV")


def _check_samples(table: _Table, found: Mapping[str, _Column], values: Mapping[str, Array]) -> None:
    t = values["time"]
    require(
        t.size >= MIN_SAMPLES,
        f"{table.path}: {t.size} samples are too few; at least {MIN_SAMPLES} are needed",
        LogError,
    )
    for channel, column in values.items():
        missing = np.isnan(column)
        where = f"column {table.header[found[channel].place]!r}"
        require(not missing.all(), f"{table.path}: {where} is empty; leave it out", LogError)
        if channel == "time":
            row = int(np.argmax(missing)) + 2
            require(
                not missing.any(), f"{table.path}: row {row}, {where}: the time is missing; delete the row", LogError
            )
    late = np.flatnonzero(np.diff(t) <= 0)
    if late.size:
        row = int(late[0]) + 3
        kind = "repeats" if t[row - 2] == t[row - 3] else "runs backwards"
        raise LogError(
            f"{table.path}: row {row}: time {kind} ({t[row - 3]:.9g} s, then {t[row - 2]:.9g} s); "
            "delete the row, or cut the log there"
        )
