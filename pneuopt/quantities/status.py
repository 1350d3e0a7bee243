"""How a computation ended, in words that name the remedy; what it reports on its way; where a result comes from."""

import functools
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from importlib.metadata import PackageNotFoundError, version

from pneuopt.quantities.report import Line, Report, Tone

ProgressCallback = Callable[[str], None]


class Code(Enum):
    """Why a solver stopped."""

    CONVERGED = "converged"
    PARTIAL = "converged for a part of the parameters"
    MISFIT = "converged, but the model misses the logs"
    NOT_CONVERGED = "not converged"
    ITERATION_LIMIT = "iteration limit reached"
    INFEASIBLE = "no answer found keeps all limits"
    DIVERGED = "the iteration left the region where the model is defined"
    NOT_CERTIFIED = "the independent simulation does not confirm the claim"
    INTERRUPTED = "interrupted"
    BUDGET = "the CPU budget is spent"


@dataclass(frozen=True)
class Status:
    """A typed end state.

    Attributes
    ----------
    sentences : tuple of str
        The verdict first, in less than 100 characters; then details with figures; the remedy last.
    """

    code: Code
    sentences: tuple[str, ...] = ()

    @property
    def converged(self) -> bool:
        """Whether the search ended at an optimum.

        The answer may be trusted unless the code is `Code.MISFIT`; that of `Code.PARTIAL` holds no value of what it
        names as unidentifiable.
        """
        return self.code in (Code.CONVERGED, Code.PARTIAL, Code.MISFIT)

    @property
    def verdict(self) -> str:
        """The first sentence."""
        return self.sentences[0] if self.sentences else self.code.value

    @property
    def message(self) -> str:
        """All sentences on one line, as a file or a table holds them."""
        return "; ".join(self.sentences)

    def with_details(self, *details: str) -> "Status":
        """The status with more details behind its verdict, so that a remedy stays last; empty ones are left out."""
        return replace(self, sentences=(*self.sentences[:1], *filter(None, details), *self.sentences[1:]))

    def with_remedies(self, *remedies: str) -> "Status":
        """The status with more remedies at its end; empty ones are left out."""
        return replace(self, sentences=(*self.sentences, *filter(None, remedies)))

    def __str__(self) -> str:
        lead = self.code.value if self.converged else f"NOT converged ({self.code.value})"
        return "\n  ".join((f"{lead}: {self.sentences[0]}", *self.sentences[1:])) if self.sentences else lead


def report_status(status: Status) -> Report:
    """How a computation ended: the verdict, which a screen shows in colour, then its details, a line each."""
    verdict, *details = str(status).splitlines()
    good = Tone.DOUBTFUL if status.code in (Code.MISFIT, Code.PARTIAL) else Tone.GOOD
    lead = Line(verdict, good if status.converged else Tone.BAD)
    return Report((lead, *(Line(detail.strip(), indent=2) for detail in details)))


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
    """Passes lines of text on as reports of a job, with the time since it was made; None: nobody listens."""

    def __init__(self, receive: Callable[[Progress], None] | None, job: str) -> None:
        self._receive, self._job, self._begun = receive, job, time.perf_counter()

    def __call__(self, text: str, done: int | None = None, total: int | None = None) -> None:
        """Pass a line on."""
        if self._receive is not None:
            self._receive(Progress(text, self._job, time.perf_counter() - self._begun, done, total))


def provenance(*options: object) -> dict[str, str]:
    """The versions of Python and of the packages that computed a result, and the repr of the options that were used."""
    return {
        "pneuopt": _version("pneuopt"),
        "casadi": _version("casadi"),
        "numpy": _version("numpy"),
        "scipy": _version("scipy"),
        "python": platform.python_version(),
        "options": "; ".join(repr(o) for o in options),
    }


@functools.cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
