"""`try_candidate`: a short search of a model with loose gaps, which ranks it, or shows that no search can save it.

Gaps between segments only relax a fit: with any gaps allowed the squares are less than without. So where short searches
with loose gaps have ended, and their squares exceed those of another model's whole fit many times, the model
cannot explain the logs, and minutes of search would show only that.
"""

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.system import System
from pneuopt.identification.examination import pose_problem
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.errors import PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.shooting.least_squares import LeastSquares, Stage, solve_least_squares
from pneuopt.shooting.solution import Fit

# gaps and iterations of a trial: with tighter gaps, or more iterations, it takes as long as a search; with looser ones
# a wrong model looks as good as a right one
TRIAL_STAGES = (Stage(3e-3, 12), Stage(1e-3, 8), Stage(1e-4, 12))
MAX_TRIALS = 3  # starts of a model that are tried: fewer may miss the right basin, more take as long as a search


@dataclass(frozen=True)
class Trial:
    """The best short search of a model.

    Parameters
    ----------
    squares : float
        Squared residuals and gaps, in noise variances; infinite where no start is finite.
    least : float
        What these would still fall to, by the linearised equations; zero where these say nothing.
    """

    squares: float = math.inf
    least: float = math.inf


def try_candidate(
    system: System,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
    *,
    window: float = math.inf,
    near: IdentificationResult | None = None,
    known: Trial | None = None,
    enough: float = math.inf,
) -> Trial:
    """Search shortly from a model's first starts.

    Parameters
    ----------
    system : System
    experiments : sequence of Experiment
    parameters : ParameterSet
    method : LeastSquares
    window : float
        Time after which a log starts anew [s].
    near : IdentificationResult, optional
        A fit with another model of the same states, from which a search begins, too, where the model's starts guess.
    known : Trial, optional
        Of the first start, which is not tried again.
    enough : float
        Squares to which a search must fall to be the last.

    Returns
    -------
    Trial

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    KeyboardInterrupt
        If a search is interrupted.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # a fit says them
        problem = replace(pose_problem(system, experiments, parameters, method), window=window)
    candidates, best = problem.candidates(), known or Trial()
    others = [problem.start_from(near)] if near and candidates[0].trial_parameters else []
    for start in itertools.chain(others, itertools.islice(candidates, 1 if known else 0, MAX_TRIALS)):
        found = _try_start(problem, start)
        best = Trial(min(best.squares, found.squares), min(best.least, found.least))
        if best.least <= enough:
            break
    return best


def _try_start(problem: EstimationProblem, start: Start) -> Trial:
    """The trial from one start."""
    stages = TRIAL_STAGES if problem.has_gaps else TRIAL_STAGES[-1:]
    # an empty last stage: the last one of a method would iterate to its end
    method = replace(problem.method, stages=(*stages, replace(stages[-1], iterations=0)))
    fit = solve_least_squares(problem.transcription(start), method)
    if fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    squares = 2 * fit.stats["cost"]
    return Trial(squares, _least_squares(fit)) if squares < math.inf else Trial()


def _least_squares(fit: Fit) -> float:
    """The squares at the end of an undamped step, by the linearised equations; zero where there is no such step."""
    if fit.optimum is None:
        return 0.0
    arrow = fit.optimum.equations.arrow
    reduced = arrow.eliminate(0.0)
    step = reduced and reduced.step(fit.optimum.keep)
    least = 2 * fit.stats["cost"] - arrow.descent_rate(step) if step else 0.0
    return least if least > 0.0 else 0.0
