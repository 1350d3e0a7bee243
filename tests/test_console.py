import io

import pandas as pd
from rich.console import Console

from pneuopt.console import metric_units, show_metrics
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
