"""Every kind of requirement as objective, weighted term and limit: found by the search, certified by the simulation."""

import math
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    Ripple,
    RiseTime,
    SettlingTime,
    StepEnvelope,
    metric_name,
    requirement_values,
    upper_limit,
)
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import TuningResult, tune
from pneuopt.tuning.two_phase import TwoPhase

FAST = Racing(members=8, trials=80)
STEP, SETTLING = Step(1.0, horizon=1.0), SettlingTime()
TUBE = ((0.0, -0.1, 1.1), (0.3, 0.8, 1.05), (0.8, 0.97, 1.03))
FREE = {"pid.Kp": (0.02, 1.0), "pid.Ki": (0.1, 20.0)}


def speed_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(SecondOrder().system(), PID(sample_time=5e-3))
    return loop, loop.parameters.with_values({"pid.Kp": 0.1, "pid.Ki": 1.0}).with_bounds(FREE).freed(*FREE)


@cache
def tuned(*limits: Requirement, minimise: Requirement = SETTLING) -> TuningResult:
    loop, given = speed_loop()
    return tune(loop, STEP, given, minimise=minimise, subject_to=limits, method=FAST, plants={}, throw=False)


def column(table: pd.DataFrame, case: str = "0 to 1") -> dict[str, float]:
    return {str(n): float(v) for n, v in zip(table.index, table[case].to_numpy(dtype=float), strict=True)}


@pytest.mark.parametrize(
    "limit",
    [
        RiseTime(0.15),
        Ripple(0.002),
        IAE(0.16),
        ISE(0.1),
        ITAE(0.03),
        StepEnvelope(TUBE),
        ControlRate(6.0),
        MaxComplementarySensitivity(1.01),
        GainMargin(45.0),
        PhaseMargin(66.0),
        NoiseGain(1.05),
    ],
    ids=metric_name,
)
def test_each_kind_is_a_limit_that_is_certified(limit: Requirement) -> None:
    """Found by the search, kept by the independent simulation, which reads what the search claims."""
    found = tuned(limit)
    assert found.status.converged, found.status
    certified, kind = column(found.certified), metric_name(limit)
    assert requirement_values(certified)[kind] <= upper_limit(limit)
    assert column(found.claimed)[kind] == pytest.approx(certified[kind], rel=2e-3, abs=1e-5)


def test_a_limit_changes_the_answer() -> None:
    free, held = tuned(), tuned(PhaseMargin(72.0))
    assert free.status.converged
    assert held.status.converged, held.status
    assert 72.0 <= column(held.certified)["PhaseMargin"] <= 76.0
    assert "PhaseMargin" in held.active
    assert column(held.certified)["SettlingTime"] > column(free.certified)["SettlingTime"]


@pytest.mark.parametrize("kind", [IAE, ISE, ITAE, GainMargin, PhaseMargin, NoiseGain, MaxComplementarySensitivity])
def test_each_kind_is_an_objective(kind: type[Requirement]) -> None:
    """Whatever is minimised ends better than where another one is."""
    other = tuned(RiseTime(0.3), minimise=ControlRate())
    best = tuned(RiseTime(0.3), minimise=kind())
    assert best.status.converged, best.status
    loop, given = speed_loop()
    values = [
        requirement_values(column(evaluate(loop, STEP, given | found.parameters)))[kind.__name__]
        for found in (best, other)
    ]
    assert values[0] <= values[1] * (1 + 1e-3)


def test_a_weighted_term_shifts_the_compromise() -> None:
    (loop, given), gains = speed_loop(), list[float]()
    for weight in (1e-3, 1.0):
        found = tune(loop, STEP, given, minimise={ITAE(): 1.0, NoiseGain(): weight}, method=FAST, plants={})
        gains.append(column(found.certified)["NoiseGain"])
    assert gains[1] < gains[0]


def test_a_linear_loop_is_raced_where_the_exact_problem_has_no_equation() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    limits: list[Requirement] = [PeakControl(4.0), ControlRate(30.0)]
    with pytest.raises(InputError, match=r"TwoPhase has no equation for IAE, ControlRate; use method=Racing\(\)"):
        tune(loop, Step(1.0), given, minimise=IAE(), subject_to=limits, method=TwoPhase())
    found = tune(loop, Step(1.0), given, minimise=IAE(), subject_to=limits, plants={})
    assert column(found.certified)["ControlRate"] <= 30.0
    assert "simulations" in found.stats


def test_margins_of_a_drive_with_friction_hold_about_the_moving_reference() -> None:
    """Friction's slope at the speed reached counts: a falling one costs phase where the drive creeps."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3))
    given = loop.parameters.with_values({"pid.Kp": 300.0, "pid.Ki": 4000.0})
    slow, fast = (column(evaluate(loop, Step(v, horizon=1.0), given), f"0 to {v:g}") for v in (0.03, 0.2))
    assert slow["PhaseMargin"] < fast["PhaseMargin"] - 1.0
    assert slow["MaxSensitivity"] > fast["MaxSensitivity"]


def test_an_unstable_loop_has_no_margins() -> None:
    loop = ClosedLoop(SecondOrder().system(), PID(sample_time=2e-3))
    given = loop.parameters.with_values({"pid.Kp": 0.9, "pid.Ki": 30.0, "pid.lower": -1.0, "pid.upper": 1.0})
    found = column(evaluate(loop, Step(0.1, horizon=0.5), given), "0 to 0.1")
    assert found["MaxSensitivity"] == found["MaxComplementarySensitivity"] == found["NoiseGain"] == math.inf
    assert np.isnan([found["GainMargin"], found["PhaseMargin"]]).all()


def test_margins_hold_on_every_scenarios_plant() -> None:
    loop, given = speed_loop()
    stronger = {"stronger": {"plant.gain": 1.5 * given.value("plant.gain")}}
    found = tune(
        loop,
        STEP,
        given,
        minimise=SettlingTime(),
        subject_to=[PhaseMargin(50.0), MaxSensitivity(1.8), Overshoot(0.1)],
        scenarios=stronger,
        method=FAST,
        plants={},
    )
    margins = [column(found.certified, case)["PhaseMargin"] for case in ("0 to 1", "0 to 1 [stronger]")]
    assert min(margins) >= 50.0
    assert margins[1] < margins[0]


def least_peak(time_constant: float, overshoot: float, settled: float) -> float:
    """Of a lag of gain one under PI control, by stepping its exact discretisation over a fine grid of both gains."""
    Kp, Ki = (g.ravel() for g in np.meshgrid(np.linspace(0.5, 3.0, 51), np.linspace(5.0, 30.0, 51)))
    h, n, A = 1e-3, 500, np.zeros((len(Kp), 3, 3))
    A[:, 0] = np.stack([-(1 + Kp), Ki, Kp], axis=1) / time_constant
    A[:, 1] = [-1.0, 0.0, 1.0]
    step, x = expm(A * h), np.tile([0.0, 0.0, 1.0], (len(Kp), 1))
    peak, highest, last = Kp.copy(), np.zeros(len(Kp)), np.zeros(len(Kp))
    for k in range(1, n + 1):
        x = (step @ x[..., None])[..., 0]
        peak = np.maximum(peak, np.abs(Kp * (1 - x[:, 0]) + Ki * x[:, 1]))
        highest = np.maximum(highest, x[:, 0])
        last = np.where(np.abs(x[:, 0] - 1) > 0.02, k * h, last)
    return float(peak[(highest <= 1 + overshoot) & (last <= settled)].min())


def test_limits_come_first_whatever_the_objective_is_measured_in() -> None:
    """Peak control of tens of thousands: it is the smallest that keeps both limits, not the smallest there is."""
    loop, unit = ClosedLoop(FirstOrder().system(), PID(limits=False)), 1e4
    values = {"plant.gain": 1 / unit, "plant.time_constant": 0.1, "pid.Kp": 0.2 * unit, "pid.Ki": 2 * unit}
    bounds = {"pid.Kp": (0.1 * unit, 5 * unit), "pid.Ki": (unit, 60 * unit)}
    given = loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)
    limits: list[Requirement] = [Overshoot(0.02), SettlingTime(max=0.15)]
    found = tune(loop, Step(1.0, horizon=0.5), given, minimise=PeakControl(), subject_to=limits, method=FAST, plants={})
    certified = column(found.certified)
    assert certified["Overshoot"] <= 2.0
    assert certified["SettlingTime"] <= 0.15
    assert certified["PeakControl"] == pytest.approx(unit * least_peak(0.1, 0.02, 0.15), rel=0.03)
