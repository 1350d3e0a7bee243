"""`accept` of a tuning.toml: the defects with which a design is certified all the same."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.moves import MotionPath, Move, MoveProfile, MoveSequence
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.runnable import count_from_centre
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.limit_cycle import NoHunting
from pneuopt.evaluation.metric import Tolerance
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    AirUse,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Ripple,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.evaluation.scenarios import Factor, Scenarios, Spread, corners, samples, tolerances
from pneuopt.files.drive import read_status
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import Tuning, move_paths, read_path, read_scenarios, read_tuning, read_validation_scenarios
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, PressureDependent, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.result import TuningResult

PLANT = SecondOrder().system()
TUNING = """# my loop, 2024
[pid]
form = "parallel"          # | standard
sample_time = "1 ms"       # leave out: continuous
Kp = { value = "2 V*s/m", lower = "0.2 V*s/m", upper = "60 V*s/m", free = true }   # by hand
Ki = { value = "5 V/m", lower = "0 V/m", upper = "100 V/m", free = true }
Tf = "2 ms"
limits = ["-5 V", "5 V"]

[dither]
waveform = "sine"
frequency = "160 Hz"
amplitude = { value = "0 V", lower = "0 V", upper = "2 V", free = true }
offset = "0 V"

[[reference]]
step = "0.2 m/s"
horizon = "1 s"

[[reference]]   # the way back
step = "-100 mm/s"
initial = "0.2 m/s"
at = "50 ms"
horizon = "1 s"

[minimise]
settling_time = { band = "2 %", weight = 1.0 }
overshoot = { weight = 2 }

[limits]
overshoot = "5 %"
steady_state_error = 0.01
settling_time = { max = "500 ms", band = 0.02 }
max_sensitivity = 1.6
peak_control = "4500 mV"
"""


def tuned(parameters: ParameterSet, status: Status | None = None) -> TuningResult:
    """A result with nothing but what a file shows of it."""
    table, certified = pd.DataFrame(), pd.DataFrame({"0 to 0.2": {"SettlingTime": np.float64(0.25)}})
    status = status or Status(Code.CONVERGED, ("certified",))
    return TuningResult(parameters, certified, certified, table, table, (), status, {}, {"pneuopt": "0.1"})


def written(folder: Path, text: str, name: str = "tuning.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_reads_what_design_draws(tmp_path: Path) -> None:
    tuning = read_tuning(written(tmp_path, TUNING), PLANT)
    assert tuning.loop.plant is count_from_centre(PLANT)
    assert (tuning.loop.pid, tuning.loop.dither) == (PID(sample_time=1e-3), Dither(160.0))
    assert tuning.references == (Step(0.2, horizon=1.0), Step(-0.1, at=0.05, initial=0.2, horizon=1.0))
    assert tuning.specification.weights == {SettlingTime(0.02): 1.0, Overshoot(): 2.0}
    limits = {Overshoot(0.05), SteadyStateError(0.01), SettlingTime(0.02, 0.5), MaxSensitivity(1.6), PeakControl(4.5)}
    assert set(tuning.specification.limits) == limits
    given = tuning.parameters
    assert given.free_names == ("pid.Kp", "pid.Ki", "dither.amplitude")
    assert (given["pid.Kp"].value, given["pid.Kp"].lower, given["pid.Kp"].upper) == (2.0, 0.2, 60.0)
    assert [given.value(f"pid.{n}") for n in ("Kd", "Tf", "b", "c", "lower", "upper")] == [
        0.0,
        2e-3,
        1.0,
        1.0,
        -5.0,
        5.0,
    ]
    assert all(n.startswith(("pid.", "dither.")) for n in given)


def test_a_short_file_describes_a_continuous_loop_without_limits(tmp_path: Path) -> None:
    text = '[pid]\nKp = "2 V*s/m"\n[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n'
    tuning = read_tuning(written(tmp_path, text), PLANT)
    assert (tuning.loop.pid, tuning.loop.dither) == (PID(limits=False), None)
    assert (tuning.specification.weights, tuning.specification.limits, tuning.parameters.free_names) == ({}, (), ())


def test_the_loop_says_which_signals_where_the_plant_has_several(tmp_path: Path) -> None:
    plant = ForceDrive(PressureDependent(Coulomb())).system()
    text = '[pid]\nKp = "200 N/m"\n[[reference]]\nstep = "10 mm"\nhorizon = "1 s"\n[loop]\n'
    signals = 'actuated = "force"\nmeasured = "position"\n'
    tuning = read_tuning(written(tmp_path, text + signals), plant)
    assert (tuning.loop.command.name, tuning.loop.feedback.name) == ("force", "position")
    assert tuning.references == (Step(0.01),)
    with pytest.raises(
        InputError, match=r"tuning\.toml: the plant has the inputs force, pressure_a, pressure_b; choose"
    ):
        read_tuning(written(tmp_path, text), plant)
    with pytest.raises(InputError, match=r"unknown output 'positon'; did you mean 'position'"):
        read_tuning(written(tmp_path, text + signals.replace("position", "positon")), plant)


def test_a_reference_may_start_elsewhere(tmp_path: Path) -> None:
    path, drive = tmp_path / "tuning.toml", ForceDrive(Coulomb()).system()
    text = (
        '[pid]\nKp = "200 N*s/m"\n[[reference]]\nstep = "-0.1 m/s"\nhorizon = "1 s"\nstart = { position = "250 mm" }\n'
    )
    path.write_text(text + "[minimise]\nsettling_time = {}\n", encoding="utf-8")
    assert read_tuning(path, drive).references == (Step(-0.1, start={"position": 0.25}),)


def test_a_reference_may_be_a_disturbance(tmp_path: Path) -> None:
    path, drive = tmp_path / "tuning.toml", ForceDrive(Coulomb()).system()
    held = '[[reference]]\ninitial = "0.1 m/s"\nhorizon = "1 s"\ndisturbance = { "load.force" = "20 N" }\n'
    still = '[[reference]]\nscale = "50 mm/s"\nat = "0.2 s"\nhorizon = "1 s"\ndisturbance.load.force = "-5 N"\n'
    path.write_text(f'[pid]\nKp = "200 N*s/m"\n{held}{still}[minimise]\nsettling_time = {{}}\n', encoding="utf-8")
    first, second = read_tuning(path, drive).references
    assert first == Step(0.0, initial=0.1, disturbance={"load.force": 20.0})
    assert second == Step(0.0, at=0.2, scale=0.05, disturbance={"load.force": -5.0})


def read_all(folder: Path, tuned: Mapping[str, float]) -> tuple[Tuning, ParameterSet]:
    given = read_tuning(written(folder, TUNING), PLANT)
    return given, given.parameters.with_values(tuned)


def test_a_tuned_file_keeps_the_users_text_and_adds_the_results(tmp_path: Path) -> None:
    given, found = read_all(tmp_path, {"pid.Kp": 12.34, "pid.Ki": 56.78, "dither.amplitude": 0.5})
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuning.toml", tuned(PLANT.parameters | found))
    text = (tmp_path / "tuned.toml").read_text(encoding="utf-8")
    for kept in (
        "# my loop, 2024",
        "# by hand",
        "# the way back",
        'lower = "0.2 V*s/m"',
        '"12.34 V*s/m"',
        '"56.78 V/m"',
    ):
        assert kept in text
    again = read_tuning(tmp_path / "tuned.toml", PLANT)
    assert again.parameters == found
    assert again.references == given.references
    assert vars(again.specification) == vars(given.specification)
    said = read_toml(tmp_path / "tuned.toml").unwrap()
    assert said["certified"] == {"0 to 0.2": {"SettlingTime": 0.25}}
    assert said["provenance"] == {"pneuopt": "0.1"}
    assert read_status(tmp_path / "tuned.toml") == Status(Code.CONVERGED, ("certified",))


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 60.0), st.floats(0.0, 100.0), st.floats(0.0, 2.0))
def test_any_gains_read_back(tmp_path_factory: pytest.TempPathFactory, Kp: float, Ki: float, amplitude: float) -> None:
    folder = tmp_path_factory.mktemp("tuned")
    _, found = read_all(folder, {"pid.Kp": Kp, "pid.Ki": Ki, "dither.amplitude": amplitude})
    write_tuned(folder / "tuned.toml", folder / "tuning.toml", tuned(found))
    again = read_tuning(folder / "tuned.toml", PLANT).parameters
    assert again.free_names == found.free_names
    for name, parameter in found.items():
        assert again.value(name) == pytest.approx(parameter.value, rel=1e-8)


def test_a_sensor_lags_what_the_controller_sees(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    path.write_text(TUNING + '[sensor]\nlag = "5.5 ms"   # of the encoder\n', encoding="utf-8")
    tuning = read_tuning(path, PLANT)
    assert tuning.parameters.value("sensor.lag") == pytest.approx(5.5e-3)
    assert [q.name for q in tuning.loop.states if q.name.startswith("sensor.")] == ["sensor.reading"]
    assert tuning.loop.feedback.name == "speed"


KINDS = """
[minimise]
iae = { weight = 1.0 }
noise_gain = { weight = 0.01 }
[limits]
rise_time = "200 ms"
ripple = "1 mm/s"
ise = "50 ms"
itae = "0.02 s^2"
control_rate = "2 V/ms"
max_complementary_sensitivity = 1.3
gain_margin = 2.5
phase_margin = { min = "45 deg" }
step_envelope = { bounds = [["0 s", "-10 %", "110 %"], ["300 ms", 0.9, 1.1]] }
"""


def test_every_kind_of_requirement_has_a_key_and_its_units(tmp_path: Path) -> None:
    text = TUNING[: TUNING.index("[minimise]")]
    tuning = read_tuning(written(tmp_path, text + KINDS), PLANT)
    assert tuning.specification.weights == {IAE(): 1.0, NoiseGain(): 0.01}
    assert tuning.specification.limits == (
        RiseTime(0.2),
        Ripple(1e-3),
        ISE(0.05),
        ITAE(0.02),
        ControlRate(2000.0),
        MaxComplementarySensitivity(1.3),
        GainMargin(2.5),
        PhaseMargin(45.0),
        StepEnvelope(((0.0, -0.1, 1.1), (0.3, 0.9, 1.1))),
    )
    term = KINDS.replace("iae = { weight = 1.0 }", 'step_envelope = { bounds = [["0 s", -1, 2]], weight = 3 }')
    term = term[: term.index('step_envelope = { bounds = [["0 s", "-10')] + 'noise_gain = "0.5 V*s/m"\n'
    again = read_tuning(written(tmp_path, text + term), PLANT)
    assert again.specification.weights == {StepEnvelope(((0.0, -1.0, 2.0),), max=None): 3.0, NoiseGain(): 0.01}
    assert again.specification.limits[-1] == NoiseGain(0.5)


def test_a_triangle_and_a_limit_on_the_air(tmp_path: Path) -> None:
    text = TUNING.replace('waveform = "sine"', 'waveform = "triangle"').replace(
        "max_sensitivity = 1.6", 'air_use = "2 l(ANR)"'
    )
    tuning = read_tuning(written(tmp_path, text), PLANT)
    assert tuning.loop.dither == Dither(160.0, waveform=Waveform.TRIANGLE)
    assert AirUse(2.0) in tuning.specification.limits


ACCEPT = '[pid]\nKp = "2 V*s/m"\n[[reference]]\nstep = "0.2 m/s"\nhorizon = "1 s"\n'


def read_accept(folder: Path, line: str) -> tuple[Defect, ...]:
    path = folder / "tuning.toml"
    path.write_text(f"{line}\n{ACCEPT}", encoding="utf-8")
    return read_tuning(path, SecondOrder().system()).accept


def test_defects_are_accepted_by_their_words(tmp_path: Path) -> None:
    assert read_accept(tmp_path, "") == ()
    every = ", ".join(f'"{defect.value}"' for defect in Defect)
    assert read_accept(tmp_path, f"accept = [{every}]") == tuple(Defect)


REST_TUNING = """
[loop]
measured = "position"
[pid]
Kp = "2 N/m"
[[reference]]
step = "100 mm"
horizon = "1 s"
[limits]
no_hunting = {}
"""


def read_rest(folder: Path, written: str) -> NoHunting | None:
    path = folder / "tuning.toml"
    path.write_text(REST_TUNING.format(written), encoding="utf-8")
    return read_tuning(path, ForceDrive(Stribeck()).system()).specification.rest


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ('"20 s"', NoHunting(20.0)),
        ('{ duration = "20 s", repeatability = "0.1 mm" }', NoHunting(20.0, 1e-4)),
        ('{ repeatability = "0.2 mm" }', NoHunting(repeatability=2e-4)),
    ],
)
def test_a_file_says_for_how_long_and_how_near(tmp_path: Path, written: str, expected: NoHunting) -> None:
    found = read_rest(tmp_path, written)
    assert found is not None
    assert (found.duration, found.repeatability) == pytest.approx((expected.duration, expected.repeatability))


BOXES = ParameterSet({"load.mass": Parameter(5.0, "kg", 1.0, 20.0), "friction.coulomb": Parameter(40.0, "N")})
BOXES = BOXES | ParameterSet({"pid.Kp": Parameter(2.0, "V*s/m", free=True)})


def read_boxes(tmp_path: Path, text: str) -> Scenarios:
    path = tmp_path / "tuning.toml"
    path.write_text(text, encoding="utf-8")
    return read_scenarios(read_toml(path).unwrap()["scenarios"], "tuning.toml", BOXES)


def test_corners_samples_and_tolerances_join(tmp_path: Path) -> None:
    found = read_boxes(
        tmp_path,
        """
[scenarios.corners]
"load.mass" = "30 %"
"friction.*" = ["30 N", "60 N"]
[scenarios.samples]
count = 3
seed = 7
"load.mass" = 0.1
[scenarios.tolerances]
"pid.*" = "1 %"
""",
    )
    spreads: dict[str, Spread] = {"load.mass": 0.3, "friction.*": (30.0, 60.0)}
    assert found == {
        **corners(BOXES, spreads),
        **samples(BOXES, {"load.mass": 0.1}, 3, seed=7),
        **tolerances(BOXES, {"pid.*": 0.01}),
    }
    assert found["pid.* high"] == {"pid.Kp": Factor(1.01)}


def test_a_tuning_gives_the_scenarios_of_a_fit(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    lines = ['[pid]\nKp = "2 V*s/m"', '[[reference]]\nstep = "0.2 m/s"\nhorizon = "1 s"']
    path.write_text("\n".join(lines), encoding="utf-8")
    plant = SecondOrder().system()
    assert dict(read_tuning(path, plant).scenarios(plant.parameters)) == {}
    path.write_text("\n".join([*lines, '[scenarios.corners]\n"plant.gain" = "20 %"']), encoding="utf-8")
    fitted = plant.parameters.with_values({"plant.gain": 3.0})
    values = [case["plant.gain"] for case in read_tuning(path, plant).scenarios(fitted).values()]
    assert values == pytest.approx([2.4, 3.6])


def test_the_commands_certify_every_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "viscous"\nviscous = "40 N*s/m"'
    loop = '[pid]\nsample_time = "5 ms"\nKp = "300 N*s/m"\nKi = "5000 N/m"\n[[reference]]\nstep = "0.2 m/s"'
    Path("drive.toml").write_text(drive, encoding="utf-8")
    scenarios = '[scenarios.corners]\n"load.mass" = "30 %"'
    Path("tuning.toml").write_text(f'{loop}\nhorizon = "0.3 s"\n{scenarios}', encoding="utf-8")
    result = CliRunner().invoke(app, ["simulate", "drive.toml", "tuning.toml", "--json", "out.json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(Path("out.json").read_text(encoding="utf-8"))["certified"]
    assert len(rows) == 3
    slow, fast = (rows[k]["RiseTime"] for k in (2, 1))
    assert slow > 1.3 * fast


def test_new_plants_come_from_the_same_boxes_and_differ(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    text = '[scenarios.samples]\ncount = 3\n"load.mass" = "30 %"\n[scenarios.tolerances]\n"pid.Kp" = "1 %"'
    path.write_text(text, encoding="utf-8")
    said = read_toml(path).unwrap()["scenarios"]
    seen, fresh = (found(said, "tuning.toml", BOXES) for found in (read_scenarios, read_validation_scenarios))
    assert len(fresh) == 200, "a half for the verdict, a half for vetting"
    masses = [v["load.mass"] for v in fresh.values()]
    factors = [v["pid.Kp"] for v in fresh.values()]
    assert all(isinstance(m, float) and 3.5 <= m <= 6.5 for m in masses)
    assert all(isinstance(f, Factor) and 0.99 <= f.share <= 1.01 for f in factors)
    assert not {v["load.mass"] for v in seen.values() if "load.mass" in v} & set(masses)
    assert len(set(masses)) == 200, "no plant that chose is one that judges"


def test_a_tuning_with_scenarios_is_validated_on_new_plants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "viscous"\nviscous = "40 N*s/m"'
    gain = '{ value = "300 N*s/m", lower = "100 N*s/m", upper = "900 N*s/m", free = true }'
    loop = f'[pid]\nsample_time = "5 ms"\nKp = {gain}\nKi = "2000 N/m"\n[[reference]]\nstep = "0.2 m/s"'
    asked = '[minimise]\nsettling_time = { band = "5 %" }\n[limits]\novershoot = "20 %"'
    scenarios = '[scenarios.corners]\n"load.mass" = "30 %"'
    Path("drive.toml").write_text(drive, encoding="utf-8")
    Path("tuning.toml").write_text(f'{loop}\nhorizon = "0.3 s"\n{asked}\n{scenarios}', encoding="utf-8")
    result = CliRunner().invoke(app, ["tune", "drive.toml", "tuning.toml", "--json", "out.json"])
    assert result.exit_code == 0, result.output
    assert "holds on 100 of 100 plants" in result.output
    assert "as the scenarios have them: load.mass" in result.output
    assert "assumed tolerances: friction.viscous +-10 %" in result.output
    found = json.loads(Path("out.json").read_text(encoding="utf-8"))
    settling, overshoot = found["validation"]
    worst_corner = max(row["SettlingTime"] for row in found["certified"])
    assert settling["violations"] == overshoot["violations"] == 0
    assert 0.5 * worst_corner < settling["median"] <= settling["p95"] <= settling["worst"]
    assert settling["worst"] <= 1.05 * worst_corner, "friction and the gain vary beside the mass: by 10 % and by 1 %"
    assert settling["certified"] == pytest.approx(settling["worst"], rel=1e-2)


def written_tuning(folder: Path, text: str) -> Path:
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
    assert read_tuning(written_tuning(tmp_path, given), ForceDrive(Coulomb()).system()).specification.band == band


@pytest.mark.parametrize(("text", "robust"), [("", True), ("robust = true\n", True), ("robust = false\n", False)])
def test_a_design_for_other_plants_is_sought_unless_the_file_says_no(tmp_path: Path, text: str, robust: bool) -> None:
    tuning = read_tuning(written_tuning(tmp_path, f"{text}{MOVE}"), ForceDrive(Coulomb()).system())
    assert tuning.robust is robust


def test_a_reference_may_be_several_moves(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    several = MOVE.replace('move = "-200 mm"', 'moves = ["200 mm", "-100 mm"]')
    first = Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0)
    second = replace(first, distance=-0.1, at=0.0, initial=0.0, disturbance={"load.force": 20.0})
    assert read_tuning(written_tuning(tmp_path, several), drive).references == (MoveSequence([first, second]),)


def test_one_of_several_moves_may_have_limits_of_its_own(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    own = '{ distance = "-0.1 m", speed = "10 mm/s", dwell = "1 s", profile = "s-curve" }'
    several = MOVE.replace('move = "-200 mm"', f'moves = ["200 mm", {own}]')
    first = Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0)
    second = replace(first, distance=-0.1, speed=0.01, dwell=1.0, at=0.0, initial=0.0, disturbance={"load.force": 20.0})
    assert read_tuning(written_tuning(tmp_path, several), drive).references == (MoveSequence([first, second]),)


def test_a_reference_may_be_a_move(tmp_path: Path) -> None:
    drive = ForceDrive(Coulomb()).system()
    push = {"load.force": 20.0}
    move = Move(-0.2, speed=0.5, acceleration=5.0, jerk=100.0, at=0.1, initial=0.05, dwell=2.0, disturbance=push)
    assert read_tuning(written_tuning(tmp_path, MOVE), drive).references == (move,)
    shaped = MOVE.replace('jerk = "100 m/s^3"', 'profile = "minimum jerk"')
    (found,) = read_tuning(written_tuning(tmp_path, shaped), drive).references
    assert found == replace(move, jerk=math.inf, profile=MoveProfile.MINIMUM_JERK)


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
    tuning = written_tuning(tmp_path, CAM + 'start = { speed = "0.1 m/s" }\ndisturbance = { "load.force" = "20 N" }\n')
    (found,) = read_tuning(tuning, drive).references
    assert isinstance(found, MotionPath)
    np.testing.assert_allclose([found.t, found.points], points.T, atol=1e-9)
    assert (found.name, found.dwell, found.start, found.disturbance) == ("cam", 0.4, {"speed": 0.1}, {"load.force": 20})
    wider = np.column_stack([1e3 * points, 1e3 * points[:, 1] + 7.0])
    table(tmp_path, "time [ms],position_reference [mm],position [mm]", wider)
    assert read_tuning(tuning, drive).references[0].origin == pytest.approx(0.0)
    table(tmp_path, "time [ms],position [mm]", 1e3 * points)
    (found,) = read_tuning(written_tuning(tmp_path, CAM.replace('dwell = "0.4 s"\n', "")), drive).references
    assert found.horizon == pytest.approx(points[-1, 0] + Move.dwell)


def test_a_tuned_file_elsewhere_names_the_same_table(tmp_path: Path) -> None:
    points, drive = cam(tmp_path, "time [ms],position [mm]"), ForceDrive(Coulomb()).system()
    tuning = written_tuning(tmp_path, CAM + "[minimise]\nfollowing_error = {}\n")
    folder = tmp_path / "results" / "today"
    folder.mkdir(parents=True)
    document = read_toml(tuning)
    move_paths(document["reference"], tmp_path, folder)
    (folder / "tuned.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    assert document["reference"][0]["path"] == "../../cams/cam.csv"
    (found,) = read_tuning(folder / "tuned.toml", drive).references
    assert found.final == pytest.approx(points[-1, 1])


def written_cam(folder: Path, head: str, points: np.ndarray) -> Path:
    path = folder / "cam.csv"
    rows = "\n".join(f"{t:.6g};{y:.9g}".replace(".", ",") for t, y in points)
    path.write_text(f"{head}\n{rows}\n", encoding="utf-8")
    return path


def test_a_path_is_read_with_its_units(tmp_path: Path) -> None:
    t = np.linspace(0, 500, 21)
    y = 50 * (1 - np.cos(2 * np.pi * t / 1000))
    path = read_path(written_cam(tmp_path, "time [ms];position [mm]", np.column_stack([t + 2000, y])), dwell=0.2)
    assert path.label == "cam"
    np.testing.assert_allclose(path.t, t / 1000, atol=1e-12)
    np.testing.assert_allclose(path.points, y / 1000, atol=1e-9)
    assert path.horizon == pytest.approx(0.7)


def test_a_table_without_a_motion_is_refused(tmp_path: Path) -> None:
    t = np.linspace(0, 1, 21)
    with pytest.raises(InputError, match=r"cam\.csv: no column of a path; name one position \[mm\]"):
        read_path(written_cam(tmp_path, "time [s];force [N]", np.column_stack([t, t])))
    with pytest.raises(InputError, match=r"cam\.csv.*nothing moves, every point is 0\.005"):
        read_path(written_cam(tmp_path, "time [s];position [mm]", np.column_stack([t, 5 + 0 * t])))
    with pytest.raises(InputError, match="unknown channel 'postion'"):
        read_path(written_cam(tmp_path, "time [s];position [mm]", np.column_stack([t, t])), channel="postion")
