from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pneuopt.quantities.arrays import Array
from pneuopt.shooting.arrow import ArrowEquations, indistinguishable_parameters, positive_definite_inverse
from pneuopt.shooting.tolerances import STATE_REGULARISATION


def random_problem(m: int, n: int, k: int, seed: int, spread: float = 1.0) -> tuple[ArrowEquations, Array, Array]:
    """Normal equations of random residuals, each of one node or of two neighbours, and of the parameters; and dense."""
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(m):
        own = np.zeros((n + k + 2, m * n + k))
        own[:, i * n : (i + 1) * n] = rng.standard_normal((n + k + 2, n))
        own[:, m * n :] = rng.standard_normal((n + k + 2, k))
        link = np.zeros((n, m * n + k))
        if i + 1 < m:
            link[:, i * n : (i + 2) * n] = spread * rng.standard_normal((n, 2 * n))
            link[:, m * n :] = spread * rng.standard_normal((n, k))
        rows += [own, link]
    J = np.concatenate(rows)
    H, g = J.T @ J, J.T @ rng.standard_normal(len(J))
    blocks = H[: m * n, : m * n].reshape(m, n, m, n)
    here = np.arange(m)
    coupling = np.zeros((m, n, n))
    coupling[:-1] = blocks[here[:-1], :, here[1:], :]
    arrow = ArrowEquations(
        blocks[here, :, here, :],
        coupling,
        H[: m * n, m * n :].reshape(m, n, k),
        H[m * n :, m * n :],
        g[: m * n].reshape(m, n),
        g[m * n :],
    )
    return arrow, H, g


sizes = {"m": st.integers(1, 6), "n": st.integers(0, 4), "k": st.integers(0, 4), "seed": st.integers(0, 10**6)}


@settings(deadline=None)
@given(**sizes, damping=st.sampled_from([0.0, 1e-3, 10.0]), hold=st.integers(0, 15))
def test_a_step_is_the_dense_solution(m: int, n: int, k: int, seed: int, damping: float, hold: int) -> None:
    arrow, H, g = random_problem(m, n, k, seed)
    keep = np.array([not hold >> i & 1 for i in range(k)], dtype=bool)
    reduced = arrow.eliminate(damping)
    assert reduced is not None
    step = reduced.step(keep)
    assert step is not None
    moving = np.concatenate([np.ones(m * n, dtype=bool), keep])
    damped = H + damping * np.diag(np.diag(H)) + STATE_REGULARISATION * np.diag(np.arange(len(H)) < m * n)
    expected = np.zeros(len(H))
    expected[moving] = -np.linalg.solve(damped[np.ix_(moving, moving)], g[moving])
    found = np.concatenate([step.nodes.ravel(), step.parameters])
    assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * max(1.0, np.abs(expected).max(initial=0.0)))
    assert step.nodes.shape == (m, n)
    assert (step.parameters[~keep] == 0).all()


@settings(deadline=None)
@given(m=st.integers(1, 5), n=st.integers(1, 4), k=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_the_schur_complement_is_what_the_parameters_alone_know(m: int, n: int, k: int, seed: int) -> None:
    arrow, H, _ = random_problem(m, n, k, seed)
    reduced = arrow.eliminate(0.0)
    assert reduced is not None
    H = H + STATE_REGULARISATION * np.diag(np.arange(len(H)) < m * n)
    dense = np.linalg.inv(H)[m * n :, m * n :]
    assert indistinguishable_parameters(reduced.schur, arrow.corner).size == 0
    assert_allclose(positive_definite_inverse(reduced.schur), dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())
    assert_allclose(
        reduced.node_sensitivity.reshape(m * n, k), np.linalg.solve(H[: m * n, : m * n], H[: m * n, m * n :])
    )


def test_stiff_links_keep_their_digits() -> None:
    """Gaps weighted 1e7 more than the data, as in the last stage: 1e14 in the matrix."""
    arrow, H, g = random_problem(40, 3, 2, 0, spread=1e7)
    reduced = arrow.eliminate(0.0)
    step = reduced.step(np.ones(2, dtype=bool)) if reduced else None
    assert step is not None
    gradient = H @ np.concatenate([step.nodes.ravel(), step.parameters]) + g
    assert np.abs(gradient).max() < 1e-7 * np.abs(g).max()


def test_what_is_not_positive_definite_gives_no_step() -> None:
    arrow, _, _ = random_problem(2, 2, 2, 0)
    arrow.diagonal[0] *= -1
    assert arrow.eliminate(0.0) is None
    arrow, _, _ = random_problem(2, 2, 2, 0)
    arrow.corner[:] = 0
    reduced = arrow.eliminate(0.0)
    assert reduced is not None
    assert reduced.step(np.ones(2, dtype=bool)) is None
    assert reduced.step(np.zeros(2, dtype=bool)) is not None


def test_an_inverse_ignores_units_but_not_rank() -> None:
    units = np.outer(*2 * [np.array([1e-8, 1.0, 1e9])])
    matrix = np.array([[2.0, 0.5, 0.1], [0.5, 2.0, 0.3], [0.1, 0.3, 2.0]])
    assert_allclose(positive_definite_inverse(matrix * units) * units, np.linalg.inv(matrix), rtol=1e-12)
    assert positive_definite_inverse(np.zeros((0, 0))).shape == (0, 0)


@pytest.mark.parametrize("units", [1.0, 1e6])
def test_the_indistinct_are_named(units: float) -> None:
    J = np.random.default_rng(0).standard_normal((20, 4)) * np.array([1.0, units, 1.0, 1.0])
    assert indistinguishable_parameters(J.T @ J, J.T @ J).tolist() == []
    J[:, 3] = 2 * J[:, 1]
    assert indistinguishable_parameters(J.T @ J, J.T @ J).tolist() == [1, 3]


def test_what_rounding_has_eaten_is_indistinct() -> None:
    """Of a corner of 1e14, a Schur complement of 1e-2 is noise; and a weak direction of 1e-7 is, under 1e8."""
    assert indistinguishable_parameters(np.diag([1.0, 1e-2]), np.diag([1.0, 1e14])).tolist() == [1]
    weak = np.array([[1.0, 1 - 1e-7], [1 - 1e-7, 1.0]])
    assert indistinguishable_parameters(weak, np.eye(2)).tolist() == []
    assert indistinguishable_parameters(weak, 1e8 * np.eye(2)).tolist() == [0, 1]
    assert indistinguishable_parameters(np.full((2, 2), np.nan), np.eye(2)).tolist() == [0, 1]
    assert indistinguishable_parameters(np.zeros((0, 0)), np.zeros((0, 0))).tolist() == []


@pytest.mark.parametrize("bad", [np.inf, np.nan, 1e300])
@pytest.mark.parametrize("part", ["diagonal", "border", "corner", "node_gradient"])
def test_equations_of_an_absurd_start_give_no_warning(part: str, bad: float) -> None:
    """Warnings are errors here; what overflows is no number, and no step of it counts as a descent."""
    arrow, _, _ = random_problem(4, 2, 3, 0)
    spoiled = getattr(arrow, part).copy()
    spoiled[1] = bad
    equations = replace(arrow, **{part: spoiled})
    for damping in (0.0, 1e10):
        reduced = equations.eliminate(damping)
        step = None if reduced is None else reduced.step(np.ones(3, dtype=bool))
        assert step is None or bad == 1e300 or not equations.descent_rate(step) > 0
