"""`sensitivity_peaks`: the largest sensitivity of many loops, from their poles alone.

The sensitivity of a loop whose open loop rolls off is ``S(s) = prod (s - p)/prod (s - q)`` over the poles p of the open
and q of the closed loop. So it takes no frequency response of the plant, and its resonances are known beforehand: they
lie near the closed loop's poles.
"""

from math import inf

import numpy as np

from pneuopt.evaluation.stability import ComplexArray
from pneuopt.quantities.arrays import Array

# Frequencies spread over the range, beside those about the closed poles. Fewer miss a broad maximum between them;
# more cost time in proportion.
SPREAD_FREQUENCIES = 48
# Finer grids about the two highest peaks, each within two steps of the last, and the frequencies of each. Fewer of
# either show a sharp resonance too low; more cost time in proportion.
PEAK_REFINEMENTS = 4
PEAK_GRID_POINTS = 9
LOOPS_AT_A_TIME = 128  # more do not fit the processor's cache; fewer spend their time between the operations


def sensitivity_peaks(opened: ComplexArray, closed: ComplexArray, low: float, high: float) -> Array:
    """The largest ``|S(jw)|`` of m loops for low <= w <= high [rad/s], shape (m,).

    Parameters
    ----------
    opened, closed : ndarray of complex, shape (m, n)
        The poles of the open and of the closed loop [rad/s].
    low, high : float
        [rad/s]

    Examples
    --------
    ``L = 25/(s (s + 3))`` closes to poles at ``-1.5 +- 4.77j``:

    >>> peak = sensitivity_peaks(np.array([[0.0, -3.0]]), np.roots([1.0, 3.0, 25.0])[None], 0.01, 1e3)
    >>> round(float(peak[0]), 4)
    1.9946
    """
    parts = np.arange(0, len(opened), LOOPS_AT_A_TIME)[1:]
    pairs = zip(np.split(opened, parts), np.split(closed, parts), strict=True)
    return np.concatenate([_peaks(p, q, low, high) for p, q in pairs])


def _peaks(opened: ComplexArray, closed: ComplexArray, low: float, high: float) -> Array:
    spread = np.broadcast_to(np.geomspace(low, high, SPREAD_FREQUENCIES), (len(opened), SPREAD_FREQUENCIES))
    around = (np.abs(closed) + share * np.abs(closed.real) for share in (-1, 0, 1))  # a resonance and its flanks
    omega = np.sort(np.concatenate([spread, *(np.clip(w, low, high) for w in around)], axis=1), axis=1)
    sizes, rows = _squares(opened, closed, omega), np.arange(len(omega))
    edged = np.pad(sizes, ((0, 0), (1, 1)), constant_values=-inf)
    is_peak = (sizes >= edged[:, :-2]) & (sizes >= edged[:, 2:])
    k = np.argpartition(np.where(is_peak, -sizes, 0.0), 1, axis=1)[:, :2]
    low_end, high_end = (np.log(omega[rows[:, None], np.clip(k + d, 0, omega.shape[1] - 1)]) for d in (-1, 1))
    largest, shares = sizes.max(axis=1), np.linspace(0.0, 1.0, PEAK_GRID_POINTS)
    for _ in range(PEAK_REFINEMENTS):
        grids = low_end[..., None] + (high_end - low_end)[..., None] * shares
        found = _squares(opened, closed, np.exp(grids.reshape(len(rows), -1))).reshape(grids.shape)
        largest, at = np.fmax(largest, found.max(axis=(1, 2))), found.argmax(axis=2)[..., None]
        low_end, high_end = (
            np.take_along_axis(grids, np.clip(at + d, 0, PEAK_GRID_POINTS - 1), axis=2)[..., 0] for d in (-1, 1)
        )
    return np.asarray(np.sqrt(largest))


def _squares(opened: ComplexArray, closed: ComplexArray, omega: Array) -> Array:
    """``|S(jw)|^2``, shape (m, k); pole by pole, so that no product leaves the range of a double."""
    with np.errstate(all="ignore"):
        found = np.ones_like(omega)
        for p, q in zip(opened.T[..., None], closed.T[..., None], strict=True):
            found *= (np.square(omega - p.imag) + np.square(p.real)) / (np.square(omega - q.imag) + np.square(q.real))
    return found
