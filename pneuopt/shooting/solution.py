"""What every solver of `shooting` hands back."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Status
from pneuopt.quantities.trajectories import Trajectory


@dataclass(frozen=True, eq=False)
class Solution:
    """What every solver returns.

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
