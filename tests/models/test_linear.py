from math import factorial, pi

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.models.friction import Coulomb, LuGre, PressureDependent
from pneuopt.models.linear import FirstOrder, Integrator, Plant, SecondOrder
from pneuopt.quantities.errors import InputError, ModelError
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
        h = 1e-6 * max(abs(point[k]), 1e-6)
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


def test_bad_input_is_named() -> None:
    with pytest.raises(ModelError, match="pade_order must be 0 to 5, got 6"):
        FirstOrder(pade_order=6).system()
    with pytest.raises(ModelError, match="PressureDependent needs pressures"):
        SecondOrder(friction=PressureDependent(Coulomb()))
    with pytest.raises(InputError, match=r"plant.dead_time.*outside its bounds"):
        FirstOrder(pade_order=1).system().parameters.with_values({"plant.dead_time": 0.0})


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
