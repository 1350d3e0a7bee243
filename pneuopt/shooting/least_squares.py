"""`LeastSquares`: soft-continuity multiple shooting, one nonlinear least squares in all nodes and parameters.

The gaps between segments are weighted residuals, and are tightened in stages: a bad start is never integrated over the
whole record, as single shooting does, which fails there (problems/speed/benchmark_identification.py). Each step is a
banded Cholesky with an arrow, linear in the record's length.

A search is a frozen `SearchState`; each move takes one and returns the next, in the order of the search and of this
file. Only `LevenbergMarquardt`, which takes the steps of one stage, changes itself.

    stage    gap [nominal sizes]   iterations   what is particular to it
    first    1e-2                  12           log parameters are drawn to their start, as by all gaps above `WIDE_GAP`
    next     3e-3, 1e-3, 3e-4      8            the same
    next     1e-4                  8            the data alone count
    last     1e-5                  30           finer integration steps; it decides on convergence

    end            at                           because
    TOO_STIFF      the start                    a sample takes more integration steps than a search can afford
    DIVERGED       a stage's end                the model was not finite where the stage began
    DUPLICATE      a stage's end                the cost is that of a known search after the same stage
    ABANDONED      the first's end, the last    the misfit exceeds `LeastSquares.max_misfit`
    OPTIMUM        a shortcut, the last stage   a full undamped step would move no parameter noticeably
    UNSETTLED      the last stage               one would still move, or is not determined, and no repeat helps
    INTERRUPTED    any move                     of Ctrl-C or a spent CPU budget: the last iterate before it
"""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import wraps
from typing import Concatenate, NamedTuple, ParamSpec

import numpy as np

from pneuopt.dynamics.compiled.rollout import RolloutResult, check_during_runs
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations, positive_definite_inverse
from pneuopt.shooting.equations import (
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
    Segments,
    choose_integration,
    fine_steps,
    gap_scales,
    segment,
    start_nodes,
)
from pneuopt.shooting.tolerances import (
    COARSE_TOLERANCE,
    CREEPING_SHARE,
    FINAL_COST_TOLERANCE,
    FINE_TOLERANCE,
    FIRST_JOINING_STAGE,
    INITIAL_DAMPING,
    JUMP_COST_TOLERANCE,
    MAX_CHI_SQUARE_RATIO,
    MAX_CREEPING_STEPS,
    MAX_GAP_SHARE,
    MAX_GRADIENT_ERROR,
    MAX_JUMP_MISFIT,
    MAX_LOG_CHANGE,
    MAX_LOOSENED,
    MAX_NODE_STEPS,
    MAX_NOISY_STEP,
    MAX_REPEATS,
    MAX_SEARCH_SUBSTEPS,
    MAX_SETTLED_STEP,
    MAX_SHIFT,
    MAX_STAGE_REFINEMENT,
    MAX_STEP_HALVINGS,
    MAX_TRIES,
    MAX_UNDAMPED_STEPS,
    MIN_DAMPING,
    MIN_GAIN_RATIO,
    MIN_IMPLICIT_SUBSTEPS,
    MISFIT_TOLERANCE,
    PATIENT_ITERATIONS,
    SETTLED_COST_DECREASE,
    STAGE_COST_TOLERANCE,
    STALL_COST_DECREASE,
    STEEP_DECREASE,
    STIFFNESS_UPDATE_CHANGE,
    TRAPPING_DAMPING,
    TRIAL_ITERATIONS,
    UNIDENTIFIABLE_PRIOR_RATIO,
    WIDE_GAP,
)
from pneuopt.shooting.transcription import Transcription


class BudgetSpentError(KeyboardInterrupt):
    """A CPU budget has ended; whatever keeps its best result at Ctrl-C keeps it here, too."""


class CpuBudget:
    """CPU seconds of this process, all its threads together, that may be spent from now on; infinite: no budget."""

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


@dataclass(frozen=True)
class Stage:
    """A stage of the search: how tight the gaps are, and how long it runs."""

    gap: float  # standard deviation of a gap, as a fraction of the state's nominal size
    iterations: int  # largest number of iterations
    # integration steps at the end of the stage, as a multiple of those before. Let the last stage have more than 1:
    # with 1 and a gap above `WIDE_GAP` a stage draws log parameters to their start (`has_prior`).
    refine: int = 1

    def __post_init__(self) -> None:
        require(0 < self.gap < math.inf, f"Stage(gap={self.gap}): give a positive fraction of a state's size, as 1e-3")
        require(self.iterations >= 0, f"Stage(iterations={self.iterations}): give 0 or more")
        require(self.refine >= 1, f"Stage(refine={self.refine}): give 1 (no finer steps) or more")

    @property
    def has_prior(self) -> bool:
        """Whether log parameters are drawn to their start: wide gaps hide what some do; a last stage refines steps."""
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
        their noise; a search that comes to the same ends there (`SearchEnd.DUPLICATE`).
    checks_steps : bool
        Whether finer integration steps are tried at the end: not where a refit keeps those of a fit that tried them.

    Raises
    ------
    InputError
        If an option is not in its range.
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

    def __post_init__(self) -> None:
        lead, substeps = "LeastSquares", self.substeps
        require(len(self.stages) > 0, f"{lead}(stages=()): give one Stage or more, or leave it out")
        require(self.segment_time > 0, f"{lead}(segment_time={self.segment_time}): give seconds above 0, or math.inf")
        is_count = substeps is None or (float(substeps).is_integer() and substeps >= 1)
        require(is_count, f"{lead}(substeps={substeps}): give a whole number from 1 on, or leave it out")
        for name in ("tolerance", "kinematic"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{lead}({name}={value}): give a positive number")


class SearchEnd(Enum):
    """Why a search ended, with the status that says so where nothing else is known."""

    OPTIMUM = Status(Code.CONVERGED)
    UNSETTLED = Status(Code.NOT_CONVERGED)
    ABANDONED = Status(Code.NOT_CONVERGED, ("a start is so far off that the others are tried first",))
    DUPLICATE = Status(Code.NOT_CONVERGED, ("a start has led to where another one was",))
    TOO_STIFF = Status(Code.NOT_CONVERGED, ("the model is too stiff",))
    DIVERGED = Status(Code.DIVERGED, ("the model is not finite at the start", "check values and units"))
    INTERRUPTED = Status(Code.INTERRUPTED, ("the best iterate so far", "run again for an answer"))

    @property
    def status(self) -> Status:
        """The status of a search that ended so."""
        return self.value


@dataclass(frozen=True, eq=False)
class Optimum:
    """The equations and the run at the end of a search, from which the residuals are diagnosed."""

    equations: NormalEquations
    run: RolloutResult  # with states, by the finest steps
    nodes: Array  # (m, n_states)
    values: Array  # all the problem's parameter values
    keep: Mask  # (k,): the free parameters that have a covariance
    gap_deviations: Array  # (n_states,): standard deviations of the gaps, in nominal sizes
    substeps: int  # integration steps a sample of the sensitivities


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a least squares: states over time, parameters, and how well the data determine them."""

    trajectories: tuple[Trajectory, ...]  # states and outputs, one a phase
    parameters: ParameterSet  # the problem's parameters with the free ones solved for
    status: Status  # as it is reported; a caller may say more of it
    end: SearchEnd  # why the search ended
    stats: Mapping[str, float]  # iterations, seconds, final cost, largest gap
    # (k, k): of the free parameters in their own units, at unit noise scale; None where the data do not determine them
    covariance: Array | None
    chi_square: float  # sum of squared data residuals, in noise standard deviations
    count: int  # number of data residuals
    at_bound: Mask  # (k,): which parameters are at a bound, without those fixed by equal bounds
    # (m, n_states): the gap behind each linked segment, in nominal sizes, if the gaps stand for noise of the
    # states
    jumps: Array | None = None
    # the parameters that the data do not determine here; a caller holds them, and fits again
    unidentifiable: tuple[str, ...] = ()
    # the parameter along which the search was still moving when it gave up; empty where it ended otherwise
    unsettled: tuple[str, ...] = ()
    # (k, k): the covariance due to a weak prior of fixed parameters (`NormalEquations.prior_covariance`);
    # None where nothing is fixed
    prior_covariance: Array | None = None
    variance_inflation: float = 1.0  # factor on the estimates' variance by weighted squares (robust losses)
    optimum: Optimum | None = None  # None where there is no covariance
    # the gap and the cost at the end of the stages from the third, and of the search
    stage_costs: tuple[tuple[float, float], ...] = ()

    def with_effort_of(self, *earlier: "Fit") -> "Fit":
        """The fit with the iterations and seconds of earlier ones added to its own."""
        total = {n: sum(fit.stats[n] for fit in (*earlier, self)) for n in ("iterations", "seconds")}
        return replace(self, stats={**self.stats, **total})


def solve_least_squares(transcription: Transcription, method: LeastSquares | None = None) -> Fit:
    """Solve a transcription without costs and limits from its guesses; Ctrl-C gives the best iterate, marked."""
    began, state = time.perf_counter(), start_search(segment(transcription), method or LeastSquares())
    return end_search(run_search(state), time.perf_counter() - began)


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
    """The lifted least squares with given gaps' weights and integration steps."""

    segments: Segments
    scaling: ParameterScaling
    sigma: Array  # (n_states,): standard deviation of a gap, in nominal sizes
    substeps: int  # integration steps a sample
    correction: IntegrationCorrection | None = None  # the change of outputs and ends by finer steps
    has_prior: bool = False  # whether log parameters are drawn to their start (`ParameterScaling.add_start_prior`)

    def evaluate(self, nodes: Array, z: Array) -> Iterate:
        """The iterate at these nodes, shape (m, n_states), and searched parameters."""
        with np.errstate(all="ignore"):  # a step too far may overflow; its cost is infinite then
            given = (nodes, self.scaling.values(z), self.scaling.chain(z), self.sigma, self.substeps, self.correction)
            equations = normal_equations(self.segments, *given)
        return self.with_prior(nodes, z, equations)

    def with_prior(self, nodes: Array, z: Array, equations: NormalEquations) -> Iterate:
        """The iterate with these equations, to which the prior is added where there is one."""
        return Iterate(nodes, z, self.scaling.add_start_prior(equations, z) if self.has_prior else equations)


NO_POSITIONS = np.zeros(0, dtype=np.intp)


class ConvergenceTest(NamedTuple):
    """The status of an iterate, and the positions of free parameters that the data do not determine there."""

    status: Status
    unidentifiable: Indices = NO_POSITIONS
    unsettled: Indices = NO_POSITIONS  # the one that would still move most where nothing else is wrong
    largest_step: float = 0.0  # of a converged iterate [standard deviations]


@dataclass(frozen=True, eq=False)
class SearchSetup:
    """What stays the same during a search."""

    method: LeastSquares
    scaling: ParameterScaling
    gap_scales: Array  # (n_states,): factor on each state's gaps (`segments.gap_scales`)
    # required_substeps, first_substeps: integration steps a sample by the stiffness of the start, and those that the
    # search begins with
    required_substeps: int
    first_substeps: int

    @property
    def is_too_stiff(self) -> bool:
        """Whether a sample of the start takes more integration steps than a search can afford."""
        return self.required_substeps > self.first_substeps


class StageEnd(NamedTuple):
    """Where a stage ended."""

    nodes: Array
    z: Array
    cost: float


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search is: its iterate, the stage and the steps by which it got there, and what it has tried."""

    setup: SearchSetup
    iterate: Iterate  # nodes, parameters as searched, and the equations linearised there
    stage: Stage
    # substeps, output_substeps: integration steps a sample of the sensitivities, and of the outputs
    substeps: int
    output_substeps: int
    stiffness_values: Array  # all parameters' values at which the integration steps were chosen
    node_damping: Array  # (m,): of each node alone, over its diagonal, where the stage has ended
    tolerance: float  # the method's; wider where kinks hold up a search that has settled
    correction: IntegrationCorrection | None = None  # what finer steps change in the outputs
    is_coarse: bool = False  # whether finer steps are to follow in this stage
    noisy_gaps: bool = False  # whether the gaps stand for noise of the states
    # iterations, stage_began: iterations so far, and at the beginning of the stage
    iterations: int = 0
    stage_began: int = 0
    has_stalled: bool = False  # whether the stage has converged, or hardly lowered the cost at its end
    last_decrease: float = 0.0  # of the stage's cost by its last iteration, over itself
    # largest change of an output by the last refinement [noise standard deviations]; NaN where there was none
    integration_change: float = math.nan
    stage_ends: tuple[StageEnd, ...] = ()
    unsettled_gaps: frozenset[float] = frozenset()  # gaps at which noise of the states has not settled
    tried_state_noise: bool = False  # whether noise of the states was tried before the last stage
    end: SearchEnd | None = None  # None while the search goes on
    status: Status = SearchEnd.UNSETTLED.status  # what is said of the end

    @property
    def method(self) -> LeastSquares:
        """The method and its options."""
        return self.setup.method

    @property
    def segments(self) -> Segments:
        """The segments, with their integration."""
        return self.iterate.equations.segments

    @property
    def cost(self) -> float:
        """Half of the squares of data and gaps, without the prior of a stage."""
        return self.iterate.cost - self.stage.has_prior * self.setup.scaling.start_prior_cost(self.iterate.z)

    @property
    def is_at_noise(self) -> bool:
        """Whether the cost is that of the noise alone."""
        return is_noise_cost(self.iterate.cost, self.iterate.equations.count)

    @property
    def is_hopeless(self) -> bool:
        """Whether this search is to be left for those from other starts."""
        return 2 * self.iterate.cost > self.method.max_misfit * self.iterate.equations.count

    @property
    def is_near_end(self) -> bool:
        """Whether a search explains the log to its noise in a last stage that refines its steps, and so converges."""
        return self.stage is self.method.stages[-1] and self.stage.refine > 1 and self.is_at_noise

    @property
    def gaps_absorb_misfit(self) -> bool:
        """Whether the gaps absorb the misfit of the model in a stalled search: tighter gaps cost more."""
        return self.has_stalled and self.iterate.equations.gap_share > MAX_GAP_SHARE and not self.is_at_noise

    @property
    def corrects_residuals(self) -> bool:
        """Whether finer steps are for the residuals alone: derivatives need them where these exceed the noise."""
        return not self.noisy_gaps and self.is_at_noise

    @property
    def outputs(self) -> Array:
        """The model's outputs with the correction of finer steps, shape (m, n, n_outputs)."""
        y = self.iterate.equations.linearisation.y
        return y if self.correction is None else y + self.correction.y

    @property
    def gap_deviations(self) -> Array:
        """Standard deviations of the stage's gaps, in nominal sizes, shape (n_states,)."""
        return self.stage.gap * self.setup.gap_scales

    def objective(self, segments: Segments | None = None) -> Objective:
        """The least squares of the stage, by the integration of the state or of other segments."""
        given = (segments or self.segments, self.setup.scaling, self.gap_deviations, self.substeps, self.correction)
        return Objective(*given, self.stage.has_prior)

    def at(self, nodes: Array, z: Array, segments: Segments | None = None) -> "SearchState":
        """The state with the iterate at these nodes and searched parameters."""
        return replace(self, iterate=self.objective(segments).evaluate(nodes, z))

    def run(self, steps: int) -> RolloutResult:
        """The run of the iterate by so many integration steps a sample, with states."""
        return self.segments.run(self.iterate.nodes, self.setup.scaling.values(self.iterate.z), steps, states=True)

    def largest_change(self, change: Array) -> float:
        """The largest change of a measured output [noise standard deviations], of all that are given."""
        weighted = np.abs(change) * self.segments.weights
        return float(np.max(weighted, where=np.isfinite(self.segments.measured), initial=0.0))

    def moves_no_estimate(self, change: Array) -> bool:
        """Whether a change of the outputs moves no estimate: none moves by more deviations than the norm of it."""
        weighted = (change * self.segments.weights)[np.isfinite(self.segments.measured)]
        return float(np.nansum(weighted**2)) <= MAX_GRADIENT_ERROR**2

    def promised_squares(self, stage: Stage) -> float:
        """The squares, in noise variances, to which the gaps of a stage would lead by the linearised equations."""
        slopes, scaling = self.iterate.equations.linearisation, self.setup.scaling
        equations = weigh_gaps(self.segments, slopes, stage.gap * self.setup.gap_scales)
        return equations.promised_squares(scaling.has_effect(equations) & ~scaling.fixed)

    def assess(self) -> ConvergenceTest:
        """The convergence test of the iterate."""
        equations, z, message = self.iterate.equations, self.iterate.z, f"{self.iterations} iterations"
        found = assess_convergence(
            equations, self.setup.scaling, z, self.tolerance, message, noisy_gaps=self.noisy_gaps
        )
        if not (found.status.converged and found.largest_step > self.method.tolerance):
            return found
        asked = f"kinks of the model ask for {found.largest_step:.2g} standard deviations, which the intervals hold"
        return found._replace(status=found.status.with_details(f"the estimates have settled; {asked}"))

    def end_with(self, end: SearchEnd, status: Status | None = None) -> "SearchState":
        """The state with an end, and its status if that says more than the end does."""
        return replace(self, end=end, status=status or end.status)

    def conclude(self, found: ConvergenceTest | None = None) -> "SearchState":
        """The state with the end that its convergence test says."""
        status = (found or self.assess()).status
        return self.end_with(SearchEnd.OPTIMUM if status.converged else SearchEnd.UNSETTLED, status)

    def resumed_after(self, trial: "SearchState") -> "SearchState":
        """The state after a trial that led nowhere: nothing has moved but the trial's iterations and stiffness."""
        return replace(self, iterations=trial.iterations, stiffness_values=trial.stiffness_values)


class InterruptedSearchError(KeyboardInterrupt):
    """An interruption, with the last state before it."""

    def __init__(self, state: SearchState) -> None:
        super().__init__()
        self.state = state


P = ParamSpec("P")


def keeps_state(
    move: Callable[Concatenate[SearchState, P], SearchState],
) -> Callable[Concatenate[SearchState, P], SearchState]:
    """Let an interruption of a move carry the state before it, unless it carries a later one already."""

    @wraps(move)
    def keeping(state: SearchState, /, *args: P.args, **kwargs: P.kwargs) -> SearchState:
        try:
            return move(state, *args, **kwargs)
        except InterruptedSearchError:
            raise
        except KeyboardInterrupt as stop:
            raise InterruptedSearchError(state) from stop

    return keeping


def start_search(segments: Segments, method: LeastSquares) -> SearchState:
    """The state in which a search begins, at the guesses of a transcription."""
    scaling, nodes = ParameterScaling(segments.transcription), start_nodes(segments)
    values = scaling.values(scaling.start)
    segments, required = choose_integration(segments, nodes, values, method.substeps)
    first = method.substeps or min(required, MAX_SEARCH_SUBSTEPS)
    setup = SearchSetup(method, scaling, gap_scales(segments, method.kinematic), required, first)
    stage = method.stages[0]
    objective = Objective(segments, scaling, stage.gap * setup.gap_scales, first, None, stage.has_prior)
    iterate = objective.evaluate(nodes, scaling.start)
    return SearchState(setup, iterate, stage, first, first, values, np.zeros(segments.count), method.tolerance)


def run_search(state: SearchState) -> SearchState:
    """Run all stages to an end; an interruption (Ctrl-C) ends them with the best iterate so far, marked."""
    try:
        with check_during_runs(state.method.budget.check):
            return refine_steps(run_stages(state))
    except InterruptedSearchError as stop:
        return stop.state.end_with(SearchEnd.INTERRUPTED)
    except KeyboardInterrupt:
        return state.end_with(SearchEnd.INTERRUPTED)


@keeps_state
def run_stages(state: SearchState) -> SearchState:
    """Run the schedule of stages, from loose gaps to tight ones, until one of them ends the search."""
    if state.setup.is_too_stiff:
        verdict = f"the model is so stiff that a sample takes {state.setup.required_substeps} integration steps"
        remedy = "widen the smoothing of its sharpest term, or give LeastSquares(substeps=)"
        return state.end_with(SearchEnd.TOO_STIFF, Status(Code.NOT_CONVERGED, (verdict, remedy)))
    for stage in state.method.stages:
        state = pass_stage(state, stage)
        if state.end is not None:
            return state
    concluded = repeat_last_stage(state)
    # gaps that absorb the misfit of the model: the answer depends on their weight
    is_absorbed = concluded.iterate.equations.gap_share > MAX_GAP_SHARE and not state.tried_state_noise
    return allow_state_noise(concluded) if is_absorbed else concluded


@keeps_state
def pass_stage(state: SearchState, stage: Stage) -> SearchState:
    """One stage of the schedule, with what is tried before the last one and after the first one."""
    first, last = state.method.stages[0], state.method.stages[-1]
    if stage is last and state.gaps_absorb_misfit and state.method.allows_state_noise:
        state = replace(allow_state_noise(state), tried_state_noise=True)
        if state.end is not None:
            return state
    elif stage is last and state.stage_ends and state.is_hopeless:
        return state.end_with(SearchEnd.ABANDONED)
    state = run_stage(state, stage)
    if not math.isfinite(state.iterate.cost):
        return state.end_with(SearchEnd.DIVERGED)
    state = replace(state, stage_ends=(*state.stage_ends, StageEnd(state.iterate.nodes, state.iterate.z, state.cost)))
    if joins_known_search(state):
        return state.end_with(SearchEnd.DUPLICATE)
    if stage is not last and state.is_hopeless:
        return state.end_with(SearchEnd.ABANDONED)
    return shorten(state) if stage is first else state


def joins_known_search(state: SearchState) -> bool:
    """Whether a search has come to where a known one was after the same stage, and would go on as that one."""
    known = [cost for gap, cost in state.method.known_costs if gap == state.stage.gap]
    return any(abs(state.cost - cost) <= STAGE_COST_TOLERANCE * cost for cost in known)


def run_stage(state: SearchState, stage: Stage) -> SearchState:
    """The state after a stage that begins where the search is; as it is entered where the model is not finite there."""
    state = enter_stage(state, stage, state.iterate.nodes, state.iterate.z)
    return finish_stage(state, stage.iterations) if math.isfinite(state.iterate.cost) else state


@keeps_state
def enter_stage(state: SearchState, stage: Stage, nodes: Array, z: Array) -> SearchState:
    """Weigh the gaps as in a stage, with integration steps from the stiffness at these nodes."""
    segments, steps, stiffness_values = renew_integration(state, nodes, z)
    is_same = segments is state.segments and nodes is state.iterate.nodes
    is_known = is_same and steps == state.substeps and state.correction is None
    entered = replace(
        state,
        stage=stage,
        tolerance=state.method.tolerance,
        substeps=steps,
        output_substeps=steps,
        stiffness_values=stiffness_values,
        correction=None,
        is_coarse=stage.refine > 1,
        node_damping=np.zeros(len(nodes)),
    )
    if not is_known:
        return entered.at(nodes, z, segments)
    equations = weigh_gaps(segments, state.iterate.equations.linearisation, entered.gap_deviations)
    return replace(entered, iterate=entered.objective().with_prior(nodes, z, equations))


def renew_integration(state: SearchState, nodes: Array, z: Array) -> tuple[Segments, int, Array]:
    """The integration, its steps, and the values it was chosen for; the state's own where hardly one has changed."""
    values, setup = state.setup.scaling.values(z), state.setup
    if state.method.substeps or np.allclose(values, state.stiffness_values, rtol=STIFFNESS_UPDATE_CHANGE):
        return state.segments, state.substeps, state.stiffness_values
    segments, needed = choose_integration(state.segments, nodes, values)
    most = MAX_STAGE_REFINEMENT * max(setup.first_substeps, MIN_IMPLICIT_SUBSTEPS)
    return segments, min(needed, most), values


@keeps_state
def finish_stage(state: SearchState, iterations: int) -> SearchState:
    """Iterate in a stage, then again with the finer steps that it asks for; at the noise they correct residuals."""
    state = iterate(state, iterations)
    if not (state.stage.refine > 1 and state.correction is None and not state.is_hopeless):
        return state
    finer = apply_finer_steps(state, fine_steps(state.segments, state.substeps, state.stage.refine))
    return iterate(finer, iterations) if math.isfinite(finer.iterate.cost) else replace(state, is_coarse=False)


def iterate(state: SearchState, iterations: int) -> SearchState:
    """Iterate in a stage, until it converges, or its iterations are used up: then it may have stalled."""
    damping, before = min(INITIAL_DAMPING, 10 * state.stage.gap**2), math.inf  # as the diagonal grows
    state = replace(state, stage_began=state.iterations, last_decrease=0.0)
    descent = LevenbergMarquardt(
        state.objective(), damping, lambda at, reduced, step: is_negligible_step(state, at, reduced, step)
    )
    descent.node_damping = np.zeros(len(state.node_damping)) if state.noisy_gaps else state.node_damping
    creeping = 0
    try:
        for _ in range(iterations):
            if state.is_coarse and state.corrects_residuals and state.correction is None:
                state = correct_residuals_by(state, fine_steps(state.segments, state.substeps, state.stage.refine))
                descent.objective = state.objective()
            descent.damps_nodes = state.noisy_gaps or state.is_near_end
            trial = descent.step(state.iterate)
            state = replace(state, node_damping=descent.node_damping)
            if trial is None:
                return replace(state, has_stalled=True)
            before = state.iterate.cost
            state = replace(state, iterate=trial, iterations=state.iterations + 1)
            if state.method.progress is not None:
                state.method.progress(describe_iteration(state))
            short = min(CREEPING_SHARE * descent.promised, STAGE_COST_TOLERANCE * before)
            creeping = creeping + 1 if state.noisy_gaps and before - trial.cost < short else 0
            if creeping == MAX_CREEPING_STEPS:
                at, (best, taken) = state.iterate.cost, descent.undamped_steps(state.iterate)
                state, creeping = replace(state, iterate=best, iterations=state.iterations + taken), 0
                if not best.cost < at:
                    return replace(state, has_stalled=True)
    except KeyboardInterrupt as stop:
        raise InterruptedSearchError(state) from stop
    decrease = 1 - state.iterate.cost / before
    return replace(state, last_decrease=decrease, has_stalled=decrease < STALL_COST_DECREASE)


def describe_iteration(state: SearchState) -> str:
    """A line of progress: the stage, the iteration, the cost and the largest gap."""
    stages = state.method.stages
    number = "loosened" if state.noisy_gaps else f"stage {stages.index(state.stage) + 1}/{len(stages)}"
    return (
        f"{number}  iteration {state.iterations}  cost {state.cost:.6g}  "
        f"largest gap {state.iterate.equations.largest_gap:.1e}"
    )


def is_negligible_step(state: SearchState, current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
    """Whether a step is negligible: in the last stage, 0.1 % of a deviation in any direction, or as good as that.

    With noisy gaps, whose states settle late, the parameters' step counts; so it does where a wrong model's search is
    slow, in deviations of the residuals: what is far below these is far below the bias.
    """
    promised, equations = 0.5 * current.equations.arrow.descent_rate(step), current.equations
    is_last, misfit = state.stage.gap <= state.method.stages[-1].gap, max(1.0, 2 * current.cost / equations.count)
    if not (state.noisy_gaps or is_last):
        is_first = state.stage is state.method.stages[0] and is_noise_cost(current.cost, equations.count)
        return promised < (JUMP_COST_TOLERANCE if is_first else STAGE_COST_TOLERANCE) * current.cost
    if is_last and promised < FINAL_COST_TOLERANCE * misfit:
        return True
    is_slow = state.iterations - state.stage_began >= PATIENT_ITERATIONS
    is_wrong = is_last and is_slow and misfit > MAX_CHI_SQUARE_RATIO
    asks_parameters = bool(state.segments.transcription.parameters.free_names)
    is_settled = asks_parameters and (state.is_coarse or is_wrong or promised < SETTLED_COST_DECREASE * misfit)
    if not ((is_settled or state.noisy_gaps) and promised < STAGE_COST_TOLERANCE * current.cost):
        return False
    keep = state.setup.scaling.movable(current.z, equations, reduced)
    largest = largest_parameter_step(equations, keep, reduced, step.parameters) / state.method.tolerance
    if is_wrong:
        return largest < MISFIT_TOLERANCE * math.sqrt(max(1.0, equations.chi_square / max(1, equations.count)))
    return largest < (COARSE_TOLERANCE if state.is_coarse else FINE_TOLERANCE)


@keeps_state
def apply_finer_steps(state: SearchState, steps: int) -> SearchState:
    """Integrate the iterate by finer steps."""
    if state.corrects_residuals:
        return correct_residuals_by(state, steps)
    finer = replace(state, substeps=steps, output_substeps=steps, correction=None, is_coarse=False)
    return finer.at(state.iterate.nodes, state.iterate.z)


def correct_residuals_by(state: SearchState, steps: int) -> SearchState:
    """Add what finer steps change to the residuals of the iterate; derivatives are computed anew where that is much."""
    slopes, fine = state.iterate.equations.linearisation, state.run(steps)
    correction = IntegrationCorrection(fine.y - slopes.y, fine.x_end - slopes.x_end, fine, state.iterate.nodes)
    corrected = replace(state, correction=correction, output_substeps=steps, is_coarse=False)
    nodes, z, equations = state.iterate.nodes, state.iterate.z, state.iterate.equations
    if not state.moves_no_estimate(fine.y - state.outputs):
        return corrected.at(nodes, z)
    equations = correct_residuals(equations, nodes, correction, state.gap_deviations)
    return replace(corrected, iterate=Iterate(nodes, z, equations))


class Shortcut(Enum):
    """What may follow a first stage in place of the stages between it and the last."""

    NONE = "the stages between"
    LAST_STAGE = "the last stage at once, while it soon converges"
    STATE_NOISE = "gaps as noise of the states"


def choose_shortcut(state: SearchState) -> tuple[Shortcut, Stage]:
    """The shortcut after the first stage of a search that explains its logs, and the stage in which it goes on."""
    count, (first, *between, last) = state.iterate.equations.count, state.method.stages
    if not state.promised_squares(last) > MAX_JUMP_MISFIT * count:
        return Shortcut.LAST_STAGE, last
    if not state.method.allows_state_noise:
        return Shortcut.NONE, first
    near_noise = [s for s in between if state.promised_squares(s) <= MAX_CHI_SQUARE_RATIO * count]
    return Shortcut.STATE_NOISE, near_noise[-1] if near_noise else first


@keeps_state
def shorten(state: SearchState) -> SearchState:
    """The optimum that a shortcut after the first stage leads to; where it does not, the state goes on from there."""
    stays = len(state.method.stages) < 3 or bool(state.method.known_costs)
    if stays or not state.is_at_noise:
        return state
    if state.segments.implicit_state is not None:  # the errors of coarse steps add up where no gaps take them
        state = correct_residuals_by(state, fine_steps(state.segments, state.substeps, state.method.stages[-1].refine))
    shortcut, stage = choose_shortcut(state)
    if shortcut is Shortcut.LAST_STAGE:
        return jump_to_last_stage(state)
    if shortcut is Shortcut.NONE:
        return state
    return loosen(state, stage, state.iterate.nodes, state.iterate.z)


def jump_to_last_stage(state: SearchState) -> SearchState:
    """The optimum that the last stage soon reaches; where it does not, the state goes on from there."""
    trial = enter_stage(state, state.method.stages[-1], state.iterate.nodes, state.iterate.z)
    if math.isfinite(trial.iterate.cost):
        trial = iterate(trial, TRIAL_ITERATIONS)
        if trial.is_at_noise:  # finer steps are lost on what has not come near the noise by then
            trial = finish_stage(trial, TRIAL_ITERATIONS).conclude()
            if trial.end is SearchEnd.OPTIMUM and trial.is_at_noise:
                return trial
    return state.resumed_after(trial)


class Repeat(Enum):
    """How a last stage goes on that has used up its iterations."""

    STOP = "not at all"
    FREE_NODES = "from where trapped nodes are put to the ends of the segments before them"
    GO_ON = "from where it is"


def choose_repeat(state: SearchState, found: ConvergenceTest) -> Repeat:
    """How the last stage goes on: while it lowers the cost steeply, or at the noise at all, but has not converged.

    Nodes that overshoot a kink of friction at rest are damped alone; one that its equations no longer move is trapped.
    """
    is_trial = state.stage.iterations <= TRIAL_ITERATIONS
    falls = state.last_decrease > STEEP_DECREASE and not is_trial
    goes_on = state.noisy_gaps or state.is_near_end or falls
    if found.status.converged or found.unidentifiable.size or not goes_on:
        return Repeat.STOP
    return Repeat.FREE_NODES if trapped_nodes(state).size and not state.noisy_gaps else Repeat.GO_ON


def trapped_nodes(state: SearchState) -> Indices:
    """Positions of nodes that a kink of the model traps."""
    return np.flatnonzero(state.node_damping > TRAPPING_DAMPING).astype(np.intp)


@keeps_state
def repeat_last_stage(state: SearchState) -> SearchState:
    """Run the last stage again as `choose_repeat` says; once that moves no estimate, kinks count no longer."""
    least_decrease = 0.5 * state.method.tolerance**2  # that of a step of so many deviations
    count = min(TRIAL_ITERATIONS, state.stage.iterations)
    for _ in range(MAX_REPEATS * state.stage.iterations // max(1, count)):
        before, found = state, state.assess()
        repeat = choose_repeat(state, found)
        if repeat is Repeat.STOP:
            return state.conclude(found)
        state = free_nodes(state, trapped_nodes(state)) if repeat is Repeat.FREE_NODES else iterate(state, count)
        has_settled = moved_deviations(state, before.iterate.z) <= state.method.tolerance
        if has_settled:
            settled = MAX_NOISY_STEP if state.noisy_gaps else MAX_SETTLED_STEP
            state = replace(state, tolerance=max(state.tolerance, settled))
        is_lost = state.noisy_gaps and not has_settled  # a kink that it creeps over would take hundreds of steps
        if is_lost or before.iterate.cost - state.iterate.cost < least_decrease:
            break
    return state.conclude()


@keeps_state
def free_nodes(state: SearchState, trapped: Indices) -> SearchState:
    """Run the last stage with trapped nodes put to the ends of the segments before them, if that lowers the cost."""
    nodes, behind = state.iterate.nodes.copy(), trapped[trapped > 0]
    nodes[behind] += state.iterate.equations.gaps[behind - 1] * state.segments.nominal
    freed = iterate(
        replace(state.at(nodes, state.iterate.z), node_damping=np.zeros(len(nodes))), state.stage.iterations
    )
    return freed if freed.iterate.cost < state.iterate.cost else state.resumed_after(freed)


def moved_deviations(state: SearchState, z: Array) -> float:
    """How far the parameters have moved from z, at most [standard deviations]; infinite where one has none."""
    equations, current = state.iterate.equations, state.iterate.z
    reduced = equations.arrow.eliminate(0.0)
    if reduced is None:
        return math.inf
    keep = state.setup.scaling.movable(current, equations, reduced)
    return largest_parameter_step(equations, keep, reduced, current - z)


def allow_state_noise(state: SearchState) -> SearchState:
    """The optimum with the tightest gaps that agree as noise of a wrong model's states; or nothing moves."""
    for stage, at in stages_to_loosen(state) if state.method.allows_state_noise else ():
        state = loosen(state, stage, at.nodes, at.z)
        if state.end is SearchEnd.OPTIMUM:
            break
    return state


def stages_to_loosen(state: SearchState) -> tuple[tuple[Stage, StageEnd], ...]:
    """The stages whose gaps may stand for noise of the states, tightest first, and where they ended.

    They explained the logs to their noise; those that did not settle would, from another start, creep again.
    """
    ended = zip(state.method.stages[:-1], state.stage_ends, strict=False)
    explaining = [(s, e) for s, e in ended if is_noise_cost(e.cost, state.iterate.equations.count)]
    return tuple((s, e) for s, e in reversed(explaining[-MAX_LOOSENED:]) if s.gap not in state.unsettled_gaps)


@keeps_state
def loosen(state: SearchState, stage: Stage, nodes: Array, z: Array) -> SearchState:
    """The optimum with a stage's gaps as noise of the states, or tight ones if it leads there; else nothing moves."""
    last, noisy = state.method.stages[-1], replace(state, noisy_gaps=True)
    trial = enter_stage(noisy, replace(stage, iterations=last.iterations, refine=last.refine), nodes, z)
    trial = repeat_last_stage(finish_stage(trial, last.iterations))
    if trial.end is SearchEnd.OPTIMUM:
        return tighten(trial)
    back = state.resumed_after(trial)
    return replace(back, unsettled_gaps=state.unsettled_gaps | {stage.gap})


@keeps_state
def tighten(state: SearchState) -> SearchState:
    """The optimum with tight gaps, where one with noise of the states, whose equations are nearer, leads to it."""
    last, trial = state.method.stages[-1], replace(state, noisy_gaps=False)
    if state.promised_squares(last) > MAX_JUMP_MISFIT * state.iterate.equations.count:
        return state
    for stage in state.method.stages:
        if stage.gap < state.stage.gap and trial.is_at_noise:
            trial = run_stage(trial, stage)
    trial = trial.conclude()
    if trial.stage is last and trial.end is SearchEnd.OPTIMUM and trial.is_at_noise:
        return trial
    return state.resumed_after(trial)


@keeps_state
def refine_steps(state: SearchState) -> SearchState:
    """Halve the integration steps of an optimum until no estimate moves; steps that the user gave stay."""
    for _ in range(MAX_STEP_HALVINGS):
        steps = choose_finer_steps(state)
        if not steps:
            break
        finer = apply_finer_steps(state, steps)
        change = finer.outputs - state.outputs
        if steps_are_fine(state) and finer.correction is not None:
            change = finer.correction.y
        if not math.isfinite(finer.iterate.cost):
            break
        if finer.assess().status.converged:
            shown = math.nan if state.method.substeps else finer.largest_change(change)
            state = replace(finer, integration_change=shown)
            # the finer steps have moved the optimum with noise of the states a little
            return iterate(state, state.stage.iterations) if state.noisy_gaps else state
        state = iterate(finer, finer.stage.iterations).conclude()
    return state


def choose_finer_steps(state: SearchState) -> int:
    """The steps a sample that show what the integration still changes at an optimum; 0 where none are to be tried.

    They are half as long; as they are where the last refinement moved no estimate, and where the user gave the steps.
    """
    if state.end is not SearchEnd.OPTIMUM or not state.method.checks_steps:
        return 0
    return (1 if state.method.substeps or steps_are_fine(state) else 2) * state.output_substeps


def steps_are_fine(state: SearchState) -> bool:
    """Whether the finer steps of the last stage have moved no estimate."""
    return state.correction is not None and state.moves_no_estimate(state.correction.y)


IsNegligible = Callable[[Iterate, ReducedEquations, GaussNewtonStep], bool]


class LevenbergMarquardt:
    """Levenberg-Marquardt steps on one objective."""

    def __init__(self, objective: Objective, damping: float, is_negligible: IsNegligible) -> None:
        self.damps_nodes, self.promised = False, math.inf
        self.objective, self.damping, self._is_negligible = objective, damping, is_negligible
        self.node_damping = np.zeros(objective.segments.count)

    def step(self, current: Iterate) -> Iterate | None:
        """The next iterate; None if no damping lowers the cost, or the step would be negligible."""
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
                    shift = (trial.nodes - current.nodes) / self.objective.segments.nominal
                    given = shift, trial.z - current.z, trial.equations, self.objective.sigma
                    self.node_damping = missed_curvature(current.equations, *given)
                if is_lower:
                    self.damping = self.damping * 0.1 if self.damping > MIN_DAMPING else 0.0
                    return trial
                if k == 0 and self.node_damping.any():
                    continue
            self.damping, raise_by = max(self.damping, MIN_DAMPING) * raise_by, 3 * raise_by
        return None

    def undamped_steps(self, current: Iterate) -> tuple[Iterate, int]:
        """Take undamped steps over a kink at which a descent creeps: the best iterate among them, and their number.

        It is the watchdog technique (Chamberlain et al., Mathematical Programming Study 16, 1982).
        """
        trial: Iterate | None = current
        best, taken = current, 0
        while trial is not None and math.isfinite(trial.cost) and taken < MAX_UNDAMPED_STEPS:
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

        The bend of the valley that tight gaps make turns a long step into gaps; a step of the nodes alone closes them.
        """
        z = self.objective.scaling.project_to_bounds(current.z + step.parameters)
        moved = z - current.z
        shift = reduced.back_substitute(moved)  # a bound may have cut the parameters' step short
        trial = self.objective.evaluate(current.nodes + shift * self.objective.segments.nominal, z)
        promised = 0.5 * current.equations.arrow.descent_rate(GaussNewtonStep(shift, moved))
        for _ in range(MAX_NODE_STEPS):
            by_data = 0.5 * (trial.equations.chi_square - current.equations.chi_square)
            misses_by_gaps = math.isfinite(trial.cost) and trial.cost - current.cost > 2 * by_data
            if current.cost - trial.cost >= MIN_GAIN_RATIO * promised or not misses_by_gaps:
                break
            arrow = trial.equations.arrow
            own = arrow.node_step(self.damping + self.node_damping)
            if own is None or trial.cost - 0.5 * arrow.descent_rate(GaussNewtonStep(own, 0.0 * z)) >= current.cost:
                break
            settled = self.objective.evaluate(trial.nodes + own * self.objective.segments.nominal, z)
            if not settled.cost < trial.cost:
                break
            trial = settled
        return trial


def assess_convergence(
    equations: NormalEquations, space: ParameterScaling, z: Array, tolerance: float, message: str, *, noisy_gaps: bool
) -> ConvergenceTest:
    """Test an iterate: converged means that a full undamped step would move no parameter noticeably.

    `tolerance` is the largest step of a converged iterate [standard deviations], `message` its status's first sentence.
    """
    names = np.array(equations.segments.transcription.parameters.free_names, dtype=object)
    no_sensitivity = np.diag(equations.arrow.corner) == 0  # even at a bound
    idle = ~space.fixed & ~space.has_effect(equations) & (no_sensitivity | ~space.at_bound(z))
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
    bounded = np.flatnonzero(space.at_bound(z) & ~space.fixed)
    return ConvergenceTest(
        _optimum_status(equations, message, noisy_gaps=noisy_gaps),
        _least_sensitive(bounded, space, reduced, noise, z),
        largest_step=float(np.max(step, initial=0.0)),
    )


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


def largest_parameter_step(equations: NormalEquations, keep: Mask, reduced: ReducedEquations, step: Array) -> float:
    """The largest step (k,) of a kept parameter, in its deviations; infinite where the data do not determine all."""
    if equations.unidentifiable_parameters(reduced, keep).size:
        return math.inf
    spread = np.sqrt(np.diag(positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])))
    return float(np.max(np.abs(step[keep]) / spread, initial=0.0))


def is_noise_cost(cost: float, count: int) -> bool:
    """Whether this cost is that of the noise alone in so many residuals."""
    return 2 * cost <= MAX_CHI_SQUARE_RATIO * count


def end_search(state: SearchState, seconds: float) -> Fit:
    """The fit where a search has ended, after so many seconds."""
    transcription, scaling = state.segments.transcription, state.setup.scaling
    current, equations, free = state.iterate, state.iterate.equations, transcription.parameters.free_names
    q, run, fixed = scaling.values(current.z), _final_run(state), scaling.fixed
    at_bound = scaling.at_bound(current.z) & ~fixed
    keep = scaling.has_effect(equations) & ~at_bound & ~fixed
    covariance, prior, optimum, found = None, None, None, ConvergenceTest(state.status)
    if math.isfinite(equations.cost):
        covariance = equations.covariance(keep, noisy_gaps=state.noisy_gaps)
        if covariance is not None and state.tolerance > state.method.tolerance:
            covariance = covariance + unsettled_covariance(state)
        if fixed.any():
            prior = equations.prior_covariance(keep, fixed, scaling.weak_prior(current.z))
        if not (state.setup.is_too_stiff or state.end in (SearchEnd.ABANDONED, SearchEnd.DUPLICATE)):
            found = state.assess()
    if covariance is not None:
        optimum = Optimum(equations, run, current.nodes, q, keep, state.gap_deviations, state.substeps)
    ended = [(stage.gap, end.cost) for stage, end in zip(state.method.stages, state.stage_ends, strict=False)]
    return Fit(
        state.segments.trajectories(run),
        transcription.parameters.with_values(dict(zip(free, q[transcription.free].tolist(), strict=True))),
        state.status,
        state.end or SearchEnd.UNSETTLED,
        _stats(state, run, seconds),
        covariance,
        equations.chi_square,
        equations.count,
        at_bound,
        equations.gaps[state.segments.linked] if state.noisy_gaps else None,
        tuple(free[i] for i in found.unidentifiable),
        tuple(free[i] for i in found.unsettled),
        prior,
        optimum=optimum,
        stage_costs=(*ended[FIRST_JOINING_STAGE:], (state.stage.gap, state.cost)),
    )


def unsettled_covariance(state: SearchState) -> Array:
    """The covariance (own units) of the step that kinks still ask for. Shape (k, k)."""
    equations, z = state.iterate.equations, state.iterate.z
    reduced = equations.arrow.eliminate(0.0)
    solved = reduced and reduced.step(state.setup.scaling.movable(z, equations, reduced))
    asked = equations.linearisation.chain * solved.parameters if solved else np.zeros(len(z))
    return np.outer(asked, asked)


def _final_run(state: SearchState) -> RolloutResult:
    """The run of the last iterate by the finest steps, with states; those of an interrupted search are by its own."""
    correction = state.correction
    if correction is not None and correction.nodes is state.iterate.nodes:
        return correction.fine_run
    if state.end is not SearchEnd.INTERRUPTED or not math.isfinite(state.iterate.cost):
        return state.run(state.output_substeps)
    run = state.run(state.substeps)
    return run if correction is None else replace(run, y=run.y + correction.y, x_end=run.x_end + correction.x_end)


def _stats(state: SearchState, run: RolloutResult, seconds: float) -> dict[str, float]:
    """The figures of a search; the integration error is the largest change of an output by halved steps [deviations].

    It is NaN without an optimum, and where the budget ends before it is measured: the answer is known by then.
    """
    error = state.integration_change
    if not math.isfinite(error) and state.end is SearchEnd.OPTIMUM and state.method.checks_steps:
        error = math.nan
        with suppress(BudgetSpentError), check_during_runs(state.method.budget.check):
            error = state.largest_change(state.run(2 * state.output_substeps).y - run.y)
    return {
        "iterations": float(state.iterations),
        "seconds": seconds,
        "cost": state.cost,
        "substeps": float(state.output_substeps),
        "largest_gap": state.iterate.equations.largest_gap,
        "gap_share": state.iterate.equations.gap_share,
        "gap_deviation": state.stage.gap,
        "integration_error": error,
    }


def close_gaps(optimum: Optimum) -> Array | None:
    """The outputs (m, n, n_outputs) of a fit's run without gaps between linked segments.

    None where the gaps do not close in a few steps, as those of a model that runs away from its log.
    """
    segments, linear = optimum.equations.segments, optimum.equations.linearisation
    slopes = np.where(segments.linked[:, None, None], linear.end_sensitivities[:, :, : optimum.nodes.shape[1]], 0.0)
    nodes, y, x_end = optimum.nodes, optimum.run.y, optimum.run.x_end
    for _ in range(MAX_NODE_STEPS):
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
