"""Crawl: the screen and what the search sees; the slow part tunes and runs the rig."""

from pathlib import Path

import pytest

import pneuopt as po
from problems.friction import crawl
from problems.shared.r25 import lagging


def test_the_screen_holds() -> None:
    assert [claim for claim in crawl.screen() if not claim.holds] == []


def test_its_loop_rests_where_the_drive_does_and_sees_the_encoders_lag() -> None:
    drive, p = lagging(po.Stribeck())
    loop = crawl.controlled(drive.system(), dither=False)
    state = dict(zip((q.name for q in loop.states), loop.initial(loop.parameters | p), strict=True))
    assert state["position"] == pytest.approx(0.5)
    assert (state["speed"], state["sensor.reading"]) == (0.0, 0.0)
    assert loop.parameters.value("sensor.lag") == pytest.approx(5.5e-3)


@pytest.mark.slow
def test_crawl(tmp_path: Path) -> None:
    job = crawl.run()
    rows = crawl.main(job)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert set(crawl.BOUNDS) <= set(rows["name"])
    crawl.figure(job).savefig(tmp_path / "crawl.png")
    assert (tmp_path / "crawl.png").stat().st_size > 10_000
