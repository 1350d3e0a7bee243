"""The scripts of restarts and of faulty samples: their rows hold, and a controller that breaks a promise is found."""

import shutil

import numpy as np
import pytest

from problems.demo import faulty_samples, restart_tables

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler on the path")


@needs_gcc
@pytest.mark.slow
def test_a_controller_goes_through_all_languages() -> None:
    rows = faulty_samples.main([3, 7])
    assert rows["holds"].all()
    assert rows.set_index("name").loc["count.sequences", "value"] == 20


@pytest.mark.slow
def test_a_broken_promise_is_found() -> None:
    """An output that follows a bad sample, one that never stops, and a flag that stays off."""
    case = faulty_samples.draw_case(3)
    given = faulty_samples.draw_sequence(case, 11)
    sent, flags = faulty_samples.run_library(case, given)
    first = int(np.flatnonzero(given.is_bad)[0])
    followed = np.where(np.arange(len(sent)) == first, sent + 1e-3, sent)
    for found, row in (((followed, flags), "held"), ((sent, ~flags), "flags")):
        tally = faulty_samples.Tally()
        faulty_samples.judge(case, given, {"library": found}, tally)
        assert max(tally.differences.get(row, 0.0), tally.counts.get(row, 0)) > 1e-6


@needs_gcc
@pytest.mark.slow
def test_the_cascade_restarts() -> None:
    rows = restart_tables.main(quick=True)
    assert rows["holds"].all()
