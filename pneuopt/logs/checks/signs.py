"""Signs and units: position and speed, what drives the motion and its work, the command and what follows it."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pneuopt.logs.checks.findings import LARGE_SHARE, Evidence, LogFinding, Panel, StatedAxis, evidence, is_opposed
from pneuopt.logs.checks.motion import (
    MEAN_BLOCKS,
    lagged_correlation,
    lagged_ratio,
    motion_speed,
    position_slope,
    sensor_lags,
    shift,
    slope_half_width,
    speed_panel,
    window_mean,
)
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.trajectories import Trajectory

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
MAX_COMMAND_LAG = 0.1
"""Time [s] within which a drive's speed follows its valve: longer finds chance correlations, shorter misses drives."""
WRONG_SIGN_CORRELATIONS = (-0.6, 0.3)
"""The sign is wrong if the least correlation of command and speed is below the first, the largest below the second."""
RECIPROCATING_TRAVEL_RATIO = 1.9
"""Travel over range [1]: at 2 a piston has come back, so it is commanded; a lower bound blames overshoot."""


def check_position_speed(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a speed that is not the slope of the position, in sign or in unit."""
    log = experiment.trajectory
    if axis.position not in log or axis.speed not in log:
        return
    experiment = _known_part(experiment, axis.position, axis.speed)
    log = experiment.trajectory
    t, x, v = log.t, log[axis.position], log[axis.speed]
    half = slope_half_width(t, x, experiment.noise.get(axis.position))
    if half is None:
        return
    slope, means = position_slope(t, x, half), [window_mean(v, half, simpson) for simpson in (False, True)]
    found = {lag: lagged_correlation(slope, means[0], lag) for lag in sensor_lags(t)}
    best = max(found, key=found.__getitem__)
    if found[best] < -MIN_SPEED_CORRELATION / 2 and min(found.values()) < -MIN_SPEED_CORRELATION:
        i = int(np.nanargmax(np.abs(slope)))
        seen = f"at {t[i]:.4g} s {axis.position} changes by {slope[i]:.3g}/s, {axis.speed} is {means[0][i]:.3g}"
        message = f"{axis.position} and {axis.speed} run against each other ({seen}): change the sign of one"
        shown = _speeds(experiment, axis, slope, is_opposed(slope, means[0]), i)
        yield LogFinding(axis.speed, message, True, evidence=shown)
    elif found[best] > MIN_SPEED_CORRELATION:
        ratios = [lagged_ratio(slope, mean, best) for mean in means]
        # trapezoids and parabolas through the speed err in opposite directions where its samples are far apart
        if max(ratios) < SPEED_SLOPE_RATIOS[0] or min(ratios) > SPEED_SLOPE_RATIOS[1]:
            message = f"{axis.speed} is {ratios[0]:.3g} times the slope of the {axis.position}: check both units"
            fast = np.abs(slope) > LARGE_SHARE * np.nanmax(np.abs(slope))
            shown = _speeds(experiment, axis, slope, fast, int(np.nanargmax(np.abs(slope))))
            yield LogFinding(axis.speed, message, True, evidence=shown)


def _known_part(experiment: Experiment, *channels: str) -> Experiment:
    """The samples in which channels are all known."""
    log = experiment.trajectory
    known = np.isfinite(log.matrix(channels)).all(axis=1)
    part = Trajectory(log.t[known], {n: log[n][known] for n in log})
    return replace(experiment, trajectory=part, holes=())


def _speeds(experiment: Experiment, axis: StatedAxis, slope: Array, where: Mask, at: int) -> Evidence:
    """The logged speed beside the slope of the position."""
    speed, unit = experiment.trajectory[axis.speed], experiment.unit(axis.speed)
    both = Panel(unit, {axis.speed: speed, f"slope of the {axis.position}": slope})
    return evidence(experiment, both, axis.position, where=where, at=at, motion=slope)


def check_work_sign(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a force, torque or pressures of the wrong sign: a drive does net work on a load that comes back."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
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
        shares = np.stack([_work_shares(log.t, np.stack(pushes), motion, lag) for lag in sensor_lags(log.t)], axis=1)
        share = max(shares.ravel().tolist())
        if share < MIN_WORK_SHARE:
            at = int(np.nanargmin(pushes[-1] * motion))
            unit = experiment.unit(axis.push) if name == axis.push else "Pa"
            fast = f"{motion[at]:.3g} {experiment.unit(axis.speed)}"
            seen = f"most at {log.t[at]:.4g} s, where {pushes[-1][at]:.3g} {unit} pushes and the speed is {fast}"
            why = f"{message} the motion on balance ({100 * share:.0f} % of its power, {seen}), which no drive does"
            speed = speed_panel(experiment, axis, motion)
            shown = Panel(experiment.unit(axis.push), {axis.push: pushes[0]})
            if name != axis.push:
                shown = Panel("Pa(a)", {n: log[n] for n in ("pressure_a", "pressure_b")})
            brakes = is_opposed(pushes[-1], motion)
            found = evidence(experiment, shown, speed, where=brakes, at=at, motion=motion, label="it brakes")
            yield LogFinding(name, f"{why}: change the sign of {remedy}", True, evidence=found)


def check_command(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a piston that runs against its valve's command, or without one."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    if motion is None or "valve_voltage" not in log:
        return
    known = np.isfinite(motion) & np.isfinite(log["valve_voltage"])
    t, command, motion = log.t[known], log["valve_voltage"][known], motion[known]
    part = replace(experiment, trajectory=Trajectory(t, {"valve_voltage": command}), noise={}, intersample={})
    if len(t) < 2 * MEAN_BLOCKS:
        return
    if not np.any(np.diff(command)):
        every = max(1, len(t) // (5 * MEAN_BLOCKS))  # coarse: noise is no travel
        travel = np.cumsum(motion[1:] * np.diff(t))[::every]
        if float(np.abs(np.diff(travel)).sum()) > RECIPROCATING_TRAVEL_RATIO * float(np.ptp(travel)) > 0:
            message = "'valve_voltage' is constant while the piston goes to and fro: log the command that moves it"
            shown = evidence(part, "valve_voltage", speed_panel(experiment, axis, motion))
            yield LogFinding("valve_voltage", message, True, evidence=shown)
        return
    lowest, highest = _command_correlations(t, command, motion)
    if lowest < WRONG_SIGN_CORRELATIONS[0] and highest < WRONG_SIGN_CORRELATIONS[1]:
        at = int(np.argmax(np.abs(motion)))
        seen = f"correlation {lowest:.2f}; {motion[at]:.3g} m/s at {t[at]:.4g} s under {command[at]:.3g} V"
        message = f"the piston runs against the valve's command ({seen}): change the sign of "
        speed = speed_panel(experiment, axis, motion)
        shown = evidence(
            part, "valve_voltage", speed, where=is_opposed(command, motion), at=at, motion=motion, label="opposed"
        )
        yield LogFinding("valve_voltage", message + "'valve_voltage', or of the motion", True, evidence=shown)


def _work_shares(t: Array, pushes: Array, motion: Array, lag: int) -> Array:
    """Work of each push, over the integral of its power's absolute value; NaN where the log does not return."""
    unknown = np.full(len(pushes), math.nan)
    rows, motion = shift(np.where(np.isfinite(pushes).all(axis=0), np.arange(t.size), math.nan), motion, lag)
    if rows.size < 10:
        return unknown
    at = rows.astype(np.intp)
    steps = np.diff(t[at], prepend=t[at[0]], append=t[at[-1]])
    travel = 0.5 * (steps[:-1] + steps[1:]) * motion  # by trapezoids
    path = float(np.abs(travel).sum())
    if path == 0 or abs(float(travel.sum())) > MAX_NET_TRAVEL_SHARE * path:
        return unknown
    known = pushes[:, at]
    work, total = known @ travel, np.abs(known) @ np.abs(travel)
    return np.asarray(np.divide(work, total, out=unknown, where=total > 0))


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
