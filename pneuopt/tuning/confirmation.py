"""Confirmation that no design keeps all limits, by a search that shares neither method nor merit with the first.

A search adds up the excesses over its limits. Where that sum has a local minimum it stays there, though a design far
away keeps every limit. The second search is SciPy's differential evolution on the largest excess.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, differential_evolution

from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.relaxation import limit_excess
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space

# Members of the population and trials in all, for each free gain. Fewer miss designs that keep the limits; more delay
# the answer where there is none.
MEMBERS_A_GAIN, TRIALS_A_GAIN = 15, 900
SEED = 0  # of the random numbers, so that an answer repeats
# Designs that are certified one after the other, at most, and how far apart they lie, a share of a gain's range. Fewer
# or closer ones fail alike; each more costs an independent simulation of every case.
MAX_CANDIDATES, CANDIDATE_DISTANCE = 8, 0.05


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
    quick, stable = simulator.coarse(spec), spec.with_stability()
    found, count = _minimise_excess(
        lambda points: limit_excess(quick.values(points, stable), stable),
        simulator.space,
        lambda excess: excess <= -room,
        lambda excess: progress(f"confirming that no design keeps all limits: {_describe_closest(excess)}"),
    )
    share = float(limit_excess(simulator.values(found[None], stable), stable)[0])
    return Confirmation(found, share, count)


def find_candidates(
    excess: Callable[[Array], Array], space: Space, progress: ProgressCallback
) -> tuple[list[Array], int]:
    """Designs that keep all limits, to be certified one after the other, by the same search.

    Parameters
    ----------
    excess : callable
        The largest relative excess over a limit of points, shape (m, n): shape (m,), at most 0 where all are kept.
    space : Space
    progress : callable
        Receives a line of text a generation.

    Returns
    -------
    points : list of ndarray, shape (n,)
        The one with the most room first, then others that lie apart from those before; empty where there is none.
    simulations : int
        Candidates simulated.
    """
    kept, rooms = list[Array](), list[float]()

    def record(points: Array) -> Array:
        values = excess(points)
        kept.extend(points[values <= 0])
        rooms.extend(values[values <= 0].tolist())
        return values

    _, count = _minimise_excess(
        record,
        space,
        lambda _: False,
        lambda excess: progress(f"searching for other designs that keep all limits: {_describe_closest(excess)}"),
    )
    chosen = list[Array]()
    for k in np.argsort(rooms, kind="stable").tolist():
        unit = space.to_unit(kept[k])
        if all(np.max(np.abs(unit - space.to_unit(other))) > CANDIDATE_DISTANCE for other in chosen):
            chosen.append(kept[k])
    return chosen[:MAX_CANDIDATES], count


def _minimise_excess(
    excess: Callable[[Array], Array], space: Space, is_enough: Callable[[float], bool], report: Callable[[float], None]
) -> tuple[Array, int]:
    """The point with the least excess that SciPy's differential evolution finds, shape (n,), and how many it tried."""
    count = 0

    def cost(unit: Array) -> Any:
        nonlocal count
        count += unit.shape[1]
        return excess(space.from_unit(np.clip(unit.T, 0.0, 1.0)))

    def is_found(intermediate_result: OptimizeResult) -> bool:
        report(float(intermediate_result.fun))
        return is_enough(float(intermediate_result.fun))

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
    found: Any = differential_evolution(cost, **settings)
    return space.from_unit(np.clip(found.x, 0.0, 1.0)), count


def _describe_closest(excess: float) -> str:
    """How far the best candidate so far lies beyond its limits, or within them, in words.

    Examples
    --------
    >>> _describe_closest(0.123), _describe_closest(-0.61)
    ('the closest is 12.3 % beyond them', 'the best stays 61 % below them')
    """
    share = f"{100 * abs(excess):.3g} %"
    return f"the closest is {share} beyond them" if excess > 0 else f"the best stays {share} below them"


def describe_confirmation(simulations: int) -> str:
    """Say in words by what an infeasible answer, or a refusal, is confirmed.

    Examples
    --------
    >>> describe_confirmation(3600)
    "a second search, SciPy's differential evolution over 3600 simulations"
    """
    return f"a second search, SciPy's differential evolution over {simulations} simulations"
