"""How a design gets to a controller: a page offers the forms that can hold it, and no other."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.export.blocks import describe_refusal, export_settings
from pneuopt.export.makers import Block
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.report.gains import EXPORTS, report_exports

PLAIN = ClosedLoop(FirstOrder().system(), PID(sample_time=0.01))
BENT = ClosedLoop(FirstOrder().system(), PID(sample_time=0.01), compensators=(DeadZoneInverse(),))
LIMITED = {"pid.lower": -5.0, "pid.upper": 5.0}


@pytest.mark.parametrize("loop", [PLAIN, BENT])
@pytest.mark.parametrize("values", [LIMITED, {}])
def test_a_page_offers_the_exports_that_are_not_refused(loop: ClosedLoop, values: dict[str, float]) -> None:
    given = loop.parameters.with_values(values | ({"dead_zone_inverse.width": 0.1} if loop is BENT else {}))
    report = report_exports(loop.controller, given, [Step(1.0)], 0.0, Path("fit.toml"), Path("tuned.toml"))
    shown = " ".join(report.to_text().split())
    told = {block: describe_refusal(loop.controller, given, block, Step(1.0)) for block in Block}
    for block, reason in told.items():
        with pytest.raises(InputError) if reason else nullcontext(InputError("")) as refusal:
            export_settings(loop, given, block, Step(1.0))
        assert reason == str(refusal.value if isinstance(refusal, pytest.ExceptionInfo) else refusal)
    refused = {block.value for block, reason in told.items() if reason}
    assert bool(refused) == (loop is BENT or not values)
    assert [form for form in EXPORTS if f"--to {form}" in shown] == [form for form in EXPORTS if form not in refused]
