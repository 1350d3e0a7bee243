"""`pneuopt study`: cases, fronts and sensitivities as shown and written, and how its options compute them."""

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli import study as study_module
from pneuopt.cli import study as study_sensitivity
from pneuopt.cli.app import app
from pneuopt.cli.study import report_cases, tune_cell
from pneuopt.models.declaration import Drive
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.studies.batch import evaluate_batch
from pneuopt.studies.sensitivity import sensitivity, sweep_from_neighbours
from pneuopt.studies.sweep import sweep
from pneuopt.tuning.front import pareto_front
from pneuopt.tuning.racing import Racing

DRIVE = """
[drive]
kind = "force"
[load]
mass = { value = "5 kg", lower = "1 kg", upper = "50 kg" }
[friction]
model = "coulomb"
coulomb = "20 N"
viscous = "40 N*s/m"
smoothing = "5 mm/s"
"""
TUNING = """
[pid]
sample_time = "5 ms"
Kp = "300 N*s/m"
Ki = "5000 N/m"
limits = ["-200 N", "200 N"]
[[reference]]
step = "0.2 m/s"
horizon = "0.3 s"
[[reference]]
step = "-0.1 m/s"
horizon = "0.3 s"
[limits]
settling_time = { max = "1 s", band = "5 %" }
"""
STUDY = """
[study]
drive = "drive.toml"
tuning = "tuning.toml"
[axes]
load.mass = ["2 kg", "4000 g"]
load.force = { from = "0 N", to = "50 N", steps = 2 }
"""
LINE = "study study.toml -o cases.csv --json cases.json --plot map.png"
FRONT = """
[study]
drive = "drive.toml"
tuning = "tuning.toml"
[pareto]
between = ["overshoot", "peak_control"]
lower = "80 N"
points = 3
"""
FRONT_LINE = "study front.toml -o front.csv --json front.json --plot front.png"


def in_threads(function: Callable[..., Any], executor: Executor) -> Callable[..., Any]:
    """A study that starts no processes."""
    return lambda *given, **options: function(*given, **{**options, "executor": executor})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The files of a study, which runs in a thread."""
    for name, text in {"drive": DRIVE, "tuning": TUNING, "study": STUDY}.items():
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    with ThreadPoolExecutor(1) as executor:
        monkeypatch.setattr(study_module, "sweep", in_threads(sweep, executor))
        yield tmp_path


@pytest.fixture
def front(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files of a front, with a method that is good enough for two gains."""
    for gain, unit, (value, low, up) in (("Kp", "N*s/m", (300, 100, 500)), ("Ki", "N/m", (5000, 1000, 8000))):
        free = f'{{ value = "{value} {unit}", lower = "{low} {unit}", upper = "{up} {unit}", free = true }}'
        edit("tuning.toml", f'{gain} = "{value} {unit}"', f"{gain} = {free}")
    edit("tuning.toml", "[limits]", '[limits]\npeak_control = "120 N"')
    edit("tuning.toml", 'max = "1 s"', 'max = "250 ms"')
    (folder / "front.toml").write_text(FRONT, encoding="utf-8")
    monkeypatch.setattr(study_module, "pareto_front", partial(pareto_front, method=Racing(8, 40)))
    return folder


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def edit(name: str, old: str, new: str) -> None:
    text = Path(name).read_text(encoding="utf-8")
    assert old in text
    Path(name).write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.fixture
def tuned(front: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files of a study that tunes each cell over three masses, in threads."""
    edit("study.toml", "[axes]", "tune = true\n[axes]")
    edit("study.toml", "load.force", "# load.force")
    edit("study.toml", '"2 kg", "4000 g"', '"4 kg", "5 kg", "6 kg"')
    edit("tuning.toml", "[limits]", '[minimise]\nsettling_time = { band = "5 %", weight = 1.0 }\n[limits]')
    edit("tuning.toml", 'settling_time = { max = "250 ms", band = "5 %" }', "")
    edit("tuning.toml", "[limits]", '[method]\nkind = "racing"\ntrials = 40\npolish = 0\n[limits]')
    inside = in_threads(sweep_from_neighbours, ThreadPoolExecutor(1))
    monkeypatch.setattr(study_module, "sweep_from_neighbours", inside)
    return front


def test_a_study_tunes_each_cell_from_the_gains_of_its_neighbours(
    tuned: Path, monkeypatch: pytest.MonkeyPatch, parsed: list[str]
) -> None:
    begun = dict[float, float]()

    def cell(sources: dict[str, bytes], drive: Drive, tuning: Path, parameters: ParameterSet) -> dict[str, float]:
        begun[parameters.value("load.mass")] = parameters.value("pid.Kp")
        return tune_cell(sources, drive, tuning, parameters)

    monkeypatch.setattr(study_module, "tune_cell", cell)
    result = run("study study.toml -o cases.csv --json cases.json --plot map.png")
    assert result.exit_code == 0, result.stdout
    assert parsed.count(Path("drive.toml").read_text("utf-8")) == 1
    assert result.stdout.splitlines()[0] == "3 cases, each the worst of 2 references: all settle"
    cases = pd.read_csv("cases.csv").set_index("load.mass [kg]")
    assert begun[5.0] == 300.0
    assert begun[4.0] == begun[6.0] == cases["pid.Kp"][5.0] != 300.0
    worst = cases[["SettlingTime[0 to 0.2] [s]", "SettlingTime[0 to -0.1] [s]"]].max(axis=1)
    np.testing.assert_allclose(cases["objective"], worst)
    assert (cases[["PeakControl[0 to 0.2] [N]", "PeakControl[0 to -0.1] [N]"]] <= 120.0).all().all()
    assert not cases[["again", "breaks"]].any().any()


def test_a_cell_that_breaks_with_its_neighbours_is_searched_again_and_named(
    tuned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = list[float]()

    def cell(_: object, __: object, ___: Path, parameters: ParameterSet) -> dict[str, float]:
        mass = parameters.value("load.mass")
        searched.append(mass)
        long = 0.4 if mass == 6.0 else 0.1
        return {"SettlingTime": long, "Overshoot": 0.0, "objective": long, "found pid.Kp": 200.0, "found pid.Ki": 2e3}

    monkeypatch.setattr(study_module, "tune_cell", cell)
    result = run("study study.toml -o cases.csv")
    assert result.exit_code == 1
    assert result.stdout.splitlines()[0].endswith("1 break with their neighbours")
    assert "load.mass = 6 kg: breaks with its neighbours, also searched from their gains" in result.stdout
    assert searched == [5.0, 4.0, 6.0, 6.0]
    assert pd.read_csv("cases.csv")["breaks"].tolist() == [False, False, True]


def test_a_study_is_shown_written_and_drawn(folder: Path) -> None:
    result = run(LINE)
    assert result.exit_code == 0, result.stdout
    lines = result.stdout.splitlines()
    assert lines[0] == "4 cases, each the worst of 2 references: all settle"
    assert max(map(len, lines)) <= 80
    assert all(words in result.stdout for words in ("load.mass", "load.force", "SettlingTime", "[kg]", "[N]", "[s]"))
    cases = pd.read_csv("cases.csv")
    assert cases["load.mass [kg]"].tolist() == [2, 2, 4, 4]
    assert cases["load.force [N]"].tolist() == [0, 50, 0, 50]
    assert {"SettlingTime[0 to 0.2] [s]", "Overshoot[0 to -0.1] [%]", "Peak[0 to 0.2] [m/s]", "seconds [s]"} <= {*cases}
    worst = cases[["SettlingTime[0 to 0.2] [s]", "SettlingTime[0 to -0.1] [s]"]].max(axis=1)
    assert all(f"{seconds:.4g}" in result.stdout for seconds in worst)
    said = json.loads(Path("cases.json").read_text(encoding="utf-8"))
    assert said["verdict"] == lines[0]
    assert [c["SettlingTime[0 to 0.2]"] for c in said["cases"]] == pytest.approx(cases["SettlingTime[0 to 0.2] [s]"])
    assert {"sha256[study.toml]", "sha256[drive.toml]", "sha256[tuning.toml]"} == said["provenance"].keys()
    assert Path("map.png").stat().st_size > 10_000


def test_the_band_of_the_study_counts_before_the_tunings(folder: Path) -> None:
    run("study study.toml -o wide.csv")
    edit("study.toml", "[axes]", '[metrics]\nband = "1 %"\nshow = ["PhaseMargin", "Ripple", "SettlingTime"]\n[axes]')
    result = run("study study.toml -o narrow.csv")
    assert "PhaseMargin" in result.stdout
    assert "Overshoot" not in result.stdout
    wide, narrow = (pd.read_csv(f"{name}.csv")["SettlingTime[0 to 0.2] [s]"] for name in ("wide", "narrow"))
    assert (narrow.fillna(9.0) > wide).all()


def test_cases_that_fail_or_never_settle_are_rows_and_status_1(folder: Path) -> None:
    edit("study.toml", "load.force = {", 'load.force = ["0 N", "-900 N", "199 N"] # {')
    result = run(LINE)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert lines[0] == "6 cases, each the worst of 2 references: 2 failed, 2 never settle"
    assert "never" in result.stdout
    assert "failed (2 of 6): InputError: the loop cannot start at rest: it needs a command of -900 N" in result.stdout
    cases = pd.read_csv("cases.csv")
    assert cases["error"].notna().tolist() == [False, True, False] * 2
    assert Path("map.png").exists()


def test_a_study_of_nothing_but_failures_is_shown_and_drawn(folder: Path) -> None:
    edit("study.toml", "load.force = {", 'load.force = ["-900 N", "900 N"] # {')
    result = run(LINE)
    assert result.exit_code == 1
    assert result.stdout.startswith("4 cases, each the worst of 2 references: 4 failed")
    assert Path("map.png").exists()


def test_many_cases_are_shown_by_the_worst(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_module, "report_cases", partial(report_cases, most_rows=2))
    result = run("study study.toml -o cases.csv")
    assert "the 2 worst of 4 cases by SettlingTime; -o FILE writes all" in result.stdout
    settling = pd.read_csv("cases.csv")[["SettlingTime[0 to 0.2] [s]", "SettlingTime[0 to -0.1] [s]"]].max(axis=1)
    assert f"{settling.max():.4g}" in result.stdout
    assert f"{settling.min():.4g}" not in result.stdout


def test_an_interrupted_study_keeps_what_is_done(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as executor:
        interrupted = in_threads(sweep, executor)
        monkeypatch.setattr(study_module, "sweep", lambda *a, **k: interrupted(*a, **{**k, "progress": interrupt}))
        result = run(LINE)
    assert result.exit_code == 130
    assert result.stdout.startswith("4 cases, each the worst of 2 references: 3 interrupted")
    assert pd.read_csv("cases.csv")["error"].fillna("").tolist() == ["", *["interrupted"] * 3]
    assert not Path("map.png").exists(), "an interrupted command ends soon, without a figure"
    assert len(Path("cases.csv.journal").read_text("utf-8").splitlines()) == 2
    so_far = pd.read_csv("cases_so_far.csv")
    assert list(so_far) == list(pd.read_csv("cases.csv"))
    assert len(so_far) == 1
    monkeypatch.setattr(study_module, "sweep", in_threads(sweep, ThreadPoolExecutor(1)))
    again = run(LINE)
    assert again.stderr.startswith("warning: cases.csv.journal: 1 of 4 cases are known from an earlier run")
    assert pd.read_csv("cases.csv")["error"].isna().all()
    assert not Path("cases.csv.journal").exists()
    assert not Path("cases_so_far.csv").exists()


def test_one_that_was_not_certified_is_warned_of(folder: Path) -> None:
    with Path("tuning.toml").open("a", encoding="utf-8") as file:
        file.write('[status]\ncode = "interrupted"\nmessage = ""\n')
    assert run("study study.toml").stderr == "warning: tuning.toml: its tuning is NOT converged (interrupted)\n"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("tuning.toml", "none.toml", "none.toml: cannot be read"),
        ("load.mass", "load.mas", "study.toml: [axes]: unknown parameter 'load.mas'; did you mean 'load.mass'"),
        ("2 kg", "60 kg", "study.toml: [axes] axis: load.mass: value 60 kg lies outside its bounds [1, 50]"),
        ("4000 g", "2000 g", "study.toml: [axes] axis load.mass: a value is there twice"),
        ("[axes]", '[metrics]\nshow = ["Oversoot"]\n[axes]', "[metrics] show: unknown metric 'Oversoot'; did you mean"),
        ("[axes]", "[axes]\nfriction.coulomb = ['2 N']", "--plot draws one or two axes, there are 3; leave it out"),
        ("drive.toml", "cases.json", "cases.json: is an input of this command"),
    ],
)
def test_bad_input_gets_one_message_and_writes_nothing(folder: Path, old: str, new: str, said: str) -> None:
    edit("study.toml", old, new)
    before = {p: p.read_bytes() for p in folder.iterdir()}
    result = run(LINE)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ")
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert {p: p.read_bytes() for p in folder.iterdir()} == before


def test_a_tuning_ends_with_the_dither_verdict(folder: Path) -> None:
    free = 'Kp = { value = "300 N*s/m", lower = "200 N*s/m", upper = "400 N*s/m", free = true }'
    edit("tuning.toml", 'Kp = "300 N*s/m"', free)
    dither = '[dither]\nfrequency = "50 Hz"\namplitude = "0.01 N"\n[minimise]\niae = {}\n[limits]'
    edit("tuning.toml", "[limits]", dither)
    edit("tuning.toml", 'max = "1 s"', 'max = "200 ms"')
    result = run("tune drive.toml tuning.toml --json out.json")
    assert "the dither of 0.01 N at 50 Hz is useless, against gains tuned without it" in result.output
    verdict = json.loads(Path("out.json").read_text(encoding="utf-8"))["dither"]
    assert verdict["usefulness"] == "useless"
    assert any("price: ripple" in reason for reason in verdict["reasons"])


def test_a_front_is_shown_written_and_drawn(front: Path) -> None:
    edit("front.toml", "overshoot", "settling_time")
    edit("front.toml", "80 N", "50 N")
    result = run(FRONT_LINE)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0] == "3 designs between SettlingTime and PeakControl: all certified"
    assert max(map(len, lines)) <= 80
    designs = pd.read_csv("front.csv")
    assert (designs["PeakControl [N]"] <= designs["limit [N]"] * (1 + 1e-9)).all()
    assert designs["limit [N]"].iloc[-1] == 50.0
    assert designs["limit [N]"].iloc[0] <= 120.0
    assert designs["SettlingTime [s]"].is_monotonic_increasing
    assert designs["pid.Kp [N*s/m]"].between(100, 500).all()
    assert all(f"{value:.4g}" in result.stdout for value in designs["SettlingTime [s]"])
    said = json.loads(Path("front.json").read_text(encoding="utf-8"))
    assert said["verdict"] == lines[0]
    assert [d["SettlingTime"] for d in said["designs"]] == pytest.approx(designs["SettlingTime [s]"])
    assert said["units"] == {"SettlingTime": "s", "PeakControl": "N", "pid.Kp": "N*s/m", "pid.Ki": "N/m"}
    assert {"sha256[front.toml]", "sha256[drive.toml]", "sha256[tuning.toml]"} == said["provenance"].keys()
    assert Path("front.png").stat().st_size > 10_000


def table(*errors: str) -> pd.DataFrame:
    """A front with designs that are not certified."""
    good = np.array([error == "" for error in errors])
    figures = {n: np.where(good, value, np.nan) for n, value in {"Overshoot": 0.012, "PeakControl": 99.0}.items()}
    limits = {"limit": np.linspace(120.0, 80.0, len(errors)), "pid.Kp": np.where(good, 300.0, np.nan)}
    claims = {f"claimed {n}": value for n, value in figures.items()}
    return pd.DataFrame({**figures, **claims, **limits, "pid.Ki": figures["Overshoot"], "error": errors})


@pytest.mark.parametrize(
    ("errors", "status", "verdict"),
    [
        (("", "NOT converged: no", ""), 1, "1 not certified"),
        (("NOT converged: no", "NOT converged: no"), 1, "2 not certified"),
        (("", "interrupted", "interrupted"), 130, "2 interrupted"),
        (("", "NOT converged: no", "interrupted"), 130, "1 interrupted, 1 not certified"),
    ],
)
def test_designs_that_fail_are_rows_of_a_front(
    front: Path, monkeypatch: pytest.MonkeyPatch, errors: tuple[str, ...], status: int, verdict: str
) -> None:
    monkeypatch.setattr(study_module, "pareto_front", lambda *_, **__: table(*errors))
    result = run(FRONT_LINE)
    assert result.exit_code == status
    assert result.stdout.startswith(f"{len(errors)} designs between Overshoot and PeakControl: {verdict}\n")
    assert result.stdout.count("NOT converged: no") == errors.count("NOT converged: no")
    designs = pd.read_csv("front.csv", keep_default_na=False)
    assert designs["error"].tolist() == list(errors)
    assert [str(share) for share in designs["Overshoot [%]"]] == ["" if error else "1.2" for error in errors]
    assert Path("front.png").exists() == (status != 130), "an interrupted command ends soon, without a figure"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("peak_control", "peek_control", "[pareto] between: unknown requirement 'peek_control'; did you mean 'peak_"),
        ("80 N", "80 mm", "front.toml: [pareto] lower: unit 'mm' does not measure 'N'"),
        ("80 N", "130 N", "[pareto] lower, 130 N, is not below the 120 N that tuning.toml allows under [limits]"),
        ('"overshoot"', '"step_envelope"', "[pareto] between: the tuning has no bounds for step_envelope; add them"),
        ('peak_control"]', 'max_sensitivity"]', "[pareto] lower: unit 'N' does not measure '1'"),
        (
            'peak_control"]\nlower = "80 N"',
            'max_sensitivity"]\nupper = 0.5',
            "[pareto] upper: MaxSensitivity: max must be above 1",
        ),
        ("drive.toml", "front.json", "front.json: is an input of this command"),
    ],
)
def test_a_bad_front_gets_one_message_and_writes_nothing(front: Path, old: str, new: str, said: str) -> None:
    edit("front.toml", old, new)
    before = {p: p.read_bytes() for p in front.iterdir()}
    result = run(FRONT_LINE)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ")
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert {p: p.read_bytes() for p in front.iterdir()} == before


def test_a_front_without_a_free_gain_says_so(front: Path) -> None:
    Path("tuning.toml").write_text(TUNING, encoding="utf-8")
    edit("tuning.toml", "[limits]", '[limits]\npeak_control = "120 N"')
    assert "tuning.toml: no gain is free; mark what to tune with free = true" in run(FRONT_LINE).stderr


def test_a_ripple_beyond_the_band_is_said_beside_the_settling_of_the_mean(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mean settles, the signal as it is never does: a scope would show it."""
    monkeypatch.chdir(tmp_path)
    drive = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "viscous"\nviscous = "40 N*s/m"'
    gain = '{ value = "300 N*s/m", lower = "100 N*s/m", upper = "900 N*s/m", free = true }'
    dither = '[dither]\nfrequency = "50 Hz"\namplitude = "60 N"\n'
    loop = f'[pid]\nsample_time = "2 ms"\nKp = {gain}\nKi = "2000 N/m"\n{dither}[[reference]]\nstep = "0.1 m/s"'
    Path("drive.toml").write_text(drive, encoding="utf-8")
    asked = '[minimise]\nsettling_time = { band = "5 %" }\n[method]\nkind = "racing"\nmembers = 8\ntrials = 20'
    Path("tuning.toml").write_text(f'{loop}\nhorizon = "0.4 s"\n{asked}', encoding="utf-8")
    result = CliRunner().invoke(app, ["tune", "drive.toml", "tuning.toml"])
    assert result.exit_code == 0, result.output
    rows = {line.split()[0]: line.split() for line in result.output.splitlines() if line.split()}
    assert rows["SettlingTime"][1] != "never"
    assert rows["SettlingTimeRaw"][1] == "never"
    assert "ripple" in result.output
    assert "takes the signal itself out of the band of +-5 %" in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--executor somewhere", "executor 'somewhere': give a number of processes, dask, or a scheduler, tcp://"),
        ("--executor 0", "there must be a process at least, got 0"),
        ("--executor dask --time-limit 5", "hold in processes of this machine, not on dask"),
        ("--time-limit -1", "the time limit of a case must be positive, got -1 s"),
        ("--memory-limit 0", "the memory limit of a case must be positive, got 0 MB"),
        ("--resume", "--resume goes on where the file of -o or --json was left: name it"),
        ("-o cases.csv --resume", "cases.csv.journal: there is nothing to resume; leave out --resume"),
    ],
)
def test_bad_options_of_a_study_are_refused(folder: Path, options: str, said: str) -> None:
    result = run(f"study study.toml -q {options}")
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
    assert not Path("cases.csv.journal").exists()


def test_a_changed_file_is_not_resumed(folder: Path) -> None:
    Path("cases.csv.journal").write_text('{"study": {"sha256[study.toml]": "0"}}\n', encoding="utf-8")
    result = run("study study.toml -q -o cases.csv --resume")
    assert result.exit_code == 2
    assert "is of another study, sha256[study.toml], " in " ".join(result.stderr.split())
    assert Path("cases.csv.journal").exists()


def test_a_study_is_written_as_parquet_where_its_file_is_called_so(folder: Path) -> None:
    assert run("study study.toml -q -o cases.csv").exit_code == 0
    assert run("study study.toml -q -o cases.parquet").exit_code == 0
    wide, text = pd.read_parquet("cases.parquet"), pd.read_csv("cases.csv")
    assert list(wide) == list(text)
    numbers = [c for c in text.select_dtypes("number") if c not in ("seconds [s]", "error")]
    assert len(numbers) > 20
    pd.testing.assert_frame_equal(wide[numbers], text[numbers], check_dtype=False, rtol=1e-8)
    assert wide["case"].tolist() == text["case"].tolist()
    assert not Path("cases_so_far.parquet").exists()


def test_samples_are_certified_and_shown(folder: Path) -> None:
    text = Path("study.toml").read_text("utf-8").partition("[axes]")[0]
    text += "[samples]\ncount = 3\n'load.mass' = { distribution = 'normal', spread = '5 %' }\n"
    Path("study.toml").write_text(text, encoding="utf-8")
    result = run("study study.toml -q -o cases.csv")
    assert result.stdout.startswith("3 cases, each the worst of 2 references")
    assert pd.read_csv("cases.csv")["load.mass [kg]"].between(4, 6).all()
    assert run("study study.toml -q --plot shares.png").exit_code == 0
    assert Path("shares.png").stat().st_size > 0


def test_a_batch_is_run_in_lanes_and_the_worst_of_it_are_certified(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("study study.toml -q -o alone.csv")
    text = Path("study.toml").read_text("utf-8")
    Path("study.toml").write_text(text.replace("[study]", "[study]\nbatch = true"), encoding="utf-8")
    monkeypatch.setattr(study_module, "evaluate_batch", in_threads(evaluate_batch, ThreadPoolExecutor(1)))
    result = run("study study.toml -q -o batch.csv --json batch.json")
    assert result.exit_code == 0, result.stdout
    assert result.stdout.splitlines()[0].endswith("certified, all agree")
    assert "largest difference" in result.stdout
    alone, batch = (pd.read_csv(f"{name}.csv") for name in ("alone", "batch"))
    shown = [c for c in map(str, batch) if "Overshoot" in c or "SettlingTime" in c]
    assert len(shown) == 4
    np.testing.assert_allclose(batch[shown], alone[shown], rtol=1e-2, atol=1e-3)
    assert {row["agrees"] for row in json.loads(Path("batch.json").read_text("utf-8"))["checks"]} == {True}
    edit("study.toml", "[axes]", '[metrics]\nshow = ["MaxSensitivity"]\n[axes]')
    refused = " ".join(run("study study.toml -q").stderr.split())
    assert "MaxSensitivity is not read off responses; leave it out, or leave out [study] batch" in refused


def test_processes_do_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("study study.toml -o threads.csv")
    monkeypatch.setattr(study_module, "sweep", sweep)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert run("study study.toml -o processes.csv").exit_code == 0
    one, other = (pd.read_csv(f"{name}.csv").drop(columns="seconds [s]") for name in ("threads", "processes"))
    pd.testing.assert_frame_equal(one, other)


def test_the_sample_time_is_an_axis_each_with_a_loop_of_its_own(folder: Path) -> None:
    before = Path("study.toml").read_text("utf-8").partition("[axes]")[0]
    Path("study.toml").write_text(f"{before}[axes]\npid.sample_time = ['1 ms', '4 ms']\n", encoding="utf-8")
    assert run("study study.toml -q -o cases.csv").exit_code == 0
    cases = pd.read_csv("cases.csv")
    assert cases["pid.sample_time [s]"].tolist() == [0.001, 0.004]
    Path("study.toml").write_text(before + "[table]\nfile = 'times.csv'\n", encoding="utf-8")
    Path("times.csv").write_text("pid.sample_time [ms]\n4\n1\n", encoding="utf-8")
    assert run("study study.toml -q -o table.csv").exit_code == 0
    settling = "SettlingTime[0 to 0.2] [s]"
    assert pd.read_csv("table.csv")[settling].tolist() == cases[settling].tolist()[::-1]
    edit("tuning.toml", 'sample_time = "5 ms"', 'sample_time = "4 ms"')
    Path("times.csv").write_text("load.mass\n5\n", encoding="utf-8")
    assert run("study study.toml -q -o slow.csv").exit_code == 0
    assert pd.read_csv("slow.csv")[settling].tolist() == cases[settling].tolist()[1:]


def test_a_study_tells_which_tolerances_matter(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = Path("study.toml").read_text("utf-8").partition("[axes]")[0] + "[sensitivity]\ncount = 16\nlocal = true\n"
    Path("study.toml").write_text(text + "load.mass = '30 %'\nfriction.viscous = '1 %'\n", encoding="utf-8")
    with ThreadPoolExecutor(1) as executor:
        monkeypatch.setattr(study_sensitivity, "sensitivity", in_threads(sensitivity, executor))
        result = run("study study.toml -q -o shares.csv --json shares.json --plot bars.png")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[0] == "64 points: all certified"
    shares = pd.read_csv("shares.csv").set_index(["figure", "axis"])[["total", "local_share"]].to_dict()
    figure = "SettlingTime[0 to 0.2]"
    assert shares["total"][figure, "load.mass"] > 0.9
    assert shares["total"][figure, "friction.viscous"] < 0.1
    assert shares["local_share"][figure, "load.mass"] > 0.9
    said = json.loads(Path("shares.json").read_text("utf-8"))
    assert len(said["cases"]) == 64
    assert {row["axis"] for row in said["slopes"]} == {"load.mass", "friction.viscous"}
    assert Path("bars.png").stat().st_size > 10_000
    assert not Path("shares.csv.journal").exists()


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("count = 20\nload.mass = '30 %'", "[sensitivity] count must be a power of two, got 20"),
        ("count = 16", '[sensitivity] has no parameter; add "load.mass" = "30 %"'),
        ("local = 1\nload.mass = '30 %'", "[sensitivity] local must be true or false, got 1"),
        ("load.mas = '30 %'", "unknown parameter 'load.mas'"),
        ("load.mass = '30 %'\n[axes]\nload.force = ['1 N']", "a study has cases of one kind"),
    ],
)
def test_a_bad_sensitivity_is_refused(folder: Path, section: str, said: str) -> None:
    text = Path("study.toml").read_text("utf-8").partition("[axes]")[0]
    Path("study.toml").write_text(f"{text}[sensitivity]\n{section}\n", encoding="utf-8")
    result = run("study study.toml -q")
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
