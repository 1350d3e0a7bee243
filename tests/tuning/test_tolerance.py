"""A settling band in the measured unit, through search and certificate."""

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metric import Tolerance, band_share
from pneuopt.evaluation.requirements import FollowingError, OvershootDistance, PeakControl, SettlingTime
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.tune import tune


def position_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), measured="position")
    values = loop.parameters.with_values({"pid.Kp": 2000.0, "pid.Kd": 200.0, "pid.Tf": 2e-3})
    return loop, values.with_bounds({"pid.Kp": (100.0, 9e3), "pid.Kd": (10.0, 900.0)}).freed("pid.Kp", "pid.Kd")


def test_a_tolerance_is_another_fraction_of_each_reference() -> None:
    loop, values = position_loop()
    steps = [Step(0.1), Step(-0.05, initial=0.2)]
    found = evaluate(loop, steps, values, band=Tolerance(1e-3))
    for step, share in zip(steps, (0.01, 0.02), strict=True):
        assert band_share(Tolerance(1e-3), step) == pytest.approx(share)
        alone = evaluate(loop, step, values, band=share)
        assert found[step.label]["SettlingTime"] == pytest.approx(alone[step.label]["SettlingTime"], rel=1e-9)


def test_moves_are_tuned_to_a_tolerance() -> None:
    """The search's time and the certificate's are one, on moves of which a fraction would mean something else each."""
    loop, values = position_loop()
    moves = [Move(d, speed=1.0, acceleration=20.0, jerk=1000.0, dwell=0.3) for d in (0.1, -0.02)]
    limits = [OvershootDistance(1e-4), PeakControl(400.0), FollowingError(0.02)]
    best = tune(loop, moves, values, minimise=SettlingTime(Tolerance(1e-4)), subject_to=limits)
    assert best.status.converged
    for move in moves:
        claimed, certified = best.claimed[move.label]["SettlingTime"], best.certified[move.label]["SettlingTime"]
        assert certified == pytest.approx(claimed, abs=2e-3)
        assert certified < move.duration + 0.1
        assert best.certified[move.label]["OvershootDistance"] <= 1e-4


def test_a_tolerance_as_wide_as_the_step_is_refused() -> None:
    loop, values = position_loop()
    with pytest.raises(InputError, match=r"its size of 0\.1 lies within the tolerance of \+-0\.2; narrow"):
        tune(loop, Step(0.1), values, minimise=SettlingTime(Tolerance(0.2)))
