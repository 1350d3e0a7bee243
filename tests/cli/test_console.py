import io
import math
import re
import threading
from collections.abc import Callable

import pandas as pd
import pytest
from rich.console import Console

from pneuopt.cli.shared import ScreenStyle, make_console, progress, show_report, show_sentence
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import report_margins
from pneuopt.evaluation.dither import DitherEffect, DitherVerdict, Usefulness
from pneuopt.evaluation.evaluate import metric_limits, metric_units, relevant_units, report_metrics
from pneuopt.evaluation.plants import expected_plants
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    MaxComplementarySensitivity,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Requirement,
    SettlingTime,
    StepEnvelope,
)
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.quantities.report import Line, Report, Table, Tone, text_columns
from pneuopt.tuning.result import report_active, report_gains
from pneuopt.tuning.validation import validate_design


def test_metrics_stand_beside_what_is_allowed() -> None:
    """As the user wrote it: percent, and margins from below; the longest name in one piece on 80 columns."""
    loop = ClosedLoop(FirstOrder().system(), PID())
    figures = {"Overshoot": 3.2, "StepEnvelope": 0.9, "MaxComplementarySensitivity": 1.1, "PhaseMargin": 61.5}
    table = pd.DataFrame({"0 to 0.05": figures, "0 to 0.25": figures})
    limits: list[Requirement] = [
        Overshoot(0.05),
        StepEnvelope(((0.0, -0.1, 1.1),)),
        PhaseMargin(60.0),
        MaxComplementarySensitivity(),
    ]
    out = report_metrics(table, relevant_units(loop), limits=metric_limits(limits)).to_text(80)
    rows = [line.split() for line in out.splitlines()]
    assert ["Overshoot", "3.2", "3.2", "<=", "5", "%"] in rows
    assert ["StepEnvelope", "0.9", "0.9", "<=", "1"] in rows
    assert ["PhaseMargin", "61.5", "61.5", ">=", "60", "deg"] in rows
    assert ["MaxComplementarySensitivity", "1.1", "1.1"] in rows
    assert max(map(len, out.splitlines())) <= 80


def test_every_kind_of_requirement_is_shown() -> None:
    units = metric_units(ClosedLoop(FirstOrder().system(), PID()))
    assert {kind.__name__ for kind in REQUIREMENT_KINDS} <= set(units)


@pytest.mark.parametrize(
    ("form", "values", "said"),
    [
        (Form.PARALLEL, {"pid.Kp": 2.0, "pid.Ki": 4.0}, "standard form: Kp 2, Ti 0.5 s, no derivative"),
        (Form.STANDARD, {"pid.Kp": 2.0, "pid.Ti": 0.5}, "parallel form: Kp 2, Ki 4, no derivative"),
        (
            Form.SERIES,
            {"pid.K": 2.0, "pid.Ti": 0.5, "pid.Td": 0.25, "pid.Tf": 0.02},
            "parallel form: Kp 3, Ki 4, Kd 0.48, Tf 0.02 s",
        ),
    ],
)
def test_gains_are_shown_in_another_form_too(form: Form, values: dict[str, float], said: str) -> None:
    given = ClosedLoop(FirstOrder().system(), PID(form=form)).parameters.with_values(values)
    assert said in report_gains({}, given).to_text(80)


def test_a_dithers_verdict_is_shown_with_its_reasons() -> None:
    table = pd.DataFrame({"without": {"Ripple": 0.0}, "with": {"Ripple": 1e-3}})
    effect = DitherEffect(0.001, 159.0)
    verdict = DitherVerdict(Usefulness.USELESS, ("nothing changes", "price: air"), table, effect, "the same gains", "V")
    lines = verdict.summary().to_text(80).splitlines()
    assert lines[0] == "the dither of 0.001 V at 159 Hz is useless, against the same gains"
    assert [line.strip() for line in lines[1:]] == ["nothing changes", "price: air"]


@pytest.mark.parametrize("amplitude", [0.0, 0.01])
def test_a_limit_cycle_is_shown_where_there_is_one(amplitude: float) -> None:
    rows = {"SettlingTime": 0.1, "LimitCycleAmplitude": amplitude, "LimitCycleFrequency": 2.0, "AirUse": 1.5}
    loop = ClosedLoop(FirstOrder().system(), PID())
    out = report_metrics(pd.DataFrame({"0 to 1": rows}), relevant_units(loop)).to_text(80)
    assert ("LimitCycleFrequency" in out) == (amplitude > 0)
    assert "l(ANR)" in out


def screen(show: Callable[[Console], None], *, terminal: bool = False) -> str:
    console = Console(file=io.StringIO(), width=80, force_terminal=terminal, no_color=True, highlight=False)
    show(console)
    return re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue())  # type: ignore[attr-defined]


def test_figures_before_stand_in_columns_of_their_own_on_80_columns() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID())
    now = {"SettlingTime": 0.08874, "Overshoot": 3.1e-6, "MaxSensitivity": 1.077, "PeakControl": 149.6}
    then = {"SettlingTime": math.nan, "Overshoot": 23.734, "MaxSensitivity": 1.0374, "PeakControl": 68.84}
    frames = [pd.DataFrame({"0 to 0.05": row, "0 to 0.25": row}) for row in (now, then)]
    beside, limits = ("was", frames[1]), metric_limits([PeakControl(150.0)])
    text = report_metrics(frames[0], relevant_units(loop), beside=beside, limits=limits).to_text(80)
    rows = [line.split() for line in text.splitlines()]
    assert max(map(len, text.splitlines())) <= 80
    assert ["SettlingTime", "0.08874", "never", "0.08874", "never", "s"] in rows
    assert ["PeakControl", "149.6", "68.8", "149.6", "68.8", "<=", "150", "V"] in rows
    assert "< 0.001" in text, "rounding errors are not figures"


def test_what_holds_a_design_back_is_one_sentence() -> None:
    table = pd.DataFrame({"room": [0.0171, 0.5], "active": [True, False]}, index=["Overshoot", "PeakControl"])
    loop = ClosedLoop(FirstOrder().system(), PID())
    tuned = loop.parameters.with_values({"pid.Kp": 9.0}).with_bounds({"pid.Kp": (1.0, 9.0)}).freed("pid.Kp")
    text = report_active(table, ("Overshoot", "pid.Kp"), tuned).to_text(80)
    assert text == "held back by: Overshoot (1.7 % of room left), pid.Kp (at its bound)"


def test_margins_name_their_operating_point() -> None:
    rows = [("0 to 1", "at rest", 1.2, 65.0), ("0 to 1", "sliding", 3.5, 17.0), ("0 to 2", "sliding", 3.1, 19.0)]
    table = pd.DataFrame(rows, columns=["case", "point", "MaxSensitivity", "PhaseMargin"])
    text = report_margins(table).to_text(120)
    assert text == "MaxSensitivity, the worst of all cases: 1.2 at rest, 3.5 sliding; phase margin at least 17 deg"


def test_a_derivative_that_does_nothing_has_no_riddle_of_a_time() -> None:
    gains = {"pid.Kp": 793.4, "pid.Ki": 28950.0, "pid.Kd": 1e-6, "pid.Tf": 0.05}
    given = ClosedLoop(FirstOrder().system(), PID()).parameters.with_values(gains)
    text = report_gains({}, given).to_text(120)
    assert "next to no derivative (Kd/Tf is 2.5e-06 % of Kp)" in text
    assert "Td" not in text


def test_sentences_end_between_words_on_a_terminal_and_stay_whole_in_a_pipe() -> None:
    text = "in the tuning's file: " + ", ".join(f'"load.parameter_{k}" = "5 %"' for k in range(5))
    assert screen(lambda c: show_sentence(c, text)) == text + "\n"
    lines = screen(lambda c: show_sentence(c, text, indent=2), terminal=True).splitlines()
    assert len(lines) > 1
    assert max(map(len, lines)) <= 80
    assert all(line.startswith("    ") for line in lines[1:])
    assert " ".join(line.strip() for line in lines) == text


def test_the_plants_are_told_verdict_first_and_what_would_help() -> None:
    loop = ClosedLoop(Integrator().system(), PID(limits=False))
    design = loop.parameters.with_values({"plant.gain": 1.0, "pid.Kp": 5.0})
    design = design.with_bounds({"pid.Kp": (0.1, 50.0)}).freed("pid.Kp")
    asked, step = SettlingTime(max=0.79), Step(1.0, horizon=2.0)
    found = validate_design(loop, step, design, minimise=asked, scenarios=expected_plants(design))
    assert repr(found).startswith(f"holds on {found.held} of 100 plants: SettlingTime breaks on {100 - found.held}\n")
    text = "\n".join(line for line, _ in found.summary().lines(None))
    assert "assumed tolerances: plant.gain +-5 %\n" in text
    assert text.endswith("these gains hold on 100 of 100")


def test_in_a_pipe_progress_is_a_line_every_few_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pneuopt.cli.shared.SCREEN", ScreenStyle(0.01))
    with progress("identifying", quiet=False) as report:
        report("stage 2 of 6")
        ended = threading.Event()
        ended.wait(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert set(lines) == {"identifying, 0 s: stage 2 of 6"}
    with progress("identifying", quiet=True) as report:
        report("stage 2 of 6")
        ended.wait(0.05)
    assert capsys.readouterr() == ("", "")


def test_no_color_leaves_no_escape(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    verdict = Report((Line("converged", Tone.GOOD), Table(text_columns("parameter"), (("load.mass",),))))
    show_report(make_console(), verdict)
    assert "\x1b[" in capsys.readouterr().out
    monkeypatch.setenv("NO_COLOR", "1")
    show_report(make_console(), verdict)
    assert "\x1b" not in capsys.readouterr().out
    monkeypatch.setattr("pneuopt.cli.shared.SCREEN", ScreenStyle(0.01))
    with progress("tuning", quiet=False) as report:
        report("generation 3")
        threading.Event().wait(0.1)
    said = capsys.readouterr().err
    assert said.startswith("tuning, 0 s: generation 3\n")
    assert "\x1b" not in said
