"""Where a certificate finds what a response does after its horizon, the next attempt searches over a longer one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pneuopt import catalog
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Defect, Finding
from pneuopt.evaluation.requirements import ITAE, Overshoot, RiseTime, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import Refusal, TuningResult
from pneuopt.tuning.search import Search
from pneuopt.tuning.tune import prepare_search, prepare_task, tune

SMALL = Racing(8, 60)


def slow_problem() -> tuple[ClosedLoop, Any]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 10.0, "plant.damping": 0.7}
    free = {"pid.Kp": (0.0, 20.0), "pid.Ki": (0.0, 30.0)}
    given = loop.parameters.with_values(plant | {"pid.Kp": 0.5, "pid.Ki": 1.0}).with_bounds(free).freed(*free)
    return loop, given


def test_a_design_that_creeps_is_followed_by_a_search_over_four_horizons(monkeypatch: pytest.MonkeyPatch) -> None:
    (loop, given), heard, horizons = slow_problem(), list[str](), list[float]()
    certify, find = Search.certify_roundings, Racing.find

    def refuse_once(search: Search, found: SearchResult, margin: float) -> TuningResult:
        result = certify(search, found, margin)
        if len(horizons) > 1 or result.certificate is None:
            return result
        creep = Finding(Defect.CREEPS, "0 to 1", "it still moves")
        refused = replace(result.certificate, findings=(creep,))
        return replace(result, status=Status(Code.NOT_CERTIFIED, ("it creeps",)), certificate=refused)

    def record_horizon(method: Racing, task: TuningTask, *rest: Any) -> SearchResult:
        horizons.append(task.references[0].horizon)
        return find(method, task, *rest)

    monkeypatch.setattr(Search, "certify_roundings", refuse_once)
    monkeypatch.setattr(Racing, "find", record_horizon)
    asked: Any = {"minimise": SettlingTime(), "subject_to": [Overshoot(0.05)], "method": SMALL, "plants": {}}
    found = tune(loop, Step(1.0, horizon=1.5), given, progress=heard.append, **asked)
    assert any("searching over 4 horizons" in text for text in heard)
    assert horizons == [1.5, 6.0]
    assert found.status.converged
    claimed, certified = found.requirements["claimed"], found.requirements["certified"]
    assert claimed["SettlingTime"] == pytest.approx(certified["SettlingTime"], rel=5e-3)


def search_for(loop: ClosedLoop, step: Step, given: Any) -> Search:
    return prepare_search(prepare_task(loop, step, given, specify(SettlingTime(), [Overshoot(0.05)])), SMALL)


def test_it_has_to_settle_within_the_horizon_or_the_longer_one() -> None:
    loop, given = slow_problem()
    search = search_for(loop, Step(1.0, horizon=1.5), given)
    for rests, latest in ((True, 1.5), (False, 6.0)):
        longer = search.lengthen(rests=rests)
        assert [r.horizon for r in longer.task.references] == [6.0]
        assert longer.spec.limit(SettlingTime) == pytest.approx(0.95 * latest)
    assert [r.horizon for r in longer.lengthen(rests=False).task.references] == [24.0]
    assert search.task.references[0].horizon == 1.5


@pytest.mark.parametrize(("start", "factor"), [(0.1, 1.4), (0.45, 1.0)])
def test_the_stroke_allows_less_than_four_horizons(start: float, factor: float) -> None:
    """A step of half a stroke a second: from 10 % on it has room for 1.8 s, from 45 % on for 1.1 s."""
    drive, rig = catalog.s32()
    loop = ClosedLoop(drive.system(), PID(), measured="speed")
    given = loop.parameters | rig.fixed("*")
    bounds = {"pid.Kp": (0.2, 60.0), "pid.Ki": (0.5, 400.0)}
    given = given.with_values({"pid.Kp": 5.0, "pid.Ki": 30.0}).with_bounds(bounds).freed(*bounds)
    stroke = rig.value("cylinder.stroke")
    search = search_for(loop, Step(0.5 * stroke, horizon=1.0, start={"position": start * stroke}), given)
    longer = search.lengthen(rests=True)
    assert [r.horizon for r in longer.task.references] == [pytest.approx(factor)]
    assert (longer is search) == (factor == 1.0)


def test_a_limit_that_breaks_after_the_horizon_is_no_matter_of_rounding() -> None:
    """The largest overshoot comes at .3 s, the horizon ends at .15 s: the next search has to see it."""
    loop, given = slow_problem()
    found = {}
    for horizon in (0.15, 2.0):
        task = prepare_task(loop, Step(1.0, horizon=horizon), given, specify(ITAE(), [Overshoot(0.05)]))
        found[horizon] = prepare_search(task, SMALL).certify_point(np.array([1.0, 18.0]))
        assert found[horizon].status.code is Code.NOT_CERTIFIED
        assert "Overshoot is" in found[horizon].status.message
    assert found[0.15].stats["fails_late"] == 1.0
    assert "fails_late" not in found[2.0].stats
    assert [found[h].refusal for h in (0.15, 2.0)] == [Refusal.LATE, None]


def test_a_design_that_meets_an_end_stop_is_followed_by_a_search_for_one_that_rests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (loop, given), heard, certify = slow_problem(), list[str](), Search.certify_roundings

    def meet_the_stop(search: Search, found: SearchResult, margin: float) -> TuningResult:
        result = certify(search, found, margin)
        status = Status(Code.NOT_CERTIFIED, ("the stop",))
        refused = replace(result, status=status, stats={}, refusal=Refusal.END_STOP)
        return result if search.rests else refused

    monkeypatch.setattr(Search, "certify_roundings", meet_the_stop)
    asked: Any = {"minimise": RiseTime(), "subject_to": [Overshoot(0.05)], "method": SMALL, "plants": {}}
    found = tune(loop, Step(1.0, horizon=1.5), given, progress=heard.append, **asked)
    assert any("searching for one that does" in text for text in heard)
    assert found.status.converged
    assert found.certified.loc["SettlingTime"].max() <= 1.5
