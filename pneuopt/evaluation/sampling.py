"""`Sampling`: how the points of a sample fill the unit cube; `generator`: random numbers that no two draws share.

Random numbers are a function of a seed and of the name of what is drawn: the kind of the draw, and each axis of it. So
two kinds, two axes, and a search and the plants on which its result is tried never see the same numbers, whatever seeds
a user gives them, equal ones included; and an axis more leaves the numbers of the others as they were.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from math import ceil, log2
from numbers import Integral

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError

Seed = int | tuple[int | str, ...]
"""A user's number, or that with words after it which say for what it is taken: (0, "validation")."""


class Sampling(Enum):
    """How points are chosen in the unit cube; a newcomer adds a word here and a row of `_POINTS`."""

    RANDOM = "random"
    """Independent of each other: Monte Carlo, whose scatter tells its own error."""
    LATIN_HYPERCUBE = "latin_hypercube"
    """Each of n equal parts of each axis has one point: means of smooth figures converge faster."""
    SOBOL = "sobol"
    """A scrambled Sobol sequence: as even in several axes at once; best with a power of two."""


def further(seed: Seed, *words: str) -> Seed:
    """A seed of another stream: what is drawn with it shares no number with what is drawn with the first.

    Examples
    --------
    >>> further(3, "validation")
    (3, 'validation')
    """
    return (*(seed if isinstance(seed, tuple) else (seed,)), *words)


def generator(seed: Seed, *stream: str) -> np.random.Generator:
    """Random numbers of a stream, the same on every machine; those of two streams are independent.

    Parameters
    ----------
    seed : int or tuple
        Whole numbers, not below 0, and words.
    *stream : str
        What is drawn: its kind, and the names of what varies.

    Raises
    ------
    InputError
        If a number of the seed is no whole one, or is below 0.

    Examples
    --------
    >>> float(generator(0, "samples", "load.mass").random()) == float(generator(0, "draws", "load.mass").random())
    False
    """
    parts: list[int | str] = []
    for part in (*(seed if isinstance(seed, tuple) else (seed,)), *stream):
        if isinstance(part, str):
            parts.append(part)
        elif isinstance(part, Integral) and not isinstance(part, bool) and part >= 0:
            parts.append(int(part))
        else:
            raise InputError(f"a seed is a whole number, not below 0, got {part!r}")
    digest = hashlib.sha256(json.dumps(parts).encode()).digest()  # no two lists of parts have one text
    return np.random.default_rng(int.from_bytes(digest, "big"))


def unit_points(sampling: Sampling, count: int, axes: Sequence[str], seed: Seed, kind: str) -> Array:
    """Points of the unit cube, the same for the same seed wherever they are computed.

    Parameters
    ----------
    sampling : Sampling
    count : int
    axes : sequence of str
        The name of each axis: together with `kind` it says which random numbers the axis has.
    seed : int or tuple
    kind : str
        What is drawn.

    Returns
    -------
    ndarray, shape (count, n_axes)

    Examples
    --------
    >>> points = unit_points(Sampling.LATIN_HYPERCUBE, 4, ["mass", "force"], 0, "samples")
    >>> np.sort((4 * points).astype(int), axis=0).tolist()
    [[0, 0], [1, 1], [2, 2], [3, 3]]
    """
    return _POINTS[sampling](count, axes, further(seed, kind, sampling.value))


def _random_points(count: int, axes: Sequence[str], seed: Seed) -> Array:
    return np.column_stack([generator(seed, axis).random(count) for axis in axes])


def _latin_points(count: int, axes: Sequence[str], seed: Seed) -> Array:
    """A permutation of the parts of each axis, and a point anywhere in each."""

    def column(rng: np.random.Generator) -> Array:
        return np.asarray((rng.permutation(count) + rng.random(count)) / count)

    return np.column_stack([column(generator(seed, axis)) for axis in axes])


def _sobol_points(count: int, axes: Sequence[str], seed: Seed) -> Array:
    """The first points of a scrambled sequence, which is balanced at powers of two, in an order of their own.

    In their own order the first axes of any two sequences go along with each other, however they are scrambled.
    """
    from scipy.stats import qmc  # now: it takes as long to import as all else of a certificate

    rng = generator(seed, *axes)
    points = qmc.Sobol(len(axes), scramble=True, rng=rng).random_base2(ceil(log2(count)))
    return np.asarray(rng.permutation(points[:count]))


_POINTS: Mapping[Sampling, Callable[[int, Sequence[str], Seed], Array]] = {
    Sampling.RANDOM: _random_points,
    Sampling.LATIN_HYPERCUBE: _latin_points,
    Sampling.SOBOL: _sobol_points,
}
