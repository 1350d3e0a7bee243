"""Crawl: the screen and what the search sees; the slow part tunes and runs the rig."""

from pathlib import Path

import crawl
import numpy as np
import pytest
from r25 import lagging

import pneuopt as po


def test_the_screen_holds() -> None:
    assert [claim for claim in crawl.screen() if not claim.holds] == []


def test_the_search_sees_the_speed_behind_a_lag() -> None:
    """A volt from rest: the lagged speed is the convolution of the true one with the lag."""
    lag = 5.5e-3
    drive, p = lagging(po.Stribeck())
    plant = crawl.seen(drive.system(), lag)
    t = np.linspace(0, 0.3, 601)
    start = drive.rest(p).states
    run = po.simulate(plant, po.Trajectory(t, {"valve_voltage": np.ones(len(t))}), p, initial=start)
    true, late = run["speed"], np.zeros(len(t))
    a = np.exp(-(t[1] - t[0]) / lag)
    for k in range(1, len(t)):
        late[k] = a * late[k - 1] + (1 - a) * (true[k] + true[k - 1]) / 2
    assert true.max() > 0.05
    assert run["seen"] == pytest.approx(late, abs=1e-4)


def test_its_loop_rests_where_the_drive_does() -> None:
    drive, p = lagging(po.Stribeck())
    loop = crawl.controlled(crawl.seen(drive.system(), 5e-3), "seen", dither=False)
    state = dict(zip((q.name for q in loop.states), loop.initial(loop.parameters | p), strict=True))
    assert state["position"] == pytest.approx(0.5)
    assert (state["speed"], state["seen"]) == (0.0, 0.0)


@pytest.mark.slow
def test_crawl(tmp_path: Path) -> None:
    job = crawl.run()
    rows = crawl.main(job)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert set(crawl.BOUNDS) <= set(rows["name"])
    crawl.figure(job).savefig(tmp_path / "crawl.png")
    assert (tmp_path / "crawl.png").stat().st_size > 10_000
