"""A valve that is closed at another voltage than zero is the same valve; a loop counts its command from there."""

import numpy as np
import pytest

import pneuopt as po
from pneuopt.dynamics.centre import command_centre, count_from_centre

DRIVE = po.PneumaticDrive(friction=po.Stribeck())
OFF = DRIVE.parameters.with_values({"valve.centre": 5.06})
T = np.arange(200) * 1e-3
COMMAND = 2 * np.sin(30 * T)


def run(system: po.System, command: np.ndarray, parameters: po.ParameterSet) -> po.Trajectory:
    at_rest = dict(zip((q.name for q in system.states), system.rest_state(parameters), strict=True))
    return po.simulate(system, po.Trajectory(T, {"valve_voltage": command}), parameters, initial=at_rest)


def test_a_valve_with_another_centre_is_moved_by_the_deviation_from_it() -> None:
    usual, off = run(DRIVE.system(), COMMAND, DRIVE.parameters), run(DRIVE.system(), COMMAND + 5.06, OFF)
    assert np.ptp(usual["position"]) > 0.01
    for name in ("position", "speed", "pressure_a", "pressure_b"):
        np.testing.assert_allclose(off[name], usual[name], rtol=1e-7, atol=1e-7)


def test_a_drive_rests_under_the_voltage_of_its_centre() -> None:
    rests = [DRIVE.rest(p) for p in (DRIVE.parameters, OFF)]
    off_centre = rests[0].inputs["valve_voltage"]
    assert off_centre != 0  # a single rod
    assert rests[1].inputs["valve_voltage"] == pytest.approx(5.06 + off_centre, abs=1e-12)
    assert rests[1].states == rests[0].states
    x = np.array(list(rests[1].states.values()))
    rate = np.array(DRIVE.system().ode(0, x, [rests[1].inputs["valve_voltage"]], [p.value for p in OFF.values()])[0])
    assert np.abs(rate.ravel()[:2]).max() < 1e-6


def test_a_loop_counts_its_command_and_its_limits_from_the_centre() -> None:
    loop = po.ClosedLoop(DRIVE, po.PID(sample_time=1e-3))
    gains = {"pid.Kp": 8.0, "pid.Ki": 20.0, "pid.lower": -3.0, "pid.upper": 2.0}
    step = po.Trajectory(T, {"reference": np.where(T > 0.02, 0.3, 0.0)})
    runs = [
        po.simulate(loop, step, (loop.parameters | p).with_values(gains), initial=loop.initial(loop.parameters | p))
        for p in (DRIVE.parameters, OFF)
    ]
    assert np.ptp(runs[0]["position"]) > 0.01
    assert runs[0]["control"].max() == 2.0
    for name in ("position", "control"):
        np.testing.assert_array_equal(runs[1][name], runs[0][name])


def test_a_plant_is_counted_from_its_centre_once() -> None:
    system = DRIVE.system()
    loop = po.ClosedLoop(system, po.PID())
    assert command_centre(system, OFF) == 5.06
    assert command_centre(loop.plant, OFF) == 0
    assert count_from_centre(loop.plant) is loop.plant
    assert po.ClosedLoop(loop.plant, po.PID(1e-3)).plant is loop.plant
    force = po.ForceDrive(po.Coulomb()).system()
    assert count_from_centre(force) is force
    assert loop.parameters["valve.centre"] == system.parameters["valve.centre"]
