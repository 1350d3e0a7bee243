"""Where an identification of friction starts, without a guess from the user: equation error on the filtered log.

Given the Stribeck velocity, a drive's force is linear in its other parameters; so for each of a few velocities one
bounded linear least squares gives a candidate, in milliseconds (NUMERICS section 3, steps 1 and 2).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter

from pneuopt.dynamics.hooks import Log, Start
from pneuopt.models.load import GRAVITY
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

STRIBECK_VELOCITIES = (0.025, 0.012, 0.05, 0.006, 0.1, 0.003)  # [m/s] in the order that succeeded most often
FILTER_TIME = 0.031  # [s] window of the Savitzky-Golay filter, order 3
SLIDING_SPEED = 4e-3  # [m/s] slower samples say nothing of sliding friction
BRISTLE_STIFFNESS_RANGE = (1e4, 1e6)  # [N/m] of bristles, in steps 2 and 3 of the recipe
RIDGE_WEIGHT = 1e-2  # on columns of unit length: sliding one way only, Coulomb friction and a constant force are one
MIN_STATIC_EXCESS = 0.03  # of static friction over Coulomb's, as a fraction of it (step 2)
MAX_VALVE_SAMPLES = 2000  # samples of a log, about, by which a valve is judged
PRESLIDING_DEFLECTIONS = 3.0  # bristle deflections since the last reversal, within which bristles still bend
SLOW_SPEED = 1e-2  # [m/s] below it friction comes near its static level, and bristles still bend
STATIC_QUANTILE = 0.995  # quantile of the force in slow samples that counts as static friction (step 2)
STATIC_WEIGHT = 0.003  # squared weight of that, in sliding samples (step 2)


def force_starts(logs: Mapping[str, Log]) -> Sequence[Start]:
    """Candidates for a `ForceDrive`: states from the filtered logs, parameters from M a + F_f(v) + F_L = F.

    Raises
    ------
    LogError
        If a log has neither position nor speed.
    """
    rows = {}
    for name, (measured, parameters) in logs.items():
        position, speed, acceleration = filter_motion(measured)
        columns, states = load_columns(parameters, position, acceleration), {"position": position, "speed": speed}
        rows[name] = RegressionRows(measured, parameters, speed, measured["force"], columns, states)
    return friction_candidates(rows)


def motion_starts(logs: Mapping[str, Log]) -> Sequence[Start]:
    """Candidates for a `MotionDrive`: parameters from the measured force at the imposed speed and pressure."""
    rows = {}
    for name, (measured, parameters) in logs.items():
        force, rig = measured["force"], {"rig.force_offset": np.ones(len(measured))}
        if "rig.area" in parameters:
            push = parameters.value("rig.area") * (measured["pressure_a"] - parameters.value("ambient.pressure"))
            force = force - push
            rig["rig.area_bias"] = push
        rows[name] = RegressionRows(measured, parameters, measured["speed"], force, rig, {})
    return friction_candidates(rows)


def load_columns(parameters: ParameterSet, position: Array, acceleration: Array) -> dict[str, Array]:
    """What multiplies each of the load's parameters in the force that moves it."""
    sine = math.sin(parameters.value("load.inclination")) if "load.inclination" in parameters else 0.0
    columns = {"load.mass": acceleration + GRAVITY * sine, "load.force": np.ones_like(position)}
    if "load.stiffness" in parameters:
        columns["load.stiffness"] = position - parameters.value("load.rest_position")
    return columns


def filter_motion(measured: Trajectory) -> tuple[Array, Array, Array]:
    """Filtered position [m], speed [m/s] and acceleration [m/s^2], from whichever of position and speed is logged."""
    require(
        "position" in measured or "speed" in measured,
        "the log has neither 'position' nor 'speed'; friction cannot be told without motion",
        LogError,
    )
    if "position" in measured:
        speed = filter_channel(measured, "speed", 0) if "speed" in measured else filter_channel(measured, "position", 1)
        return filter_channel(measured, "position", 0), speed, filter_channel(measured, "position", 2)
    speed, acceleration = filter_channel(measured, "speed", 0), filter_channel(measured, "speed", 1)
    return np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(measured.t))]), speed, acceleration


def filter_channel(measured: Trajectory, name: str, derivative: int) -> Array:
    """A channel, or its derivative by time, by Savitzky and Golay's filter; missing samples interpolated."""
    step = float(np.median(np.diff(measured.t)))
    window = max(5, 2 * round(FILTER_TIME / step / 2) + 1)
    window = min(window, (len(measured) - 1) // 2 * 2 + 1)
    column = _interpolate_gaps(measured, name)
    return np.asarray(savgol_filter(column, window, min(3, window - 1), deriv=derivative, delta=step))


@dataclass(frozen=True, eq=False)
class RegressionRows:
    """One log's part of the regression: ``force = sum(columns * parameters) + friction``."""

    measured: Trajectory
    parameters: ParameterSet
    speed: Array
    force: Array
    columns: Mapping[str, Array]
    states: Mapping[str, Array]


def friction_candidates(logs: Mapping[str, RegressionRows]) -> Sequence[Start]:
    """One start for each Stribeck velocity tried, from the rows of all logs."""
    parameters = next(iter(logs.values())).parameters
    searched = "friction.stribeck_velocity" in parameters.free_names
    given = parameters.value("friction.stribeck_velocity") if "friction.stribeck_velocity" in parameters else np.inf
    if searched:
        bounds = parameters["friction.stribeck_velocity"]
        tried = np.clip(STRIBECK_VELOCITIES, bounds.lower, bounds.upper).tolist()
    starts = []
    for velocity in dict.fromkeys(tried) if searched else (given,):
        values, _ = _regress(logs, parameters, velocity)
        own = {n: rows.parameters for n, rows in logs.items()}
        guess = per_log_values("friction.stribeck_velocity", velocity, own) if searched else {}
        values |= guess
        label = f"stribeck velocity {velocity:g} m/s" if searched else "equation error"
        bristles = _bristle_deflections(logs, values)
        states = {n: Trajectory(r.measured.t, {**r.states, **bristles.get(n, {})}) for n, r in logs.items()}
        starts.append(Start(states, values, label, tuple(guess)))
    return starts


def force_misfit(logs: Mapping[str, RegressionRows]) -> float:
    """Mean size of the force that no friction explains, of all that the sliding samples show [N]."""
    thinned = {name: _thin_rows(rows) for name, rows in logs.items()}
    parameters = next(iter(logs.values())).parameters
    if not all(np.isfinite(rows.force).all() for rows in thinned.values()):
        return math.inf
    return float(np.mean(np.abs(_regress(thinned, parameters, STRIBECK_VELOCITIES[0])[1])))


def per_log_values(name: str, value: float, logs: Mapping[str, ParameterSet]) -> dict[str, float]:
    """A start value, for each log where the parameter is each log's own."""
    per_log = any(parameters[name].per_log for parameters in logs.values())
    return (
        {f"{name}[{log}]": value for log, parameters in logs.items() if parameters[name].free}
        if per_log
        else {name: value}
    )


def _thin_rows(rows: RegressionRows) -> RegressionRows:
    """At most about `MAX_VALVE_SAMPLES` of the samples."""
    every = slice(None, None, max(1, len(rows.measured) // MAX_VALVE_SAMPLES))
    measured = Trajectory(rows.measured.t[every], {n: rows.measured[n][every] for n in rows.measured})
    columns, states = ({n: c[every] for n, c in part.items()} for part in (rows.columns, rows.states))
    return replace(
        rows, measured=measured, speed=rows.speed[every], force=rows.force[every], columns=columns, states=states
    )


def _regress(
    logs: Mapping[str, RegressionRows], parameters: ParameterSet, velocity: float
) -> tuple[dict[str, float], Array]:
    """Bounded linear least squares over all logs' sliding samples, with four Cauchy reweights; and what is left [N]."""
    parts = [_log_columns(name, rows, velocity) for name, rows in logs.items()]
    free = list(dict.fromkeys(n for columns, _ in parts for n in columns))
    A = np.vstack(
        [np.array([columns.get(n, np.zeros(len(y))) for n in free]).reshape(-1, len(y)).T for columns, y in parts]
    )
    y = np.concatenate([y for _, y in parts])
    known = np.isfinite(y)
    speed = np.abs(np.concatenate([rows.speed for rows in logs.values()]))
    sliding = known & (speed > SLIDING_SPEED)
    if "friction.bristle_stiffness" in parameters and sliding.any():
        level, travelled = (
            float(np.median(np.abs(y[sliding]))),
            [_distance_since_reversal(part) for part in logs.values()],
        )
        pull = {name: force for name, (_, force) in zip(logs, parts, strict=True)}
        stiffness = np.clip(_presliding_slope(logs, pull, 0.6 * level), *BRISTLE_STIFFNESS_RANGE)
        sliding &= np.concatenate(travelled) > PRESLIDING_DEFLECTIONS * level / stiffness
    rows = sliding if np.count_nonzero(sliding) > 10 * len(free) else known
    if not free:
        return {}, y[rows]
    bases = {n: parameters[n.split("[")[0]] for n in free}
    lower, upper = _regression_bounds(bases, float(np.median(np.abs(y[rows]))))
    weight = math.sqrt(STATIC_WEIGHT * np.count_nonzero(rows))
    stuck = [(_coefficient_row(columns, free), level) for columns, level in _static_levels(logs, velocity)]
    given = np.array([row for row, _ in stuck]).reshape(-1, len(free)), np.array([level for _, level in stuck])
    x = _robust_least_squares(A[rows], y[rows], lower, upper, (weight * given[0], weight * given[1]))
    values = dict(zip(free, x.tolist(), strict=True))
    for name in [n for n in free if n.startswith("friction.static")]:
        own = name.replace("static", "coulomb")
        coulomb = values.get(own, values.get("friction.coulomb", parameters.value("friction.coulomb")))
        values[name] = coulomb + max(values[name], MIN_STATIC_EXCESS * coulomb)
    return {n: float(np.clip(values[n], p.lower, p.upper)) for n, p in bases.items()}, y[rows] - A[rows] @ x


def _coefficient_row(columns: Mapping[str, float], free: Sequence[str]) -> Array:
    return np.array([columns.get(n, 0.0) for n in free])


def _static_levels(logs: Mapping[str, RegressionRows], velocity: float) -> list[tuple[dict[str, float], float]]:
    """For each log a slow sample in which friction is about to give way: it is static there, whatever the speed."""
    out = []
    for name, rows in logs.items():
        _, pull = _log_columns(name, rows, velocity)
        slow = np.flatnonzero((np.abs(rows.speed) < SLOW_SPEED) & np.isfinite(pull))
        columns, level = _log_columns(name, rows, velocity, np.sign(pull))
        if slow.size and any(n.startswith("friction.static") for n in columns):
            at = slow[np.argsort(np.abs(level[slow]))[math.ceil(STATIC_QUANTILE * (slow.size - 1))]]
            out.append(({n: float(c[at]) for n, c in columns.items()}, float(level[at])))
    return out


def _log_columns(
    name: str, rows: RegressionRows, velocity: float, stuck: Array | None = None
) -> tuple[dict[str, Array], Array]:
    """A log's free columns ("name[log]" if its own), and its force less what is known; `stuck`: see below."""
    p = rows.parameters
    columns = {n: c for n, c in {**rows.columns, **_friction_columns(rows, velocity, stuck)}.items() if n in p}
    known = {n: p.value(n) for n in columns}
    if "friction.static" in columns:
        known["friction.static"] -= p.value("friction.coulomb")
        if p["friction.coulomb"].free and not p["friction.static"].free:
            # the level is known, so what is above Coulomb's shrinks as Coulomb's grows
            known["friction.static"] = p.value("friction.static")
            columns["friction.coulomb"] = columns["friction.coulomb"] - columns["friction.static"]
    target = rows.force - sum(
        (known[n] * c for n, c in columns.items() if not p[n].free), start=np.zeros(len(rows.force))
    )
    return {f"{n}[{name}]" if p[n].per_log else n: c for n, c in columns.items() if p[n].free}, target


def _friction_columns(rows: RegressionRows, velocity: float, stuck: Array | None = None) -> dict[str, Array]:
    """What multiplies each friction parameter in the force; static friction counts as the part above Coulomb's.

    If stuck (1 or -1: the side to which a sample is pulled) friction has its static level, whatever the filtered speed.
    """
    parameters, speed = rows.parameters, rows.speed
    smoothing = parameters.value("friction.smoothing") if "friction.smoothing" in parameters else 1e-3
    side, peak = np.tanh(speed / smoothing), np.exp(-((speed / velocity) ** 2))
    if stuck is not None:
        side, peak = stuck, np.ones_like(speed)
    columns = {"friction.coulomb": side, "friction.static": side * peak, "friction.viscous": speed}
    for chamber in ("pressure_a", "pressure_b"):
        if f"friction.coulomb_{chamber}" in parameters:
            gauge = rows.measured[chamber] - parameters.value("ambient.pressure")
            columns[f"friction.coulomb_{chamber}"] = side * gauge
    return columns


def _robust_least_squares(
    A: Array, y: Array, lower: Array, upper: Array, given: tuple[Array, Array] | None = None
) -> Array:
    """Bounded least squares, reweighted but for the given rows; `RIDGE_WEIGHT` splits what no row tells apart."""
    k = A.shape[1]
    given_A, given_y = (np.empty((0, k)), np.empty(0)) if given is None else given
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


def _regression_bounds(bases: Mapping[str, Parameter], level: float) -> tuple[Array, Array]:
    """Of the regression: the parameters' own, and floors that keep friction positive (NUMERICS section 3, step 2)."""
    floors = {"friction.coulomb": 0.05 * level, "friction.viscous": 0.0}
    own = {n: n.split("[")[0] for n in bases}
    given = [0.0 if own[n] == "friction.static" else p.lower for n, p in bases.items()]
    lower = np.array([max(floors.get(own[n], -np.inf), lo) for n, lo in zip(bases, given, strict=True)])
    upper = np.array([max(p.upper, lo + 1e-9) for p, lo in zip(bases.values(), lower, strict=True)])
    return lower, upper


def _bristle_deflections(logs: Mapping[str, RegressionRows], values: dict[str, float]) -> dict[str, dict[str, Array]]:
    """The bristle deflection along each log, and their stiffness from presliding motion (changes `values`)."""
    parameters = next(iter(logs.values())).parameters
    if "friction.bristle_stiffness" not in parameters:
        return {}

    def value_of(name: str) -> float:
        return values.get(name, parameters.value(name))

    friction = {n: _friction_force(n, rows, values) for n, rows in logs.items()}
    stiffness = parameters["friction.bristle_stiffness"]
    if stiffness.free:
        slope = _presliding_slope(logs, friction, 0.6 * value_of("friction.coulomb"))
        low, high = max(BRISTLE_STIFFNESS_RANGE[0], stiffness.lower), min(BRISTLE_STIFFNESS_RANGE[1], stiffness.upper)
        found = float(np.clip(slope, low, high))
        values |= per_log_values("friction.bristle_stiffness", found, {n: rows.parameters for n, rows in logs.items()})
    else:
        found = stiffness.value
    limit = value_of("friction.static") / found
    deflections = {n: (friction[n] - value_of("friction.viscous") * rows.speed) / found for n, rows in logs.items()}
    return {n: {"friction.bristle": np.clip(z, -limit, limit)} for n, z in deflections.items()}


def _presliding_slope(logs: Mapping[str, RegressionRows], friction: Mapping[str, Array], level: float) -> float:
    """Robust slope of dF/dt over v in slow samples below the sliding level [N/m]; zero where there are none."""
    rate, speed = [], []
    for n, rows in logs.items():
        presliding = (np.abs(rows.speed) < SLOW_SPEED) & (np.abs(friction[n]) < level)
        rate.append(np.gradient(friction[n], rows.measured.t)[presliding])
        speed.append(rows.speed[presliding])
    v = np.concatenate(speed)
    # a step of the force, or the log's edge, is no presliding: the robust weights take it out
    return (
        float(_robust_least_squares(v[:, None], np.concatenate(rate), np.zeros(1), np.full(1, np.inf))[0])
        if v.size
        else 0.0
    )


def _distance_since_reversal(rows: RegressionRows) -> Array:
    """Distance since the speed last changed its sign [m]."""
    v, step = rows.speed, np.diff(rows.measured.t)
    path = np.concatenate([[0.0], np.cumsum(np.abs(v[1:] + v[:-1]) / 2 * step)])
    turns = np.append(False, np.diff(np.sign(v)) != 0)
    return np.asarray(path - np.maximum.accumulate(np.where(turns, path, 0.0)))


def _friction_force(name: str, rows: RegressionRows, values: Mapping[str, float]) -> Array:
    """The force less what inertia, load and offsets take [N]."""
    p = rows.parameters
    used = {n: c for n, c in rows.columns.items() if n in p}
    taken = (values.get(n, values.get(f"{n}[{name}]", p.value(n))) * c for n, c in used.items())
    return np.asarray(rows.force - sum(taken))


def _interpolate_gaps(measured: Trajectory, name: str) -> Array:
    """The column with missing samples interpolated, for filters only."""
    column = measured[name]
    known = np.isfinite(column)
    require(bool(known.any()), f"channel {name!r} has no samples", LogError)
    return np.interp(measured.t, measured.t[known], column[known])
