"""How a computation ended, in words that name the remedy, and how it reports on its way."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

ProgressCallback = Callable[[str], None]


class Code(Enum):
    """Why a solver stopped."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged"
    ITERATION_LIMIT = "iteration limit reached"
    INFEASIBLE = "the limits contradict each other"
    DIVERGED = "the iteration left the region where the model is defined"
    NOT_CERTIFIED = "the independent simulation does not confirm the claim"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class Status:
    """A typed end state.

    Attributes
    ----------
    code : Code
    message : str
        One sentence with figures; where it did not converge it names the worst residual and the remedy.
    """

    code: Code
    message: str = ""

    @property
    def converged(self) -> bool:
        """Whether the answer may be trusted."""
        return self.code is Code.CONVERGED

    def __str__(self) -> str:
        lead = "converged" if self.converged else f"NOT converged ({self.code.value})"
        return f"{lead}: {self.message}" if self.message else lead
