"""`Progress`: what a long computation says on its way, to whoever has asked for it by `progress=`."""

import time
from collections.abc import Callable


class Progress(str):
    """A report of a computation on its way: a line of text, which knows what it belongs to.

    Parameters
    ----------
    text : str
        What is done now, or the best so far; the report itself is this text.
    job : str
        The function that computes: "identify", "tune", "sweep" and so on.
    seconds : float
        Time since it began [s].
    done, total : int, optional
        Steps done, and of how many, where that is known: the cases of a study. A search does not know its length.

    Examples
    --------
    >>> report = Progress("3 of 12 cases", "sweep", 1.5, 3, 12)
    >>> report, report.job, report.done
    ('3 of 12 cases', 'sweep', 3)
    """

    __slots__ = ("done", "job", "seconds", "total")
    job: str
    seconds: float
    done: int | None
    total: int | None

    def __new__(
        cls, text: str, job: str = "", seconds: float = 0.0, done: int | None = None, total: int | None = None
    ) -> "Progress":
        """A report; parameters as of the class."""
        report = super().__new__(cls, text)
        report.job, report.seconds, report.done, report.total = job, seconds, done, total
        return report


class ProgressReporter:
    """Passes lines of text on as reports of a job, with the time since it was made.

    Parameters
    ----------
    receive : callable or None
        Takes a `Progress`; None: nobody listens.
    """

    def __init__(self, receive: Callable[[Progress], None] | None, job: str) -> None:
        self._receive, self._job, self._begun = receive, job, time.perf_counter()

    def __call__(self, text: str, done: int | None = None, total: int | None = None) -> None:
        """Pass a line on."""
        if self._receive is not None:
            self._receive(Progress(text, self._job, time.perf_counter() - self._begun, done, total))
