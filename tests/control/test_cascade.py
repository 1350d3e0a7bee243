"""A cascade: position loop around the PID of the speed, against hand recursions and python-control."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pneuopt.control.bumpless import bumpless_transfer
from pneuopt.control.compensation import Compensator
from pneuopt.control.composed_loops import ComposedLoops, _exponentials
from pneuopt.control.dead_zone_inverse import DeadZoneInverse
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.friction_feedforward import Direction, FrictionFeedforward
from pneuopt.control.linear_loop import noise_path, open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.motion_feedforward import MotionFeedforward
from pneuopt.control.pid import PID
from pneuopt.control.position_loop import PositionLoop
from pneuopt.control.pressure_feedback import PressureFeedback
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names
from pneuopt.evaluation.batch_margins import batch_margin_function
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import frequency_response, margins, noise_gain
from pneuopt.evaluation.record import record
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import read_tuning
from pneuopt.models import catalog
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

H, COUNT, LAG = 1e-3, 1e-5, 4e-3
OUTER = {"position_loop.Kp": 5.0, "position_loop.weight": 0.9}
MANY = ((3.0, 1.0), (5.0, 2.0), (8.0, 3.0))  # [kg], [V s/m]
GAINS = {"pid.Kp": 2.0, "pid.Ki": 4.0, "pid.b": 0.8}


def cascade(*parts: Compensator, sensor: Encoder | SensorLag | None = None, h: float | None = H) -> ClosedLoop:
    plant = catalog.t32()[0].system()
    delay = 1 if h else 0
    return ClosedLoop(plant, PID(h, limits=False, delay=delay), sensor=sensor, compensators=parts, outer=PositionLoop())


def given_values(loop: ClosedLoop, values: dict[str, float]) -> ParameterSet:
    known = catalog.t32()[1] | loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    return known.with_values({n: v for n, v in (GAINS | OUTER | values).items() if n in known})


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
    assert "position_loop" in loop.tunable_sections
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
    np.testing.assert_allclose(frequency_response(linear, 2 / H * np.tan(w * H / 2)[::100]), L[::100], rtol=1e-6)
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


def test_search_and_certificate_agree() -> None:
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
    source.write_text(text + '[[reference]]\nstep = "10 mm"\nhorizon = "1 s"\n', encoding="utf-8")
    tuning = read_tuning(source, catalog.t32()[0].system())
    assert tuning.loop.outer == PositionLoop()
    assert (tuning.loop.feedback.name, tuning.parameters.free_names) == ("position", ("position_loop.Kp",))
    assert tuning.parameters.value("position_loop.Kp") == 12.0
    source.write_text(text.replace("Kp = {", "weighty = {"), encoding="utf-8")
    with pytest.raises(InputError, match=r"\[position_loop\] has no gain; write Kp"):
        read_tuning(source, catalog.t32()[0].system())


def test_what_does_not_fit_is_refused() -> None:
    plant = catalog.t32()[0].system()
    with pytest.raises(ModelError, match="a PositionLoop controls the position, this loop 'pressure_a'"):
        ClosedLoop(plant, PID(), measured="pressure_a", outer=PositionLoop())
    with pytest.raises(ModelError, match="take MotionFeedforward"):
        ClosedLoop(plant, PID(), feedforward=Feedforward(), outer=PositionLoop())
