"""`fit_with_closed_gaps`: the optimum of a model that misses its logs, with gaps so tight that they carry no misfit.

A search ends with gaps that a right model closes. A wrong model leaves them open at its optimum, where they take a part
of the misfit, and the estimates depend on their weight. Gaps that are weighed more, from there on, close: what is left
is the least squares of the whole logs' simulation, of which the estimates are a property of model and logs alone.
"""

from dataclasses import replace

from pneuopt.identification.fit_order import is_optimum
from pneuopt.identification.problem import EstimationProblem
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import MAX_GAP_SHARE, Fit, solve_least_squares

# squared residuals over the noise's [1], and the gaps' share of them [1], above which a model does not follow whole
# logs, so that windows are tried: lower cuts logs that it follows but for a sensor's lag (60 and .17), higher iterates
# for a plant that runs away from its log (.9)
MAX_CLOSED_MISFIT, MAX_CLOSED_SHARE = 100.0, 0.3
# gap of each stage over that of the one before [1]: lower leaves an optimum too far off, higher takes more stages
GAP_FACTOR = 0.3
MAX_STAGES = 3  # more weigh gaps until nothing else counts but rounding, fewer leave a misfit in them


def fit_with_closed_gaps(problem: EstimationProblem, fit: Fit) -> Fit | None:
    """The fit with tighter gaps, where a search has ended at an optimum whose gaps absorb the misfit.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
        Of whole logs.

    Returns
    -------
    Fit or None
        A converged one; None where the fit has not failed by its gaps alone, tighter ones lead to no optimum, or to
        residuals so large that the model does not follow the logs.
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
