"""A servo with an encoder and a torque: identified from its counts, and its speed loop tuned.

Rest and steady motion of drives that a known force or torque pushes.
"""

import math

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.hooks import DEFAULT_WIDTH, LoggedMotion
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.evaluation.dither import dither_effect
from pneuopt.evaluation.requirements import Overshoot, PeakControl, SettlingTime
from pneuopt.files.drive import read_drive
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive, MotionDrive, RotaryDrive
from pneuopt.models.friction import (
    Asymmetric,
    Coulomb,
    FrictionModel,
    LoadDependent,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.models.load import Load
from pneuopt.quantities.errors import ConvergenceError, LogError
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import tune

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


COUNTS = 8192  # a revolution
TRUTH = {"load.inertia": 2e-3, "friction.coulomb": 0.15, "friction.viscous": 4e-3}
SERVO = """[drive]
kind = "rotary"
[load]
inertia = { value = "10 kg*cm^2", free = true }
[friction]
model = "coulomb"
coulomb = { value = "300 N*mm", free = true }
viscous = { value = "1 N*mm*s/rad", free = true }
smoothing = "1 rpm"
"""
SIDECAR = f"""[columns]
time = "t [ms]"
torque = "torque [N*mm]"
angle = {{ column = "encoder", unit = "count", scale = "{COUNTS} count/rev" }}
"""


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> tuple[RotaryDrive, IdentificationResult]:
    folder = tmp_path_factory.mktemp("servo")
    (folder / "drive.toml").write_text(SERVO, encoding="utf-8")
    (folder / "run.toml").write_text(SIDECAR, encoding="utf-8")
    drive, given = read_drive(folder / "drive.toml")
    assert isinstance(drive, RotaryDrive)
    t = np.arange(2000) * 1e-3
    torque = 0.5 * np.sin(2 * np.pi * 1.5 * t) + 0.25 * np.sin(2 * np.pi * 4.3 * t)
    run = simulate(
        drive.system(),
        Trajectory(t, {"torque": torque}),
        given.with_values(TRUTH),
        intersample={"torque": Intersample.LINEAR},
    )
    counts = np.floor(run["angle"] / (2 * np.pi) * COUNTS + 0.5)
    rows = "\n".join(f"{1e3 * s:.9g},{1e3 * m:.9g},{n:.0f}" for s, m, n in zip(t, torque, counts, strict=True))
    (folder / "run.csv").write_text(f"t [ms],torque [N*mm],encoder\n{rows}\n", encoding="utf-8")
    log = read_log(folder / "run.csv", plant=drive.system())
    return drive, identify(drive.system(), [log], given)


def test_encoder_counts_and_torque_give_inertia_and_friction(servo: tuple[RotaryDrive, IdentificationResult]) -> None:
    _, fit = servo
    assert fit.status.converged
    for name, value in TRUTH.items():
        row = fit.estimates.loc[name]
        assert row["ci_low"] <= value <= row["ci_high"]
        assert row["value"] == pytest.approx(value, rel=0.01)
    assert fit.estimates["unit"].to_dict() == dict(zip(TRUTH, ("kg*m^2", "N*m", "N*m*s/rad"), strict=True))


def test_its_speed_loop_is_tuned_in_radians_per_second(servo: tuple[RotaryDrive, IdentificationResult]) -> None:
    drive, fit = servo
    loop = ClosedLoop(drive.system(), PID(sample_time=2e-3, limits=False))
    assert [loop.parameters[n].unit for n in ("pid.Kp", "pid.Ki")] == ["N*m*s/rad", "N*m/rad"]
    bounds = {"pid.Kp": (1e-3, 1.0), "pid.Ki": (1e-2, 10.0)}
    known = loop.parameters | fit.parameters.fixed(*fit.parameters.free_names)
    parameters = known.with_values({"pid.Kp": 0.05, "pid.Ki": 0.5}).with_bounds(bounds)
    limits = [Overshoot(max=0.05), PeakControl(max=5.0)]
    free = parameters.freed("pid.Kp", "pid.Ki")
    best = tune(loop, [Step(50.0, horizon=0.4)], free, minimise=SettlingTime(), subject_to=limits, plants={})
    assert best.status.converged
    peak, settled = (best.certified.loc[n].iloc[0] for n in ("PeakControl", "SettlingTime"))
    assert peak <= 5.0
    # A step of 50 rad/s that takes 5 N*m has Kp = 0.1 N*m*s/rad, with which 2e-3 kg*m^2 are 2 % off after 4 J/Kp.
    assert settled < 4 * 2e-3 / 0.1


def test_advice_speaks_in_the_axis_units() -> None:
    given = RotaryDrive().parameters
    slow = LoggedMotion(10.0, 12.0, 0.5, 9, 1e-3, np.array([10.0, 12.0]), given, given)
    needs = RotaryDrive().system().identification_hints.needs
    viscous, inertia = (needs[n].lack(slow) for n in ("friction.viscous", "load.inertia"))
    assert viscous is not None
    assert viscous.remedy == "log speeds from 10 to beyond 60 rad/s"
    assert inertia is not None
    assert inertia.reason == "inertia takes 5e-07 N*m (rms), nothing beside 0.3 N*m of friction"


def test_the_torque_is_the_load_of_load_dependent_friction() -> None:
    drive = RotaryDrive(LoadDependent(Coulomb()))
    truth = {**TRUTH, "friction.coulomb_load": 0.1}
    parameters = drive.parameters.with_values(truth)
    t = np.arange(2000) * 1e-3
    torque = 0.9 * np.sin(2 * np.pi * 1.5 * t) + 0.6 * np.sin(2 * np.pi * 4.3 * t)
    run = simulate(
        drive.system(), Trajectory(t, {"torque": torque}), parameters, intersample={"torque": Intersample.LINEAR}
    )
    noise = 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"torque": torque, "angle": run["angle"] + noise}))
    known = drive.parameters.with_values({"load.inertia": 2e-3})
    fit = identify(drive.system(), [log], known.freed("friction.coulomb", "friction.viscous", "friction.coulomb_load"))
    for name in ("friction.coulomb", "friction.coulomb_load"):
        assert fit.parameters.value(name) == pytest.approx(truth[name], rel=0.05)


def test_the_log_of_a_shaft_is_checked_in_its_own_channels(servo: tuple[RotaryDrive, IdentificationResult]) -> None:
    drive, fit = servo
    run = next(iter(fit.trajectories.values()))
    torque = 0.5 * np.sin(2 * np.pi * 1.5 * run.t) + 0.25 * np.sin(2 * np.pi * 4.3 * run.t)
    turned = Experiment(Trajectory(run.t, {"torque": -torque, "angle": run["angle"], "speed": run["speed"]}))
    with pytest.raises(LogError, match=r"the torque brakes the motion on balance .* change the sign of 'torque'"):
        identify(drive.system(), [turned], fit.parameters)
    against = Experiment(Trajectory(run.t, {"torque": torque, "angle": -run["angle"], "speed": run["speed"]}))
    with pytest.raises(
        LogError,
        match=r"angle and speed run against each other \(at .* angle changes by .*\): change the sign of one",
    ):
        identify(drive.system(), [against], fit.parameters)


def test_the_width_of_its_friction_is_estimated_in_the_axis_units() -> None:
    system = RotaryDrive().system()
    assert [(w.name, system.parameters[w.name].unit) for w in system.identification_hints.widths] == [
        ("friction.smoothing", "rad/s")
    ]
    assert system.parameters["friction.smoothing"].source == DEFAULT_WIDTH


def test_friction_laws_are_those_of_sliding_in_units_of_turning() -> None:
    units = {n: p.unit for n, p in RotaryDrive(LuGre()).parameters.items()}
    assert units["friction.stribeck_velocity"] == "rad/s"
    assert units["friction.bristle_stiffness"] == "N*m/rad"
    assert units["friction.bristle_damping"] == "N*m*s/rad"
    assert RotaryDrive(LuGre()).system().states[-1].unit == "rad"


LAWS = [Viscous(), Coulomb(), Asymmetric(Stribeck()), LuGre(), LoadDependent(Stribeck()), LoadDependent(LuGre())]
LOADS = {"load.force": 12.0, "load.torque": 0.1, "friction.coulomb_load": 0.2, "friction.asymmetry": 0.1}


def loaded(system: System) -> tuple[System, np.ndarray]:
    given = system.parameters.with_values({n: v for n, v in LOADS.items() if n in system.parameters})
    return system, parameter_vector(system.parameters, given)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: repr(law).replace("()", ""))
@pytest.mark.parametrize("drive", [ForceDrive, RotaryDrive])
@pytest.mark.parametrize("speed", [0.0, 0.04, -0.3])
def test_the_rest_keeps_its_speed_when_it_is_integrated(
    drive: type[ForceDrive | RotaryDrive], law: FrictionModel, speed: float
) -> None:
    system, p = loaded(drive(law).system())
    assert system.rest_hook is not None
    rest = system.rest_hook(
        system.parameters.with_values(dict(zip(system.parameters, p, strict=True))), {"speed": speed}
    )
    x, u = [rest.states[n] for n in names(system.states)], [rest.inputs[n] for n in names(system.inputs)]

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(system.ode(t, x, u, p)[0]).ravel()

    run = solve_ivp(rate, (0.0, 0.2), x, method="LSODA", rtol=1e-9, atol=1e-12)
    kept = run.y[names(system.states).index("speed")]
    np.testing.assert_allclose(kept, speed, atol=1e-7)
    assert run.y[0, -1] == pytest.approx(0.2 * speed, abs=1e-6)


def test_a_spring_holds_still_where_it_is_and_lets_no_motion_be_steady() -> None:
    system = ForceDrive(Viscous(), Load(spring=True)).system()
    p = system.parameters.with_values({"load.stiffness": 100.0})
    assert system.rest_hook is not None
    assert system.rest_hook(p, {"position": 0.2}).inputs == {"force": pytest.approx(20.0)}
    with pytest.raises(ConvergenceError):
        system.rest_hook(p, {"speed": 0.1})


@pytest.mark.parametrize("drive", [ForceDrive(Stribeck()), RotaryDrive(Stribeck())], ids=["force", "rotary"])
def test_a_dither_swings_the_moving_body_not_the_standing_one(drive: ForceDrive | RotaryDrive) -> None:
    """By harmonic balance as by integrating Newton's law under the dithered push."""
    plant = drive.system()
    loop = ClosedLoop(plant, PID(), Dither(100.0))
    amplitude, speed = (10.0, 0.25) if isinstance(drive, ForceDrive) else (0.1, 10.0)
    p = loop.parameters.with_values({"dither.amplitude": amplitude})
    found = dither_effect(loop, Step(speed), p)
    assert plant.rest_hook is not None
    (push,), values = plant.rest_hook(p, {"speed": speed}).inputs.values(), parameter_vector(plant.parameters, p)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(plant.ode(t, x, [push + amplitude * np.sin(200 * np.pi * t)], values)[0]).ravel()

    last = np.linspace(0.99, 1.0, 201)
    run = solve_ivp(rate, (0.0, 1.0), [0.0, speed], t_eval=last, rtol=1e-8, atol=1e-10, max_step=1e-3)
    assert found.speed == pytest.approx(np.ptp(run.y[1]) / 2, rel=0.01)
    assert found.travel == pytest.approx(found.speed / (200 * np.pi))
