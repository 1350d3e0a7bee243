"""Means of sampled signals over a dither's period, linear between samples: along the record, and at its end."""

import numpy as np

from pneuopt.quantities.arrays import Array

FINAL_PERIODS = 5
TAIL_SHARE = 0.05  # of a record without dither, that counts as its end


def period_mean(t: Array, y: Array, initial: float, period: float, at: Array) -> Array:
    """Centred mean over one period of signals that are linear between samples, and `initial` before the first.

    Parameters
    ----------
    t : ndarray, shape (n,)
    y : ndarray, shape (m, n)
    initial : float
    period : float
        [s]
    at : ndarray, shape (k,)
        Instants, half a period from the end at most [s].

    Returns
    -------
    ndarray, shape (m, k)
    """
    steps = 0.5 * np.diff(t) * (y[:, 1:] + y[:, :-1])
    whole = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    ends = (_integral(t, y, whole, initial, at + side * period / 2) for side in (1, -1))
    mean: Array = (next(ends) - next(ends)) / period
    return mean


def end_mean(t: Array, y: Array, period: float | None) -> Array:
    """The final values as `step_metrics` reads them, shape (m,): the last sample, or the mean over the last periods."""
    if period is None:
        return y[:, -1]
    t, y = tail(t, y, period)
    return np.asarray(np.trapezoid(y, t, axis=1) / (t[-1] - t[0]))


def tail(t: Array, y: Array, period: float | None) -> tuple[Array, Array]:
    """The end of a record: its last periods, five or as many as there are, without dither its last 5 %."""
    duration = (
        TAIL_SHARE * (t[-1] - t[0]) if period is None else period * min(FINAL_PERIODS, int((t[-1] - t[0]) / period))
    )
    begin = t[-1] - duration
    k = min(max(int(np.searchsorted(t, begin, side="right")) - 1, 0), len(t) - 2)
    first = y[:, [k]] + (begin - t[k]) / (t[k + 1] - t[k]) * (y[:, [k + 1]] - y[:, [k]])
    return np.append(begin, t[t > begin]), np.concatenate([first, y[:, t > begin]], axis=1)


def _integral(t: Array, y: Array, whole: Array, initial: float, at: Array) -> Array:
    """From the first sample to `at`; `whole` is the integral to each sample."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    ahead = at - t[k]
    inside: Array = whole[:, k] + ahead * (y[:, k] + 0.5 * ahead * (y[:, k + 1] - y[:, k]) / (t[k + 1] - t[k]))
    return np.where(at < t[0], initial * (at - t[0]), inside)
