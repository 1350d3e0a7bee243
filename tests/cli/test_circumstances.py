"""Full disks, damaged and foreign caches, moved inputs, processes and threads lose nothing and show no traceback."""

import os
import tempfile
from pathlib import Path

import pytest

from tests.cli.circumstances import CIRCUMSTANCES, try_circumstances


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="redirections, mounts and users of Linux")
def test_unlucky_circumstances_lose_nothing() -> None:
    with tempfile.TemporaryDirectory() as folder:  # not pytest's, which no other user may enter
        Path(folder).chmod(0o755)
        outcomes = list(try_circumstances(Path(folder)))
    assert [str(outcome) for outcome in outcomes if outcome.fault] == []
    assert len(outcomes) == len(CIRCUMSTANCES) or os.geteuid() != 0
