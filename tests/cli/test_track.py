"""`pneuopt track`: logs of five weeks whose friction rises, and what that does to a tuned loop.

`pneuopt next-experiment`: a run from a file, written as a controller plays it.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.logs.read_log import read_log
from tests.cli.test_check import folder, run, write
from tests.logs.bad_logs import RIGHT, T, swing
from tests.report.reading import read_page

__all__ = ["folder"]  # the fixture: a drive.toml in a folder of its own
TUNED = """
[pid]
sample_time = "1 ms"
Kp = "300 N*s/m"
Ki = "4000 N/m"
[[reference]]
step = "0.2 m/s"
horizon = "0.6 s"
[minimise]
settling_time = { band = "2 %" }
[limits]
peak_control = "62 N"
"""
WEEKS = 5


@pytest.fixture
def logs(folder: Path) -> Path:
    rng = np.random.default_rng(4)
    for week in range(WEEKS):
        more = 30 * (0.12 * week + 0.002 * float(rng.standard_normal()))
        force = RIGHT["force"] + more * np.sign(np.cos(2 * np.pi * T))
        write(swing(force=force).select(["position", "force"]), f"run_2026-03-{1 + 7 * week:02}.csv")
    return folder


def test_a_drift_is_status_1_and_says_when_to_tune_again(logs: Path, parsed: list[str]) -> None:
    Path("tuned.toml").write_text(TUNED, encoding="utf-8")
    files = "--tuned tuned.toml -o history.csv --json drift.json --plot drift.png --report page.html"
    result = run(f"track drive.toml run_2026*.csv --parameter friction.coulomb -q {files}")
    said = " ".join(result.stdout.split())
    assert (result.exit_code, result.stderr) == (1, "")
    assert parsed.count(Path("drive.toml").read_text("utf-8")) == 1
    assert said.startswith("drift of friction.coulomb: identify and tune again")
    assert "tune again: the tuned loop will fail by 2026-04-19 (PeakControl)" in said
    history = pd.read_csv("history.csv")
    assert history["date"].tolist() == [f"2026-03-{1 + 7 * week:02}" for week in range(WEEKS)]
    assert history["value"].to_numpy() == pytest.approx(30 * (1 + 0.12 * np.arange(WEEKS)), rel=0.05)
    written = json.loads(Path("drift.json").read_text("utf-8"))
    assert written["drift"][0]["percent_a_week"] == pytest.approx(12, abs=1)
    assert [row["ahead"] for row in written["design"]] == [False] * WEEKS + [True] * 4
    assert written["design"][-1]["PeakControl"] > written["design"][0]["PeakControl"]
    assert Path("drift.png").stat().st_size > 10_000
    read = read_page(Path("page.html"))
    assert "Tracking of drive.toml with 5 logs" in read.text
    assert "tune again: the tuned loop will fail by 2026-04-19" in read.text
    assert len(read.named("figure")) == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("track drive.toml run_2026*.csv --dates 2026-03-01", "--dates has 1 dates for 5 logs"),
        ("track drive.toml run_2026*.csv --parameter friction.colomb", "did you mean 'friction.coulomb'"),
        ("track drive.toml run_2026*.csv --drift 0", "give the percent a week that is to be seen"),
        ("track drive.toml missing.csv", "missing.csv: cannot be read (No such file or directory)"),
        ("track drive.toml other.csv", "neither its time column nor its name says when it was taken"),
    ],
)
def test_what_cannot_be_tracked_is_said_before_the_work(line: str, message: str, logs: Path) -> None:
    write(swing().select(["position", "force"]), "other.csv")
    result = run(line)
    assert (result.exit_code, message in result.stderr) == (2, True)


DRIVE = Path(__file__).parents[2] / "data/force_rig/drive.toml"
USUAL = ("--duration", "0.5s", "--sample-time", "2ms", "--limit", "force=-150N..150N", "--limit", "position=-1m..1m")


def run_of_next_experiment(*words: str) -> Result:
    return CliRunner(env={"COLUMNS": "120"}).invoke(
        app, ["next-experiment", str(DRIVE), *words], catch_exceptions=False
    )


def test_a_run_is_planned_and_written(tmp_path: Path) -> None:
    place, figure = tmp_path / "run.csv", tmp_path / "run.png"
    result = run_of_next_experiment(
        *USUAL,
        "--noise",
        "position=20um",
        "--budget",
        "2",
        "-q",
        "--target",
        "friction.*",
        "-o",
        str(place),
        "--report",
        str(tmp_path / "run.html"),
        "--plot",
        str(figure),
    )
    assert result.exit_code == 0, result.output
    assert "a run of 500 ms gives" in result.output
    force = read_log(place).trajectory["force"]
    assert len(force) == 250
    assert "a run of 500 ms gives" in read_page(tmp_path / "run.html").text
    assert abs(force).max() <= 150
    assert figure.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--noise", "position=20"), "--noise position"),
        (("--noise", "positon=20um"), "did you mean 'position'"),
        (("--limit", "speed=1m/s"), "--limit speed=1m/s: give both ends"),
        (("--limit", "speed"), "--limit speed: give a signal and its value"),
        ((), "noise: give the standard deviation of each output"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(words: tuple[str, ...], message: str) -> None:
    result = run_of_next_experiment(*USUAL, "-q", *words)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


def test_each_run_has_a_file_that_is_named(tmp_path: Path) -> None:
    place = tmp_path / "runs"
    place.mkdir()
    words = ("--noise", "position=20um", "--budget", "1", "-q", "--runs", "2", "-o", str(place / "run.csv"))
    result = run_of_next_experiment(*USUAL, *words)
    assert sorted(p.name for p in place.iterdir()) == ["run_1.csv", "run_2.csv"]
    assert "run_2.csv" in result.output.replace("\n", "")
