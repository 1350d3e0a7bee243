"""A response that is continued up to an end stop is judged by what it did before the stop's rounded edge slowed it."""

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import certificate
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_speed_that_holds_until_the_stop_does_not_creep(side: float) -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Viscous()).system(), PID(sample_time=2e-3))
    gains = loop.parameters.with_values({"pid.Kp": 1.0, "pid.Ki": 20.0, "friction.viscous": 300.0})
    found = certificate(loop, Step(0.1 * side, horizon=0.5), gains)
    assert found.findings == ()
    assert any("reached the" in note and "end stop" in note for note in found.notes)
    settling = found.metrics.T["SettlingTime"].to_list()
    assert 0 < settling[0] < 0.5
