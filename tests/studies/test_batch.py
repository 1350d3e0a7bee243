"""A design on many plants in lanes: held to the independent simulation, the same whatever the chunks, reasons kept."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

import pneuopt as po
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


def test_what_lanes_cannot_do_is_refused_with_the_remedy() -> None:
    loop = po.ClosedLoop(po.SecondOrder().system(), po.PID())
    cases, step = {"a": {"plant.gain": 1.0}}, po.Step(1.0)
    with pytest.raises(po.InputError, match="MaxSensitivity: not read off"):
        po.evaluate_batch(loop, step, loop.parameters, cases, metrics=["MaxSensitivity"])
    with pytest.raises(po.InputError, match="recertify is a share"):
        po.evaluate_batch(loop, step, loop.parameters, cases, recertify=2.0)
    with pytest.raises(po.InputError, match="nonsense"):
        po.evaluate_batch(loop, step, loop.parameters, {"a": {"nonsense": 1.0}})
