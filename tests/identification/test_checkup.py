"""`check`: what is read, assumed, found and identifiable before a fit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pneuopt.files.drive import read_drive
from pneuopt.identification import checkup
from pneuopt.identification.checkup import check
from pneuopt.identification.identify import identify
from pneuopt.logs.doctor import Severity
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from tests.logs.bad_logs import BAD_LOGS, RIGHT, T, swing

DRIVE = ForceDrive(Coulomb())
GIVEN = DRIVE.parameters.with_values({"load.mass": 2.65}).freed("friction.coulomb", "friction.viscous")
LOG = swing().select(["position", "force"])


def in_file(log: Experiment, folder: Path) -> Experiment:
    """The log as read from a file."""
    columns = [log.trajectory.t, *(log.trajectory[n] for n in log.trajectory)]
    head = ",".join(["time [s]", *(f"{n} [{log.unit(n)}]" for n in log.trajectory)])
    rows = [",".join(f"{v:.9g}" for v in row) for row in np.column_stack(columns).tolist()]
    path = folder / f"{log.name}.csv"
    path.write_text("\n".join(["# rig 7", head, *rows]), encoding="utf-8")
    return read_log(path)


def test_a_right_log_has_no_findings_and_is_identifiable() -> None:
    found = check(DRIVE, LOG, GIVEN)
    assert (found.findings, found.is_refused, found.runs) == ((), False, {})
    assert found.verdict is not None
    assert not found.verdict.unidentifiable
    assert str(found).startswith("nothing is wrong: the logs identify all of 2 free parameters")


def test_what_a_check_promises_is_a_fit_of_its_own_or_is_called_a_right_models(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = check(DRIVE, LOG, GIVEN)
    monkeypatch.setattr(checkup, "TRIAL_SECONDS", 1e-9)
    for found in (check(DRIVE, LOG, GIVEN), check(DRIVE, LOG, GIVEN, trial=False)):
        assert not found.is_tried
        assert "identifiable, if the model is right: a fit takes longer, and may know less" in str(found)
    assert tried.is_tried
    assert "identifiable, by a trial fit" in str(tried)


def test_what_is_read_is_said_with_rows_columns_and_rate(tmp_path: Path) -> None:
    (tmp_path / "swing.toml").write_text('[columns]\nposition = "x [mm]"\n[noise]\nposition = "10 um"\n', "utf-8")
    text = "time [s],x [mm],force [N],temp\n"
    text += "".join(
        f"{t:.3f},{1e3 * x:.5f},{f:.6f},20\n" for t, x, f in zip(T, RIGHT["position"], RIGHT["force"], strict=True)
    )
    (tmp_path / "swing.csv").write_text(text, "utf-8")
    said = str(check(DRIVE, read_log(tmp_path / "swing.csv"), GIVEN)).replace("\n", " ")
    words = " ".join(said.split())
    assert f"rows 2 to {T.size + 1} of" in words
    assert "0 s to 3.999 s, every 1 ms (1000 Hz)" in words
    span = f"{RIGHT['force'].min():.3g} N to {RIGHT['force'].max():.3g} N"
    assert f"force: {span}, column 'force [N]'" in words
    assert "position: 52.2 mm to 148 mm, column 'x [mm]'" in words
    assert "not read: temp" in words
    assert "says columns, noise" in words


def test_assumptions_are_what_no_file_states(tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    path.write_text(
        '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "coulomb"\ncoulomb = { free = true }\n',
        "utf-8",
    )
    drive, rig = read_drive(path)
    assumed = {
        a.name: a
        for a in check(drive, swing().select(["position", "force"]).with_noise({"position": 1e-5}), rig).assumptions
    }
    assert "load.mass" not in assumed  # stated, though it is the default
    assert "friction.coulomb" not in assumed  # free
    assert "noise of position" not in assumed  # stated in the log
    assert assumed["friction.viscous"].text == '"70 N*s/m"'
    assert assumed["friction.smoothing"].key == "[friction] smoothing"
    assert "identify estimates it" in assumed["friction.smoothing"].reason
    assert assumed["force between samples"].value == "linear"
    bare = replace(LOG, noise={})
    noise = next(a for a in check(drive, bare, rig).assumptions if a.name == "noise of position")
    assert noise.key == "[noise] position"
    assert noise.value == pytest.approx(1e-5, rel=0.1)


def test_each_kind_of_drive_lists_its_own_defaults() -> None:
    own = DRIVE.parameters.freed("friction.coulomb")
    names = {a.name for a in check(DRIVE, LOG, own).assumptions}
    assert {"load.mass", "load.force", "friction.viscous"} <= names
    stated = own.with_values({"load.mass": DRIVE.parameters.value("load.mass")})
    assert "load.mass" not in {a.name for a in check(DRIVE, LOG, stated).assumptions}


@pytest.mark.parametrize("name", ["work", "scale", "jumps", "stops"])
def test_a_fault_is_refused_as_a_fit_refuses_it(name: str, tmp_path: Path) -> None:
    log = in_file(BAD_LOGS[name].select(["position", "force"]), tmp_path)
    found = check(DRIVE, log, GIVEN)
    assert found.is_refused
    assert found.verdict is None
    fault = found.findings[0]
    assert (fault.severity, fault.check) == (Severity.FAULT, name)
    with pytest.raises(LogError) as refused:
        identify(DRIVE, log, GIVEN)
    assert str(refused.value) == f"{fault.log}: {fault.message}"
    assert f"--accept {name}" in fault.message


def test_rows_are_those_of_the_file(tmp_path: Path) -> None:
    """The position jumps at 1.501 s, and back after 1.599 s; the first sample is in row 3, for row 1 is a comment."""
    found = check(DRIVE, in_file(BAD_LOGS["jumps"], tmp_path), GIVEN).findings[0]
    assert found.rows == (3 + 1500, 3 + 1600)
    assert "fault in swing, rows 1503 to 1603" in " ".join(
        str(check(DRIVE, in_file(BAD_LOGS["jumps"], tmp_path), GIVEN)).split()
    )


def test_a_fault_of_one_log_among_several_is_a_doubt() -> None:
    logs = [LOG, replace(LOG, name="b"), replace(BAD_LOGS["work"], name="c")]
    found = check(DRIVE, logs, GIVEN)
    assert not found.is_refused
    doubt = next(f for f in found.findings if f.check == "work")
    assert (doubt.severity, doubt.log) == (Severity.DOUBT, "c")
    assert "most logs do not show it" in doubt.message
    assert any(w.startswith("c: ") for w in found.warnings)


def test_an_accepted_fault_is_a_doubt() -> None:
    found = check(DRIVE, BAD_LOGS["work"].accepting("work"), GIVEN)
    assert [f.severity for f in found.findings if f.check == "work"] == [Severity.DOUBT]


def test_without_a_free_parameter_a_fit_is_refused() -> None:
    found = check(DRIVE, LOG, DRIVE.parameters)
    assert found.is_refused
    assert "no parameter is free" in found.findings[0].message


def one_way() -> tuple[Experiment, ForceDrive, ParameterSet]:
    """Sliding at .2 m/s, one way."""
    rng = np.random.default_rng(0)
    x = 0.2 * T + 1e-5 * rng.standard_normal(T.size)
    log = Experiment(Trajectory(T, {"position": x, "force": 40 + 0.01 * rng.standard_normal(T.size)}), name="slide")
    drive = ForceDrive(Stribeck())
    return log, drive, drive.parameters.freed("friction.*", "load.force").fixed("friction.smoothing")


def test_what_logs_do_not_identify_is_said_with_the_run_that_would() -> None:
    log, drive, given = one_way()
    found = check(drive, log, given)
    assert found.verdict is not None
    assert {"friction.static", "load.force"} <= set(found.verdict.unidentifiable)
    runs = {name: run for run, names in found.runs.items() for name in names}
    assert runs["load.force"] == "log both directions"
    stribeck = found.verdict.table["value"]["friction.stribeck_velocity"]  # the value in use
    speeds = f"from {0.1 * stribeck:.1g} to {5 * stribeck:.1g} m/s"
    assert runs["friction.static"] == f"log constant speeds, or slow ramps, {speeds}"
    assert "what would help" in str(found)


def test_a_missing_sample_is_a_note_and_not_nothing() -> None:
    column = LOG.trajectory["position"].copy()
    column[700:703] = np.nan
    channels = {"position": column, "force": LOG.trajectory["force"]}
    found = check(DRIVE, replace(LOG, trajectory=Trajectory(T, channels)), GIVEN)
    (note,) = found.findings
    assert (note.severity, note.channel, note.log) == (Severity.NOTE, "position", "swing")
    assert "3 samples of position are missing" in note.message
    assert str(found).startswith("a fit takes this, with 1 note: the logs identify all of 2 free parameters")


def test_the_dictionary_is_plain() -> None:
    log, drive, given = one_way()
    record = check(drive, log, given).to_dict()
    assert json.loads(json.dumps(record, default=str))["read"][0]["rows"] == T.size
