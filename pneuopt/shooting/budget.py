"""`CpuBudget`: a search that may not last longer than a stated CPU time, and ends with the best that it has found."""

import time

from pneuopt.quantities.errors import require
from pneuopt.quantities.status import Code, Status


class BudgetSpentError(KeyboardInterrupt):
    """A CPU budget has ended; whatever keeps its best result at Ctrl-C keeps it here, too."""


class CpuBudget:
    """CPU time that may be spent, from now on.

    Parameters
    ----------
    seconds : float
        Of this process, all its threads together [s]; infinite: no budget.

    Raises
    ------
    InputError
        If it is not positive.
    """

    def __init__(self, seconds: float) -> None:
        require(seconds > 0, f"cpu_seconds must be positive, got {seconds:g}; leave it out for a search to its end")
        self.seconds, self._end = seconds, time.process_time() + seconds

    @property
    def is_spent(self) -> bool:
        """Whether no time is left."""
        return time.process_time() >= self._end

    def part(self, share: float) -> "CpuBudget":
        """A budget of this share [1] of the time that is left."""
        return CpuBudget(max(share * (self._end - time.process_time()), 1e-9))

    def check(self) -> None:
        """Raise `BudgetSpentError` if no time is left."""
        if self.is_spent:
            raise BudgetSpentError

    def name_end(self, status: Status) -> Status:
        """The status of a search, which names this budget first where it has ended the search."""
        if status.converged or not self.is_spent:
            return status
        verdict = f"the CPU budget of {self.seconds:g} s is spent: these are the best values so far"
        details = () if status.code is Code.INTERRUPTED else status.sentences
        return Status(Code.BUDGET, (verdict, *details, "give more, or begin with these values: start="))
