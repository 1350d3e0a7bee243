"""What a loop makes of moves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import MotionPath, Move, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.quantities.parameters import ParameterSet

MOVE = Move(0.1, speed=0.5, acceleration=5.0, jerk=100.0, dwell=0.6)


def position_loop(sample_time: float | None = None) -> tuple[ClosedLoop, ParameterSet]:
    """A mass on viscous friction under a PD controller."""
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(sample_time), measured="position")
    return loop, loop.parameters.with_values({"pid.Kp": 4000.0, "pid.Kd": 250.0, "pid.Tf": 2e-3})


@pytest.mark.parametrize("sample_time", [None, 1e-3])
def test_a_move_is_followed_from_rest_to_rest(sample_time: float | None) -> None:
    loop, values = position_loop(sample_time)
    found = evaluate(loop, MOVE, values)[MOVE.label]
    assert found["SettlingTime"] == pytest.approx(MOVE.duration, abs=0.04)
    assert found["SteadyStateValue"] == pytest.approx(MOVE.final, rel=1e-3)
    assert certificate(loop, MOVE, values).findings == ()


def test_a_move_takes_less_command_than_a_step_of_its_size() -> None:
    loop, values = position_loop()
    found = evaluate(loop, [MOVE, Step(0.1)], values)
    assert found[MOVE.label]["PeakControl"] < 0.2 * found["0 to 0.1"]["PeakControl"]


def test_a_move_beyond_the_bandwidth_is_followed_as_a_step() -> None:
    loop, values = position_loop()
    fast = Move(0.1, speed=1e4, acceleration=1e8, dwell=1.0)
    found = evaluate(loop, [fast, Step(0.1)], values)
    moved, stepped = found[fast.label], found["0 to 0.1"]
    for n in ("SettlingTime", "SteadyStateValue", "RiseTime"):
        assert math.isclose(moved[n], stepped[n], rel_tol=0.01, abs_tol=2e-3), n


def test_a_response_begins_where_its_move_does() -> None:
    loop, values = position_loop(1e-3)
    late = Move(-0.1, speed=0.5, acceleration=5.0, at=0.2, initial=0.05)
    run = respond(loop, late, values)
    before = run.t <= 0.2
    np.testing.assert_allclose(run["position"][before], 0.05, atol=1e-9)
    assert run["position"][-1] == pytest.approx(-0.05, abs=1e-4)


def test_a_move_is_measured_in_the_units_of_its_user() -> None:
    loop, values = position_loop(1e-3)
    found = evaluate(loop, MOVE, values)[MOVE.label]
    run = respond(loop, MOVE, values)
    off = run["position"] - MOVE.values(run.t)
    assert found["FollowingError"] == pytest.approx(np.abs(off).max())
    assert found["FollowingErrorRMS"] == pytest.approx(math.sqrt(np.trapezoid(off**2, run.t) / MOVE.horizon), rel=1e-6)
    assert found["OvershootDistance"] == pytest.approx(found["Overshoot"] / 100 * 0.1)
    assert found["Compliance"] == 0


def test_a_sequence_is_measured_from_its_last_move_on() -> None:
    loop, values = position_loop(1e-3)
    both = MoveSequence([replace(MOVE, initial=0.05, dwell=0.4), replace(MOVE, distance=-0.1)])
    alone = Move(-0.1, speed=0.5, acceleration=5.0, jerk=100.0, initial=0.15, dwell=0.6)
    found = evaluate(loop, [both, alone], values)
    assert both.at == pytest.approx(MOVE.duration + 0.4)
    for n in ("SettlingTime", "FollowingError", "SteadyStateValue", "PeakControl", "RiseTime"):
        assert found[both.label][n] == pytest.approx(found[alone.label][n], rel=0.02), n
    run = respond(loop, both, values)
    assert run["position"][0] == pytest.approx(0.05)
    assert run["position"].max() == pytest.approx(0.15, abs=2e-3)
    assert certificate(loop, both, values).findings == ()


def test_a_loop_yields_to_a_load_as_its_gain_says() -> None:
    """At rest a PD controller is a spring of Kp: 50 N move it by 50/4000 m, after an overshoot that hardly counts."""
    loop, values = position_loop()
    push = Step(0.0, initial=0.1, scale=0.01, disturbance={"load.force": -50.0})
    found = evaluate(loop, push, values)[push.label]
    assert found["Compliance"] == pytest.approx(1 / 4000, rel=0.2)
    assert found["OvershootDistance"] == pytest.approx(50 * found["Compliance"])


def test_a_path_that_returns_is_followed() -> None:
    loop, values = position_loop(1e-3)
    t = np.linspace(0, 2, 41)
    path = MotionPath(t, 0.1 + 0.05 * (1 - np.cos(np.pi * t)), dwell=0.5)
    found = evaluate(loop, path, values)["path"]
    run = respond(loop, path, values)
    assert found["FollowingError"] == pytest.approx(np.abs(run["position"] - path.values(run.t)).max())
    assert found["FollowingError"] < 0.02
    assert found["SteadyStateValue"] == pytest.approx(0.1, abs=1e-4)
