"""[samples], [corners] and [table] of a study.toml: each kind through the same mill."""

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


BAD = {
    "section": (("[axes]", "[axis]"), "study.toml: unknown section 'axis'; did you mean 'axes'"),
    "key": (("tuning =", "tunning ="), r"\[study\]: unknown key 'tunning'; did you mean 'tuning'"),
    "no drive": (('drive = "fit.toml"', ""), r"\[study\] has no drive; write drive = "),
    "no file": (('"fit.toml"', "3"), r"\[study\] drive must be text, got 3"),
    "no axis": (("[axes]", "[metrics]"), r"\[metrics\]: unknown key"),
    "parameter": (("load.mass", "load.mas"), r"\[axes\]: unknown parameter 'load.mas'; did you mean 'load.mass'"),
    "bare bar": (
        ('"5 bar(g)"', '"5 bar"'),
        r"\[axes\] supply.pressure: a pressure level in 'bar' may be absolute or gauge",
    ),
    "unit": (('"2 kg"', '"2 m"'), r"\[axes\] load.mass from: unit 'm' does not measure 'kg'"),
    "one value": (("{ from", '"3 kg"#'), r"\[axes\] load.mass: write a list or a range"),
    "empty": (("{ from", "[]#"), r"\[axes\] load.mass: write a list or a range"),
    "range": ((", steps = 4", ""), r"\[axes\] load.mass has no steps; write"),
    "range's key": (("steps =", "step ="), r"\[axes\] load.mass: unknown key 'step'; did you mean 'steps'"),
    "too many": (("steps = 4", "steps = 1000000000"), "steps must be from 2 to 20000, got 1000000000"),
    "cells": (("steps = 4", "steps = 20000"), "make [0-9]{5,} cells, 20000 are allowed; take fewer values"),
    "steps": (("steps = 4", "steps = 1"), "load.mass steps must be from 2 to 20000, got 1"),
    "band": (
        ("[axes]", "[metrics]\nband = 2\n[axes]"),
        r"\[metrics\] band must be above 0 and below 1, got 2",
    ),
    "show": (("[axes]", "[metrics]\nshow = 2\n[axes]"), r"\[metrics\] show must be a list, got 2"),
    "nothing": ((STUDY, "[study]\ndrive = 'a'\ntuning = 'b'\n"), r'no axis; add \[axes\] with "load.mass" = '),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_message(file: Path, case: str) -> None:
    (old, new), said = BAD[case]
    assert old in STUDY
    with pytest.raises(InputError, match=said) as error:
        axes(file, STUDY.replace(old, new, 1))
    assert str(error.value).startswith(str(file))


BAD_FRONT = {
    "key": (("points", "pints"), r"\[pareto\]: unknown key 'pints'; did you mean 'points'"),
    "requirement": (
        ("peak_control", "peek_control"),
        r"\[pareto\] between: unknown requirement 'peek_control'; did you",
    ),
    "twice": (("settling_time", "peak_control"), r"\[pareto\] between names peak_control twice; a front needs two"),
    "one": (('"settling_time", ', ""), r"\[pareto\] between must be a list of 2, got"),
    "none": (("between =", "#"), r"\[pareto\] has no between"),
    "points": (("= 5\n", "= 1\n"), r"\[pareto\] points must be from 2 to 20000, got 1"),
    "no number": (("= 5\n", "= true\n"), r"\[pareto\] points must be a whole number, got True"),
    "unit": (("2 V", "2 s"), r"\[pareto\] lower: unit 's' does not measure 'V'"),
    "no unit": (('"2 V"', "2"), r"\[pareto\] lower: 2 has no unit"),
    "sign": (("2 V", "-2 V"), r"\[pareto\] lower: peak_control must be positive, got '-2 V'"),
    "order": (("2 V", "6 V"), r"\[pareto\] lower, 6 V, is not below upper, 5000 mV"),
    "grid": (("[pareto]", "[axes]\nload.mass = [1.0]\n[pareto]"), r"\[axes\] belongs to a grid, \[pareto\] to a front"),
    "metrics": (("[pareto]", '[metrics]\nband = "1 %"\n[pareto]'), r"\[metrics\] belongs to a grid"),
}


@pytest.mark.parametrize("case", BAD_FRONT)
def test_a_bad_front_gets_one_message(file: Path, case: str) -> None:
    (old, new), said = BAD_FRONT[case]
    assert old in FRONT
    with pytest.raises(InputError, match=said) as error:
        front(file, FRONT.replace(old, new, 1))
    assert str(error.value).startswith(str(file))


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


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (STUDY.replace("[axes]", 'batch = "yes"\n[axes]'), "batch must be true or false, got 'yes'"),
        (STUDY.replace("[axes]", "batch = true\ntune = true\n[axes]"), "a batch is of one design"),
        (FRONT.replace("[pareto]", "batch = true\n[pareto]"), "batch is of cases; a front is tuned"),
        (STUDY.replace("[axes]", 'tune = "yes"\n[axes]'), "tune must be true or false, got 'yes'"),
        (FRONT.replace("[pareto]", "tune = true\n[pareto]"), "tune belongs to a grid; a front is tuned anyway"),
        (STUDY.replace("[axes]", "tune = true\n[axes]") + '[metrics]\nband = "5 %"\n', "state it in tuned.toml"),
    ],
)
def test_what_a_study_cannot_tune_is_refused(file: Path, text: str, told: str) -> None:
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_study(file)


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


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[samples]\ncount = 5", r"study\.toml: \[samples\] nothing varies: state how"),
        ('[samples]\ncount = -1\n"load.mass" = 0.1', r"\[samples\] count must be from 1 to 20000, got -1"),
        ('[samples]\ncount = 1e9\n"load.mass" = 0.1', r"\[samples\] count must be a whole number"),
        ('[samples]\ncount = 100000000\n"load.mass" = 0.1', r"\[samples\] count must be from 1 to 20000"),
        ('[samples]\nseed = -1\n"load.mass" = 0.1', r"\[samples\] seed must be at least 0"),
        ('[samples]\nsampling = "sobel"\n"load.mass" = 0.1', r"unknown sampling 'sobel'; did you mean 'sobol'"),
        ('[samples]\nsampling = ["sobol"]\n"load.mass" = 0.1', r"\[samples\] sampling must be text"),
        ('[samples]\nfit = 1\n"load.mass" = 0.1', "fit must be true or false"),
        ('[samples]\n"load.mas" = 0.1', r"\[samples\] unknown parameter 'load\.mas'"),
        ('[samples]\n"load.mass" = "3 kg"', r"\[samples\] load\.mass"),
        ('[samples]\n"load.mass" = ["3 kg"]', "write a fraction"),
        ('[samples]\n"load.mass" = {}', r"load\.mass has no spread"),
        ('[samples]\n"load.mass" = { normal = "5 %" }', "unknown key 'normal'"),
        ('[samples]\n"load.mass" = { distribution = "norml", spread = 0.1 }', "did you mean 'normal'"),
        ('[samples]\n"load.mass" = { distribution = 3, spread = 0.1 }', "load.mass distribution must be text, got 3"),
        ('[samples]\n"load.mass" = { distribution = "normal", spread = -0.1 }', "Normal: a spread is a positive"),
        ('[samples]\n"load.mass" = { distribution = "normal", spread = ["500 kg", "1 kg"] }', "leaves its bounds"),
        ('[samples]\n"supply.pressure" = { distribution = "normal", spread = ["6 bar", "1 bar"] }', "bar"),
        ('[corners]\n"load.mass" = { spread = 0.1 }', r"\[corners\] load\.mass"),
        ("[corners]", r"study\.toml: \[corners\] no spread"),
        ("[table]", r"\[table\] has no file"),
        ("[table]\nfile = 3", r"\[table\] file must be text, got 3"),
        ('[table]\nfile = "none.csv"', r"none\.csv: cannot be read"),
        ('[table]\nfil = "plants.csv"', "did you mean 'file'"),
        (
            '[corners]\nload.mass = 0.1\n[table]\nfile = "plants.csv"',
            r"\[corners\], \[table\]: a study has cases of one",
        ),
        (
            '[corners]\nload.mass = 0.1\n[axes]\nload.mass = ["1 kg"]',
            r"\[axes\], \[corners\]: a study has cases of one",
        ),
    ],
)
def test_bad_cases_are_refused_in_one_line(case_file: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        cases(case_file, text)
    assert "\n" not in str(raised.value)


def test_a_drive_that_no_fit_has_written_has_nothing_to_draw_from(case_file: Path) -> None:
    (case_file.parent / "fit.toml").write_text(FIT.partition("[estimates]")[0], encoding="utf-8")
    with pytest.raises(InputError, match=r"fit = true needs a fit\.toml, which identify writes; .* has no estimates"):
        cases(case_file, '[samples]\nfit = true\n"load.mass" = 0.1')


def test_cells_without_neighbours_are_not_tuned(case_file: Path) -> None:
    case_file.write_text(f"{HEAD}tune = true\n{SAMPLED}", encoding="utf-8")
    with pytest.raises(InputError, match="tune needs a grid, whose cells have neighbours"):
        read_study(case_file)
