"""The rig: ideal hardware changes nothing, each imperfection does what it says, the log is what a rig would know."""

from itertools import pairwise
from math import exp, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.rig import Actuator, Recording, Rig, Sensor, record
from pneuopt.identification.identify import identify
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import FrictionModel, Karnopp, Stribeck
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

FRICTION = {"friction.coulomb": 30.0, "friction.static": 45.0, "friction.viscous": 40.0, "load.mass": 3.0}
REAL = {"position": Sensor(lag=5e-4, noise=1e-6, resolution=1e-5)}


def drive_loop(friction: FrictionModel, **pid: float) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(friction).system(), PID(sample_time=1e-3), Dither(frequency=80.0))
    gains = {"Kp": 400.0, "Ki": 4000.0, "lower": -200.0, "upper": 200.0} | pid
    values = FRICTION | {"dither.amplitude": 5.0} | {f"pid.{n}": v for n, v in gains.items()}
    return loop, loop.parameters.with_values(values)


def step(size: float, seconds: float = 0.4, h: float = 1e-3) -> Trajectory:
    t = h * np.arange(round(seconds / h) + 1)
    return Trajectory(t, {"reference": size * (t > 0.02)})


@pytest.mark.parametrize("friction", [Stribeck(), Karnopp(Stribeck())])
def test_a_rig_of_ideal_hardware_is_the_simulation(friction: FrictionModel) -> None:
    loop, p = drive_loop(friction)
    run = record(Rig(loop, {"speed": Sensor()}), step(0.05), p, rtol=1e-10)
    exact = simulate(loop, step(0.05), p)
    for name in run.truth:
        assert run.truth[name] == pytest.approx(exact[name], abs=1e-8), name
    assert np.array_equal(run.experiment.trajectory["speed"], run.truth["speed"])
    assert np.array_equal(run.experiment.trajectory["force"], run.truth["control"])
    assert run.experiment.noise == {}


def test_the_same_seed_gives_the_same_log_and_another_one_only_other_noise() -> None:
    plant = ForceDrive(Karnopp(Stribeck())).system()
    t = np.linspace(0, 0.3, 301)
    push = Trajectory(t, {"force": 80 * np.sin(2 * pi * 5 * t)})
    rig = Rig(plant, REAL)
    one, again, other = (record(rig, push, plant.parameters, seed=s) for s in (1, 1, 2))
    assert np.array_equal(one.experiment.trajectory["position"], again.experiment.trajectory["position"])
    assert not np.array_equal(one.experiment.trajectory["position"], other.experiment.trajectory["position"])
    assert np.array_equal(one.truth["position"], other.truth["position"])
    assert one.events == other.events
    assert len(one.events) > 2
    assert one.parameters is plant.parameters


def test_readings_lag_are_noisy_and_rounded_as_said() -> None:
    """An integrator at unit speed: a lag of tau shows a ramp tau late, once it has settled."""
    plant = Integrator().system()
    p, t = plant.parameters.with_values({"plant.gain": 1.0}), np.linspace(0, 4, 4001)
    name, (output,) = plant.inputs[0].name, plant.outputs
    ramp = Trajectory(t, {name: np.ones(len(t))})
    lagging = record(Rig(plant, {output.name: Sensor(lag=0.05)}), ramp, p).experiment.trajectory[output.name]
    assert lagging == pytest.approx(t - 0.05 * (1 - np.exp(-t / 0.05)), abs=1e-7)
    digital = record(Rig(plant, {output.name: Sensor(noise=2e-3, resolution=5e-3)}), ramp, p).experiment
    reading = digital.trajectory[output.name]
    assert reading / 5e-3 == pytest.approx(np.round(reading / 5e-3), abs=1e-9)
    assert np.std(reading - t) == pytest.approx(digital.noise[output.name], rel=0.05)
    assert digital.noise[output.name] == pytest.approx(np.hypot(2e-3, 5e-3 / np.sqrt(12)))


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=50), st.floats(0, 4))
def test_play_keeps_its_distance_and_forgets_nothing_inside(commands: list[float], width: float) -> None:
    actuator, spool = Actuator(hysteresis=width), 0.0
    for command in commands:
        before, spool = spool, actuator.apply_hysteresis(command, spool)
        assert abs(command - spool) <= width / 2 + 1e-12
        if abs(command - before) <= width / 2:
            assert spool == before


def test_the_plant_gets_what_hysteresis_and_dead_zone_leave() -> None:
    """A triangle of 1 V through a loop 0.4 V wide, then a dead zone of 0.1 V."""
    plant = FirstOrder().system()
    t = np.linspace(0, 4, 401)
    command = np.interp(t % 4, [0, 1, 3, 4], [0, 1, -1, 0])
    rig = Rig(plant, {"speed": Sensor()}, Actuator(hysteresis=0.4, dead_zone=0.1))
    run = record(rig, Trajectory(t, {"valve_voltage": command}), plant.parameters)
    got = run.truth["control"]
    assert np.array_equal(run.experiment.trajectory["valve_voltage"], command)
    assert got[100] == pytest.approx(1 - 0.2 - 0.1)
    assert got[100:140] == pytest.approx(0.7)
    assert got[200] == pytest.approx(0.1)
    assert got[300] == pytest.approx(-0.7)
    y = 0.0
    tau = plant.parameters.value("plant.time_constant")
    for k in range(400):
        assert run.truth["speed"][k] == pytest.approx(y, abs=1e-6)
        y = got[k] + (y - got[k]) * exp(-0.01 / tau)


def logged_loop(**pid: float) -> tuple[Recording, ParameterSet]:
    loop, p = drive_loop(Karnopp(Stribeck()), **pid)
    rig = Rig(loop, REAL, Actuator(hysteresis=4.0, dead_zone=3.0), Encoder(filter=3e-3))
    return record(rig, step(0.05), p, seed=4, name="rig@7"), p


def test_the_controller_knows_the_readings_only() -> None:
    """The logged command is that of a PI recursion on the logged positions, differentiated and filtered."""
    run, p = logged_loop()
    log, h = run.experiment.trajectory, 1e-3
    raw = np.diff(log["position"], prepend=log["position"][0]) / h
    speed, integral = 0.0, 0.0
    for k in range(len(log)):
        speed += h / (h + 3e-3) * (raw[k] - speed)
        error = log["speed_reference"][k] - speed
        integral += 4000.0 * h * error
        w = 400.0 * error + integral + 5.0 * np.sin(2 * pi * 80.0 * log.t[k])
        u = min(max(w, -200.0), 200.0)
        integral += h / p.value("pid.Tt") * (u - w)
        assert log["feedback"][k] == pytest.approx(speed, abs=1e-12)
        assert log["force"][k] == pytest.approx(u, abs=1e-9)


def test_a_log_may_begin_at_any_time() -> None:
    loop, p = drive_loop(Karnopp(Stribeck()))
    p, rig = p.with_values({"dither.amplitude": 0.0}), Rig(loop, REAL)
    now = step(0.05, 0.2)
    later = Trajectory(1.7e9 + now.t, dict(now.values))
    runs = [record(rig, inputs, p, seed=1).truth["position"] for inputs in (now, later)]
    assert runs[1] == pytest.approx(runs[0], abs=1e-6)


def test_what_is_logged_and_what_is_true() -> None:
    run, p = logged_loop()
    assert run.experiment.name == "rig@7"
    assert run.experiment.trajectory.names == ("speed_reference", "force", "feedback", "position")
    assert run.truth.names == ("position", "speed", "stuck", "control")
    assert run.parameters is p
    assert np.array_equal(run.truth.t, run.experiment.trajectory.t)
    assert len(run.events) >= 1
    assert run.experiment.noise["position"] == pytest.approx(np.hypot(1e-6, 1e-5 / np.sqrt(12)))


def test_a_coarse_encoder_roughens_a_loop_that_is_smooth_on_paper() -> None:
    """The mismatch that a rig is for: at 50 mm/s, counts of 0.1 um leave 0.5 mm/s of ripple, of 0.1 mm 34 mm/s."""
    loop, p = drive_loop(Karnopp(Stribeck()), Kp=1500.0, Ki=3e4)
    p, ripple = p.with_values({"dither.amplitude": 0.0}), []
    for resolution in (1e-7, 1e-4):
        rig = Rig(loop, {"position": Sensor(resolution=resolution)}, encoder=Encoder(filter=1e-3))
        ripple.append(float(np.ptp(record(rig, step(0.05), p).truth["speed"][-200:])))
    assert ripple[0] < 1e-3
    assert ripple[1] > 0.02


def test_friction_identified_from_a_rig_is_near_with_a_bias_that_the_mismatch_explains() -> None:
    """The smooth model on a log with true sticking, 0.5 ms of sensor lag and 10 um counts.

    Coulomb and viscous friction come back within 1 %, static friction within 3 % and high, at the width that the log
    chooses (at 1 mm/s 5 to 10 % high); the fit says that the model does not follow the log to its noise.
    """
    truth = ForceDrive(Karnopp(Stribeck())).system()
    t = np.linspace(0, 2, 2001)
    push = 90 * np.sin(2 * pi * 1.3 * t) + 40 * np.sin(2 * pi * 3.1 * t)
    p = truth.parameters.with_values(FRICTION)
    log = record(Rig(truth, REAL), Trajectory(t, {"force": push}), p, seed=1).experiment
    model = ForceDrive(Stribeck()).system()
    start = model.parameters.with_values({"load.mass": 3.0})
    fit = identify(model, [log], start.freed("friction.coulomb", "friction.static", "friction.viscous"), throw=False)
    assert fit.parameters.value("friction.coulomb") == pytest.approx(30.0, rel=0.01)
    assert fit.parameters.value("friction.viscous") == pytest.approx(40.0, rel=0.01)
    assert 1.0 < fit.parameters.value("friction.static") / 45.0 < 1.03
    assert "the model does not explain the log to its noise" in str(fit.status)


def test_a_pneumatic_rig_logs_pressures() -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Karnopp(Stribeck())).system(), PID(sample_time=1e-3))
    p = loop.parameters.with_values({"pid.Kp": 8.0, "pid.Ki": 40.0, "pid.lower": -5.0, "pid.upper": 5.0})
    pressure = Sensor(lag=1e-3, noise=200.0, resolution=150.0)
    sensors = {"pressure_b": pressure, "position": Sensor(resolution=1e-5), "pressure_a": pressure}
    run = record(Rig(loop, sensors, Actuator(hysteresis=0.04)), step(0.1, 0.3), p, seed=2)
    log = run.experiment.trajectory
    assert log.names[-3:] == ("position", "pressure_a", "pressure_b")
    for name in ("pressure_a", "pressure_b"):
        true, a = run.truth[name], exp(-1.0)
        late = [true[0]]
        for before, now in pairwise(true):
            late.append(a * late[-1] + (1 - a) * before + a * (now - before))
        assert np.std(log[name] - late) == pytest.approx(run.experiment.noise[name], rel=0.15)
    assert np.abs(log["position"] - run.truth["position"]).max() <= 0.5e-5 + 1e-12
