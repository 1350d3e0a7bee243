"""A valve's command that was logged from 0 to 10 V: the centre is found, and estimated; one about 0 V stays."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import pneuopt as po
from pneuopt.dynamics.hooks import Log
from pneuopt.identification.command_centre import find_centre
from pneuopt.quantities.errors import LogError

DRIVE = po.PneumaticDrive(friction=po.Viscous())
GIVEN = DRIVE.parameters
CENTRE = "valve.centre"


def logged(centre: float, rest: float = 0.05, swing: float = 2.0, name: str = "run") -> po.Experiment:
    """A piston that stands between two strokes, while its command rests a little off the valve's middle."""
    t = np.arange(600) * 2e-3
    moving = np.where((t > 0.2) & (t < 0.5), 1.0, np.where((t > 0.8) & (t < 1.1), -1.0, 0.0))
    position = 0.05 + np.cumsum(moving) * 2e-3 * 0.1 + 1e-6 * np.sin(1e3 * t)
    command = centre + np.where(moving == 0, rest, swing * moving)
    pressures = {f"pressure_{s}": 3e5 + 1e4 * np.sin(9 * t) for s in "ab"}
    return po.Experiment(po.Trajectory(t, {"valve_voltage": command, "position": position, **pressures}), name=name)


def found(*logs: po.Experiment, given: po.ParameterSet = GIVEN) -> po.ParameterSet:
    return find_centre(DRIVE.system(), logs, given)


def test_a_command_from_0_to_10_V_frees_the_valves_centre_in_words() -> None:
    words = (
        r"run: valve_voltage runs from 3 to 7 V and rests at 5.05 V: the valve is closed near 5 V; valve.centre is "
        r'estimated with the rest, or state it, centre = "5 V", under \[valve\]'
    )
    with pytest.warns(po.PhysicsWarning, match=words):
        centre = found(logged(5.0))[CENTRE]
    assert centre.free
    assert (centre.value, centre.lower, centre.upper) == pytest.approx((5.05, 4.05, 6.05))


@pytest.mark.parametrize(
    ("centre", "rest", "swing"),
    [(0.0, 0.05, 2.0), (0.0, 0.05, 5.0), (2.0, 0.05, 1.0), (5.0, 2.0, 4.0), (5.0, 0.05, 6.0)],
    ids=["about zero", "full range about zero", "rests at 2 V", "held by 7 V", "beyond 10 V"],
)
def test_another_command_leaves_the_centre_as_it_is(centre: float, rest: float, swing: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(logged(centre, rest, swing)) is GIVEN


def test_a_stated_centre_is_kept_of_a_drive_and_of_a_log() -> None:
    given = GIVEN.with_values({CENTRE: 5.1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found(logged(5.0), given=given) is given
        assert found(logged(5.0).with_conditions({CENTRE: 5.1})) is GIVEN


def test_the_valves_span_counts_and_a_log_knows_its_own() -> None:
    assert not found(logged(5.0).with_conditions({"valve.span": 10.0}))[CENTRE].free


def test_a_log_without_motion_sensors_counts_as_a_whole() -> None:
    log = logged(5.0).select(["valve_voltage", "pressure_a", "pressure_b"])
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        assert abs(found(log).value(CENTRE) - 5) < 1


def test_logs_that_count_from_different_voltages_are_refused() -> None:
    words = "one: valve_voltage .* rests at 5.05 V, but other: valve_voltage .* rests at 0.05 V; subtract"
    with pytest.raises(LogError, match=words):
        found(logged(5.0, name="one"), logged(0.0, name="other"))


def test_a_centre_that_is_counted_twice_is_refused() -> None:
    words = "run: valve_voltage .* rests at 0.05 V, which is no command of a valve with valve.centre = 5 V; leave that"
    with pytest.raises(LogError, match=words):
        found(logged(0.0), given=GIVEN.with_values({CENTRE: 5.0}))


def test_a_loop_counts_from_the_centre_and_has_none_to_find() -> None:
    loop = po.ClosedLoop(DRIVE, po.PID(1e-3))
    assert find_centre(loop.plant, [logged(5.0)], loop.parameters) is loop.parameters


def simulated(centre: float) -> tuple[po.System, po.ParameterSet, po.Experiment]:
    system = DRIVE.system()
    values = {CENTRE: centre, "valve.dead_zone": 0.03, "valve.rounding": 0.01, "friction.viscous": 90.0}
    truth = system.parameters.with_values(values)
    t, random = np.arange(1500) * 1e-3, np.random.default_rng(1)
    swing = np.where((t % 0.5) < 0.1, 0.0, 0.8 * np.sin(2 * np.pi * 3 * t))
    rest = dict(zip((q.name for q in system.states), system.rest_state(truth), strict=True))
    run = po.simulate(system, po.Trajectory(t, {"valve_voltage": centre + swing}), truth, initial=rest)
    levels = {"position": 1e-5, "pressure_a": 500.0, "pressure_b": 500.0}
    noisy = {n: run[n] + s * random.standard_normal(t.size) for n, s in levels.items()}
    return system, truth, po.Experiment(po.Trajectory(t, {"valve_voltage": centre + swing, **noisy}), name="run")


def test_the_centre_is_estimated_with_the_rest_and_predicts_the_log() -> None:
    system, truth, log = simulated(5.06)
    given = truth.with_values({CENTRE: 0.0, "valve.dead_zone": 0.0, "friction.viscous": 50.0})
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        fit = po.identify(system, [log], given.freed("valve.dead_zone", "friction.viscous"))
    for name in (CENTRE, "valve.dead_zone", "friction.viscous"):
        row = fit.estimates.loc[name]
        assert abs(row["value"] - truth.value(name)) < 4 * row["stderr"]
    assert 0 < fit.estimates["stderr"][CENTRE] < 0.002
    assert fit.parameters.value(CENTRE) == fit.estimates["value"][CENTRE]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = po.validate(system, [log], fit.parameters)
    assert (table["nrmse"] < 0.05).all()
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        blind = po.identifiability(system, [log], system.parameters.freed("friction.viscous"))
    assert CENTRE in blind.table.index


def test_a_log_predicted_before_any_fit_is_read_from_where_it_rests() -> None:
    system, truth, log = simulated(5.06)
    with pytest.warns(po.PhysicsWarning, match="closed near 5 V"):
        run = po.predict(system, log, truth.with_values({CENTRE: 0.0}))
    travel = float(np.ptp(log.trajectory["position"]))
    assert np.abs(run["position"] - log.trajectory["position"]).max() < 0.3 * travel


def test_a_search_starts_at_the_centre_that_the_pressures_show() -> None:
    """From 0.16 V beside it, where a mass balance would take the supply's pressure for a wrong one."""
    system, truth, log = simulated(5.06)
    beside = replace(truth[CENTRE], value=4.9, lower=4.0, upper=6.0, free=True)
    given = truth.with_values({"valve.dead_zone": 0.0, "valve.conductance": 1.5e-8})
    given = given.freed("valve.dead_zone", "valve.conductance") | po.ParameterSet({CENTRE: beside})
    logs = {"run": Log(log.trajectory, given)}
    start = system.starts(logs)[0].parameters
    assert start[CENTRE] == pytest.approx(5.06, abs=0.02)
    assert start["valve.conductance"] == pytest.approx(truth.value("valve.conductance"), rel=0.2)
    assert list(system.log_warnings(logs)) == []
