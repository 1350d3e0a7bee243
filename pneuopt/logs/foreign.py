"""Readers of foreign formats: LabVIEW, MATLAB, MDF, Parquet, TDMS, Excel; one function and one row of `READERS` each.

A reader takes the path, for messages, and the bytes of a file, and returns a `LogTable` or raises a `LogError`; where a
library reads the format for us, an `InputError` says how to get it.
"""

import io
import math
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from datetime import date
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pneuopt.logs.table import (
    EMPTY_CELL,
    LogTable,
    array_table,
    check_cells,
    check_columns,
    foreign_code,
    import_extra,
    run_apart,
)
from pneuopt.logs.text import (
    MISSING,
    TextBlock,
    decode,
    find_layout,
    has_table,
    is_stamp,
    plain_unit,
    read_delimited,
    read_text,
    seconds_from_first,
)
from pneuopt.logs.tolerances import (
    MAX_BYTES,
    MAX_COLUMNS,
    MAX_DEPTH,
    MAX_EMPTY_ROWS,
    MAX_HEAD_ROWS,
    MAX_LEVELS,
    MAX_MAGNITUDE,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, require

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


_END = "***End_of_Header***"
_TIME = "X_Value"


def read_lvm(path: Path, raw: bytes) -> LogTable:
    """Read a measurement file of one segment; one without a head is read as text.

    Its time is the column X_Value, or, with X_Columns "No", X0 and Delta_X. Rows have the numbers that an editor shows.
    """
    text = decode(path, raw)
    lines = text.rstrip("\n ").split("\n")
    ends = [i for i, line in enumerate(lines) if line.strip(" \t,;") == _END]
    if not ends:
        return read_text(path, text)
    segments = f"{path}: has {len(ends) - 1} segments; save one a file, or one header only"
    require(len(ends) == 2, segments, LogError)
    head = ends[1] + 1
    require(head + 1 < len(lines), f"{path}: a header, but no samples; save the log again", LogError)
    delimiter = next((d for d in "\t,;" if d in lines[0]), "\t")
    rows = [[cell.strip() for cell in line.split(delimiter)] for line in lines[: head + 1]]
    keys = {row[0]: row[1:] for row in rows}
    # the first X_Value is the time, further ones are those of the channels behind them
    names = ["" if name == _TIME else name for name in rows[head]]
    names[names.index("") if "" in names else 0] = "time"
    names = names[: names.index("Comment") if "Comment" in names else len(names) - (not names[-1])]
    require(_TIME in rows[head], f"{path}: row {head + 1} names no {_TIME}; save the log again", LogError)
    labels = zip([name for name in names[1:] if name], keys.get("Y_Unit_Label", []), strict=False)
    units = {**{name: plain_unit(label) or label for name, label in labels if label}, "time": "s"}
    samples = [delimiter.join(line.split(delimiter)[: len(names)]) for line in lines[head + 1 :]]  # without a comment
    block = TextBlock(path, names, samples, delimiter, head + 2)
    grid = _lvm_grid(path, keys) if keys.get("X_Columns", [""])[0] == "No" else None
    remark = f"rows 1 to {head} are read as the head of a LabVIEW measurement file"
    return LogTable(path, names, head + 2, partial(_lvm_columns, block, grid), units, frozenset(), (remark,))


def _lvm_grid(path: Path, keys: Mapping[str, Sequence[str]]) -> tuple[float, float]:
    """Start and step [s] of the time of a file that has no column of it."""
    found = []
    for key in ("X0", "Delta_X"):
        texts = {text for text in keys.get(key, []) if text}
        require(len(texts) == 1, f"{path}: the channels differ in {key}; save them at one rate", LogError)
        try:
            found.append(float(texts.pop().replace(",", ".")))
        except ValueError:
            found.append(math.nan)
    require(all(map(math.isfinite, found)), f"{path}: X0 or Delta_X is not a number; save the log again", LogError)
    return found[0], found[1]


def _lvm_columns(block: TextBlock, grid: tuple[float, float] | None, names: Sequence[str]) -> dict[str, Array]:
    times = [i for i, name in enumerate(block.names) if name in {"time", ""}]
    if grid is not None:
        columns = block.columns([name for name in names if name != "time"])
        time = np.asarray(grid[0] + grid[1] * np.arange(len(block.lines)), dtype=np.float64)
        return {name: time if name == "time" else columns[name] for name in names}
    columns = block.columns(names)
    for i in times[1:]:
        renamed = ["own" if k == i else name for k, name in enumerate(block.names)]
        own = TextBlock(block.path, renamed, block.lines, block.delimiter, block.first_row)
        same = np.array_equal(own.columns(["own"])["own"], own.columns(["time"])["time"])
        require(same, f"{block.path}: the channels have times of their own; save them with one X column", LogError)
    return columns


_STRUCTURE_REMEDY = "in MATLAB, save('run.mat', '-struct', 'S') with S a structure of vectors; of a table T, "
_STRUCTURE_REMEDY += "S = table2struct(T, 'ToScalar', true)"


class _Column(NamedTuple):
    name: str
    values: Any
    unit: str = ""


def read_mat(path: Path, raw: bytes) -> LogTable:
    """Read a .mat file; its first sample is row 1, MATLAB's index 1.

    Its vectors of real numbers are columns, and so are those in its structures, by the name of their field. In a
    structure array, as Simulink's ("Structure With Time") and dSPACE's, each element is a column by its `label` or
    `Name`, and their time is in seconds. NaN is a missing sample. Whatever else the file holds is left alone.
    """
    remedy = "in MATLAB, save it with the option '-v7'"
    require(b"MATLAB 7.3" not in raw[:20], f"{path}: a .mat file of version 7.3 (HDF5) is not read; {remedy}", LogError)
    variables: list[tuple[str, Any]] = []
    with foreign_code(path, "a .mat file"):
        if raw[124:128] in {b"\x00\x01IM", b"\x01\x00MI"}:  # versions 5 to 7
            variables = read_elements(raw)
        else:
            require(0 in raw[:4], "its head names no version from 4 to 7")  # SciPy would read it as version 5
            from scipy.io import loadmat

            file: Any = io.BytesIO(raw)  # which the types do not know
            variables = [(n, v) for n, v in loadmat(file, squeeze_me=True).items() if not n.startswith("__")]
    flat = [column for name, value in variables for column in _flatten(_Column(name, value), 0)]
    columns = [c for c in flat if isinstance(c.values, np.ndarray) and c.values.ndim == 1]
    columns = [c for c in columns if c.values.dtype.kind in "fiub"]
    require(bool(columns), f"{path}: no vector of numbers; {_STRUCTURE_REMEDY}", LogError)
    names = [column.name for column in columns]
    check_columns(path, names)
    units = {column.name: column.unit for column in columns if column.unit}
    return array_table(path, {column.name: column.values for column in columns}, units)


def _flatten(column: _Column, depth: int) -> Iterator[_Column]:
    """A variable, or in place of a structure its fields."""
    value = column.values
    if not isinstance(value, Structure):
        yield column
    elif depth < MAX_DEPTH:
        for element in value.elements:
            signal = _signal(column.name, element)
            if signal is not None:
                yield signal
            elif len(value.elements) == 1:
                for field in value.fields:
                    unit = "s" if field == "time" and "signals" in value.fields else ""  # Simulink's
                    yield from _flatten(_Column(field, element[field], unit), depth + 1)


def _signal(name: str, element: Mapping[str, Any]) -> _Column | None:
    """One signal of Simulink's structure with time (values, label) or of dSPACE's (Data, Name, Unit)."""
    for values, label in (("values", "label"), ("Data", "Name")):
        if values in element and label in element:
            said, unit = element[label], element.get("Unit")
            if name == "X" and not (isinstance(said, str) and said):
                return _Column("time", element[values], "s")
            return _Column(str(said), element[values], unit if isinstance(unit, str) else "")
    return None


_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}


class _ElementType(IntEnum):
    """Types of elements, and classes of arrays."""

    MATRIX = 14
    COMPRESSED = 15
    STRUCTURE_ARRAY = 2
    CHARACTER_ARRAY = 4


class _Element(NamedTuple):
    kind: int
    data: memoryview


class Structure(NamedTuple):
    """A structure, or an array of them: each element's values by field."""

    elements: list[dict[str, Any]]
    fields: tuple[str, ...]


def read_elements(raw: bytes) -> list[tuple[str, Any]]:
    """Read the variables: arrays without dimensions of length one, texts, structures; None for all others.

    The format is that of MathWorks, "MAT-File Format", chapter 1. SciPy's own reader trusts the sizes in a file, as its
    documentation warns: some damaged logs end the whole process.
    """
    order = "<" if raw[126:128] == b"IM" else ">"
    budget, found = MAX_BYTES, []
    for element in _elements(memoryview(raw)[128:], order):
        if element.kind == _ElementType.COMPRESSED:
            unpacked = zlib.decompressobj().decompress(element.data, budget)
            budget -= len(unpacked)
            require(budget > 0, "it unpacks to more than a log's size")
            found += [_variable(inner, order, 0) for inner in _elements(memoryview(unpacked), order)]
        else:
            found.append(_variable(element, order, 0))
    return found


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """The elements in a row; each is padded to 8 bytes, but compressed ones."""
    at = 0
    while at < len(data):
        require(len(data) - at >= 8, "it ends within a tag")
        kind, size = struct.unpack_from(order + "II", data, at)
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            require(size <= 4, "a short element is too long")
        require(start + size <= len(data), "an element is longer than what holds it")
        yield _Element(kind, data[start : start + size])
        at = start + size if kind == _ElementType.COMPRESSED else at + 8 * math.ceil((start + size - at) / 8)


def _variable(element: _Element, order: str, level: int) -> tuple[str, Any]:
    require(element.kind == _ElementType.MATRIX, f"an element of type {element.kind} stands where a variable should")
    require(level < MAX_LEVELS, "it is nested too deep")
    parts = _elements(element.data, order)
    flags = next(parts, None)
    if flags is None:  # an empty cell or field
        return "", None
    require(len(flags.data) == 8, "a variable has no flags")
    word = struct.unpack_from(order + "I", flags.data)[0]
    kind, is_complex = word & 0xFF, bool(word & 0x800)
    if kind not in {_ElementType.STRUCTURE_ARRAY, _ElementType.CHARACTER_ARRAY, *range(6, 16)} or is_complex:
        return "", None
    dims = _next(parts)
    n = len(dims.data) // 4
    require(dims.kind in {5, 6} and 1 <= n <= 32 and len(dims.data) == 4 * n, "an array has no size")
    shape = struct.unpack_from(f"{order}{n}i", dims.data)
    require(min(shape) >= 0 and math.prod(shape) <= MAX_BYTES, "an array has an impossible size")
    name = _text(_next(parts), order)
    if kind == _ElementType.STRUCTURE_ARRAY:
        return name, _structure(parts, math.prod(shape), order, level)
    part = _next(parts)
    if kind == _ElementType.CHARACTER_ARRAY:
        return name, _text(part, order)
    require(part.kind in _NUMBERS, "numbers are none")
    dtype = np.dtype(order + _NUMBERS[part.kind])
    require(len(part.data) == math.prod(shape) * dtype.itemsize, "an array has another size than it says")
    array = np.frombuffer(part.data, dtype).reshape(shape, order="F")
    return name, array.astype(_NUMBERS[part.kind]).squeeze()


def _text(part: _Element, order: str) -> str:
    require(part.kind in _ENCODINGS, "a text is none")
    encoding = _ENCODINGS[part.kind]
    suffix = "" if encoding in {"latin-1", "utf-8"} else "-le" if order == "<" else "-be"
    return bytes(part.data).decode(encoding + suffix, errors="replace").rstrip("\0")


def _structure(parts: Iterator[_Element], count: int, order: str, level: int) -> Structure:
    length, names = _next(parts), bytes(_next(parts).data)
    require(length.kind == 5 and len(length.data) == 4, "a structure has no fields")
    size = struct.unpack_from(order + "i", length.data)[0]
    require(0 < size <= 64 and len(names) % size == 0, "a structure's fields have no names")
    starts = range(0, len(names), size)
    fields = tuple(names[i : i + size].split(b"\0")[0].decode("latin-1") for i in starts)
    require(not fields or count <= MAX_COLUMNS, "a structure array is too long")
    elements = [
        {field: _variable(_next(parts), order, level + 1)[1] for field in fields} for _ in range(count * bool(fields))
    ]
    return Structure(elements, fields)


def _next(parts: Iterator[_Element]) -> _Element:
    part = next(parts, None)
    if part is None:
        raise InputError("a variable ends too early")
    return part


def read_mdf(path: Path, raw: bytes) -> LogTable:
    """Read an MDF file; its first sample is row 1.

    A column is a channel, by its name, or as "name (group 2)" where two groups have one of that name; "time" is the
    master of the group that the channels are of. Channels of groups with different times are refused.
    """
    import_extra("asammdf", "asammdf", path, "MDF", "mdf")
    log = run_apart(_read_mdf_channels, path, raw, kind="MDF")
    names = ["time", *(name for name in log.columns if name.casefold() != "time")]
    units = {name: plain_unit(unit) or unit for name, unit in log.units.items() if unit}

    def read(names: Sequence[str]) -> dict[str, Array]:
        channels = [name for name in names if name != "time"]
        times = [log.times[log.groups[name]] for name in channels]
        text = f"{path}: channels {', '.join(channels)} are of groups with different times; export them at one rate"
        require(all(np.array_equal(t, times[0], equal_nan=True) for t in times), text, LogError)
        columns = {"time": times[0], **{name: log.columns[name] for name in channels}}
        return dict(array_table(path, columns, {}).read(names))

    return LogTable(path, names, 1, read, {**units, "time": "s"})


class _Log(NamedTuple):
    """The numbers of a file: columns and units by name, the group of a column, the times of a group."""

    columns: dict[str, Any]
    units: dict[str, str]
    groups: dict[str, int]
    times: dict[int, Any]


def _read_mdf_channels(path: Path, raw: bytes) -> _Log:
    """Read all channels that hold numbers."""
    import asammdf

    log = _Log({}, {}, {}, {})
    with foreign_code(path, "MDF"), asammdf.MDF(io.BytesIO(raw)) as opened:
        file: Any = opened  # which the types know in part
        # group and index of every channel but the groups' masters, by name
        found = [
            (channel.name, group, index)
            for group, entry in enumerate(file.groups)
            for index, channel in enumerate(entry.channels)
            if file.masters_db.get(group) != index
        ]
        uses = Counter(name for name, _, _ in found)
        places = {name if uses[name] == 1 else f"{name} (group {g})": (g, i) for name, g, i in found}
        rows = [int(file.groups[group].channel_group.cycles_nr) for group, _ in places.values()]
        check_cells(path, sum(rows), 1)
        for name, (group, index) in places.items():
            channel = file.get(group=group, index=index)
            if channel.samples.ndim == 1 and channel.samples.dtype.kind in "fiub":
                log.columns[name], log.units[name] = channel.samples, str(channel.unit or "")
                log.groups[name], log.times[group] = group, channel.timestamps
    return log


def read_parquet(path: Path, raw: bytes) -> LogTable:
    """Read a Parquet file; its first sample is row 1.

    Its columns that are used hold integers, floats or decimals, or, for the time, stamps or durations; a null or NaN is
    a missing sample.
    """
    with _parquet_file(path, raw) as file:
        fields = list(file.schema_arrow)
        check_cells(path, file.metadata.num_rows, len(fields))
    stamps = frozenset(field.name for field in fields if _is_time(field.type))
    texts = {f.name: {k.decode(): v.decode(errors="replace") for k, v in (f.metadata or {}).items()} for f in fields}
    units = {name: unit for name, said in texts.items() if (unit := _unit(said))}
    every = [field.name for field in fields]

    def read(names: Sequence[str]) -> dict[str, Array]:
        with _parquet_file(path, raw) as file:
            columns = file.read()
            return {name: _parquet_numbers(path, name, columns.column(every.index(name))) for name in names}

    return LogTable(path, every, 1, read, units, stamps)


_UNIT_KEYS = ("unit_string", "NI_UnitDescription", "Unit", "unit", "units")


def _unit(properties: Mapping[str, Any]) -> str:
    """The unit of a channel by the keys that National Instruments and several loggers use; empty where none says it."""
    said = next((str(properties[key]) for key in _UNIT_KEYS if properties.get(key)), "")
    return plain_unit(said) or said


@contextmanager
def _parquet_file(path: Path, raw: bytes) -> "Iterator[pq.ParquetFile]":
    import_extra("pyarrow", "pyarrow", path, "Parquet", "parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    with foreign_code(path, "Parquet"), pq.ParquetFile(pa.BufferReader(raw)) as file:
        yield file


def _is_time(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return bool(pa.types.is_timestamp(kind) or pa.types.is_duration(kind))


def _parquet_numbers(path: Path, name: str, column: "pa.ChunkedArray") -> Array:
    import pyarrow as pa

    kind = column.type
    if _is_time(kind):
        times = column.cast(pa.timestamp("ns") if pa.types.is_timestamp(kind) else pa.duration("ns"))
        return array_table(path, {name: times.to_numpy()}, {}).read([name])[name]
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)):
        row, cell = next(((i, c) for i, c in enumerate(column.to_pylist(), 1) if c is not None), (1, None))
        raise LogError(
            f"{path}: row {row}, column {name!r}: {cell!r} is not a number, as the column's type is {kind}; "
            "store the column as float64"
        )
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=float)


def read_tdms(path: Path, raw: bytes) -> LogTable:
    """Read a TDMS file; its first sample is row 1.

    A column is a channel, by its name, or as "group/channel" where two groups have one of that name. Without a channel
    "time", the time of the waveforms is; waveforms of different rates are refused.
    """
    nptdms = import_extra("nptdms", "npTDMS", path, "TDMS", "tdms")
    with foreign_code(path, "TDMS"):
        listed = nptdms.TdmsFile.read_metadata(io.BytesIO(raw))
        check_cells(path, sum(len(channel) for group in listed.groups() for channel in group.channels()), 1)
        file = nptdms.TdmsFile.read(io.BytesIO(raw))
        pairs = [(group.name, channel) for group in file.groups() for channel in group.channels() if len(channel)]
        uses = Counter(channel.name for _, channel in pairs)
        channels = {c.name if uses[c.name] == 1 else f"{group}/{c.name}": c for group, c in pairs}
        columns = {name: channel[:] for name, channel in channels.items()}
        grids = {}  # by channel when the first sample was taken, its time and the step [s]
        for name, channel in channels.items():
            said = channel.properties
            if "wf_increment" in said:
                start = str(said.get("wf_start_time", "")), float(said.get("wf_start_offset", 0.0))
                grids[name] = (*start, float(said["wf_increment"]))
    units = {name: unit for name, channel in channels.items() if (unit := _unit(channel.properties))}
    if not grids or any(name.casefold() == "time" for name in columns):
        return array_table(path, columns, units)
    table = array_table(path, {"time": np.zeros(0), **columns}, {**units, "time": "s"})

    def read(names: Sequence[str]) -> dict[str, Array]:
        named = [name for name in names if name != "time"]
        rates = {grids.get(name) for name in named}
        text = f"{path}: the waveforms of {', '.join(named)} differ in start or step; export them at one rate"
        require(len(rates) == 1 and None not in rates, text, LogError)
        numbers = dict(table.read(named))
        _, start, step = next(grid for grid in rates if grid is not None)
        time = np.asarray(start + step * np.arange(len(numbers[named[0]])), dtype=np.float64)
        return {name: time if name == "time" else numbers[name] for name in names}

    return LogTable(path, table.names, 1, read, table.units, table.stamps)


_MAX_DAYS = (date.max - date(1899, 12, 30)).days + 1  # below it a number is a date of Excel, to the end of 9999-12-31
_SHOWN_DATE = "0:00:00"  # what a date looks like where only its being one counts


class _Date(float):
    """A cell in days that Excel shows as a date or a time."""


def read_xlsx(path: Path, raw: bytes) -> LogTable:
    """Read a workbook; rows have Excel's numbers.

    An empty cell is a missing sample; a formula counts by its last value. Above the names may stand metadata, below
    them a row of units. Dates and times are read to the microsecond, as Excel keeps them.
    """
    openpyxl = import_extra("openpyxl", "openpyxl", path, "an Excel workbook", "xlsx")
    with foreign_code(path, "an Excel workbook"):
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        require(size <= MAX_BYTES, f"{path}: holds {size / 2**20:.0f} MiB of cells; export it as CSV", LogError)
        book = openpyxl.load_workbook(io.BytesIO(raw), read_only=True, data_only=True)
        # openpyxl rounds dates to milliseconds; as numbers they keep all digits.
        date_styles = book._date_formats | book._timedelta_formats
        book._date_formats.clear()
        book._timedelta_formats.clear()
        sheets = {sheet.title: _read_cells(path, sheet, date_styles) for sheet in book.worksheets}
    shown = {title: [[_show(cell) for cell in row] for row in rows[:MAX_HEAD_ROWS]] for title, rows in sheets.items()}
    title = next((title for title, rows in shown.items() if has_table(rows)), next(iter(sheets), ""))
    require(any(shown.values()), f"{path}: no sheet holds cells; it has to name the columns in a row", LogError)
    layout = find_layout(shown[title], str(path))
    rows = [*sheets[title][layout.start :]]
    first = shown[title][layout.start] if layout.start < len(shown[title]) else []
    stamps = frozenset(name for name, cell in zip(layout.names, first, strict=False) if name and is_stamp(cell))
    read = _Sheet(path, layout.names, rows, layout.start + 1, stamps).columns
    others = (f"sheet {title!r} is read, of {len(sheets)}",) if len(sheets) > 1 else ()
    return LogTable(path, layout.names, layout.start + 1, read, layout.units, stamps, layout.remarks + others)


class _Sheet(NamedTuple):
    """The samples of a sheet."""

    path: Path
    names: Sequence[str]
    rows: Sequence[Sequence[Any]]
    first_row: int
    stamps: frozenset[str]

    def columns(self, names: Sequence[str]) -> dict[str, Array]:
        """Read the named columns (n,); stamps as seconds from the first."""
        width = len(self.names)
        for i, row in enumerate(self.rows, self.first_row):
            require(
                len(row) <= width, f"{self.path}: row {i} has {len(row)} cells, the header {width}; mend it", LogError
            )
        columns = {}
        for name in names:
            i = self.names.index(name)
            cells = [row[i] if i < len(row) else None for row in self.rows]
            if name in self.stamps and not isinstance(cells[0], _Date):
                columns[name] = seconds_from_first([_show(cell) for cell in cells], self.path, name, self.first_row)
                continue
            numbers = np.full(len(cells), np.nan)
            for k, cell in enumerate(cells):
                if cell is None or (isinstance(cell, str) and cell.strip() in MISSING):
                    continue
                is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
                place = f"{self.path}: row {k + self.first_row}, column {name!r}"
                require(is_number, f"{place}: {str(cell)[:40]!r} is not a number; {EMPTY_CELL}", LogError)
                numbers[k] = float(cell) if not abs(cell) > MAX_MAGNITUDE else np.inf  # which is refused
            columns[name] = numbers
            if name not in self.stamps:
                continue
            # days become seconds from the first; a time of day leaps back at midnight; a double holds a date to 0.6 us
            wrong = np.flatnonzero(np.abs(numbers) > _MAX_DAYS)
            if wrong.size:
                place = f"{self.path}: row {wrong[0] + self.first_row}, column {name!r}"
                remedy = "write a date with its time, or a number"
                raise LogError(f"{place}: {numbers[wrong[0]]:.6g} is no date of Excel; {remedy}")
            known = numbers[np.isfinite(numbers)]
            days = numbers
            if known.max(initial=0.0) <= 1:
                days = numbers + np.cumsum(np.diff(numbers, prepend=numbers[:1]) < -0.5)
            columns[name] = np.asarray(np.round((days - (known[0] if known.size else 0.0)) * 86400, 6))
        return columns


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
        # not by a cell's own `is_date`, which searches the style's text again for each: a quarter of the time
        dates = [cell.data_type == "n" and cell.value is not None and cell._style_id in date_styles for cell in row]
        rows.append([_Date(c.value) if is_date else c.value for c, is_date in zip(row, dates, strict=True)])
        check_cells(path, len(rows), width)
    while rows and all(cell is None for cell in rows[-1]):
        rows.pop()
    for cells in rows:
        while cells and cells[-1] is None:
            cells.pop()
    return rows


def _show(cell: Any) -> str:
    if isinstance(cell, _Date):
        return _SHOWN_DATE
    return "" if cell is None else str(cell).strip()


READERS: Mapping[str, Callable[[Path, bytes], LogTable]] = {
    ".csv": read_delimited,
    ".txt": read_delimited,
    ".tsv": read_delimited,
    ".dat": read_delimited,
    ".parquet": read_parquet,
    ".mat": read_mat,
    ".lvm": read_lvm,
    ".xlsx": read_xlsx,
    ".tdms": read_tdms,
    ".mf4": read_mdf,
    ".mdf": read_mdf,
}
"""The suffix of a file, in lower case, to the function that reads it."""


def parse_log(path: Path, raw: bytes) -> LogTable:
    """Read a log's columns from the bytes of a file with the reader of its path's suffix."""
    suffix = path.suffix.lower()
    shown = f"{suffix!r} files" if suffix else "a name without suffix"
    require(suffix in READERS, f"{path}: no reader for {shown}; known: {', '.join(READERS)}", LogError)
    return READERS[suffix](path, raw)
