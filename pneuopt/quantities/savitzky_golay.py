"""`savitzky_golay`: a column, or its derivative, by polynomials fitted to the samples around each one.

A. Savitzky and M. Golay, Analytical Chemistry 36 (1964) 1627-1639.
"""

import functools
import math

import numpy as np

from pneuopt.quantities.arrays import Array


def savitzky_golay(column: Array, window: int, order: int, *, derivative: int = 0, step: float = 1.0) -> Array:
    """Filter evenly spaced samples; at both ends the polynomial of the last whole window counts.

    Parameters
    ----------
    column : ndarray, shape (n,)
        Without missing samples.
    window : int
        Samples of a fit, odd, `column.size` at most.
    order : int
        Of the polynomials, below `window`.
    derivative : int
        0 for the values.
    step : float
        Time between two samples [s].

    Returns
    -------
    ndarray, shape (n,)

    Examples
    --------
    >>> savitzky_golay(np.array([1.0, 4.0, 9.0, 16.0, 25.0]), 5, 2, derivative=1).round(9).tolist()
    [2.0, 4.0, 6.0, 8.0, 10.0]
    """
    weights, half = _weights(window, order, derivative), window // 2
    out = np.empty(column.size)
    out[half : column.size - half] = np.correlate(column, weights[half], "valid")
    out[:half] = weights[:half] @ column[:window]
    out[column.size - half :] = weights[half + 1 :] @ column[-window:]
    return out / step**derivative


@functools.lru_cache(maxsize=64)
def _weights(window: int, order: int, derivative: int) -> Array:
    """Weights of a window's samples in the derivative at each of them, per step^derivative; shape (window, window)."""
    half = window // 2
    at = np.arange(-half, half + 1) / max(1, half)
    powers = np.vander(at, order + 1, increasing=True)
    slopes = np.zeros_like(powers)
    for k in range(derivative, order + 1):
        slopes[:, k] = math.perm(k, derivative) * powers[:, k - derivative]
    weights = np.asarray(slopes @ np.linalg.pinv(powers) / max(1, half) ** derivative)
    weights.flags.writeable = False
    return weights
