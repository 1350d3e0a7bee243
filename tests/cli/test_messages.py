"""A user's mistakes at the command line: one message each before any search, exit status 2, and no file written."""

from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.cli.tune import tune_rival
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import Tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Viscous


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def rewrite(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text, encoding="utf-8")


def edit(name: str, old: str, new: str, count: int = 1) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        rewrite(folder, name, text.replace(old, new, count))

    return apply


def cut(folder: Path) -> None:
    rows = (folder / "run_01.csv").read_text(encoding="utf-8").splitlines()
    rewrite(folder, "run_01.csv", "\n".join(rows[:8]) + "\n")


IDENTIFY = "identify drive.toml run_01.csv -o fit.toml --json fit.json --plot fit.png"
TUNE = "tune drive.toml tuning.toml -o tuned.toml --json tuned.json --plot tuned.png"
KP = 'Kp = { value = "100 N*s/m", lower = "10 N*s/m", upper = "600 N*s/m", free = true }   # by hand\nKi = "4000 N/m"'
TURNED = 'Kp = { value = "-9 N*s/m", lower = "-60 N*s/m", upper = "-1 N*s/m", free = true }'
TUBE = 'step_envelope = { bounds = [["0 s", "-10 %", "150 %"], ["0.1 s", "50 %", "80 %"]] }'
SMOOTHING = 'smoothing = "5 mm/s"\n'
PRESSURE = 'pressure_dependent = true\n[ambient]\npressure = "1 bar"\n'
BAD: dict[str, tuple[str, Callable[[Path], None] | None, str]] = {
    "unit missing": (
        IDENTIFY,
        edit("drive.toml", '"40 N"', '"40"'),
        "drive.toml:8: [friction] coulomb: '40' has no unit",
    ),
    "unit wrong": (
        TUNE,
        edit("tuning.toml", '"4000 N/m"', '"4000 N*s/m"'),
        "tuning.toml: [pid] Ki: unit 'N*s/m' does not",
    ),
    "bare bar": (
        IDENTIFY,
        edit("drive.toml", SMOOTHING, SMOOTHING + PRESSURE),
        "drive.toml:13: [ambient] pressure: a pressure level in 'bar' may be absolute or gauge; write \"bar(a)\" or",
    ),
    "unknown key": (
        TUNE,
        edit("tuning.toml", "horizon", "horison"),
        "[[reference]] 1: unknown key 'horison'; did you mean 'horizon'?",
    ),
    "unknown channel": (
        IDENTIFY,
        edit("run_01.csv", "position [mm]", "positoin [mm]"),
        "run_01.csv: column 'positoin [mm]' looks like the channel 'position'",
    ),
    "not a number": (
        IDENTIFY,
        edit("run_01.csv", "\n0.0020,", "\n0.0020,NaN"),
        "run_01.csv: row 3, column 'force [N]': 'NaN",
    ),
    "time backwards": (IDENTIFY, edit("run_01.csv", "\n0.0080", "\n0.0030"), "run_01.csv: row 6: time runs backwards"),
    "useless channel": (
        IDENTIFY,
        edit("run_01.csv", "position [mm]", "pressure_a [bar(a)]"),
        "run_01: the model cannot use channel 'pressure_a', it reads force, position, speed",
    ),
    "start out of bounds": (
        IDENTIFY,
        edit("drive.toml", '"5 kg"', '"50 kg"'),
        "drive.toml:5: [load] mass: value 50 kg lies outside its bounds [1, 20]; move the value or the bounds",
    ),
    "too short": (IDENTIFY, cut, "run_01.csv: 7 samples are too few; at least 10 are needed"),
    "missing file": (
        IDENTIFY.replace("run_01", "run_99"),
        None,
        "run_99.csv: cannot be read (No such file or directory)",
    ),
    "no match": (IDENTIFY.replace("run_01", "x*"), None, "x*.csv: no file matches"),
    "output is input": (IDENTIFY.replace("fit.toml", "drive.toml"), None, "drive.toml: is an input of this command"),
    "output is the sidecar": (IDENTIFY.replace("fit.toml", "run_01.toml"), None, "run_01.toml: is an input"),
    "folder missing": (TUNE.replace("tuned.json", "out/tuned.json"), None, "out/tuned.json: the folder does not exist"),
    "figure's format": (
        TUNE.replace("tuned.png", "tuned.gif"),
        None,
        "tuned.gif: a figure is written as .png, .pdf, .svg",
    ),
    "nothing free": (
        IDENTIFY,
        edit("drive.toml", ", free = true", "", count=-1),
        "drive.toml: no parameter is free; mark what to identify",
    ),
    "nothing to tune": (TUNE, edit("tuning.toml", ", free = true", ""), "tuning.toml: no gain is free"),
    "nothing to minimise": (
        TUNE,
        edit("tuning.toml", '[minimise]\nsettling_time = { band = "5 %" }\n', ""),
        "tuning.toml: has nothing to minimise",
    ),
    "limit after the record": (
        TUNE,
        edit("tuning.toml", 'overshoot = "10 %"', 'settling_time = { band = "5 %", max = "2 s" }'),
        "SettlingTime: max 2 s is more than 0.3 s after the step can show (reference 0 to 0.2); lengthen its horizon",
    ),
    "tube without the reference": (
        TUNE,
        edit("tuning.toml", "[limits]", f"[limits]\n{TUBE}"),
        "tuning.toml: [minimise] and [limits]: StepEnvelope: from 0.1 s on the bounds are 0.5 to 0.8, SettlingTime",
    ),
    "force beyond the clip": (
        TUNE,
        edit("tuning.toml", '"-200 N", "200 N"', '"-20 N", "20 N"'),
        "reference 0 to 0.2: holding 0.19 m/s takes 41.9 N, the controller's limits are -20 and 20 N; take a smaller",
    ),
    "gains of the wrong sign": (
        TUNE,
        edit("tuning.toml", KP, f"{TURNED}\nKi = '-400 N/m'"),
        "every gain allowed makes the loop unstable: pid.Kp within [-60, -1], pid.Ki = -400; linearised at 0.2 m/s,",
    ),
    "disturbance of nothing": (
        TUNE,
        edit("tuning.toml", 'horizon = "0.3 s"', 'horizon = "0.3 s"\ndisturbance = { "load.froce" = "5 N" }'),
        "[[reference]] 1 disturbance: unknown parameter or input 'load.froce'; did you mean 'load.force'?",
    ),
    "window": (IDENTIFY + " --window 0.001", None, "windows of 0.001 s hold 0 samples of run_01"),
    "what to simulate": ("simulate drive.toml -o x.csv", None, "give either a tuning file or --log"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_message_and_writes_nothing(folder: Path, case: str) -> None:
    line, spoil, said = BAD[case]
    if spoil is not None:
        spoil(folder)
    before = {p: p.read_bytes() for p in folder.iterdir()}
    result = run(line)
    assert result.exit_code == 2
    assert said in result.stderr
    assert result.stderr.startswith("error: ")
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""
    assert {p: p.read_bytes() for p in folder.iterdir()} == before


@pytest.mark.parametrize(
    "line", ["identfy", "identify drive.toml", "tune --jsn x", "identify drive.toml x.csv --window two"]
)
def test_wrong_usage_is_bad_input(line: str) -> None:
    result = run(line)
    assert result.exit_code == 2
    assert "Error" in result.stderr


def test_a_rival_that_cannot_be_tuned_leaves_the_dithered_result(capsys: pytest.CaptureFixture[str]) -> None:
    """Under dither a band below half an encoder's count can be kept, without it not."""
    loop = ClosedLoop(
        ForceDrive(Viscous()).system(), PID(1e-3), Dither(20.0), measured="position", sensor=Encoder(1e-3)
    )
    given = loop.parameters.with_values({"dither.amplitude": 1.0, "pid.Kp": 100.0})
    given = given.with_bounds({"pid.Kp": (50.0, 200.0)}).freed("pid.Kp")
    task = Tuning(loop, (Step(0.02, horizon=0.1),), given, specify(SettlingTime()))
    assert tune_rival(Console(width=400), task, given, {}, quiet=True) is None
    said = capsys.readouterr().out
    assert said.startswith("no gains were certified without dither: reference 0 to 0.02: the settling band of +-0.4 mm")


DRIVE = """[drive]
kind = "pneumatic"
[cylinder]
stroke = "300 mm"
[valve]
bandwidth = "100 Hz"
[friction]
model = "viscous"
"""
TUNING = """[pid]
sample_time = "1 ms"
Kp = { value = "1 V*s/m", lower = "0.2 V*s/m", upper = "5 V*s/m", free = true }
limits = ["-5 V", "5 V"]
[position_loop]
Kp = "10 1/s"
[sensor]
resolution = "10 um"
[pressure_feedback]
gain = "1e-6 V/Pa"
[[reference]]
move = "100 mm"
speed = "0.3 m/s"
acceleration = "3 m/s^2"
initial = "100 mm"
[minimise]
settling_time = { band = "1 mm" }
[limits]
max_sensitivity = 2
"""
RIG = '[sensors.position]\nresolution = "10 um"\n'
FASTER = 'speed = "9 m/s"\nacceleration = "3000 m/s^2"'
LIMITS = '[limits]\nfollowing_error = "2 mm"\nsettling_time = { band = "1 mm", max = "200 ms" }\n'
BAD_POSITIONING: dict[str, tuple[str, str, str]] = {
    "stroke": (
        'move = "100 mm"',
        'move = "250 mm"',
        "it leads the piston over 250 mm, but from position 100 mm to the front end stop there are 199.9 mm; take a",
    ),
    "valve": (
        'speed = "0.3 m/s"\nacceleration = "3 m/s^2"',
        FASTER,
        "m/s, within the command's limits -5 and 5 V the plant moves at 2.",
    ),
    "force": ('"3 m/s^2"', '"300 m/s^2"', "it accelerates with 300 m/s^2, full command (5 V) from rest with "),
    "tolerance": (
        'band = "1 mm"',
        'band = "4 um"',
        "the settling band of +-4 um is narrower than half the encoder's count of 10 um, the controller cannot tell",
    ),
    "limits": (
        'settling_time = { band = "1 mm" }\n[limits]\n',
        f"iae = {{}}\n{LIMITS}",
        "max 0.2 s comes when the reference still lacks 55 mm, more than the band and FollowingError's max 2 mm",
    ),
    "sensors": ("", "", "the controller reads pressure_a, pressure_b, which no sensor measures; add to sensors"),
}


@pytest.mark.parametrize("case", BAD_POSITIONING)
def test_a_bad_positioning_task_gets_one_message(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    old, new, said = BAD_POSITIONING[case]
    assert old in TUNING
    files = {"drive.toml": DRIVE, "tuning.toml": TUNING.replace(old, new, 1), "rig.toml": RIG}
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    line = "tune drive.toml tuning.toml -o tuned.toml" + (" --rig rig.toml" if case == "sensors" else "")
    result = CliRunner().invoke(app, line.split(), catch_exceptions=False)
    assert result.exit_code == 2, result.output
    assert said in result.stderr
    assert result.stderr.startswith("error: ")
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "tuned.toml").exists()
