"""Instants at which responses cross a level."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pneuopt.quantities.arrays import Array


@dataclass(frozen=True)
class Samples:
    """Samples from the step on, a row a response; t is counted from the step."""

    t: Array
    y: Array


def first_crossing_times(t: Array, z: Array, level: float) -> Array:
    """Instants at which each row first reaches the level; meaningless in rows that never do."""
    k = np.argmax(z >= level, axis=1)
    before = np.maximum(k - 1, 0)
    low, high = pick_samples(z, before), pick_samples(z, k)
    with np.errstate(all="ignore"):
        between = t[before] + (t[k] - t[before]) * (level - low) / (high - low)
    return np.asarray(np.where(k == 0, t[0], between))


def pick_samples(rows: Array, k: NDArray[np.intp]) -> Array:
    """One sample of each row."""
    return np.asarray(rows[np.arange(len(rows)), k], dtype=float)
