"""A set-point lead: what it adds, that the loop's stability does not feel it, and that a search can use it."""

from collections.abc import Callable

import control
import numpy as np
import pytest

from pneuopt.control.feedforward import Feedforward
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import frequency_response
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.two_phase import is_linear

Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
GAINS = {"pid.Kp": 0.225, "pid.Ki": 1.23, "pid.Kd": 0.01, "pid.Tf": 0.01}
LEAD = {"feedforward.gain": 0.3, "feedforward.time": 0.04}


def test_a_step_adds_a_decaying_push(second_order: System, run: Run) -> None:
    """Without feedback the command is the push alone: gain R exp(-t/T), sampled gain R (T/(T + h))^(k + 1)."""
    values = {"pid.Kp": 0.0, **LEAD}
    t, _, y = run(
        loop := ClosedLoop(second_order, PID(limits=False), feedforward=Feedforward()),
        loop.parameters.with_values(values),
        0.5,
        1e-3,
        0.2,
    )
    np.testing.assert_allclose(y[:, -1], 0.3 * 0.5 * np.exp(-t / 0.04), rtol=1e-6)
    loop = ClosedLoop(second_order, PID(5e-3, limits=False), feedforward=Feedforward())
    t, _, y = run(loop, loop.parameters.with_values(values), 0.5, 5e-3, 0.2)
    np.testing.assert_allclose(y[:, -1], 0.3 * 0.5 * (0.04 / 0.045) ** (np.arange(len(t)) + 1), rtol=1e-12)


def test_a_loop_with_it_follows_python_control(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID(), feedforward=Feedforward())
    t, _, y = run(loop, loop.parameters.with_values(GAINS | LEAD), 1.0, 1e-3, 0.6)
    plant, pid = (
        control.tf([1270.12], [1, 17.5, 86.34]),
        0.225 + control.tf([1.23], [1, 0]) + control.tf([0.01, 0], [0.01, 1]),
    )
    expected = (pid + control.tf([0.3 * 0.04, 0], [0.04, 1])) * control.feedback(plant, pid)
    np.testing.assert_allclose(y[:, 0], control.step_response(expected, t).outputs, atol=2e-8)


def test_margins_do_not_feel_it(second_order: System) -> None:
    w = np.geomspace(0.1, 400.0, 30)
    plain, led = (ClosedLoop(second_order, PID(), feedforward=f) for f in (None, Feedforward()))
    L = [frequency_response(open_loop(loop, loop.parameters.with_values(GAINS)), w) for loop in (plain, led)]
    np.testing.assert_array_equal(L[0], L[1])
    assert is_linear(led)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_at_rest_and_in_steady_motion_it_adds_nothing(second_order: System, sample_time: float | None) -> None:
    loop = ClosedLoop(second_order, PID(sample_time), feedforward=Feedforward())
    p = loop.parameters.with_values(GAINS | LEAD)
    plain = ClosedLoop(second_order, PID(sample_time))
    x = loop.initial(p, reference=0.5)
    np.testing.assert_allclose(x[:-1], plain.initial(p, reference=0.5), atol=1e-12)
    if sample_time is not None:
        x = np.array(loop.update(0.0, x, [0.5], loop.parameter_vector(p))).ravel()
        assert x[names(loop.states).index("pid.command")] == pytest.approx(0.5 * 86.34 / 1270.12)
        return
    rates = loop.system().ode(0.0, x, [0.5], loop.parameter_vector(p))[0]
    np.testing.assert_allclose(np.array(rates).ravel(), 0.0, atol=1e-9)


def friction_loop(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time), feedforward=Feedforward(0.03))
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.lower": -300.0, "pid.upper": 300.0, "feedforward.gain": 300.0}
    bounds = {"pid.Kp": (50.0, 600.0), "feedforward.gain": (0.0, 1500.0), "feedforward.time": (5e-3, 0.1)}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_gradients_are_those_of_finite_differences(
    sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    loop, given = friction_loop(sample_time)
    steps = [Step(0.1, horizon=0.3), Step(0.1, at=0.05, initial=0.05, horizon=0.3)]
    simulator = Simulator(loop, steps, search_space(loop, given))
    posed = LinearisedProblem(
        simulator, sensitivity_rollout(simulator), specify(SettlingTime(), [Overshoot(0.1)]), 60, 1.0
    )
    z = np.array([0.4, 0.3, 0.5, 0.2037])
    check_slopes(posed, z)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_search_and_certificate_agree(sample_time: float | None) -> None:
    loop, given = friction_loop(sample_time)
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 300.0, 0.03]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    for name in ("SettlingTime", "Overshoot", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_it_makes_a_lag_follow_as_fast_as_wanted_whatever_the_gain() -> None:
    """k/(T s + 1) under ``Ki = 1/(k time)`` and ``gain = T/(k time) - Kp`` answers a step with 1 - exp(-t/time)."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), feedforward=Feedforward())
    k, T, time = loop.parameters.value("plant.gain"), 0.1, 0.02
    for Kp in (0.1, 2.0):
        values = {"pid.Kp": Kp, "pid.Ki": 1 / (k * time), "feedforward.time": time}
        values |= {"plant.time_constant": T, "feedforward.gain": T / (k * time) - Kp}
        found = evaluate(loop, Step(1.0, horizon=0.3), loop.parameters.with_values(values))["0 to 1"]
        assert found["SettlingTime"] == pytest.approx(time * np.log(50), abs=1e-4)


def test_a_time_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="Feedforward: time must be at least 1e-06 s, got 0 s"):
        Feedforward(0.0)
