"""A design on many plants in lanes: held to the independent simulation, the same whatever the chunks, reasons kept."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pneuopt as po
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.studies.batch import PlantBatch
from problems.shared.t32 import SPREADS, STEP, benchmark

GAINS = {"pid.Kp": 2.806, "pid.Ki": 83.63, "pid.Kd": 0.1103, "dither.offset": -0.07758}


@cache
def batch(amplitude: float, count: int, recertify: float, chunk: int) -> po.BatchEvaluation:
    loop, given = benchmark()
    design = given.with_values(GAINS | {"dither.amplitude": amplitude})
    plants = po.samples(given, SPREADS, count)
    settings = {"recertify": recertify, "chunk": chunk, "executor": ThreadPoolExecutor(1)}
    return po.evaluate_batch(loop, STEP, design, plants, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("amplitude", [0.6155, 0.0])
def test_lanes_and_the_independent_simulation_agree_on_every_plant(amplitude: float) -> None:
    found = batch(amplitude, 20, 1.0, 128)
    assert found.checks["case"].nunique() == 20
    assert found.checks["agrees"].all()
    assert (found.table["error"] == "").all()


def test_the_table_does_not_depend_on_how_many_plants_run_at_a_time() -> None:
    whole, parts = batch(0.6155, 30, 0.0, 128), batch(0.6155, 30, 0.0, 7)
    assert whole.table.equals(parts.table)
    assert whole.checks.equals(parts.checks)


def test_a_plant_that_cannot_be_is_a_row_with_its_reason_and_the_others_are_computed() -> None:
    loop = po.ClosedLoop(po.SecondOrder().system(), po.PID())
    rig = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 2.0})
    plants = {"good": {"plant.gain": 1.0}, "none": {"plant.gain": float("nan")}, "wild": {"pid.Kp": -1e4}}
    step, alone = po.Step(1.0, horizon=4.0), ThreadPoolExecutor(1)
    rows = po.evaluate_batch(loop, step, rig, plants, executor=alone).table.set_index("case").to_dict("index")
    assert rows["good"]["error"] == ""
    assert "plant.gain is nan" in rows["none"]["error"]
    assert np.isnan(rows["none"]["Overshoot"])
    assert "runs away" in rows["wild"]["error"]
    same = po.evaluate(loop, step, rig).iloc[:, 0]
    assert rows["good"]["Overshoot"] == pytest.approx(same["Overshoot"], abs=1e-4)


def test_a_difference_is_said() -> None:
    loop = po.ClosedLoop(po.SecondOrder().system(), po.PID())
    rig = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 2.0})
    plants, alone = po.samples(rig, {"plant.gain": 0.1}, 5), ThreadPoolExecutor(1)
    found = po.evaluate_batch(loop, po.Step(1.0, horizon=4.0), rig, plants, tolerance=0.0, executor=alone)
    assert "differ" in found.summary().to_text()
    assert not found.checks["agrees"].all()


def test_a_killed_batch_goes_on_where_it_was_and_gives_the_same_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = po.ClosedLoop(po.SecondOrder().system(), po.PID())
    rig = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 2.0})
    plants, ran = po.samples(rig, {"plant.gain": 0.1}, 12), list[int]()
    measure = PlantBatch.measure

    def evaluate(journal: po.Journal | None) -> po.BatchEvaluation:
        one = ThreadPoolExecutor(1)
        step = po.Step(1.0, horizon=4.0)
        return po.evaluate_batch(loop, step, rig, plants, chunk=5, executor=one, journal=journal, recertify=0.3)

    def measure_until_ctrl_c(self: PlantBatch, rows: Indices, columns: Mapping[str, Array]) -> None:
        if len(ran) == 5:
            raise KeyboardInterrupt
        ran.extend(rows.tolist())
        measure(self, rows, columns)

    whole = evaluate(None)
    monkeypatch.setattr(PlantBatch, "measure", measure_until_ctrl_c)
    journal = po.Journal(tmp_path / "journal", "batch")
    cut = evaluate(journal)
    journal.close(finished=False)
    assert (cut.table["error"] == "interrupted").sum() == 7
    assert cut.table[:5].equals(whole.table[:5])
    assert len(cut.checks) == 0
    monkeypatch.setattr(PlantBatch, "measure", measure)
    journal = po.Journal(tmp_path / "journal", "batch", resume=True)
    assert set(journal.known) == set(list(plants)[:5])
    again = evaluate(journal)
    journal.close(finished=False)
    assert again.table.equals(whole.table)
    assert again.checks.equals(whole.checks)
    monkeypatch.setattr(PlantBatch, "measure", None)  # nothing is left to run
    journal = po.Journal(tmp_path / "journal", "batch", resume=True)
    assert evaluate(journal).table.equals(whole.table)
    journal.close(finished=True)


def test_one_metric_is_a_name_and_no_letters() -> None:
    loop = po.ClosedLoop(po.SecondOrder().system(), po.PID())
    step, nominal, spreads = po.Step(1.0), {"a": dict[str, float]()}, {"plant.gain": 0.1}
    for metrics, words in (("Overshot", r"'Overshot'"), (3, r"^metrics takes names of metrics")):
        with pytest.raises(po.InputError, match=words):
            po.evaluate_batch(loop, step, loop.parameters, nominal, metrics=metrics)  # type: ignore[arg-type]
        with pytest.raises(po.InputError, match=words):
            po.local_sensitivity(loop, step, loop.parameters, spreads, metrics=metrics)  # type: ignore[arg-type]
