"""Scheduled gains: against hand recursions, fixed gains at each position, the search, the rig and python files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.controller import PositionLoop
from pneuopt.control.gain_schedule import SCHEDULED_GAINS, GainSchedule
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop, bumpless_transfer
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import batch_margin_function, frequency_response, margins, sensitivity_terms
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor, record
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import read_tuning
from pneuopt.models import catalog
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

H, COUNT, LAG = 1e-3, 1e-5, 4e-3
SCHEDULE = GainSchedule(("pid.Kp", "pid.Ki", "position_loop.Kp"), 0.0, 0.2, load=5.0)
VALUES = {
    "pid.Kp": 1.0,
    "pid.Ki": 2.0,
    "pid.b": 0.8,
    "position_loop.Kp": 5.0,
    "schedule.load": 8.0,
    "schedule.Kp_slope": 0.4,
    "schedule.Kp_curve": 0.3,
    "schedule.Kp_load": 0.5,
    "schedule.Ki_curve": -0.5,
    "schedule.position_loop_Kp_slope": -0.6,
    "schedule.position_loop_Kp_load": -0.25,
}


def cascade(sensor: Encoder | SensorLag | None = None, h: float | None = H) -> tuple[ClosedLoop, ParameterSet]:
    plant, hardware = catalog.t32()[0].system(), catalog.t32()[1]
    pid = PID(h, limits=False, delay=1 if h else 0)
    loop = ClosedLoop(plant, pid, sensor=sensor, outer=PositionLoop(), schedule=SCHEDULE)
    own = loop.parameters.select([n for n in loop.parameters if n not in plant.parameters])
    return loop, (hardware | own).with_values(VALUES)


def gains_at(y: float) -> tuple[float, float, float]:
    """Kp, Ki and the outer Kp of `VALUES`, by hand."""
    xi = min(1.0, max(-1.0, (y - 0.1) / 0.1))
    Kp = np.exp(0.4 * xi + 0.3 * xi**2) * 1.6**0.5
    return float(Kp), float(2.0 * np.exp(-0.5 * xi**2)), float(5.0 * np.exp(-0.6 * xi) * 1.6**-0.25)


def fixed_at(loop: ClosedLoop, p: ParameterSet, y: float) -> tuple[ClosedLoop, ParameterSet]:
    """The loop whose gains are those of a position."""
    bare = replace(loop, schedule=None)
    gains = dict(zip(("pid.Kp", "pid.Ki", "position_loop.Kp"), gains_at(y), strict=True))
    return bare, p.select(bare.parameters).with_values(gains)


def test_signals_and_parameters() -> None:
    loop, p = cascade()
    assert loop.readings == ("position",)
    assert cascade(Encoder())[0].readings == ()
    assert (p["schedule.low"].unit, p["schedule.load"].unit, p["schedule.Kp_slope"].unit) == ("m", "kg", "1")
    assert "schedule" in loop.controller.tunable_sections
    speed = ClosedLoop(loop.plant, PID(H), schedule=GainSchedule(("pid.Kp",), 0.0, 0.2))
    assert speed.readings == ("position",)
    assert "schedule.load" not in speed.parameters
    assert ClosedLoop(loop.plant, PID(H), measured="position", schedule=GainSchedule(("pid.Kp",), 0, 1)).readings == ()


def test_the_commands_are_those_of_a_hand_recursion() -> None:
    """The cascade's, each sample with the gains of the position just counted; beyond the ends with those of the end."""
    (loop, p), rng = cascade(Encoder(COUNT, LAG)), np.random.default_rng(8)
    x, order = loop.initial(p, reference=0.1), names(loop.states)
    position = np.linspace(0.1, 0.23, 300) + np.cumsum(rng.normal(size=300)) * 2e-5
    wanted = position + 2e-3 * np.sin(0.05 * np.arange(300))
    integral = x[order.index("pid.integral")]
    count, speed, late, expected, found = round(0.1 / COUNT) * COUNT, 0.0, x[order.index("pid.command")], [], []
    for y, r in zip(position, wanted, strict=True):
        q = COUNT * np.floor(y / COUNT + 0.5)
        speed += H / (H + LAG) * ((q - count) / H - speed)
        count = q
        Kp, Ki, outer = gains_at(q)
        target = outer * (r - q) + 0.3
        integral += Ki * H * (target - speed)
        expected.append(late)
        late = Kp * (0.8 * target - speed) + integral
        x[order.index("position")] = y
        x = np.array(loop.update(0.0, x, [r, 0.3], loop.parameter_vector(p))).ravel()
        found.append(x[order.index("pid.command")])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("y", [0.0, 0.07, 0.2])
@pytest.mark.parametrize(("h", "sensor"), [(None, None), (H, Encoder(COUNT, LAG)), (H, SensorLag(2e-3))])
def test_margins_are_those_of_the_gains_frozen_at_a_position(
    h: float | None, sensor: Encoder | SensorLag | None, y: float
) -> None:
    loop, p = cascade(sensor, h)
    rest = catalog.t32()[0].rest(catalog.t32()[1], position=y, speed=0.2)
    x, u = np.array([rest.states[q.name] for q in loop.plant.states]), dict(rest.inputs)
    found, (bare, fixed) = margins(open_loop(loop, p, x, u)), fixed_at(loop, p, y)
    wanted = margins(open_loop(bare, fixed, x, u))
    assert wanted.stable
    for name in ("max_sensitivity", "phase_margin", "gain_margin"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-9), name
    read = batch_margin_function(loop, np.geomspace(0.01, 2e4, 600), 0.3)
    inputs = np.array([[[u.get(n, 0.0) for n in names(loop.plant.inputs)]]])
    batch = read(loop.parameter_vector(p)[None], x[None, None], inputs, ["MaxSensitivity"])
    assert batch["MaxSensitivity"][0] == pytest.approx(wanted.max_sensitivity, rel=1e-3)


def test_they_differ_along_the_stroke() -> None:
    loop, p = cascade()
    peaks = [
        abs(frequency_response(open_loop(loop, p, loop.initial(p, reference=y)[: len(loop.plant.states)]), [30.0])[0])
        for y in (0.0, 0.2)
    ]
    assert peaks[1] != pytest.approx(peaks[0], rel=0.05)


@pytest.mark.parametrize(("h", "sensor"), [(None, None), (H, None), (H, SensorLag(2e-3)), (H, Encoder(0.0, LAG))])
def test_it_rests_where_the_reference_is(h: float | None, sensor: Encoder | SensorLag | None) -> None:
    loop, p = cascade(sensor, h)
    x, u = loop.initial(p, reference=0.17), [0.17, 0.0]
    rates = np.array((loop.hold_system() if h else loop.system()).ode(0.0, x, u, loop.parameter_vector(p))[0]).ravel()
    scale = np.array([q.nominal for q in loop.states])
    np.testing.assert_allclose(rates / scale, 0.0, atol=1e-6)
    if h is not None:
        after = np.array(loop.update(0.0, x, u, loop.parameter_vector(p))).ravel()
        np.testing.assert_allclose((after - x) / scale, 0.0, atol=1e-9)


def test_a_rig_runs_it() -> None:
    loop, p = cascade(Encoder(COUNT, LAG))
    t = np.arange(250) * H
    run = Trajectory(t, {"reference": 0.1 + 0.3 * t, "reference_speed": np.full(len(t), 0.3)})
    start = loop.initial(p, reference=0.1)
    rig = Rig(loop, {"position": Sensor()}, encoder=Encoder(COUNT, LAG))
    log = record(rig, run, p, initial=start, rtol=1e-9).experiment.trajectory
    sent = simulate(loop, run, p, initial=start, rtol=1e-9)
    np.testing.assert_allclose(log["valve_voltage"], sent["control"], atol=1e-7)
    bare, fixed = fixed_at(loop, p, 0.1)
    other = simulate(bare, run, fixed, initial=bare.initial(fixed, reference=0.1), rtol=1e-9)
    assert np.abs(other["control"] - sent["control"]).max() > 1e-3


def test_new_coefficients_on_a_running_loop_do_not_bump() -> None:
    loop, old = cascade()
    new = old.with_values({"schedule.Kp_slope": -0.5, "schedule.load": 3.0})
    x = loop.initial(old, reference=0.15)
    x[1] += 0.02
    after = bumpless_transfer(loop, x, old, new, reference=0.152)
    pending = names(loop.states).index("pid.pending")
    sent = [
        float(loop.update(0.0, z, [0.152, 0.0], loop.parameter_vector(p))[pending])
        for z, p in ((x, old), (after, new), (x, new))
    ]
    assert sent[1] == pytest.approx(sent[0], abs=1e-9)
    assert abs(sent[2] - sent[0]) > 0.01


def test_search_and_certificate_agree() -> None:
    plant = ForceDrive(Viscous()).system()
    schedule = GainSchedule(("pid.Kp", "position_loop.Kp"), -0.1, 0.1, load=5.0)
    loop = ClosedLoop(plant, PID(2e-3), outer=PositionLoop(), schedule=schedule)
    values = {"pid.Kp": 200.0, "pid.Ki": 2000.0, "pid.lower": -300.0, "pid.upper": 300.0, "position_loop.Kp": 8.0}
    values |= {"schedule.Kp_load": 1.0, "schedule.load": 8.0, "schedule.position_loop_Kp_curve": 0.3}
    name = "schedule.position_loop_Kp_slope"
    given = loop.parameters.with_values(values).with_bounds({name: (-1.0, 1.0)}).freed(name)
    step = Step(0.05, horizon=1.5)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([0.7]), specify(SettlingTime(), [Overshoot(0.5), MaxSensitivity(2.0)]))
    certified = evaluate(loop, step, given.with_values({name: 0.7}))[step.label]
    for metric in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity"):
        assert claimed[metric] == pytest.approx(certified[metric], rel=5e-3, abs=2e-3), metric
    assert evaluate(loop, step, given)[step.label]["SettlingTime"] > 1.1 * certified["SettlingTime"]


FILE = (
    '[pid]\nsample_time = "1 ms"\nKp = "6 V*s/m"\n[schedule]\nlow = "0 mm"\nhigh = "200 mm"\nload = "5 kg"\n'
    "Kp_curve = { value = 0.1, lower = -1, upper = 1, free = true }\nKp_load = 0.5\n"
    '[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n[scenarios.corners]\n"load.mass + schedule.load" = "30 %"\n'
)


def test_a_file_makes_it(tmp_path: Path) -> None:
    source, plant = tmp_path / "tuning.toml", catalog.t32()[0].system()
    source.write_text(FILE, encoding="utf-8")
    tuning = read_tuning(source, plant)
    assert tuning.loop.schedule == GainSchedule(("pid.Kp",), 0.0, 0.2, 5.0)
    assert tuning.parameters.free_names == ("schedule.Kp_curve",)
    assert tuning.parameters.value("schedule.Kp_load") == 0.5
    corners = tuning.scenarios(catalog.t32()[1] | tuning.parameters)
    mass = catalog.t32()[1].value("load.mass")
    assert [v for c in corners.values() for v in c.values()] == pytest.approx([0.7 * mass, 3.5, 1.3 * mass, 6.5])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('low = "0 mm"\n', "", r"\[schedule\] has no low"),
        ('high = "200 mm"', 'high = "-1 mm"', "low must lie below high, got 0 and -0.001"),
        ('load = "5 kg"', 'load = "0 kg"', "the load must be positive, got 0.0"),
        ('load = "5 kg"\n', "", "unknown key 'Kp_load'"),
        ("Kp_curve", "Kd_bend", "unknown key 'Kd_bend'"),
        ("Kp_load", "position_loop_Kp_load", r"the loop has no position_loop\.Kp; schedule the gains that it has"),
        ("lower = -1, ", "", "Kp_curve is free, so it needs both bounds"),
        (
            FILE[FILE.index("Kp_curve") : FILE.index("[[ref")],
            "",
            "schedules no gain; write a coefficient such as Kp_sl",
        ),
    ],
)
def test_a_files_mistakes_are_refused(old: str, new: str, told: str, tmp_path: Path) -> None:
    source = tmp_path / "tuning.toml"
    assert old in FILE
    source.write_text(FILE.replace(old, new), encoding="utf-8")
    with pytest.raises((InputError, ModelError), match=told):
        read_tuning(source, catalog.t32()[0].system())


def test_what_does_not_fit_is_refused() -> None:
    loop, p = cascade()
    alone = ClosedLoop(loop.plant, PID(), schedule=GainSchedule(("pid.Kp",), 0.0, 0.2))
    with pytest.raises(ModelError, match="scheduled gains change with the operating point"):
        sensitivity_terms(alone, [1.0], p)
    with pytest.raises(ModelError, match="reads position, which no sensor measures"):
        Rig(replace(alone, pid=PID(H)), {"speed": Sensor()})
    assert set(SCHEDULED_GAINS) >= set(SCHEDULE.gains)
