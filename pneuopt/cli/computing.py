"""How the cases of a study are computed and kept, as the options of `pneuopt study` say it."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace

from pneuopt.cli.shared import Outputs, add_to_stem, file_hashes, warn
from pneuopt.files.study import Study
from pneuopt.quantities.errors import require
from pneuopt.studies.cluster import open_executor
from pneuopt.studies.journal import Journal
from pneuopt.studies.processes import Processes
from pneuopt.studies.row_file import RowFile

SO_FAR = "so_far"
"""What the name of the file ends in that shows the rows of a study that runs."""


@dataclass(frozen=True)
class Computing:
    """How the cases of a study are computed.

    Attributes
    ----------
    executor : str
        As for `open_executor`; empty: one process a CPU.
    seconds, megabytes : float
        What a case may take.
    resume : bool
        Whether there must be a journal of this study.
    """

    executor: str = ""
    seconds: float = math.inf
    megabytes: float = math.inf
    resume: bool = False

    @contextmanager
    def open(self) -> Iterator[Executor | Processes]:
        """Open the executor."""
        limits = Processes(None, self.seconds, self.megabytes)
        if not self.executor:
            yield limits
            return
        here = self.executor.isdecimal() or limits == Processes()
        require(here, f"--time-limit and --memory-limit hold in processes of this machine, not on {self.executor}")
        with open_executor(self.executor) as executor:
            yield replace(limits, count=executor.count) if isinstance(executor, Processes) else executor


@contextmanager
def keep_cases(
    study: Study, outputs: Outputs, count: int, resume: bool, heading: Callable[[str], str] = str
) -> Iterator[Journal | None]:
    """Keep the cases as they come, beside the file that is asked for; for people to read with these headings."""
    place = outputs.output or outputs.json
    if place is None:
        require(not resume, "--resume goes on where the file of -o or --json was left: name it")
        yield None
        return
    hashes = file_hashes(study.path, study.drive, study.tuning)
    rows = None if outputs.output is None else RowFile(add_to_stem(outputs.output, SO_FAR), heading)
    journal = Journal(place.with_name(f"{place.name}.journal"), hashes, resume=resume, rows=rows)
    if journal.known:
        warn(f"{journal.path}: {len(journal.known)} of {count} cases are known from an earlier run of this study")
    try:
        yield journal
    finally:
        journal.close(finished=False)
        for problem in (journal.problem, rows.problem if rows else ""):
            if problem:
                warn(problem)
