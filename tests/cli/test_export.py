"""The command `export`: from files to files, whole or none, and what it refuses."""

from pathlib import Path

import pytest
import tomlkit
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.files.drive import read_fit
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import checksum_section

DRIVE = """
[drive]
kind = "pneumatic"
[cylinder]
bore = "32 mm"
rod = "12 mm"
stroke = "200 mm"
dead_volume_a = "8 cm^3"
dead_volume_b = "8 cm^3"
[valve]
conductance = "2e-8 m^3/(s*Pa)"
critical_ratio = 0.3
bandwidth = "80 Hz"
centre = "5 V"
[supply]
pressure = "6 bar(g)"
[load]
mass = "5 kg"
[friction]
model = "coulomb"
coulomb = "30 N"
viscous = "50 N*s/m"
"""
TUNED = """
[pid]
sample_time = "1 ms"
Kp = "2 V*s/m"
Ki = "20 V/m"
limits = ["0 V", "10 V"]
[dither]
frequency = "100 Hz"
amplitude = "0.5 V"
[[reference]]
step = "0.1 m/s"
horizon = "1 s"
[certified]
"0 to 0.1" = { SettlingTime = 0.0849, Overshoot = 4.9, Ripple = 0.01 }
[status]
code = "converged"
message = "certified */ *)"
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("fit.toml").write_text(DRIVE, "utf-8")
    write_with_checksum(TUNED)
    return tmp_path


def write_with_checksum(text: str) -> None:
    """A tuned.toml as if a tuning had written it."""
    path = Path("tuned.toml")
    path.write_text(text, "utf-8")
    document = read_toml(path)
    document["checksum"] = checksum_section(document.unwrap(), path, read_fit("fit.toml"))
    path.write_text(tomlkit.dumps(document), "utf-8")


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


@pytest.mark.parametrize(
    ("to", "files"),
    [
        ("c", ["controller.c", "controller.h", "controller_test.c"]),
        ("st", ["controller.st"]),
        ("python", ["controller.py"]),
    ],
)
def test_files_are_written_with_where_they_come_from(place: Path, to: str, files: list[str]) -> None:
    result = run(f"export fit.toml tuned.toml --to {to} -o made/here")
    assert result.exit_code == 0, result.stderr
    assert sorted(p.name for p in (place / "made" / "here").iterdir()) == files
    text = (place / "made" / "here" / files[0]).read_text("ascii")
    for said in (
        "from tuned.toml, sha256 ",
        "plant fit.toml, sha256 ",
        "Certified: 0 to 0.1: SettlingTime 0.0849, Overshoot 4.9",
    ):
        assert said in text
    assert "The output runs from 0 V to 10 V; lower and upper count from the centre." in text
    assert "NOT CERTIFIED" not in text


def test_no_old_file_is_replaced_and_then_none_is_written(place: Path) -> None:
    (place / "controller_test.c").write_text("mine")
    result = run("export fit.toml tuned.toml --to c")
    assert result.exit_code == 2
    assert "controller_test.c: is there already" in result.stderr
    assert not (place / "controller.c").exists()
    assert run("export fit.toml tuned.toml --to c --force").exit_code == 0
    assert (place / "controller_test.c").read_text("ascii").startswith("/* Compares controller")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            'code = "converged"',
            'code = "no answer found keeps all limits"',
            "NOT CERTIFIED: its tuning ended so: no answer found keeps all limits",
        ),
        ("[status]", "[provenance]", "its gains were not written by pneuopt tune"),
        ('sample_time = "1 ms"', "", "a continuous controller cannot be exported"),
    ],
)
def test_what_is_no_certified_sampled_controller_is_refused(place: Path, old: str, new: str, said: str) -> None:
    write_with_checksum(TUNED.replace(old, new))
    result = run("export fit.toml tuned.toml --to st")
    assert result.exit_code == 2
    assert said in result.stderr
    assert not (place / "controller.st").exists()


def test_uncertified_gains_are_written_on_demand_and_say_so(place: Path) -> None:
    (place / "tuned.toml").write_text(TUNED.split("[certified]", maxsplit=1)[0], "utf-8")
    result = run("export fit.toml tuned.toml --to st --uncertified --name axis_1")
    assert result.exit_code == 0
    assert "says NOT CERTIFIED" in result.stderr
    assert "NOT CERTIFIED: its gains were not written by pneuopt tune" in (place / "axis_1.st").read_text("ascii")


def test_a_form_that_is_not_known_and_a_bad_name_are_refused(place: Path) -> None:
    assert "did you mean" in run("export fit.toml tuned.toml --to pyton").stderr
    result = run("export fit.toml tuned.toml --to c --name a*/b")
    assert result.exit_code == 2
    assert "a block's name has letters" in result.stderr
    assert list(place.glob("*.c")) == []


def test_the_settings_of_a_block_are_shown_and_written(place: Path) -> None:
    result = run("export fit.toml tuned.toml --to siemens -o plc")
    assert result.exit_code == 0, result.stderr
    text = (place / "plc" / "controller_siemens.txt").read_text("ascii")
    assert text in result.stdout
    assert "Retain.CtrlParams.Gain" in text
    assert "from tuned.toml, sha256 " in text
    assert "its integral is clamped at a limit" in text


def test_the_plant_is_written_as_an_fmu(place: Path) -> None:
    result = run("export fit.toml tuned.toml --to fmu --name axis -o made")
    assert result.exit_code == 0, result.stderr
    assert (place / "made" / "axis.fmu").read_bytes().startswith(b"PK")
    assert "is there already" in run("export fit.toml tuned.toml --to fmu --name axis -o made").stderr
    result = run("export fit.toml tuned.toml --to fmu -o fit.toml/below")
    assert (result.exit_code, "the folder cannot be made" in result.stderr) == (2, True)


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("plc", "structured text, --to st; settings for its own PID block: siemens, rockwell"),
        ("SCL", "--to st"),
        ("TwinCAT", "it is called 'beckhoff' here"),
        ("C", "it is called 'c' here"),
        ("cc", "did you mean 'c'?"),
    ],
)
def test_a_form_by_another_name_is_understood(place: Path, word: str, told: str) -> None:
    result = run(f"export fit.toml tuned.toml --to {word}")
    assert (result.exit_code, told in result.stderr) == (2, True), result.stderr
    assert not (place / "controller.c").exists()


def test_the_span_of_a_process_value_is_rockwells(place: Path) -> None:
    assert run("export fit.toml tuned.toml --to rockwell --pv-span 500mm/s").exit_code == 0
    assert "S the span of PV, here 0.5 m/s" in (place / "controller_rockwell.txt").read_text("ascii")
    for words, told in (
        ("--to siemens --pv-span 0.5m/s", "of --to rockwell only"),
        ("--to rockwell --pv-span 5", "unit"),
    ):
        result = run(f"export fit.toml tuned.toml {words}")
        assert (result.exit_code, told in result.stderr) == (2, True), result.stderr
