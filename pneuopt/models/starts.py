"""Starts of an identification of friction without a guess from the user: equation error on the filtered log.

A drive's force is linear in its parameters, except a few that the law scans, such as the Stribeck velocity. So each of
a few values gives a candidate by one bounded linear least squares, in milliseconds. The law declares this (`start`). At
the end stands the filter that gives motion and channels of a log with their rates.
"""

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter

from pneuopt.dynamics.hooks import Log, Start, Starts
from pneuopt.logs.tolerances import MAX_REGRESSION_ROWS
from pneuopt.models.friction import SMOOTHING_PARAMETER, FrictionModel, FrictionSamples, FrictionStart, law_inputs
from pneuopt.models.load import GRAVITY
from pneuopt.models.tolerances import (
    FILTER_TIMES,
    MAX_JITTER,
    MIN_BALANCE_GAIN,
    MIN_LEVEL_EXCESS,
    PRESLIDING_DEFLECTIONS,
    RIDGE_WEIGHT,
    SLIDING_SPEED,
    SLOW_SPEED,
    STATIC_QUANTILE,
    STATIC_WEIGHT,
    STUCK_WEIGHT,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory


def force_starts(friction: FrictionModel, logs: Mapping[str, Log]) -> Sequence[Start]:
    """Starts of a `ForceDrive`: states from the filtered logs, parameters from M a + F_f(v) + F_L = F."""

    @functools.cache
    def balances(window: float) -> dict[str, RegressionRows]:
        rows = {}
        for name, (measured, parameters, _) in logs.items():
            position, speed, acceleration = filter_motion(measured, window)
            columns, states = load_columns(parameters, position, acceleration), {"position": position, "speed": speed}
            rows[name] = RegressionRows(measured, parameters, speed, measured["force"], columns, states)
        return rows

    return friction_candidates(friction, balances(choose_filter_time(friction, balances)))


def motion_starts(friction: FrictionModel, logs: Mapping[str, Log]) -> Sequence[Start]:
    """Starts of a `MotionDrive`: parameters from the measured force at the imposed speed and pressure."""
    rows = {}
    for name, (measured, parameters, _) in logs.items():
        force, rig = measured["force"], {"rig.force_offset": np.ones(len(measured))}
        if "rig.area" in parameters:
            push = parameters.value("rig.area") * (measured["pressure_a"] - parameters.value("ambient.pressure"))
            force = force - push
            rig["rig.area_bias"] = push
        rows[name] = RegressionRows(measured, parameters, measured["speed"], force, rig, {})
    return friction_candidates(friction, rows)


def load_columns(parameters: ParameterSet, position: Array, acceleration: Array) -> dict[str, Array]:
    """Regression columns of the load's parameters in the force that moves it."""
    sine = math.sin(parameters.value("load.inclination")) if "load.inclination" in parameters else 0.0
    columns = {"load.mass": acceleration + GRAVITY * sine, "load.force": np.ones_like(position)}
    if "load.stiffness" in parameters:
        columns["load.stiffness"] = position - parameters.value("load.rest_position")
    return columns


@dataclass(frozen=True, eq=False)
class RegressionRows:
    """Rows of one log in the regression ``force = sum(columns * parameters) + friction``."""

    measured: Trajectory
    parameters: ParameterSet
    speed: Array
    force: Array
    columns: Mapping[str, Array]
    states: Mapping[str, Array]

    def thin(self, every: int) -> "RegressionRows":
        """The rows, thinned to one of so many."""
        measured = Trajectory(self.measured.t[::every], {n: self.measured[n][::every] for n in self.measured})
        columns, states = ({n: c[::every] for n, c in part.items()} for part in (self.columns, self.states))
        return RegressionRows(measured, self.parameters, self.speed[::every], self.force[::every], columns, states)


def friction_candidates(friction: FrictionModel, logs: Mapping[str, RegressionRows]) -> Sequence[Start]:
    """Starts from the rows of all logs, one for each set of values of the parameters that the law scans."""
    parameters, scanned = next(iter(logs.values())).parameters, friction.start.scanned
    free = {n: parameters[f"friction.{n}"] for n in scanned if f"friction.{n}" in parameters.free_names}
    tried = [dict.fromkeys(np.clip(scanned[n], p.lower, p.upper).tolist()) for n, p in free.items()]
    sets = [dict(zip(free, values, strict=True)) for values in itertools.product(*tried)]

    def candidate(tried: dict[str, float]) -> Start:
        values = _regress(friction, logs, parameters, tried)[0]
        guess: dict[str, float] = {}
        for name, value in tried.items():
            guess |= per_log_values(f"friction.{name}", value, {n: rows.parameters for n, rows in logs.items()})
        values |= guess
        words = [f"{n.replace('_', ' ')} {v:g} {parameters[f'friction.{n}'].unit}" for n, v in tried.items()]
        bristles = _bristle_deflections(friction, logs, values)
        states = {n: Trajectory(r.measured.t, {**r.states, **bristles.get(n, {})}) for n, r in logs.items()}
        return Start(states, values, ", ".join(words) or "equation error", tuple(guess))

    return Starts([functools.partial(candidate, values) for values in sets])


def force_misfit(friction: FrictionModel, logs: Mapping[str, RegressionRows]) -> float:
    """Mean absolute force in sliding samples that friction does not explain [N]; of long logs, some samples tell."""
    if not all(np.isfinite(rows.force).all() for rows in logs.values()):
        return math.inf
    return _unexplained_force(friction, logs)[0]


def choose_filter_time(friction: FrictionModel, balances: Callable[[float], Mapping[str, RegressionRows]]) -> float:
    """The longest window of the filter [s], unless a shorter one leaves clearly less of the force unexplained.

    `balances` gives the rows of the logs that are filtered with a window [s].
    """
    chosen, left, least = FILTER_TIMES[0], math.inf, math.inf
    for window in FILTER_TIMES:
        unexplained, force = _unexplained_force(friction, balances(window))
        share = unexplained / max(force, np.finfo(float).tiny)
        if not share < least:
            break  # no shorter one is tried after one that leaves no less
        least = share
        if share < MIN_BALANCE_GAIN * left:
            chosen, left = window, share
    return chosen


def _unexplained_force(friction: FrictionModel, logs: Mapping[str, RegressionRows]) -> tuple[float, float]:
    """Mean absolute force that friction does not explain by the first values that are tried, and that of all [N].

    Of long logs, some samples tell.
    """
    total = sum(len(rows.measured) for rows in logs.values())
    thinned = {n: rows.thin(max(1, total // MAX_REGRESSION_ROWS)) for n, rows in logs.items()}
    parameters = next(iter(logs.values())).parameters
    tried = {name: values[0] for name, values in friction.start.scanned.items()}
    _, unexplained, force = _regress(friction, thinned, parameters, tried)
    return float(np.mean(np.abs(unexplained))), float(np.mean(np.abs(force)))


def per_log_values(name: str, value: float, logs: Mapping[str, ParameterSet]) -> dict[str, float]:
    """Start value of a parameter, one for each log where the parameter is `per_log`."""
    per_log = any(parameters[name].per_log for parameters in logs.values())
    if not per_log:
        return {name: value}
    return {f"{name}[{log}]": value for log, parameters in logs.items() if parameters[name].free}


def _regress(
    friction: FrictionModel, logs: Mapping[str, RegressionRows], parameters: ParameterSet, tried: Mapping[str, float]
) -> tuple[dict[str, float], Array, Array]:
    """Bounded robust least squares over all logs' sliding samples: the values, their residuals and forces [N]."""
    parts = [_log_columns(friction, name, rows, tried) for name, rows in logs.items()]
    free = list(dict.fromkeys(n for columns, _ in parts for n in columns))
    A = np.vstack(
        [np.array([columns.get(n, np.zeros(len(y))) for n in free]).reshape(-1, len(y)).T for columns, y in parts]
    )
    y = np.concatenate([y for _, y in parts])
    finite = np.isfinite(y)
    sliding = finite & (np.abs(np.concatenate([rows.speed for rows in logs.values()])) > SLIDING_SPEED)
    if friction.start.bristles is not None and sliding.any():
        level = float(np.median(np.abs(y[sliding])))
        pull = {name: force for name, (_, force) in zip(logs, parts, strict=True)}
        stiffness = np.clip(_presliding_slope(logs, pull, 0.6 * level), *friction.start.bristles.range)
        travelled = np.concatenate([_distance_since_reversal(part) for part in logs.values()])
        sliding &= travelled > PRESLIDING_DEFLECTIONS * level / stiffness
    slides = np.count_nonzero(sliding) > 10 * len(free)
    rows = sliding if slides else finite
    if not free:
        return {}, y[rows], y[rows]
    bases = {n: parameters[n.split("[")[0]] for n in free}
    lower, upper = _regression_bounds(friction.start, bases, float(np.median(np.abs(y[rows]))))
    if not slides:  # friction is its static level, and nothing tells that from Coulomb's
        upper = np.where(np.isin([n.split("[")[0] for n in free], _excesses(friction.start)), lower + 1e-9, upper)
    weight = math.sqrt((STATIC_WEIGHT if slides else STUCK_WEIGHT) * np.count_nonzero(rows))
    stuck = [
        (np.array([columns.get(n, 0.0) for n in free]), level)
        for columns, level in _static_levels(friction, logs, tried)
    ]
    level_rows = np.array([row for row, _ in stuck]).reshape(-1, len(free)), np.array([level for _, level in stuck])
    x = _robust_least_squares(A[rows], y[rows], lower, upper, (weight * level_rows[0], weight * level_rows[1]))
    values = _raise_levels(friction.start, dict(zip(free, x.tolist(), strict=True)), parameters)
    return {n: float(np.clip(values[n], p.lower, p.upper)) for n, p in bases.items()}, y[rows] - A[rows] @ x, y[rows]


def _raise_levels(start: FrictionStart, values: dict[str, float], parameters: ParameterSet) -> dict[str, float]:
    """Values in which each excess over another level becomes the level itself."""
    levels = {f"friction.{n}": f"friction.{base}" for n, base in start.above.items()}
    out = dict(values)
    for name in (n for n in values if n.split("[")[0] in levels):
        level, _, log = name.partition("[")
        base = levels[level]
        usual = values.get(base, parameters.value(base))
        below = values.get(f"{base}[{log}", usual) if log else usual
        out[name] = below + max(values[name], MIN_LEVEL_EXCESS * below)
    return out


def _static_levels(
    friction: FrictionModel, logs: Mapping[str, RegressionRows], tried: Mapping[str, float]
) -> list[tuple[dict[str, float], float]]:
    """Regression row and force of a slow sample just before break-away, for each log: friction is static there."""
    out, levels = [], _excesses(friction.start)
    for name, rows in logs.items():
        _, pull = _log_columns(friction, name, rows, tried)
        slow = np.flatnonzero((np.abs(rows.speed) < SLOW_SPEED) & np.isfinite(pull))
        columns, level = _log_columns(friction, name, rows, tried, np.sign(pull))
        if slow.size and any(n.split("[")[0] in levels for n in columns):
            at = slow[np.argsort(np.abs(level[slow]))[math.ceil(STATIC_QUANTILE * (slow.size - 1))]]
            out.append(({n: float(c[at]) for n, c in columns.items()}, float(level[at])))
    return out


def _log_columns(
    friction: FrictionModel, name: str, rows: RegressionRows, tried: Mapping[str, float], stuck: Array | None = None
) -> tuple[dict[str, Array], Array]:
    """Columns of a log's free parameters ("name[log]" if per log), and its force less the terms of fixed ones.

    With `stuck`, the sign of the force that pulls, friction has its static level, whatever the filtered speed.
    """
    p, speed = rows.parameters, rows.speed
    values = {n: p.value(f"friction.{n}") for n in friction.parameters} | dict(tried)
    signals = {**{n: rows.measured[n] for n in rows.measured}, "force": rows.force}
    inputs = law_inputs(friction, signals, {n: p.value(n) for n in p if n.startswith("ambient.")})
    samples = FrictionSamples(
        speed, np.tanh(speed / values.get("smoothing", SMOOTHING_PARAMETER.value)), speed, inputs, values
    )
    if stuck is not None:
        samples = replace(samples, side=stuck, level_speed=np.zeros_like(speed))
    columns = {n: c for n, c in rows.columns.items() if n in p}
    columns |= {f"friction.{n}": c for n, c in friction.start.columns(samples).items() if f"friction.{n}" in p}
    values_of = {n: p.value(n) for n in columns}
    for level, base in ((f"friction.{n}", f"friction.{below}") for n, below in friction.start.above.items()):
        values_of[level] -= p.value(base)
        if p[base].free and not p[level].free:
            # the level is fixed, so its excess over the other level shrinks as that one grows
            values_of[level] = p.value(level)
            columns[base] = columns[base] - columns[level]
    target = rows.force - sum(
        (values_of[n] * c for n, c in columns.items() if not p[n].free), start=np.zeros(len(rows.force))
    )
    return {f"{n}[{name}]" if p[n].per_log else n: c for n, c in columns.items() if p[n].free}, target


def _robust_least_squares(
    A: Array, y: Array, lower: Array, upper: Array, exact: tuple[Array, Array] | None = None
) -> Array:
    """Bounded least squares with Cauchy weights, except on the given rows, and a ridge (`RIDGE_WEIGHT`)."""
    k = A.shape[1]
    given_A, given_y = (np.empty((0, k)), np.empty(0)) if exact is None else exact
    scale = np.linalg.norm(A, axis=0) + 1e-300
    weight, x = np.ones(len(A)), np.zeros(k)
    for _ in range(5):
        weighted = np.concatenate([A / scale * weight[:, None], given_A / scale, RIDGE_WEIGHT * np.eye(k)])
        right = np.concatenate([y * weight, given_y, np.zeros(k)])
        fit = lsq_linear(weighted, right, (lower * scale, upper * scale))
        x = np.clip(np.asarray(fit.x) / scale, lower, upper)
        error = y - A @ x
        spread = 1.4826 * np.median(np.abs(error)) + 1e-12
        weight = 1 / np.sqrt(1 + (error / (2.385 * spread)) ** 2)
    return x


def _regression_bounds(start: FrictionStart, bases: Mapping[str, Parameter], level: float) -> tuple[Array, Array]:
    """Bounds of the regression: those of the parameters, and the law's floors, which keep friction positive."""
    floors = {f"friction.{n}": share * level for n, share in start.floors.items()}
    excesses, shared = _excesses(start), {n: n.split("[")[0] for n in bases}
    bounds = [0.0 if shared[n] in excesses else p.lower for n, p in bases.items()]
    lower = np.array([max(floors.get(shared[n], -np.inf), lo) for n, lo in zip(bases, bounds, strict=True)])
    upper = np.array([max(p.upper, lo + 1e-9) for p, lo in zip(bases.values(), lower, strict=True)])
    return lower, upper


def _excesses(start: FrictionStart) -> list[str]:
    """The parameters whose columns multiply their excess over another one."""
    return [f"friction.{n}" for n in start.above]


def _bristle_deflections(
    friction: FrictionModel, logs: Mapping[str, RegressionRows], values: dict[str, float]
) -> dict[str, dict[str, Array]]:
    """Bristle deflections along each log; the stiffness is estimated from presliding and written to `values`."""
    bristles = friction.start.bristles
    if bristles is None:
        return {}
    parameters = next(iter(logs.values())).parameters
    law = {n: values.get(f"friction.{n}", parameters.value(f"friction.{n}")) for n in friction.parameters}
    forces = {}
    for n, rows in logs.items():  # less those of inertia, load and offsets [N]
        p, columns = rows.parameters, {c: column for c, column in rows.columns.items() if c in rows.parameters}
        terms = (values.get(c, values.get(f"{c}[{n}]", p.value(c))) * column for c, column in columns.items())
        forces[n] = np.asarray(rows.force - sum(terms))
    name = f"friction.{bristles.stiffness}"
    stiffness = parameters[name]
    if stiffness.free:
        slope = _presliding_slope(logs, forces, 0.6 * law[bristles.level])
        low, high = max(bristles.range[0], stiffness.lower), min(bristles.range[1], stiffness.upper)
        law[bristles.stiffness] = float(np.clip(slope, low, high))
        values |= per_log_values(name, law[bristles.stiffness], {n: rows.parameters for n, rows in logs.items()})
    deflections = {n: bristles.deflections(forces[n], rows.speed, law) for n, rows in logs.items()}
    return {n: {f"friction.{state}": z for state, z in found.items()} for n, found in deflections.items()}


def _presliding_slope(logs: Mapping[str, RegressionRows], friction: Mapping[str, Array], level: float) -> float:
    """Robust slope of dF/dt over v in slow samples below the sliding level [N/m]; zero where there are none."""
    rate, speed = [], []
    for n, rows in logs.items():
        presliding = (np.abs(rows.speed) < SLOW_SPEED) & (np.abs(friction[n]) < level)
        rate.append(np.gradient(friction[n], rows.measured.t)[presliding])
        speed.append(rows.speed[presliding])
    v = np.concatenate(speed)
    if not v.size:
        return 0.0
    # a step of the force, or the log's edge, is no presliding: the robust weights suppress it
    return float(_robust_least_squares(v[:, None], np.concatenate(rate), np.zeros(1), np.full(1, np.inf))[0])


def _distance_since_reversal(rows: RegressionRows) -> Array:
    """Distance since the speed last changed its sign [m]."""
    v, step = rows.speed, np.diff(rows.measured.t)
    path = np.concatenate([[0.0], np.cumsum(np.abs(v[1:] + v[:-1]) / 2 * step)])
    turns = np.append(False, np.diff(np.sign(v)) != 0)
    return np.asarray(path - np.maximum.accumulate(np.where(turns, path, 0.0)))


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
