"""Sampled tuning: the continuous gains do not survive 5 ms, those tuned for it do."""

from pathlib import Path

import pytest

from problems.tune import sampled_tuning


@pytest.mark.slow
def test_what_is_tuned_for_its_sample_time_keeps_its_limits(tmp_path: Path) -> None:
    runs = sampled_tuning.run([5.0])
    rows = sampled_tuning.main(runs)
    assert rows["holds"].all()
    figures = rows.set_index("name")["value"]
    assert figures["5ms.continuous.kept"] == 0
    assert figures["5ms.tuned.kept"] == 1
    sampled_tuning.figure(runs).savefig(tmp_path / "picture.png")
