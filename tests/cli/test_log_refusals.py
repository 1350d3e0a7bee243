"""`pneuopt identify` of a log that contradicts itself: the words at 80 columns, the exit status, the figure."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli import identify as identify_module
from pneuopt.cli.app import app
from pneuopt.cli.shared import write_csv
from pneuopt.logs.experiment import Experiment
from tests.logs.bad_logs import BAD_LOGS

DRIVE = """
[drive]
kind = "force"
[load]
mass = "20 kg"
[friction]
model = "coulomb"
coulomb = { value = "20 N", free = true }
viscous = { value = "40 N*s/m", free = true }
smoothing = "5 mm/s"
"""
REFUSED = ("motion", "work", "scale", "jumps", "stops", "mass")
"""The checks that a force drive's log meets."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.toml").write_text(DRIVE, encoding="utf-8")
    return tmp_path


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def write(log: Experiment) -> None:
    write_csv(Path("run.csv"), log.trajectory, {n: (n, log.unit(n)) for n in log.trajectory})


@pytest.mark.parametrize("check", REFUSED)
def test_a_refusal_is_said_in_whole_words_and_drawn(check: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(BAD_LOGS[check].select(["position", "force"]))
    plain = run("identify drive.toml run.csv -q")
    assert plain.exit_code == 2
    assert plain.stderr.startswith("error: run: ")
    assert f"--accept {check}; --plot refusal.png draws it" in plain.stderr
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    wide = run("identify drive.toml run.csv -q").stderr
    assert max(map(len, wide.splitlines())) <= 80
    assert " ".join(wide.split()) == " ".join(plain.stderr.split())
    drawn = run("identify drive.toml run.csv -q --json fit.json --plot fit.png")
    assert (drawn.exit_code, drawn.stdout) == (2, "wrote fit_refused.png\n")
    assert "draws it" not in drawn.stderr
    assert (folder / "fit_refused.png").stat().st_size > 10_000
    assert not (folder / "fit.json").exists()


def test_a_doubt_is_said_before_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A force that reads off by 20 N; the drive's load.force is stated as zero, its mass as it is."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(identify_module, "identify", stop)
    Path("drive.toml").write_text(DRIVE.replace("20 kg", "2.6 kg"), encoding="utf-8")
    write(BAD_LOGS["offset"].select(["position", "force"]))
    result = run("identify drive.toml run.csv -q")
    assert "warning: before the fit: run: the drive pushes with 20 N more than the motion needs" in result.stderr
    assert "free load.force, which takes it" in result.stderr


def test_a_refusal_that_no_signal_shows_is_said_only(folder: Path) -> None:
    log = BAD_LOGS["work"]
    write(Experiment(log.trajectory.rows(0, 5)))
    assert run("identify drive.toml run.csv -q --plot fit.png").exit_code == 2
    assert not list(folder.glob("*.png"))
