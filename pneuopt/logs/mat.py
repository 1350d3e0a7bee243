"""Reader of MATLAB's .mat logs, versions 4 to 7: vectors, structures of them, Simulink's and dSPACE's structures."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.arrays import array_table
from pneuopt.logs.libraries import foreign_code
from pneuopt.logs.mat_elements import Structure, has_elements, read_elements
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
    """Read a .mat file; its first sample is row 1, MATLAB's index 1.

    Its vectors of real numbers are columns, and so are those in its structures, by the name of their field. In a
    structure array, as Simulink's ("Structure With Time") and dSPACE's, each element is a column by its `label` or
    `Name`, and their time is in seconds. NaN is a missing sample. Whatever else the file holds is left alone.
    """
    variables = (_flatten(_Column(name, value), 0) for name, value in _load(path, raw))
    columns = [column for found in variables for column in found if _is_vector(column.values)]
    require(bool(columns), f"{path}: no vector of numbers; {_STRUCTURE_REMEDY}", LogError)
    names = [column.name for column in columns]
    check_columns(path, names)
    units = {column.name: column.unit for column in columns if column.unit}
    return array_table(path, {column.name: column.values for column in columns}, units)


def _load(path: Path, raw: bytes) -> list[tuple[str, Any]]:
    remedy = "in MATLAB, save it with the option '-v7'"
    require(b"MATLAB 7.3" not in raw[:20], f"{path}: a .mat file of version 7.3 (HDF5) is not read; {remedy}", LogError)
    with foreign_code(path, "a .mat file"):
        if has_elements(raw):
            return read_elements(raw)
        require(0 in raw[:4], "its head names no version from 4 to 7")  # SciPy would read it as version 5
        from scipy.io import loadmat

        file: Any = io.BytesIO(raw)  # which the types do not know
        return [(n, v) for n, v in loadmat(file, squeeze_me=True).items() if not n.startswith("__")]  # loadmat's own
    raise AssertionError  # the context lets no error pass


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


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiub"
