"""`check_has_motion`, `check_scale`: a log in which nothing moves, or faster than any drive."""

import math
from collections.abc import Iterator

import numpy as np

from pneuopt.logs.checks.findings import PISTON, Evidence, LogFinding, Panel, StatedAxis, evidence
from pneuopt.logs.checks.motion import MEAN_BLOCKS, motion_speed
from pneuopt.logs.checks.signs import MIN_SPEED_CORRELATION
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import find_resolution
from pneuopt.quantities.arrays import Array

MAX_WHITE_LAG = 20
"""Lags [samples] that white noise leaves uncorrelated: with one, motion at a quarter of the rate looks white."""
STILL_STEPS = 2.0
"""Range at rest in steps of the resolution [1]: more takes small motion for rest, fewer flicker for motion."""
MAX_PISTON_SPEED = 50.0
"""Speed [m/s] that no piston or linear servo has; lower blames fast ones, higher misses slow ones in mm."""


def check_has_motion(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find channels without motion."""
    for name in (axis.position, axis.speed):
        if name not in experiment.trajectory:
            continue
        y = experiment.trajectory[name]
        y, noise = y[np.isfinite(y)], experiment.noise.get(name, 0.0)
        if y.size and not np.any(np.diff(y)) and (name == axis.position or y[0] == 0):
            message = f"{name!r} is constant: without motion friction is unidentifiable"
            yield LogFinding(name, message, True, evidence=_stillness(experiment, name, axis))
        elif y.size >= 2 * MEAN_BLOCKS and (_is_motionless(y, noise) or (name == axis.position and _is_white(y))):
            message = f"{name!r} shows noise and no motion: log a run in which the drive moves"
            yield LogFinding(name, message, True, evidence=_stillness(experiment, name, axis))


def check_scale(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find motion of a size that no drive has, as millimetres that are read as metres."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    fastest = 0.0 if motion is None else float(np.nanpercentile(np.abs(motion), 99))
    if axis.position == PISTON.position and fastest > MAX_PISTON_SPEED:
        name = axis.speed if axis.speed in log else axis.position
        size = np.zeros(len(log)) if motion is None else np.abs(motion)
        speeds = Panel("m/s", {"speed": size, "no piston is faster": np.full(size.size, MAX_PISTON_SPEED)})
        shown = evidence(experiment, speeds, where=size > MAX_PISTON_SPEED, at=int(np.nanargmax(size)), motion=motion)
        message = f"{name!r} moves at {fastest:.3g} m/s: is its unit mm, and read as m?"
        yield LogFinding(name, message, True, evidence=shown)


def _stillness(experiment: Experiment, name: str, axis: StatedAxis) -> Evidence:
    """A channel without motion beside what should move it."""
    drives = [n for n in (axis.push, "valve_voltage", "pressure_a") if n in experiment.trajectory]
    return evidence(experiment, name, *drives[:1])


def _is_motionless(y: Array, noise: float) -> bool:
    """Whether a channel, and its block means, vary by no more than its noise, which has no rhythm."""
    size = y.size // MEAN_BLOCKS
    means = y[: MEAN_BLOCKS * size].reshape(MEAN_BLOCKS, size).mean(axis=1)
    is_small = float(means.std()) < 3 * noise / math.sqrt(size) and float(y.std()) < 2 * noise
    flickers = float(np.ptp(y)) <= STILL_STEPS * find_resolution(y)
    return is_small and (flickers or float(np.max(np.abs(_autocorrelation(y)))) < MIN_SPEED_CORRELATION)


def _is_white(y: Array) -> bool:
    """Whether samples are uncorrelated, which the position of a moving mass never is."""
    return bool(np.max(np.abs(_autocorrelation(y))) < 4 / math.sqrt(y.size))


def _autocorrelation(y: Array) -> Array:
    """The correlation of samples at each lag up to `MAX_WHITE_LAG`."""
    e = y - y.mean()
    power = float(e @ e)
    if power == 0:
        return np.zeros(1)
    return np.array([float(e[k:] @ e[:-k]) / power for k in range(1, min(MAX_WHITE_LAG, y.size - 1) + 1)])
