"""Filtered motion and channels of a log, from which the starts of an identification read states and rates."""

import math

import numpy as np
from scipy.signal import savgol_filter

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.trajectories import Trajectory

# Spread of the steps [1], over the usual one, that the filter takes as even: above, derivatives of a log that lacks
# samples are wrong; below, every log with jitter is resampled.
MAX_JITTER = 0.5
# Windows of the Savitzky-Golay filter of order 3 that are tried [s]: shorter ones leave noise in the acceleration,
# longer ones flatten stick and slip of a light load.
FILTER_TIMES = (0.031, 0.021, 0.015, 0.011, 0.007)


def filter_motion(measured: Trajectory, window: float = FILTER_TIMES[0]) -> tuple[Array, Array, Array]:
    """Filtered position [m], speed [m/s] and acceleration [m/s^2], from whichever of position and speed is logged."""
    require(
        "position" in measured or "speed" in measured,
        "the log has neither 'position' nor 'speed', without which friction is unidentifiable; log one of them",
        LogError,
    )
    if "position" in measured:
        name, order = ("speed", 0) if "speed" in measured else ("position", 1)
        position, acceleration = (filter_channel(measured, "position", k, window) for k in (0, 2))
        return position, filter_channel(measured, name, order, window), acceleration
    speed, acceleration = (filter_channel(measured, "speed", k, window) for k in (0, 1))
    return np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(measured.t))]), speed, acceleration


def filter_channel(measured: Trajectory, name: str, derivative: int, window: float = FILTER_TIMES[0]) -> Array:
    """Channel, or its derivative by time, by a Savitzky-Golay filter; missing and uneven samples are interpolated."""
    steps = np.diff(measured.t)
    step = float(np.median(steps))
    if np.ptp(steps) > MAX_JITTER * step:
        grid = np.linspace(measured.t[0], measured.t[-1], math.ceil(measured.duration / step) + 1)
        even = Trajectory(grid, {name: np.interp(grid, measured.t, measured.fill_gaps(name))})
        return np.interp(measured.t, grid, filter_channel(even, name, derivative, window))
    samples = max(5, 2 * round(window / step / 2) + 1)
    samples = min(samples, (len(measured) - 1) // 2 * 2 + 1)
    column = measured.fill_gaps(name)
    return np.asarray(savgol_filter(column, samples, min(3, samples - 1), deriv=derivative, delta=step))
