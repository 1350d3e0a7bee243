"""The loop in a tuning.toml: forms, delay, dead band, encoder, feedforward."""

from pathlib import Path

import pandas as pd
import pytest

from pneuopt.control.controller import Feedforward
from pneuopt.control.pid import PID, Form, SeriesForm, to_parallel
from pneuopt.control.sensor import Encoder
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.models.linear import SecondOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.result import TuningResult

PLANT = SecondOrder().system()
STANDARD = """[pid]
form = "standard"
sample_time = "2 ms"
delay = "1 sample"
dead_band = "2 mm/s"
Kp = "2 V*s/m"
Ti = { value = "500 ms", lower = "50 ms", upper = "2 s", free = true }
Td = "250 ms"
N = 10
b = 0.5
[feedforward]
gain = { value = "1 V*s/m", lower = "0 V*s/m", upper = "9 V*s/m", free = true }
time = "30 ms"
[[reference]]
step = "0.1 m/s"
horizon = "1 s"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "tuning.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_form_is_tuned_in_its_own_gains(tmp_path: Path) -> None:
    tuning = read_tuning(written(tmp_path, STANDARD), PLANT)
    pid = PID(2e-3, limits=False, form=Form.STANDARD, delay=1, dead_band=True)
    assert (tuning.loop.pid, tuning.loop.feedforward) == (pid, Feedforward(0.03))
    given = tuning.parameters
    assert given.free_names == ("pid.Ti", "feedforward.gain")
    assert (given["pid.Ti"].lower, given["pid.Ti"].upper, given.value("pid.dead_band")) == (0.05, 2.0, 2e-3)
    assert vars(tuning.loop.parallel_form(given)) == pytest.approx({"Kp": 2.0, "Ki": 4.0, "Kd": 0.5, "Tf": 0.025})
    table, found = pd.DataFrame(), given.with_values({"pid.Ti": 0.25, "feedforward.gain": 2.5})
    result = TuningResult(found, table, table, table, table, (), Status(Code.CONVERGED), {}, {})
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuning.toml", result)
    again = read_tuning(tmp_path / "tuned.toml", PLANT).parameters
    assert [again.value(n) for n in given.free_names] == [0.25, 2.5]


def test_the_series_form_is_read(tmp_path: Path) -> None:
    text = STANDARD.replace('"standard"', '"series"').replace("Kp =", "K =").replace("N = 10", 'Tf = "20 ms"')
    tuning = read_tuning(written(tmp_path, text), PLANT)
    assert tuning.loop.parallel_form(tuning.parameters) == to_parallel(SeriesForm(2.0, 0.5, 0.25, 0.02))


ENCODER = """[pid]
sample_time = "1 ms"
Kp = "200 N*s/m"
[[reference]]
step = "0.1 m/s"
horizon = "1 s"
[sensor]
resolution = "10 um"
filter = "5 ms"
"""


def test_an_encoder_is_what_the_controller_reads(tmp_path: Path) -> None:
    tuning = read_tuning(written(tmp_path, ENCODER), ForceDrive(Coulomb()).system())
    assert tuning.loop.sensor == Encoder(1e-5, 5e-3)
    assert (tuning.parameters.value("sensor.resolution"), tuning.parameters.value("sensor.filter")) == (1e-5, 5e-3)


LIMITED = """[pid]
sample_time = "2 ms"
Kp = { value = "2 V*s/m", lower = "1 V*s/m", upper = "3 V*s/m", free = true }
limits = ["0 V", "10 V"]
[[reference]]
step = "0.1 m/s"
horizon = "1 s"
"""
VALVE_DRIVE = PneumaticDrive()
AT_5_06_V = VALVE_DRIVE.parameters.with_values({"valve.centre": 5.06})


def test_limits_on_the_wire_become_limits_about_the_valves_centre(tmp_path: Path) -> None:
    path = written(tmp_path, LIMITED)
    task = read_tuning(path, VALVE_DRIVE.system(), AT_5_06_V)
    ends = [task.parameters.value(n) for n in ("pid.lower", "pid.upper")]
    assert ends == pytest.approx([-5.06, 4.94])
    usual = read_tuning(path, VALVE_DRIVE.system())
    assert [usual.parameters.value(n) for n in ("pid.lower", "pid.upper")] == [0.0, 10.0]
    table = pd.DataFrame()
    result = TuningResult(task.parameters, table, table, table, table, (), Status(Code.CONVERGED), {}, {})
    write_tuned(tmp_path / "tuned.toml", path, result, task.wire)
    written_file = read_toml(tmp_path / "tuned.toml").unwrap()
    assert written_file["wire"] == {"centre": "5.06 V"}
    assert written_file["pid"]["limits"] == ["0 V", "10 V"]
    assert read_tuning(tmp_path / "tuned.toml", VALVE_DRIVE.system(), AT_5_06_V).parameters == task.parameters
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuned.toml", result, usual.wire)
    assert "wire" not in read_toml(tmp_path / "tuned.toml")


def test_limits_beside_the_valves_centre_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, LIMITED.replace('["0 V", "10 V"]', '["-5 V", "5 V"]'))
    with pytest.raises(InputError) as error:
        read_tuning(path, VALVE_DRIVE.system(), AT_5_06_V)
    said = (
        "limits: the valve's centre, 5.06 V, does not lie between -5 V and 5 V; "
        'write what the wire may carry, limits = ["0 V", "10 V"] for instance'
    )
    assert said in str(error.value)
    assert read_tuning(path, VALVE_DRIVE.system()).parameters.value("pid.lower") == -5


FAULTS = 'fault_samples = 8\nfault_output = "6 V"\n'
SAFE = LIMITED.replace("limits =", f"{FAULTS}limits =")


def test_the_safe_output_is_the_wires_and_the_centre_by_default(tmp_path: Path) -> None:
    task = read_tuning(written(tmp_path, SAFE), VALVE_DRIVE.system(), AT_5_06_V)
    assert task.parameters.value("pid.fault_output") == pytest.approx(0.94)
    assert task.parameters.value("pid.fault_samples") == 8
    plain = written(tmp_path, SAFE.replace('fault_samples = 8\nfault_output = "6 V"\n', ""))
    usual = read_tuning(plain, VALVE_DRIVE.system(), AT_5_06_V).parameters
    assert [usual.value(f"pid.{n}") for n in ("fault_output", "fault_samples")] == [0.0, 5.0]
