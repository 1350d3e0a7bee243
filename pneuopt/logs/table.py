"""A log as its file has it: named columns of numbers that have no meaning yet, within a budget of bytes and cells."""

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
class LogTable:
    """What a reader of one file format returns; two columns of one name, or too many, are a `LogError`."""

    path: Path | str  # for messages
    names: Sequence[str]  # in the file's order; "" for a column without a name
    first_row: int  # the number that messages give to the row of the first sample
    # Of the names that it takes, each column as floats (n,), NaN where a sample is missing. Nothing else is parsed,
    # because other columns may hold anything. Its `LogError` names row and column of the first cell that is no number.
    read: Callable[[Sequence[str]], Mapping[str, Array]]
    units: Mapping[str, str] = field(default_factory=dict)  # stated apart from the names: in a row, or as a property
    stamps: frozenset[str] = frozenset()  # the columns of time stamps, which `read` gives in seconds from the first
    remarks: tuple[str, ...] = ()  # what the reader did that the user may want to know, a sentence each

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
    """Read a whole file, once; a `LogError` if that fails or it is larger than `most` [byte], a pipe or a device."""
    return read_source(path, most, "cut it, or leave out rows and columns", LogError)


def check_cells(path: Path | str, rows: int, columns: int) -> None:
    """Refuse more samples than the memory is meant for."""
    require(
        rows * columns <= MAX_CELLS,
        f"{path}: {rows} rows of {columns} channels are more than {MAX_CELLS:.0e} samples; cut the log, or read fewer "
        "channels or every tenth row",
        LogError,
    )


def list_rows(rows: Sequence[int], most: int = 8) -> str:
    """List rows in at most so many runs, as in "row 14", or "rows 14 to 20, 31, ... (57 in all)"."""
    if len(rows) == 1:
        return f"row {rows[0]}"
    ends = np.flatnonzero(np.diff(rows) > 1).tolist()
    runs = list(zip([rows[0], *(rows[k + 1] for k in ends)], [*(rows[k] for k in ends), rows[-1]], strict=True))
    shown = ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in runs[:most])
    more = ", ..." if len(runs) > most else ""
    return f"rows {shown}{more}" + (f" ({len(rows)} in all)" if more or len(runs) < len(rows) else "")


Result = TypeVar("Result")


def import_extra(module: str, package: str, path: Path | str, kind: str, extra: str) -> Any:
    """Import the library that reads a kind of file; an `InputError` says how to get it."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{path}: {kind} needs {package}; run: pip install 'pneuopt[{extra}]'") from None


@contextmanager
def foreign_code(path: Path, kind: str) -> Iterator[None]:
    """Run a library on a file that may be damaged, its warnings and log off; its error becomes a `LogError`."""
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
        traceback.clear_frames(error.__traceback__)  # half-made objects are deleted while warnings are off
        text = f"{path}: cannot be read as {kind} ({reason}); save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        logging.root.manager.disable = said
        sys.unraisablehook = unraisable


def run_apart(read: Callable[[Path, bytes], Result], path: Path, raw: bytes, kind: str) -> Result:
    """Run a reader in a process of its own, which a damaged file may end or keep busy, but not ours: a `LogError`."""
    import loky

    executor = loky.ProcessPoolExecutor(1, context=loky.backend.get_context("loky"))
    try:
        return cast("Result", executor.submit(read, path, raw).result(MAX_SECONDS))
    except (loky.process_executor.BrokenProcessPool, FutureTimeoutError):
        text = f"{path}: cannot be read as {kind}: the library fails on it; save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        executor.shutdown(kill_workers=True)


def array_table(path: Path | str, columns: Mapping[str, Any], units: Mapping[str, str]) -> LogTable:
    """A table of arrays, each (n,), its first sample in row 1; dates or durations count in seconds from the first."""
    stamps = frozenset(name for name, column in columns.items() if np.asarray(column).dtype.kind in "Mm")

    def read(names: Sequence[str]) -> dict[str, Array]:
        arrays = {name: np.asarray(columns[name]) for name in names}
        for name, array in arrays.items():
            n, first = array.size, arrays[names[0]].size
            text = f"{path}: column {name!r} has {n} samples, column {names[0]!r} has {first}; export them at one rate"
            require(n == first and array.ndim == 1, text, LogError)
            check_cells(path, n, len(names))
        return {name: _floats(path, name, array) for name, array in arrays.items()}

    return LogTable(path, list(columns), 1, read, units, stamps)


def _floats(path: Path | str, name: str, column: Any) -> Array:
    if column.dtype.kind in "fiub":
        return np.asarray(column, dtype=float)
    if column.dtype.kind in "Mm":
        counts = column.astype(column.dtype.kind + "8[ns]").astype(np.int64)
        missing = np.isnat(column)
        start = counts[~missing][0] if not missing.all() else 0
        return np.where(missing, np.nan, (counts - start) / 1e9)
    numbers = np.full(column.size, np.nan)
    for i, cell in enumerate(column.tolist()):
        try:
            if isinstance(cell, str | bytes | bool):  # of which Python may make a number
                raise TypeError(cell)
            numbers[i] = np.nan if cell is None else float(cell)
        except (TypeError, ValueError, ArithmeticError):
            raise LogError(
                f"{path}: row {i + 1}, column {name!r}: {str(cell)[:40]!r} is not a number; store the column as float64"
            ) from None
    return numbers
