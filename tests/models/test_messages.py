"""What is said of plants and logs that cannot be: what triggers each message, and its words."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.system import System
from pneuopt.files.drive import read_drive
from pneuopt.models.drives import ForceDrive, RotaryDrive
from pneuopt.models.friction import Coulomb, PressureDependent, Viscous
from pneuopt.models.linear import FirstOrder, SecondOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.sensing import with_sensors
from pneuopt.models.starts import filter_motion
from pneuopt.quantities.errors import (
    ConvergenceError,
    HardwareError,
    InputError,
    LogError,
    ModelError,
    PneuoptError,
    UnknownNameError,
)
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory

PLAIN, SPRUNG = PneumaticDrive(), PneumaticDrive(load=Load(spring=True))
BODY = ForceDrive(Viscous(), Load(spring=True))
STILL = Trajectory(np.linspace(0.0, 1.0, 101), {"valve_voltage": np.ones(101), "speed": np.zeros(101)})
FREE = FirstOrder().system().parameters.freed("plant.*")


def start_speed_loop(reference: float) -> object:
    loop = ClosedLoop(PLAIN.system(), PID())
    return loop.initial(loop.parameters.with_values({"pid.lower": -0.1, "pid.upper": 0.1}), reference=reference)


def rest(system: System, outputs: dict[str, float], values: dict[str, float]) -> object:
    assert system.rest_hook is not None
    return system.rest_hook(system.parameters.with_values(values), outputs)


REFUSALS: dict[str, tuple[type[PneuoptError], Callable[[], object], str]] = {
    "order of a dead time": (
        ModelError,
        lambda: FirstOrder(pade_order=6).system(),
        "pade_order must be 0 to 5, got 6",
    ),
    "dead time of zero": (
        InputError,
        lambda: FirstOrder(pade_order=1).system().parameters.with_values({"plant.dead_time": 0.0}),
        r"plant.dead_time.*outside its bounds",
    ),
    "pressures in a linear plant": (
        ModelError,
        lambda: SecondOrder(friction=PressureDependent(Coulomb())),
        "PressureDependent needs pressures",
    ),
    "pressures on a shaft": (
        ModelError,
        lambda: RotaryDrive(PressureDependent(Coulomb())),
        "needs pressure_a, pressure_b, which a rotary axis lacks",
    ),
    "pressures without a level": (
        ModelError,
        lambda: PressureDependent(Viscous()),
        r"Viscous.* has no Coulomb level .*; take Coulomb\(\), Stribeck\(\) or LuGre",
    ),
    "input that never changes": (
        LogError,
        lambda: FirstOrder().system().starts({"run": Log(STILL, FREE)}),
        "valve_voltage never changes",
    ),
    "short log": (
        LogError,
        lambda: FirstOrder().system().starts({"run": Log(STILL.rows(0, 10), FREE)}),
        "run: 10 samples of valve_voltage and speed are too few",
    ),
    "log without motion": (
        LogError,
        lambda: filter_motion(Trajectory([0.0, 1.0], {"force": [0.0, 0.0]})),
        "neither 'position' nor 'speed'",
    ),
    "log without a sample": (
        LogError,
        lambda: filter_motion(Trajectory(np.arange(20.0), {"position": np.full(20, np.nan)})),
        "channel 'position' has no samples",
    ),
    "sensor of no output": (
        UnknownNameError,
        lambda: with_sensors(BODY.system(), delay=["positon"]),
        "with_sensors: delay",
    ),
    "motion of a sprung body": (
        ConvergenceError,
        lambda: rest(BODY.system(), {"speed": 0.1}, {"load.stiffness": 100.0}),
        "changes the force that position needs",
    ),
    "start from a torque": (
        InputError,
        lambda: rest(RotaryDrive().system(), {"torque": 0.1}, {}),
        "from angle and speed, not from torque; leave torque out",
    ),
    "start from a valve": (
        InputError,
        lambda: rest(PLAIN.system(), {"valve": 0.1}, {}),
        "starts from position, speed and pressure_b, not from valve",
    ),
    "start beyond the stroke": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters, position=0.3),
        "position = 0.3 m lies outside the stroke, 0 to 0.2 m",
    ),
    "load beyond the supply": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters.with_values({"load.force": 600.0})),
        "no equilibrium exists.*lower the load, raise the supply or the bore",
    ),
    "trapped vacuum": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters, pressure_b=0.0),
        "pressure_b = 0 Pa is no absolute pressure",
    ),
    "vacuum beside trapped air": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters.with_values({"load.force": -400.0}), pressure_b=2e5),
        "chamber a would need",
    ),
    "too fast": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters, speed=4.0),
        "no steady motion at speed = 4 m/s: beyond friction and load .*lower the speed",
    ),
    "motion with trapped air": (
        InputError,
        lambda: PLAIN.rest(PLAIN.parameters, speed=0.1, pressure_b=4e5),
        r"at speed = 0.1 m/s: trapped air \(pressure_b\) holds",
    ),
    "motion against a spring": (
        InputError,
        lambda: SPRUNG.rest(SPRUNG.parameters.with_values({"load.stiffness": 50.0}), speed=0.1),
        "load.stiffness = 50 N/m pulls more the farther it goes",
    ),
    "command beyond its limits": (
        InputError,
        lambda: start_speed_loop(0.5),
        "needs a command of .* V, the limits are -0.1 and 0.1",
    ),
    "force without a spring": (
        InputError,
        lambda: rest(SPRUNG.system(), {"load_force": 100.0}, {}),
        r"load\.stiffness is 0 N/m: without a spring there is no force to control",
    ),
    "force and position": (
        InputError,
        lambda: rest(SPRUNG.system(), {"load_force": 100.0, "position": 0.1}, {"load.stiffness": 1e5}),
        "start from load_force or position, not both",
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_says_what_is_wrong_and_what_to_do(name: str) -> None:
    kind, cause, words = REFUSALS[name]
    with pytest.raises(kind, match=words):
        cause()


@pytest.mark.parametrize(
    ("name", "value", "unit", "words"),
    [
        ("cylinder.rod", 0.04, "m", r"rod = 40 mm \(source: a sketch\) is impossible; a rod is thinner.*32 mm"),
        ("cylinder.dead_volume_a", -1e-6, "m^3", "cylinder.dead_volume_a = -1e-06 m.3.*always hold some air"),
        ("valve.critical_ratio", 1.2, "1", "valve.critical_ratio = 1.2.*between 0 and 1"),
        ("supply.pressure", 9e4, "Pa(a)", r"pressure = 0.9 bar\(a\).*above the ambient pressure, 1.01325 bar\(a\)"),
        ("cylinder.start", 1.5, "1", "cylinder.start = 1.5.*within the stroke"),
        ("cylinder.leak", -1.0, "kg/(s*Pa)", "no leakage is 0"),
        ("chamber.exponent", 0.0, "1", "1 is isothermal, 1.4 adiabatic"),
        ("load.mass", 0.0, "kg", "weighs something"),
    ],
)
def test_impossible_hardware_is_named_with_what_is_possible(name: str, value: float, unit: str, words: str) -> None:
    with pytest.raises(HardwareError, match=words):
        PLAIN.check(PLAIN.parameters | ParameterSet({name: Parameter(value, unit, source="a sketch")}))


@pytest.mark.parametrize(
    ("kind", "law", "words"),
    [
        ("rotary", "coulomb", "needs pressure_a, pressure_b, which a rotary axis lacks; choose"),
        ("force", "viscous", "has no Coulomb level that could rise with pressure; take"),
    ],
)
def test_friction_that_does_not_fit_is_refused_with_its_line(tmp_path: Path, kind: str, law: str, words: str) -> None:
    path = tmp_path / "drive.toml"
    text = f'[drive]\nkind = "{kind}"\n[friction]\nmodel = "{law}"\npressure_dependent = true\n'
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as error:
        read_drive(path)
    assert str(error.value).startswith(f"{path}:3: [friction]: ")
    assert words in str(error.value)
