"""A PID: its law, its forms, anti-windup, dead band and starts, and that search, certificate and files run the same."""

from collections.abc import Callable
from math import inf
from pathlib import Path

import casadi as ca
import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.control.controller import PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop, bumpless_transfer
from pneuopt.control.pid import (
    PID,
    AntiWindup,
    Form,
    ParallelForm,
    SeriesForm,
    StandardForm,
    proportional_band,
    proportional_gain,
    to_parallel,
    to_series,
    to_standard,
)
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate_stick_slip
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import batch_margin_function, frequency_response, sensitivity_terms
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, Stribeck, Viscous
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.gradients import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import is_linear

MEASURED, COMMAND = Quantity("speed", "m/s"), Quantity("valve_voltage", "V")
GAINS = {"Kp": 2.0, "Ki": 9.0, "Kd": 0.05, "Tf": 0.004, "b": 0.7, "c": 0.4, "Tt": 0.06, "lower": -1.0, "upper": 1.5}


@pytest.mark.parametrize("sample_time", [0.0, -1e-3, inf])
def test_sample_time_must_be_positive(sample_time: float) -> None:
    with pytest.raises(InputError, match="sample_time"):
        PID(sample_time=sample_time)


def test_without_limits_there_is_nothing_to_saturate() -> None:
    assert tuple(PID(limits=False).parameters("m", "N")) == ("Kp", "Ki", "Kd", "Tf", "b", "c")


def run_sampled(r: np.ndarray, y: np.ndarray, h: float) -> np.ndarray:
    """The law of `PID`'s docstring in plain Python, for comparison."""
    g = GAINS
    integral = derivative = previous = 0.0
    sent = []
    for rk, yk in zip(r, y, strict=True):
        error = g["c"] * rk - yk
        derivative = g["Tf"] / (g["Tf"] + h) * derivative + g["Kd"] / (g["Tf"] + h) * (error - previous)
        previous = error
        integral += g["Ki"] * h * (rk - yk)
        w = g["Kp"] * (g["b"] * rk - yk) + integral + derivative
        u = min(max(w, g["lower"]), g["upper"])
        integral += h / g["Tt"] * (u - w)
        sent.append(u)
    return np.array(sent)


def sampled_function(pid: PID) -> ca.Function:
    x = {q.name: ca.SX.sym(q.name) for q in pid.states(MEASURED, COMMAND)}
    p = {n: ca.SX.sym(n) for n in GAINS}
    r, y, d = ca.SX.sym("r"), ca.SX.sym("y"), ca.SX.sym("d")
    after = pid.update(x, r, y, d, p)
    assert list(after) == list(x)
    return ca.Function(
        "pid", [ca.vertcat(*x.values()), r, y, d, ca.vertcat(*p.values())], [ca.vertcat(*after.values())]
    )


def test_sampled_law_is_the_documented_difference_equation() -> None:
    h, rng = 2e-3, np.random.default_rng(3)
    r, y = np.repeat(rng.normal(size=20), 25), np.cumsum(rng.normal(size=500)) * 0.05
    law = sampled_function(PID(sample_time=h))
    x, sent = np.zeros(6), []
    for rk, yk in zip(r, y, strict=True):
        x = np.array(law(x, rk, yk, 0.0, list(GAINS.values()))).ravel()
        sent.append(x[3])
    expected = run_sampled(r, y, h)
    assert expected.max() == GAINS["upper"]
    assert expected.min() == GAINS["lower"]
    np.testing.assert_allclose(sent, expected, atol=1e-12)


def test_anti_windup_sees_command_plus_dither() -> None:
    pid = PID(sample_time=1e-3)
    law = sampled_function(pid)
    p = list({**GAINS, "Kp": 0.0, "Ki": 1e-9, "Kd": 0.0}.values())
    free = np.array(law([1.0, *[0] * 5], 0.0, 0.0, 0.4, p)).ravel()
    stopped = np.array(law([1.0, *[0] * 5], 0.0, 0.0, 0.8, p)).ravel()
    assert free[[0, 3]] == pytest.approx([1.0, 1.4])
    assert stopped[[0, 3]] == pytest.approx([1.0 - 1e-3 / 0.06 * 0.3, 1.5])


def test_derivatives_agree_with_finite_differences() -> None:
    pid, p = PID(), {n: ca.SX.sym(n) for n in GAINS}
    x = {q.name: ca.SX.sym(q.name) for q in pid.states(MEASURED, COMMAND)}
    r, y, d = ca.SX.sym("r"), ca.SX.sym("y"), ca.SX.sym("d")
    rates, u = pid.rates(x, r, y, d, p)
    z = ca.vertcat(*x.values(), r, y, d, *p.values())
    f = ca.Function("f", [z], [ca.vertcat(*rates.values(), u)])
    jacobian = ca.Function("J", [z], [ca.jacobian(f(z), z)])
    for level in (0.2, 5.0):
        point = np.array([0.1, 0.02, level, 0.05, 0.03, *GAINS.values()])
        step = 1e-6
        columns = [(np.array(f(point + e)) - np.array(f(point - e))).ravel() / 2e-6 for e in step * np.eye(len(point))]
        np.testing.assert_allclose(np.array(jacobian(point)), np.column_stack(columns), rtol=1e-5, atol=1e-6)


H = 2e-3
ANTI_WINDUP_GAINS = {"pid.Kp": 2.0, "pid.Ki": 40.0, "pid.lower": -1.2, "pid.upper": 1.2}
STEP = Step(1.0, horizon=0.6)


def clamped() -> ClosedLoop:
    return ClosedLoop(FirstOrder().system(), PID(H, anti_windup=AntiWindup.CLAMPING))


@pytest.mark.parametrize(
    ("speed", "integral", "expected"),
    [
        (0.8, 0.1, 0.1 + 40 * H * 0.2),  # within the limits it integrates
        (0.0, 0.9, 0.9),  # at the upper limit, and the error drives it on: it stays
        (1.3, 3.0, 3.0 - 40 * H * 0.3),  # at the upper limit, and the error takes it back
        (3.0, -0.5, -0.5),  # at the lower limit
        (0.7, 0.59, 0.6),  # a step that crosses the upper limit: it goes as far as the limit lets it, 0.6 + 0.6 = 1.2
        (1.3, -0.59, -0.6),  # one that crosses the lower limit
    ],
)
def test_the_integral_stays_where_the_error_drives_it_beyond_a_limit(
    speed: float, integral: float, expected: float
) -> None:
    loop = clamped()
    order = names(loop.states)
    x = np.zeros(len(order))
    x[0], x[order.index("pid.integral")] = speed, integral
    after = (
        loop.update(0.0, x, [1.0], loop.parameter_vector(loop.parameters.with_values(ANTI_WINDUP_GAINS))).full().ravel()
    )
    assert after[order.index("pid.integral")] == pytest.approx(expected)


def test_a_saturated_step_overshoots_less_than_with_a_slow_back_calculation() -> None:
    back = ClosedLoop(FirstOrder().system(), PID(H))
    slow = evaluate(back, STEP, back.parameters.with_values({**ANTI_WINDUP_GAINS, "pid.Tt": 1e6}))
    clamp = evaluate(clamped(), STEP, clamped().parameters.with_values(ANTI_WINDUP_GAINS))
    was, now = (frame[STEP.label]["Overshoot"] for frame in (slow, clamp))
    assert now < 0.5 * was


def saturated_loop() -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, anti_windup=AntiWindup.CLAMPING))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0)}
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.lower": -46.0, "pid.upper": 46.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


def test_search_and_certificate_agree_while_the_command_is_clipped() -> None:
    loop, given = saturated_loop()
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 4000.0]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    assert certified["PeakControl"] == pytest.approx(46.0)
    for name in ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_gradients_are_those_of_finite_differences(
    check_slopes: Callable[[LinearisedProblem, np.ndarray], None],
) -> None:
    loop, given = saturated_loop()
    simulator = Simulator(loop, [Step(0.2, horizon=0.3)], search_space(loop, given))
    spec = specify(SettlingTime(), [Overshoot(0.1)])
    check_slopes(
        LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0), np.array([0.4, 0.5, 0.2037])
    )


def test_it_has_no_unwinding_time() -> None:
    assert "pid.Tt" not in clamped().parameters
    assert "pid.upper" in clamped().parameters


FILE = """
[pid]
sample_time = "2 ms"
Kp = "2 V*s/m"
Ki = "40 V/m"
limits = ["-1.2 V", "1.2 V"]
anti_windup = "clamping"
[[reference]]
step = "1 m/s"
horizon = "0.6 s"
"""


def test_a_file_names_it(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    path.write_text(FILE, "utf-8")
    found = read_tuning(path, FirstOrder().system())
    assert found.loop.pid == PID(H, anti_windup=AntiWindup.CLAMPING)
    path.write_text(FILE.replace('anti_windup = "clamping"', 'anti_windup = "clamping"\nTt = "1 s"'), "utf-8")
    with pytest.raises(InputError, match="Tt is back-calculation's; clamping has none"):
        read_tuning(path, FirstOrder().system())
    path.write_text(FILE.replace('"clamping"', '"clampin"'), "utf-8")
    with pytest.raises(InputError, match="did you mean"):
        read_tuning(path, FirstOrder().system())


@pytest.mark.parametrize("error", [-0.5, -0.1, -0.04, 0.0, 0.07, 0.3])
def test_nothing_is_integrated_within_it(second_order: System, error: float) -> None:
    """Continuous and sampled; beyond the band what exceeds it counts."""
    beyond = np.sign(error) * max(abs(error) - 0.1, 0.0)
    values = {"pid.Ki": 3.0, "pid.Kp": 0.0, "pid.dead_band": 0.1}
    loop = ClosedLoop(second_order, PID(dead_band=True))
    x = np.array([-error, 0.0, 0.0, 0.0])
    rates = loop.system().ode(0.0, x, [0.0], loop.parameter_vector(loop.parameters.with_values(values)))[0]
    assert float(rates[2]) == pytest.approx(3.0 * beyond)
    loop = ClosedLoop(second_order, PID(2e-3, dead_band=True))
    p = loop.parameter_vector(loop.parameters.with_values(values))
    after = np.array(loop.update(0.0, [-error, *[0] * 7], [0.0], p)).ravel()
    assert after[2] == pytest.approx(2e-3 * 3.0 * beyond)


def test_a_clipped_command_unwinds_the_integral_within_it(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(1e-3, dead_band=True), Dither(60.0))
    values = {"pid.dead_band": 0.1, "pid.Ki": 3.0, "pid.Kp": 0.0, "pid.upper": 1.0, "pid.lower": -1.0, "pid.Tt": 0.1}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    after = np.array(loop.update(0.0, [0.05, 0, 2.0, *[0] * 5], [0.0], p)).ravel()
    assert after[2] == pytest.approx(2.0 + 1e-3 / 0.1 * (1.0 - 2.0))


def hunting(dead_band: float) -> tuple[float, float]:
    """A position loop on a stick-slip axis: travel, peak to peak, from 1.6 to 2.4 s, and the largest error then."""
    pid = PID(2e-3, dead_band=True)
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), pid, measured="position")
    values = {"friction.coulomb": 25.0, "friction.static": 40.0, "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": 60.0, "pid.Kp": 4000.0, "pid.Ki": 80000.0, "pid.Kd": 150.0}
    parameters = loop.parameters.with_values({**values, "pid.dead_band": dead_band})
    t = np.arange(0.0, 2.4, 0.05)
    run = simulate_stick_slip(loop, Trajectory(t, {"reference": np.full(len(t), 0.05)}), parameters).trajectory
    late = run["position"][run.t >= 1.6 - 1e-9]
    return float(np.ptp(late)), float(np.abs(late - 0.05).max())


def test_it_ends_the_hunting_of_an_axis_that_sticks() -> None:
    travel, _ = hunting(0.0)
    rested, off = hunting(2e-3)
    assert travel > 4e-3
    assert rested == 0.0
    assert off <= 2e-3 + 1e-12


def friction_loop(sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time, dead_band=True))
    bounds = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 6000.0), "pid.dead_band": (0.0, 5e-3)}
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "pid.dead_band": 2e-3, "pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_dead_band_gradients_are_those_of_finite_differences(
    sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    """It bends, but does not jump: derivatives hold on either side, the band's own too."""
    loop, given = friction_loop(sample_time)
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, given))
    posed = LinearisedProblem(
        simulator, sensitivity_rollout(simulator), specify(SettlingTime(), [Overshoot(0.1)]), 60, 1.0
    )
    z = np.array([0.4, 0.5, 0.4, 0.2037])
    (point,) = posed.evaluate(z[None])
    assert np.abs(point.slopes[:, 2]).max() > 0
    check_slopes(posed, z)


@pytest.mark.parametrize("sample_time", [None, 2e-3])
def test_search_and_certificate_agree(sample_time: float | None) -> None:
    loop, given = friction_loop(sample_time)
    step = Step(0.2, horizon=0.6)
    simulator = Simulator(loop, [step], search_space(loop, given))
    (claimed,) = simulator.table(np.array([200.0, 4000.0, 2e-3]), specify(SettlingTime()))
    certified = evaluate(loop, step, given)[step.label]
    assert np.isfinite(certified["SettlingTime"])
    for name in ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl"):
        assert claimed[name] == pytest.approx(certified[name], rel=2e-3, abs=2e-4), name


def test_a_loop_with_it_is_not_linear() -> None:
    plain, banded = (ClosedLoop(SecondOrder().system(), PID(dead_band=band)) for band in (False, True))
    assert is_linear(plain)
    assert not is_linear(banded)


def test_a_negative_one_is_refused(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(dead_band=True))
    assert loop.parameters["pid.dead_band"].unit == "m/s"
    foreign = loop.parameters | ParameterSet({"pid.dead_band": Parameter(-0.1, "m/s")})
    with pytest.raises(InputError, match=r"pid\.dead_band"):
        loop.check(foreign)


EMPTYING_INTEGRAL_H, Tt = 5e-3, 0.2
FORCE = ForceDrive(friction=Viscous()).system()
SERVO = {"pid.Kp": 2000.0, "pid.Kd": 100.0, "pid.Tt": Tt, "pid.lower": -200.0, "pid.upper": 200.0}
WINDUPS = pytest.mark.parametrize("windup", [None, *AntiWindup])
RESTS = {"no integral": 0.0, "slow": 250.0, "usual": 4000.0}  # Ki


def servo(
    windup: AntiWindup | None = AntiWindup.BACK_CALCULATION,
    h: float | None = EMPTYING_INTEGRAL_H,
    form: Form = Form.PARALLEL,
) -> ClosedLoop:
    kind = windup or AntiWindup.BACK_CALCULATION
    return ClosedLoop(FORCE, PID(h, windup is not None, form, anti_windup=kind), measured="position")


def settings(loop: ClosedLoop, **values: float) -> ParameterSet:
    own = SERVO | {f"pid.{n}": v for n, v in values.items()}
    return loop.parameters.with_values({n: v for n, v in own.items() if n in loop.parameters})


def follow(
    loop: ClosedLoop, p: ParameterSet, x: Array, reference: float, duration: float
) -> tuple[Array, Array, Array]:
    """The first states after a sample, the last ones, and the outputs, under a constant reference."""
    v, step, control, first = loop.parameter_vector(p), loop.discrete(4).step, [], None
    u = [reference] + [0.0] * (len(loop.inputs) - 1)
    for k in range(round(duration / EMPTYING_INTEGRAL_H)):
        x = loop.update(k * EMPTYING_INTEGRAL_H, x, u, v).full().ravel()
        first = x if first is None else first
        control.append(x[names(loop.states).index("pid.command")])
        x = step(k * EMPTYING_INTEGRAL_H, EMPTYING_INTEGRAL_H, x, u, v)[0].full().ravel()
    assert first is not None
    return first, x, np.array(control)


def emptying_time(windup: AntiWindup | None) -> float:
    """Tt, or where there is none its default [s]."""
    return Tt if windup is AntiWindup.BACK_CALCULATION else 0.1


def state(loop: ClosedLoop, x: Array, name: str) -> float:
    return float(x[names(loop.states).index(name)])


@WINDUPS
@pytest.mark.parametrize("rest", RESTS)
def test_a_start_away_from_the_set_point_does_not_jump_and_arrives(windup: AntiWindup | None, rest: str) -> None:
    loop = servo(windup)
    p = settings(loop, Ki=RESTS[rest])
    x = loop.initial(p, [0.0, 0.0], reference=0.05)
    first, last, control = follow(loop, p, x, 0.05, 5.0)
    assert abs(control[0]) <= RESTS[rest] * EMPTYING_INTEGRAL_H * 0.05 * (1 + 1e-9)
    assert np.max(np.abs(np.diff(control))) < 8.0  # of 100 N, which a step would have taken at once
    assert state(loop, last, "position") == pytest.approx(0.05, abs=2e-3 if rest == "slow" else 1e-4)
    kept = (
        RESTS[rest] * EMPTYING_INTEGRAL_H * 0.05
        if RESTS[rest]
        else -100.0 / (1 + EMPTYING_INTEGRAL_H / emptying_time(windup))
    )
    assert state(loop, first, "pid.integral") == pytest.approx(kept)


@WINDUPS
def test_without_an_integral_a_hands_output_passes_with_Tt(windup: AntiWindup | None) -> None:
    loop = servo(windup)
    p, time = settings(loop, Ki=0.0), emptying_time(windup)
    x = loop.initial(p, [0.0, 0.0], command=20.0)
    v = loop.parameter_vector(p)
    for k in range(1, 30):
        x = loop.update(0.0, x, [0.0], v).full().ravel()
        assert state(loop, x, "pid.integral") == pytest.approx(20.0 * (1 + EMPTYING_INTEGRAL_H / time) ** -k)
        assert state(loop, x, "pid.command") == pytest.approx(20.0 * (1 + EMPTYING_INTEGRAL_H / time) ** (1 - k))


@pytest.mark.parametrize("form", Form)
@pytest.mark.parametrize("Ti", [inf, 1.0e30, 3.4e38])
def test_an_infinite_time_is_no_integral_in_every_form(form: Form, Ti: float) -> None:
    loop = servo(form=form)
    given = (
        {"Ki": 0.0} if form is Form.PARALLEL else {"Ti": Ti, "K" if form is Form.SERIES else "Kp": 2000.0, "Td": 0.05}
    )
    p = settings(loop, **given)
    _, x, control = follow(loop, p, loop.initial(p, [0.0, 0.0], command=150.0), 0.5, 3.0)
    assert control.max() == 200.0
    assert state(loop, x, "position") == pytest.approx(0.5, abs=1e-4)
    assert abs(state(loop, x, "pid.integral")) < 1e-3


@pytest.mark.parametrize("windup", AntiWindup)
@pytest.mark.parametrize("slow", [Tt, 1e9, inf])
def test_out_of_saturation_nothing_is_left(windup: AntiWindup, slow: float) -> None:
    """Whatever Tt: a back-calculation that is switched off is one that takes nothing, and keeps nothing."""
    loop = servo(windup)
    p = settings(loop, Ki=0.0, Tt=slow)
    _, x, control = follow(loop, p, loop.initial(p), 0.2, 5.0)
    assert (control == 200.0).sum() > 3
    assert state(loop, x, "position") == pytest.approx(0.2, abs=1e-6)
    _, x, _ = follow(loop, p, loop.initial(p, [0.0, 0.0], reference=0.2, command=20.0), 0.2, 8.0)
    assert state(loop, x, "position") == pytest.approx(0.2, abs=1e-4)


def test_the_cascade_arrives() -> None:
    loop = ClosedLoop(
        PneumaticDrive(friction=Viscous()).system(), PID(EMPTYING_INTEGRAL_H), measured="position", outer=PositionLoop()
    )
    values = {"pid.Kp": 2.0, "pid.lower": -1.0, "pid.upper": 1.0, "position_loop.Kp": 4.0}
    p = loop.parameters.with_values({**values, "friction.viscous": 200.0, "cylinder.stroke": 0.6})
    ends = []
    for command, reference in ((0.0, 0.05), (0.5, 0.05), (0.0, 0.2)):
        rest = loop.initial(p)[: len(loop.plant.states)]
        x = loop.initial(p, rest, reference=reference if reference < 0.2 else 0.0, command=command)
        ends.append(state(loop, follow(loop, p, x, reference, 6.0)[1], "position") - reference)
    assert max(ends) - min(ends) < 2e-4  # a proportional loop's own rest, 1.7 mm off
    assert max(np.abs(ends)) < 2e-3


@pytest.mark.parametrize("h", [EMPTYING_INTEGRAL_H, None])
def test_the_gain_counts_where_it_is_zero(h: float | None) -> None:
    """The derivative by Ki is that of an integral, so that a search can leave zero."""
    loop = servo(h=h)
    p = ca.SX.sym("p", len(loop.parameters))
    x = np.zeros(len(loop.states))
    after = loop.system().ode(0, x, [0.03], p)[0] if h is None else loop.update(0, x, [0.03], p)
    slope = ca.Function("slope", [p], [ca.jacobian(after, p)])(loop.parameter_vector(settings(loop, Ki=0.0)))
    row, column = names(loop.states).index("pid.integral"), list(loop.parameters).index("pid.Ki")
    assert float(slope[row, column]) == pytest.approx(0.03 * (h or 1.0))


@pytest.mark.parametrize("limits", [True, False])
def test_a_continuous_integral_empties_too(limits: bool) -> None:
    loop = ClosedLoop(FORCE, PID(None, limits), measured="position")
    p = settings(loop, Ki=0.0)
    x = loop.initial(p, [0.0, 0.0], command=20.0)
    rates = loop.system().ode(0, x, [0.5], loop.parameter_vector(p))[0].full().ravel()
    assert state(loop, rates, "pid.integral") == pytest.approx(-20.0 / (Tt if limits else 0.1))


def test_at_rest_on_the_set_point_nothing_is_transferred() -> None:
    loop = servo()
    p = settings(loop, Ki=4000.0, b=0.3)
    x = loop.initial(p, [0.07, 0.0], reference=0.07, command=11.0)
    assert state(loop, x, "pid.transfer") == 0.0
    assert state(loop, x, "pid.integral") == 11.0 - 2000.0 * (0.3 * 0.07 - 0.07)
    _, last, control = follow(loop, p, loop.initial(p, reference=0.07), 0.07, 1.0)
    assert np.max(np.abs(control)) < 1e-9
    assert state(loop, last, "position") == pytest.approx(0.07, abs=1e-12)


@pytest.mark.parametrize("Ki", [0.0, 250.0])
def test_new_gains_on_the_way_neither_jump_nor_keep_the_axis(Ki: float) -> None:
    """In the middle of a move, to half the gain: what the distance was worth passes."""
    loop = servo(None)
    old, new = settings(loop, Ki=4000.0), settings(loop, Ki=Ki, Kp=1000.0)
    _, x, control = follow(loop, old, loop.initial(old), 0.1, 0.035)
    assert (2000.0 - 1000.0) * (0.1 - state(loop, x, "position")) / 1000.0 > 0.03  # what the distance is worth [m]
    moved = bumpless_transfer(loop, x, old, new, reference=0.1)
    before = state(loop, loop.update(0.0, x, [0.1], loop.parameter_vector(old)).full().ravel(), "pid.command")
    after = state(loop, loop.update(0.0, moved, [0.1], loop.parameter_vector(new)).full().ravel(), "pid.command")
    assert after == pytest.approx(before, abs=1e-9)
    assert abs(control[-1]) > 1.0
    _, x, _ = follow(loop, new, moved, 0.1, 4.0)
    never = follow(loop, new, loop.initial(new), 0.1, 4.0)[1]
    assert state(loop, x, "position") == pytest.approx(state(loop, never, "position"), abs=6e-3)


def test_a_gain_that_becomes_zero_leaves_nothing() -> None:
    loop = servo()
    old, new = settings(loop, Ki=4000.0), settings(loop, Ki=0.0)
    _, x, _ = follow(loop, old, loop.initial(old), 0.1, 0.2)
    assert abs(state(loop, x, "pid.integral")) > 1.0
    _, x, _ = follow(loop, new, x, 0.1, 4.0)
    assert state(loop, x, "position") == pytest.approx(0.1, abs=1e-6)


Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
SAME = {
    Form.STANDARD: {"Kp": 0.24, "Ti": 0.2, "Td": 0.04, "N": 4.0},
    Form.SERIES: {"K": 0.2, "Ti": 0.15, "Td": 0.05, "Tf": 0.01},
}


@given(
    Kp=st.floats(0.01, 100),
    Ki=st.floats(0.01, 1000),
    Kd=st.floats(1e-4, 10),
    Tf=st.floats(1e-5, 1.0),
)
def test_parallel_to_standard_and_back(Kp: float, Ki: float, Kd: float, Tf: float) -> None:
    back = to_parallel(to_standard(ParallelForm(Kp, Ki, Kd, Tf)))
    np.testing.assert_allclose([back.Kp, back.Ki, back.Kd, back.Tf], [Kp, Ki, Kd, Tf], rtol=1e-12)


@given(K=st.floats(0.01, 100), Ti=st.floats(1e-2, 10), Td=st.floats(0.0, 0.45), Tf=st.floats(0.0, 1.0))
def test_series_to_parallel_and_back(K: float, Ti: float, Td: float, Tf: float) -> None:
    """Two series forms have the same sum where Td + Tf < Ti; the one with the smaller Td is given."""
    own, filtering = Ti * Td, Ti * Td * Tf
    back = to_series(to_parallel(SeriesForm(K, Ti, own, filtering)))
    np.testing.assert_allclose([back.K, back.Ti, back.Td, back.Tf], [K, Ti, own, filtering], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("parallel", "standard", "series"),
    [
        (ParallelForm(2.0), StandardForm(2.0, inf, 0.0, inf), SeriesForm(2.0)),
        (ParallelForm(2.0, 4.0), StandardForm(2.0, 0.5, 0.0, inf), SeriesForm(2.0, 0.5)),
        (ParallelForm(2.0, 0.0, 0.5), StandardForm(2.0, inf, 0.25, inf), SeriesForm(2.0, inf, 0.25)),
        (ParallelForm(-2.0, -4.0), StandardForm(-2.0, 0.5, 0.0, inf), SeriesForm(-2.0, 0.5)),
    ],
)
def test_missing_actions_convert_both_ways(parallel: ParallelForm, standard: StandardForm, series: SeriesForm) -> None:
    assert to_standard(parallel) == standard
    assert to_series(parallel) == series
    assert to_parallel(standard) == to_parallel(series) == parallel


def test_the_series_form_is_its_two_factors() -> None:
    """Against python-control's product, the derivative's filter included."""
    own, s = SeriesForm(2.0, 0.4, 0.1, 0.02), control.tf("s")
    same = to_parallel(own)
    product = own.K * (1 + 1 / (own.Ti * s)) * (1 + own.Td * s / (own.Tf * s + 1))
    summed = same.Kp + same.Ki / s + same.Kd * s / (same.Tf * s + 1)
    w = 1j * np.geomspace(0.01, 1e4, 50)
    np.testing.assert_allclose(summed(w), product(w), rtol=1e-12)


@given(Kp=st.floats(1e-3, 1e3), measured=st.floats(0.1, 10.0), command=st.floats(0.1, 20.0))
def test_the_proportional_band_drives_the_full_command(Kp: float, measured: float, command: float) -> None:
    band = proportional_band(Kp, measured, command)
    assert Kp * band / 100 * measured == pytest.approx(command)
    assert proportional_gain(band, measured, command) == pytest.approx(Kp)


def both(plant: System, form: Form, sample_time: float | None) -> list[tuple[ClosedLoop, ParameterSet]]:
    """The same controller by its own gains, and in the parallel form."""
    own = SAME[form]
    kind = StandardForm if form is Form.STANDARD else SeriesForm
    parallel = vars(to_parallel(kind(**own)))
    found = []
    for given_form, gains in ((form, own), (Form.PARALLEL, parallel)):
        loop = ClosedLoop(plant, PID(sample_time, form=given_form))
        values = {f"pid.{n}": v for n, v in gains.items()} | {"pid.b": 0.6, "pid.upper": 0.4, "pid.lower": -0.4}
        found.append((loop, loop.parameters.with_values(values)))
    return found


@pytest.mark.parametrize("sample_time", [None, 2e-3])
@pytest.mark.parametrize("form", SAME)
def test_whatever_its_form_the_same_law_runs(
    second_order: System, run: Run, form: Form, sample_time: float | None
) -> None:
    pairs = both(second_order, form, sample_time)
    runs = [run(loop, p, 0.5, 2e-3, 0.4) for loop, p in pairs]
    np.testing.assert_allclose(runs[0][2], runs[1][2], atol=1e-12)
    starts = [loop.initial(p, reference=0.3) for loop, p in pairs]
    np.testing.assert_allclose(starts[0], starts[1], atol=1e-12)
    w = np.geomspace(0.1, 400.0, 30)
    L = [frequency_response(open_loop(loop, p), w) for loop, p in pairs]
    np.testing.assert_allclose(L[0], L[1], rtol=1e-10)
    if sample_time is None:
        terms = [sensitivity_terms(loop, w, p)(loop.parameter_vector(p)).full() for loop, p in pairs]
        np.testing.assert_allclose(terms[0], terms[1], rtol=1e-10)
    only = ("MaxSensitivity", "NoiseGain")
    reads = [
        batch_margin_function(loop, w)(loop.parameter_vector(p)[None], np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), only)
        for loop, p in pairs
    ]
    for name in only:
        np.testing.assert_allclose(reads[0][name], reads[1][name], rtol=1e-9)
    tables = [evaluate(loop, Step(0.5, horizon=0.4), p) for loop, p in pairs]
    np.testing.assert_allclose(tables[0].to_numpy(), tables[1].to_numpy(), rtol=1e-5, atol=1e-7)


def test_a_standard_form_without_derivative_or_integral_runs(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID(form=Form.STANDARD))
    _, _, y = run(loop, loop.parameters.with_values({"pid.Kp": 0.2}), 1.0, 1e-3, 3.0)
    assert y[-1, 0] == pytest.approx(0.2 * 1270.12 / (86.34 + 0.2 * 1270.12), rel=1e-3)


def forms_friction_loop(form: Form, sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time, form=form))
    bounds = {
        Form.STANDARD: {"pid.Kp": (50.0, 600.0), "pid.Ti": (0.01, 0.3), "pid.Td": (1e-3, 5e-3), "pid.N": (2.0, 20.0)},
        Form.SERIES: {"pid.K": (50.0, 600.0), "pid.Ti": (0.01, 0.3), "pid.Td": (0.0, 5e-3), "pid.Tf": (2e-3, 2e-2)},
    }[form]
    values = {n: (low + up) / 2 for n, (low, up) in bounds.items()} | {"pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize(("form", "sample_time"), [(Form.STANDARD, None), (Form.SERIES, 2e-3)])
def test_forms_gradients_are_those_of_finite_differences(
    form: Form, sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    loop, freed = forms_friction_loop(form, sample_time)
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, freed))
    spec = specify(SettlingTime(), [Overshoot(0.1), MaxSensitivity(1.6)])
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0)
    z = np.array([0.4, 0.3, 0.5, 0.6, 0.2037])
    check_slopes(posed, z)


def test_it_is_tuned_in_its_own_gains() -> None:
    loop, freed = forms_friction_loop(Form.STANDARD, 2e-3)
    quick = Racing(members=8, trials=40, polish=16)
    best = tune(
        loop,
        Step(0.1, horizon=0.3),
        freed,
        minimise=SettlingTime(),
        subject_to=[Overshoot(0.1)],
        method=quick,
        plants={},
    )
    assert best.status.converged
    assert set(best.parameters.free_names) == {"pid.Kp", "pid.Ti", "pid.Td", "pid.N"}
    before = evaluate(loop, Step(0.1, horizon=0.3), freed)["0 to 0.1"]["SettlingTime"]
    assert not before <= best.certified["0 to 0.1"]["SettlingTime"]


def test_a_search_keeps_what_is_divided_by_above_zero(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(form=Form.STANDARD))
    for name in ("pid.Ti", "pid.Td", "pid.N"):
        freed = loop.parameters.with_values({name: 1.0}).with_bounds({name: (0.0, 20.0)}).freed(name)
        with pytest.raises(InputError, match=name):
            search_space(loop, freed)
