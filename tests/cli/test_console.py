import io

import pandas as pd
import pytest
from rich.console import Console

from pneuopt.cli.show_loops import metric_units, show_dither, show_gains, show_metrics
from pneuopt.cli.terminal import make_console
from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.evaluation.dither_effect import DitherEffect
from pneuopt.evaluation.dither_verdict import DitherVerdict, Usefulness
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    MaxComplementarySensitivity,
    Overshoot,
    PhaseMargin,
    Requirement,
    StepEnvelope,
)
from pneuopt.models.linear import FirstOrder


def test_metrics_stand_beside_what_is_allowed() -> None:
    """As the user wrote it: percent, and margins from below; the longest name in one piece on 80 columns."""
    loop, out = ClosedLoop(FirstOrder().system(), PID()), io.StringIO()
    figures = {"Overshoot": 3.2, "StepEnvelope": 0.9, "MaxComplementarySensitivity": 1.1, "PhaseMargin": 61.5}
    table = pd.DataFrame({"0 to 0.05": figures, "0 to 0.25": figures})
    limits: list[Requirement] = [
        Overshoot(0.05),
        StepEnvelope(((0.0, -0.1, 1.1),)),
        PhaseMargin(60.0),
        MaxComplementarySensitivity(),
    ]
    show_metrics(Console(file=out, width=80), table, loop, limits=limits)
    rows = [line.split() for line in out.getvalue().splitlines()]
    assert ["Overshoot", "3.2", "3.2", "<=", "5", "%"] in rows
    assert ["StepEnvelope", "0.9", "0.9", "<=", "1"] in rows
    assert ["PhaseMargin", "61.5", "61.5", ">=", "60", "deg"] in rows
    assert ["MaxComplementarySensitivity", "1.1", "1.1"] in rows


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
    out = io.StringIO()
    show_gains(Console(file=out, width=80), given, given)
    assert said in out.getvalue()


def test_a_dithers_verdict_is_shown_with_its_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    table = pd.DataFrame({"without": {"Ripple": 0.0}, "with": {"Ripple": 1e-3}})
    effect = DitherEffect(0.001, 159.0)
    verdict = DitherVerdict(Usefulness.USELESS, ("nothing changes", "price: air"), table, effect, "the same gains", "V")
    show_dither(make_console(), verdict)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "the dither of 0.001 V at 159 Hz is useless, against the same gains"
    assert [line.strip() for line in lines[1:]] == ["nothing changes", "price: air"]


@pytest.mark.parametrize("amplitude", [0.0, 0.01])
def test_a_limit_cycle_is_shown_where_there_is_one(amplitude: float, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {"SettlingTime": 0.1, "LimitCycleAmplitude": amplitude, "LimitCycleFrequency": 2.0, "AirUse": 1.5}
    loop = ClosedLoop(FirstOrder().system(), PID())
    show_metrics(make_console(), pd.DataFrame({"0 to 1": rows}), loop)
    out = capsys.readouterr().out
    assert ("LimitCycleFrequency" in out) == (amplitude > 0)
    assert "l(ANR)" in out
