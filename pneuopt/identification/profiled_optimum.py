"""`fit_from_profiles`: the fit to which a profile has shown the way, where the search has ended beside its optimum.

A profile fits all other parameters again at each value of one. Where it finds less cost than the fit, its interval lies
elsewhere: an estimate outside of its own interval is no optimum.
"""

from collections.abc import Iterable
from dataclasses import replace

from pneuopt.identification.problem import REFIT_STAGES, EstimationProblem
from pneuopt.identification.profiles import Profile
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import Fit, solve_least_squares


def fit_from_profiles(problem: EstimationProblem, fit: Fit, profiles: Iterable[Profile]) -> Fit | None:
    """The fit that begins with the best values of the first profile whose interval does not hold the estimate.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
    profiles : iterable of Profile
        Of that fit.

    Returns
    -------
    Fit or None
        None where every estimate lies in its interval. The given one, not converged, where no better one is found; of
        an interrupted search the better of both, marked.
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
