"""Gauge pressures in files count from the drive's ambient pressure, where it has one."""

from pathlib import Path

import pandas as pd
import pytest

from pneuopt.files.drive import read_drive, write_fit
from pneuopt.files.study import read_axes, read_study
from pneuopt.files.tuning import read_scenarios
from pneuopt.identification.result import IdentificationResult
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import ATMOSPHERE, read_value

HIGH_PLACE = ParameterSet({"supply.pressure": Parameter(6.84e5, "Pa(a)"), "ambient.pressure": Parameter(84e3, "Pa(a)")})
CYLINDER = """[drive]
kind = "pneumatic"
[cylinder]
[valve]
[load]
[friction]
model = "stribeck"
[supply]
pressure = { value = "6 bar(g)", upper = "9 bar(g)" }
[ambient]
"""


def written(folder: Path, text: str, name: str = "drive.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("ambient", ["84 kPa(a)", "1.0 bar(a)", None])
def test_gauge_pressures_count_from_the_drives_own_ambient_pressure(tmp_path: Path, ambient: str | None) -> None:
    _, rig = read_drive(written(tmp_path, CYLINDER + (f'pressure = "{ambient}"\n' if ambient else "")))
    zero = read_value(ambient, "Pa(a)") if ambient else ATMOSPHERE
    assert rig.value("supply.pressure") == pytest.approx(6e5 + zero, rel=1e-12)
    assert rig["supply.pressure"].upper == pytest.approx(9e5 + zero, rel=1e-12)


@pytest.mark.parametrize("said", ['{ value = "6 bar(g)", upper = "9 bar(g)" }', '"6 bar(g)"'])
def test_a_found_ambient_pressure_leaves_the_others_what_they_are(tmp_path: Path, said: str) -> None:
    text = CYLINDER.replace('{ value = "6 bar(g)", upper = "9 bar(g)" }', said)
    rig = read_drive(written(tmp_path, text + 'pressure = "1 bar(a)"\n'))[1]
    found, table = rig.with_values({"ambient.pressure": 0.98e5}), pd.DataFrame()
    result = IdentificationResult(found, table, table, table, {}, Status(Code.CONVERGED, ("gaps 1e-9",)), {}, {})
    write_fit(tmp_path / "fit.toml", tmp_path / "drive.toml", result)
    again = read_drive(tmp_path / "fit.toml")[1]
    assert again.value("ambient.pressure") == 0.98e5
    assert again.value("supply.pressure") == pytest.approx(rig.value("supply.pressure"), rel=1e-9)
    assert again["supply.pressure"].upper == pytest.approx(rig["supply.pressure"].upper, rel=1e-9)


def test_a_corner_of_gauge_pressures_counts_from_the_drives_ambient_pressure() -> None:
    section = {"corners": {"supply.pressure": ["5 bar(g)", "7 bar(g)"]}}
    found = read_scenarios(section, "tuning.toml", HIGH_PLACE)
    assert {round(float(str(case["supply.pressure"]))) for case in found.values()} >= {584_000, 784_000}


def test_an_axis_of_gauge_pressures_counts_from_the_drives_ambient_pressure(tmp_path: Path) -> None:
    text = '[study]\ndrive = "fit.toml"\ntuning = "tuned.toml"\n[axes]\n"supply.pressure" = ["4 bar(g)", "5 bar(g)"]\n'
    (pressure,) = read_axes(read_study(written(tmp_path, text, "study.toml")), HIGH_PLACE)
    assert pressure.points == pytest.approx((484e3, 584e3))
    assert pressure.in_axis_unit(pressure.points).tolist() == pytest.approx([4.0, 5.0])
