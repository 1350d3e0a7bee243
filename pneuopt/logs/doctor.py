"""`examine`: faults that a log shows without a model: units, signs, zero points, sampling, missing motion."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array
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
SPEED_SLOPE_RATIOS = (0.5, 2.0)
"""Speed over the position's slope [1] that passes: wider lets wrong units pass, inches for centimetres say; narrower
refuses filtered speeds of fast motion."""
MIN_SPEED_CORRELATION = 0.7
"""Correlation [1] of speed and slope from which they are compared: lower compares noise, higher misses short motion."""
MAX_SENSOR_LAG = 0.02
"""Time [s] by which one sensor may come later than another: shorter takes a filter's lag in fast motion for a wrong
sign, longer misses wrong signs of motion at a few hertz."""
MAX_SLOPE_NOISE_SHARE = 0.1
"""Share of a slope's variance [1] that noise may have: higher drowns the work in it, lower blurs fast motion."""
MAX_WHITE_LAG = 20
"""Lags [samples] that white noise leaves uncorrelated: with one, motion at a quarter of the rate looks white."""
STILL_STEPS = 2.0
"""Range at rest in steps of the resolution [1]: more takes small motion for rest, fewer flicker for motion."""
MAX_COMMAND_LAG = 0.1
"""Time [s] within which a drive's speed follows its valve: longer finds chance correlations, shorter misses drives."""
WRONG_SIGN_CORRELATIONS = (-0.6, 0.3)
"""The sign is wrong if the least correlation of command and speed is below the first, the largest below the second."""
RECIPROCATING_TRAVEL_RATIO = 1.9
"""Travel over range [1]: at 2 a piston has come back, so it is commanded; a lower bound blames overshoot."""
MAX_PISTON_SPEED = 50.0
"""Speed [m/s] that no piston or linear servo has; lower blames fast ones, higher misses slow ones in mm."""
MAX_PRESSURE = 1e7
"""Pressure [Pa] that no pneumatic drive has, 100 bar; lower blames blow moulding, higher misses units."""
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
    check : str
        The name of the check that found it, by which a user accepts it.
    """

    channel: str
    message: str
    fault: bool
    check: str = ""


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
    >>> from pneuopt.quantities.trajectories import Trajectory
    >>> t = np.arange(2000) * 1e-3
    >>> swing = {"position": 0.1 * np.sin(6 * t), "force": 5.0 * np.cos(6 * t)}
    >>> examine(Experiment(Trajectory(t, swing)))
    ()
    >>> finding = examine(Experiment(Trajectory(t, {**swing, "force": -swing["force"]})))[0]
    >>> print(finding.check, finding.message.partition("(")[0], finding.message.partition(": ")[2], sep="; ")
    work; the force brakes the motion on balance ; change the sign of 'force'
    """
    found = [replace(f, check=name) for name, check in CHECKS.items() for f in check(experiment, axis)]
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
    """Whether a channel, and its block means, vary by no more than its noise, which has no rhythm."""
    size = y.size // MEAN_BLOCKS
    means = y[: MEAN_BLOCKS * size].reshape(MEAN_BLOCKS, size).mean(axis=1)
    is_small = float(means.std()) < 3 * noise / math.sqrt(size) and float(y.std()) < 2 * noise
    flickers = float(np.ptp(y)) <= STILL_STEPS * math.sqrt(12) * noise
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


def _check_position_speed(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find a speed that is not the slope of the position, in sign or in unit."""
    log = experiment.trajectory
    if axis.position not in log or axis.speed not in log:
        return
    known = np.isfinite(log[axis.position]) & np.isfinite(log[axis.speed])
    t, x, v = log.t[known], log[axis.position][known], log[axis.speed][known]
    half = _slope_half_width(t, x, experiment.noise.get(axis.position))
    if half is None:
        return
    slope, means = _slope(t, x, half), [_window_mean(v, half, simpson) for simpson in (False, True)]
    found = {lag: _lagged_correlation(slope, means[0], lag) for lag in _lags(t)}
    best = max(found, key=found.__getitem__)
    if found[best] < -MIN_SPEED_CORRELATION / 2 and min(found.values()) < -MIN_SPEED_CORRELATION:
        i = int(np.nanargmax(np.abs(slope)))
        seen = f"at {t[i]:.4g} s {axis.position} changes by {slope[i]:.3g}/s, {axis.speed} is {means[0][i]:.3g}"
        message = f"{axis.position} and {axis.speed} run against each other ({seen}): change the sign of one"
        yield Finding(axis.speed, message, True)
    elif found[best] > MIN_SPEED_CORRELATION:
        ratios = [_lagged_ratio(slope, mean, best) for mean in means]
        # trapezoids and parabolas through the speed err in opposite directions where its samples are far apart
        if max(ratios) < SPEED_SLOPE_RATIOS[0] or min(ratios) > SPEED_SLOPE_RATIOS[1]:
            message = f"{axis.speed} is {ratios[0]:.3g} times the slope of the {axis.position}: check both units"
            yield Finding(axis.speed, message, True)


def _lags(t: Array) -> list[int]:
    """Lags [samples] between two sensors that count as one instant, both ways."""
    most = min(math.ceil(MAX_SENSOR_LAG / float(np.median(np.diff(t)))), t.size // 10)
    steps = sorted({round(k * most / 4) for k in range(5)})
    return [*(-k for k in reversed(steps[1:])), *steps]


def _shift(a: Array, b: Array, lag: int) -> tuple[Array, Array]:
    """Two columns, the second one later by a lag [samples], where both are known."""
    if lag > 0:
        a, b = a[:-lag], b[lag:]
    elif lag < 0:
        a, b = a[-lag:], b[:lag]
    known = np.isfinite(a) & np.isfinite(b)
    return a[known], b[known]


def _lagged_correlation(a: Array, b: Array, lag: int) -> float:
    """The correlation about zero of two columns at a lag; 0 where one is zero."""
    a, b = _shift(a, b, lag)
    power = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / power if power > 0 else 0.0


def _lagged_ratio(a: Array, b: Array, lag: int) -> float:
    """The size of the second column over that of the first, by regression at a lag."""
    a, b = _shift(a, b, lag)
    return float(a @ b) / float(a @ a)


def _window_mean(v: Array, half: int, simpson: bool) -> Array:
    """Mean of a column from `half` samples before each sample to as many behind, by trapezoids or parabolas."""
    pieces = (v[:-2] + 4 * v[1:-1] + v[2:]) / 6 if simpson else (v[:-2] + 2 * v[1:-1] + v[2:]) / 4
    sums, out = np.zeros(v.size), np.full(v.size, np.nan)
    for first in (0, 1):  # a piece spans two steps: every other one covers the window once
        sums[2 + first :: 2] = np.cumsum(pieces[first::2])
    out[half : v.size - half] = (sums[2 * half :] - sums[: v.size - 2 * half]) / half
    return out


def _check_work_sign(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find a force, torque or pressures of the wrong sign: a drive does net work on a load that comes back."""
    log, motion = experiment.trajectory, _motion_speed(experiment, axis)
    if motion is None:
        return
    drives = {axis.push: (f"the {axis.push} brakes", f"'{axis.push}'")}
    if "pressure_a" in log and "pressure_b" in log:
        drives["pressures"] = ("the pressures brake", "the position, or exchange pressure_a and pressure_b")
    for name, (message, remedy) in drives.items():
        if name == axis.push and name not in log:
            continue
        if name == axis.push:
            pushes = [log[name]]
        else:
            pushes = [log["pressure_a"] - ratio * log["pressure_b"] for ratio in ROD_AREA_RATIOS]
            pushes = [push - np.nanmean(push) for push in pushes]
        share = max(_work_share(log.t, push, motion, lag) for push in pushes for lag in _lags(log.t))
        if share < MIN_WORK_SHARE:
            at = int(np.nanargmin(pushes[-1] * motion))
            seen = f"most at {log.t[at]:.4g} s, where {pushes[-1][at]:.3g} pushes and the speed is {motion[at]:.3g} m/s"
            why = f"{message} the motion on balance ({100 * share:.0f} % of its power, {seen}), which no drive does"
            yield Finding(name, f"{why}: change the sign of {remedy}", True)


def _check_command(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find a piston that runs against its valve's command, or without one."""
    log, motion = experiment.trajectory, _motion_speed(experiment, axis)
    if motion is None or "valve_voltage" not in log:
        return
    known = np.isfinite(motion) & np.isfinite(log["valve_voltage"])
    t, command, motion = log.t[known], log["valve_voltage"][known], motion[known]
    if len(t) < 2 * MEAN_BLOCKS:
        return
    if not np.any(np.diff(command)):
        every = max(1, len(t) // (5 * MEAN_BLOCKS))  # coarse: noise is no travel
        travel = np.cumsum(motion[1:] * np.diff(t))[::every]
        if float(np.abs(np.diff(travel)).sum()) > RECIPROCATING_TRAVEL_RATIO * float(np.ptp(travel)) > 0:
            message = "'valve_voltage' is constant while the piston goes to and fro: log the command that moves it"
            yield Finding("valve_voltage", message, True)
        return
    lowest, highest = _command_correlations(t, command, motion)
    if lowest < WRONG_SIGN_CORRELATIONS[0] and highest < WRONG_SIGN_CORRELATIONS[1]:
        at = int(np.argmax(np.abs(motion)))
        seen = f"correlation {lowest:.2f}; {motion[at]:.3g} m/s at {t[at]:.4g} s under {command[at]:.3g} V"
        message = f"the piston runs against the valve's command ({seen}): change the sign of "
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


def _work_share(t: Array, push: Array, motion: Array, lag: int) -> float:
    """Work over the integral of the power's absolute value; NaN where the log does not return to its beginning."""
    t = np.where(np.isfinite(push), t, np.nan)
    (t, _), (push, motion) = _shift(t, motion, lag), _shift(push, motion, lag)
    if t.size < 10:
        return math.nan
    path = float(np.trapezoid(np.abs(motion), t))
    if path == 0 or abs(float(np.trapezoid(motion, t))) > MAX_NET_TRAVEL_SHARE * path:
        return math.nan
    total = float(np.trapezoid(np.abs(push * motion), t))
    return float(np.trapezoid(push * motion, t)) / total if total > 0 else math.nan


def _check_pressures(experiment: Experiment, _: AxisChannels) -> Iterator[Finding]:
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
        elif high > MAX_PRESSURE:
            yield Finding(
                name, f"{name!r} rises to {high / 1e5:.3g} bar(a), more than air drives have: its unit?", True
            )
        elif supply is not None and high > 1.1 * supply and name != "supply_pressure":
            message = f"{name!r} rises to {high / 1e5:.2f} bar(a), above the supply of {supply / 1e5:.2f} bar(a)"
            yield Finding(name, f"{message}; is an absolute sensor read as bar(g)?", True)


def _check_sampling(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find jitter, clipping and coarse resolution."""
    log = experiment.trajectory
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
                message = f"{share:.0%} of {name!r} are exactly its {which} value: is the sensor clipped?"
                yield Finding(name, message, False)
        if name in (axis.position, axis.speed) and 2 < levels < min(50, y.size // 4):
            message = f"{name!r} has only {levels} levels, the resolution is coarse for the motion"
            yield Finding(name, message, False)


def _motion_speed(experiment: Experiment, axis: AxisChannels) -> Array | None:
    """The speed as logged, else the slope of the position; None without either, or where noise hides the motion."""
    log = experiment.trajectory
    if axis.speed in log:
        return log[axis.speed]
    if axis.position not in log:
        return None
    known = np.isfinite(log[axis.position])
    half = _slope_half_width(log.t[known], log[axis.position][known], experiment.noise.get(axis.position))
    return None if half is None else _slope(log.t, log[axis.position], half)


def _slope_half_width(t: Array, x: Array, noise: float | None) -> int | None:
    """The narrowest half width [samples] over which a slope shows motion and hardly noise; None where none does.

    It depends on the noise and not on the length of the log: a window that is longer than a cycle turns its sign round.
    """
    if t.size < 2 * MEAN_BLOCKS:
        return None
    sigma = noise_level(x, t) if noise is None else noise
    half = 1
    while 4 * half < t.size:
        slope = _slope(t, x, half)
        expected = math.sqrt(2) * sigma / (2 * half * float(np.median(np.diff(t))))
        if expected**2 < MAX_SLOPE_NOISE_SHARE * float(np.nanmean(slope**2)):
            return half
        half *= 2
    return None


def _slope(t: Array, y: Array, half: int) -> Array:
    """Speed from the position over a window of `half` samples to both sides; NaN at the ends."""
    slope = np.full(len(t), np.nan)
    slope[half:-half] = (y[2 * half :] - y[: -2 * half]) / (t[2 * half :] - t[: -2 * half])
    return slope


def _check_scale(experiment: Experiment, axis: AxisChannels) -> Iterator[Finding]:
    """Find motion of a size that no drive has, as millimetres that are read as metres."""
    log, motion = experiment.trajectory, _motion_speed(experiment, axis)
    fastest = 0.0 if motion is None else float(np.nanpercentile(np.abs(motion), 99))
    if axis.position == PISTON_CHANNELS.position and fastest > MAX_PISTON_SPEED:
        name = axis.speed if axis.speed in log else axis.position
        yield Finding(name, f"{name!r} moves at {fastest:.3g} m/s: is its unit mm, and read as m?", True)


CHECKS: dict[str, Callable[[Experiment, AxisChannels], Iterator[Finding]]] = {
    "motion": _check_has_motion,
    "speed": _check_position_speed,
    "work": _check_work_sign,
    "command": _check_command,
    "scale": _check_scale,
    "pressures": _check_pressures,
    "sampling": _check_sampling,
}
"""The checks by the names under which a user accepts what they find: a log that is right all the same."""
