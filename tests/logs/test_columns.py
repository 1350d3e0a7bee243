"""What columns mean: by a plant's signals and, of foreign logs, by names, units and values, or by what is asked."""

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from pneuopt.logs.columns import CHANNELS, ColumnGuess, LogGuess, Question, guess_channels, guess_log
from pneuopt.logs.foreign import parse_log
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import RotaryDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, UnitError
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


T = np.arange(0.0, 2.0, 0.002)
TRUTH = {
    "time": T,
    "valve_voltage": 0.8 * np.sign(np.sin(7 * T)),
    "position": 0.15 + 0.02 * np.sin(3 * T),
    "speed": 0.06 * np.cos(3 * T),
    "pressure_a": 4e5 + 5e4 * np.sin(5 * T),
    "pressure_b": 4.2e5 - 5e4 * np.sin(5 * T),
}
GAUGE = 101325.0
ROTARY = {**CHANNELS, "torque": "N*m", "angle": "rad", "speed": "rad/s", "angle_reference": "rad"}


def write(path: Path, columns: Mapping[str, Array], delimiter: str = ",") -> Path:
    rows = np.column_stack(list(columns.values()))
    lines = [delimiter.join(columns), *(delimiter.join(f"{v:.9g}" for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def guess(
    path: Path, answers: Mapping[str, str] | None = None, channels: Mapping[str, str] = CHANNELS
) -> tuple[LogGuess, list[Question]]:
    asked: list[Question] = []

    def ask(question: Question) -> str:
        asked.append(question)
        answer = (answers or {}).get(question.channel, question.options[0])
        assert answer in question.options
        return answer

    return guess_log(parse_log(path, path.read_bytes()), channels, ask), asked


FOREIGN: dict[str, tuple[dict[str, Array], dict[str, str], set[str]]] = {
    "German, in a logger's units": (
        {
            "t_ms": 1e3 * T, "U Ventil": 5 + TRUTH["valve_voltage"], "Weg (mm)": 1e3 * TRUTH["position"],
            "p1 [bar(a)]": 1e-5 * TRUTH["pressure_a"], "p2 [bar(a)]": 1e-5 * TRUTH["pressure_b"],
        },
        {}, set(),
    ),
    "names as ours": (
        {"time [s]": T, "valve_voltage [V]": TRUTH["valve_voltage"], "position_mm": 1e3 * TRUTH["position"]}, {}, set(),
    ),
    "units unsaid": (
        {"t": T, "x": 1e3 * TRUTH["position"], "v": TRUTH["speed"]}, {}, {"time", "position", "speed"},
    ),
    "pressures of a gauge, which shows vacuum": (
        {"Time [s]": T, "PA [bar]": 1e-5 * (TRUTH["pressure_a"] - GAUGE) - 2.6, "pos [m]": TRUTH["position"]},
        {}, set(),
    ),
    "pressures that the user knows": (
        {"time_s": T, "press_a [kPa]": 1e-3 * (TRUTH["pressure_a"] - GAUGE), "pos [m]": TRUTH["position"]},
        {"pressure_a": "kPa(g)"}, {"pressure_a"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FOREIGN)
def test_a_foreign_log_reads_as_what_it_was_written_from(case: str, tmp_path: Path) -> None:
    columns, answers, doubts = FOREIGN[case]
    log = write(tmp_path / "run.csv", columns, ";" if "German" in case else ",")
    found, asked = guess(log, answers)
    assert {question.channel for question in asked} == doubts
    assert (found.sample_time, found.unused) == (0.002, ())
    entries = "".join(f"{column.channel} = {column.entry}\n" for column in found.columns)
    (tmp_path / "run.toml").write_text(f"[columns]\n{entries}", encoding="utf-8")
    read = read_log(log).trajectory
    for channel in (c.channel for c in found.columns if c.channel != "time"):
        off = 2.6e5 if "vacuum" in case and channel == "pressure_a" else 0.0
        assert np.allclose(read[channel], TRUTH[channel] - off, rtol=1e-6, atol=1e-6), channel
    assert np.allclose(read.t, T)


def test_a_shaft_and_its_reference_are_told_from_a_cylinder(tmp_path: Path) -> None:
    log = write(tmp_path / "run.csv", {"t [s]": T, "M_Nm": T, "phi": 100 * T, "phi soll [deg]": T, "flag": T})
    found, asked = guess(log, channels=ROTARY)
    units = {c.channel: (c.column, c.unit) for c in found.columns}
    assert units["torque"] == ("M_Nm", "Nm")
    assert units["angle"] == ("phi", "deg")
    assert units["angle_reference"] == ("phi soll [deg]", "deg")
    assert [q.channel for q in asked] == ["angle"]
    assert found.unused == ("flag",)


def test_of_two_columns_the_user_chooses(tmp_path: Path) -> None:
    log = write(tmp_path / "run.csv", {"t [s]": T, "x [mm]": T, "pos [mm]": 2 * T})
    found, asked = guess(log, {"position": "pos [mm]"})
    assert [(q.channel, q.options) for q in asked] == [("position", ("x [mm]", "pos [mm]"))]
    assert [c.column for c in found.columns] == ["t [s]", "pos [mm]"]
    assert found.unused == ("x [mm]",)


def test_a_command_from_0_to_10_v_that_leaves_doubt_is_asked_for(tmp_path: Path) -> None:
    log = write(tmp_path / "run.csv", {"t [s]": T, "u [V]": np.where(T < 1.5, 8.0, 5.0), "x [mm]": T})
    assert [c.centre for c in guess(log, {"valve_voltage": "5 V"})[0].columns] == ["", "5 V", ""]
    assert [c.centre for c in guess(log)[0].columns] == ["", "", ""]


def test_a_centre_that_is_estimated_is_not_rounded_to_5_v(tmp_path: Path) -> None:
    """A valve closed at 5.06 V: 5 V in the sidecar leave 60 mV, which become a smaller valve and dead zone."""
    log = write(tmp_path / "run.csv", {"t [s]": T, "u [V]": 5.06 + 2 * np.sin(9 * T), "x [mm]": T})
    found = guess_log(parse_log(log, log.read_bytes()), CHANNELS, lambda q: q.options[0], has_centre=True)
    assert [(c.centre, c.centre_is_estimated) for c in found.columns] == [("", False), ("", True), ("", False)]
    assert [c.centre for c in guess(log)[0].columns] == ["", "5 V", ""]


def test_what_measures_something_else_is_not_read(tmp_path: Path) -> None:
    log = write(tmp_path / "run.csv", {"t [s]": T, "valve [mA]": 12 + T, "x [mm]": T})
    found, _ = guess(log)
    assert (found.unused, [c.channel for c in found.columns]) == (("valve [mA]",), ["time", "position"])


def test_a_column_without_numbers_is_not_read(tmp_path: Path) -> None:
    log = tmp_path / "run.csv"
    rows = "".join(f"{0.1 * i:.1f},open,,{i}\n" for i in range(20))
    log.write_text(f"t [s],valve,speed [m/s],x [mm]\n{rows}", encoding="utf-8")
    found, _ = guess(log)
    assert (found.unused, [c.channel for c in found.columns]) == (("valve", "speed [m/s]"), ["time", "position"])


def test_time_stamps_are_the_time(tmp_path: Path) -> None:
    rows = "".join(f"2024-03-01 10:00:00.{i:03d},{i / 1e3}\n" for i in range(0, 200, 10))
    (tmp_path / "run.csv").write_text(f"stamp,x [mm]\n{rows}", encoding="utf-8")
    found, _ = guess(tmp_path / "run.csv")
    assert (found.columns[0].entry, found.sample_time) == ('{ column = "stamp" }', 0.01)


@pytest.mark.parametrize(
    "columns", [{"foo": T, "x": T}, {"t [s]": T, "foo": T}], ids=["no time", "no channel but the time"]
)
def test_a_log_that_says_nothing_is_refused(columns: dict[str, Array], tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"run\.csv"):
        guess(write(tmp_path / "run.csv", columns))


@pytest.mark.parametrize("name", ['a "quoted" x [mm]', "x\\y [mm]", "x\0 \x7f\n"])
def test_an_entry_is_toml_whatever_the_name(name: str) -> None:
    assert tomllib.loads(f"x = {ColumnGuess('position', name, 'mm').entry}")["x"] == {"column": name, "unit": "mm"}


def test_names_of_other_loggers_are_known() -> None:
    names = [
        "Timestamp",
        "Valve Cmd",
        "Cyl Position",
        "P1_bar",
        "P2_bar",
        "Supply Pressure",
        "Setpoint Position",
        "Temp",
    ]
    found = guess_channels(names, CHANNELS)
    assert found == {
        "time": ["Timestamp"],
        "valve_voltage": ["Valve Cmd"],
        "position": ["Cyl Position"],
        "pressure_a": ["P1_bar"],
        "pressure_b": ["P2_bar"],
        "supply_pressure": ["Supply Pressure"],
        "position_reference": ["Setpoint Position"],
    }


@pytest.mark.parametrize("names", ["torque [N*m],speed [rad/s]", "torque [N*m],angle [rad]"])
def test_a_rotary_log_without_its_plant_is_refused_with_the_cure(names: str, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"time [s],{names}\n" + "".join(f"{k / 100},{k},{k}\n" for k in range(20)), "utf-8")
    with pytest.raises(InputError, match=r"read_log\(path, plant=drive\.system\(\)\)"):
        read_log(path)
    log = read_log(path, plant=RotaryDrive(Coulomb()).system())
    assert "torque" in log.trajectory
