"""References in a tuning.toml: moves, paths from tables, and the band about their ends."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from pneuopt.control.moves import MotionPath, Move, MoveProfile, MoveSequence
from pneuopt.evaluation.band import Tolerance
from pneuopt.files.references import move_paths
from pneuopt.files.toml import read_toml
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
        ('move = "-200 mm"', 'step = "1 mm"\nmove = "1 mm"', "has more than one of step, move, moves and path"),
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


CAM = '[loop]\nmeasured = "position"\n[pid]\nKp = "200 N/m"\n[[reference]]\npath = "cams/cam.csv"\ndwell = "0.4 s"\n'


def table(folder: Path, head: str, points: np.ndarray) -> None:
    (folder / "cams").mkdir(exist_ok=True)
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in points)
    (folder / "cams" / "cam.csv").write_text(f"{head}\n{rows}\n", encoding="utf-8")


def cam(folder: Path, head: str = "t [ms],x [mm]") -> np.ndarray:
    """A cam of 100 mm, written beside the tuning [s, m]."""
    t = np.linspace(0.0, 0.8, 41)
    points = np.column_stack([t, 0.05 * (1 - np.cos(np.pi * t / 0.8))])
    table(folder, head, 1e3 * points)
    return points


def test_a_reference_may_be_a_path_from_a_table(tmp_path: Path) -> None:
    """Beside the tuning's own file, wherever the command runs; the column of the measured signal's reference counts."""
    points, drive = cam(tmp_path, "time [ms],position_reference [mm]"), ForceDrive(Coulomb()).system()
    tuning = written(tmp_path, CAM + 'start = { speed = "0.1 m/s" }\ndisturbance = { "load.force" = "20 N" }\n')
    (found,) = read_tuning(tuning, drive).references
    assert isinstance(found, MotionPath)
    np.testing.assert_allclose([found.t, found.points], points.T, atol=1e-9)
    assert (found.name, found.dwell, found.start, found.disturbance) == ("cam", 0.4, {"speed": 0.1}, {"load.force": 20})
    wider = np.column_stack([1e3 * points, 1e3 * points[:, 1] + 7.0])
    table(tmp_path, "time [ms],position_reference [mm],position [mm]", wider)
    assert read_tuning(tuning, drive).references[0].origin == pytest.approx(0.0)
    table(tmp_path, "time [ms],position [mm]", 1e3 * points)
    (found,) = read_tuning(written(tmp_path, CAM.replace('dwell = "0.4 s"\n', "")), drive).references
    assert found.horizon == pytest.approx(points[-1, 0] + Move.dwell)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("cams/cam.csv", "cam.csv", "path: {folder}/cam.csv: cannot be read (No such file or directory)"),
        ('"cams/cam.csv"', "3", 'path must name a file, path = "path.csv"'),
        ('dwell = "0.4 s"', 'horizon = "1 s"', "horizon does not belong to a path, which ends by dwell"),
        ('dwell = "0.4 s"', 'speed = "1 m/s"', "speed does not belong to a path, which ends by dwell"),
        ('dwell = "0.4 s"', 'step = "1 mm"', "has more than one of step, move, moves and path"),
        ('dwell = "0.4 s"', 'dwell = "-2 s"', "MotionPath: dwell -2 s ends the experiment before it begins"),
        ('"position"', '"speed"', "no column of a path; name one speed [m/s]"),
    ],
)
def test_refuses_a_path_and_says_where(tmp_path: Path, old: str, new: str, said: str) -> None:
    cam(tmp_path, "time [ms],position [mm]")
    text = CAM.replace("N/m", "N*s/m") if new == '"speed"' else CAM
    assert old in text
    with pytest.raises(InputError) as error:
        read_tuning(written(tmp_path, text.replace(old, new, 1)), ForceDrive(Coulomb()).system())
    assert "[[reference]] 1" in str(error.value)
    assert said.format(folder=tmp_path) in str(error.value)


def test_a_tuned_file_elsewhere_names_the_same_table(tmp_path: Path) -> None:
    points, drive = cam(tmp_path, "time [ms],position [mm]"), ForceDrive(Coulomb()).system()
    tuning, folder = written(tmp_path, CAM + "[minimise]\nfollowing_error = {}\n"), tmp_path / "results" / "today"
    folder.mkdir(parents=True)
    document = read_toml(tuning)
    move_paths(document["reference"], tmp_path, folder)
    (folder / "tuned.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    assert document["reference"][0]["path"] == "../../cams/cam.csv"
    (found,) = read_tuning(folder / "tuned.toml", drive).references
    assert found.final == pytest.approx(points[-1, 1])
