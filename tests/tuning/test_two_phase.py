"""`TwoPhase` reads what the certificate reads."""

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import PeakControl, Requirement, SettlingTime, SteadyStateError
from pneuopt.models.linear import FirstOrder
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import TwoPhase


@pytest.mark.parametrize(
    ("aim", "limits"),
    [(PeakControl(), []), (PeakControl(), [SettlingTime(max=0.9)]), ({PeakControl(): 1.0, SettlingTime(): 1e-3}, [])],
)
def test_the_exact_problem_reads_the_steady_state_error_at_the_horizon(
    aim: dict[Requirement, float], limits: list[Requirement]
) -> None:
    """The least command that brings a lag to within 0.3 % of the reference by the horizon; slower gains do later."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.01, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    limits, method = [SteadyStateError(0.003), *limits], TwoPhase((20, 25), starts=1)
    best = tune(loop, Step(1.0), given, minimise=aim, subject_to=limits, method=method, plants={})
    assert best.certified["0 to 1"]["SteadyStateError"] == pytest.approx(0.3, rel=0.05)
    assert "margin" in best.stats
    assert best.stats["margin"] == method.margin
