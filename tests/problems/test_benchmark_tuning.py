"""The tuning benchmark: what its rows say, and, slow, one of its runs."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from pneuopt.tuning.space import search_space
from problems.speed import benchmark_tuning
from problems.speed.benchmark_tuning import Clock, Run, Study


def test_a_run_that_never_settles_is_the_worst() -> None:
    good, lost = Run(0.05, 0.06, 3.0, 1.0, 100, 99), Run(0.05, math.nan, 4.0, 1.0, 100, 96)
    runs = {"10_corners": {"condensed": [good, lost, lost], "de.x1": [good, good, good]}}
    study = Study(runs, {}, {"10_corners": {"de": [2.0, math.inf, math.inf]}})
    rows = benchmark_tuning.main(study).set_index("name")
    assert rows.loc["10_corners.condensed.median", "value"] == math.inf
    assert not rows.loc["10_corners.condensed.median", "holds"]
    assert rows.loc["10_corners.condensed.fresh.within_5", "value"] == 96
    assert rows.loc["10_corners.de.x1.best", "value"] == pytest.approx(0.06)
    assert rows.loc["10_corners.de.reach", "value"] == math.inf
    assert rows.loc["10_corners.condensed.at_median_of_de", "value"] == pytest.approx(100 / 3)
    assert rows.loc["10_corners.condensed.reach_of_de", "value"] == math.inf
    runs["10_corners"]["condensed"] = [good, good, lost]
    rows = benchmark_tuning.main(study).set_index("name")
    assert rows.loc["10_corners.condensed.reach_of_de", "value"] == 1.0


def test_differential_evolution_uses_its_time_though_its_members_are_alike() -> None:
    calls = 0

    class Flat:
        def merits(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
            nonlocal calls
            calls += 1
            if calls == 9:
                raise StopIteration
            return 1.0 + 1e-6 * points[:, 0]

    benchmark_tuning.evolve(Flat(), search_space(*benchmark_tuning.posed(5)), 0, {})  # type: ignore[arg-type]
    assert calls == 9


def test_the_clock_stops_at_the_goal_and_keeps_what_was_there_before() -> None:
    best = iter([0.3, 0.2, 0.1])

    class Simulated:
        def respond(self, points: NDArray[np.float64], band: float) -> SimpleNamespace:  # noqa: ARG002
            value = np.full(len(points), next(best))
            return SimpleNamespace(values={"SettlingTime": value, "Overshoot": 0 * value, "Excess": 0 * value})

    clock = Clock(Simulated(), (0.0, 0.0, 60.0), 0.15)  # type: ignore[arg-type]
    clock.merits(np.array([[3.0]]))
    clock.merits(np.array([[2.0]]))
    with pytest.raises(StopIteration):
        clock.merits(np.array([[1.0]]))
    assert clock.best == pytest.approx(0.1)
    assert 0 < clock.reached < 60


@pytest.mark.slow
def test_one_plant_is_tuned_and_certified(tmp_path: Path) -> None:
    study = benchmark_tuning.run(["5_nominal"], 1, 3.0)
    (best,) = study.runs["5_nominal"]["condensed"]
    assert best.settling_time <= 0.075
    assert best.overshoot <= 5.0
    assert best.settling_time == pytest.approx(best.claimed, abs=3e-3)
    benchmark_tuning.figure(study).savefig(tmp_path / "picture.png")
