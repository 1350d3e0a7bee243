"""Every registered reader of logs passes the same tests; a new one needs a row in `WRITERS`."""

import random
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import openpyxl
import pandas as pd
import pytest
import scipy.io
from scipy.io import savemat

from pneuopt.logs.experiment import Experiment
from pneuopt.logs.foreign import READERS, read_mat
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import InputError, LogError, UnknownNameError
from pneuopt.quantities.units import ATMOSPHERE
from tests.logs.binary_styles import BINARY_STYLES
from tests.logs.fuzz import damage_bytes
from tests.logs.styles import POSITION, PRESSURE, TEXT_STYLES, VOLTAGE
from tests.logs.styles import TIME as STYLE_TIME
from tests.logs.styles import N as STYLE_N

ROOT = Path(__file__).parents[2]
TIME = 0.1 * np.arange(12)
LOADMAT = """
import io, resource, sys, warnings
from scipy.io import loadmat
from tests.logs.test_foreign import damaged_files
resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))
warnings.simplefilter("ignore")
for k, raw in enumerate(damaged_files(int(sys.argv[2]))):
    if k >= int(sys.argv[1]):
        print(k, flush=True)
        try:
            loadmat(io.BytesIO(raw), squeeze_me=True)
        except Exception:
            pass
"""
"""Reads damaged files with SciPy from the one that is said first, and prints the number of each before it is read."""


def write_variables(folder: Path, variables: dict[str, object], *, version: Literal["4", "5"] = "5") -> Path:
    path = folder / "run.mat"
    savemat(path, variables, format=version)
    return path


@pytest.mark.parametrize("version", ["4", "5"])
@pytest.mark.parametrize("shape", [(12,), (12, 1), (1, 12)])
def test_rows_and_columns_are_vectors(tmp_path: Path, version: Literal["4", "5"], shape: tuple[int, ...]) -> None:
    path = write_variables(tmp_path, {"time_s": TIME.reshape(shape), "force_N": TIME.reshape(shape)}, version=version)
    np.testing.assert_array_equal(read_log(path).trajectory["force"], TIME)


def test_the_fields_of_a_structure_are_columns_and_the_rest_is_left_alone(tmp_path: Path) -> None:
    log = {"time_s": TIME, "position_mm": np.arange(12, dtype=np.uint8), "rig": "B", "raw": np.zeros((12, 3))}
    run = read_log(
        write_variables(tmp_path, {"log": log, "mass": 5.0, "note": "warm", "cells": np.array([1, "a"], object)})
    )
    assert run.trajectory.names == ("position",)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.arange(12), rtol=1e-15)


def test_scipy_reads_version_4_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A head that is damaged, but for which SciPy still takes its reader of version 5."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("SciPy's reader of version 5 was called")

    path = write_variables(tmp_path, {"time_s": TIME, "force_N": TIME})
    raw = bytearray(path.read_bytes())
    raw[127:128] = b"X"
    path.write_bytes(raw)
    monkeypatch.setattr(scipy.io, "loadmat", fail)
    with pytest.raises(LogError, match=r"run\.mat"):
        read_log(path)


def damaged_files(count: int) -> list[bytes]:
    """Logs of version 5 with bytes changed, cut out, put in or repeated: the same ones each time."""
    rng, bases = random.Random(0), []
    with tempfile.TemporaryDirectory() as folder:
        for style in (s for s in BINARY_STYLES.values() if s.suffix == ".mat"):
            style.write(Path(folder) / "run.mat")
            raw = (Path(folder) / "run.mat").read_bytes()
            bases.append(b"MATLAB 5.0 MAT-file".ljust(116) + raw[116:])  # without the time of writing
    return [damage_bytes(rng, rng.choice(bases)) for _ in range(count)]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
def test_damaged_files_end_scipys_process_and_not_ours() -> None:
    """Of 10,000 files 86 ended SciPy 1.17.1: once none of these does, use it, and delete our reader of version 5."""
    count, start, ends = 1000, 0, 0
    while start < count:
        command = [sys.executable, "-c", LOADMAT, str(start), str(count)]
        done = subprocess.run(command, capture_output=True, cwd=ROOT, check=False, timeout=600)
        ends += done.returncode < 0
        start = count if done.returncode == 0 else int(done.stdout.split()[-1]) + 1
    assert ends > 0
    read = 0
    for raw in damaged_files(count):
        try:
            read_mat(Path("run.mat"), raw)
            read += 1
        except LogError:
            pass
    assert read > 0


def write_frame(folder: Path, **columns: object) -> Path:
    path = folder / "run.parquet"
    pd.DataFrame({"time [s]": TIME, **columns}).to_parquet(path)
    return path


def test_names_may_hold_units_in_brackets_and_points(tmp_path: Path) -> None:
    path = write_frame(
        tmp_path, **{"position [mm]": np.arange(12, dtype=np.int16), "rig.force": TIME.astype(np.float32)}
    )
    assert read_log(path).trajectory["position"] == pytest.approx(1e-3 * np.arange(12), rel=1e-15)
    columns: dict[str, str | dict[str, str | float]]
    columns = {"time": "time [s]", "force": {"column": "rig.force", "unit": "N"}}
    assert read_log(path, columns=columns).trajectory["force"] == pytest.approx(TIME, rel=1e-7)


def test_a_null_among_whole_numbers_is_a_missing_sample(tmp_path: Path) -> None:
    counts = pd.array([None, *range(1, 12)], dtype="Int32")
    position = read_log(write_frame(tmp_path, **{"position [mm]": counts})).trajectory["position"]
    assert np.flatnonzero(np.isnan(position)).tolist() == [0]


def test_text_is_left_alone_where_it_is_not_used_and_refused_where_it_is(tmp_path: Path) -> None:
    path = write_frame(tmp_path, **{"position [mm]": TIME, "note": [None, "good", *[""] * 10]})
    assert read_log(path).trajectory.names == ("position",)
    with pytest.raises(LogError, match="row 2, column 'note'"):
        read_log(path, columns={"time": "time [s]", "force": {"column": "note", "unit": "N"}})


def write_workbook(folder: Path, cells: dict[str, object], form: str = "General") -> Path:
    """A sheet of twelve rows every 2.5 ms, with some cells set afterwards."""
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(["time [s]", "position [mm]"])
    for k in range(12):
        sheet.append([46093.5 + 2.5e-3 * k / 86400 if form != "General" else 2.5e-3 * k, float(k)])
        sheet.cell(k + 2, 1).number_format = form
    for place, value in cells.items():
        sheet[place] = value  # openpyxl writes "#DIV/0!" as Excel's error, "=..." as a formula without a value
    book.save(folder / "run.xlsx")
    return folder / "run.xlsx"


def test_dates_keep_more_than_milliseconds(tmp_path: Path) -> None:
    run = read_log(write_workbook(tmp_path, {}, "yyyy-mm-dd hh:mm:ss.000"))
    np.testing.assert_allclose(run.trajectory.t, 2.5e-3 * np.arange(12), atol=1.5e-6)


def test_merged_cells_and_formulas_without_a_value_are_missing_samples(tmp_path: Path) -> None:
    path = write_workbook(tmp_path, {"B5": "=1+1"})
    book = openpyxl.load_workbook(path)
    book.active.merge_cells("B8:B9")
    book.save(path)
    assert np.flatnonzero(np.isnan(read_log(path).trajectory["position"])).tolist() == [3, 7]


Columns = Mapping[str, Sequence[float]]
N = 12
TIMES = [k / 10 for k in range(N)]
LOG: Columns = {
    "time_s": TIMES,
    "position_mm": [float(k * k) for k in range(N)],
    "U_valve": [0.5 * k for k in range(N)],
}
SIDECAR = """
[columns]
time = "time_s"
valve_voltage = { column = "U_valve", unit = "V", centre = "1 V" }
pressure_a = { column = "position_mm", unit = "mV", scale = "2 bar(g)/V" }
[conditions]
"load.mass" = "5 kg"
"""


def write_text(path: Path, columns: Columns) -> None:
    rows = (",".join("" if np.isnan(v) else repr(v) for v in row) for row in zip(*columns.values(), strict=True))
    path.write_text("\n".join([",".join(columns), *rows]) + "\n", encoding="utf-8")


def write_parquet(path: Path, columns: Columns) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {name: pa.array([None if np.isnan(v) else v for v in values]) for name, values in columns.items()}
    pq.write_table(pa.table(arrays), path)


def write_mat(path: Path, columns: Columns) -> None:
    savemat(path, {name: np.array(values)[:, None] for name, values in columns.items()}, appendmat=False)


def write_lvm(path: Path, columns: Columns) -> None:
    head = "LabVIEW Measurement\t\nX_Columns\tOne\n***End_of_Header***\t\n\nChannels\t2\n***End_of_Header***\t\n"
    rows = ("\t".join("" if np.isnan(v) else repr(v) for v in row) for row in zip(*columns.values(), strict=True))
    names = ["X_Value", *[name for name in columns if name != "time_s"]]
    path.write_text(head + "\n".join(["\t".join(names), *rows]) + "\n", encoding="utf-8")


def write_xlsx(path: Path, columns: Columns) -> None:
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(list(columns))
    for row in zip(*columns.values(), strict=True):
        book.active.append([None if np.isnan(v) else v if np.isfinite(v) else str(v) for v in row])
    book.save(path)


def write_tdms(path: Path, columns: Columns) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("Log", name, np.array(values)) for name, values in columns.items()])


def write_mdf(path: Path, columns: Columns) -> None:
    from asammdf import MDF, Signal

    time = np.array(columns["time_s"])
    signals = [Signal(np.array(v), time, name=name) for name, v in columns.items() if name != "time_s"]
    with MDF(version="3.30" if path.suffix == ".mdf" else "4.10") as file:
        file.append(signals, common_timebase=True)
        file.save(path, overwrite=True)


WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    ".csv": write_text,
    ".txt": write_text,
    ".tsv": write_text,
    ".dat": write_text,
    ".parquet": write_parquet,
    ".mat": write_mat,
    ".lvm": write_lvm,
    ".xlsx": write_xlsx,
    ".mf4": write_mdf,
    ".mdf": write_mdf,
    ".tdms": write_tdms,
}
FIRST_ROWS = {**dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".xlsx"), 2), ".lvm": 8}
"""The row number of a format's first sample, where it is not 1."""
TIME_NAMES = dict.fromkeys((".lvm", ".mf4", ".mdf"), "time")
"""What the column of the time is called, where the format does not name it."""


@pytest.fixture(params=sorted(READERS))
def suffix(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def write_format(folder: Path, suffix: str, columns: Columns, sidecar: str = "") -> Path:
    path = folder / f"run{suffix}"
    WRITERS[suffix](path, columns)
    if sidecar:
        text = sidecar.replace("time_s", TIME_NAMES.get(suffix, "time_s"))
        path.with_suffix(".toml").write_text(text, encoding="utf-8")
    return path


def test_every_format_is_written_here(suffix: str) -> None:
    assert suffix in WRITERS, f"add a writer of {suffix} files to WRITERS, so that its reader is tested"


def test_the_same_log_gives_the_same_experiment(tmp_path: Path, suffix: str) -> None:
    run = read_log(write_format(tmp_path, suffix, LOG))
    assert (run.name, run.trajectory.names, len(run.sha256)) == ("run", ("position",), 64)
    np.testing.assert_array_equal(run.trajectory.t, TIMES)
    np.testing.assert_array_equal(run.trajectory["position"], 1e-3 * np.array(LOG["position_mm"]))


def test_a_sidecar_means_the_same_for_every_format(tmp_path: Path, suffix: str) -> None:
    def read(of: str) -> Experiment:
        return read_log(write_format(tmp_path, of, LOG, SIDECAR))

    expected, found = read(".csv"), read(suffix)
    assert found.conditions == expected.conditions == {"load.mass": 5.0}
    assert found.trajectory.names == expected.trajectory.names == ("valve_voltage", "pressure_a")
    for channel in expected.trajectory.names:
        np.testing.assert_array_equal(found.trajectory[channel], expected.trajectory[channel])


def test_the_suffix_may_be_in_capitals(tmp_path: Path, suffix: str) -> None:
    path = write_format(tmp_path, suffix, LOG)
    assert read_log(path.rename(path.with_suffix(suffix.upper()))).trajectory.names == ("position",)


def test_missing_samples_are_nan(tmp_path: Path, suffix: str) -> None:
    holes = [np.nan if k in {3, 4} else float(k) for k in range(N)]
    run = read_log(write_format(tmp_path, suffix, {"time_s": TIMES, "position_mm": holes}))
    assert np.flatnonzero(np.isnan(run.trajectory["position"])).tolist() == [3, 4]


@pytest.mark.parametrize(
    ("column", "sample", "said"),
    [
        ("position_mm", np.inf, "row {row}, column 'position_mm': '?inf'? is not a number"),
        ("time_s", np.nan, "row {row}, column 'time_s': the time is missing; delete the row"),
        ("time_s", 0.2, r"row {row}: time runs backwards \(0.4 s, then 0.2 s\); delete the row"),
    ],
)
def test_a_bad_cell_is_named_by_row_and_column(
    tmp_path: Path, suffix: str, column: str, sample: float, said: str
) -> None:
    columns = {name: list(values) for name, values in LOG.items()}
    columns[column][5] = sample
    path = write_format(tmp_path, suffix, columns)
    said = said.replace("time_s", TIME_NAMES.get(suffix, "time_s"))
    with pytest.raises(LogError, match=said.format(row=FIRST_ROWS.get(suffix, 1) + 5)) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: ")


def test_a_column_that_is_not_there_is_named(tmp_path: Path, suffix: str) -> None:
    path = write_format(tmp_path, suffix, LOG)
    time = TIME_NAMES.get(suffix, "time_s")
    with pytest.raises(UnknownNameError, match=r"unknown column 'position'; did you mean 'position_mm'\?"):
        read_log(path, columns={"time": time, "position": {"column": "position", "unit": "mm"}})


@pytest.mark.parametrize("raw", [b"", b"\x00\x01\xffno log at all\n" * 40], ids=["empty", "noise"])
def test_a_file_that_is_not_of_its_format_is_refused_in_one_line(tmp_path: Path, suffix: str, raw: bytes) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_bytes(raw)
    with pytest.raises(LogError) as error:
        read_log(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert ";" in message, "the message ends with a remedy"


@pytest.mark.parametrize(("name", "shown"), [("run.xls", "'.xls'"), ("run", "a name without suffix")])
def test_an_unknown_suffix_is_refused_with_the_known_ones(tmp_path: Path, name: str, shown: str) -> None:
    (tmp_path / name).write_text("time_s,position_mm\n", encoding="utf-8")
    with pytest.raises(LogError) as error:
        read_log(tmp_path / name)
    assert shown in str(error.value)
    assert f"known: {', '.join(READERS)}" in str(error.value)


STYLES = {**TEXT_STYLES, **BINARY_STYLES}


@pytest.mark.parametrize("name", STYLES)
def test_a_logger_s_file_is_read_right(tmp_path: Path, name: str) -> None:
    style = STYLES[name]
    path = tmp_path / f"run{style.suffix}"
    style.write(path)
    run = read_log(path, columns=style.columns or None)
    assert set(run.trajectory.names) == {"position", "valve_voltage", "pressure_a"}
    assert len(run.trajectory) == STYLE_N
    np.testing.assert_allclose(run.trajectory.t - run.trajectory.t[0], STYLE_TIME, atol=2e-6)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.array(POSITION), rtol=1e-12)
    np.testing.assert_allclose(run.trajectory["valve_voltage"], VOLTAGE, rtol=1e-12)
    np.testing.assert_allclose(run.trajectory["pressure_a"], 1e5 * np.array(PRESSURE) + ATMOSPHERE, rtol=1e-12)
    assert style.remark in run.remarks or not style.remark


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [
        (".xlsx", "openpyxl", "xlsx"),
        (".tdms", "nptdms", "tdms"),
        (".mf4", "asammdf", "mdf"),
        (".parquet", "pyarrow", "parquet"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, package: str, extra: str
) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_bytes(b"any")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"; run: pip install 'pneuopt\[{extra}\]'"):
        read_log(path)
