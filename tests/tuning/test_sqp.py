"""Max-type problems with known answers."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from pneuopt.quantities.arrays import Array
from pneuopt.tuning.sqp import SQP, LinearisedPoint, RowGroups, descend, solve_quadratic_program

Index = NDArray[np.intp]


class Analytic:
    """Rows and slopes as functions of z; a linear objective."""

    def __init__(self, rows: Callable[[Array], tuple[Array, Array]], gradient: Array, groups: RowGroups, group: Index):
        self.rows, self.gradient, self.groups, self.group = rows, gradient, groups, group
        self.bounds, self.scales = np.tile([-5.0, 5.0], (len(gradient), 1)), np.ones(len(gradient))
        self.evaluations = 0

    def evaluate(self, z: Array) -> Sequence[LinearisedPoint]:
        self.evaluations += len(z)
        return [
            LinearisedPoint(x, float(self.gradient @ x), self.gradient, *self.rows(x), self.group, self.groups)
            for x in z
        ]

    def improve(self, point: LinearisedPoint) -> LinearisedPoint:
        return point


MINIMAX = RowGroups(np.ones(1), np.array([-np.inf]))
PENALTY = RowGroups(np.array([20.0]), np.zeros(1))


def cb2(x: Array) -> tuple[Array, Array]:
    """Charalambous and Conn 1978: the minimum of the largest is 1.95222 at (1.13904, 0.89956)."""
    e = 2 * np.exp(x[1] - x[0])
    values = np.array([x[0] ** 2 + x[1] ** 4, (2 - x[0]) ** 2 + (2 - x[1]) ** 2, e])
    return values, np.array([[2 * x[0], 4 * x[1] ** 3], [-2 * (2 - x[0]), -2 * (2 - x[1])], [-e, e]])


@pytest.mark.parametrize("start", [(1.0, -0.1), (3.0, 2.0), (-2.0, 1.0)])
def test_the_largest_of_three_functions(start: tuple[float, float]) -> None:
    problem = Analytic(cb2, np.zeros(2), MINIMAX, np.zeros(3, dtype=np.intp))
    (found,) = descend(problem, np.array([start]), 60)
    assert found.merit == pytest.approx(1.9522245, abs=2e-4)
    assert found.z == pytest.approx([1.13904, 0.89956], abs=0.03)


def test_a_linear_objective_on_a_circle() -> None:
    """Minimise x + y within the unit circle: -sqrt 2; the penalty is exact."""

    def circle(x: Array) -> tuple[Array, Array]:
        return np.array([x @ x - 1]), 2 * x[None]

    problem = Analytic(circle, np.ones(2), PENALTY, np.zeros(1, dtype=np.intp))
    for found in descend(problem, np.array([[2.0, 1.0], [-3.0, 0.5], [0.1, 0.2]]), 60):
        assert found.merit == pytest.approx(-np.sqrt(2), abs=1e-3)
        assert found.values.max() < 1e-4


def test_a_step_that_makes_it_worse_is_refused() -> None:
    """Slopes of the wrong sign: every step of the program leads uphill, so the start stands, and the descent ends."""

    def misleading(x: Array) -> tuple[Array, Array]:
        return np.array([x @ x]), -2 * x[None]

    problem = Analytic(misleading, np.zeros(2), MINIMAX, np.zeros(1, dtype=np.intp))
    (found,) = descend(problem, np.array([[1.0, 2.0]]), 40)
    assert found.z.tolist() == [1.0, 2.0]
    assert found.merit == 5.0
    assert problem.evaluations < 60


def test_the_best_line_through_a_parabola_has_the_known_error() -> None:
    """Chebyshev: x^2 on [-1, 1] is a line within 1/2 and no less, the rows 2 x 201; a vertex, found in few steps."""
    t = np.linspace(-1, 1, 201)
    A = np.column_stack([np.ones_like(t), t])

    def rows(z: Array) -> tuple[Array, Array]:
        e = A @ z - t**2
        return np.concatenate([e, -e]), np.concatenate([A, -A])

    problem = Analytic(rows, np.zeros(2), MINIMAX, np.zeros(402, dtype=np.intp))
    (found,) = descend(problem, np.array([[3.0, -2.0]]), 20)
    assert found.merit == pytest.approx(0.5, abs=1e-6)
    assert problem.evaluations < 20


def test_a_program_solves_the_linear_program_that_scipy_solves() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        n, m, g = 4, 120, 3
        groups = RowGroups(np.array([1.0, 5.0, 3.0]), np.array([-np.inf, 0.0, 0.0]))
        group, slopes, values = rng.integers(g, size=m), rng.normal(size=(m, n)), rng.normal(size=m)
        point = LinearisedPoint(rng.uniform(0, 1, n), 0.0, rng.normal(size=n), values, slopes, group, groups)
        step = solve_quadratic_program(point, np.tile([0.0, 1.0, 0.3], (n, 1)))
        A = np.hstack([slopes, -np.eye(g)[group]])
        box = [(max(-0.3, -z), min(0.3, 1 - z)) for z in point.z] + [(None, None), (0, None), (0, None)]
        exact = linprog(np.concatenate([point.gradient, groups.weights]), A, -values, bounds=box)
        assert point.predict_merit(step) == pytest.approx(exact.fun, abs=1e-3)


def test_a_point_that_is_no_number_is_left() -> None:
    def rows(z: Array) -> tuple[Array, Array]:
        bad = z[0] > 0.5
        return np.array([np.nan if bad else -z[0]]), np.array([[-1.0]])

    problem = Analytic(rows, np.zeros(1), MINIMAX, np.zeros(1, dtype=np.intp))
    (found,) = descend(problem, np.zeros((1, 1)), 40, SQP(radius=1.0))
    assert 0.45 < found.z[0] <= 0.5
    assert np.isfinite(found.merit)
