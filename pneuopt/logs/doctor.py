"""Faults that a log shows without a model: units, signs, zero points, sampling, missing motion, a wrong mass.

`examine` runs the checks of `CHECKS`, at the end of the file: each takes a log and what is known of its axis, and
yields findings with the signals that show them.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import find_resolution, noise_level
from pneuopt.logs.tolerances import (
    CLIPPED_SHARE,
    FAST_QUANTILE,
    LAG_STEPS,
    LARGE_SHARE,
    LEAST_SPEED,
    LEAST_WAY_SHARE,
    MAX_ATMOSPHERE_ERROR,
    MAX_COMMAND_LAG,
    MAX_MASS_FACTOR,
    MAX_NET_TRAVEL_SHARE,
    MAX_NOISE_SHARE,
    MAX_PHASE_STEP,
    MAX_PISTON_SPEED,
    MAX_POSITION_ZERO_ERROR,
    MAX_PRESSURE,
    MAX_REGRESSION_ROWS,
    MAX_SENSOR_LAG,
    MAX_SLOPE_NOISE_SHARE,
    MAX_STEPS_BETWEEN,
    MAX_UNEXPLAINED,
    MEAN_BLOCKS,
    MIN_CONTRADICTION,
    MIN_HATS,
    MIN_JUMP_ACCELERATION,
    MIN_JUMP_NOISE,
    MIN_JUMP_SPEED_RATIO,
    MIN_OFFSET_SHARE,
    MIN_PRESSURE_RATIO,
    MIN_RESIDUAL_FACTOR,
    MIN_SAMPLES,
    MIN_SPEED_CORRELATION,
    MIN_STOP_FORCE_RATIO,
    MIN_WORK_SHARE,
    MOST_MOTION,
    NEIGHBOURS,
    NOISE_WIDTHS,
    RECIPROCATING_TRAVEL_RATIO,
    ROD_AREA_RATIOS,
    SHORTEST_REST,
    SPEED_SLOPE_RATIOS,
    STILL_STEPS,
    STOP_WIDTH,
    WHITE_LAGS,
    WRONG_SIGN_CORRELATIONS,
)
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, write_value


class StatedAxis(NamedTuple):
    """What is known of the axis that a log is of: a piston's channels unless a plant names its own (angle, torque)."""

    position: str = "position"
    speed: str = "speed"
    push: str = "force"  # the force or torque that drives the axis, positive in the direction of positive speed
    forces: Mapping[str, float] = {"force": 1.0}  # on the body, per unit of each channel; empty where one is not known
    constant: float = math.nan  # the force that no channel gives, as a weight's; NaN where a part of it is free
    inertia: float = math.nan  # as stated; NaN where it is free
    inertia_name: str = "mass"
    inertia_unit: str = "kg"
    force_unit: str = "N"
    offset_parameter: str = ""  # of a constant force; empty where there is none
    stops: tuple[float, ...] = ()  # positions at which the model has end stops
    is_piston: bool = True  # not so where the motion's unit is another, or the gain is stated as negative

    def net_force(self, channels: Mapping[str, Array]) -> Array:
        """The force on the body without friction, from channels; the constant counts as zero where it is unknown."""
        total = sum((weight * channels[n] for n, weight in self.forces.items()), np.zeros(1))
        return np.asarray(total + (0.0 if math.isnan(self.constant) else self.constant))


PISTON = StatedAxis()


class Panel(NamedTuple):
    """Curves over one axis of a figure: by name, in one SI unit."""

    unit: str
    curves: Mapping[str, Array]


@dataclass(frozen=True)
class Evidence:
    """The signals that contradict each other, over time."""

    t: Array  # (n,) [s]
    panels: tuple[Panel, ...]
    contradiction: Mask  # (n,), where they contradict each other
    view: tuple[float, float]  # begin and end of the time [s] in which this is plainest
    label: str = "they contradict each other"  # what is seen there


class Severity(StrEnum):
    """What a finding means for a fit.

    Attributes
    ----------
    FAULT
        A fit refuses the logs.
    DOUBT
        A fit takes the logs, and its estimates may be wrong.
    NOTE
        It is worth knowing.
    """

    FAULT = "fault"
    DOUBT = "doubt"
    NOTE = "note"


@dataclass(frozen=True, eq=False)
class LogFinding:
    """One thing about a log.

    Attributes
    ----------
    message : str
        What is found, with figures, and the remedy.
    fault : bool
        The log cannot be used so; otherwise it is worth knowing.
    check : str
        The name of the check that found it, by which a user accepts it.
    log : str
        The log's name.
    evidence : Evidence, optional
        What `plotting.plot_finding` draws.
    severity : Severity
        Of all logs together; a log alone knows faults and notes.
    rows : (int, int), optional
        First and last row of the log's file that show it; none where the whole log does, or comes from no file.
    """

    channel: str
    message: str
    fault: bool
    check: str = ""
    log: str = ""
    evidence: Evidence | None = None
    severity: Severity = Severity.NOTE
    rows: tuple[int, int] | None = None


def examine(experiment: Experiment, axis: StatedAxis = PISTON) -> tuple[LogFinding, ...]:
    """Find what `CHECKS` see in a log before any model is fitted to it, faults first.

    The log's noise, where given, separates motion from noise.
    """
    from scipy.interpolate import CubicSpline

    log = experiment.trajectory
    moved = (n for n in (axis.position, axis.speed) if n in log and n not in experiment.noise)
    noise = {n: noise_level(log[n], log.t) for n in moved}  # which several checks need
    experiment = experiment.with_noise({n: level for n, level in noise.items() if level > 0})
    # each channel at every instant, as recorders that give each its own rate do not write it: by a cubic spline, but
    # not across a hole
    splines = dict[str, Array]()
    for n, known in ((n, np.isfinite(log[n])) for n in log):
        if 4 <= known.sum() < known.size:  # as a spline needs
            at, steps = log.t[known], np.diff(log.t[known])
            before = np.clip(np.searchsorted(at, log.t, side="right") - 1, 0, steps.size - 1)
            splines[n] = np.asarray(CubicSpline(at, log[n][known], extrapolate=False)(log.t))
            splines[n][steps[before] > MAX_STEPS_BETWEEN * float(np.median(steps))] = np.nan
            splines[n][known] = log[n][known]
    whole = replace(experiment, trajectory=log.with_columns(splines))
    logs = {name: experiment if name in SINGLE_SAMPLE_CHECKS else whole for name in CHECKS}
    named = ((name, finding) for name, check in CHECKS.items() for finding in check(logs[name], axis))
    found = [replace(finding, check=name, log=experiment.name) for name, finding in named]
    return tuple(sorted(found, key=lambda f: not f.fault))


def evidence(
    experiment: Experiment,
    *channels: str | Panel,
    where: Mask | None = None,
    at: int | None = None,
    motion: Array | None = None,
    label: str = "they contradict each other",
) -> Evidence:
    """The evidence of a finding, a panel a channel: `where` they contradict each other, seen about the sample `at`.

    By default they do so everywhere, and all samples are seen; `motion` is the speed, whose strokes say how much.
    """
    log = experiment.trajectory
    panels = [c if isinstance(c, Panel) else Panel(experiment.unit(c), {c: log[c]}) for c in channels if c]
    everywhere = np.ones(len(log), dtype=bool)
    view = float(log.t[0]), float(log.t[-1])
    if at is not None:  # a few strokes of the motion about it; an eighth of the log without motion
        duration, strokes = view[1] - view[0], 16
        if motion is not None and np.isfinite(motion).any():
            level = LARGE_SHARE * float(np.nanmax(np.abs(motion)))
            strokes = 1 + int(np.count_nonzero(np.diff(np.sign(motion[np.abs(motion) > level]))))
        view = _view_around(log.t, float(log.t[at]), float(log.t[at]), duration / strokes)
    return Evidence(log.t, tuple(panels), everywhere if where is None else where, view, label)


def is_opposed(a: Array, b: Array) -> Mask:
    """Where two signals have opposite signs, both beyond a tenth of their largest value."""
    return np.asarray(np.sign(a) * np.sign(b) < 0) & _is_large(a) & _is_large(b)


def _is_large(a: Array) -> Mask:
    return np.asarray(np.abs(a) > LARGE_SHARE * np.nanmax(np.abs(a), initial=0.0))


def _view_around(t: Array, begin: float, end: float, margin: float, least: int = 25) -> tuple[float, float]:
    """Begin and end of a span with a margin [s] to either side, of `least` samples or more; fewer look like noise."""
    margin = max(margin, least * float(np.median(np.diff(t))))
    return max(float(t[0]), begin - margin), min(float(t[-1]), end + margin)


class ForceBalance(NamedTuple):
    """The balance of forces over windows of a log, in SI units."""

    mass: float  # as estimated from the log, and so the offset
    offset: float
    friction: float  # Coulomb's part
    residual: float  # root mean square of what is left
    with_stated_mass: float  # the same with the stated mass
    without_offset: float  # the same without an offset
    spread: float  # standard deviation of the force
    rows: "_Rows"  # the windows

    def holds(self) -> bool:
        """Whether the balance explains the forces, with friction that brakes."""
        return self.residual < MAX_UNEXPLAINED * self.spread and self.friction > 0

    def contradicts(self, residual: float) -> bool:
        """Whether the log contradicts what leaves this residual."""
        return residual > max(MIN_RESIDUAL_FACTOR * self.residual, MIN_CONTRADICTION * self.spread)


_LAST_BALANCES: WeakKeyDictionary[Experiment, tuple[StatedAxis, ForceBalance | None]] = WeakKeyDictionary()


def check_mass(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a stated mass that force and acceleration contradict by a factor."""
    found = None if math.isnan(axis.inertia) else force_balance(experiment, axis)
    if found is None or not found.holds() or found.mass <= 0:
        return
    factor = found.mass / axis.inertia
    if 1 / MAX_MASS_FACTOR < factor < MAX_MASS_FACTOR:
        return
    if found.contradicts(found.with_stated_mass):
        left = [f"{100 * r / found.spread:.3g} %" for r in (found.residual, found.with_stated_mass)]
        message = f"force and acceleration are those of {found.mass:.3g} {axis.inertia_unit}, {factor:.3g} times the "
        message += f"stated {axis.inertia_name} of {axis.inertia:.3g} {axis.inertia_unit}"
        message += f" (of the force {left[0]} remain unexplained with the one, {left[1]} with the other)"
        remedy = f"correct {axis.inertia_name}, or the unit of the force, or free {axis.inertia_name}"
        shown = _accelerations(experiment, axis, found)
        yield LogFinding(axis.inertia_name, f"{message}: {remedy}", True, evidence=shown)


def _accelerations(experiment: Experiment, axis: StatedAxis, found: ForceBalance) -> Evidence:
    """What the force leaves behind friction, beside the stated mass times the acceleration."""
    rows = found.rows
    A = np.column_stack([rows.direction, rows.speed, np.ones(rows.t.size)])
    used = (rows.direction != 0) & np.isfinite(A).all(axis=1) & np.isfinite(rows.force)
    rest = rows.force - found.mass * rows.acceleration
    left = rows.force - A @ np.linalg.lstsq(A[used], rest[used])[0]
    needed = axis.inertia * rows.acceleration
    curves = {"force without friction": left, f"stated {axis.inertia_name} times acceleration": needed}
    shown = {n: np.where(used, curve, np.nan) for n, curve in curves.items()}
    differs = used & (np.abs(left - needed) > LARGE_SHARE * np.nanmax(np.abs(needed[used])))
    part = Experiment(Trajectory(rows.t, shown), name=experiment.name)
    at = int(np.nanargmax(np.abs(shown["force without friction"])))
    speed = Panel(experiment.unit(axis.speed), {"mean speed": rows.speed})
    return evidence(part, Panel(axis.force_unit, shown), speed, where=differs, at=at, motion=rows.speed)


def check_offset(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a constant by which the forces do not balance in either direction: a sensor's zero, or a load."""
    found = None if math.isnan(axis.constant) else force_balance(experiment, axis)
    if found is None or not found.holds():
        return
    is_large = abs(found.offset) > MIN_OFFSET_SHARE * abs(found.friction)
    if is_large and found.contradicts(found.without_offset):
        more = "more" if found.offset > 0 else "less"
        atmosphere = ATMOSPHERE * sum(weight for n, weight in axis.forces.items() if n.startswith("pressure_"))
        cause = "a sensor's zero is off: " + (
            f"free {axis.offset_parameter}, which takes it" if axis.offset_parameter else "take it off"
        )
        if abs(abs(found.offset) - abs(atmosphere)) < MAX_ATMOSPHERE_ERROR * abs(atmosphere):
            taken, meant, unit = ("gauge", "absolute", "bar(a)")
            if found.offset * atmosphere < 0:
                taken, meant, unit = ("absolute", "gauge", "bar(g)")
            cause = (
                f"{meant} pressures are taken for {taken} ones: write {unit} if they are, in the header or the sidecar"
            )
        message = (
            f"the drive pushes with {abs(found.offset):.3g} {axis.force_unit} {more} than the motion needs both ways"
        )
        message += f" (friction is {found.friction:.3g} {axis.force_unit}), as where {cause}"
        rows, centre = found.rows, np.full(found.rows.t.size, found.offset)
        # friction makes the force opposite in either direction
        curves = {"force of the drive": rows.force, "middle between both directions": centre}
        forces = Panel(axis.force_unit, {**curves, "where it should be": 0 * centre})
        part = Experiment(Trajectory(rows.t, {"force": rows.force}), name=experiment.name)
        speed, at = Panel(experiment.unit(axis.speed), {"mean speed": rows.speed}), int(np.argmax(np.abs(rows.speed)))
        shown = evidence(part, forces, speed, at=at, motion=rows.speed)
        yield LogFinding(axis.push, message, False, evidence=shown)


def force_balance(experiment: Experiment, axis: StatedAxis) -> ForceBalance | None:
    """The balance of forces over the windows of a log that move one way; None where motion or forces are not known.

    Newton's law holds under every weight: with a hat function w of half width H the mean of the acceleration is a
    second difference of the position, so that no noise is differentiated. Over the windows that move one way,

        mean(w F) = M (x(t + H) - 2 x(t) + x(t - H)) / H^2 + F_c sign(v) + b mean(w v) + F_0

    is linear in the mass M, friction F_c and b, and the offset F_0. The sensors may come late against each other, so
    that each alternative has the lag that suits it best.
    """
    axis_then, found = _LAST_BALANCES.get(experiment, (None, None))
    if axis_then is not axis:
        found = _fit_balance(experiment, axis)
        _LAST_BALANCES[experiment] = axis, found
    return found


def _fit_balance(experiment: Experiment, axis: StatedAxis) -> ForceBalance | None:
    rows = _weigh(experiment, axis)
    if rows is None:
        return None
    lags, n = [], rows.t.size  # each lag with what holds for it in the windows that move one way
    for lag in sensor_lags(rows.t, LAG_STEPS):
        late, early = slice(max(lag, 0), n + min(lag, 0)), slice(max(-lag, 0), n - max(lag, 0))
        a, s, v, f = rows.acceleration[late], rows.direction[late], rows.speed[late], rows.force[early]
        used = np.flatnonzero((s != 0) & np.isfinite(a) & np.isfinite(v) & np.isfinite(f))
        used = used[:: max(1, used.size // MAX_REGRESSION_ROWS)]
        lags.append((lag, a[used], s[used], v[used], f[used]))
    if min(min(int((s > 0).sum()), int((s < 0).sum())) for _, _, s, _, _ in lags) < MIN_HATS:
        return None
    if _rms(rows.acceleration) * (rows.t[1] - rows.t[0]) > MAX_PHASE_STEP * _rms(rows.speed):
        return None
    mass = 0.0 if math.isnan(axis.inertia) else axis.inertia
    columns = [np.column_stack([s, v, np.ones(v.size), a, f]) for _, a, s, v, f in lags]
    # the triangular factor over the root of the length: root mean squares of regressions stand in it
    one = [np.asarray(np.linalg.qr(each, mode="r"), dtype=float) / math.sqrt(len(each)) for each in columns]
    left = [abs(R[4, 4]) for R in one]
    # a lag turns speed into acceleration: of lags that leave about the same residual, the least one is assumed
    alike = [k for k in range(len(one)) if left[k] <= MIN_RESIDUAL_FACTOR * min(left)]
    chosen = min(alike, key=lambda k: (abs(lags[k][0]), left[k]))
    friction, _, offset, own_mass = np.linalg.lstsq(one[chosen][:, :4], one[chosen][:, 4])[0].tolist()
    stated = min(math.hypot(R[3, 4] - mass * R[3, 3], R[4, 4]) for R in one)
    fits = ((R[:, [0, 1, 3]], R[:, 4]) for R in one)
    centred = min(float(np.linalg.norm(f - A @ np.linalg.lstsq(A, f)[0])) for A, f in fits)
    return ForceBalance(own_mass, offset, friction, left[chosen], stated, centred, float(lags[chosen][4].std()), rows)


class _Rows(NamedTuple):
    """A log under hat functions: time, position's second difference, mean speed, mean force, direction (0: mixed)."""

    t: Array
    acceleration: Array
    speed: Array
    force: Array
    direction: Array


def _weigh(experiment: Experiment, axis: StatedAxis) -> _Rows | None:
    """The log under the narrowest hat functions whose second differences are motion and hardly noise."""
    log = experiment.trajectory
    moved = axis.position if axis.position in log else axis.speed
    if moved not in log or not axis.forces or any(n not in log for n in axis.forces):
        return None
    step = float(np.median(np.diff(log.t)))
    t = log.t[0] + step * np.arange(math.floor(float(log.t[-1] - log.t[0]) / step) + 1)
    x, force = np.interp(t, log.t, log[moved]), axis.net_force({n: np.interp(t, log.t, log[n]) for n in axis.forces})
    noise = experiment.noise[moved] if moved in experiment.noise else noise_level(log[moved], log.t)
    if moved == axis.speed:
        x, noise = np.append(0.0, np.cumsum((x[1:] + x[:-1]) * step / 2)), noise * step
    half = 1
    while 8 * half < t.size:
        a = (x[2 * half :] - 2 * x[half:-half] + x[: -2 * half]) / (half * step) ** 2
        if 6 * (noise / (half * step) ** 2) ** 2 < MAX_NOISE_SHARE * float(np.nanmean(a**2)):
            break
        half *= 2
    else:
        return None
    hat = (half - np.abs(np.arange(1 - half, half))) / half**2
    speed = (x[2 * half :] - x[: -2 * half]) / (2 * half * step)
    # by quarters: where a part of a window rests, friction is what holds the body there, and looks like a mass
    each, count = max(1, half // 2), speed.size
    edges = range(0, 2 * half, each)
    parts = np.array([x[k + each : k + each + count] - x[k : k + count] for k in edges]) / (each * step)
    least = LARGE_SHARE * float(np.nanquantile(np.abs(speed), 0.99))
    direction = np.where((parts > least).all(axis=0), 1.0, np.where((parts < -least).all(axis=0), -1.0, 0.0))
    return _Rows(t[half:-half], a, speed, np.convolve(force, hat, "same")[half:-half], direction)


def _rms(e: Array) -> float:
    return math.sqrt(float(np.nanmean(e**2)))


def check_dwells(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Note a log that stands still most of the time: which share is motion, and what is identified from it."""
    t, motion = experiment.trajectory.t, motion_speed(experiment, axis)
    if motion is None or not np.isfinite(motion).any():
        return
    known = np.isfinite(motion)
    moves = _find_moves(t[known], np.abs(motion[known]))
    moving = np.zeros(int(known.sum()), dtype=bool)
    for first, last in moves:
        moving[first:last] = True
    share = float(moving.mean())
    if len(moves) < 2 or share > MOST_MOTION:
        return
    signal, whole = axis.position if axis.position in experiment.trajectory else axis.speed, float(t[-1] - t[0])
    shares = f"{signal!r} moves in {share:.0%} of the log, {share * whole:.3g} of {whole:.3g} s, in {len(moves)} moves"
    these = "mass, Coulomb and viscous friction are identified from these moves, static friction from how each begins"
    still = np.zeros(len(t), dtype=bool)
    still[known] = ~moving
    shown = evidence(experiment, signal, where=still, label="it stands still")
    yield LogFinding(signal, f"{shares}, and stands still between them: {these}", False, evidence=shown)


def _find_moves(t: Array, size: Array) -> list[tuple[int, int]]:
    """First sample of each move and that after its last, from the speed's size."""
    noise = float(np.percentile(size, 25)) / 0.3186  # the lower quartile of |N(0, 1)|
    fast = float(np.quantile(size, FAST_QUANTILE))
    moving = np.flatnonzero(size > max(LEAST_SPEED * fast, NOISE_WIDTHS * noise))
    if noise > LARGE_SHARE * fast or not moving.size:
        return []
    breaks = np.flatnonzero(np.diff(t[moving]) > SHORTEST_REST)
    spans = list(zip(moving[np.r_[0, breaks + 1]], moving[np.r_[breaks, moving.size - 1]] + 1, strict=True))
    travelled = size * np.gradient(t)  # in the time of each sample
    ways = [float(travelled[first:last].sum()) for first, last in spans]
    return [(int(a), int(b)) for (a, b), way in zip(spans, ways, strict=True) if way > LEAST_WAY_SHARE * max(ways)]


def check_end_stops(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find rests at an extreme position under a push that moves the body everywhere else."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    if motion is None or axis.position not in log or not axis.forces or any(n not in log for n in axis.forces):
        return
    x, push, unit = log[axis.position], axis.net_force({n: log[n] for n in axis.forces}), experiment.unit(axis.position)
    way = float(np.nanmax(x) - np.nanmin(x))
    noise = experiment.noise[axis.position] if axis.position in experiment.noise else noise_level(x, log.t)
    width = max(STOP_WIDTH * noise, LEAST_WAY_SHARE * way)
    inside = (x > np.nanmin(x) + width) & (x < np.nanmax(x) - width)
    middle, level = _usual_push(inside, motion, push)
    for side, end in ((1, float(np.nanmax(x))), (-1, float(np.nanmin(x)))):
        held = (np.abs(x - end) < width) & (side * (push - middle) > MIN_STOP_FORCE_RATIO * level)
        edges = np.flatnonzero(
            np.diff(np.pad(held.astype(int), 1))
        )  # first samples of runs, and those after their last
        if not edges.size:
            continue
        begin, behind = max(
            zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True), key=lambda run: run[1] - run[0]
        )
        last = behind - 1
        is_long = last - begin >= MIN_SAMPLES and log.t[last] - log.t[begin] >= SHORTEST_REST
        if not is_long or any(
            abs(end - stop) < MAX_POSITION_ZERO_ERROR * float(np.ptp(axis.stops)) for stop in axis.stops
        ):
            continue
        force = float(np.median(push[begin : last + 1]))
        times = f"from {log.t[begin]:.4g} s to {log.t[last]:.4g} s"
        ratio = abs(force - middle) / level
        pushed = f"{force:.3g} {axis.force_unit} push it on, {ratio:.2g} times what moves it elsewhere"
        message = f"{axis.position!r} stays at {write_value(end, unit, 4)} {times} while {pushed}, as at an end stop"
        message += " that the model has not: leave these rows out, the log is cut there"
        panel, at = Panel(axis.force_unit, {"force of the drive": push}), (begin + last) // 2
        shown = evidence(experiment, axis.position, panel, where=held, at=at, motion=motion, label="stop")
        yield LogFinding(axis.position, message, True, evidence=shown)


def _usual_push(inside: Mask, motion: Array, push: Array) -> tuple[float, float]:
    """The middle of the pushes that move the body each way, and how far from it a push moves or holds it."""
    fast = LARGE_SHARE * float(np.nanquantile(np.abs(motion), 0.99))
    moving = [side * motion > fast for side in (1, -1)]
    ways = [push[each] for each in moving]
    known = [float(np.nanmedian(way)) for way in ways if way.size >= MIN_SAMPLES]
    travels = [float(np.sum(np.abs(motion[each]))) for each in moving]
    # noise in rest goes either way: a body that only advances has no middle
    goes_back = min(travels) > LARGE_SHARE * max(travels)
    middle = sum(known) / 2 if len(known) == 2 and goes_back else 0.0
    pushes = np.abs(np.concatenate(ways) - middle)
    held = np.abs(push[(np.abs(motion) < fast) & inside] - middle)
    holding = float(np.nanquantile(held, 0.99)) if held.size >= MIN_SAMPLES else 0.0
    return middle, max(float(np.nanmedian(pushes)), holding)


def check_jumps(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find jumps of the position that no motion explains."""
    log = experiment.trajectory
    if axis.position not in log or axis.position != PISTON.position:
        return
    known = np.flatnonzero(np.isfinite(log[axis.position]))
    t, x = log.t[known], log[axis.position][known]
    if known.size < 4 * NEIGHBOURS:
        return
    time, steps = np.diff(t), np.diff(x)
    speed = np.abs(steps) / time
    usual = float(np.quantile(speed, FAST_QUANTILE))
    padded = np.pad(speed, NEIGHBOURS)
    shifts = [k for k in range(2 * NEIGHBOURS + 1) if k != NEIGHBOURS]
    around = np.max([padded[k : k + speed.size] for k in shifts], axis=0)
    is_fast = speed > MIN_JUMP_SPEED_RATIO * np.maximum(around, usual)
    jumps = np.flatnonzero(is_fast & (4 * speed / time > MIN_JUMP_ACCELERATION))
    if jumps.size:  # few logs have abrupt steps, and only theirs need a level of the noise
        noise = max(experiment.noise.get(axis.position, 0.0), noise_level(x, t))
        jumps = jumps[np.abs(steps)[jumps] > MIN_JUMP_NOISE * noise]
    if jumps.size:
        first = int(jumps[0])
        limit = f"{speed[first]:.3g} m/s; the log usually moves below {usual:.2g} m/s"
        message = (
            f"{axis.position!r} jumps by {1e3 * steps[first]:.3g} mm within a sample at {t[first + 1]:.4g} s ({limit})"
        )
        remedy = ": cut the log in two there"
        if jumps.size > 1:
            more = "and again" if jumps.size == 2 else f"and {jumps.size - 1} times more, next"
            remedy = f", {more} at {t[jumps[1] + 1]:.4g} s: leave the cells of {axis.position!r} in between empty"
        shown = _jump_evidence(experiment, axis, known, jumps)
        yield LogFinding(axis.position, message + remedy, True, evidence=shown)


def _jump_evidence(experiment: Experiment, axis: StatedAxis, known: Indices, jumps: Indices) -> Evidence:
    """The position, and the speed that it would need."""
    log = experiment.trajectory
    t, speed = log.t, np.full(len(log), np.nan)
    speed[known[1:]] = np.diff(log[axis.position][known]) / np.diff(t[known])
    begin, end = t[known[jumps[0]]], t[known[jumps[min(1, jumps.size - 1)] + 1]]
    where = np.zeros(len(log), dtype=bool)
    for jump in jumps:
        where[known[jump] : known[jump + 1] + 1] = True
    needed = Panel("m/s", {f"slope of the {axis.position}": speed})
    shown = evidence(experiment, axis.position, needed, where=where, label="jump")
    return replace(shown, view=_view_around(t, begin, end, end - begin))


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


def check_pressures(experiment: Experiment, _: StatedAxis) -> Iterator[LogFinding]:
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
            least = MIN_PRESSURE_RATIO * ATMOSPHERE
            shown = _beside(experiment, name, "no chamber is exhausted further", least, above=False)
            yield LogFinding(name, message, True, evidence=shown)
        elif high > MAX_PRESSURE:
            message = f"{name!r} rises to {high / 1e5:.3g} bar(a), more than air drives have: its unit?"
            yield LogFinding(name, message, True, evidence=_beside(experiment, name, "highest of drives", MAX_PRESSURE))
        elif supply is not None and high > 1.1 * supply and name != "supply_pressure":
            message = f"{name!r} rises to {high / 1e5:.2f} bar(a), above the supply of {supply / 1e5:.2f} bar(a)"
            shown = _beside(experiment, name, "supply", supply)
            yield LogFinding(name, f"{message}; is an absolute sensor read as bar(g)?", True, evidence=shown)


def _beside(experiment: Experiment, name: str, label: str, limit: float, *, above: bool = True) -> Evidence:
    """A pressure beside a limit that it crosses, about where it is farthest beyond."""
    p = experiment.trajectory[name]
    at = int(np.nanargmax(p) if above else np.nanargmin(p))
    panel = Panel("Pa(a)", {name: p, label: np.full(p.size, limit)})
    return evidence(experiment, panel, where=(p > limit) if above else (p < limit), at=at)


def check_sampling(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find jitter, clipping and coarse resolution."""
    log = experiment.trajectory
    steps = np.diff(log.t)
    usual = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - usual))) * 1.4826
    if jitter > 0.05 * usual:
        message = f"the samples jitter by {jitter / usual:.0%} of {usual:g} s; their times are used"
        lengths = np.append(steps, steps[-1])
        uneven = np.abs(lengths - usual) > 0.05 * usual
        shown = evidence(experiment, Panel("s", {"time to the next sample": lengths}), where=uneven)
        yield LogFinding("time", message, False, evidence=shown)
    for name in log:
        y = log[name][np.isfinite(log[name])]
        levels = np.unique(y).size
        for end, which in ((y.max(initial=-np.inf), "largest"), (y.min(initial=np.inf), "smallest")):
            share = float(np.mean(y == end)) if y.size else 0.0
            if name.startswith("pressure") and levels > 50 and share > CLIPPED_SHARE:
                message = f"{share:.0%} of {name!r} are exactly its {which} value: is the sensor clipped?"
                shown = evidence(experiment, name, where=log[name] == end)
                yield LogFinding(name, message, False, evidence=shown)
        if name in (axis.position, axis.speed) and 2 < levels < min(50, y.size // 4):
            message = f"{name!r} has only {levels} levels, the resolution is coarse for the motion"
            yield LogFinding(name, message, False, evidence=evidence(experiment, name, at=len(log) // 2))


def check_position_speed(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a speed that is not the slope of the position, in sign or in unit."""
    log = experiment.trajectory
    if axis.position not in log or axis.speed not in log:
        return
    known = np.isfinite(log.matrix((axis.position, axis.speed))).all(axis=1)
    log = Trajectory(log.t[known], {n: log[n][known] for n in log})
    experiment = replace(experiment, trajectory=log, holes=())
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
        pairs = [shift(slope, mean, best) for mean in means]
        ratios = [float(a @ b) / float(a @ a) for a, b in pairs]  # of their sizes, by regression
        # trapezoids and parabolas through the speed err in opposite directions where its samples are far apart
        if max(ratios) < SPEED_SLOPE_RATIOS[0] or min(ratios) > SPEED_SLOPE_RATIOS[1]:
            message = f"{axis.speed} is {ratios[0]:.3g} times the slope of the {axis.position}: check both units"
            fast = np.abs(slope) > LARGE_SHARE * np.nanmax(np.abs(slope))
            shown = _speeds(experiment, axis, slope, fast, int(np.nanargmax(np.abs(slope))))
            yield LogFinding(axis.speed, message, True, evidence=shown)


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
    drives = {axis.push: (f"the {axis.push} brakes", f"'{axis.push}'")} if axis.push in log else {}
    if "pressure_a" in log and "pressure_b" in log:
        drives["pressures"] = ("the pressures brake", "the position, or exchange pressure_a and pressure_b")
    for name, (message, remedy) in drives.items():
        if name == axis.push:
            pushes, unit, shown = [log[name]], experiment.unit(name), Panel(experiment.unit(name), {name: log[name]})
        else:
            unit, shown = "Pa", Panel("Pa(a)", {n: log[n] for n in ("pressure_a", "pressure_b")})
            pushes = [log["pressure_a"] - ratio * log["pressure_b"] for ratio in ROD_AREA_RATIOS]
            pushes = [push - np.nanmean(push) for push in pushes]
        shares = np.stack([_work_shares(log.t, np.stack(pushes), motion, lag) for lag in sensor_lags(log.t)], axis=1)
        share = max(shares.ravel().tolist())
        if share < MIN_WORK_SHARE:
            at = int(np.nanargmin(pushes[-1] * motion))
            fast = f"{motion[at]:.3g} {experiment.unit(axis.speed)}"
            seen = f"most at {log.t[at]:.4g} s, where {pushes[-1][at]:.3g} {unit} pushes and the speed is {fast}"
            why = f"{message} the motion on balance ({100 * share:.0f} % of its power, {seen}), which no drive does"
            speed = speed_panel(experiment, axis, motion)
            brakes = is_opposed(pushes[-1], motion)
            found = evidence(experiment, shown, speed, where=brakes, at=at, motion=motion, label="it brakes")
            yield LogFinding(name, f"{why}: change the sign of {remedy}", True, evidence=found)


def check_command(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a piston that runs against its valve's command, or without one."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    if motion is None or "valve_voltage" not in log or not axis.is_piston:
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
    grid = np.linspace(t[0], t[-1], t.size)
    u, v = np.interp(grid, t, command), np.interp(grid, t, motion)
    most = min(round(MAX_COMMAND_LAG / float(grid[1] - grid[0])), t.size // 4)
    lags = range(0, most + 1, max(1, most // MEAN_BLOCKS))
    if np.ptp(v) == 0 or any(np.ptp(u[: u.size - k]) == 0 for k in lags):
        return
    correlations = [float(np.corrcoef(u[: u.size - k], v[k:])[0, 1]) for k in lags]
    lowest = min(correlations)
    if lowest < WRONG_SIGN_CORRELATIONS[0] and max(correlations) < WRONG_SIGN_CORRELATIONS[1]:
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
    if rows.size < MIN_SAMPLES:
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
        elif y.size >= 2 * MEAN_BLOCKS and _is_motionless(y, noise, name == axis.position):
            message = f"{name!r} shows noise and no motion: log a run in which the drive moves"
            yield LogFinding(name, message, True, evidence=_stillness(experiment, name, axis))


def check_scale(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find motion of a size that no drive has, as millimetres that are read as metres."""
    log, motion = experiment.trajectory, motion_speed(experiment, axis)
    fastest = 0.0 if motion is None else float(np.nanpercentile(np.abs(motion), 99))
    if axis.position == PISTON.position and axis.is_piston and fastest > MAX_PISTON_SPEED:
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


def _is_motionless(y: Array, noise: float, is_position: bool) -> bool:
    """Whether a channel, and its block means, vary by no more than its noise, which has no rhythm.

    Or its samples are uncorrelated, which the position of a moving mass never is.
    """
    e = y - y.mean()
    power = float(e @ e)
    lags = range(1, min(WHITE_LAGS, y.size - 1) + 1) if power > 0 else ()
    correlation = max((abs(float(e[k:] @ e[:-k]) / power) for k in lags), default=0.0)
    if is_position and correlation < 4 / math.sqrt(y.size):
        return True
    size = y.size // MEAN_BLOCKS
    means = y[: MEAN_BLOCKS * size].reshape(MEAN_BLOCKS, size).mean(axis=1)
    is_small = float(means.std()) < 3 * noise / math.sqrt(size) and float(y.std()) < 2 * noise
    return is_small and (float(np.ptp(y)) <= STILL_STEPS * find_resolution(y) or correlation < MIN_SPEED_CORRELATION)


CHECKS: dict[str, Callable[[Experiment, StatedAxis], Iterator[LogFinding]]] = {
    "motion": check_has_motion,
    "speed": check_position_speed,
    "work": check_work_sign,
    "command": check_command,
    "scale": check_scale,
    "jumps": check_jumps,
    "stops": check_end_stops,
    "mass": check_mass,
    "offset": check_offset,
    "pressures": check_pressures,
    "sampling": check_sampling,
    "dwells": check_dwells,
}
"""The checks by the names under which a user accepts what they find: a log that is right all the same."""
SINGLE_SAMPLE_CHECKS = ("motion", "jumps", "sampling")
"""Checks of single samples, to which nothing is to be added."""
