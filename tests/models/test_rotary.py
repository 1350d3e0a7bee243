"""A servo with an encoder and a torque: identified from its counts, and its speed loop tuned."""

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.excitation import DEFAULT_WIDTH, LoggedMotion
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.requirements import Overshoot, PeakControl, SettlingTime
from pneuopt.files.drive import read_drive
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.friction import Coulomb, LuGre, PressureDependent
from pneuopt.models.load_dependent import LoadDependent
from pneuopt.models.rotary import RotaryDrive
from pneuopt.quantities.errors import LogError, ModelError
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import tune

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
    needs = RotaryDrive().system().excitation.needs
    viscous, inertia = (needs[n].lack(slow) for n in ("friction.viscous", "load.inertia"))
    assert viscous is not None
    assert viscous.remedy == "log speeds from 10 to beyond 60 rad/s"
    assert inertia is not None
    assert inertia.reason == "inertia takes 5e-07 N*m (rms), nothing beside 0.3 N*m of friction"


def test_a_friction_that_needs_pressures_is_refused() -> None:
    with pytest.raises(ModelError, match="needs pressure_a, pressure_b, which a rotary axis lacks"):
        RotaryDrive(PressureDependent(Coulomb()))


def test_the_torque_is_the_load_of_load_dependent_friction() -> None:
    drive = RotaryDrive(LoadDependent(Coulomb()))
    truth = {**TRUTH, "friction.coulomb_load": 0.1, "friction.load_rounding": 0.02}
    parameters = drive.parameters.with_values(truth)
    assert parameters["friction.load_rounding"].unit == "N*m"
    t = np.arange(2000) * 1e-3
    torque = 0.9 * np.sin(2 * np.pi * 1.5 * t) + 0.6 * np.sin(2 * np.pi * 4.3 * t)
    run = simulate(
        drive.system(), Trajectory(t, {"torque": torque}), parameters, intersample={"torque": Intersample.LINEAR}
    )
    noise = 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    log = Experiment(Trajectory(t, {"torque": torque, "angle": run["angle"] + noise}))
    known = drive.parameters.with_values({"load.inertia": 2e-3, "friction.load_rounding": 0.02})
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


def test_the_width_of_its_friction_is_chosen_in_the_axis_units() -> None:
    system = RotaryDrive().system()
    assert [(w.name, system.parameters[w.name].unit) for w in system.excitation.widths] == [
        ("friction.smoothing", "rad/s")
    ]
    assert system.parameters["friction.smoothing"].source == DEFAULT_WIDTH


def test_friction_laws_are_those_of_sliding_in_units_of_turning() -> None:
    units = {n: p.unit for n, p in RotaryDrive(LuGre()).parameters.items()}
    assert units["friction.stribeck_velocity"] == "rad/s"
    assert units["friction.bristle_stiffness"] == "N*m/rad"
    assert units["friction.bristle_damping"] == "N*m*s/rad"
    assert RotaryDrive(LuGre()).system().states[-1].unit == "rad"
