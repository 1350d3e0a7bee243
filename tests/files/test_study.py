"""study.toml: axes, fronts, and the cases of each kind through the same mill."""

from pathlib import Path

import pytest

from pneuopt.evaluation.plants import monte_carlo
from pneuopt.evaluation.scenarios import Distribution, LogNormal, LogUniform, Normal, Sampling, Spread, Uniform, corners
from pneuopt.files.drive import read_fit
from pneuopt.files.study import (
    CASE_KEYS,
    Cases,
    Pareto,
    SweptAxis,
    read_axes,
    read_pareto,
    read_study,
    read_study_cases,
    swept_axes,
)
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.sweep import read_cases

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

FRONT = """
[study]
drive = "fit.toml"
tuning = "tuning.toml"
[pareto]
between = ["settling_time", "peak_control"]
points = 5
lower = "2 V"
upper = "5000 mV"
"""
UNITS = {"settling_time": "s", "peak_control": "V", "overshoot": "1", "air_use": "l"}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "study.toml"


def axes(file: Path, text: str) -> tuple[SweptAxis, ...]:
    file.write_text(text, encoding="utf-8")
    return read_axes(read_study(file), RIG)


def test_a_study_names_its_files_axes_and_metrics(file: Path) -> None:
    pressure, mass = axes(file, STUDY)
    assert (pressure.name, pressure.unit) == ("supply.pressure", "bar(g)")
    assert pressure.points == (501325.0, 601325.0, 601325.0)
    assert pressure.in_axis_unit(pressure.points).tolist() == [4.0, 5.0, 5.0]
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


def front(file: Path, text: str) -> Pareto:
    file.write_text(text, encoding="utf-8")
    return read_pareto(read_study(file), UNITS)


def test_a_front_names_two_requirements_and_the_range_of_the_second(file: Path) -> None:
    assert front(file, FRONT) == Pareto(("settling_time", "peak_control"), 5, 2.0, 5.0)
    short = FRONT.partition("points")[0]
    assert front(file, short) == Pareto(("settling_time", "peak_control"), 9, None, None)
    assert front(file, short.replace('peak_control"]', 'overshoot"]\nupper = "5 %"')).upper == 0.05
    assert front(file, short.replace('peak_control"]', 'air_use"]\nupper = "2 l(ANR)"')).upper == 2.0
    assert read_study(file).axes == {}


def test_a_study_may_tune_each_cell_of_a_grid(file: Path) -> None:
    file.write_text(STUDY, encoding="utf-8")
    assert not read_study(file).tune
    file.write_text(STUDY.replace("[axes]", "tune = true\n[axes]"), encoding="utf-8")
    assert read_study(file).tune


def test_a_study_may_run_its_cases_as_a_batch(file: Path) -> None:
    file.write_text(STUDY, encoding="utf-8")
    assert not read_study(file).batch
    file.write_text(STUDY.replace("[axes]", "batch = true\n[axes]"), encoding="utf-8")
    assert read_study(file).batch


CASE_RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 0.1, 100.0),
        "supply.pressure": Parameter(7e5, "Pa(a)"),
        "friction.coulomb": Parameter(40.0, "N", 0.0, free=True),
    }
)
HEAD = '[study]\ndrive = "fit.toml"\ntuning = "tuned.toml"\n'
SAMPLED = """
[samples]
count = 8
seed = 3
sampling = "sobol"
load.mass = "10 %"
"friction.*" = ["30 N", "50 N"]
"supply.pressure" = { distribution = "normal", spread = ["6 bar(g)", "0.2 bar"] }
"""
FIT = """
[drive]
kind = "force"
[friction]
model = "coulomb"
[estimates]
"friction.coulomb" = { value = 40.0, stderr = 2.0, dof = 5.0 }
[covariance]
"friction.coulomb" = [4.0]
"""


@pytest.fixture
def case_file(tmp_path: Path) -> Path:
    (tmp_path / "fit.toml").write_text(FIT, encoding="utf-8")
    (tmp_path / "plants.csv").write_text("load.mass [g]\n4000\n6000\n", encoding="utf-8")
    return tmp_path / "study.toml"


def cases(case_file: Path, text: str) -> Cases:
    case_file.write_text(HEAD + text, encoding="utf-8")
    study = read_study(case_file)
    return read_study_cases(study, read_fit(study.drive), CASE_RIG)


def test_each_kind_gives_what_python_gives(case_file: Path) -> None:
    spreads: dict[str, Spread | Distribution] = {"load.mass": 0.1, "friction.*": (30.0, 50.0)}
    spreads["supply.pressure"] = Normal((701325.0, 2e4))
    found = {
        "samples": (SAMPLED, monte_carlo(CASE_RIG, 8, spreads=spreads, seed=3, sampling=Sampling.SOBOL)),
        "corners": ('[corners]\nload.mass = "20 %"', corners(CASE_RIG, {"load.mass": 0.2})),
        "table": ('[table]\nfile = "plants.csv"', read_cases(CASE_RIG, case_file.parent / "plants.csv")),
    }
    assert found.keys() == CASE_KEYS.keys()
    for text, expected in found.values():
        assert cases(case_file, text) == expected


@pytest.mark.parametrize(
    ("given", "distribution"),
    [
        ('{ spread = "30 %" }', Uniform(0.3)),
        ('{ distribution = "uniform", spread = ["4 kg", "6000 g"] }', Uniform((4.0, 6.0))),
        ('{ distribution = "log_uniform", spread = ["1 kg", "9 kg"] }', LogUniform((1.0, 9.0))),
        ('{ distribution = "normal", spread = ["5 kg", "200 g"] }', Normal((5.0, 0.2))),
        ('{ distribution = "log_normal", spread = ["5 kg", "20 %"] }', LogNormal((5.0, 0.2))),
    ],
)
def test_distributions_are_read_in_their_units(
    case_file: Path, given: str, distribution: Uniform | LogUniform | Normal | LogNormal
) -> None:
    expected = monte_carlo(CASE_RIG, 20, spreads={"load.mass": distribution})
    assert cases(case_file, f'[samples]\n"load.mass" = {given}') == expected


def test_a_fit_is_drawn_from_beside_what_is_stated(case_file: Path) -> None:
    found = cases(case_file, '[samples]\ncount = 300\nfit = true\n"load.mass" = "5 %"')
    friction = sorted(case["friction.coulomb"] for case in found.values())
    assert friction[7] < 40 - 1.9 * 2 < friction[40]  # 2.5 % of Student's t with 5 degrees of freedom lie below -2.6
    assert {tuple(case) for case in found.values()} == {("friction.coulomb", "load.mass")}


def test_axes_of_cases_are_shown_in_units_that_read_well() -> None:
    axes = swept_axes(CASE_RIG, {"a": {"supply.pressure": 6e5}, "b": {"load.mass": 4.0, "supply.pressure": 7e5}})
    assert [(axis.name, axis.unit, axis.in_axis_unit(axis.points).tolist()) for axis in axes] == [
        ("supply.pressure", "bar(a)", [6.0, 7.0]),
        ("load.mass", "kg", [4.0]),
    ]


def test_a_drive_that_no_fit_has_written_has_nothing_to_draw_from(case_file: Path) -> None:
    (case_file.parent / "fit.toml").write_text(FIT.partition("[estimates]")[0], encoding="utf-8")
    with pytest.raises(InputError, match=r"fit = true needs a fit\.toml, which identify writes; .* has no estimates"):
        cases(case_file, '[samples]\nfit = true\n"load.mass" = 0.1')
