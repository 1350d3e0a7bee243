"""Marks, widened intervals and bounds of the bias of fits to logs whose residuals are, or are not, noise.

Cluster-robust covariances against literal refits, against the definitions row by row, and by coverage.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import fractional_matrix_power
from scipy.signal import lfilter
from scipy.stats import ttest_1samp

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, read_fit, write_fit
from pneuopt.identification import identify as identification
from pneuopt.identification import misfit
from pneuopt.identification.identify import identify
from pneuopt.identification.misfit import (
    Clusters,
    Misfit,
    RejectedWidth,
    RobustCovariance,
    _hotelling_p,
    between_clusters,
    diagnose_misfit,
    disagreement_p,
    jackknife,
    robust_covariance,
    score_widths,
    suspect_widths,
    t_quantile,
)
from pneuopt.identification.problem import EstimationProblem, check_logs, input_behaviour
from pneuopt.identification.profiles import profile
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.identification.tolerances import BIAS_SHIFTS, TIME_BLOCKS
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Viscous
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, solve_least_squares

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
    # and the width of friction's step, which nobody has stated, is estimated, too
    assert_allclose(result.estimates["dof"], TIME.size - len(FREE) - 2)


def test_only_what_an_interval_of_chance_does_not_hold_bounds_a_bias() -> None:
    whole = Misfit(np.eye(1), np.ones(1), 1.0, 1.0, noisy_states=False, is_excessive=False)
    half = np.ones(1)
    given: Any
    assert (whole.mark, whole.bound_bias(half).tolist()) == (Mark.EXACT, [0.0])
    for given in ({"widened": True}, {"level": 1.3}):
        wide = replace(whole, **given)
        assert (wide.mark, wide.bound_bias(half).tolist()) == (Mark.WIDENED, [0.0]), given
    for given in ({"level": 2.1}, {"noisy_states": True}, {"signals": ("speed",)}, {"restarts": True}):
        assert replace(whole, **given).bound_bias(half) > half, given


def estimates(half_widths: Array, bias: float, *, converged: bool = True) -> pd.DataFrame:
    """Two estimates of the same bias, in half widths of their intervals, with these half widths over the value."""
    own, none = DRIVE.parameters.select(FREE[:2]), np.zeros(2, dtype=bool)
    covariance = np.diag((half_widths * [own.value(n) for n in own] / 1.96) ** 2)
    dof = np.full(2, math.inf)
    misfit = Misfit(covariance, dof, 1.0, 1.0, noisy_states=False, is_excessive=False)
    if bias:
        misfit = replace(misfit, shifts=bias * half_widths * [own.value(n) for n in own] / BIAS_SHIFTS)
    status = Status(Code.CONVERGED if converged else Code.NOT_CONVERGED, ("",))
    return identification._estimates(own, covariance, none, none, status, misfit)


def test_a_bias_widens_the_interval_and_is_marked_where_a_design_would_notice_it() -> None:
    """Bounds of .4 % and of 40 % of the value: both are in the interval, and one is worth a word."""
    plain, found = estimates(np.array([1e-3, 0.1]), 0.0), estimates(np.array([1e-3, 0.1]), 4.0)
    assert_allclose(found["bias"] / found["value"], [4e-3, 0.4], rtol=1e-3)
    assert found["mark"].tolist() == [Mark.EXACT, Mark.BIAS_POSSIBLE]
    assert plain["mark"].tolist() == [Mark.EXACT, Mark.EXACT]
    assert_allclose(found["stderr"], plain["stderr"])
    widths = [t["ci_high"] - t["ci_low"] for t in (plain, found)]
    assert_allclose(widths[1] / widths[0], 4.0, rtol=1e-3)
    assert set(estimates(np.array([1e-3, 0.1]), 0.0, converged=False)["mark"]) == {Mark.BIAS_POSSIBLE}


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
    assert row["bias"] > 1


def test_residuals_that_depend_on_the_speed_are_named() -> None:
    """A sensor whose error turns with the speed, at most by the noise, which no parameter explains."""
    speed, truth = exact()
    result = fit(log_of(speed + NOISE * np.sin(2 * np.pi * speed / speed.max())))
    assert any("residuals depend on speed" in s for s in result.status.sentences)
    assert result.stats["chi_square_ratio"] < 1.3
    rows = result.estimates
    assert (rows["bias"] > 1.96 * rows["stderr"]).all()
    assert all(rows["ci_low"][n] < truth.value(n) < rows["ci_high"][n] for n in FREE)
    assert (rows["mark"] == Mark.BIAS_POSSIBLE).tolist() == (rows["bias"] > 0.02 * rows["value"]).tolist()


def test_far_beyond_the_noise_there_is_a_bound_of_the_bias_and_no_interval(tmp_path: Path) -> None:
    """Coulomb friction of 26 to 34 N in one model: residuals of 20 times the noise."""
    result = scattered(26.0, 30.0, 34.0)[1]
    assert result.status.code is Code.MISFIT
    assert result.status.converged
    assert str(result.status).startswith("converged, but the model misses the logs: residuals are ")
    rows = result.estimates
    assert rows[["stderr", "ci_low", "ci_high"]].isna().all(axis=None)
    assert result.covariance.isna().all(axis=None)
    assert rows["bias"]["friction.coulomb"] > 4  # the runs have 26 to 34 N
    source = tmp_path / "drive.toml"
    source.write_text('[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n', encoding="utf-8")
    write_fit(tmp_path / "fit.toml", source, result)
    assert read_fit(tmp_path / "fit.toml").marks == dict.fromkeys(rows.index, Mark.BIAS_POSSIBLE)
    assert read_fit(source).marks == {}
    assert read_drive(tmp_path / "fit.toml")[1].value("load.mass") == pytest.approx(rows["value"]["load.mass"])


def test_few_degrees_of_freedom_reach_profiles() -> None:
    logs, result = scattered(29.0, 30.0, 31.0)
    found, row = profile(DRIVE.system(), logs, result, "friction.coulomb"), result.estimates.loc["friction.coulomb"]
    dof, stderr = (float(result.estimates[n]["friction.coulomb"]) for n in ("dof", "stderr"))
    half = t_quantile(dof) * stderr
    assert found.low == pytest.approx(row["value"] - half, rel=0.02)
    assert found.high == pytest.approx(row["value"] + half, rel=0.02)


def test_a_mark_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.toml"
    path.write_text(
        '[drive]\nkind = "force"\n[friction]\nmodel = "coulomb"\n'
        '[estimates]\n"load.mass" = {value = 5.0, mark = "perfect"}\n',
        encoding="utf-8",
    )
    with pytest.raises(InputError, match="perfect"):
        read_fit(path).marks  # noqa: B018


def test_a_width_that_the_logs_reject_bounds_a_bias_by_what_it_moves() -> None:
    plain = Misfit(None, np.full(2, 9.0), 1.0, 1.0, noisy_states=False, is_excessive=False)
    wide = replace(plain, widened=True, rejected_widths=("friction.smoothing",), shifts=np.array([-3.0, 0.0]))
    assert wide.bound_bias(np.ones(2)).tolist() == [3 * BIAS_SHIFTS, 0.0]
    assert wide.sentences[0].startswith("the stated friction.smoothing is rejected by a score test")


def test_an_estimate_without_a_deviation_is_not_exact() -> None:
    """Static friction of 29.99 N in a one-way log was, without a deviation."""
    plain = Misfit(None, np.full(2, 9.0), 1.0, 1.0, noisy_states=False, is_excessive=False)
    own, none = DRIVE.parameters.select(FREE[:2]), np.zeros(2, dtype=bool)
    status = Status(Code.CONVERGED, ("converged",))
    found = identification._estimates(own, np.diag([1.0, np.nan]), none, none, status, plain)
    assert found["mark"].tolist() == [Mark.EXACT, Mark.BIAS_POSSIBLE]


def test_windows_that_start_anew_where_whole_logs_do_not_fit_leave_a_bias_possible() -> None:
    """Short windows hide what adds up over a log: their residuals are noise, and five of six intervals were wrong."""
    plain = Misfit(None, np.full(2, 9.0), 1.0, 1.0, noisy_states=False, is_excessive=False)
    anew = replace(plain, restarts=True)
    assert (anew.bound_bias(np.ones(2)) > 1).all()
    assert anew.sentences == ("over whole logs the misfit exceeds the noise: estimates from windows may be biased",)


Rows = list[tuple[Array, Array]]
DRAWS = 100
NAMES = ("coulomb", "viscous", "offset")


def friction_columns(n: int, rng: np.random.Generator) -> Array:
    """Columns of Coulomb and viscous friction and of an offset over two seconds of motion of four frequencies."""
    t = np.linspace(0, 2, n)
    v = sum(0.1 * np.cos(2 * np.pi * rng.uniform(0.5, 3) * t + rng.uniform(0, 2 * np.pi)) for _ in range(4))
    return np.stack([np.tanh(np.asarray(v) / 0.01), v, np.ones(n)], axis=1)


def autoregression(n: int, time: float, rng: np.random.Generator) -> Array:
    """An AR(1) process of unit variance with a correlation time in samples."""
    a = np.exp(-1 / time)
    e = lfilter([np.sqrt(1 - a**2)], [1, -a], rng.standard_normal(n + round(5 * time)))
    return np.asarray(e)[-n:]


def cut(logs: Rows, blocks: int = TIME_BLOCKS) -> tuple[Rows, list[int]]:
    """The rows in blocks of time, and the log of each."""
    rows: Rows = []
    own: list[int] = []
    for i, (X, y) in enumerate(logs):
        count = max(1, round(blocks * len(y) / sum(len(e) for _, e in logs)))
        rows += list(zip(np.array_split(X, count), np.array_split(y, count), strict=True))
        own += [i] * count
    return rows, own


def solve_rows(rows: Rows) -> Array:
    X, y = (np.concatenate(a) for a in zip(*rows, strict=True))
    return np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])


def clusters_of(rows: Rows, logs: list[int], estimate: Array) -> Clusters:
    return Clusters(
        np.array([X.T @ (X @ estimate - y) for X, y in rows]), np.array([X.T @ X for X, _ in rows]), np.array(logs)
    )


def solve(logs: Rows) -> tuple[Array, Array, RobustCovariance]:
    """Estimates, their covariance for white residuals, and the robust one."""
    rows, own = cut(logs)
    estimate = solve_rows(rows)
    X, y = (np.concatenate(a) for a in zip(*rows, strict=True))
    variance = float(np.sum((y - X @ estimate) ** 2)) / (len(y) - 3)
    white = variance * np.linalg.inv(X.T @ X)
    return estimate, white, robust_covariance(clusters_of(rows, own, estimate), white, variance, len(y) - 3.0)


@pytest.fixture
def uneven() -> tuple[Rows, list[int], Clusters]:
    """Three logs of unequal lengths with correlated residuals."""
    rng = np.random.default_rng(3)
    logs = [(friction_columns(n, rng), autoregression(n, 5, rng)) for n in (60, 100, 140)]
    rows, own = cut(logs)
    return rows, own, clusters_of(rows, own, solve_rows(rows))


def test_jackknife_is_that_of_literal_refits(uneven: tuple[Rows, list[int], Clusters]) -> None:
    rows, _, clusters = uneven
    moved = np.array([solve_rows(rows[:g] + rows[g + 1 :]) - solve_rows(rows) for g in range(len(rows))])
    found = jackknife(clusters)
    size = np.abs(moved).max(axis=0)  # within the regularisation, a thousandth of the information
    assert_allclose(found.changes / size, moved / size, rtol=0.01, atol=0.005)
    assert_allclose(np.diag(found.covariance), 23 / 24 * np.sum(moved**2, axis=0), rtol=0.01)


def test_between_clusters_is_bell_and_mccaffreys_definition(uneven: tuple[Rows, list[int], Clusters]) -> None:
    """CR2 and its degrees of freedom with the matrices of all rows, as the paper writes them."""
    rows, own, clusters = uneven
    logs = [
        tuple(np.concatenate(a) for a in zip(*(r for r, o in zip(rows, own, strict=True) if o == i), strict=True))
        for i in range(3)
    ]
    X, y = (np.concatenate(a) for a in zip(*logs, strict=True))
    inverse = np.linalg.inv(X.T @ X)
    residuals, hat = y - X @ inverse @ X.T @ y, X @ inverse @ X.T
    ends = np.cumsum([0, *(len(e) for _, e in logs)])
    meat, columns = np.zeros((3, 3)), []
    for a, b in itertools.pairwise(ends.tolist()):
        root = np.real(fractional_matrix_power(np.eye(b - a) - hat[a:b, a:b], -0.5))
        score = X[a:b].T @ root @ residuals[a:b]
        meat += np.outer(score, score)
        columns.append((np.eye(len(X)) - hat)[:, a:b] @ root @ X[a:b] @ inverse)
    found = between_clusters(clusters.by_log())
    assert_allclose(found.covariance, inverse @ meat @ inverse, rtol=1e-6)
    for k in range(3):
        G = np.stack([c[:, k] for c in columns], axis=1)
        values = np.linalg.eigvalsh(G.T @ G)
        assert found.dof[k] == pytest.approx(values.sum() ** 2 / (values**2).sum(), rel=1e-6)


def test_halving_joins_neighbours_of_one_log_only() -> None:
    blocks = Clusters(np.arange(5.0)[:, None], np.arange(5.0)[:, None, None], np.array([0, 0, 0, 1, 1]))
    half = blocks.halve()
    assert half.scores.ravel().tolist() == [1, 2, 7]
    assert half.logs.tolist() == [0, 0, 1]
    assert half.halve().scores.ravel().tolist() == [3, 7]
    assert blocks.by_log().information.ravel().tolist() == [3, 7]


def test_disagreement_of_white_residuals_is_uniform() -> None:
    """Probabilities of Chow's test over many draws: as many below a tenth as chance has it."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows, own = cut([(friction_columns(480, rng), rng.standard_normal(480))])
        found.append(disagreement_p(clusters_of(rows, own, solve_rows(rows)), 1.0))
    assert np.mean(found) == pytest.approx(0.5, abs=0.07)
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.06)


def white(n: int, rng: np.random.Generator) -> Array:
    return rng.standard_normal(n)


def slowly(share: float) -> Callable[[int, np.random.Generator], Array]:
    return lambda n, rng: rng.standard_normal(n) + share * autoregression(n, n / 25, rng)


def coloured(time: float) -> Callable[[int, np.random.Generator], Array]:
    return lambda n, rng: rng.standard_normal(n) + autoregression(n, time, rng)


def coverage(
    logs: int, n: int, residuals: Callable[[int, np.random.Generator], Array], bad: int = 0, scatter: float = 0.0
) -> tuple[Array, Array, float]:
    """Coverage [%] of robust and of white intervals, the worst parameter's, and the share of draws widened."""
    robust, plain, widened = [], [], 0
    for seed in range(DRAWS):
        rng = np.random.default_rng((seed, logs))
        given: Rows = []
        for i in range(logs):
            X = friction_columns(n, rng)
            y = residuals(n, rng) + (autoregression(n, 100, rng) if i < bad else 0.0)
            y = y + X @ (scatter / np.linalg.norm(X, axis=0) * rng.standard_normal(3))
            given.append((X, y))
        estimate, plain_covariance, found = solve(given)
        robust.append(np.abs(estimate) <= t_quantile(found.dof) * np.sqrt(np.diag(found.covariance)))
        plain.append(np.abs(estimate) <= 1.96 * np.sqrt(np.diag(plain_covariance)))
        widened += found.widened
    return 100 * np.mean(robust, axis=0), 100 * np.mean(plain, axis=0), widened / DRAWS


@pytest.mark.parametrize("logs", [1, 3, 8])
def test_white_residuals_keep_their_intervals(logs: int) -> None:
    robust, _, widened = coverage(logs, 960 // logs, white)
    assert np.all(np.abs(robust - 95) <= 5)  # 2.3 binomial deviations of 100 draws
    assert widened <= 0.08


@pytest.mark.parametrize(
    ("logs", "n", "residuals", "bad", "scatter"),
    [
        (1, 3000, slowly(0.15), 0, 0.0),
        (1, 3000, slowly(0.2), 0, 0.0),
        (1, 2000, coloured(5), 0, 0.0),
        (1, 2000, coloured(20), 0, 0.0),
        (1, 3000, coloured(60), 0, 0.0),
        (8, 400, white, 1, 0.0),
        (4, 400, white, 1, 0.0),
        (3, 200, white, 0, 3.0),
        (7, 200, white, 0, 3.0),
        (20, 200, white, 0, 3.0),
    ],
)
def test_intervals_hold_where_those_of_white_residuals_do_not(
    logs: int, n: int, residuals: Callable[[int, np.random.Generator], Array], bad: int, scatter: float
) -> None:
    robust, plain, widened = coverage(logs, n, residuals, bad, scatter)
    assert plain.min() < 75
    assert robust.min() >= 90 - 6  # two binomial deviations of 100 draws
    assert widened > 0.7


WIDTH = "friction.smoothing"
SLIDING = ("friction.coulomb", "friction.viscous")
FINE_NOISE = 2e-6  # of the position [m]


def fitted(friction: FrictionModel, width: float = 1.0) -> tuple[EstimationProblem, Fit]:
    """Friction found in a pushed drive's log by a model whose width is so many times the drive's."""
    system, t = ForceDrive(friction).system(), np.arange(1000) * 1e-3
    truth = {n: v for n, v in {"friction.coulomb": 30.0, "friction.viscous": 60.0}.items() if n in system.parameters}
    own = system.parameters.with_values(truth)
    force = Trajectory(t, {"force": 60 * np.sin(2 * np.pi * 4 * t)})
    behaviour = input_behaviour(system, Experiment(force.with_columns({"position": t}), {}, name="run"))
    run = simulate(system, force, own, initial={"position": 0.0, "speed": 0.0}, intersample=behaviour)
    position = run["position"] + FINE_NOISE * np.random.default_rng(3).standard_normal(1000)
    log = Experiment(force.with_columns({"position": position}), {"position": FINE_NOISE}, name="run")
    given = own.freed(*truth)
    if WIDTH in given:
        given = given.with_values({WIDTH: width * own.value(WIDTH)})
    problem = EstimationProblem(system, tuple(check_logs(system, [log], given)), given, LeastSquares())
    return problem, solve_least_squares(problem.transcription(problem.candidates[0]), problem.method)


def test_the_width_that_made_the_log_is_not_rejected() -> None:
    (found,) = score_widths(*fitted(Coulomb()))
    assert found.name == WIDTH
    assert found.fall < 10.8


def test_the_fall_and_the_shifts_are_those_of_a_fit_that_estimates_the_width() -> None:
    problem, fit = fitted(Coulomb(), 1.1)
    (found,) = score_widths(problem, fit)
    freed = replace(problem, parameters=problem.parameters.freed(WIDTH))
    refit = solve_least_squares(freed.transcription(freed.start_from(fit)), freed.method)
    assert refit.parameters.value(WIDTH) == pytest.approx(problem.system.parameters.value(WIDTH), rel=0.02)
    assert found.fall > 10.8
    assert found.fall == pytest.approx(2 * (fit.stats["cost"] - refit.stats["cost"]), rel=0.2)
    shifts = [refit.parameters.value(n) - fit.parameters.value(n) for n in SLIDING]
    assert dict(zip(SLIDING, found.shifts, strict=True)) == pytest.approx(
        dict(zip(SLIDING, shifts, strict=True)), rel=0.2
    )


def test_noise_of_the_states_has_other_weights_and_a_model_without_a_width_none_to_reject() -> None:
    problem, fit = fitted(Coulomb())
    assert not list(score_widths(problem, replace(fit, jumps=np.zeros((1, 2)))))
    assert not list(score_widths(*fitted(Viscous())))
    free = replace(problem, parameters=problem.parameters.freed(WIDTH))
    assert not list(score_widths(free, solve_least_squares(free.transcription(free.start_from(fit)), free.method)))


@pytest.mark.parametrize(
    ("fall", "shift", "inflation", "marked"),
    [
        (10.9, 1.1, 1.0, True),
        (10.7, 1.1, 1.0, False),  # chi-square with one degree of freedom exceeds 10.8 once in a thousand
        (10.9, 0.9, 1.0, False),  # the intervals hold it
        (10.9, 1.1, 1.1, False),  # what scatters more between parts of the logs is told apart with more
        (-1.0, 1.1, 1.0, False),
    ],
)
def test_a_rejected_width_bounds_a_bias_where_it_moves_an_estimate_beyond_its_interval(
    fall: float, shift: float, inflation: float, marked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, fit = fitted(Coulomb())
    plain = diagnose_misfit(problem, fit, 1.0, 900.0)
    assert plain.covariance is not None
    half_widths = t_quantile(900.0) * np.sqrt(np.diag(plain.covariance))
    suspect = replace(plain, widened=True, signals=(), inflation=inflation)
    moved = RejectedWidth(WIDTH, fall, np.array([shift, 0.1]) * half_widths / BIAS_SHIFTS)
    monkeypatch.setattr(misfit, "score_widths", lambda *_: iter([moved]))
    found = suspect_widths(suspect, problem, fit, 1.0)
    assert (found.rejected_widths == (WIDTH,)) is marked
    bounds = [shift, 0.1] if marked else [0.0, 0.0]
    assert_allclose(found.bound_bias(half_widths) / half_widths, bounds, rtol=1e-6)
    told = any(WIDTH in sentence for sentence in found.sentences)
    assert told is marked
