"""The map of crawl: its measure, its boundary and a corner of it; the slow part simulates the whole."""

from pathlib import Path

import numpy as np
import pytest

import pneuopt as po
from problems.paper import paper_crawl


def test_uniform_sliding_is_unstable_where_friction_falls_with_speed() -> None:
    """Around the Stribeck velocity it does; far above, nothing falls, and nothing hunts."""
    assert paper_crawl.unstable_from(12.0) == pytest.approx(1.144, abs=2e-3)
    slow, fast = (paper_crawl.fastest_growth(1.6, v) for v in (12.0, 80.0))
    assert slow > 0 > fast


def test_the_less_static_and_kinetic_friction_differ_the_less_it_crawls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_crawl, "SECONDS", 3.0)
    monkeypatch.setattr(paper_crawl, "TRAVEL", 100.0)
    paper_crawl.crawl.cache_clear()
    equal, some, much = (paper_crawl.unevenness(ratio, 12.0) for ratio in (1.0, 1.3, 1.8))
    paper_crawl.crawl.cache_clear()
    assert equal[0] == 0
    assert equal[1] < 0.01
    assert 0.2 < some[0] < much[0] - 0.2
    assert some[1] < much[1]


def test_the_share_stuck_is_taken_over_whole_cycles(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(0, 10, 0.01)
    stuck = (np.mod(t, 3.0) < 1.2).astype(float)  # 40 % of a cycle; the last 6 s alone hold more
    run = po.Trajectory(t, {"stuck": stuck, "speed": 1 - stuck})
    monkeypatch.setattr(paper_crawl, "crawl", lambda _ratio, _v: run)
    assert paper_crawl.unevenness(1.5, 10.0)[0] == pytest.approx(0.4, abs=0.01)


@pytest.mark.slow
def test_the_whole_map(tmp_path: Path) -> None:
    found = paper_crawl.run()
    rows = paper_crawl.main(found)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    for picture in paper_crawl.figures(found).values():
        picture.savefig(tmp_path / "crawl.png")
    assert (tmp_path / "crawl.png").stat().st_size > 10_000
