"""The reset integral: a hand recursion, what it is for, and that search, files and cascade run the same."""

from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.controller import PositionLoop
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate_stick_slip
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import margins
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, Stribeck, Viscous
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

H = 2e-3


@pytest.mark.parametrize("cascaded", [False, True])
def test_the_command_is_that_of_a_hand_recursion(cascaded: bool) -> None:
    """Of a PI, in a cascade of the speed, while the error wanders about zero, in counts and out of them."""
    plant, encoder = ForceDrive(Viscous()).system(), Encoder(1e-3, 4e-3)
    outer = PositionLoop() if cascaded else None
    loop = ClosedLoop(plant, PID(H, limits=False, reset=True), measured="position", sensor=encoder, outer=outer)
    values = {"pid.Kp": 3.0, "pid.Ki": 70.0, "pid.reset_ratio": 0.6, "pid.reset_band": 1.5e-3, "position_loop.Kp": 8.0}
    p = loop.parameter_vector(loop.parameters.with_values({n: v for n, v in values.items() if n in loop.parameters}))
    rng = np.random.default_rng(2)
    path = 4e-3 * np.sin(0.11 * np.arange(400)) + 2e-3 * np.cumsum(rng.normal(size=400)) * 0.1
    x, order = np.zeros(len(loop.states)), names(loop.states)
    integral = side = excursion = count = speed = 0.0
    found, expected, seen = [], [], set()
    for y in path:
        q = 1e-3 * np.floor(y / 1e-3 + 0.5)
        speed += H / (H + 4e-3) * ((q - count) / H - speed)
        count, e = q, -q
        if side * e < 0 and abs(e) > 1.5e-3:
            integral, side, excursion = -0.6 * integral, np.sign(e), abs(e)
            seen.add("crosses")
        elif excursion > 0 and abs(e) > excursion:
            excursion = abs(e)
            seen.add("goes on")
        elif excursion > 0:
            integral = excursion = 0.0
            seen.add("stops")
        elif side == 0 and abs(e) > 1.5e-3:
            side = np.sign(e)
        error = 8.0 * e - speed if cascaded else e
        integral += 70.0 * H * error
        expected.append(3.0 * error + integral)
        x[order.index("position")] = y
        x = np.array(loop.update(0.0, x, np.zeros(len(loop.inputs)), p)).ravel()
        found.append(x[order.index("pid.command")])
    assert seen == {"crosses", "goes on", "stops"}
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def hunting(*, reset: bool) -> tuple[float, float]:
    """A position loop on a stick-slip axis: travel over the last two seconds of 8, and the largest error then [m]."""
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(H, reset=reset), measured="position")
    values = {"friction.coulomb": 25.0, "friction.static": 40.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 60.0, "pid.Kp": 4000.0, "pid.Ki": 80000.0, "pid.Kd": 150.0}
    parameters = loop.parameters.with_values(values | ({"pid.reset_ratio": 0.5} if reset else {}))
    t = np.arange(0.0, 8.0, 0.1)
    run = simulate_stick_slip(loop, Trajectory(t, {"reference": np.full(len(t), 0.05)}), parameters).trajectory
    late = run["position"][t >= 6.0]
    return float(np.ptp(late)), float(np.abs(late - 0.05).max())


def test_a_pid_that_hunts_comes_to_rest() -> None:
    """Armstrong & Amin, Automatica 32 (1996) 679-692: with static friction above Coulomb's a PID hunts."""
    travel, _ = hunting(reset=False)
    assert travel > 5e-3
    travel, error = hunting(reset=True)
    assert travel < 1e-8
    assert error < 1e-5


def test_without_a_change_of_sign_it_is_the_plain_integral(second_order: System) -> None:
    plain, other = (ClosedLoop(second_order, PID(H, reset=reset)) for reset in (False, True))
    values = {"pid.Kp": 0.02, "pid.Ki": 0.1}
    one, two = (evaluate(m, Step(0.1, horizon=1.0), m.parameters.with_values(values)) for m in (plain, other))
    assert one.loc["Overshoot"].iloc[0] < 1e-3
    assert two.loc["IAE"].iloc[0] == pytest.approx(one.loc["IAE"].iloc[0], rel=1e-9)
    peaks = [margins(open_loop(m, m.parameters.with_values(values))).max_sensitivity for m in (plain, other)]
    assert peaks[0] == peaks[1]


def test_a_file_turns_it_on(tmp_path: Path) -> None:
    text = '[pid]\nsample_time = "2 ms"\nKp = "2 V*s/m"\nreset_ratio = 0.5\nreset_band = "1 mm/s"\n'
    source = tmp_path / "tuning.toml"
    source.write_text(text + '[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n', encoding="utf-8")
    tuning = read_tuning(source, SecondOrder().system())
    assert tuning.loop.pid.reset
    assert [tuning.parameters.value(f"pid.reset_{n}") for n in ("ratio", "band")] == [0.5, 1e-3]
    source.write_text(source.read_text("utf-8").replace("reset_ratio = 0.5\n", ""), encoding="utf-8")
    with pytest.raises(InputError, match="write reset_ratio, too"):
        read_tuning(source, SecondOrder().system())


def test_what_cannot_run_is_refused(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(H, reset=True))
    with pytest.raises(InputError, match="reset_ratio"):
        loop.check(loop.parameters | ParameterSet({"pid.reset_ratio": Parameter(2.0, "1")}))
