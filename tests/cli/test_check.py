"""`pneuopt check`: the words, the exit status, the figure."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli.app import app
from pneuopt.cli.shared import write_csv
from pneuopt.logs.experiment import Experiment
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
    plain = run("check drive.toml run.csv").stdout
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "60")
    wide = run("check drive.toml run.csv").stdout
    assert max(map(len, wide.splitlines())) <= 60
    assert wide.split() == plain.split()


def mend(name: str) -> Result:
    return run(f"check drive.toml {name} --fix mended")


@pytest.mark.parametrize(
    ("check", "said", "verdict"),
    [
        ("work", "all 4000 rows: force multiplied by -1", "nothing is wrong"),
        ("scale", "all 4000 rows: position multiplied by 0.001", "nothing is wrong"),
        ("jumps", "rows 1503 to 1601 (99 in all): cells of position emptied", "a fit takes this, with 1 note"),
        ("stops", "left out, at an end stop", "a fit takes this, with 1 note"),
    ],
)
def test_a_fault_is_mended_by_its_rule_and_then_gone(check: str, said: str, verdict: str, folder: Path) -> None:
    write(BAD_LOGS[check].select(["position", "force"]))
    old = Path("run.csv").read_bytes()
    (folder / "mended").mkdir()
    result = mend("run.csv")
    assert result.exit_code == 0
    assert said in result.stdout
    assert f"the mended logs: {verdict}: the logs identify all" in result.stdout
    assert Path("run.csv").read_bytes() == old
    assert said in Path("mended/run.toml").read_text("utf-8")
    assert run("check drive.toml mended/run.csv").exit_code == 0


def test_exchanged_columns_are_found_by_trying_and_mended(folder: Path) -> None:
    log = swing().select(["position", "force"]).trajectory
    write(Experiment(log.with_columns({"position": log["force"], "force": log["position"]})))
    (folder / "mended").mkdir()
    result = mend("run.csv")
    words = " ".join(result.stdout.split())
    assert "with the columns of position and force exchanged nothing is wrong" in words
    assert "the mended logs: nothing is wrong" in words
    assert result.exit_code == 0


def test_an_input_is_never_written_over(folder: Path) -> None:
    write(BAD_LOGS["work"].select(["position", "force"]))
    old = Path("run.csv").read_bytes()
    result = run("check drive.toml run.csv --fix .")
    assert result.exit_code == 2
    assert "is there already" in " ".join(result.stderr.split())
    assert Path("run.csv").read_bytes() == old


def test_what_no_rule_mends_is_said(folder: Path) -> None:
    write(swing().select(["position"]))
    (folder / "mended").mkdir()
    result = mend("run.csv")
    assert result.exit_code == 2
    assert "not mended: run: the model needs the channel 'force'" in result.stderr
    assert not list((folder / "mended").iterdir())


def test_two_logs_of_one_name_are_not_written_over_each_other(folder: Path) -> None:
    (folder / "other").mkdir()
    write(swing().select(["position", "force"]))
    write(swing().select(["position", "force"]), "other/run.csv")
    result = run("check drive.toml run.csv other/run.csv --fix mended")
    assert result.exit_code == 2
    assert "another log has its name" in result.stderr
    assert not (folder / "mended").exists()
