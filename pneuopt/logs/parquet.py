"""Reader of Parquet logs, as pandas, Spark and data loggers write them; needs pyarrow, the extra `parquet`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.logs.arrays import array_table
from pneuopt.logs.budget import check_cells
from pneuopt.logs.layout import plain_unit
from pneuopt.logs.libraries import foreign_code, import_extra
from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


def read_table(path: Path, raw: bytes) -> Table:
    """Read a Parquet file; its first sample is row 1.

    Its columns that are used hold integers, floats or decimals, or, for the time, stamps or durations; a null or NaN is
    a missing sample.
    """
    with _parquet_file(path, raw) as file:
        fields = list(file.schema_arrow)
        check_cells(path, file.metadata.num_rows, len(fields))
    stamps = frozenset(field.name for field in fields if _is_time(field.type))
    units = {field.name: unit for field in fields if (unit := _unit(field))}
    return Table(path, [field.name for field in fields], 1, partial(_read_columns, path, raw), units, stamps)


@contextmanager
def _parquet_file(path: Path, raw: bytes) -> "Iterator[pq.ParquetFile]":
    import_extra("pyarrow", "pyarrow", path, "Parquet", "parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    with foreign_code(path, "Parquet"), pq.ParquetFile(pa.BufferReader(raw)) as file:
        yield file


def _read_columns(path: Path, raw: bytes, names: Sequence[str]) -> dict[str, Array]:
    with _parquet_file(path, raw) as file:
        places = [file.schema_arrow.names.index(name) for name in names]
        columns = file.read()
        return {name: _floats(path, name, columns.column(i)) for name, i in zip(names, places, strict=True)}


def _is_time(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return bool(pa.types.is_timestamp(kind) or pa.types.is_duration(kind))


def _unit(field: "pa.Field") -> str:
    """What a field's metadata say, by the key that several loggers use."""
    metadata = field.metadata or {}
    said = next((metadata[key].decode(errors="replace") for key in (b"unit", b"units") if key in metadata), "")
    return plain_unit(said) or said


def _floats(path: Path, name: str, column: "pa.ChunkedArray") -> Array:
    import numpy as np
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
