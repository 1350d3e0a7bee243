"""`Journal`: the cases of a study on the disk as they come, so that a study that ends early goes on where it was.

`RowFile`: the rows of a study in a CSV or Parquet file while it runs, whole ones at every moment. A row is appended to
a CSV by one write, so a study that is killed leaves whole rows. A Parquet file is valid only with the footer at its
end, and parts in a folder would be many small files: the whole file is written anew from time to time, under another
name that replaces the old one. What came since the last time is in the journal alone.
"""

import csv
import hashlib
import io
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Protocol

from pneuopt.logs.table import import_extra
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.output import format_cell, write_bytes, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import provenance
from pneuopt.studies.executors import CaseValues, Outcome
from pneuopt.studies.tolerances import REWRITE_SECONDS, REWRITE_SHARE, SYNC_SECONDS

PARQUET = ".parquet"
"""What the name of a file ends in that is Parquet; any other is CSV."""
LAST_COLUMNS = ("seconds", "error")
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
            content = self._format(columns, self._waiting).encode()
            try:
                if self._file.write(content) != len(content):
                    raise OSError(None, "No space left on device")
            except OSError:  # a row that has no room is cut off again
                self._file.truncate(self._size)
                raise
            self._size += len(content)
        self._waiting = []

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

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
        self._due = now + max(REWRITE_SECONDS, (now - begun) / REWRITE_SHARE)


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


class Journal:
    """A file with a line of JSON a case: what a study has computed, which a later run of the same study reads.

    Parameters
    ----------
    path : str or Path
        Made if it is not there. One of another study is begun anew.
    identity : str or mapping of str to str
        What the function of the study depends on: hashes of its inputs, by name. Versions are added to it. Parameters
        and values of a case are checked case by case.
    resume : bool
        Whether the file must be there, and of this study.
    rows : RowFile, optional
        Gets the rows of the table as they come, for people and other programs to read while the study runs; failed
        cases are in it.

    Attributes
    ----------
    known : mapping of str to Outcome
        What an earlier run of the same study computed, by case.
    problem : str
        Why cases could not be kept, a full disk; empty where all are.

    Raises
    ------
    InputError
        If the file cannot be read or written; with `resume` also if it is not there or of another study, with what has
        changed.
    """

    def __init__(
        self, path: str | Path, identity: str | Mapping[str, str], *, resume: bool = False, rows: RowFile | None = None
    ) -> None:
        self.path, self.problem, self.rows = Path(path), "", rows
        study = {"study": identity} if isinstance(identity, str) else dict(identity)
        study |= {f"version of {name}": version for name, version in provenance().items() if name != "options"}
        try:
            lines = self.path.read_bytes().splitlines() if self.path.exists() else []
            head = _parse(lines[0]) if lines else None
            before = head.get("study") if isinstance(head, dict) else None
            if resume and not isinstance(before, dict):
                raise InputError(f"{self.path}: there is nothing to resume; leave out --resume, resume=True in Python")
            known = before if isinstance(before, dict) else {}
            changed = [n for n in {**known, **study} if known.get(n) != study.get(n)]
            if resume and changed:
                message = f"{self.path}: is of another study, {', '.join(changed)} changed since; put that back"
                raise InputError(f"{message}, or begin anew without --resume, resume=True in Python")
            entries = [entry for entry in map(_parse, lines[1:] if before == study else ()) if isinstance(entry, dict)]
            whole = [e for e in entries if {"case", "of", "results"} <= e.keys()]  # a case's last entry counts
            self._marks = {e["case"]: e["of"] for e in whole}
            self.known: Mapping[str, Outcome] = {
                e["case"]: Outcome(e["results"], float(e.get("seconds", 0.0))) for e in whole
            }
            self._count, self._synced, self._is_cut = len(self.known), 0.0, before == study
            self._file: IO[str] = self.path.open("a" if before == study else "w", encoding="utf-8")
            self._write([] if before == study else [json.dumps({"study": study})])
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror}); check the folder") from None

    def find(self, name: str, mark: str) -> Outcome | None:
        """Outcome of a case with the same values in an earlier run, by their mark; None where there is none."""
        return self.known[name] if self._marks.get(name) == mark else None

    def add(self, name: str, mark: str, outcome: Outcome) -> None:
        """Keep what a case gave, by its name and mark; one that failed is computed again by the next run."""
        if outcome.error:
            return
        entry = {"case": name, "of": mark, "results": dict(outcome.results), "seconds": outcome.seconds}
        try:
            self._write([json.dumps(entry)])
            self._count += 1
        except OSError as error:  # a full disk does not end the study
            self._is_cut, self.problem = True, _describe_failure(self.path, error)

    def append_rows(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Append rows of the study's table to the `RowFile`, if there is one."""
        if self.rows is not None:
            self.rows.extend(rows)

    def delete(self) -> None:
        """Delete the files of a study whose table is written."""
        for path in (self.path, *([self.rows.path] if self.rows is not None else [])):
            path.unlink(missing_ok=True)

    def close(self, *, finished: bool) -> None:
        """Close the files; they are deleted where all is done, the journal also where nothing is in it."""
        if self.rows is not None:
            self.rows.close(finished=finished)
        try:
            self._file.close()
        except OSError as error:  # what a full disk has left in the buffer
            self.problem = _describe_failure(self.path, error)
        if finished or not self._count:
            self.path.unlink(missing_ok=True)

    def _write(self, lines: list[str]) -> None:
        """Write whole lines; one that was cut ends first."""
        self._file.write("\n" * self._is_cut + "".join(f"{line}\n" for line in lines))
        self._file.flush()
        self._is_cut = False
        if time.monotonic() - self._synced > SYNC_SECONDS:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()


class CaseMarks:
    """Hashes of cases: two have the same mark if all their parameters, common ones included, agree."""

    def __init__(self, parameters: ParameterSet) -> None:
        self._common = hashlib.sha256(repr(dict(parameters)).encode())

    def of(self, values: CaseValues) -> str:
        """The mark of a case."""
        mark = self._common.copy()
        case = dict(values) if isinstance(values, ParameterSet) else {n: float(v) for n, v in values.items()}
        mark.update(repr(sorted(case.items(), key=lambda entry: entry[0])).encode())
        return mark.hexdigest()[:16]


def _describe_failure(path: Path, error: OSError) -> str:
    return f"{path}: cannot be written ({error.strerror}); cases are not kept, make room and run the study again"


def _parse(line: bytes) -> object:
    """Content of a line; None where it was cut."""
    try:
        return json.loads(line)
    except ValueError:
        return None
