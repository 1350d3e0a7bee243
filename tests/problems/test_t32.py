"""The tuning benchmark: what its rows say, that rivals use their time and no more, and, slow, one of its runs."""

import time
from math import inf
from pathlib import Path

import numpy as np
import pytest

import pneuopt as po
from pneuopt.evaluation.specification import specify
from pneuopt.quantities.arrays import Array
from problems.shared.t32 import MINIMISE, OVERSHOOT, ROWS, SENSITIVITY, STEP, benchmark
from problems.speed import t32
from problems.speed.t32 import RIVALS, Clock, OutOfTimeError, Run, Study


def test_a_design_without_certificate_is_the_worst() -> None:
    good, lost = Run(0.05, 3.0, 1.8, 1.0), Run(inf, 3.0, 1.8, 1.0)
    runs = {"10_corners": {"racing": [good, lost, lost], "de.x1": [good, good, good]}}
    rows = t32.main(Study(runs)).set_index("name")
    assert rows.loc["10_corners.racing.median", "value"] == inf
    assert rows.loc["10_corners.racing.without_certificate", "value"] == 2
    assert rows.loc["10_corners.racing.within_5_percent", "value"] == pytest.approx(100 / 3)
    assert not rows.loc["10_corners.racing.within_5_percent", "holds"]
    assert rows.loc["10_corners.best_rival_over_racing", "value"] == 0
    assert rows.loc["10_corners.reference", "value"] == pytest.approx(0.05)


def test_where_no_method_finds_a_certified_design_none_is_near_the_best(tmp_path: Path) -> None:
    lost = Study({"10_corners": {"racing": [Run(inf, 3.0, 1.8, 1.0)], "de.x1": [Run(inf, 3.0, 1.8, 1.0)]}})
    assert not t32.main(lost).set_index("name").loc["10_corners.racing.within_5_percent", "holds"]
    t32.figure(lost).savefig(tmp_path / "picture.png")


class Bowl:
    """A merit with its least at .3 in each gain, which takes a while."""

    def __call__(self, unit: Array, rivals: Array) -> Array:  # noqa: ARG002 - a merit function's
        time.sleep(1e-4)
        return np.asarray(np.sum((unit - 0.3) ** 2, axis=1))


@pytest.mark.parametrize("rival", RIVALS)
def test_a_rival_uses_its_time_and_finds_the_bottom_of_a_bowl(rival: str) -> None:
    clock = Clock(Bowl(), 0.5)
    with pytest.raises(OutOfTimeError):
        RIVALS[rival](clock, np.full(3, 0.9), 0)
    assert len(clock.kept) == t32.REREAD
    np.testing.assert_allclose(clock.kept[0][1], 0.3, atol=0.02)


def test_the_rows_free_the_gains_and_draw_the_plants_that_they_name() -> None:
    counts = {name: (row.gains, len(row.scenarios(benchmark(row.gains)[1]))) for name, row in ROWS.items()}
    assert counts == {"5_nominal": (5, 0), "5_corners": (5, 8), "10_corners": (10, 8), "10_plants": (10, 32)}
    assert len(benchmark(10)[1].free_names) == 10


@pytest.mark.slow
def test_one_plant_is_tuned_and_certified(tmp_path: Path) -> None:
    search = t32.prepare("5_nominal", specify(MINIMISE, [OVERSHOOT, SENSITIVITY]), po.Racing())
    method, seed, found = next(t32.compete(search, 1))
    assert (method, seed) == ("racing", t32.FIRST_SEED)
    assert found.settling_time < 0.1 * STEP.horizon
    assert found.max_sensitivity <= 2.0
    t32.figure(Study({"5_nominal": {"racing": [found]}})).savefig(tmp_path / "picture.png")
