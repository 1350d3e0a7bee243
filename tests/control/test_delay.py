"""The computing delay of a sampled controller: in the loop, in its margins, in search and certificate."""

from collections.abc import Callable

import control
import numpy as np
import pytest

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import margins
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import tune

GAINS = {"pid.Kp": 0.18, "pid.Ki": 0.9, "pid.Kd": 0.008, "pid.Tf": 0.01}
STEP = Step(0.1, horizon=0.3)


def exact(h: float, delay: int) -> control.TransferFunction:
    """The sampled open loop of eq. 16: exact zero-order hold, backward-Euler controller, whole samples of delay."""
    plant = control.sample_system(control.tf([1270.12], [1, 17.5, 86.34]), h, "zoh")
    z = control.tf([1, 0], [1], h)
    slope = (z - 1) / (h * z)
    C = GAINS["pid.Kp"] + GAINS["pid.Ki"] / slope + GAINS["pid.Kd"] * slope / (GAINS["pid.Tf"] * slope + 1)
    return control.minreal(plant * C / z**delay, verbose=False)


@pytest.mark.parametrize("h", [1e-3, 4e-3, 1e-2])
@pytest.mark.parametrize("delay", [0, 1])
def test_margins_are_those_of_the_sampled_loop(second_order: System, h: float, delay: int) -> None:
    loop = ClosedLoop(second_order, PID(h, delay=delay))
    ours, L = margins(open_loop(loop, loop.parameters.with_values(GAINS))), exact(h, delay)
    w = np.geomspace(0.1, 0.999 * np.pi / h, 2000)
    Ms = np.max(1 / np.abs(1 + L(np.exp(1j * w * h))))
    gain, phase, *_ = control.stability_margins(control.frd(L, w, smooth=True))
    assert ours.max_sensitivity == pytest.approx(Ms, rel=1e-3)
    assert ours.gain_margin == pytest.approx(gain, rel=0.02)
    assert ours.phase_margin == pytest.approx(phase, abs=0.1)


def test_a_delay_costs_phase(second_order: System) -> None:
    found = []
    for delay in (0, 1):
        loop = ClosedLoop(second_order, PID(4e-3, delay=delay))
        found.append(margins(open_loop(loop, loop.parameters.with_values(GAINS))))
    lost = np.degrees(found[0].gain_crossover * 4e-3)
    assert found[0].phase_margin - found[1].phase_margin == pytest.approx(lost, rel=1e-3)


def friction_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(5e-3, delay=1))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0), "pid.Kd": (0.0, 0.5)}
    values = {"pid.Kp": 200.0, "pid.Ki": 3000.0, "pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("step", [Step(0.1, horizon=0.6), Step(0.1, at=0.05, initial=0.05, horizon=0.6)])
def test_search_and_certificate_agree(step: Step) -> None:
    loop, given = friction_loop()
    simulator, spec = Simulator(loop, [step], search_space(loop, given)), specify(SettlingTime(), [MaxSensitivity(2.0)])
    (claimed,) = simulator.table(np.array([200.0, 3000.0, 0.0]), spec)
    certified = evaluate(loop, step, given)[step.label]
    assert np.isfinite(certified["SettlingTime"])
    for name in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_gradients_are_those_of_finite_differences(
    check_slopes: Callable[[LinearisedProblem, np.ndarray], None],
) -> None:
    loop, given = friction_loop()
    simulator = Simulator(loop, [STEP, Step(0.1, at=0.05, initial=0.05, horizon=0.3)], search_space(loop, given))
    spec = specify(SettlingTime(), [Overshoot(0.1), MaxSensitivity(1.6)])
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0)
    z = np.array([0.3, 0.3, 0.2, 0.2037])
    check_slopes(posed, z)


def test_a_tuning_reckons_with_it() -> None:
    """Tuned without the delay the loop overshoots once it is there; tuned with it, it keeps the limit."""
    loop, given = friction_loop()
    ignorant = ClosedLoop(loop.plant, PID(5e-3))
    quick = Racing(members=8, trials=40, polish=16)
    limits = [Overshoot(0.05)]
    knowing = tune(loop, STEP, given, minimise=SettlingTime(), subject_to=limits, method=quick, plants={})
    blind = tune(ignorant, STEP, given, minimise=SettlingTime(), subject_to=limits, method=quick, plants={})
    seen = evaluate(loop, STEP, blind.parameters)["0 to 0.1"]
    assert knowing.certified["0 to 0.1"]["Overshoot"] <= 5.0
    assert seen["Overshoot"] > 5.0 or not seen["SettlingTime"] <= knowing.certified["0 to 0.1"]["SettlingTime"]


def test_a_delay_is_a_whole_sample_of_a_sampled_controller() -> None:
    with pytest.raises(InputError, match="a delay of 1 sample needs a sample_time"):
        PID(delay=1)
    for delay in (0.5, 2, -1):
        with pytest.raises(InputError, match=f"delay is 0 or 1, whole samples, got {delay}"):
            PID(1e-3, delay=delay)  # type: ignore[arg-type]
