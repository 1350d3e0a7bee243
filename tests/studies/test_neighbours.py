"""Cells of a study that break with their neighbours."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.neighbours import search_again, sweep_from_neighbours
from pneuopt.studies.sweep import grid, sweep

GIVEN = ParameterSet({"a": Parameter(0.0, "1"), "b": Parameter(0.0, "1"), "gain": Parameter(0.0, "1", 0.0, 9.0)})
PLACES = grid(GIVEN, {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]})
STARTS = {"found": "gain"}


def search(p: ParameterSet) -> dict[str, float]:
    """A local search that ends far away in the middle cell, and fails in a corner, unless it starts near by."""
    a, b, start = (p.value(n) for n in ("a", "b", "gain"))
    if (a, b) == (2.0, 2.0) and start == 0:
        raise ConvergenceError("nothing settles")
    lost = (a, b) == (1.0, 1.0) and start == 0
    return {"found": 1.0 if lost else 5.0 + a, "settling": 4.0 if lost else 1.0 + 0.1 * b}


def test_they_are_computed_again_from_the_best_neighbour_and_flagged() -> None:
    with ThreadPoolExecutor(3) as pool:
        first = sweep(search, GIVEN, PLACES, executor=pool)
        table = search_again(search, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
        again = search_again(search, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
    assert first["settling"].max() == 4.0
    assert table["again"].tolist() == [False] * 4 + [True] + [False] * 3 + [True]
    assert not table["breaks"].any()
    np.testing.assert_allclose(table["settling"], 1.0 + 0.1 * table["b"])
    assert (table["error"] == "").all()
    assert table["found"].iloc[4] == 6.0
    assert list(table)[:-2] == list(first)
    assert again.drop(columns="seconds").equals(table.drop(columns="seconds"))


def test_a_cell_that_stays_bad_is_flagged() -> None:
    def stubborn(p: ParameterSet) -> dict[str, float]:
        return {"found": 1.0, "settling": 9.0 if p.value("a") == p.value("b") == 1.0 else 1.0}

    with ThreadPoolExecutor(3) as pool:
        first = sweep(stubborn, GIVEN, PLACES, executor=pool)
        table = search_again(stubborn, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS, executor=pool)
    assert table["breaks"].tolist() == [k == 4 for k in range(9)]
    assert table["settling"].iloc[4] == 9.0


def test_smooth_studies_are_left_alone_and_missing_columns_are_named() -> None:
    def calm(p: ParameterSet) -> dict[str, float]:
        return {"found": 1.0, "settling": 2.0 ** p.value("a")}

    with ThreadPoolExecutor(3) as pool:
        first = sweep(calm, GIVEN, PLACES, executor=pool)
    table = search_again(calm, GIVEN, first, axes=["a", "b"], value="settling", starts=STARTS)  # no process is started
    assert not table[["again", "breaks"]].to_numpy().any()
    with pytest.raises(InputError, match="Ts"):
        search_again(calm, GIVEN, first, axes=["a", "b"], value="Ts", starts=STARTS)


def nearsighted(p: ParameterSet) -> dict[str, float]:
    """A search that gets from its start no further than 1, towards 3 + a + b."""
    start, best = p.value("gain"), 3.0 + p.value("a") + p.value("b")
    found = min(best, start + 1.0)
    return {"found": found, "settling": 1.0 + best - found}


def test_each_cell_starts_from_its_best_neighbour_nearest_to_the_given_parameters_first() -> None:
    given = GIVEN.with_values({"a": 1.0, "b": 2.0, "gain": 5.5})
    axes = {"b": [0.0, 1.0, 2.0], "a": [2.0, 1.0, 0.0]}
    with ThreadPoolExecutor(3) as pool:
        table = sweep_from_neighbours(nearsighted, given, axes, value="settling", starts=STARTS, executor=pool)
        alone = sweep(nearsighted, given, grid(given, axes), executor=pool)
    np.testing.assert_allclose(table["settling"], 1.0)
    assert alone["settling"].max() == 1.5  # from the given start the farthest cell is out of reach
    assert list(table) == ["case", "b", "a", "found", "settling", "seconds", "error", "again", "breaks"]
    assert table["case"].tolist() == list(grid(given, axes))
    assert not table["breaks"].any()


def test_cells_that_fail_are_searched_again_from_a_neighbour_and_flagged_if_they_fail_again() -> None:
    with ThreadPoolExecutor(3) as pool:
        kinds = {"axes": {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]}, "value": "settling", "starts": STARTS}
        table = sweep_from_neighbours(search, GIVEN, executor=pool, **kinds)  # type: ignore[arg-type]
        dead = sweep_from_neighbours(fails, GIVEN, executor=pool, **kinds)  # type: ignore[arg-type]
    assert not table["breaks"].any()  # the corner and the middle start from a neighbour's 5, not from 0
    np.testing.assert_allclose(table["settling"], 1.0 + 0.1 * table["b"])
    assert dead["breaks"].all()
    assert dead[["found", "settling"]].isna().all().all()


def fails(p: ParameterSet) -> dict[str, float]:
    raise ConvergenceError(f"nothing settles at {p.value('a'):g}")
