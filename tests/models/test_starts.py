from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.dynamics.hooks import Log, Start
from pneuopt.dynamics.system import DiscreteSystem, discretise, names, parameter_vector
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Coulomb, FrictionModel, LuGre, PressureDependent, Stribeck
from pneuopt.models.load import Load
from pneuopt.models.starts import (
    RegressionRows,
    choose_filter_time,
    filter_motion,
    force_misfit,
    load_columns,
)
from pneuopt.models.tolerances import FILTER_TIMES
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {
    "load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0, "friction.static": 42.0,
    "friction.stribeck_velocity": 0.025, "friction.bristle_stiffness": 6e4,
}  # fmt: skip


def true_values(parameters: ParameterSet, **others: float) -> ParameterSet:
    own = {n: v for n, v in TRUTH.items() if n in parameters}
    return parameters.with_values({**own, **{n.replace("__", "."): v for n, v in others.items()}})


def compute(system: DiscreteSystem, u: Array, p: Array, t: Array) -> dict[str, Array]:
    """From rest, by 40 steps of RK4 a sample."""
    h, start = np.full((1, len(t)), t[1] - t[0]), np.zeros((1, len(system.states)))
    y = Rollout(Pieces(system.step)).run(start, u[None], p, t[None], h, substeps=40).y[0]
    return dict(zip(names(system.outputs), y.T, strict=True))


def logged(drive: ForceDrive, truth: ParameterSet, *channels: str, seed: int = 0) -> Trajectory:
    """2 s at 1 kHz of a drive that slides, sticks and turns; 10 um and 1 mm/s of noise."""
    rng, t = np.random.default_rng(seed), np.linspace(0, 2, 2000, endpoint=False)
    force = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t + seed)
    system = drive.system()
    run = compute(discretise(system), force[:, None], parameter_vector(system.parameters, truth), t)
    noise = {"position": 1e-5, "speed": 1e-3}
    return Trajectory(t, {"force": force, **{c: run[c] + noise[c] * rng.standard_normal(len(t)) for c in channels}})


def starts(drive: ForceDrive | MotionDrive, logs: dict[str, Trajectory], parameters: ParameterSet) -> list[Start]:
    return list(drive.system().starts({n: Log(log, parameters) for n, log in logs.items()}))


@pytest.mark.parametrize("channels", [("position",), ("speed",), ("position", "speed")])
@pytest.mark.parametrize("friction", [Coulomb(), Stribeck(), LuGre()])
def test_equation_error_comes_near_without_a_guess(friction: FrictionModel, channels: tuple[str, ...]) -> None:
    drive = ForceDrive(friction)
    log = logged(drive, true_values(drive.parameters), *channels)
    free = [n for n in TRUTH if n in drive.parameters]
    found = starts(drive, {"run": log}, drive.parameters.freed(*free))
    assert len(found) == (1 if isinstance(friction, Coulomb) else 6)
    values = found[0].parameters
    assert set(values) == set(free)
    near = 0.3 if isinstance(friction, LuGre) else 0.15  # bristles smear the reversals that tell Coulomb's level
    for name in ("load.mass", "friction.coulomb", "friction.viscous"):
        assert values[name] == pytest.approx(TRUTH[name], rel=near), name
    if isinstance(friction, LuGre):
        assert values["friction.bristle_stiffness"] == pytest.approx(6e4, rel=0.6)
        assert "friction.bristle" in found[0].states["run"]


def test_each_stribeck_velocity_is_a_candidate_within_the_bounds() -> None:
    drive = ForceDrive(Stribeck())
    log = logged(drive, true_values(drive.parameters), "position")
    bounds = {"friction.stribeck_velocity": (0.01, 0.03)}
    free = drive.parameters.with_bounds(bounds).freed("friction.stribeck_velocity", "friction.static")
    tried = [s.parameters["friction.stribeck_velocity"] for s in starts(drive, {"run": log}, free)]
    assert tried == [0.025, 0.012, 0.03, 0.01]


def test_only_free_parameters_are_given() -> None:
    drive = ForceDrive(Coulomb())
    truth = true_values(drive.parameters)
    (start,) = starts(drive, {"run": logged(drive, truth, "position")}, truth.freed("friction.coulomb"))
    assert list(start.parameters) == ["friction.coulomb"]
    assert start.parameters["friction.coulomb"] == pytest.approx(30, rel=0.1)
    (start,) = starts(drive, {"run": logged(drive, truth, "position")}, truth)
    assert start.parameters == {}
    assert start.states["run"].names == ("position", "speed")


def test_a_known_static_level_leaves_coulombs_level_alone() -> None:
    drive = ForceDrive(Stribeck())
    truth = true_values(drive.parameters, friction__stribeck_velocity=0.2)
    (start,) = starts(drive, {"run": logged(drive, truth, "position")}, truth.freed("friction.coulomb"))
    assert start.parameters["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_a_spring_is_told_from_friction() -> None:
    drive = ForceDrive(Coulomb(), Load(spring=True))
    truth = true_values(drive.parameters, load__stiffness=400.0, load__rest_position=0.01)
    (start,) = starts(
        drive, {"run": logged(drive, truth, "position")}, truth.freed("load.stiffness", "friction.coulomb")
    )
    assert start.parameters["load.stiffness"] == pytest.approx(400, rel=0.05)
    assert start.parameters["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_logs_share_what_is_shared_and_keep_what_is_their_own() -> None:
    drive = ForceDrive(Stribeck())
    parameters = drive.parameters.freed(
        "friction.coulomb", "friction.static", "load.force", "friction.stribeck_velocity"
    )
    parameters = parameters.per_log("load.force", "friction.static", "friction.stribeck_velocity")
    logs = {
        n: logged(drive, true_values(drive.parameters, load__force=force), "position", seed=k)
        for k, (n, force) in enumerate({"a": 5.0, "b": -8.0}.items())
    }
    values = starts(drive, logs, true_values(parameters))[0].parameters
    assert values["load.force[a]"] == pytest.approx(5, abs=1.5)
    assert values["load.force[b]"] == pytest.approx(-8, abs=1.5)
    assert values["friction.coulomb"] == pytest.approx(30, rel=0.1)
    for log in "ab":
        assert values[f"friction.static[{log}]"] > values["friction.coulomb"]
        assert values[f"friction.stribeck_velocity[{log}]"] == 0.025


def test_missing_samples_do_no_harm() -> None:
    drive = ForceDrive(Coulomb())
    truth = true_values(drive.parameters)
    log = logged(drive, truth, "position")
    holed = log["position"].copy()
    holed[np.random.default_rng(0).random(len(holed)) < 0.1] = np.nan
    (start,) = starts(
        drive, {"run": log.with_columns({"position": holed})}, truth.freed("friction.*oulomb", "load.mass")
    )
    assert start.parameters["friction.coulomb"] == pytest.approx(30, rel=0.1)
    assert np.isfinite(start.states["run"]["speed"]).all()


def test_a_rigs_levels_are_linear_in_pressure() -> None:
    rig = MotionDrive(PressureDependent(Coulomb(), ("pressure_a",)))
    t, rng = np.linspace(0, 10, 1000, endpoint=False), np.random.default_rng(2)
    truth = {"friction.coulomb": 4.0, "friction.coulomb_pressure_a": 1.5e-5, "friction.viscous": 0.0}
    p = rig.parameters.with_values({**truth, "rig.force_offset": 2.0})
    logs = {}
    for name, pressure in {"low": 2e5, "high": 6e5}.items():
        inputs = {"speed": 0.01 * np.sign(np.sin(t)), "pressure_a": np.full_like(t, pressure)}
        u, system = np.column_stack(list(inputs.values())), discretise(rig.system())
        force = compute(system, u, parameter_vector(system.parameters, p), t)["force"] + 0.2 * rng.standard_normal(
            len(t)
        )
        logs[name] = Trajectory(t, {**inputs, "force": np.where(rng.random(len(t)) < 0.05, np.nan, force)})
    free = p.freed("friction.coulomb", "friction.coulomb_pressure_a", "rig.force_offset").per_log("rig.force_offset")
    (start,) = starts(rig, logs, free)
    assert start.parameters["friction.coulomb"] == pytest.approx(4, abs=0.1)
    assert start.parameters["friction.coulomb_pressure_a"] == pytest.approx(1.5e-5, rel=0.05)
    assert start.parameters["rig.force_offset[high]"] == pytest.approx(2, abs=0.1)


def test_motion_is_filtered_from_position_or_speed() -> None:
    t = np.arange(500) * 1e-3
    y, v, a = np.sin(10 * t), 10 * np.cos(10 * t), -100 * np.sin(10 * t)
    for channels in ({"position": y}, {"position": y, "speed": v}, {"speed": v}):
        position, speed, acceleration = filter_motion(Trajectory(t, channels))
        assert position == pytest.approx(y, abs=2e-3)
        assert speed == pytest.approx(v, abs=2e-2)
        assert acceleration[20:-20] == pytest.approx(a[20:-20], abs=1)


def test_a_short_log_takes_a_shorter_filter() -> None:
    position, speed, _ = filter_motion(Trajectory(np.arange(6) * 1e-3, {"position": np.arange(6) * 1e-3}))
    assert speed == pytest.approx(np.ones(6))
    assert position == pytest.approx(np.arange(6) * 1e-3)


def test_an_incline_adds_weight_to_the_mass() -> None:
    columns = load_columns(ForceDrive(Coulomb(), Load(inclined=True)).parameters, np.zeros(3), np.ones(3))
    assert columns["load.mass"] == pytest.approx(1 + 9.80665)
    assert set(columns) == {"load.mass", "load.force"}


def test_the_misfit_is_what_no_friction_explains() -> None:
    t = np.arange(4000) * 1e-3
    speed, wrong = 0.1 * np.sin(7 * t), 20 * np.cos(31 * t)
    drive = ForceDrive(Coulomb())
    given = drive.parameters.freed("friction.coulomb", "friction.viscous")
    columns = load_columns(given, np.zeros(4000), 0.7 * np.cos(7 * t))
    right = 33 * np.tanh(speed / 1e-3) + 50 * speed + given.value("load.mass") * columns["load.mass"]
    rows = RegressionRows(Trajectory(t, {"speed": speed}), given, speed, right, columns, {})
    assert force_misfit(Coulomb(), {"run": rows}) < 1.0
    assert force_misfit(Coulomb(), {"run": replace(rows, force=right + wrong)}) == pytest.approx(
        np.mean(np.abs(wrong)), rel=0.1
    )
    assert force_misfit(Coulomb(), {"run": replace(rows, force=np.full(4000, np.nan))}) == np.inf


def test_static_friction_shows_where_the_drive_gives_way() -> None:
    # a slip is over before filtered samples of Stribeck's range are many: the slow samples tell its level
    drive, t = ForceDrive(Stribeck()), np.linspace(0, 3, 3000, endpoint=False)
    truth = true_values(drive.parameters, friction__static=60.0, friction__stribeck_velocity=0.005, load__force=0.0)
    force = 70 * np.sin(2 * np.pi * t)
    system = drive.system()
    run = compute(discretise(system), force[:, None], parameter_vector(system.parameters, truth), t)
    free = truth.freed("friction.coulomb", "friction.static", "friction.viscous", "friction.stribeck_velocity")
    log = Trajectory(t, {"force": force, "position": run["position"]})
    found = {s.parameters["friction.stribeck_velocity"]: s.parameters for s in starts(drive, {"run": log}, free)}
    assert found[0.006]["friction.static"] == pytest.approx(60, rel=0.15)
    assert found[0.006]["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_bending_bristles_do_not_pass_for_sliding() -> None:
    drive, t = ForceDrive(LuGre()), np.linspace(0, 4, 4000, endpoint=False)
    truth = true_values(drive.parameters, load__force=0.0)
    force = np.where(t > 3, 55.0, 28.0) * np.sin(2 * np.pi * 2 * t)  # mostly presliding, and not slowly
    system = drive.system()
    run = compute(discretise(system), force[:, None], parameter_vector(system.parameters, truth), t)
    log = Trajectory(t, {"force": force, "position": run["position"]})
    free = truth.freed(
        "friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.bristle_stiffness"
    )
    values = starts(drive, {"run": log}, free)[0].parameters
    assert values["friction.coulomb"] == pytest.approx(30, rel=0.1)
    assert values["friction.bristle_stiffness"] == pytest.approx(6e4, rel=0.2)


def slipping(duration: float, mass: float, noise: float) -> Trajectory:
    """4 s at 1 kHz of a load that slips every tenth of a second, the way it goes by turns, by 30 N; its exact force."""
    t = np.arange(4000) * 1e-3
    since, way = t % 0.1, np.where(t % 2 < 1, 1.0, -1.0)
    slips = since < duration
    phase = np.pi * np.where(slips, since / duration, 0.0)
    position = np.cumsum(way * 0.4 * np.sin(phase) ** 2) * 1e-3
    friction = way * np.where(slips, 30.0, 27.0)
    force = friction + way * mass * 0.4 * np.pi / duration * np.sin(2 * phase)
    noisy = position + noise * np.random.default_rng(0).standard_normal(4000)
    return Trajectory(t, {"force": force, "position": noisy})


@pytest.mark.parametrize(
    ("duration", "mass", "noise", "is_shorter"), [(0.03, 0.2, 2e-6, True), (0.08, 3.0, 5e-5, False)]
)
def test_short_slips_take_a_shorter_filter(duration: float, mass: float, noise: float, is_shorter: bool) -> None:
    """A window that is longer than a slip turns the speed round before and after it, where friction does not."""
    drive, log = ForceDrive(Coulomb()), slipping(duration, mass, noise)
    given = true_values(drive.parameters, load__mass=mass, load__force=0.0)
    given = given.freed("friction.coulomb", "friction.viscous")

    def balances(window: float) -> dict[str, RegressionRows]:
        position, speed, acceleration = filter_motion(log, window)
        columns = load_columns(given, position, acceleration)
        return {"run": RegressionRows(log, given, speed, log["force"], columns, {})}

    assert (choose_filter_time(Coulomb(), balances) < FILTER_TIMES[0]) == is_shorter
    (start,) = starts(drive, {"run": log}, given)
    assert start.parameters["friction.coulomb"] == pytest.approx(30, rel=0.1)


def test_where_nothing_slides_friction_holds_what_pulls() -> None:
    """Bristles that only bend show a spring; a start from them alone had a fortieth of the friction."""
    drive = ForceDrive(LuGre())
    t, truth = np.linspace(0, 4, 4000, endpoint=False), true_values(drive.parameters, load__force=0.0)
    pull, system = np.asarray(27 * np.sin(2 * np.pi * 0.7 * t)), drive.system()
    run = compute(discretise(system), pull[:, None], parameter_vector(system.parameters, truth), t)
    noisy = run["position"] + 5e-6 * np.random.default_rng(0).standard_normal(len(t))
    free = truth.freed("friction.coulomb", "friction.static", "friction.viscous", "friction.bristle_stiffness")
    (start,) = starts(drive, {"run": Trajectory(t, {"force": pull, "position": noisy})}, free)
    for name in ("friction.coulomb", "friction.static"):
        assert 24 < start.parameters[name] < 36, name
