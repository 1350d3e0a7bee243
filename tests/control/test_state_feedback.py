"""Feedback of pressure and acceleration: hand recursions, and margins of the exactly sampled loop by python-control."""

import numpy as np
import pytest
from scipy.optimize import brentq

from pneuopt.control.acceleration_feedback import AccelerationFeedback
from pneuopt.control.compensation import Compensator
from pneuopt.control.dead_zone_inverse import DeadZoneInverse
from pneuopt.control.linear_loop import noise_path, open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.pressure_feedback import PressureFeedback
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import names
from pneuopt.evaluation.batch_margins import batch_margin_function
from pneuopt.evaluation.margins import frequency_response, margins, noise_gain
from pneuopt.evaluation.record import record
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.models import catalog
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

control = pytest.importorskip("control")
H = 1e-3
GAINS = {"pid.Kp": 40.0, "pid.Ki": 30.0, "pid.Kd": 1.5, "pid.Tf": 4e-3}
PRESSURE = {"pressure_feedback.gain": 2e-6, "pressure_feedback.time": 0.08}
ACCELERATION = {"acceleration_feedback.gain": 0.02, "acceleration_feedback.filter": 6e-3}


def pneumatic_loop(
    *parts: Compensator, sample_time: float | None = H, delay: int = 0, sensor: Encoder | SensorLag | None = None
) -> ClosedLoop:
    pid = PID(sample_time, limits=False, delay=delay)
    return ClosedLoop(catalog.t32()[0].system(), pid, measured="position", sensor=sensor, compensators=parts)


def given_values(loop: ClosedLoop, values: dict[str, float]) -> ParameterSet:
    known = catalog.t32()[1] | loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    return known.with_values({n: v for n, v in (GAINS | values).items() if n in known})


def steady_motion(speed: float) -> tuple[Array, dict[str, float]]:
    """The drive's state and command in steady motion at 0.1 m."""
    drive, hardware = catalog.t32()
    found = drive.rest(hardware, position=0.1, speed=speed)
    return np.array([found.states[q.name] for q in drive.states]), dict(found.inputs)


def commands(loop: ClosedLoop, p: ParameterSet, signals: Array) -> Array:
    """The commands of a sampled loop whose position and pressures are those of the rows."""
    x = loop.initial(p, reference=signals[0, 0])
    order, vector = names(loop.states), loop.parameter_vector(p)
    moved, held = [order.index(n) for n in ("position", "pressure_a", "pressure_b")], order.index("pid.command")
    x[order.index("pid.integral")] = x[order.index("pid.derivative")] = 0.0
    x[order.index("pid.previous_error")] = 0.0
    found = []
    for row in signals:
        x[moved] = row
        x = np.array(loop.update(0.0, x, np.full(len(loop.inputs), signals[0, 0]), vector)).ravel()
        found.append(x[held])
    return np.array(found)


def test_the_commands_are_those_of_hand_recursions() -> None:
    loop, rng = pneumatic_loop(PressureFeedback(), AccelerationFeedback()), np.random.default_rng(5)
    p = given_values(loop, PRESSURE | ACCELERATION)
    signals = np.array([0.1, 4e5, 5e5]) + np.cumsum(rng.normal(size=(300, 3)) * [1e-4, 2e3, 2e3], axis=0)
    signals[0] = loop.initial(p, reference=0.1)[[0, 2, 3]]
    r = before = signals[0, 0]
    expected, integral, derivative, error, speed = [], 0.0, 0.0, 0.0, 0.0
    slow, T, f = signals[0, 1] - signals[0, 2], 0.08, 6e-3
    for y, a, b in signals:
        e = r - y
        integral += 30.0 * H * e
        derivative = (4e-3 * derivative + 1.5 * (e - error)) / (4e-3 + H)
        error = e
        slow = (T * slow + H * (a - b)) / (T + H)
        rate = (y - before) / (f + H)
        before = (f * before + H * y) / (f + H)
        acceleration = (rate - speed) / (f + H)
        speed = (f * speed + H * rate) / (f + H)
        expected.append(40.0 * e + integral + derivative - 2e-6 * (a - b - slow) - 0.02 * acceleration)
    np.testing.assert_allclose(commands(loop, p, signals), expected, rtol=1e-12, atol=1e-12)


def sampled_by_hand(
    loop: ClosedLoop, p: ParameterSet, x: Array, u: dict[str, float], delay: int
) -> tuple[Array, Array, Array]:
    """Frequencies, the loop's response at them and the PID's, by python-control from the plant's matrices."""
    plant = loop.plant.linearise(x, u, p)
    every = control.sample_system(control.ss(plant.A, plant.B, plant.C, plant.D), H, "zoh")
    w = np.geomspace(0.05, 0.999 * np.pi / H, 20000)
    response, z = every(np.exp(1j * w * H)), np.exp(1j * w * H)
    y, a, b = (response[plant.outputs.index(n), 0] for n in ("position", "pressure_a", "pressure_b"))
    pid = 40.0 + 30.0 * H * z / (z - 1) + 1.5 * (z - 1) / ((4e-3 + H) * z - 4e-3)
    T, f = 0.08, 6e-3
    passed = 2e-6 * T * (z - 1) / ((T + H) * z - T)
    twice = 0.02 * ((z - 1) / ((f + H) * z - f)) ** 2
    more = (PressureFeedback() in loop.compensators) * passed * (a - b)
    more = more + (AccelerationFeedback() in loop.compensators) * twice * y
    return w, z**-delay * (pid * y + more), pid + (AccelerationFeedback() in loop.compensators) * twice


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(
    "parts", [(PressureFeedback(),), (AccelerationFeedback(),), (PressureFeedback(), AccelerationFeedback())]
)
def test_margins_are_those_of_the_exactly_sampled_loop(parts: tuple[Compensator, ...], delay: int) -> None:
    loop = pneumatic_loop(*parts, delay=delay)
    p = given_values(loop, PRESSURE | ACCELERATION)
    x, u = steady_motion(0.2)
    linear = open_loop(loop, p, x, u)
    w, L, C = sampled_by_hand(loop, p, x, u, delay)
    warped = 2 / H * np.tan(w * H / 2)
    np.testing.assert_allclose(frequency_response(linear, warped[::100]), L[::100], rtol=1e-6)
    found = margins(linear)
    assert found.stable
    assert found.max_sensitivity == pytest.approx(np.abs(1 / (1 + L)).max(), rel=1e-5)
    assert found.max_complementary_sensitivity == pytest.approx(np.abs(L / (1 + L)).max(), rel=1e-5)
    noise = noise_gain(linear, noise_path(loop, p, x, u), 0.3)
    counts = w >= 0.3
    assert noise == pytest.approx(np.abs(C / (1 + L))[counts].max(), rel=1e-4)
    read = batch_margin_function(loop, np.geomspace(0.01, 20 / H, 600), 0.3)
    inputs = np.array([[[u.get(n, 0.0) for n in names(loop.plant.inputs)]]])
    only = ["MaxSensitivity", "PhaseMargin", "GainMargin", "NoiseGain"]
    in_search = read(loop.parameter_vector(p)[None], x[None, None], inputs, only)
    assert in_search["MaxSensitivity"][0] == pytest.approx(found.max_sensitivity, rel=1e-3)
    assert in_search["PhaseMargin"][0] == pytest.approx(found.phase_margin, abs=0.1)
    assert in_search["GainMargin"][0] == pytest.approx(found.gain_margin, rel=2e-3)
    assert in_search["NoiseGain"][0] == pytest.approx(noise, rel=1e-3)


@pytest.mark.parametrize("sensor", [None, Encoder(1e-5), SensorLag(2e-3)])
def test_a_gain_of_zero_has_the_margins_of_the_plain_loop(sensor: Encoder | SensorLag | None) -> None:
    """The plain loop counts as its continuous equivalent, which is as good as exact well below the sampling rate."""
    plain, other = (pneumatic_loop(*parts, sensor=sensor) for parts in ((), (PressureFeedback(), DeadZoneInverse())))
    p = given_values(other, {})
    at = steady_motion(0.2)
    found, expected = (margins(open_loop(loop, given_values(loop, {}), *at)) for loop in (other, plain))
    assert found.max_sensitivity == pytest.approx(expected.max_sensitivity, rel=2e-3)
    assert found.phase_margin == pytest.approx(expected.phase_margin, abs=0.3)
    shaped = p.with_values({"dead_zone_inverse.width": 0.15, "dead_zone_inverse.smoothing": 0.3})
    v = brentq(lambda v: v + 0.15 * np.tanh(v / 0.3) - at[1]["valve_voltage"], 0.0, 1.0)
    slope = 1 + 0.15 / 0.3 * (1 - np.tanh(v / 0.3) ** 2)
    steeper = given_values(plain, {n: slope * v for n, v in GAINS.items() if n != "pid.Tf"})
    found, expected = margins(open_loop(other, shaped, *at)), margins(open_loop(plain, steeper, *at))
    assert slope > 1.1
    assert found.max_sensitivity == pytest.approx(expected.max_sensitivity, rel=2e-3)


def test_a_continuous_loop_has_the_poles_of_its_own_jacobian() -> None:
    loop = pneumatic_loop(PressureFeedback(), AccelerationFeedback(), sample_time=None)
    p = given_values(loop, PRESSURE | ACCELERATION)
    state = loop.initial(p, reference=0.1)
    order = names(loop.states)
    linear = open_loop(
        loop, p, state[: len(loop.plant.states)], {loop.command.name: state[order.index("pid.integral")]}
    )
    found = np.linalg.eigvals(linear.A - linear.B @ linear.C / (1 + linear.D[0, 0]))
    expected = np.linalg.eigvals(loop.system().linearise(state, {"reference": 0.1}, p).A)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-5, atol=1e-4)


def test_a_rigs_pressures_reach_the_controller_with_their_noise() -> None:
    loop = pneumatic_loop(PressureFeedback())
    p = given_values(loop, PRESSURE | {"pressure_feedback.gain": 1e-5})
    t = np.arange(60) * H
    still = Trajectory(t, {"reference": np.full(len(t), 0.1)})
    sensors = {"position": Sensor(), "pressure_a": Sensor(noise=1e3), "pressure_b": Sensor()}
    quiet, noisy = (
        record(Rig(loop, own), still, p, initial=loop.initial(p, reference=0.1)).experiment.trajectory
        for own in (dict.fromkeys(sensors, Sensor()), sensors)
    )
    assert np.ptp(quiet["valve_voltage"]) < 1e-4
    pressure = noisy["pressure_a"] - quiet["pressure_a"]
    np.testing.assert_allclose(np.std(noisy["valve_voltage"][1:]), 1e-5 * np.std(pressure), rtol=0.1)
    with pytest.raises(ModelError, match="reads pressure_b, which no sensor measures"):
        Rig(loop, {n: s for n, s in sensors.items() if n != "pressure_b"})
