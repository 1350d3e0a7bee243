"""The tuning benchmark: what its rows say, and, slow, one of its runs."""

import math
from pathlib import Path

import benchmark_tuning
import pytest
from benchmark_tuning import Run


def test_a_run_that_never_settles_is_the_worst() -> None:
    good, lost = Run(0.05, 0.06, 3.0, 1.0, 100, 99), Run(0.05, math.nan, 4.0, 1.0, 100, 96)
    rows = benchmark_tuning.main(
        {"8_corners": {"condensed": [good, lost, lost], "de.x3": [good, good, good], "screening": [good]}}
    ).set_index("name")
    assert rows.loc["8_corners.condensed.median", "value"] == math.inf
    assert not rows.loc["8_corners.condensed.median", "holds"]
    assert not rows.loc["8_corners.de_x3_over_ours", "holds"]
    assert rows.loc["8_corners.condensed.fresh.within_5", "value"] == 96
    assert rows.loc["8_corners.screening.best", "value"] == pytest.approx(0.06)


@pytest.mark.slow
def test_one_plant_is_tuned_and_certified(tmp_path: Path) -> None:
    found, traces = benchmark_tuning.run(["5_nominal"], 1)
    (best,) = found["5_nominal"]["condensed"]
    assert best.settling_time <= 0.075
    assert best.overshoot <= 5.0
    assert best.settling_time == pytest.approx(best.claimed, abs=3e-3)
    benchmark_tuning.figure(found, traces).savefig(tmp_path / "picture.png")
