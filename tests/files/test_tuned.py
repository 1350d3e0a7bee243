"""What a tuning's file becomes with a result.

Whether a tuned.toml's certificate holds: every forgery is named, and no other way to write the same is one.
"""

import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomlkit

from pneuopt.evaluation.response import cases
from pneuopt.files.drive import read_drive, read_fit, read_status
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import CertificateCheck, check_certificate, checksum_section, write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.result import TuningResult
from tests.files.test_tuning import PLANT, read_all, tuned


def test_of_a_failed_tuning_the_best_candidate_is_written_without_the_old_certificate(tmp_path: Path) -> None:
    _, found = read_all(tmp_path, {"pid.Kp": 12.34})
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuning.toml", tuned(found))
    nothing = tuned(found, status=Status(Code.NOT_CERTIFIED, ("grazes the band",)))
    with pytest.raises(InputError, match="found no candidate: grazes the band"):
        write_tuned(tmp_path / "again.toml", tmp_path / "tuned.toml", nothing)
    assert not (tmp_path / "again.toml").exists()
    failed = replace(nothing, best={"pid.Kp": 50.0})
    write_tuned(tmp_path / "again.toml", tmp_path / "tuned.toml", failed)
    assert read_tuning(tmp_path / "again.toml", PLANT).parameters.value("pid.Kp") == 50.0
    said = read_toml(tmp_path / "again.toml").unwrap()
    assert "certified" not in said
    assert "no certificate" in said["status"]["gains"]
    assert read_status(tmp_path / "again.toml") == failed.status


FIT = """
[drive]
kind = "linear"
[plant]
model = "first_order"
gain = "0.12 (m/s)/V"
time_constant = "200 ms"   # measured by hand
dead_time = "10 ms"
[estimates]
"plant.gain" = { value = 0.12, stderr = 0.002, dof = 40.0 }
[covariance]
"plant.gain" = [4e-6]
"""
TUNED = """# axis 7
accept = ["hunts"]
[pid]
form = "parallel"
sample_time = "10 ms"
limits = ["-5 V", "5 V"]
Kp = { value = "8 V*s/m", lower = "0.1 V*s/m", upper = "30000 V*s/m", free = true }
Ki = { value = "50 V/m", lower = "1 V/m", upper = "2000 V/m", free = true }
Kd = "0.01 V*s^2/m"
Tf = "20 ms"
b = 0.8
[dither]
frequency = "40 Hz"
amplitude = "100 mV"
[[reference]]
step = "200 mm/s"
horizon = "2 s"
[[reference]]
step = "0.1 m/s"
horizon = "2 s"
[minimise]
settling_time = { band = "2 %" }
[limits]
overshoot = "5 %"
max_sensitivity = 1.6
[scenarios.corners]
"plant.gain" = "10 %"
[scenarios.samples]
count = 3
"plant.time_constant" = { distribution = "normal", spread = "5 %" }
[certified]
"0 to 0.2" = { SettlingTime = 0.505, Overshoot = 0.8 }
"0 to 0.1" = { SettlingTime = 0.505, Overshoot = nan }
[status]
code = "converged"
message = "certified objective 0.505"
[provenance]
pneuopt = "0.2"
"""
FAILED = TUNED.replace('"converged"', '"no answer found keeps all limits"')


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "fit.toml").write_text(FIT, "utf-8")
    write(tmp_path, TUNED)
    return tmp_path


def write(folder: Path, text: str) -> str:
    """The text as a tuning would have written it, with the checksum that belongs to it; returns it."""
    path = folder / "tuned.toml"
    path.write_text(text, "utf-8")
    document = read_toml(path)
    document["checksum"] = checksum_section(document.unwrap(), path, read_fit(folder / "fit.toml"))
    path.write_text(tomlkit.dumps(document), "utf-8")
    return path.read_text("utf-8")


def check(folder: Path) -> CertificateCheck:
    found = check_certificate(read_fit(folder / "fit.toml"), folder / "tuned.toml")
    assert found is not None
    return found


def edit(path: Path, old: str, new: str, count: int = 1) -> None:
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), "utf-8")


FORGERIES = [
    ('"8 V*s/m"', '"20000 V*s/m"', "pid.Kp was changed after tuning (8 V*s/m -> 20000 V*s/m)"),
    ('"50 V/m"', '"50.001 V/m"', "pid.Ki was changed after tuning (50 V/m -> 50.001 V/m)"),
    ('"0.01 V*s^2/m"', '"0.02 V*s^2/m"', "pid.Kd was changed after tuning (0.01 V*s^2/m -> 0.02 V*s^2/m)"),
    ('Tf = "20 ms"\n', "", "pid.Tf was changed after tuning (20 ms -> 10 ms)"),
    ("b = 0.8", "b = 0.9", "pid.b was changed after tuning (0.8 -> 0.9)"),
    ('"100 mV"', '"150 mV"', "dither.amplitude was changed after tuning (100 mV -> 150 mV)"),
    ('"40 Hz"', '"41 Hz"', "dither.frequency was changed after tuning (40 Hz -> 41 Hz)"),
    ("[dither]\n", '[dither]\nwaveform = "triangle"\n', "dither.waveform was changed"),
    ('"5 V"]', '"10 V"]', "pid.limits, the upper one was changed after tuning (5 V -> 10 V)"),
    ('"10 ms"', '"5 ms"', "pid.sample_time was changed after tuning (10 ms -> 5 ms)"),
    ('"parallel"\n', '"parallel"\ndelay = "1 sample"\n', "pid.delay was changed after tuning (0 -> 1)"),
    ('"parallel"\n', '"parallel"\nanti_windup = "clamping"\n', "pid.anti_windup was changed"),
    ("[dither]", '[sensor]\nlag = "5 ms"\n[dither]', "sensor.lag was added after tuning (5 ms)"),
    ("[dither]", '[feedforward]\ngain = "1 V*s/m"\n[dither]', "feedforward was added after tuning"),
    ('overshoot = "5 %"', 'overshoot = "20 %"', "[limits] overshoot.max was changed after tuning (5 % -> 20 %)"),
    ("max_sensitivity = 1.6\n", "", "[limits] max_sensitivity.max was left out after tuning (1.6)"),
    ('band = "2 %"', 'band = "5 %"', "the settling band was changed after tuning"),
    (
        "settling_time = {",
        "iae = { weight = 2 }\nsettling_time = {",
        "[minimise] iae.weight was added after tuning (2)",
    ),
    ("accept = [", 'accept = ["creeps", ', "accept was changed"),
    ('"0.1 m/s"\nhorizon', '"0.15 m/s"\nhorizon', "reference 1 step was changed after tuning (0.1 m/s -> 0.15 m/s)"),
    ('"2 s"', '"1 s"', "reference 2 horizon was changed after tuning (2 s -> 1 s)"),
    ('"10 %"', '"5 %"', "[scenarios.corners] plant.gain was changed after tuning (0.1 -> 0.05)"),
    ("count = 3", "count = 4", "[scenarios.samples].count was changed after tuning (3 -> 4)"),
    ("Overshoot = 0.8", "Overshoot = 0.1", "the row of '0 to 0.2' in [certified] was changed after tuning"),
    ('"certified objective 0.505"', '"certified objective 0.1"', "the message of the status was changed"),
    ("[status]", '[wire]\ncentre = "5 V"\n[status]', "wire.centre was added after tuning (5 V)"),
]


@pytest.mark.parametrize(("old", "new", "told"), FORGERIES)
def test_what_was_changed_after_tuning_is_named_with_both_values(place: Path, old: str, new: str, told: str) -> None:
    assert check(place) == CertificateCheck(True)
    edit(place / "tuned.toml", old, new)
    found = check(place)
    assert not found.holds
    assert any(told in reason for reason in found.reasons), found.reasons
    assert found.lines[0].startswith("NOT CERTIFIED: ")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"0.12 (m/s)/V"', '"0.13 (m/s)/V"', "the plant's plant.gain was changed after tuning (0.12 (m/s)/V -> 0.13"),
        ('"200 ms"', '"0.21 s"', "the plant's plant.time_constant was changed after tuning (0.2 s -> 0.21 s)"),
        ('dead_time = "10 ms"\n', "", "the plant's structure was changed after tuning"),
        ("[4e-6]", "[5e-6]", "the plant's covariance was changed after tuning"),
        ("dof = 40.0", "dof = 4.0", "the plant's table of estimates was changed after tuning"),
    ],
)
def test_another_plant_is_named(place: Path, old: str, new: str, told: str) -> None:
    edit(place / "fit.toml", old, new)
    found = check(place)
    assert not found.holds
    assert any(told in reason for reason in found.reasons), found.reasons


def test_a_gain_that_is_replaced_in_the_whole_file_is_named_all_the_same(place: Path) -> None:
    edit(place / "tuned.toml", "8 V*s/m", "9 V*s/m", -1)
    assert check(place).reasons == ("pid.Kp was changed after tuning (8 V*s/m -> 9 V*s/m)",)


def test_a_status_made_good_by_hand_is_named(place: Path) -> None:
    write(place, FAILED)
    assert check(place).reasons == ("its tuning ended so: no answer found keeps all limits",)
    edit(place / "tuned.toml", '"no answer found keeps all limits"', '"converged"', -1)
    assert check(place).reasons == ("the status was changed after tuning (INFEASIBLE -> CONVERGED)",)


def test_a_certificate_without_a_checksum_is_none(place: Path) -> None:
    """As one written by hand, or by a version that knew no checksum."""
    (place / "tuned.toml").write_text(TUNED, "utf-8")
    assert "run pneuopt certify" in check(place).reasons[0]
    (place / "tuned.toml").write_text(TUNED.partition("[status]")[0], "utf-8")
    assert check(place).reasons == ("its gains were not written by pneuopt tune",)
    (place / "tuned.toml").write_text(TUNED.partition("[certified]")[0], "utf-8")
    assert check_certificate(read_fit(place / "fit.toml"), place / "tuned.toml") is None


def test_an_edited_checksum_is_no_certificate(place: Path) -> None:
    text = (place / "tuned.toml").read_text("utf-8")
    (digest,) = re.findall(r'^hash = "([0-9a-f]{64})"', text, re.M)
    edit(place / "tuned.toml", digest, digest[::-1])
    assert check(place).reasons == ("its [checksum] was edited, or is damaged",)
    (place / "tuned.toml").write_text(text.partition("[checksum]")[0] + "[checksum]\nhash = 3\nloop = 4\n", "utf-8")
    assert not check(place).holds


def reordered(text: str) -> str:
    """The same table with all keys in the opposite order, written anew."""

    def turn(value: object) -> object:
        if isinstance(value, dict):
            return {k: turn(v) for k, v in reversed(value.items())}
        return [turn(v) for v in value] if isinstance(value, list) else value

    table = tomlkit.parse(text).unwrap()
    table["reference"] = table["reference"][::-1]
    return tomlkit.dumps(turn(table))  # type: ignore[arg-type]


SAME: Mapping[str, Callable[[str], str]] = {
    "comments": lambda text: text.replace("\n", "   # a comment\n", 3) + "\n# the end\n",
    "blanks": lambda text: text.replace("[dither]", "\n\n[dither]").replace(" = ", "   =  "),
    "units": lambda text: (
        text.replace('"8 V*s/m"', '"8000 mV*s/m"')
        .replace('"20 ms"', '"0.02 s"')
        .replace('"100 mV"', '"0.1 V"')
        .replace('"200 mm/s"', '"0.2 m/s"')
        .replace('"5 %"', "0.05")
        .replace('"10 %"', '"0.1"')
        .replace('"2 s"', '"2000 ms"')
    ),
    "order": reordered,
    "tomlkit": lambda text: tomlkit.dumps(tomlkit.parse(text)),
    "bounds": lambda text: text.replace("2000 V/m", "1000 V/m"),
    "wind": lambda text: text.replace("pneuopt = ", "edited_by = 'me'\npneuopt = "),
}


@pytest.mark.parametrize("name", SAME)
def test_another_way_to_write_the_same_is_still_certified(place: Path, name: str) -> None:
    text = (place / "tuned.toml").read_text("utf-8")
    other = SAME[name](text)
    assert other != text or name == "tomlkit"
    (place / "tuned.toml").write_text(other, "utf-8")
    assert check(place) == CertificateCheck(True)


def test_a_fit_that_is_written_in_other_units_and_files_that_are_moved_are_still_certified(
    place: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    edit(place / "fit.toml", '"200 ms"   # measured by hand', '"0.2 s"')
    edit(place / "fit.toml", '"0.12 (m/s)/V"', '"120 (mm/s)/V"')
    assert check(place).holds
    other = tmp_path_factory.mktemp("elsewhere")
    for name in ("fit.toml", "tuned.toml"):
        shutil.move(place / name, other / name)
    assert check(other).holds


def test_a_path_counts_by_its_points(place: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    table = pd.DataFrame({"time [s]": np.arange(20) * 0.1, "speed [m/s]": np.linspace(0, 0.2, 20) ** 2})
    table.to_csv(place / "cam.csv", index=False)
    text = TUNED.replace('step = "0.1 m/s"\nhorizon = "2 s"', 'path = "cam.csv"')
    write(place, text)
    other = tmp_path_factory.mktemp("elsewhere")
    for name in ("fit.toml", "tuned.toml", "cam.csv"):
        shutil.copy(place / name, other / name)
    assert check(other).holds
    table.assign(**{"speed [m/s]": table["speed [m/s]"] * 1.01}).to_csv(other / "cam.csv", index=False)
    assert any("points was changed" in reason for reason in check(other).reasons)


def certified_result(folder: Path, **changes: float) -> TuningResult:
    """A result as a tuning of the file would have it, with these values."""
    drive, plant = read_drive(folder / "fit.toml")
    task = read_tuning(folder / "tuned.toml", drive.system(), plant)
    known = plant | task.parameters
    labels = [case.label for case in cases(task.references, task.scenarios(known), known)]
    figures, table = pd.DataFrame(1.0, index=["SettlingTime"], columns=labels), pd.DataFrame()
    values = known.with_values(changes)
    return TuningResult(values, figures, figures, table, table, (), Status(Code.CONVERGED, ("good",)), {}, {})


def test_what_is_written_is_bound_to_its_files(place: Path) -> None:
    tuned, fit = place / "tuned.toml", place / "fit.toml"
    write_tuned(place / "new.toml", tuned, certified_result(place, **{"pid.Kp": 12.5}), fit=fit)
    assert check_certificate(read_fit(fit), place / "new.toml") == CertificateCheck(True)
    assert "checksum" not in (place / "new.toml").read_text("utf-8").partition("[checksum")[0]
    write_tuned(place / "free.toml", tuned, certified_result(place))
    assert "checksum" not in read_toml(place / "free.toml")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [("plant.gain", 0.2, "fit.toml: plant.gain is 0.12"), ("pid.b", 0.5, "new.toml: pid.b is 0.8")],
)
def test_a_result_of_other_values_than_the_files_have_is_not_bound_to_them(
    place: Path, name: str, value: float, told: str
) -> None:
    result = certified_result(place, **{name: value})
    with pytest.raises(InputError, match=re.escape(told)):
        write_tuned(place / "new.toml", place / "tuned.toml", result, fit=place / "fit.toml")
    assert not (place / "new.toml").exists()


def data_pairs() -> Iterator[tuple[Path, Path]]:
    for folder in (Path(__file__).parents[2] / "data").iterdir():
        tunings = [p for p in folder.glob("*.toml") if "[pid]" in p.read_text("utf-8")]
        yield from product(folder.glob("drive.toml"), tunings)


@pytest.mark.parametrize(("drive", "tuning"), list(data_pairs()), ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_kind_of_drive_and_loop_has_a_checksum_that_repeats(drive: Path, tuning: Path) -> None:
    table = read_toml(tuning).unwrap()
    first, second = (checksum_section(table, tuning, read_fit(drive)).unwrap() for _ in range(2))
    assert first == second
    assert {"loop", "plant", "references", "limits", "scenarios", "figures", "status"} <= first.keys()
    assert " object at 0x" not in str(first)
