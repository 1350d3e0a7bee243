"""`CpuBudget`: the CPU time that an identification may take, after which it hands out the best so far."""

import time
from dataclasses import dataclass, field

from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback, Status


class CpuBudgetSpent(KeyboardInterrupt):
    """The CPU time is over; as Ctrl-C it ends a search, which then returns the best so far."""


@dataclass
class CpuBudget:
    """Receives a line of text an iteration of each search, and ends the search when the time is over.

    Parameters
    ----------
    seconds : float
        CPU seconds of this process, from now on; math.inf for no limit.
    progress : callable, optional
        Receives the lines, too.
    """

    seconds: float
    progress: ProgressCallback | None = None
    began: float = field(default_factory=time.process_time)
    is_spent: bool = False

    def __post_init__(self) -> None:
        require(self.seconds > 0, f"cpu_seconds must be positive, got {self.seconds:g}")

    def __call__(self, line: str) -> None:
        """Pass a line on; raises `CpuBudgetSpent` when the time is over."""
        if self.progress is not None:
            self.progress(line)
        if time.process_time() - self.began > self.seconds:
            self.is_spent = True
            raise CpuBudgetSpent

    def assess(self, status: Status) -> Status:
        """The status of an interrupted fit, with the budget named in the place of Ctrl-C."""
        if not self.is_spent:
            return status
        verdict = f"{self.seconds:g} CPU seconds were over: {status.verdict}"
        return Status(status.code, (verdict, *status.sentences[1:-1], "give more CPU seconds, or a part of the logs"))
