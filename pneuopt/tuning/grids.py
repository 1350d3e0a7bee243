"""The samples on which a search runs its responses, and closer ones where a response is fast."""

from collections.abc import Callable, Sequence

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.dynamics.system import names
from pneuopt.evaluation.resolution import MAX_REFINEMENTS, refine_instants, spread_instants
from pneuopt.evaluation.response import SAMPLES_A_DITHER_PERIOD, loop_inputs, readings_a_sample, sample_spacing
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.readings import ReferenceGrid

# Multiple of the tolerances of a certificate's readings that a search's samples keep. A smaller one searches on more
# samples than a ranking of designs needs; a larger one claims figures that the certificate refuses.
SEARCH_TOLERANCE = 5.0


def reference_grids(
    loop: ClosedLoop,
    references: Sequence[Reference],
    parameters: ParameterSet,
    samples_a_period: int = SAMPLES_A_DITHER_PERIOD,
) -> list[ReferenceGrid]:
    """The samples of each reference, with so many samples in the period of a continuous dither."""
    found = []
    for reference in references:
        h = sample_spacing(loop, reference, parameters, samples_a_period)
        run, k = loop_inputs(loop, reference, h), readings_a_sample(loop, reference)
        number = np.arange(k * (len(run) - 1) + 1)
        t: Array = np.asarray(number * (h / k), dtype=np.float64)
        found.append(
            ReferenceGrid(reference, t, run.matrix(names(loop.inputs))[number // k], h / k, loop.pid.sample_time)
        )
    return found


def refine_grids(
    grids: list[ReferenceGrid], cases: Sequence[Mask], read: Callable[[int, ReferenceGrid], Array | None]
) -> list[ReferenceGrid]:
    """Grids whose samples are close enough for the responses of a point; the same list where they are.

    Parameters
    ----------
    grids : list of ReferenceGrid
    cases : sequence of ndarray of bool, shape (n_cases,)
        Which cases run on each grid.
    read : callable
        The signal of a case at a grid's samples; None where it runs away.
    """
    finer = []
    for grid, own in zip(grids, cases, strict=True):
        found = [_resolve(grid, case, read).t for case in np.flatnonzero(own).tolist()]
        t = np.unique(np.concatenate(found))
        least = 1e-6 * grid.spacing  # the same instant, but for rounding
        finer.append(grid.at(spread_instants(grid.t, t[np.append(True, np.diff(t) > least)], grid.reference.at)))
    more = any(len(new.t) > len(old.t) for new, old in zip(finer, grids, strict=True))
    return finer if more else grids


def _resolve(grid: ReferenceGrid, case: int, read: Callable[[int, ReferenceGrid], Array | None]) -> ReferenceGrid:
    """The samples of a case, with others where its response changes fast."""
    reference = grid.reference
    for _ in range(MAX_REFINEMENTS):
        signal = read(case, grid)
        if signal is None:
            break
        finer = refine_instants(grid.t, signal, reference.final, reference.nominal_size, reference.at, SEARCH_TOLERANCE)
        if finer is None:
            break
        grid = grid.at(finer)
    return grid
