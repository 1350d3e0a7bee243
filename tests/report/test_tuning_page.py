"""`write_report`: a page of each result, with the figures for which there is something to draw."""

from pathlib import Path

import pytest

import pneuopt as po
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import certificate
from pneuopt.files.drive import read_drive
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.results import Shown
from pneuopt.report.page import report_forms
from tests.report.reading import Read, read_page


@pytest.fixture(scope="module")
def fit(axis_logs: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> tuple[IdentificationResult, Experiment]:
    """A fit and its log."""
    from tests.conftest import DRIVE

    folder = tmp_path_factory.mktemp("fit")
    (folder / "run_01.csv").write_text(axis_logs["run_01"], "utf-8")
    (folder / "drive.toml").write_text(DRIVE, "utf-8")
    drive, parameters = read_drive(folder / "drive.toml")
    log = read_log(folder / "run_01.csv")
    return identify(drive.system(), log, parameters), log


@pytest.fixture
def loop() -> tuple[ClosedLoop, ParameterSet]:
    made = ClosedLoop(SecondOrder().system(), PID(limits=False))
    return made, made.parameters.with_values({"pid.Kp": 0.02, "pid.Ki": 0.1, "pid.Kd": 5e-4, "pid.Tf": 1e-3})


def headings(read: Read) -> list[str]:
    return [words for tag, words in read.words if tag == "h2"]


def test_a_fit_alone_has_tables_and_no_figure_of_its_logs(
    fit: tuple[IdentificationResult, Experiment], tmp_path: Path
) -> None:
    po.write_report(fit[0], tmp_path / "fit.html")
    read = read_page(tmp_path / "fit.html")
    assert headings(read) == ["Estimates", "Agreement with the logs", "Known values", "Provenance"]
    assert "load.force 0 N" in read.text, "what was given"
    assert "load.mass 5 kg" not in read.text, "a start is not"
    assert len(read.named("figure")) == 1, "the correlation"


def test_a_held_out_log_is_predicted(fit: tuple[IdentificationResult, Experiment], tmp_path: Path) -> None:
    result, log = fit
    drive = ForceDrive(Coulomb())
    po.write_report(result, tmp_path / "a.html", title="A & B", model=drive, experiments=log, held_out=[log])
    read = read_page(tmp_path / "a.html")
    assert ("h1", "A & B") in read.words
    wanted = ["Estimates", "Agreement with the logs", "Held-out runs", "Friction", "Residuals", "Known values"]
    wanted += ["Data", "Provenance"]
    assert headings(read) == wanted
    with pytest.raises(InputError, match="held-out logs are predicted with the model"):
        po.write_report(result, tmp_path / "b.html", held_out=log)
    assert not (tmp_path / "b.html").exists()


def test_a_certificate_has_steps_margins_and_forms(loop: tuple[ClosedLoop, ParameterSet], tmp_path: Path) -> None:
    made, parameters = loop
    found = certificate(made, Step(1.0), parameters)
    place = tmp_path / "a.html"
    po.write_report(found, place, model=made, references=Step(1.0), parameters=parameters)
    read = read_page(place)
    assert headings(read) == ["Metrics", "Gains in every form", "Margins", "The loop", "Try it"]
    assert len(read.named("figure")) == 3
    with pytest.raises(InputError, match="give parameters with the loop"):
        po.write_report(found, place, model=made, references=Step(1.0))
    with pytest.raises(InputError, match="with its references"):
        po.write_report(found, place, model=made, parameters=parameters)


def test_forms_are_those_of_the_conversions_and_a_form_that_does_not_exist_says_so(
    loop: tuple[ClosedLoop, ParameterSet],
) -> None:
    made, parameters = loop
    text = report_forms(made.controller, parameters).to_text(200)
    for words in ("Ki 0.1 V/m", "Ti 200 ms", "Td 25 ms", "N 25", "K 0.0170502"):
        assert words in text, text
    text = report_forms(made.controller, parameters.with_values({"pid.Ki": 1.0})).to_text(200)
    assert "no series form has these gains" in text


def test_any_other_result_has_its_summary(tmp_path: Path) -> None:
    class Found(Shown):
        def summary(self) -> Report:
            return Report((Line("nothing is wrong"), Line("at all")))

    po.write_report(Found(), tmp_path / "a.html")
    read = read_page(tmp_path / "a.html")
    assert ("h1", "Found") in read.words
    assert read.words.index(("p", "nothing is wrong")) < read.words.index(("h2", "Result"))
    with pytest.raises(InputError, match="a report is written of a result, got dict"):
        po.write_report({}, tmp_path / "b.html")  # type: ignore[arg-type]
