"""Fresh plants: an integrator under P control settles after ln 50/(K Kp), so that each figure is known."""

import math

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, PhaseMargin, SettlingTime
from pneuopt.evaluation.scenarios import apply_scenario, samples, tolerances
from pneuopt.models.linear import FirstOrder, Integrator
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.validation import validate_design

STEPS = [Step(1.0, horizon=2.0), Step(-0.5, horizon=1.5)]


def integrator(Kp: float = 5.0) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(Integrator().system(), PID(limits=False))
    return loop, loop.parameters.with_values({"plant.gain": 1.0, "pid.Kp": Kp})


def test_the_figures_are_those_of_the_plants() -> None:
    """Median, 95th of 100, worst and the count above the limit, from each plant's own settling time."""
    loop, design = integrator()
    plants = samples(design, {"plant.gain": 0.2}, 100, seed=3)
    times = {n: math.log(50) / (5 * v["plant.gain"]) for n, v in plants.items()}
    limit = 0.9
    found = validate_design(loop, STEPS, design, minimise=SettlingTime(max=limit), scenarios=plants)
    row, ordered = found.summary.loc["SettlingTime"], sorted(times.values())
    assert row["worst"] == pytest.approx(ordered[-1], rel=1e-3)
    assert row["certified"] == pytest.approx(ordered[-1], rel=1e-3)
    assert row["p95"] == pytest.approx(ordered[94], rel=1e-3)
    assert row["median"] == pytest.approx(ordered[49], rel=1e-3)
    assert row["worst_plant"] == max(times, key=lambda n: times[n])
    assert row["violations"] == sum(t > limit for t in times.values()) > 0
    assert found.plants["SettlingTime"].to_numpy() == pytest.approx(list(times.values()), rel=1e-3)


def test_what_never_settles_is_the_worst_and_counted_without_a_limit() -> None:
    loop, design = integrator(1.0)
    slow = {f"plant {k}": {"plant.gain": gain} for k, gain in enumerate((8.0, 1.0, 6.0))}
    found = validate_design(loop, STEPS, design, minimise=SettlingTime(), scenarios=slow)
    row = found.summary.loc["SettlingTime"]
    assert row["worst_plant"] == "plant 1"
    assert row[["worst", "certified"]].isna().all()
    assert row["violations"] == 1
    assert row["median"] == pytest.approx(math.log(50) / 6, rel=1e-3)


def test_the_smallest_margin_is_the_worst() -> None:
    """PI on a lag: L = (Kp s + Ki) K/(s (T s + 1)), so the margin falls with the gain where Ki leads."""
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    design = loop.parameters.with_values({"pid.Kp": 0.2, "pid.Ki": 40.0})
    plants = {"low": {"plant.gain": 0.8}, "high": {"plant.gain": 1.2}}
    found = validate_design(
        loop,
        Step(1.0),
        design,
        minimise=SettlingTime(),
        subject_to=[PhaseMargin(40.0), Overshoot(0.9)],
        scenarios=plants,
    )
    row = found.summary.loc["PhaseMargin"]
    assert row["worst"] == found.plants["PhaseMargin"].min()
    assert row["worst_plant"] == "high"
    assert row["limit"] == pytest.approx(40.0)
    assert row["certified"] == pytest.approx(row["worst"], abs=0.5)
    assert found.summary.loc["Overshoot", "limit"] == pytest.approx(90.0)
    assert list(found.summary.index) == ["SettlingTime", "Overshoot", "PhaseMargin"]


def test_gains_off_by_a_tolerance_are_new_plants_too() -> None:
    loop, design = integrator()
    drawn = tolerances(design, {"pid.Kp": 0.1}, 40, seed=2)
    gains = np.array([apply_scenario(design, values).value("pid.Kp") for values in drawn.values()])
    assert np.all(np.abs(gains / 5.0 - 1) <= 0.1)
    assert np.ptp(gains) > 0.5
    found = validate_design(loop, STEPS[0], design, minimise=SettlingTime(), scenarios=drawn)
    assert found.plants["SettlingTime"].to_numpy() == pytest.approx(math.log(50) / gains, rel=1e-3)


def test_no_plant_is_refused() -> None:
    loop, design = integrator()
    with pytest.raises(InputError, match="no new plants"):
        validate_design(loop, STEPS, design, minimise=SettlingTime(), subject_to=[MaxSensitivity(2.0)], scenarios={})
