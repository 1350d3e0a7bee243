"""Clamping: the law, what it is for, and that search, certificate and files run the same."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

H = 2e-3
GAINS = {"pid.Kp": 2.0, "pid.Ki": 40.0, "pid.lower": -1.2, "pid.upper": 1.2}
STEP = Step(1.0, horizon=0.6)


def clamped() -> ClosedLoop:
    return ClosedLoop(FirstOrder().system(), PID(H, anti_windup=AntiWindup.CLAMPING))


@pytest.mark.parametrize(
    ("speed", "integral", "expected"),
    [
        (0.8, 0.1, 0.1 + 40 * H * 0.2),  # within the limits it integrates
        (0.0, 0.9, 0.9),  # at the upper limit, and the error drives it on: it stays
        (1.3, 3.0, 3.0 - 40 * H * 0.3),  # at the upper limit, and the error takes it back
        (3.0, -0.5, -0.5),  # at the lower limit
        (0.7, 0.59, 0.6),  # a step that crosses the upper limit: it goes as far as the limit lets it, 0.6 + 0.6 = 1.2
        (1.3, -0.59, -0.6),  # one that crosses the lower limit
    ],
)
def test_the_integral_stays_where_the_error_drives_it_beyond_a_limit(
    speed: float, integral: float, expected: float
) -> None:
    loop = clamped()
    order = names(loop.states)
    x = np.zeros(len(order))
    x[0], x[order.index("pid.integral")] = speed, integral
    after = loop.update(0.0, x, [1.0], loop.parameter_vector(loop.parameters.with_values(GAINS))).full().ravel()
    assert after[order.index("pid.integral")] == pytest.approx(expected)


def test_a_saturated_step_overshoots_less_than_with_a_slow_back_calculation() -> None:
    back = ClosedLoop(FirstOrder().system(), PID(H))
    slow = evaluate(back, STEP, back.parameters.with_values({**GAINS, "pid.Tt": 1e6}))
    clamp = evaluate(clamped(), STEP, clamped().parameters.with_values(GAINS))
    was, now = (frame[STEP.label]["Overshoot"] for frame in (slow, clamp))
    assert now < 0.5 * was


def saturated_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, anti_windup=AntiWindup.CLAMPING))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0)}
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.lower": -46.0, "pid.upper": 46.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def test_search_and_certificate_agree_while_the_command_is_clipped() -> None:
    loop, given = saturated_loop()
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 4000.0]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    assert certified["PeakControl"] == pytest.approx(46.0)
    for name in ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_gradients_are_those_of_finite_differences(
    check_slopes: Callable[[LinearisedProblem, np.ndarray], None],
) -> None:
    loop, given = saturated_loop()
    simulator = Simulator(loop, [Step(0.2, horizon=0.3)], search_space(loop, given))
    spec = specify(SettlingTime(), [Overshoot(0.1)])
    check_slopes(
        LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0), np.array([0.4, 0.5, 0.2037])
    )


def test_it_has_no_unwinding_time() -> None:
    assert "pid.Tt" not in clamped().parameters
    assert "pid.upper" in clamped().parameters


def test_it_is_of_sampled_controllers() -> None:
    with pytest.raises(InputError, match="clamping is decided once a sample"):
        PID(anti_windup=AntiWindup.CLAMPING)
    with pytest.raises(InputError, match="anti_windup is one of AntiWindup"):
        PID(H, anti_windup="clamping")  # type: ignore[arg-type]


FILE = """
[pid]
sample_time = "2 ms"
Kp = "2 V*s/m"
Ki = "40 V/m"
limits = ["-1.2 V", "1.2 V"]
anti_windup = "clamping"
[[reference]]
step = "1 m/s"
horizon = "0.6 s"
"""


def test_a_file_names_it(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    path.write_text(FILE, "utf-8")
    found = read_tuning(path, FirstOrder().system())
    assert found.loop.pid == PID(H, anti_windup=AntiWindup.CLAMPING)
    path.write_text(FILE.replace('anti_windup = "clamping"', 'anti_windup = "clamping"\nTt = "1 s"'), "utf-8")
    with pytest.raises(InputError, match="Tt is back-calculation's; clamping has none"):
        read_tuning(path, FirstOrder().system())
    path.write_text(FILE.replace('"clamping"', '"clampin"'), "utf-8")
    with pytest.raises(InputError, match="did you mean"):
        read_tuning(path, FirstOrder().system())
