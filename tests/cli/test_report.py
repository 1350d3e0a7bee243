"""`--report`: every command's page says first how it ended, and stands or falls as a whole."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from pneuopt.cli import identify as identify_module
from pneuopt.cli import tune as tune_module
from pneuopt.cli.app import app
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate, relevant_units
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.tune import tune
from tests.report.reading import Read, read_page


def run(*words: str) -> Result:
    return CliRunner().invoke(app, words, catch_exceptions=False)


def page(name: str = "page.html") -> Read:
    read = read_page(Path(name))
    assert Path(name).stat().st_size < 2e6
    return read


def headings(read: Read) -> list[str]:
    return [words for tag, words in read.words if tag == "h2"]


def verdict(read: Read) -> str:
    tags = [name for name, _ in read.tags]
    return read.words[[tag for tag, _ in read.words].index("h1") + 1][1] if "h1" in tags else ""


def test_a_fit_has_its_page(folder: Path) -> None:
    result = run("identify", "drive.toml", "run_01.csv", "run_02.csv", "--report", "page.html", "-q")
    assert result.exit_code == 0, result.output
    assert "wrote page.html" in result.stdout
    read = page()
    assert verdict(read).startswith("converged: ")
    wanted = ["Estimates", "Agreement with the logs", "Friction", "Residuals", "Known values", "Data", "Provenance"]
    assert headings(read) == wanted
    for words in ("load.mass", "friction.coulomb", "95 % interval", "run_01", "run_02", "drive.toml"):
        assert words in read.text, words
    hashes = [words for tag, words in read.words if tag == "td" and len(words) == 64]
    assert len(hashes) == 3, "two logs and the drive's file"
    assert len(read.named("figure")) == 4


def test_a_held_out_log_is_predicted_in_the_report(folder: Path) -> None:
    line = ["identify", "drive.toml", "run_01.csv", "--held-out", "run_02.csv", "-q"]
    result = run(*line, "--report", "page.html")
    assert result.exit_code == 0, result.output
    read = page()
    assert headings(read)[2] == "Held-out runs"
    assert ("th", "run_02") in read.words
    hashes = [words for tag, words in read.words if tag == "td" and len(words) == 64]
    assert len(hashes) == 3
    assert run(*line).exit_code == 2


def test_logs_that_are_refused_have_a_page_that_says_so_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise LogError("run_01: the force has the wrong sign")

    monkeypatch.setattr(identify_module, "identify", refuse)
    result = run("identify", "drive.toml", "run_01.csv", "--report", "page.html", "-o", "fit.toml", "-q")
    assert result.exit_code == 2
    read = page()
    assert verdict(read) == "refused: nothing was identified"
    assert "run_01: the force has the wrong sign" in read.text
    assert "What shows it" in headings(read)
    assert not Path("fit.toml").exists()


def test_a_fit_that_does_not_converge_says_so_first(folder: Path) -> None:
    result = run("identify", "drive.toml", "run_01.csv", "--budget", "1e-6", "--report", "page.html", "-q")
    assert result.exit_code == 1
    assert verdict(page()).startswith("NOT converged")


def test_hostile_names_of_files_and_columns_are_text(folder: Path) -> None:
    if os.name == "nt":
        pytest.skip("Windows has no such names")
    name = "<img src=x onerror=alert(1)> $\\frac$ {{7*7}}"
    text = Path("run_01.csv").read_text("utf-8").replace("force [N]", "<script>alert(2)</script>")
    Path(f"{name}.csv").write_text(text, "utf-8")
    sidecar = '[columns]\nforce = { column = "<script>alert(2)</script>", unit = "N" }\n'
    Path(f"{name}.toml").write_text(sidecar, "utf-8")
    shutil.copy("drive.toml", "<b>drive.toml")
    result = run("identify", "<b>drive.toml", f"{name}.csv", "--report", "page.html", "-q")
    assert result.exit_code == 0, result.output
    read = page()
    assert f"Identification of <b>drive.toml from {name}.csv" in read.text
    assert ("td", "<script>alert(2)</script>") in read.words
    assert not read.named("img")
    assert run("check", "<b>drive.toml", f"{name}.csv", "--report", "page.html").exit_code == 0
    read = page()
    assert f"Check of <b>drive.toml with {name}.csv" in read.text
    assert not [*read.named("img"), *read.named("b")]


def test_a_check_has_its_page(folder: Path) -> None:
    Path("broken.csv").write_text("a,b\n1,2\n", "utf-8")
    result = run("check", "drive.toml", "run_01.csv", "broken.csv", "--report", "page.html")
    assert (result.exit_code, "wrote page.html" in result.stdout) == (2, True), result.output
    read = page()
    assert headings(read) == ["Figures", "Result", "Data", "Provenance"]
    assert verdict(read) == result.stdout.splitlines()[0]
    assert any(words.startswith("not read: broken.csv: ") for tag, words in read.words if tag == "li")
    assert "friction.coulomb" in read.text
    assert len(read.named("figure")) >= 1


def test_a_tuning_has_its_page(folder: Path) -> None:
    result = run("tune", "drive.toml", "tuning.toml", "-o", "tuned.toml", "--report", "page.html", "-q")
    assert result.exit_code == 0, result.output
    assert result.stdout.endswith("Next: pneuopt export drive.toml tuned.toml --to st    (for a PLC; or --help)\n")
    read = page()
    assert ("td", "pneuopt export drive.toml tuned.toml --to siemens") in read.words
    assert verdict(read).startswith("converged: ")
    wanted = ["Gains", "Before and after", "Gains in every form", "To the controller", "Margins", "Other plants"]
    wanted += ["The loop", "Provenance"]
    assert headings(read) == [*wanted, "Try it"]
    for words in ("holds on ", "standard (ISA)", "series", "at rest", "Ms", "was"):
        assert words in read.text
    assert len(read.named("figure")) == 3


def test_a_tuning_that_is_refused_says_so_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(loop: ClosedLoop, references: Sequence[Step], parameters: ParameterSet, **_: object) -> TuningResult:
        metrics = evaluate(loop, references, parameters)
        status = Status(Code.NOT_CERTIFIED, ("hunts at 0 to 0.2", "widen the limits"))
        empty = pd.DataFrame()
        units, best = relevant_units(loop), {"pid.Kp": 321.0}
        return TuningResult(parameters, metrics, metrics, empty, empty, (), status, {}, {}, units=units, best=best)

    monkeypatch.setattr(tune_module, "tune", refuse)
    result = run("tune", "drive.toml", "tuning.toml", "--report", "page.html", "-q")
    assert result.exit_code == 1, result.output
    read = page()
    assert verdict(read).startswith("NOT converged")
    assert headings(read)[:2] == ["What was tried", "The gains that stand"]
    assert "the gains of tuning.toml stand; rejected: pid.Kp 321 N*s/m" in read.text


def test_a_simulated_loop_names_its_defects_and_the_limits_that_it_breaks(folder: Path) -> None:
    text = Path("tuning.toml").read_text("utf-8")
    Path("tuning.toml").write_text(text.replace('overshoot = "10 %"', 'overshoot = "0.01 %"'), "utf-8")
    result = run("simulate", "drive.toml", "tuning.toml", "--report", "page.html", "-q")
    assert result.exit_code == 0, result.output
    read = page()
    assert verdict(read).startswith("simulated: ")
    assert "Overshoot" in read.text
    assert "breaks its limit of 0.01 at 0 to 0.2" in read.text


def test_a_prediction_has_its_page(folder: Path) -> None:
    result = run("simulate", "drive.toml", "--log", "run_01.csv", "--report", "page.html", "-q")
    assert result.exit_code == 0, result.output
    read = page()
    assert verdict(read).startswith("predicted in open loop: NRMSE at most ")
    assert headings(read) == ["Agreement with the logs", "Residuals", "Data", "Provenance"]


def test_a_study_has_its_page(folder: Path) -> None:
    study = '[study]\ndrive = "drive.toml"\ntuning = "tuning.toml"\n[axes]\nload.mass = ["4 kg", "6 kg"]\n'
    Path("study.toml").write_text(study, "utf-8")
    result = run("study", "study.toml", "--report", "page.html", "--executor", "1", "-q")
    read = page()
    assert verdict(read) == result.stdout.splitlines()[0]
    assert headings(read) == ["Cases", "The design", "Provenance"]
    assert "pid.Kp 100 N*s/m" in read.text, "the gains that all cases share"
    assert len(read.named("figure")) == 1


def test_an_interrupted_tuning_has_a_page_without_figures(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("page.html").write_text("mine", "utf-8")

    def stop(*args: object, **keywords: object) -> object:
        def interrupt(_: str) -> None:
            raise KeyboardInterrupt

        return tune(*args, **{**keywords, "progress": interrupt})  # type: ignore[arg-type]

    monkeypatch.setattr(tune_module, "tune", stop)
    result = run("tune", "drive.toml", "tuning.toml", "--report", "page.html", "-q")
    assert result.exit_code == 130, result.output
    assert Path("page.html").read_text("utf-8") == "mine"
    read = page("page_interrupted.html")
    assert "interrupted" in verdict(read)
    assert not read.named("figure")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("identify drive.toml run_01.csv --report page.pdf", "page.pdf: a report is a page of HTML; name it so"),
        ("identify drive.toml run_01.csv --report none/page.html", "none/page.html: the folder does not exist"),
        ("tune drive.toml tuning.toml --report page.html --json page.html", "is named for two outputs"),
    ],
)
def test_a_page_that_cannot_be_written_is_refused_before_the_work(folder: Path, line: str, said: str) -> None:
    before = sorted(folder.iterdir())
    result = run(*line.split())
    assert result.exit_code == 2
    assert said in result.stderr
    assert sorted(folder.iterdir()) == before
