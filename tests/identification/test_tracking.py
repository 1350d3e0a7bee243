"""`track`: which parameters drift, from estimates and their dates, and what it refuses."""

from datetime import date, timedelta

import numpy as np
import pandas as pd
import pytest

from pneuopt.identification.tracking import track
from pneuopt.plotting import plot_tracking
from pneuopt.quantities.errors import InputError

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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fits": fits(3), "dates": DATES[:3]}, "3 logs show no drift; give 4 at least"),
        ({"dates": DATES[:5]}, "12 fits have 5 dates"),
        ({"dates": ["12.3.26", *DATES[1:]]}, "'12.3.26' is no date; write it as 2026-03-12"),
        ({"dates": [DATES[0]] * 12}, "are of one moment"),
        ({"parameters": ["friction.colomb"]}, "did you mean 'friction.coulomb'"),
        ({"level": 1.5}, "give a probability"),
    ],
)
def test_what_cannot_be_tracked_is_refused(changes: dict[str, object], message: str) -> None:
    given: dict[str, object] = {"fits": fits(), "dates": DATES} | changes
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        track(**given)  # type: ignore[arg-type]


def test_the_figure_shows_what_drifts_first_with_the_date_of_its_alarm() -> None:
    found = track(fits(), DATES)
    first, second = plot_tracking(found).axes
    assert first.get_title().startswith("friction.coulomb")
    labels = {p: [line.get_label() for line in p.get_lines()] for p in (first, second)}
    assert "drift seen" in labels[first]
    assert "drift seen" not in labels[second]
