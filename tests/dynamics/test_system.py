""""""

import math
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate, simulate_stick_slip
from pneuopt.dynamics.system import (
    DiscreteSystem,
    Symbols,
    System,
    add_slopes,
    append_slopes,
    define,
    discretise,
    parameter_vector,
    slopes,
)
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, Viscous
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, ModelError, UnknownNameError
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity, usual_intersample
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


LINEAR, HELD = Intersample.LINEAR, Intersample.HELD
T = np.cumsum([0.0, 0.01, 0.02, 0.005, 0.03, 0.01, 0.02])
FORCE_RAMPS, COMMAND = (
    np.array([0.0, 30.0, -10.0, 40.0, 40.0, 5.0, 0.0]),
    np.array([1.0, 1.0, -2.0, 0.5, 3.0, 3.0, 0.0]),
)
MASS, FRICTION, GAIN = 2.0, 15.0, 4.0


def pushed_mass() -> System:
    """A mass under a measured force and a held command, whose speed is squared: no plant of this is linear."""
    states, inputs = [Quantity("speed", "m/s")], [Quantity("force", "N"), Quantity("command", "V")]
    parameters = ParameterSet({"mass": Parameter(MASS, "kg"), "gain": Parameter(GAIN, "N/V")})
    return define(
        states,
        inputs,
        [Quantity("speed", "m/s")],
        parameters,
        lambda _t, x, u, p: (
            {"speed": (u["force"] + p["gain"] * u["command"] - FRICTION * x["speed"] * abs(x["speed"])) / p["mass"]},
            {"speed": x["speed"]},
        ),
    )


def truth() -> Array:
    """The speed at T by SciPy: the force runs linearly, the command is held."""

    def rate(t: float, v: Array) -> Array:
        held = COMMAND[min(int(np.searchsorted(T, t, side="right")) - 1, len(T) - 1)]
        return np.asarray((np.interp(t, T, FORCE_RAMPS) + GAIN * held - FRICTION * v * abs(v)) / MASS)

    v, out = np.array([0.1]), [0.1]
    for a, b in pairwise(T):
        v = solve_ivp(rate, (a, b - 1e-13), v, rtol=1e-12, atol=1e-14).y[:, -1]
        out.append(float(v[0]))
    return np.array(out)


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_simulation_follows_a_line_between_two_samples(begin: float) -> None:
    inputs = Trajectory(T + begin, {"force": FORCE_RAMPS, "command": COMMAND})
    run = simulate(pushed_mass(), inputs, ParameterSet(), initial=[0.1], intersample={"force": LINEAR})
    np.testing.assert_allclose(run["speed"], truth(), rtol=1e-8 if not begin else 1e-4)
    held = simulate(pushed_mass(), inputs, ParameterSet(), initial=[0.1], intersample={"force": HELD})
    assert np.max(np.abs(held["speed"] - truth())) > 0.02
    same = simulate(pushed_mass(), inputs, ParameterSet(), initial=[0.1])
    np.testing.assert_array_equal(held["speed"], same["speed"])


@pytest.mark.parametrize("lanes", [None, 0])
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_sampled_step_follows_a_line_between_two_samples(lanes: int | None, begin: float) -> None:
    system, linear = pushed_mass(), np.array([True, False])
    discrete = add_slopes(discretise(system), linear)
    u = append_slopes(T + begin, np.column_stack([FORCE_RAMPS, COMMAND]), linear, linear)
    p, h = parameter_vector(system.parameters, system.parameters), np.append(np.diff(T), 0.0)
    run = Rollout(discrete.pieces, lanes=lanes).run([[0.1]], u[None], p, (T + begin)[None], h[None], substeps=20)
    np.testing.assert_allclose(run.y[0, :, 0], truth(), rtol=1e-7 if not begin else 1e-4)


def test_slopes_of_a_log_that_holds_its_inputs_are_zero_in_a_system_that_takes_them() -> None:
    system, linear = pushed_mass(), np.array([True, False])
    plain, rising = discretise(system), add_slopes(discretise(system), linear)
    assert add_slopes(plain, ~linear & linear) is plain
    u, none = np.column_stack([FORCE_RAMPS, COMMAND]), np.zeros(2, dtype=bool)
    p, h = parameter_vector(system.parameters, system.parameters), np.append(np.diff(T), 0.0)
    held = Rollout(plain.pieces).run([[0.1]], u[None], p, T[None], h[None], substeps=5).y
    own = append_slopes(T, u, linear, none)[None]
    same = Rollout(rising.pieces).run([[0.1]], own, p, T[None], h[None], substeps=5).y
    np.testing.assert_allclose(same, held, rtol=1e-13)
    np.testing.assert_array_equal(append_slopes(T, u, none, none), u)


def test_slopes_are_those_of_the_linear_columns() -> None:
    found = slopes(T, np.column_stack([FORCE_RAMPS, COMMAND]), np.array([True, False]))
    np.testing.assert_allclose(found[:-1, 0], np.diff(FORCE_RAMPS) / np.diff(T))
    assert not found[:, 1].any()
    assert not found[-1].any()


def test_a_step_without_its_ode_takes_no_slopes() -> None:
    with pytest.raises(ModelError, match="need the system's ode"):
        add_slopes(replace(discretise(pushed_mass()), ode=None), np.array([True, False]))


def test_a_stuck_mass_breaks_away_where_the_line_crosses_its_friction() -> None:
    drive = ForceDrive(Karnopp(Coulomb())).system()
    level = drive.parameters.value("friction.coulomb")
    push = Trajectory([0.0, 0.1, 0.2], {"force": [0.0, 0.0, 4 * level]})
    run = simulate(drive, push, drive.parameters, intersample={"force": LINEAR})
    assert run["stuck"].tolist() == [1.0, 1.0, 0.0]
    # from t = 0.125 s on the force exceeds friction by 40 level (t - 0.125)
    mass, rest = drive.parameters.value("load.mass"), 0.075
    viscous = drive.parameters.value("friction.viscous")
    rate, slope = viscous / mass, 40 * level / mass
    speed = slope * (rest / rate - (1 - np.exp(-rate * rest)) / rate**2) if rate else slope * rest**2 / 2
    assert run["speed"][-1] == pytest.approx(speed, rel=1e-6)
    events = simulate_stick_slip(drive, push, drive.parameters, intersample={"force": LINEAR}).events
    assert [event.t for event in events] == pytest.approx([0.125], abs=1e-9)
    assert [event.t for event in simulate_stick_slip(drive, push, drive.parameters).events] == [0.2]


def test_an_unknown_input_is_named() -> None:
    with pytest.raises(UnknownNameError, match="forse"):
        simulate(
            ForceDrive(Viscous()),
            Trajectory([0.0, 1.0], {"force": [0, 1]}),
            ParameterSet(),
            intersample={"forse": HELD},
        )


@pytest.mark.parametrize(
    ("name", "unit", "usual"),
    [
        ("valve_voltage", "V", HELD),
        ("speed_reference", "m/s", HELD),
        ("angle_reference", "rad", HELD),
        ("command", "mA", HELD),
        ("force", "N", LINEAR),
        ("torque", "N*m", LINEAR),
        ("pressure_a", "Pa(a)", LINEAR),
        ("position", "m", LINEAR),
        ("unit_unknown", "", LINEAR),
    ],
)
def test_what_is_usual(name: str, unit: str, usual: Intersample) -> None:
    assert usual_intersample(name, unit) is usual
