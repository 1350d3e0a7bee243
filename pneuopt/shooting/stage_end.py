"""`is_negligible_step`: whether a step of a search is not worth a try, which ends its stage; `creeps`: after one.

`describe_iteration` tells of one.
"""

import math
from typing import TYPE_CHECKING

from pneuopt.shooting.arrow import GaussNewtonStep, ReducedEquations
from pneuopt.shooting.convergence import MAX_CHI_SQUARE_RATIO, largest_parameter_step
from pneuopt.shooting.levenberg_marquardt import Iterate

if TYPE_CHECKING:
    from pneuopt.shooting.search import Search

# promised decrease over the cost [1] at which a stage ends: lower wastes iterations, higher ends it too early
STAGE_COST_TOLERANCE = 1e-3
# promised decrease at which the last stage ends, in noise variances: half of (0.1 % of a standard deviation)^2
FINAL_COST_TOLERANCE = 5e-7
# promised decrease in noise variances at which the last stage ends where no parameter moves: lower iterates for states
# that no parameter depends on, higher leaves costs that are compared short of their least
SETTLED_COST_DECREASE = 0.01
# step of a parameter over the tolerance of convergence [1] at which the last stage ends: lower settles states that no
# parameter depends on, higher leaves the parameters short of their optimum; and where finer steps follow, which move it
FINE_TOLERANCE, COARSE_TOLERANCE = 0.01, 0.5
# the same where the model misses the logs, in deviations by the residuals: lower follows Gauss-Newton steps that go to
# and fro (30 iterations of .02 deviations on a log with sensor lag), higher leaves costs that differ at one optimum
MISFIT_TOLERANCE = 0.2
# iterations of a stage after which that counts: fewer leave optima that soon would be exact, more take time
PATIENT_ITERATIONS = 8
# promised decrease over the cost [1] at which such a first stage ends: lower iterates for what the last one finds
# anyway, higher jumps from a start that is not near
JUMP_COST_TOLERANCE = 1e-2

# actual over promised decrease [1] below which a search with noise of the states creeps: higher leaves a fit that
# converges, lower follows a kink of the model for hundreds of steps (encoder steps: 50 of .13 each, of 35 promised)
CREEPING_SHARE = 0.3


def is_negligible_step(search: "Search", current: Iterate, reduced: ReducedEquations, step: GaussNewtonStep) -> bool:
    """Whether a step is negligible: in the last stage, 0.1 % of a deviation in any direction, or as good as that.

    The states of noisy gaps estimate that noise, and settle long after the parameters, whose step then counts; so it
    does where the model misses the logs and the search is slow: the deviations are then those of the residuals, near
    such an optimum Gauss-Newton steps go to and fro for long, and what is far below a deviation is far below the bias,
    too. Where no parameter is free, the states are what is asked for.

    Parameters
    ----------
    search : Search
    current : Iterate
    reduced : ReducedEquations
    step : GaussNewtonStep

    Returns
    -------
    bool
    """
    promised, equations = 0.5 * current.equations.arrow.descent_rate(step), current.equations
    is_last, misfit = search.stage.gap <= search.method.stages[-1].gap, max(1.0, 2 * current.cost / equations.count)
    if not (search.noisy_gaps or is_last):
        is_first = search.stage is search.method.stages[0] and search.is_noise(current.cost)
        return promised < (JUMP_COST_TOLERANCE if is_first else STAGE_COST_TOLERANCE) * current.cost
    if is_last and promised < FINAL_COST_TOLERANCE * misfit:
        return True
    is_slow = search.iterations - search.stage_began >= PATIENT_ITERATIONS
    is_wrong = is_last and is_slow and misfit > MAX_CHI_SQUARE_RATIO
    asks_parameters = bool(search.segments.transcription.parameters.free_names)
    is_settled = asks_parameters and (search.is_coarse or is_wrong or promised < SETTLED_COST_DECREASE * misfit)
    if not ((is_settled or search.noisy_gaps) and promised < STAGE_COST_TOLERANCE * current.cost):
        return False
    keep = search.scaling.movable(current.z, equations, reduced)
    largest = largest_parameter_step(equations, keep, reduced, step.parameters) / search.method.tolerance
    if is_wrong:
        return largest < MISFIT_TOLERANCE * math.sqrt(max(1.0, equations.chi_square / max(1, equations.count)))
    return largest < (COARSE_TOLERANCE if search.is_coarse else FINE_TOLERANCE)


def creeps(search: "Search", before: float, promised: float) -> bool:
    """Whether a step of a search with noise of the states has fallen far short of its promise, and changed little.

    Parameters
    ----------
    search : Search
        After the step.
    before : float
        Cost before it.
    promised : float
        Decrease of the cost that it has promised.

    Returns
    -------
    bool
    """
    return search.noisy_gaps and before - search.current.cost < min(
        CREEPING_SHARE * promised, STAGE_COST_TOLERANCE * before
    )


def describe_iteration(search: "Search") -> str:
    """A line of progress: the stage, the iteration, the cost and the largest gap."""
    stages = search.method.stages
    number = "loosened" if search.noisy_gaps else f"stage {stages.index(search.stage) + 1}/{len(stages)}"
    return (
        f"{number}  iteration {search.iterations}  cost {search.cost:.6g}  "
        f"largest gap {search.current.equations.largest_gap:.1e}"
    )
