"""Every registered compensator through the same mill; a new one is a row of the registry, and one of `ROWS`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq

from pneuopt.control.compensators import (
    COMPENSATORS,
    PRESSURES,
    AccelerationFeedback,
    Compensator,
    ControllerSnapshot,
    DeadZoneInverse,
    Direction,
    FrictionFeedforward,
    ImpulsiveControl,
    Knocker,
    MotionFeedforward,
    PressureFeedback,
)
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.linear_loop import noise_path, open_loop
from pneuopt.control.loop import ClosedLoop, bumpless_transfer
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensedSignal, SensorLag
from pneuopt.dynamics.simulate import simulate, simulate_stick_slip
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import batch_margin_function, frequency_response, margins, noise_gain
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.response import loop_inputs
from pneuopt.evaluation.rig import Actuator, Rig, Sensor, record
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.models import catalog
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, Stribeck, Viscous
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, ModelError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import unit_ratio
from pneuopt.tuning.gradients import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space

H = 2e-3  # [s] of the sampled loops


@dataclass(frozen=True)
class Row:
    """A compensator's units for V and m/s, values that act on a friction loop in N, and a tuning's section in V.

    `smooth` is a free parameter that the response depends on smoothly, with its bounds.
    """

    units: Mapping[str, str]
    acting: Mapping[str, float]
    section: str
    smooth: tuple[str, float, float]
    continuous: bool = True
    signed: bool = False
    scale: float = 1.0


ROWS: Mapping[str, Row] = {
    "pressure_feedback": Row(
        {"gain": "V/Pa", "time": "s"},
        {"gain": 3e-4, "time": 0.05},
        'gain = { value = "0.2 V/bar", lower = "0 V/bar", upper = "1 V/bar", free = true }\ntime = "50 ms"',
        ("gain", 0.0, 1e-3),
        signed=True,
        scale=1e-5,
    ),
    "acceleration_feedback": Row(
        {"gain": "V*s^2/m", "filter": "s"},
        {"gain": 3.0, "filter": 5e-3},
        'gain = { value = "0.2 V*s^2/m", lower = "0 V*s^2/m", upper = "1 V*s^2/m", free = true }\nfilter = "5 ms"',
        ("gain", 0.0, 6.0),
        signed=True,
    ),
    "motion_feedforward": Row(
        {"speed": "V*s/m", "acceleration": "V*s^2/m"},
        {"speed": 90.0, "acceleration": 4.0},
        'speed = { value = "0.2 V*s/m", lower = "0 V*s/m", upper = "9 V*s/m", free = true }\n'
        'acceleration = "0.1 V*s^2/m"',
        ("speed", 0.0, 200.0),
        signed=True,
    ),
    "friction_feedforward": Row(
        {"level": "V", "smoothing": "m/s"},
        {"level": 18.0, "smoothing": 0.02},
        'level = { value = "0.2 V", lower = "0 V", upper = "1 V", free = true }\nsmoothing = "5 mm/s"\n'
        'direction = "measured"',
        ("level", 0.0, 40.0),
    ),
    "knocker": Row(
        {"amplitude": "V", "width": "s", "period": "s", "smoothing": "V"},
        {"amplitude": 15.0, "width": 4e-3, "period": 2e-2, "smoothing": 0.5},
        'amplitude = { value = "0.2 V", lower = "0 V", upper = "1 V", free = true }\nwidth = "4 ms"\nperiod = "20 ms"',
        ("amplitude", 0.0, 30.0),
        continuous=False,
    ),
    "impulsive_control": Row(
        {"amplitude": "V", "limit": "V", "width": "s", "pause": "s", "tolerance": "m/s", "growth": "1", "brake": "1"},
        {"amplitude": 60.0, "limit": 500, "width": 2e-2, "pause": 6e-3, "tolerance": 0.05, "growth": 1.2, "brake": 0.5},
        'amplitude = { value = "0.2 V", lower = "0 V", upper = "1 V", free = true }\nwidth = "20 ms"\npause = "6 ms"\n'
        'tolerance = "2 mm/s"',
        ("amplitude", 0.0, 90.0),
        continuous=False,
    ),
    "dead_zone_inverse": Row(
        {"width": "V", "smoothing": "V"},
        {"width": 8.0, "smoothing": 5.0},
        'width = { value = "0.2 V", lower = "0 V", upper = "1 V", free = true }\nsmoothing = "50 mV"',
        ("width", 0.0, 20.0),
    ),
}
KINDS = pytest.mark.parametrize("section", COMPENSATORS)
SETTINGS = [(n, h) for n in COMPENSATORS for h in (None, H) if h or ROWS[n].continuous]
EVERY_SETTING = pytest.mark.parametrize(("section", "sample_time"), SETTINGS)
SPEED = SensedSignal(Quantity("speed", "m/s"), {}, H)


def with_pressures(plant: System) -> System:
    """The plant with two pressures among its outputs, the first of which moves with the speed."""
    t, x, u, p = (ca.SX.sym(n, plant.ode.size1_in(k)) for k, n in enumerate("txup"))
    xdot, y = plant.ode(t, x, u, p)
    more = ca.vertcat(5e5 + 2e5 * y[names(plant.outputs).index("speed")], 5e5)
    ode = ca.Function(plant.ode.name(), [t, x, u, p], [xdot, ca.vertcat(y, more)], [*"txup"], plant.ode.name_out())
    return replace(plant, outputs=(*plant.outputs, *(Quantity(n, "Pa(a)") for n in PRESSURES)), ode=ode)


FRICTION = with_pressures(ForceDrive(Stribeck()).system())
SIMPLE = with_pressures(SecondOrder().system())


def part(section: str) -> Compensator:
    return COMPENSATORS[section]()


def friction_loop(section: str, sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    """A mass with friction under a PI and the compensator, one gain and the smooth parameter free."""
    row = ROWS[section]
    own = {f"{section}.{n}": v for n, v in row.acting.items()}
    loop = ClosedLoop(FRICTION, PID(sample_time), compensators=(part(section),))
    name, low, high = row.smooth
    bounds = {"pid.Kp": (50.0, 400.0), f"{section}.{name}": (low, high)}
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.lower": -300.0, "pid.upper": 300.0, **own}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def test_every_compensator_has_a_row() -> None:
    assert set(ROWS) == set(COMPENSATORS)
    assert all(kind.section == name for name, kind in COMPENSATORS.items())


@KINDS
def test_parameters_are_declared_with_units_and_bounds(section: str) -> None:
    kind, row = part(section), ROWS[section]
    found = kind.parameters(SPEED, "V")
    assert {n: q.unit for n, q in found.items()} == dict(row.units)
    assert set(kind.without_gradient) <= set(found)
    assert (found[kind.size].value, found[kind.size].lower) == (0.0, -np.inf if row.signed else 0.0)
    assert all(unit_ratio(q.unit, "1") for q in found.values())
    for name in found if not row.signed else ():
        bad = ParameterSet({f"{section}.{name}": Parameter(-1.0, found[name].unit)})
        loop = ClosedLoop(SIMPLE, PID(H), compensators=(kind,))
        with pytest.raises(InputError, match=rf"{section}\.{name}"):
            loop.check(loop.parameters | bad)
    assert f"{section}.{kind.size}" in repr(ClosedLoop(SIMPLE, PID(H), compensators=(kind,)))


@EVERY_SETTING
def test_of_size_zero_it_changes_nothing(section: str, sample_time: float | None) -> None:
    drive = FRICTION
    plain, other = (ClosedLoop(drive, PID(sample_time), compensators=c) for c in ((), (part(section),)))
    rng, n = np.random.default_rng(1), len(plain.states)
    for _ in range(5):
        x, r = rng.normal(size=len(other.states)), rng.normal()
        p = rng.uniform(0.1, 1.0, len(plain.parameters))
        q = np.array([*p, *(other.parameters.value(n) for n in list(other.parameters)[len(p) :])])
        bare, full = (
            np.array(m.system().ode(0.0, z, [r], w)[0] if sample_time is None else m.update(0.0, z, [r], w)).ravel()
            for m, z, w in ((plain, x[:n], p), (other, x, q))
        )
        np.testing.assert_allclose(full[:n], bare, rtol=1e-12, atol=1e-12)


@KINDS
def test_derivatives_agree_with_finite_differences(section: str) -> None:
    kind, values = part(section), ROWS[section].acting
    r, y, v = (ca.SX.sym(n) for n in "ryv")
    x = {q.name: ca.SX.sym(q.name) for q in kind.states(SPEED, Quantity("u", "V"))}
    p = {n: ca.SX.sym(n) for n in kind.parameters(SPEED, "V")}
    rates, read = ({n: ca.SX.sym(n) for n in own} for own in (kind.motion_inputs(SPEED), kind.reads(SPEED)))
    moved, added = kind.act(ControllerSnapshot(ca.SX(0.0), r, y, v, H, rates, read), x, p)
    assert list(moved) == list(x)
    smooth = [n for n in p if n not in kind.without_gradient]
    z = ca.vertcat(r, y, v, *rates.values(), *read.values(), *x.values(), *p.values())
    f = ca.Function("f", [z], [ca.vertcat(added, *moved.values())])
    slope = ca.Function("J", [z], [ca.jacobian(f(z), z)])
    at = np.array([0.02, 0.01, 0.4, *[0.3] * (len(rates) + len(read) + len(x)), *(values[n] for n in p)])
    signals = len(at) - len(p)
    columns = [*range(signals), *(signals + list(p).index(n) for n in smooth)]
    nudges = [1e-6 * max(1e-3, abs(at[k])) * (np.arange(len(at)) == k) for k in columns]
    found = [(np.array(f(at + e)) - np.array(f(at - e))).ravel() / (2 * e.sum()) for e in nudges]
    np.testing.assert_allclose(np.array(slope(at))[:, columns], np.column_stack(found), rtol=1e-5, atol=1e-7)
    assert np.abs(found).max() > 0


@EVERY_SETTING
def test_gradients_of_a_response_are_those_of_finite_differences(
    section: str, sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    loop, given = friction_loop(section, sample_time)
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given))
    spec = specify(SettlingTime(), [Overshoot(0.1)])
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0)
    z = np.array([0.4, 0.4, 0.2037])
    (point,) = posed.evaluate(z[None])
    assert np.abs(point.slopes[:, 1]).max() > 0
    check_slopes(posed, z)


@EVERY_SETTING
def test_search_and_certificate_agree(section: str, sample_time: float | None) -> None:
    loop, given = friction_loop(section, sample_time)
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    size = given.value(f"{section}.{ROWS[section].smooth[0]}")
    (claimed,) = simulator.table(np.array([200.0, size]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    bare = evaluate(loop, step, given.with_values({f"{section}.{part(section).size}": 0.0}))[step.label]
    assert certified["IAE"] != pytest.approx(bare["IAE"], rel=1e-3)
    for name, off in {"SettlingTime": 2e-4, "Overshoot": 2e-3, "SteadyStateError": 2e-3, "PeakControl": 1e-3}.items():
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=off, nan_ok=True), name  # NaN: it hunts


@EVERY_SETTING
def test_a_moving_drive_goes_on_as_it_was(section: str, sample_time: float | None) -> None:
    """The valve's command in steady motion is not zero; the controller takes it over through the compensator."""
    drive, hardware = catalog.t32()
    loop = ClosedLoop(drive.system(), PID(sample_time), compensators=(part(section),))
    values = {
        "gain": 1e-6,
        "level": 0.3,
        "smoothing": 0.05,
        "width": 0.4,
        "amplitude": 0.3,
        "period": 0.02,
        "speed": 2.0,
    }
    own = {f"{section}.{n}": v for n, v in values.items() if f"{section}.{n}" in loop.parameters}
    p = (hardware | loop.parameters.select(n for n in loop.parameters if n not in hardware)).with_values(own)
    p = p.with_values({"pid.Ki": 3.0})
    plain = ClosedLoop(drive.system(), PID(sample_time))
    x, u = loop.initial(p, reference=0.1), [0.1]
    model, bare = (m.system() if sample_time is None else m.hold_system() for m in (loop, plain))
    if sample_time is not None:
        x = np.array(loop.update(0.0, x, u, loop.parameter_vector(p))).ravel()
    rates, y = (np.array(v).ravel() for v in model.ode(0.0, x, u, loop.parameter_vector(p)))
    wanted = np.array(bare.ode(0.0, plain.initial(p, reference=0.1), u, plain.parameter_vector(p))[1]).ravel()
    assert abs(y[-1]) > 0.05
    assert y[-1] == pytest.approx(wanted[-1], abs=1e-9)
    moving = [k for k, n in enumerate(names(model.states)) if n != "position"]
    scale = np.array([q.nominal for q in model.states])
    np.testing.assert_allclose((rates / scale)[moving], 0.0, atol=1e-6)


@EVERY_SETTING
def test_new_gains_on_a_running_loop_do_not_bump(section: str, sample_time: float | None) -> None:
    loop, old = friction_loop(section, sample_time)
    sizes = {f"{section}.{part(section).size}": 3.0 * ROWS[section].scale, "pid.Kp": 90.0, "pid.b": 0.4}
    new = old.with_values(sizes)
    rng = np.random.default_rng(4)
    x = rng.uniform(0.05, 0.2, len(loop.states))
    after = bumpless_transfer(loop, x, old, new, reference=0.3)
    sent = []
    for z, p in ((x, old), (after, new)):
        q = loop.parameter_vector(p)
        next_one = (
            loop.system().ode(0.0, z, [0.3], q)[1][-1]
            if sample_time is None
            else loop.update(0.0, z, [0.3], q)[names(loop.states).index("pid.command")]
        )
        sent.append(float(next_one))
    assert sent[1] == pytest.approx(sent[0], abs=1e-9)


@KINDS
def test_a_rigs_controller_runs_it(section: str) -> None:
    """On a rig without imperfections the recorded command is that of the loop."""
    loop, given = friction_loop(section, H)
    t = np.arange(101) * H
    rates = {q.name: 0.2 * np.sin(20 * t) for q in loop.motion_inputs}
    step = Trajectory(t, {"reference": np.where(t > 0, 0.1, 0.0), **rates})
    sensors = dict.fromkeys(("speed", *loop.readings), Sensor())
    log = record(Rig(loop, sensors), step, given, rtol=1e-9).experiment.trajectory
    sent = simulate(loop, step, given, rtol=1e-9)["control"]
    np.testing.assert_allclose(log["force"], sent, atol=1e-3)


@EVERY_SETTING
def test_a_file_reads_it_and_writes_what_was_found(section: str, sample_time: float | None, tmp_path: Path) -> None:
    text = "[pid]\n" + (f'sample_time = "{1e3 * sample_time:g} ms"\n' if sample_time else "") + 'Kp = "2 V*s/m"\n'
    text += f'[{section}]\n{ROWS[section].section}\n[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n'
    source = tmp_path / "tuning.toml"
    source.write_text(text, encoding="utf-8")
    tuning = read_tuning(source, SIMPLE)
    (found,) = tuning.loop.compensators
    size = f"{section}.{found.size}"
    assert (type(found), tuning.parameters.free_names) == (COMPENSATORS[section], (size,))
    assert tuning.parameters.value(size) == pytest.approx(0.2 * ROWS[section].scale)
    if isinstance(found, FrictionFeedforward):
        assert found.direction is Direction.MEASURED
    table = pd.DataFrame()
    tuned = tuning.parameters.with_values({size: 0.75 * ROWS[section].scale})
    write_tuned(
        tmp_path / "tuned.toml",
        source,
        TuningResult(tuned, table, table, table, table, (), Status(Code.CONVERGED), {}, {}),
    )
    again = read_tuning(tmp_path / "tuned.toml", SIMPLE)
    assert again.loop.compensators == tuning.loop.compensators
    assert again.parameters.value(size) == pytest.approx(0.75 * ROWS[section].scale)
    source.write_text(text.replace(f"{found.size} =", "strange ="), encoding="utf-8")
    with pytest.raises(InputError, match=rf"\[{section}\] has no {found.size}"):
        read_tuning(source, SIMPLE)


@KINDS
def test_several_act_one_on_the_others_command(section: str) -> None:
    """Behind a feedforward and before the clip, whose back-calculation unwinds what they add, too."""
    parts = tuple(part(n) for n in COMPENSATORS)
    loop = ClosedLoop(SIMPLE, PID(H), feedforward=Feedforward(), compensators=parts)
    sizes = {f"{c.section}.{c.size}": 0.3 for c in parts}
    values = {
        "pid.Kp": 2.0,
        "pid.Ki": 1e-9,
        "pid.Tt": 0.02,
        "pid.lower": -0.9,
        "pid.upper": 0.9,
        "feedforward.gain": 1.0,
    }
    p = loop.parameters.with_values({**values, **sizes, "friction_feedforward.smoothing": 0.05})
    x = np.zeros(len(loop.states))
    after = dict(
        zip(names(loop.states), np.array(loop.update(0.0, x, [0.1], loop.parameter_vector(p))).ravel(), strict=True)
    )
    v = 2.0 * 0.1 + 0.1 * 0.05 / 0.052 + 0.3 * 0.1
    v += 0.3 * np.tanh(0.1 / 0.05)
    pulse = 0.3 * np.tanh(v / 0.01)
    w = v + pulse + 0.3 * np.tanh((v + pulse) / 0.02)
    assert after["knocker.command"] == pytest.approx(v)
    assert (w > 0.9, after["pid.command"]) == (True, 0.9)
    assert after["pid.integral"] == pytest.approx(H / 0.02 * (0.9 - w))
    assert section in loop.controller.tunable_sections


def sent_by(loop: ClosedLoop, p: ParameterSet, reference: np.ndarray, h: float) -> np.ndarray:
    """The commands of a sampled loop whose plant stands still at zero."""
    x, sent = np.zeros(len(loop.states)), []
    held, plant = names(loop.states).index("pid.command"), len(loop.plant.states)
    for k, r in enumerate(reference):
        x = np.array(loop.update(k * h, x, [r], loop.parameter_vector(p))).ravel()
        x[:plant] = 0.0
        sent.append(x[held])
    return np.array(sent)


@pytest.mark.parametrize(("width", "period"), [(1, 4), (3, 7), (2, 2), (9, 4)])
def test_pulses_are_those_of_the_papers_recursion(second_order: System, width: int, period: int) -> None:
    """``a sign(u(t) - u(t_p))`` from an onset for the width, t_p the onset before; a wide one joins the pulses."""
    h, rng = 2e-3, np.random.default_rng(0)
    u = np.cumsum(rng.normal(size=60))
    loop = ClosedLoop(second_order, PID(h, limits=False), compensators=(Knocker(),))
    values = {"knocker.amplitude": 0.25, "knocker.width": width * h, "knocker.period": period * h}
    p = loop.parameters.with_values({"pid.Kp": 1.0, **values, "knocker.smoothing": 1e-9})
    expected, onset, sign = [], 0.0, 0.0
    for k, now in enumerate(u):
        if k % period == 0:
            sign, onset = np.sign(now - onset), now
        expected.append(now + 0.25 * sign * (k % period < width))
    np.testing.assert_allclose(sent_by(loop, p, u, h), expected, atol=1e-12)


def test_it_knocks_while_the_integral_winds_up_and_is_quiet_at_rest(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(1e-3, limits=False), compensators=(Knocker(),))
    values = {"pid.Kp": 0.0, "pid.Ki": 5.0, "knocker.amplitude": 0.3}
    p = loop.parameters.with_values(values)
    reference = np.concatenate([np.full(200, 1.0), np.zeros(200)])
    plain = np.cumsum(5e-3 * reference)
    pulses = sent_by(loop, p, reference, 1e-3) - plain
    assert pulses[:200].max() == pytest.approx(0.3 * np.tanh(0.05 / 0.01))
    np.testing.assert_allclose(pulses[:200] > 0.1, np.arange(200) % 10 < 2)
    np.testing.assert_allclose(pulses[211:], 0.0, atol=1e-12)


def test_measured_feedforward_leaves_a_frictionless_axis() -> None:
    """With the friction's own level and smoothing, Coulomb friction is as good as gone."""
    rough, smooth = ForceDrive(Coulomb()).system(), ForceDrive(Viscous()).system()
    loop = ClosedLoop(rough, PID(), compensators=(FrictionFeedforward(Direction.MEASURED),))
    plain = ClosedLoop(smooth, PID())
    gains = {"pid.Kp": 60.0, "pid.Ki": 500.0}
    level, within = (rough.parameters.value(f"friction.{n}") for n in ("coulomb", "smoothing"))
    own = {"friction_feedforward.level": level, "friction_feedforward.smoothing": within}
    t = np.linspace(0.0, 1.0, 201)
    wave = Trajectory(t, {"reference": 0.1 * np.sin(2 * np.pi * t)})
    given = loop.parameters.with_values({**gains, **own})
    shared = given.select(n for n in given if n in plain.parameters)
    found, expected = (simulate(one, wave, p, rtol=1e-9) for one, p in ((loop, given), (plain, shared)))
    np.testing.assert_allclose(found["speed"], expected["speed"], atol=1e-7)
    bare = simulate(loop, wave, given.with_values({"friction_feedforward.level": 0.0}), rtol=1e-9)
    assert np.abs(bare["speed"] - expected["speed"]).max() > 0.02


def test_referred_feedforward_pushes_as_the_reference_goes(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(limits=False), compensators=(FrictionFeedforward(),))
    own = {"pid.Kp": 0.0, "friction_feedforward.level": 0.7, "friction_feedforward.smoothing": 0.01}
    p = loop.parameter_vector(loop.parameters.with_values(own))
    sent = [float(loop.system().ode(0.0, np.zeros(4), [r], p)[1][-1]) for r in (0.3, 0.0, -0.3, 0.01)]
    np.testing.assert_allclose(sent, [0.7, 0.0, -0.7, 0.7 * np.tanh(1.0)], atol=1e-12)


def test_a_loop_without_integral_rests_where_compensator_and_gain_balance(second_order: System) -> None:
    """Of the plant with the gain G at rest: ``y = G (v + width tanh(v/smoothing))`` with ``v = Kp (r - y)``."""
    loop = ClosedLoop(second_order, PID(limits=False), compensators=(DeadZoneInverse(),))
    values = {"pid.Kp": 0.2, "dead_zone_inverse.width": 0.01, "dead_zone_inverse.smoothing": 0.02}
    p = loop.parameters.with_values(values)
    x = loop.initial(p, reference=0.1)
    v = 0.2 * (0.1 - x[0])
    assert x[0] == pytest.approx(1270.12 / 86.34 * (v + 0.01 * np.tanh(v / 0.02)), rel=1e-9)
    assert x[2] == pytest.approx(0.0, abs=1e-12)


def test_the_inverse_gives_back_what_a_dead_zone_takes() -> None:
    """On a rig whose actuator has a dead zone of 6 N the axis moves as one without it, beyond the smoothing."""
    drive, h = ForceDrive(Viscous()).system(), 2e-3
    plain, undone = (ClosedLoop(drive, PID(h), compensators=c) for c in ((), (DeadZoneInverse(),)))
    values = {"pid.Kp": 60.0, "pid.Ki": 400.0, "dead_zone_inverse.width": 6.0, "dead_zone_inverse.smoothing": 1e-3}
    p = undone.parameters.with_values(values)
    t = np.arange(500) * h
    wave = Trajectory(t, {"reference": 0.2 * np.sin(2 * np.pi * t)})

    def speed(loop: ClosedLoop, zone: float) -> np.ndarray:
        given = p.select(n for n in p if n in loop.parameters)
        return record(Rig(loop, {"speed": Sensor()}, Actuator(dead_zone=zone)), wave, given).truth["speed"]

    expected = speed(plain, 0.0)
    assert np.abs(speed(undone, 6.0) - expected).max() < 2e-4
    assert np.abs(speed(plain, 6.0) - expected).max() > 0.02


IMPULSIVE_CONTROL_H, COUNT = 1e-3, 1e-5  # [s, m]
GIVEN = {"amplitude": 2.0, "limit": 2.5, "width": 8e-3, "pause": 3e-3, "tolerance": 1e-4, "growth": 1.1, "brake": 0.6}


def pulses_by_hand(errors: Array, speeds: Array) -> tuple[Array, set[str]]:
    """What is added at each sample, from the errors and the reference's speeds, and what has happened."""
    added, seen = np.zeros(len(errors)), set()
    stood = standing = peak = before = ceiling = 0.0
    pulse: list[float] = []
    for k, (e, v) in enumerate(zip(errors.tolist(), speeds.tolist(), strict=True)):
        if v:
            seen |= {"cut"} if pulse else set()
            peak, ceiling, pulse = 0.0, 0.0, []
        still = not v and not pulse and abs(e - stood) < 0.2 * GIVEN["tolerance"]
        standing = standing + 1 if still else 0
        stood = stood if still else e
        if standing >= 3 and abs(e) > GIVEN["tolerance"]:
            way = (before - e) * np.sign(peak)
            ratio = 0.5 * abs(e) / max(way, 0.06 * GIVEN["tolerance"])
            factor = ratio ** (0.05 if ratio > 1 else 0.15)
            ceiling = 0.0 if peak * e < 0 else abs(peak) if ratio < 1 else ceiling
            most = min(1.1, max(1.02, np.sqrt(ceiling / abs(peak)))) if ceiling else 1.1
            seen |= {"first"} if not peak else {"grows"} if factor > 1.1 else {"more"} if ratio > 1 else {"less"}
            seen |= {"halves"} if 1.02 < most < min(1.1, factor) else {"creeps"} if 1.02 == most < factor else set()
            peak = float(np.sign(e)) * (abs(peak) * min(most, factor) if peak else 2.0)
            n = int(np.floor(8 * max(1.0, abs(peak) / 2.5) + 0.5))
            seen |= {"longer"} if n > 8 else set()
            wave = np.sin(2 * np.pi * (np.arange(n) + 0.5) / n)
            pulse = list(np.sign(peak) * min(abs(peak), 2.5) * np.where(wave > 0, wave, 0.6 * wave))
            before, standing = e, 0.0
        if pulse:
            added[k] = pulse.pop(0)
    return added, seen


@pytest.mark.parametrize("cascaded", [False, True])
def test_the_command_is_that_of_a_hand_recursion(cascaded: bool) -> None:
    """Of a part alone: the body is moved from outside, now and then, as a pulse might, and the reference, too."""
    plant, outer = ForceDrive(Viscous()).system(), PositionLoop() if cascaded else None
    pid, encoder = PID(IMPULSIVE_CONTROL_H, limits=False), Encoder(COUNT, 4e-3)
    parts = (ImpulsiveControl(),)
    loop = ClosedLoop(plant, pid, measured="position", sensor=encoder, compensators=parts, outer=outer)
    values = {f"impulsive_control.{n}": v for n, v in GIVEN.items()} | {"pid.Kp": 0.0, "pid.Ki": 0.0}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    rng, n = np.random.default_rng(3), 3000
    moves = np.where(rng.random(n) < 0.03, rng.choice([2e-6, 4e-5, 3e-4, -2e-4], n), 0.0)
    speeds = np.where((np.arange(n) % 700) < 5, 0.05 * (-1.0) ** (np.arange(n) // 700), 0.0)
    speeds[1203] = 0.02
    reference, path = 5e-4 + IMPULSIVE_CONTROL_H * np.cumsum(speeds), 4e-4 * np.sin(np.cumsum(moves) / 3e-4)
    errors = reference - COUNT * np.floor(path / COUNT + 0.5)
    expected, seen = pulses_by_hand(errors, speeds)
    x, order, found = np.zeros(len(loop.states)), names(loop.states), []
    for k, y in enumerate(path):
        x[order.index("position")] = y
        x = np.array(loop.update(k * IMPULSIVE_CONTROL_H, x, [reference[k], speeds[k]], p)).ravel()
        found.append(x[order.index("pid.command")])
    assert seen == {"first", "grows", "more", "less", "halves", "creeps", "longer", "cut"}
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def standing_error(*, pulses: bool) -> tuple[float, float]:
    """Of a PD loop on an axis that sticks: the error after three seconds, and the travel over the last of them [m]."""
    plant, part = ForceDrive(Karnopp(Stribeck())).system(), ImpulsiveControl()
    loop = ClosedLoop(plant, PID(IMPULSIVE_CONTROL_H), measured="position", sensor=Encoder(COUNT), compensators=(part,))
    values = {"friction.coulomb": 25.0, "friction.static": 40.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 60.0, "pid.Kp": 4000.0, "pid.Ki": 0.0, "pid.Kd": 150.0}
    own = {"amplitude": 10.0 if pulses else 0.0, "limit": 500.0, "width": 6e-3, "brake": 0.0, "tolerance": 5e-5}
    p = loop.parameters.with_values(values | {f"impulsive_control.{n}": v for n, v in own.items()})
    t = np.arange(0.0, 3.0, 0.01)
    moved = Trajectory(t, {"reference": np.full(len(t), 0.05), "reference_speed": np.zeros(len(t))})
    path = simulate_stick_slip(loop, moved, p).trajectory["position"]
    return abs(float(path[-1]) - 0.05), float(np.ptp(path[t >= 2.0]))


def test_a_body_that_sticks_is_brought_within_the_tolerance_and_stays() -> None:
    assert standing_error(pulses=False)[0] > 1e-3
    error, travel = standing_error(pulses=True)
    assert error < 6e-5
    assert travel == 0.0


def test_a_tolerance_within_a_count_is_refused() -> None:
    plant, part, cascade = ForceDrive(Viscous()).system(), ImpulsiveControl(), PositionLoop()
    loop = ClosedLoop(
        plant, PID(IMPULSIVE_CONTROL_H), measured="position", sensor=Encoder(COUNT), compensators=(part,), outer=cascade
    )
    p = loop.parameters.with_values({"impulsive_control.tolerance": COUNT})
    loop.check(p)
    with pytest.raises(InputError, match=r"impulsive_control\.tolerance"):
        loop.check(p.with_values({"impulsive_control.amplitude": 1.0}))


PARTS = (MotionFeedforward(), FrictionFeedforward())


def position_loop(*parts: object, sample_time: float | None = H) -> ClosedLoop:
    return ClosedLoop(
        ForceDrive(Stribeck()).system(),
        PID(sample_time, limits=False),
        measured="position",
        compensators=parts,  # type: ignore[arg-type]
    )


def test_a_loop_has_the_rates_that_its_parts_use() -> None:
    found = {len(p): [(q.name, q.unit) for q in position_loop(*p).inputs] for p in ((), PARTS[1:], PARTS)}
    assert found[0] == [("reference", "m")]
    assert found[1] == [("reference", "m"), ("reference_speed", "m/s")]
    assert found[2] == [*found[1], ("reference_acceleration", "m/s^2")]
    loop = position_loop(*PARTS)
    units = {n: loop.parameters[f"motion_feedforward.{n}"].unit for n in ("speed", "acceleration")}
    assert units == {"speed": "N*s/m", "acceleration": "N*s^2/m"}
    assert loop.parameters["friction_feedforward.smoothing"].unit == "m/s"
    moving = ClosedLoop(loop.plant, PID(H), compensators=PARTS)
    assert names(moving.inputs) == ("reference", "reference_acceleration")


def test_motion_feedforward_the_command_is_that_of_a_hand_recursion() -> None:
    """PI of the position, ``speed v_r + acceleration a_r`` and ``level tanh(v_r/smoothing)``."""
    loop, rng = position_loop(*PARTS), np.random.default_rng(3)
    values = {"pid.Kp": 40.0, "pid.Ki": 90.0, "pid.Tf": 0.01, "pid.Kd": 2.0}
    values |= {"motion_feedforward.speed": 7.0, "motion_feedforward.acceleration": 1.5}
    values |= {"friction_feedforward.level": 6.0, "friction_feedforward.smoothing": 0.02}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    x, held = np.zeros(len(loop.states)), names(loop.states).index("pid.command")
    integral = derivative = before = 0.0
    for r, v, a, y in 0.1 * rng.normal(size=(200, 4)):
        x[0] = y
        x = np.array(loop.update(0.0, x, [r, v, a], p)).ravel()
        integral += 90.0 * H * (r - y)
        derivative = (0.01 * derivative + 2.0 * (r - y - before)) / (0.01 + H)
        before = r - y
        u = 40.0 * (r - y) + integral + derivative + 7.0 * v + 1.5 * a + 6.0 * np.tanh(v / 0.02)
        assert x[held] == pytest.approx(u, rel=1e-12, abs=1e-12)


def test_the_inverse_dynamics_follow_a_smooth_motion_without_an_error() -> None:
    """A mass with viscous friction, driven by its own inverse, needs no feedback."""
    drive = ForceDrive(Viscous()).system()
    loop = ClosedLoop(drive, PID(limits=False), measured="position", compensators=(MotionFeedforward(),))
    own = {
        "motion_feedforward.speed": drive.parameters.value("friction.viscous"),
        "motion_feedforward.acceleration": drive.parameters.value("load.mass"),
    }
    given = loop.parameters.with_values({"pid.Kp": 50.0, **own})
    t = np.linspace(0.0, 1.0, 1001)
    w = 2 * np.pi
    motion = {
        "reference": 0.05 * (1 - np.cos(w * t)),
        "reference_speed": 0.05 * w * np.sin(w * t),
        "reference_acceleration": 0.05 * w**2 * np.cos(w * t),
    }
    start = np.zeros(len(loop.states))
    late = np.abs(simulate(loop, Trajectory(t, motion), given, initial=start)["position"] - motion["reference"]).max()
    bare = given.with_values(dict.fromkeys(own, 0.0))
    plain = np.abs(simulate(loop, Trajectory(t, motion), bare, initial=start)["position"] - motion["reference"]).max()
    assert late < 3e-4  # the inputs are held from sample to sample
    assert plain > 0.05


def test_a_step_has_no_rates_and_adds_nothing() -> None:
    loop, plain = position_loop(*PARTS), position_loop()
    run = loop_inputs(loop, Step(0.1, horizon=0.4), H)
    assert not np.any([run["reference_speed"], run["reference_acceleration"]])
    values = {"pid.Kp": 300.0, "pid.Kd": 60.0}
    more = {"motion_feedforward.speed": 7.0, "friction_feedforward.level": 6.0}
    found, bare = (
        evaluate(one, Step(0.1, horizon=0.4), one.parameters.with_values(v))
        for one, v in ((loop, values | more), (plain, values))
    )
    assert found.loc["IAE"].iloc[0] == pytest.approx(bare.loc["IAE"].iloc[0], rel=1e-9)


def test_it_starts_in_a_rest_that_is_the_plain_loops() -> None:
    loop, plain = position_loop(*PARTS), position_loop()
    values = {"pid.Kp": 300.0, "pid.Ki": 20.0, "motion_feedforward.speed": 7.0, "friction_feedforward.level": 6.0}
    found = loop.initial(loop.parameters.with_values(values), reference=0.2)
    bare = plain.initial(
        plain.parameters.with_values({n: v for n, v in values.items() if n.startswith("pid.")}), reference=0.2
    )
    np.testing.assert_array_equal(found, bare)


control = pytest.importorskip("control")
STATE_FEEDBACK_H = 1e-3
GAINS = {"pid.Kp": 40.0, "pid.Ki": 30.0, "pid.Kd": 1.5, "pid.Tf": 4e-3}
PRESSURE = {"pressure_feedback.gain": 2e-6, "pressure_feedback.time": 0.08}
ACCELERATION = {"acceleration_feedback.gain": 0.02, "acceleration_feedback.filter": 6e-3}


def pneumatic_loop(
    *parts: Compensator,
    sample_time: float | None = STATE_FEEDBACK_H,
    delay: int = 0,
    sensor: Encoder | SensorLag | None = None,
) -> ClosedLoop:
    pid = PID(sample_time, limits=False, delay=delay)
    return ClosedLoop(catalog.t32()[0].system(), pid, measured="position", sensor=sensor, compensators=parts)


def given_values(loop: ClosedLoop, values: dict[str, float]) -> ParameterSet:
    known = catalog.t32()[1] | loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    return known.with_values({n: v for n, v in (GAINS | values).items() if n in known})


def steady_motion(speed: float) -> tuple[Array, dict[str, float]]:
    """The drive's state and command in steady motion at 0.1 m."""
    drive, hardware = catalog.t32()
    found = drive.rest(hardware, position=0.1, speed=speed)
    return np.array([found.states[q.name] for q in drive.states]), dict(found.inputs)


def commands(loop: ClosedLoop, p: ParameterSet, signals: Array) -> Array:
    """The commands of a sampled loop whose position and pressures are those of the rows."""
    x = loop.initial(p, reference=signals[0, 0])
    order, vector = names(loop.states), loop.parameter_vector(p)
    moved, held = [order.index(n) for n in ("position", "pressure_a", "pressure_b")], order.index("pid.command")
    x[order.index("pid.integral")] = x[order.index("pid.derivative")] = 0.0
    x[order.index("pid.previous_error")] = 0.0
    found = []
    for row in signals:
        x[moved] = row
        x = np.array(loop.update(0.0, x, np.full(len(loop.inputs), signals[0, 0]), vector)).ravel()
        found.append(x[held])
    return np.array(found)


def test_the_commands_are_those_of_hand_recursions() -> None:
    loop, rng = pneumatic_loop(PressureFeedback(), AccelerationFeedback()), np.random.default_rng(5)
    p = given_values(loop, PRESSURE | ACCELERATION)
    signals = np.array([0.1, 4e5, 5e5]) + np.cumsum(rng.normal(size=(300, 3)) * [1e-4, 2e3, 2e3], axis=0)
    signals[0] = loop.initial(p, reference=0.1)[[0, 2, 3]]
    r = before = signals[0, 0]
    expected, integral, derivative, error, speed = [], 0.0, 0.0, 0.0, 0.0
    slow, T, f = signals[0, 1] - signals[0, 2], 0.08, 6e-3
    for y, a, b in signals:
        e = r - y
        integral += 30.0 * STATE_FEEDBACK_H * e
        derivative = (4e-3 * derivative + 1.5 * (e - error)) / (4e-3 + STATE_FEEDBACK_H)
        error = e
        slow = (T * slow + STATE_FEEDBACK_H * (a - b)) / (T + STATE_FEEDBACK_H)
        rate = (y - before) / (f + STATE_FEEDBACK_H)
        before = (f * before + STATE_FEEDBACK_H * y) / (f + STATE_FEEDBACK_H)
        acceleration = (rate - speed) / (f + STATE_FEEDBACK_H)
        speed = (f * speed + STATE_FEEDBACK_H * rate) / (f + STATE_FEEDBACK_H)
        expected.append(40.0 * e + integral + derivative - 2e-6 * (a - b - slow) - 0.02 * acceleration)
    np.testing.assert_allclose(commands(loop, p, signals), expected, rtol=1e-12, atol=1e-12)


def sampled_by_hand(
    loop: ClosedLoop, p: ParameterSet, x: Array, u: dict[str, float], delay: int
) -> tuple[Array, Array, Array]:
    """Frequencies, the loop's response at them and the PID's, by python-control from the plant's matrices."""
    plant = loop.plant.linearise(x, u, p)
    every = control.sample_system(control.ss(plant.A, plant.B, plant.C, plant.D), STATE_FEEDBACK_H, "zoh")
    w = np.geomspace(0.05, 0.999 * np.pi / STATE_FEEDBACK_H, 20000)
    response, z = every(np.exp(1j * w * STATE_FEEDBACK_H)), np.exp(1j * w * STATE_FEEDBACK_H)
    y, a, b = (response[plant.outputs.index(n), 0] for n in ("position", "pressure_a", "pressure_b"))
    pid = 40.0 + 30.0 * STATE_FEEDBACK_H * z / (z - 1) + 1.5 * (z - 1) / ((4e-3 + STATE_FEEDBACK_H) * z - 4e-3)
    T, f = 0.08, 6e-3
    passed = 2e-6 * T * (z - 1) / ((T + STATE_FEEDBACK_H) * z - T)
    twice = 0.02 * ((z - 1) / ((f + STATE_FEEDBACK_H) * z - f)) ** 2
    more = (PressureFeedback() in loop.compensators) * passed * (a - b)
    more = more + (AccelerationFeedback() in loop.compensators) * twice * y
    return w, z**-delay * (pid * y + more), pid + (AccelerationFeedback() in loop.compensators) * twice


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(
    "parts", [(PressureFeedback(),), (AccelerationFeedback(),), (PressureFeedback(), AccelerationFeedback())]
)
def test_margins_are_those_of_the_exactly_sampled_loop(parts: tuple[Compensator, ...], delay: int) -> None:
    loop = pneumatic_loop(*parts, delay=delay)
    p = given_values(loop, PRESSURE | ACCELERATION)
    x, u = steady_motion(0.2)
    linear = open_loop(loop, p, x, u)
    w, L, C = sampled_by_hand(loop, p, x, u, delay)
    np.testing.assert_allclose(frequency_response(linear, w[::100]), L[::100], rtol=1e-6)
    found = margins(linear)
    assert found.stable
    assert found.max_sensitivity == pytest.approx(np.abs(1 / (1 + L)).max(), rel=1e-5)
    assert found.max_complementary_sensitivity == pytest.approx(np.abs(L / (1 + L)).max(), rel=1e-5)
    noise = noise_gain(linear, noise_path(loop, p, x, u), 0.3)
    counts = w >= 0.3
    assert noise == pytest.approx(np.abs(C / (1 + L))[counts].max(), rel=1e-4)
    read = batch_margin_function(loop, np.geomspace(0.01, 20 / STATE_FEEDBACK_H, 600), 0.3)
    inputs = np.array([[[u.get(n, 0.0) for n in names(loop.plant.inputs)]]])
    only = ["MaxSensitivity", "PhaseMargin", "GainMargin", "NoiseGain"]
    in_search = read(loop.parameter_vector(p)[None], x[None, None], inputs, only)
    assert in_search["MaxSensitivity"][0] == pytest.approx(found.max_sensitivity, rel=1e-3)
    assert in_search["PhaseMargin"][0] == pytest.approx(found.phase_margin, abs=0.1)
    assert in_search["GainMargin"][0] == pytest.approx(found.gain_margin, rel=2e-3)
    assert in_search["NoiseGain"][0] == pytest.approx(noise, rel=1e-3)


@pytest.mark.parametrize("sensor", [None, Encoder(1e-5), SensorLag(2e-3)])
def test_a_gain_of_zero_has_the_margins_of_the_plain_loop(sensor: Encoder | SensorLag | None) -> None:
    """The plain loop counts as its continuous equivalent, which is as good as exact well below the sampling rate."""
    plain, other = (pneumatic_loop(*parts, sensor=sensor) for parts in ((), (PressureFeedback(), DeadZoneInverse())))
    p = given_values(other, {})
    at = steady_motion(0.2)
    found, expected = (margins(open_loop(loop, given_values(loop, {}), *at)) for loop in (other, plain))
    assert found.max_sensitivity == pytest.approx(expected.max_sensitivity, rel=2e-3)
    assert found.phase_margin == pytest.approx(expected.phase_margin, abs=0.3)
    shaped = p.with_values({"dead_zone_inverse.width": 0.15, "dead_zone_inverse.smoothing": 0.3})
    v = brentq(lambda v: v + 0.15 * np.tanh(v / 0.3) - at[1]["valve_voltage"], 0.0, 1.0)
    slope = 1 + 0.15 / 0.3 * (1 - np.tanh(v / 0.3) ** 2)
    steeper = given_values(plain, {n: slope * v for n, v in GAINS.items() if n != "pid.Tf"})
    found, expected = margins(open_loop(other, shaped, *at)), margins(open_loop(plain, steeper, *at))
    assert slope > 1.1
    assert found.max_sensitivity == pytest.approx(expected.max_sensitivity, rel=2e-3)


def test_a_continuous_loop_has_the_poles_of_its_own_jacobian() -> None:
    loop = pneumatic_loop(PressureFeedback(), AccelerationFeedback(), sample_time=None)
    p = given_values(loop, PRESSURE | ACCELERATION)
    state = loop.initial(p, reference=0.1)
    order = names(loop.states)
    linear = open_loop(
        loop, p, state[: len(loop.plant.states)], {loop.command.name: state[order.index("pid.integral")]}
    )
    found = np.linalg.eigvals(linear.A - linear.B @ linear.C / (1 + linear.D[0, 0]))
    expected = np.linalg.eigvals(loop.system().linearise(state, {"reference": 0.1}, p).A)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-5, atol=1e-4)


def test_a_rigs_pressures_reach_the_controller_with_their_noise() -> None:
    loop = pneumatic_loop(PressureFeedback())
    p = given_values(loop, PRESSURE | {"pressure_feedback.gain": 1e-5})
    t = np.arange(60) * STATE_FEEDBACK_H
    still = Trajectory(t, {"reference": np.full(len(t), 0.1)})
    sensors = {"position": Sensor(), "pressure_a": Sensor(noise=1e3), "pressure_b": Sensor()}
    quiet, noisy = (
        record(Rig(loop, own), still, p, initial=loop.initial(p, reference=0.1)).experiment.trajectory
        for own in (dict.fromkeys(sensors, Sensor()), sensors)
    )
    assert np.ptp(quiet["valve_voltage"]) < 1e-4
    pressure = noisy["pressure_a"] - quiet["pressure_a"]
    np.testing.assert_allclose(np.std(noisy["valve_voltage"][1:]), 1e-5 * np.std(pressure), rtol=0.1)
    with pytest.raises(ModelError, match="reads pressure_b, which no sensor measures"):
        Rig(loop, {n: s for n, s in sensors.items() if n != "pressure_b"})
