"""How a computation ended, in words that name the remedy, and how it reports on its way."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

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
