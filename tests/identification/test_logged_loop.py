"""Identification of a plant inside its loop, from logs that hold the reference but not the command."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.compensators import DeadZoneInverse, Knocker
from pneuopt.control.controller import Feedforward
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.sensor import SensorLag
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import LogError, ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
GAINS = {"pid.Kp": 300.0, "pid.Ki": 2000.0, "pid.Kd": 1.0, "pid.Tf": 5e-3, "pid.lower": -60.0, "pid.upper": 60.0}
NOISE = {"position": 2e-5, "speed": 1e-3}


def loop_of(h: float = 2e-3, sensor: SensorLag | None = None) -> ClosedLoop:
    return ClosedLoop(ForceDrive(Coulomb()).system(), PID(sample_time=h), sensor=sensor)


def given(loop: ClosedLoop) -> ParameterSet:
    return loop.parameters.with_values({**TRUTH, **GAINS})


def logged(loop: ClosedLoop, *channels: str, h: float = 1e-3, seed: int = 0) -> tuple[Experiment, Trajectory]:
    """A speed loop that starts, stops and turns, in and out of saturation; and the truth."""
    t = np.arange(round(1.5 / h)) * h
    wanted = np.select([t < 0.1, t < 0.4, t < 0.7, t < 1.0, t < 1.2], [0.0, 0.3, -0.2, 0.05, 0.4], -0.1)
    run = simulate(loop, Trajectory(t, {"reference": wanted}), given(loop), initial=[0.0] * len(loop.states))
    random = np.random.default_rng(seed)
    noisy = {n: run[n] + NOISE[n] * random.standard_normal(t.size) for n in channels}
    log = Experiment(Trajectory(t, {"speed_reference": wanted, **noisy}), {n: NOISE[n] for n in channels}, name="loop")
    return log, run


@pytest.mark.parametrize(("h", "channels"), [(2e-3, ("position",)), (1e-3, ("position", "speed")), (4e-3, ("speed",))])
def test_a_plant_is_identified_in_its_saturated_loop(h: float, channels: tuple[str, ...]) -> None:
    loop = loop_of(h)
    log, run = logged(loop, *channels)
    assert np.mean(np.abs(run["control"]) >= GAINS["pid.upper"]) > 0.03
    start = given(loop).with_values({n: loop.parameters.value(n) for n in TRUTH}).freed(*TRUTH)
    fit = identify(loop, [log], start)
    for name, row in fit.estimates.iterrows():
        assert abs(row["value"] - TRUTH[str(name)]) < 4 * row["stderr"], name
        assert row["value"] == pytest.approx(TRUTH[str(name)], rel=0.02)
    assert fit.stats["chi_square_ratio"] == pytest.approx(1, abs=0.15)


def test_the_controller_is_replayed_exactly_along_an_exact_log() -> None:
    """The held-out run is the truth, and so is the command that the start reconstructs once the integral is known."""
    loop = loop_of()
    log, run = logged(loop, "position", "speed")
    exact = log.trajectory.with_columns({"speed": run["speed"]})
    from_rest, empty = LoggedLoop(loop).starts({"loop": Log(exact, given(loop).freed("load.mass"))})
    assert "from rest" in from_rest.label
    assert "empty integral" in empty.label
    held = np.append(run["control"][:-1][::2], 0.0)
    np.testing.assert_allclose(empty.states["loop"]["pid.command"][1::2], held[: len(held) - 1], atol=1e-6)
    assert validate(loop, [log], given(loop))["fit_percent"].min() > 99
    # what the derivative was at the first sample, a noisy log hardly shows; it fades within a few Tf
    np.testing.assert_allclose(predict(loop, log, given(loop))["control"][50:], run["control"][50:], atol=1.0)


def test_a_lagging_sensor_is_part_of_the_loop() -> None:
    loop = loop_of(sensor=SensorLag(4e-3))
    log, _ = logged(loop, "position", "speed")
    fit = identify(loop, [log], given(loop).freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def test_a_delay_and_a_feedforward_are_part_of_the_loop() -> None:
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(2e-3, delay=1), feedforward=Feedforward(0.05))
    known = given(loop).with_values({"feedforward.gain": 100.0})
    t = np.arange(600) * 1e-3
    wanted = np.where(t < 0.1, 0.0, np.where(t < 0.35, 0.3, -0.2))
    run = simulate(loop, Trajectory(t, {"reference": wanted}), known, initial=[0.0] * len(loop.states))
    noisy = run["position"] + NOISE["position"] * np.random.default_rng(1).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"speed_reference": wanted, "position": noisy}), {"position": NOISE["position"]})
    fit = identify(loop, [log], known.freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def test_what_compensators_add_is_part_of_the_loop() -> None:
    """Their pulses and their inverse are replayed from the log's first sample on."""
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(2e-3), compensators=(Knocker(), DeadZoneInverse()))
    sizes = {"knocker.amplitude": 8.0, "knocker.smoothing": 2.0, "dead_zone_inverse.width": 5.0}
    known = given(loop).with_values({**sizes, "dead_zone_inverse.smoothing": 2.0})
    t = np.arange(600) * 1e-3
    wanted = np.where(t < 0.1, 0.0, np.where(t < 0.35, 0.3, -0.2))
    run = simulate(loop, Trajectory(t, {"reference": wanted}), known, initial=[0.0] * len(loop.states))
    noisy = run["position"] + NOISE["position"] * np.random.default_rng(1).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"speed_reference": wanted, "position": noisy}), {"position": NOISE["position"]})
    fit = identify(loop, [log], known.freed("friction.coulomb", "load.mass"))
    assert fit.estimates["value"]["load.mass"] == pytest.approx(3.0, rel=0.01)


def test_what_a_log_of_a_loop_must_not_be() -> None:
    loop = loop_of()
    log, run = logged(loop, "position")
    free = given(loop).freed("load.mass")
    commanded = replace(log, trajectory=log.trajectory.with_columns({"force": run["control"]}))
    with pytest.raises(LogError, match=r"holds the command 'force'; identify the plant alone"):
        identify(loop, [commanded], free)
    with pytest.raises(LogError, match=re.escape("needs the channel 'speed_reference'")):
        identify(loop, [log.select(["position"])], free)
    rows = np.delete(np.arange(1500), 700)
    dropped = Trajectory(log.trajectory.t[rows], {n: c[rows] for n, c in log.trajectory.values.items()})
    with pytest.raises(LogError, match=re.escape("no sample at t = 0.7 s; log at the controller's sample time")):
        identify(loop, [replace(log, trajectory=dropped)], free)
    slow, _ = logged(loop, "position", h=3e-3)
    with pytest.raises(LogError, match=re.escape("the log has no sample at t = 0.002 s")):
        identify(loop, [slow], free)
    with pytest.raises(ModelError, match="sample_time"):
        identify(replace(loop, pid=PID()), [log], free)


def test_a_position_loop_needs_some_motion_to_start_from() -> None:
    drive = ForceDrive(Coulomb()).system()
    loop = ClosedLoop(drive, PID(sample_time=1e-3), measured="position")
    t = np.arange(100) * 1e-3
    log = Trajectory(t, {"position_reference": np.ones(100), "speed": np.sin(t)})
    held = LoggedLoop(loop)
    start, *_ = held.starts({"a": Log(log, loop.parameters)})
    assert start.states["a"]["pid.integral"][0] == 0.0
    with pytest.raises(LogError, match="the loop feeds back 'position'"):
        held.starts({"a": Log(log.select(["position_reference"]), loop.parameters)})
