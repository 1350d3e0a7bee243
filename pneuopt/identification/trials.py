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
        Squared residuals and gaps, in noise variances; infinite where no start is finite, or none was searched to the
        end.
    least : float
        What these would still fall to, by the linearised equations; zero where these say nothing.
    by_stage : tuple of float
        The squares after each stage, at least the noise's.
    ratio : float
        The least squares over those that were allowed after the same stage, where no start kept within these; else 0.
    """

    squares: float = math.inf
    least: float = math.inf
    by_stage: tuple[float, ...] = ()
    ratio: float = 0.0

    @property
    def is_hopeless(self) -> bool:
        """Whether each start was left for its squares, or is not finite."""
        return math.isinf(self.squares)

    def better(self, other: "Trial") -> "Trial":
        """The one of fewer squares; of two that were left, the one that was nearer."""
        return min(self, other, key=lambda trial: (trial.squares, trial.ratio or math.inf))


def try_candidate(
    system: System,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
    *,
    window: float = math.inf,
    near: IdentificationResult | None = None,
    known: Trial | None = None,
    allowed: Sequence[float] = (),
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
        Of the first start, which is not tried again; the other starts are tried where it is hopeless.
    allowed : sequence of float
        Squares after each stage beyond which a start is left, by default none; one that keeps within them is the last.

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
        best = best.better(_try_start(problem, start, allowed))
        if not (allowed and best.is_hopeless):
            break
    return best


def _try_start(problem: EstimationProblem, start: Start, allowed: Sequence[float]) -> Trial:
    """The trial from one start, until its squares exceed what is allowed."""
    stages = TRIAL_STAGES if problem.has_gaps else TRIAL_STAGES[-1:]
    trial = Trial(0.0, 0.0)
    for stage, enough in itertools.zip_longest(stages, allowed[: len(stages)], fillvalue=math.inf):
        assert isinstance(stage, Stage)
        # an empty last stage: the last one of a method would iterate to its end
        method = replace(problem.method, stages=(stage, replace(stage, iterations=0)))
        fit = solve_least_squares(problem.transcription(start), method)
        if fit.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        squares, optimum = 2 * fit.stats["cost"], fit.optimum
        if not squares < math.inf:
            return Trial()
        least = max(0.0, optimum.equations.promised_squares(optimum.keep)) if optimum else 0.0
        trial = Trial(squares, least, (*trial.by_stage, max(squares, fit.count)))
        if least > enough:
            return replace(trial, squares=math.inf, ratio=least / enough)
        start = problem.start_from(fit)
    return trial
