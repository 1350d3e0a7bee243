"""What a fit is worth: confidence intervals, noise levels, agreement of a prediction with a measurement."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

Array = NDArray[np.float64]


def agreement(measured: ArrayLike, predicted: ArrayLike) -> Mapping[str, float]:
    """How well a prediction follows a measurement; missing samples (NaN) do not count.

    Parameters
    ----------
    measured, predicted : array_like, shape (n,)

    Returns
    -------
    mapping
        rmse [unit of the channel]; nrmse = |error| / |measured - its mean| [1]; fit_percent = 100 (1 - nrmse), as in
        MATLAB's `compare`; samples. NRMSE is NaN for a constant channel.

    Examples
    --------
    >>> agreement([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 2.0])["rmse"]
    0.5
    """
    y, e = np.asarray(measured, dtype=float), np.asarray(predicted, dtype=float) - np.asarray(measured, dtype=float)
    known = np.isfinite(y)
    y, e = y[known], e[known]
    spread = float(np.linalg.norm(y - y.mean())) if y.size else 0.0
    nrmse = float(np.linalg.norm(e)) / spread if spread > 0 else math.nan
    rmse = float(np.sqrt(np.mean(e**2))) if y.size else math.nan
    return {"rmse": rmse, "nrmse": nrmse, "fit_percent": 100 * (1 - nrmse), "samples": float(y.size)}


def noise_level(column: ArrayLike, t: ArrayLike | None = None) -> float:
    """Estimate white noise from how far samples lie off the line of their neighbours; the resolution is the floor.

    Parameters
    ----------
    column : array_like, shape (n,)
        NaN where a sample is missing.
    t : array_like, shape (n,), optional
        Time [s], where the samples are not evenly spaced.

    Returns
    -------
    float
        Standard deviation [unit of the channel]: 1.4826 MAD of those distances, each over its own deviation for unit
        noise, which motion slower than the sampling hardly touches; at least q / sqrt(12), with q the smallest
        difference between two samples. NaN for a constant channel, which shows none.

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
    off = _off_line(time, column)  # not across a hole, as long as some samples have both neighbours
    off = off[np.isfinite(off)] if np.isfinite(off).any() else _off_line(time[known], column[known])
    random = 1.4826 * float(np.median(np.abs(off - np.median(off)))) if off.size else 0.0
    resolution = float(np.min(steps[steps > 1e-9 * np.max(steps)])) / math.sqrt(12)
    return max(random, resolution)


def _off_line(t: Array, y: Array) -> Array:
    """Distance of inner samples from the line through their neighbours, scaled to the noise of one sample."""
    left = (t[2:] - t[1:-1]) / (t[2:] - t[:-2])
    distance = y[1:-1] - left * y[:-2] - (1 - left) * y[2:]
    return np.asarray(distance / np.sqrt(1 + left**2 + (1 - left) ** 2))


def correlation_time(residuals: ArrayLike) -> float:
    """Samples that count as one where residuals are correlated: 1 + 2 (rho_1 + rho_2 + ...), up to the first rho <= 0.

    Parameters
    ----------
    residuals : array_like, shape (n,)
        NaN where a sample is missing.

    Returns
    -------
    float
        1 for white residuals: if rho_1 is below 3 / sqrt(n), nothing is summed. The variance of an estimate from n
        correlated samples is this much larger (Geyer, Statistical Science 7(4), 1992, for the truncation).

    Examples
    --------
    >>> correlation_time(np.random.default_rng(1).standard_normal(1000))
    1.0
    """
    e = np.asarray(residuals, dtype=float)
    e = e[np.isfinite(e)]
    n = e.size
    if n < 10 or not np.any(e - e.mean()):
        return 1.0
    spectrum = np.abs(np.fft.rfft(e - e.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[1 : n // 2]
    rho = rho / (spectrum[0] + 2 * spectrum[1:-1].sum() + spectrum[-1]) * (2 * n)
    if rho[0] < 3 / math.sqrt(n):
        return 1.0
    negative = np.flatnonzero(rho <= 0)
    return float(1 + 2 * rho[: negative[0] if negative.size else rho.size].sum())


def confidence_interval(value: float, stderr: float, *, log: bool, level: float = 0.95) -> tuple[float, float]:
    """Normal confidence interval; symmetric in the logarithm where the parameter was searched so.

    Examples
    --------
    >>> low, high = confidence_interval(10.0, 1.0, log=False)
    >>> round(low, 2), round(high, 2)
    (8.04, 11.96)
    """
    width = float(norm.ppf(0.5 + level / 2)) * stderr
    if log and math.isfinite(width):
        ratio = math.exp(min(width / value, 700.0))
        return value / ratio, value * ratio
    return value - width, value + width


def correlation(covariance: Array) -> Array:
    """Correlation matrix of a covariance; NaN where a variance is not positive."""
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.sqrt(np.diag(covariance))
        return np.asarray(covariance / np.outer(deviation, deviation))
