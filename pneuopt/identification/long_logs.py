"""`fit_logs`: the best fit of an estimation problem, the short ways of long logs first.

Most long logs need no more than a short search. Where gaps have to close slowly, a filter follows the parameters that
wide gaps have found, or those of a part of each log, from node to node, and the tight gaps begin with its states.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.excerpts import cut_excerpts, filter_states
from pneuopt.identification.fit_order import are_alike, is_in_order, rank
from pneuopt.identification.multistart import (
    GUESS_STAGES,
    HOPELESS_MISFIT,
    Candidate,
    explains_to_noise,
    fit_a_part,
    fit_from_starts,
    fit_holding_unidentifiable,
    is_at_noise,
)
from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import (
    MAX_CHI_SQUARE_RATIO,
    Fit,
    SearchEnd,
    solve_least_squares,
)

# iterations with tight gaps that long logs get before a part of them is tried: more cost time, fewer leave easy logs
SHORT_ITERATIONS = 10


def fit_logs(problem: EstimationProblem, search: Callable[[EstimationProblem], Candidate]) -> Candidate:
    """Fit long logs by the short ways where these lead to the noise, and else by a search from all starts.

    Parameters
    ----------
    problem : EstimationProblem
    search : callable
        `fit_from_starts`, which states what is returned.

    Raises
    ------
    KeyboardInterrupt
        If it comes before the first fit; after that the best fit so far is returned, marked.
    """
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

    What was tried is appended to `tried`. With a parameter held, or one that does not settle, one more start has been
    tried before; with one that is not clearly above another that bounds it, one that has led to the same.
    """
    for found in _tries_of_long_logs(problem):
        held, fit, label = _settle(*found) if tried else found
        is_answer = explains_to_noise(held, fit) and not fit.unidentifiable and (not held.held or bool(tried))
        is_sure = is_in_order(held, fit) or any(_is_confirmed(fit, other) for _, other, _ in tried)
        tried.append((held, fit, label))
        if (is_answer and is_sure) or fit.status.code is Code.INTERRUPTED:
            return held, fit, label
    return None


def _is_confirmed(fit: Fit, other: Fit) -> bool:
    """Whether both ended at one optimum, whichever of them is the better."""
    return are_alike(*sorted((fit, other), key=lambda each: each.stats["cost"]))


def _settle(problem: EstimationProblem, fit: Fit, label: str) -> Candidate:
    """The fit; where it is at the noise but for a parameter that did not settle, that of the others."""
    is_unsettled = fit.status.code is Code.NOT_CONVERGED and is_at_noise(problem, fit)
    return (*(fit_a_part(problem, fit, label) if is_unsettled else (problem, fit)), label)


def _tries_of_long_logs(problem: EstimationProblem) -> Iterator[Candidate]:
    """What is tried before a long search of long logs; nothing where they are short.

    First a short search: most logs need no more, and one that is cut near the noise goes on. Then the fit from states
    that are filtered, and that from the parameters of a part of each log. The states of the whole logs are filtered by
    these parameters, too: rough states would spoil what the parts have found.
    """
    parts = cut_excerpts(problem)
    if parts is None:
        return
    rough, stages = problem.candidates()[0], problem.method.stages
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
    whole, fit = fit_holding_unidentifiable(warm, start, HOPELESS_MISFIT)
    yield replace(whole, method=problem.method), fit, f"{label}, of a part"


def _fit_filtered(problem: EstimationProblem, rough: Start, *, is_far: bool) -> Candidate | None:
    """The fit with tight gaps from states that are filtered by the parameters of one with wide gaps.

    Nodes that wide gaps have let go apart close slowly; a filter follows the same parameters from node to node. Where
    the rough states are far off, wide gaps begin with filtered ones, too. None where they leave more than the noise.
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
    held, fit = fit_holding_unidentifiable(tight, start, HOPELESS_MISFIT)
    return replace(held, method=problem.method), fit.with_effort_of(settled), rough.label
