import math

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, parameter_vector
from pneuopt.models.drive import ForceDrive, MotionDrive
from pneuopt.models.friction import Asymmetric, Coulomb, LuGre, PressureDependent, Stribeck, Viscous
from pneuopt.models.load import Load
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

DRIVES: dict[str, System] = {
    "coulomb": ForceDrive(Coulomb()).system(),
    "spring": ForceDrive(Viscous(), Load(spring=True)).system(),
    "lugre": ForceDrive(LuGre()).system(),
    "pressure": ForceDrive(PressureDependent(Asymmetric(Stribeck()))).system(),
    "motion": MotionDrive(PressureDependent(Coulomb(), ("pressure_a",))).system(),
    "motion lugre": MotionDrive(LuGre(), chamber=False).system(),
}


@pytest.mark.parametrize("name", DRIVES)
def test_derivatives_are_the_central_differences(name: str) -> None:
    system, rng = DRIVES[name], np.random.default_rng(1)
    sizes = [system.ode.size1_in(i) for i in range(4)]
    symbols = [ca.SX.sym(f"i{i}", n) for i, n in enumerate(sizes)]
    jacobian = ca.Function("J", symbols, [ca.jacobian(ca.vertcat(*system.ode(*symbols)), ca.vertcat(*symbols[1:]))])
    p = parameter_vector(system.parameters, system.parameters)
    nominal = [np.array([q.nominal for q in group]) for group in (system.states, system.inputs)]
    for _ in range(4):
        x, u = (0.3 * n * rng.standard_normal(len(n)) for n in nominal)
        scale = np.concatenate([*nominal, np.maximum(np.abs(p), 1e-3)])
        exact, point = np.array(jacobian(0, x, u, p)), np.concatenate([x, u, p])
        for column, step in enumerate(1e-6 * scale):
            shift = step * (np.arange(len(point)) == column)
            high, low = (
                np.concatenate([np.array(o).ravel() for o in system.ode(0, *np.split(w, np.cumsum(sizes[1:3])))])
                for w in (point + shift, point - shift)
            )
            rounding = 1e-15 * np.abs(high).max() / step
            assert_allclose(exact[:, column], (high - low) / (2 * step), rtol=1e-4, atol=rounding + 1e-9)


def constant(force: float, seconds: float, n: int = 200) -> Trajectory:
    return Trajectory(np.linspace(0, seconds, n), {"force": np.full(n, force)})


def ramp(force: float) -> Trajectory:
    """A force that grows within 2 s, slowly enough that the mass does not swing, and stays for 2 s more."""
    t = np.linspace(0, 4, 4001)
    return Trajectory(t, {"force": force * np.minimum(t / 2, 1)})


def with_values(system: System, **values: float) -> ParameterSet:
    return system.parameters.with_values({k.replace("__", "."): v for k, v in values.items()})


def test_names_units_and_wiring() -> None:
    drive = ForceDrive(PressureDependent(LuGre()))
    text = repr(drive.system())
    assert "states: position [m], speed [m/s], friction.bristle [m]" in text
    assert "inputs: force [N], pressure_a [Pa(a)], pressure_b [Pa(a)]" in text
    assert "ambient.pressure" in text
    assert tuple(drive.parameters) == tuple(drive.system().parameters)
    assert "ambient.pressure" not in ForceDrive(Coulomb()).parameters


def test_newtons_law() -> None:
    system = DRIVES["spring"]
    p = with_values(
        system, load__mass=2.0, load__force=3.0, load__stiffness=100.0, load__rest_position=0.1, friction__viscous=5.0
    )
    xdot, y = system.ode(0, [0.3, 0.4], [50.0], parameter_vector(system.parameters, p))
    assert np.array(xdot).ravel().tolist() == pytest.approx([0.4, (50 - 3 - 100 * 0.2 - 5 * 0.4) / 2])
    assert np.array(y).ravel().tolist() == pytest.approx([0.3, 0.4])


def test_the_work_of_the_force_is_stored_or_dissipated() -> None:
    system = DRIVES["spring"]
    p = with_values(
        system, load__mass=2.0, load__stiffness=300.0, load__rest_position=0.02, friction__viscous=4.0, load__force=1.0
    )
    t = np.linspace(0, 2, 4001)
    run = simulate(system, Trajectory(t, {"force": np.full_like(t, 10.0)}), p)
    y, v = run["position"], run["speed"]
    stored = v**2 + 150 * (y - 0.02) ** 2
    lost = np.concatenate([[0], np.cumsum((v[1:] ** 2 + v[:-1] ** 2) / 2 * np.diff(t))]) * 4.0
    assert_allclose(stored - stored[0] + lost, (10 - 1) * y, atol=1e-5)


def test_tanh_friction_creeps_under_a_load() -> None:
    system = DRIVES["coulomb"]
    p = with_values(system, friction__coulomb=40.0, friction__viscous=0.0, friction__smoothing=1e-3, load__mass=1.0)
    run = simulate(system, constant(30.0, 0.5), p)
    assert run["speed"][-1] == pytest.approx(1e-3 * math.atanh(30 / 40), rel=1e-6)


def test_lugre_holds_a_load_below_its_static_level_and_lets_go_above() -> None:
    system = DRIVES["lugre"]
    p = with_values(system, friction__coulomb=40.0, friction__static=60.0, load__mass=1.0)
    held = simulate(system, ramp(50.0), p)
    # dz/dy = 1 - sigma_0 z / F_s on the way there
    presliding = -60 / p.value("friction.bristle_stiffness") * math.log(1 - 50 / 60)
    assert held["position"][-1] == pytest.approx(presliding, rel=0.02)
    assert abs(held["position"][-1] - held["position"][2100]) < 1e-5  # 1.9 s later
    assert simulate(system, ramp(62.0), p)["position"][-1] > 0.1


def test_lugre_slides_at_the_speed_of_its_curve() -> None:
    system = DRIVES["lugre"]
    p = with_values(system, friction__coulomb=40.0, friction__static=60.0, friction__viscous=100.0, load__mass=1.0)
    assert simulate(system, constant(90.0, 2.0), p)["speed"][-1] == pytest.approx(0.5, rel=1e-6)


def test_gauge_pressure_is_what_raises_friction() -> None:
    system = DRIVES["pressure"]
    p = with_values(system, friction__coulomb_pressure_a=2e-5, ambient__pressure=1e5)
    x = [0.0, 0.5]
    at_ambient, above = (
        np.array(system.ode(0, x, [0.0, pa, 1e5], parameter_vector(system.parameters, p))[0]).ravel()[1]
        for pa in (1e5, 5e5)
    )
    assert at_ambient - above == pytest.approx(2e-5 * 4e5 / p.value("load.mass"))


def test_a_rig_measures_pressure_force_friction_and_offset() -> None:
    system = DRIVES["motion"]
    p = with_values(
        system, rig__area=5e-4, rig__area_bias=0.01, rig__force_offset=2.0, ambient__pressure=1e5,
        friction__coulomb=4.0, friction__viscous=10.0, friction__coulomb_pressure_a=1e-5,
    )  # fmt: skip
    y = float(system.ode(0, [], [0.1, 4e5], parameter_vector(system.parameters, p))[1])
    assert y == pytest.approx(5e-4 * 1.01 * 3e5 + (4 + 3 + 1) + 2)
    assert system.states == ()


def test_a_rig_without_a_chamber_has_no_pressure() -> None:
    system = MotionDrive(Coulomb(), chamber=False).system()
    assert [q.name for q in system.inputs] == ["speed"]
    assert not {"rig.area", "ambient.pressure"}.intersection(system.parameters)
    assert [q.name for q in MotionDrive(Coulomb()).system().inputs] == ["speed", "pressure_a"]
    with_b = MotionDrive(PressureDependent(Coulomb(), ("pressure_b",)))
    assert [q.name for q in with_b.system().inputs] == ["speed", "pressure_a", "pressure_b"]


def test_linearised_it_is_a_mass_on_a_damper() -> None:
    system = DRIVES["coulomb"]
    p = with_values(system, load__mass=4.0, friction__viscous=8.0, friction__coulomb=0.0)
    lin = system.linearise(np.array([0.2, 0.3]), {"force": 1.0}, p)
    assert_allclose(lin.A, [[0.0, 1.0], [0.0, -2.0]])
    assert_allclose(lin.B, [[0.0], [0.25]])
    x = DRIVES["spring"].equilibrium({"force": 20.0}, with_values(DRIVES["spring"], load__stiffness=100.0))
    assert x.tolist() == pytest.approx([0.2, 0.0], abs=1e-12)
