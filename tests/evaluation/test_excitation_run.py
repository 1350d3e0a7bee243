"""The excitation run: what it holds, that it is safe on the guess, and that its log tells the truth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.evaluation.excitation_run import (
    GUESSED_SENSITIVITY,
    LEAST_DWELL,
    LEAST_FAST_SPEED,
    ExcitationRun,
    excitation_run,
)
from pneuopt.evaluation.move_check import check_move
from pneuopt.evaluation.record import record
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.identification.identify import identify
from pneuopt.models.catalog import s25
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.models.karnopp import Karnopp
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

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


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"speed": 0.01}, "with a speed of 10 mm/s at most does not tell .*; allow 50 mm/s or more"),
        ({"between": (0.1, 0.11)}, "needs a way of 30 mm, there are 10 mm from 100 mm to 110 mm"),
        ({"between": (0.0, 0.1)}, "from 0 m to 100 mm, and the end stops are at 0.1 mm and 200 mm; keep the run"),
    ],
)
def test_a_run_that_shows_too_little_is_refused(given: dict[str, float], words: str) -> None:
    drive, known = guessed()
    with pytest.raises(InputError, match=words):
        excitation_run(drive.system(), known, **given)  # type: ignore[arg-type]


def test_a_drive_that_cannot_make_the_run_is_refused() -> None:
    drive, known = guessed()
    short = known.with_values({"cylinder.stroke": 0.04, "cylinder.start": 0.02})
    with pytest.raises(InputError, match=r"needs a way of 30 mm, there are 19.8 mm .*; correct \[cylinder\] stroke"):
        excitation_run(drive.system(), short)
    weak = known.with_values({"valve.conductance": known.value("valve.conductance") / 100})
    with pytest.raises(InputError, match=r"moves at .* mm/s at most, by its file, and an excitation run needs 0.1 m/s"):
        excitation_run(drive.system(), weak)
    with pytest.raises(ModelError, match="needs a drive whose valve moves an axis between two end stops"):
        excitation_run(ForceDrive(Coulomb()).system(), ParameterSet())


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
