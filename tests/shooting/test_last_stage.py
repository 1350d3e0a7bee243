"""The last stage of a search goes on where its cost still falls steeply."""

from dataclasses import replace

import pytest

from pneuopt.shooting import least_squares as lifted
from pneuopt.shooting.least_squares import Iterate, LeastSquares, LevenbergMarquardt, SearchState, Stage, start_search
from tests.shooting.first_order import first_order_log

N = 30


def with_cost(state: SearchState, cost: float) -> SearchState:
    """The state at a cost that its equations only claim."""
    return replace(state, iterate=replace(state.iterate, equations=replace(state.iterate.equations, cost=cost)))


@pytest.mark.parametrize(
    ("decreases", "iterations", "repeats"),
    [((0.3, 0.3, 0.05, 0.3), 30, 2), ((0.05, 0.3), 30, 0), ((0.0,), 30, 0), ((0.3, 0.3), 10, 0)],
)
def test_a_search_whose_cost_falls_steeply_goes_on_before_it_is_near_the_noise(
    decreases: tuple[float, ...], iterations: int, repeats: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log that sticks and slips fell from 7 to 1.3 times its noise in the last of 30 iterations, and was refused.

    A short trial of a long log ends: the next way is cheaper.
    """
    method = LeastSquares(stages=(Stage(1e-5, iterations, refine=2),))
    falls, taken = iter(decreases), list[float]()

    def fall(state: SearchState, _: object = None) -> SearchState:
        taken.append(state.last_decrease)
        return replace(with_cost(state, 0.1 * state.iterate.cost), last_decrease=next(falls))

    state = replace(with_cost(start_search(first_order_log(N).segments, method), 1e9), last_decrease=next(falls))
    monkeypatch.setattr(lifted, "iterate", fall)
    lifted.repeat_last_stage(state)
    assert taken == [0.3] * repeats


def test_a_stage_keeps_by_how_much_its_last_iteration_has_lowered_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = iter([50.0, 45.0])
    state = with_cost(start_search(first_order_log(N).segments, LeastSquares()), 100.0)

    def step(_: LevenbergMarquardt, current: Iterate) -> Iterate:
        return replace(current, equations=replace(current.equations, cost=next(costs)))

    monkeypatch.setattr(LevenbergMarquardt, "step", step)
    monkeypatch.setattr(SearchState, "corrects_residuals", False)
    state = lifted.iterate(state, 2)
    assert not state.has_stalled
    assert state.last_decrease == pytest.approx(0.1)
