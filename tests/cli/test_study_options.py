"""How `pneuopt study` computes its cases, and which it takes."""

import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pneuopt.cli import study as study_module
from pneuopt.cli import study as study_sensitivity
from pneuopt.studies.batch import evaluate_batch
from pneuopt.studies.sensitivity import sensitivity
from pneuopt.studies.sweep import sweep
from tests.cli.test_commands import DRIVE, STUDY, TUNING, edit, in_threads, run


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The files of a study, which runs in a thread."""
    for name, text in {"drive": DRIVE, "tuning": TUNING, "study": STUDY}.items():
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(1) as executor:
        monkeypatch.setattr(study_module, "sweep", in_threads(sweep, executor))
        yield tmp_path


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
