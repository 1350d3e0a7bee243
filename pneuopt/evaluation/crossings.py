"""Instants at which responses cross a level, or enter a band for good."""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from pneuopt.evaluation.dither_mean import TAIL_SHARE
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


def times_in_bands(record: Samples, centre: Array, width: Array, factors: Array) -> Array:
    """Settling times in bands wider by some factors, shape (m, n_factors)."""
    return np.stack([settling_times(record, centre, factor * width) for factor in factors], axis=1)


def settling_times(record: Samples, centre: Array, width: Array) -> Array:
    """Instant of the last crossing of the band, linear between samples; NaN if it lies in the record's last share."""
    t, y = record.t, record.y
    outside = np.abs(y - centre[:, None]) > width[:, None]
    k = len(t) - 1 - np.argmax(outside[:, ::-1], axis=1)
    after = np.minimum(k + 1, len(t) - 1)
    last, following = pick_samples(y, k), pick_samples(y, after)
    edge = centre + width * np.sign(last - centre)
    with np.errstate(all="ignore"):
        settled = t[k] + (t[after] - t[k]) * (edge - last) / (following - last)
    settled = np.where(outside[:, -1] | ~(settled <= (1 - TAIL_SHARE) * t[-1]), nan, settled)
    return np.where(outside.any(axis=1), settled, 0.0)


def pick_samples(rows: Array, k: NDArray[np.intp]) -> Array:
    """One sample of each row."""
    return np.asarray(rows[np.arange(len(rows)), k], dtype=float)
