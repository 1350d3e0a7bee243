"""Mean of sampled signals over a dither period: along the record, and at its end.

`period_mean` takes signals to be linear between samples and needs twenty samples a period. `DitherPeriodMean` takes
signals with their integral, which is a state of the simulation, and is as exact as that state from ten samples on.
"""

from dataclasses import dataclass

import numpy as np

from pneuopt.quantities.arrays import Array

# Whole dither periods at the end of a record over which its final value is averaged: fewer average less noise, more
# reach back into the transient.
FINAL_PERIODS = 5
# Share of a record that counts as its end, where ripple is read and a settling comes too late to count: a smaller one
# sees less than a cycle of slow hunting, a larger one reaches back into the transient.
TAIL_SHARE = 0.05


def period_mean(t: Array, y: Array, initial: float, period: float, at: Array) -> Array:
    """Centred mean over one period of signals that are linear between samples and `initial` before the first.

    Parameters
    ----------
    t : ndarray, shape (n,)
    y : ndarray, shape (m, n)
    initial : float
    period : float
        [s]
    at : ndarray, shape (k,)
        Instants, at least half a period before the end [s].

    Returns
    -------
    ndarray, shape (m, k)
    """
    steps = 0.5 * np.diff(t) * (y[:, 1:] + y[:, :-1])
    whole = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    ends = (_integral(t, y, whole, initial, at + side * period / 2) for side in (1, -1))
    mean: Array = (next(ends) - next(ends)) / period
    return mean


def end_mean(t: Array, y: Array, period: float) -> Array:
    """Mean over the last five periods, or as many as the record has, of signals whose last axis is time."""
    span = period * min(FINAL_PERIODS, int((t[-1] - t[0]) / period))
    t, y = _cut_end(t, y, span)
    return np.asarray(np.trapezoid(y, t, axis=-1) / (t[-1] - t[0]))


def tail(t: Array, y: Array) -> Array:
    """Signals in the last 5 % of a record, from an interpolated first value on."""
    return _cut_end(t, y, TAIL_SHARE * (t[-1] - t[0]))[1]


def _cut_end(t: Array, y: Array, span: float) -> tuple[Array, Array]:
    begin = t[-1] - span
    k = min(max(int(np.searchsorted(t, begin, side="right")) - 1, 0), len(t) - 2)
    first = y[..., [k]] + (begin - t[k]) / (t[k + 1] - t[k]) * (y[..., [k + 1]] - y[..., [k]])
    return np.append(begin, t[t > begin]), np.concatenate([first, y[..., t > begin]], axis=-1)


@dataclass(frozen=True)
class DitherPeriodMean:
    """Centred mean over a period, from an integral that is taken as cubic between samples.

    Parameters
    ----------
    period : float
        [s]
    spacing : float
        Spacing of the samples [s].
    """

    period: float
    spacing: float

    @property
    def half_period_samples(self) -> int:
        """Number of whole samples in half a period."""
        return int(self.period / 2 / self.spacing + 1e-9)

    def mean_count(self, n: int) -> int:
        """Number of samples, of n from the first on, that have a mean."""
        return max(0, n - self.half_period_samples - 1)

    def means(self, signal: Array, integral: Array, initial: float, stride: int = 1) -> Array:
        """Return the means at every `stride`-th sample that has one.

        Parameters
        ----------
        signal, integral : ndarray, shape (m, n)
        initial : float
            The signal before the first sample.

        Returns
        -------
        ndarray, shape (m, ceil(mean_count(n) / stride))

        Examples
        --------
        >>> t = np.linspace(0.0, 2.0, 21)[None]
        >>> DitherPeriodMean(0.5, 0.1).means(3 * t**2, t**3, 0.0)[0, 5].round(9).item()  # (0.75^3 - 0.25^3)/0.5
        0.8125
        """
        m, h, n = self.half_period_samples, self.spacing, signal.shape[1]
        s = self.period / 2 / h - m
        before = np.arange(-m - 1, 0) * (h * initial)
        Y = np.concatenate([np.broadcast_to(before, (len(signal), m + 1)), integral - integral[:, :1]], axis=1)
        y = np.concatenate([np.full((len(signal), m + 1), initial), signal], axis=1)
        near, far = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
        slope_near, slope_far = h * s * (1 - s) ** 2, h * s * s * (s - 1)

        def shift(rows: Array, ahead: int) -> Array:
            return rows[:, m + 1 + ahead : m + 1 + ahead + self.mean_count(n) : stride]

        total = near * (shift(Y, m) - shift(Y, -m)) + far * (shift(Y, m + 1) - shift(Y, -m - 1))
        total += slope_near * (shift(y, m) + shift(y, -m)) + slope_far * (shift(y, m + 1) + shift(y, -m - 1))
        return np.asarray(total / self.period)


def _integral(t: Array, y: Array, whole: Array, initial: float, at: Array) -> Array:
    """Integral from the first sample to `at`, from the integrals `whole` up to each sample."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    ahead = at - t[k]
    inside: Array = whole[:, k] + ahead * (y[:, k] + 0.5 * ahead * (y[:, k + 1] - y[:, k]) / (t[k + 1] - t[k]))
    return np.where(at < t[0], initial * (at - t[0]), inside)
