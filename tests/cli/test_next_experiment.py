"""`pneuopt next-experiment`: a run from a file, written as a controller plays it."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.logs.read_log import read_log
from tests.report.reading import read_page

DRIVE = Path(__file__).parents[2] / "data/force_rig/drive.toml"
USUAL = ("--duration", "0.5s", "--sample-time", "2ms", "--limit", "force=-150N..150N", "--limit", "position=-1m..1m")


def run(*words: str) -> Result:
    return CliRunner(env={"COLUMNS": "120"}).invoke(
        app, ["next-experiment", str(DRIVE), *words], catch_exceptions=False
    )


def test_a_run_is_planned_and_written(tmp_path: Path) -> None:
    place, figure = tmp_path / "run.csv", tmp_path / "run.png"
    result = run(
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
    result = run(*USUAL, "-q", *words)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


def test_each_run_has_a_file_that_is_named(tmp_path: Path) -> None:
    words = ("--noise", "position=20um", "--budget", "1", "-q", "--runs", "2", "-o", str(tmp_path / "run.csv"))
    result = run(*USUAL, *words)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run_1.csv", "run_2.csv"]
    assert "run_2.csv" in result.output.replace("\n", "")
