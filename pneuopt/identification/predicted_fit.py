"""`fit_from_predictions`: the fit that begins with the parameters by which a filter predicts a part of the logs best.

It is for logs whose first start has failed. Each of the model's guesses is tried with several values of what another
parameter bounds (static friction, which filtered speeds show too low); the best of them descend side by side
(`shooting.prediction_errors`), and the search with tight gaps begins with the states that a filter finds by what they
lead to. Six of nine logs that stick and slip, and that no other start explained in 60 CPU s, are explained so.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from pneuopt.dynamics.compiled.rollout import check_during_runs
from pneuopt.dynamics.hooks import Start
from pneuopt.identification.excerpts import filter_states, liveliest_part
from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.filters import PredictionErrors
from pneuopt.shooting.least_squares import Fit, solve_least_squares
from pneuopt.shooting.segments import Segments, segment, start_nodes

# segments of all logs that the filter follows: fewer may lack motion that a parameter needs, more cost time
PART_SEGMENTS = 300
# a parameter over the one that bounds it [1]: finer and wider ones cost time, others miss the valley
RATIOS = np.geomspace(1.1, 2.4, 8)
BEST = 4  # sets that descend: fewer end in a side minimum, more cost time
# deviation that the states gather along a segment, in nominal sizes, the steps at most, and the sets that go on
LEVELS = ((1e-3, 4, 2), (3e-4, 6, 1), (1e-4, 6, 1), (3e-5, 6, 1))
# cost a sample at which no set goes on [1]: lower gives up what would lead to the noise (.9), higher follows a wrong
# model; and the least deviation gathered at which it counts, for with less of it a lost slip costs a right set as much
MAX_COST, DECIDING = 1.3, 3e-4


def fit_from_predictions(problem: EstimationProblem, max_misfit: float) -> Fit | None:
    """The fit with tight gaps from where the prediction errors of a filter lead.

    Parameters
    ----------
    problem : EstimationProblem
    max_misfit : float
        As of `LeastSquares`.

    Returns
    -------
    Fit or None
        Whatever its status. None of a model without guesses, where logs have holes, windows or weights, and where no
        parameters predict the part to its noise.

    Raises
    ------
    KeyboardInterrupt
        If it comes, or the CPU budget ends, before the search.
    """
    bounded, guesses = _bounded_parameters(problem), [c for c in problem.candidates() if c.trial_parameters]
    if not bounded or len(guesses) < 2 or not _is_plain(problem):
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


def _is_plain(problem: EstimationProblem) -> bool:
    """Whether a filter can follow the logs from segment to segment."""
    is_whole = problem.has_gaps and not np.isfinite(problem.window) and not any(e.holes for e in problem.experiments)
    return is_whole and bool(problem.system.states) and not problem.weights


def _bounded_parameters(problem: EstimationProblem) -> dict[str, str]:
    """The free parameters that another one bounds, and that one."""
    free, order = set(problem.parameters.free_names) - set(problem.held), problem.system.plant.excitation.at_least
    return {n: m for n, m in order.items() if n in free and m in free}


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
