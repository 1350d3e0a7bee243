"""What is wrong with a tuning of a positioning axis is said before any search: one message each, with what can be."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app

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
BAD: dict[str, tuple[str, str, str]] = {
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


@pytest.mark.parametrize("case", BAD)
def test_a_bad_positioning_task_gets_one_message(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    old, new, said = BAD[case]
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
