"""When a log was taken: by its time stamps, by its name, and never by the file's own time."""

from datetime import datetime
from pathlib import Path

import pytest

from pneuopt.logs.dates import find_date
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import LogError


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
    with pytest.raises(LogError, match=rf"{name}: neither its time column nor its name .* give --dates 2026-03-12"):
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
        with pytest.raises(LogError, match=r'date must be a date, as date = "2026-03-12"; got'):
            read(log)
