"""Libraries that read a format for us fail alone, and in one line."""

import os
import warnings
from pathlib import Path

import pytest

from pneuopt.logs.table import foreign_code, run_apart
from pneuopt.quantities.errors import LogError


def end_process(path: Path, raw: bytes) -> bytes:
    if raw == b"damaged":
        os.abort()
    return raw[::-1]


def test_a_library_that_ends_its_process_leaves_ours_alone() -> None:
    with pytest.raises(LogError, match=r"run\.mf4"):
        run_apart(end_process, Path("run.mf4"), b"damaged", kind="MDF")


def test_what_a_library_reads_apart_comes_back() -> None:
    assert run_apart(end_process, Path("run.mf4"), b"abc", kind="MDF") == b"cba"


def test_what_a_library_raises_or_warns_of_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        warnings.warn("odd", stacklevel=1)
        raise RuntimeError("line one\nline two " + "x" * 1000)

    with pytest.raises(LogError) as error, foreign_code(Path("run.mf4"), "MDF"):
        fail()
    assert str(error.value).startswith("run.mf4: cannot be read as MDF (RuntimeError: line one line two xxx")
    assert len(str(error.value)) < 300
    assert capsys.readouterr().err == ""
