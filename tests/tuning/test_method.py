"""How far the starts of a search agree, and what that says of optima that none has seen."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.full_space import FullSpace
from pneuopt.tuning.method import Agreement, compare_starts, describe_agreement
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.search import Search
from pneuopt.tuning.tune import TuningResult, tune
from pneuopt.tuning.two_phase import TwoPhase


def test_starts_that_all_agree_warn_of_nothing() -> None:
    found = compare_starts([0.5, 0.5001, 0.5, 0.5], 1e-3)
    stats = found.stats
    assert (stats["starts"], stats["starts_agreeing"], stats["starts_optima"]) == (4, 4, 1)
    assert stats["starts_unseen"] == pytest.approx(2 / 12)
    assert describe_agreement(found) == ("4 of 4 starts agree", "")
    assert describe_agreement(None) == ("", "")


def test_the_chance_of_another_optimum_is_the_one_seen_in_random_draws() -> None:
    """Optima with random shares of the box, uniform as in the paper: one draw more is new with the chance said."""
    rng = np.random.default_rng(0)
    found, said = [], []
    for _ in range(8000):
        count = int(rng.integers(1, 60))
        shares = rng.dirichlet(np.ones(count))
        draws = rng.choice(count, size=9, p=shares)
        seen = set(draws[:8].tolist())
        if len(seen) == 2:
            found.append(draws[8] not in seen)
            said.append(compare_starts([float(k) for k in draws[:8] + 1], 1e-3).unseen)
    assert np.mean(found) == pytest.approx(np.mean(said), abs=0.05)


def test_failed_starts_and_single_ones_say_nothing_of_the_spread() -> None:
    alone = compare_starts([0.7, np.inf], 1e-3)
    assert (alone.converged, alone.agreeing) == (1, 1)
    assert np.isnan([alone.spread, alone.unseen]).all()
    none = compare_starts([np.inf, np.inf], 1e-3)
    assert (none.converged, none.agreeing, none.optima) == (0, 0, 0)


def oscillator() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 5.0, "plant.damping": 0.2}
    free = {"pid.Kp": (0.01, 20.0), "pid.Ki": (0.05, 60.0), "pid.Kd": (0.0, 2.0)}
    given = loop.parameters.with_values(plant | {"pid.Kp": 0.5, "pid.Ki": 2.0, "pid.Tf": 0.05})
    return loop, given.with_bounds(free).freed(*free)


def search(method: TwoPhase, lines: list[str]) -> TuningResult:
    loop, given = oscillator()
    aims: dict[str, Any] = {"minimise": SettlingTime(), "subject_to": [Overshoot(0.05)], "plants": {}, "throw": False}
    return tune(loop, Step(1.0, horizon=4.0), given, **aims, method=method, progress=lines.append)


def test_a_result_says_how_many_of_its_starts_agree() -> None:
    found = search(TwoPhase(nodes=(50, 50), starts=2), [])
    assert found.stats["starts"] == 2
    words, _ = describe_agreement(found.agreement)
    assert words
    assert not found.status.converged or words in str(found.status)


def test_a_search_whose_starts_mostly_fail_ends_after_three() -> None:
    """Each failing start takes longest, and `tune` has another search for such a problem."""
    lines = list[str]()
    search(TwoPhase(nodes=(20, 20), starts=8, solver=FullSpace(max_iterations=1)), lines)
    asked = {line.partition(":")[0] for line in lines if " of 8:" in line}
    assert asked == {f"start {k} of 8" for k in (1, 2, 3)}


@pytest.mark.parametrize(
    ("agreeing", "exact", "raced", "expected"),
    [(1, 5.0, 9.0, 9.0), (1, 9.0, 5.0, 9.0), (2, 5.0, 9.0, 5.0), (1, 5.0, math.nan, 5.0), (2, math.nan, 5.0, 5.0)],
)
def test_where_fewer_than_two_starts_agree_another_search_runs_and_the_better_design_counts(
    monkeypatch: pytest.MonkeyPatch, agreeing: int, exact: float, raced: float, expected: float
) -> None:
    """Of pid.Ki the larger one settles sooner; NaN: the search finds nothing."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 1.0, "pid.Tf": 0.1})
    given = given.with_bounds({"pid.Ki": (0.5, 20.0)}).freed("pid.Ki")
    ran = list[type]()

    def run(search: Search) -> TuningResult:
        ran.append(type(search.method))
        gain = exact if isinstance(search.method, TwoPhase) else raced
        found = search.certify_point(np.array([1.0 if math.isnan(gain) else gain]))
        lost = replace(found, status=Status(Code.NOT_CONVERGED, ("nothing found",)))
        return replace(lost if math.isnan(gain) else found, agreement=Agreement(4, agreeing))

    monkeypatch.setattr(Search, "run", run)
    found = tune(loop, Step(1.0, horizon=4.0), given, minimise=SettlingTime(), plants={})
    assert found.parameters.value("pid.Ki") == expected
    doubtful = agreeing < 2 or math.isnan(exact)
    assert ran == ([TwoPhase, Racing] if doubtful else [TwoPhase])


def test_where_the_second_search_is_interrupted_the_first_one_s_design_is_tried_on_no_plants(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The trial takes longer than a user waits who has pressed Ctrl-C."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_values({"pid.Kp": 4.0, "pid.Ki": 1.0, "pid.Tf": 0.1})
    given = given.with_bounds({"pid.Ki": (0.5, 20.0)}).freed("pid.Ki")

    def run(search: Search) -> TuningResult:
        found = search.certify_point(np.array([5.0]))
        if isinstance(search.method, TwoPhase):
            return replace(found, agreement=Agreement(4, 1))
        return replace(found, status=Status(Code.INTERRUPTED))

    monkeypatch.setattr(Search, "run", run)
    found = tune(loop, Step(1.0, horizon=4.0), given, minimise=SettlingTime(), throw=False)
    assert (found.status.code, found.validation) == (Code.INTERRUPTED, None)
    assert (found.best, found.parameters.value("pid.Ki")) == ({"pid.Ki": 5.0}, 1.0)
