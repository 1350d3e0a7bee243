"""Fresh processes on a busy machine do not crash."""

from pathlib import Path

import pytest

from tests.cli.under_load import run_under_load


@pytest.mark.slow
def test_no_process_crashes_under_load(tmp_path: Path) -> None:
    assert run_under_load(20, 4, tmp_path) == {0: 20}
