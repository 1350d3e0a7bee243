"""`Table`: a log as its file has it: named columns of numbers that have no meaning yet.

What a log may cost: bytes, columns and cells are bounded before anything is parsed, and a file is read once.

Libraries that read files for us: how to get them, and what to say where they fail.

Columns that a file holds as arrays: numbers, or times, as floats.
"""

import importlib
import logging
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from pneuopt.logs.tolerances import MAX_BYTES, MAX_CELLS, MAX_COLUMNS, MAX_NAME, MAX_SECONDS
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, require
from pneuopt.quantities.output import MAX_REASON, read_source

EMPTY_CELL = "leave the cell empty if the sample is missing, as `pneuopt check --fix FOLDER` does in a copy of the log"
"""What to do about a cell that holds no sample."""


@dataclass(frozen=True)
class Table:
    """What a reader of one file format returns.

    Parameters
    ----------
    path : Path or str
        For messages.
    names : sequence of str
        The columns in the file's order; "" for a column without a name.
    first_row : int
        The number that messages give to the row of the first sample.
    read : callable
        Takes names, and returns these columns as floats, each of shape (n,), NaN where a sample is missing. Nothing
        else is parsed, because other columns may hold anything. It raises a `LogError` that names the row and column of
        the first cell that is not a number.
    units : mapping of str to str
        Units that the file states apart from the names, by column: in a row of units, or as a property.
    stamps : frozenset of str
        The columns of time stamps, which `read` gives in seconds from the first.
    remarks : tuple of str
        What the reader did that the user may want to know, a sentence each: rows that are no samples, say.

    Raises
    ------
    LogError
        If two columns have the same name, or there are more columns, or longer names, than a log has.
    """

    path: Path | str
    names: Sequence[str]
    first_row: int
    read: Callable[[Sequence[str]], Mapping[str, Array]]
    units: Mapping[str, str] = field(default_factory=dict)
    stamps: frozenset[str] = frozenset()
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_columns(self.path, self.names)


def check_columns(path: Path | str, names: Sequence[str]) -> None:
    """Refuse two columns of the same name, and more columns, or longer names, than a log has."""
    n = len(names)
    require(n <= MAX_COLUMNS, f"{path}: {n} columns are more than {MAX_COLUMNS}; export fewer channels", LogError)
    for name, uses in Counter(filter(None, names)).items():
        require(uses == 1, f"{path}: two columns are named {name[:MAX_NAME]!r}; rename one", LogError)
        text = f"{path}: the name of column {name[:20]!r}... has {len(name)} characters; shorten it"
        require(len(name) <= MAX_NAME, text, LogError)


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a whole file, once.

    Parameters
    ----------
    most : int
        Its size [byte] may be.

    Raises
    ------
    LogError
        If it cannot be read, is larger, or is a pipe or a device, which may never end.
    """
    return read_source(path, most, "cut it, or leave out rows and columns", LogError)


def check_cells(path: Path | str, rows: int, columns: int) -> None:
    """Refuse more samples than the memory is meant for."""
    require(
        rows * columns <= MAX_CELLS,
        f"{path}: {rows} rows of {columns} channels are more than {MAX_CELLS:.0e} samples; cut the log, or read fewer "
        "channels or every tenth row",
        LogError,
    )


Result = TypeVar("Result")


def import_extra(module: str, package: str, path: Path | str, kind: str, extra: str) -> Any:
    """Import the library that reads a kind of file, or say how to get it.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{path}: {kind} needs {package}; run: pip install 'pneuopt[{extra}]'") from None


@contextmanager
def foreign_code(path: Path, kind: str) -> Iterator[None]:
    """Run a library on a file that may be damaged: it stays silent, and whatever it raises becomes a `LogError`."""
    said, logging.root.manager.disable = logging.root.manager.disable, logging.CRITICAL
    unraisable, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except LogError:
        raise
    except Exception as error:
        name = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        reason = " ".join(f"{name}{error}".split())[:MAX_REASON]
        traceback.clear_frames(error.__traceback__)  # so that half-made objects die while nobody listens
        text = f"{path}: cannot be read as {kind} ({reason}); save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        logging.root.manager.disable = said
        sys.unraisablehook = unraisable


def run_apart(read: Callable[[Path, bytes], Result], path: Path, raw: bytes, kind: str) -> Result:
    """Run a reader in a process of its own, which a damaged file may end or keep busy, but not ours.

    Raises
    ------
    LogError
        If it does either, or the reader says so.
    """
    import loky

    executor = loky.ProcessPoolExecutor(1, context=loky.backend.get_context("loky"))
    try:
        return cast("Result", executor.submit(read, path, raw).result(MAX_SECONDS))
    except (loky.process_executor.BrokenProcessPool, FutureTimeoutError):
        text = f"{path}: cannot be read as {kind}: the library fails on it; save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        executor.shutdown(kill_workers=True)


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
