"""Disturbance steps: what a loop shows of them is what theory says, in the search as in the certificate."""

import numpy as np
import pytest

from pneuopt.control.disturbance import add_disturbances
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.requirements import Overshoot, PeakControl, Requirement, SettlingTime
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError, UnknownNameError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.method import Method
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import TwoPhase

PUSH = Step(0.0, initial=0.2, at=0.1, horizon=1.1, disturbance={"load.force": 30.0})


def axis() -> tuple[ClosedLoop, ParameterSet]:
    """5 kg with 40 N s/m of friction under PI control of its speed."""
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(limits=False))
    values = {"load.mass": 5.0, "friction.viscous": 40.0, "pid.Kp": 60.0, "pid.Ki": 800.0}
    return loop, loop.parameters.with_values(values)


def test_a_load_step_shows_the_closed_form() -> None:
    """M v'' + (b + Kp) v' + Ki v = 0 from v' = -F/M: a damped oscillation about the reference."""
    loop, p = axis()
    M, b, Kp, Ki, F = 5.0, 40.0, 60.0, 800.0, 30.0
    run = respond(loop, PUSH, p)
    decay = (b + Kp) / (2 * M)
    rate = np.sqrt(Ki / M - decay**2)
    t = np.maximum(run.t - PUSH.at, 0.0)
    expected = 0.2 - F / (M * rate) * np.exp(-decay * t) * np.sin(rate * t)
    np.testing.assert_allclose(run["speed"], expected, atol=1e-7)
    found = evaluate(loop, PUSH, p)[PUSH.label]
    assert found["Overshoot"] == pytest.approx(100 * np.abs(expected - 0.2).max() / 0.2, rel=1e-4)
    outside = t[np.abs(expected - 0.2) > 0.02 * 0.2][-1]
    assert found["SettlingTime"] == pytest.approx(outside, abs=1e-3)
    assert found["RiseTime"] == 0.0
    assert found["Peak"] == pytest.approx(expected.min(), abs=1e-6)


def test_the_integral_of_the_error_is_the_load_over_Ki() -> None:
    """Overdamped the error keeps its sign: its integral is what the integral action had to gather."""
    loop, p = axis()
    p = p.with_values({"pid.Kp": 300.0})
    long = Step(0.0, scale=0.1, horizon=4.0, disturbance={"load.force": 30.0})
    assert evaluate(loop, long, p)[long.label]["IAE"] == pytest.approx(30.0 / 800.0 / 0.1, rel=1e-3)


def test_friction_slope_and_margins_are_stated() -> None:
    loop, p = axis()
    assert evaluate(loop, PUSH, p)[PUSH.label]["FrictionSlope"] == pytest.approx(40.0)


def test_a_disturbance_of_a_step_comes_with_it() -> None:
    """A linear loop: both at once are the sum of each alone."""
    loop, p = axis()
    both, step, push = (
        respond(loop, s, p)["speed"]
        for s in (
            Step(0.2, disturbance={"load.force": 30.0}),
            Step(0.2),
            Step(0.0, scale=0.2, disturbance={"load.force": 30.0}),
        )
    )
    np.testing.assert_allclose(both, step + push, atol=1e-9)


@pytest.mark.parametrize("method", [TwoPhase((12, 20), starts=1), Racing()])
def test_each_search_claims_what_is_certified(method: Method) -> None:
    """The step's rise and the load's recovery are bound together: all searches end in the same design."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    bounds = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.1, 200.0)}
    given = loop.parameters.with_values({"plant.time_constant": 0.1, "pid.Ki": 20.0}).with_bounds(bounds).freed(*bounds)
    steps = [Step(1.0), Step(0.0, scale=1.0, disturbance={"valve_voltage": -0.5})]
    limits: list[Requirement] = [PeakControl(6.0), Overshoot(0.08)]
    best = tune(loop, steps, given, minimise=SettlingTime(), subject_to=limits, method=method, plants={})
    assert best.status.converged
    certified = best.certified.astype(float).T
    assert certified["SettlingTime"].max() == pytest.approx(0.1203, abs=0.001)
    assert best.stats["deviation.SettlingTime"] < 1e-3
    assert best.stats["deviation.Overshoot"] < 0.05
    assert certified["Overshoot"].max() == pytest.approx(5.59, abs=0.05)


def test_zero_disturbance_is_the_plant_as_it_was() -> None:
    loop, p = axis()
    other = add_disturbances(loop, [PUSH])
    x, u = np.array([0.1, 0.3]), {"force": 20.0}
    ours, theirs = (model.plant.linearise(x, u, p) for model in (loop, other))
    np.testing.assert_array_equal(ours.A, theirs.A)
    assert other.inputs[-1].name == "disturbance.load.force"
    assert other.inputs[-1].unit == "N"
    assert add_disturbances(other, [PUSH]) is other
    assert add_disturbances(loop, [Step(1.0)]) is loop


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"size": 0.0, "disturbance": {"load.force": 1.0}}, "a loop that holds 0 needs a scale"),
        ({"size": 0.1, "disturbance": {"load.force": 0.0}}, "must not be zero, nothing would change"),
        ({"size": 0.1, "scale": 0.1}, "scale is for a disturbance alone"),
        ({"size": 0.0, "scale": -0.1, "disturbance": {"load.force": 1.0}}, "scale must be positive, got -0.1"),
    ],
)
def test_bad_input_is_named(fields: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Step(**fields)  # type: ignore[arg-type]  # a parametrised call


def test_an_unknown_disturbance_is_named() -> None:
    loop, p = axis()
    with pytest.raises(UnknownNameError, match=r"unknown parameter or input of the plant 'load.froce'; did you mean"):
        evaluate(loop, Step(0.1, disturbance={"load.froce": 1.0}), p)
