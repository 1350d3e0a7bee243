"""What the scripts of design questions make of their studies: valve, sample time, friction, parts of a dither."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.tune import ablate_dither, friction_tolerance, sample_time, tolerance_sensitivity, valve_sizing

RIPPLE, GAINS = 1e-3, {"pid.Kp": 1.0, "pid.Ki": 1.0, "pid.Kd": 0.0, "pid.Tf": 0.01}


def rows_of(claims: pd.DataFrame) -> tuple[dict[str, float], dict[str, bool]]:
    """Values, and whether they hold, by name."""
    names = [str(name) for name in claims["name"]]
    return dict(zip(names, claims["value"], strict=True)), dict(zip(names, claims["holds"], strict=True))


def tuned(settling: float, overshoot: float = 1.0, sensitivity: float = 1.5) -> po.TuningResult:
    """A result with these certified figures."""
    metrics = {"SettlingTime": settling, "Overshoot": overshoot, "MaxSensitivity": sensitivity, "Ripple": RIPPLE}
    given = po.ParameterSet({name: po.Parameter(value, "1") for name, value in GAINS.items()})
    found = SimpleNamespace(parameters=given, certified=pd.DataFrame({"0 to 0.1": metrics}))
    return cast(po.TuningResult, found)


def test_slower_samples_are_priced_against_the_fastest() -> None:
    times = dict(zip(sample_time.TIMES, (0.1, 0.11, 0.14, 0.2, 0.4), strict=True))
    job = sample_time.Job({t: tuned(s) for t, s in times.items()}, tuned(0.1, 40.0, 12.0).certified)
    values, hold = rows_of(sample_time.main(job))
    assert values["price.10_ms"] == pytest.approx(4.0)
    assert values["kept.max_sensitivity"] == 12.0
    assert all(hold.values())


def test_a_valve_that_cannot_keep_the_limits_takes_for_ever() -> None:
    n = len(valve_sizing.SIZES)
    figures = {"SettlingTime": 0.1, "Overshoot": 2.0, "MaxSensitivity": 1.5, "AirUse": 1.0, "breaks": 0.0, "error": ""}
    table = pd.DataFrame({name: [value] * n for name, value in figures.items()}).assign(size=list(valve_sizing.SIZES))
    table.loc[0, ["SettlingTime", "Overshoot", "MaxSensitivity", "AirUse"]] = np.nan
    table.loc[0, "error"] = "refused"
    values, hold = rows_of(valve_sizing.main(valve_sizing.Job(table)))
    assert values["gain.35"] == np.inf
    assert all(hold.values())


def test_the_tolerated_friction_ends_where_a_bin_fails() -> None:
    factors = np.linspace(*friction_tolerance.RANGE, 241)
    held = ((factors > 0.71) & (factors < 1.29)).astype(float)
    for kept, ends in ((held, [0.8, 1.2]), (np.ones(241), [0.4, 1.6]), (np.zeros(241), [1.0, 1.0])):
        assert list(friction_tolerance.tolerated(factors, kept)) == pytest.approx(ends)


def test_a_plant_that_never_settles_or_failed_does_not_keep_the_specification() -> None:
    settled = [0.1, np.nan, 0.1, 0.3]
    cases = pd.DataFrame({"SettlingTime[0]": settled, "SettlingTime[1]": 0.1, "Overshoot[0]": [1.0, 1.0, 20.0, 1.0]})
    assert friction_tolerance.keeps(cases, 0.2).tolist() == [True, False, False, False]


def test_a_part_that_is_left_out_may_not_be_missed() -> None:
    parts = {(0.02, part): {"SettlingTime": 0.2, "Ripple": RIPPLE} for part in ablate_dither.LABELS}
    parts[0.02, "neither"] = dict.fromkeys(ablate_dither.FIGURES, np.nan)
    values, hold = rows_of(ablate_dither.main(ablate_dither.Job(parts)))
    assert values["parts.2_percent"] == pytest.approx(1.0)
    assert hold["parts.2_percent"]
    assert np.isnan(values["2_percent.neither.settling_time"])
    parts[0.02, "all"] = {"SettlingTime": 0.25, "Ripple": RIPPLE}
    assert not rows_of(ablate_dither.main(ablate_dither.Job(parts)))[1]["parts.2_percent"]


def test_slopes_are_held_to_central_differences_on_the_scale_of_all_axes() -> None:
    axes = ["load.mass", "friction.coulomb + friction.static"]
    index = pd.MultiIndex.from_product([tolerance_sensitivity.METRICS, axes], names=["figure", "axis"])
    table = pd.DataFrame({"change": 3.0, "relative": 1.0, "share": 0.5, "first": 0.4}, index=index)
    about = pd.DataFrame({"value": 1.0, "std": 10.0}, index=tolerance_sensitivity.METRICS)
    job = tolerance_sensitivity.Job(
        po.LocalSensitivity(table, about), po.Sensitivity(table, about, table), dict.fromkeys(index, 3.2)
    )
    values, hold = rows_of(tolerance_sensitivity.main(job))
    assert values["SettlingTime.friction.coulomb.change"] == 3.0
    assert values["Overshoot.apart"] == pytest.approx(0.02)
    assert all(hold[f"{metric}.apart"] for metric in tolerance_sensitivity.METRICS)
