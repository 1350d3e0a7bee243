"""The rows of a study can be read while it runs, and after it was killed."""

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
from pneuopt.studies import row_file
from pneuopt.studies.journal import Journal
from pneuopt.studies.row_file import RowFile, parquet_bytes
from pneuopt.studies.sweep import sweep

RIG = ParameterSet({"mass": Parameter(1.0, "kg")})
CASES = {f"case {k}": {"mass": 1.0 + k} for k in range(5)}


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
    monkeypatch.setattr(row_file, "_REWRITE_SECONDS", 0.0)
    monkeypatch.setattr(row_file, "_REWRITE_SHARE", inf)
    path, seen = tmp_path / f"rows.{suffix}", list[pd.DataFrame]()
    journal = Journal(tmp_path / "journal", "study", rows=RowFile(path, lambda n: f"{n} [kg]" if n == "mass" else n))
    table = sweep(
        third,
        RIG,
        CASES,
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
    with pytest.raises(InputError, match=r"Parquet needs pyarrow; run: pip install 'pneuopt\[parquet\]'"):
        RowFile(tmp_path / "rows.parquet")


class FullDisk:
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
    disk = FullDisk(rows._sink._file)  # type: ignore[attr-defined]
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
