"""Soft-continuity multiple shooting: the gaps between segments are weighted residuals, solved by Levenberg-Marquardt.

One nonlinear least squares in all nodes and parameters; each step is a banded Cholesky with an arrow, linear in the
record's length. The gaps are tightened in stages, so that a bad start is never integrated over the whole record,
as single shooting does, which fails there (problems/speed/benchmark_identification.py).
"""

import math
from dataclasses import dataclass, field

from pneuopt.quantities.status import ProgressCallback
from pneuopt.shooting.budget import CpuBudget
from pneuopt.shooting.search import Search
from pneuopt.shooting.segments import segment
from pneuopt.shooting.solution import Fit
from pneuopt.shooting.transcription import Transcription

# gap [1] beyond which log parameters are drawn to their start: lower biases what tight gaps tell, higher lets them
# drift to where tight gaps cannot tell them any more
WIDE_GAP = 2e-4


@dataclass(frozen=True)
class Stage:
    """A stage of the search: how tight the gaps are, and how long it runs.

    Parameters
    ----------
    gap : float
        Standard deviation of a gap, as a fraction of the state's nominal size.
    iterations : int
        Largest number of iterations.
    refine : int
        Integration steps at the end of the stage, as a multiple of those before. Let the last stage have more than 1:
        with 1 and a gap above `WIDE_GAP` a stage draws log parameters to their start (`has_prior`).
    """

    gap: float
    iterations: int
    refine: int = 1

    @property
    def has_prior(self) -> bool:
        """Whether log parameters are drawn to their start: wide gaps hide what some of them do.

        Not in a stage that may be the last, which refines its steps.
        """
        return self.gap > WIDE_GAP and self.refine == 1


@dataclass(frozen=True)
class LeastSquares:
    """Lifted least squares by Levenberg-Marquardt: a method and its options.

    Parameters
    ----------
    stages : tuple of Stage
        Continuation in the gaps' weight; the last stage decides on convergence.
    segment_time : float
        Time between two shooting nodes [s]; math.inf for one segment a log.
    substeps : int, optional
        Integration steps a sample; default: from the stiffness at the start of each stage, h |lambda| <= 2 a step of
        RK4, or fewer that are implicit in the one state whose own rate asks for these (`choose_integration`); the last
        stage adds what finer steps change, halved until that moves no estimate.
    tolerance : float
        Largest last undamped step of a parameter, in its standard deviations.
    kinematic : float
        States whose rate holds no free parameter keep their gaps this much smaller.
    progress : callable, optional
        Receives one line of text an iteration.
    budget : CpuBudget
        Ends the search as Ctrl-C does, within the run that goes on by then; by default none.
    max_misfit : float
        Squared residuals a sample, in noise variances, beyond which the search ends after the first stage, or before
        the last where the gaps do not absorb the misfit, for a caller who has other starts to try.
    allows_state_noise : bool
        Whether gaps may stand for noise of the states where the model misses the logs with tight ones.
    known_costs : tuple of (float, float)
        Gaps and costs at which a search from another start has ended its stages, none of which explained the logs to
        their noise; a search that comes to the same ends there (`JOINED_SEARCH`).
    checks_steps : bool
        Whether finer integration steps are tried at the end: not where a refit keeps those of a fit that tried them.
    """

    stages: tuple[Stage, ...] = (
        Stage(1e-2, 12),
        Stage(3e-3, 8),
        Stage(1e-3, 8),
        Stage(3e-4, 8),
        Stage(1e-4, 8),
        Stage(1e-5, 30, refine=2),
    )
    segment_time: float = 0.01
    substeps: int | None = None
    tolerance: float = 0.1
    kinematic: float = 0.01
    progress: ProgressCallback | None = field(default=None, repr=False, compare=False)
    budget: CpuBudget = field(default=CpuBudget(math.inf), repr=False, compare=False)
    max_misfit: float = math.inf
    allows_state_noise: bool = True
    known_costs: tuple[tuple[float, float], ...] = field(default=(), repr=False, compare=False)
    checks_steps: bool = field(default=True, repr=False)


def solve_least_squares(transcription: Transcription, method: LeastSquares | None = None) -> Fit:
    """Solve a transcription that has residuals and bounds, but neither costs nor limits.

    Parameters
    ----------
    transcription : Transcription
        Its phases' guesses and its parameters' values are the start.
    method : LeastSquares, optional

    Returns
    -------
    Fit
        Whatever its status; an interruption (Ctrl-C) returns the best iterate so far, marked.
    """
    return Search(segment(transcription), method or LeastSquares()).solve()
