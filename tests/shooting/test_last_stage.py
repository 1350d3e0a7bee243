"""The last stage of a search goes on where its cost still falls steeply."""

from dataclasses import replace

import pytest

from pneuopt.shooting import least_squares as lifted
from pneuopt.shooting.least_squares import Descent, Iterate, LeastSquares, Search, Stage
from tests.shooting.first_order import first_order_log

N = 30


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
    search, falls, taken = Search(first_order_log(N).segments, method), iter(decreases), list[float]()

    def fall(*_: object) -> bool:
        cost = search.current.equations.cost
        taken.append(search.last_decrease)
        search.current = replace(search.current, equations=replace(search.current.equations, cost=0.1 * cost))
        search.last_decrease = next(falls)
        return False

    search.current = replace(search.current, equations=replace(search.current.equations, cost=1e9))
    search.last_decrease = next(falls)
    monkeypatch.setattr(search, "run_stage", fall)
    lifted.repeat_last_stage(search)
    assert taken == [0.3] * repeats


def test_a_stage_keeps_by_how_much_its_last_iteration_has_lowered_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = iter([50.0, 45.0])
    search = Search(first_order_log(N).segments, LeastSquares())
    search.current = replace(search.current, equations=replace(search.current.equations, cost=100.0))

    def step(_: Descent, current: Iterate) -> Iterate:
        return replace(current, equations=replace(current.equations, cost=next(costs)))

    monkeypatch.setattr(Descent, "step", step)
    monkeypatch.setattr(Search, "_corrects_residuals", False)
    assert not search.run_stage(2)
    assert search.last_decrease == pytest.approx(0.1)
