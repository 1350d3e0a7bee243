"""`pneuopt init --from LOG`: what a log's columns show fills its sidecar, and what was assumed is said."""

import re
from pathlib import Path

import numpy as np
import pytest

from pneuopt.files.drive import read_drive
from pneuopt.files.first_files import first_files, first_kinds
from pneuopt.files.tuning import read_tuning
from pneuopt.identification.problem import check_logs
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.parameters import Intersample, ParameterSet
from tests.cli.test_init import run


def write_foreign_log(path: Path, columns: str = "t_ms;U Ventil;x ist;p1 [bar];p2 [bar]") -> Path:
    t = np.arange(0.0, 400.0, 2.0)
    kinds = {
        "t_ms": t, "U Ventil": 5 + np.sign(np.sin(t / 30)), "x ist": 150 + 20 * np.sin(t / 60),
        "p1 [bar]": 4 + np.sin(t / 40), "p2 [bar]": 4 - np.sin(t / 40), "Kraft [N]": t, "M [N*m]": t, "v [m/s]": t,
    }  # fmt: skip
    rows = np.column_stack([kinds[name] for name in columns.split(";")])
    path.write_text("\n".join([columns, *(";".join(f"{v:.6g}" for v in row) for row in rows)]), encoding="utf-8")
    return path


def test_a_log_fills_its_sidecar_and_says_what_was_assumed(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path / "files"))
    assert code == 0, output
    assert max(map(len, output.replace(str(tmp_path), "").splitlines())) <= 80
    said = " ".join(output.split())
    assert "valve_voltage: column 'U Ventil' [V], less 5 V" in said
    assert "assumed, check it in [columns] of run.toml: position: 'x ist' reaches 170. In which unit? Taken: mm" in said
    assert "# Assumed, check it: position:" in (tmp_path / "run.toml").read_text("utf-8")
    drive, _ = read_drive(tmp_path / "files/drive.toml")
    read = read_log(log, plant=drive.system()).trajectory
    assert drive.kind == "pneumatic"
    assert [float(read[n].max()) for n in ("position", "pressure_a")] == pytest.approx([0.17, 5e5], rel=1e-3)
    tuning = read_tuning(tmp_path / "files/tuning.toml", drive.system())
    assert tuning.loop.pid.sample_time == 2e-3
    place = re.match("#:schema (.*)\n", (tmp_path / "run.toml").read_text("utf-8"))
    assert place is not None
    assert (tmp_path / place[1]).resolve() == (tmp_path / "files/schemas/sidecar.json").resolve()


def test_a_valve_of_0_to_10_v_gets_the_limits_of_its_wire(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv")
    assert run("init", "--from", str(log), "-o", str(tmp_path / "five"))[0] == 0
    assert 'limits = ["-5 V", "5 V"]' in (tmp_path / "five" / "tuning.toml").read_text("utf-8")
    log.write_text(log.read_text("utf-8").replace(";6;", ";5.5;").replace(";4;", ";4.6;"), encoding="utf-8")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path / "wire"), "--force")
    assert (code, "its centre, near 5 V, is estimated" in " ".join(output.split())) == (0, True)
    assert 'limits = ["0 V", "10 V"]' in (tmp_path / "wire" / "tuning.toml").read_text("utf-8")


def test_a_second_log_gets_its_sidecar_beside_files_that_were_edited(tmp_path: Path) -> None:
    logs = [write_foreign_log(tmp_path / f"run_{k}.csv") for k in (1, 2)]
    assert run("init", "--from", str(logs[0]), "-o", str(tmp_path))[0] == 0
    (tmp_path / "drive.toml").write_text("# mine\n", encoding="utf-8")
    code, output = run("init", "--from", str(logs[1]), "-o", str(tmp_path))
    assert code == 0, output
    assert "wrote run_2.toml in" in output
    assert (tmp_path / "drive.toml").read_text("utf-8") == "# mine\n"
    (tmp_path / "run_2.toml").write_text("# mine\n", encoding="utf-8")
    code, output = run("init", "--from", str(logs[1]), "-o", str(tmp_path))
    assert (code, "run_2.toml: is there already" in output) == (2, True)


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ("t_ms;Kraft [N];x ist", "force"),
        ("t_ms;Kraft [N];U Ventil;x ist", "force"),
        ("t_ms;M [N*m]", "rotary"),
        ("t_ms;U Ventil;v [m/s]", "linear"),
        ("t_ms;U Ventil;x ist", "pneumatic"),  # the linear kind reads no position
    ],
)
def test_a_log_says_what_drives_the_load(columns: str, kind: str, tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", columns)
    code, output = run("init", "--from", str(log), "-o", str(tmp_path))
    assert code == 0
    assert f"by the log's columns a {kind} drive" in " ".join(output.split())
    assert read_drive(tmp_path / "drive.toml")[0].kind == kind


def test_another_kind_than_the_guessed_one_is_written_as_the_screen_says(tmp_path: Path) -> None:
    """A voltage and a position may be a motor's, too: the command that is shown replaces the files of the guess."""
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;U Ventil;x ist")
    _, output = run("init", "--from", str(log), "-o", str(tmp_path))
    shown = next(line for line in output.splitlines() if "pneuopt init KIND" in line).split()
    code, output = run("init", "force", *shown[shown.index("--from") :], "-o", str(tmp_path))
    assert code == 0, output
    assert read_drive(tmp_path / "drive.toml")[0].kind == "force"


def test_a_channel_that_the_drive_does_not_use_is_left_out(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;Kraft [N];U Ventil;x ist;p1 [bar]")
    code, output = run("init", "force", "--from", str(log), "-o", str(tmp_path))
    assert code == 0, output
    assert "valve_voltage: left out, column 'U Ventil': this kind of drive does not use it" in output
    drive, _ = read_drive(tmp_path / "drive.toml")
    system = drive.system()
    check_logs(system, read_log(log, plant=system), system.parameters)
    assert "valve_voltage = false" in log.with_suffix(".toml").read_text("utf-8")


@pytest.mark.parametrize(("kind", "command", "scale"), [("force", "force", "1 N/V"), ("rotary", "torque", "1 N*m/V")])
def test_a_voltage_beside_no_force_is_said_to_be_its_command(
    kind: str, command: str, scale: str, tmp_path: Path
) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;U Ventil;x ist")
    code, output = run("init", kind, "--from", str(log), "-o", str(tmp_path))
    entry = f'{command} = {{ column = "U Ventil", unit = "V", scale = "{scale}" }}'
    assert (code, entry in " ".join(output.split())) == (0, True), output
    assert f'[intersample] {command} = "held"' in output
    sidecar = log.with_suffix(".toml").read_text("utf-8").replace("\n[columns]", f"\n[columns]\n{entry}")
    log.with_suffix(".toml").write_text(f'{sidecar}\n[intersample]\n{command} = "held"\n', encoding="utf-8")
    system = read_drive(tmp_path / "drive.toml")[0].system()
    assert read_log(log, plant=system).intersample[command] is Intersample.HELD
    beside = write_foreign_log(tmp_path / "beside.csv", "t_ms;Kraft [N];U Ventil;x ist")
    assert "commands it" not in run("init", "force", "--from", str(beside), "-o", str(tmp_path))[1]


def test_a_log_that_does_not_is_met_with_a_question(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;x ist")
    code, output = run("init", "--from", str(log))
    assert (code, "do not say what drives the load; say it before --from" in output) == (2, True)
    log = write_foreign_log(tmp_path / "drive.csv")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path))
    assert (code, "rename it; drive.toml is the name of another file" in output) == (2, True)
    assert not (tmp_path / "drive.toml").exists()


@pytest.mark.parametrize("kind", sorted(first_kinds()))
@pytest.mark.parametrize("sample_time", [1e-4, 1e-3, 5e-3, 0.02])
def test_the_first_dither_can_be_sampled_by_a_controller_as_slow_as_the_log(
    kind: str, sample_time: float, tmp_path: Path
) -> None:
    files = first_files(kind, ParameterSet({}), {}, sample_time=sample_time)
    for name in ("drive.toml", "tuning.toml"):
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    loop = read_tuning(tmp_path / "tuning.toml", read_drive(tmp_path / "drive.toml")[0].system()).loop
    if loop.dither is not None:
        loop.dither.check(loop.parameters.value("dither.frequency"), loop.pid.sample_time)
