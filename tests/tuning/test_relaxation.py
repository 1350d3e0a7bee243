"""Limits that no design keeps: the smallest relaxation is the known one, and a design that was found keeps it."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import (
    GainMargin,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    SettlingTime,
    SteadyStateError,
)
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.method import Method
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import with_relaxations
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import TuningResult, tune
from pneuopt.tuning.two_phase import TwoPhase

FAST, PRECISE = Racing(members=8, trials=60), Racing(polish=0)
PEAK, ERROR = 30.0, 0.02


@cache
def proportional(sample_time: float | None) -> TuningResult:
    """P control of y' = -y + u: the command begins with 2 Kp, the error ends at 1/(1 + Kp); 15 and 49 contradict."""
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time, limits=False))
    given = loop.parameters.with_values({"plant.time_constant": 1.0}).with_bounds({"pid.Kp": (1.0, 200.0)})
    method: Method = TwoPhase(nodes=(10, 12), starts=1) if sample_time is None else PRECISE
    limits: list[Requirement] = [PeakControl(PEAK), SteadyStateError(ERROR)]
    step, free = Step(2.0), given.freed("pid.Kp")
    return tune(loop, step, free, minimise=SettlingTime(0.1), subject_to=limits, method=method, throw=False, plants={})


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_the_smallest_relaxation_of_each_limit_is_the_analytic_one(sample_time: float | None) -> None:
    found: Any = proportional(sample_time).relaxations
    assert found.loc["PeakControl", "needed"] == pytest.approx(2 * 49.0, rel=5e-3)
    assert found.loc["SteadyStateError", "needed"] == pytest.approx(1 / 16, rel=5e-3)
    assert found.loc["PeakControl", "share"] == pytest.approx(98 / 30 - 1, rel=1e-2)
    Kp = np.linspace(1.0, 200.0, 100_000)
    together = np.maximum(2 * Kp / PEAK, 1 / (1 + Kp) / ERROR).min() - 1
    assert found.loc["all", "share"] == pytest.approx(together, rel=5e-3)


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_the_status_says_what_would_do(sample_time: float | None) -> None:
    result = proportional(sample_time)
    assert result.status.code is Code.INFEASIBLE
    assert "one alone would do: PeakControl relaxed to 98" in result.status.message
    assert "(30 asked), or SteadyStateError relaxed to 0.06" in result.status.message
    assert "or all limits relaxed by 79.3 %; or widen the gains' bounds" in result.status.message
    assert result.parameters.value("pid.Kp") == 1.0


def test_where_no_relaxation_would_do_wider_bounds_are_the_only_remedy() -> None:
    rows = {"PeakControl": {"asked": PEAK, "needed": np.inf, "share": np.inf}}
    said = with_relaxations(proportional(1e-3), rows, 100).status.message
    assert said.endswith("no limit relaxed alone would do; widen the gains' bounds")


def oscillator() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(sample_time=5e-3))
    bounds = {"pid.Kp": (0.02, 1.0), "pid.Ki": (0.1, 20.0)}
    return loop, loop.parameters.with_values({"pid.Kp": 0.1, "pid.Ki": 1.0}).with_bounds(bounds).freed(*bounds)


@cache
def slow() -> TuningResult:
    loop, given = oscillator()
    limits: list[Requirement] = [SettlingTime(max=0.35), Overshoot(0.02), PeakControl(1.2)]
    step = Step(1.0, horizon=1.0)
    return tune(loop, step, given, minimise=SettlingTime(), subject_to=limits, method=FAST, throw=False, plants={})


def test_a_relaxed_limit_is_the_least_on_a_grid_and_its_design_keeps_the_others() -> None:
    """Brute force: 40 x 40 PI gains."""
    result, (loop, given) = slow(), oscillator()
    assert result.status.code is Code.INFEASIBLE
    relaxed: Any = result.relaxations  # its cells are numbers
    for n in ("SettlingTime", "Overshoot", "PeakControl"):
        if np.isfinite(relaxed.loc[n, "needed"]):
            gains = {k: float(relaxed.loc[n, k]) for k in ("pid.Kp", "pid.Ki")}
            own = evaluate(loop, Step(1.0, horizon=1.0), given.with_values(gains))["0 to 1"]
            allowed = {"SettlingTime": 0.35, "Overshoot": 2.0, "PeakControl": 1.2}
            allowed[n] = float(relaxed.loc[n, "needed"]) * (100 if n == "Overshoot" else 1)
            assert all(own[k] <= most for k, most in allowed.items())
    space = search_space(loop, given)
    grid = np.stack(np.meshgrid(np.linspace(0.02, 0.6, 40), np.linspace(0.5, 8.0, 40)), axis=-1).reshape(-1, 2)
    values = Simulator(loop, [Step(1.0, horizon=1.0)], space).values(grid, specify(SettlingTime()))
    kept = (values["Overshoot"] <= 0.02) & (values["PeakControl"] <= 1.2)
    least = np.nanmin(np.where(kept, values["SettlingTime"], np.nan))
    assert relaxed.loc["SettlingTime", "needed"] <= least * 1.002


def test_a_single_limit_is_answered_with_what_can_be_had() -> None:
    loop, given = oscillator()
    step, limits = Step(1.0, horizon=1.0), [PhaseMargin(179.0)]
    result = tune(loop, step, given, minimise=SettlingTime(), subject_to=limits, method=FAST, throw=False, plants={})
    table: Any = result.relaxations
    needed = table.loc["PhaseMargin", "needed"]
    assert result.status.code is Code.INFEASIBLE
    assert list(result.relaxations.index) == ["PhaseMargin"]
    assert 80.0 < needed < 90.0
    assert result.status.verdict.endswith("of 179")
    assert f"this would do: PhaseMargin relaxed to {needed:.6g} (179 asked)" in result.status.message


def test_limits_that_only_the_margins_miss_are_kept() -> None:
    """Just what one gain can do: a search for less finds nothing, and the design is handed out all the same."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_values({"plant.time_constant": 1.0}).with_bounds({"pid.Kp": (1.0, 200.0)})
    limits: list[Requirement] = [PeakControl(98.05), SteadyStateError(0.02)]
    method = TwoPhase(nodes=(10, 12), starts=1, margin=0.05)
    best = tune(
        loop,
        Step(2.0),
        given.freed("pid.Kp"),
        minimise=SettlingTime(0.1),
        subject_to=limits,
        method=method,
        throw=False,
        plants={},
    )
    assert best.status.converged, best.status
    assert best.parameters.value("pid.Kp") == pytest.approx(49.0, rel=1e-3)
    assert best.relaxations.empty


def test_what_is_left_of_each_limit_is_in_the_result() -> None:
    loop, given = oscillator()
    limits: list[Requirement] = [Overshoot(0.05), PeakControl(3.0), GainMargin(3.0)]
    step = Step(1.0, horizon=1.0)
    best = tune(loop, step, given, minimise=SettlingTime(), subject_to=limits, method=FAST, plants={})
    found: Any = best.requirements  # its cells are numbers
    own = evaluate(loop, step, best.parameters)["0 to 1"]
    assert list(found.index) == ["SettlingTime", "Overshoot", "PeakControl", "GainMargin"]
    assert found.loc["Overshoot", "certified"] == pytest.approx(own["Overshoot"] / 100)
    assert found.loc["GainMargin", "certified"] == pytest.approx(own["GainMargin"])
    assert found.loc["PeakControl", "room"] == pytest.approx(1 - own["PeakControl"] / 3.0)
    assert found.loc["GainMargin", "room"] == pytest.approx(own["GainMargin"] / 3.0 - 1)
    assert np.isnan(found.loc["SettlingTime", "room"])
    assert [n for n in found.index if found.loc[n, "active"]] == [n for n in limits_of(best) if n in found.index]


def limits_of(result: TuningResult) -> list[str]:
    """Active, as the room says it."""
    table: Any = result.requirements
    return [n for n in table.index if table.loc[n, "room"] <= 0.02]
