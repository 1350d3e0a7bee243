"""Responses with their derivatives to the gains, as rows of a max-type problem in gains and settling time.

The settling time Ts is an unknown: from Ts on the averaged response shall lie within the band, so that for given gains
the objective is smooth where the settling time itself jumps. Nodes after Ts move with it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pneuopt.codegen import Rollout
from pneuopt.control.metrics import PERIODS_INSIDE, TAIL, end_mean, period_mean
from pneuopt.nlp.sqp import Groups, Point
from pneuopt.requirements import MaxSensitivity, Overshoot, PeakControl, SettlingTime, SteadyStateError
from pneuopt.specification import Specification
from pneuopt.tuning.simulator import CONTROL, SIGNAL, Grid, Simulator, is_sound, watched

Array = NDArray[np.float64]
Index = NDArray[np.intp]
KINDS = (Overshoot, SteadyStateError, PeakControl, MaxSensitivity)
BAND = 50.0  # what leaving the band by the whole step costs at least, times the objective's scale
LIMIT = 2.0  # what a limit missed by its whole size costs, times the same
FREELY = 5.0  # trust region of Ts over that of the gains: with 1 it, not they, was what held steps back
LANES = 64  # that are run and read at a time
NUDGE = 1e-4  # of a gain's range: the sensitivity is differentiated over it
SHAPING = ("pid.Kp", "pid.Ki", "pid.Kd", "pid.Tf")  # gains that the sensitivity feels


@dataclass(frozen=True, eq=False)
class Reading:
    """What was read off one point's responses to one reference, C cases on K nodes, by n gains.

    Attributes
    ----------
    error : ndarray, shape (C, K)
        The averaged signal's distance from the reference, a fraction of the step; inf where it runs away.
    by_gain : ndarray, shape (C, K, n)
    values, derivatives : dict of type to ndarray, shapes (C, R) and (C, R, n)
        Rows of the other requirements.
    """

    error: Array
    by_gain: Array
    values: dict[type, Array]
    derivatives: dict[type, Array]


class Linearised:
    """The problem that `nlp.sqp` minimises: unknowns are the gains as numbers from 0 to 1, and Ts over the horizon.

    Parameters
    ----------
    simulator : Simulator
        Of the cases that count.
    rollout : Rollout
        Of `differentiated`.
    spec : Specification
    nodes : int
        At which a response is read.
    scale : float
        What the objective is of the order of, which the penalties have to beat.

    Attributes
    ----------
    bounds : ndarray, shape (n + 1, 2)
    scales : ndarray, shape (n + 1,)
    horizon : float
        [s]
    count : int
        Candidates simulated.
    """

    def __init__(self, simulator: Simulator, rollout: Rollout, spec: Specification, nodes: int, scale: float) -> None:
        self._simulator, self._rollout, self._spec, self.count = simulator, rollout, spec, 0
        self._scale = scale
        self._space = simulator.space
        self._order = list(simulator.loop.parameters)
        self._wrt = [self._order.index(n) for n in self._space.names]
        self._cases = [np.flatnonzero(own) for own in simulator.by_grid()]
        self._periods = simulator.averaged_over()
        self.horizon = min(g.reference.horizon - g.reference.at for g in simulator.grids)
        self._nodes = [_nodes(g, nodes, max(self._periods, default=0.0)) for g in simulator.grids]
        self._latest = (1 - TAIL) * self.horizon
        self._latest = min(self._latest, self.horizon - PERIODS_INSIDE * max(self._periods, default=0.0))
        most = min(self._latest, spec.limit(SettlingTime))
        low = most if spec.concerns(SettlingTime) and not spec.weight(SettlingTime) else 0.0
        self.bounds = np.array([*[[0.0, 1.0]] * len(self._space.names), [low / self.horizon, most / self.horizon]])
        self.scales = np.append(np.ones(len(self._space.names)), FREELY)

    def start(self, unit: Array) -> Array:
        """Unknowns for gains, shape (m, n + 1): Ts as late as may be, which `improve` mends."""
        return np.column_stack([np.clip(unit, 0.0, 1.0), np.full(len(unit), self.bounds[-1, 1])])

    def evaluate(self, z: Array) -> Sequence[Point]:
        """Simulate and linearise each row of z."""
        self.count += len(z)
        readings = self._read(z[:, :-1])
        return [self._point(row, reading) for row, reading in zip(z, readings, strict=True)]

    def improve(self, point: Point) -> Point:
        """The same gains with their best Ts: the earliest, or one a little early if that is worth its penalty."""
        weight = self._spec.weight(SettlingTime)
        readings: Sequence[Reading] = point.data
        if not weight or not np.isfinite(point.values).any() or np.isinf(point.merit):
            return point
        times = np.unique(np.concatenate(self._nodes))
        late, crossings = np.zeros(len(times)), np.zeros(len(times))
        for t, reading in zip(self._nodes, readings, strict=True):
            size = np.abs(reading.error)
            after = np.maximum.accumulate(size.max(axis=0)[::-1])[::-1]
            k = np.searchsorted(t, times)
            late = np.maximum(late, np.append(after, 0.0)[k])
            crossings = np.maximum(crossings, np.append(_crossings(t, size, self._spec.band), np.inf)[k])
        excess = np.maximum(late - self._spec.band, 0.0)
        times = np.where(excess == 0, np.minimum(crossings, times), times)
        costs = np.where(
            times <= self.bounds[-1, 1] * self.horizon, weight * times + self._band_weight * excess, np.inf
        )
        best = times[np.argmin(costs)] / self.horizon
        moved = self._point(np.append(point.z[:-1], best), readings)
        return moved if moved.merit < point.merit else point

    @cached_property
    def _band_weight(self) -> float:
        return self._scale * max(BAND, 1 / self._spec.band)

    @cached_property
    def _groups(self) -> tuple[list[tuple[type, float, bool]], Groups]:
        """Rows' kinds, what their values are divided by, whether they are limits; the band's is the first group."""
        kinds, weights, floors = list[tuple[type, float, bool]](), [], []
        if self._spec.concerns(SettlingTime):
            kinds, weights, floors = [(SettlingTime, 1.0, True)], [self._band_weight], [0.0]
        for kind in KINDS:
            weight, limit = self._spec.weight(kind), self._spec.limit(kind)
            if weight > 0:
                kinds.append((kind, 1.0, False))
                weights.append(weight)
                floors.append(0.0 if kind in (Overshoot, SteadyStateError) else -np.inf)
            if limit < np.inf:
                kinds.append((kind, limit, True))
                weights.append(LIMIT * self._scale)
                floors.append(0.0)
        return kinds, Groups(np.array(weights), np.array(floors))

    def _point(self, z: Array, readings: Sequence[Reading]) -> Point:
        kinds, groups = self._groups
        values, slopes, group = list[Array](), list[Array](), list[Index]()
        for g, (kind, size, is_limit) in enumerate(kinds):
            for t, reading in zip(self._nodes, readings, strict=True):
                if kind is SettlingTime:
                    v, s = self._band_rows(t, reading, float(z[-1] * self.horizon))
                else:
                    v, s = reading.values[kind] / size - is_limit, reading.derivatives[kind] / size
                    s = np.concatenate([s, np.zeros((*v.shape, 1))], axis=-1)
                values.append(v.ravel())
                slopes.append(s.reshape(-1, s.shape[-1]))
                group.append(np.full(v.size, g))
        weight = self._spec.weight(SettlingTime) * self.horizon
        gradient = np.append(np.zeros(len(z) - 1), weight)
        rows, whose = (np.concatenate(values), np.concatenate(slopes)), np.concatenate(group)
        return Point(z, float(weight * z[-1]), gradient, *rows, whose, groups, readings)

    def _band_rows(self, t: Array, reading: Reading, Ts: float) -> tuple[Array, Array]:
        """Both sides of the band at as many instants from Ts to the end, which move with it."""
        late = np.linspace(0.0, 1.0, len(t))
        at = Ts + late * (t[-1] - Ts)
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        with np.errstate(invalid="ignore"):
            step = reading.error[:, k + 1] - reading.error[:, k]
            error = reading.error[:, k] + share * step
            by_time = step / (t[k + 1] - t[k]) * (1 - late) * self.horizon
        by_gain = reading.by_gain[:, k] * (1 - share)[:, None] + reading.by_gain[:, k + 1] * share[:, None]
        slopes = np.concatenate([by_gain, by_time[..., None]], axis=-1)
        return np.array([error, -error]) - self._spec.band, np.array([slopes, -slopes])

    def _read(self, unit: Array) -> list[list[Reading]]:
        """Readings of each point, one a reference."""
        points = self._space.draw(unit)
        found: list[list[Reading]] = [[] for _ in points]
        for g, own in enumerate(self._cases):
            rows, case = np.repeat(np.arange(len(points)), len(own)), np.tile(own, len(points))
            parts = [
                self._lanes(g, points, rows[k : k + LANES], case[k : k + LANES]) for k in range(0, len(rows), LANES)
            ]
            whole = _joined(parts)
            for i in range(len(points)):
                found[i].append(_part(whole, slice(i * len(own), (i + 1) * len(own))))
        return found

    def _lanes(self, g: int, points: Array, rows: Index, case: Index) -> Reading:
        """Simulate lanes on one grid and read them."""
        grid = self._simulator.grids[g]
        p, starts = self._simulator.lanes(points, rows, case)
        u, instants, h, steps = self._simulator.padded(case)
        with np.errstate(all="ignore"):
            found = self._rollout.run(starts, u, p, instants, h, substeps=steps)
        after = int(np.searchsorted(grid.t, grid.reference.at - 1e-12))
        assert found.dy is not None
        lanes = _Lanes(
            grid,
            grid.t[after:] - grid.reference.at,
            found.y[:, after:],
            found.dy[:, after:],
            is_sound(found.y, found.x_end) & np.isfinite(found.dy[:, -1]).all(axis=(1, 2)),
            self._chain(points, rows, case),
            [self._periods[k] for k in case.tolist()],
        )
        if not lanes.sound.all():
            lanes.y[~lanes.sound], lanes.dy[~lanes.sound] = 0.0, 0.0
        error, by_gain = lanes.averaged(self._nodes[g])
        values: dict[type, Array] = {Overshoot: np.where(lanes.sound[:, None], error, np.inf)}
        derivatives: dict[type, Array] = {Overshoot: by_gain}
        if self._spec.concerns(SteadyStateError):
            values[SteadyStateError], derivatives[SteadyStateError] = lanes.at_end()
        if self._spec.concerns(PeakControl):
            values[PeakControl], derivatives[PeakControl] = lanes.peaks(len(self._nodes[g]))
        if self._spec.concerns(MaxSensitivity):
            robust = self._robust(p, found.x_end, lanes, points[rows], case)
            values[MaxSensitivity], derivatives[MaxSensitivity] = robust
        return Reading(values[Overshoot], by_gain, values, derivatives)

    def _chain(self, points: Array, rows: Index, case: Index) -> Array:
        """How parameters, and before them the rest, move with the unknowns, shape (m, n_columns, n)."""
        names, cases = self._space.names, self._simulator.cases
        factors = np.array([case.slopes(names) for case in cases])[case]
        chain = factors[:, :, None] * np.eye(len(names))
        if self._rollout.n_columns > len(names):
            chain = np.concatenate([self._rest_slopes(points, rows, case), chain], axis=1)
        return np.asarray(chain * self._space.rates(points)[rows][:, None, :])

    def _rest_slopes(self, points: Array, rows: Index, case: Index) -> Array:
        """How the rest moves with the gains, by central differences, shape (m, n_states, n)."""
        (low, up), columns = self._space.bounds.T, []
        for k, step in enumerate(NUDGE * (up - low)):
            nudge = step * (np.arange(len(low)) == k)
            above, below = (np.clip(points + sign * nudge, low, up) for sign in (1, -1))
            moved = (self._simulator.lanes(side, rows, case)[1] for side in (above, below))
            columns.append((next(moved) - next(moved)) / (above - below)[rows, k][:, None])
        return np.stack(columns, axis=-1)

    def _robust(self, p: Array, x_end: Array, lanes: "_Lanes", points: Array, case: Index) -> tuple[Array, Array]:
        """Ms and its derivatives by differences, the operating point held."""
        names, n, sound = self._space.names, len(self._wrt), lanes.sound
        shaping = [k for k, name in enumerate(names) if name in SHAPING]
        steps = NUDGE * np.diff(self._space.bounds, axis=1)[:, 0]
        values, slopes = np.full((len(p), 1), np.inf), np.zeros((len(p), 1, n))
        if not sound.any():
            return values, slopes
        nudged = [p, *(p + steps[k] * (np.arange(p.shape[1]) == self._wrt[k]) for k in shaping)]
        ends = np.tile(x_end[sound], (len(nudged), 1)), np.tile(lanes.y[sound, -1, CONTROL], len(nudged))
        stacked = np.concatenate([q[sound] for q in nudged])
        found = self._simulator.robustness(stacked, *ends, ("MaxSensitivity",))["MaxSensitivity"]
        peaks = found.reshape(len(nudged), -1)
        values[sound, 0] = peaks[0]
        factors = np.array([c.slopes(names) for c in self._simulator.cases])[case[sound]]
        rates = self._space.rates(points[sound]) * factors
        for row, k in zip(peaks[1:], shaping, strict=True):
            slopes[sound, 0, k] = (row - peaks[0]) / steps[k] * rates[:, k]
        return values, slopes


@dataclass(frozen=True, eq=False)
class _Lanes:
    """Simulated lanes of one reference, from the step on; what is no number is zero where `sound` is False."""

    grid: Grid
    t: Array
    y: Array
    dy: Array
    sound: NDArray[np.bool_]
    chain: Array
    periods: Sequence[float]

    def averaged(self, nodes: Array) -> tuple[Array, Array]:
        """The averaged distance from the reference at the nodes, a fraction of the step, and its derivatives."""
        reference, shape = self.grid.reference, (len(self.y), self.dy.shape[-1])
        error, by_column = np.empty((len(self.y), len(nodes))), np.empty((*shape, len(nodes)))
        for period, own, signal, columns in self._alike():
            error[own] = _smooth(self.t, signal, reference.initial, period, nodes) - reference.final
            by_column[own] = _smooth(self.t, columns, 0.0, period, nodes).reshape(-1, shape[1], len(nodes))
        return error / reference.size, np.swapaxes(by_column, 1, 2) @ self.chain / reference.size

    def at_end(self) -> tuple[Array, Array]:
        """The steady-state error, a fraction of the step, and its derivatives, a row a lane."""
        reference, columns = self.grid.reference, self.dy.shape[-1]
        error, by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period, own, signal, flat in self._alike():
            error[own, 0] = end_mean(self.t, signal, period or None) - reference.final
            by_column[own, 0] = end_mean(self.t, flat, period or None).reshape(-1, columns)
        sign = np.sign(error)[..., None]
        return np.abs(error / reference.size), sign * (by_column @ self.chain) / abs(reference.size)

    def peaks(self, blocks: int) -> tuple[Array, Array]:
        """The largest command of each stretch of time, either side, and its derivatives."""
        control, n = self.y[:, :, CONTROL], self.y.shape[1]
        edges = np.linspace(0, n, min(blocks, n) + 1).astype(int)[:-1]
        parts = np.split(np.abs(control), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(control))[:, None]
        slopes = np.sign(control[rows, k])[..., None] * (self.dy[rows, k, CONTROL] @ self.chain)
        return np.abs(control[rows, k]), slopes

    def _alike(self) -> Iterator[tuple[float, NDArray[np.bool_], Array, Array]]:
        """Lanes with one period: which, their signals, and these signals' derivatives, a row a lane and column."""
        for period in sorted(set(self.periods)):
            own = np.array([other == period for other in self.periods])
            columns = np.ascontiguousarray(np.moveaxis(self.dy[own, :, SIGNAL], 2, 1))
            yield period, own, self.y[own, :, SIGNAL], columns.reshape(-1, len(self.t))


def differentiated(simulator: Simulator) -> Rollout:
    """The compiled loop with its sensitivities to the gains; to the start where the rest depends on them."""
    order, names = list(simulator.loop.parameters), simulator.space.names
    through_start = any(simulator.starts_vary(k) for k in range(len(simulator.cases)))
    return Rollout(watched(simulator.loop), [order.index(n) for n in names], start=through_start)


def _nodes(grid: Grid, count: int, period: float) -> Array:
    t = grid.t[grid.t >= grid.reference.at - 1e-12] - grid.reference.at
    t = t[t <= t[-1] - period / 2]
    return np.asarray(t[:: max(1, len(t) // count)])


def _smooth(t: Array, y: Array, initial: float, period: float, at: Array) -> Array:
    if period:
        return period_mean(t, y, initial, period, at)
    return np.asarray(y[:, np.searchsorted(t, at)])


def _crossings(t: Array, size: Array, band: float) -> Array:
    """For each node when the band was last entered just before it, linear between nodes; the node's time otherwise."""
    before, after = size[:, :-1], size[:, 1:]
    with np.errstate(all="ignore"):
        share = np.where((before > band) & (after <= band), (before - band) / (before - after), 0.0)
    entered = np.where(before > band, t[:-1] + share * np.diff(t), t[:-1])
    return np.asarray(np.append(t[0], entered.max(axis=0)))


def _joined(parts: Sequence[Reading]) -> Reading:
    if len(parts) == 1:
        return parts[0]
    kinds = parts[0].values
    return Reading(
        np.concatenate([r.error for r in parts]),
        np.concatenate([r.by_gain for r in parts]),
        {k: np.concatenate([r.values[k] for r in parts]) for k in kinds},
        {k: np.concatenate([r.derivatives[k] for r in parts]) for k in kinds},
    )


def _part(whole: Reading, lanes: slice) -> Reading:
    return Reading(
        whole.error[lanes],
        whole.by_gain[lanes],
        {k: v[lanes] for k, v in whole.values.items()},
        {k: v[lanes] for k, v in whole.derivatives.items()},
    )
