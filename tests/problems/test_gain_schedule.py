"""Fixed against scheduled gains: what the rows make of the maps, what the controller is told, and the whole job."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.shared.arrays import Array
from problems.tune import gain_schedule
from problems.tune.gain_schedule import COEFFICIENTS, MAP_LOADS, MAP_PLACES, RANGES, Job

SHAPE = (len(MAP_PLACES), len(MAP_LOADS))


def tuned(settled: float) -> po.TuningResult:
    """A certified result with this worst settling time."""
    figures = {"SettlingTime": settled, "OvershootDistance": 5e-4, "MaxSensitivity": 1.5}
    given = po.ParameterSet({n: po.Parameter(1.0, "1") for n in (*RANGES, *COEFFICIENTS)})
    certified, status = pd.DataFrame({"a move": figures}), SimpleNamespace(converged=True)
    found = SimpleNamespace(certified=certified, parameters=given, status=status, stats={"simulations": 10.0})
    return cast(po.TuningResult, found)


def metrics(settled: float) -> dict[str, Array]:
    """A map of which every cell settles then, within the limits."""
    figures = {"SettlingTime": settled, "OvershootDistance": 5e-4, "MaxSensitivity": 1.5}
    return {n: np.full(SHAPE, value) for n, value in figures.items()}


def rows_of(fixed: float, scheduled: float, maps: dict[str, dict[str, Array]]) -> pd.DataFrame:
    """The rows, by name."""
    seconds = {"fixed": 1.0, "scheduled": 1.0}
    designs = {"fixed": tuned(fixed), "scheduled": tuned(scheduled)}
    return gain_schedule.main(Job(designs, maps, designs["scheduled"].certified, seconds)).set_index("name")


def test_a_schedule_that_is_slower_breaks_its_row() -> None:
    maps = {"fixed": metrics(0.6), "scheduled": metrics(0.5)}
    assert rows_of(0.6, 0.5, maps)["holds"].all()
    rows = rows_of(0.5, 0.55, maps)
    assert list(rows.index[~rows["holds"].astype(bool)]) == ["scheduled.worst_time.share"]


def test_a_cell_that_never_settles_or_breaks_a_limit_is_not_kept() -> None:
    own = metrics(0.5)
    own["SettlingTime"][0, 0] = np.nan
    own["OvershootDistance"][1, 1], own["MaxSensitivity"][2, 2] = 2e-3, 2.1
    assert gain_schedule.kept(own).sum() == own["SettlingTime"].size - 3
    value = rows_of(0.6, 0.5, {"fixed": own, "scheduled": metrics(0.5)})["value"]
    assert value["fixed.map.kept"] == own["SettlingTime"].size - 3
    assert np.isinf(value["fixed.map.worst_time"])
    assert value["fixed.map.median_time"] == 0.5


def test_the_controller_of_a_schedule_alone_is_told_the_load() -> None:
    assert gain_schedule.loads({"heavy": 20.0}, scheduled=False) == {"heavy": {"load.mass": 20.0}}
    assert gain_schedule.loads({"heavy": 20.0}, scheduled=True)["heavy"]["schedule.load"] == 20.0
    assert gain_schedule.axis(scheduled=False).schedule is None
    assert set(COEFFICIENTS) <= set(gain_schedule.axis(scheduled=True).parameters)


@pytest.mark.slow
def test_gain_schedule(tmp_path: Path) -> None:
    job = gain_schedule.run()
    rows = gain_schedule.main(job)
    assert [str(n) for n in rows.loc[~rows["holds"].astype(bool), "name"]] == []
    gain_schedule.figure(job).savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000
