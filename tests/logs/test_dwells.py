"""Moves and dwells of long logs are found in a time that grows as their samples do."""

import numpy as np
import pytest

from pneuopt.logs.doctor import _find_moves
from pneuopt.quantities.arrays import Array


def test_the_steps_of_a_log_are_taken_once_for_all_its_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a move, they took 2 of 45 CPU s of the identification from a million samples with 1859 moves."""
    gradient, taken = np.gradient, list[Array]()

    def count(t: Array) -> Array:
        taken.append(t)
        return np.asarray(gradient(t))

    monkeypatch.setattr(np, "gradient", count)
    t = 0.01 * np.arange(4000.0)
    moves = _find_moves(t, np.where(t % 1.0 < 0.195, 0.3, 0.0))
    assert [first for first, _ in moves] == list(range(0, 4000, 100))
    assert {last - first for first, last in moves} == {20}
    assert len(taken) == 1


def test_a_short_creep_beside_long_moves_is_no_move() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.015, 3000))  # steps of different lengths
    size = np.zeros(3000)
    size[500:900] = size[1500:1900] = 0.5
    size[2500:2502] = 0.1  # 1 mm of 2 m
    assert _find_moves(t, size) == [(500, 900), (1500, 1900)]
