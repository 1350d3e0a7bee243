"""The drift script on a few histories and real identifications."""

from problems.identify import drift


def test_drift_is_seen_in_time_and_few_stable_histories_have_an_alarm() -> None:
    rows, _ = drift.main(histories=40, runs=9)
    assert rows.loc[~rows["holds"].astype(bool), "name"].tolist() == []
