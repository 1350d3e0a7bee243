"""Instants at which a response is read, so close that its settling time, peaks and integrals are right.

A horizon may be hundreds of times as long as the response: then readings at even distances miss what happens. From a
first reading, `refine_instants` finds where the signal bends between readings, or where an integral of the error is not
exact, and adds instants there.
"""

import numpy as np

from pneuopt.quantities.arrays import Array, Indices, Mask

# Largest distance of a signal between two readings from the straight line that joins them, a share of the step: with a
# larger one settling times and overshoots are off; a smaller one adds readings that change no digit shown.
LINE_TOLERANCE = 1e-4
# Relative error of the integrals over the error that readings may cause: with a larger one a search compares reading
# errors; a smaller one adds readings that change no digit shown.
INTEGRAL_TOLERANCE = 1e-3
# Parts into which a distance between readings is divided at a time: fewer take more simulations; more add readings
# where they are not needed.
PARTS_AT_A_TIME = 8
# Times that points are added where a response changes fast: each brings them eight times as close. Fewer leave the peak
# of a fast response in a long horizon unread; more cost a simulation each.
MAX_REFINEMENTS = 4
# Factor on the time after a step within which responses of different gains are taken to change equally fast: a smaller
# one misses those that are faster than the first; a larger one adds readings where nothing happens.
SPREAD = 3.0
# Readings of a response, at most: fewer leave a fast response in a long horizon unresolved; more take seconds to read.
MAX_INSTANTS = 60_000


def refine_instants(
    t: Array, signal: Array, target: float, size: float, start: float, tolerance: float = 1.0
) -> Array | None:
    """Instants with others added where readings are too far apart; None where they are close enough.

    Parameters
    ----------
    t, signal : ndarray, shape (n,)
        Readings of the signal [s, its unit].
    target, size : float
        The reference and the step's size [the signal's unit].
    start : float
        When the step begins [s].
    tolerance : float
        Multiple of `LINE_TOLERANCE` and `INTEGRAL_TOLERANCE` that counts as close enough.

    Returns
    -------
    ndarray or None

    Examples
    --------
    >>> t = np.linspace(0.0, 10.0, 101)
    >>> finer = refine_instants(t, 1 - np.exp(-5 * t), 1.0, 1.0, 0.0)
    >>> bool(finer[1] < t[1] and finer[-2] == t[-2])
    True
    >>> refine_instants(t, np.zeros(101), 1.0, 1.0, 0.0) is None
    True
    """
    after, error = np.maximum(t - start, 0.0), np.where(t < start - 1e-12, 0.0, signal - target) / abs(size)
    coarse = np.diff(t) ** 2 / 8 * _curvatures(t, signal / abs(size)) > tolerance * LINE_TOLERANCE
    for integrand in (error, error**2, after * error):
        coarse |= _is_inexact(t, integrand, tolerance)
    fine = np.diff(t) > 8 * np.spacing(t[-1])
    chosen = np.flatnonzero(coarse & fine)
    if not len(chosen) or len(t) + (PARTS_AT_A_TIME - 1) * len(chosen) > MAX_INSTANTS:
        return None
    return _divide(t, chosen)


def spread_instants(even: Array, needed: Array, start: float) -> Array:
    """Instants for the responses of other gains, which are as fast as one's, but not at the same instants.

    They are as close as those needed at a third to three times their time after the step.

    Parameters
    ----------
    even : ndarray, shape (n,)
        Readings before any were added [s].
    needed : ndarray, shape (m,)
        Instants of `refine_instants`, of one response or of several together [s].
    start : float
        When the step begins [s].
    """
    t, begin, width = even, needed[:-1], np.diff(needed)
    closest = width.min()
    while True:
        low, high = start + (t[:-1] - start) / SPREAD, start + (t[1:] - start) * SPREAD
        first, last = np.searchsorted(begin, low, side="right") - 1, np.searchsorted(begin, high)
        finest = [width[max(a, 0) : max(b, a + 1)].min() for a, b in zip(first.tolist(), last.tolist(), strict=True)]
        chosen = np.flatnonzero((np.diff(t) > 1.5 * np.maximum(finest, closest)) & (t[:-1] >= start - 1e-12))
        if not len(chosen):
            return t
        t = _divide(t, chosen)


def _divide(t: Array, chosen: Indices) -> Array:
    """Instants with those added that divide the chosen intervals."""
    added = t[chosen, None] + np.diff(t)[chosen, None] * np.arange(1, PARTS_AT_A_TIME) / PARTS_AT_A_TIME
    return np.sort(np.concatenate([t, added.ravel()]))


def _is_inexact(t: Array, integrand: Array, tolerance: float) -> Mask:
    """Intervals whose share of the trapezoidal rule's error is too large, shape (n - 1,).

    All intervals together may contribute `INTEGRAL_TOLERANCE` of the integral of its size, times `tolerance`. Where the
    integrand changes its sign, its size has a corner, which is a small part of it all.
    """
    most = tolerance * INTEGRAL_TOLERANCE * float(np.trapezoid(np.abs(integrand), t)) / (len(t) - 1)
    return np.asarray(np.diff(t) ** 3 / 12 * _curvatures(t, integrand) > most)


def _curvatures(t: Array, y: Array) -> Array:
    """The size of the second derivative in each interval, the larger of those at its ends, shape (n - 1,)."""
    inside = np.abs(np.diff(np.diff(y) / np.diff(t))) / (t[2:] - t[:-2]) * 2
    ends = np.concatenate([[0.0], inside, [0.0]])
    return np.asarray(np.maximum(ends[:-1], ends[1:]))
