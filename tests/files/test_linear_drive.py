"""The signals of a linear plant in a drive.toml."""

from pathlib import Path

import pytest

from pneuopt.files.drive import read_drive
from pneuopt.models.declaration import Drive
from pneuopt.models.linear import Integrator, SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet, Quantity


def read(folder: Path, text: str) -> tuple[Drive, ParameterSet]:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return read_drive(path)


def test_a_linear_plants_signal_in_a_unit_of_its_own(tmp_path: Path) -> None:
    text = '[drive]\nkind = "linear"\n[plant]\nmodel = "second_order"\noutput_unit = "V"\ngain = 14.7\n'
    drive, p = read(tmp_path, text)
    assert drive == SecondOrder(output=Quantity("speed", "V"))
    assert p.value("plant.gain") == 14.7
    for unit, message in (("mV", "no SI unit without a prefix"), ("bananas", "bananas")):
        with pytest.raises(InputError, match=message):
            read(tmp_path, text.replace('"V"', f'"{unit}"'))


def test_a_linear_plant_between_other_signals(tmp_path: Path) -> None:
    text = '[drive]\nkind = "linear"\n[plant]\nmodel = "integrator"\noutput = "position"\ngain = "50 mm/(V*s)"\n'
    plant, rig = read(tmp_path, text)
    assert isinstance(plant, Integrator)
    assert [q.name for q in (*plant.system().inputs, *plant.system().outputs)] == ["valve_voltage", "position"]
    assert rig.value("plant.gain") == 0.05
