"""Confirmation that limits contradict each other, by a search that shares neither method nor merit with the first.

A search adds up the excesses over its limits. Where that sum has a local minimum it stays there, though a design far
away keeps every limit. The second search is SciPy's differential evolution on the largest excess.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, differential_evolution

from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.relaxation import limit_excess
from pneuopt.tuning.simulator import Simulator

# Members of the population and trials in all, for each free gain. Fewer miss designs that keep the limits; more delay
# the answer where there is none.
MEMBERS_A_GAIN, TRIALS_A_GAIN = 15, 900
SEED = 0  # of the random numbers, so that an answer repeats


@dataclass(frozen=True, eq=False)
class Confirmation:
    """What the second search found.

    Attributes
    ----------
    point : ndarray, shape (n,)
        The gains closest to the limits.
    share : float
        The largest relative excess over a limit there, as `limit_excess` counts; at most 0 where all are kept.
    simulations : int
        Candidates simulated.
    """

    point: Array
    share: float
    simulations: int


def confirm_infeasible(
    simulator: Simulator, spec: Specification, room: float, progress: ProgressCallback
) -> Confirmation:
    """Search for gains that keep all limits, with some room, until they are found or the trials are used up.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        As asked for.
    room : float
        Share of every limit that is to be left; the search ends where it is.
    progress : callable
        Receives a line of text a generation.

    Returns
    -------
    Confirmation
    """
    space, quick, stable = simulator.space, simulator.coarse(spec), spec.with_stability()
    count = 0

    def find_excess(unit: Array) -> Any:
        nonlocal count
        count += unit.shape[1]
        return limit_excess(quick.values(space.from_unit(np.clip(unit.T, 0.0, 1.0)), stable), stable)

    def is_found(intermediate_result: OptimizeResult) -> bool:
        progress(f"confirming that no design keeps all limits: closest {100 * intermediate_result.fun:.3g} % beyond")
        return bool(intermediate_result.fun <= -room)

    settings: Any = {
        "bounds": [(0.0, 1.0)] * len(space.names),
        "popsize": MEMBERS_A_GAIN,
        "maxiter": TRIALS_A_GAIN // MEMBERS_A_GAIN,
        "x0": space.to_unit(space.start),
        "init": "sobol",
        "polish": False,
        "vectorized": True,
        "updating": "deferred",
        "seed": SEED,
        "callback": is_found,
    }
    found: Any = differential_evolution(find_excess, **settings)
    point = space.from_unit(np.clip(found.x, 0.0, 1.0))
    share = float(limit_excess(simulator.values(point[None], stable), stable)[0])
    return Confirmation(point, share, count)


def describe_confirmation(found: Confirmation) -> str:
    """Say in words by what an infeasible answer is confirmed.

    Examples
    --------
    >>> describe_confirmation(Confirmation(np.zeros(2), 0.1234, 3600))
    "a second search, SciPy's differential evolution over 3600 simulations"
    """
    return f"a second search, SciPy's differential evolution over {found.simulations} simulations"
