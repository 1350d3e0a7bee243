"""What a plant refuses to be, and what a simulation of it tells."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.hooks import Contact, IdentificationHints, Log, Start, Starts, ValidityLimit
from pneuopt.dynamics.simulate import contacts, simulate
from pneuopt.dynamics.system import System, define, names
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.identification.identify import identify
from pneuopt.logs.experiment import Experiment
from pneuopt.models import starts as friction_starts
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, Stribeck
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import ConvergenceError, HardwareError, InputError, ModelError, PhysicsWarning
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import tune

DRIVE = PneumaticDrive()
CLOSED = {"valve.dead_zone": 0.1, "valve.rounding": 1e-5, "load.mass": 50.0}


def held(volts: float, until: float, count: int = 101) -> Trajectory:
    return Trajectory(np.linspace(0.0, until, count), {"valve_voltage": np.full(count, volts)})


@pytest.mark.parametrize("y", [None, 0.04])
def test_a_drive_starts_at_rest(y: float | None) -> None:
    """Under pressure, the valve where it holds the load: with that voltage nothing moves."""
    p = DRIVE.parameters.with_values({"load.force": 60.0})
    rest = DRIVE.rest(p, position=y)
    run = simulate(
        DRIVE.system(), held(rest.inputs["valve_voltage"], 0.5), p, initial=None if y is None else {"position": y}
    )
    for q in DRIVE.states:
        assert run[q.name] == pytest.approx(np.full(101, rest.states[q.name]), abs=1e-6 * q.nominal), q.name


def test_states_that_are_given_replace_those_at_rest() -> None:
    start = {"position": 0.04, "speed": 0.1, "pressure_b": 3e5}
    for model in (DRIVE.system(), ClosedLoop(DRIVE.system(), PID())):
        inputs = held(0.0, 0.01).with_columns({"reference": np.zeros(101)})
        run = simulate(model, inputs, model.parameters, initial=start)
        at_rest = DRIVE.rest(DRIVE.parameters, position=0.04).states
        assert {n: run[n][0] for n in at_rest} == pytest.approx({**at_rest, **start})


def test_a_rig_of_a_drive_starts_at_rest() -> None:
    run = record(Rig(DRIVE.system(), {"position": Sensor()}), held(0.0, 0.05), DRIVE.parameters)
    assert run.truth["position"] == pytest.approx(np.full(101, 0.1), abs=1e-4)


def test_an_end_stop_is_told_when_and_where() -> None:
    """On a grid of 0.5 s, between whose instants the piston comes and stays, and by each simulator alike."""
    p = DRIVE.parameters
    with pytest.warns(PhysicsWarning) as told:
        simulate(DRIVE.system(), held(5.0, 0.5, 2), p)
    assert str(told[0].message) == (
        "the piston reached the front end stop (position 199.9 mm) at t = 0.07633 s with 2.65 m/s; from there the "
        "response is the stop's"
    )
    with pytest.warns(PhysicsWarning, match=r"front end stop .* at t = 0.0763"):
        run = simulate(DRIVE.system(), held(5.0, 0.5, 5001), p)
    (met,) = contacts(run, DRIVE.system(), p)
    k = int(np.argmax(run["position"] > 0.1999))
    assert run.t[k - 1] <= met.t <= run.t[k]
    assert met.rate == pytest.approx(run["speed"][k], rel=1e-2)
    sticking = PneumaticDrive(friction=Karnopp(Stribeck()))
    with pytest.warns(PhysicsWarning, match="rear end stop"):
        simulate(sticking.system(), held(-5.0, 0.5, 2), sticking.parameters)
    with pytest.warns(PhysicsWarning, match="front end stop"):
        record(Rig(DRIVE.system(), {"position": Sensor()}), held(5.0, 0.5), p)


def test_a_piston_that_starts_in_a_stop_has_not_run_into_it() -> None:
    simulate(DRIVE.system(), held(0.0, 0.2), DRIVE.parameters, initial={"position": 0.0})
    with pytest.warns(PhysicsWarning, match="front"):
        run = simulate(DRIVE.system(), held(5.0, 1.0), DRIVE.parameters)
    end = {n: run[n][-1] for n in names(DRIVE.states)}
    assert end["position"] > 0.2
    simulate(DRIVE.system(), held(5.0, 0.2), DRIVE.parameters, initial=end)


def test_a_drive_without_stops_tells_where_it_leaves_its_stroke() -> None:
    drive = PneumaticDrive(cylinder=Cylinder(stops=False))
    with pytest.warns(PhysicsWarning, match=r"left the stroke at the front \(position 200 mm\).*has no stops"):
        simulate(drive.system(), held(5.0, 0.09), drive.parameters)


def test_an_emptied_chamber_is_told_with_the_law_of_its_expansion() -> None:
    """A heavy load at 3 m/s behind a closed valve: p V^n is constant, half the ambient pressure is where it says."""
    p, start = DRIVE.parameters.with_values(CLOSED), {"position": 0.005, "speed": 3.0}
    with pytest.warns(PhysicsWarning, match=r"chamber a was emptied \(pressure_a 0.5066 bar\(a\)\) at t = 0.0301"):
        run = simulate(DRIVE.system(), held(0.0, 0.05), p, initial=start)
    (met,) = contacts(run, DRIVE.system(), p)
    volume = 8e-6 + np.pi / 4 * 0.032**2 * np.interp([0.0, met.t], run.t, run["position"])
    assert met.value == pytest.approx(run["pressure_a"][0] * (volume[0] / volume[1]) ** 1.2, rel=0.02)


def escaping() -> System:
    x = Quantity("level", "m")
    tank = define([x], [], [x], ParameterSet(), lambda _t, x, _u, _p: ({"level": x["level"] ** 2}, dict(x)))
    return replace(
        tank, validity_limits=(ValidityLimit("level", lambda _: 4.0, 1, "the tank spilled", "air is pumped"),)
    )


def test_a_run_that_stops_names_what_it_met_before() -> None:
    said = r"stopped after t = 0.9 s, where level 10 m.*Before that, the tank spilled \(level 4 m\) at t = 0.75 s"
    with pytest.raises(ConvergenceError, match=said) as caught:
        simulate(escaping(), Trajectory(np.linspace(0, 2, 21), {}), ParameterSet(), initial={"level": 1.0})
    assert len(caught.value.solution) == 10
    met = contacts(caught.value.solution, escaping(), ParameterSet())
    assert [type(c) for c in met] == [Contact]


@pytest.mark.parametrize("name", ["cylinder.rod", "valve.critical_ratio", "supply.pressure", "cylinder.dead_volume_a"])
def test_impossible_hardware_is_refused_by_every_verb(name: str) -> None:
    system = DRIVE.system()
    value = {"cylinder.rod": 0.04, "valve.critical_ratio": 1.2, "supply.pressure": 9e4}.get(name, -1e-6)
    wrong = Parameter(value, system.parameters[name].unit, free=True, source="a sketch")
    p = system.parameters | ParameterSet({name: wrong})
    Kp = {"pid.Kp": (0.1, 100.0)}
    x = np.array(list(DRIVE.rest(system.parameters).states.values()))
    loop = ClosedLoop(system, PID())
    log = Experiment(held(0.1, 0.5).with_columns({"position": np.linspace(0.1, 0.11, 101)}), {"position": 1e-5})
    verbs = (
        lambda: simulate(system, held(0.0, 0.1), p, initial=x),
        lambda: system.linearise(x, {}, p),
        lambda: system.equilibrium({}, p),
        lambda: identify(system, [log], p),
        lambda: loop.check(p),
        lambda: tune(
            loop,
            Step(0.1),
            (loop.parameters | p.fixed(name)).with_bounds(Kp).freed(*Kp),
            minimise=SettlingTime(),
            plants={},
        ),
    )
    for verb in verbs:
        with pytest.raises(HardwareError, match=rf"{name} = .* \(source: a sketch\) is impossible; ") as caught:
            verb()
        assert caught.value.parameter == name


def test_a_condition_that_no_hardware_has_names_its_log() -> None:
    log = Experiment(held(0.1, 0.5).with_columns({"position": np.linspace(0.1, 0.11, 101)}), {"position": 1e-5})
    log = replace(log, name="run 7", conditions={"supply.pressure": 9e4})
    with pytest.raises(InputError, match=r"run 7: condition supply.pressure = 0.9 bar\(a\) is impossible"):
        identify(DRIVE.system(), [log], DRIVE.parameters.freed("friction.coulomb"))


def test_a_start_outside_the_stroke_is_refused() -> None:
    for y in (-0.01, 0.21):
        state = {**DRIVE.rest(DRIVE.parameters).states, "position": y}
        for initial in (state, list(state.values())):
            with pytest.raises(InputError, match=rf"position = {1e3 * y:g} mm lies outside the stroke, 0 to 200 mm"):
                simulate(DRIVE.system(), held(0.0, 0.1), DRIVE.parameters, initial=initial)


def test_a_search_refuses_friction_that_only_a_simulation_switches() -> None:
    plant = ForceDrive(Karnopp(Stribeck())).system()
    loop = ClosedLoop(plant, PID(sample_time=1e-3))
    given = loop.parameters.with_bounds({"pid.Kp": (1.0, 100.0)}).with_values({"pid.Kp": 10.0}).freed("pid.Kp")
    with pytest.raises(ModelError, match=r"Karnopp's friction \(friction.direction\).*search on the smooth model"):
        tune(loop, Step(0.1), given, minimise=SettlingTime())
    t = np.linspace(0, 1, 101)
    log = Experiment(Trajectory(t, {"force": 60 * np.sin(9 * t), "speed": 0.1 * np.sin(9 * t)}))
    with pytest.raises(ModelError, match="Karnopp's friction"):
        identify(plant, [log], plant.parameters.freed("friction.coulomb"))


def test_starts_are_computed_once_and_when_asked_for() -> None:
    made: list[str] = []

    def make(label: str) -> Start:
        made.append(label)
        return Start({}, {}, label)

    starts = Starts([partial(make, label) for label in "abc"])
    assert len(starts) == 3
    assert starts[0] is starts[0]
    assert made == ["a"]
    assert [start.label for start in starts[-2:]] == ["b", "c"]
    assert [start.label for start in starts] == made == ["a", "b", "c"]
    with pytest.raises(IndexError):
        starts[3]


def test_a_drive_regresses_the_candidates_of_friction_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []
    regress = friction_starts._regress

    def count(friction: Any, logs: Any, parameters: Any, values: Any) -> Any:
        tried.append(values["stribeck_velocity"])
        return regress(friction, logs, parameters, values)

    monkeypatch.setattr(friction_starts, "_regress", count)
    t = np.arange(0.0, 1.0, 1e-3)
    log = Trajectory(t, {"force": 60 * np.sin(6 * t), "position": 0.1 * np.sin(6 * t)})
    drive = ForceDrive(Stribeck())
    starts = drive.system().starts({"run": Log(log, drive.parameters.freed("friction.*"))})
    assert "stribeck velocity 0.025 m/s" in starts[0].label
    assert set(tried) == {0.025}  # also where the window of the filter was chosen
    assert len(starts) > 1


def test_parameters_in_order_keep_their_order_in_a_plant() -> None:
    own = IdentificationHints(at_least={"static": "coulomb"}) | IdentificationHints(at_least={"second": "load.force"})
    assert own.with_prefix("friction").at_least == {
        "friction.static": "friction.coulomb",
        "friction.second": "load.force",
    }
