import warnings
from collections.abc import Callable
from math import pi
from types import ModuleType

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics import smooth
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, define
from pneuopt.evaluation.metrics import step_metrics
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck, Viscous
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, UnknownNameError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from problems.shared.paper2015 import paper_plant


def exact(plant: System, p: ParameterSet, t: Array, u: Array, x: Array) -> Array:
    """States of a linear plant on the grid by matrix exponentials, the input held."""
    linear, states = plant.linearise(x, {}, p), [x]
    n = len(x)
    for h, value in zip(np.diff(t), u[:-1], strict=True):
        joint = np.zeros((n + 1, n + 1))
        joint[:n, :n], joint[:n, n:] = linear.A, linear.B
        moved = expm(h * joint)
        states.append(moved[:n, :n] @ states[-1] + moved[:n, n] * value)
    return np.array(states)


@settings(deadline=None, max_examples=8)
@given(st.floats(1.0, 60.0), st.floats(0.05, 3.0), st.lists(st.floats(1e-4, 0.2), min_size=3, max_size=12), st.data())
def test_linear_plants_are_exact(w0: float, zeta: float, steps: list[float], data: st.DataObject) -> None:
    plant = SecondOrder().system()
    p = plant.parameters.with_values({"plant.natural_frequency": w0, "plant.damping": zeta})
    t = np.cumsum([5.0, *steps])
    u = np.array(data.draw(st.lists(st.floats(-5, 5), min_size=len(t), max_size=len(t))))
    run = simulate(plant, Trajectory(t, {"valve_voltage": u}), p, initial={"speed": 1.0, "drive": -2.0})
    expected = exact(plant, p, t, u, np.array([1.0, -2.0]))
    assert run.matrix(["speed", "drive"]) == pytest.approx(expected, rel=1e-6, abs=1e-6 * max(1.0, w0))


def closed(gain: float = 1.0, **pid: float) -> tuple[ClosedLoop, ParameterSet]:
    plant, printed = paper_plant(gain)
    loop = ClosedLoop(plant, PID(limits=False))
    return loop, (loop.parameters | printed).with_values({f"pid.{n}": v for n, v in pid.items()})


@pytest.mark.parametrize(
    ("gain", "dc", "peak", "settling"),
    [
        (1.0, 0.936349, 1.370598, {0.05: 0.2947, 0.02: 0.4494, 0.01: 0.4716, 0.001: 0.7350}),
        (0.5, 0.880316, 1.178517, {0.02: 0.4148}),
    ],
)
def test_golden_unit_feedback(gain: float, dc: float, peak: float, settling: dict[float, float]) -> None:
    loop, p = closed(gain)
    run = simulate(loop, Step(1.0, horizon=3.0).trajectory(1e-4), p)
    assert run["speed"][-1] == pytest.approx(dc, abs=1e-6)
    assert run["speed"].max() == pytest.approx(peak, abs=1e-6)
    for band, expected in settling.items():
        measured = step_metrics(run.t, run["speed"], 1.0, 0.0, band=band)["SettlingTime"]
        assert measured == pytest.approx(expected, abs=6e-5), band


@pytest.mark.parametrize(("gain", "overshoot", "settling"), [(0.5, 0.0, 0.348), (1.0, 1.31, 0.1575)])
def test_golden_pid(gain: float, overshoot: float, settling: float) -> None:
    loop, p = closed(gain, Kp=0.225, Ki=1.23, Kd=0.01, Tf=0.01)
    run = simulate(loop, Step(1.0, horizon=3.0).trajectory(5e-4), p)
    m = step_metrics(run.t, run["speed"], 1.0, 0.0)
    assert m["Overshoot"] == pytest.approx(overshoot, abs=5e-3)
    assert m["SettlingTime"] == pytest.approx(settling, abs=5e-4)


def sampled_by_hand(t: Array, r: Array, h: float) -> Array:
    """A PI of Kp 0.4, Ki 3 on 1/(0.1 s + 1): a recursion on the exact decay between instants."""
    y, integral, u, ys, samples = 0.0, 0.0, 0.0, [], 0
    for k in range(len(t)):
        if t[k] - t[0] > samples * h - 1e-9:
            integral += 3.0 * h * (r[k] - y)
            u, samples = 0.4 * (r[k] - y) + integral, samples + 1
        ys.append(y)
        if k + 1 < len(t):
            y = u + (y - u) * np.exp(-(t[k + 1] - t[k]) / 0.1)
    return np.array(ys)


@pytest.mark.parametrize("begin", [0.0, -3.7, 1.7e9])
def test_a_sampled_loop_acts_at_its_samples_only(begin: float) -> None:
    """The reference also changes between samples, which the controller must not see before the next one."""
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=0.02, limits=False))
    p = loop.parameters.with_values({"pid.Kp": 0.4, "pid.Ki": 3.0})
    t: Array = 0.005 * np.arange(201.0)
    r = np.sin(3.0 * t) + (t > 0.333)
    run = simulate(loop, Trajectory(begin + t, {"reference": r}), p)
    assert run["speed"] == pytest.approx(sampled_by_hand(t, r, 0.02), abs=1e-6 if begin > 1e6 else 1e-8)


def test_instants_asked_for_are_those_of_the_same_run() -> None:
    loop, p = closed()
    inputs = Trajectory([0.0, 0.5], {"reference": [1.0, 1.0]})
    t = np.array([0.0, 0.0123, 0.2, 0.5])
    few, many = simulate(loop, inputs, p, t_out=t), simulate(loop, Step(1.0, horizon=0.5).trajectory(1e-4), p)
    assert np.array_equal(few.t, t)
    assert few["speed"] == pytest.approx(many["speed"][np.searchsorted(many.t, t - 1e-9)], abs=1e-7)


def test_instants_that_rounding_puts_beside_a_sample() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-3))
    t, fine = np.linspace(0, 0.1, 101), np.linspace(0, 0.1, 1001)
    assert np.any((fine[::10] != t) & (np.abs(fine[::10] - t) < 1e-15))
    inputs = Trajectory(t, {"reference": np.ones(101)})
    run = simulate(loop, inputs, loop.parameters, t_out=fine)
    assert run["speed"][::10] == pytest.approx(simulate(loop, inputs, loop.parameters)["speed"], abs=1e-9)


def test_a_small_fast_sine_on_a_plant_at_rest_is_not_stepped_over() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), Dither(frequency=160.0))
    p = loop.parameters.with_values({"pid.Kp": 0.0, "dither.amplitude": 1e-3})
    t = np.linspace(0.0, 1.5, 30001)
    y = simulate(loop, Trajectory(t, {"reference": np.zeros(len(t))}), p)["speed"][t > 1.0]
    assert np.ptp(y) / 2 == pytest.approx(1e-3 / abs(0.1j * 2 * pi * 160 + 1), rel=1e-3)


def test_outputs_and_states_of_a_drive_that_sticks() -> None:
    """A force below Coulomb's only makes the regularised friction creep at v = smoothing * atanh(F / F_c)."""
    drive = ForceDrive(Coulomb()).system()
    p = drive.parameters.with_values({"friction.coulomb": 30.0, "friction.viscous": 0.0, "friction.smoothing": 1e-3})
    t = np.linspace(0.0, 1.0, 101)
    run = simulate(drive, Trajectory(t, {"force": np.full(101, 15.0)}), p)
    assert run["speed"][-1] == pytest.approx(1e-3 * np.arctanh(0.5), rel=1e-6)


def test_a_sampled_loop_with_stiff_friction_takes_few_evaluations(
    count_calls: Callable[[ModuleType], list[int]],
) -> None:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=1e-3))
    p = loop.parameters.with_values({"pid.Kp": 500.0, "pid.Ki": 3000.0, "friction.smoothing": 1e-3})
    inputs = Step(0.1, horizon=1.0).trajectory(1e-3)
    inputs = inputs.with_columns({q.name: np.zeros(len(inputs)) for q in loop.inputs if q.name != "reference"})
    calls = count_calls(smooth)
    run = simulate(loop, inputs, p)
    assert sum(calls) < 40_000  # 20,797 when this was written
    assert run["speed"][-1] == pytest.approx(0.1, rel=0.01)


def stepped_simulations() -> dict[str, Trajectory]:
    """Runs with a held and with a rising input, of a sampled loop, and into both end stops with a coarse grid."""
    force = ForceDrive(Stribeck()).system()
    held = Trajectory([0.0, 0.03, 0.1], {"force": [60.0, 20.0, 0.0]})
    loop = ClosedLoop(force, PID(sample_time=1e-3))
    gains = loop.parameters.with_values({"pid.Kp": 500.0, "pid.Ki": 3000.0})
    step = Step(0.1, horizon=0.05).trajectory(1e-3)
    step = step.with_columns({q.name: np.zeros(len(step)) for q in loop.inputs if q.name != "reference"})
    drive = PneumaticDrive(friction=Viscous()).system()
    swing = Trajectory([0.0, 0.7, 1.5], {"valve_voltage": [5.0, -5.0, 0.0]})
    grid = np.linspace(0.0, 0.1, 57)
    return {
        "held": simulate(force, held, force.parameters, t_out=grid),
        "rising": simulate(force, held, force.parameters, t_out=grid, intersample={"force": Intersample.LINEAR}),
        "sampled": simulate(loop, step, gains, t_out=np.linspace(0.0, 0.05, 501)),
        "stops": simulate(drive, swing, drive.parameters, t_out=np.linspace(0.0, 1.5, 151)),
    }


def test_a_run_in_one_call_of_the_integrator_is_that_of_a_call_an_instant_to_the_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = list[tuple[dict[str, Trajectory], list[str]]]()
    for stepwise in (False, True):
        if stepwise:
            monkeypatch.setattr(smooth.SmoothIntegration, "advance_along", lambda *_: None)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            runs = stepped_simulations()
        found.append((runs, [str(w.message) for w in said if issubclass(w.category, PhysicsWarning)]))
    (runs, contacts), (wanted, told) = found
    assert contacts == told
    assert len(contacts) == 2
    for name, run in runs.items():
        for column in run.names:
            assert np.array_equal(run[column], wanted[name][column]), (name, column)


def runaway() -> System:
    x = Quantity("level", "1", lower=-10.0)
    p = ParameterSet({"rate": Parameter(1.0, "1/s")})
    return define([x], [], [x], p, lambda _t, x, _u, p: ({"level": p["rate"] * x["level"] ** 2}, dict(x)))


def test_a_run_that_escapes_says_when_and_where() -> None:
    with pytest.raises(ConvergenceError, match=r"stopped after t = 0.9 s, where level 10 1") as caught:
        simulate(runaway(), Trajectory(np.linspace(0, 2, 21), {}), ParameterSet(), initial={"level": 1.0})
    assert caught.value.solution["level"][-1] == pytest.approx(10.0, rel=1e-6)


def test_a_model_that_is_undefined_says_so() -> None:
    x = Quantity("level", "1")
    root = define([x], [], [x], ParameterSet(), lambda _t, x, _u, _p: ({"level": -ca.sqrt(x["level"]) - 1}, dict(x)))
    with pytest.raises(ConvergenceError, match="not defined there"):
        simulate(root, Trajectory([0.0, 0.5, 1.5], {}), ParameterSet(), initial={"level": 1.0})


def test_bad_input_is_named() -> None:
    plant = FirstOrder().system()
    held = Trajectory([0.0, 1.0], {"valve_voltage": [1.0, 1.0]})
    with pytest.raises(UnknownNameError, match="unknown channel 'valve_voltage'"):
        simulate(plant, Trajectory([0.0, 1.0], {"voltage": [1.0, 1.0]}), plant.parameters)
    with pytest.raises(InputError, match=r"'valve_voltage' is nan at t = 1 s"):
        simulate(plant, Trajectory([0.0, 1.0], {"valve_voltage": [1.0, np.nan]}), plant.parameters)
    with pytest.raises(InputError, match="t_out runs from 0 to 2 s, the inputs from 0 to 1 s"):
        simulate(plant, held, plant.parameters, t_out=[0.0, 2.0])
    with pytest.raises(UnknownNameError, match="did you mean 'speed'"):
        simulate(plant, held, plant.parameters, initial={"sped": 1.0})
    with pytest.raises(InputError, match=r"initial has shape \(2,\), the model has 1 states"):
        simulate(plant, held, plant.parameters, initial=[1.0, 2.0])
    with pytest.raises(InputError, match=r"level starts at -20 1, outside \[-10, inf\]"):
        simulate(runaway(), Trajectory([0.0, 1.0], {}), ParameterSet(), initial={"level": -20.0})


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("rtol", value) for value in (-1.0, 0.0, np.nan, "1e-6", 2.0)),
        *(("atol", value) for value in (-1.0, np.nan, "1e-6")),
        *(("max_steps", value) for value in (np.nan, "1000")),
        ("intersample", "linear"),
        ("intersample", {"valve_voltage": "linear"}),
    ],
)
def test_a_wrong_option_is_named(option: str, value: object) -> None:
    """A tolerance of NaN was taken, and an input said to be "linear" was held."""
    plant = FirstOrder().system()
    with pytest.raises(InputError, match=f"^{option}.* takes .*; got "):
        simulate(
            plant,
            Trajectory([0.0, 1.0], {"valve_voltage": [1.0, 1.0]}),
            plant.parameters,
            **{option: value},  # type: ignore[arg-type]
        )
