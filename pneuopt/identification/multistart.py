"""`fit_from_starts`: the best fit from the model's own starts, with the parameters held that the logs cannot identify.

The first start is tried alone. Where it is left, the parameters to which the prediction errors of a filter lead are
tried (`predicted_fit`). Where these fail, too, the guessed parameters of each other start (`trial_parameters`, as the
Stribeck velocity) are held for a few iterations, until the states and the other parameters have settled to them; the
first that explains the logs is tried at once, the others are then tried by the cost they reached.

A parameter that the data do not determine is held at its given value. A weak prior (a decade about that value) would
leave it there, too; holding it needs no weight for the prior beside that of the data, and the prior's spread is counted
in the covariance of the others (`Fit.prior_covariance`).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.fit_order import are_alike, is_in_order, is_optimum, rank
from pneuopt.identification.identifiability import rejects_held_values, rests_on_prior
from pneuopt.identification.losses import Loss, fit_robustly, white_chi_square
from pneuopt.identification.predicted_fit import fit_from_predictions
from pneuopt.identification.problem import REFIT_STAGES, EstimationProblem
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import Fit, LeastSquares, SearchEnd, solve_least_squares

GUESS_STAGES = 3  # stages of a search with guesses held: more force a wrong guess on the log, fewer rank starts wrongly
# squared residuals a sample after the first stage or before the last, in noise variances, beyond which the first start
# waits for the others: lower settles all starts of a model that misses the log a little, higher follows hopeless starts
# to their end
HOPELESS_MISFIT = 3.0
# relative width of the bounds that hold a guess; equal bounds would compile other equations than those of the search
GUESS_BOUND_WIDTH = 1e-9
# squared residuals a sample, in noise variances, up to which no other start is tried: below 1 every start would be
# tried, while a wrong basin of soft bristles has left 1.1
ACCEPTED_CHI_SQUARE_RATIO = 1.05
# cost of a settled start over that of the first one after as many stages [1] up to which the guess is not what is
# wrong: lower settles all starts of a wrong model, higher takes another basin for the same
SAME_MISFIT_RATIO = 1.02

MIN_DOUBTED = 2  # fits after which the problem is doubted: fewer doubt it for one bad start, more take time

Candidate = tuple[EstimationProblem, Fit, str]


def fit_from_starts(
    problem: EstimationProblem,
    loss: Loss | None = None,
    *,
    estimate_noise: bool = False,
    gives_up: Callable[[EstimationProblem, Fit], bool] = lambda *_: False,
) -> Candidate:
    """Fit from the first start that converges at the noise's level; else take the best of all that were tried.

    Parameters
    ----------
    problem : EstimationProblem
    loss : Loss, optional
    estimate_noise : bool
    gives_up : callable
        Called with the best fit so far, where it is an optimum or the second one: whether another start cannot help.

    Returns
    -------
    problem : EstimationProblem
        With the values held, the weights and the noise levels that the fit ended with.
    fit : Fit
        A wrong basin can converge, too, but leaves residuals above the noise; so more starts are tried until two of
        them agree on the least cost; so is one more where a parameter is not clearly above another that bounds
        it. Where a search explains the logs but for a parameter that does not settle, that one is held and one more
        start is tried.
    label : str
        The label of its start.

    Raises
    ------
    KeyboardInterrupt
        If it comes before the first fit; after that the best fit so far is returned, marked.
    """
    fits: list[Candidate] = []
    interrupted, tightest = False, problem.method.stages[-1].gap
    is_plain = loss is None and not estimate_noise
    try:
        confirms, left_after = lambda: _only_needs_confirmation(fits), lambda: _stages_before_left(problem, fits[0][1])
        for start in starts_by_cost(problem, confirms, left_after, lambda: _cost_after_guesses(problem, fits)):
            may_wait = not fits and loss is None and problem.has_gaps and start.trial_parameters
            limit = HOPELESS_MISFIT if may_wait else math.inf
            known = _joinable_costs(fits) if is_plain else ()
            tried = replace(problem, method=_method_after(problem, fits)) if known else problem
            held, fit = fit_holding_unidentifiable(tried, start, limit, known)
            held = replace(held, method=problem.method)
            if fit.end is SearchEnd.DUPLICATE:
                break
            held, fit = fit_robustly(held, fit, loss, estimate_noise=estimate_noise)
            if explains_to_noise(held, fit) and not held.held and is_in_order(held, fit):
                return held, fit, start.label
            if fit.status.code is not Code.INTERRUPTED and is_at_noise(held, fit):
                held, fit = fit_a_part(held, fit, start.label)
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
        held, fit = fit_a_part(held, fit, label)
        interrupted = fit.status.code is Code.INTERRUPTED
    return held, replace(fit, status=_status(problem, fit, len(fits), interrupted=interrupted)), label


def _fit_predicted(problem: EstimationProblem, first: Fit) -> Fit | None:
    """The fit by prediction errors where the first start was left; None where that does not explain the logs.

    Raises `KeyboardInterrupt` if it was interrupted.
    """
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


def starts_by_cost(
    problem: EstimationProblem,
    confirms: Callable[[], bool] = lambda: False,
    left_after: Callable[[], int] = lambda: 0,
    left_cost: Callable[[], float] = lambda: math.nan,
) -> Iterator[Start]:
    """The model's first start; if more are asked for, the others: settled to what each holds, the least cost first.

    Parameters
    ----------
    problem : EstimationProblem
    confirms : callable
        Called before each further start: whether the first led to an optimum that only needs confirmation. The next
        start is then taken as it is, for settling all would cost more; the others are settled where it is not called
        enough.
    left_after : callable
        Called before the others settle: the stages after which the first start was left, 0 if it was not. The others
        then get no more than those, either.
    left_cost : callable
        Called then, too: the cost of the first start after as many stages as the others get, NaN if it got fewer. Where
        a start costs the same with another guess held, the guess is not what is wrong, and no more of them settle.

    Yields
    ------
    Start
        One that explains the logs to their noise with its guesses held comes as soon as it has settled.

    Raises
    ------
    KeyboardInterrupt
        If a start was interrupted while it settled.
    """
    candidates = problem.candidates()
    yield candidates[0]
    while len(candidates) > 1 and confirms():
        candidates = candidates[1:]
        yield candidates[0]
    guessed = [c for c in candidates if c.trial_parameters]
    # where no segment continues another, stages differ in nothing, and each would go on where the last one gave up
    left = left_after()
    stages = min(GUESS_STAGES, left or GUESS_STAGES) if problem.has_gaps else 1
    settled, known = list[tuple[tuple[float, float], Start]](), left_cost() if left else math.nan
    others = list(guessed) if len(guessed) > 1 else []
    while others:
        cost, start, explains = _settle_start(problem, others.pop(0), stages)
        if explains:
            yield start
            continue
        settled.append((cost, start))
        if cost[1] <= SAME_MISFIT_RATIO * known and cost[0] == problem.method.stages[GUESS_STAGES - 1].gap:
            break
    yield from [start for _, start in sorted(settled, key=lambda each: each[0])]
    yield from others
    yield from [c for c in candidates[1:] if len(guessed) < 2 or not c.trial_parameters]
    yield from candidates[:1] if left and len(guessed) < 2 else []


def _stages_before_left(problem: EstimationProblem, fit: Fit) -> int:
    """The stages after which a search was left for other starts; 0 if it was not."""
    gaps = [stage.gap for stage in problem.method.stages]
    return 1 + gaps.index(fit.stats["gap_deviation"]) if fit.end is SearchEnd.ABANDONED else 0


def _cost_after_guesses(problem: EstimationProblem, fits: Sequence[Candidate]) -> float:
    """The cost of the first start after the stages in which the others settle; NaN where it was left before."""
    gap = problem.method.stages[min(GUESS_STAGES, len(problem.method.stages)) - 1].gap
    return next((cost for stage, cost in fits[0][1].stage_costs if stage == gap), math.nan)


def _settle_start(problem: EstimationProblem, candidate: Start, stages: int) -> tuple[tuple[float, float], Start, bool]:
    """What a start reaches in some stages with its guesses held, the start from there, and whether that is the noise.

    A search that ends with wider gaps has a lower cost, which says nothing; it ranks behind those with tight ones. With
    noise of the states a wrong guess explains any log.
    """
    transcription = problem.transcription(candidate)
    guesses = {n: candidate.parameters[n] for n in candidate.trial_parameters}
    bounds = {n: (v - GUESS_BOUND_WIDTH * abs(v), v + GUESS_BOUND_WIDTH * abs(v)) for n, v in guesses.items()}
    held = replace(transcription, parameters=transcription.parameters.with_bounds(bounds))
    method = replace(problem.method, stages=problem.method.stages[:stages], allows_state_noise=False)
    fit = solve_least_squares(held, method)
    if fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    start = problem.start_from(fit, f"{candidate.label}, settled")
    gap, cost = fit.stats["gap_deviation"], fit.stats["cost"]
    explains = stages == GUESS_STAGES and 2 * cost <= ACCEPTED_CHI_SQUARE_RATIO * fit.count
    return (gap, cost), replace(start, parameters={**start.parameters, **guesses}), explains


def fit_holding_unidentifiable(
    problem: EstimationProblem,
    start: Start,
    max_misfit: float = math.inf,
    known_costs: tuple[tuple[float, float], ...] = (),
) -> tuple[EstimationProblem, Fit]:
    """Fit from one start; while the data do not determine a parameter, hold that one and fit again.

    Parameters
    ----------
    problem : EstimationProblem
    start : Start
    max_misfit, known_costs
        As of `LeastSquares`, for the first fit.

    Returns
    -------
    problem : EstimationProblem
        With what is held: at the given values, or, if the logs reject those, where the search had left them.
    fit : Fit
        The first one, where holding does not converge, or would leave no parameter to estimate.
    """
    method = replace(problem.method, max_misfit=max_misfit, known_costs=known_costs)
    first = solve_least_squares(problem.transcription(start), method)
    if not first.unidentifiable or first.status.code is Code.INTERRUPTED:
        return problem, first
    for is_given in (True, False) if not first.status.converged else (True,):
        held, fit = _hold_unidentifiable(problem, start.label, first, is_given=is_given)
        is_settled = fit.status.converged and not fit.unidentifiable
        if fit.status.code is Code.INTERRUPTED or (is_settled and not rejects_held_values(fit, first, len(held.held))):
            return held, fit
    return problem, first


def _hold_unidentifiable(
    problem: EstimationProblem, label: str, first: Fit, *, is_given: bool
) -> tuple[EstimationProblem, Fit]:
    """Hold one undetermined parameter after the other, at its given value or where the first fit has left it."""
    held, fit, given = problem, first, problem.unknowns()
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    source = given if is_given else first.parameters
    while fit.unidentifiable and len(held.held) + len(fit.unidentifiable) < len(given.free_names):
        held = replace(held, held={**held.held, **{n: source.value(n) for n in fit.unidentifiable}})
        before, fit = fit, solve_least_squares(held.transcription(held.start_from(fit, label)), warm)
        fit = fit.with_effort_of(before)
        if fit.status.code in (Code.INTERRUPTED, Code.DIVERGED):
            break
    return held, fit


def fit_a_part(problem: EstimationProblem, fit: Fit, label: str) -> tuple[EstimationProblem, Fit]:
    """Where a search did not settle in a parameter, the fit of the others with that one held where it had come to.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
        The best of all starts.
    label : str

    Returns
    -------
    problem : EstimationProblem
        With what is held.
    fit : Fit
        The given one, where nothing was unsettled, the rest does not converge either, or only the prior of what is held
        tells of it; marked, if that was interrupted.
    """
    held, part = problem, fit
    last = problem.method.stages[-REFIT_STAGES:]
    warm = replace(
        problem.method, stages=last, allows_state_noise=problem.method.allows_state_noise and fit.jumps is not None
    )
    while not part.status.converged:
        names = part.unidentifiable or part.unsettled
        if not names or len(held.held) + len(names) >= len(part.parameters.free_names):
            return problem, fit
        held = replace(held, held={**held.held, **{n: part.parameters.value(n) for n in names}})
        before, part = part, solve_least_squares(held.transcription(held.start_from(part, label)), warm)
        part = part.with_effort_of(before)
        if part.status.code is Code.INTERRUPTED:
            return problem, replace(fit, status=part.status)
        if part.status.code is Code.DIVERGED:
            return problem, fit
    return (problem, fit) if _rests_on_held(held, part) else (held, part)


def _rests_on_held(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether the logs tell nothing of any other parameter where those held may be ten times as large."""
    if fit.covariance is None or fit.prior_covariance is None:
        return False
    names = fit.parameters.free_names
    values, free = np.array([fit.parameters.value(n) for n in names]), [n not in problem.held for n in names]
    covariance = fit.covariance + fit.prior_covariance
    return bool(rests_on_prior(covariance, fit.prior_covariance, values, problem.held.values())[free].all())


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


def _only_needs_confirmation(fits: Sequence[Candidate]) -> bool:
    """Whether the next start is tried as it is, after fits of which the first is the best.

    So is one start where the best fit ended at an optimum; and each where its gaps stand for noise of the states, for
    settling with wide gaps says little there.
    """
    best = fits[0][1]
    return is_optimum(best) and (len(fits) == 1 or best.jumps is not None)


def _joinable_costs(fits: Sequence[Candidate]) -> tuple[tuple[float, float], ...]:
    """The costs at the end of the best search's stages, at which another one that joins it only confirms it."""
    return fits[0][1].stage_costs if fits and is_optimum(fits[0][1]) and not fits[0][0].held else ()


def _method_after(problem: EstimationProblem, fits: Sequence[Candidate]) -> LeastSquares:
    """The method of a start that is to confirm the best one: without noise of the states where that did not settle."""
    settles = problem.method.allows_state_noise and fits[0][1].status.converged
    return replace(problem.method, allows_state_noise=settles)


def _are_enough(fits: Sequence[Candidate]) -> bool:
    """Whether two starts agree, or the better of them explains the logs to their noise with what it holds."""
    if len(fits) < 2:
        return False
    (held, best, _), (_, second, _) = fits[:2]
    # with noise of the states every estimate may be biased, and another optimum of it would not change that
    is_wrong = best.jumps is not None and best.status.converged and is_optimum(second)
    return is_wrong or are_alike(best, second) or explains_to_noise(held, best)
