"""Starts of a pneumatic drive from its log alone."""

import numpy as np
import pytest

import pneuopt as po
from pneuopt.models.catalog import b32
from pneuopt.system import Log


@pytest.fixture(scope="module")
def truth() -> tuple[po.System, po.ParameterSet, po.Trajectory]:
    drive, parameters = b32()
    system = drive.system()
    t = np.arange(1000) * 1e-3
    voltage = 0.25 * np.sign(np.cos(2 * np.pi * 5.0 * t))
    rest = drive.rest(parameters, position=0.1)
    run = po.simulate(system, po.Trajectory(t, {"valve_voltage": voltage}), parameters, initial=rest.states, rtol=1e-8)
    rng = np.random.default_rng(0)
    noisy = {"position": run["position"] + 5e-6 * rng.standard_normal(1000)}
    noisy |= {n: run[n] + 1e3 * rng.standard_normal(1000) for n in ("pressure_a", "pressure_b")}
    return system, parameters, po.Trajectory(t, {"valve_voltage": voltage, **noisy, "true_speed": run["speed"]})


def blind(parameters: po.ParameterSet) -> po.ParameterSet:
    start = parameters.with_values({"valve.conductance": 1e-9, "friction.coulomb": 10.0, "friction.static": 12.0})
    return start.freed("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous").freed(
        "valve.conductance", "valve.leak"
    )


def test_valve_and_friction_start_near_the_truth(truth: tuple[po.System, po.ParameterSet, po.Trajectory]) -> None:
    system, parameters, log = truth
    starts = system.starts({"run": Log(log, blind(parameters))})
    assert len(starts) == 6
    for start in starts:
        assert start.parameters["valve.conductance"] == pytest.approx(2e-8, rel=0.1)
        assert 0 < start.parameters["valve.leak"] < 0.05
    best = min(abs(s.parameters["friction.coulomb"] - 40) for s in starts)
    assert best < 20


def test_states_along_the_log_are_the_drives(truth: tuple[po.System, po.ParameterSet, po.Trajectory]) -> None:
    system, parameters, log = truth
    states = system.starts({"run": Log(log, blind(parameters))})[0].states["run"]
    assert set(states.names) >= {"position", "speed", "pressure_a", "pressure_b", "valve.spool"}
    assert np.sqrt(np.mean((states["speed"] - log["true_speed"]) ** 2)) < 0.05 * np.abs(log["true_speed"]).max()


def test_without_pressures_they_are_integrated(truth: tuple[po.System, po.ParameterSet, po.Trajectory]) -> None:
    system, parameters, log = truth
    known = parameters.freed("friction.coulomb")
    states = system.starts({"run": Log(log.select(["valve_voltage", "position"]), known)})[0].states["run"]
    late = log.t > 0.4
    for name in ("pressure_a", "pressure_b"):
        assert np.sqrt(np.mean((states[name] - log[name])[late] ** 2)) < 0.1 * np.ptp(log[name])
