"""`certify`, and what becomes of its certificate in exported files when something is changed afterwards."""

import json
import re
import shutil
from pathlib import Path

import pytest
import tomlkit

from pneuopt.files.drive import read_status
from pneuopt.quantities.status import Code
from problems.demo.forged_certificates import (
    FILES,
    FORGERIES,
    GIVEN,
    count_noticed,
    edit,
    forge,
    forms,
    make_files,
    run,
)

STUDY = """
[study]
drive = "fit.toml"
tuning = "tuned.toml"
[samples]
count = 2
fit = true
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a certified design, of one with dither, and of a tuning that was refused."""
    folder = tmp_path_factory.mktemp("made")
    make_files(folder)
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_refused_and_stands_in_every_exported_file(place: Path, name: str) -> None:
    assert count_noticed(place, name) == len(forms(name)) >= 3


@pytest.mark.parametrize("name", ["Kp", "status"])
def test_a_simulation_and_its_page_say_first_what_was_changed(place: Path, name: str) -> None:
    file, told = forge(place, name)
    shown = run(f"simulate fit.toml {file}.toml --json shown.json --report shown.html")
    assert shown.stdout.startswith("NOT CERTIFIED: ")
    assert told in shown.stdout
    assert not re.search(r"(?m)^certified\b", shown.stdout)  # the figures are those of a simulation
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
    edit(place / "tuned.toml", '"8 V*s/m"', '"9 V*s/m"')
    result = run("certify fit.toml tuned.toml -o again.toml -q --json again.json --report again.html")
    assert result.exit_code == 0, result.output
    assert re.match(r"certified: (holds on|settles in .* on 95 of) [0-9]+", result.stdout)
    assert "  the gains as they stand keep 2 limits in 1 case\n" in result.stdout
    text = Path("again.toml").read_text("utf-8")
    assert '"9 V*s/m"' in text
    assert text.startswith("# axis 7")
    said = json.loads(Path("again.json").read_text("utf-8"))
    assert said["status"]["code"] == "converged"
    assert said["validation"]
    assert "the gains as they stand" in Path("again.html").read_text("utf-8")
    assert run("export fit.toml again.toml --to st").exit_code == 0
    refused = run("certify fit.toml tuned.toml -o tuned.toml -q")
    assert (refused.exit_code, "is an input" in refused.stderr) == (2, True)


def test_edited_gains_that_break_something_get_no_file_and_hear_by_how_much(place: Path) -> None:
    edit(place / "tuned.toml", '"8 V*s/m"', '"62 V*s/m"')
    before = set(place.iterdir())
    result = run("certify fit.toml tuned.toml -o again.toml -q --report again.html")
    assert result.exit_code == 1
    (found,) = re.findall(r"NOT CERTIFIED: MaxSensitivity is ([\d.]+), allowed 1.6: off by ([\d.]+) %", result.stdout)
    assert 100 * (float(found[0]) / 1.6 - 1) == pytest.approx(float(found[1]), rel=1e-2)
    assert "again.toml is not written" in result.stdout
    assert {path.name for path in set(place.iterdir()) - before} == {"again.html"}
    edit(place / "tuned.toml", '"62 V*s/m"', '"20000 V*s/m"')
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
    assert "its tuning ended so: no answer found keeps all limits" in refused.stderr
    assert run("export fit.toml failed_best.toml --to c -o c --uncertified").exit_code == 0
    text = Path("c/controller.c").read_text("ascii")
    assert "NOT CERTIFIED: its tuning ended so" in text
    (gain,) = re.findall(r'Kp = \{ value = "(\S+) ', Path("failed_best.toml").read_text("utf-8"))
    assert f"parallel: Kp = {gain} " in text


@pytest.mark.parametrize(
    "command",
    [
        "tune fit.toml given.toml -o new.toml --rig rig.toml --report page.html",
        "certify fit.toml tuned.toml -o new.toml --rig rig.toml --report page.html",
        "simulate fit.toml tuned.toml --report page.html",
        "export fit.toml tuned.toml --to st -o out",
        "study study.toml --report page.html --executor 1",
        "next-experiment fit.toml --duration 1s --sample-time 10ms --limit valve_voltage=-1V..1V --budget 1 "
        "--noise speed=1mm/s --report page.html",
    ],
)
def test_a_fit_is_parsed_once_a_command(place: Path, command: str, parsed: list[str]) -> None:
    Path("rig.toml").write_text("[actuator]\n", "utf-8")
    if not command.startswith(("tune", "certify", "simulate", "export")):
        edit(place / "fit.toml", 'gain = "0.12 (m/s)/V"', 'gain = { value = "0.12 (m/s)/V", free = true }')
        uncertain = '[estimates]\n"plant.gain" = { value = 0.12, stderr = 1e-3 }\n'
        edit(place / "fit.toml", "[plant]", f"{uncertain}[plant]")
        Path("study.toml").write_text(STUDY, "utf-8")
    assert run(command).exit_code in (0, 1)
    assert parsed.count(Path("fit.toml").read_text("utf-8")) == 1
