"""`DitherPeriodMean`: the mean over a dither period of signals whose integral is known, on a uniform grid.

With the integral as a state of the simulation the mean is as exact as that: ten samples a period do, where a
trapezoidal rule on the signal's own samples takes twenty.
"""

from dataclasses import dataclass

import numpy as np

from pneuopt.quantities.arrays import Array


@dataclass(frozen=True)
class DitherPeriodMean:
    """A centred mean over `period`, of integrals that are cubic between samples.

    Parameters
    ----------
    period : float
        [s]
    spacing : float
        Of the samples [s].
    """

    period: float
    spacing: float

    @property
    def half_period_samples(self) -> int:
        """Whole samples in half a period."""
        return int(self.period / 2 / self.spacing + 1e-9)

    def mean_count(self, n: int) -> int:
        """How many of n samples, from the first on, have a mean."""
        return max(0, n - self.half_period_samples - 1)

    def means(self, signal: Array, integral: Array, initial: float, stride: int = 1) -> Array:
        """Means at every `stride`-th sample that has one.

        Parameters
        ----------
        signal, integral : ndarray, shape (m, n)
        initial : float
            The signal before the first sample.

        Returns
        -------
        ndarray, shape (m, ceil(reach(n) / stride))

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
