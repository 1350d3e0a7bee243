"""Gradients: points of a search improved by quadratic programs on compiled simulations with sensitivities.

Minimise ``f(z) + sum_g weight_g max(floor_g, max_i r_gi(z))`` in a box, f linear: a limit is a group of rows with floor
0 and a weight beyond its multiplier (an exact penalty), an objective such as a peak is one without a floor. `descend`
solves such problems from many starts in lockstep by sequential quadratic programs, dense and small. `LinearisedProblem`
makes the rows of a tuning: the settling time Ts is an unknown from which on the response has to lie within the band, so
that the objective is smooth in the gains where the settling time itself jumps; `Lanes` reads the responses at nodes
without their dither's ripple, a largest value's derivative at its present instant. `Polish` applies it to a search.

Differential evolution finds the basin; within it gradients are worth a hundred trials each. On 32 plants of the drive
in problems/shared/t32.py points that an evolution left at 0.062 and 0.065 s came to 0.050 s in some thirty simulations.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.dither import DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.evaluation.metric import (
    DitherPeriodMean,
    SettlingBand,
    StepRecord,
    ValuesAndSlopes,
    band_share,
    end_mean,
    extend_means,
    ripple_and_slopes,
    wave_instants,
)
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.requirements import (
    PUSH,
    REQUIREMENT_KINDS,
    ROBUSTNESS_REQUIREMENTS,
    Requirement,
    SettlingTime,
    metric_name,
    requirement_values,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import MIN_SETTLED_PERIODS, RIPPLE_ALLOWANCE, TAIL_SHARE
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import require
from pneuopt.tuning.simulator import ResponsePoints, Simulator, to_records
from pneuopt.tuning.space import (
    CONTROL_OUTPUT,
    INTEGRAL_OUTPUT,
    SIGNAL_OUTPUT,
    ReferenceGrid,
    Space,
    is_sound,
    loop_pieces,
    meter_values,
    shapes_linear_loop,
)
from pneuopt.tuning.tolerances import (
    DIFFERENCE_STEP,
    INFINITE_BOUND,
    KEPT_STATES,
    LIMIT_TOLERANCE,
    MAX_CUTTING_ROUNDS,
    NEAR_LIMIT,
    PENALTY_RAISES,
    PROGRAM_BAND_PENALTY,
    PROGRAM_LIMIT_PENALTY,
    PROGRAM_MARGIN,
    QP_CURVATURE,
    ROW_PADDING,
    SETTLING_RADIUS_RATIO,
    VIOLATION_TOLERANCE,
)


@dataclass(frozen=True, eq=False)
class Polish:
    """Improve points of a search by gradients, from responses that are read at so many `nodes`, at most."""

    simulator: Simulator
    spec: Specification
    nodes: int = 2000

    @property
    def is_possible(self) -> bool:
        """Whether there are gradients of all that is asked for."""
        return not nonsmooth_terms(self.simulator.loop, self.simulator.space, self.spec)

    @cached_property
    def _rollout(self) -> Rollout:
        return sensitivity_rollout(self.simulator)

    def improve(self, unit: Array, on: Simulator, iterations: int) -> tuple[Array, int]:
        """Descend from points of the unit cube (m, n) on some samples; where each ends, and points simulated."""
        inside, count, space = (
            self.spec.tighten(PROGRAM_MARGIN, PROGRAM_MARGIN, LIMIT_TOLERANCE / 2),
            0,
            self.simulator.space,
        )
        first = to_records(on.values(space.from_unit(unit[:1]), self.spec))[0]
        unknown = {SettlingTime.metric.name: max(grid.reference.horizon for grid in on.grids)}
        known = {n: v if np.isfinite(v) else unknown.get(n, 1.0) for n, v in first.items()}
        scale = self.spec.objective(known)  # the size of the objective sets that of the penalties
        for raises in range(PENALTY_RAISES + 1):
            problem = LinearisedProblem(on, self._rollout, inside, self.nodes, scale * 10.0**raises)
            found = descend(problem, problem.start(unit), iterations, SQP())
            unit, count = np.array([point.z[:-1] for point in found]), count + problem.count
            values = to_records(on.values(space.from_unit(unit), self.spec))
            if not any(self.spec.violations(row) for row in values):
                break
        return unit, count


# Free parameters that no gradient serves: the averaging time moves with the frequency, and a clip that no response
# meets has derivative zero.
NONSMOOTH_PARAMETERS = ("dither.frequency", "pid.Tt", "pid.lower", "pid.upper")
QUANTISER_PARAMETERS = ("sensor.resolution",)  # an encoder's: its counts make responses piecewise flat


def nonsmooth_terms(loop: ClosedLoop, space: Space, spec: Specification) -> list[str]:
    """The names of requirements without a gradient, and of free parameters to which there is none."""
    rough = [metric_name(q) for q in (*spec.weights, *spec.limits) if not isinstance(q, SMOOTH_REQUIREMENTS)]
    counted = [f"{n} (an encoder's counts)" for n in QUANTISER_PARAMETERS if n in space.parameters]
    jumping = {f"{c.section}.{n}" for c in loop.compensators for n in c.without_gradient}
    return [*rough, *(n for n in space.names if n in NONSMOOTH_PARAMETERS or n in jumping), *counted]


@dataclass(frozen=True)
class RowGroups:
    """Weights and floors (n_groups,): a limit has its violation's penalty and floor 0, an objective floor -inf."""

    weights: Array
    floors: Array


@dataclass(frozen=True, eq=False)
class LinearisedPoint:
    """A point z (n,) with f, its gradient (n,), and the rows linearised there, -inf where one does not count.

    `data` is what the problem needs to improve the point.
    """

    z: Array
    cost: float
    gradient: Array
    values: Array
    slopes: Array
    group: Indices
    groups: RowGroups
    data: Any = None

    @functools.cached_property
    def merit(self) -> float:
        """The objective; inf where a row is NaN."""
        return self._merit(self.values, self.cost)

    def predict_merit(self, d: Array) -> float:
        """The objective after a step d by the linearised rows."""
        return self._merit(self.values + self.slopes @ d, self.cost + float(self.gradient @ d))

    def _merit(self, values: Array, cost: float) -> float:
        tops = self.groups.floors.copy()
        with np.errstate(invalid="ignore"):
            np.maximum.at(tops, self.group, values)
        total = cost + float(self.groups.weights @ tops)
        return total if np.isfinite(total) else np.inf


class MinimaxProblem(Protocol):
    """A minimax problem: `bounds`, shape (n, 2), and `scales`, the half widths of a trust region of 1, shape (n,)."""

    bounds: Array
    scales: Array

    def evaluate(self, z: Array) -> Sequence[LinearisedPoint]:
        """Linearise at each row of z, shape (m, n)."""

    def improve(self, point: LinearisedPoint) -> LinearisedPoint:
        """A better point that needs no new evaluation, or the same point."""


@dataclass(frozen=True)
class SQP:
    """Step control: first and least half width of the trust region, and the relative decrease that ends a descent.

    Widths are shares of the unknowns' ranges. Actual over predicted decrease below `shrink` narrows the region, above
    `grow` widens it (J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., algorithm 4.1).
    """

    radius: float = 0.3
    least_radius: float = 1e-5
    tolerance: float = 1e-5
    shrink: float = 0.25
    grow: float = 0.75

    def __post_init__(self) -> None:
        require(0 < self.least_radius < self.radius, f"SQP: radius must exceed {self.least_radius:g}")


@dataclass(frozen=True, eq=False)
class DescentState:
    """The descent from one start: its present point, its trust region, and whether it goes on."""

    point: LinearisedPoint
    radius: float
    moves: bool = True


def descend(
    problem: MinimaxProblem, starts: Array, iterations: int, method: SQP | None = None
) -> list[LinearisedPoint]:
    """Descend from every start (m, n) in lockstep, for so many iterations at most; where each ends, in their order."""
    method = method or SQP()
    first = [problem.improve(p) for p in problem.evaluate(starts)]
    found = [DescentState(p, method.radius, bool(np.isfinite(p.merit))) for p in first]
    for _ in range(iterations):
        moving = [k for k, d in enumerate(found) if d.moves]
        if not moving:
            break
        for k, descent in zip(moving, _advance(problem, [found[k] for k in moving], method), strict=True):
            found[k] = descent
    return [d.point for d in found]


def _advance(problem: MinimaxProblem, descents: Sequence[DescentState], method: SQP) -> list[DescentState]:
    """Advance each descent by a step; where it gains less than predicted, a second-order correction is tried, too."""
    steps = [solve_quadratic_program(d.point, _step_box(problem, d)) for d in descents]
    trials = _evaluate_and_improve(problem, [d.point.z + step for d, step in zip(descents, steps, strict=True)])
    gains = [
        (d.point.merit - d.point.predict_merit(s), d.point.merit - t[1].merit)
        for d, s, t in zip(descents, steps, trials, strict=True)
    ]
    poor = [
        k
        for k, (predicted, gained) in enumerate(gains)
        if _promises_decrease(descents[k], predicted, method) and gained < method.shrink * predicted
    ]
    corrected = list[Array]()
    for k in poor:  # the step of the program with the rows' true values at the trial point
        point, trial = descents[k].point, trials[k][0]
        with np.errstate(invalid="ignore"):
            values = trial.values - point.slopes @ steps[k]
        known = np.isfinite(values) & np.isfinite(point.values)
        point = replace(point, values=np.where(known, values, point.values))
        corrected.append(point.z + solve_quadratic_program(point, _step_box(problem, descents[k])))
    for k, second in zip(poor, _evaluate_and_improve(problem, corrected), strict=True):
        if second[1].merit < trials[k][1].merit:
            trials[k] = second
    return [
        _update_descent(d, step / problem.scales, trial[1], predicted, method)
        for d, step, trial, (predicted, _) in zip(descents, steps, trials, gains, strict=True)
    ]


def _evaluate_and_improve(problem: MinimaxProblem, z: Sequence[Array]) -> list[tuple[LinearisedPoint, LinearisedPoint]]:
    """Evaluate points within the bounds; each as it is, and improved."""
    if not z:
        return []
    low, up = problem.bounds.T
    return [(p, problem.improve(p)) for p in problem.evaluate(np.clip(np.array(z), low, up))]


def _promises_decrease(descent: DescentState, predicted: float, method: SQP) -> bool:
    """Whether the predicted decrease of the objective is worth a step."""
    return predicted > method.tolerance * abs(descent.point.merit)


def _update_descent(
    descent: DescentState, step: Array, trial: LinearisedPoint, predicted: float, method: SQP
) -> DescentState:
    """Accept or refuse a trial point, and adapt the trust region."""
    if not _promises_decrease(descent, predicted, method):
        smaller = 0.25 * descent.radius  # where the program failed, a smaller region may help
        return replace(descent, radius=smaller, moves=predicted < 0 and smaller > method.least_radius)
    gained, reach = descent.point.merit - trial.merit, float(np.max(np.abs(step)))
    radius = descent.radius
    if gained < method.shrink * predicted:
        radius = 0.4 * min(radius, reach)
    elif gained > method.grow * predicted and reach > 0.9 * radius:
        radius = min(2 * radius, 1.0)
    point = trial if gained > 0 else descent.point
    return DescentState(point, radius, radius > method.least_radius)


def _step_box(problem: MinimaxProblem, descent: DescentState) -> Array:
    """Bounds and trust region as `solve_quadratic_program` takes them, shape (n, 3)."""
    return np.column_stack([problem.bounds, descent.radius * problem.scales])


def solve_quadratic_program(point: LinearisedPoint, box: Array) -> Array:
    """The step (n,) that minimises the linearised problem in a box of bounds and reaches (n, 3), or else zero.

    The program starts from the highest rows and takes in those that its solution violates.
    """
    low, up = np.maximum(box[:, 0] - point.z, -box[:, 2]), np.minimum(box[:, 1] - point.z, box[:, 2])
    reach = np.abs(point.slopes) @ np.maximum(-low, up)
    usable = np.isfinite(point.values) & np.isfinite(reach)
    tops = point.groups.floors.copy()
    np.maximum.at(tops, point.group[usable], (point.values - reach)[usable])
    rows = np.flatnonzero(usable & (point.values + reach > tops[point.group]))  # no other can be active
    chosen = rows[_local_maxima(point.values[rows], -np.inf)]
    step = np.zeros(len(low))
    for _ in range(MAX_CUTTING_ROUNDS):
        found = _solve_active_rows(point, chosen, low, up)
        if found is None:
            return step
        step, slack = found
        excess = point.values[rows] + point.slopes[rows] @ step - slack[point.group[rows]]
        excess[np.isin(rows, chosen)] = -np.inf
        worst = _local_maxima(excess)
        if not len(worst):
            break
        chosen = np.concatenate([chosen, rows[worst]])
    return step


def _local_maxima(heights: Array, least: float = VIOLATION_TOLERANCE) -> Indices:
    """Indices of the highest local maxima; rows beside them in time, which a step lowers with them, are left out."""
    beside = np.concatenate([[-np.inf], heights, [-np.inf]])
    found = np.flatnonzero((heights > least) & (heights >= beside[:-2]) & (heights >= beside[2:]))
    return np.asarray(found[np.argsort(-heights[found], kind="stable")[:ROW_PADDING]])


def _solve_active_rows(point: LinearisedPoint, rows: Indices, low: Array, up: Array) -> tuple[Array, Array] | None:
    """Step and slacks of the program with the chosen rows; a group's slack is its floor or its highest row."""
    n, g = len(low), len(point.groups.weights)
    m = -(-max(1, len(rows)) // ROW_PADDING) * ROW_PADDING
    A, upper = np.zeros((m, n + g)), np.full(m, INFINITE_BOUND)
    A[: len(rows), :n], upper[: len(rows)] = point.slopes[rows], -point.values[rows]
    A[np.arange(len(rows)), n + point.group[rows]] = -1.0
    lowest = np.where(np.isfinite(point.groups.floors), point.groups.floors, -INFINITE_BOUND)
    alone = ~np.isin(np.arange(g), point.group[rows]) & ~np.isfinite(point.groups.floors)
    weights = np.where(alone, 0.0, point.groups.weights)  # without rows an objective falls for ever
    unlimited = point.groups.weights[~np.isfinite(point.groups.floors)]
    size = max(np.abs(point.gradient).max(initial=0.0), unlimited.max(initial=0.0)) or 1.0
    solver = _qp_solver(n + g, m)
    found = solver(
        h=QP_CURVATURE * np.eye(n + g),
        g=np.concatenate([point.gradient, weights]) / size,
        a=A,
        uba=upper,
        lba=-np.inf,
        lbx=np.concatenate([low, np.where(alone, 0.0, lowest)]),
        ubx=np.concatenate([up, np.full(g, INFINITE_BOUND)]),
    )
    x = np.array(found["x"]).ravel()
    if not (solver.stats()["success"] and np.isfinite(x).all()):
        return None
    slack = np.where(alone, np.inf, x[n:])
    return np.clip(x[:n], low, up), slack


@functools.lru_cache(maxsize=256)
def _qp_solver(n: int, m: int) -> Any:
    """The solver of dense programs with n unknowns and m rows."""
    sparsity = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
    return ca.conic("program", "daqp", sparsity, {"error_on_fail": False})


ROW_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.slope is not None)
SMOOTH_REQUIREMENTS: tuple[type[Requirement], ...] = (SettlingTime, *ROW_REQUIREMENTS, *ROBUSTNESS_REQUIREMENTS)
"""Requirements of which there are derivatives to the gains."""


@dataclass(frozen=True, eq=False)
class LinearisedResponse:
    """One point's responses to one reference, C cases on K nodes, with derivatives to n gains.

    The error without ripple (C, K) is a fraction of the step, inf where it runs away; further rows stand by kind of
    requirement, values (C, R) and derivatives (C, R, n).
    """

    error: Array
    by_gain: Array
    values: dict[type, Array]
    derivatives: dict[type, Array]


class LinearisedProblem:
    """The minimax problem that `descend` minimises, in the gains as numbers from 0 to 1 and Ts over the horizon [s].

    `scale`, the objective's size, sets that of the penalties; `bounds` (n + 1, 2), `scales` (n + 1,) are the unknowns'
    ranges and trust regions; `most_lanes` with sensitivities run at a time, as fit a processor's cache.
    """

    most_lanes: ClassVar[int] = 64

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
        points = self._space.from_unit(z[:, :-1])
        found: list[list[LinearisedResponse]] = [[] for _ in points]
        for g, own in enumerate(self._cases):
            rows, case = np.repeat(np.arange(len(points)), len(own)), np.tile(own, len(points))
            chunks = [slice(k, k + self.most_lanes) for k in range(0, len(rows), self.most_lanes)]
            parts = [self._simulate_lanes(g, points, rows[k], case[k]) for k in chunks]
            error, by_gain = (np.concatenate(rows) for rows in zip(*((r.error, r.by_gain) for r in parts), strict=True))
            values = {k: np.concatenate([r.values[k] for r in parts]) for k in parts[0].values}
            slopes = {k: np.concatenate([r.derivatives[k] for r in parts]) for k in values}
            for i in range(len(points)):
                lanes = slice(i * len(own), (i + 1) * len(own))
                tables = ({k: v[lanes] for k, v in every.items()} for every in (values, slopes))
                found[i].append(LinearisedResponse(error[lanes], by_gain[lanes], *tables))
        return [self._point(row, readings) for row, readings in zip(z, found, strict=True)]

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
            fastest, periods = np.zeros(len(p), dtype=np.intp), self._simulator.sampled.periods(p)
            for period in np.unique(periods).tolist():
                own = periods == period
                fastest[own] = self._simulator.fastest_samples(grid, found.y[own], period)
            assert found.x is not None
            ends = ResponsePoints(found.x, found.x_end, fastest, found.y[:, -1, CONTROL_OUTPUT])
            at = self._simulator.operating_points(p, case, ends)
            rows_of |= self._robustness_rows(p, sound, at, points[rows], case)
        return LinearisedResponse(
            np.where(sound[:, None], error, np.inf),
            by_gain,
            {kind: np.where(sound[:, None], value, np.inf) for kind, (value, _) in rows_of.items()},
            {kind: slopes for kind, (_, slopes) in rows_of.items()},
        )

    def _chain(self, points: Array, rows: Indices, case: Indices) -> Array:
        """Derivatives of parameters, and of starts that depend on gains, to the unknowns (m, n_columns, n)."""
        names, cases = self._space.names, self._simulator.cases
        factors = np.array([case.slopes(names) for case in cases])[case]
        chain = factors[:, :, None] * np.eye(len(names))
        if self._rollout.n_columns > len(names):
            (low, up), columns = self._space.bounds.T, []
            for k, step in enumerate(DIFFERENCE_STEP * (up - low)):  # start states by central differences
                nudge = step * (np.arange(len(low)) == k)
                above, below = (np.clip(points + sign * nudge, low, up) for sign in (1, -1))
                moved = (self._simulator.lanes(side, rows, case)[1] for side in (above, below))
                columns.append((next(moved) - next(moved)) / (above - below)[rows, k][:, None])
            chain = np.concatenate([np.stack(columns, axis=-1), chain], axis=1)
        return np.asarray(chain * self._space.from_unit_slope(points)[rows][:, None, :])

    def _robustness_rows(
        self, p: Array, sound: Mask, at: tuple[Array, Array], points: Array, case: Indices
    ) -> dict[type, tuple[Array, Array]]:
        """Margins and peaks of the linearised loop, and their derivatives by differences at fixed operating points."""
        names, n, kinds = (
            self._space.names,
            len(self._wrt),
            [k for k in ROBUSTNESS_REQUIREMENTS if self._spec.concerns(k)],
        )
        loop = self._simulator.loop  # an offset acts by the operating points only, which are held
        shaping = [k for k, n in enumerate(names) if n != DITHER_OFFSET and shapes_linear_loop(loop, n)]
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
            limit = self._spec.limit(kind)
            least = -np.inf if self._spec.weight(kind) or limit <= 0 else NEAR_LIMIT * limit
            near |= np.isfinite(values[:, 0]) & (values[:, 0] >= least)
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
    """For each node the time at which the segment before it enters the band, by interpolation, or else begins."""
    before, after, inside = size[:, :-1], size[:, 1:], SettlingBand(0.0, band).contains(size)
    with np.errstate(all="ignore"):
        share = np.where(~inside[:, :-1] & inside[:, 1:], (before - band) / (before - after), 0.0)
    entered = np.where(inside[:, :-1], t[:-1], t[:-1] + share * np.diff(t))
    return np.asarray(np.append(t[0], entered.max(axis=0)))


@dataclass(frozen=True, eq=False)
class Lanes:
    """Simulated lanes of one reference: outputs y (m, n, n_outputs), derivatives dy (m, n, n_outputs, n_columns).

    `chain` (m, n_columns, n_gains) leads on to the unknowns, `periods` [s] are the averaging times, 0 without dither,
    and `stride` is the number of samples between two nodes.
    """

    grid: ReferenceGrid
    y: Array
    dy: Array
    chain: Array
    periods: Sequence[float]
    stride: int
    envelope: Envelope = ()
    channels: Sequence[str] = ()

    @cached_property
    def t(self) -> Array:
        """The samples' time after the step, shape (n,) [s]."""
        return self.grid.t[self.grid.step_index :] - self.grid.reference.at

    @cached_property
    def nodes(self) -> Array:
        """The nodes' time after the step, shape (K,) [s]."""
        return reading_times(self.grid, self.stride)

    @cached_property
    def record(self) -> StepRecord:
        """The step record of the lanes, the signal without ripple at the nodes, with derivatives to the unknowns."""
        reference, columns, K = self.grid.reference, self.dy.shape[-1], len(self.nodes)
        error, by_column = np.empty((len(self.y), K)), np.empty((len(self.y), columns, K))
        last, last_by_column = np.empty((len(self.y), 1)), np.empty((len(self.y), 1, columns))
        for period in sorted(set(self.periods)):
            own = np.array([other == period for other in self.periods])
            signal = self._output(own, SIGNAL_OUTPUT), self._slopes(own, SIGNAL_OUTPUT)
            along, end = self._at_nodes(signal), (signal[0][:, -1:], signal[1][..., -1:])
            if period:
                along, end = self._remove_ripple(own, period, signal)
            error[own], by_column[own] = along
            last[own], last_by_column[own] = end[0], np.swapaxes(end[1], 1, 2)
        size, since = reference.nominal_size, slice(self.grid.step_index, None)
        y, dy = self.y[:, since], self.dy[:, since]
        shown = meter_values(y, self.channels), meter_values(np.moveaxis(dy, 2, -1), self.channels)
        return StepRecord(
            self.t,
            ((error - reference.final) / size, self._to_gains(np.swapaxes(by_column, 1, 2)) / size),
            ((last - reference.final) / size, self._to_gains(last_by_column) / size),
            self.chain,
            (y[..., CONTROL_OUTPUT], dy[:, :, CONTROL_OUTPUT]),
            {n: (shown[0][n], shown[1][n]) for n in self.channels},
            self.stride,
            self.grid.sample_time,
            self.envelope,
            reference.changes,
            size,
            (reference.values(self.nodes + reference.at) - reference.final) / size,
            reference.disturbance.get(PUSH, 0.0),
        )

    def _to_gains(self, by_column: Array) -> Array:
        """Derivatives to the unknowns from those to the columns, by the chain rule."""
        return np.asarray(by_column @ self.chain)

    def _output(self, own: NDArray[np.bool_], which: int) -> Array:
        """One output of some lanes from the step on, shape (m, n)."""
        return np.ascontiguousarray(self.y[own, self.grid.step_index :, which])

    def _slopes(self, own: NDArray[np.bool_], which: int) -> Array:
        """The derivatives of one output of some lanes from the step on, shape (m, n_columns, n)."""
        return np.ascontiguousarray(np.moveaxis(self.dy[own, self.grid.step_index :, which], 2, 1))

    def _remove_ripple(
        self, own: NDArray[np.bool_], period: float, signal: ValuesAndSlopes
    ) -> tuple[ValuesAndSlopes, ValuesAndSlopes]:
        """The signal without ripple at the nodes, and its final value, with derivatives; as `remove_ripple`."""
        t, count = self.t, DitherPeriodMean(period, self.grid.spacing).mean_count(len(self.t))
        at, weights = wave_instants(t[:count], period)
        first = max(0, int(np.searchsorted(t, at[0])) - 1)
        tail = self._means(own, period, first, 1)
        rest = signal[0][:, first:count] - tail[0], signal[1][..., first:count] - tail[1]
        ripple = ripple_and_slopes(t[first:count], rest, at, weights)
        reach = RIPPLE_ALLOWANCE / 2 * ripple[0][:, None], RIPPLE_ALLOWANCE / 2 * ripple[1][..., None]
        late = [extend_means(t, a, b[..., -1], count, period) for a, b in zip(signal, tail, strict=True)]
        past = -count % self.stride
        early = self._means(own, period, 0, self.stride)
        means = [np.concatenate([a, b[..., past :: self.stride]], axis=-1) for a, b in zip(early, late, strict=True)]
        level = [end_mean(t, a, period)[..., None] for a in signal]
        ends = signal[0][:, -1:], signal[1][..., -1:]
        return _move(self._at_nodes(signal), (means[0], means[1]), reach), _move(ends, (level[0], level[1]), reach)

    def _means(self, own: NDArray[np.bool_], period: float, first: int, stride: int) -> ValuesAndSlopes:
        """Means over the period, from sample `first` to the last that has one, and their derivatives."""
        window = DitherPeriodMean(period, self.grid.spacing)
        before = min(first, window.half_period_samples + 1)  # their means would need the signal further back
        found = []
        for read, initial in ((self._output, self.grid.reference.initial), (self._slopes, 0.0)):
            signal, integral = (read(own, k)[..., first - before :] for k in (SIGNAL_OUTPUT, INTEGRAL_OUTPUT))
            rows, grown = (a.reshape(-1, a.shape[-1]) for a in (signal, integral))
            means = window.means(rows, grown, initial, stride)[:, before:]
            found.append(means.reshape(*signal.shape[:-1], means.shape[-1]))
        return found[0], found[1]

    def _at_nodes(self, signal: ValuesAndSlopes) -> ValuesAndSlopes:
        return signal[0][:, :: self.stride], signal[1][..., :: self.stride]


def reading_times(grid: ReferenceGrid, stride: int) -> Array:
    """The times after the step at which a response is read [s]."""
    return (grid.t[grid.step_index :] - grid.reference.at)[::stride]


def _move(signal: ValuesAndSlopes, mean: ValuesAndSlopes, reach: ValuesAndSlopes) -> ValuesAndSlopes:
    """The mean where it is within reach of the signal, elsewhere the signal moved towards it by the reach."""
    rest = signal[0] - mean[0]
    side, inside = np.sign(rest), np.abs(rest) <= reach[0]
    slopes = np.where(inside[:, None], mean[1], signal[1] - side[:, None] * reach[1])
    return np.where(inside, mean[0], signal[0] - side * reach[0]), slopes
