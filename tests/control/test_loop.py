"""A loop of plant and controller: its signals, its rest, its steps, its disturbances.

New gains take over without a bump: in simulation the command goes on where it is.
"""

from collections.abc import Callable

import casadi as ca
import control
import numpy as np
import pytest
from scipy.linalg import expm

from pneuopt.control.controller import Feedforward
from pneuopt.control.dither import Dither
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop, add_disturbances, bumpless_transfer
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, define, names
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.margins import frequency_response
from pneuopt.evaluation.requirements import Overshoot, PeakControl, Requirement, SettlingTime
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck, Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError, ModelError, UnknownNameError
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.method import Method
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.tune import tune
from pneuopt.tuning.two_phase import TwoPhase

Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
TUNED = {"pid.Kp": 0.225, "pid.Ki": 1.23, "pid.Kd": 0.01, "pid.Tf": 0.01}


def test_the_loop_lists_its_signals_with_units(axis: System) -> None:
    loop = ClosedLoop(axis, PID(sample_time=1e-3), Dither(), actuated="force")
    assert [q.name for q in loop.inputs] == ["reference", "pressure"]
    assert (loop.inputs[0].unit, loop.feedback.name, loop.outputs[-1].unit) == ("m/s", "speed", "N")
    assert loop.parameters["pid.Kp"].unit == "N*s/m"
    assert loop.parameters["dither.amplitude"].unit == "N"
    text = repr(loop)
    assert text.startswith("ClosedLoop")
    assert all(f"{q.name} [{q.unit}]" in text for q in (*loop.states, *loop.inputs, *loop.outputs))


def test_a_completed_set_keeps_what_is_given_and_fills_in_the_rest(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(limits=False))
    given = loop.parameters.with_values({"pid.Kp": 3.0})
    full = loop.complete(given.select(["pid.Kp"]))
    assert list(full) == list(loop.parameters)
    assert full == given
    assert loop.complete(full) == full


def test_a_continuous_loop_follows_python_control(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID())
    t, _, y = run(loop, loop.parameters.with_values(TUNED), 1.0, 1e-3, 0.6)
    plant = control.tf([1270.12], [1, 17.5, 86.34])
    controller = 0.225 + control.tf([1.23], [1, 0]) + control.tf([0.01, 0], [0.01, 1])
    expected = control.step_response(control.feedback(plant * controller, 1), t)
    np.testing.assert_allclose(y[:, 0], expected.outputs, atol=2e-8)


def test_set_point_weights_act_on_the_reference_alone(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID())
    t, _, y = run(loop, loop.parameters.with_values({**TUNED, "pid.b": 0.3, "pid.c": 0.0}), 1.0, 1e-3, 0.6)
    plant = control.tf([1270.12], [1, 17.5, 86.34])
    integral, derivative = control.tf([1.23], [1, 0]), control.tf([0.01, 0], [0.01, 1])
    expected = (0.225 * 0.3 + integral) * control.feedback(plant, 0.225 + integral + derivative)
    np.testing.assert_allclose(y[:, 0], control.step_response(expected, t).outputs, atol=2e-8)


def sampled_by_hand(
    p: dict[str, float], h: float, n: int, dither: Callable[[float], float], delay: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Eq. 16 by its exact zero-order-hold step, the controller as `PID` documents it."""
    A, B = np.array([[0.0, 1.0], [-86.34, -17.5]]), np.array([0.0, 1270.12])
    block = expm(h * np.vstack([np.column_stack([A, B]), np.zeros(3)]))
    x, integral, derivative, previous = np.zeros(2), 0.0, 0.0, 0.0
    speed, sent, queue = list[float](), list[float](), [0.0] * delay
    for k in range(n):
        e = 1.0 - x[0]
        derivative = (p["pid.Tf"] * derivative + p["pid.Kd"] * (e - previous)) / (p["pid.Tf"] + h)
        previous = e
        integral += p["pid.Ki"] * h * e
        w = p["pid.Kp"] * e + integral + derivative + dither(k * h)
        u = min(max(w, p["pid.lower"]), p["pid.upper"])
        integral += h / p["pid.Tt"] * (u - w)
        queue.append(u)
        u = queue.pop(0)
        speed.append(x[0])
        sent.append(u)
        x = block[:2, :2] @ x + block[:2, 2] * u
    return np.array(speed), np.array(sent)


@pytest.mark.parametrize("delay", [0, 1])
def test_a_sampled_loop_is_the_difference_equation_on_the_exact_plant(
    second_order: System, run: Run, delay: int
) -> None:
    h, loop = 2e-3, ClosedLoop(second_order, PID(sample_time=2e-3, delay=delay), Dither(60.0))
    values = {**TUNED, "pid.Kp": 0.9, "pid.Tt": 0.05, "pid.lower": -0.3, "pid.upper": 0.7}
    values |= {"dither.amplitude": 0.05, "dither.offset": -0.02}
    t, x, y = run(loop, loop.parameters.with_values(values), 1.0, h, 0.8)
    speed, sent = sampled_by_hand(values, h, len(t), lambda s: -0.02 + 0.05 * np.sin(2 * np.pi * 60.0 * s), delay)
    assert sent.max() == 0.7
    np.testing.assert_allclose(y[:, 0], speed, atol=1e-7)
    np.testing.assert_allclose(y[:, 1], sent, atol=1e-7)
    np.testing.assert_array_equal(x[:, [q.name for q in loop.states].index("pid.command")], y[:, 1])


def test_sampling_faster_approaches_the_continuous_loop(second_order: System, run: Run) -> None:
    continuous = ClosedLoop(second_order, PID())
    _, _, y = run(continuous, continuous.parameters.with_values(TUNED), 1.0, 1e-3, 0.4)
    errors = []
    for m in (1, 4):
        loop = ClosedLoop(second_order, PID(sample_time=1e-3 / m))
        _, _, sampled = run(loop, loop.parameters.with_values(TUNED), 1.0, 1e-3 / m, 0.4)
        errors.append(np.abs(sampled[::m, 0] - y[:, 0]).max())
    assert errors[0] < 0.02
    assert errors[1] == pytest.approx(errors[0] / 4, rel=0.1)


def test_analogue_dither_moves_between_samples(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(sample_time=1e-2), Dither(100.0, analogue=True))
    values = {"pid.upper": 0.5, "dither.amplitude": 0.3, "dither.offset": 0.4}
    p = loop.parameter_vector(loop.parameters.with_values(values))
    x = np.array(loop.update(0.0, loop.initial(loop.parameters), [0.0], p)).ravel()
    assert x[names(loop.states).index("pid.command")] == pytest.approx(0.4)
    sent = [float(loop.hold_system().ode(t, x, [0.0], p)[1][-1]) for t in (0.0, 0.0025, 0.0075)]
    assert sent == pytest.approx([0.4, 0.5, 0.1])


def test_anti_windup_spares_the_overshoot(second_order: System, run: Run) -> None:
    peaks = {}
    for Tt in (0.02, 1e6):
        loop = ClosedLoop(second_order, PID(sample_time=1e-3))
        values = {"pid.Kp": 0.2, "pid.Ki": 4.0, "pid.upper": 0.08, "pid.lower": -0.08, "pid.Tt": Tt}
        _, _, y = run(loop, loop.parameters.with_values(values), 1.0, 1e-3, 2.0)
        assert np.abs(y[:, -1]).max() == 0.08
        peaks[Tt] = y[:, 0].max()
    assert peaks[1e6] > 1.15
    assert peaks[0.02] - 1 < 0.3 * (peaks[1e6] - 1)


def test_without_limits_nothing_is_clipped(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID(limits=False))
    _, _, y = run(loop, loop.parameters.with_values({"pid.Kp": 50.0}), 1.0, 1e-4, 0.01)
    assert y[0, -1] == 50.0


@pytest.mark.parametrize("pid", [PID(), PID(sample_time=5e-3, delay=1), PID(sample_time=5e-3, dead_band=True)])
def test_derivatives_agree_with_finite_differences(second_order: System, pid: PID) -> None:
    loop = ClosedLoop(second_order, pid, Dither(60.0))
    values = {**TUNED, "pid.lower": -9.0, "pid.upper": 9.0, "dither.amplitude": 0.2}
    model, p = loop.discrete(2), loop.parameter_vector(loop.parameters.with_values(values))
    n = len(model.states)
    z = ca.MX.sym("z", n + len(p))
    after, y = model.advance_sample(ca.MX(0.003), ca.MX(5e-3), z[:n], ca.MX(0.7), z[n:])
    f = ca.Function("f", [z], [ca.vertcat(after, y)])
    jacobian = ca.Function("J", [z], [ca.jacobian(f(z), z)])
    point = np.concatenate([np.linspace(0.1, 0.4, n), p])
    steps = np.diag(1e-6 * np.maximum(1.0, np.abs(point)))
    columns = [(np.array(f(point + s)) - np.array(f(point - s))).ravel() / (2 * s.sum()) for s in steps]
    np.testing.assert_allclose(np.array(jacobian(point)), np.column_stack(columns), rtol=2e-6, atol=1e-7)


def test_rest_holds_the_load(axis: System) -> None:
    for pid in (PID(), PID(sample_time=1e-3), PID(sample_time=1e-3, delay=1)):
        loop = ClosedLoop(axis, pid, Dither(), actuated="force")
        p = loop.parameters.with_values({"pid.Ki": 5.0, "dither.offset": 1.0})
        x = dict(zip([q.name for q in loop.states], loop.initial(p), strict=True))
        assert x["pid.integral"] == pytest.approx(3.0)
        assert x["speed"] == pytest.approx(0.0, abs=1e-12)
        assert x.get("pid.command", 3.0) == pytest.approx(3.0)


def test_rest_at_another_reference_and_without_integral(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    x = loop.initial(loop.parameters, reference=0.5)
    dc = 1270.12 / (1270.12 + 86.34)
    np.testing.assert_allclose(x, [0.5 * dc, 0, 0, 0.5 * (1 - dc)], atol=1e-12)
    rate = loop.system().ode(0, x, [0.5], loop.parameter_vector(loop.parameters))[0]
    np.testing.assert_allclose(np.array(rate).ravel(), 0.0, atol=1e-9)


@pytest.mark.parametrize("pid", [PID(), PID(sample_time=1e-3), PID(sample_time=1e-3, delay=1)])
def test_a_given_state_is_taken_over_without_a_bump(axis: System, pid: PID) -> None:
    loop = ClosedLoop(axis, pid, actuated="force")
    p = loop.parameters.with_values({"pid.Kp": 7.0, "pid.Kd": 0.3, "pid.b": 0.6})
    x = loop.initial(p, [0.1, 0.2], reference=0.2, command=5.0)
    if pid.sample_time is not None:
        x = np.array(loop.update(0.0, x, [0.2, 0.0], loop.parameter_vector(p))).ravel()
    model = loop.hold_system() if pid.sample_time is not None else loop.system()
    assert float(model.ode(0, x, [0.2, 0.0], loop.parameter_vector(p))[1][-1]) == pytest.approx(5.0)


@pytest.mark.parametrize("pid", [PID(), PID(sample_time=1e-3)])
def test_a_position_may_move_on(axis: System, pid: PID) -> None:
    loop = ClosedLoop(axis, pid, actuated="force")
    p = loop.parameters.with_values({"pid.Ki": 1.0, "pid.Kp": 4.0, "pid.b": 0.5})
    x = dict(zip([q.name for q in loop.states], loop.initial(p, reference=0.2, start={"position": 0.3}), strict=True))
    assert (x["position"], x["speed"]) == pytest.approx((0.3, 0.2))
    assert x["pid.integral"] == pytest.approx(3.0 + 10.0 * 0.2 + 4.0 * 0.5 * 0.2)


def test_the_open_loop_is_controller_times_plant(second_order: System) -> None:
    w, h = np.geomspace(0.1, 400.0, 30), 2e-3
    s = 1j * w

    plant = control.tf([1270.12], [1, 17.5, 86.34])

    def controller(slope: np.ndarray) -> np.ndarray:
        """Its differentiator is s, or the difference over a sample."""
        return np.asarray(0.225 + 1.23 / slope + 0.01 * slope / (0.01 * slope + 1))

    for pid, dead_time in ((PID(), 0.0), (PID(sample_time=h), h / 2), (PID(sample_time=h, delay=1), 1.5 * h)):
        loop = ClosedLoop(second_order, pid, Dither(60.0))
        assert loop.dead_time == pytest.approx(dead_time)
        L = open_loop(loop, loop.parameters.with_values(TUNED))
        exact = plant(s) * controller(s)
        if pid.sample_time is not None:
            z = np.exp(s * h)
            exact = control.sample_system(plant, h, "zoh")(z) * controller((1 - 1 / z) / h) / z**pid.delay
        np.testing.assert_allclose(frequency_response(L, w), exact, rtol=1e-8)


def test_a_plant_may_not_use_the_loops_names() -> None:
    r, y = Quantity("reference", "V"), Quantity("y", "V")
    plant = define([y], [r], [y], ParameterSet(), lambda _t, x, u, _p: ({"y": u["reference"]}, {"y": x["y"]}))
    with pytest.raises(ModelError, match="'reference'"):
        ClosedLoop(plant, PID())


def test_dither_beyond_nyquist_is_refused(second_order: System) -> None:
    sampled = ClosedLoop(second_order, PID(sample_time=5e-3), Dither(60.0))
    other = ClosedLoop(second_order, PID(), Dither(160.0)).parameters
    with pytest.raises(InputError, match=r"dither\.frequency"):
        sampled.initial(sampled.parameters | other)


def test_a_continuous_derivative_needs_its_filter(second_order: System) -> None:
    continuous, sampled = ClosedLoop(second_order, PID()), ClosedLoop(second_order, PID(sample_time=1e-3))
    unfiltered = sampled.parameters.with_values({"pid.Tf": 0.0})
    sampled.check(unfiltered)
    with pytest.raises(InputError, match=r"pid\.Tf"):
        continuous.initial(unfiltered)
    assert np.isfinite(open_loop(sampled, unfiltered).A).all()


PUSH = Step(0.0, initial=0.2, at=0.1, horizon=1.1, disturbance={"load.force": 30.0})


def force_axis() -> tuple[ClosedLoop, ParameterSet]:
    """5 kg with 40 N s/m of friction under PI control of its speed."""
    loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(limits=False))
    values = {"load.mass": 5.0, "friction.viscous": 40.0, "pid.Kp": 60.0, "pid.Ki": 800.0}
    return loop, loop.parameters.with_values(values)


def test_a_load_step_shows_the_closed_form() -> None:
    """M v'' + (b + Kp) v' + Ki v = 0 from v' = -F/M: a damped oscillation about the reference."""
    loop, p = force_axis()
    M, b, Kp, Ki, F = 5.0, 40.0, 60.0, 800.0, 30.0
    run = respond(loop, PUSH, p)
    decay = (b + Kp) / (2 * M)
    rate = np.sqrt(Ki / M - decay**2)
    t = np.maximum(run.t - PUSH.at, 0.0)
    expected = 0.2 - F / (M * rate) * np.exp(-decay * t) * np.sin(rate * t)
    np.testing.assert_allclose(run["speed"], expected, atol=1e-7)
    found = evaluate(loop, PUSH, p)[PUSH.label]
    assert found["Overshoot"] == pytest.approx(100 * np.abs(expected - 0.2).max() / 0.2, rel=1e-4)
    outside = t[np.abs(expected - 0.2) > 0.02 * 0.2][-1]
    assert found["SettlingTime"] == pytest.approx(outside, abs=1e-3)
    assert found["RiseTime"] == 0.0
    assert found["Peak"] == pytest.approx(expected.min(), abs=1e-6)


def test_the_integral_of_the_error_is_the_load_over_Ki() -> None:
    """Overdamped the error keeps its sign: its integral is what the integral action had to gather."""
    loop, p = force_axis()
    p = p.with_values({"pid.Kp": 300.0})
    long = Step(0.0, scale=0.1, horizon=4.0, disturbance={"load.force": 30.0})
    assert evaluate(loop, long, p)[long.label]["IAE"] == pytest.approx(30.0 / 800.0 / 0.1, rel=1e-3)


def test_friction_slope_and_margins_are_stated() -> None:
    loop, p = force_axis()
    assert evaluate(loop, PUSH, p)[PUSH.label]["FrictionSlope"] == pytest.approx(40.0)


def test_a_disturbance_of_a_step_comes_with_it() -> None:
    """A linear loop: both at once are the sum of each alone."""
    loop, p = force_axis()
    both, step, push = (
        respond(loop, s, p)["speed"]
        for s in (
            Step(0.2, disturbance={"load.force": 30.0}),
            Step(0.2),
            Step(0.0, scale=0.2, disturbance={"load.force": 30.0}),
        )
    )
    np.testing.assert_allclose(both, step + push, atol=1e-9)


@pytest.mark.parametrize("method", [TwoPhase((12, 20), starts=1), Racing()])
def test_each_search_claims_what_is_certified(method: Method) -> None:
    """The step's rise and the load's recovery are bound together: all searches end in the same design."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    bounds = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.1, 200.0)}
    given = loop.parameters.with_values({"plant.time_constant": 0.1, "pid.Ki": 20.0}).with_bounds(bounds).freed(*bounds)
    steps = [Step(1.0), Step(0.0, scale=1.0, disturbance={"valve_voltage": -0.5})]
    limits: list[Requirement] = [PeakControl(6.0), Overshoot(0.08)]
    best = tune(loop, steps, given, minimise=SettlingTime(), subject_to=limits, method=method, plants={})
    assert best.status.converged
    certified = best.certified.astype(float).T
    assert certified["SettlingTime"].max() == pytest.approx(0.1203, abs=0.001)
    assert best.stats["deviation.SettlingTime"] < 1e-3
    assert best.stats["deviation.Overshoot"] < 0.05
    assert certified["Overshoot"].max() == pytest.approx(5.59, abs=0.05)


def test_zero_disturbance_is_the_plant_as_it_was() -> None:
    loop, p = force_axis()
    other = add_disturbances(loop, [PUSH])
    x, u = np.array([0.1, 0.3]), {"force": 20.0}
    ours, theirs = (model.plant.linearise(x, u, p) for model in (loop, other))
    np.testing.assert_array_equal(ours.A, theirs.A)
    assert other.inputs[-1].name == "disturbance.load.force"
    assert other.inputs[-1].unit == "N"
    assert add_disturbances(other, [PUSH]) is other
    assert add_disturbances(loop, [Step(1.0)]) is loop


def test_an_unknown_disturbance_is_named() -> None:
    loop, p = force_axis()
    with pytest.raises(UnknownNameError, match=r"load\.froce"):
        evaluate(loop, Step(0.1, disturbance={"load.froce": 1.0}), p)


OLD = {"pid.Kp": 200.0, "pid.Ki": 3000.0, "pid.Kd": 1.0, "pid.Tf": 0.01, "pid.b": 0.7, "pid.c": 1.0}
NEW = {"pid.Kp": 350.0, "pid.Ki": 6000.0, "pid.Kd": 2.5, "pid.Tf": 0.02, "pid.b": 0.2, "pid.c": 0.0}
H = 2e-3


LOOPS = {
    "continuous": ClosedLoop(ForceDrive(Stribeck()).system(), PID()),
    "feedforward": ClosedLoop(ForceDrive(Stribeck()).system(), PID(limits=False), feedforward=Feedforward()),
    "sampled": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H)),
    "delayed": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, delay=1), Dither(60.0)),
    "encoder": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, dead_band=True), sensor=Encoder(0.0, 5e-3)),
}


def fed(n: int) -> Trajectory:
    return Trajectory(np.arange(n) * H, {"reference": np.full(n, 0.1)})


@pytest.mark.parametrize("name", LOOPS)
def test_the_command_goes_on_where_it_is(name: str) -> None:
    """In the midst of a step, between two samples: the next command is the old gains', and the loop still settles."""
    loop = LOOPS[name]
    old = loop.parameters.with_values(OLD | ({"feedforward.gain": 50.0} if loop.feedforward else {}))
    new = old.with_values(NEW | ({"feedforward.gain": 90.0} if loop.feedforward else {}))
    run = simulate(loop, fed(11), old, t_out=[0.0, 9.999 * H])
    x = np.array([run[q.name][-1] for q in loop.states])
    moved = bumpless_transfer(loop, x, old, new, reference=0.1)
    commands = {}
    for label, state, gains in (("on", x, old), ("jumped", x, new), ("bumpless", moved, new)):
        after = simulate(loop, fed(301), gains, initial=state)
        commands[label] = float(after["control"][loop.pid.delay])
    assert abs(commands["jumped"] - commands["on"]) > 3.0
    assert commands["bumpless"] == pytest.approx(commands["on"], abs=1e-9)
    assert after["speed"][-1] == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("c", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_that_starts_in_steady_motion_goes_on_so(name: str, c: float) -> None:
    """Whatever part of the reference the derivative sees: it remembers that part, not the whole error."""
    loop = LOOPS[name]
    p = loop.parameters.with_values(OLD | {"pid.c": c})
    after = simulate(loop, fed(31), p, initial=loop.initial(p, reference=0.1))
    np.testing.assert_allclose(after["control"], after["control"][0], rtol=1e-6)
    np.testing.assert_allclose(after["speed"], 0.1, rtol=1e-6)


def test_a_form_takes_over_in_its_own_gains() -> None:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, form=Form.STANDARD))
    old = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Ti": 0.1})
    x = loop.initial(old, reference=0.1)
    moved = bumpless_transfer(loop, x, old, old.with_values({"pid.Kp": 300.0, "pid.b": 0.0}), reference=0.1)
    k = [q.name for q in loop.states].index("pid.integral")
    assert moved[k] - x[k] == pytest.approx(300.0 * 0.1)
    np.testing.assert_array_equal(np.delete(moved, k), np.delete(x, k))
