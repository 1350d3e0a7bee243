"""The samples of a search follow the response, and a claim holds on them before it is certified or refused."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import IAE, ITAE, MaxSensitivity, Overshoot, Requirement, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import SearchResult
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.search import Search
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tolerances import MAX_LOOP_SUBSTEPS
from pneuopt.tuning.tune import prepare_task, tune

STEP = Step(1.0, horizon=20.0)
FREE = {"pid.Kp": (0.01, 20.0), "pid.Ki": (0.1, 400.0), "pid.Kd": (0.0, 1.0), "pid.Tf": (1e-3, 0.05)}
GAINS = {"pid.Kp": 7.502, "pid.Ki": 394.9, "pid.Kd": 0.4313, "pid.Tf": 0.001003}


def problem(step: Step = STEP) -> tuple[ClosedLoop, Simulator]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 30.0, "plant.damping": 0.3}
    given = loop.parameters.with_values(plant | GAINS).with_bounds(FREE).freed(*FREE)
    return loop, Simulator(loop, [step], search_space(loop, given), spec=specify(ITAE(), [IAE(1.0)]))


def test_samples_are_added_where_the_response_is() -> None:
    _, simulator = problem()
    start, spec = simulator.space.start, specify(ITAE(), [IAE(1.0)])
    finer = simulator.refine(start)
    assert len(finer.grids[0].t) < 4 * len(simulator.grids[0].t)
    assert np.diff(finer.grids[0].t)[0] < 1e-3
    assert np.all(np.diff(finer.grids[0].t) > 0)
    assert simulator.values(start[None], spec)["ITAE"][0] < 0.1 * 5.088e-6
    assert finer.values(start[None], spec)["ITAE"][0] == pytest.approx(5.088e-6, rel=5e-3)  # tests/evaluation
    assert finer.values(start[None], spec)["SettlingTime"][0] == pytest.approx(0.00592, rel=5e-3)
    assert len(finer.coarse(spec).grids[0].t) == len(finer.grids[0].t)


def test_slow_responses_need_no_more_samples() -> None:
    _, simulator = problem(Step(1.0, horizon=2.0))
    assert simulator.refine(np.array([0.05, 1.0, 0.0, 0.01])) is simulator
    assert simulator.refine(simulator.space.start) is not simulator


def test_steps_that_change_a_claim_are_halved_and_a_short_search_goes_on_from_its_point() -> None:
    step = Step(1.0, horizon=2.0)
    loop, simulator = problem(step)
    method, point = Racing(), np.array([0.05, 1.0, 0.0, 0.01])
    spec, calls, agree = specify(ITAE(), [IAE(1.0)]), list[tuple[Simulator, int]](), iter([False, True])

    def find(*given: Any) -> SearchResult:
        calls.append((given[2], given[5]))
        return SearchResult(given[4], Status(Code.CONVERGED), (), optimum=1.0, uses_simulator=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Racing, "find", find)
        patch.setattr(Search, "_agree", lambda *_: next(agree))
        task = prepare_task(loop, step, simulator.space.parameters, spec)
        found = Search(task, method, lambda _: None).find(method.margin, point, 0)
    (first, full), (second, short) = calls
    assert (full, short) == (0, 1)
    assert second.grids is first.grids
    assert second.substeps[0] >= 2 * first.substeps[0]
    assert found.point.tolist() == point.tolist()


def test_steps_are_halved_until_there_are_too_many() -> None:
    simulators = [problem()[1]]
    for _ in range(20):
        simulators.append(simulators[-1].shorten_steps())
    counts = list(dict.fromkeys(max(s.substeps) for s in simulators))
    assert len(counts) >= 3
    assert all(fine >= 2 * coarse for coarse, fine in pairwise(counts))
    assert counts[-1] <= MAX_LOOP_SUBSTEPS < 2 * counts[-1]
    assert simulators[-1] is simulators[-2]


@pytest.mark.parametrize("minimise", [SettlingTime(), ITAE()])
def test_a_fast_loop_in_a_long_horizon_is_claimed_as_it_is(minimise: Requirement) -> None:
    loop, simulator = problem()
    small = Racing(8, 60)
    limits = [Overshoot(0.05), MaxSensitivity(2.0)]
    given = simulator.space.parameters
    found = tune(loop, STEP, given, minimise=minimise, subject_to=limits, method=small, throw=False, plants={})
    claimed, certified = found.requirements["claimed"], found.requirements["certified"]
    assert found.status.converged
    np.testing.assert_allclose(claimed, certified, rtol=5e-3, atol=1e-3)
    assert found.certified.loc["SettlingTime"].max() < 0.1
