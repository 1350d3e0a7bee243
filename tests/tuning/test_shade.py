"""Success-history differential evolution: known optima, the same by the same seed, and a race's bounds are enough."""

from collections.abc import Callable

import numpy as np
import pytest

from pneuopt.tuning.shade import SuccessHistory

Merit = Callable[[np.ndarray], np.ndarray]


def sphere(x: np.ndarray) -> np.ndarray:
    return np.asarray(((x - 0.3) ** 2).sum(axis=1))


def valley(x: np.ndarray) -> np.ndarray:
    """Rosenbrock's, its optimum at 0.75 of the unit cube in every coordinate."""
    z = 4 * x - 2
    return np.asarray((100 * (z[:, 1:] - z[:, :-1] ** 2) ** 2 + (1 - z[:, :-1]) ** 2).sum(axis=1))


def search(merit: Merit, seed: int, generations: int, *, races: bool = False, n: int = 4) -> SuccessHistory:
    rng = np.random.default_rng(seed)
    population = rng.random((30, n))
    history = SuccessHistory(population, merit(population), rng)
    for _ in range(generations):
        trials = history.propose()
        assert trials.min() >= 0
        assert trials.max() <= 1
        merits = merit(trials)
        history.select(trials, np.where(merits > history.merits, np.inf, merits) if races else merits)
    return history


@pytest.mark.parametrize(("merit", "optimum", "generations"), [(sphere, 0.3, 120), (valley, 0.75, 400)])
def test_it_finds_a_known_optimum(merit: Merit, optimum: float, generations: int) -> None:
    for seed in range(3):
        history = search(merit, seed, generations)
        best = history.population[np.argmin(history.merits)]
        assert best == pytest.approx(np.full(4, optimum), abs=1e-4)


def test_a_seed_decides_and_a_bound_is_as_good_as_the_merit_of_what_has_lost() -> None:
    plain, raced, other = search(valley, 1, 40), search(valley, 1, 40, races=True), search(valley, 2, 40)
    assert np.array_equal(plain.population, raced.population)
    assert np.array_equal(plain.merits, raced.merits)
    assert not np.array_equal(plain.population, other.population)


def test_merits_count_by_their_ratio() -> None:
    """Neither the objective's unit nor what never settles, which counts a million, decides what is learned."""
    assert np.array_equal(search(sphere, 5, 30).population, search(lambda x: 4096 * sphere(x), 5, 30).population)


def test_a_tie_moves_on() -> None:
    """On a plateau members move, but teach nothing."""
    history = search(lambda x: np.zeros(len(x)), 0, 10)
    assert np.ptp(history.population, axis=0).min() > 0
