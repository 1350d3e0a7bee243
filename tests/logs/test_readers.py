"""Every registered reader of logs passes the same tests; a new one needs a row in `WRITERS`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from pneuopt.logs.experiments import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.logs.readers import READERS
from pneuopt.quantities.errors import LogError, UnknownNameError

Columns = Mapping[str, Sequence[float]]
N = 12
TIME = [k / 10 for k in range(N)]
LOG: Columns = {"time_s": TIME, "position_mm": [float(k * k) for k in range(N)], "U_valve": [0.5 * k for k in range(N)]}
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


def written(folder: Path, suffix: str, columns: Columns, sidecar: str = "") -> Path:
    path = folder / f"run{suffix}"
    WRITERS[suffix](path, columns)
    if sidecar:
        text = sidecar.replace("time_s", TIME_NAMES.get(suffix, "time_s"))
        path.with_suffix(".toml").write_text(text, encoding="utf-8")
    return path


def test_every_format_is_written_here(suffix: str) -> None:
    assert suffix in WRITERS, f"add a writer of {suffix} files to WRITERS, so that its reader is tested"


def test_the_same_log_gives_the_same_experiment(tmp_path: Path, suffix: str) -> None:
    run = read_log(written(tmp_path, suffix, LOG))
    assert (run.name, run.trajectory.names, len(run.sha256)) == ("run", ("position",), 64)
    np.testing.assert_array_equal(run.trajectory.t, TIME)
    np.testing.assert_array_equal(run.trajectory["position"], 1e-3 * np.array(LOG["position_mm"]))


def test_a_sidecar_means_the_same_for_every_format(tmp_path: Path, suffix: str) -> None:
    def read(of: str) -> Experiment:
        return read_log(written(tmp_path, of, LOG, SIDECAR))

    expected, found = read(".csv"), read(suffix)
    assert found.conditions == expected.conditions == {"load.mass": 5.0}
    assert found.trajectory.names == expected.trajectory.names == ("valve_voltage", "pressure_a")
    for channel in expected.trajectory.names:
        np.testing.assert_array_equal(found.trajectory[channel], expected.trajectory[channel])


def test_the_suffix_may_be_in_capitals(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, LOG)
    assert read_log(path.rename(path.with_suffix(suffix.upper()))).trajectory.names == ("position",)


def test_missing_samples_are_nan(tmp_path: Path, suffix: str) -> None:
    holes = [np.nan if k in {3, 4} else float(k) for k in range(N)]
    run = read_log(written(tmp_path, suffix, {"time_s": TIME, "position_mm": holes}))
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
    path = written(tmp_path, suffix, columns)
    said = said.replace("time_s", TIME_NAMES.get(suffix, "time_s"))
    with pytest.raises(LogError, match=said.format(row=FIRST_ROWS.get(suffix, 1) + 5)) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: ")


def test_a_column_that_is_not_there_is_named(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, suffix, LOG)
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
