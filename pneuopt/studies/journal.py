"""`Journal`: the cases of a study on the disk as they come, so that a study that ends early goes on where it was."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from pneuopt.quantities.errors import InputError
from pneuopt.studies.outcome import Outcome


class Journal:
    """A file with a line of JSON a case: what a study has computed, which a later run of the same study reads.

    Parameters
    ----------
    path : str or Path
        Made if it is not there. One of another study is begun anew.
    identity : str
        What the cases depend on: a hash of the inputs, and the version.

    Attributes
    ----------
    known : mapping of str to Outcome
        What an earlier run of the same study computed, by case.

    Raises
    ------
    InputError
        If the file cannot be read or written.
    """

    def __init__(self, path: str | Path, identity: str) -> None:
        self.path = Path(path)
        try:
            lines = self.path.read_bytes().splitlines() if self.path.exists() else []
            same = bool(lines) and _parse(lines[0]) == {"study": identity}
            self.known: Mapping[str, Outcome] = _read_outcomes(lines[1:]) if same else {}
            self._count = len(self.known)
            self._file: IO[str] = self.path.open("a" if same else "w", encoding="utf-8")
            # a line that was cut ends here
            self._write("\n" if same else json.dumps({"study": identity}) + "\n")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror}); check the folder") from None

    def add(self, name: str, outcome: Outcome) -> None:
        """Keep what a case gave; one that failed is computed again by the next run."""
        if not outcome.error:
            entry = {"case": name, "results": dict(outcome.results), "seconds": outcome.seconds}
            with contextlib.suppress(OSError, TypeError):  # a full disk does not end the study
                self._write(json.dumps(entry) + "\n")
                self._count += 1

    def close(self, *, finished: bool) -> None:
        """Close the file; it is deleted where all is done, or nothing is in it."""
        self._file.close()
        if finished or not self._count:
            self.path.unlink(missing_ok=True)

    def _write(self, text: str) -> None:
        self._file.write(text)
        self._file.flush()
        os.fsync(self._file.fileno())


def _read_outcomes(lines: list[bytes]) -> dict[str, Outcome]:
    """The outcomes of the lines that are whole."""
    entries = [entry for entry in map(_parse, lines) if isinstance(entry, dict) and {"case", "results"} <= entry.keys()]
    return {entry["case"]: Outcome(entry["results"], float(entry.get("seconds", 0.0))) for entry in entries}


def _parse(line: bytes) -> object:
    """What a line says; None where it was cut."""
    try:
        return json.loads(line)
    except ValueError:
        return None
