"""Statistics of a fit: agreement, confidence intervals, information criteria, tests of the residuals."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2, t

from pneuopt.quantities.arrays import Array


def agreement(measured: ArrayLike, predicted: ArrayLike) -> Mapping[str, float]:
    """Agreement of a prediction with a measurement; missing samples (NaN) do not count.

    rmse [unit of the channel]; nrmse = |error| / |measured - its mean| [1], NaN for a constant channel; fit_percent =
    100 (1 - nrmse), as in MATLAB's `compare`; samples.
    """
    y, e = np.asarray(measured, dtype=float), np.asarray(predicted, dtype=float) - np.asarray(measured, dtype=float)
    known = np.isfinite(y)
    y, e = y[known], e[known]
    spread = float(np.linalg.norm(y - y.mean())) if y.size else 0.0
    with np.errstate(over="ignore"):  # of a free run that diverged: infinitely far from the log
        nrmse = float(np.linalg.norm(e)) / spread if spread > 0 else math.nan
        rmse = float(np.sqrt(np.mean(e**2))) if y.size else math.nan
    return {"rmse": rmse, "nrmse": nrmse, "fit_percent": 100 * (1 - nrmse), "samples": float(y.size)}


def confidence_interval(
    value: float, stderr: float, *, log: bool, level: float = 0.95, dof: float = math.inf
) -> tuple[float, float]:
    """Confidence interval by Student's t; symmetric in the logarithm where the parameter is searched as one.

    Examples
    --------
    >>> low, high = confidence_interval(10.0, 1.0, log=False)
    >>> round(low, 2), round(high, 2)
    (8.04, 11.96)
    >>> round(confidence_interval(10.0, 1.0, log=False, dof=3.0)[1], 2)
    13.18
    """
    width = float(t.ppf(0.5 + level / 2, dof)) * stderr
    if log and math.isfinite(width):
        ratio = math.exp(min(width / value, 700.0))
        return value / ratio, value * ratio
    return value - width, value + width


def correlation(covariance: Array) -> Array:
    """Correlation matrix of a covariance; NaN where a variance is not positive."""
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.sqrt(np.diag(covariance))
        return np.asarray(covariance / np.outer(deviation, deviation))


def bayes_information(deviance: float, parameters: int, samples: float) -> float:
    """``deviance + k ln n``: the lower, the better a model's fit for its number of parameters (Schwarz 1978).

    Examples
    --------
    >>> round(bayes_information(100.0, 3, 1000.0), 2)
    120.72
    """
    return deviance + parameters * math.log(max(samples, 1.0))


def likelihood_ratio_p(drop: float, extra: int) -> float:
    """Probability that `extra` parameters without effect lower a deviance by `drop` or more: chi-square (Wilks 1938).

    Examples
    --------
    >>> round(likelihood_ratio_p(3.841, 1), 3)
    0.05
    """
    return float(chi2.sf(max(drop, 0.0), extra))


def ljung_box(residuals: ArrayLike, lags: int = 20) -> tuple[float, float]:
    """Ljung-Box test of whiteness: Q = n (n + 2) sum of rho_k^2 / (n - k), and the probability of so large a one.

    Chi-square with `lags` degrees of freedom (Ljung, Box, Biometrika 65, 1978); missing samples (NaN) do not count.

    Examples
    --------
    >>> q, p = ljung_box(np.random.default_rng(0).standard_normal(500))
    >>> p > 0.05, ljung_box(np.cumsum(np.ones(50)))[1] < 1e-6
    (True, True)
    """
    e = np.asarray(residuals, dtype=float)
    e = e[np.isfinite(e)]
    e, n = e - e.mean(), e.size
    if n <= lags + 1 or not np.any(e):
        return math.nan, math.nan
    k = np.arange(1, lags + 1)
    rho = np.array([e[: n - j] @ e[j:] for j in k]) / (e @ e)
    q = float(n * (n + 2) * np.sum(rho**2 / (n - k)))
    return q, float(chi2.sf(q, lags))


def cross_correlation(residuals: ArrayLike, command: ArrayLike, lags: int = 20) -> tuple[float, int]:
    """Largest correlation of residuals with an earlier input and its lag in samples, 0 to `lags`.

    In standard deviations without a relation, ``1 / sqrt(n)`` for white residuals: beyond about 3 the model lacks an
    effect of the input.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> u = rng.standard_normal(1000)
    >>> size, lag = cross_correlation(0.3 * np.roll(u, 4) + rng.standard_normal(1000), u)
    >>> size > 5, lag
    (True, 4)
    """
    e, u = np.asarray(residuals, dtype=float), np.asarray(command, dtype=float)
    known = np.isfinite(e) & np.isfinite(u)
    e, u = np.where(known, e - np.mean(e[known]), 0.0), np.where(known, u - np.mean(u[known]), 0.0)
    spread = math.sqrt(float(e @ e) * float(u @ u))
    if spread == 0:
        return math.nan, 0
    n = int(known.sum())
    rho = np.array([e[k:] @ u[: len(u) - k] for k in range(min(lags, n - 2) + 1)]) / spread
    lag = int(np.argmax(np.abs(rho)))
    return float(abs(rho[lag]) * math.sqrt(n)), lag
