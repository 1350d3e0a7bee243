import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import UnitError
from pneuopt.quantities.parameters import Quantity


class Servo(NamedTuple):
    inputs: tuple[Quantity, ...] = (Quantity("torque", "N*m"),)
    outputs: tuple[Quantity, ...] = (Quantity("angle", "rad"), Quantity("speed", "rad/s"))


def test_a_plants_signals_are_channels_in_its_units(tmp_path: Path) -> None:
    rows = "\n".join(f"{k},{k * 8192},{60 * k},{k % 3},{k}" for k in range(12))
    path = tmp_path / "servo.csv"
    path.write_text(f"time [ms],enc,speed [rpm],torque [N*mm],angle_reference [rev]\n{rows}\n", encoding="utf-8")
    columns: dict[str, str | dict[str, str | float]] = {
        "time": "time [ms]",
        "angle": {"column": "enc", "unit": "count", "scale": "8192 count/rev"},
        "speed": "speed [rpm]",
        "torque": "torque [N*mm]",
        "angle_reference": "angle_reference [rev]",
    }
    run = read_log(path, columns=columns, plant=Servo())
    turns = 2 * math.pi * np.arange(12)
    assert run.trajectory["angle"] == pytest.approx(turns, rel=1e-15)
    assert run.trajectory["speed"] == pytest.approx(turns, rel=1e-15)
    assert run.trajectory["angle_reference"] == pytest.approx(turns, rel=1e-15)
    assert run.trajectory["torque"] == pytest.approx(1e-3 * (np.arange(12) % 3))
    assert [run.unit(n) for n in ("angle", "speed", "torque", "valve_voltage")] == ["rad", "rad/s", "N*m", "V"]
    with pytest.raises(UnitError, match="does not measure"):
        read_log(path, columns={"time": "time [ms]", "speed": "speed [rpm]"})
    with pytest.raises(UnitError, match="does not measure"):
        read_log(
            path,
            columns={**columns, "angle": {"column": "enc", "unit": "count", "scale": "8192 count/mm"}},
            plant=Servo(),
        )
