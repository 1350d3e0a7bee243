"""Files that are read: budgets, what is no file, and one reading a command."""

import os
from pathlib import Path

import pytest

from pneuopt.files.toml import read_toml
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.source import MAX_TOML_BYTES, read_once, read_source, read_toml_source


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"a = " + b"[" * 3000 + b"]" * 3000, "too many brackets in brackets"),
        (b"a = " + b"9" * 5000, "not valid TOML"),
        (b"#" * (MAX_TOML_BYTES + 1), "is larger than 128 KiB"),
        (b"a = \xff", "not a text file in UTF-8"),
        (b"a = 1\na = 2", "not valid TOML"),
        (b"a = 1979-99-99", "not valid TOML"),
    ],
)
def test_toml_that_a_parser_chokes_on_is_refused_in_one_line(text: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    path.write_bytes(text)
    with pytest.raises(InputError, match=said) as refused:
        read_toml(path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < len(str(path)) + 300


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    for path, said in [(tmp_path, "cannot be read"), (Path("a\0b"), r"a\\x00b: cannot be read")]:
        with pytest.raises(InputError, match=said):
            read_toml(path)
    with pytest.raises(InputError, match="File name too long"):
        read_toml("x" * 300)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        for path in (tmp_path / "pipe", Path("/dev/zero")):
            with pytest.raises(InputError, match="is a pipe or a device; give the name of a file"):
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
    with pytest.raises(InputError, match="cannot be read"):
        read_toml_source(path)
    with read_once(sources):  # another process
        assert read_toml_source(path) == b"a = 1"
