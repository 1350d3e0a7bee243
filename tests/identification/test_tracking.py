"""`track`: which parameters drift, from estimates and their dates, and what it refuses.

The line through estimates against SciPy's, its scatter, and how often chance raises an alarm.

Whether logs are of one drive.
"""

from datetime import date, timedelta

import numpy as np
import pandas as pd
import pytest
from scipy.stats import linregress

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.identify import identify
from pneuopt.identification.tracking import _disagreements, compare_logs, fit_line, look_level, power, track
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.plotting import plot_tracking
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory

DATES = [date(2026, 1, 5) + timedelta(weeks=k) for k in range(12)]


def fits(count: int = 12, rate: float = 0.03, stderr: float = 0.3) -> list[pd.DataFrame]:
    rng = np.random.default_rng(2)
    rows = []
    for week in range(count):
        values = {"friction.coulomb": 30 * (1 + rate * week), "friction.viscous": 50.0}
        errors = {n: stderr * float(rng.standard_normal()) for n in values}
        frame = {n: {"value": v + errors[n], "stderr": stderr, "dof": np.inf, "unit": "N"} for n, v in values.items()}
        rows.append(pd.DataFrame.from_dict(frame, orient="index"))
    return rows


def test_what_drifts_is_named_with_its_rate_and_what_does_not_is_not() -> None:
    found = track(fits(), DATES)
    assert found.drifting == ("friction.coulomb",)
    row = found.table.to_dict(orient="index")["friction.coulomb"]
    assert row["percent_a_week_low"] < 3 < row["percent_a_week_high"]
    assert row["logs_80"] <= row["logs_90"]
    assert found.history.loc["friction.coulomb"].index.tolist().index(row["alarm"]) >= 3
    text = str(found)
    assert text.startswith("drift of friction.coulomb: identify and tune again")


def test_the_order_of_logs_does_not_matter_and_an_earlier_alarm_stays_when_logs_are_added() -> None:
    estimates = fits()
    whole = track(estimates, DATES, horizon=12)
    turned = track(estimates[::-1], DATES[::-1], horizon=12)
    pd.testing.assert_frame_equal(whole.table, turned.table)
    fewer = track(estimates[:9], DATES[:9], horizon=12)
    assert fewer.look_level == whole.look_level
    assert fewer.table["alarm"].iloc[0] == whole.table["alarm"].iloc[0]


def test_a_stable_drive_has_no_alarm_and_says_so() -> None:
    found = track(fits(rate=0.0), DATES)
    assert found.drifting == ()
    assert str(found).startswith("no parameter drifts")


def test_more_parameters_ask_for_more_significance() -> None:
    assert track(fits(), DATES, parameters=["friction.coulomb"]).look_level > track(fits(), DATES).look_level


def test_a_fit_without_an_interval_does_not_count() -> None:
    estimates = fits()
    estimates[3].loc["friction.coulomb", "stderr"] = np.nan
    found = track(estimates, DATES).history.loc["friction.coulomb"]
    assert np.isnan(found["value"].iloc[3])
    assert np.isnan(found["p"].iloc[3])
    assert np.isfinite(found["p"].iloc[4])


def test_the_figure_shows_what_drifts_first_with_the_date_of_its_alarm() -> None:
    found = track(fits(), DATES)
    first, second = plot_tracking(found).axes
    assert first.get_title().startswith("friction.coulomb")
    labels = {p: [line.get_label() for line in p.get_lines()] for p in (first, second)}
    assert "drift seen" in labels[first]
    assert "drift seen" not in labels[second]


WEEKLY = tuple(float(k) for k in range(20))


def test_with_errors_below_the_scatter_it_is_the_line_of_least_squares() -> None:
    rng = np.random.default_rng(3)
    x, y = np.sort(rng.uniform(0, 9, 12)), rng.standard_normal(12)
    line, known = fit_line(x, y, np.full(12, 1e-6)), linregress(x, y)
    assert (line.slope, line.slope_error, line.p) == pytest.approx((known.slope, known.stderr, known.pvalue), rel=1e-6)
    middle, half = line.at(np.array([0.0, 9.0]))
    assert middle == pytest.approx([known.intercept, known.intercept + 9 * known.slope])
    assert half[0] / line.at(np.array([line.centre]))[1] > 1


def test_estimates_nearer_than_their_errors_have_no_scatter_and_the_errors_own_deviation() -> None:
    x, s = np.arange(6.0), np.array([1.0, 2.0, 1.0, 3.0, 1.0, 2.0])
    line = fit_line(x, 10 + 0.1 * x, s)
    w = 1 / s**2
    assert line.scatter == 0
    assert line.slope == pytest.approx(0.1)
    assert line.slope_error == pytest.approx((w @ (x - w @ x / w.sum()) ** 2) ** -0.5)


def test_the_scatter_makes_the_weighted_squares_as_large_as_their_degrees_of_freedom() -> None:
    rng = np.random.default_rng(5)
    x, s = np.arange(30.0), rng.uniform(0.2, 0.6, 30)
    y = rng.standard_normal(30)
    line = fit_line(x, y, s)
    squares = np.sum((y - line.at(x)[0]) ** 2 / (s**2 + line.scatter**2))
    assert line.scatter > 0.5
    assert squares == pytest.approx(28)


def test_a_look_has_less_than_the_history_and_more_than_an_equal_share() -> None:
    """Looks resemble each other: Bonferroni's share would be too strict."""
    assert 0.01 / 17 < look_level(WEEKLY, 0.01) < 0.01 / 2


def test_power_without_a_drift_is_the_level_and_grows_with_drift_and_logs() -> None:
    look = look_level(WEEKLY, 0.05)
    assert power(WEEKLY, 0.0, look)[-1] == pytest.approx(0.05, abs=0.01)
    slow, fast = power(WEEKLY, 0.1, look), power(WEEKLY, 0.3, look)
    assert slow[:3].tolist() == [0, 0, 0]
    assert np.all(np.diff(slow) >= 0)
    assert np.all(fast[5:] > slow[5:])


def test_logs_with_unequal_errors_and_a_scatter_keep_the_level() -> None:
    look, rng = look_level(WEEKLY, 0.05), np.random.default_rng(1)
    x, alarms = np.array(WEEKLY), 0
    for _ in range(200):
        s = rng.uniform(0.3, 1.5, len(x))
        y = np.hypot(s, 0.7) * rng.standard_normal(len(x))
        alarms += any(fit_line(x[:k], y[:k], s[:k]).p <= look for k in range(4, len(x) + 1))
    assert alarms <= 19  # 10 are expected; chance exceeds 19 in 3 of 1000


TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
DRIVE = ForceDrive(Coulomb()).system()
FREE = DRIVE.parameters.freed(*TRUTH)


def pushed(name: str, seed: int, **other: float) -> Experiment:
    t = np.arange(1000) * 1e-3
    force = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t + seed)
    truth = {**TRUTH, **{n.replace("__", "."): v for n, v in other.items()}}
    run = simulate(
        DRIVE,
        Trajectory(t, {"force": force}),
        DRIVE.parameters.with_values(truth),
        intersample={"force": Intersample.LINEAR},
    )
    noisy = run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": 2e-5}, name=name)


def test_the_parameter_and_the_log_that_disagree_are_named() -> None:
    logs = [pushed("a", 1), pushed("b", 2), pushed("other", 3, friction__coulomb=36.0)]
    joint = identify(DRIVE, logs, FREE, throw=False)
    assert "compare_logs shows whether the logs are of one drive" in joint.status.message
    found = compare_logs(DRIVE, logs, FREE)
    assert not found.agree
    assert found.reason.startswith("the logs disagree in friction.coulomb, by ")
    assert "in other alone, and 30" in found.reason
    deviation = found.table["deviation"].abs()
    assert deviation["friction.coulomb"]["other"] > 20
    assert deviation["load.mass"].max() < 4


def test_logs_of_one_drive_agree_whatever_is_each_ones_own() -> None:
    logs = [pushed("a", 1, load__force=-4.0), pushed("b", 2, load__force=9.0)]
    found = compare_logs(DRIVE, logs, FREE.per_log("load.force"))
    assert found.agree, found
    assert "load.force" not in found.table.index.get_level_values("parameter")
    assert found.reason == "the 2 logs agree in load.mass, friction.coulomb, friction.viscous"
    masses = [pushed("a", 1), pushed("b", 2, load__mass=6.0).with_conditions({"load.mass": 6.0})]
    assert compare_logs(DRIVE, masses, FREE).agree


@pytest.mark.parametrize(
    ("deviation", "value", "disagree"), [(3.9, 2.0, 0), (4.1, 2.0, 1), (-4.1, 2.0, 1), (40.0, 1.01, 0)]
)
def test_a_disagreement_is_beyond_four_deviations_and_two_percent(
    deviation: float, value: float, disagree: int
) -> None:
    table = pd.DataFrame({"deviation": [deviation], "value": [value], "others": [1.0]})
    assert len(_disagreements(table)) == disagree


def test_what_no_two_logs_identify_is_not_compared() -> None:
    known = FREE.fixed(*TRUTH).freed("load.mass")
    logs = [pushed("a", 1), pushed("b", 2).with_conditions({"load.mass": 3.0})]
    found = compare_logs(DRIVE, logs, known)
    assert found.agree
    assert found.reason.startswith("nothing could be compared")
