import math

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.system import DiscreteSystem, Symbols, System, define, discretise, parameter_vector
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

SPRING = ParameterSet(
    {"stiffness": Parameter(30.0, "N/m"), "damping": Parameter(2.0, "N*s/m"), "mass": Parameter(2.0, "kg")}
)
STATES = (Quantity("position", "m", 0.1), Quantity("speed", "m/s", 0.5))
FORCE = Quantity("force", "N")
A = np.array([[0.0, 1.0], [-15.0, -1.0]])


def spring_mass() -> System:
    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        net = u["force"] - p["stiffness"] * x["position"] - p["damping"] * x["speed"]
        return {"speed": net / p["mass"], "position": x["speed"]}, {"position": x["position"], "net": net}

    return define(STATES, [FORCE], [STATES[0], Quantity("net", "N")], SPRING, rhs)


def test_the_vectors_follow_the_declarations_not_the_mapping() -> None:
    xdot, y = spring_mass().ode(0, [0.1, 0.2], [7.0], parameter_vector(SPRING, SPRING))
    assert np.array(xdot).ravel().tolist() == pytest.approx([0.2, (7 - 3 - 0.4) / 2])
    assert np.array(y).ravel().tolist() == pytest.approx([0.1, 3.6])


def test_linearise_gives_the_analytic_matrices() -> None:
    lin = spring_mass().linearise(np.array([0.3, 0.1]), {"force": 1.0}, SPRING)
    assert_allclose(lin.A, A)
    assert_allclose(lin.B, [[0.0], [0.5]])
    assert_allclose(lin.C, [[1.0, 0.0], [-30.0, -2.0]])
    assert_allclose(lin.D, [[0.0], [1.0]])
    assert (lin.states, lin.inputs, lin.outputs) == (("position", "speed"), ("force",), ("position", "net"))


def test_equilibrium_of_a_spring() -> None:
    assert_allclose(spring_mass().equilibrium({"force": 6.0}, SPRING), [0.2, 0.0], atol=1e-12)
    softer = SPRING.with_values({"stiffness": 10.0})
    assert_allclose(spring_mass().equilibrium({"force": 6.0}, softer, {"position": 1.0}), [0.6, 0.0], atol=1e-12)


def test_equilibrium_where_a_state_is_free_keeps_it_near_the_guess() -> None:
    loose = SPRING.with_values({"stiffness": 0.0})
    assert_allclose(spring_mass().equilibrium({}, loose, {"position": 0.7, "speed": 0.3}), [0.7, 0.0], atol=1e-12)


def test_no_equilibrium_names_the_state_and_the_remedy() -> None:
    loose = SPRING.with_values({"stiffness": 0.0, "damping": 0.0})
    with pytest.raises(ConvergenceError, match=r"d\(speed\)/dt stays at 3 m/s/s; give a guess"):
        spring_mass().equilibrium({"force": 6.0}, loose)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="unknown input 'torque'"):
        spring_mass().linearise(np.zeros(2), {"torque": 1.0}, SPRING)
    with pytest.raises(UnknownNameError, match="unknown state 'positon'; did you mean 'position'"):
        spring_mass().equilibrium({}, SPRING, {"positon": 1.0})


def exact(x: Array, force: float, h: float) -> Array:
    augmented = np.zeros((3, 3))
    augmented[:2, :2], augmented[1, 2] = A, force / 2
    return np.asarray(expm(h * augmented) @ [*x, 1.0])[:2]


def step_once(system: DiscreteSystem, x: Array, force: float, h: float) -> Array:
    t, dt, state, u, p = (ca.MX.sym(n, system.step.size1_in(i)) for i, n in enumerate("thxup"))
    sample = ca.Function("sample", [t, dt, state, u, p], list(system.advance_sample(t, dt, state, u, p)))
    return np.array(sample(0, h, x, [force], parameter_vector(SPRING, SPRING))[0]).ravel()


def test_rk4_has_order_four() -> None:
    x, system = np.array([0.1, -0.4]), spring_mass()
    errors = [
        np.abs(step_once(discretise(system, k), x, 5.0, 0.4) - exact(x, 5.0, 0.4)).max() for k in (16, 32, 64, 128)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4, 4, 4], abs=0.2)


def test_rk4_is_stable_up_to_2_78_over_lambda() -> None:
    lag = ParameterSet({"rate": Parameter(1000.0, "1/s")})
    state = Quantity("speed", "m/s")

    def decay(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {"speed": -p["rate"] * x["speed"]}, {"speed": x["speed"]}

    system = define([state], [], [state], lag, decay)
    factors = [float(discretise(system).step(0, h / 1000, [1.0], [], [1000.0])[0]) for h in (2.78, 2.79)]
    assert abs(factors[0]) < 1 < abs(factors[1])


def test_substeps_are_at_least_one() -> None:
    with pytest.raises(InputError, match="substeps must be at least 1, got 0"):
        discretise(spring_mass(), 0)
    with pytest.raises(InputError, match="substeps must be at least 1, got -1"):
        discretise(spring_mass()).with_substeps(-1)
    assert discretise(spring_mass()).with_substeps(3).substeps == 3


def test_a_right_hand_side_that_leaves_out_a_name_is_refused() -> None:
    def without_speed(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {"position": x["speed"]}, {"position": x["position"]}

    with pytest.raises(ModelError, match="no rate of state 'speed'"):
        define(STATES, [FORCE], STATES[:1], SPRING, without_speed)


def test_a_right_hand_side_with_a_foreign_name_is_refused() -> None:
    def misspelt(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {"position": x["speed"], "sped": x["speed"]}, {"position": x["position"]}

    with pytest.raises(UnknownNameError, match="unknown rate of state 'sped'; did you mean 'speed'"):
        define(STATES, [FORCE], STATES[:1], SPRING, misspelt)


def test_a_name_declared_twice_is_refused() -> None:
    def nothing(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {}, {}

    with pytest.raises(ModelError, match="state 'position' is declared twice"):
        define((STATES[0], *STATES), [FORCE], STATES[:1], SPRING, nothing)


def test_repr_lists_every_signal_and_parameter_with_its_unit() -> None:
    for system in (spring_mass(), discretise(spring_mass())):
        text = repr(system)
        assert "states: position [m], speed [m/s]" in text
        assert "inputs: force [N]" in text
        assert "stiffness  30 N/m" in text


def test_without_a_finder_it_starts_from_what_was_logged() -> None:
    log = Trajectory([0.0, 1.0, 2.0], {"position": [1.0, math.nan, 3.0], "force": [0.0, 0.0, 0.0]})
    (start,) = spring_mass().starts({"run": Log(log, SPRING)})
    assert start.states["run"]["position"].tolist() == [1.0, 2.0, 3.0]
    assert start.states["run"]["speed"].tolist() == [0.0, 0.0, 0.0]
    assert start.parameters == {}


def test_missing_values_keep_the_default() -> None:
    assert parameter_vector(SPRING, ParameterSet({"mass": Parameter(4.0, "kg")})).tolist() == [30.0, 2.0, 4.0]
