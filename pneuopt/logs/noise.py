"""`noise_level`: the standard deviation of a channel's white noise, estimated from the channel alone."""

import math

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.quantities.arrays import Array


def noise_level(column: ArrayLike, t: ArrayLike | None = None) -> float:
    """Estimate white noise from the distances of samples from the line through their neighbours.

    Parameters
    ----------
    column : array_like, shape (n,)
        NaN where a sample is missing.
    t : array_like, shape (n,), optional
        Time [s], where the samples are not evenly spaced.

    Returns
    -------
    float
        Standard deviation [unit of the channel]: 1.4826 times the median absolute deviation of those distances, each
        divided by the deviation that unit noise gives it. Motion much slower than the sampling hardly changes it. It is
        at least q / sqrt(12), the deviation of a rounding to the resolution q, the smallest difference between two
        samples. NaN for a constant channel, which shows no noise.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> round(noise_level(np.sin(np.linspace(0, 6, 4000)) + 0.01 * rng.standard_normal(4000)), 3)
    0.01
    """
    column = np.asarray(column, dtype=float)
    time = np.arange(column.size, dtype=float) if t is None else np.asarray(t, dtype=float)
    known = np.isfinite(column)
    steps = np.abs(np.diff(column[known]))
    if not np.any(steps > 0):
        return math.nan
    off = _line_deviation(time, column)  # not across a hole, as long as some samples have both neighbours
    off = off[np.isfinite(off)] if np.isfinite(off).any() else _line_deviation(time[known], column[known])
    random = 1.4826 * float(np.median(np.abs(off - np.median(off)))) if off.size else 0.0
    resolution = float(np.min(steps[steps > 1e-9 * np.max(steps)])) / math.sqrt(12)
    return max(random, resolution)


def _line_deviation(t: Array, y: Array) -> Array:
    """Distance of inner samples from the line through their neighbours, scaled to the noise of one sample."""
    left = (t[2:] - t[1:-1]) / (t[2:] - t[:-2])
    distance = y[1:-1] - left * y[:-2] - (1 - left) * y[2:]
    return np.asarray(distance / np.sqrt(1 + left**2 + (1 - left) ** 2))
