"""Marks, widened intervals and ranges of fits to logs whose residuals are, or are not, noise."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter
from scipy.stats import ttest_1samp

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, read_fit, write_fit
from pneuopt.identification import identify as identification
from pneuopt.identification.identify import identify
from pneuopt.identification.misfit import Misfit, _hotelling_p
from pneuopt.identification.profiles import profile
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory

TIME = np.arange(0, 4.0, 2e-3)
FORCE = 150 * np.sin(2 * np.pi * 1.3 * TIME) + 60 * np.sin(2 * np.pi * 3.1 * TIME + 1)
NOISE = 1e-3  # of the speed [m/s]
DRIVE = ForceDrive(Coulomb())
FREE = ("load.mass", "friction.coulomb", "friction.viscous")


@cache
def exact(coulomb: float = 30.0) -> tuple[Array, ParameterSet]:
    """The speed of the drive, with its parameters."""
    truth = DRIVE.parameters.with_values({"friction.coulomb": coulomb, "friction.viscous": 80.0})
    run = simulate(DRIVE.system(), Trajectory(TIME, {"force": FORCE}), truth, intersample={"force": Intersample.LINEAR})
    return run["speed"], truth


def log_of(speed: Array, seed: int = 0, noise: float = NOISE, name: str = "run") -> Experiment:
    noisy = speed + noise * np.random.default_rng(seed).standard_normal(TIME.size)
    return Experiment(Trajectory(TIME, {"force": FORCE, "speed": noisy}), {"speed": noise}, name=name)


def slow(share: float, seed: int) -> Array:
    """A slow disturbance of the speed, `share` times the noise, correlated over 200 samples."""
    a, normal = np.exp(-1 / 200), np.random.default_rng(seed).standard_normal(TIME.size + 1000)
    return np.asarray(share * NOISE * lfilter([np.sqrt(1 - a**2)], [1, -a], normal)[-TIME.size :])


def fit(*logs: Experiment) -> IdentificationResult:
    return identify(DRIVE.system(), list(logs), DRIVE.parameters.freed(*FREE))


def covers(result: IdentificationResult, truth: ParameterSet) -> Array:
    rows = result.estimates
    return np.array([rows["ci_low"][n] <= truth.value(n) <= rows["ci_high"][n] for n in FREE])


def test_one_column_of_hotellings_test_is_students() -> None:
    """T^2 of one variable is t^2 (Hotelling 1931), however few the rows."""
    for count in (3, 5, 12):
        rows = 0.4 + np.random.default_rng(count).standard_normal((count, 1))
        assert _hotelling_p(rows) == pytest.approx(ttest_1samp(rows[:, 0], 0.0).pvalue, rel=1e-9)


@pytest.mark.parametrize(("count", "closed"), [(9, False), (9, True), (32, True)])
def test_hotellings_probability_is_uniform_where_chance_alone_acts(count: int, closed: bool) -> None:
    """Rows of four correlated columns; closed: a fifth makes their sum zero, as classes that share an offset have."""
    rng, mix = np.random.default_rng(1), np.tril(np.ones((4, 4)))
    rows = rng.standard_normal((2000, count, 4)) @ mix
    rows = np.concatenate([rows, -rows.sum(axis=2, keepdims=True)], axis=2) if closed else rows
    found = np.array([_hotelling_p(each) for each in rows])
    for level in (0.05, 0.2, 0.5):
        assert np.mean(found < level) == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / 2000))


def test_white_residuals_are_exact() -> None:
    result = fit(log_of(exact()[0]))
    assert set(result.estimates["mark"]) == {Mark.EXACT}
    assert result.stats["variance_inflation"] == 1.0
    assert_allclose(np.diag(result.covariance), result.estimates["stderr"] ** 2)
    # the logged speed has a start state that is fitted, the position has none: no output shows it
    assert_allclose(result.estimates["dof"], TIME.size - len(FREE) - 1)


def test_the_mark_of_an_estimate_is_the_gravest_that_anything_gives() -> None:
    whole = Misfit(np.eye(1), np.ones(1), 1.0, np.zeros((1, 2)), 1.0, noisy_states=False, is_excessive=False)
    assert whole.mark(0, is_optimum=True) is Mark.EXACT
    assert whole.mark(0, is_optimum=False) is Mark.BIAS_POSSIBLE  # at a bound, or a fit that did not converge
    for changed, mark in (
        ({"widened": True}, Mark.WIDENED),
        ({"level": 1.3}, Mark.WIDENED),
        ({"level": 2.1}, Mark.BIAS_POSSIBLE),
        ({"noisy_states": True}, Mark.BIAS_POSSIBLE),
        ({"signals": ("speed",), "widened": True}, Mark.BIAS_POSSIBLE),
    ):
        given: Any = changed
        assert replace(whole, **given).mark(0, is_optimum=True) is mark, changed


def test_a_slow_residual_below_the_noise_widens_the_intervals() -> None:
    """Half the noise, 12 % of the power: white intervals hold the truth half as often as these."""
    speed, truth = exact()
    results = [fit(log_of(speed + slow(0.5, seed), 100 + seed)) for seed in range(8)]
    assert np.mean([covers(r, truth) for r in results]) >= 0.85
    assert {mark for r in results for mark in r.estimates["mark"]} >= {Mark.WIDENED}
    assert np.mean([r.stats["variance_inflation"] for r in results]) > 3
    assert all(r.stats["chi_square_ratio"] < 1.35 for r in results)
    widened = next(r for r in results if r.stats["variance_inflation"] > 3)
    assert_allclose(np.diag(widened.covariance), widened.estimates["stderr"] ** 2)
    assert widened.estimates["dof"].max() < 50


def test_one_bad_log_among_good_ones_widens_the_intervals() -> None:
    speed, truth = exact()
    results = []
    for seed in range(5):
        bad = log_of(speed + slow(2.0, seed), 200 + seed, name="bad")
        results.append(fit(bad, *(log_of(speed, 300 + 10 * seed + i, name=f"good {i}") for i in range(3))))
    assert np.mean([covers(r, truth) for r in results]) >= 0.9
    assert sum(Mark.EXACT in set(r.estimates["mark"]) for r in results) <= 1


@cache
def scattered(*levels: float) -> tuple[tuple[Experiment, ...], IdentificationResult]:
    """Runs with different Coulomb friction, and their joint fit."""
    logs = tuple(log_of(exact(coulomb=c)[0], i, name=f"run {i}") for i, c in enumerate(levels))
    return logs, fit(*logs)


def test_logs_that_differ_have_an_interval_that_holds_their_scatter() -> None:
    """Three runs whose Coulomb friction is 29, 30 and 31 N, each known to .01 N alone."""
    row = scattered(29.0, 30.0, 31.0)[1].estimates.loc["friction.coulomb"]
    assert row["ci_low"] < 29
    assert row["ci_high"] > 31
    assert row["dof"] < 5
    assert row["mark"] == Mark.BIAS_POSSIBLE


def test_residuals_that_depend_on_the_speed_are_named() -> None:
    """A sensor whose error turns with the speed, at most by the noise, which no parameter explains."""
    speed, truth = exact()
    result = fit(log_of(speed + NOISE * np.sin(2 * np.pi * speed / speed.max())))
    assert any("residuals depend on speed" in s for s in result.status.sentences)
    assert set(result.estimates["mark"]) == {Mark.BIAS_POSSIBLE}
    assert result.stats["chi_square_ratio"] < 1.3
    errors = [abs(result.estimates["value"][n] - truth.value(n)) for n in FREE]
    assert all(
        2 * (result.estimates["ci_high"][n] - result.estimates["value"][n]) > e
        for n, e in zip(FREE, errors, strict=True)
    )


def test_far_beyond_the_noise_there_is_a_range_and_no_interval(tmp_path: Path) -> None:
    """Coulomb friction of 26 to 34 N in one model: residuals of 20 times the noise."""
    result = scattered(26.0, 30.0, 34.0)[1]
    assert result.status.code is Code.MISFIT
    assert result.status.converged
    assert str(result.status).startswith("converged, but the model misses the logs: residuals are ")
    rows = result.estimates
    assert rows[["stderr", "ci_low", "ci_high"]].isna().all(axis=None)
    assert result.covariance.isna().all(axis=None)
    assert ((rows["range_low"] < rows["value"]) & (rows["value"] < rows["range_high"])).all()
    source = tmp_path / "drive.toml"
    source.write_text('[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n', encoding="utf-8")
    write_fit(tmp_path / "fit.toml", source, result)
    assert read_fit(tmp_path / "fit.toml").marks == dict.fromkeys(FREE, Mark.BIAS_POSSIBLE)
    assert read_fit(source).marks == {}
    assert read_drive(tmp_path / "fit.toml")[1].value("load.mass") == pytest.approx(rows["value"]["load.mass"])


def test_the_range_is_what_literal_refits_give() -> None:
    """Coulomb friction when one of three runs is left out, against fits of the two others."""
    logs, result = scattered(29.0, 30.0, 31.0)
    row = result.estimates.loc["friction.coulomb"]
    refits = [fit(*(g for g in logs if g is not left_out)).estimates["value"]["friction.coulomb"] for left_out in logs]
    assert row["range_low"] == pytest.approx(min(refits), abs=0.1)
    assert row["range_high"] == pytest.approx(max(refits), abs=0.1)


def test_few_degrees_of_freedom_reach_profiles() -> None:
    logs, result = scattered(29.0, 30.0, 31.0)
    found, row = profile(DRIVE.system(), logs, result, "friction.coulomb"), result.estimates.loc["friction.coulomb"]
    assert found.low == pytest.approx(row["ci_low"], rel=0.02)
    assert found.high == pytest.approx(row["ci_high"], rel=0.02)


def test_a_mark_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.toml"
    path.write_text(
        '[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n'
        '[estimates]\n"load.mass" = {value = 5.0, mark = "perfect"}\n',
        encoding="utf-8",
    )
    with pytest.raises(InputError, match="perfect"):
        read_fit(path).marks  # noqa: B018


def test_a_width_that_the_logs_reject_marks_what_it_moves() -> None:
    plain = Misfit(None, np.full(2, 9.0), 1.0, np.zeros((2, 2)), 1.0, noisy_states=False, is_excessive=False)
    wide = replace(plain, widened=True, rejected_widths=("friction.smoothing",), biased=np.array([True, False]))
    assert [wide.mark(i, is_optimum=True) for i in range(2)] == [Mark.BIAS_POSSIBLE, Mark.WIDENED]
    assert "friction.smoothing that the logs reject" in wide.sentences[0]
    assert wide.is_suspect
    assert not replace(wide, signals=("speed",)).is_suspect
    assert not plain.is_suspect


def test_an_estimate_without_a_deviation_is_not_exact() -> None:
    """Static friction of 29.99 N in a one-way log was, without a deviation."""
    plain = Misfit(None, np.full(2, 9.0), 1.0, np.zeros((2, 2)), 1.0, noisy_states=False, is_excessive=False)
    own, none = DRIVE.parameters.select(FREE[:2]), np.zeros(2, dtype=bool)
    status = Status(Code.CONVERGED, ("converged",))
    found = identification._estimates(own, np.diag([1.0, np.nan]), none, none, status, plain)
    assert found["mark"].tolist() == [Mark.EXACT, Mark.BIAS_POSSIBLE]


def test_windows_that_start_anew_where_whole_logs_do_not_fit_leave_a_bias_possible() -> None:
    """Short windows hide what adds up over a log: their residuals are noise, and five of six intervals were wrong."""
    plain = Misfit(None, np.full(2, 9.0), 1.0, np.zeros((2, 2)), 1.0, noisy_states=False, is_excessive=False)
    assert plain.mark(0, is_optimum=True) is Mark.EXACT
    anew = replace(plain, restarts=True)
    assert anew.mark(0, is_optimum=True) is Mark.BIAS_POSSIBLE
    assert anew.sentences == (
        "over whole logs the model misses more than their noise: estimates from windows may be biased",
    )
