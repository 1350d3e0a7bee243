"""The certificate of a search's point: limits, objective and defects decide, each by the independent figures."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import (
    IAE,
    REQUIREMENT_KINDS,
    NoiseGain,
    Overshoot,
    PeakControl,
    Requirement,
    RiseTime,
    SettlingTime,
    SteadyStateError,
)
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning import search as certifier
from pneuopt.tuning.method import SearchResult
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.search import Search
from pneuopt.tuning.tune import prepare_search, prepare_task

POINT = np.array([0.5, 8.0])  # Kp, Ki: an overshoot of 4.6 %
FAST, SLOW = {"plant.gain": 1.2}, {"plant.gain": 0.6}


def search(
    minimise: Requirement, *limits: Requirement, scenarios: dict[str, Any] | None = None, accept: Sequence[Defect] = ()
) -> Search:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.0, 10.0), "pid.Ki": (0.0, 100.0)}).freed("pid.Kp", "pid.Ki")
    given = given.with_values({"pid.Kp": 0.5, "pid.Ki": 5.0})
    task = prepare_task(loop, Step(1.0, horizon=2.0), given, specify(minimise, limits), scenarios or {}, accept)
    return prepare_search(task, Racing())


class ForgedSimulator:
    """A search's simulator whose claims are multiplied by factors."""

    def __init__(self, tuning: Search, **factors: float) -> None:
        self.cases, self._inner, self._factors = tuning.simulator.cases, tuning.simulator, factors

    def table(self, point: Any, spec: Any) -> list[dict[str, float]]:
        rows = self._inner.table(point, spec)
        return [{n: v * self._factors.get(n, 1.0) for n, v in row.items()} for row in rows]


def certify(tuning: Search, **factors: float) -> TuningResult:
    found = SearchResult(POINT, Status(Code.CONVERGED), (), optimum=np.inf)
    forged: Any = ForgedSimulator(tuning, **factors)
    return tuning.certifier.certify(forged, found, POINT)


@cache
def overshoots() -> dict[str, float]:
    """Certified overshoots of the point, as fractions, by case."""
    found = certify(search(IAE(), scenarios={"fast": FAST, "slow": SLOW})).certified.T["Overshoot"]
    return {str(case): float(value) / 100 for case, value in found.to_dict().items()}


def test_limits_are_judged_by_the_certificate_and_not_by_the_claim() -> None:
    nominal = next(iter(overshoots().values()))
    tuning = search(IAE(), Overshoot(0.8 * nominal))
    claims_less = certify(tuning, Overshoot=0.5)
    assert claims_less.status.code is Code.NOT_CERTIFIED
    assert claims_less.status.sentences[0].startswith("Overshoot is")
    assert certify(search(IAE(), Overshoot(1.2 * nominal)), Overshoot=2.0).status.converged


def test_a_limit_has_no_slack() -> None:
    nominal = next(iter(overshoots().values()))
    kept, broken = (certify(search(IAE(), Overshoot(nominal * share))).status for share in (1.0001, 0.9975))
    assert kept.converged
    assert not broken.converged


def test_the_worst_case_decides_and_not_their_mean() -> None:
    every = list(overshoots().values())
    limit = float(np.mean(every) + max(every)) / 2
    assert np.mean(every) < limit < max(every)
    result = certify(search(IAE(), Overshoot(limit), scenarios={"fast": FAST, "slow": SLOW}))
    assert not result.status.converged
    assert "fast" in result.status.sentences[0]
    alone = certify(search(Overshoot(), scenarios={"fast": FAST, "slow": SLOW}))
    assert alone.requirements.loc["Overshoot", "certified"] == pytest.approx(max(every))


@pytest.mark.parametrize(("factor", "agrees"), [(0.5, False), (0.97, False), (1.0, True), (1.03, False), (4.0, False)])
def test_an_objective_that_is_claimed_too_low_or_too_high_is_refused(factor: float, agrees: bool) -> None:
    result = certify(search(IAE()), IAE=factor)
    assert result.status.converged is agrees
    assert agrees or "the objective is" in result.status.sentences[0]


def test_an_optimum_before_rounding_is_not_missed_by_much() -> None:
    tuning = search(IAE())
    exact = float(certify(tuning).requirements["certified"]["IAE"])
    lower = SearchResult(POINT, Status(Code.CONVERGED), (), optimum=0.9 * exact)
    assert not tuning.certifier.certify(tuning.simulator, lower, POINT).status.converged


def test_an_objective_of_zero_is_no_refusal() -> None:
    tuning = search(Overshoot())
    point = np.array([0.5, 4.0])  # no overshoot
    found = SearchResult(point, Status(Code.CONVERGED), (), optimum=0.0)
    assert tuning.certifier.certify(tuning.simulator, found, point).status.converged
    assert certifier.objectives_agree(4.16e-16, 0.0, 0.0, specify(Overshoot()).resolution)
    assert not certifier.objectives_agree(1e-3, 0.0, 0.0, specify(Overshoot()).resolution)


def test_every_kind_has_a_resolution_far_below_what_is_asked_for() -> None:
    assert all(0 < kind.metric.resolution <= 1e-5 for kind in REQUIREMENT_KINDS)


@pytest.mark.parametrize(("kind", "lack"), [(SettlingTime, "does not settle"), (RiseTime, "does not reach 90 %")])
def test_a_design_without_the_objectives_value_is_refused_in_words(kind: type[Requirement], lack: str) -> None:
    """The search over a longer horizon may hand out what does not settle within the one asked for."""
    refused = search(kind()).certify_point(np.array([0.5, 0.3])).status
    assert refused.code is Code.NOT_CERTIFIED
    assert refused.sentences[0].startswith(f"the design found {lack}")
    assert refused.sentences[0].endswith("within its horizon")
    two = search(kind(), scenarios={"fast": FAST}).certify_point(np.array([0.5, 0.3])).status
    assert two.sentences[0].endswith("within its horizon at 0 to 1")


def test_a_value_that_only_the_search_has_is_told() -> None:
    tuning, never = search(SettlingTime()), np.array([0.5, 0.3])
    found = SearchResult(never, Status(Code.CONVERGED), (), optimum=0.5)
    row = {**tuning.simulator.table(never, tuning.spec)[0], "SettlingTime": 0.5}
    forged: Any = type("Claims", (), {"cases": tuning.simulator.cases, "table": lambda *_: [row]})()
    refused = tuning.certifier.certify(forged, found, never).status
    assert refused.sentences[0] == "the design found does not settle within its horizon, claimed 0.5"


def test_a_simulation_that_stops_certifies_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_args: Any, **_options: Any) -> Any:
        raise ConvergenceError("the simulation stopped after t = 0.1 s", None)

    monkeypatch.setattr(certifier, "evaluate_cases", stop)
    result = certify(search(IAE()))
    assert result.status.code is Code.NOT_CERTIFIED
    assert "stopped" in result.status.sentences[0]
    assert result.certificate is None
    assert result.certified.isna().all(axis=None)


def test_an_unstable_design_is_refused_unless_all_that_is_wrong_is_accepted_by_name() -> None:
    point = np.array([0.5, 22.5])
    tunings = [search(IAE(), accept=a) for a in ((), (Defect.UNSTABLE,), (Defect.UNSTABLE, Defect.GROWS))]
    results = [t.certify_point(point) for t in tunings]
    assert [r.status.converged for r in results] == [False, False, True]
    assert "unstable" in results[0].status.sentences[0]
    assert "runs away" in results[1].status.sentences[0]
    assert "'grows'" in results[1].status.sentences[-1]
    assert results[2].status.sentences[1].startswith("accepted: the linear loop is unstable")
    assert [r.parameters.value("pid.Ki") for r in results] == [5.0, 5.0, 22.5]


@pytest.mark.parametrize("kind", [RiseTime, NoiseGain, PeakControl])
def test_a_design_that_hardly_moves_is_never_certified(kind: type[Requirement]) -> None:
    tuning = search(kind(), Overshoot(0.05))
    for point in ([0.0, 0.0], [1e-3, 0.0], [0.9, 0.0]):
        result = tuning.certify_point(np.array(point))
        assert result.status.code is Code.NOT_CERTIFIED


def test_a_search_that_may_stand_still_is_repeated_among_designs_that_arrive() -> None:
    """The least peak of a command that brings a gain of 1 to within 2 % of the reference is 0.98 V."""
    best = replace(search(PeakControl(), Overshoot(0.05)), method=Racing(8, 60)).run()
    assert best.status.converged
    assert best.requirements.T["PeakControl"]["certified"] == pytest.approx(0.99, rel=0.02)
    assert best.certified.T["SettlingTime"].max() <= 1.9
    assert best.certified.T["SteadyStateError"].max() <= 2.0


def test_a_rest_off_the_reference_is_accepted_as_far_as_a_limit_on_it_says() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0)}).with_values({"pid.Kp": 9.0, "pid.Ki": 0.0})
    given = given.freed("pid.Kp")

    def rest(*limits: Requirement) -> TuningResult:
        task = prepare_task(loop, Step(1.0), given, specify(IAE(), limits))
        return prepare_search(task, Racing()).certify_point(np.array([9.0]))  # rests 10 % off

    assert rest(SteadyStateError(0.11)).status.converged
    assert "misses the reference" in rest().status.sentences[0]
    assert "misses the reference" in rest(Overshoot(0.1)).status.sentences[0]
