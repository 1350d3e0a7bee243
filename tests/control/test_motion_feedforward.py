"""What a position loop adds for the motion of its reference, against hand recursions and a plant that it inverts."""

import numpy as np
import pytest

from pneuopt.control.friction_feedforward import FrictionFeedforward
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.motion_feedforward import MotionFeedforward
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.response import loop_inputs
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.quantities.trajectories import Trajectory

H = 2e-3
PARTS = (MotionFeedforward(), FrictionFeedforward())


def position_loop(*parts: object, sample_time: float | None = H) -> ClosedLoop:
    return ClosedLoop(
        ForceDrive(Stribeck()).system(),
        PID(sample_time, limits=False),
        measured="position",
        compensators=parts,  # type: ignore[arg-type]
    )


def test_a_loop_has_the_rates_that_its_parts_use() -> None:
    found = {len(p): [(q.name, q.unit) for q in position_loop(*p).inputs] for p in ((), PARTS[1:], PARTS)}
    assert found[0] == [("reference", "m")]
    assert found[1] == [("reference", "m"), ("reference_speed", "m/s")]
    assert found[2] == [*found[1], ("reference_acceleration", "m/s^2")]
    loop = position_loop(*PARTS)
    units = {n: loop.parameters[f"motion_feedforward.{n}"].unit for n in ("speed", "acceleration")}
    assert units == {"speed": "N*s/m", "acceleration": "N*s^2/m"}
    assert loop.parameters["friction_feedforward.smoothing"].unit == "m/s"
    moving = ClosedLoop(loop.plant, PID(H), compensators=PARTS)
    assert names(moving.inputs) == ("reference", "reference_acceleration")


def test_the_command_is_that_of_a_hand_recursion() -> None:
    """PI of the position, ``speed v_r + acceleration a_r`` and ``level tanh(v_r/smoothing)``."""
    loop, rng = position_loop(*PARTS), np.random.default_rng(3)
    values = {"pid.Kp": 40.0, "pid.Ki": 90.0, "pid.Tf": 0.01, "pid.Kd": 2.0}
    values |= {"motion_feedforward.speed": 7.0, "motion_feedforward.acceleration": 1.5}
    values |= {"friction_feedforward.level": 6.0, "friction_feedforward.smoothing": 0.02}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    x, held = np.zeros(len(loop.states)), names(loop.states).index("pid.command")
    integral = derivative = before = 0.0
    for r, v, a, y in 0.1 * rng.normal(size=(200, 4)):
        x[0] = y
        x = np.array(loop.update(0.0, x, [r, v, a], p)).ravel()
        integral += 90.0 * H * (r - y)
        derivative = (0.01 * derivative + 2.0 * (r - y - before)) / (0.01 + H)
        before = r - y
        u = 40.0 * (r - y) + integral + derivative + 7.0 * v + 1.5 * a + 6.0 * np.tanh(v / 0.02)
        assert x[held] == pytest.approx(u, rel=1e-12, abs=1e-12)


def test_the_inverse_dynamics_follow_a_smooth_motion_without_an_error() -> None:
    """A mass with viscous friction, driven by its own inverse, needs no feedback."""
    drive = ForceDrive(Viscous()).system()
    loop = ClosedLoop(drive, PID(limits=False), measured="position", compensators=(MotionFeedforward(),))
    own = {
        "motion_feedforward.speed": drive.parameters.value("friction.viscous"),
        "motion_feedforward.acceleration": drive.parameters.value("load.mass"),
    }
    given = loop.parameters.with_values({"pid.Kp": 50.0, **own})
    t = np.linspace(0.0, 1.0, 1001)
    w = 2 * np.pi
    motion = {
        "reference": 0.05 * (1 - np.cos(w * t)),
        "reference_speed": 0.05 * w * np.sin(w * t),
        "reference_acceleration": 0.05 * w**2 * np.cos(w * t),
    }
    start = np.zeros(len(loop.states))
    late = np.abs(simulate(loop, Trajectory(t, motion), given, initial=start)["position"] - motion["reference"]).max()
    bare = given.with_values(dict.fromkeys(own, 0.0))
    plain = np.abs(simulate(loop, Trajectory(t, motion), bare, initial=start)["position"] - motion["reference"]).max()
    assert late < 3e-4  # the inputs are held from sample to sample
    assert plain > 0.05


def test_a_step_has_no_rates_and_adds_nothing() -> None:
    loop, plain = position_loop(*PARTS), position_loop()
    run = loop_inputs(loop, Step(0.1, horizon=0.4), H)
    assert not np.any([run["reference_speed"], run["reference_acceleration"]])
    values = {"pid.Kp": 300.0, "pid.Kd": 60.0}
    more = {"motion_feedforward.speed": 7.0, "friction_feedforward.level": 6.0}
    found, bare = (
        evaluate(one, Step(0.1, horizon=0.4), one.parameters.with_values(v))
        for one, v in ((loop, values | more), (plain, values))
    )
    assert found.loc["IAE"].iloc[0] == pytest.approx(bare.loc["IAE"].iloc[0], rel=1e-9)


def test_it_starts_in_a_rest_that_is_the_plain_loops() -> None:
    loop, plain = position_loop(*PARTS), position_loop()
    values = {"pid.Kp": 300.0, "pid.Ki": 20.0, "motion_feedforward.speed": 7.0, "friction_feedforward.level": 6.0}
    found = loop.initial(loop.parameters.with_values(values), reference=0.2)
    bare = plain.initial(
        plain.parameters.with_values({n: v for n, v in values.items() if n.startswith("pid.")}), reference=0.2
    )
    np.testing.assert_array_equal(found, bare)
