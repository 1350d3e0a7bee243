"""[samples], [corners] and [table] of a study.toml: each kind through the same mill."""

from pathlib import Path

import pytest

from pneuopt.evaluation.distributions import Distribution, LogNormal, LogUniform, Normal, Uniform
from pneuopt.evaluation.monte_carlo import monte_carlo
from pneuopt.evaluation.sampling import Sampling
from pneuopt.evaluation.scenarios import Spread, corners
from pneuopt.files.study import read_study, swept_axes
from pneuopt.files.study_cases import CASE_KEYS, Cases, read_study_cases
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.cases import read_cases

RIG = ParameterSet(
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
[estimates]
"friction.coulomb" = { value = 40.0, stderr = 2.0, dof = 5.0 }
[covariance]
"friction.coulomb" = [4.0]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "fit.toml").write_text(FIT, encoding="utf-8")
    (tmp_path / "plants.csv").write_text("load.mass [g]\n4000\n6000\n", encoding="utf-8")
    return tmp_path / "study.toml"


def cases(file: Path, text: str) -> Cases:
    file.write_text(HEAD + text, encoding="utf-8")
    return read_study_cases(read_study(file), RIG)


def test_each_kind_gives_what_python_gives(file: Path) -> None:
    spreads: dict[str, Spread | Distribution] = {"load.mass": 0.1, "friction.*": (30.0, 50.0)}
    spreads["supply.pressure"] = Normal((701325.0, 2e4))
    found = {
        "samples": (SAMPLED, monte_carlo(RIG, 8, spreads=spreads, seed=3, sampling=Sampling.SOBOL)),
        "corners": ('[corners]\nload.mass = "20 %"', corners(RIG, {"load.mass": 0.2})),
        "table": ('[table]\nfile = "plants.csv"', read_cases(RIG, file.parent / "plants.csv")),
    }
    assert found.keys() == CASE_KEYS.keys()
    for text, expected in found.values():
        assert cases(file, text) == expected


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
    file: Path, given: str, distribution: Uniform | LogUniform | Normal | LogNormal
) -> None:
    expected = monte_carlo(RIG, 20, spreads={"load.mass": distribution})
    assert cases(file, f'[samples]\n"load.mass" = {given}') == expected


def test_a_fit_is_drawn_from_beside_what_is_stated(file: Path) -> None:
    found = cases(file, '[samples]\ncount = 300\nfit = true\n"load.mass" = "5 %"')
    friction = sorted(case["friction.coulomb"] for case in found.values())
    assert friction[7] < 40 - 1.9 * 2 < friction[40]  # 2.5 % of Student's t with 5 degrees of freedom lie below -2.6
    assert {tuple(case) for case in found.values()} == {("friction.coulomb", "load.mass")}


def test_axes_of_cases_are_shown_in_units_that_read_well() -> None:
    axes = swept_axes(RIG, {"a": {"supply.pressure": 6e5}, "b": {"load.mass": 4.0, "supply.pressure": 7e5}})
    assert [(axis.name, axis.unit, axis.in_axis_unit(axis.points).tolist()) for axis in axes] == [
        ("supply.pressure", "bar(a)", [6.0, 7.0]),
        ("load.mass", "kg", [4.0]),
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[samples]\ncount = 5", r"study\.toml: \[samples\] nothing varies: state how"),
        ('[samples]\ncount = -1\n"load.mass" = 0.1', r"\[samples\] count must be at least 1, got -1"),
        ('[samples]\ncount = 1e9\n"load.mass" = 0.1', "whole numbers"),
        ('[samples]\ncount = 100000000\n"load.mass" = 0.1', "may be 20000 at most"),
        ('[samples]\nseed = -1\n"load.mass" = 0.1', "seed not below 0"),
        ('[samples]\nsampling = "sobel"\n"load.mass" = 0.1', r"unknown sampling 'sobel'; did you mean 'sobol'"),
        ('[samples]\nsampling = ["sobol"]\n"load.mass" = 0.1', "unknown sampling"),
        ('[samples]\nfit = 1\n"load.mass" = 0.1', "fit must be true or false"),
        ('[samples]\n"load.mas" = 0.1', r"\[samples\] unknown parameter 'load\.mas'"),
        ('[samples]\n"load.mass" = "3 kg"', r"\[samples\] load\.mass"),
        ('[samples]\n"load.mass" = ["3 kg"]', "write a fraction"),
        ('[samples]\n"load.mass" = {}', r"load\.mass has no spread; write \{ distribution"),
        ('[samples]\n"load.mass" = { normal = "5 %" }', "unknown key 'normal'"),
        ('[samples]\n"load.mass" = { distribution = "norml", spread = 0.1 }', "did you mean 'normal'"),
        ('[samples]\n"load.mass" = { distribution = 3, spread = 0.1 }', "unknown distribution '3'"),
        ('[samples]\n"load.mass" = { distribution = "normal", spread = -0.1 }', "Normal: a spread is a positive"),
        ('[samples]\n"load.mass" = { distribution = "normal", spread = ["500 kg", "1 kg"] }', "leaves its bounds"),
        ('[samples]\n"supply.pressure" = { distribution = "normal", spread = ["6 bar", "1 bar"] }', "bar"),
        ('[corners]\n"load.mass" = { spread = 0.1 }', r"\[corners\] load\.mass"),
        ("[corners]", r"study\.toml: \[corners\] no spread"),
        ("[table]", r"\[table\] names no file"),
        ("[table]\nfile = 3", r"\[table\] names no file"),
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
def test_bad_cases_are_refused_in_one_line(file: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        cases(file, text)
    assert "\n" not in str(raised.value)


def test_a_drive_that_no_fit_has_written_has_nothing_to_draw_from(file: Path) -> None:
    (file.parent / "fit.toml").write_text('[drive]\nkind = "force"\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"fit = true needs a fit\.toml, which identify writes; .* has no estimates"):
        cases(file, '[samples]\nfit = true\n"load.mass" = 0.1')


def test_cells_without_neighbours_are_not_tuned(file: Path) -> None:
    file.write_text(f"{HEAD}tune = true\n{SAMPLED}", encoding="utf-8")
    with pytest.raises(InputError, match="tune needs a grid, whose cells have neighbours"):
        read_study(file)
