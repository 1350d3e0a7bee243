"""Sequential quadratic programs for max-type problems in a few unknowns, from many starts in lockstep.

Minimise ``f(z) + sum_g weight_g max(floor_g, max_i r_gi(z))`` in a box, f linear: a limit is a group of rows with floor
0 and a weight beyond its multiplier (an exact penalty), an objective such as a peak is one without a floor. The rows
come from compiled simulations with forward sensitivities, the gaps between segments closed in every iteration
(condensed multiple shooting), so that the program in each step is dense and small.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi as ca
import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import require

QP_CURVATURE = 3e-3  # of the program, over the objective's slope: at 1e-5 the solver loses its way
ROW_PADDING = 32  # rows: programs are built for whole multiples of it
MAX_CUTTING_ROUNDS = 20  # rounds in which rows that the step violates are taken in
VIOLATION_TOLERANCE = 1e-7  # by more than this
SHRINK_GAIN_RATIO, GROW_GAIN_RATIO = (
    0.25,
    0.75,
)  # share of the predicted decrease below which the region shrinks, above which it grows
INFINITE_BOUND = 1e20


@dataclass(frozen=True)
class RowGroups:
    """What the rows stand for.

    Parameters
    ----------
    weights : ndarray, shape (n_groups,)
    floors : ndarray, shape (n_groups,)
        0 for a limit, -inf for an objective.
    """

    weights: Array
    floors: Array


@dataclass(frozen=True, eq=False)
class LinearisedPoint:
    """A point with the rows linearised there.

    Parameters
    ----------
    z : ndarray, shape (n,)
    cost : float
        f(z).
    gradient : ndarray, shape (n,)
        Of f.
    values : ndarray, shape (n_rows,)
        -inf: the row does not count here.
    slopes : ndarray, shape (n_rows, n)
    group : ndarray of int, shape (n_rows,)
    groups : Groups
    data : object
        What the problem keeps to improve the point.
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
        """The objective after a step, by the linearised rows."""
        return self._merit(self.values + self.slopes @ d, self.cost + float(self.gradient @ d))

    def _merit(self, values: Array, cost: float) -> float:
        tops = self.groups.floors.copy()
        with np.errstate(invalid="ignore"):
            np.maximum.at(tops, self.group, values)
        total = cost + float(self.groups.weights @ tops)
        return total if np.isfinite(total) else np.inf


class MinimaxProblem(Protocol):
    """What is minimised: least and greatest values, shape (n, 2), and what a trust region of 1 allows, shape (n,)."""

    bounds: Array
    scales: Array

    def evaluate(self, z: Array) -> Sequence[LinearisedPoint]:
        """Linearise at each row of z, shape (m, n)."""

    def improve(self, point: LinearisedPoint) -> LinearisedPoint:
        """A better point that costs no evaluation, or the same."""


@dataclass(frozen=True)
class SQP:
    """Step control.

    Parameters
    ----------
    radius : float
        Of the first trust region, a box.
    least_radius : float
        At which a point has come to its end.
    tolerance : float
        Predicted relative decrease at which it has.
    """

    radius: float = 0.3
    least_radius: float = 1e-5
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        require(0 < self.least_radius < self.radius, f"SQP: radius must exceed {self.least_radius:g}")


@dataclass(frozen=True, eq=False)
class Descent:
    """One start: where it is, its trust region, whether it still moves."""

    point: LinearisedPoint
    radius: float
    moves: bool = True


def descend(
    problem: MinimaxProblem, starts: Array, iterations: int, method: SQP | None = None
) -> list[LinearisedPoint]:
    """Improve every start, so many iterations at most.

    Parameters
    ----------
    problem : Problem
    starts : ndarray, shape (m, n)
    iterations : int
    method : SQP, optional

    Returns
    -------
    list of Point
        One a start, in their order.
    """
    method = method or SQP()
    first = [problem.improve(p) for p in problem.evaluate(starts)]
    found = [Descent(p, method.radius, bool(np.isfinite(p.merit))) for p in first]
    for _ in range(iterations):
        moving = [k for k, d in enumerate(found) if d.moves]
        if not moving:
            break
        for k, descent in zip(moving, _advance(problem, [found[k] for k in moving], method), strict=True):
            found[k] = descent
    return [d.point for d in found]


def _advance(problem: MinimaxProblem, descents: Sequence[Descent], method: SQP) -> list[Descent]:
    """One iteration of each: a step, and where it disappoints a corrected one."""
    steps = [solve_quadratic_program(d.point, _step_box(problem, d)) for d in descents]
    trials = _evaluate_and_improve(problem, [d.point.z + step for d, step in zip(descents, steps, strict=True)])
    gains = [
        (d.point.merit - d.point.predict_merit(s), d.point.merit - t[1].merit)
        for d, s, t in zip(descents, steps, trials, strict=True)
    ]
    poor = [
        k
        for k, (hoped, gained) in enumerate(gains)
        if _promises_decrease(descents[k], hoped, method) and gained < SHRINK_GAIN_RATIO * hoped
    ]
    seconds = [
        _second_order_step(descents[k].point, steps[k], trials[k][0], _step_box(problem, descents[k])) for k in poor
    ]
    for k, second in zip(
        poor,
        _evaluate_and_improve(problem, [descents[k].point.z + s for k, s in zip(poor, seconds, strict=True)]),
        strict=True,
    ):
        if second[1].merit < trials[k][1].merit:
            trials[k] = second
    return [
        _update_descent(d, step / problem.scales, trial[1], hoped, method)
        for d, step, trial, (hoped, _) in zip(descents, steps, trials, gains, strict=True)
    ]


def _evaluate_and_improve(problem: MinimaxProblem, z: Sequence[Array]) -> list[tuple[LinearisedPoint, LinearisedPoint]]:
    """Each point as it is, and improved."""
    if not z:
        return []
    low, up = problem.bounds.T
    return [(p, problem.improve(p)) for p in problem.evaluate(np.clip(np.array(z), low, up))]


def _promises_decrease(descent: Descent, hoped: float, method: SQP) -> bool:
    return hoped > method.tolerance * abs(descent.point.merit)


def _update_descent(descent: Descent, step: Array, trial: LinearisedPoint, hoped: float, method: SQP) -> Descent:
    if not _promises_decrease(descent, hoped, method):
        smaller = 0.25 * descent.radius  # for where the program itself went wrong
        return replace(descent, radius=smaller, moves=hoped < 0 and smaller > method.least_radius)
    gained, reach = descent.point.merit - trial.merit, float(np.max(np.abs(step)))
    radius = descent.radius
    if gained < SHRINK_GAIN_RATIO * hoped:
        radius = 0.4 * min(radius, reach)
    elif gained > GROW_GAIN_RATIO * hoped and reach > 0.9 * radius:
        radius = min(2 * radius, 1.0)
    point = trial if gained > 0 else descent.point
    return Descent(point, radius, radius > method.least_radius)


def _step_box(problem: MinimaxProblem, descent: Descent) -> Array:
    return np.column_stack([problem.bounds, descent.radius * problem.scales])


def _second_order_step(point: LinearisedPoint, step: Array, trial: LinearisedPoint, box: Array) -> Array:
    """The step of the program whose rows are right at the trial: the second-order correction."""
    with np.errstate(invalid="ignore"):
        values = trial.values - point.slopes @ step
    known = np.isfinite(values) & np.isfinite(point.values)
    return solve_quadratic_program(replace(point, values=np.where(known, values, point.values)), box)


def solve_quadratic_program(point: LinearisedPoint, box: Array) -> Array:
    """The step that minimises the linearised problem, shape (n,); zero where there is none.

    The program starts from the highest rows and takes in those that its solution violates.

    Parameters
    ----------
    point : Point
    box : ndarray, shape (n, 3)
        Least and greatest value of each unknown, and how far it may step.
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
    """Local maxima, for rows that lie beside each other in time hold each other down; the highest of them."""
    beside = np.concatenate([[-np.inf], heights, [-np.inf]])
    found = np.flatnonzero((heights > least) & (heights >= beside[:-2]) & (heights >= beside[2:]))
    return np.asarray(found[np.argsort(-heights[found], kind="stable")[:ROW_PADDING]])


def _solve_active_rows(point: LinearisedPoint, rows: Indices, low: Array, up: Array) -> tuple[Array, Array] | None:
    """Step and slacks, one a group; a slack stands at its group's floor, or on its highest row."""
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
    sparsity = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(m, n)}
    return ca.conic("program", "daqp", sparsity, {"error_on_fail": False})
