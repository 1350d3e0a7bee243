"""Margins at the operating points that a step passes; what mutants of them would leave out."""

from dataclasses import replace

import control
import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System, define
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.margins import margins
from pneuopt.evaluation.operating_points import operating_point_margins, operating_points, worst_margins
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import LuGre, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

MARGINS = ["MaxSensitivity", "MaxComplementarySensitivity", "GainMargin", "PhaseMargin"]
GAINS = {"pid.Kp": 4000.0, "pid.Ki": 300.0, "pid.Kd": 20.0, "pid.Tf": 2e-3}


def positioner() -> tuple[ClosedLoop, ParameterSet, Step]:
    """A position loop that is well damped where friction is steep and rings where it slides (80 N s/m, 5 kg)."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(1e-3), measured="position")
    return loop, loop.parameters.with_values({"friction.viscous": 80.0, **GAINS}), Step(0.05, horizon=0.5)


def test_the_margins_of_a_position_loop_are_those_of_its_sliding_body() -> None:
    """At its end, where it sticks, nothing seems wrong; sliding it has the phase margin of P = 1/(5 s^2 + 80 s)."""
    loop, p, step = positioner()
    response = respond(loop, step, p)
    table = operating_point_margins(loop, p, step, response).set_index("point")
    assert list(table.index) == ["at rest", "sliding", "at the end"]
    assert table["FrictionSlope"]["at rest"] > 1e4
    assert 70 < table["FrictionSlope"]["sliding"] < 90
    s, (Kp, Ki, Kd, Tf) = control.tf("s"), GAINS.values()
    numerator, denominator = control.pade(5e-4, 2)
    C = Kp + Ki * 5e-4 + Ki / s + Kd * s / ((Tf + 5e-4) * s + 1)
    L = C * control.tf(numerator, denominator) / (5 * s**2 + table["FrictionSlope"]["sliding"] * s)
    assert table["PhaseMargin"]["sliding"] == pytest.approx(control.stability_margins(L)[1], rel=1e-3)
    assert table["MaxSensitivity"]["sliding"] > 1.5 * table["MaxSensitivity"]["at the end"]
    found = evaluate(loop, step, p)[step.label]
    assert found["MaxSensitivity"] == table["MaxSensitivity"].max()
    assert found["PhaseMargin"] == table["PhaseMargin"].min()
    assert found["FrictionSlope"] == table["FrictionSlope"].min()


def test_the_points_are_those_of_the_response() -> None:
    loop, p, step = positioner()
    response = respond(loop, step, p)
    rest, sliding, end = operating_points(loop, p, step, response)
    assert (rest.x.tolist(), rest.inputs["force"]) == ([0.0, 0.0], 0.0)
    fastest = np.argmax(np.abs(response["speed"]))
    assert sliding.x[1] == pytest.approx(response["speed"][fastest], rel=1e-3)
    assert sliding.t == pytest.approx(response.t[fastest], abs=2e-3)
    assert end.x.tolist() == [response["position"][-1], response["speed"][-1]]
    moving = Step(0.1, at=0.02, initial=0.05, horizon=0.4)
    speed = ClosedLoop(ForceDrive(Stribeck()).system(), PID(1e-3))
    q = speed.parameters.with_values({"pid.Kp": 200.0, "pid.Ki": 2000.0})
    names = [point.name for point in operating_points(speed, q, moving, respond(speed, moving, q))]
    assert names == ["at the start", "sliding", "at the end"]


def test_a_linear_plant_has_one_point() -> None:
    loop = ClosedLoop(SecondOrder().system(), PID())
    p = loop.parameters.with_values({"pid.Kp": 0.2, "pid.Ki": 1.0})
    assert len(operating_points(loop, p, Step(1.0), respond(loop, Step(1.0), p))) == 1


def test_under_dither_the_points_are_means() -> None:
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID(), Dither(100.0))
    p = loop.parameters.with_values({"pid.Kp": 200.0, "pid.Ki": 2000.0, "dither.amplitude": 30.0})
    step = Step(0.2, horizon=0.5)
    response = respond(loop, step, p)
    points = operating_points(loop, p, step, response)
    period = response.t > 0.49 - 1e-9
    last, speed = response.t[period], response["speed"][period]
    mean = np.trapezoid(speed, last) / 0.01 + 0.5 * (speed[-1] - speed[0])  # of the period around the end
    assert points[-1].x[1] == pytest.approx(mean, rel=1e-6)
    assert np.ptp(speed) > 0.01
    assert 0.999 * mean <= points[1].x[1] < response["speed"].max()


def test_margins_do_not_jump_where_a_dither_begins(light_cylinder: tuple[ClosedLoop, ParameterSet, Step]) -> None:
    loop, p, step = light_cylinder
    step = replace(step, horizon=0.2)
    found = [
        operating_point_margins(loop, q, step, respond(loop, step, q)).set_index("point")[["t", *MARGINS]]
        for q in (p.with_values({"dither.amplitude": a}) for a in (0.0, 1e-12, 1e-3))
    ]
    assert 3 < found[0]["MaxSensitivity"]["sliding"] < 5
    for table in found[1:]:
        np.testing.assert_allclose(table, found[0], rtol=1e-3)


def test_unstable_at_one_point_is_unstable() -> None:
    rows = [
        {"MaxSensitivity": 1.5, "GainMargin": 0.3, "PhaseMargin": -50.0, "NoiseGain": 9.0, "FrictionSlope": 5.0},
        {"MaxSensitivity": 1.2, "GainMargin": 4.0, "PhaseMargin": 40.0, "NoiseGain": 3.0, "FrictionSlope": -2.0},
    ]
    worst = worst_margins(rows)
    assert worst == {
        "MaxSensitivity": 1.5,
        "GainMargin": 0.3,
        "PhaseMargin": 40.0,
        "NoiseGain": 3.0,
        "FrictionSlope": -2.0,
    }
    broken = worst_margins([*rows, {n: np.inf if n in ("MaxSensitivity", "NoiseGain") else np.nan for n in rows[0]}])
    assert broken["MaxSensitivity"] == np.inf
    assert np.isnan(broken["PhaseMargin"])


def gained() -> System:
    """A lag whose gain is an input of its own, and rises with it."""
    x, u, gain = Quantity("x", "1"), Quantity("u", "1"), Parameter(1.0, "1")
    return define(
        [x], [u], [x], ParameterSet({"gain": gain}), lambda _t, x, u, p: ({"x": p["gain"] * u["u"] - x["x"]}, dict(x))
    )


def test_margins_are_those_of_the_disturbed_plant() -> None:
    """A gain that rises tenfold with the step: the loop rings afterwards, not before."""
    loop, step = ClosedLoop(gained(), PID(0.05)), Step(1.0, horizon=4.0, disturbance={"gain": 9.0})
    p = loop.parameters.with_values({"pid.Kp": 0.0, "pid.Ki": 2.0, "pid.Kd": 0.0, "pid.Tf": 0.01, "gain": 1.0})
    disturbed = ClosedLoop(gained(), PID(0.05))
    before, after = (margins(open_loop(disturbed, p.with_values({"gain": g}))).max_sensitivity for g in (1.0, 10.0))
    assert after > 2 * before
    assert evaluate(loop, step, p).iloc[:, 0]["MaxSensitivity"] == pytest.approx(after, rel=1e-6)
    whole = add_disturbances(loop, [step])
    response = respond(loop, step, p)
    table = operating_point_margins(whole, whole.complete(p), step, response).set_index("point")
    assert table["MaxSensitivity"].tolist() == pytest.approx([before, after], rel=1e-6)


def test_the_friction_slope_is_that_of_bristles_that_follow() -> None:
    """LuGre's steady force falls by Stribeck's curve; at a fixed deflection of the bristles it would only rise."""
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID())
    p = loop.parameters.with_values({"pid.Kp": 3000.0, "pid.Ki": 10000.0})
    step = Step(0.01, initial=0.01, horizon=0.2)
    start = operating_point_margins(loop, p, step, respond(loop, step, p)).iloc[0]
    coulomb, static, v_s, viscous = (
        p.value(f"friction.{n}") for n in ("coulomb", "static", "stribeck_velocity", "viscous")
    )
    v = 0.01
    slope = viscous - 2 * v / v_s**2 * (static - coulomb) * np.exp(-((v / v_s) ** 2))
    assert start["FrictionSlope"] == pytest.approx(slope, rel=1e-3)
    assert slope < 0


@pytest.mark.parametrize("growth", [1e-4, -1e-4])
def test_a_slow_growth_is_instability(growth: float) -> None:
    """One part in ten thousand of the fastest pole: it doubles in seven seconds."""
    x, y, u = Quantity("x", "1"), Quantity("y", "1"), Quantity("u", "1")
    signals = ([x, y], [u], [x], ParameterSet())
    plant = define(
        *signals,
        lambda _t, x, u, _p: ({"x": 0.1 * x["x"] + x["y"], "y": 1e3 * (u["u"] - x["y"])}, {"x": x["x"]}),
    )
    loop = ClosedLoop(plant, PID())
    p = loop.parameters.with_values({"pid.Kp": 0.1 - 1e3 * growth, "pid.Ki": 0.0, "pid.Kd": 0.0, "pid.Tf": 1e-3})
    assert margins(open_loop(loop, p)).stable == (growth < 0)
