"""What a loop makes of moves.

What no controller can: too long, too fast, too violent moves, and the fastest that is left.

The excitation run: what it holds, that it is safe on the guess, and that its log tells the truth.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import MotionPath, Move, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.moves import ExcitationRun, check_move, excitation_run, scale_move, shortest_move
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.rig import Actuator, Rig, Sensor, record
from pneuopt.evaluation.tolerances import GUESSED_SENSITIVITY, LEAST_DWELL, LEAST_FAST_SPEED
from pneuopt.identification.identify import identify
from pneuopt.models.catalog import s25, t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, Stribeck, Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import tune

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


def pneumatic() -> tuple[ClosedLoop, ParameterSet]:
    drive, values = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.Kp": 20.0, "pid.lower": -5.0, "pid.upper": 5.0}
    return loop, (loop.parameters | values).with_values(given)


def pushed(limit: float = 100.0) -> tuple[ClosedLoop, ParameterSet]:
    """5 kg on 40 N of Coulomb friction."""
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.lower": -limit, "pid.upper": limit, "load.mass": 5.0, "friction.coulomb": 40.0}
    given |= {"friction.viscous": 0.0, "pid.Kp": 500.0}
    return loop, loop.parameters.with_values(given)


@pytest.mark.parametrize(
    ("move", "words"),
    [
        (Move(0.5, speed=0.5, acceleration=5.0, initial=0.05), "to the front end stop there are 450 mm"),
        (Move(-0.2, speed=0.5, acceleration=5.0, initial=0.05), "to the rear end stop there are 50 mm"),
        (Move(0.4, speed=9.0, acceleration=800.0, initial=0.05), r"at 9 m/s, .* 5 V the plant moves at [12]\.\d+ m/s"),
        (Move(0.1, speed=1.0, acceleration=200.0, initial=0.05), r"accelerates with 200 m/s\^2, full command \(5 V\)"),
    ],
)
def test_a_move_that_cannot_be_made_is_refused_with_what_can(move: Move, words: str) -> None:
    loop, values = pneumatic()
    with pytest.raises(InputError, match=words):
        check_move(loop, move, values)
    feasible = Move(0.1, speed=0.5, acceleration=5.0, jerk=200.0, initial=0.05)
    check_move(loop, feasible, values)
    check_move(loop, replace(feasible, distance=-0.1, initial=0.2), values)
    back = replace(move, initial=0.0)
    with pytest.raises(InputError):
        check_move(loop, MoveSequence([feasible, back]), values)


def test_force_less_friction_bounds_the_acceleration() -> None:
    """100 N less 40 N accelerate 5 kg by 12 m/s^2."""
    loop, values = pushed()
    check_move(loop, Move(0.5, speed=9.0, acceleration=11.0), values)
    with pytest.raises(InputError, match=r"with 13 m/s\^2, full command \(100 N\) from rest with 1[12]\.\d m/s\^2"):
        check_move(loop, Move(0.5, speed=9.0, acceleration=13.0), values)


def test_the_shortest_move_of_a_pushed_mass_is_that_of_its_force() -> None:
    """A triangle of speed at 12 m/s^2 takes 2 sqrt(d/a)."""
    loop, values = pushed()
    found = shortest_move(loop, Move(0.5, speed=9.0, acceleration=1.0), values)
    assert found.duration == pytest.approx(2 * math.sqrt(0.5 / 12), rel=0.04)
    assert found.duration >= 2 * math.sqrt(0.5 / 12)
    check_move(loop, found, values)
    with pytest.raises(InputError):
        check_move(loop, scale_move(found, 1.05), values)


def test_the_shortest_move_of_a_cylinder_is_allowed_and_hardly_a_faster_one() -> None:
    loop, values = pneumatic()
    found = shortest_move(loop, Move(0.2, speed=0.5, acceleration=5.0, jerk=200.0, initial=0.05), values)
    check_move(loop, found, values)
    with pytest.raises(InputError, match="lower its"):
        check_move(loop, scale_move(found, 1.05), values)


def test_a_body_that_full_command_does_not_move_has_no_shortest_move() -> None:
    loop = ClosedLoop(ForceDrive(Karnopp(Coulomb())).system(), PID(sample_time=1e-3), measured="position")
    given = {"pid.lower": -30.0, "pid.upper": 30.0, "friction.coulomb": 40.0}
    values = loop.parameters.with_values(given)
    with pytest.raises(InputError, match="full command"):
        shortest_move(loop, Move(0.1, speed=0.1, acceleration=1.0), values)


def test_what_nothing_limits_is_not_checked() -> None:
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(limits=False), measured="position")
    check_move(loop, Move(0.5, speed=90.0, acceleration=1e5), loop.parameters)
    with pytest.raises(InputError, match="nothing limits this move"):
        shortest_move(loop, Move(0.5, speed=90.0, acceleration=1e5), loop.parameters)


def test_a_tuning_refuses_what_no_gains_can() -> None:
    loop, values = pushed()
    free = values.with_bounds({"pid.Kp": (10.0, 1e4)}).freed("pid.Kp")
    with pytest.raises(InputError, match="lower its acceleration"):
        tune(loop, Move(0.5, speed=9.0, acceleration=50.0), free, minimise=SettlingTime())


GUESS = {"friction.coulomb": 30.0, "friction.static": 30.0, "friction.stribeck_velocity": 0.01}
# What the rig truly has, far from the guess; the tolerances are of the estimates [relative]. The valve's hysteresis,
# which the model has not, blurs where the dead zone ends; the others follow from pressures and motion alone.
TRUTH = {
    "valve.conductance": (1.3, 0.1),  # of the guess
    "valve.dead_zone": (0.02, 0.25),
    "friction.coulomb": (22.0, 0.04),
    "friction.static": (35.0, 0.06),
    "friction.stribeck_velocity": (0.02, 0.2),
    "friction.viscous": (65.0, 0.05),
    "load.mass": (1.25, 0.03),  # of the guess
}


def guessed() -> tuple[PneumaticDrive, ParameterSet]:
    drive, known = PneumaticDrive(friction=Stribeck()), s25()[1]
    own = known.select(n for n in drive.parameters if n in known)
    return drive, (drive.parameters | own).with_values(GUESS)


@cache
def planned() -> ExcitationRun:
    drive, known = guessed()
    return excitation_run(drive.system(), known)


def test_the_run_moves_fast_and_slowly_both_ways_and_rests_at_several_places() -> None:
    run = planned()
    moves, (low, high) = run.moves.moves, run.between
    for speeds in ([m.speed for m in moves if m.distance > 0], [m.speed for m in moves if m.distance < 0]):
        assert max(speeds) > 25 * min(speeds)
        assert max(speeds) >= LEAST_FAST_SPEED
    assert all(m.dwell >= LEAST_DWELL for m in moves)
    places = run.moves.values(run.response.t)
    assert (places.min(), places.max()) == pytest.approx((low, high))
    assert len({round(m.final, 4) for m in run.moves.chain}) >= 6
    assert run.moves.final == pytest.approx(run.moves.origin)
    assert run.duration < 30


def test_the_run_is_safe_on_the_drive_as_guessed() -> None:
    run = planned()
    check_move(run.loop, run.moves, run.parameters)
    position, (low, high) = run.response["position"], run.between
    assert low - 0.002 < position.min()
    assert position.max() < high + 0.002
    assert float(np.abs(run.response["control"]).max()) < 0.5 * run.parameters.value("pid.upper")
    assert 0.01 < run.following_error < 0.3 * (high - low)
    assert GUESSED_SENSITIVITY <= 2


@pytest.mark.slow
def test_a_limit_of_speed_and_of_the_way_is_kept() -> None:
    drive, known = guessed()
    run = excitation_run(drive.system(), known, between=(0.06, 0.14), speed=0.1)
    assert run.fastest == 0.1
    places = run.moves.values(run.response.t)
    assert (places.min(), places.max()) == pytest.approx((0.06, 0.14))


def rig_log() -> tuple[Trajectory, Rig, ParameterSet]:
    """The run's reference, and a rig that truly sticks, with a valve's hysteresis, under the plain controller."""
    run, (_, known) = planned(), guessed()
    drive = PneumaticDrive(friction=Karnopp(Stribeck()))
    loop = ClosedLoop(drive.system(), PID(1e-3), measured="position")
    p = loop.parameters.with_values({n: run.parameters.value(n) for n in loop.parameters if n in run.parameters})
    shares = {n: TRUTH[n][0] * known.value(n) for n in ("valve.conductance", "load.mass")}
    p = p.with_values({n: value for n, (value, _) in TRUTH.items()} | shares)
    gauge = Sensor(noise=500.0, resolution=100.0)
    sensors = {"position": Sensor(resolution=1e-5), "pressure_a": gauge, "pressure_b": gauge}
    return run.moves.trajectory(1e-3).select(["reference"]), Rig(loop, sensors, Actuator(0.02)), p


@pytest.mark.slow
def test_an_identification_with_defaults_finds_the_truth_in_the_log_of_the_run() -> None:
    reference, rig, truth = rig_log()
    assert rig.loop is not None
    begin = rig.loop.initial(truth, reference=float(reference["reference"][0]))
    log = record(rig, reference, truth, seed=1, initial=begin).experiment
    log = log.select(["valve_voltage", "position", "pressure_a", "pressure_b"])
    assert log.trajectory["position"].min() > 0.002
    assert log.trajectory["position"].max() < 0.198
    drive, known = guessed()
    fit = identify(drive.system(), [replace(log, noise={})], known.freed(*TRUTH))
    for name, (value, within) in TRUTH.items():
        assert fit.parameters.value(name) == pytest.approx(truth.value(name), rel=within), (name, value)
