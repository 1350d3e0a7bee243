"""`RowFile`: the rows of a study in a CSV or Parquet file while it runs, whole ones at every moment.

A row is appended to a CSV by one write, so a study that is killed leaves whole rows. A Parquet file is valid only with
the footer at its end, and parts in a folder would be many small files: the whole file is written anew from time to
time, under another name that replaces the old one. What came since the last time is in the journal alone.
"""

import csv
import io
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Protocol

from pneuopt.logs.libraries import import_extra
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.output import format_cell, write_bytes, write_text

PARQUET = ".parquet"
"""What the name of a file ends in that is Parquet; any other is CSV."""
LAST_COLUMNS = ("seconds", "error")
_REWRITE_SECONDS = 5.0  # least time between two Parquet files [s]: less writes without end, more is lost with a kill
_REWRITE_SHARE = 0.05  # most of the time that may go into writing them [1]
_Row = Mapping[str, Any]


class RowFile:
    """A file with a row for each case that a study has computed, in the order in which they came; for a `Journal`.

    Parameters
    ----------
    path : str or Path
        Parquet where it ends in ".parquet" (needs pyarrow), else CSV. A file that is there is replaced with the first
        row.
    heading : callable, optional
        Gives a column's heading by its name, with its unit for instance.

    Attributes
    ----------
    path : Path
    problem : str
        Why rows are missing, a full disk; empty where none are.

    Raises
    ------
    InputError
        If pyarrow is not installed and the file is Parquet.

    Examples
    --------
    >>> import tempfile
    >>> rows = RowFile(Path(tempfile.mkdtemp()) / "rows.csv")
    >>> rows.extend([{"case": "a", "mass": 2.0, "seconds": 0.5, "error": ""}])
    >>> rows.extend([{"case": "b", "mass": 3.0, "peak": 0.1, "seconds": 0.5, "error": ""}])  # a new column
    >>> print(rows.path.read_text("utf-8").strip())
    case,mass,peak,seconds,error
    a,2,,0.5,
    b,3,0.1,0.5,
    >>> rows.close(finished=True)
    """

    def __init__(self, path: str | Path, heading: Callable[[str], str] = str) -> None:
        self.path, self.problem = Path(path), ""
        kind, last = _ParquetRows if self.path.suffix.lower() == PARQUET else _CsvRows, map(heading, LAST_COLUMNS)
        self._sink: _Sink = kind(self.path, tuple(last))
        self._heading = heading

    def extend(self, rows: Iterable[_Row]) -> None:
        """Add rows; those of the first call, what an earlier run computed, replace what is in the file, all at once."""
        named = [{self._heading(n): value for n, value in row.items()} for row in rows]
        self._try(lambda: self._sink.extend(named) if named else None)

    def close(self, *, finished: bool) -> None:
        """Write what is not written yet; the file is deleted where the study is done, whose own table has all rows."""
        self._try(self._sink.close)
        if finished:
            self.path.unlink(missing_ok=True)

    def _try(self, step: Callable[[], None]) -> None:
        """A full disk does not end the study; what it keeps out is written with the next rows."""
        try:
            step()
            self.problem = ""
        except (OSError, InputError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            self.problem = f"{self.path}: lacks rows ({reason}); the table at the end has them all"


class _Sink(Protocol):
    def extend(self, rows: Sequence[_Row]) -> None: ...

    def close(self) -> None: ...


class _CsvRows:
    """Rows appended to a CSV; a new column rewrites it."""

    def __init__(self, path: Path, last: Sequence[str]) -> None:
        self._path, self._last, self._columns, self._waiting = path, last, list[str](), list[_Row]()
        self._file: IO[bytes] | None = None
        self._size = 0

    def extend(self, rows: Sequence[_Row]) -> None:
        self._waiting += rows
        columns = _order([self._columns, *self._waiting], self._last)
        if self._file is None or columns != self._columns:
            self._rewrite(columns)
        else:
            self._append(self._file, self._format(columns, self._waiting))
        self._waiting = []

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _append(self, file: IO[bytes], text: str) -> None:
        """One write; a row that has no room is cut off again."""
        content = text.encode()
        try:
            if file.write(content) != len(content):
                raise OSError(None, "No space left on device")
        except OSError:
            file.truncate(self._size)
            raise
        self._size += len(content)

    def _rewrite(self, columns: list[str]) -> None:
        old: Sequence[_Row] = ()
        if self._file is not None:
            self._file.close()
            with self._path.open(encoding="utf-8", newline="") as file:
                old = [dict(row) for row in csv.DictReader(file)]
            self._file = None
        text = self._format(columns, [dict(zip(columns, columns, strict=True))])
        text += self._format(columns, old) + self._format(columns, self._waiting)
        try:
            write_text(self._path, text)
            self._columns = columns
        finally:
            if self._columns:
                self._file = self._path.open("ab", buffering=0)
                self._size = self._path.stat().st_size

    @staticmethod
    def _format(columns: Sequence[str], rows: Iterable[_Row]) -> str:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([format_cell(row.get(n)) for n in columns] for row in rows)
        return text.getvalue()


class _ParquetRows:
    """Rows in memory, written as a whole file from time to time."""

    def __init__(self, path: Path, last: Sequence[str]) -> None:
        import_extra("pyarrow", "pyarrow", path, "Parquet", "parquet")
        self._path, self._count, self._due, self._is_written = path, 0, 0.0, True
        self._last, self._columns = last, dict[str, list[Any]]()

    def extend(self, rows: Sequence[_Row]) -> None:
        for row in rows:
            for n in (n for n in row if n not in self._columns):
                self._columns[n] = [None] * self._count
            for n, column in self._columns.items():
                column.append(row.get(n))
            self._count += 1
        self._is_written = False
        if time.monotonic() >= self._due:
            self.close()

    def close(self) -> None:
        if self._is_written:
            return
        begun = time.monotonic()
        write_bytes(self._path, parquet_bytes({n: self._columns[n] for n in _order([self._columns], self._last)}))
        self._is_written, now = True, time.monotonic()
        self._due = now + max(_REWRITE_SECONDS, (now - begun) / _REWRITE_SHARE)


def parquet_bytes(columns: Mapping[str, Sequence[Any]]) -> bytes:
    """A table as the content of a Parquet file; a column of numbers and texts becomes one of texts."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(values: Sequence[Any]) -> Any:
        try:
            return pa.array(values)
        except (pa.ArrowInvalid, pa.ArrowTypeError):
            return pa.array([str(v) if v == v and v is not None else None for v in values])  # noqa: PLR0124 - NaN

    with io.BytesIO() as file:
        pq.write_table(pa.table({n: column(values) for n, values in columns.items()}), file)
        return file.getvalue()


def _order(rows: Iterable[Iterable[str]], last: Sequence[str]) -> list[str]:
    """All columns in the order in which they came, time and error last."""
    seen = dict.fromkeys(n for row in rows for n in row)
    return [*(n for n in seen if n not in last), *(n for n in last if n in seen)]
