"""What each compensator does, against hand recursions and against plants that it makes simple."""

import numpy as np
import pytest

from pneuopt.control.dead_zone_inverse import DeadZoneInverse
from pneuopt.control.friction_feedforward import Direction, FrictionFeedforward
from pneuopt.control.knocker import Knocker
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.record import record
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, Viscous
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory


def sent_by(loop: ClosedLoop, p: ParameterSet, reference: np.ndarray, h: float) -> np.ndarray:
    """The commands of a sampled loop whose plant stands still at zero."""
    x, sent = np.zeros(len(loop.states)), []
    held, plant = names(loop.states).index("pid.command"), len(loop.plant.states)
    for k, r in enumerate(reference):
        x = np.array(loop.update(k * h, x, [r], loop.parameter_vector(p))).ravel()
        x[:plant] = 0.0
        sent.append(x[held])
    return np.array(sent)


@pytest.mark.parametrize(("width", "period"), [(1, 4), (3, 7), (2, 2), (9, 4)])
def test_pulses_are_those_of_the_papers_recursion(second_order: System, width: int, period: int) -> None:
    """``a sign(u(t) - u(t_p))`` from an onset for the width, t_p the onset before; a wide one joins the pulses."""
    h, rng = 2e-3, np.random.default_rng(0)
    u = np.cumsum(rng.normal(size=60))
    loop = ClosedLoop(second_order, PID(h, limits=False), compensators=(Knocker(),))
    values = {"knocker.amplitude": 0.25, "knocker.width": width * h, "knocker.period": period * h}
    p = loop.parameters.with_values({"pid.Kp": 1.0, **values, "knocker.smoothing": 1e-9})
    expected, onset, sign = [], 0.0, 0.0
    for k, now in enumerate(u):
        if k % period == 0:
            sign, onset = np.sign(now - onset), now
        expected.append(now + 0.25 * sign * (k % period < width))
    np.testing.assert_allclose(sent_by(loop, p, u, h), expected, atol=1e-12)


def test_it_knocks_while_the_integral_winds_up_and_is_quiet_at_rest(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(1e-3, limits=False), compensators=(Knocker(),))
    values = {"pid.Kp": 0.0, "pid.Ki": 5.0, "knocker.amplitude": 0.3}
    p = loop.parameters.with_values(values)
    reference = np.concatenate([np.full(200, 1.0), np.zeros(200)])
    plain = np.cumsum(5e-3 * reference)
    pulses = sent_by(loop, p, reference, 1e-3) - plain
    assert pulses[:200].max() == pytest.approx(0.3 * np.tanh(0.05 / 0.01))
    np.testing.assert_allclose(pulses[:200] > 0.1, np.arange(200) % 10 < 2)
    np.testing.assert_allclose(pulses[211:], 0.0, atol=1e-12)


def test_measured_feedforward_leaves_a_frictionless_axis() -> None:
    """With the friction's own level and smoothing, Coulomb friction is as good as gone."""
    rough, smooth = ForceDrive(Coulomb()).system(), ForceDrive(Viscous()).system()
    loop = ClosedLoop(rough, PID(), compensators=(FrictionFeedforward(Direction.MEASURED),))
    plain = ClosedLoop(smooth, PID())
    gains = {"pid.Kp": 60.0, "pid.Ki": 500.0}
    level, within = (rough.parameters.value(f"friction.{n}") for n in ("coulomb", "smoothing"))
    own = {"friction_feedforward.level": level, "friction_feedforward.smoothing": within}
    t = np.linspace(0.0, 1.0, 201)
    wave = Trajectory(t, {"reference": 0.1 * np.sin(2 * np.pi * t)})
    given = loop.parameters.with_values({**gains, **own})
    shared = given.select(n for n in given if n in plain.parameters)
    found, expected = (simulate(one, wave, p, rtol=1e-9) for one, p in ((loop, given), (plain, shared)))
    np.testing.assert_allclose(found["speed"], expected["speed"], atol=1e-7)
    bare = simulate(loop, wave, given.with_values({"friction_feedforward.level": 0.0}), rtol=1e-9)
    assert np.abs(bare["speed"] - expected["speed"]).max() > 0.02


def test_referred_feedforward_pushes_as_the_reference_goes(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(limits=False), compensators=(FrictionFeedforward(),))
    own = {"pid.Kp": 0.0, "friction_feedforward.level": 0.7, "friction_feedforward.smoothing": 0.01}
    p = loop.parameter_vector(loop.parameters.with_values(own))
    sent = [float(loop.system().ode(0.0, np.zeros(4), [r], p)[1][-1]) for r in (0.3, 0.0, -0.3, 0.01)]
    np.testing.assert_allclose(sent, [0.7, 0.0, -0.7, 0.7 * np.tanh(1.0)], atol=1e-12)


def test_a_loop_without_integral_rests_where_compensator_and_gain_balance(second_order: System) -> None:
    """Of the plant with the gain G at rest: ``y = G (v + width tanh(v/smoothing))`` with ``v = Kp (r - y)``."""
    loop = ClosedLoop(second_order, PID(limits=False), compensators=(DeadZoneInverse(),))
    values = {"pid.Kp": 0.2, "dead_zone_inverse.width": 0.01, "dead_zone_inverse.smoothing": 0.02}
    p = loop.parameters.with_values(values)
    x = loop.initial(p, reference=0.1)
    v = 0.2 * (0.1 - x[0])
    assert x[0] == pytest.approx(1270.12 / 86.34 * (v + 0.01 * np.tanh(v / 0.02)), rel=1e-9)
    assert x[2] == pytest.approx(0.0, abs=1e-12)


def test_the_inverse_gives_back_what_a_dead_zone_takes() -> None:
    """On a rig whose actuator has a dead zone of 6 N the axis moves as one without it, beyond the smoothing."""
    drive, h = ForceDrive(Viscous()).system(), 2e-3
    plain, undone = (ClosedLoop(drive, PID(h), compensators=c) for c in ((), (DeadZoneInverse(),)))
    values = {"pid.Kp": 60.0, "pid.Ki": 400.0, "dead_zone_inverse.width": 6.0, "dead_zone_inverse.smoothing": 1e-3}
    p = undone.parameters.with_values(values)
    t = np.arange(500) * h
    wave = Trajectory(t, {"reference": 0.2 * np.sin(2 * np.pi * t)})

    def speed(loop: ClosedLoop, zone: float) -> np.ndarray:
        given = p.select(n for n in p if n in loop.parameters)
        return record(Rig(loop, {"speed": Sensor()}, Actuator(dead_zone=zone)), wave, given).truth["speed"]

    expected = speed(plain, 0.0)
    assert np.abs(speed(undone, 6.0) - expected).max() < 2e-4
    assert np.abs(speed(plain, 6.0) - expected).max() > 0.02
