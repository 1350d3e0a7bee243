"""What stays in the cache of compiled models."""

import os
import time
from pathlib import Path

import pytest

from pneuopt.dynamics.compiled import library_cache
from pneuopt.dynamics.compiled.library_cache import NOTICE_TIME, find_library, keep_library, trim_cache

DAY = 24 * 3600.0


def library(folder: Path, name: str, days: float, size: int = 100) -> Path:
    path = folder / f"{name}.so"
    path.write_bytes(b"x" * size)
    then = time.time() - days * DAY
    os.utime(path, (then, then))
    return path


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_was_not_used_for_half_a_year_goes(tmp_path: Path) -> None:
    library(tmp_path, "new", 0)
    library(tmp_path, "spring", 170)
    library(tmp_path, "winter", 190)
    (tmp_path / "zig").mkdir()
    trim_cache(tmp_path)
    assert left(tmp_path) == {"new.so", "spring.so", "zig"}


def test_too_many_go_from_the_one_unused_for_longest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library_cache, "LARGEST_SIZE", 250)
    for k in range(4):
        library(tmp_path, f"l{k}", k)
    trim_cache(tmp_path)
    assert left(tmp_path) == {"l0.so", "l1.so"}


def test_what_a_killed_process_left_goes_after_a_day(tmp_path: Path) -> None:
    for name, days in (("compile-a", 0.1), ("compile-b", 2.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.c").touch()
        then = time.time() - days * DAY
        os.utime(tmp_path / name, (then, then))
    trim_cache(tmp_path)
    assert left(tmp_path) == {"compile-a"}


def test_a_use_counts_and_a_new_library_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    product = tmp_path / "product"
    product.write_bytes(b"one")
    one = keep_library(tmp_path, "one", product)
    then = time.time() - 2 * NOTICE_TIME
    os.utime(one, (then, then))
    assert find_library(tmp_path, "one") == one
    assert time.time() - one.stat().st_mtime < NOTICE_TIME
    monkeypatch.setattr(library_cache, "LARGEST_SIZE", 2)
    product.write_bytes(b"two")
    two = keep_library(tmp_path, "two", product)
    assert left(tmp_path) == {two.name}
