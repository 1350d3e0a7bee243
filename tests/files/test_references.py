"""References in a tuning.toml: moves, and the band about their ends."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from pneuopt.control.move_sequence import MoveSequence
from pneuopt.control.moves import Move, MoveProfile
from pneuopt.evaluation.band import Tolerance
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import InputError


def written(folder: Path, text: str) -> Path:
    path = folder / "tuning.toml"
    path.write_text(text, encoding="utf-8")
    return path


MOVE = """[loop]
measured = "position"
[pid]
Kp = "200 N/m"
[[reference]]
move = "-200 mm"
speed = "0.5 m/s"
acceleration = "5 m/s^2"
jerk = "100 m/s^3"
at = "100 ms"
initial = "50 mm"
dwell = "2 s"
disturbance = { "load.force" = "20 N" }
[minimise]
settling_time = {}
"""


@pytest.mark.parametrize(("text", "band"), [('"0.1 mm"', Tolerance(1e-4)), ('"2 %"', 0.02), ("0.05", 0.05)])
def test_a_band_may_be_in_the_measured_unit(tmp_path: Path, text: str, band: float | Tolerance) -> None:
    given = MOVE.replace("settling_time = {}", f"settling_time = {{ band = {text} }}")
    assert read_tuning(written(tmp_path, given), ForceDrive(Coulomb()).system()).specification.band == band


def test_a_reference_may_be_several_moves(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    several = MOVE.replace('move = "-200 mm"', 'moves = ["200 mm", "-100 mm"]')
    first = Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0)
    second = replace(first, distance=-0.1, at=0.0, initial=0.0, disturbance={"load.force": 20.0})
    assert read_tuning(written(tmp_path, several), drive).references == (MoveSequence([first, second]),)


def test_one_of_several_moves_may_have_limits_of_its_own(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    own = '{ distance = "-0.1 m", speed = "10 mm/s", dwell = "1 s", profile = "s-curve" }'
    several = MOVE.replace('move = "-200 mm"', f'moves = ["200 mm", {own}]')
    first = Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0)
    second = replace(first, distance=-0.1, speed=0.01, dwell=1.0, at=0.0, initial=0.0, disturbance={"load.force": 20.0})
    assert read_tuning(written(tmp_path, several), drive).references == (MoveSequence([first, second]),)


def test_a_reference_may_be_a_move(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    push = {"load.force": 20.0}
    move = Move(-0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0, disturbance=push)
    assert read_tuning(written(tmp_path, MOVE), drive).references == (move,)
    shaped = MOVE.replace('jerk = "100 m/s^3"', 'profile = "minimum jerk"')
    (found,) = read_tuning(written(tmp_path, shaped), drive).references
    assert found == replace(move, jerk=math.inf, profile=MoveProfile.MINIMUM_JERK)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('dwell = "2 s"', 'horizon = "2 s"', "horizon does not belong to a move, which ends by dwell"),
        ('move = "-200 mm"', 'step = "-200 mm"', "speed does not belong to a step, which ends by horizon"),
        ('move = "-200 mm"', 'step = "1 mm"\nmove = "1 mm"', "has more than one of step, move and moves"),
        ('move = "-200 mm"', 'moves = "-200 mm"', "moves must be a list"),
        ('move = "-200 mm"', 'moves = ["-200 mm", "0 mm"]', "Move: distance must not be zero"),
        ('move = "-200 mm"', 'moves = ["1 mm", { speed = "1 m/s" }]', "moves 2 has no distance; write { distance"),
        ('move = "-200 mm"', 'moves = ["1 mm", { distance = "1 mm", at = "1 s" }]', "unknown key 'at'"),
        ('speed = "0.5 m/s"', "", "[[reference]] 1 has no speed"),
        ('jerk = "100 m/s^3"', 'profile = "ramp"', "unknown profile 'ramp'"),
        (
            'jerk = "100 m/s^3"',
            'jerk = "9 m/s^3"\nprofile = "trapezoid"',
            "the acceleration of a trapezoid steps",
        ),
        ('"0.5 m/s"', '"0.5 m"', "speed: unit 'm' does not measure 'm/s'"),
        ('"0.5 m/s"', '"-0.5 m/s"', "Move: speed is a limit on its size and must be positive"),
    ],
)
def test_refuses_a_move_and_says_where(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in MOVE
    with pytest.raises(InputError) as error:
        read_tuning(written(tmp_path, MOVE.replace(old, new, 1)), ForceDrive(Coulomb()).system())
    assert "[[reference]] 1" in str(error.value)
    assert said in str(error.value)
