"""Sequential quadratic programs for max-type problems in a few unknowns, from many starts in lockstep.

Minimise ``f(z) + sum_g weight_g max(floor_g, max_i r_gi(z))`` in a box, f linear: a limit is a group of rows with floor
0 and a weight beyond its multiplier (an exact penalty), an objective such as a peak is one without a floor. The rows
come from compiled simulations with forward sensitivities, so that the program in each step is dense and small.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi as ca
import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import require

# Curvature of the quadratic program over the objective's slope. At 1e-5 the solver fails on nearly flat programs; a
# larger one shortens the steps.
QP_CURVATURE = 3e-3
# Numbers of rows are rounded up to multiples of it, so that few programs are built. With a smaller one each program is
# built anew; a larger one makes the solver work on empty rows.
ROW_PADDING = 32
# Rounds in which rows that a step violates are added to its program. Fewer may return a step that violates rows; each
# more costs a program.
MAX_CUTTING_ROUNDS = 20
# Violation from which a row is added, as rows count. A smaller one adds rows for rounding errors; a larger one leaves
# violations in the step.
VIOLATION_TOLERANCE = 1e-7
# Actual over predicted decrease below which the trust region shrinks, and above which it grows. Higher ones keep steps
# short; lower ones accept steps that the linearisation does not predict.
SHRINK_GAIN_RATIO, GROW_GAIN_RATIO = 0.25, 0.75
INFINITE_BOUND = 1e20  # stands for no bound; a smaller one might be reached by a slack of a badly scaled objective


@dataclass(frozen=True)
class RowGroups:
    """The weights and floors of groups of rows: a group is a limit or a term of the objective.

    Parameters
    ----------
    weights : ndarray, shape (n_groups,)
        The penalty of a limit's violation, or the weight of an objective.
    floors : ndarray, shape (n_groups,)
        0 for a limit, -inf for an objective.
    """

    weights: Array
    floors: Array


@dataclass(frozen=True, eq=False)
class LinearisedPoint:
    """A point and the objective's rows linearised there.

    Parameters
    ----------
    z : ndarray, shape (n,)
    cost : float
        f(z).
    gradient : ndarray, shape (n,)
        The gradient of f.
    values : ndarray, shape (n_rows,)
        -inf: the row does not count here.
    slopes : ndarray, shape (n_rows, n)
        Derivatives of the values.
    group : ndarray of int, shape (n_rows,)
        The group of each row.
    groups : RowGroups
    data : object
        Anything that the problem needs to improve the point.
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
    """Step control of the sequential quadratic programs.

    Parameters
    ----------
    radius : float
        Half width of the first trust region, a box, as a fraction of the unknowns' ranges.
    least_radius : float
        Half width below which a descent ends.
    tolerance : float
        Predicted relative decrease of the objective below which it ends.
    """

    radius: float = 0.3
    least_radius: float = 1e-5
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        require(0 < self.least_radius < self.radius, f"SQP: radius must exceed {self.least_radius:g}")


@dataclass(frozen=True, eq=False)
class Descent:
    """The descent from one start: its present point, its trust region, and whether it goes on."""

    point: LinearisedPoint
    radius: float
    moves: bool = True


def descend(
    problem: MinimaxProblem, starts: Array, iterations: int, method: SQP | None = None
) -> list[LinearisedPoint]:
    """Descend from every start in lockstep, for so many iterations at most.

    Parameters
    ----------
    problem : MinimaxProblem
    starts : ndarray, shape (m, n)
    iterations : int
    method : SQP, optional

    Returns
    -------
    list of LinearisedPoint
        One for each start, in their order.
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
        if _promises_decrease(descents[k], predicted, method) and gained < SHRINK_GAIN_RATIO * predicted
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
        _update_descent(d, step / problem.scales, trial[1], predicted, method)
        for d, step, trial, (predicted, _) in zip(descents, steps, trials, gains, strict=True)
    ]


def _evaluate_and_improve(problem: MinimaxProblem, z: Sequence[Array]) -> list[tuple[LinearisedPoint, LinearisedPoint]]:
    """Evaluate points within the bounds; each as it is, and improved."""
    if not z:
        return []
    low, up = problem.bounds.T
    return [(p, problem.improve(p)) for p in problem.evaluate(np.clip(np.array(z), low, up))]


def _promises_decrease(descent: Descent, predicted: float, method: SQP) -> bool:
    """Whether the predicted decrease of the objective is worth a step."""
    return predicted > method.tolerance * abs(descent.point.merit)


def _update_descent(descent: Descent, step: Array, trial: LinearisedPoint, predicted: float, method: SQP) -> Descent:
    """Accept or refuse a trial point, and adapt the trust region."""
    if not _promises_decrease(descent, predicted, method):
        smaller = 0.25 * descent.radius  # where the program failed, a smaller region may help
        return replace(descent, radius=smaller, moves=predicted < 0 and smaller > method.least_radius)
    gained, reach = descent.point.merit - trial.merit, float(np.max(np.abs(step)))
    radius = descent.radius
    if gained < SHRINK_GAIN_RATIO * predicted:
        radius = 0.4 * min(radius, reach)
    elif gained > GROW_GAIN_RATIO * predicted and reach > 0.9 * radius:
        radius = min(2 * radius, 1.0)
    point = trial if gained > 0 else descent.point
    return Descent(point, radius, radius > method.least_radius)


def _step_box(problem: MinimaxProblem, descent: Descent) -> Array:
    """Bounds and trust region as `solve_quadratic_program` takes them, shape (n, 3)."""
    return np.column_stack([problem.bounds, descent.radius * problem.scales])


def _second_order_step(point: LinearisedPoint, step: Array, trial: LinearisedPoint, box: Array) -> Array:
    """The second-order correction: the step of the program with the rows' true values at the trial point."""
    with np.errstate(invalid="ignore"):
        values = trial.values - point.slopes @ step
    known = np.isfinite(values) & np.isfinite(point.values)
    return solve_quadratic_program(replace(point, values=np.where(known, values, point.values)), box)


def solve_quadratic_program(point: LinearisedPoint, box: Array) -> Array:
    """The step that minimises the linearised problem, shape (n,); zero where there is none.

    The program starts from the highest rows and takes in those that its solution violates.

    Parameters
    ----------
    point : LinearisedPoint
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
