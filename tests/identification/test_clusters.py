"""Cluster-robust covariances against literal refits, against the definitions row by row, and by coverage."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import fractional_matrix_power
from scipy.signal import lfilter

from pneuopt.identification.clusters import (
    TIME_BLOCKS,
    Clusters,
    RobustCovariance,
    between_clusters,
    disagreement_p,
    jackknife,
    robust_covariance,
    t_quantile,
)
from pneuopt.quantities.arrays import Array

Rows = list[tuple[Array, Array]]
DRAWS = 100
NAMES = ("coulomb", "viscous", "offset")


def friction_columns(n: int, rng: np.random.Generator) -> Array:
    """Columns of Coulomb and viscous friction and of an offset over two seconds of motion of four frequencies."""
    t = np.linspace(0, 2, n)
    v = sum(0.1 * np.cos(2 * np.pi * rng.uniform(0.5, 3) * t + rng.uniform(0, 2 * np.pi)) for _ in range(4))
    return np.stack([np.tanh(np.asarray(v) / 0.01), v, np.ones(n)], axis=1)


def autoregression(n: int, time: float, rng: np.random.Generator) -> Array:
    """An AR(1) process of unit variance with a correlation time in samples."""
    a = np.exp(-1 / time)
    e = lfilter([np.sqrt(1 - a**2)], [1, -a], rng.standard_normal(n + round(5 * time)))
    return np.asarray(e)[-n:]


def cut(logs: Rows, blocks: int = TIME_BLOCKS) -> tuple[Rows, list[int]]:
    """The rows in blocks of time, and the log of each."""
    rows: Rows = []
    own: list[int] = []
    for i, (X, y) in enumerate(logs):
        count = max(1, round(blocks * len(y) / sum(len(e) for _, e in logs)))
        rows += list(zip(np.array_split(X, count), np.array_split(y, count), strict=True))
        own += [i] * count
    return rows, own


def fit(rows: Rows) -> Array:
    X, y = (np.concatenate(a) for a in zip(*rows, strict=True))
    return np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])


def clusters_of(rows: Rows, logs: list[int], estimate: Array) -> Clusters:
    return Clusters(
        np.array([X.T @ (X @ estimate - y) for X, y in rows]), np.array([X.T @ X for X, _ in rows]), np.array(logs)
    )


def solve(logs: Rows) -> tuple[Array, Array, RobustCovariance]:
    """Estimates, their covariance for white residuals, and the robust one."""
    rows, own = cut(logs)
    estimate = fit(rows)
    X, y = (np.concatenate(a) for a in zip(*rows, strict=True))
    variance = float(np.sum((y - X @ estimate) ** 2)) / (len(y) - 3)
    white = variance * np.linalg.inv(X.T @ X)
    return estimate, white, robust_covariance(clusters_of(rows, own, estimate), white, variance, len(y) - 3.0)


@pytest.fixture
def uneven() -> tuple[Rows, list[int], Clusters]:
    """Three logs of unequal lengths with correlated residuals."""
    rng = np.random.default_rng(3)
    logs = [(friction_columns(n, rng), autoregression(n, 5, rng)) for n in (60, 100, 140)]
    rows, own = cut(logs)
    return rows, own, clusters_of(rows, own, fit(rows))


def test_jackknife_is_that_of_literal_refits(uneven: tuple[Rows, list[int], Clusters]) -> None:
    rows, _, clusters = uneven
    moved = np.array([fit(rows[:g] + rows[g + 1 :]) - fit(rows) for g in range(len(rows))])
    found = jackknife(clusters)
    size = np.abs(moved).max(axis=0)  # within the regularisation, a thousandth of the information
    assert_allclose(found.changes / size, moved / size, rtol=0.01, atol=0.005)
    assert_allclose(np.diag(found.covariance), 23 / 24 * np.sum(moved**2, axis=0), rtol=0.01)


def test_between_clusters_is_bell_and_mccaffreys_definition(uneven: tuple[Rows, list[int], Clusters]) -> None:
    """CR2 and its degrees of freedom with the matrices of all rows, as the paper writes them."""
    rows, own, clusters = uneven
    logs = [
        tuple(np.concatenate(a) for a in zip(*(r for r, o in zip(rows, own, strict=True) if o == i), strict=True))
        for i in range(3)
    ]
    X, y = (np.concatenate(a) for a in zip(*logs, strict=True))
    inverse = np.linalg.inv(X.T @ X)
    residuals, hat = y - X @ inverse @ X.T @ y, X @ inverse @ X.T
    ends = np.cumsum([0, *(len(e) for _, e in logs)])
    meat, columns = np.zeros((3, 3)), []
    for a, b in itertools.pairwise(ends.tolist()):
        root = np.real(fractional_matrix_power(np.eye(b - a) - hat[a:b, a:b], -0.5))
        score = X[a:b].T @ root @ residuals[a:b]
        meat += np.outer(score, score)
        columns.append((np.eye(len(X)) - hat)[:, a:b] @ root @ X[a:b] @ inverse)
    found = between_clusters(clusters.by_log())
    assert_allclose(found.covariance, inverse @ meat @ inverse, rtol=1e-6)
    for k in range(3):
        G = np.stack([c[:, k] for c in columns], axis=1)
        values = np.linalg.eigvalsh(G.T @ G)
        assert found.dof[k] == pytest.approx(values.sum() ** 2 / (values**2).sum(), rel=1e-6)


def test_halving_joins_neighbours_of_one_log_only() -> None:
    blocks = Clusters(np.arange(5.0)[:, None], np.arange(5.0)[:, None, None], np.array([0, 0, 0, 1, 1]))
    half = blocks.halve()
    assert half.scores.ravel().tolist() == [1, 2, 7]
    assert half.logs.tolist() == [0, 0, 1]
    assert half.halve().scores.ravel().tolist() == [3, 7]
    assert blocks.by_log().information.ravel().tolist() == [3, 7]


def test_disagreement_of_white_residuals_is_uniform() -> None:
    """Probabilities of Chow's test over many draws: as many below a tenth as chance has it."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows, own = cut([(friction_columns(480, rng), rng.standard_normal(480))])
        found.append(disagreement_p(clusters_of(rows, own, fit(rows)), 1.0))
    assert np.mean(found) == pytest.approx(0.5, abs=0.07)
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.06)


def white(n: int, rng: np.random.Generator) -> Array:
    return rng.standard_normal(n)


def slow(share: float) -> Callable[[int, np.random.Generator], Array]:
    return lambda n, rng: rng.standard_normal(n) + share * autoregression(n, n / 25, rng)


def coloured(time: float) -> Callable[[int, np.random.Generator], Array]:
    return lambda n, rng: rng.standard_normal(n) + autoregression(n, time, rng)


def coverage(
    logs: int, n: int, residuals: Callable[[int, np.random.Generator], Array], bad: int = 0, scatter: float = 0.0
) -> tuple[Array, Array, float]:
    """Coverage [%] of robust and of white intervals, the worst parameter's, and the share of draws widened."""
    robust, plain, widened = [], [], 0
    for seed in range(DRAWS):
        rng = np.random.default_rng((seed, logs))
        given: Rows = []
        for i in range(logs):
            X = friction_columns(n, rng)
            y = residuals(n, rng) + (autoregression(n, 100, rng) if i < bad else 0.0)
            y = y + X @ (scatter / np.linalg.norm(X, axis=0) * rng.standard_normal(3))
            given.append((X, y))
        estimate, plain_covariance, found = solve(given)
        robust.append(np.abs(estimate) <= t_quantile(found.dof) * np.sqrt(np.diag(found.covariance)))
        plain.append(np.abs(estimate) <= 1.96 * np.sqrt(np.diag(plain_covariance)))
        widened += found.widened
    return 100 * np.mean(robust, axis=0), 100 * np.mean(plain, axis=0), widened / DRAWS


@pytest.mark.parametrize("logs", [1, 3, 8])
def test_white_residuals_keep_their_intervals(logs: int) -> None:
    robust, _, widened = coverage(logs, 960 // logs, white)
    assert np.all(np.abs(robust - 95) <= 5)  # 2.3 binomial deviations of 100 draws
    assert widened <= 0.08


@pytest.mark.parametrize(
    ("logs", "n", "residuals", "bad", "scatter"),
    [
        (1, 3000, slow(0.15), 0, 0.0),
        (1, 3000, slow(0.2), 0, 0.0),
        (1, 2000, coloured(5), 0, 0.0),
        (1, 2000, coloured(20), 0, 0.0),
        (1, 3000, coloured(60), 0, 0.0),
        (8, 400, white, 1, 0.0),
        (4, 400, white, 1, 0.0),
        (3, 200, white, 0, 3.0),
        (7, 200, white, 0, 3.0),
        (20, 200, white, 0, 3.0),
    ],
)
def test_intervals_hold_where_those_of_white_residuals_do_not(
    logs: int, n: int, residuals: Callable[[int, np.random.Generator], Array], bad: int, scatter: float
) -> None:
    robust, plain, widened = coverage(logs, n, residuals, bad, scatter)
    assert plain.min() < 75
    assert robust.min() >= 90 - 6  # two binomial deviations of 100 draws
    assert widened > 0.7
