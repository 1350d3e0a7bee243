"""What the commands' tests share."""

import pytest


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error holds what a command says, however slow the machine is."""
    monkeypatch.setattr("pneuopt.cli.terminal.SECONDS_A_LINE", 3600.0)
