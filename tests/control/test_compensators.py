"""Every registered compensator through the same mill; a new one is a row of the registry, and one of `ROWS`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest

from pneuopt.control.bumpless import bumpless_transfer
from pneuopt.control.compensation import Compensator, Instant
from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.friction_feedforward import Direction, FrictionFeedforward
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.pressure_feedback import PRESSURES
from pneuopt.control.reference import Step
from pneuopt.control.sensor import SensedSignal
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.record import record
from pneuopt.evaluation.requirements import Overshoot, SettlingTime
from pneuopt.evaluation.rig import Rig, Sensor
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.models import catalog
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.unit_algebra import unit_ratio
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
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
        with pytest.raises(InputError, match=rf"{section}\.{name} must lie within"):
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
    moved, added = kind.act(Instant(ca.SX(0.0), r, y, v, H, rates, read), x, p)
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
    assert section in loop.tunable_sections
