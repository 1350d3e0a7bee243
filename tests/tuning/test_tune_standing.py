"""Limits that only a standing drive keeps are said to be that, and are what the remedy names."""

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import IAE, ControlRate, PeakControl
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import tune


def test_limits_that_only_a_standing_drive_keeps() -> None:
    """A command that rises by 1 N/s takes 45 s to overcome the static friction of 45 N; the record ends after 0.5 s."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=5e-3))
    gains, bounds = {"pid.Kp": 0.0, "pid.Ki": 4000.0}, {"pid.Ki": (0.0, 20000.0)}
    given = loop.parameters.with_values(gains).with_bounds(bounds).freed(*bounds)
    limits = [ControlRate(1.0), PeakControl(100.0)]
    quick = Racing(members=10, trials=40)
    message = "only designs that stand still: ControlRate and PeakControl may leave no room to move; relax them"
    with pytest.raises(ConvergenceError, match=message):
        tune(loop, Step(0.1, horizon=0.5), given, minimise=IAE(), subject_to=limits, method=quick)
