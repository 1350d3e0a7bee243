"""Reader of MATLAB's .mat logs, versions 4 to 7: one vector a channel, or a structure of vectors."""

import io
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

_STRUCTURE_REMEDY = "in MATLAB, save('run.mat', '-struct', 'S') with S a structure of vectors; of a table T, "
_STRUCTURE_REMEDY += "S = table2struct(T, 'ToScalar', true)"


def read_table(path: Path, raw: bytes) -> Table:
    """Read a .mat file.

    Parameters
    ----------
    path : Path
        For messages.
    raw : bytes
        Its vectors of real numbers are columns, and so are those in its structures, by the name of their field; NaN is
        a missing sample. Whatever else the file holds is left alone.

    Returns
    -------
    Table
        Its first sample is row 1, MATLAB's index 1.

    Raises
    ------
    LogError
        If the file is not a .mat file of these versions, or holds no vector.
    """
    columns = [(name, value) for name, value in _flatten(_load(path, raw)) if _is_vector(value)]
    require(bool(columns), f"{path}: no vector of numbers; {_STRUCTURE_REMEDY}", LogError)
    return Table(path, [name for name, _ in columns], 1, partial(_read_columns, path, dict(columns)))


def _load(path: Path, raw: bytes) -> Mapping[str, Any]:
    from scipy.io import loadmat

    try:
        file: Any = io.BytesIO(raw)  # which the types do not know
        return loadmat(file, squeeze_me=True)
    except NotImplementedError:
        remedy = "in MATLAB, save it with the option '-v7'"
        raise LogError(f"{path}: a .mat file of version 7.3 (HDF5) is not read; {remedy}") from None
    except Exception as error:  # scipy raises whatever a damaged file makes it raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise LogError(f"{path}: cannot be read as a .mat file ({reason}); save the log again") from None


def _flatten(variables: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Variables by name, and in place of a structure its fields."""
    found: list[tuple[str, Any]] = []
    for name, value in variables.items():
        if isinstance(value, np.ndarray) and value.dtype.names and value.shape == ():
            found += [(field, value[field].item()) for field in value.dtype.names]
        elif not name.startswith("__"):  # loadmat's own, such as "__header__"
            found.append((name, value))
    return found


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiub"


def _read_columns(path: Path, columns: Mapping[str, Array], names: Sequence[str]) -> dict[str, Array]:
    for name in names[1:]:
        n, first = columns[name].size, columns[names[0]].size
        text = f"{path}: column {name!r} has {n} samples, column {names[0]!r} has {first}; export them at one rate"
        require(n == first, text, LogError)
    return {name: columns[name].astype(float) for name in names}
