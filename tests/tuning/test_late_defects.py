"""Where a certificate finds what a response does after its horizon, the next attempt searches over a longer one."""

from typing import Any

import pytest

from pneuopt import catalog
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import NoiseGain, Overshoot, Requirement, RiseTime, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import SecondOrder
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.search import Search
from pneuopt.tuning.tune import prepare_search, prepare_task, tune

SMALL = Screening(12, 8, (), 60)


def slow_problem() -> tuple[ClosedLoop, Any]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 10.0, "plant.damping": 0.7}
    free = {"pid.Kp": (0.0, 20.0), "pid.Ki": (0.0, 30.0)}
    given = loop.parameters.with_values(plant | {"pid.Kp": 0.5, "pid.Ki": 1.0}).with_bounds(free).freed(*free)
    return loop, given


@pytest.mark.parametrize("minimise", [RiseTime(), NoiseGain()])
def test_a_design_that_does_not_reach_the_reference_is_followed_by_one_that_does(minimise: Requirement) -> None:
    """Without integral both are best, and the response stays where it is: that was handed out."""
    (loop, given), heard = slow_problem(), list[str]()
    asked: Any = {"minimise": minimise, "subject_to": [Overshoot(0.05)], "method": SMALL, "plants": {}}
    found = tune(loop, Step(1.0, horizon=1.5), given, progress=heard.append, **asked)
    assert any("searching over 4 horizons" in text for text in heard)
    assert found.certificate is not None
    assert not found.certificate.findings
    later = evaluate(loop, Step(1.0, horizon=24.0), found.parameters).iloc[:, 0]
    assert later["SteadyStateError"] < 0.1
    assert later["SettlingTime"] < 6.0


def search_for(loop: ClosedLoop, step: Step, given: Any) -> Search:
    return prepare_search(prepare_task(loop, step, given, specify(SettlingTime(), [Overshoot(0.05)])), SMALL)


def test_it_has_to_settle_over_the_longer_horizon() -> None:
    loop, given = slow_problem()
    search = search_for(loop, Step(1.0, horizon=1.5), given)
    longer = search.lengthen()
    assert [r.horizon for r in longer.task.references] == [6.0]
    assert longer.spec.limit(SettlingTime) == pytest.approx(0.95 * 6.0)
    assert [r.horizon for r in longer.lengthen().task.references] == [24.0]
    assert search.task.references[0].horizon == 1.5


def test_the_stroke_forbids_a_longer_horizon() -> None:
    drive, rig = catalog.s32()
    loop = ClosedLoop(drive.system(), PID(), measured="speed")
    given = loop.parameters | rig.fixed("*")
    bounds = {"pid.Kp": (0.2, 60.0), "pid.Ki": (0.5, 400.0)}
    given = given.with_values({"pid.Kp": 5.0, "pid.Ki": 30.0}).with_bounds(bounds).freed(*bounds)
    stroke = rig.value("cylinder.stroke")
    search = search_for(loop, Step(0.5 * stroke, horizon=1.0, start={"position": 0.2 * stroke}), given)
    assert search.lengthen() is search
