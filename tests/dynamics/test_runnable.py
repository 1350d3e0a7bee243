"""Every kind of model runs through the same mill: a new one is a row here.

A valve that is closed at another voltage than zero is the same valve; a loop counts its command from there.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pytest

import pneuopt as po
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.sensor import SensorLag
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.runnable import Fittable, Runnable, check_smooth, command_centre, count_from_centre
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names, parameter_vector
from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, LuGre, Stribeck
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

H = 1e-3  # [s]
GAINS = {"pid.Kp": 2.0, "pid.Ki": 10.0}


def sampled_loop() -> ClosedLoop:
    return ClosedLoop(FirstOrder().system(), PID(sample_time=H), sensor=SensorLag(2e-3))


FITTABLE: Mapping[str, Callable[[], Fittable]] = {
    "linear": lambda: FirstOrder().system(),
    "friction": lambda: ForceDrive(Stribeck()).system(),
    "bristles": lambda: ForceDrive(LuGre()).system(),
    "pneumatic": lambda: PneumaticDrive().system(),
    "logged loop": lambda: LoggedLoop(sampled_loop()),
}
RUNNABLE: Mapping[str, Callable[[], Runnable]] = {
    **FITTABLE,
    "continuous loop": lambda: ClosedLoop(FirstOrder().system(), PID(), Dither(frequency=50.0)),
    "sampled loop": sampled_loop,
}
every_model = pytest.mark.parametrize("kind", RUNNABLE)


def gains_of(model: Runnable) -> ParameterSet:
    return model.parameters.with_values({n: v for n, v in GAINS.items() if n in model.parameters})


def inputs_of(model: Runnable, size: float, n: int = 21) -> Trajectory:
    t = H * np.arange(n)
    wave = size * np.cumsum(np.cos(300 * t))
    return Trajectory(t, {q.name: wave if k == 0 else np.zeros(n) for k, q in enumerate(model.inputs)})


@every_model
def test_it_names_its_channels_once_and_the_plant_stands_first(kind: str) -> None:
    model = RUNNABLE[kind]()
    run = simulate(model, inputs_of(model, 0.1), gains_of(model))
    listed = (*names(model.states), *names(model.outputs))
    assert run.names == tuple(dict.fromkeys(listed))
    assert names(model.states)[: len(model.plant.states)] == names(model.plant.states)
    assert set(names(model.plant.outputs)) <= set(names(model.outputs))
    assert set(model.plant.parameters) <= set(model.parameters)


@every_model
def test_at_rest_it_stays_at_rest(kind: str) -> None:
    model = RUNNABLE[kind]()
    given = gains_of(model)
    x = model.rest_state(given)
    still = dict(model.plant.rest_hook(given, {}).inputs) if model.plant.rest_hook is not None else {}
    held = inputs_of(model, 0.0).with_columns({n: np.full(21, still.get(n, 0.0)) for n in names(model.inputs)})
    run = simulate(model, held, given)
    scale = [q.nominal for q in model.states]
    np.testing.assert_allclose(run.matrix(names(model.states)) / scale, np.tile(x / scale, (21, 1)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(model.rest_state(given, {}), x, atol=1e-12)


@every_model
def test_its_discrete_form_is_its_continuous_form_at_small_steps(kind: str) -> None:
    model = RUNNABLE[kind]()
    given, inputs = gains_of(model), inputs_of(model, 0.05)
    run, scale = simulate(model, inputs, given), np.array([q.nominal for q in model.outputs])
    found = discrete_outputs(model, given, inputs, 40)
    np.testing.assert_allclose(found / scale, run.matrix(names(model.outputs)) / scale, atol=1e-6)


@every_model
def test_its_motion_is_that_of_its_own_signals(kind: str) -> None:
    model = RUNNABLE[kind]()
    motion = model.motion()
    for signals in ("states", "inputs", "outputs"):
        assert names(getattr(motion.system, signals)) == names(getattr(model, signals))
    assert list(motion.system.parameters) == list(model.parameters)
    assert (motion.update is None) == (motion.sample_time is None)


@pytest.mark.parametrize("kind", FITTABLE)
def test_what_can_be_fitted_reads_its_inputs_from_a_log_and_starts_from_it(kind: str) -> None:

    model = FITTABLE[kind]()
    given = gains_of(model)
    inputs = inputs_of(model, 0.05, 101)
    log = inputs.with_columns(simulate(model, inputs, given).select(names(model.plant.outputs)).values)
    model.check(given)
    model.check_log(log, "run")
    assert model.input_matrix(log, "run").shape == (101, len(model.discrete().inputs))
    starts = model.starts({"run": Log(log, given)})
    assert set(names(model.states)) <= set(starts[0].states["run"].names)
    known = model.unobservable_start(log, starts[0].states["run"], given)
    assert known is None or known.shape == (len(model.states),)
    assert list(model.log_warnings({"run": Log(log, given)})) == []


def test_a_rig_is_recorded_with_its_plants_channels() -> None:
    rig = Rig(sampled_loop(), {"speed": Sensor(noise=1e-3)})
    run = record(rig, inputs_of(rig.model, 0.05), gains_of(rig.model))
    plant = rig.model.plant
    assert run.truth.names == (*dict.fromkeys((*names(plant.states), *names(plant.outputs))), "control")


def test_friction_that_only_a_simulation_switches_is_no_smooth_model() -> None:
    check_smooth(ForceDrive(Coulomb()).system())
    with pytest.raises(ModelError, match="Karnopp"):
        check_smooth(ClosedLoop(ForceDrive(Karnopp(Coulomb())).system(), PID()))


def discrete_outputs(model: Runnable, given: ParameterSet, inputs: Trajectory, substeps: int) -> Array:
    """The outputs at each sample of the discrete form, from rest."""
    sampled, p = model.discrete(substeps), parameter_vector(model.parameters, given)
    u = inputs.matrix(names(model.inputs))
    if len(sampled.inputs) > len(model.inputs):  # a loop's log says where the controller acts
        u = np.column_stack([u, np.ones(len(inputs))])
    x, rows = model.rest_state(given), []
    for t, row in zip(inputs.t, u, strict=True):
        x = sampled.update(t, x, row, p) if sampled.update is not None else x
        rows.append(sampled.step(t, H / substeps, x, row, p)[1].full().ravel())
        for k in range(substeps):
            x = sampled.step(t + k * H / substeps, H / substeps, x, row, p)[0]
    return np.array(rows)


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
