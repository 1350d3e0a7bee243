"""The integral's dead band: the law, what it is for, and that search and certificate run the same."""

from collections.abc import Callable

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate_stick_slip
from pneuopt.dynamics.system import System
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.karnopp import Karnopp
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.two_phase import is_linear


@pytest.mark.parametrize("error", [-0.5, -0.1, -0.04, 0.0, 0.07, 0.3])
def test_nothing_is_integrated_within_it(second_order: System, error: float) -> None:
    """Continuous and sampled; beyond the band what exceeds it counts."""
    beyond = np.sign(error) * max(abs(error) - 0.1, 0.0)
    values = {"pid.Ki": 3.0, "pid.Kp": 0.0, "pid.dead_band": 0.1}
    loop = ClosedLoop(second_order, PID(dead_band=True))
    x = np.array([-error, 0.0, 0.0, 0.0])
    rates = loop.system().ode(0.0, x, [0.0], loop.parameter_vector(loop.parameters.with_values(values)))[0]
    assert float(rates[2]) == pytest.approx(3.0 * beyond)
    loop = ClosedLoop(second_order, PID(2e-3, dead_band=True))
    p = loop.parameter_vector(loop.parameters.with_values(values))
    after = np.array(loop.update(0.0, [-error, *[0] * 7], [0.0], p)).ravel()
    assert after[2] == pytest.approx(2e-3 * 3.0 * beyond)


def test_a_clipped_command_unwinds_the_integral_within_it(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(1e-3, dead_band=True), Dither(60.0))
    values = {"pid.dead_band": 0.1, "pid.Ki": 3.0, "pid.Kp": 0.0, "pid.upper": 1.0, "pid.lower": -1.0, "pid.Tt": 0.1}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    after = np.array(loop.update(0.0, [0.05, 0, 2.0, *[0] * 5], [0.0], p)).ravel()
    assert after[2] == pytest.approx(2.0 + 1e-3 / 0.1 * (1.0 - 2.0))


def hunting(dead_band: float) -> tuple[float, float]:
    """A position loop on a stick-slip axis: travel, peak to peak, from 1.6 to 2.4 s, and the largest error then."""
    pid = PID(2e-3, dead_band=True)
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), pid, measured="position")
    values = {"friction.coulomb": 25.0, "friction.static": 40.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 60.0, "pid.Kp": 4000.0, "pid.Ki": 80000.0, "pid.Kd": 150.0}
    parameters = loop.parameters.with_values({**values, "pid.dead_band": dead_band})
    t = np.arange(0.0, 2.4, 0.05)
    run = simulate_stick_slip(loop, Trajectory(t, {"reference": np.full(len(t), 0.05)}), parameters).trajectory
    late = run["position"][run.t >= 1.6 - 1e-9]
    return float(np.ptp(late)), float(np.abs(late - 0.05).max())


def test_it_ends_the_hunting_of_an_axis_that_sticks() -> None:
    travel, _ = hunting(0.0)
    rested, off = hunting(2e-3)
    assert travel > 4e-3
    assert rested == 0.0
    assert off <= 2e-3 + 1e-12


def friction_loop(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time, dead_band=True))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0), "pid.dead_band": (0.0, 5e-3)}
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.dead_band": 2e-3, "pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_gradients_are_those_of_finite_differences(
    sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    """It bends, but does not jump: derivatives hold on either side, the band's own too."""
    loop, given = friction_loop(sample_time)
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given))
    posed = LinearisedProblem(
        simulator, sensitivity_rollout(simulator), specify(SettlingTime(), [Overshoot(0.1)]), 60, 1.0
    )
    z = np.array([0.4, 0.5, 0.4, 0.2037])
    (point,) = posed.evaluate(z[None])
    assert np.abs(point.slopes[:, 2]).max() > 0
    check_slopes(posed, z)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_search_and_certificate_agree(sample_time: float | None) -> None:
    loop, given = friction_loop(sample_time)
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 4000.0, 2e-3]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    assert np.isfinite(certified["SettlingTime"])
    for name in ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_a_loop_with_it_is_not_linear() -> None:
    plain, banded = (ClosedLoop(SecondOrder().system(), PID(dead_band=band)) for band in (False, True))
    assert is_linear(plain)
    assert not is_linear(banded)


def test_a_negative_one_is_refused(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(dead_band=True))
    assert loop.parameters["pid.dead_band"].unit == "m/s"
    foreign = loop.parameters | ParameterSet({"pid.dead_band": Parameter(-0.1, "m/s")})
    with pytest.raises(InputError, match=r"pid\.dead_band must not be negative, got -0\.1"):
        loop.check(foreign)
