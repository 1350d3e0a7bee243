"""`suspect_widths`: whether the logs reject a width that only serves the integration, and which estimates it biases.

A smooth model turns friction round over a width; a drive that truly sticks does it over none. What the width hides goes
into the parameters, the Stribeck velocity first, before the residuals show it: at 1.006 times the noise it was 7 %
off, 5.6 of its deviations (`problems/identify/mismatch.py`). The width counts as one more parameter, and the gradient
of the cost by it at the estimates tells whether the logs reject the one in use (Rao's score test, Proc. Cambridge
Philos. Soc. 44, 1948): no fit with another width is needed, which the integration could not follow where it is narrow.
Where the drive has the width that the model has, as in a log that the model has made itself, the logs do not reject it.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pneuopt.identification.misfit import Misfit
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.widths import SIGNIFICANT_FALL
from pneuopt.quantities.arrays import Array
from pneuopt.shooting.least_squares import Fit, Optimum, solve_least_squares

# change of an estimate by a rejected width, in its deviations [1], up to which it is no bias: a 95 % interval that is
# shifted by half a deviation still holds the truth 92 times in 100; lower marks what does no harm
HARMLESS_SHIFT = 0.5


class RejectedWidth(NamedTuple):
    """A width that the logs reject.

    Attributes
    ----------
    name : str
    fall : float
        Of the squared residuals, in noise variances, to the width that the logs prefer.
    shifts : ndarray, shape (k,)
        What each free parameter of the fit changes by to there, to first order; at most to a width of zero.
    """

    name: str
    fall: float
    shifts: Array


def suspect_widths(misfit: Misfit, problem: EstimationProblem, fit: Fit, variance: float) -> Misfit:
    """The misfit, with the widths behind it; only looked for where there is one (`Misfit.is_suspect`).

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
    if not (misfit.is_suspect and fit.status.converged) or misfit.covariance is None:
        return misfit
    level = SIGNIFICANT_FALL * max(1.0, variance) * max(1.0, misfit.inflation)
    found = [width for width in score_widths(problem, fit) if width.fall > level]
    spread = np.sqrt(np.diag(misfit.covariance))
    biased = np.any([np.abs(width.shifts) > HARMLESS_SHIFT * spread for width in found], axis=0)
    return replace(misfit, rejected_widths=tuple(w.name for w in found), biased=biased) if np.any(biased) else misfit


def score_widths(problem: EstimationProblem, fit: Fit) -> Iterator[RejectedWidth]:
    """What each width of a model would change if it was estimated, too.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
        A converged one.

    Yields
    ------
    RejectedWidth
        None where the model has no width, or gaps stand for noise of the states, whose costs are of other weights.
    """
    names = fixed_widths(problem)
    if not names or fit.jumps is not None:
        return
    freed = replace(problem, parameters=problem.parameters.freed(*names))
    here = replace(problem.method, stages=(replace(problem.method.stages[-1], iterations=0),), progress=None)
    found = solve_least_squares(freed.transcription(freed.start_from(fit)), here)
    free = found.parameters.free_names
    scales = np.array([p.value if p.log else 1.0 for p in (found.parameters[n] for n in free)])
    own = [free.index(n) for n in fit.parameters.free_names]
    if found.optimum is None:
        return
    for name in names:
        moved = _step_with(found.optimum, free.index(name), [free.index(n) for n in names])
        if moved is not None:
            fall, step = moved
            change = (scales * step)[free.index(name)] / found.parameters.value(name)
            yield RejectedWidth(name, fall, (scales * step)[own] / max(1.0, -change))


def fixed_widths(problem: EstimationProblem) -> list[str]:
    """The widths of the model that are not free; a free one is an estimate itself."""
    names = dict.fromkeys(n for w in problem.system.plant.excitation.widths for n in (w.name, *w.follows))
    return [n for n in names if n in problem.parameters and not problem.parameters[n].free]


def _step_with(optimum: Optimum, width: int, widths: list[int]) -> tuple[float, Array] | None:
    """The fall of twice the cost by a width, and the Gauss-Newton step of all parameters with it; None without one."""
    arrow, keep = optimum.equations.arrow, optimum.keep.copy()
    reduced = arrow.eliminate(0.0)
    keep[widths] = False
    without = reduced and reduced.step(keep)
    keep[width] = optimum.keep[width]
    step = reduced and reduced.step(keep)
    if not step or not without:
        return None
    return arrow.descent_rate(step) - arrow.descent_rate(without), step.parameters
