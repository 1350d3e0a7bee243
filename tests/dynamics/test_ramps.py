from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.ramps import add_slopes, append_slopes, slopes
from pneuopt.dynamics.simulate import simulate, simulate_stick_slip
from pneuopt.dynamics.system import System, define, discretise, parameter_vector
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, Viscous
from pneuopt.models.karnopp import Karnopp
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, UnknownNameError
from pneuopt.quantities.intersample import Intersample, usual_intersample
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

LINEAR, HELD = Intersample.LINEAR, Intersample.HELD
T = np.cumsum([0.0, 0.01, 0.02, 0.005, 0.03, 0.01, 0.02])
FORCE, COMMAND = np.array([0.0, 30.0, -10.0, 40.0, 40.0, 5.0, 0.0]), np.array([1.0, 1.0, -2.0, 0.5, 3.0, 3.0, 0.0])
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
        return np.asarray((np.interp(t, T, FORCE) + GAIN * held - FRICTION * v * abs(v)) / MASS)

    v, out = np.array([0.1]), [0.1]
    for a, b in pairwise(T):
        v = solve_ivp(rate, (a, b - 1e-13), v, rtol=1e-12, atol=1e-14).y[:, -1]
        out.append(float(v[0]))
    return np.array(out)


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_simulation_follows_a_line_between_two_samples(begin: float) -> None:
    inputs = Trajectory(T + begin, {"force": FORCE, "command": COMMAND})
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
    u = append_slopes(T + begin, np.column_stack([FORCE, COMMAND]), linear, linear)
    p, h = parameter_vector(system.parameters, system.parameters), np.append(np.diff(T), 0.0)
    run = Rollout(discrete.pieces, lanes=lanes).run([[0.1]], u[None], p, (T + begin)[None], h[None], substeps=20)
    np.testing.assert_allclose(run.y[0, :, 0], truth(), rtol=1e-7 if not begin else 1e-4)


def test_slopes_of_a_log_that_holds_its_inputs_are_zero_in_a_system_that_takes_them() -> None:
    system, linear = pushed_mass(), np.array([True, False])
    plain, rising = discretise(system), add_slopes(discretise(system), linear)
    assert add_slopes(plain, ~linear & linear) is plain
    u, none = np.column_stack([FORCE, COMMAND]), np.zeros(2, dtype=bool)
    p, h = parameter_vector(system.parameters, system.parameters), np.append(np.diff(T), 0.0)
    held = Rollout(plain.pieces).run([[0.1]], u[None], p, T[None], h[None], substeps=5).y
    own = append_slopes(T, u, linear, none)[None]
    same = Rollout(rising.pieces).run([[0.1]], own, p, T[None], h[None], substeps=5).y
    np.testing.assert_allclose(same, held, rtol=1e-13)
    np.testing.assert_array_equal(append_slopes(T, u, none, none), u)


def test_slopes_are_those_of_the_linear_columns() -> None:
    found = slopes(T, np.column_stack([FORCE, COMMAND]), np.array([True, False]))
    np.testing.assert_allclose(found[:-1, 0], np.diff(FORCE) / np.diff(T))
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
