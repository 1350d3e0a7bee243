"""`LinearisedProblem`: responses and their derivatives as rows of a minimax problem in gains and settling time.

The settling time Ts is an unknown: from Ts on the response has to lie within the band. So the objective is
smooth in the gains where the settling time itself jumps. Nodes after Ts move with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.dynamics.compiled.rollout import Rollout, RolloutResult
from pneuopt.evaluation.band import SettlingBand, band_share
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.metrics import MIN_SETTLED_PERIODS
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    ROBUSTNESS_REQUIREMENTS,
    Requirement,
    SettlingTime,
    requirement_values,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.tuning.passage import KEPT_STATES, ResponsePoints
from pneuopt.tuning.readings import CONTROL_OUTPUT, ReferenceGrid, is_sound, loop_pieces
from pneuopt.tuning.rows import Lanes, reading_times
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.sqp import LinearisedPoint, RowGroups

ROW_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.slope is not None)
SMOOTH_REQUIREMENTS: tuple[type[Requirement], ...] = (SettlingTime, *ROW_REQUIREMENTS, *ROBUSTNESS_REQUIREMENTS)
"""Requirements of which there are derivatives to the gains."""
# Least penalty of leaving the settling band by the whole step, over the objective's scale. With a smaller one leaving
# the band pays; with a larger one a search stays in the first basin that it meets.
PROGRAM_BAND_PENALTY = 50.0
# Penalty of exceeding a limit by its own size, over the objective's scale; below and above as for the band.
PROGRAM_LIMIT_PENALTY = 2.0
# Trust region of Ts over that of the gains, both fractions of their ranges. At 1 the settling time, not the gains, held
# steps back; far above it the linearisation in time fails first.
SETTLING_RADIUS_RATIO = 5.0
# Lanes with sensitivities that are run and read at a time. Fewer leave cores idle; more do not fit the cache.
MAX_SENSITIVITY_LANES = 64
# Share of a limit on a margin from which on it has derivatives. Below it no step of a descent reaches the limit; nearer
# to it a step breaks a limit that it did not see; farther ones cost a frequency response a gain.
NEAR_LIMIT = 0.75
# Step of the difference quotients of margins and rest, a fraction of a gain's range. A smaller one divides rounding
# errors; a larger one linearises a curved function.
DIFFERENCE_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class LinearisedResponse:
    """One point's responses to one reference, C cases on K nodes, with derivatives to n gains.

    Attributes
    ----------
    error : ndarray, shape (C, K)
        Distance of the signal without ripple from the reference, a fraction of the step; inf where it runs away.
    by_gain : ndarray, shape (C, K, n)
        Its derivatives.
    values, derivatives : dict of type to ndarray, shapes (C, R) and (C, R, n)
        Rows of the other requirements, by kind, and their derivatives.
    """

    error: Array
    by_gain: Array
    values: dict[type, Array]
    derivatives: dict[type, Array]


class LinearisedProblem:
    """The minimax problem that `descend` minimises, in the gains as numbers from 0 to 1 and Ts over the horizon.

    Parameters
    ----------
    simulator : Simulator
        Its cases count.
    rollout : Rollout
        The compiled loop of `sensitivity_rollout`.
    spec : Specification
    nodes : int
        Number of instants at which a response is read.
    scale : float
        The size of the objective, by which the penalties are scaled.

    Attributes
    ----------
    bounds : ndarray, shape (n + 1, 2)
    scales : ndarray, shape (n + 1,)
        Sizes of the unknowns' trust regions relative to each other.
    horizon : float
        The shortest record after a step [s].
    count : int
        Candidates simulated.
    """

    def __init__(self, simulator: Simulator, rollout: Rollout, spec: Specification, nodes: int, scale: float) -> None:
        self._simulator, self._rollout, self._spec, self.count = simulator, rollout, spec, 0
        self._scale = scale
        self._space = simulator.space
        self._order = list(simulator.loop.parameters)
        self._wrt = [self._order.index(n) for n in self._space.names]
        self._cases = [np.flatnonzero(own) for own in simulator.cases_by_grid()]
        self._periods = simulator.dither_periods()
        shares = [band_share(spec.band, grid.reference) for grid in simulator.grids]
        self._band = min(shares)  # the error is counted so that it is every reference's
        self._error_units = [self._band / share for share in shares]
        self.horizon = min(g.reference.horizon - g.reference.at for g in simulator.grids)
        self._strides = [max(1, (len(g.t) - g.step_index) // nodes) for g in simulator.grids]
        longest = max(self._periods, default=0.0)
        self._nodes = [reading_times(g, stride) for g, stride in zip(simulator.grids, self._strides, strict=True)]
        latest = min((1 - TAIL_SHARE) * self.horizon, self.horizon - MIN_SETTLED_PERIODS * longest)
        most = min(latest, spec.limit(SettlingTime))
        low = most if spec.concerns(SettlingTime) and not spec.weight(SettlingTime) else 0.0
        self.bounds = np.array([*[[0.0, 1.0]] * len(self._space.names), [low / self.horizon, most / self.horizon]])
        self.scales = np.append(np.ones(len(self._space.names)), SETTLING_RADIUS_RATIO)

    def start(self, unit: Array) -> Array:
        """Unknowns for gains, shape (m, n + 1), with the latest Ts allowed; `improve` then finds the best one."""
        return np.column_stack([np.clip(unit, 0.0, 1.0), np.full(len(unit), self.bounds[-1, 1])])

    def evaluate(self, z: Array) -> Sequence[LinearisedPoint]:
        """Simulate and linearise the responses for each row of z."""
        self.count += len(z)
        readings = self._read(z[:, :-1])
        return [self._point(row, reading) for row, reading in zip(z, readings, strict=True)]

    def improve(self, point: LinearisedPoint) -> LinearisedPoint:
        """Keep the gains and choose their best Ts: the settling time, or an earlier one where that pays."""
        weight = self._spec.weight(SettlingTime)
        readings: Sequence[LinearisedResponse] = point.data
        if not weight or not np.isfinite(point.values).any() or np.isinf(point.merit):
            return point
        times = np.unique(np.concatenate(self._nodes))
        late, crossings = np.zeros(len(times)), np.zeros(len(times))
        for t, reading in zip(self._nodes, readings, strict=True):
            size = np.abs(reading.error)
            after = np.maximum.accumulate(size.max(axis=0)[::-1])[::-1]
            k = np.searchsorted(t, times)
            late = np.maximum(late, np.append(after, 0.0)[k])
            crossings = np.maximum(crossings, np.append(_band_entry_times(t, size, self._band), np.inf)[k])
        inside = SettlingBand(0.0, self._band).contains(late)
        excess = np.where(inside, 0.0, late - self._band)
        times = np.where(inside, np.minimum(crossings, times), times)
        costs = np.where(
            times <= self.bounds[-1, 1] * self.horizon, weight * times + self._band_weight * excess, np.inf
        )
        best = times[np.argmin(costs)] / self.horizon
        moved = self._point(np.append(point.z[:-1], best), readings)
        return moved if moved.merit < point.merit else point

    @cached_property
    def _band_weight(self) -> float:
        """The penalty of leaving the settling band by the whole step."""
        return self._scale * max(PROGRAM_BAND_PENALTY, 1 / self._band)

    @cached_property
    def _groups(self) -> tuple[list[tuple[type, float, bool]], RowGroups]:
        """The groups of rows: kind, divisor of the values and whether they are limits; the band comes first."""
        kinds, weights, floors = list[tuple[type, float, bool]](), [], []
        if self._spec.concerns(SettlingTime):
            kinds, weights, floors = [(SettlingTime, 1.0, True)], [self._band_weight], [0.0]
        for kind in SMOOTH_REQUIREMENTS[1:]:
            weight, limit = self._spec.weight(kind), self._spec.limit(kind)
            if weight > 0:
                kinds.append((kind, 1.0, False))
                weights.append(weight)
                floors.append(kind.metric.floor)
            if limit < np.inf:
                kinds.append((kind, limit, True))
                weights.append(PROGRAM_LIMIT_PENALTY * self._scale)
                floors.append(0.0)
        return kinds, RowGroups(np.array(weights), np.array(floors))

    def _point(self, z: Array, readings: Sequence[LinearisedResponse]) -> LinearisedPoint:
        """The rows of all requirements at the unknowns z."""
        kinds, groups = self._groups
        values, slopes, group = list[Array](), list[Array](), list[Indices]()
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
        return LinearisedPoint(z, float(weight * z[-1]), gradient, *rows, whose, groups, readings)

    def _band_rows(self, t: Array, reading: LinearisedResponse, Ts: float) -> tuple[Array, Array]:
        """Rows of both sides of the band at instants from Ts to the end, which move with Ts."""
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
        return np.array([error, -error]) - self._band, np.array([slopes, -slopes])

    def _read(self, unit: Array) -> list[list[LinearisedResponse]]:
        """Simulate points; the linearised response of each point to each reference."""
        points = self._space.from_unit(unit)
        found: list[list[LinearisedResponse]] = [[] for _ in points]
        for g, own in enumerate(self._cases):
            rows, case = np.repeat(np.arange(len(points)), len(own)), np.tile(own, len(points))
            parts = [
                self._simulate_lanes(
                    g, points, rows[k : k + MAX_SENSITIVITY_LANES], case[k : k + MAX_SENSITIVITY_LANES]
                )
                for k in range(0, len(rows), MAX_SENSITIVITY_LANES)
            ]
            whole = _concatenate_responses(parts)
            for i in range(len(points)):
                found[i].append(_slice_response(whole, slice(i * len(own), (i + 1) * len(own))))
        return found

    def _simulate_lanes(self, g: int, points: Array, rows: Indices, case: Indices) -> LinearisedResponse:
        """Simulate lanes on one grid and linearise their responses."""
        grid = self._simulator.grids[g]
        p, starts = self._simulator.lanes(points, rows, case)
        u, instants, h, steps = self._simulator.pad(case)
        with np.errstate(all="ignore"):
            found = self._rollout.run(starts, u, p, instants, h, substeps=steps, states=KEPT_STATES)
        assert found.dy is not None
        sound = is_sound(found.y, found.x_end) & np.isfinite(found.dy[:, -1]).all(axis=(1, 2))
        if not sound.all():
            found.y[~sound], found.dy[~sound] = 0.0, 0.0
        lanes = Lanes(
            grid,
            found.y,
            found.dy,
            self._chain(points, rows, case),
            [self._periods[k] for k in case.tolist()],
            self._strides[g],
            self._spec.envelope,
            self._simulator.sampled.channels,
        )
        error, by_gain = (self._error_units[g] * a for a in lanes.record.error)
        rows_of: dict[type, tuple[Array, Array]] = {
            kind: kind.metric.slope(lanes.record)
            for kind in ROW_REQUIREMENTS
            if kind.metric.slope is not None and self._spec.concerns(kind)
        }
        if self._spec.concerns(ROBUSTNESS_REQUIREMENTS):
            rows_of |= self._robustness_rows(p, sound, self._points(grid, p, case, found), points[rows], case)
        return LinearisedResponse(
            np.where(sound[:, None], error, np.inf),
            by_gain,
            {kind: np.where(sound[:, None], value, np.inf) for kind, (value, _) in rows_of.items()},
            {kind: slopes for kind, (_, slopes) in rows_of.items()},
        )

    def _points(self, grid: ReferenceGrid, p: Array, case: Indices, found: RolloutResult) -> tuple[Array, Array]:
        """The operating points of lanes on one grid, states and inputs."""
        fastest, periods = np.zeros(len(p), dtype=np.intp), self._simulator.sampled.periods(p)
        for period in np.unique(periods).tolist():
            rows = periods == period
            fastest[rows] = self._simulator.fastest_samples(grid, found.y[rows], period)
        assert found.x is not None
        passage = ResponsePoints(found.x, found.x_end, fastest, found.y[:, -1, CONTROL_OUTPUT])
        return self._simulator.operating_points(p, case, passage)

    def _chain(self, points: Array, rows: Indices, case: Indices) -> Array:
        """Derivatives of the start states, where they depend on the gains, and the parameters to the unknowns.

        Their shape is (m, n_columns, n).
        """
        names, cases = self._space.names, self._simulator.cases
        factors = np.array([case.slopes(names) for case in cases])[case]
        chain = factors[:, :, None] * np.eye(len(names))
        if self._rollout.n_columns > len(names):
            chain = np.concatenate([self._rest_slopes(points, rows, case), chain], axis=1)
        return np.asarray(chain * self._space.from_unit_slope(points)[rows][:, None, :])

    def _rest_slopes(self, points: Array, rows: Indices, case: Indices) -> Array:
        """Derivatives of the start states to the gains by central differences, shape (m, n_states, n)."""
        (low, up), columns = self._space.bounds.T, []
        for k, step in enumerate(DIFFERENCE_STEP * (up - low)):
            nudge = step * (np.arange(len(low)) == k)
            above, below = (np.clip(points + sign * nudge, low, up) for sign in (1, -1))
            moved = (self._simulator.lanes(side, rows, case)[1] for side in (above, below))
            columns.append((next(moved) - next(moved)) / (above - below)[rows, k][:, None])
        return np.stack(columns, axis=-1)

    def _robustness_rows(
        self, p: Array, sound: Mask, at: tuple[Array, Array], points: Array, case: Indices
    ) -> dict[type, tuple[Array, Array]]:
        """Margins and peaks of the linearised loop, and their derivatives by differences at fixed operating points."""
        names, n, kinds = (
            self._space.names,
            len(self._wrt),
            [k for k in ROBUSTNESS_REQUIREMENTS if self._spec.concerns(k)],
        )
        loop = self._simulator.loop
        outer = (loop.outer,) if loop.outer else ()
        scheduled = (loop.schedule,) if loop.schedule else ()
        sections = tuple(f"{c.section}." for c in (*outer, *scheduled, *loop.controller.acting_always))
        felt = {*(f"pid.{gain}" for gain in loop.pid.form.gains), DITHER_AMPLITUDE, DITHER_FREQUENCY}
        shaping = [k for k, name in enumerate(names) if name in felt or name.startswith(sections)]
        found: dict[type, tuple[Array, Array]] = {
            kind: (np.full((len(p), 1), np.inf), np.zeros((len(p), 1, n))) for kind in kinds
        }
        if not sound.any():
            return found
        steps = DIFFERENCE_STEP * np.diff(self._space.bounds, axis=1)[:, 0]
        only, read = [k.metric.name for k in kinds], self._simulator.robustness
        first = requirement_values(read(p[sound], at[0][:, sound], at[1][:, sound], only))
        near = np.zeros(len(p), dtype=bool)
        for kind, (values, _) in found.items():
            values[sound, 0] = np.nan_to_num(first[kind.__name__], nan=np.inf, posinf=np.inf)
            near |= np.isfinite(values[:, 0]) & (values[:, 0] >= self._slope_threshold(kind))
        if not shaping or not near.any():
            return found
        nudged = [p[near] + steps[k] * (np.arange(p.shape[1]) == self._wrt[k]) for k in shaping]
        x, u = (np.tile(a[:, near], (1, len(nudged), 1)) for a in at)
        moved = requirement_values(read(np.concatenate(nudged), x, u, only))
        factors = np.array([c.slopes(names) for c in self._simulator.cases])[case[near]]
        rates = self._space.from_unit_slope(points[near]) * factors
        for kind, (values, slopes) in found.items():
            with np.errstate(invalid="ignore"):
                for row, k in zip(np.reshape(moved[kind.__name__], (len(nudged), -1)), shaping, strict=True):
                    slopes[near, 0, k] = (row - values[near, 0]) / steps[k] * rates[:, k]
        return found

    def _slope_threshold(self, kind: type[Requirement]) -> float:
        """The requirement's value from which on its derivatives count."""
        limit = self._spec.limit(kind)
        return -np.inf if self._spec.weight(kind) or limit <= 0 else NEAR_LIMIT * limit


def sensitivity_rollout(simulator: Simulator) -> Rollout:
    """Compile the loop with sensitivities to the gains, and to the start states where those depend on the gains."""
    order, names = list(simulator.loop.parameters), simulator.space.names
    through_start = any(simulator.starts_vary(k) for k in range(len(simulator.cases)))
    return Rollout(
        loop_pieces(simulator.loop, simulator.sampled.channels),
        [order.index(n) for n in names],
        start=through_start,
    )


def _band_entry_times(t: Array, size: Array, band: float) -> Array:
    """For each node the time at which the segment before it enters the band, by linear interpolation.

    Where that segment does not enter the band it is the time at which the segment begins.
    """
    before, after, inside = size[:, :-1], size[:, 1:], SettlingBand(0.0, band).contains(size)
    with np.errstate(all="ignore"):
        share = np.where(~inside[:, :-1] & inside[:, 1:], (before - band) / (before - after), 0.0)
    entered = np.where(inside[:, :-1], t[:-1], t[:-1] + share * np.diff(t))
    return np.asarray(np.append(t[0], entered.max(axis=0)))


def _concatenate_responses(parts: Sequence[LinearisedResponse]) -> LinearisedResponse:
    """Join the lanes of several responses."""
    if len(parts) == 1:
        return parts[0]
    kinds = parts[0].values
    return LinearisedResponse(
        np.concatenate([r.error for r in parts]),
        np.concatenate([r.by_gain for r in parts]),
        {k: np.concatenate([r.values[k] for r in parts]) for k in kinds},
        {k: np.concatenate([r.derivatives[k] for r in parts]) for k in kinds},
    )


def _slice_response(whole: LinearisedResponse, lanes: slice) -> LinearisedResponse:
    """The response of some lanes."""
    return LinearisedResponse(
        whole.error[lanes],
        whole.by_gain[lanes],
        {k: v[lanes] for k, v in whole.values.items()},
        {k: v[lanes] for k, v in whole.derivatives.items()},
    )
