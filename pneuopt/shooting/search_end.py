"""`end_search`: the `Fit` at the end of a search, and the statuses by which one ends early."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from pneuopt.dynamics.compiled.rollout import RolloutResult, check_during_runs
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.budget import BudgetSpentError
from pneuopt.shooting.last_stage import unsettled_covariance
from pneuopt.shooting.levenberg_marquardt import Iterate
from pneuopt.shooting.segments import IntegrationCorrection
from pneuopt.shooting.solution import Fit, Optimum

if TYPE_CHECKING:
    from pneuopt.shooting.least_squares import Stage
    from pneuopt.shooting.search import Search

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
