"""Coverage and model mismatch: what is drawn, how the rows are counted; the slow part identifies a few draws."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from problems.identify import interval_coverage, mismatch
from problems.shared import b32


def failed(rows: pd.DataFrame) -> list[str]:
    return [str(r) for r in rows.loc[~rows["holds"].astype(bool), "name"]]


def coverage_rows(covered: float) -> pd.DataFrame:
    """400 draws, whose intervals hold the truth in this share."""
    held = np.arange(400) < 400 * covered
    rows = {f"covered {n}": held.astype(float) for n in interval_coverage.WANTED}
    scaled = {f"scaled {n}": np.random.default_rng(0).standard_normal(400) for n in interval_coverage.WANTED}
    return pd.DataFrame(rows | scaled | {"converged": 1.0, "misfit": 1.0, "seconds": 0.6})


@pytest.mark.parametrize(
    ("covered", "holds"), [(0.91, False), (0.925, True), (0.95, True), (0.975, True), (0.99, False)]
)
def test_400_draws_are_held_to_92_to_98_percent(covered: float, holds: bool) -> None:
    claims = {c.name: c for c in interval_coverage._claims("right", coverage_rows(covered))}
    assert claims["right.friction.static"].holds is holds
    assert claims["right.scaled_error"].holds
    wrong = {c.name: c for c in interval_coverage._claims("wrong", coverage_rows(covered))}
    assert [n for n, c in wrong.items() if c.bound] == ["wrong.misfit"]
    assert not wrong["wrong.misfit"].holds  # these rows have a misfit of 1, as right noise levels have


def test_what_did_not_converge_covers_nothing_and_is_counted() -> None:
    rows = coverage_rows(1.0)
    rows.loc[:39, "converged"] = 0.0
    claims = {c.name: c for c in interval_coverage._claims("right", rows)}
    assert (claims["right.converged"].value, claims["right.converged"].holds) == (90, False)


def test_draws_share_the_exact_log_and_state_their_noise() -> None:
    one, two, wrong = (
        interval_coverage.drawn("right", 1)[0],
        interval_coverage.drawn("right", 2)[0],
        interval_coverage.drawn("wrong", 1)[0],
    )
    assert np.array_equal(one.trajectory["valve_voltage"], two.trajectory["valve_voltage"])
    apart = one.trajectory["position"] - two.trajectory["position"]
    assert np.std(apart) == pytest.approx(np.sqrt(2) * b32.NOISE["position"], rel=0.05)
    assert np.array_equal(one.trajectory["pressure_a"], wrong.trajectory["pressure_a"])
    assert wrong.noise["pressure_a"] == pytest.approx(0.2 * one.noise["pressure_a"])


def test_a_silent_fit_is_wrong_and_says_nothing() -> None:
    def row(bias: float, off: float, told: float) -> dict[str, float]:
        quiet = {f"{k} {n}": 0.1 for n in mismatch.WANTED for k in ("bias", "off")}
        return quiet | {"bias friction.static": bias, "off friction.static": off, "told": told}

    rows = [row(5.0, -9.0, 0.0), row(-5.0, 9.0, 1.0), row(1.0, 9.0, 0.0), row(5.0, 3.0, 0.0), row(5.0, np.nan, 0.0)]
    assert [mismatch.silent(pd.DataFrame([r])) for r in rows] == [1, 0, 0, 0, 1]


def test_the_rig_sticks_where_the_smooth_model_creeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mismatch, "SAMPLES", 600)
    log = mismatch.recorded(mismatch.Hardware(encoder=1e-5), 0)
    position = log.trajectory["position"] / 1e-5
    assert np.max(np.abs(position - np.round(position))) < 1e-6
    assert log.noise["position"] == pytest.approx(1e-5 / np.sqrt(12))
    assert np.mean(np.diff(position) == 0) > 0.3
    assert set(mismatch.WANTED) <= set(po.catalog.b32()[1])


@pytest.mark.slow
def test_coverage(tmp_path: Path) -> None:
    draws = interval_coverage.run(6, cases=("right", "estimated"))
    assert failed(interval_coverage.main(draws)) == []
    interval_coverage.figure(draws).savefig(tmp_path / "coverage.png")
    assert (tmp_path / "coverage.png").stat().st_size > 10_000


@pytest.mark.slow
def test_mismatch(tmp_path: Path) -> None:
    rows = mismatch.run(1, ("width_0.3mm", "hysteresis"))
    claims = mismatch.main(rows).set_index("name")
    assert claims.loc["width_0.3mm.coulomb", "holds"]
    assert "hysteresis: converged" in mismatch.told(rows)
    mismatch.figure(rows).savefig(tmp_path / "mismatch.png")
    assert (tmp_path / "mismatch.png").stat().st_size > 10_000
