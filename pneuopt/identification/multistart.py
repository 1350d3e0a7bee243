"""Which starts an identification tries, and in which order: where the first fails, all are carried a few iterations.

What a start finder could only guess (`Start.tried`, as the Stribeck velocity) is held meanwhile, so that the states and
the other parameters settle to each guess; from there the right basin is near, and its cost tells it from the others.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.system import names
from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import Fit, solve_least_squares

GUESS_STAGES = 3  # of the search; tighter gaps would force a wrong guess on the log
GUESS_BOUND_WIDTH = (
    1e-9  # relative width of the bounds that hold a guess: the compiled equations stay those of the search
)


def multistart(problem: EstimationProblem, confirms: Callable[[], bool] = lambda: False) -> Iterator[Start]:
    """The model's first start; if more are asked for, the others: settled to what each holds, the least cost first.

    Parameters
    ----------
    problem : Problem
    confirms : callable
        Asked after the first start: whether it led to an optimum that only needs confirmation (of a model that misses
        the log, say). The others are then taken as they are; settling all would cost more.

    Yields
    ------
    Start

    Raises
    ------
    KeyboardInterrupt
        If a start was interrupted while it settled.
    """
    candidates = problem.candidates()
    yield candidates[0]
    guessed = [] if confirms() else [c for c in candidates if c.trial_parameters]
    settled = [_settle_start(problem, c) for c in guessed] if len(guessed) > 1 else []
    yield from [start for _, start in sorted(settled, key=lambda each: each[0])]
    yield from [c for c in candidates[1:] if not settled or not c.trial_parameters]


def _settle_start(problem: EstimationProblem, candidate: Start) -> tuple[float, Start]:
    """The cost that a start reaches with its guesses held, and where."""
    transcription = problem.transcription(candidate)
    guesses = {n: candidate.parameters[n] for n in candidate.trial_parameters}
    bounds = {n: (v - GUESS_BOUND_WIDTH * abs(v), v + GUESS_BOUND_WIDTH * abs(v)) for n, v in guesses.items()}
    held = replace(transcription, parameters=transcription.parameters.with_bounds(bounds))
    fit = solve_least_squares(held, replace(problem.method, stages=problem.method.stages[:GUESS_STAGES]))
    if fit.solution.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    return fit.solution.stats["cost"], _continue_start(problem, candidate, fit, guesses)


def _continue_start(problem: EstimationProblem, candidate: Start, fit: Fit, guesses: dict[str, float]) -> Start:
    """The start that goes on where a fit ended."""
    found, states = fit.solution.parameters, names(problem.system.states)
    runs = {e.name: t.select(states) for e, t in zip(problem.experiments, fit.solution.trajectories, strict=True)}
    return Start(runs, {**{n: found.value(n) for n in found.free_names}, **guesses}, f"{candidate.label}, settled")
