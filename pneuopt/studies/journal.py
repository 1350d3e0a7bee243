"""`Journal`: the cases of a study on the disk as they come, so that a study that ends early goes on where it was."""

import hashlib
import json
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.provenance import provenance
from pneuopt.studies.outcome import CaseValues, Outcome
from pneuopt.studies.row_file import RowFile

_SYNC_SECONDS = 1.0
"""Time between two waits for the disk [s]: only what came since is lost where the machine itself loses power; a wait a
case slows quick cases down. A process that is killed loses nothing."""


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
    rows : RowFile or None

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
        study = {**({"study": identity} if isinstance(identity, str) else identity), **_versions()}
        try:
            lines = self.path.read_bytes().splitlines() if self.path.exists() else []
            head = _parse(lines[0]) if lines else None
            before = head.get("study") if isinstance(head, dict) else None
            if resume:
                self._check_study(before, study)
            entries = _read_entries(lines[1:]) if before == study else {}
            self._marks = {name: mark for name, (mark, _) in entries.items()}
            self.known: Mapping[str, Outcome] = {name: outcome for name, (_, outcome) in entries.items()}
            self._count, self._synced, self._is_cut = len(self.known), 0.0, before == study
            self._file: IO[str] = self.path.open("a" if before == study else "w", encoding="utf-8")
            self._write([] if before == study else [json.dumps({"study": study})])
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror}); check the folder") from None

    def find(self, name: str, mark: str) -> Outcome | None:
        """What an earlier run computed for a case with the same values, by their mark; None where there is nothing."""
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

    def show(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Put rows of the study's table into the file that shows them, if there is one."""
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
        if time.monotonic() - self._synced > _SYNC_SECONDS:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()

    def _check_study(self, before: object, study: Mapping[str, str]) -> None:
        """Raise `InputError` unless the file is of this study."""
        if not isinstance(before, dict):
            raise InputError(f"{self.path}: there is nothing to resume; leave out --resume, resume=True in Python")
        changed = [n for n in {**before, **study} if before.get(n) != study.get(n)]
        if changed:
            raise InputError(
                f"{self.path}: is of another study, {', '.join(changed)} changed since; put that back, or begin anew "
                "without --resume, resume=True in Python"
            )


class CaseMarks:
    """Hashes of cases: two have the same mark if all their parameters agree.

    Parameters
    ----------
    parameters : ParameterSet
        What the cases have in common.
    """

    def __init__(self, parameters: ParameterSet) -> None:
        self._common = hashlib.sha256(repr(dict(parameters)).encode())

    def of(self, values: CaseValues) -> str:
        """The mark of a case."""
        mark = self._common.copy()
        own = dict(values) if isinstance(values, ParameterSet) else {n: float(v) for n, v in values.items()}
        mark.update(repr(sorted(own.items(), key=lambda entry: entry[0])).encode())
        return mark.hexdigest()[:16]


def _describe_failure(path: Path, error: OSError) -> str:
    return f"{path}: cannot be written ({error.strerror}); cases are not kept, make room and run the study again"


def _versions() -> dict[str, str]:
    """What computes, by name and version."""
    return {f"version of {name}": version for name, version in provenance().items() if name != "options"}


def _read_entries(lines: list[bytes]) -> dict[str, tuple[str, Outcome]]:
    """Marks and outcomes of the lines that are whole, by case; of a case that is there twice, the last."""
    entries = [entry for entry in map(_parse, lines) if isinstance(entry, dict) and {"case", "of"} <= entry.keys()]
    return {
        e["case"]: (e["of"], Outcome(e["results"], float(e.get("seconds", 0.0)))) for e in entries if "results" in e
    }


def _parse(line: bytes) -> object:
    """What a line says; None where it was cut."""
    try:
        return json.loads(line)
    except ValueError:
        return None
