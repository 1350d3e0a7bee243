"""`Sampling`: how the points of a sample fill the unit cube."""

from collections.abc import Callable, Mapping
from enum import Enum
from math import ceil, log2

import numpy as np

from pneuopt.quantities.arrays import Array

Seed = int | tuple[int, ...]


class Sampling(Enum):
    """How points are chosen in the unit cube; a newcomer adds a word here and a row of `_POINTS`."""

    RANDOM = "random"
    """Independent of each other: Monte Carlo, whose scatter tells its own error."""
    LATIN_HYPERCUBE = "latin_hypercube"
    """Each of n equal parts of each axis has one point: means of smooth figures converge faster."""
    SOBOL = "sobol"
    """A scrambled Sobol sequence: as even in several axes at once; best with a power of two."""


def unit_points(sampling: Sampling, count: int, axes: int, seed: Seed) -> Array:
    """Points of the unit cube, the same for the same seed wherever they are computed.

    Parameters
    ----------
    sampling : Sampling
    count, axes : int
    seed : int or tuple of int

    Returns
    -------
    ndarray, shape (count, axes)

    Examples
    --------
    >>> points = unit_points(Sampling.LATIN_HYPERCUBE, 4, 2, 0)
    >>> np.sort((4 * points).astype(int), axis=0).tolist()
    [[0, 0], [1, 1], [2, 2], [3, 3]]
    """
    return _POINTS[sampling](count, axes, np.random.default_rng(seed))


def _sobol_points(count: int, axes: int, rng: np.random.Generator) -> Array:
    """The first points of a scrambled sequence, which is balanced at powers of two."""
    from scipy.stats import qmc  # now: it takes as long to import as all else of a certificate

    points = qmc.Sobol(axes, scramble=True, rng=rng).random_base2(ceil(log2(count)))
    return np.asarray(points[:count])


def _latin_points(count: int, axes: int, rng: np.random.Generator) -> Array:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(axes, rng=rng).random(count))


_POINTS: Mapping[Sampling, Callable[[int, int, np.random.Generator], Array]] = {
    Sampling.RANDOM: lambda count, axes, rng: rng.random((count, axes)),
    Sampling.LATIN_HYPERCUBE: _latin_points,
    Sampling.SOBOL: _sobol_points,
}
