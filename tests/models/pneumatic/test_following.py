"""The states of a pneumatic drive that no log holds, along those that one does."""

from dataclasses import replace

import numpy as np
import pytest

import pneuopt as po
from pneuopt.models.catalog import b32
from pneuopt.models.pneumatic.chamber import Thermal
from pneuopt.models.pneumatic.following import AirSimulator

Truth = tuple[po.System, po.ParameterSet, po.Trajectory]


def run(thermal: bool) -> Truth:
    drive, parameters = b32()
    if thermal:
        drive = replace(drive, chamber=Thermal())
        parameters = drive.parameters | parameters.select(n for n in parameters if n in drive.parameters)
    system, t = drive.system(), np.arange(600) * 1e-3
    voltage = 0.3 * np.sign(np.cos(2 * np.pi * 5.0 * t))
    rest = drive.rest(parameters, position=0.1)
    inputs = po.Trajectory(t, {"valve_voltage": voltage})
    truth = po.simulate(system, inputs, parameters, initial=rest.states, rtol=1e-8)
    return system, parameters, truth.with_columns({"valve_voltage": voltage})


@pytest.mark.parametrize("thermal", [False, True])
@pytest.mark.parametrize("logged", [(), ("pressure_a",), ("pressure_b",), ("pressure_a", "pressure_b")])
def test_what_is_not_logged_follows_the_motion(thermal: bool, logged: tuple[str, ...]) -> None:
    system, parameters, truth = run(thermal)
    follower = AirSimulator(system, ("position", "speed", *logged))
    (found,) = follower.simulate_states(truth, [parameters])
    air = {"pressure_a", "pressure_b"} | ({"temperature_a", "temperature_b"} if thermal else set())
    assert set(found) == (air | {"valve.spool"}) - set(logged)
    late = truth.t > 0.5  # the start is a guess, until valve and leak have changed the air; its heat stays longer
    for name in found:
        near = 0.1 if name.startswith("temperature") else 0.02
        assert np.max(np.abs(found[name] - truth[name])[late]) < near * np.ptp(truth[name]), name


def test_rates_of_the_pressures_are_the_odes() -> None:
    system, parameters, truth = run(False)
    rates = AirSimulator(system, [q.name for q in system.states]).pressure_rates(truth, [parameters] * 2)
    assert rates.shape == (2, len(truth), 2)
    k = 140
    x = [truth[q.name][k] for q in system.states]
    numbers = [parameters.value(n) for n in system.parameters]
    expected = np.array(system.ode(0, x, [truth["valve_voltage"][k]], numbers)[0]).ravel()[2:4]
    assert rates[0, k] == pytest.approx(expected)
    assert np.array_equal(rates[0], rates[1])


def test_sets_run_side_by_side_and_an_absurd_one_spoils_no_other() -> None:
    system, parameters, truth = run(False)
    absurd = parameters.with_values({"valve.conductance": 1e-5})
    follower = AirSimulator(system, ("position", "speed"))
    both, alone = follower.simulate_states(truth, [parameters, absurd]), follower.simulate_states(truth, [parameters])
    for name in alone[0]:
        assert both[0][name] == pytest.approx(alone[0][name], rel=1e-9)
