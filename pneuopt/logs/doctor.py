"""`examine`: faults that a log shows without a model: units, signs, zero points, sampling, missing motion."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE

MEAN_BLOCKS = 20
"""Blocks of a log whose means separate motion from noise: with more their means are noisy, with fewer hide motion."""
MIN_PRESSURE_RATIO = 0.3
"""Lowest pressure over the atmosphere [1] that counts as absolute: no chamber is exhausted further. A lower bound
lets gauge readings pass, a higher one refuses sensors with an offset."""
MAX_NET_TRAVEL_SHARE = 0.3
"""Net travel over path [1] up to which a log counts as one that returns: higher blames lifts, lower skips most logs."""
MIN_WORK_SHARE = -0.2
"""Work over the integral of the absolute power [1] below which the sign is wrong: nearer to zero, noise is blamed."""
ROD_AREA_RATIOS = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)
"""Areas of the rod's side over the other's [1]: one of these is near for real cylinders; more hide wrong signs."""
SPEED_SLOPE_RATIOS = (0.8, 1.25)
"""Speed over the position's slope [1] that passes: wider lets wrong units pass, narrower refuses filtered speeds."""
MAX_COMMAND_LAG = 0.1
"""Time [s] within which a drive's speed follows its valve: longer finds chance correlations, shorter misses drives."""
WRONG_SIGN_CORRELATIONS = (-0.6, 0.3)
"""The sign is wrong if the least correlation of command and speed is below the first, the largest below the second."""
RECIPROCATING_TRAVEL_RATIO = 1.9
"""Travel over range [1]: at 2 a piston has come back, so it is commanded; a lower bound blames overshoot."""
CLIPPED_SHARE = 0.02
"""Share of samples at the largest value [1] that looks clipped: lower blames rest, higher misses short clipping."""


class AxisChannels(NamedTuple):
    """The channels of the axis that a log is of: a piston's unless a plant names its own (angle, torque).

    Attributes
    ----------
    position, speed : str
    push : str
        The force or torque that drives the axis, positive in the direction of positive speed.
    """

    position: str = "position"
    speed: str = "speed"
    push: str = "force"


PISTON_CHANNELS = AxisChannels()


@dataclass(frozen=True)
class Finding:
    """One thing about a log.

    Attributes
    ----------
    channel : str
    message : str
        What is found, with figures, and the remedy.
    fault : bool
        The log cannot be used so; otherwise it is worth knowing.
    """

    channel: str
    message: str
    fault: bool


def examine(experiment: Experiment, axis: AxisChannels = PISTON_CHANNELS) -> tuple[Finding, ...]:
    """Find faults of a log before any model is fitted to it.

    Parameters
    ----------
    experiment : Experiment
        Its noise, where given, separates motion from noise.
    axis : AxisChannels
        What the log calls its motion and what drives it.

    Returns
    -------
    tuple of Finding
        Faults first: nothing moves; a channel is constant; position and speed disagree in sign or unit; the force, or
        the pressures, brake the motion on balance, which no drive does; the piston runs against the valve's command, or
        to and fro without one; a pressure is a vacuum, or above the supply.
        Then notes: jitter, a clipped sensor, a coarse resolution.

    Examples
    --------
    >>> t = np.arange(2000) * 1e-3
    >>> swing = {"position": 0.1 * np.sin(6 * t), "force": 5.0 * np.cos(6 * t)}
    >>> examine(Experiment(Trajectory(t, swing)))
    ()
    >>> print(examine(Experiment(Trajectory(t, {**swing, "force": -swing["force"]})))[0].message)
    the force brakes the motion on balance (-100 % of its power), which no drive does: change the sign of 'force'
    """
    log = experiment.trajectory
    checks = (
        *(_check_has_motion(experiment, axis), _check_position_speed(log, axis), _check_work_sign(log, axis)),
        *(_check_command(log, axis), _check_pressures(experiment), _check_sampling(log, axis)),
    )
    found = [finding for check in checks for finding in check]
    return tuple(sorted(found, key=lambda f: not f.fault))


def _check_has_motion(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find channels without motion."""
    for name in (axis.position, axis.speed):
        if name not in experiment.trajectory:
            continue
        y = experiment.trajectory[name]
        y, noise = y[np.isfinite(y)], experiment.noise.get(name, 0.0)
        if y.size and not np.any(np.diff(y)) and (name == axis.position or y[0] == 0):
            yield Finding(name, f"{name!r} is constant: without motion friction is unidentifiable", True)
        elif y.size >= 2 * MEAN_BLOCKS and (_is_motionless(y, noise) or (name == axis.position and _is_white(y))):
            message = f"{name!r} shows noise and no motion: log a run in which the drive moves"
            yield Finding(name, message, True)


def _is_motionless(y: Array, noise: float) -> bool:
    """Whether a channel, and its block means, vary by no more than its noise."""
    size = y.size // MEAN_BLOCKS
    means = y[: MEAN_BLOCKS * size].reshape(MEAN_BLOCKS, size).mean(axis=1)
    return float(means.std()) < 3 * noise / math.sqrt(size) and float(y.std()) < 2 * noise


def _is_white(y: Array) -> bool:
    """Whether neighbouring samples are uncorrelated, which the position of a moving mass never is."""
    e = y - y.mean()
    return abs(float(e[1:] @ e[:-1])) < 3 / math.sqrt(e.size) * float(e @ e)


def _check_position_speed(log: Trajectory, axis: AxisChannels) -> Iterator[Finding]:
    """Find a speed that is not the slope of the position, in sign or in unit."""
    if axis.position not in log or axis.speed not in log:
        return
    slope, speed = _position_slope(log, axis), log[axis.speed]
    known = np.isfinite(slope) & np.isfinite(speed)
    slope, speed = slope[known], speed[known]
    power = math.sqrt(float(slope @ slope) * float(speed @ speed))
    if power == 0 or abs(slope @ speed) < 0.7 * power:
        return
    ratio = float(speed @ slope) / float(slope @ slope)
    if ratio < 0:
        message = f"{axis.position} and {axis.speed} run against each other: change the sign of one"
        yield Finding(axis.speed, message, True)
    elif not SPEED_SLOPE_RATIOS[0] < ratio < SPEED_SLOPE_RATIOS[1]:
        message = f"{axis.speed} is {ratio:.3g} times the slope of the {axis.position}: check both units"
        yield Finding(axis.speed, message, True)


def _check_work_sign(log: Trajectory, axis: AxisChannels) -> Iterator[Finding]:
    """Find a force, torque or pressures of the wrong sign: a drive does net work on a load that comes back."""
    motion = _motion_speed(log, axis)
    if motion is None:
        return
    drives = {axis.push: (f"the {axis.push} brakes", f"'{axis.push}'")}
    if "pressure_a" in log and "pressure_b" in log:
        drives["pressures"] = ("the pressures brake", "the position, or exchange pressure_a and pressure_b")
    for name, (message, remedy) in drives.items():
        if name == axis.push and name not in log:
            continue
        if name == axis.push:
            share = _work_share(log.t, log[name], motion, centred=False)
        else:
            pushes = (log["pressure_a"] - ratio * log["pressure_b"] for ratio in ROD_AREA_RATIOS)
            share = max(_work_share(log.t, push, motion, centred=True) for push in pushes)
        if share < MIN_WORK_SHARE:
            why = f"{message} the motion on balance ({100 * share:.0f} % of its power), which no drive does"
            yield Finding(name, f"{why}: change the sign of {remedy}", True)


def _check_command(log: Trajectory, axis: AxisChannels) -> Iterator[Finding]:
    """Find a piston that runs against its valve's command, or without one."""
    motion = _motion_speed(log, axis)
    if motion is None or "valve_voltage" not in log:
        return
    known = np.isfinite(motion) & np.isfinite(log["valve_voltage"])
    t, command, motion = log.t[known], log["valve_voltage"][known], motion[known]
    if len(t) < 2 * MEAN_BLOCKS:
        return
    if not np.any(np.diff(command)):
        travel = np.cumsum(motion[1:] * np.diff(t))[
            :: max(1, len(t) // (5 * MEAN_BLOCKS))
        ]  # coarse: noise is no travel
        if float(np.abs(np.diff(travel)).sum()) > RECIPROCATING_TRAVEL_RATIO * float(np.ptp(travel)) > 0:
            message = "'valve_voltage' is constant while the piston goes to and fro: log the command that moves it"
            yield Finding("valve_voltage", message, True)
        return
    lowest, highest = _command_correlations(t, command, motion)
    if lowest < WRONG_SIGN_CORRELATIONS[0] and highest < WRONG_SIGN_CORRELATIONS[1]:
        message = f"the piston runs against the valve's command (correlation {lowest:.2f}): change the sign of "
        yield Finding("valve_voltage", message + "'valve_voltage', or of the motion", True)


def _command_correlations(t: Array, command: Array, motion: Array) -> tuple[float, float]:
    """Least and largest correlation of a speed with the command up to `MAX_COMMAND_LAG` before; NaN at rest."""
    grid = np.linspace(t[0], t[-1], t.size)
    u, v = np.interp(grid, t, command), np.interp(grid, t, motion)
    most = min(round(MAX_COMMAND_LAG / float(grid[1] - grid[0])), t.size // 4)
    lags = range(0, most + 1, max(1, most // MEAN_BLOCKS))
    if np.ptp(v) == 0 or any(np.ptp(u[: u.size - k]) == 0 for k in lags):
        return math.nan, math.nan
    found = [float(np.corrcoef(u[: u.size - k], v[k:])[0, 1]) for k in lags]
    return min(found), max(found)


def _work_share(t: Array, push: Array, motion: Array, *, centred: bool) -> float:
    """Work over the integral of the power's absolute value; NaN where the log does not return to its beginning."""
    known = np.isfinite(push) & np.isfinite(motion)
    if known.sum() < 10:
        return math.nan
    t, push, motion = t[known], push[known], motion[known]
    path = float(np.trapezoid(np.abs(motion), t))
    if path == 0 or abs(float(np.trapezoid(motion, t))) > MAX_NET_TRAVEL_SHARE * path:
        return math.nan
    power = (push - push.mean() if centred else push) * motion
    total = float(np.trapezoid(np.abs(power), t))
    return float(np.trapezoid(power, t)) / total if total > 0 else math.nan


def _check_pressures(experiment: Experiment) -> Iterator[Finding]:
    """Find wrong zero points: gauge pressures taken for absolute ones, or the reverse."""
    log = experiment.trajectory
    supply = experiment.conditions.get("supply.pressure")
    if supply is None and "supply_pressure" in log:
        supply = float(np.nanmedian(log["supply_pressure"]))
    for name in ("pressure_a", "pressure_b", "supply_pressure"):
        if name not in log:
            continue
        low, high = (float(np.nanpercentile(log[name], q)) for q in (1, 99))
        if low < MIN_PRESSURE_RATIO * ATMOSPHERE:
            message = f"{name!r} falls to {low / 1e5:.2f} bar(a), a vacuum; a gauge sensor's unit is written bar(g)"
            yield Finding(name, message, True)
        elif supply is not None and high > 1.1 * supply and name != "supply_pressure":
            message = f"{name!r} rises to {high / 1e5:.2f} bar(a), above the supply of {supply / 1e5:.2f} bar(a)"
            yield Finding(name, f"{message}; is an absolute sensor read as bar(g)?", True)


def _check_sampling(log: Trajectory, axis: AxisChannels) -> Iterator[Finding]:
    """Find jitter, clipping and coarse resolution."""
    steps = np.diff(log.t)
    usual = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - usual))) * 1.4826
    if jitter > 0.05 * usual:
        yield Finding("time", f"the samples jitter by {jitter / usual:.0%} of {usual:g} s; their times are used", False)
    for name in log:
        y = log[name][np.isfinite(log[name])]
        levels = np.unique(y).size
        for end, which in ((y.max(initial=-np.inf), "largest"), (y.min(initial=np.inf), "smallest")):
            share = float(np.mean(y == end)) if y.size else 0.0
            if name.startswith("pressure") and levels > 50 and share > CLIPPED_SHARE:
                message = (
                    f"{share:.0%} of the samples of {name!r} have exactly its {which} value: is the sensor clipped?"
                )
                yield Finding(name, message, False)
        if name in (axis.position, axis.speed) and 2 < levels < min(50, y.size // 4):
            message = f"{name!r} has only {levels} levels, the resolution is coarse for the motion"
            yield Finding(name, message, False)


def _motion_speed(log: Trajectory, axis: AxisChannels) -> Array | None:
    """The speed as logged, else the slope of the position; None without either."""
    return log[axis.speed] if axis.speed in log else _position_slope(log, axis) if axis.position in log else None


def _position_slope(log: Trajectory, axis: AxisChannels) -> Array:
    """Speed from the position over a window of a hundredth of the log, at least five samples."""
    half = max(2, len(log) // 200)
    t, y = log.t, log[axis.position]
    slope = np.full(len(t), np.nan)
    slope[half:-half] = (y[2 * half :] - y[: -2 * half]) / (t[2 * half :] - t[: -2 * half])
    return slope
