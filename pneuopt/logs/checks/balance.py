"""`check_mass`, `check_offset`: what a log says of the force balance, beside the mass and the forces that are stated.

Newton's law holds under every weight: with a hat function w of half width H the mean of the acceleration is a second
difference of the position, so that no noise is differentiated. Over the windows that move one way,

    mean(w F) = M (x(t + H) - 2 x(t) + x(t - H)) / H^2 + F_c sign(v) + b mean(w v) + F_0

is linear in the mass M, friction F_c and b, and the offset F_0. The sensors may come late against each other, so that
each alternative has the lag that suits it best.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from pneuopt.logs.checks.findings import LARGE_SHARE, Evidence, LogFinding, Panel, StatedAxis, evidence
from pneuopt.logs.checks.motion import sensor_lags
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE

MIN_RESIDUAL_FACTOR = 2.0
"""Residual with the stated value over that with the log's own [1]: lower blames values for what no model has, higher
leaves wrong ones to the fit, which ends in a misfit."""
MAX_UNEXPLAINED = 0.15
"""Residual of the balance over the spread of the force [1] up to which it says something: higher lets a balance speak
that holds for nothing, lower skips noisy forces."""
MIN_CONTRADICTION = 0.1
"""Residual with the stated value over the spread of the force [1] that is worth a word: lower blames a light mass whose
force the sensors' lags hide, and a right one that sticks and slips, as its friction falls while it speeds up (6 % of
the force); higher passes wrong ones in slow motion."""
MAX_MASS_FACTOR = 1.5
"""Factor [1] by which a stated mass may be off: lower blames what lags of sensors do, higher passes a lost carriage."""
MIN_OFFSET_SHARE = 0.2
"""Offset over friction [1] that is worth a word: lower speaks of every sensor, higher passes what moves estimates."""
MAX_ATMOSPHERE_ERROR = 0.2
"""Share [1] by which an offset may miss one atmosphere on the difference of a piston's areas: lower forgets gauge
pressures on a log with noise, higher blames their unit for another force."""
MAX_NOISE_SHARE = 2e-3
"""Share of the accelerations' variance [1] that noise may have: higher makes masses small, lower blurs fast motion."""
MIN_HATS = 30
"""Windows each way [1] that a balance needs: fewer fit any mass."""
MAX_PHASE_STEP = 0.25
"""Phase of the motion from sample to sample [rad]: higher leaves lags of a part of a sample, which look like a mass."""
LAG_STEPS = 20
"""Lags each way that are tried: fewer leave a lag of milliseconds, which looks like a mass under viscous friction."""
MAX_HATS = 2000
"""Windows that are used of a log [1]: more cost time and say the same."""


class Balance(NamedTuple):
    """What windows of a log say of its forces.

    Attributes
    ----------
    mass, offset : float
        [kg], [N]: what the log itself shows.
    friction : float
        Coulomb's part [N].
    residual : float
        Root mean square of what is left [N].
    with_stated_mass, without_offset : float
        The same with the stated mass; without an offset [N].
    spread : float
        Standard deviation of the force [N].
    """

    mass: float
    offset: float
    friction: float
    residual: float
    with_stated_mass: float
    without_offset: float
    spread: float

    def holds(self) -> bool:
        """Whether the balance explains the forces, with friction that brakes."""
        return self.residual < MAX_UNEXPLAINED * self.spread and self.friction > 0

    def contradicts(self, residual: float) -> bool:
        """Whether the log contradicts what leaves this residual."""
        return residual > max(MIN_RESIDUAL_FACTOR * self.residual, MIN_CONTRADICTION * self.spread)


_LAST_BALANCES: WeakKeyDictionary[Experiment, tuple[StatedAxis, Balance | None]] = WeakKeyDictionary()


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
        yield LogFinding(
            axis.inertia_name, f"{message}: {remedy}", True, evidence=_accelerations(experiment, axis, found)
        )


def check_offset(experiment: Experiment, axis: StatedAxis) -> Iterator[LogFinding]:
    """Find a constant by which the forces do not balance in either direction: a sensor's zero, or a load."""
    found = None if math.isnan(axis.constant) else force_balance(experiment, axis)
    if found is None or not found.holds():
        return
    is_large = abs(found.offset) > MIN_OFFSET_SHARE * abs(found.friction)
    if is_large and found.contradicts(found.without_offset):
        more = "more" if found.offset > 0 else "less"
        message = (
            f"the drive pushes with {abs(found.offset):.3g} {axis.force_unit} {more} than the motion needs both ways"
        )
        message += (
            f" (friction is {found.friction:.3g} {axis.force_unit}), as where {_offset_cause(axis, found.offset)}"
        )
        yield LogFinding(axis.push, message, False, evidence=_forces(experiment, axis, found))


def _offset_cause(axis: StatedAxis, offset: float) -> str:
    """What shifts the forces by this much, and the remedy: pressures that are one atmosphere off, or some zero."""
    atmosphere = ATMOSPHERE * sum(weight for n, weight in axis.forces.items() if n.startswith("pressure_"))
    if abs(abs(offset) - abs(atmosphere)) < MAX_ATMOSPHERE_ERROR * abs(atmosphere):
        taken, meant, unit = (
            ("absolute", "gauge", "bar(g)") if offset * atmosphere < 0 else ("gauge", "absolute", "bar(a)")
        )
        return f"{meant} pressures are taken for {taken} ones: write {unit} if they are, in the header or the sidecar"
    remedy = f"free {axis.offset_parameter}, which takes it" if axis.offset_parameter else "take it off"
    return f"a sensor's zero is off: {remedy}"


def force_balance(experiment: Experiment, axis: StatedAxis) -> Balance | None:
    """The balance of forces over the windows of a log that move one way; None where motion or forces are not known.

    Two checks ask for that of one log, one after the other.
    """
    axis_then, found = _LAST_BALANCES.get(experiment, (None, None))
    if axis_then is not axis:
        found = _fit_balance(experiment, axis)
        _LAST_BALANCES[experiment] = axis, found
    return found


def _fit_balance(experiment: Experiment, axis: StatedAxis) -> Balance | None:
    rows = _weigh(experiment, axis)
    if rows is None:
        return None
    lags = [(lag, *_columns(rows, lag)) for lag in sensor_lags(rows.t, LAG_STEPS)]
    if min(min(int((s > 0).sum()), int((s < 0).sum())) for _, _, s, _, _ in lags) < MIN_HATS:
        return None
    if _rms(rows.acceleration) * (rows.t[1] - rows.t[0]) > MAX_PHASE_STEP * _rms(rows.speed):
        return None
    mass = 0.0 if math.isnan(axis.inertia) else axis.inertia
    one = [_factor(np.column_stack([s, v, np.ones(v.size), a, f])) for _, a, s, v, f in lags]
    left = [abs(R[4, 4]) for R in one]
    # a lag turns speed into acceleration: where the log hardly tells lags apart, the least one is assumed
    told = [k for k in range(len(one)) if left[k] <= MIN_RESIDUAL_FACTOR * min(left)]
    chosen = min(told, key=lambda k: (abs(lags[k][0]), left[k]))
    friction, _, offset, own_mass = np.linalg.lstsq(one[chosen][:, :4], one[chosen][:, 4])[0].tolist()
    stated = min(math.hypot(R[3, 4] - mass * R[3, 3], R[4, 4]) for R in one)
    centred = min(_rms_left(R[:, [0, 1, 3]], R[:, 4]) for R in one)
    return Balance(own_mass, offset, friction, left[chosen], stated, centred, float(lags[chosen][4].std()))


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
    x, force = _on_grid(log.t, log[moved], t), axis.net_force({n: _on_grid(log.t, log[n], t) for n in axis.forces})
    noise = experiment.noise[moved] if moved in experiment.noise else noise_level(log[moved], log.t)
    if moved == axis.speed:
        x, noise = np.append(0.0, np.cumsum((x[1:] + x[:-1]) * step / 2)), noise * step
    half = 1
    while 8 * half < t.size:
        a = (x[2 * half :] - 2 * x[half:-half] + x[: -2 * half]) / (half * step) ** 2
        if 6 * (noise / (half * step) ** 2) ** 2 < MAX_NOISE_SHARE * float(np.nanmean(a**2)):
            return _rows(t, x, a, force, half)
        half *= 2
    return None


def _rows(t: Array, x: Array, a: Array, force: Array, half: int) -> _Rows:
    step = float(t[1] - t[0])
    hat = (half - np.abs(np.arange(1 - half, half))) / half**2
    speed = (x[2 * half :] - x[: -2 * half]) / (2 * half * step)
    # by quarters: where a part of a window rests, friction is what holds the body there, and looks like a mass
    each, count = max(1, half // 2), speed.size
    edges = range(0, 2 * half, each)
    parts = np.array([x[k + each : k + each + count] - x[k : k + count] for k in edges]) / (each * step)
    least = LARGE_SHARE * float(np.nanquantile(np.abs(speed), 0.99))
    direction = np.where((parts > least).all(axis=0), 1.0, np.where((parts < -least).all(axis=0), -1.0, 0.0))
    mean = np.convolve(force, hat, "same")[half:-half]
    return _Rows(t[half:-half], a, speed, mean, direction)


def _on_grid(t: Array, y: Array, grid: Array) -> Array:
    """A column on an even grid; NaN beside missing samples."""
    return np.asarray(np.interp(grid, t, y))


def _columns(rows: _Rows, lag: int) -> tuple[Array, Array, Array, Array]:
    """Acceleration, direction, speed, and the force earlier by a lag, of the windows that move one way."""
    n = rows.t.size
    late, early = slice(max(lag, 0), n + min(lag, 0)), slice(max(-lag, 0), n - max(lag, 0))
    a, s, v, f = rows.acceleration[late], rows.direction[late], rows.speed[late], rows.force[early]
    used = np.flatnonzero((s != 0) & np.isfinite(a) & np.isfinite(v) & np.isfinite(f))
    used = used[:: max(1, used.size // MAX_HATS)]
    return a[used], s[used], v[used], f[used]


def _factor(columns: Array) -> Array:
    """The triangular factor of columns over the root of their length: root mean squares of regressions stand in it."""
    return np.asarray(np.linalg.qr(columns, mode="r"), dtype=float) / math.sqrt(len(columns))


def _rms_left(A: Array, f: Array) -> float:
    return float(np.linalg.norm(f - A @ np.linalg.lstsq(A, f)[0]))


def _rms(e: Array) -> float:
    return math.sqrt(float(np.nanmean(e**2)))


def _accelerations(experiment: Experiment, axis: StatedAxis, found: Balance) -> Evidence | None:
    """What the force leaves behind friction, beside the stated mass times the acceleration."""
    rows = _weigh(experiment, axis)
    if rows is None:
        return None
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


def _forces(experiment: Experiment, axis: StatedAxis, found: Balance) -> Evidence | None:
    """The force beside its mean in either direction, which friction makes opposite."""
    rows = _weigh(experiment, axis)
    if rows is None:
        return None
    force, centre = rows.force, np.full(rows.t.size, found.offset)
    curves = {"force of the drive": force, "middle between both directions": centre, "where it should be": 0 * centre}
    part = Experiment(Trajectory(rows.t, {"force": force}), name=experiment.name)
    at = int(np.argmax(np.abs(rows.speed)))
    speed = Panel(experiment.unit(axis.speed), {"mean speed": rows.speed})
    return evidence(part, Panel(axis.force_unit, curves), speed, at=at, motion=rows.speed)
