"""`pneuopt check`: the words, the exit status, the figure."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.cli.shared import write_csv
from pneuopt.logs.experiments import Experiment
from tests.cli.test_log_refusals import DRIVE
from tests.logs.bad_logs import BAD_LOGS, swing


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.toml").write_text(DRIVE.replace("20 kg", "2.6 kg"), encoding="utf-8")
    return tmp_path


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def write(log: Experiment, name: str = "run.csv") -> None:
    write_csv(Path(name), log.trajectory, {n: (n, log.unit(n)) for n in log.trajectory})


def test_a_right_log_is_good_and_drawn_whole(folder: Path) -> None:
    write(swing().select(["position", "force"]))
    result = run("check drive.toml run.csv --plot check.png --json check.json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.startswith(
        "nothing is wrong: the logs identify all of 2 free parameters\n\nread\n  run: rows 2 to 4001"
    )
    assert "[load] inclined = false: whether positive motion goes up an incline" in result.stdout
    assert (folder / "check.png").stat().st_size > 10_000
    assert json.loads((folder / "check.json").read_text("utf-8"))["found"] == []


@pytest.mark.parametrize("check", ["motion", "work", "scale", "jumps", "stops"])
def test_what_a_fit_would_refuse_is_status_1(check: str, folder: Path) -> None:
    write(BAD_LOGS[check].select(["position", "force"]))
    result = run("check drive.toml run.csv --plot check.png")
    assert result.exit_code == 1
    assert result.stdout.startswith("a fit would refuse this: ")
    assert "fault in run" in result.stdout
    assert (folder / "check.png").exists()
    assert run("identify drive.toml run.csv -q").exit_code == 2


def test_all_logs_that_cannot_be_read_are_named_and_the_others_checked() -> None:
    write(swing().select(["position", "force"]))
    write(swing().select(["position"]), "b.csv")
    text = Path("run.csv").read_text("utf-8")
    Path("c.csv").write_text(text.replace("position", "postion"), encoding="utf-8")
    Path("d.csv").write_text(text.replace("force [N]", "load cell [N]"), encoding="utf-8")
    result = run("check drive.toml run.csv b.csv c.csv d.csv")
    assert result.exit_code == 2
    errors = result.stderr.splitlines()
    assert len(errors) == 3
    assert "needs the channel 'force'" in errors[0]
    assert "'postion [m]' looks like the channel 'position'" in errors[1]
    assert "columns that are not read: load cell [N]" in errors[2]
    assert result.stdout.startswith("nothing is wrong")


def test_lines_are_no_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    write(BAD_LOGS["stops"].select(["position", "force"]))
    monkeypatch.setenv("COLUMNS", "60")
    result = run("check drive.toml run.csv")
    assert max(map(len, result.stdout.splitlines())) <= 60
    assert "\x1b" not in result.stdout
