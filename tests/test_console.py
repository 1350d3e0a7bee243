import io

import pandas as pd
import pytest
from rich.console import Console

from pneuopt.console import metric_units, show_gains, show_metrics
from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.models.linear import FirstOrder
from pneuopt.requirements import KINDS, MaxComplementarySensitivity, Overshoot, PhaseMargin, Requirement, StepEnvelope


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
    assert {kind.__name__ for kind in KINDS} <= set(units)


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
