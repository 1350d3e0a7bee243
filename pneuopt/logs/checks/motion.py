"""The motion of a log as closely as its noise allows, and how two sensors of it agree at a lag."""

import math

import numpy as np

from pneuopt.logs.checks.findings import Panel, StatedAxis
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array

MEAN_BLOCKS = 20
"""Blocks of a log whose means separate motion from noise: with more their means are noisy, with fewer hide motion."""
MAX_SENSOR_LAG = 0.02
"""Time [s] by which one sensor may come later than another: shorter takes a filter's lag in fast motion for a wrong
sign, longer misses wrong signs of motion at a few hertz."""
MAX_SLOPE_NOISE_SHARE = 0.1
"""Share of a slope's variance [1] that noise may have: higher drowns the work in it, lower blurs fast motion."""


def motion_speed(experiment: Experiment, axis: StatedAxis) -> Array | None:
    """The speed as logged, else the slope of the position; None without either, or where noise hides the motion."""
    log = experiment.trajectory
    if axis.speed in log:
        return log[axis.speed]
    if axis.position not in log:
        return None
    known = np.isfinite(log[axis.position])
    half = slope_half_width(log.t[known], log[axis.position][known], experiment.noise.get(axis.position))
    return None if half is None else position_slope(log.t, log[axis.position], half)


def speed_panel(experiment: Experiment, axis: StatedAxis, motion: Array) -> Panel:
    """The panel of a speed from `motion_speed`, by the name of what it is."""
    name = axis.speed if axis.speed in experiment.trajectory else f"slope of the {axis.position}"
    return Panel(experiment.unit(axis.speed), {name: motion})


def slope_half_width(t: Array, x: Array, noise: float | None) -> int | None:
    """The narrowest half width [samples] over which a slope shows motion and hardly noise; None where none does.

    It depends on the noise and not on the length of the log: a window that is longer than a cycle turns its sign round.
    """
    if t.size < 2 * MEAN_BLOCKS:
        return None
    sigma = noise_level(x, t) if noise is None else noise
    half = 1
    while 4 * half < t.size:
        slope = position_slope(t, x, half)
        expected = math.sqrt(2) * sigma / (2 * half * float(np.median(np.diff(t))))
        if expected**2 < MAX_SLOPE_NOISE_SHARE * float(np.nanmean(slope**2)):
            return half
        half *= 2
    return None


def position_slope(t: Array, y: Array, half: int) -> Array:
    """Speed from the position over a window of `half` samples to both sides; NaN at the ends."""
    slope = np.full(len(t), np.nan)
    slope[half:-half] = (y[2 * half :] - y[: -2 * half]) / (t[2 * half :] - t[: -2 * half])
    return slope


def window_mean(v: Array, half: int, simpson: bool) -> Array:
    """Mean of a column from `half` samples before each sample to as many behind, by trapezoids or parabolas."""
    pieces = (v[:-2] + 4 * v[1:-1] + v[2:]) / 6 if simpson else (v[:-2] + 2 * v[1:-1] + v[2:]) / 4
    sums, out = np.zeros(v.size), np.full(v.size, np.nan)
    for first in (0, 1):  # a piece spans two steps: every other one covers the window once
        sums[2 + first :: 2] = np.cumsum(pieces[first::2])
    out[half : v.size - half] = (sums[2 * half :] - sums[: v.size - 2 * half]) / half
    return out


def sensor_lags(t: Array, count: int = 4) -> list[int]:
    """Lags [samples] between two sensors that count as one instant, as many each way as there are samples for."""
    most = min(math.ceil(MAX_SENSOR_LAG / float(np.median(np.diff(t)))), t.size // 10)
    steps = sorted({round(k * most / count) for k in range(count + 1)})
    return [*(-k for k in reversed(steps[1:])), *steps]


def shift(a: Array, b: Array, lag: int) -> tuple[Array, Array]:
    """Two columns, the second one later by a lag [samples], where both are known."""
    if lag > 0:
        a, b = a[:-lag], b[lag:]
    elif lag < 0:
        a, b = a[-lag:], b[:lag]
    known = np.isfinite(a) & np.isfinite(b)
    return a[known], b[known]


def lagged_correlation(a: Array, b: Array, lag: int) -> float:
    """The correlation about zero of two columns at a lag; 0 where one is zero."""
    a, b = shift(a, b, lag)
    power = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / power if power > 0 else 0.0


def lagged_ratio(a: Array, b: Array, lag: int) -> float:
    """The size of the second column over that of the first, by regression at a lag."""
    a, b = shift(a, b, lag)
    return float(a @ b) / float(a @ a)
