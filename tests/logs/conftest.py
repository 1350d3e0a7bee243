from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def libraries_run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read MDF in this process: the files are sound, and a process takes a second of CPU."""

    def run_here(read: Callable[[Path, bytes], object], path: Path, raw: bytes, kind: str) -> object:
        return read(path, raw)

    monkeypatch.setattr("pneuopt.logs.foreign.run_apart", run_here)
