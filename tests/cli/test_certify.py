"""`certify`, and what becomes of its certificate in exported files when something is changed afterwards."""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest
import tomlkit
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.files.drive import read_status
from pneuopt.quantities.status import Code

DRIVE = """
[drive]
kind = "linear"
[plant]
model = "first_order"
gain = "0.12 (m/s)/V"
time_constant = "200 ms"
dead_time = "10 ms"
"""
GIVEN = """# axis 7
[pid]
form = "parallel"
sample_time = "10 ms"
limits = ["-5 V", "5 V"]
Kp = { value = "8 V*s/m", lower = "0.1 V*s/m", upper = "30000 V*s/m", free = true }
Ki = { value = "50 V/m", lower = "1 V/m", upper = "2000 V/m", free = true }
Kd = "0.02 V*s^2/m"
Tf = "20 ms"
b = 0.9
[[reference]]
step = "0.2 m/s"
horizon = "2 s"
[minimise]
settling_time = { band = "2 %" }
[limits]
overshoot = "5 %"
max_sensitivity = 1.6
"""
FILES = {"c": "controller.c", "st": "controller.st", "python": "controller.py", "siemens": "controller_siemens.txt"}


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def edit(name: str, old: str, new: str) -> None:
    text = Path(name).read_text("utf-8")
    assert old in text
    Path(name).write_text(text.replace(old, new, 1), "utf-8")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a certified design, of one with dither, and of a tuning that was refused."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "fit.toml").write_text(DRIVE, "utf-8")
    dither = '[dither]\nfrequency = "20 Hz"\namplitude = "50 mV"\n[[reference]]'
    (folder / "given.toml").write_text(GIVEN, "utf-8")
    (folder / "dithered.toml").write_text(GIVEN.replace("[[reference]]", dither), "utf-8")
    wanted = GIVEN.replace("30000 V", "10 V") + 'settling_time = { max = "100 ms", band = "2 %" }\n'
    (folder / "wanted.toml").write_text(wanted, "utf-8")
    for given, made in (("given", "tuned"), ("dithered", "dither")):
        ended = run(f"certify {folder}/fit.toml {folder}/{given}.toml -o {folder}/{made}.toml -q")
        assert ended.exit_code == 0, ended.output
    failed = run(f"tune {folder}/fit.toml {folder}/wanted.toml -o {folder}/failed.toml -q")
    assert failed.exit_code == 1, failed.output
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


FORGERIES: Mapping[str, tuple[str, str, str, str]] = {
    "Kp": ("tuned", '"8 V*s/m"', '"20000 V*s/m"', "pid.Kp was changed after tuning (8 V*s/m -> 20000 V*s/m)"),
    "Ki": ("tuned", '"50 V/m"', '"51 V/m"', "pid.Ki was changed after tuning (50 V/m -> 51 V/m)"),
    "Kd": ("tuned", '"0.02 V*s^2/m"', '"0.03 V*s^2/m"', "pid.Kd was changed after tuning"),
    "Tf": ("tuned", '"20 ms"', '"2 ms"', "pid.Tf was changed after tuning (20 ms -> 2 ms)"),
    "b": ("tuned", "b = 0.9", "b = 1", "pid.b was changed after tuning (0.9 -> 1)"),
    "dither": ("dither", '"50 mV"', '"1 V"', "dither.amplitude was changed after tuning (0.05 V -> 1 V)"),
    "range": ("tuned", '["-5 V"', '["-10 V"', "pid.limits, the lower one was changed after tuning (-5 V -> -10 V)"),
    "limit": ("tuned", '"5 %"', '"50 %"', "[limits] overshoot.max was changed after tuning (5 % -> 50 %)"),
    "reference": ("tuned", '"0.2 m/s"', '"0.3 m/s"', "reference 1 step was changed after tuning (0.2 m/s -> 0.3 m/s)"),
    "samples": ("tuned", '"10 ms"', '"20 ms"', "pid.sample_time was changed after tuning (10 ms -> 20 ms)"),
    "plant": ("fit", '"0.12 (m/s)/V"', '"0.24 (m/s)/V"', "the plant's plant.gain was changed after tuning (0.12"),
    "figures": ("tuned", "Overshoot = ", "Overshoot = 1", "the row of '0 to 0.2' in [certified] was changed"),
    "status": ("failed_best", f'"{Code.INFEASIBLE.value}"', '"converged"', "the status was changed after tuning"),
    "by hand": ("given", "[[reference]]", '[status]\ncode = "converged"\n[[reference]]', "it has no checksum"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_refused_and_stands_in_every_exported_file(place: Path, name: str) -> None:
    file, old, new, told = FORGERIES[name]
    tuned = "tuned" if file == "fit" else file
    edit(f"{file}.toml", old, new)
    forms = [form for form in FILES if form != "siemens" or name != "dither"]
    for form in forms:
        line = f"export fit.toml {tuned}.toml --to {form} -o {form}"
        refused = run(line)
        assert refused.exit_code == 2, refused.output
        assert told in " ".join(refused.stderr.split())
        assert not Path(form).exists()
        assert run(f"{line} --uncertified").exit_code == 0
        text = (Path(form) / FILES[form]).read_text("ascii")
        assert f"NOT CERTIFIED: {told}" in text
        assert "Certified: " not in text


@pytest.mark.parametrize("name", ["Kp", "status"])
def test_a_simulation_and_its_page_say_first_what_was_changed(place: Path, name: str) -> None:
    file, old, new, told = FORGERIES[name]
    edit(f"{file}.toml", old, new)
    shown = run(f"simulate fit.toml {file}.toml --json shown.json --report shown.html")
    assert shown.stdout.startswith("NOT CERTIFIED: ")
    assert told in shown.stdout
    said = json.loads(Path("shown.json").read_text("utf-8"))["certificate"]
    assert not said["holds"]
    assert any(told in reason for reason in said["reasons"])
    page = " ".join(re.sub(r"<[^>]*>", " ", Path("shown.html").read_text("utf-8")).split())
    assert page.index("NOT CERTIFIED") < page.index("simulated: ")


@pytest.mark.parametrize("form", FILES)
def test_a_certificate_that_holds_stands_in_every_exported_file(place: Path, form: str) -> None:
    text = tomlkit.dumps(tomlkit.parse(Path("tuned.toml").read_text("utf-8")))
    Path("tuned.toml").write_text(text.replace('"20 ms"', '"0.02 s"   # a note'), "utf-8")
    moved = place.rename(place.parent / "moved")
    result = run(f"export {moved}/fit.toml {moved}/tuned.toml --to {form} -o {moved}/{form}")
    assert result.exit_code == 0, result.output
    text = (moved / form / FILES[form]).read_text("ascii")
    assert "Certified: 0 to 0.2: SettlingTime" in text
    assert "NOT CERTIFIED" not in text
    shown = run(f"simulate {moved}/fit.toml {moved}/tuned.toml")
    assert shown.stdout.startswith("certified: the certificate in ")


def test_a_tuning_without_a_certificate_is_simulated_as_before(place: Path) -> None:
    shown = run("simulate fit.toml given.toml --json shown.json")
    assert "CERTIFIED" not in shown.stdout
    assert "certificate" not in json.loads(Path("shown.json").read_text("utf-8"))


def test_edited_gains_that_hold_get_a_certificate_of_their_own(place: Path) -> None:
    edit("tuned.toml", '"8 V*s/m"', '"9 V*s/m"')
    result = run("certify fit.toml tuned.toml -o again.toml -q --json again.json --report again.html")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("certified: the gains as they stand keep 2 limits in 1 case\nholds on ")
    assert "of 100 plants" in result.stdout
    text = Path("again.toml").read_text("utf-8")
    assert '"9 V*s/m"' in text
    assert text.startswith("# axis 7")
    said = json.loads(Path("again.json").read_text("utf-8"))
    assert said["status"]["code"] == "converged"
    assert said["validation"]
    assert "certified: the gains as they stand" in Path("again.html").read_text("utf-8")
    assert run("export fit.toml again.toml --to st").exit_code == 0
    refused = run("certify fit.toml tuned.toml -o tuned.toml -q")
    assert (refused.exit_code, "is an input" in refused.stderr) == (2, True)


def test_edited_gains_that_break_something_get_no_file_and_hear_by_how_much(place: Path) -> None:
    edit("tuned.toml", '"8 V*s/m"', '"62 V*s/m"')
    before = set(place.iterdir())
    result = run("certify fit.toml tuned.toml -o again.toml -q --report again.html")
    assert result.exit_code == 1
    (found,) = re.findall(r"NOT CERTIFIED: MaxSensitivity is ([\d.]+), allowed 1.6: off by ([\d.]+) %", result.stdout)
    assert 100 * (float(found[0]) / 1.6 - 1) == pytest.approx(float(found[1]), rel=1e-2)
    assert "again.toml is not written" in result.stdout
    assert {path.name for path in set(place.iterdir()) - before} == {"again.html"}
    edit("tuned.toml", '"62 V*s/m"', '"20000 V*s/m"')
    unstable = run("certify fit.toml tuned.toml -q")
    assert unstable.exit_code == 1
    assert "NOT CERTIFIED: the linear loop is unstable" in unstable.stdout
    assert "inf %" not in unstable.stdout


def test_gains_of_which_none_is_free_and_nothing_is_minimised_are_certified_by_their_limits(place: Path) -> None:
    plain = GIVEN.replace('[minimise]\nsettling_time = { band = "2 %" }\n', "").replace(", free = true", "")
    for name, text in (("limits", plain), ("bare", plain.partition("[limits]")[0])):
        Path(f"{name}.toml").write_text(text, "utf-8")
        result = run(f"certify fit.toml {name}.toml -o {name}_tuned.toml -q")
        assert result.exit_code == 0, result.output
        assert "of 100 plants" in result.stdout
        assert run(f"export fit.toml {name}_tuned.toml --to c -o {name}").exit_code == 0


def test_the_best_of_a_refused_tuning_has_its_own_gains_and_no_certificate(place: Path) -> None:
    assert not Path("failed.toml").exists()
    status = read_status("failed_best.toml")
    assert status is not None
    assert status.code is Code.INFEASIBLE
    assert "[certified]" not in Path("failed_best.toml").read_text("utf-8")
    refused = run("export fit.toml failed_best.toml --to c -o c")
    assert (refused.exit_code, Path("c").exists()) == (2, False)
    assert "its tuning ended so: the limits contradict each other" in refused.stderr
    assert run("export fit.toml failed_best.toml --to c -o c --uncertified").exit_code == 0
    text = Path("c/controller.c").read_text("ascii")
    assert "NOT CERTIFIED: its tuning ended so" in text
    (gain,) = re.findall(r'Kp = \{ value = "(\S+) ', Path("failed_best.toml").read_text("utf-8"))
    assert f"parallel: Kp = {gain} " in text
