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
from pneuopt.quantities.errors import InputError

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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[valve]\n", "unknown section 'valve'"),
        ('[actuator]\nhysterese = "1 N"\n', r"\[actuator\]: unknown key 'hysterese'; did you mean 'hysteresis'"),
        ('[sensors.speeed]\nnoise = "1 mm/s"\n', r"\[sensors\]: unknown output 'speeed'; did you mean 'speed'"),
        ('[sensors.speed]\nnoise = "1 mm"\n', r"\[sensors.speed\] noise"),
        ('[sensors.speed]\nnoise = "-1 mm/s"\n', "noise must not be negative"),
        ("actuator = 3\n", r"actuator must be a section, \[actuator\]"),
        ('[sensors.position]\nnoise = "1 um"\n[encoder]\nresolution = "-1 um"\n', "resolution must not be negative"),
    ],
)
def test_bad_entries_name_file_section_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"rig.toml.*{message}"):
        read(tmp_path, text)


def test_a_continuous_loop_has_no_rig(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"rig.toml: a rig's controller is sampled"):
        read(tmp_path, "", ClosedLoop(DRIVE.system(), PID()))


@pytest.mark.parametrize("name", ["force_rig", "pneumatic_rig"])
def test_the_rigs_of_the_data_are_read(name: str) -> None:
    drive, _ = read_drive(DATA / name / "drive.toml")
    loop = read_tuning(DATA / name / "tuning.toml", drive.system()).loop
    assert read_rig(DATA / name / "rig.toml", drive, loop).loop is not None
