"""The map's rows count a case that never settles as never."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.tune import supply_and_load


def rows_of(settled: list[float]) -> dict[str, float]:
    """The map's rows of a study with these settling times."""
    n = len(settled)
    study = pd.DataFrame({"SettlingTime": settled, "Overshoot": np.arange(n, dtype=float), "error": [""] * n})
    study["supply.pressure"], study["load.mass"] = 1e5 * np.arange(1, n + 1), 5.0
    certified = pd.DataFrame({"0 to 0.1": {"SettlingTime": 0.1, "Overshoot": 4.0}})
    best = SimpleNamespace(parameters=po.ParameterSet({}), certified=certified)
    cells = {"SettlingTime": [0.1, np.nan], "error": ["", "refused"], "again": [False, True], "breaks": [False, True]}
    job = supply_and_load.Job(cast(po.TuningResult, best), study, pd.DataFrame(cells), 0.0)
    return dict(zip(*(supply_and_load.main(job)[k] for k in ("name", "value")), strict=True))


def test_a_case_that_never_settles_is_the_worst_and_counts_in_the_median() -> None:
    rows = rows_of([0.1, np.nan, 0.2, np.nan, 0.3])
    assert rows["map.never_settle"] == 2
    assert rows["map.settling_time.worst"] == np.inf
    assert rows["map.settling_time.worst.pressure"] == 2
    assert rows["map.settling_time.median"] == pytest.approx(0.3)
    assert rows["map.settling_time.best"] == pytest.approx(0.1)


def test_where_most_never_settle_neither_does_the_median() -> None:
    assert rows_of([0.1, np.nan, np.nan])["map.settling_time.median"] == np.inf


def test_where_all_settle_nothing_changes() -> None:
    rows = rows_of([0.3, 0.1, 0.2])
    assert (rows["map.never_settle"], rows["map.settling_time.worst"]) == (0, 0.3)
    assert rows["map.settling_time.worst.pressure"] == 1


def test_a_cell_that_fails_or_breaks_is_counted_and_never_settles() -> None:
    rows = rows_of([0.3, 0.1, 0.2])
    assert (rows["retuned.failed"], rows["retuned.breaks"]) == (1, 1)
    assert rows["retuned.settling_time.worst"] == np.inf
