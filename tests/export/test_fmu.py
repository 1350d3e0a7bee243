"""The plant as an FMU: FMPy's validation, and the closed loop with the exported controller beside `simulate`."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Model
from fmpy.validation import validate_fmu

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.export.fmu import export_fmu
from pneuopt.export.languages import Language, export_controller
from pneuopt.models import catalog
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

GCC = shutil.which("gcc")


def test_it_is_valid_and_the_same_each_time(tmp_path: Path) -> None:
    drive, rig = catalog.s32()
    made = export_fmu(drive.system(), rig)
    assert made == export_fmu(drive.system(), rig)
    (tmp_path / "plant.fmu").write_bytes(made)
    assert validate_fmu(str(tmp_path / "plant.fmu")) == []
    found = {v.name: v for v in fmpy.read_model_description(str(tmp_path / "plant.fmu")).modelVariables}
    assert float(found["load.mass"].start) == rig.value("load.mass")
    assert {"valve_voltage", "speed", "out.speed", "pressure_a"} <= set(found)


def plant_model(
    system: System, folder: Path, parameters: ParameterSet | None = None
) -> tuple[FMU3Model, dict[str, int]]:
    """The FMU, compiled by gcc and instantiated."""
    path = folder / "plant.fmu"
    path.write_bytes(export_fmu(system, parameters or system.parameters))
    zipfile.ZipFile(path).extractall(folder / "fmu")
    place = folder / "fmu" / "binaries" / "x86_64-linux"
    place.mkdir(parents=True)
    headers = Path(fmpy.__file__).parent / "c-code"
    sources = [str(p) for p in (folder / "fmu" / "sources").glob("*.c")]
    command = [str(GCC), "-shared", "-fPIC", "-O1", f"-I{headers}", *sources, "-lm", "-o", str(place / "plant.so")]
    subprocess.run(command, check=True, capture_output=True)
    described = fmpy.read_model_description(str(path))
    model = FMU3Model(
        guid=described.guid, unzipDirectory=str(folder / "fmu"), modelIdentifier="plant", instanceName="plant"
    )
    model.instantiate()
    model.enterInitializationMode()
    model.exitInitializationMode()
    model.enterContinuousTimeMode()
    return model, {v.name: v.valueReference for v in described.modelVariables}


def closed_loop(
    loop: ClosedLoop, given: ParameterSet, model: FMU3Model, command: int, wanted: float, steps: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """The speed over 0.2 s by `simulate`, and of FMU and exported controller, by RK4 with so many steps a sample."""
    space: dict[str, type] = {}
    exec(export_controller(loop, given, Language.PYTHON)["controller.py"], space)
    controller, sample = space["Controller"](), loop.pid.sample_time or 0.0
    t = np.arange(0.0, 0.2, sample)
    start, count = loop.initial(given), len(loop.plant.states)
    controller.start(0.0, 0.0, start[names(loop.states).index("pid.command")])
    run = simulate(loop, Trajectory(t, {"reference": np.full(len(t), wanted)}), given, initial=start)
    x, found, h = np.array(start[:count]), [], sample / steps
    speed = names(loop.plant.states).index("speed")

    def rates(at: np.ndarray) -> np.ndarray:
        model.setContinuousStates((fmpy.fmi3.fmi3Float64 * count)(*at), count)
        rate = (fmpy.fmi3.fmi3Float64 * count)()
        model.getContinuousStateDerivatives(rate, count)
        return np.array(rate)

    for _ in t:
        found.append(x[speed])
        model.setFloat64([command], [controller.step(wanted, x[speed])])
        for _ in range(steps):
            k1 = rates(x)
            k2 = rates(x + h / 2 * k1)
            k3 = rates(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3))
    return run["speed"], np.array(found)


@pytest.mark.skipif(GCC is None, reason="no C compiler on the path")
def test_the_pneumatic_drive_and_its_controller_together_are_the_loop(tmp_path: Path) -> None:
    """The s32 drive of the catalogue, whose rest the controller takes over; FMPy calls the FMU."""
    drive, rig = catalog.s32()
    loop = ClosedLoop(drive.system(), PID(1e-3), Dither(100.0))
    values = {"pid.Kp": 4.0, "pid.Ki": 40.0, "dither.amplitude": 0.5, "pid.lower": -5.0, "pid.upper": 5.0}
    given = loop.complete(rig).with_values(values)
    model, places = plant_model(loop.plant, tmp_path, given)
    wanted, found = closed_loop(loop, given, model, places["valve_voltage"], 0.2, steps=20)
    assert np.max(np.abs(found - wanted)) < 1e-5 * 0.2
    assert np.max(found) > 0.15


@pytest.mark.skipif(GCC is None, reason="no C compiler on the path")
def test_plant_and_controller_together_are_the_loop(tmp_path: Path) -> None:
    """The exported Python controller drives the FMU by RK4, 10 steps a sample, beside the library's simulation."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(2e-3), Dither(60.0))
    values = {"pid.Kp": 200.0, "pid.Ki": 4000.0, "dither.amplitude": 10.0, "pid.lower": -80.0, "pid.upper": 80.0}
    given = loop.parameters.with_values(values)
    model, places = plant_model(loop.plant, tmp_path)
    wanted, found = closed_loop(loop, given, model, places["force"], 0.2)
    assert np.max(np.abs(found - wanted)) < 1e-5 * 0.2
    assert np.max(found) > 0.19
