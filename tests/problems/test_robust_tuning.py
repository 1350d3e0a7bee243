"""Robust tuning: the part on T32 holds what it claims."""

from pathlib import Path

import pytest

from problems.tune import robust_tuning


@pytest.mark.slow
def test_the_drive_is_robust_on_fresh_plants(tmp_path: Path) -> None:
    part = robust_tuning.drive(1)
    rows = robust_tuning.main({"drive": part})
    assert rows["holds"].all()
    kept = rows.set_index("name")["value"]
    assert kept["drive.robust.fresh.overshoot.kept"] >= 95
    assert kept["drive.robust.worst.overshoot"] < kept["drive.nominal.worst.overshoot"]
    robust_tuning.figure(part, 0.02).savefig(tmp_path / "picture.png")
