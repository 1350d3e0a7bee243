"""How a solver ended, in words that name the remedy, and what it hands back."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory


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


@dataclass(frozen=True, eq=False)
class Solution:
    """What every solver of `nlp` returns.

    Attributes
    ----------
    trajectories : tuple of Trajectory
        States and outputs, one a phase.
    parameters : ParameterSet
        The problem's parameters with the free ones solved for.
    status : Status
    stats : mapping of str to float
        Iterations, seconds, final cost, largest gap, ...
    multipliers : mapping of str to float
        Largest absolute multiplier of each limit and of each bound that is active, by name.
    """

    trajectories: tuple[Trajectory, ...]
    parameters: ParameterSet
    status: Status
    stats: Mapping[str, float] = field(default_factory=dict)
    multipliers: Mapping[str, float] = field(default_factory=dict)
