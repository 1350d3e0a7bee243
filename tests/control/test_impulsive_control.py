"""Pulses towards the reference: their recursion by hand, when they come, and what they do for a body that sticks."""

import numpy as np
import pytest

from pneuopt.control.impulsive_control import ImpulsiveControl
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.position_loop import PositionLoop
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate_stick_slip
from pneuopt.dynamics.system import System, names
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.trajectories import Trajectory

H, COUNT = 1e-3, 1e-5  # [s, m]
GIVEN = {"amplitude": 2.0, "limit": 2.5, "width": 8e-3, "pause": 3e-3, "tolerance": 1e-4, "growth": 1.1, "brake": 0.6}


def pulses_by_hand(errors: Array, speeds: Array) -> tuple[Array, set[str]]:
    """What is added at each sample, from the errors and the reference's speeds, and what has happened."""
    added, seen = np.zeros(len(errors)), set()
    stood = standing = peak = before = ceiling = 0.0
    pulse: list[float] = []
    for k, (e, v) in enumerate(zip(errors.tolist(), speeds.tolist(), strict=True)):
        if v:
            seen |= {"cut"} if pulse else set()
            peak, ceiling, pulse = 0.0, 0.0, []
        still = not v and not pulse and abs(e - stood) < 0.2 * GIVEN["tolerance"]
        standing = standing + 1 if still else 0
        stood = stood if still else e
        if standing >= 3 and abs(e) > GIVEN["tolerance"]:
            way = (before - e) * np.sign(peak)
            ratio = 0.5 * abs(e) / max(way, 0.06 * GIVEN["tolerance"])
            factor = ratio ** (0.05 if ratio > 1 else 0.15)
            ceiling = 0.0 if peak * e < 0 else abs(peak) if ratio < 1 else ceiling
            most = min(1.1, max(1.02, np.sqrt(ceiling / abs(peak)))) if ceiling else 1.1
            seen |= {"first"} if not peak else {"grows"} if factor > 1.1 else {"more"} if ratio > 1 else {"less"}
            seen |= {"halves"} if 1.02 < most < min(1.1, factor) else {"creeps"} if 1.02 == most < factor else set()
            peak = float(np.sign(e)) * (abs(peak) * min(most, factor) if peak else 2.0)
            n = int(np.floor(8 * max(1.0, abs(peak) / 2.5) + 0.5))
            seen |= {"longer"} if n > 8 else set()
            wave = np.sin(2 * np.pi * (np.arange(n) + 0.5) / n)
            pulse = list(np.sign(peak) * min(abs(peak), 2.5) * np.where(wave > 0, wave, 0.6 * wave))
            before, standing = e, 0.0
        if pulse:
            added[k] = pulse.pop(0)
    return added, seen


@pytest.mark.parametrize("cascaded", [False, True])
def test_the_command_is_that_of_a_hand_recursion(cascaded: bool) -> None:
    """Of a part alone: the body is moved from outside, now and then, as a pulse might, and the reference, too."""
    plant, outer = ForceDrive(Viscous()).system(), PositionLoop() if cascaded else None
    pid, encoder = PID(H, limits=False), Encoder(COUNT, 4e-3)
    parts = (ImpulsiveControl(),)
    loop = ClosedLoop(plant, pid, measured="position", sensor=encoder, compensators=parts, outer=outer)
    values = {f"impulsive_control.{n}": v for n, v in GIVEN.items()} | {"pid.Kp": 0.0, "pid.Ki": 0.0}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    rng, n = np.random.default_rng(3), 3000
    moves = np.where(rng.random(n) < 0.03, rng.choice([2e-6, 4e-5, 3e-4, -2e-4], n), 0.0)
    speeds = np.where((np.arange(n) % 700) < 5, 0.05 * (-1.0) ** (np.arange(n) // 700), 0.0)
    speeds[1203] = 0.02
    reference, path = 5e-4 + H * np.cumsum(speeds), 4e-4 * np.sin(np.cumsum(moves) / 3e-4)
    errors = reference - COUNT * np.floor(path / COUNT + 0.5)
    expected, seen = pulses_by_hand(errors, speeds)
    x, order, found = np.zeros(len(loop.states)), names(loop.states), []
    for k, y in enumerate(path):
        x[order.index("position")] = y
        x = np.array(loop.update(k * H, x, [reference[k], speeds[k]], p)).ravel()
        found.append(x[order.index("pid.command")])
    assert seen == {"first", "grows", "more", "less", "halves", "creeps", "longer", "cut"}
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def standing_error(*, pulses: bool) -> tuple[float, float]:
    """Of a PD loop on an axis that sticks: the error after three seconds, and the travel over the last of them [m]."""
    plant, part = ForceDrive(Karnopp(Stribeck())).system(), ImpulsiveControl()
    loop = ClosedLoop(plant, PID(H), measured="position", sensor=Encoder(COUNT), compensators=(part,))
    values = {"friction.coulomb": 25.0, "friction.static": 40.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 60.0, "pid.Kp": 4000.0, "pid.Ki": 0.0, "pid.Kd": 150.0}
    own = {"amplitude": 10.0 if pulses else 0.0, "limit": 500.0, "width": 6e-3, "brake": 0.0, "tolerance": 5e-5}
    p = loop.parameters.with_values(values | {f"impulsive_control.{n}": v for n, v in own.items()})
    t = np.arange(0.0, 3.0, 0.01)
    moved = Trajectory(t, {"reference": np.full(len(t), 0.05), "reference_speed": np.zeros(len(t))})
    path = simulate_stick_slip(loop, moved, p).trajectory["position"]
    return abs(float(path[-1]) - 0.05), float(np.ptp(path[t >= 2.0]))


def test_a_body_that_sticks_is_brought_within_the_tolerance_and_stays() -> None:
    assert standing_error(pulses=False)[0] > 1e-3
    error, travel = standing_error(pulses=True)
    assert error < 6e-5
    assert travel == 0.0


def test_a_tolerance_within_a_count_is_refused() -> None:
    plant, part, cascade = ForceDrive(Viscous()).system(), ImpulsiveControl(), PositionLoop()
    loop = ClosedLoop(plant, PID(H), measured="position", sensor=Encoder(COUNT), compensators=(part,), outer=cascade)
    p = loop.parameters.with_values({"impulsive_control.tolerance": COUNT})
    loop.check(p)
    told = r"impulsive_control\.tolerance 1e-05 m lies within a count of the sensor, 1e-05: .*; take at least 2e-05"
    with pytest.raises(InputError, match=told):
        loop.check(p.with_values({"impulsive_control.amplitude": 1.0}))


def test_a_continuous_controller_is_refused(second_order: System) -> None:
    with pytest.raises(ModelError, match="an ImpulsiveControl counts samples: give the PID a sample_time"):
        ClosedLoop(second_order, PID(), compensators=(ImpulsiveControl(),))
