"""`fit_from_starts`: the best fit from the model's own starts, with the parameters held that logs cannot identify.

The first start is tried alone, then the parameters to which the prediction errors of a filter lead, then the others by
their cost after a few iterations with their guesses held. A parameter that the data do not determine is held at its
given value: that needs no weight for a prior beside that of the data, and the prior's spread is counted in the
covariance of the others (`Fit.prior_covariance`).

`fit_logs`: the short ways of long logs first; most need no more (`problems/identify/random_plants.py --kind other`).

`fit_in_windows`: a plant that integrates adds up whatever its model misses: the position runs away from the log, and
the gaps of a fit that links its segments take the misfit in their place. In windows with a start state each the model
runs freely for a limited time only. Short windows show little of slow terms, long ones gather what the model misses;
the length is that with the narrowest intervals among those that agree with all shorter ones (the rule of Lepski, Theory
of Probability and its Applications 35(3), 1991; problems/identify/windows.py holds its estimates to the truth).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from pneuopt.dynamics.compiled.rollout import check_during_runs
from pneuopt.dynamics.hooks import Start
from pneuopt.identification.identifiability import prior_dominated, rejects_fixed_values, verdict_from_sensitivities
from pneuopt.identification.losses import Loss, fit_robustly, white_chi_square
from pneuopt.identification.misfit import Misfit, degrees_of_freedom, diagnose_misfit, t_quantile
from pneuopt.identification.problem import EstimationProblem, outputs_in_log
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import ChosenWindow, IdentificationResult, Mark
from pneuopt.identification.tolerances import (
    ACCEPTED_CHI_SQUARE_RATIO,
    BEST,
    CLEAR_DEVIATIONS,
    DECIDING,
    EXCERPT_SEGMENTS,
    GAP_FACTOR,
    GUESS_STAGES,
    HOPELESS_MISFIT,
    LEVELS,
    MAX_CLOSED_MISFIT,
    MAX_CLOSED_SHARE,
    MAX_COST,
    MAX_SEGMENTS,
    MAX_STAGES,
    MIN_DOUBTED,
    MIN_EXCESS,
    MIN_KNOWN_SHARE,
    MIN_LENGTH_RATIO,
    MIN_WINDOW_SAMPLES,
    MIN_WINDOWS,
    PART_SEGMENTS,
    REFIT_STAGES,
    SAME_COST_RATIO,
    SAME_MISFIT_RATIO,
    SHORT_ITERATIONS,
    WINDOW_FACTOR,
    WINDOW_ITERATIONS,
)
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.filters import PredictionErrors, filter_nodes
from pneuopt.shooting.least_squares import BudgetSpentError, Fit, SearchEnd, close_gaps, solve_least_squares
from pneuopt.shooting.segments import Segments, choose_integration, segment, start_nodes
from pneuopt.shooting.tolerances import GATHERED_DEVIATION, MAX_CHI_SQUARE_RATIO, MAX_GAP_SHARE

Candidate = tuple[EstimationProblem, Fit, str]


def fit_from_starts(
    problem: EstimationProblem,
    loss: Loss | None = None,
    *,
    estimate_noise: bool = False,
    gives_up: Callable[[EstimationProblem, Fit], bool] = lambda *_: False,
) -> Candidate:
    """Fit from the first start that ends at the noise's level; else the best of all until two agree on the least cost.

    `gives_up` is called with the best fit so far: whether another start cannot help.
    """
    fits: list[Candidate] = []
    interrupted, tightest = False, problem.method.stages[-1].gap
    is_plain = loss is None and not estimate_noise
    try:
        for start in starts_by_cost(problem, fits):
            may_wait = not fits and loss is None and problem.has_gaps and start.trial_parameters
            limit = HOPELESS_MISFIT if may_wait else math.inf
            # a search that joins the best one only confirms it: without noise of the states where that did not settle
            is_joinable = is_plain and bool(fits) and is_optimum(fits[0][1]) and not fits[0][0].fixed
            known = fits[0][1].stage_costs if is_joinable else ()
            settles = is_joinable and problem.method.allows_state_noise and fits[0][1].status.converged
            tried = replace(problem, method=replace(problem.method, allows_state_noise=settles)) if known else problem
            held, fit = fit_fixing_unidentifiable(tried, start, limit, known)
            held = replace(held, method=problem.method)
            if fit.end is SearchEnd.DUPLICATE:
                break
            held, fit = fit_robustly(held, fit, loss, estimate_noise=estimate_noise)
            if explains_to_noise(held, fit) and not held.fixed and is_in_order(held, fit):
                return held, fit, start.label
            if fit.status.code is not Code.INTERRUPTED and is_at_noise(held, fit):
                held, fit = fit_without_unsettled(held, fit, start.label)
            interrupted = fit.status.code is Code.INTERRUPTED
            fits.append((held, fit, start.label))
            fits.sort(key=lambda each: rank(each[1], tightest))
            is_end = interrupted or _are_enough(fits)
            if is_end or ((is_optimum(fits[0][1]) or len(fits) == MIN_DOUBTED) and gives_up(*fits[0][:2])):
                break
            if len(fits) == 1 and is_plain and (predicted := _fit_predicted(problem, fit)):
                return problem, predicted, f"{start.label}, by prediction errors"
    except KeyboardInterrupt:
        if not fits:
            raise
        interrupted = True
    held, fit, label = fits[0]
    if not interrupted:
        held, fit = fit_without_unsettled(held, fit, label)
        interrupted = fit.status.code is Code.INTERRUPTED
    return held, replace(fit, status=_status(problem, fit, len(fits), interrupted=interrupted)), label


def _fit_predicted(problem: EstimationProblem, first: Fit) -> Fit | None:
    """The fit by prediction errors where the first start was left; None where that does not explain the logs."""
    found = fit_from_predictions(problem, HOPELESS_MISFIT) if first.end is SearchEnd.ABANDONED else None
    if found is not None and found.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    if found is None or not explains_to_noise(problem, found) or not is_in_order(problem, found):
        return None
    return found.with_effort_of(first)


def _status(problem: EstimationProblem, fit: Fit, starts: int, *, interrupted: bool) -> Status:
    """The status of the best fit of several starts."""
    status = fit.status
    if interrupted and (starts > 1 or status.code is not Code.INTERRUPTED):
        status = Status(Code.INTERRUPTED, (f"the best of {starts} starts so far", "run again for an answer"))
    elif not status.converged and starts > 1:
        in_the_best = (f"in the best, {status.verdict}", *status.sentences[1:])
        status = Status(status.code, (f"none of {starts} starts converged", *in_the_best))
    if len(problem.experiments) > 1:
        status = status.with_remedies("compare_logs shows whether the logs are of one drive")
    return status


def starts_by_cost(problem: EstimationProblem, fits: Sequence[Candidate] = ()) -> Iterator[Start]:
    """The model's first start, then the others, settled to what each holds, the least cost first.

    `fits` are those from the starts up to then, the best first. An optimum needs one more start, as it is; one whose
    gaps stand for noise of the states takes all so, for settling with wide gaps says little there.
    """
    candidates, gaps = problem.candidates, [stage.gap for stage in problem.method.stages]
    yield candidates[0]
    while len(candidates) > 1 and fits and is_optimum(fits[0][1]) and (len(fits) == 1 or fits[0][1].jumps is not None):
        candidates = candidates[1:]
        yield candidates[0]
    guessed = [c for c in candidates if c.trial_parameters]
    # after how many stages the first start was left, and what it cost after as many as the others get
    left, known = 0, math.nan
    if fits and fits[0][1].end is SearchEnd.ABANDONED:
        left, last = 1 + gaps.index(fits[0][1].stats["gap_deviation"]), gaps[:GUESS_STAGES][-1]
        known = next((cost for gap, cost in fits[0][1].stage_costs if gap == last), math.nan)
    # where no segment continues another, stages differ in nothing, and each would go on where the last one gave up
    stages = min(GUESS_STAGES, left or GUESS_STAGES) if problem.has_gaps else 1
    settled, others = list[tuple[tuple[float, float], Start]](), list(guessed) if len(guessed) > 1 else []
    while others:
        cost, start, explains = _settle_start(problem, others.pop(0), stages)
        if explains:
            yield start
            continue
        settled.append((cost, start))
        if cost[1] <= SAME_MISFIT_RATIO * known and cost[0] == gaps[GUESS_STAGES - 1]:
            break
    yield from [start for _, start in sorted(settled, key=lambda each: each[0])]
    yield from others
    yield from [c for c in candidates[1:] if len(guessed) < 2 or not c.trial_parameters]
    yield from candidates[:1] if left and len(guessed) < 2 else []


def _settle_start(
    problem: EstimationProblem, candidate: Start, stages: int, width: float = 1e-9
) -> tuple[tuple[float, float], Start, bool]:
    """The cost of a start after some stages with its guesses held, the start from there, and whether that is the noise.

    Wider gaps cost less, which says nothing: they rank behind. Bounds of some `width` [1] hold a guess, for equal ones
    would compile other equations; with noise of the states a wrong guess would explain any log.
    """
    transcription = problem.transcription(candidate)
    guesses = {n: candidate.parameters[n] for n in candidate.trial_parameters}
    bounds = {n: (v - width * abs(v), v + width * abs(v)) for n, v in guesses.items()}
    held = replace(transcription, parameters=transcription.parameters.with_bounds(bounds))
    method = replace(problem.method, stages=problem.method.stages[:stages], allows_state_noise=False)
    fit = solve_least_squares(held, method)
    if fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    start = problem.start_from(fit, f"{candidate.label}, settled")
    gap, cost = fit.stats["gap_deviation"], fit.stats["cost"]
    explains = stages == GUESS_STAGES and 2 * cost <= ACCEPTED_CHI_SQUARE_RATIO * fit.count
    return (gap, cost), replace(start, parameters={**start.parameters, **guesses}), explains


def fit_fixing_unidentifiable(
    problem: EstimationProblem,
    start: Start,
    max_misfit: float = math.inf,
    known_costs: tuple[tuple[float, float], ...] = (),
) -> tuple[EstimationProblem, Fit]:
    """Fit from one start; while the data do not determine a parameter, hold that one and fit again.

    It is held at its given value, or, if the logs reject that, where the search had left it.
    """
    method = replace(problem.method, max_misfit=max_misfit, known_costs=known_costs)
    first = solve_least_squares(problem.transcription(start), method)
    if not first.unidentifiable or first.status.code is Code.INTERRUPTED:
        return problem, first
    for is_given in (True, False) if not first.status.converged else (True,):
        held, fit = _hold_unidentifiable(problem, start.label, first, is_given=is_given)
        is_settled = fit.status.converged and not fit.unidentifiable
        is_taken = is_settled and not rejects_fixed_values(fit, first, len(held.fixed))
        if fit.status.code is Code.INTERRUPTED or is_taken:
            return held, fit
    return problem, first


def _hold_unidentifiable(
    problem: EstimationProblem, label: str, first: Fit, *, is_given: bool
) -> tuple[EstimationProblem, Fit]:
    """Hold one undetermined parameter after the other, at its given value or where the first fit has left it."""
    held, fit, given = problem, first, problem.unknowns()
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    source = given if is_given else first.parameters
    while fit.unidentifiable and len(held.fixed) + len(fit.unidentifiable) < len(given.free_names):
        held = replace(held, fixed={**held.fixed, **{n: source.value(n) for n in fit.unidentifiable}})
        before, fit = fit, solve_least_squares(held.transcription(held.start_from(fit, label)), warm)
        fit = fit.with_effort_of(before)
        if fit.status.code in (Code.INTERRUPTED, Code.DIVERGED):
            break
    return held, fit


def fit_without_unsettled(problem: EstimationProblem, fit: Fit, label: str) -> tuple[EstimationProblem, Fit]:
    """The fit of the other parameters, where a search did not settle in one: that one is held where it came to."""
    held, part = problem, fit
    last = problem.method.stages[-REFIT_STAGES:]
    warm = replace(
        problem.method, stages=last, allows_state_noise=problem.method.allows_state_noise and fit.jumps is not None
    )
    while not part.status.converged:
        names = part.unidentifiable or part.unsettled
        if not names or len(held.fixed) + len(names) >= len(part.parameters.free_names):
            return problem, fit
        held = replace(held, fixed={**held.fixed, **{n: part.parameters.value(n) for n in names}})
        before, part = part, solve_least_squares(held.transcription(held.start_from(part, label)), warm)
        part = part.with_effort_of(before)
        if part.status.code is Code.INTERRUPTED:
            return problem, replace(fit, status=part.status)
        if part.status.code is Code.DIVERGED:
            return problem, fit
    if part.covariance is None or part.prior_covariance is None:
        return held, part
    # where those held may be ten times as large, the logs may tell nothing of any other
    values = np.array([part.parameters.value(n) for n in part.parameters.free_names])
    covariance = part.covariance + part.prior_covariance
    free = [n not in held.fixed for n in part.parameters.free_names]
    leans = prior_dominated(covariance, part.prior_covariance, values, held.fixed.values())
    return (problem, fit) if leans[free].all() else (held, part)


def explains_to_noise(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether a fit explains the logs to their noise, so that no other start can do better.

    Where a log declares too little noise, the white part of the residuals counts in its place.
    """
    return fit.status.converged and is_at_noise(problem, fit)


def is_at_noise(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether the residuals of a fit, converged or not, are those of the noise."""
    return fit.jumps is None and (
        fit.chi_square <= ACCEPTED_CHI_SQUARE_RATIO * fit.count
        or fit.chi_square <= ACCEPTED_CHI_SQUARE_RATIO * white_chi_square(problem, fit)
    )


def _are_enough(fits: Sequence[Candidate]) -> bool:
    """Whether two starts agree, or the better of them explains the logs to their noise with what it holds."""
    if len(fits) < 2:
        return False
    (held, best, _), (_, second, _) = fits[:2]
    # with noise of the states every estimate may be biased, and another optimum of it would not change that
    is_wrong = best.jumps is not None and best.status.converged and is_optimum(second)
    return is_wrong or are_alike(best, second) or explains_to_noise(held, best)


def is_optimum(fit: Fit) -> bool:
    """Whether a search ended at an optimum, be it of a model so wrong that the gaps absorb its misfit."""
    is_settled = not (fit.unsettled or fit.unidentifiable)
    is_missed = fit.status.code is Code.NOT_CONVERGED and is_settled and fit.stats["gap_share"] > MAX_GAP_SHARE
    is_missed &= fit.end is not SearchEnd.ABANDONED
    return fit.status.converged or is_missed


def is_in_order(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether each free parameter that another one bounds is clearly above it, as static friction above Coulomb's.

    Else a search may have lost it: one ended so at the noise, its Stribeck velocity 13 times too high.
    """
    order, found = problem.system.plant.identification_hints.at_least, fit.parameters
    bounded = [n for n in found.free_names if n not in problem.fixed and order.get(n) in found]
    return all(found.value(n) >= (1 + MIN_EXCESS) * found.value(order[n]) for n in bounded)


def rank(fit: Fit, tightest: float) -> tuple[int, float]:
    """The order of fits: by cost; after those that explain the log come those with state noise or wide gaps."""
    cost = fit.stats["cost"]
    is_cut = fit.end is SearchEnd.ABANDONED or fit.status.code is Code.INTERRUPTED
    if is_cut and fit.stats["gap_deviation"] > tightest:
        return 3, cost
    if fit.jumps is not None:
        return 1, cost
    return 0 if 2 * cost <= MAX_CHI_SQUARE_RATIO * fit.count else 2, cost


def are_alike(best: Fit, second: Fit) -> bool:
    """Whether both ended at an optimum, at the same cost."""
    same = is_optimum(best) and is_optimum(second) and (best.jumps is None) == (second.jumps is None)
    return same and second.stats["cost"] <= SAME_COST_RATIO * best.stats["cost"]


def fit_logs(problem: EstimationProblem, search: Callable[[EstimationProblem], Candidate]) -> Candidate:
    """Fit long logs by the short ways where these lead to the noise, and else by a search from all starts."""
    tried = list[Candidate]()
    try:
        found = _fit_long_logs(problem, tried) or search(problem)
    except KeyboardInterrupt:
        if not tried:
            raise
        held, fit, label = tried[0]
        found = held, replace(fit, status=SearchEnd.INTERRUPTED.status), label
    if found[1].status.code is not Code.INTERRUPTED:
        return found
    held, fit, label = min([found, *tried], key=lambda each: rank(each[1], problem.method.stages[-1].gap))
    return held, replace(fit, status=found[1].status), label


def _fit_long_logs(problem: EstimationProblem, tried: list[Candidate]) -> Candidate | None:
    """A fit that explains long logs to their noise, or was interrupted; None if they need a longer search.

    What was tried is appended to `tried`; a doubtful fit needs another one before it.
    """
    for found in _tries(problem):
        held, fit, label = found
        if tried and fit.status.code is Code.NOT_CONVERGED and is_at_noise(held, fit):
            held, fit = fit_without_unsettled(*found)
        is_answer = explains_to_noise(held, fit) and not fit.unidentifiable and (not held.fixed or bool(tried))
        pairs = (sorted((fit, other), key=lambda each: each.stats["cost"]) for _, other, _ in tried)
        is_sure = is_in_order(held, fit) or any(are_alike(better, worse) for better, worse in pairs)
        tried.append((held, fit, label))
        if (is_answer and is_sure) or fit.status.code is Code.INTERRUPTED:
            return held, fit, label
    return None


def _tries(problem: EstimationProblem) -> Iterator[Candidate]:
    """The attempts before a long search of long logs: short, from filtered states, from a part; none of short logs.

    The states of whole logs are filtered by a part's parameters: rough states would spoil what it has found.
    """
    parts = cut_excerpts(problem)
    if parts is None:
        return
    rough, stages = problem.candidates[0], problem.method.stages
    few = stages[0], replace(stages[-1], iterations=SHORT_ITERATIONS)
    method = replace(problem.method, stages=few, max_misfit=HOPELESS_MISFIT, allows_state_noise=False)
    short = solve_least_squares(problem.transcription(rough), method)
    yield problem, short, rough.label
    is_near = short.jumps is None and 2 * short.stats["cost"] <= MAX_CHI_SQUARE_RATIO * short.count
    if is_near and not short.status.converged:
        last = replace(problem.method, stages=stages[-1:])
        longer = solve_least_squares(problem.transcription(problem.start_from(short)), last)
        yield problem, longer.with_effort_of(short), rough.label
    elif not is_near and (found := _fit_filtered(problem, rough, is_far=short.end is SearchEnd.ABANDONED)):
        yield found
    held, fit, label = fit_from_starts(parts)
    if fit.status.code is Code.INTERRUPTED:
        yield problem, replace(short, status=fit.status), rough.label
    if not explains_to_noise(held, fit):
        return
    warm = replace(problem, method=replace(problem.method, stages=stages[-1:]))
    start = filter_states(warm, replace(rough, parameters=parts.start_from(fit).parameters), stages[-1].gap)
    whole, fit = fit_fixing_unidentifiable(warm, start, HOPELESS_MISFIT)
    yield replace(whole, method=problem.method), fit, f"{label}, of a part"


def _fit_filtered(problem: EstimationProblem, rough: Start, *, is_far: bool) -> Candidate | None:
    """The fit with tight gaps from states filtered by the parameters of wide ones, whose nodes would close slowly.

    Where the rough states are far off, wide gaps begin with filtered ones, too. None where they leave more than noise.
    """
    stages = problem.method.stages
    first_and_third = stages[:GUESS_STAGES:2]
    wide = replace(problem.method, stages=first_and_third, allows_state_noise=False)
    begin = filter_states(problem, rough) if is_far else rough
    settled = solve_least_squares(problem.transcription(begin), wide)
    if settled.status.code is Code.INTERRUPTED:
        return problem, settled, rough.label
    if not 2 * settled.stats["cost"] <= MAX_CHI_SQUARE_RATIO * settled.count:
        return None
    tight = replace(problem, method=replace(problem.method, stages=stages[-1:], allows_state_noise=False))
    start = filter_states(tight, replace(rough, parameters=problem.start_from(settled).parameters))
    held, fit = fit_fixing_unidentifiable(tight, start, HOPELESS_MISFIT)
    return replace(held, method=problem.method), fit.with_effort_of(settled), rough.label


def cut_excerpts(problem: EstimationProblem) -> EstimationProblem | None:
    """The problem with its liveliest part in place of each long log."""
    if math.isfinite(problem.window) or not problem.has_gaps or len(problem.candidates) < 2:
        return None
    if not problem.system.states or any(e.holes for e in problem.experiments) or problem.weights:
        return None
    parts = []
    for e in problem.experiments:
        run, step, part = e.trajectory, float(np.median(np.diff(e.trajectory.t))), e
        count = math.ceil(EXCERPT_SEGMENTS * max(problem.method.segment_time, step) / step)
        if len(run) >= MIN_LENGTH_RATIO * count:
            columns = [run.fill_gaps(name) for name in outputs_in_log(problem.system, e)]
            begin = liveliest_part(np.column_stack(columns), count)
            part = replace(e, trajectory=run.rows(begin, begin + count), source=None)
        parts.append(part)
    whole, kept = (sum(len(e.trajectory) for e in each) for each in (problem.experiments, parts))
    is_huge = sum(e.trajectory.duration for e in problem.experiments) > MAX_SEGMENTS * problem.method.segment_time
    return replace(problem, experiments=tuple(parts)) if whole >= MIN_LENGTH_RATIO * kept and not is_huge else None


def filter_states(problem: EstimationProblem, start: Start, gathered: float = GATHERED_DEVIATION) -> Start:
    """The start with states along the logs that fit its parameters (`shooting.state_filter`)."""
    segments = segment(problem.transcription(start))
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    try:
        with check_during_runs(problem.method.budget.check):
            nodes = filter_nodes(segments, start_nodes(segments), q, gathered)
            segments, substeps = choose_integration(segments, nodes, q)
            run = segments.run(nodes, q, substeps, states=True)
    except BudgetSpentError:
        return start
    names = (e.name for e in problem.experiments)
    return replace(start, states=dict(zip(names, segments.trajectories(run), strict=True)))


def liveliest_part(columns: Array, count: int) -> int:
    """The first row of the part of so many rows with the largest product of the columns' variances.

    A product, for a part in which one output hardly moves shows no friction, however much the others do.
    """
    flat = columns.reshape(len(columns), -1, columns.shape[-1])
    known = np.isfinite(flat)
    # about the mean of all rows and over their spread, sums of squares lose no digits that count
    middle = np.where(known, flat, 0.0).sum(axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)), 1)
    centred = np.where(known, flat - middle, 0.0)
    scaled = centred / np.maximum(np.abs(centred).max(axis=(0, 1)), np.finfo(float).tiny)
    first = np.arange(0, max(1, len(columns) - count + 1), max(1, count // 10))
    last = np.minimum(first + count, len(columns))
    sums = [np.cumsum(np.insert(part.sum(axis=1), 0, 0.0, axis=0), axis=0) for part in (known, scaled, scaled**2)]
    counts, totals, squares = (each[last] - each[first] for each in sums)
    counts = np.maximum(counts, 1)
    variances = np.maximum(squares / counts - (totals / counts) ** 2, np.finfo(float).eps)
    return int(first[np.argmax(np.log(variances).sum(axis=1))])


# a parameter over the one that bounds it [1]: finer and wider ones cost time, others miss the valley
RATIOS = np.geomspace(1.1, 2.4, 8)


def fit_from_predictions(problem: EstimationProblem, max_misfit: float) -> Fit | None:
    """The fit with tight gaps from where the prediction errors of a filter lead; None where no guess predicts."""
    free = set(problem.parameters.free_names) - set(problem.fixed)
    order = problem.system.plant.identification_hints.at_least
    bounded = {n: m for n, m in order.items() if n in free and m in free}
    guesses = [c for c in problem.candidates if c.trial_parameters]
    # a filter follows whole logs from segment to segment
    is_whole = problem.has_gaps and not np.isfinite(problem.window) and not any(e.holes for e in problem.experiments)
    is_plain = is_whole and bool(problem.system.states) and not problem.weights
    if not bounded or len(guesses) < 2 or not is_plain:
        return None
    segments = segment(problem.transcription(guesses[0]))
    scaling = ParameterScaling(segments.transcription)
    with check_during_runs(problem.method.budget.check):
        errors = PredictionErrors(segments, start_nodes(segments), scaling, _liveliest(segments, problem))
        z = _best_sets(errors, list(_hypotheses(guesses, bounded)), problem)
        for gathered, steps, count in LEVELS:
            if problem.method.progress is not None:
                problem.method.progress(f"prediction errors, states may gather {gathered:g} of their nominal size")
            z, costs = errors.descend(z, gathered, steps)
            if gathered >= DECIDING and not costs.min() < MAX_COST * errors.count:
                return None
            z = z[np.argsort(costs)[:count]]
    values = scaling.values(z[0])
    named = dict(zip(segments.transcription.parameters, values.tolist(), strict=True))
    found = {n: named[n] for n in segments.transcription.parameters.free_names}
    last = problem.method.stages[-1:]
    tight = replace(problem, method=replace(problem.method, stages=last, allows_state_noise=False))
    start = replace(guesses[0], parameters={**guesses[0].parameters, **found})
    start = filter_states(tight, start, last[-1].gap)
    method = replace(tight.method, max_misfit=max_misfit)
    return solve_least_squares(tight.transcription(start), method)


def _hypotheses(guesses: Sequence[Start], bounded: dict[str, str]) -> Iterator[tuple[tuple[int, int], Start]]:
    """The guesses with each ratio, and the place of both."""
    order = sorted(guesses, key=lambda c: [c.parameters[n] for n in c.trial_parameters])
    for (i, guess), (j, ratio) in product(enumerate(order), enumerate(RATIOS.tolist())):
        raised = {n: ratio * guess.parameters[m] for n, m in bounded.items()}
        yield (i, j), replace(guess, parameters={**guess.parameters, **raised})


def _best_sets(
    errors: PredictionErrors, hypotheses: Sequence[tuple[tuple[int, int], Start]], problem: EstimationProblem
) -> Array:
    """The searched parameters of the best hypotheses, of which no two are neighbours. Shape (at most BEST, k)."""
    z = np.array([ParameterScaling(problem.transcription(start)).start for _, start in hypotheses])
    chosen = list[int]()
    for k in np.argsort(errors.evaluate(z, LEVELS[0][0]).costs).tolist():
        away = [np.abs(np.subtract(hypotheses[k][0], hypotheses[other][0])).max() for other in chosen]
        if len(chosen) < BEST and min(away, default=2) > 1:
            chosen.append(k)
    return z[chosen]


def _liveliest(segments: Segments, problem: EstimationProblem) -> Indices:
    """The liveliest consecutive segments of each log."""
    count, parts = max(1, PART_SEGMENTS // len(problem.experiments)), list[Indices]()
    for phase in range(len(problem.experiments)):
        own = np.flatnonzero(segments.phase == phase)
        begin = liveliest_part(segments.measured[own], count)
        parts.append(own[begin : begin + count])
    return np.concatenate(parts)


def tighten_gaps(problem: EstimationProblem, fit: Fit) -> Fit | None:
    """The fit with tighter gaps, where a search has ended at an optimum whose gaps absorb the misfit.

    None where they lead to no optimum, or to residuals so large that the model does not follow the logs.
    """
    is_missed = fit.status.code is Code.NOT_CONVERGED and MAX_GAP_SHARE < fit.stats["gap_share"] < MAX_CLOSED_SHARE
    found, stage = fit, replace(problem.method.stages[-1], refine=1)  # steps are refined where it has converged
    for _ in range(MAX_STAGES if is_missed else 0):
        if not (is_optimum(found) and 2 * found.stats["cost"] <= MAX_CLOSED_MISFIT * found.count):
            break
        stage = replace(stage, gap=GAP_FACTOR * stage.gap)
        method = replace(problem.method, stages=(stage,), allows_state_noise=False)
        before, found = found, solve_least_squares(problem.transcription(problem.start_from(found)), method)
        found = found.with_effort_of(before)
        if found.status.converged:
            return found
    return None


def fit_from_profiles(problem: EstimationProblem, fit: Fit, profiles: Iterable[Profile]) -> Fit | None:
    """The fit that begins with the best values of the first profile whose interval does not hold the estimate.

    None where every estimate lies in its interval; the given fit, not converged, where no better one is found.
    """
    found = next((p for p in profiles if not p.low <= p.estimate <= p.high), None)
    if found is None:
        return None
    start, best = problem.start_from(fit), found.curve.sort_values("deviance").iloc[0]
    value = float(best["value"])
    values = {n: float(best[n]) for n in start.parameters if n != found.name} | {found.name: value}
    method = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    start = replace(start, parameters={**start.parameters, **values})
    better = solve_least_squares(problem.transcription(start), method).with_effort_of(fit)
    is_better = better.stats["cost"] < fit.stats["cost"]
    if better.status.code is Code.INTERRUPTED:
        return better if is_better else replace(fit, status=better.status)
    if is_better and better.status.converged:
        return better
    verdict = f"{found.name} fits better at {value:.4g} {found.unit}, from where the search finds no better optimum"
    return replace(fit, status=Status(Code.NOT_CONVERGED, (verdict, "try other start values, or fix a parameter")))


def enforce_ordering(problem: EstimationProblem, fit: Fit, label: str) -> tuple[EstimationProblem, Fit]:
    """Hold parameters that no plant has below another one at that one's value, where the logs do not show them."""
    found, bound = fit.parameters, dict(zip(fit.parameters.free_names, fit.at_bound, strict=True))
    order = problem.system.plant.identification_hints.at_least
    below = {n: m for n, m in order.items() if bound.get(n) or n in problem.fixed}
    given = problem.unknowns()
    known = {n: m for n, m in below.items() if m in found and found.value(n) < found.value(m) <= given[n].upper}
    values = {n: found.value(m) for n, m in known.items()}
    if not values or not fit.status.converged:
        return problem, fit
    start = problem.start_from(fit, label)
    start = replace(start, parameters={**start.parameters, **values})
    begun = given.with_values(start.parameters)
    unseen = {n: begun.value(n) for n in verdict_from_sensitivities(problem, start).unidentifiable}
    ordered = replace(problem, fixed={**problem.fixed, **unseen, **values})
    if len(ordered.fixed) >= len(found.free_names):
        return problem, fit
    held, other = fit_fixing_unidentifiable(ordered, start)
    settled = other.status.converged and not other.unidentifiable and (other.jumps is None or fit.jumps is not None)
    rejected = not settled or rejects_fixed_values(other, fit, len(held.fixed))
    return (problem, fit) if rejected else (held, other.with_effort_of(fit))


def mark_order(problem: EstimationProblem, result: IdentificationResult) -> IdentificationResult:
    """Mark estimates that the logs put below another one beyond chance, though no plant has them there."""
    estimates, status = result.estimates.copy(), result.status
    for low, high in problem.system.plant.identification_hints.at_least.items():
        if low not in estimates.index:
            continue
        names = [n for n in (low, high) if n in estimates.index]
        signs = np.array([1.0 if n == high else -1.0 for n in names])
        variance = float(signs @ result.covariance.loc[names, names].to_numpy() @ signs)
        below = result.parameters.value(high) - float(result.estimates["value"][low])
        if variance >= 0 and below > CLEAR_DEVIATIONS * math.sqrt(variance):
            estimates.loc[names, "mark"] = Mark.BIAS_POSSIBLE
            words = f"{low} is below {high}, which no drive has: model error, both may be biased"
            status = status.with_details(words)
    return replace(result, estimates=estimates, status=status)


Windowed = tuple[EstimationProblem, Fit, ChosenWindow]


def check_window(problem: EstimationProblem) -> None:
    """Refuse a window of fewer than two samples, longer than every log, or in a loop whose controller goes on."""
    if problem.window == math.inf:
        return
    logs = [e.trajectory for e in problem.experiments]
    step = max(float(np.median(np.diff(log.t))) for log in logs)
    n, longest = round(problem.window / step), max(len(log) for log in logs)
    require(
        2 <= n <= longest,
        f"windows of {problem.window:g} s hold {n} samples of {problem.experiments[0].name}, which has {len(logs[0])}, "
        f"one every {step:g} s; choose between {2 * step:g} and {longest * step:g} s",
    )
    message = "a sampled controller goes on from window to window; leave the window out"
    require(problem.system.motion().sample_time is None, message, InputError)


def fit_in_windows(problem: EstimationProblem, fit: Fit) -> Windowed | None:
    """The fit in windows of the length with the narrowest intervals; None unless whole logs failed by their gaps."""
    absorbed = fit.stats["gap_share"] > MAX_GAP_SHARE and math.isfinite(fit.stats["cost"])
    can_cut = not problem.is_whole and bool(problem.system.states) and problem.system.motion().sample_time is None
    if not (fit.status.code is Code.NOT_CONVERGED and absorbed and can_cut):
        return None
    lengths = [problem.window] if math.isfinite(problem.window) else _lengths(problem)
    trials, start, iterations = list[_WindowTrial](), problem.start_from(fit), 2 * WINDOW_ITERATIONS
    for length in reversed(lengths):
        trials.append(_try_length(problem, start, length, iterations))
        if trials[-1].fit.status.code is Code.INTERRUPTED:
            break
        start, iterations = trials[-1].problem.start_from(trials[-1].fit), WINDOW_ITERATIONS
    found = [trial for trial in trials if trial.is_answer]
    if not found:
        return None
    agreeing = [trial for trial in found if all(trial.agrees(other) for other in found if other.length < trial.length)]
    best = min(agreeing, key=lambda trial: trial.rank)
    window = ChosenWindow(best.length, lengths[0], lengths[-1], fit.stats["gap_share"])
    return best.problem, best.fit.with_effort_of(fit), window


def run_freely(problem: EstimationProblem, fit: Fit, window: float = math.inf) -> tuple[Trajectory, ...]:
    """Each log simulated from its fitted start to its end without gaps; only a hole in its inputs starts anew.

    And so does each window of a finite time, from the fitted state. Not finite where the model diverges.
    """
    if not problem.system.states:
        return fit.trajectories
    is_whole = math.isinf(window) and math.isinf(problem.window)
    if is_whole and fit.optimum is not None and (y := close_gaps(fit.optimum)) is not None:
        return fit.optimum.equations.segments.output_trajectories(y)
    whole = replace(problem, window=window, method=replace(problem.method, segment_time=window))
    segments = segment(whole.transcription(whole.start_from(fit)))
    nodes, q = start_nodes(segments), np.array([p.value for p in segments.transcription.parameters.values()])
    segments, substeps = choose_integration(segments, nodes, q, int(fit.stats["substeps"]))
    return segments.trajectories(segments.run(nodes, q, substeps, states=True))


class _WindowTrial(NamedTuple):
    """The fit in windows of one length."""

    length: float
    problem: EstimationProblem
    fit: Fit
    misfit: Misfit

    @property
    def rank(self) -> tuple[int, bool, float]:
        """Parameters without a variance, whether residuals are too large for intervals, and the mean log of these."""
        if self.misfit.covariance is None:
            return len(self.fit.parameters.free_names), True, math.inf
        half_widths = self.half_widths[np.isfinite(self.half_widths)]
        unknown = len(self.half_widths) - len(half_widths)
        return unknown, self.misfit.is_excessive, float(np.log(half_widths).sum())

    @property
    def half_widths(self) -> Array:
        """Half of each interval, infinite where a parameter has no variance, shape (k,)."""
        if self.misfit.covariance is None:
            return np.full(len(self.fit.parameters.free_names), np.inf)
        variances = np.diag(self.misfit.covariance)
        widths = t_quantile(self.misfit.dof) * np.sqrt(np.maximum(variances, 0.0))
        return np.where(variances > 0, widths, np.inf)

    @property
    def is_answer(self) -> bool:
        """Whether it is an optimum that tells most parameters better than their own size."""
        sizes = np.abs([self.fit.parameters.value(n) for n in self.fit.parameters.free_names])
        known = float(np.mean(self.half_widths < sizes)) if sizes.size else 1.0
        return self.fit.status.converged and known > MIN_KNOWN_SHARE

    def agrees(self, shorter: "_WindowTrial") -> bool:
        """Whether its estimates agree with those of shorter windows, in which the model's errors add up less."""
        names = [n for n in self.fit.parameters.free_names if n in shorter.fit.parameters.free_names]
        apart = np.abs([self.fit.parameters.value(n) - shorter.fit.parameters.value(n) for n in names])
        free, others = self.fit.parameters.free_names, shorter.fit.parameters.free_names
        own, other = self.half_widths, shorter.half_widths
        widths = [own[free.index(n)] + other[others.index(n)] for n in names]
        return bool(np.all(apart <= np.array(widths)))


def _lengths(problem: EstimationProblem) -> list[float]:
    """Lengths of windows to try, the shortest first; at least one [s]."""
    shortest, total = 0.0, 0.0
    for e in problem.experiments:
        known = np.isfinite(e.trajectory.matrix(outputs_in_log(problem.system, e))).any(axis=1)
        shortest = max(shortest, MIN_WINDOW_SAMPLES * e.trajectory.duration / max(1, int(known.sum())))
        total += e.trajectory.duration
    count = max(1, 1 + math.floor(math.log(max(1.0, total / MIN_WINDOWS / shortest), WINDOW_FACTOR)))
    return [shortest * WINDOW_FACTOR**k for k in range(count)]


def _try_length(problem: EstimationProblem, start: Start, length: float, iterations: int) -> _WindowTrial:
    """The fit in windows of one length, a segment each, with the diagnosis of its residuals."""
    # without gaps all stages are alike; steps are refined where the search has converged
    last = replace(problem.method.stages[-1], iterations=iterations, refine=1)
    cut = replace(problem, window=length, method=replace(problem.method, segment_time=length, stages=(last,)))
    held, found = fit_fixing_unidentifiable(cut, start)
    held = replace(held, method=replace(held.method, stages=problem.method.stages))
    freedom = degrees_of_freedom(held, found)
    return _WindowTrial(length, held, found, diagnose_misfit(held, found, found.chi_square / freedom, freedom))
