"""Files that are read: budgets, what is no file, and one reading a command."""

import json
import math
import os
import re
import stat
from io import StringIO
from pathlib import Path

import pandas as pd
import pytest

from pneuopt.files.toml import read_toml
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.output import (
    MAX_TOML_BYTES,
    check_output_paths,
    format_table,
    read_once,
    read_source,
    read_toml_source,
    records,
    write_json,
    write_text,
)


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.toml"
    path.write_text("before", encoding="utf-8")
    write_text(path, "after\n")
    assert path.read_bytes() == b"after\n"
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half of it \ud800")
    assert path.read_bytes() == b"after\n"
    assert [p.name for p in tmp_path.iterdir()] == ["out.toml"]


def test_records_are_plain() -> None:
    frame = pd.DataFrame({"value": [1.5, math.nan, math.inf], "holds": [True, False, True], "unit": ["%", "s", "µm"]})
    found = records(frame)
    assert found[0] == {"value": 1.5, "holds": True, "unit": "%"}
    assert [type(v) for v in found[0].values()] == [float, bool, str]
    assert [r["name"] for r in records(frame.set_axis(["a", "b", "c"], axis=0))] == ["a", "b", "c"]


def test_a_table_of_logs_and_channels_keeps_both_names() -> None:
    frame = pd.DataFrame({"log": ["a", "b"], "channel": ["speed", "speed"], "rmse": [1.0, 2.0]})
    assert records(frame.set_index(["log", "channel"])) == frame.to_dict(orient="records")


def test_a_document_is_plain_json(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": {"b": math.nan, "path": Path("c")}, "rows": [{"v": math.inf}]})
    said = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert said == {"a": {"b": None, "path": "c"}, "rows": [{"v": None}]}


def test_outputs_are_refused_before_the_work(tmp_path: Path) -> None:
    given = tmp_path / "drive.toml"
    given.touch()
    check_output_paths([tmp_path / "fit.toml", None, tmp_path / "fit.json"], [given])
    taken, folder = [tmp_path / "a", tmp_path / "a"], [tmp_path]
    for outputs in ([tmp_path / "." / "drive.toml"], taken, [tmp_path / "none" / "a"], folder):
        with pytest.raises(InputError, match=re.escape(str(outputs[0]))):
            check_output_paths(outputs, [given])


@pytest.mark.skipif(os.name == "nt", reason="links, modes and pipes are POSIX")
def test_a_link_stays_and_the_file_behind_it_keeps_its_mode(tmp_path: Path) -> None:
    real = tmp_path / "real.toml"
    real.write_text("before")
    real.chmod(0o640)
    link = tmp_path / "fit.toml"
    link.symlink_to(real)
    write_text(link, "after\n")
    assert link.is_symlink()
    assert (real.read_text(), stat.S_IMODE(real.stat().st_mode)) == ("after\n", 0o640)
    old = os.umask(0o027)
    try:
        write_text(tmp_path / "new.toml", "")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "new.toml").stat().st_mode) == 0o640
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="loop: "):
        write_text(tmp_path / "loop", "")


@pytest.mark.skipif(os.name == "nt", reason="links, modes and pipes are POSIX")
def test_a_pipe_and_a_device_are_never_replaced(tmp_path: Path) -> None:
    """As root, `-o /dev/null` made a file of the machine's null device."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    (tmp_path / "null").symlink_to("/dev/null")
    for path in (pipe, tmp_path / "null", Path("/dev/null")):
        with pytest.raises(InputError, match=re.escape(str(path))):
            write_text(path, "x")
        with pytest.raises(InputError, match=re.escape(str(path))):
            check_output_paths([path], [])
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    assert stat.S_ISCHR(Path("/dev/null").lstat().st_mode)


def test_a_name_of_250_characters_is_written(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 245}.toml"
    check_output_paths([path], [])
    write_text(path, "a")
    assert path.read_text() == "a"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_write_protected_file_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "fit.toml"
    path.write_text("kept")
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda p, mode: Path(p) != path.resolve() and allowed(p, mode))  # root may all
    with pytest.raises(InputError, match=r"fit\.toml"):
        write_text(path, "lost")
    assert path.read_text() == "kept"


def test_a_disk_that_is_full_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "fit.toml"
    path.write_text("kept")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_text(path, "lost")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["kept"]


def test_text_in_a_table_is_no_formula() -> None:
    """Names of logs, cases and columns come from users; a spreadsheet computes what begins with = + - @."""
    hostile = ["=cmd|' /C calc'!A0", "+1", "-1+1", "@SUM(A1)", "\t=1", "run_01", "a=b"]
    frame = pd.DataFrame({"=HYPERLINK(1)": hostile, "value": [-1.5, *range(6)]})
    read = pd.read_csv(StringIO(format_table(frame)))
    assert list(read) == ["'=HYPERLINK(1)", "value"]
    assert read.iloc[:, 0].tolist() == [f"'{text}" for text in hostile[:5]] + hostile[5:]
    assert read["value"].tolist() == [-1.5, *range(6)]


@pytest.mark.parametrize(
    "text",
    [
        b"a = " + b"[" * 3000 + b"]" * 3000,
        b"a = " + b"9" * 5000,
        b"#" * (MAX_TOML_BYTES + 1),
        b"a = \xff",
        b"a = 1\na = 2",
        b"a = 1979-99-99",
    ],
    ids=["nested", "long number", "large", "encoding", "twice", "date"],
)
def test_toml_that_a_parser_chokes_on_is_refused_in_one_line(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    path.write_bytes(text)
    with pytest.raises(InputError) as refused:
        read_toml(path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < len(str(path)) + 300


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    for path in (tmp_path, Path("a\0b"), Path("x" * 300)):
        with pytest.raises(InputError):
            read_toml(path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        for path in (tmp_path / "pipe", Path("/dev/zero")):
            with pytest.raises(InputError, match=re.escape(str(path))):
                read_source(path, 10, "")


def test_a_file_that_moves_or_changes_during_a_command_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    path.write_bytes(b"a = 1")
    with read_once() as sources:
        assert read_toml_source(path) == b"a = 1"
        path.write_bytes(b"a = 2")
        assert read_toml_source(path) == b"a = 1"
        path.unlink()
        with read_once():  # a part of the command sees what the command has read
            assert read_toml_source(path) == b"a = 1"
    with pytest.raises(InputError):
        read_toml_source(path)
    with read_once(sources):  # another process
        assert read_toml_source(path) == b"a = 1"
