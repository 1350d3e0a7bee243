"""Columns that a file holds as arrays: numbers, or times, as floats."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pneuopt.logs.budget import check_cells
from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require


def array_table(
    path: Path | str, columns: Mapping[str, Any], units: Mapping[str, str], remarks: Sequence[str] = ()
) -> Table:
    """A table of arrays.

    Parameters
    ----------
    path : Path or str
        For messages.
    columns : mapping of str to array_like
        By name. Those of dates or durations are read as seconds from the first.
    units : mapping of str to str
        Those that the file states.

    Returns
    -------
    Table
        Its first sample is row 1.
    """
    stamps = frozenset(name for name, column in columns.items() if np.asarray(column).dtype.kind in "Mm")
    return Table(path, list(columns), 1, partial(_read_columns, path, columns), units, stamps, tuple(remarks))


def _read_columns(path: Path | str, columns: Mapping[str, Any], names: Sequence[str]) -> dict[str, Array]:
    arrays = {name: np.asarray(columns[name]) for name in names}
    for name, array in arrays.items():
        n, first = array.size, arrays[names[0]].size
        text = f"{path}: column {name!r} has {n} samples, column {names[0]!r} has {first}; export them at one rate"
        require(n == first and array.ndim == 1, text, LogError)
        check_cells(path, n, len(names))
    return {name: _floats(path, name, array) for name, array in arrays.items()}


def _floats(path: Path | str, name: str, column: Any) -> Array:
    if column.dtype.kind in "fiub":
        return np.asarray(column, dtype=float)
    if column.dtype.kind in "Mm":
        return _seconds_from_first(column)
    try:
        return np.array([np.nan if cell is None else _number(cell) for cell in column.tolist()])
    except (TypeError, ValueError, ArithmeticError):
        row, cell = next((i, c) for i, c in enumerate(column.tolist(), 1) if not _is_number(c))
        raise LogError(
            f"{path}: row {row}, column {name!r}: {str(cell)[:40]!r} is not a number; store the column as float64"
        ) from None


def _seconds_from_first(column: Any) -> Array:
    counts = column.astype(column.dtype.kind + "8[ns]").astype(np.int64)
    missing = np.isnat(column)
    start = counts[~missing][0] if not missing.all() else 0
    return np.where(missing, np.nan, (counts - start) / 1e9)


def _number(cell: Any) -> float:
    """A number, a decimal or a missing one, not text."""
    if isinstance(cell, str | bytes | bool):
        raise TypeError(cell)
    return float(cell)


def _is_number(cell: Any) -> bool:
    try:
        _number(0 if cell is None else cell)
    except (TypeError, ValueError, ArithmeticError):
        return False
    return True
