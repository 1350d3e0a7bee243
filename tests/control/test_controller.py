"""What a controller adds to its PID: feedforward, an outer loop, a delay; and what it does at a faulty sample."""

from collections.abc import Callable, Mapping
from pathlib import Path

import control
import numpy as np
import pytest
from scipy.linalg import expm

from pneuopt.control.compensators import (
    AccelerationFeedback,
    Compensator,
    DeadZoneInverse,
    Direction,
    FrictionFeedforward,
    MotionFeedforward,
    PressureFeedback,
)
from pneuopt.control.controller import Controller, Feedforward, PlantSignals, PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.linear_loop import ComposedLoops, _exponentials, noise_path, open_loop
from pneuopt.control.loop import ClosedLoop, bumpless_transfer
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import batch_margin_function, frequency_response, margins, noise_gain
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.evaluation.specification import specify
from pneuopt.export.languages import Language, export_controller
from pneuopt.files.tuning import read_tuning
from pneuopt.models import catalog
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.gradients import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import is_linear

Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
GAINS = {"pid.Kp": 0.225, "pid.Ki": 1.23, "pid.Kd": 0.01, "pid.Tf": 0.01}
LEAD = {"feedforward.gain": 0.3, "feedforward.time": 0.04}


def test_a_step_adds_a_decaying_push(second_order: System, run: Run) -> None:
    """Without feedback the command is the push alone: gain R exp(-t/T), sampled gain R (T/(T + h))^(k + 1)."""
    values = {"pid.Kp": 0.0, **LEAD}
    t, _, y = run(
        loop := ClosedLoop(second_order, PID(limits=False), feedforward=Feedforward()),
        loop.parameters.with_values(values),
        0.5,
        1e-3,
        0.2,
    )
    np.testing.assert_allclose(y[:, -1], 0.3 * 0.5 * np.exp(-t / 0.04), rtol=1e-6)
    loop = ClosedLoop(second_order, PID(5e-3, limits=False), feedforward=Feedforward())
    t, _, y = run(loop, loop.parameters.with_values(values), 0.5, 5e-3, 0.2)
    np.testing.assert_allclose(y[:, -1], 0.3 * 0.5 * (0.04 / 0.045) ** (np.arange(len(t)) + 1), rtol=1e-12)


def test_a_loop_with_it_follows_python_control(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID(), feedforward=Feedforward())
    t, _, y = run(loop, loop.parameters.with_values(GAINS | LEAD), 1.0, 1e-3, 0.6)
    plant, pid = (
        control.tf([1270.12], [1, 17.5, 86.34]),
        0.225 + control.tf([1.23], [1, 0]) + control.tf([0.01, 0], [0.01, 1]),
    )
    expected = (pid + control.tf([0.3 * 0.04, 0], [0.04, 1])) * control.feedback(plant, pid)
    np.testing.assert_allclose(y[:, 0], control.step_response(expected, t).outputs, atol=2e-8)


def test_margins_do_not_feel_it(second_order: System) -> None:
    w = np.geomspace(0.1, 400.0, 30)
    plain, led = (ClosedLoop(second_order, PID(), feedforward=f) for f in (None, Feedforward()))
    L = [frequency_response(open_loop(loop, loop.parameters.with_values(GAINS)), w) for loop in (plain, led)]
    np.testing.assert_array_equal(L[0], L[1])
    assert is_linear(led)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_at_rest_and_in_steady_motion_it_adds_nothing(second_order: System, sample_time: float | None) -> None:
    loop = ClosedLoop(second_order, PID(sample_time), feedforward=Feedforward())
    p = loop.parameters.with_values(GAINS | LEAD)
    plain = ClosedLoop(second_order, PID(sample_time))
    x = loop.initial(p, reference=0.5)
    np.testing.assert_allclose(x[:-1], plain.initial(p, reference=0.5), atol=1e-12)
    if sample_time is not None:
        x = np.array(loop.update(0.0, x, [0.5], loop.parameter_vector(p))).ravel()
        assert x[names(loop.states).index("pid.command")] == pytest.approx(0.5 * 86.34 / 1270.12)
        return
    rates = loop.system().ode(0.0, x, [0.5], loop.parameter_vector(p))[0]
    np.testing.assert_allclose(np.array(rates).ravel(), 0.0, atol=1e-9)


def friction_loop(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time), feedforward=Feedforward(0.03))
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.lower": -300.0, "pid.upper": 300.0, "feedforward.gain": 300.0}
    bounds = {"pid.Kp": (50.0, 600.0), "feedforward.gain": (0.0, 1500.0), "feedforward.time": (5e-3, 0.1)}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_gradients_are_those_of_finite_differences(
    sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    loop, given = friction_loop(sample_time)
    steps = [Step(0.1, horizon=0.3), Step(0.1, at=0.05, initial=0.05, horizon=0.3)]
    simulator = Simulator(loop, steps, search_space(loop, given))
    posed = LinearisedProblem(
        simulator, sensitivity_rollout(simulator), specify(SettlingTime(), [Overshoot(0.1)]), 60, 1.0
    )
    z = np.array([0.4, 0.3, 0.5, 0.2037])
    check_slopes(posed, z)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_search_and_certificate_agree(sample_time: float | None) -> None:
    loop, given = friction_loop(sample_time)
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 300.0, 0.03]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    for name in ("SettlingTime", "Overshoot", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_it_makes_a_lag_follow_as_fast_as_wanted_whatever_the_gain() -> None:
    """k/(T s + 1) under ``Ki = 1/(k time)`` and ``gain = T/(k time) - Kp`` answers a step with 1 - exp(-t/time)."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), feedforward=Feedforward())
    k, T, time = loop.parameters.value("plant.gain"), 0.1, 0.02
    for Kp in (0.1, 2.0):
        values = {"pid.Kp": Kp, "pid.Ki": 1 / (k * time), "feedforward.time": time}
        values |= {"plant.time_constant": T, "feedforward.gain": T / (k * time) - Kp}
        found = evaluate(loop, Step(1.0, horizon=0.3), loop.parameters.with_values(values))["0 to 1"]
        assert found["SettlingTime"] == pytest.approx(time * np.log(50), abs=1e-4)


H, COUNT, LAG = 1e-3, 1e-5, 4e-3
OUTER = {"position_loop.Kp": 5.0, "position_loop.weight": 0.9}
MANY = ((3.0, 1.0), (5.0, 2.0), (8.0, 3.0))  # [kg], [V s/m]
CASCADE_GAINS = {"pid.Kp": 2.0, "pid.Ki": 4.0, "pid.b": 0.8}


def cascade(*parts: Compensator, sensor: Encoder | SensorLag | None = None, h: float | None = H) -> ClosedLoop:
    plant = catalog.t32()[0].system()
    delay = 1 if h else 0
    return ClosedLoop(plant, PID(h, limits=False, delay=delay), sensor=sensor, compensators=parts, outer=PositionLoop())


def given_values(loop: ClosedLoop, values: dict[str, float]) -> ParameterSet:
    known = catalog.t32()[1] | loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    return known.with_values({n: v for n, v in (CASCADE_GAINS | OUTER | values).items() if n in known})


def steady_motion(speed: float) -> tuple[np.ndarray, dict[str, float]]:
    drive, hardware = catalog.t32()
    found = drive.rest(hardware, position=0.1, speed=speed)
    return np.array([found.states[q.name] for q in drive.states]), dict(found.inputs)


def test_signals_and_units_are_those_of_position_and_speed() -> None:
    loop = cascade(MotionFeedforward(), FrictionFeedforward(Direction.MEASURED))
    assert (loop.feedback.name, loop.pid_signal.name) == ("position", "speed")
    assert [(q.name, q.unit) for q in loop.inputs] == [
        ("reference", "m"),
        ("reference_speed", "m/s"),
        ("reference_acceleration", "m/s^2"),
    ]
    units = {n: loop.parameters[n].unit for n in ("position_loop.Kp", "pid.Kp", "friction_feedforward.smoothing")}
    assert units == {"position_loop.Kp": "1/s", "pid.Kp": "V*s/m", "friction_feedforward.smoothing": "m/s"}
    assert "position_loop" in loop.controller.tunable_sections
    assert cascade(sensor=Encoder()).readings == ()
    assert loop.readings == ("position",)


def test_the_commands_are_those_of_a_hand_recursion() -> None:
    """Counts, their filtered difference, ``Kp (r - q) + weight v_r``, a PI with a set-point weight, a sample late."""
    loop, rng = cascade(DeadZoneInverse(), sensor=Encoder(COUNT, LAG)), np.random.default_rng(8)
    values = {"dead_zone_inverse.width": 0.15, "dead_zone_inverse.smoothing": 0.05}
    p = given_values(loop, values)
    x, order = loop.initial(p, reference=0.1), names(loop.states)
    position = 0.1 + np.cumsum(rng.normal(size=300)) * 2e-5
    wanted = 0.1 + 0.02 * np.sin(0.05 * np.arange(300))
    speed_wanted = np.gradient(wanted, H)
    integral = x[order.index("pid.integral")]
    count, speed, late, expected, found = round(0.1 / COUNT) * COUNT, 0.0, x[order.index("pid.command")], [], []
    for y, r, v in zip(position, wanted, speed_wanted, strict=True):
        q = COUNT * np.floor(y / COUNT + 0.5)
        speed += H / (H + LAG) * ((q - count) / H - speed)
        count = q
        target = 5.0 * (r - q) + 0.9 * v
        integral += 4.0 * H * (target - speed)
        u = 2.0 * (0.8 * target - speed) + integral
        expected.append(late)
        late = u + 0.15 * np.tanh(u / 0.05)
        x[order.index("position")] = y
        x = np.array(loop.update(0.0, x, [r, v], loop.parameter_vector(p))).ravel()
        found.append(x[order.index("pid.command")])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("encoder", [True, False])
def test_margins_are_those_of_the_exactly_sampled_loop(encoder: bool) -> None:
    control = pytest.importorskip("control")
    loop = cascade(PressureFeedback(), sensor=Encoder(COUNT, LAG) if encoder else None)
    p = given_values(loop, {"pressure_feedback.gain": 2e-6, "pressure_feedback.time": 0.08})
    x, u = steady_motion(0.2)
    plant = loop.plant.linearise(x, u, p)
    response = control.sample_system(control.ss(plant.A, plant.B, plant.C, plant.D), H, "zoh")
    w = np.geomspace(0.05, 0.999 * np.pi / H, 20000)
    z = np.exp(1j * w * H)
    y, v, a, b = (response(z)[plant.outputs.index(n), 0] for n in ("position", "speed", "pressure_a", "pressure_b"))
    v = y * (1 - 1 / z) / ((H + LAG) - LAG / z) if encoder else v
    proportional, integral = 2.0, 4.0 * H * z / (z - 1)
    passed = 2e-6 * 0.08 * (z - 1) / ((0.08 + H) * z - 0.08)
    L = ((0.8 * proportional + integral) * 5.0 * y + (proportional + integral) * v + passed * (a - b)) / z
    linear = open_loop(loop, p, x, u)
    np.testing.assert_allclose(frequency_response(linear, w[::100]), L[::100], rtol=1e-6)
    found = margins(linear)
    assert found.stable
    assert found.max_sensitivity == pytest.approx(np.abs(1 / (1 + L)).max(), rel=1e-5)
    seen = ((0.8 * proportional + integral) * 5.0 + encoder * (proportional + integral) * v / y) / (1 + L)
    noise = noise_gain(linear, noise_path(loop, p, x, u), 0.3)
    assert noise == pytest.approx(np.abs(seen)[w >= 0.3].max(), rel=1e-4)
    read = batch_margin_function(loop, np.geomspace(0.01, 20 / H, 600), 0.3)
    inputs = np.array([[[u.get(n, 0.0) for n in names(loop.plant.inputs)]]])
    in_search = read(loop.parameter_vector(p)[None], x[None, None], inputs, ["MaxSensitivity", "PhaseMargin"])
    assert in_search["MaxSensitivity"][0] == pytest.approx(found.max_sensitivity, rel=1e-3)
    assert in_search["PhaseMargin"][0] == pytest.approx(found.phase_margin, abs=0.1)


@pytest.mark.parametrize("h", [None, H])
@pytest.mark.parametrize("sensor", [None, SensorLag(2e-3), Encoder(0.0, LAG)])
def test_it_rests_where_the_reference_is(h: float | None, sensor: Encoder | SensorLag | None) -> None:
    if h is None and isinstance(sensor, Encoder):
        return
    loop = cascade(PressureFeedback(), sensor=sensor, h=h)
    p = given_values(loop, {"pressure_feedback.gain": 2e-6})
    x = loop.initial(p, reference=0.12)
    rates = np.array(
        (loop.system() if h is None else loop.hold_system()).ode(0.0, x, [0.12, 0.0], loop.parameter_vector(p))[0]
    ).ravel()
    scale = np.array([q.nominal for q in loop.states])
    assert x[0] == pytest.approx(0.12)
    np.testing.assert_allclose(rates / scale, 0.0, atol=1e-6)
    if h is not None:
        after = np.array(loop.update(0.0, x, [0.12, 0.0], loop.parameter_vector(p))).ravel()
        np.testing.assert_allclose((after - x) / scale, 0.0, atol=1e-9)


def test_a_plant_without_a_rest_of_its_own_is_solved_for() -> None:
    plant = ForceDrive(Viscous()).system()
    loop = ClosedLoop(plant, PID(limits=False), outer=PositionLoop())
    x = loop.initial(loop.parameters.with_values({"pid.Kp": 40.0, "pid.Ki": 90.0}), reference=0.3)
    assert dict(zip(names(loop.states), x, strict=True))["position"] == pytest.approx(0.3)


def test_the_rigs_controller_is_the_loops_own() -> None:
    loop = cascade(PressureFeedback(), sensor=Encoder(COUNT, LAG))
    p = given_values(loop, {"pressure_feedback.gain": 2e-6})
    t = np.arange(150) * H
    run = Trajectory(t, {"reference": 0.1 + 0.2 * t, "reference_speed": np.full(len(t), 0.2)})
    sensors = dict.fromkeys(("position", "pressure_a", "pressure_b"), Sensor())
    start = loop.initial(p, reference=0.1)
    rig = Rig(loop, sensors, encoder=Encoder(COUNT, LAG))
    log = record(rig, run, p, initial=start, rtol=1e-9).experiment.trajectory
    sent = simulate(loop, run, p, initial=start, rtol=1e-9)
    np.testing.assert_allclose(log["valve_voltage"], sent["control"], atol=1e-7)
    assert np.ptp(sent["control"]) > 0.3
    with pytest.raises(ModelError, match=r"reads position, which no sensor measures|needs 'position'"):
        Rig(cascade(), {"speed": Sensor()})


def test_new_gains_on_a_running_loop_do_not_bump() -> None:
    loop = cascade(PressureFeedback(), DeadZoneInverse(), sensor=Encoder(COUNT, LAG))
    old = given_values(loop, {"pressure_feedback.gain": 2e-6, "dead_zone_inverse.width": 0.1})
    new = old.with_values({"position_loop.Kp": 9.0, "pid.Kp": 3.0, "pid.b": 1.0, "pressure_feedback.gain": 1e-6})
    x = loop.initial(old, reference=0.1)
    x[1] += 0.02
    after = bumpless_transfer(loop, x, old, new, reference=0.102)
    pending = names(loop.states).index("pid.pending")
    sent = [
        float(loop.update(0.0, z, [0.102, 0.0], loop.parameter_vector(p))[pending]) for z, p in ((x, old), (after, new))
    ]
    assert sent[1] == pytest.approx(sent[0], abs=1e-9)
    bumped = float(loop.update(0.0, x, [0.102, 0.0], loop.parameter_vector(new))[pending])
    assert abs(bumped - sent[0]) > 0.01


def test_cascade_search_and_certificate_agree() -> None:
    plant = ForceDrive(Viscous()).system()
    loop = ClosedLoop(plant, PID(2e-3), outer=PositionLoop())
    values = {"pid.Kp": 200.0, "pid.Ki": 2000.0, "pid.lower": -300.0, "pid.upper": 300.0, "position_loop.Kp": 8.0}
    given = loop.parameters.with_values(values).with_bounds({"position_loop.Kp": (2.0, 20.0)}).freed("position_loop.Kp")
    step = Step(0.05, horizon=1.5)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([8.0]), specify(SettlingTime(), [Overshoot(0.5)]))
    certified = evaluate(loop, step, given)[step.label]
    for name in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity"):
        assert claimed[name] == pytest.approx(certified[name], rel=5e-3, abs=2e-3), name


def test_many_loops_at_once_are_linearised_as_each_alone() -> None:
    loop = cascade(PressureFeedback(), DeadZoneInverse(), sensor=Encoder(COUNT, LAG))
    sets = [given_values(loop, {"load.mass": m, "pid.Kp": k, "pressure_feedback.gain": 2e-6}) for m, k in MANY]
    p = np.array([loop.parameter_vector(each) for each in sets])
    x = np.array([loop.initial(each, reference=0.1)[: len(loop.plant.states)] for each in sets])
    linearise, u = ComposedLoops(loop), np.linspace(0.2, 0.4, len(sets))[:, None]
    together = linearise(p, x, u)
    for k in range(len(sets)):
        alone = linearise(p[k : k + 1], x[k : k + 1], u[k : k + 1])
        for found, wanted in zip((*together.loop, *together.noise), (*alone.loop, *alone.noise), strict=True):
            np.testing.assert_allclose(found[k], wanted[0], rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_exponentials_are_scipys() -> None:
    A = np.random.default_rng(1).standard_normal((4, 7, 7)) * np.array([1e-3, 0.3, 3.0, 10.0])[:, None, None]
    for found, wanted in zip(_exponentials(A), expm(A), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12 * np.abs(wanted).max())
    assert _exponentials(np.empty((0, 3, 3))).shape == (0, 3, 3)


def test_a_file_makes_it(tmp_path: Path) -> None:
    text = '[pid]\nsample_time = "1 ms"\nKp = "6 V*s/m"\n[position_loop]\nweight = "0.9"\n'
    text += 'Kp = { value = "12 1/s", lower = "1 1/s", upper = "50 1/s", free = true }\n'
    source = tmp_path / "tuning.toml"
    text += '[[reference]]\nstep = "10 mm"\nhorizon = "1 s"\n'
    source.write_text(text, encoding="utf-8")
    tuning = read_tuning(source, catalog.t32()[0].system())
    assert tuning.loop.outer == PositionLoop()
    assert (tuning.loop.feedback.name, tuning.parameters.free_names) == ("position", ("position_loop.Kp",))
    assert tuning.parameters.value("position_loop.Kp") == 12.0
    source.write_text(text.replace("Kp = {", "weighty = {"), encoding="utf-8")
    with pytest.raises(InputError, match=r"\[position_loop\] has no Kp"):
        read_tuning(source, catalog.t32()[0].system())


FAULTY_SAMPLES_H = 2e-3
FORCE, AIR = ForceDrive(friction=Viscous()).system(), PneumaticDrive(friction=Viscous()).system()
BAD = pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e31, -1e300])
FAULTY_SAMPLES_GAINS = {
    "pid.Kp": 3.0,
    "pid.Ki": 20.0,
    "pid.Kd": 0.05,
    "pid.Tf": 0.004,
    "pid.lower": -5.0,
    "pid.upper": 5.0,
}


class Bench:
    """A loop's controller, its plant moved by hand."""

    def __init__(self, loop: ClosedLoop, values: Mapping[str, float]) -> None:
        self.loop, self.order, self.k = loop, names(loop.states), 0
        known = {n: v for n, v in values.items() if n in loop.parameters}
        self.parameters = loop.parameters.with_values(known)
        self.x = loop.initial(self.parameters)

    def sample(self, reference: float, **plant: float) -> dict[str, float]:
        """The states after a sample at which the plant's states have these values."""
        for name, value in plant.items():
            self.x[self.order.index(name)] = value
        u = [reference] + [0.0] * (len(self.loop.inputs) - 1)
        p, t = self.loop.parameter_vector(self.parameters), self.k * (self.loop.pid.sample_time or 0.0)
        self.x, self.k = self.loop.update(t, self.x, u, p).full().ravel(), self.k + 1
        return self.states

    @property
    def states(self) -> dict[str, float]:
        """Those of the controller."""
        own = zip(self.order, self.x.tolist(), strict=True)
        return {n: v for n, v in own if n not in names(self.loop.plant.states)}


@BAD
@pytest.mark.parametrize("where", ["reference", "speed"])
@pytest.mark.parametrize("delay", [0, 1])
def test_the_output_is_held_and_the_states_stay(bad: float, where: str, delay: int) -> None:
    bench = Bench(
        ClosedLoop(AIR, PID(FAULTY_SAMPLES_H, delay=delay), Dither(60.0)),
        {**FAULTY_SAMPLES_GAINS, "dither.amplitude": 0.3},
    )
    for k in range(4):
        before = bench.sample(0.2, speed=0.05 * k)
    after = bench.sample(bad if where == "reference" else 0.2, speed=bad if where == "speed" else 0.2)
    sent = before["pid.pending" if delay else "pid.command"]
    assert after == before | {"pid.command": sent, "pid.bad_samples": 1.0}  # the delayed one acts, and stays
    assert bench.sample(0.2, speed=0.2)["pid.bad_samples"] == 0.0


def test_every_signal_that_is_read_counts_and_no_other() -> None:
    loop = ClosedLoop(
        AIR, PID(FAULTY_SAMPLES_H), measured="position", outer=PositionLoop(), compensators=(PressureFeedback(),)
    )
    for name in ("position", "speed", "pressure_a", "pressure_b"):
        bench = Bench(loop, FAULTY_SAMPLES_GAINS)
        assert bench.sample(0.1, **{name: np.nan})["pid.bad_samples"] == 1.0
    bench = Bench(loop, FAULTY_SAMPLES_GAINS)
    assert bench.sample(0.1, **{"valve.spool": np.nan})["pid.bad_samples"] == 0.0
    lagging = Bench(ClosedLoop(AIR, PID(FAULTY_SAMPLES_H), sensor=SensorLag(5e-3)), FAULTY_SAMPLES_GAINS)
    assert lagging.sample(0.1, speed=np.nan)["pid.bad_samples"] == 0.0  # the controller sees the sensor
    after = lagging.sample(0.1, **{"sensor.reading": np.nan})
    assert after["pid.bad_samples"] == 1.0
    assert np.isnan(after["sensor.reading"])  # which is not the controller's to mend


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(("wanted", "safe"), [(-1.0, -1.0), (9.0, 5.0)])
def test_after_so_many_it_is_safe_and_begins_anew_as_at_a_start(delay: int, wanted: float, safe: float) -> None:
    values = {**FAULTY_SAMPLES_GAINS, "pid.fault_samples": 3.0, "pid.fault_output": wanted}
    loop = ClosedLoop(
        AIR, PID(FAULTY_SAMPLES_H, delay=delay), feedforward=Feedforward(), compensators=(AccelerationFeedback(),)
    )
    bench = Bench(loop, {**values, "feedforward.gain": 2.0, "acceleration_feedback.gain": 0.1})
    for k in range(5):
        bench.sample(0.2, speed=0.02 * k)
    held = "pid.pending" if delay else "pid.command"
    sent = [bench.sample(0.2, speed=np.nan)[held] for _ in range(7)]
    assert sent[0] == sent[1] != safe
    assert sent[2:] == [safe] * 5
    assert bench.states["pid.bad_samples"] == 7.0
    after = bench.sample(-0.1, speed=0.3)
    begun = Bench(loop, values)
    begun.parameters = bench.parameters
    x = loop.initial(bench.parameters, [0.0, 0.3, 5e5, 5e5, 0.0, 0.0], reference=-0.1, command=safe)
    begun.x = x
    expected = begun.sample(-0.1, speed=0.3)
    assert after == pytest.approx(expected, abs=1e-12)
    assert after[held] == pytest.approx(
        np.clip(safe + FAULTY_SAMPLES_H * 20.0 * -0.4, -5, 5)
    )  # but for the integral's first step


@pytest.mark.parametrize("gap", [1, 2, 4])
def test_differences_are_taken_over_the_whole_gap(gap: int) -> None:
    """A signal that rises evenly has the same slope behind a gap as before it."""
    rate = 0.7
    values = {"pid.Kp": 0.0, "pid.Ki": 0.0, "pid.Kd": 0.5, "pid.Tf": 0.0, "pid.c": 0.0}
    bench = Bench(ClosedLoop(FORCE, PID(FAULTY_SAMPLES_H, limits=False), measured="position"), values)
    counter = Bench(
        ClosedLoop(FORCE, PID(FAULTY_SAMPLES_H, limits=False), sensor=Encoder(filter=0.0)), FAULTY_SAMPLES_GAINS
    )
    for k in range(3):
        for b in (bench, counter):
            b.sample(0.0, position=rate * FAULTY_SAMPLES_H * (k + 1))
    for _ in range(gap):
        for b in (bench, counter):
            b.sample(0.0, position=np.nan)
    after = bench.sample(0.0, position=rate * FAULTY_SAMPLES_H * (4 + gap))
    assert after["pid.command"] == pytest.approx(-0.5 * rate, rel=1e-9)
    assert counter.sample(0.0, position=rate * FAULTY_SAMPLES_H * (4 + gap))["sensor.reading"] == pytest.approx(
        rate, rel=1e-9
    )


def test_filters_count_the_gap_and_the_integral_one_sample() -> None:
    parts = (PressureFeedback(), AccelerationFeedback())
    values = {**FAULTY_SAMPLES_GAINS, "pid.Kd": 0.0, "feedforward.time": 0.05, "pressure_feedback.time": 0.1}
    bench = Bench(ClosedLoop(AIR, PID(FAULTY_SAMPLES_H), feedforward=Feedforward(), compensators=parts), values)
    bench.sample(0.1, speed=0.0, pressure_a=5e5, pressure_b=5e5)
    before = bench.states
    for _ in range(3):
        bench.sample(np.nan)
    after = bench.sample(0.3, speed=0.2, pressure_a=6e5, pressure_b=5e5)
    passed = 4 * FAULTY_SAMPLES_H
    slow = {"feedforward.filter": (0.05, 0.3), "pressure_feedback.slow": (0.1, 1e5)}
    slow |= {"acceleration_feedback.speed": (5e-3, 0.2)}
    for name, (time, signal) in slow.items():
        assert after[name] == pytest.approx((time * before[name] + passed * signal) / (time + passed))
    assert after["pid.integral"] == pytest.approx(before["pid.integral"] + 20.0 * FAULTY_SAMPLES_H * 0.1)


def test_a_dither_keeps_its_phase() -> None:
    loop, values = (
        ClosedLoop(FORCE, PID(FAULTY_SAMPLES_H, limits=False), Dither(60.0)),
        {"pid.Kp": 0.0, "dither.amplitude": 1.0},
    )
    whole, broken = Bench(loop, values), Bench(loop, values)
    for k in range(20):
        one = whole.sample(0.0)["pid.command"]
        other = broken.sample(np.nan if 5 <= k < 15 else 0.0)["pid.command"]
    assert one == other != 0.0


@pytest.mark.parametrize("lanes", [0, 1, None])
@pytest.mark.parametrize("segments", [1, 40])
@pytest.mark.parametrize("sensor", [None, Encoder(filter=4e-3)])
def test_machine_code_and_array_programs_do_the_same(lanes: int | None, segments: int, sensor: Encoder | None) -> None:
    loop = ClosedLoop(
        FORCE, PID(FAULTY_SAMPLES_H, form=Form.STANDARD), Dither(60.0), sensor=sensor, feedforward=Feedforward()
    )
    values = {"pid.Kp": 40.0, "pid.Ti": 0.3, "pid.Td": 0.01, "dither.amplitude": 2.0, "feedforward.gain": 5.0}
    p = loop.parameters.with_values({**values, "pid.lower": -9.0, "pid.upper": 9.0, "pid.fault_output": 1.0})
    reference = np.where(np.arange(60) > 4, 0.2, 0.0)
    reference[[10, 11, 25]] = np.nan, np.inf, -np.inf
    reference[30:41] = 1e31
    u, t = np.zeros((segments, 60, len(loop.inputs))), np.tile(FAULTY_SAMPLES_H * np.arange(60), (segments, 1))
    u[:, :, 0] = reference
    rollout = Rollout(loop.discrete().pieces, lanes=lanes)
    run = rollout.run(
        np.tile(loop.initial(p), (segments, 1)), u, loop.parameter_vector(p), t, np.full_like(t, FAULTY_SAMPLES_H)
    )
    expected = by_hand(loop, p, reference)
    assert np.isfinite(run.y).all()
    for y in run.y[..., names(loop.outputs).index("control")]:
        np.testing.assert_allclose(y, expected, rtol=0, atol=1e-11)
    assert expected[11] == expected[10] == expected[9]
    assert expected[40] == 1.0


def by_hand(loop: ClosedLoop, p: ParameterSet, reference: Array) -> Array:
    """The outputs of the loop, sample by sample."""
    x, v, step = loop.initial(p), loop.parameter_vector(p), loop.discrete()
    found = []
    for k, r in enumerate(reference):
        x = loop.update(k * FAULTY_SAMPLES_H, x, [r], v).full().ravel()
        found.append(x[names(loop.states).index("pid.command")])
        x = step.step(k * FAULTY_SAMPLES_H, FAULTY_SAMPLES_H, x, [r], v)[0].full().ravel()
    return np.array(found)


@pytest.mark.parametrize("samples", [1, 3, 12])
def test_a_loop_arrives_all_the_same(samples: int) -> None:
    """A step with a fault in its rise: no worse than the step itself, for which the plant was on its own."""
    loop = ClosedLoop(FirstOrder().system(), PID(1e-2))
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.lower": -2.0, "pid.upper": 2.0})
    x, v, step, y = loop.initial(p), loop.parameter_vector(p), loop.discrete(), []
    for k in range(400):
        x = loop.update(k * 1e-2, x, [np.nan if 5 <= k < 5 + samples else 1.0], v).full().ravel()
        x = step.step(k * 1e-2, 1e-2, x, [1.0], v)[0].full().ravel()
        y.append(x[0])
    assert y[-1] == pytest.approx(1.0, abs=1e-3)
    assert max(y) < 1.3


@pytest.mark.parametrize("name", ["pid.fault_samples", "pid.fault_output"])
def test_what_a_fault_does_is_never_free(name: str) -> None:
    loop = ClosedLoop(FORCE, PID(FAULTY_SAMPLES_H))
    bounded = loop.parameters.freed("pid.Kp", name).with_bounds(
        {"pid.Kp": (0.1, 9.0), name: (0.0, 9.0) if "output" in name else (1.0, 9.0)}
    )
    with pytest.raises(InputError, match=f"{name} is free, but"):
        search_space(loop, bounded)


def test_a_continuous_controller_has_no_parameters_of_faults() -> None:
    assert not PID().fixed_parameters
    assert not [n for n in PID().parameters("m", "N") if n.startswith("fault")]


DELAY_GAINS = {"pid.Kp": 0.18, "pid.Ki": 0.9, "pid.Kd": 0.008, "pid.Tf": 0.01}
STEP = Step(0.1, horizon=0.3)


def exact(h: float, delay: int) -> control.TransferFunction:
    """The sampled open loop of eq. 16: exact zero-order hold, backward-Euler controller, whole samples of delay."""
    plant = control.sample_system(control.tf([1270.12], [1, 17.5, 86.34]), h, "zoh")
    z = control.tf([1, 0], [1], h)
    slope = (z - 1) / (h * z)
    C = (
        DELAY_GAINS["pid.Kp"]
        + DELAY_GAINS["pid.Ki"] / slope
        + DELAY_GAINS["pid.Kd"] * slope / (DELAY_GAINS["pid.Tf"] * slope + 1)
    )
    return control.minreal(plant * C / z**delay, verbose=False)


@pytest.mark.parametrize("h", [1e-3, 4e-3, 1e-2])
@pytest.mark.parametrize("delay", [0, 1])
def test_margins_are_those_of_the_sampled_loop(second_order: System, h: float, delay: int) -> None:
    loop = ClosedLoop(second_order, PID(h, delay=delay))
    ours, L = margins(open_loop(loop, loop.parameters.with_values(DELAY_GAINS))), exact(h, delay)
    w = np.geomspace(0.1, 0.999 * np.pi / h, 2000)
    Ms = np.max(1 / np.abs(1 + L(np.exp(1j * w * h))))
    gain, phase, *_ = control.stability_margins(control.frd(L, w, smooth=True))
    assert ours.max_sensitivity == pytest.approx(Ms, rel=1e-3)
    assert ours.gain_margin == pytest.approx(gain, rel=0.02)
    assert ours.phase_margin == pytest.approx(phase, abs=0.1)


def test_a_delay_costs_phase(second_order: System) -> None:
    found = []
    for delay in (0, 1):
        loop = ClosedLoop(second_order, PID(4e-3, delay=delay))
        found.append(margins(open_loop(loop, loop.parameters.with_values(DELAY_GAINS))))
    lost = np.degrees(found[0].gain_crossover * 4e-3)
    assert found[0].phase_margin - found[1].phase_margin == pytest.approx(lost, rel=1e-3)


def delay_friction_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(5e-3, delay=1))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0), "pid.Kd": (0.0, 0.5)}
    values = {"pid.Kp": 200.0, "pid.Ki": 3000.0, "pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("step", [Step(0.1, horizon=0.6), Step(0.1, at=0.05, initial=0.05, horizon=0.6)])
def test_delay_search_and_certificate_agree(step: Step) -> None:
    loop, given = delay_friction_loop()
    simulator, spec = Simulator(loop, [step], search_space(loop, given)), specify(SettlingTime(), [MaxSensitivity(2.0)])
    (claimed,) = simulator.table(np.array([200.0, 3000.0, 0.0]), spec)
    certified = evaluate(loop, step, given)[step.label]
    assert np.isfinite(certified["SettlingTime"])
    for name in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_delay_gradients_are_those_of_finite_differences(
    check_slopes: Callable[[LinearisedProblem, np.ndarray], None],
) -> None:
    loop, given = delay_friction_loop()
    simulator = Simulator(loop, [STEP, Step(0.1, at=0.05, initial=0.05, horizon=0.3)], search_space(loop, given))
    spec = specify(SettlingTime(), [Overshoot(0.1), MaxSensitivity(1.6)])
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0)
    z = np.array([0.3, 0.3, 0.2, 0.2037])
    check_slopes(posed, z)


def test_a_tuning_reckons_with_it() -> None:
    """Tuned without the delay the loop overshoots once it is there; tuned with it, it keeps the limit."""
    loop, given = delay_friction_loop()
    ignorant = ClosedLoop(loop.plant, PID(5e-3))
    quick = Racing(members=8, trials=40, polish=16)
    limits = [Overshoot(0.05)]
    knowing = tune(loop, STEP, given, minimise=SettlingTime(), subject_to=limits, method=quick, plants={})
    blind = tune(ignorant, STEP, given, minimise=SettlingTime(), subject_to=limits, method=quick, plants={})
    seen = evaluate(loop, STEP, blind.parameters)["0 to 0.1"]
    assert knowing.certified["0 to 0.1"]["Overshoot"] <= 5.0
    assert seen["Overshoot"] > 5.0 or not seen["SettlingTime"] <= knowing.certified["0 to 0.1"]["SettlingTime"]


def test_a_controller_needs_no_plant_to_run_and_to_be_exported() -> None:
    """Of the signals alone it is the same controller as in a loop, to the byte of its files."""
    loop = ClosedLoop(
        ForceDrive(Stribeck()).system(),
        PID(sample_time=1e-3),
        Dither(frequency=160.0),
        measured="position",
        sensor=Encoder(),
        compensators=(MotionFeedforward(),),
        outer=PositionLoop(),
    )
    command, outputs = Quantity("force", "N", 100.0), {q.name: q for q in loop.plant.outputs}
    signals = PlantSignals(command, outputs["position"], outputs, loop.plant.axis)
    alone = Controller(loop.pid, signals, loop.dither, loop.sensor, None, loop.compensators, loop.outer)
    assert list(alone.parameters) == [n for n in loop.parameters if n not in loop.plant.parameters]
    assert [*loop.plant.states, *alone.states] == [*loop.states]
    parameters = alone.parameters.with_values({"pid.Kp": 300.0, "pid.Ki": 2000.0, "dither.amplitude": 3.0})
    for language in Language:
        files = export_controller(alone, parameters, language)
        assert files == export_controller(loop, loop.parameters | parameters, language)
