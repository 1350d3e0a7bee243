"""Reader of Parquet logs, as pandas, Spark and data loggers write them; needs pyarrow, the extra `logs`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


def read_table(path: Path, raw: bytes) -> Table:
    """Read a Parquet file.

    Parameters
    ----------
    path : Path
        For messages.
    raw : bytes
        Its columns that are used hold integers, floats or decimals; a null or NaN is a missing sample.

    Returns
    -------
    Table
        Its first sample is row 1.

    Raises
    ------
    LogError
        If the file is not Parquet.
    InputError
        If pyarrow is not installed.
    """
    with _parquet_file(path, raw) as file:
        return Table(path, file.schema_arrow.names, 1, partial(_read_columns, path, raw))


@contextmanager
def _parquet_file(path: Path, raw: bytes) -> "Iterator[pq.ParquetFile]":
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError(f"{path}: Parquet needs pyarrow; run: pip install 'pneuopt[logs]'") from None
    try:
        with pq.ParquetFile(pa.BufferReader(raw)) as file:
            yield file
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise LogError(f"{path}: cannot be read as Parquet ({reason}); export the log again") from None


def _read_columns(path: Path, raw: bytes, names: Sequence[str]) -> dict[str, Array]:
    with _parquet_file(path, raw) as file:
        places = [file.schema_arrow.names.index(name) for name in names]
        columns = file.read()
    return {name: _floats(path, name, columns.column(i)) for name, i in zip(names, places, strict=True)}


def _floats(path: Path, name: str, column: "pa.ChunkedArray") -> Array:
    import numpy as np
    import pyarrow as pa

    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)):
        row, cell = next(((i, c) for i, c in enumerate(column.to_pylist(), 1) if c is not None), (1, None))
        raise LogError(
            f"{path}: row {row}, column {name!r}: {cell!r} is not a number, as the column's type is {kind}; "
            "store the column as float64"
        )
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=float)
