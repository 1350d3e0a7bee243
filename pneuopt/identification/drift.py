"""A straight line through estimates that scatter from log to log, and the level at which it is watched log by log.

The line is that of a random-effects meta-regression: an estimate differs from it by its own error, whose deviation its
log states, and by a scatter from log to log, which all share. The scatter's variance is Paule and Mandel's (J. Res. NBS
87(5), 1982): the one with which the weighted squares are as large as their degrees of freedom. The test is Student's,
and its deviation never less than what the logs' own errors give (Knapp, Hartung, Statistics in Medicine 22, 2003, with
the lower limit of Roever, Knapp, Friede, BMC Medical Research Methodology 15:99, 2015).

Whoever looks after each log would meet chance sooner or later. So each look has the same, smaller level (Pocock,
Biometrika 64(2), 1977), with which chance raises an alarm in the asked share of whole histories. It is found by drawing
histories: where errors are equally large the test's distribution depends on the dates alone, not on error or scatter.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from pneuopt.quantities.arrays import Array

MIN_LOGS = 4
"""Logs from which a drift is tested [1]: three leave one degree of freedom, with which nothing is significant."""
HISTORIES = 40_000
"""Drawn histories: fewer make the level of a look uncertain by more than a tenth, more take seconds."""


@dataclass(frozen=True)
class DriftLine:
    """A weighted line through estimates.

    Attributes
    ----------
    mean, slope : float
        At the weighted mean of the times [unit], and by time [unit/time].
    centre : float
        That mean [time].
    mean_error, slope_error : float
        Standard errors, independent of each other.
    scatter : float
        Standard deviation from log to log [unit].
    dof : int
        Degrees of freedom of Student's t.
    p : float
        Probability of so steep a line without a drift, two-sided.
    """

    mean: float
    slope: float
    centre: float
    mean_error: float
    slope_error: float
    scatter: float
    dof: int
    p: float

    def at(self, times: Array, level: float = 0.95) -> tuple[Array, Array]:
        """The line at given times, and the half width of its confidence band there."""
        shift = np.asarray(times, dtype=float) - self.centre
        error = np.hypot(self.mean_error, self.slope_error * shift)
        return self.mean + self.slope * shift, float(student.ppf(0.5 + level / 2, self.dof)) * error


def fit_line(times: Array, values: Array, errors: Array) -> DriftLine:
    """Fit the line.

    Parameters
    ----------
    times : array_like, shape (n,)
        At least three, not all the same.
    values, errors : array_like, shape (n,)
        Estimates and their standard errors [unit].

    Examples
    --------
    >>> line = fit_line([0, 1, 2, 3], [1.0, 2.1, 2.9, 4.0], [1e-3] * 4)  # errors far below the scatter: least squares
    >>> round(line.slope, 3), round(line.slope_error, 4), line.dof
    (0.98, 0.0424, 2)
    """
    x, y, s = (np.asarray(v, dtype=float) for v in (times, values, errors))
    dof = len(x) - 2

    def excess(variance: float) -> float:
        return _squares(x, y, s**2 + variance) - dof

    top = float(np.ptp(y)) ** 2 + 1e-300
    while excess(top) > 0:
        top *= 4
    variance = float(brentq(excess, 0.0, top)) if excess(0.0) > 0 else 0.0
    w = 1 / (s**2 + variance)
    centre, mean = float(np.average(x, weights=w)), float(np.average(y, weights=w))
    spread = float(w @ (x - centre) ** 2)
    slope, error = float(w @ ((x - centre) * y)) / spread, spread**-0.5
    p = 2 * float(student.sf(abs(slope) / error, dof))
    return DriftLine(mean, slope, centre, float(w.sum()) ** -0.5, error, variance**0.5, dof, p)


def _squares(x: Array, y: Array, variance: Array) -> float:
    """Weighted squares of the residuals of a line."""
    w = 1 / variance
    x, y = x - np.average(x, weights=w), y - np.average(y, weights=w)
    slope = (w @ (x * y)) / (w @ x**2)
    return float(w @ (y - slope * x) ** 2)


def look_level(times: tuple[float, ...], level: float) -> float:
    """The p-value of a look at which an alarm is raised, so that a history of these logs has one by chance at `level`.

    Parameters
    ----------
    times : tuple of float
        Of all logs of the history, those to come too [any unit]; the first look is after the fourth.
    level : float
        Share of histories without a drift in which any look raises an alarm [1].
    """
    return float(np.quantile(_smallest(times), level))


def power(times: tuple[float, ...], drift: float, level: float) -> Array:
    """The probability that a drift is seen with each log or an earlier one.

    Parameters
    ----------
    times : tuple of float
    drift : float
        By time, in standard deviations of an estimate about its line: its error and the scatter together.
    level : float
        As `look_level` gives it.

    Returns
    -------
    ndarray, shape (n,)
    """
    seen = np.minimum.accumulate(_p_values(times, drift, HISTORIES // 4), axis=1) <= level
    return np.asarray(np.concatenate([np.zeros(MIN_LOGS - 1), seen.mean(axis=0)]))


@lru_cache(maxsize=32)
def _smallest(times: tuple[float, ...]) -> Array:
    return np.asarray(_p_values(times, 0.0, HISTORIES).min(axis=1))


def _p_values(times: tuple[float, ...], drift: float, count: int) -> Array:
    """The p-values of each look of drawn histories, shape (count, n - 3), by running sums."""
    x = np.asarray(times) - times[0]
    y = drift * x + np.random.default_rng(0).standard_normal((count, len(x)))
    n = np.arange(1, len(x) + 1)
    sx, sy = np.cumsum(x), np.cumsum(y, axis=1)
    xx = np.cumsum(x**2) - sx**2 / n
    xy, yy = np.cumsum(x * y, axis=1) - sx * sy / n, np.cumsum(y**2, axis=1) - sy**2 / n
    late = slice(MIN_LOGS - 1, None)
    slope = xy[:, late] / xx[late]
    left = np.maximum(yy[:, late] - slope * xy[:, late], 0) / (n[late] - 2)
    return np.asarray(2 * student.sf(np.abs(slope) / np.sqrt(left / xx[late]), n[late] - 2))
