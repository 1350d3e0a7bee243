"""A study that ends early goes on where it was."""

from concurrent.futures import ThreadPoolExecutor
from math import nan
from pathlib import Path

import pandas as pd
import pytest

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.cases import grid
from pneuopt.studies.journal import Journal
from pneuopt.studies.neighbours import sweep_from_neighbours
from pneuopt.studies.outcome import INTERRUPTED_CASE, Outcome
from pneuopt.studies.sweep import sweep

RIG = ParameterSet({"mass": Parameter(1.0, "kg"), "gain": Parameter(1.0, "1")})
CASES = grid(RIG, {"mass": [1.0, 2.0, 3.0, 4.0]})


def sweep_with(path: Path, seen: list[float], stop_at: float = nan, identity: str = "study") -> pd.DataFrame:
    def cell(p: ParameterSet) -> dict[str, float | str | bool]:
        seen.append(p.value("mass"))
        if p.value("mass") == stop_at:
            raise KeyboardInterrupt
        if p.value("mass") == 2.0 and stop_at == 4.0:
            raise ValueError("unlucky")
        return {"third": p.value("mass") / 3, "none": nan, "word": "a", "flag": True}

    journal = Journal(path, identity)
    try:
        return sweep(cell, RIG, CASES, executor=ThreadPoolExecutor(1), journal=journal)
    finally:
        journal.close(finished=False)


def test_a_study_goes_on_where_it_was_and_ends_in_the_same_table(tmp_path: Path) -> None:
    path, seen, again = tmp_path / "cells.csv.journal", list[float](), list[float]()
    first = sweep_with(path, seen, stop_at=4.0)
    assert first["error"].tolist()[-1] == INTERRUPTED_CASE
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])  # killed while it wrote
    second = sweep_with(path, again)
    assert sorted(again) == [2.0, 3.0, 4.0]  # the one that failed, the one that was cut, the one not reached
    assert (second["error"] == "").all()
    nothing = list[float]()
    third = sweep_with(path, nothing)
    assert nothing == []
    pd.testing.assert_frame_equal(second.drop(columns="seconds"), third.drop(columns="seconds"))
    assert third["third"].tolist() == [m / 3 for m in (1.0, 2.0, 3.0, 4.0)]


def test_what_another_study_has_left_is_not_read(tmp_path: Path) -> None:
    path, seen = tmp_path / "journal", list[float]()
    sweep_with(path, seen)
    sweep_with(path, seen, identity="with another mass")
    assert len(seen) == 8
    path.write_bytes(b"\xff\n[1]\n")
    journal = Journal(path, "study")
    assert journal.known == {}
    journal.close(finished=True)


def test_a_study_that_is_done_leaves_no_journal(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", "study")
    journal.add("a", Outcome({"x": 1.0}, 0.1))
    journal.close(finished=True)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="cannot be written"):
        Journal(tmp_path / "none" / "journal", "study")


def test_an_interrupted_search_from_neighbours_begins_no_other_wave() -> None:
    seen = list[float]()

    def cell(p: ParameterSet) -> dict[str, float]:
        seen.append(p.value("mass"))
        if p.value("mass") == 2.0:
            raise KeyboardInterrupt
        return {"gain found": 2.0, "excess": 1.0}

    table = sweep_from_neighbours(
        cell,
        RIG,
        {"mass": [1.0, 2.0, 3.0, 4.0]},
        value="excess",
        starts={"gain found": "gain"},
        executor=ThreadPoolExecutor(1),
    )
    assert seen == [1.0, 2.0]
    assert table["error"].tolist() == ["", *[INTERRUPTED_CASE] * 3]
    assert table["mass"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert not table["again"].any()
