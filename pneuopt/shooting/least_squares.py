"""Soft-continuity multiple shooting: the gaps between segments are weighted residuals, solved by Levenberg-Marquardt.

One nonlinear least squares in all nodes and parameters; each step is a banded Cholesky with an arrow, linear in the
record's length. The gaps are tightened in stages, so that a bad start is never integrated over the whole record,
as single shooting does, which fails there (problems/speed/benchmark_identification.py).
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pneuopt.dynamics.compiled.rollout import RolloutResult, check_during_runs
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations, positive_definite_inverse
from pneuopt.shooting.equations import (
    UNIDENTIFIABLE_PRIOR_RATIO,
    NormalEquations,
    ParameterScaling,
    correct_residuals,
    describe_misfit,
    missed_curvature,
    normal_equations,
    propagate_shifts,
    segment_gaps,
    weigh_gaps,
)
from pneuopt.shooting.segments import (
    IntegrationCorrection,
    IntegrationSteps,
    Segments,
    fine_steps,
    gap_scales,
    segment,
    start_nodes,
)
from pneuopt.shooting.transcription import Transcription


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


# gap [1] beyond which log parameters are drawn to their start: lower biases what tight gaps tell, higher lets them
# drift to where tight gaps cannot tell them any more
WIDE_GAP = 2e-4


@dataclass(frozen=True)
class Stage:
    """A stage of the search: how tight the gaps are, and how long it runs.

    Parameters
    ----------
    gap : float
        Standard deviation of a gap, as a fraction of the state's nominal size.
    iterations : int
        Largest number of iterations.
    refine : int
        Integration steps at the end of the stage, as a multiple of those before. Let the last stage have more than 1:
        with 1 and a gap above `WIDE_GAP` a stage draws log parameters to their start (`has_prior`).
    """

    gap: float
    iterations: int
    refine: int = 1

    @property
    def has_prior(self) -> bool:
        """Whether log parameters are drawn to their start: wide gaps hide what some of them do.

        Not in a stage that may be the last, which refines its steps.
        """
        return self.gap > WIDE_GAP and self.refine == 1


@dataclass(frozen=True)
class LeastSquares:
    """Lifted least squares by Levenberg-Marquardt: a method and its options.

    Parameters
    ----------
    stages : tuple of Stage
        Continuation in the gaps' weight; the last stage decides on convergence.
    segment_time : float
        Time between two shooting nodes [s]; math.inf for one segment a log.
    substeps : int, optional
        Integration steps a sample; default: from the stiffness at the start of each stage, h |lambda| <= 2 a step of
        RK4, or fewer that are implicit in the one state whose own rate asks for these (`choose_integration`); the last
        stage adds what finer steps change, halved until that moves no estimate.
    tolerance : float
        Largest last undamped step of a parameter, in its standard deviations.
    kinematic : float
        States whose rate holds no free parameter keep their gaps this much smaller.
    progress : callable, optional
        Receives one line of text an iteration.
    budget : CpuBudget
        Ends the search as Ctrl-C does, within the run that goes on by then; by default none.
    max_misfit : float
        Squared residuals a sample, in noise variances, beyond which the search ends after the first stage, or before
        the last where the gaps do not absorb the misfit, for a caller who has other starts to try.
    allows_state_noise : bool
        Whether gaps may stand for noise of the states where the model misses the logs with tight ones.
    known_costs : tuple of (float, float)
        Gaps and costs at which a search from another start has ended its stages, none of which explained the logs to
        their noise; a search that comes to the same ends there (`JOINED_SEARCH`).
    checks_steps : bool
        Whether finer integration steps are tried at the end: not where a refit keeps those of a fit that tried them.
    """

    stages: tuple[Stage, ...] = (
        Stage(1e-2, 12),
        Stage(3e-3, 8),
        Stage(1e-3, 8),
        Stage(3e-4, 8),
        Stage(1e-4, 8),
        Stage(1e-5, 30, refine=2),
    )
    segment_time: float = 0.01
    substeps: int | None = None
    tolerance: float = 0.1
    kinematic: float = 0.01
    progress: ProgressCallback | None = field(default=None, repr=False, compare=False)
    budget: CpuBudget = field(default=CpuBudget(math.inf), repr=False, compare=False)
    max_misfit: float = math.inf
    allows_state_noise: bool = True
    known_costs: tuple[tuple[float, float], ...] = field(default=(), repr=False, compare=False)
    checks_steps: bool = field(default=True, repr=False)


def solve_least_squares(transcription: Transcription, method: LeastSquares | None = None) -> Fit:
    """Solve a transcription that has residuals and bounds, but neither costs nor limits.

    Parameters
    ----------
    transcription : Transcription
        Its phases' guesses and its parameters' values are the start.
    method : LeastSquares, optional

    Returns
    -------
    Fit
        Whatever its status; an interruption (Ctrl-C) returns the best iterate so far, marked.
    """
    return Search(segment(transcription), method or LeastSquares()).solve()


# share of the cost [1] that the gaps may carry: above it they absorb the misfit of a model; lower refuses good fits
MAX_GAP_SHARE = 0.05
# squared residuals a sample, in noise variances [1], up to which a fit explains the log to its noise: lower takes
# chance for misfit, higher passes a wrong model
MAX_CHI_SQUARE_RATIO = 1.2
NO_POSITIONS = np.zeros(0, dtype=np.intp)


class ConvergenceTest(NamedTuple):
    """The status of an iterate, and the positions of free parameters that the data do not determine there.

    `unsettled` is the one that would still move most where nothing else is wrong; `largest_step` is that of a converged
    iterate, in standard deviations.
    """

    status: Status
    unidentifiable: Indices = NO_POSITIONS
    unsettled: Indices = NO_POSITIONS
    largest_step: float = 0.0


def assess_convergence(
    equations: NormalEquations, space: ParameterScaling, z: Array, tolerance: float, message: str, *, noisy_gaps: bool
) -> ConvergenceTest:
    """Test an iterate: converged means that a full undamped step would move no parameter noticeably.

    Parameters
    ----------
    equations : NormalEquations
    space : ParameterScaling
    z : ndarray, shape (k,)
        The free parameters as searched.
    tolerance : float
        Largest step of a converged iterate, in standard deviations.
    message : str
        The first sentence of a converged status.
    noisy_gaps : bool
        Whether the gaps stand for noise of the states.

    Returns
    -------
    ConvergenceTest
    """
    names = np.array(equations.segments.transcription.parameters.free_names, dtype=object)
    no_sensitivity = np.diag(equations.arrow.corner) == 0  # even at a bound
    idle = ~space.held & ~space.has_effect(equations) & (no_sensitivity | ~space.at_bound(z))
    if idle.any():
        sentences = f"the data do not depend on {' and '.join(names[idle])}", "fix it, or log a run that does"
        return ConvergenceTest(Status(Code.NOT_CONVERGED, sentences), np.flatnonzero(idle))
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return ConvergenceTest(
            Status(Code.NOT_CONVERGED, ("the data do not determine the states", "log another output"))
        )
    keep = space.movable(z, equations, reduced)
    own = np.flatnonzero(keep)
    alike, solved = own[equations.unidentifiable_parameters(reduced, keep)], reduced.step(keep)
    noise = max(1.0, math.sqrt(equations.chi_square / max(1, equations.count)))
    if alike.size or solved is None:
        verdict = f"the data do not determine {' and '.join(names[np.sort(alike)])}"
        status = Status(Code.NOT_CONVERGED, (verdict, "fix one, or log a run that separates them"))
        weakest = _least_sensitive(own, space, reduced, noise, z)
        return ConvergenceTest(status, weakest if weakest.size else alike[-1:])
    spread = np.sqrt(np.diag(positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])))
    step = np.abs(solved.parameters[keep]) / (noise * spread)
    if np.max(step, initial=0.0) > tolerance:
        worst = int(np.argmax(step))
        verdict = f"{names[keep][worst]} would still move by {step[worst]:.2g} standard deviations"
        remedy = "try more iterations, other start values, or fix a parameter"
        status = Status(Code.NOT_CONVERGED, (verdict, remedy))
        return ConvergenceTest(status, _least_certain(own, noise * spread, space, z), own[[worst]])
    bounded = np.flatnonzero(space.at_bound(z) & ~space.held)
    return ConvergenceTest(
        _optimum_status(equations, message, noisy_gaps=noisy_gaps),
        _least_sensitive(bounded, space, reduced, noise, z),
        largest_step=float(np.max(step, initial=0.0)),
    )


def largest_parameter_step(equations: NormalEquations, keep: Mask, reduced: ReducedEquations, step: Array) -> float:
    """The largest step of a kept parameter, of shape (k,) in all, in its standard deviations.

    It is infinite where the data do not determine all of them.
    """
    if equations.unidentifiable_parameters(reduced, keep).size:
        return math.inf
    spread = np.sqrt(np.diag(positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])))
    return float(np.max(np.abs(step[keep]) / spread, initial=0.0))


def _optimum_status(equations: NormalEquations, message: str, *, noisy_gaps: bool) -> Status:
    """The status of an optimum: converged, unless its gaps absorb the misfit of the model."""
    gap, misfit = equations.largest_gap, 2 * equations.cost / max(1, equations.count)
    if equations.gap_share > MAX_GAP_SHARE and not (noisy_gaps and misfit <= MAX_CHI_SQUARE_RATIO):
        verdict = f"the gaps between segments carry {equations.gap_share:.0%} of the cost"
        detail = f"the largest is {gap:.1g} of a state's nominal size: the model cannot follow the log"
        return Status(Code.NOT_CONVERGED, (verdict, detail, "check its terms, inputs and units"))
    verdict = f"{message}, largest gap {gap:.1g} of a state's nominal size"
    misfit_sentences = describe_misfit(equations, MAX_CHI_SQUARE_RATIO, noisy_gaps=noisy_gaps)
    return Status(Code.CONVERGED, (verdict, *misfit_sentences))


def _least_sensitive(
    positions: Indices, space: ParameterScaling, reduced: ReducedEquations, noise: float, z: Array
) -> Indices:
    """The position of the parameter with the least effect on the data, the others known; none if a prior is vaguer."""
    return _least_certain(positions, noise / np.sqrt(np.maximum(np.diag(reduced.schur)[positions], 1e-300)), space, z)


def _least_certain(positions: Indices, spread: Array, space: ParameterScaling, z: Array) -> Indices:
    """The position of the least certain parameter, if a weak prior would be more certain; or none.

    A linear parameter is as large as the larger of its start and its value here: a start near zero tells no size.
    """
    larger = np.where(np.abs(z) > np.abs(space.start), z, space.start)
    share = spread / space.weak_prior(larger)[positions]
    if not share.size or not share.max() > UNIDENTIFIABLE_PRIOR_RATIO:
        return NO_POSITIONS
    return positions[[int(np.argmax(share))]]


# Marquardt's damping over the diagonal [1] with loose gaps: lower takes wild first steps, higher small ones
INITIAL_DAMPING = 1e-3
# least damping over the diagonal [1], in which the gaps weigh up to 1e14: higher slows parameters, lower is rounding
MIN_DAMPING = 1e-15
# actual over promised decrease [1] below which the nodes settle after a step: higher costs evaluations, lower crawls in
# valleys
MIN_GAIN_RATIO = 0.5
# steps of the nodes alone after a step whose gaps miss its promise: fewer creep along the bend of a valley (bristles at
# 60 s: .05 % an iteration), more follow nodes that do not settle
MAX_NODE_STEPS = 3
MAX_TRIES = 10  # dampings tried for a step: fewer give up where a step exists, more try what no longer moves anything
# undamped steps over a kink: fewer turn back before the cost has fallen again, more follow steps that diverge
MAX_LEAP_STEPS = 10
MAX_LOG_CHANGE = (
    2.0  # e-folds of a log parameter in a step: longer ones leave the model's range, shorter ones take more
)


@dataclass(frozen=True, eq=False)
class Iterate:
    """The unknowns (nodes in SI, z as searched), and the equations linearised there."""

    nodes: Array
    z: Array
    equations: NormalEquations

    @property
    def cost(self) -> float:
        """Half the sum of all squares; infinite where the model is not finite."""
        return self.equations.cost


@dataclass(frozen=True, eq=False)
class Objective:
    """The lifted least squares with given gaps' weights and integration steps.

    Attributes
    ----------
    segments : Segments
    scaling : ParameterScaling
    sigma : ndarray, shape (n_states,)
        Standard deviation of a gap, in nominal sizes.
    substeps : int
        Integration steps a sample.
    correction : IntegrationCorrection or None
        The change of outputs and ends by finer steps.
    has_prior : bool
        Whether log parameters are drawn to their start (`ParameterScaling.add_start_prior`).
    """

    segments: Segments
    scaling: ParameterScaling
    sigma: Array
    substeps: int
    correction: IntegrationCorrection | None = None
    has_prior: bool = False

    def evaluate(self, nodes: Array, z: Array) -> Iterate:
        """The iterate at these nodes, shape (m, n_states), and searched parameters."""
        with np.errstate(all="ignore"):  # a step too far may overflow; its cost is infinite then
            given = (nodes, self.scaling.values(z), self.scaling.chain(z), self.sigma, self.substeps, self.correction)
            equations = normal_equations(self.segments, *given)
        return self.with_prior(nodes, z, equations)

    def with_prior(self, nodes: Array, z: Array, equations: NormalEquations) -> Iterate:
        """The iterate with these equations, to which the prior is added where there is one."""
        return Iterate(nodes, z, self.scaling.add_start_prior(equations, z) if self.has_prior else equations)


IsNegligible = Callable[[Iterate, ReducedEquations, GaussNewtonStep], bool]


class Descent:
    """Levenberg-Marquardt steps on one objective.

    Parameters
    ----------
    objective : Objective
    damping : float
        Of the first step.
    is_negligible : callable
        Whether a step that is hardly damped is not worth a try.

    Attributes
    ----------
    damps_nodes : bool
        Whether nodes that overshoot are damped alone. Near an optimum this saves the rest of the log many short steps;
        far from it, nodes are left behind that tighter gaps then cannot free.
    node_damping : ndarray, shape (m,)
        Of each node alone, over its diagonal.
    """

    def __init__(self, objective: Objective, damping: float, is_negligible: IsNegligible) -> None:
        self.damps_nodes, self.promised = False, math.inf
        self.objective, self.damping, self._is_negligible = objective, damping, is_negligible
        self.node_damping = np.zeros(objective.segments.count)

    def step(self, current: Iterate) -> Iterate | None:
        """The next iterate; None if no damping lowers the cost, or the step would be negligible.

        After the first try the damping rises only at the nodes that have overshot, if there are any.
        """
        raise_by, scaling = 10.0, self.objective.scaling
        for k in range(MAX_TRIES):
            reduced = current.equations.arrow.eliminate(self.damping, self.node_damping)
            step = reduced and reduced.step(scaling.movable(current.z, current.equations, reduced))
            if k == 0 and step:
                self.promised = 0.5 * current.equations.arrow.descent_rate(step)
            if reduced and step and np.max(np.abs(step.parameters[scaling.log]), initial=0.0) <= MAX_LOG_CHANGE:
                is_hardly_damped = self.damping <= INITIAL_DAMPING and (k == 0 or (k == 1 and self.node_damping.any()))
                if is_hardly_damped and self._is_negligible(current, reduced, step):
                    break
                trial = self._trial(current, reduced, step)
                is_lower = trial.cost < current.cost
                if self.damps_nodes and (not is_lower or self.node_damping.any()):
                    self.node_damping = self._missed_curvature(current, trial)
                if is_lower:
                    self.damping = self.damping * 0.1 if self.damping > MIN_DAMPING else 0.0
                    return trial
                if k == 0 and self.node_damping.any():
                    continue
            self.damping, raise_by = max(self.damping, MIN_DAMPING) * raise_by, 3 * raise_by
        return None

    def leap(self, current: Iterate) -> tuple[Iterate, int]:
        """Take undamped steps, which may raise the cost for a while: the best iterate among them, and their number.

        Over a kink of the model, at which a descent creeps, this is the way (the watchdog technique: Chamberlain et
        al., Mathematical Programming Study 16, 1982).
        """
        trial: Iterate | None = current
        best, taken = current, 0
        while trial is not None and math.isfinite(trial.cost) and taken < MAX_LEAP_STEPS:
            best, trial = min(best, trial, key=lambda each: each.cost), self._step_undamped(trial)
            taken += trial is not None
        return best if trial is None else min(best, trial, key=lambda each: each.cost), taken

    def _step_undamped(self, current: Iterate) -> Iterate | None:
        """The iterate after an undamped step, whatever its cost; None without one, or where it would be negligible."""
        reduced, scaling = current.equations.arrow.eliminate(0.0), self.objective.scaling
        step = reduced and reduced.step(scaling.movable(current.z, current.equations, reduced))
        if not reduced or not step or self._is_negligible(current, reduced, step):
            return None
        z = scaling.project_to_bounds(current.z + step.parameters)
        shift = reduced.back_substitute(z - current.z)
        return self.objective.evaluate(current.nodes + shift * self.objective.segments.nominal, z)

    def _trial(self, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> Iterate:
        """The iterate after a step; where its gaps let the cost fall too little, with the nodes settled.

        Tight gaps make a narrow valley of what the parameters and the whole trajectory do together, and its bend turns
        a long step into gaps. A Gauss-Newton step of the nodes alone, from the trial's own derivatives, closes them
        again without the log being left, as shooting on from the first node would.
        """
        z = self.objective.scaling.project_to_bounds(current.z + step.parameters)
        moved = z - current.z
        shift = reduced.back_substitute(moved)  # a bound may have cut the parameters' step short
        trial = self.objective.evaluate(current.nodes + shift * self.objective.segments.nominal, z)
        promised = 0.5 * current.equations.arrow.descent_rate(GaussNewtonStep(shift, moved))
        for _ in range(MAX_NODE_STEPS):
            if current.cost - trial.cost >= MIN_GAIN_RATIO * promised or not _misses_by_gaps(current, trial):
                break
            settled = self._settle_nodes(trial, current.cost)
            if settled is None or not settled.cost < trial.cost:
                break
            trial = settled
        return trial

    def _settle_nodes(self, trial: Iterate, cost: float) -> Iterate | None:
        """A trial after a step of its nodes alone; None where that does not promise less than a cost."""
        arrow = trial.equations.arrow
        shift = arrow.node_step(self.damping + self.node_damping)
        if shift is None or trial.cost - 0.5 * arrow.descent_rate(GaussNewtonStep(shift, 0.0 * trial.z)) >= cost:
            return None
        return self.objective.evaluate(trial.nodes + shift * self.objective.segments.nominal, trial.z)

    def _missed_curvature(self, current: Iterate, trial: Iterate) -> Array:
        """The curvature that a trial shows and the model has missed, by node; none of a trial that is not finite."""
        if not math.isfinite(trial.cost):
            return np.zeros(len(current.nodes))
        step, moved = (trial.nodes - current.nodes) / self.objective.segments.nominal, trial.z - current.z
        return missed_curvature(current.equations, step, moved, trial.equations, self.objective.sigma)


def _misses_by_gaps(current: Iterate, trial: Iterate) -> bool:
    """Whether the gaps of a trial, more than its data, make it cost more than where it comes from."""
    by_data = 0.5 * (trial.equations.chi_square - current.equations.chi_square)
    return math.isfinite(trial.cost) and trial.cost - current.cost > 2 * by_data


FIRST_JOINING_STAGE = 2  # stage from which two searches may join: before it the gaps are so wide that all cost alike
# difference of the costs [1] of two searches that have joined: lower follows one optimum twice, higher takes two for
# one
JOINED_COST_TOLERANCE = 1e-3
GAPS_ABSORB_MISFIT = Status(Code.NOT_CONVERGED, ("the gaps between segments absorb the misfit of the model",))
ABANDONED_START = Status(Code.NOT_CONVERGED, ("a start is so far off that the others are tried first",))
INTERRUPTED_SEARCH = Status(Code.INTERRUPTED, ("the best iterate so far", "run again for an answer"))
JOINED_SEARCH = Status(Code.NOT_CONVERGED, ("a start has led to where another one was",))


class StageEnd(NamedTuple):
    """Where a stage ended."""

    nodes: Array
    z: Array
    cost: float


class Snapshot(NamedTuple):
    """Where a search is, and by which integration."""

    stage: "Stage"
    current: Iterate
    correction: IntegrationCorrection | None
    substeps: int
    output_substeps: int


def joins_known_search(search: "Search") -> bool:
    """Whether a search has come to where a known one was after the same stage, and would go on as that one."""
    known = [cost for gap, cost in search.method.known_costs if gap == search.stage.gap]
    return any(abs(search.cost - cost) <= JOINED_COST_TOLERANCE * cost for cost in known)


def end_search(search: "Search", status: Status, seconds: float) -> Fit:
    """The fit where a search has ended.

    Parameters
    ----------
    search : Search
    status : Status
    seconds : float
        That it has taken.

    Returns
    -------
    Fit
    """
    transcription, current, equations = search.segments.transcription, search.current, search.current.equations
    q = search.scaling.values(current.z)
    free = transcription.parameters.free_names
    values = dict(zip(free, q[transcription.free].tolist(), strict=True))
    run = _final_run(search, status)
    at_bound, held = search.scaling.at_bound(current.z) & ~search.scaling.held, search.scaling.held
    keep = search.scaling.has_effect(equations) & ~at_bound & ~held
    covariance, prior, optimum, names = None, None, None, (tuple[str, ...](), tuple[str, ...]())
    if math.isfinite(equations.cost):
        covariance = equations.covariance(keep, noisy_gaps=search.noisy_gaps)
        if covariance is not None and search.tolerance > search.method.tolerance:
            covariance = covariance + unsettled_covariance(search)
        prior = equations.prior_covariance(keep, held, search.scaling.weak_prior(current.z)) if held.any() else None
        names = names if status in (ABANDONED_START, JOINED_SEARCH) else _doubtful_parameters(search)
    if covariance is not None:
        gaps = search.stage.gap * search.gap_scales
        optimum = Optimum(equations, run, current.nodes, q, keep, gaps, search.substeps)
    return Fit(
        search.segments.trajectories(run),
        transcription.parameters.with_values(values),
        status,
        _stats(search, status, run, seconds),
        covariance,
        equations.chi_square,
        equations.count,
        at_bound,
        equations.gaps[search.segments.linked] if search.noisy_gaps else None,
        *names,
        prior,
        optimum=optimum,
        stage_costs=_stage_costs(search),
    )


def _final_run(search: "Search", status: Status) -> RolloutResult:
    """The run of the last iterate by the finest steps, with states; those of an interrupted search are by its own."""
    correction = search.correction
    if correction is not None and math.isfinite(search.integration_change):  # of these very nodes
        return correction.fine_run
    if status.code is not Code.INTERRUPTED or not math.isfinite(search.current.cost):
        return search.run(search.output_substeps)
    run = search.run(search.substeps)
    return run if correction is None else replace(run, y=run.y + correction.y, x_end=run.x_end + correction.x_end)


def _stats(search: "Search", status: Status, run: RolloutResult, seconds: float) -> dict[str, float]:
    return {
        "iterations": float(search.iterations),
        "seconds": seconds,
        "cost": search.cost,
        "substeps": float(search.output_substeps),
        "largest_gap": search.current.equations.largest_gap,
        "gap_share": search.current.equations.gap_share,
        "gap_deviation": search.stage.gap,
        "integration_error": _integration_error(search, status, run),
    }


def _stage_costs(search: "Search") -> tuple[tuple[float, float], ...]:
    """The gap and the cost of stages at their ends, and those of the search's end."""
    ended = [(stage.gap, end.cost) for stage, end in zip(search.method.stages, search.stage_ends, strict=False)]
    return (*ended[FIRST_JOINING_STAGE:], (search.stage.gap, search.cost))


def _doubtful_parameters(search: "Search") -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The parameters that the data do not determine, and the one that has not settled; none of a refused start."""
    if search.steps.are_too_many:
        return (), ()
    free, found = search.segments.transcription.parameters.free_names, search.assess(search.current)
    return tuple(free[i] for i in found.unidentifiable), tuple(free[i] for i in found.unsettled)


def _integration_error(search: "Search", status: Status, run: RolloutResult) -> float:
    """Largest change of an output when the steps are halved [noise standard deviations].

    NaN without an optimum, and where the budget ends before it is measured: the answer is known by then.
    """
    if math.isfinite(search.integration_change) or not (status.converged and search.method.checks_steps):
        return search.integration_change
    try:
        with check_during_runs(search.method.budget.check):
            return search.largest_change(search.run(2 * search.output_substeps).y - run.y)
    except BudgetSpentError:
        return math.nan


# relative decrease of the cost an iteration [1] below which a search has stalled: lower keeps crawling, higher gives up
STALL_COST_DECREASE = 2e-3
# error of the parameters [standard deviations] by derivatives from before the integration was refined: higher shifts
# estimates, lower costs a run with sensitivities
MAX_GRADIENT_ERROR = 0.01
# iterations of the last stage right after the first: more are lost where stages between are needed, fewer may not
# converge
JUMP_ITERATIONS = 10
# squares that the last stage promises by the linearised equations, in noise variances [1], above which it is not tried
# right after the first: lower passes over it for a start that is only not yet near, higher iterates for wrong models
MAX_JUMP_MISFIT = 10.0
# stages at whose gaps noise of the states is tried [1]: fewer miss those at which a search settles, more of them hardly
# hold the states together
MAX_LOOSENED = 2
# creeping steps in a row after which a search with noise of the states leaps: fewer leave a way that leads on, more
# take long
MAX_CREEPING_STEPS = 3


class Search:
    """The stages of a search for the nodes and the free parameters of the segments of one transcription.

    Parameters
    ----------
    segments : Segments
    method : LeastSquares
    """

    def __init__(self, segments: Segments, method: "LeastSquares") -> None:
        self.method = method
        self.scaling = ParameterScaling(segments.transcription)
        nodes = start_nodes(segments)
        self.steps = IntegrationSteps(segments, nodes, self.scaling.values(self.scaling.start), method.substeps)
        self.segments = segments = self.steps.segments
        self.gap_scales = gap_scales(segments, method.kinematic)
        self.iterations, self.stage_began, self.noisy_gaps, self.has_stalled = 0, 0, False, False
        self.last_decrease = 0.0  # of a stage's cost by its last iteration, over itself
        self.tolerance = method.tolerance  # wider where kinks hold up a search that has settled
        self.stage, self.stage_ends, self.unsettled_gaps = method.stages[0], list[StageEnd](), set[float]()
        self.substeps = self.output_substeps = self.steps.start
        self.correction: IntegrationCorrection | None = None
        self.integration_change, self.is_coarse = math.nan, False
        self.node_damping = np.zeros(segments.count)  # where the stage has ended, of each node alone
        self.current = self.evaluate(nodes, self.scaling.start)

    @property
    def cost(self) -> float:
        """Half of the squares of data and gaps, without the prior of a stage."""
        return self.current.cost - self.stage.has_prior * self.scaling.start_prior_cost(self.current.z)

    def solve(self) -> Fit:
        """Run all stages; an interruption (Ctrl-C) ends them with the best iterate so far, marked."""
        began = time.perf_counter()
        try:
            with check_during_runs(self.method.budget.check):
                status = self._run_stages()
        except KeyboardInterrupt:
            status = INTERRUPTED_SEARCH
        return end_search(self, status, time.perf_counter() - began)

    def _run_stages(self) -> Status:
        if self.steps.are_too_many:
            verdict = f"the model is so stiff that a sample takes {self.steps.required} integration steps"
            remedy = "widen the smoothing of its sharpest term, or give LeastSquares(substeps=)"
            return Status(Code.NOT_CONVERGED, (verdict, remedy))
        last, allowed = self.method.stages[-1], None
        for stage in self.method.stages:
            if stage is last and self._gaps_absorb_misfit() and self.method.allows_state_noise:
                allowed = self._allow_state_noise()
                if allowed.converged:
                    return refine_steps(self, allowed)
            elif stage is last and self.stage_ends and self._is_hopeless():
                return ABANDONED_START
            self._enter_stage(stage, self.current.nodes, self.current.z)
            if not math.isfinite(self.current.cost):
                return Status(Code.DIVERGED, ("the model is not finite at the start", "check values and units"))
            self.has_stalled = self._finish_stage(stage.iterations)
            self.stage_ends.append(StageEnd(self.current.nodes, self.current.z, self.cost))
            if found := self._early_end(stage):
                return refine_steps(self, found)
        status = repeat_last_stage(self)
        # gaps that absorb the misfit of the model: the answer depends on their weight
        gaps_absorb = self.current.equations.gap_share > MAX_GAP_SHARE and allowed is None
        return refine_steps(self, self._allow_state_noise(status) if gaps_absorb else status)

    def _early_end(self, stage: "Stage") -> Status | None:
        """The status of a search that ends with a stage before the last; None where it goes on."""
        if joins_known_search(self):
            return JOINED_SEARCH
        if stage is not self.method.stages[0]:
            return None
        return ABANDONED_START if self._is_hopeless() else self._jump()

    def _is_hopeless(self) -> bool:
        """Whether this search is to be left for those from other starts."""
        return 2 * self.current.cost > self.method.max_misfit * self.current.equations.count

    def _jump(self) -> Status | None:
        """The status of an optimum that is soon reached after a first stage that explains the log; or None."""
        stays = len(self.method.stages) < 3 or bool(self.method.known_costs)
        if stays or not self.is_noise(self.current.cost):
            return None
        if self.segments.implicit_state is not None:  # the errors of coarse steps add up where no gaps take them
            self._correct_residuals(fine_steps(self.segments, self.substeps, self.method.stages[-1].refine))
        count, (first, *between, last) = self.current.equations.count, self.method.stages
        if not self._promised_squares(last) > MAX_JUMP_MISFIT * count:
            return self._jump_to_last_stage()
        if not self.method.allows_state_noise:
            return None
        near_noise = [s for s in between if self._promised_squares(s) <= MAX_CHI_SQUARE_RATIO * count]
        found = self._loosen(near_noise[-1] if near_noise else first, self.current.nodes, self.current.z)
        return found if found.converged else None

    def _promised_squares(self, stage: "Stage") -> float:
        """The squares, in noise variances, to which the gaps of a stage would lead by the linearised equations."""
        equations = weigh_gaps(self.segments, self.current.equations.linearisation, stage.gap * self.gap_scales)
        return equations.promised_squares(self.scaling.has_effect(equations) & ~self.scaling.held)

    def _jump_to_last_stage(self) -> Status | None:
        """The status of an optimum that the last stage soon reaches; or None."""
        before = self.snapshot()
        self._enter_stage(self.method.stages[-1], self.current.nodes, self.current.z)
        if math.isfinite(self.current.cost):
            self.run_stage(JUMP_ITERATIONS)
            if self.is_noise(self.current.cost):  # finer steps are lost on what has not come near the noise by then
                self._finish_stage(JUMP_ITERATIONS)
                if (found := self._convergence_status(self.current)).converged and self.is_noise(self.current.cost):
                    return found
        self.restore(before)
        return None

    def _gaps_absorb_misfit(self) -> bool:
        """Whether the gaps absorb the misfit of the model in a stalled search: tighter gaps cost more."""
        absorbing = self.current.equations.gap_share > MAX_GAP_SHARE
        return self.has_stalled and absorbing and not self.is_noise(self.current.cost)

    def _allow_state_noise(self, status: Status = GAPS_ABSORB_MISFIT) -> Status:
        """Let the gaps stand for noise of the states of a wrong model: the tightest with which all residuals agree."""
        if not self.method.allows_state_noise:
            return status
        ended = zip(self.method.stages[:-1], self.stage_ends, strict=False)
        explaining = [(stage, end) for stage, end in ended if self.is_noise(end.cost)]
        for stage, end in reversed(explaining[-MAX_LOOSENED:]):
            if stage.gap in self.unsettled_gaps:  # the same squares, from another start: it creeps again
                continue
            found = self._loosen(stage, end.nodes, end.z)
            if found.converged:
                return found
        return status

    def _loosen(self, stage: "Stage", nodes: Array, z: Array) -> Status:
        """The status of the optimum with a stage's gaps as noise of the states, or with tight gaps where it leads.

        Where there is none, nothing moves.
        """
        before, last, self.noisy_gaps = self.snapshot(), self.method.stages[-1], True
        self._enter_stage(replace(stage, iterations=last.iterations, refine=last.refine), nodes, z)
        self._finish_stage(last.iterations)
        found = repeat_last_stage(self)
        if found.converged:
            return self._tighten() or found
        self.unsettled_gaps.add(stage.gap)
        self.restore(before)
        self.noisy_gaps = False
        return found

    def _tighten(self) -> Status | None:
        """The status of an optimum with tight gaps, where one with noise of the states leads to it; or None.

        The nodes of a first stage may lie across kinks, and its equations then foresee a misfit that a right model has
        not; at an optimum that is nearer they are right.
        """
        before, last = self.snapshot(), self.method.stages[-1]
        if self._promised_squares(last) > MAX_JUMP_MISFIT * self.current.equations.count:
            return None
        self.noisy_gaps = False
        for stage in self.method.stages:
            if stage.gap < before.stage.gap and self.is_noise(self.current.cost):
                self._enter_stage(stage, self.current.nodes, self.current.z)
                self._finish_stage(stage.iterations)
        found = self._convergence_status(self.current)
        if self.stage is last and found.converged and self.is_noise(self.current.cost):
            return found
        self.restore(before)
        self.noisy_gaps = True
        return None

    def snapshot(self) -> Snapshot:
        """Where the search is, to which `restore` returns."""
        return Snapshot(self.stage, self.current, self.correction, self.substeps, self.output_substeps)

    def restore(self, to: Snapshot) -> None:
        """Return to where the search was."""
        self.stage, self.current, self.correction, self.substeps, self.output_substeps = to
        self.segments = self.current.equations.segments

    def _enter_stage(self, stage: "Stage", nodes: Array, z: Array) -> None:
        """Weigh the gaps as in a stage, with integration steps from the stiffness at these nodes."""
        self.segments, steps = self.steps.renew(self.segments, nodes, self.scaling.values(z), self.substeps)
        is_same = self.segments is self.current.equations.segments and nodes is self.current.nodes
        is_known = is_same and steps == self.substeps and self.correction is None
        self.stage, self.tolerance = stage, self.method.tolerance
        self.substeps, self.output_substeps, self.correction = steps, steps, None
        self.is_coarse, self.node_damping = stage.refine > 1, np.zeros(len(nodes))
        if is_known:
            equations = weigh_gaps(self.segments, self.current.equations.linearisation, stage.gap * self.gap_scales)
            self.current = self._objective().with_prior(nodes, z, equations)
        else:
            self.current = self.evaluate(nodes, z)

    def apply_finer_steps(self, steps: int) -> float:
        """Integrate the current iterate by finer steps; return the largest change of y [standard deviations]."""
        nodes, z, before = self.current.nodes, self.current.z, self._outputs()
        self.is_coarse = False
        if self._corrects_residuals:
            self._correct_residuals(steps)
        else:
            self.substeps, self.output_substeps, self.correction = steps, steps, None
            self.current = self.evaluate(nodes, z)
        return self.largest_change(self._outputs() - before)

    @property
    def _corrects_residuals(self) -> bool:
        """Whether finer steps are for the residuals alone: derivatives need them where these exceed the noise."""
        return not self.noisy_gaps and self.is_noise(self.current.cost)

    def _correct_residuals(self, steps: int) -> None:
        """Add what finer steps change to the current residuals; derivatives are computed anew where that is much."""
        current, before, fine, self.is_coarse = self.current, self._outputs(), self.run(steps), False
        slopes = current.equations.linearisation
        self.correction = IntegrationCorrection(fine.y - slopes.y, fine.x_end - slopes.x_end, fine)
        self.output_substeps, sigma = steps, self.stage.gap * self.gap_scales
        if self.moves_no_estimate(fine.y - before):
            equations = correct_residuals(current.equations, current.nodes, self.correction, sigma)
            self.current = Iterate(current.nodes, current.z, equations)
        else:
            self.current = self.evaluate(current.nodes, current.z)

    def moves_no_estimate(self, change: Array) -> bool:
        """Whether a change of the outputs moves no estimate: none moves by more deviations than the norm of it."""
        weighted = (change * self.segments.weights)[np.isfinite(self.segments.measured)]
        return float(np.nansum(weighted**2)) <= MAX_GRADIENT_ERROR**2

    def _outputs(self) -> Array:
        """The model's outputs with the correction of finer steps, shape (m, n, n_outputs)."""
        y = self.current.equations.linearisation.y
        return y if self.correction is None else y + self.correction.y

    def _finish_stage(self, iterations: int) -> bool:
        """Run a stage, then again with the finer steps that it asks for; return as `run_stage` does.

        Where an iterate explains the log to its noise, the finer steps correct its residuals within the stage.
        """
        has_ended = self.run_stage(iterations)
        if self.stage.refine > 1 and self.correction is None and not self._is_hopeless():
            before = self.snapshot()
            self.apply_finer_steps(fine_steps(self.segments, self.substeps, self.stage.refine))
            if math.isfinite(self.current.cost):
                return self.run_stage(iterations)
            self.restore(before)
        return has_ended

    def is_noise(self, cost: float) -> bool:
        """Whether this cost is that of the noise alone."""
        return 2 * cost <= MAX_CHI_SQUARE_RATIO * self.current.equations.count

    def run_stage(self, iterations: int) -> bool:
        """Iterate in a stage; return whether it converged, or had stalled when its iterations were used up."""
        damping, before = min(INITIAL_DAMPING, 10 * self.stage.gap**2), math.inf  # as the diagonal grows
        descent = Descent(self._objective(), damping, self._is_negligible_step)
        descent.node_damping = np.zeros(len(self.node_damping)) if self.noisy_gaps else self.node_damping
        hopeless, self.stage_began, self.last_decrease = 0, self.iterations, 0.0
        for _ in range(iterations):
            if self.stage.refine > 1 and self._corrects_residuals and self.correction is None:
                self._correct_residuals(fine_steps(self.segments, self.substeps, self.stage.refine))
                descent.objective = self._objective()
            descent.damps_nodes = self.noisy_gaps or is_near_end(self)
            trial = descent.step(self.current)
            self.node_damping = descent.node_damping
            if trial is None:
                return True
            self.iterations += 1
            before, self.current = self.current.cost, trial
            self._report()
            hopeless = hopeless + 1 if creeps(self, before, descent.promised) else 0
            if hopeless == MAX_CREEPING_STEPS:
                if not self._leap(descent):
                    return True
                hopeless = 0
        self.last_decrease = 1 - self.current.cost / before
        return self.last_decrease < STALL_COST_DECREASE

    def _leap(self, descent: Descent) -> bool:
        """Leap over a kink at which a descent with noise of the states creeps; return whether that helps."""
        if not self.noisy_gaps:
            return False
        before, (self.current, taken) = self.current.cost, descent.leap(self.current)
        self.iterations += taken
        return self.current.cost < before

    def _is_negligible_step(self, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
        return is_negligible_step(self, current, reduced, step)

    def _objective(self) -> Objective:
        sigma = self.stage.gap * self.gap_scales
        return Objective(self.segments, self.scaling, sigma, self.substeps, self.correction, self.stage.has_prior)

    def evaluate(self, nodes: Array, z: Array) -> Iterate:
        """The iterate at these nodes and searched parameters."""
        return self._objective().evaluate(nodes, z)

    def _convergence_status(self, current: Iterate) -> Status:
        return self.assess(current).status

    def assess(self, current: Iterate) -> ConvergenceTest:
        """The convergence test of an iterate."""
        message = f"{self.iterations} iterations"
        found = assess_convergence(
            current.equations, self.scaling, current.z, self.tolerance, message, noisy_gaps=self.noisy_gaps
        )
        if not (found.status.converged and found.largest_step > self.method.tolerance):
            return found
        asked = f"kinks of the model ask for {found.largest_step:.2g} standard deviations, which the intervals hold"
        return found._replace(status=found.status.with_details(f"the estimates have settled; {asked}"))

    def largest_change(self, change: Array) -> float:
        """The largest change of a measured output [noise standard deviations], of all that are given."""
        weighted = np.abs(change) * self.segments.weights
        return float(np.max(weighted, where=np.isfinite(self.segments.measured), initial=0.0))

    def run(self, steps: int) -> RolloutResult:
        """The run of the current iterate by so many integration steps a sample, with states."""
        return self.segments.run(self.current.nodes, self.scaling.values(self.current.z), steps, states=True)

    def _report(self) -> None:
        if self.method.progress is not None:
            self.method.progress(describe_iteration(self))


MAX_STEP_HALVINGS = 3  # halvings of the integration steps: more cost time, fewer leave an answer that depends on them
# times that the iterations of the last stage are repeated near the noise [1]: fewer leave a search over kinks (bristles
# at rest) before its end, for other starts that take longer; more follow one that does not end
MAX_REPEATS = 3
REPEAT_ITERATIONS = 10  # of a repeat, at most: fewer take a slow search for settled, more go on after it has
# decrease of the cost by an iteration, over itself [1], with which a search goes on that is not near the noise yet:
# lower follows one that creeps, higher ends one that is about to come there
STEEP_DECREASE = 0.1
# step [standard deviations] up to which a search has settled where a repeat has moved no estimate: lower follows what
# kinks ask for in vain (100 iterations of bristles at rest for .1 deviations), higher takes a slow search for one that
# has settled; and where the gaps stand for noise of the states, whose every estimate is marked anyway
MAX_SETTLED_STEP, MAX_NOISY_STEP = 0.5, 1.0
# damping of a node alone, over its diagonal [1], beyond which a kink traps it, for it moves less than half as far as
# its equations ask: lower moves nodes that are only slow, higher leaves some behind
TRAPPING_DAMPING = 1.0


def is_near_end(search: "Search") -> bool:
    """Whether a search explains the log to its noise in a last stage that is to converge: one that refines its steps.

    One that only settles a start ends with wide gaps, where nodes that are damped alone are left behind.
    """
    is_last = search.stage is search.method.stages[-1] and search.stage.refine > 1
    return is_last and search.is_noise(search.current.cost)


def repeat_last_stage(search: "Search") -> Status:
    """Run the last stage again while it lowers the cost steeply, or at the noise at all, but has not converged.

    Parameters
    ----------
    search : Search
        Moves to where it has come by then. Parameters that the data do not determine end this, for a caller holds them.
        Where a repeat moves no estimate, what the kinks still ask for no longer keeps it from having converged.

    Returns
    -------
    Status
        Of where it is then.
    """
    least_decrease = 0.5 * search.method.tolerance**2  # that of a step of so many deviations
    count = min(REPEAT_ITERATIONS, search.stage.iterations)
    for _ in range(MAX_REPEATS * search.stage.iterations // max(1, count)):
        found, before = search.assess(search.current), search.current
        falls = search.last_decrease > STEEP_DECREASE and search.stage.iterations > count  # a short one is but a trial
        goes_on = search.noisy_gaps or is_near_end(search) or falls
        if found.status.converged or found.unidentifiable.size or not goes_on:
            return found.status
        trapped = np.flatnonzero(search.node_damping > TRAPPING_DAMPING)
        if trapped.size and not search.noisy_gaps:
            free_nodes(search, trapped)
        else:
            search.run_stage(count)
        has_settled = moved_deviations(search, before.z) <= search.method.tolerance
        if has_settled:
            search.tolerance = max(search.tolerance, MAX_NOISY_STEP if search.noisy_gaps else MAX_SETTLED_STEP)
        is_lost = search.noisy_gaps and not has_settled  # a kink that it creeps over would take hundreds of steps
        if is_lost or before.cost - search.current.cost < least_decrease:
            break
    return search.assess(search.current).status


def refine_steps(search: "Search", status: Status) -> Status:
    """Halve the integration steps until no estimate moves; steps that the user gave stay.

    Where the finer steps of the last stage have moved none, still finer ones would move it less: these are run once
    more where the search has ended.

    Parameters
    ----------
    search : Search
        Of this status; moves to the optimum by the finer steps.
    status : Status

    Returns
    -------
    Status
        Of where it is then.
    """
    for _ in range(MAX_STEP_HALVINGS):
        if not (status.converged and search.method.checks_steps):
            break
        before, correction = search.snapshot(), search.correction
        are_fine = correction is not None and search.moves_no_estimate(correction.y)
        change = search.apply_finer_steps((1 if search.method.substeps or are_fine else 2) * search.output_substeps)
        if are_fine and search.correction is not None:
            change = search.largest_change(search.correction.y)
        if not math.isfinite(search.current.cost):
            search.restore(before)
            break
        if search.assess(search.current).status.converged:
            search.integration_change = math.nan if search.method.substeps else change
            if search.noisy_gaps:
                search.run_stage(search.stage.iterations)  # the finer steps have moved its optimum a little
            break
        search.run_stage(search.stage.iterations)
        status = search.assess(search.current).status
    return status


def moved_deviations(search: "Search", z: Array) -> float:
    """How far the parameters have moved from z, at most [standard deviations]; infinite where one has none."""
    equations, current = search.current.equations, search.current.z
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return math.inf
    keep = search.scaling.movable(current, equations, reduced)
    return largest_parameter_step(equations, keep, reduced, current - z)


def unsettled_covariance(search: "Search") -> Array:
    """The covariance (own units) of the step that kinks still ask for. Shape (k, k)."""
    equations, z = search.current.equations, search.current.z
    asked, reduced = np.zeros(len(z)), equations.arrow.eliminate(0.0)
    solved = None if reduced is None else reduced.step(search.scaling.movable(z, equations, reduced))
    if solved is not None:
        asked = equations.linearisation.chain * solved.parameters
    return np.outer(asked, asked)


def free_nodes(search: "Search", trapped: Indices) -> None:
    """Run the last stage from where trapped nodes are put to the ends of the segments before them, if that helps.

    Parameters
    ----------
    search : Search
        Stays where it is unless its cost falls.
    trapped : ndarray of int
        Positions of nodes.
    """
    before, damping, nodes = search.snapshot(), search.node_damping, search.current.nodes.copy()
    behind = trapped[trapped > 0]
    nodes[behind] += search.current.equations.gaps[behind - 1] * search.segments.nominal
    search.current, search.node_damping = search.evaluate(nodes, search.current.z), np.zeros(len(nodes))
    search.run_stage(search.stage.iterations)
    if not search.current.cost < before.current.cost:
        search.restore(before)
        search.node_damping = damping


# promised decrease over the cost [1] at which a stage ends: lower wastes iterations, higher ends it too early
STAGE_COST_TOLERANCE = 1e-3
# promised decrease at which the last stage ends, in noise variances: half of (0.1 % of a standard deviation)^2
FINAL_COST_TOLERANCE = 5e-7
# promised decrease in noise variances at which the last stage ends where no parameter moves: lower iterates for states
# that no parameter depends on, higher leaves costs that are compared short of their least
SETTLED_COST_DECREASE = 0.01
# step of a parameter over the tolerance of convergence [1] at which the last stage ends: lower settles states that no
# parameter depends on, higher leaves the parameters short of their optimum; and where finer steps follow, which move it
FINE_TOLERANCE, COARSE_TOLERANCE = 0.01, 0.5
# the same where the model misses the logs, in deviations by the residuals: lower follows Gauss-Newton steps that go to
# and fro (30 iterations of .02 deviations on a log with sensor lag), higher leaves costs that differ at one optimum
MISFIT_TOLERANCE = 0.2
# iterations of a stage after which that counts: fewer leave optima that soon would be exact, more take time
PATIENT_ITERATIONS = 8
# promised decrease over the cost [1] at which such a first stage ends: lower iterates for what the last one finds
# anyway, higher jumps from a start that is not near
JUMP_COST_TOLERANCE = 1e-2

# actual over promised decrease [1] below which a search with noise of the states creeps: higher leaves a fit that
# converges, lower follows a kink of the model for hundreds of steps (encoder steps: 50 of .13 each, of 35 promised)
CREEPING_SHARE = 0.3


def is_negligible_step(search: "Search", current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
    """Whether a step is negligible: in the last stage, 0.1 % of a deviation in any direction, or as good as that.

    The states of noisy gaps estimate that noise, and settle long after the parameters, whose step then counts; so it
    does where the model misses the logs and the search is slow: the deviations are then those of the residuals, near
    such an optimum Gauss-Newton steps go to and fro for long, and what is far below a deviation is far below the bias,
    too. Where no parameter is free, the states are what is asked for.

    Parameters
    ----------
    search : Search
    current : Iterate
    reduced : ReducedEquations
    step : GaussNewtonStep

    Returns
    -------
    bool
    """
    promised, equations = 0.5 * current.equations.arrow.descent_rate(step), current.equations
    is_last, misfit = search.stage.gap <= search.method.stages[-1].gap, max(1.0, 2 * current.cost / equations.count)
    if not (search.noisy_gaps or is_last):
        is_first = search.stage is search.method.stages[0] and search.is_noise(current.cost)
        return promised < (JUMP_COST_TOLERANCE if is_first else STAGE_COST_TOLERANCE) * current.cost
    if is_last and promised < FINAL_COST_TOLERANCE * misfit:
        return True
    is_slow = search.iterations - search.stage_began >= PATIENT_ITERATIONS
    is_wrong = is_last and is_slow and misfit > MAX_CHI_SQUARE_RATIO
    asks_parameters = bool(search.segments.transcription.parameters.free_names)
    is_settled = asks_parameters and (search.is_coarse or is_wrong or promised < SETTLED_COST_DECREASE * misfit)
    if not ((is_settled or search.noisy_gaps) and promised < STAGE_COST_TOLERANCE * current.cost):
        return False
    keep = search.scaling.movable(current.z, equations, reduced)
    largest = largest_parameter_step(equations, keep, reduced, step.parameters) / search.method.tolerance
    if is_wrong:
        return largest < MISFIT_TOLERANCE * math.sqrt(max(1.0, equations.chi_square / max(1, equations.count)))
    return largest < (COARSE_TOLERANCE if search.is_coarse else FINE_TOLERANCE)


def creeps(search: "Search", before: float, promised: float) -> bool:
    """Whether a step of a search with noise of the states has fallen far short of its promise, and changed little.

    Parameters
    ----------
    search : Search
        After the step.
    before : float
        Cost before it.
    promised : float
        Decrease of the cost that it has promised.

    Returns
    -------
    bool
    """
    return search.noisy_gaps and before - search.current.cost < min(
        CREEPING_SHARE * promised, STAGE_COST_TOLERANCE * before
    )


def describe_iteration(search: "Search") -> str:
    """A line of progress: the stage, the iteration, the cost and the largest gap."""
    stages = search.method.stages
    number = "loosened" if search.noisy_gaps else f"stage {stages.index(search.stage) + 1}/{len(stages)}"
    return (
        f"{number}  iteration {search.iterations}  cost {search.cost:.6g}  "
        f"largest gap {search.current.equations.largest_gap:.1e}"
    )


# Newton steps: fewer leave gaps that another would close, more cost as much as a run from end to end
MAX_STEPS = 3
# shift of a node that open gaps still cause, in nominal sizes: higher shows in the errors of the run, lower is rounding
MAX_SHIFT = 1e-6


def close_gaps(optimum: Optimum) -> Array | None:
    """The outputs of a fit's run without gaps between linked segments, shape (m, n, n_outputs).

    Parameters
    ----------
    optimum : Optimum

    Returns
    -------
    ndarray or None
        None where the gaps do not close in a few steps, as those of a model that runs away from its log.
    """
    segments, linear = optimum.equations.segments, optimum.equations.linearisation
    slopes = np.where(segments.linked[:, None, None], linear.end_sensitivities[:, :, : optimum.nodes.shape[1]], 0.0)
    nodes, y, x_end = optimum.nodes, optimum.run.y, optimum.run.x_end
    for _ in range(MAX_STEPS):
        with np.errstate(all="ignore"):  # a run that leaves the model's range has no number, and is not taken
            shift = propagate_shifts(slopes, segment_gaps(segments, nodes, x_end))
            if not np.abs(shift).max(initial=0.0) > MAX_SHIFT:
                return y
            nodes = nodes + shift * segments.nominal
        if not np.isfinite(nodes).all():
            return None
        # by coarse steps, as the sensitivities: what finer ones change is the same beside the old nodes
        run = segments.run(nodes, optimum.values, optimum.substeps)
        y, x_end = optimum.run.y + run.y - linear.y, optimum.run.x_end + run.x_end - linear.x_end
    return None
