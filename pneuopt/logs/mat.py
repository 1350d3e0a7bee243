"""Reader of MATLAB's .mat logs, versions 4 to 7: vectors, structures of them, Simulink's and dSPACE's structures."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.arrays import array_table
from pneuopt.logs.libraries import foreign_code
from pneuopt.logs.table import Table, check_columns
from pneuopt.quantities.errors import LogError, require

_STRUCTURE_REMEDY = "in MATLAB, save('run.mat', '-struct', 'S') with S a structure of vectors; of a table T, "
_STRUCTURE_REMEDY += "S = table2struct(T, 'ToScalar', true)"
MAX_DEPTH = 4
"""Structures in structures [1]: dSPACE's have 2; more depth finds numbers that are settings."""


class _Column(NamedTuple):
    name: str
    values: Any
    unit: str = ""


def read_table(path: Path, raw: bytes) -> Table:
    """Read a .mat file.

    Parameters
    ----------
    path : Path
        For messages.
    raw : bytes
        Its vectors of real numbers are columns, and so are those in its structures, by the name of their field. In a
        structure array, as Simulink's ("Structure With Time") and dSPACE's, each element is a column by its `label` or
        `Name`, and their time is in seconds. NaN is a missing sample. Whatever else the file holds is left alone.

    Returns
    -------
    Table
        Its first sample is row 1, MATLAB's index 1.

    Raises
    ------
    LogError
        If the file is not a .mat file of these versions, or holds no vector.
    """
    columns = [column for column in _columns(_load(path, raw)) if _is_vector(column.values)]
    require(bool(columns), f"{path}: no vector of numbers; {_STRUCTURE_REMEDY}", LogError)
    names = [column.name for column in columns]
    check_columns(path, names)
    units = {column.name: column.unit for column in columns if column.unit}
    return array_table(path, {column.name: column.values for column in columns}, units)


def _load(path: Path, raw: bytes) -> Mapping[str, Any]:
    from scipy.io import loadmat

    file: Any = io.BytesIO(raw)  # which the types do not know
    with foreign_code(path, "a .mat file"):
        try:
            return loadmat(file, squeeze_me=True)
        except NotImplementedError:
            remedy = "in MATLAB, save it with the option '-v7'"
            raise LogError(f"{path}: a .mat file of version 7.3 (HDF5) is not read; {remedy}") from None
    raise AssertionError  # the context lets no error pass


def _columns(variables: Mapping[str, Any]) -> Iterator[_Column]:
    """Variables by name, and in place of a structure its fields."""
    for name, value in variables.items():
        if not name.startswith("__"):  # loadmat's own, such as "__header__"
            yield from _flatten(_Column(name, value), 0)


def _flatten(column: _Column, depth: int) -> Iterator[_Column]:
    value = column.values
    fields = value.dtype.names if isinstance(value, np.ndarray) else None
    if not fields:
        yield column
        return
    if depth == MAX_DEPTH or value.ndim > 1:
        return
    for element in np.atleast_1d(value):
        signal = _signal(column.name, element, fields)
        if signal is not None:
            yield signal
        elif value.ndim == 0:
            for field in fields:
                unit = "s" if field == "time" and "signals" in fields else ""  # Simulink's
                yield from _flatten(_Column(field, element[field], unit), depth + 1)


def _signal(name: str, element: Any, fields: tuple[str, ...]) -> _Column | None:
    """One signal of Simulink's structure with time (values, label) or of dSPACE's (Data, Name, Unit)."""
    for values, label in (("values", "label"), ("Data", "Name")):
        if values in fields and label in fields:
            said, unit = str(element[label]), str(element["Unit"]) if "Unit" in fields else ""
            is_time = name == "X" and not _is_text(element[label])
            return _Column("time" if is_time else said, element[values], "s" if is_time else unit.strip("[]"))
    return None


def _is_text(value: Any) -> bool:
    return str(value) not in {"", "[]"}


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiub"
