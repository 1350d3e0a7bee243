"""`fit_holding_unidentifiable`: a fit that holds unidentifiable parameters at their given values.

A weak prior (a decade about the given value) would leave such a parameter where it is; so it is held there, which needs
no prior's weight beside that of the data, and the prior's spread is counted in the others' covariance (`Fit.borrowed`).
"""

from dataclasses import replace

from scipy.stats import chi2

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import Fit, solve_least_squares

REFIT_STAGES = 3  # of the method's last, for a refit starts near its answer
REFUSAL_CONFIDENCE = 0.95  # of confidence at which the logs may refuse a given value


def fit_holding_unidentifiable(problem: EstimationProblem, candidate: Start) -> tuple[EstimationProblem, Fit]:
    """Fit from one candidate; where the data are silent about a parameter, again with that held, until all is told.

    Parameters
    ----------
    problem : Problem
    candidate : Start

    Returns
    -------
    problem : Problem
        With what is held: at the given values, or, if the logs refuse those, where the search had left them.
    fit : Fit
        The first one, where holding leads to no convergence, or would leave nothing to tell.
    """
    first = solve_least_squares(problem.transcription(candidate), problem.method)
    if not first.unidentifiable or first.solution.status.code is Code.INTERRUPTED:
        return problem, first
    for is_given in (True, False) if not first.solution.status.converged else (True,):
        posed, fit = _hold_unidentifiable(problem, candidate, first, is_given=is_given)
        if fit.solution.status.code is Code.INTERRUPTED or _is_as_good(fit, first, len(posed.held)):
            return posed, fit
    return problem, first


def _hold_unidentifiable(
    problem: EstimationProblem, candidate: Start, first: Fit, *, is_given: bool
) -> tuple[EstimationProblem, Fit]:
    """Hold one silent parameter after the other, at its given value or where the first fit has left it."""
    posed, fit, given = problem, first, problem.unknowns()
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    while fit.unidentifiable and len(posed.held) + len(fit.unidentifiable) < len(given.free_names):
        source = given if is_given else first.solution.parameters
        posed = replace(posed, held={**posed.held, **{n: source.value(n) for n in fit.unidentifiable}})
        fit = _add_effort(
            fit, solve_least_squares(posed.transcription(_start_from_fit(posed, fit, candidate.label)), warm)
        )
        if fit.solution.status.code in (Code.INTERRUPTED, Code.DIVERGED):
            break
    return posed, fit


def _start_from_fit(problem: EstimationProblem, fit: Fit, label: str) -> Start:
    """The start that goes on where a fit ended."""
    own, names = fit.solution.parameters, [s.name for s in problem.system.states]
    runs = zip(problem.experiments, fit.solution.trajectories, strict=True)
    return Start({e.name: t.select(names) for e, t in runs}, {n: own.value(n) for n in own.free_names}, label)


def _add_effort(before: Fit, fit: Fit) -> Fit:
    """The fit with the effort of both."""
    stats = {**fit.solution.stats}
    stats |= {n: stats[n] + before.solution.stats[n] for n in ("iterations", "seconds")}
    return replace(fit, solution=replace(fit.solution, stats=stats))


def _is_as_good(fit: Fit, first: Fit, held: int) -> bool:
    """Whether it converged, and explains the logs as well as the first, by the likelihood ratio.

    What only the gaps cost more does not count: finer integration steps show gaps that the first has not seen.
    """
    before, after = first.solution.stats["cost"], fit.solution.stats["cost"]
    rise = min(2 * (after - before), fit.chi_square - first.chi_square)
    noise = max(1.0, 2 * before / max(1, first.count))
    return (
        fit.solution.status.converged
        and not fit.unidentifiable
        and bool(rise <= noise * chi2.ppf(REFUSAL_CONFIDENCE, held))
    )
