"""A log from its file and its sidecar, and when it was taken: by stamps, by its name, never by the file's own time."""

import hashlib
import io
import os
import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.logs.columns import CHANNELS
from pneuopt.logs.read_log import find_date, read_log
from pneuopt.quantities.errors import InputError, LogError, UnknownNameError
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.units import ATMOSPHERE, si_conversion
from tests.logs.fuzz import fuzz

HEADER = "time [s],position [mm]\n"
BODY = "\n".join(f"{k / 10},{k}" for k in range(12)) + "\n"
SIDECAR = """
[columns]
time = "t [ms]"
valve_voltage = { column = "U valve", unit = "V", centre = "5 V" }
force = { column = "U valve", unit = "V", centre = "5000 mV", scale = "-35.15065 N/V" }
[noise]
force = "2 N"
[conditions]
"supply.pressure" = "6.3 bar(g)"
"load.mass" = "5 kg"
"""
RENAMED = "t [ms],U valve,note\n" + "".join(f"{k},{k},free text\n" for k in range(12))


def written(folder: Path, text: str | bytes, sidecar: str = "") -> Path:
    path = folder / "run_01.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    if sidecar:
        path.with_suffix(".toml").write_text(sidecar, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "header",
    ["time [s],position [mm]", "time_s,position_mm", "Time (s),Position (mm)", '"time [ s ]", "position[mm]"'],
)
def test_the_header_may_name_channels_and_units(tmp_path: Path, header: str) -> None:
    path = written(tmp_path, f"{header}\n{BODY}")
    run = read_log(path)
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.arange(12), rtol=1e-15)
    np.testing.assert_allclose(run.trajectory.t, 0.1 * np.arange(12), rtol=1e-15)
    assert (run.name, run.sha256) == ("run_01", hashlib.sha256(path.read_bytes()).hexdigest())
    assert (run.noise, run.conditions) == ({}, {})


@pytest.mark.parametrize(
    "text",
    [
        (HEADER + BODY).replace(",", ";").replace(".", ","),
        (HEADER + BODY).replace(",", "\t").replace(".", ","),
        (HEADER + BODY).replace(",", ";"),
        (HEADER + BODY).replace(",", " , "),
        (HEADER + BODY).replace("\n", ",\n"),  # trailing delimiter everywhere
        HEADER + BODY.replace("\n", ",\n"),  # in the rows only
        HEADER.replace("\n", ",\n") + BODY,  # in the header only
        "\ufeff" + HEADER + BODY + "\n\n",
        (HEADER + BODY).replace("\n", "\r\n"),
        HEADER + "".join(f'"{k // 10},{k % 10}","{k},0"\n' for k in range(12)),
    ],
    ids=["semicolon", "tab", "point", "spaces", "trail", "trail-rows", "trail-header", "bom", "crlf", "quoted"],
)
def test_dialects_agree(tmp_path: Path, text: str) -> None:
    run = read_log(written(tmp_path, text))
    np.testing.assert_allclose(run.trajectory["position"], 1e-3 * np.arange(12), rtol=1e-15)
    np.testing.assert_allclose(run.trajectory.t, 0.1 * np.arange(12), rtol=1e-15)


def test_an_older_windows_file(tmp_path: Path) -> None:
    text = "time [s]\tposition [µm]\n" + "".join(f"{k},5\t{k}\n" for k in range(12))
    assert read_log(written(tmp_path, text.encode("cp1252"))).trajectory["position"][3] == pytest.approx(3e-6)


def test_pressures_become_absolute(tmp_path: Path) -> None:
    run = read_log(written(tmp_path, "time_ms,pressure_a_bar(g),pressure_b [kPa(a)]\n" + BODY.replace("\n", ",100\n")))
    np.testing.assert_allclose(run.trajectory["pressure_a"], 1e5 * np.arange(12) + ATMOSPHERE, rtol=1e-15)
    assert run.trajectory["pressure_b"][0] == 1e5
    assert run.trajectory.t[1] == pytest.approx(1e-4)


def test_a_sidecar_is_found_and_says_it_all(tmp_path: Path) -> None:
    run = read_log(written(tmp_path, RENAMED, SIDECAR))
    assert run.trajectory.names == ("valve_voltage", "force")
    np.testing.assert_allclose(run.trajectory["valve_voltage"], np.arange(12) - 5.0)
    np.testing.assert_allclose(run.trajectory["force"], -35.15065 * (np.arange(12) - 5.0))
    assert run.noise == {"force": 2.0}
    assert run.conditions == {"supply.pressure": 6.3e5 + ATMOSPHERE, "load.mass": 5.0}


def test_columns_in_place_of_the_sidecars(tmp_path: Path) -> None:
    path = written(tmp_path, RENAMED)
    sensor = {"column": "U valve", "unit": "V", "centre": "1 V", "scale": "2 bar(g)/V"}
    run = read_log(path, columns={"time": "t [ms]", "pressure_a": sensor})
    np.testing.assert_allclose(run.trajectory["pressure_a"], 2e5 * (np.arange(12) - 1.0) + ATMOSPHERE)
    counts = {"column": "U valve", "unit": "count", "scale": "0.5 um"}
    run = read_log(path, columns={"time": "t [ms]", "position": counts})
    assert run.trajectory["position"][2] == pytest.approx(1e-6)


def test_an_explicit_sidecar(tmp_path: Path) -> None:
    side = tmp_path / "rig.toml"
    side.write_text('[noise]\nposition = "20 um"\n')
    assert read_log(written(tmp_path, HEADER + BODY), sidecar=side).noise == {"position": 2e-5}


def test_other_columns_are_left_alone(tmp_path: Path) -> None:
    rows = "".join(f"{k};{k};12.03.2024 10:00;;ok\n" for k in range(12))
    run = read_log(written(tmp_path, "time [s];position [mm];date;;remark\n" + rows))
    assert run.trajectory.names == ("position",)


def test_missing_samples_and_any_start_time(tmp_path: Path) -> None:
    rows = "".join(f"{1.7e9 + k},{'' if k in {3, 4} else k}\n" for k in range(12))
    run = read_log(written(tmp_path, HEADER + rows))
    assert np.flatnonzero(np.isnan(run.trajectory["position"])).tolist() == [3, 4]
    assert run.trajectory.t[0] == 1.7e9


def test_a_quote_that_is_not_closed_swallows_no_row(tmp_path: Path) -> None:
    rows = BODY.splitlines()
    inches = "".join(f'{row},{5}" pipe\n' for row in rows)
    assert len(read_log(written(tmp_path, "time [s],position [mm],remark\n" + inches)).trajectory) == 12
    opened = "".join(f"{row},{chr(34) if k in {3, 9} else ''}ok\n" for k, row in enumerate(rows))
    assert len(read_log(written(tmp_path, "time [s],position [mm],remark\n" + opened)).trajectory) == 12
    swallowed = "remark,time [s],position [mm]\n" + "".join(
        f"{chr(34) if k == 3 else ''}ok,{r}\n" for k, r in enumerate(rows)
    )
    with pytest.raises(LogError, match="row 5"):
        read_log(written(tmp_path, swallowed))


def test_rows_that_may_be_samples_are_never_skipped(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="row 2, column 'time"):
        read_log(written(tmp_path, HEADER + "late,1\n" + BODY))
    with pytest.raises(LogError, match="row 2, column 'time"):
        read_log(written(tmp_path, HEADER + ",\n" + BODY))
    three = "time [s],position [mm],force [N]\n" + "".join(f"{k},{k},{k}\n" for k in range(20))
    with pytest.raises(LogError, match="rows 2 to 13"):
        read_log(written(tmp_path, HEADER + BODY + three))


def test_all_rows_whose_time_repeats_are_told_at_once(tmp_path: Path) -> None:
    times = [*range(20), 19, 20, 20, 21, 3, 4]
    with pytest.raises(LogError) as error:
        read_log(written(tmp_path, HEADER + "".join(f"{t},{k}\n" for k, t in enumerate(times))))
    assert "rows 22, 24: time repeats (19 s, then 19 s); row 26: time runs backwards (21 s, then 3 s)" in str(
        error.value
    )
    coarse = HEADER + "".join(f"{k // 10},{k}\n" for k in range(300))
    with pytest.raises(
        LogError,
        match=r"rows 3 to 11, 13 to 21, .*, \.\.\. \(270 in all\)",
    ):
        read_log(written(tmp_path, coarse))


def test_a_sidecar_adds_to_the_headers(tmp_path: Path) -> None:
    text = "t [ms],position [mm],velocity [m/s],speed_raw\n" + "".join(f"{k},{k},{k},{k}\n" for k in range(12))
    run = read_log(written(tmp_path, text, '[columns]\ntime = "t [ms]"\n'))
    assert run.trajectory.names == ("position",)
    assert [r[:60] for r in run.remarks] == [
        "column 'velocity [m/s]' looks like the channel 'speed'; writ"[:60],
        "column 'speed_raw': unknown unit 'raw'; did you mean 'rad'?;"[:60],
    ]
    run = read_log(written(tmp_path, text, '[columns]\ntime = "t [ms]"\nspeed = "velocity [m/s]"\nposition = false\n'))
    assert run.trajectory.names == ("speed",)


def test_refuses_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.csv"):
        read_log(tmp_path / "none.csv")
    with pytest.raises(LogError, match=r"none\.toml"):
        read_log(written(tmp_path, HEADER + BODY), sidecar=tmp_path / "none.toml")
    with pytest.raises(LogError, match=re.escape(str(tmp_path))):
        read_log(tmp_path)


def test_a_log_has_a_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneuopt.logs.table.MAX_CELLS", 20)
    with pytest.raises(LogError, match="12 rows of 2 channels"):
        read_log(written(tmp_path, HEADER + BODY))


def test_only_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    for name in (tmp_path / "pipe.csv", Path("/dev/zero")):
        with pytest.raises(LogError, match=str(name)):
            read_log(name)
    with pytest.raises(LogError, match=r"a\\x00b"):
        read_log("a\0b.csv")


def test_a_log_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, HEADER + BODY, '[noise]\nposition = "1 um"\n')
    opened: list[str] = []

    def open_and_count(self: Path, mode: str) -> object:
        opened.append(self.name)
        return io.FileIO(self, mode)

    monkeypatch.setattr(Path, "open", open_and_count)
    read_log(path)
    assert opened == ["run_01.csv", "run_01.toml"]


def test_reads_a_long_log(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(25_000, 5))
    rows = "\n".join(f"{k};" + ";".join(f"{v:.9g}" for v in row) for k, row in enumerate(values)).replace(".", ",")
    header = "time [ms];position [mm];force [N];pressure_a [bar(g)];pressure_b [bar(g)];valve_voltage [V]\n"
    path = written(tmp_path, header + rows)
    run = read_log(path)
    assert len(run.trajectory) == 25_000


NUMBERS = st.lists(st.one_of(st.none(), st.floats(-1e9, 1e9)), min_size=10, max_size=20)


@settings(max_examples=40)
@given(
    NUMBERS,
    st.sampled_from([";", "\t"]),
    st.sampled_from([".", ","]),
    st.sampled_from([("position", "mm"), ("force", "kN"), ("pressure_a", "bar(g)"), ("speed", "m/s")]),
)
def test_a_written_log_reads_back(
    tmp_path_factory: pytest.TempPathFactory,
    raw: list[float | None],
    delimiter: str,
    decimal: str,
    column: tuple[str, str],
) -> None:
    channel, unit = column
    raw[0] = raw[0] or 1.0
    rows = [f"{k / 8!r}{delimiter}{'' if v is None else repr(v)}".replace(".", decimal) for k, v in enumerate(raw)]
    text = f"time [s]{delimiter}{channel} [{unit}]\n" + "\n".join(rows) + "\n"
    run = read_log(written(tmp_path_factory.mktemp("log"), text))
    factor, offset = si_conversion(unit, CHANNELS[channel])
    expected = [np.nan if v is None else factor * v + offset for v in raw]
    np.testing.assert_allclose(run.trajectory[channel], expected, rtol=1e-14, equal_nan=True)


def test_a_sidecar_says_how_channels_run_between_samples(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, HEADER + BODY, '[intersample]\nposition = "held"\n'))
    assert log.intersample == {"position": Intersample.HELD}
    assert log.select([n for n in log.trajectory if n != "position"]).intersample == {}
    assert log.with_intersample({"position": Intersample.LINEAR}).intersample == {"position": Intersample.LINEAR}
    for wrong in ('"foh"', "1", '["held"]'):
        with pytest.raises(InputError, match=r"run_01\.toml: \[intersample\] position"):
            read_log(written(tmp_path, HEADER + BODY, f"[intersample]\nposition = {wrong}\n"))
    with pytest.raises(UnknownNameError, match="positoin"):
        read_log(written(tmp_path, HEADER + BODY, '[intersample]\npositoin = "held"\n'))


def test_gauge_sensors_count_from_the_drives_ambient_pressure(tmp_path: Path) -> None:
    rows = "".join(f"{k * 1e-3:.3f},{k}\n" for k in range(20))
    path = written(tmp_path, "time [s],pressure_a [bar(g)]\n" + rows, '[conditions]\n"supply.pressure" = "6 bar(g)"\n')
    high = read_log(path, ambient_pressure=84e3)
    assert high.trajectory["pressure_a"][2] == pytest.approx(2e5 + 84e3)
    assert high.conditions["supply.pressure"] == 684e3
    assert read_log(path).trajectory["pressure_a"][2] == pytest.approx(2e5 + ATMOSPHERE)


def test_a_mark_in_the_first_sample_s_first_cell_makes_it_no_comment(tmp_path: Path) -> None:
    """No row of samples is skipped silently, though its time cannot be read."""
    path = tmp_path / "run.csv"
    names, rows = "time [s],position [mm]\n", "".join(f"{0.02 * k:.2f},{50 + k}\n" for k in range(1, 13))
    path.write_text(f"{names}#,50.0\n{rows}", encoding="utf-8")
    with pytest.raises(LogError, match="row 2, column 'time"):
        read_log(path)
    path.write_text(f"{names}# a note of 1 word\n#\n{rows}", encoding="utf-8")
    assert len(read_log(path).trajectory) == 12


@pytest.mark.parametrize(
    "head", [HEADER + "# run 2, after\n", "time_s,position_mm\n# run 2, after\n", f"by,Smith\n# {HEADER}"]
)
def test_a_comment_with_a_comma_names_no_columns_unless_it_says_their_units(tmp_path: Path, head: str) -> None:
    assert read_log(written(tmp_path, head + BODY)).trajectory["position"][-1] == pytest.approx(0.011)


@pytest.mark.parametrize(
    ("name", "date"),
    [
        ("run_2026-03-12.csv", datetime(2026, 3, 12)),
        ("20260312.csv", datetime(2026, 3, 12)),
        ("axis7_20260312_1030_b.csv", datetime(2026, 3, 12, 10, 30)),
        ("2026-03-12T10-30.csv", datetime(2026, 3, 12, 10, 30)),
        ("99999999_2026-03-12.csv", datetime(2026, 3, 12)),
    ],
)
def test_a_name_holds_a_date(name: str, date: datetime) -> None:
    assert find_date(name) == date


def test_stamps_come_before_the_name(tmp_path: Path) -> None:
    path = tmp_path / "run_2026-03-12.csv"
    path.write_text("time,force [N]\n2026-03-10T09:00:00.000,1\n2026-03-10T09:00:00.001,2\n", encoding="utf-8")
    assert find_date(path) == datetime(2026, 3, 10, 9)


@pytest.mark.parametrize("name", ["run_01.csv", "20261399.csv", "120260312.csv"])
def test_without_a_date_the_remedy_is_said(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text("time [s],force [N]\n0,1\n", encoding="utf-8")
    with pytest.raises(LogError, match=name):
        find_date(path)


@pytest.mark.parametrize("written", ['"2026-03-09"', "2026-03-09", '"2026-03-09T00:00"', "2026-03-09T00:00:00"])
def test_a_sidecar_comes_first(written: str, tmp_path: Path) -> None:
    log = tmp_path / "run_2026-03-12.csv"
    rows = "".join(f"2026-03-10T09:00:00.{k:03},{k}\n" for k in range(20))
    log.write_text(f"time,force [N]\n{rows}", encoding="utf-8")
    log.with_suffix(".toml").write_text(f"date = {written}\n", encoding="utf-8")
    assert find_date(log) == datetime(2026, 3, 9)
    assert len(read_log(log).trajectory) == 20


def test_a_sidecars_date_that_is_none_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "run_01.csv"
    log.write_text("time [s],force [N]\n0,1\n1,2\n", encoding="utf-8")
    log.with_suffix(".toml").write_text('date = "12.3.26"\n', encoding="utf-8")
    for read in (find_date, read_log):
        with pytest.raises(LogError, match=r"run_01\.toml: date"):
            read(log)


def test_a_few_mutated_logs() -> None:
    fuzz(100, seed=1, styles="plain").check()


@pytest.mark.slow
def test_many_mutated_logs() -> None:
    fuzz(100_000, seed=0).check()
