"""`suspect_widths`: whether the logs refute a width that only serves the integration.

A smooth model turns friction round over a width; a drive that truly sticks does it over none. What the width hides goes
into the parameters, the Stribeck velocity first, before the residuals show it: at 1.08 times the noise it was 20 %
off, 6.3 of its deviations (`problems/identify/mismatch.py`). Where the model has its width from the drive, as in a log
that it has made itself, a narrower one explains the logs worse.
"""

from dataclasses import replace

from pneuopt.identification.misfit import Misfit
from pneuopt.identification.problem import REFIT_STAGES, EstimationProblem
from pneuopt.identification.widths import SIGNIFICANT_FALL, is_too_stiff
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares
from pneuopt.shooting.solution import Fit
from pneuopt.shooting.transcription import Transcription

# factors by which the widths are narrowed [1], the first that the integration can follow: a smaller one takes more
# steps, a larger one changes less. A log that took 110 steps a sample at .1 mm/s could not be searched with half of it
NARROWINGS = (0.5, 0.75)


def suspect_widths(misfit: Misfit, problem: EstimationProblem, fit: Fit, variance: float) -> Misfit:
    """The misfit, with whether a width may be behind it; only looked for where parts of the logs disagree.

    Parameters
    ----------
    misfit : Misfit
    problem : EstimationProblem
    fit : Fit
    variance : float
        Of the residuals, in noise variances.

    Returns
    -------
    Misfit
    """
    if not (misfit.is_suspect and fit.status.converged):
        return misfit
    return replace(misfit, is_too_wide=prefers_narrower_widths(problem, fit, variance))


def prefers_narrower_widths(problem: EstimationProblem, fit: Fit, variance: float) -> bool:
    """Tell whether narrower widths explain the logs better than chance lets them.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
        A converged one.
    variance : float
        Of its residuals, in noise variances.

    Returns
    -------
    bool
        False where the model has no width, each narrower one is too stiff, or gaps stand for noise of the states.
    """
    if fit.jumps is not None:  # costs with noise of the states are of other weights
        return False
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    narrowed = _narrowest(problem, fit, warm)
    if narrowed is None:
        return False
    found = solve_least_squares(narrowed, warm)
    if found.jumps is not None or found.status.code in (Code.DIVERGED, Code.INTERRUPTED):
        return False
    return 2 * (fit.stats["cost"] - found.stats["cost"]) > SIGNIFICANT_FALL * max(1.0, variance)


def _narrowest(problem: EstimationProblem, fit: Fit, method: LeastSquares) -> Transcription | None:
    """The fit's transcription with its widths narrowed as far as the integration can follow; None without any."""
    for factor in NARROWINGS:
        if narrow := _narrow(problem, factor):
            narrowed = replace(problem, parameters=problem.parameters.with_values(narrow))
            transcription = narrowed.transcription(narrowed.start_from(fit))
            if not is_too_stiff(transcription, method):
                return transcription
    return None


def _narrow(problem: EstimationProblem, factor: float) -> dict[str, float]:
    """The widths of the model, narrowed within their bounds; a free one is an estimate itself."""
    names = dict.fromkeys(n for w in problem.system.plant.excitation.widths for n in (w.name, *w.follows))
    own = {n: problem.parameters[n] for n in names if n in problem.parameters}
    return {n: factor * p.value for n, p in own.items() if not p.free and factor * p.value >= p.lower}
