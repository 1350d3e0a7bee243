from dataclasses import replace
from math import factorial, pi

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.control.linear_loop import linear_plant
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.runnable import command_centre
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, add_dead_time, names, parameter_vector
from pneuopt.evaluation.margins import frequency_response
from pneuopt.models.friction import Coulomb, LuGre
from pneuopt.models.linear import INPUT_OFFSET, PLANT_GAIN, FirstOrder, Integrator, Plant, SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory


def transfer(system: System, values: dict[str, float], s: complex) -> complex:
    linear = system.linearise(np.zeros(len(system.states)), {}, system.parameters.with_values(values))
    n = len(linear.A)
    return complex((linear.C @ np.linalg.solve(s * np.eye(n) - linear.A, linear.B) + linear.D).item())


def pade(order: int, s: complex) -> complex:
    """The diagonal approximant of exp(-s) from its closed form."""
    c = [
        factorial(2 * order - k) * factorial(order) / (factorial(2 * order) * factorial(k) * factorial(order - k))
        for k in range(order + 1)
    ]
    return complex(sum(q * (-s) ** k for k, q in enumerate(c)) / sum(q * s**k for k, q in enumerate(c)))


@given(st.integers(1, 5), st.floats(1e-3, 10.0), st.floats(0.01, 1000.0))
def test_dead_time_is_the_pade_approximant(order: int, dead_time: float, w: float) -> None:
    values = {"plant.dead_time": dead_time, "plant.gain": 3.0}
    expected = 3.0 / (1j * w) * pade(order, 1j * w * dead_time)
    assert transfer(Integrator(pade_order=order).system(), values, 1j * w) == pytest.approx(expected, rel=1e-9)


@given(st.floats(0.1, 50.0), st.floats(0.05, 5.0), st.floats(-4.0, 4.0), st.floats(0.1, 100.0))
def test_transfer_functions(w0: float, zeta: float, gain: float, w: float) -> None:
    s = 1j * w
    second = {"plant.gain": gain, "plant.natural_frequency": w0, "plant.damping": zeta}
    expected = gain * w0**2 / (s**2 + 2 * zeta * w0 * s + w0**2)
    assert transfer(SecondOrder().system(), second, s) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    first = {"plant.gain": gain, "plant.time_constant": zeta}
    assert transfer(FirstOrder().system(), first, s) == pytest.approx(gain / (zeta * s + 1), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_the_delay_line_keeps_the_inputs_size_at_any_dead_time(order: int) -> None:
    plant = FirstOrder(pade_order=order).system()
    t = np.linspace(0.0, 0.5, 501)
    held = Trajectory(t, {"valve_voltage": np.ones(501)})
    for dead_time in (1e-3, 0.01, 0.1, 0.3):
        run = simulate(plant, held, plant.parameters.with_values({"plant.dead_time": dead_time}))
        assert max(np.abs(run[n]).max() for n in names(plant.states[1:])) < 3.0
    late = simulate(plant, held, plant.parameters.with_values({"plant.dead_time": 0.1}))["speed"]
    exact = np.where(t > 0.1, 1 - np.exp(-(t - 0.1) / 0.1), 0.0)
    assert np.abs(late - exact)[t > 0.2].max() < (0.2, 0.05, 0.02, 0.01, 0.006)[order - 1]


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_the_stated_lower_limit_of_the_dead_time(order: int) -> None:
    limit, h = (0.72, 1.22, 1.87, 2.57, 3.26)[order - 1], 1e-3
    plant = Integrator(pade_order=order).system()
    for dead_time, stable in ((1.005 * limit * h, True), (0.97 * limit * h, False)):
        A = plant.linearise(np.zeros(order + 1), {}, _with_dead_time(plant, dead_time)).A[1:, 1:]
        step = sum((np.linalg.matrix_power(h * A, k) / factorial(k) for k in range(5)), np.zeros_like(A))
        assert (np.abs(np.linalg.eigvals(step)).max() <= 1.0) is np.bool_(stable)


def _with_dead_time(plant: System, dead_time: float) -> ParameterSet:
    wide = plant.parameters.with_bounds({"plant.dead_time": (1e-6, 10.0)})
    return wide.with_values({"plant.dead_time": dead_time})


@pytest.mark.parametrize(
    "plant",
    [
        FirstOrder(pade_order=2),
        SecondOrder(pade_order=3),
        Integrator(pade_order=1),
        SecondOrder(friction=Coulomb()),
        SecondOrder(pade_order=1, friction=LuGre()),
    ],
)
def test_derivatives_agree_with_finite_differences(plant: Plant) -> None:
    system = plant.system()
    rng = np.random.default_rng(3)
    scale = np.array([1e-4 if n == "friction.bristle" else 0.05 for n in names(system.states)])
    x, u = rng.normal(size=len(scale)) * scale, np.array([0.7])
    p = parameter_vector(system.parameters, system.parameters)
    z = [ca.SX.sym(k, n) for k, n in (("x", len(x)), ("u", 1), ("p", len(p)))]
    rate = system.ode(0, *z)[0]
    jacobian = ca.Function("jacobian", z, [ca.jacobian(rate, ca.vertcat(*z))])
    exact, point = np.array(jacobian(x, u, p)), np.concatenate([x, u, p])
    for k in range(len(point)):
        h = 1e-6 * max(abs(point[k]), 1e-3)
        high, low = (
            np.array(system.ode(0, *np.split(point + sign * h * np.eye(len(point))[k], [len(x), len(x) + 1]))[0])
            for sign in (1, -1)
        )
        assert exact[:, k] == pytest.approx((high - low).ravel() / (2 * h), rel=1e-5, abs=1e-5 * np.abs(exact).max())


def test_units_follow_the_signals() -> None:
    force, position, pressure = Quantity("force", "N"), Quantity("position", "m"), Quantity("pressure_a", "Pa(a)")
    assert FirstOrder().system().parameters["plant.gain"].unit == "m/s/V"
    assert Integrator(input=force, output=position).system().parameters["plant.gain"].unit == "m/(N*s)"
    assert FirstOrder(output=pressure).system().parameters["plant.gain"].unit == "Pa/V"
    assert SecondOrder(friction=Coulomb()).system().parameters["friction.coulomb"].unit == "V"


def test_friction_is_an_equivalent_voltage() -> None:
    """Steady motion takes y / gain + F; below the Coulomb voltage the drive sticks but for the creep of smoothing."""
    plant = SecondOrder(friction=Coulomb()).system()
    p = plant.parameters.with_values({"plant.gain": 0.2, "friction.coulomb": 0.5, "friction.smoothing": 1e-4})
    t = np.linspace(0.0, 6.0, 1201)
    u = np.select([t < 2, t < 4], [0.4, 2.0], -2.0)
    y = simulate(plant, Trajectory(t, {"valve_voltage": u}), p)["speed"]
    assert np.abs(y[t < 2]).max() < 2e-4
    assert y[np.searchsorted(t, 4.0) - 1] == pytest.approx(0.2 * (2.0 - 0.5), rel=1e-4)
    assert y[-1] == pytest.approx(-0.2 * (2.0 - 0.5), rel=1e-4)


def test_without_friction_force_the_plant_is_linear() -> None:
    rubbing = SecondOrder(friction=Coulomb()).system()
    values = {"plant.gain": 0.3, "plant.damping": 0.4}
    for w in (0.5, 10.0, 80.0):
        assert transfer(rubbing, values | {"friction.coulomb": 0.0}, 1j * w) == pytest.approx(
            transfer(SecondOrder().system(), values, 1j * w), rel=1e-9
        )


def test_resonance_peaks_where_the_damping_says() -> None:
    zeta, w0 = 0.2376, 36.83
    values = {"plant.damping": zeta, "plant.natural_frequency": w0}
    w = np.linspace(1.0, 60.0, 4000)
    gain = np.abs([transfer(SecondOrder().system(), values, 1j * q) for q in w[::20]])
    assert w[::20][np.argmax(gain)] == pytest.approx(w0 * np.sqrt(1 - 2 * zeta**2), abs=0.3)
    plant = SecondOrder().system()
    t = np.linspace(0, 2 * pi / w0, 2001)
    held = Trajectory(t, {"valve_voltage": np.ones(2001)})
    y = simulate(plant, held, plant.parameters.with_values(values))["speed"]
    assert y.max() == pytest.approx(1 + np.exp(-pi * zeta / np.sqrt(1 - zeta**2)), rel=1e-6)


def steps(t: Array, levels: tuple[float, ...]) -> Array:
    k = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    values: Array = np.array(levels)[k]
    return values


def logged(
    system: System, values: dict[str, float], levels: tuple[float, ...], seed: int = 0, begin: float = 0.0
) -> Log:
    """A generated log: 3 s at 1 kHz, noise of 0.5 % of the largest output."""
    t = np.linspace(0.0, 3.0, 3001)
    truth = system.parameters.with_values(values)
    run = simulate(system, Trajectory(t + begin, {"valve_voltage": steps(t, levels)}), truth)
    noise = 0.005 * np.abs(run["speed"]).max() * np.random.default_rng(seed).normal(size=len(t))
    channels = {"valve_voltage": steps(t, levels), "speed": run["speed"] + noise}
    return Log(Trajectory(t + begin, channels), system.parameters.freed(*(n for n in values if n.startswith("plant."))))


SECOND = {"plant.gain": -0.12, "plant.natural_frequency": 22.0, "plant.damping": 0.35}
CASES: list[tuple[Plant, dict[str, float]]] = [
    (FirstOrder(), {"plant.gain": 0.4, "plant.time_constant": 0.13}),
    (FirstOrder(pade_order=3), {"plant.gain": 0.4, "plant.time_constant": 0.13, "plant.dead_time": 0.06}),
    (SecondOrder(), SECOND),
    (SecondOrder(pade_order=3), SECOND | {"plant.dead_time": 0.03}),
    (SecondOrder(), {"plant.gain": 2.0, "plant.natural_frequency": 8.0, "plant.damping": 1.9}),
    (Integrator(pade_order=2), {"plant.gain": 0.7, "plant.dead_time": 0.05}),
]


@pytest.mark.parametrize(("plant", "values"), CASES)
def test_the_first_candidate_is_near_the_truth_without_a_guess(plant: Plant, values: dict[str, float]) -> None:
    system = plant.system()
    first = system.starts({"run": logged(system, values, (0.0, 2.0, -1.0, 1.0))})[0]
    assert set(first.parameters) == set(values)
    for name, value in values.items():
        assert first.parameters[name] == pytest.approx(value, rel=0.06 if name == "plant.dead_time" else 0.02), name
    assert set(names(system.states)) <= set(first.states["run"].names)


def test_the_states_along_the_log_are_those_of_the_model() -> None:
    system = SecondOrder(pade_order=2).system()
    log = logged(system, SECOND | {"plant.dead_time": 0.02}, (0.0, 2.0, -1.0), begin=50.0)
    states = system.starts({"run": log})[0].states["run"]
    assert np.array_equal(states.t, log.measured.t)
    assert np.std(states["speed"] - log.measured["speed"]) < 0.012 * np.abs(log.measured["speed"]).max()


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_the_delay_line_along_the_log_is_that_of_the_model(order: int) -> None:
    """At rest along the log it would say that nothing measured depends on the dead time."""
    system = SecondOrder(pade_order=order).system()
    log = logged(system, SECOND | {"plant.dead_time": 0.05}, (0.0, 2.0, -1.0))
    start = system.starts({"run": log})[0]
    given = system.parameters.with_values(start.parameters)
    run = simulate(system, log.measured.select(["valve_voltage"]), given)
    for name in (n for n in names(system.states) if "delay" in n):
        assert start.states["run"][name] == pytest.approx(run[name], abs=0.02), name


def test_several_logs_are_joined_and_need_not_begin_at_rest() -> None:
    system = SecondOrder().system()
    whole = logged(system, SECOND, (0.0, 2.0, -1.0, 1.0, 0.5, 0.0))
    parts = {n: Log(whole.measured.rows(a, b), whole.parameters) for n, a, b in (("a", 600, 1500), ("b", 1400, 2900))}
    start = system.starts(parts)[0]
    assert set(start.states) == {"a", "b"}
    assert start.parameters == pytest.approx(SECOND, rel=0.02)


def test_friction_is_found_beside_the_plant() -> None:
    system = SecondOrder(friction=Coulomb()).system()
    values = {"plant.gain": 0.2, "plant.natural_frequency": 12.0, "plant.damping": 0.8, "friction.coulomb": 0.4}
    log = logged(system, values, (0.0, 2.0, -1.5, 3.0, -2.0))
    start = system.starts({"run": Log(log.measured, log.parameters.freed("friction.coulomb"))})[0]
    assert start.parameters == pytest.approx(values, rel=0.05)


def test_fixed_values_stay_and_missing_samples_do_not_matter() -> None:
    system = SecondOrder().system()
    log = logged(system, SECOND, (0.0, 2.0, -1.0))
    holes = np.array(log.measured["speed"])
    holes[500:520] = np.nan
    known = log.parameters.with_values({"plant.gain": -0.12}).fixed("plant.gain")
    start = system.starts({"run": Log(log.measured.with_columns({"speed": holes}), known)})[0]
    assert "plant.gain" not in start.parameters
    assert start.parameters["plant.natural_frequency"] == pytest.approx(22.0, rel=0.02)


@pytest.mark.parametrize("dead", [0.02, 0.0])
def test_a_dead_time_may_have_a_lower_bound_of_zero(dead: float) -> None:
    """The model of a delay divides by it, and the candidates are told apart by their logarithms."""
    system = FirstOrder(pade_order=2).system()
    log = logged(FirstOrder().system(), {"plant.gain": 0.4, "plant.time_constant": 0.13}, (0.0, 2.0, -1.0, 1.0))
    late = np.interp(log.measured.t - dead, log.measured.t, log.measured["speed"])
    free = system.parameters.with_bounds({"plant.dead_time": (0.0, 1.0)}).freed("plant.*")
    starts = system.starts({"run": Log(log.measured.with_columns({"speed": late}), free)})
    assert all(start.parameters["plant.dead_time"] > 0 for start in starts)
    assert starts[0].parameters["plant.dead_time"] == pytest.approx(dead, abs=2e-3)


@pytest.mark.parametrize(("plant", "values"), CASES)
def test_the_first_candidate_finds_where_the_input_counts_from(plant: Plant, values: dict[str, float]) -> None:
    """A constant on the output is one on the input: the log of this one counts both from elsewhere."""
    system = plant.system()
    log = logged(system, values | {INPUT_OFFSET: 1.5}, (2.0, 3.5, 0.5, 2.5))
    shown = 0.0 if isinstance(plant, Integrator) else 0.4
    measured = log.measured.with_columns({"speed": log.measured["speed"] + shown})
    first = system.starts({"run": Log(measured, log.parameters.freed(INPUT_OFFSET))})[0]
    truth = values | {INPUT_OFFSET: 1.5 - shown / values[PLANT_GAIN]}
    for name, value in truth.items():
        assert first.parameters[name] == pytest.approx(value, rel=0.06 if name == "plant.dead_time" else 0.03), name
    error = first.states["run"]["speed"] - measured["speed"]
    assert np.std(error) < 0.012 * np.abs(measured["speed"]).max()


def test_each_log_may_count_from_elsewhere_and_a_known_offset_stays() -> None:
    system = SecondOrder().system()
    zeros = {"a": 1.0, "b": -0.5, "known": 2.0}
    logs = {n: logged(system, SECOND | {INPUT_OFFSET: zero}, (0.0, 2.0, -1.0)) for n, zero in zeros.items()}
    own = logs["a"].parameters.freed(INPUT_OFFSET).per_log(INPUT_OFFSET)
    logs = {n: Log(log.measured, own) for n, log in logs.items()}
    logs["known"] = Log(logs["known"].measured, own.with_values({INPUT_OFFSET: 2.0}).fixed(INPUT_OFFSET))
    first = system.starts(logs)[0]
    assert first.parameters["plant.gain"] == pytest.approx(SECOND["plant.gain"], rel=0.02)
    assert first.parameters[f"{INPUT_OFFSET}[a]"] == pytest.approx(1.0, abs=0.02)
    assert first.parameters[f"{INPUT_OFFSET}[b]"] == pytest.approx(-0.5, abs=0.02)
    assert {INPUT_OFFSET, f"{INPUT_OFFSET}[known]"}.isdisjoint(first.parameters)


def test_a_loop_counts_its_command_from_the_offset() -> None:
    """As from a valve's centre: what the wire carries at rest is no disturbance of the loop."""
    system = FirstOrder().system()
    at = system.parameters.with_values({INPUT_OFFSET: 3.0})
    assert command_centre(system, at) == 3.0
    loop = ClosedLoop(system, PID())
    rest = loop.plant.linearise(np.zeros(1), {}, at)
    assert loop.plant.equilibrium({"valve_voltage": 0.0}, at) == pytest.approx([0.0])
    assert system.equilibrium({"valve_voltage": 3.0}, at) == pytest.approx([0.0])
    assert pytest.approx(system.linearise(np.zeros(1), {}, at).A) == rest.A


def test_a_dead_time_is_added_to_any_plant_of_one_input() -> None:
    """As the linear plants have theirs; of a plant that has one, or has two inputs, it is refused."""
    ours, theirs = add_dead_time(FirstOrder().system(), 3), FirstOrder(pade_order=3).system()
    values = {"plant.time_constant": 0.5, "plant.gain": 3.0}
    p, q = values | {"dead_time": 0.2}, values | {"plant.dead_time": 0.2}
    found, wanted = (
        linear_plant(loop, loop.parameters.with_values(given))
        for loop, given in ((ClosedLoop(ours, PID()), p), (ClosedLoop(theirs, PID()), q))
    )
    w = np.array([0.1, 1.0, 30.0])
    exact = 3 / (0.5j * w + 1) * np.exp(-0.2j * w)
    np.testing.assert_allclose(frequency_response(found, w), exact, rtol=1e-9)
    np.testing.assert_allclose(frequency_response(wanted, w), exact, rtol=1e-9)
    with pytest.raises(ModelError, match="has a dead time"):
        add_dead_time(theirs)
    two = replace(theirs, inputs=(Quantity("a", "V"), Quantity("b", "V")), dead_time=None)
    with pytest.raises(ModelError, match="needs one input, got a, b"):
        add_dead_time(two)
