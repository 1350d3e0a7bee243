"""A study that ends early goes on where it was.

The rows of a study can be read while it runs, and after it was killed.
"""

import io
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from math import inf, nan
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.executors import INTERRUPTED_CASE, Outcome
from pneuopt.studies.journal import Journal, RowFile, parquet_bytes
from pneuopt.studies.sensitivity import sweep_from_neighbours
from pneuopt.studies.sweep import grid, sweep

RIG = ParameterSet({"mass": Parameter(1.0, "kg"), "gain": Parameter(1.0, "1")})
ONE = ThreadPoolExecutor(1)
CASES = grid(RIG, {"mass": [1.0, 2.0, 3.0, 4.0]})


def sweep_with(path: Path, seen: list[float], stop_at: float = nan, identity: str = "study") -> pd.DataFrame:
    def cell(p: ParameterSet) -> dict[str, float | str | bool]:
        seen.append(p.value("mass"))
        if p.value("mass") == stop_at:
            raise KeyboardInterrupt
        if p.value("mass") == 2.0 and stop_at == 4.0:
            raise ValueError("unlucky")
        return {"third": p.value("mass") / 3, "none": nan, "word": "a", "flag": True}

    journal = Journal(path, identity)
    try:
        return sweep(cell, RIG, CASES, executor=ThreadPoolExecutor(1), journal=journal)
    finally:
        journal.close(finished=False)


def test_a_study_goes_on_where_it_was_and_ends_in_the_same_table(tmp_path: Path) -> None:
    path, seen, again = tmp_path / "cells.csv.journal", list[float](), list[float]()
    first = sweep_with(path, seen, stop_at=4.0)
    assert first["error"].tolist()[-1] == INTERRUPTED_CASE
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])  # killed while it wrote
    second = sweep_with(path, again)
    assert sorted(again) == [2.0, 3.0, 4.0]  # the one that failed, the one that was cut, the one not reached
    assert (second["error"] == "").all()
    nothing = list[float]()
    third = sweep_with(path, nothing)
    assert nothing == []
    pd.testing.assert_frame_equal(second.drop(columns="seconds"), third.drop(columns="seconds"))
    assert third["third"].tolist() == [m / 3 for m in (1.0, 2.0, 3.0, 4.0)]


def test_what_another_study_has_left_is_not_read(tmp_path: Path) -> None:
    path, seen = tmp_path / "journal", list[float]()
    sweep_with(path, seen)
    sweep_with(path, seen, identity="with another mass")
    assert len(seen) == 8
    path.write_bytes(b"\xff\n[1]\n")
    journal = Journal(path, "study")
    assert journal.known == {}
    journal.close(finished=True)


def test_a_study_that_is_done_leaves_no_journal(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", "study")
    journal.add("a", "0", Outcome({"x": 1.0}, 0.1))
    journal.close(finished=True)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError):
        Journal(tmp_path / "none" / "journal", "study")


def test_an_interrupted_search_from_neighbours_begins_no_other_wave() -> None:
    seen = list[float]()

    def cell(p: ParameterSet) -> dict[str, float]:
        seen.append(p.value("mass"))
        if p.value("mass") == 2.0:
            raise KeyboardInterrupt
        return {"gain found": 2.0, "excess": 1.0}

    table = sweep_from_neighbours(
        cell,
        RIG,
        {"mass": [1.0, 2.0, 3.0, 4.0]},
        value="excess",
        starts={"gain found": "gain"},
        executor=ThreadPoolExecutor(1),
    )
    assert seen == [1.0, 2.0]
    assert table["error"].tolist() == ["", *[INTERRUPTED_CASE] * 3]
    assert table["mass"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert not table["again"].any()


def test_a_case_of_the_same_name_with_other_values_is_computed_again(tmp_path: Path) -> None:
    def run(parameters: ParameterSet, mass: float) -> float:
        journal = Journal(tmp_path / "journal", "study")
        cases = {"sample 1": {"mass": mass}}
        table = sweep(lambda p: p.value("mass") * p.value("gain"), parameters, cases, executor=ONE, journal=journal)
        journal.close(finished=False)
        return float(table["value"].iloc[0])

    assert [run(RIG, 2.0), run(RIG, 3.0), run(RIG.with_values({"gain": 5.0}), 3.0)] == [2.0, 3.0, 15.0]


def test_a_study_is_resumed_only_if_nothing_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, inputs = tmp_path / "journal", {"drive.toml": "1", "tuning.toml": "2"}
    with pytest.raises(InputError):
        Journal(path, inputs, resume=True)
    journal = Journal(path, inputs)
    journal.add("a", "mark", Outcome({"x": 1 / 3}, 0.1))
    journal.close(finished=False)
    again = Journal(path, inputs, resume=True)
    again.close(finished=False)
    assert again.find("a", "mark") == Outcome({"x": 1 / 3}, 0.1)
    with pytest.raises(InputError, match=r"tuning\.toml"):
        Journal(path, {**inputs, "tuning.toml": "3"}, resume=True)
    monkeypatch.setattr("pneuopt.studies.journal.provenance", lambda: {"casadi": "9.9", "options": ""})
    with pytest.raises(InputError, match="version of casadi"):
        Journal(path, inputs, resume=True)
    assert len(path.read_text("utf-8").splitlines()) > 1  # what was refused is still there


class FullDisk:
    """A file that has no room for a while."""

    def __init__(self, file: Any) -> None:
        self.file, self.full = file, True

    def write(self, text: str) -> None:
        self.file.write(text[:10] if self.full else text)
        if self.full:
            raise OSError(28, "No space left on device")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def test_a_full_disk_costs_rows_of_the_journal_and_is_said(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", "study")
    journal._file = disk = FullDisk(journal._file)  # type: ignore[assignment]
    journal.add("a", "0", Outcome({"x": 1.0}, 0.1))
    assert "No space left on device" in journal.problem
    disk.full = False
    journal.add("b", "0", Outcome({"x": 2.0}, 0.1))
    journal.close(finished=False)
    again = Journal(tmp_path / "journal", "study")
    again.close(finished=False)
    assert dict(again.known) == {"b": Outcome({"x": 2.0}, 0.1)}


@pytest.mark.skipif(os.name == "nt", reason="kills itself")
def test_a_study_that_is_killed_loses_no_row_and_ends_in_the_same_table(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import os, signal, sys\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from pneuopt import Journal, Parameter, ParameterSet, sweep\n"
        "rig = ParameterSet({'mass': Parameter(1.0, 'kg')})\n"
        "cases = {f'case {k}': {'mass': 1 + k / 7} for k in range(40)}\n"
        "journal = Journal('journal', 'study')\n"
        "print(len(journal.known))\n"
        "def kill(news):\n"
        "    if news.done == 17 and 'kill' in sys.argv:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "table = sweep(lambda p: p.value('mass') ** 0.3, rig, cases, executor=ThreadPoolExecutor(1),\n"
        "              journal=journal, progress=kill)\n"
        "print([v.hex() for v in table['value']])\n",
        encoding="utf-8",
    )

    def run(*words: str) -> tuple[int, list[str]]:
        done = subprocess.run(
            [sys.executable, script, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout.splitlines()

    assert run("kill")[0] == -9
    code, (known, resumed) = run()
    assert (code, known) == (0, "17")
    (tmp_path / "journal").unlink()
    assert run() == (0, ["0", resumed])


MASS = ParameterSet({"mass": Parameter(1.0, "kg")})
MASSES = {f"case {k}": {"mass": 1.0 + k} for k in range(5)}


def read(path: Path) -> pd.DataFrame:
    return pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)


def third(p: ParameterSet) -> dict[str, float]:
    if p.value("mass") == 1.0:
        raise ValueError("too light, alas")
    return {"third": p.value("mass") / 3} | ({"late": 7.5} if p.value("mass") > 3.5 else {})


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_the_file_holds_each_row_as_soon_as_its_case_is_done(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pneuopt.studies.journal.REWRITE_SECONDS", 0.0)
    monkeypatch.setattr("pneuopt.studies.journal.REWRITE_SHARE", inf)
    path, seen = tmp_path / f"rows.{suffix}", list[pd.DataFrame]()
    journal = Journal(tmp_path / "journal", "study", rows=RowFile(path, lambda n: f"{n} [kg]" if n == "mass" else n))
    table = sweep(
        third,
        MASS,
        MASSES,
        executor=ThreadPoolExecutor(1),
        journal=journal,
        progress=lambda _: seen.append(read(path)),
    )
    assert [len(t) for t in seen] == [1, 2, 3, 4, 5]
    assert list(seen[-1]) == ["case", "mass [kg]", "third", "late", "seconds", "error"]
    assert seen[0]["error"][0].startswith("ValueError: too light, alas")
    expected = table.rename(columns={"mass": "mass [kg]"})[list(seen[-1])]
    found = seen[-1].assign(error=seen[-1]["error"].fillna(""))
    pd.testing.assert_frame_equal(found, pd.DataFrame(expected), rtol=1e-8, check_dtype=False)
    journal.close(finished=True)
    assert list(tmp_path.iterdir()) == []


def test_parquet_is_written_now_and_then_and_at_the_end(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "rows.parquet")
    for k in range(4):
        rows.extend([{"case": str(k), "x": float(k)}])
    assert read(rows.path)["case"].tolist() == ["0"]
    rows.close(finished=False)
    assert read(rows.path)["x"].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_a_column_of_numbers_and_texts_is_one_of_texts() -> None:
    found = pd.read_parquet(io.BytesIO(parquet_bytes({"x": [1.0, "a", nan, None], "y": [1, 2.5, None, nan]})))
    assert found["x"].tolist()[:2] == ["1.0", "a"]
    assert found["x"].isna().tolist() == [False, False, True, True]
    assert found["y"].tolist()[:2] == [1.0, 2.5]


def test_parquet_without_pyarrow_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="pyarrow"):
        RowFile(tmp_path / "rows.parquet")


class SmallDisk:
    """A file that has room for some bytes only."""

    def __init__(self, file: Any) -> None:
        self.file, self.full = file, True

    def write(self, content: bytes) -> int:
        return int(self.file.write(content[:2] if self.full else content))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def test_on_a_full_disk_rows_stay_whole_and_come_later(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "rows.csv")
    rows.extend([{"case": "a", "x": 1.0}])
    whole = rows.path.read_bytes()
    disk = SmallDisk(rows._sink._file)  # type: ignore[attr-defined]
    rows._sink._file = disk  # type: ignore[attr-defined]
    rows.extend([{"case": "b", "x": 2.0}])
    assert rows.path.read_bytes() == whole
    assert "rows.csv: lacks rows (No space left on device)" in rows.problem
    disk.full = False
    rows.extend([{"case": "c", "x": 3.0}])
    assert rows.problem == ""
    assert read(rows.path)["case"].tolist() == ["a", "b", "c"]
    rows.close(finished=False)


def test_a_folder_that_is_gone_does_not_end_a_study(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "none" / "rows.csv")
    rows.extend([{"case": "a"}])
    assert "lacks rows" in rows.problem
    (tmp_path / "none").mkdir()
    rows.extend([{"case": "b"}])
    assert read(rows.path)["case"].tolist() == ["a", "b"]
    rows.close(finished=False)


@pytest.mark.skipif(os.name == "nt", reason="kills itself")
def test_a_killed_study_leaves_whole_rows_and_goes_on(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import os, signal, sys\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from pneuopt import Journal, Parameter, ParameterSet, RowFile, sweep\n"
        "rig = ParameterSet({'mass': Parameter(1.0, 'kg')})\n"
        "cases = {f'case {k}': {'mass': 1 + k / 7} for k in range(40)}\n"
        "journal = Journal('journal', 'study', resume='kill' not in sys.argv, rows=RowFile(sys.argv[1]))\n"
        "def kill(news):\n"
        "    if news.done == 17 and 'kill' in sys.argv:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "sweep(lambda p: p.value('mass') ** 0.3, rig, cases, executor=ThreadPoolExecutor(1),\n"
        "      journal=journal, progress=kill)\n"
        "journal.close(finished=False)\n",
        encoding="utf-8",
    )

    def run(*words: str) -> int:
        return subprocess.run([sys.executable, script, *words], cwd=tmp_path, check=False).returncode

    for name, least in (("rows.csv", 17), ("rows.parquet", 1)):
        assert run(name, "kill") == -9
        assert least <= len(read(tmp_path / name)) <= 17
        assert run(name) == 0
        assert read(tmp_path / name)["case"].tolist() == [f"case {k}" for k in range(40)]
        (tmp_path / "journal").unlink()
