"""Results of the solvers: `Solution` of a problem with costs and limits, `Fit` of a least squares."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pneuopt.dynamics.compiled.rollout import RolloutResult
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.equations import NormalEquations


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution of a problem with costs and limits.

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


@dataclass(frozen=True, eq=False)
class Optimum:
    """The equations and the run at the end of a search, from which the residuals are diagnosed.

    Attributes
    ----------
    equations : NormalEquations
    run : RolloutResult
        With states, by the finest steps.
    nodes : ndarray, shape (m, n_states)
    values : ndarray
        All the problem's parameter values.
    keep : ndarray of bool, shape (k,)
        The free parameters that have a covariance.
    gap_deviations : ndarray, shape (n_states,)
        Standard deviations of the gaps, in nominal sizes.
    substeps : int
        Integration steps a sample of the sensitivities.
    """

    equations: NormalEquations
    run: RolloutResult
    nodes: Array
    values: Array
    keep: Mask
    gap_deviations: Array
    substeps: int


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a least squares: states over time, parameters, and how well the data determine them.

    Attributes
    ----------
    trajectories : tuple of Trajectory
        States and outputs, one a phase.
    parameters : ParameterSet
        The problem's parameters with the free ones solved for.
    status : Status
    stats : mapping of str to float
        Iterations, seconds, final cost, largest gap, ...
    covariance : ndarray, shape (k, k), or None
        Of the free parameters in their own units, at unit noise scale; None where the data do not determine them.
    chi_square : float
        Sum of squared data residuals, in noise standard deviations.
    count : int
        Number of data residuals.
    at_bound : ndarray of bool, shape (k,)
        Which parameters are at a bound, without those held by equal bounds.
    jumps : ndarray, shape (m, n_states), or None
        The gap behind each linked segment, in nominal sizes, if the gaps stand for noise of the states.
    unidentifiable : tuple of str
        The parameters that the data do not determine here; a caller holds them, and fits again.
    unsettled : tuple of str
        The parameter along which the search was still moving when it gave up; empty where it ended otherwise.
    prior_covariance : ndarray, shape (k, k), or None
        The covariance due to a weak prior of held parameters (`NormalEquations.prior_covariance`); None where nothing
        is held.
    variance_inflation : float
        Factor on the estimates' variance by weighted squares (robust losses).
    optimum : Optimum or None
        None where there is no covariance.
    stage_costs : tuple of (float, float)
        The gap and the cost at the end of the stages from the third, and of the search.
    """

    trajectories: tuple[Trajectory, ...]
    parameters: ParameterSet
    status: Status
    stats: Mapping[str, float]
    covariance: Array | None
    chi_square: float
    count: int
    at_bound: Mask
    jumps: Array | None = None
    unidentifiable: tuple[str, ...] = ()
    unsettled: tuple[str, ...] = ()
    prior_covariance: Array | None = None
    variance_inflation: float = 1.0
    optimum: Optimum | None = None
    stage_costs: tuple[tuple[float, float], ...] = ()

    def with_effort_of(self, *earlier: "Fit") -> "Fit":
        """The fit with the iterations and seconds of earlier ones added to its own."""
        total = {n: sum(fit.stats[n] for fit in (*earlier, self)) for n in ("iterations", "seconds")}
        return replace(self, stats={**self.stats, **total})
