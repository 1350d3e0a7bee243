"""Certificates: either direction, from rest and from motion, on the smooth loop and on a rig."""

from collections.abc import Callable
from math import exp

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.system import names
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.requirements import IAE
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.models.catalog import r25
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import FrictionModel, Karnopp, LuGre, Stribeck, Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import tune

GAINS = {"pid.Kp": 150.0, "pid.Ki": 8000.0, "pid.lower": -60.0, "pid.upper": 60.0}
VALVE = {"pid.Kp": 1.0, "pid.Ki": 20.0, "pid.Kd": 0.03, "pid.Tf": 3e-3, "pid.lower": -5.0, "pid.upper": 5.0}


def axis(friction: FrictionModel) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(friction).system(), PID(sample_time=1e-3), Dither(100.0))
    return loop, loop.parameters.with_values(GAINS)


def cylinder(friction: FrictionModel) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(PneumaticDrive(friction=friction).system(), PID(sample_time=1e-3), Dither(100.0))
    return loop, loop.parameters.with_values(VALVE)


@pytest.mark.parametrize("friction", [Stribeck(), LuGre(), Karnopp(Stribeck())])
def test_the_force_in_motion_is_the_friction(friction: FrictionModel) -> None:
    loop, p = axis(friction)
    x = loop.initial(p, reference=-0.03)
    sliding = 30.0 + 15.0 * exp(-((0.03 / 0.02) ** 2)) + 70.0 * 0.03
    assert x[names(loop.states).index("pid.command")] == pytest.approx(-sliding, rel=1e-8)
    still = respond(loop, Step(0.1, at=0.02, initial=-0.03, horizon=0.04), p)
    assert still["speed"][still.t < 0.02] == pytest.approx(-0.03, abs=1e-9)


def test_a_spring_lets_no_motion_be_steady() -> None:
    loop = ClosedLoop(ForceDrive(Viscous(), Load(spring=True)).system(), PID())
    p = loop.parameters.with_values({"pid.Ki": 10.0, "load.stiffness": 100.0})
    with pytest.raises(ConvergenceError, match=r"neither rests nor moves steadily at speed 0.2 m/s: .*give x_plant"):
        evaluate(loop, Step(0.1, initial=0.2), p)


@pytest.mark.parametrize(("size", "initial"), [(0.1, 0.0), (0.3, 0.05), (-0.1, 0.2), (-0.3, 0.1)])
def test_a_mirrored_step_has_the_same_metrics(size: float, initial: float) -> None:
    """From rest and from motion, braking and through zero, with the command at its limits."""
    loop, p = axis(Stribeck())
    one, other = (
        evaluate(loop, Step(sign * size, initial=sign * initial, horizon=0.5), p).iloc[:, 0] for sign in (1, -1)
    )
    mirrored = ["SettlingMin", "SettlingMax", "Peak", "SteadyStateValue"]
    same = one.index.difference(mirrored)
    assert one[same].to_numpy() == pytest.approx(other[same].to_numpy(), rel=1e-5, abs=1e-6, nan_ok=True)
    assert one["Peak"] == pytest.approx(-other["Peak"], rel=1e-6)
    assert one["SettlingMin"] == pytest.approx(-other["SettlingMax"], rel=1e-6)
    assert one["SettlingTime"] < 0.5
    assert one["Overshoot"] > 1
    if abs(size) > 0.2:
        assert one["PeakControl"] == 60.0


def test_a_cylinder_brakes_reverses_and_runs_back() -> None:
    loop, p = cylinder(LuGre())
    steps = [
        Step(-0.2, initial=0.2, horizon=0.4, start={"position": 0.05}),
        Step(-0.4, initial=0.2, horizon=0.4, start={"position": 0.12}),
        Step(-0.2, horizon=0.4, start={"position": 0.15}),
    ]
    found = evaluate(loop, steps, p, band=0.1)
    assert bool((found.loc["SettlingTime"] < 0.4).all())
    assert found.loc["SteadyStateValue"].to_numpy() == pytest.approx([0.0, -0.2, -0.2], abs=0.02)
    assert bool((found.loc["PeakControl"] > 0.5).all())
    assert respond(loop, steps[2], p)["position"][0] == 0.15


def test_an_ideal_rig_certifies_what_the_simulation_does() -> None:
    loop, p = axis(Karnopp(Stribeck()))
    p = p.with_values({"dither.amplitude": 5.0})
    rig = Rig(loop, {"speed": Sensor()})
    steps = [Step(0.1, horizon=0.3), Step(-0.15, initial=0.1, horizon=0.3)]
    real, smooth = evaluate(rig, steps, p), evaluate(loop, steps, p)
    for n in ("Overshoot", "SteadyStateError", "PeakControl"):
        assert real.loc[n].to_numpy() == pytest.approx(smooth.loc[n].to_numpy(), rel=0.02, abs=0.1), n
    assert "MaxSensitivity" not in real.index
    assert "MaxSensitivity" in smooth.index


def test_a_rig_is_certified_by_the_truth_and_starts_in_motion() -> None:
    """Its encoder knows the speed at which it starts; hysteresis and counts make it worse than the simulation."""
    loop, p = cylinder(Karnopp(Stribeck()))
    rig = Rig(loop, {"position": Sensor(resolution=1e-5)}, Actuator(hysteresis=0.04), Encoder(filter=5e-3))
    step = Step(0.1, at=0.1, initial=0.1, horizon=0.5, start={"position": 0.05})
    run = respond(rig, step, p)
    assert run["position"][0] == 0.05
    assert run["speed"][run.t <= 0.1] == pytest.approx(0.1, abs=0.01)
    real, ideal = (evaluate(model, step, p)[step.label] for model in (rig, loop))
    assert real["Overshoot"] > ideal["Overshoot"]
    assert real["SteadyStateValue"] == pytest.approx(0.2, abs=0.01)


def test_an_end_stop_is_no_certificate() -> None:
    loop, p = cylinder(Stribeck())
    fast = p.with_values({"pid.Kp": 2.0, "pid.b": 3.0})
    with pytest.warns(PhysicsWarning, match=r"front end stop .* at t = 0\.[23]"):
        evaluate(loop, Step(0.3, horizon=0.33), fast)
    free = fast.with_bounds({"pid.Kp": (2.0, 3.0)}).freed("pid.Kp")
    method = Racing(members=5, trials=1, polish=0)
    result = tune(loop, Step(0.3, horizon=0.33), free, minimise=IAE(), method=method, throw=False, plants={})
    assert result.status.code is Code.NOT_CERTIFIED
    assert "front end stop" in result.status.message
    assert "shorten the horizon" in result.status.message
    assert result.parameters.value("pid.Kp") == 2.0
    assert result.stats["contacts"] >= 1


def test_a_horizon_longer_than_the_stroke_allows_is_refused() -> None:
    """0.3 m/s from the middle of 200 mm: evaluated, certified and simulated alike, of a rig and on a scenario, too."""
    loop, p = cylinder(Stribeck())
    words = r"reference 0 to 0.3: it leads the piston over 180 mm.*99.9 mm; end it by horizon = 0.333 s"
    calls: list[Callable[..., object]] = [evaluate, certificate, respond]
    for call in calls:
        with pytest.raises(InputError, match=words):
            call(loop, Step(0.3, horizon=0.6), p)
    with pytest.raises(InputError, match=words):
        evaluate(Rig(loop, {"position": Sensor(resolution=1e-5)}), Step(0.3, horizon=0.6), p)
    with pytest.raises(InputError, match=r"reference 0 to 0.3 \[short\]: .* there are 74.9 mm"):
        evaluate(loop, Step(0.3, horizon=0.3), p, scenarios={"short": {"cylinder.stroke": 0.15}})


def test_hunting_is_measured_and_a_ringing_that_dies_out_is_not() -> None:
    """The paper's gains hunt on its drive under LuGre friction at 10 mm/s, and settle at 50 mm/s."""
    drive, values = r25(lugre=True)
    loop = ClosedLoop(drive.system(), PID(), measured="speed")
    p = (loop.parameters | values).with_values({"pid.Kp": 4.5, "pid.Ki": 24.6, "pid.Kd": 0.2, "pid.Tf": 0.01})
    hunting = evaluate(loop, Step(0.01, horizon=5.0), p)["0 to 0.01"]
    assert hunting["LimitCycleAmplitude"] > 0.005
    assert 1.0 < hunting["LimitCycleFrequency"] < 3.0
    calm = evaluate(loop, Step(0.05, horizon=2.0), p)["0 to 0.05"]
    assert calm["LimitCycleAmplitude"] == 0.0
    assert np.isnan(calm["LimitCycleFrequency"])


def late_response(Kp: float, Ki: float, h: float, horizon: float) -> Array:
    """``dy/dt = -y + u(t - 1)`` under a PI after a step of 1, by the method of steps: RK4, the command by cubics."""
    late, count = round(1 / h), round(horizon / h)
    y, integral = np.zeros(count + 1), 0.0
    u = np.full(count + 1, Kp)
    for k in range(count):
        first, middle, last = 0.0, 0.0, 0.0
        if k >= late:
            j = k - late
            i = max(j - 1, 0)  # four of the commands about the step, of which the middle is wanted
            weights = (5, 15, -5, 1) if i == j else (-1, 9, 9, -1)
            first, middle, last = u[j], np.dot(weights, u[i : i + 4]) / 16, u[j + 1]
        k1 = first - y[k]
        k2 = middle - y[k] - h / 2 * k1
        k3 = middle - y[k] - h / 2 * k2
        k4 = last - y[k] - h * k3
        y[k + 1] = y[k] + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        between = (y[k] + y[k + 1]) / 2 + h / 8 * (k1 - (last - y[k + 1]))
        integral += Ki * h / 6 * (6 - y[k] - 4 * between - y[k + 1])
        u[k + 1] = Kp * (1 - y[k + 1]) + integral
    return y


@pytest.mark.parametrize("order", [1, 3])
def test_a_dead_time_is_the_delay_itself_whatever_a_files_order(order: int) -> None:
    loop = ClosedLoop(FirstOrder(pade_order=order).system(), PID(limits=False))
    values = {"plant.time_constant": 1.0, "plant.dead_time": 1.0, "pid.Kp": 0.6, "pid.Ki": 0.5}
    found = evaluate(loop, Step(1.0, horizon=20.0), loop.parameters.with_values(values)).iloc[:, 0]
    h = 0.002
    y = late_response(0.6, 0.5, h, 20.0)
    assert found["Overshoot"] == pytest.approx(100 * (y.max() - 1), abs=1e-3)
    assert found["IAE"] == pytest.approx(np.trapezoid(np.abs(1 - y), dx=h), rel=1e-5)
    assert found["SettlingTime"] == pytest.approx(h * np.flatnonzero(np.abs(y - 1) > 0.02)[-1], abs=h)
