from pathlib import Path

import pytest

from pneuopt.errors import InputError
from pneuopt.parameters import Parameter, ParameterSet
from pneuopt.studyfile import Axis, read_axes, read_study

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 0.1, 100.0),
        "supply.pressure": Parameter(7e5, "Pa(a)"),
        "valve.dead_zone": Parameter(0.0, "1"),
    }
)
STUDY = """
[study]
drive = "fit.toml"
tuning = "../tuned.toml"
[axes]
"supply.pressure" = ["4 bar(g)", "5 bar(g)", "601.325 kPa(a)"]   # gauge, as on the regulator
"load.mass" = { from = "2 kg", to = "8000 g", steps = 4 }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "study.toml"


def axes(file: Path, text: str) -> tuple[Axis, ...]:
    file.write_text(text, encoding="utf-8")
    return read_axes(read_study(file), RIG)


def test_a_study_names_its_files_axes_and_metrics(file: Path) -> None:
    pressure, mass = axes(file, STUDY)
    assert (pressure.name, pressure.unit) == ("supply.pressure", "bar(g)")
    assert pressure.points == (501325.0, 601325.0, 601325.0)
    assert pressure.shown(pressure.points).tolist() == [4.0, 5.0, 5.0]
    assert (mass.points, mass.unit) == ((2.0, 4.0, 6.0, 8.0), "kg")
    study = read_study(file)
    assert study.drive.resolve() == (file.parent / "fit.toml").resolve()
    assert study.tuning.resolve() == (file.parent.parent / "tuned.toml").resolve()
    assert (study.band, study.show) == (None, ("SettlingTime", "Overshoot"))


def test_names_may_stand_without_quotes_and_metrics_be_chosen(file: Path) -> None:
    metrics = '[metrics]\nband = "5 %"\nshow = ["Overshoot", "Ripple"]\n'
    text = STUDY.replace('"load.mass"', "load.mass") + 'valve.dead_zone = [0.0, "3 %"]\n' + metrics
    assert [a.name for a in axes(file, text)] == ["supply.pressure", "load.mass", "valve.dead_zone"]
    dead_zone = axes(file, text)[-1]
    assert (dead_zone.points, dead_zone.unit) == ((0.0, 0.03), "1")
    study = read_study(file)
    assert (study.band, study.show) == (0.05, ("Overshoot", "Ripple"))


BAD = {
    "section": (("[axes]", "[axis]"), "study.toml: unknown section 'axis'; did you mean 'axes'"),
    "key": (("tuning =", "tunning ="), r"\[study\]: unknown key 'tunning'; did you mean 'tuning'"),
    "no drive": (('drive = "fit.toml"', ""), r'\[study\] says no drive; write drive = "drive.toml"'),
    "no file": (('"fit.toml"', "3"), r"\[study\] drive must be a file's name, got 3"),
    "no axis": (("[axes]", "[metrics]"), r"\[metrics\]: unknown key"),
    "parameter": (("load.mass", "load.mas"), r"\[axes\]: unknown parameter 'load.mas'; did you mean 'load.mass'"),
    "bare bar": (
        ('"5 bar(g)"', '"5 bar"'),
        r"\[axes\] supply.pressure: a pressure level in 'bar' may be absolute or gauge",
    ),
    "unit": (('"2 kg"', '"2 m"'), r"\[axes\] load.mass from: unit 'm' does not measure 'kg'"),
    "one value": (("{ from", '"3 kg"#'), r"\[axes\] load.mass: write a list or a range"),
    "empty": (("{ from", "[]#"), r"\[axes\] load.mass: write a list or a range"),
    "range": ((", steps = 4", ""), r"\[axes\] load.mass says no steps; write"),
    "range's key": (("steps =", "step ="), r"\[axes\] load.mass: unknown key 'step'; did you mean 'steps'"),
    "steps": (("steps = 4", "steps = 1"), "load.mass steps is the number of values, at least 2, got 1"),
    "band": (
        ("[axes]", "[metrics]\nband = 2\n[axes]"),
        r'\[metrics\] band is a fraction of the step, "2 %" say, not 2',
    ),
    "show": (("[axes]", "[metrics]\nshow = 2\n[axes]"), r"\[metrics\] show must be a list of names"),
    "nothing": ((STUDY, "[study]\ndrive = 'a'\ntuning = 'b'\n"), r'no axis; add \[axes\] with "load.mass" = '),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_message(file: Path, case: str) -> None:
    (old, new), said = BAD[case]
    assert old in STUDY
    with pytest.raises(InputError, match=said) as error:
        axes(file, STUDY.replace(old, new, 1))
    assert str(error.value).startswith(str(file))
