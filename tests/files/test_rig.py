"""rig.toml: sections, units and defaults, and what is refused."""

from pathlib import Path

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.files.drive import read_drive
from pneuopt.files.rig import read_rig
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck

DRIVE = ForceDrive(Stribeck())
LOOP = ClosedLoop(DRIVE.system(), PID(sample_time=1e-3), sensor=SensorLag(5e-3))
DATA = Path(__file__).parents[2] / "data"


def read(folder: Path, text: str, loop: ClosedLoop = LOOP) -> Rig:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return read_rig(path, DRIVE, loop)


def test_every_section_is_read_in_its_units(tmp_path: Path) -> None:
    text = (
        '[actuator]\nhysteresis = "0.5 N"\ndead_zone = "1 N"\n[sensors.position]\nresolution = "10 um"\n'
        'noise = "5 um"\nlag = "1 ms"\n[encoder]\nresolution = "20 um"\nfilter = "3 ms"\n'
    )
    rig = read(tmp_path, text)
    assert rig.actuator == Actuator(0.5, 1.0)
    assert rig.sensors == {"position": Sensor(1e-3, 5e-6, 1e-5)}
    assert rig.encoder == Encoder(2e-5, 3e-3)
    assert "friction.direction" in rig.plant.parameters


def test_without_sensors_the_loop_s_own_stands_there(tmp_path: Path) -> None:
    assert read(tmp_path, "").sensors == {"speed": Sensor(lag=5e-3)}
    counts = ClosedLoop(DRIVE.system(), PID(sample_time=1e-3), sensor=Encoder(1e-5))
    rig = read(tmp_path, "", counts)
    assert (rig.sensors, rig.encoder.resolution) == ({"position": Sensor()}, 1e-5)


@pytest.mark.parametrize("name", ["force_rig", "pneumatic_rig"])
def test_the_rigs_of_the_data_are_read(name: str) -> None:
    drive, _ = read_drive(DATA / name / "drive.toml")
    loop = read_tuning(DATA / name / "tuning.toml", drive.system()).loop
    assert read_rig(DATA / name / "rig.toml", drive, loop).loop is not None
