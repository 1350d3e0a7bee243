"""Each distribution and each way to fill the cube goes through the same mill."""

import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, stdtr

from pneuopt.evaluation.scenarios import (
    DISTRIBUTIONS,
    Distribution,
    LogNormal,
    LogUniform,
    Normal,
    Sampling,
    Uniform,
    corners,
    draws,
    quantiles,
    samples,
    unit_points,
)
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet

LOW_HIGH = ("low", "high")
RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 1.0, 20.0),
        "load.force": Parameter(-2.0, "N", -50.0, 50.0),
        "friction.coulomb": Parameter(40.0, "N", 0.0, 1e3),
        "friction.static": Parameter(70.0, "N", 0.0, 1e3),
        "friction.stribeck_velocity": Parameter(0.02, "m/s", 1e-4, 1.0, log=True),
    }
)


def test_corners_are_every_combination_and_an_axis_moves_as_one() -> None:
    spreads: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, ("friction.coulomb", "friction.static"): 0.5}
    cases = corners(RIG, spreads)
    assert len(cases) == 4
    assert list(cases) == [f"load.mass {a}, friction.coulomb + friction.static {b}" for a in LOW_HIGH for b in LOW_HIGH]
    for case in cases.values():
        assert case["friction.static"] / case["friction.coulomb"] == pytest.approx(70 / 40)
    assert {case["load.mass"] for case in cases.values()} == {3.5, 6.5}


def test_a_fraction_of_a_negative_value_still_runs_upwards() -> None:
    low, high = corners(RIG, {"load.force": 0.5}).values()
    assert (low["load.force"], high["load.force"]) == (-3.0, -1.0)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.7))
def test_samples_lie_in_the_box_of_the_corners(seed: int, spread: float) -> None:
    spreads = {"load.mass": spread, "friction.coulomb": spread}
    box = corners(RIG, spreads)
    for case in samples(RIG, spreads, 5, seed=seed).values():
        for name, value in case.items():
            inside = sorted({corner[name] for corner in box.values()})
            assert inside[0] <= value <= inside[1]


def test_samples_fill_the_box_and_repeat_with_the_seed() -> None:
    spreads = {"load.mass": (2.0, 8.0)}
    masses = [case["load.mass"] for case in samples(RIG, spreads, 2000, seed=3).values()]
    assert np.mean(masses) == pytest.approx(5.0, abs=0.15)
    assert np.std(masses) == pytest.approx(6 / math.sqrt(12), rel=0.05)
    assert samples(RIG, spreads, 3, seed=3) == samples(RIG, spreads, 3, seed=3) != samples(RIG, spreads, 3, seed=4)


def test_draws_have_the_covariance_that_was_given() -> None:
    names = ["friction.coulomb", "friction.static", "friction.stribeck_velocity"]
    given = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 4e-6]])  # v_s: 10 % of its value, as a logarithm
    found = draws(RIG, pd.DataFrame(given, names, names), 4000, seed=1)
    table = pd.DataFrame(found.values())
    assert np.cov(table[names[0]], table[names[1]]) == pytest.approx(given[:2, :2], rel=0.1)
    logs = np.log(table[names[2]])
    assert (logs.mean(), logs.std()) == pytest.approx((math.log(0.02), 0.1), rel=0.05)


def test_draws_of_few_degrees_of_freedom_have_the_same_probability_in_students_distribution() -> None:
    name = "load.force"
    covariance = pd.DataFrame([[4.0]], index=[name], columns=[name])
    normal, wide = (draws(RIG, covariance, 50, dof=dof) for dof in ({}, {name: 3.0}))
    sizes = np.array([[found[k][name] - RIG.value(name) for k in normal] for found in (normal, wide)]) / 2.0
    assert np.allclose(ndtr(sizes[0]), stdtr(3.0, sizes[1]), rtol=1e-9)


def test_a_singular_covariance_is_drawn_along_its_line() -> None:
    names = ["friction.coulomb", "friction.static"]
    cases = draws(RIG, pd.DataFrame(np.array([[1.0, 2.0], [2.0, 4.0]]), names, names), 50)
    for case in cases.values():
        assert case["friction.static"] - 70 == pytest.approx(2 * (case["friction.coulomb"] - 40), abs=1e-6)


def test_draws_stay_within_the_bounds() -> None:
    cases = draws(RIG, pd.DataFrame([[100.0]], ["load.mass"], ["load.mass"]), 200)
    assert all(1.0 <= case["load.mass"] <= 20.0 for case in cases.values())


RIG_SAMPLING = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 1.0, 20.0),
        "load.force": Parameter(0.0, "N"),
        "friction.coulomb": Parameter(40.0, "N", 0.0, 1e3),
        "friction.static": Parameter(70.0, "N", 0.0, 1e3),
    }
)
# By the word of a file: two distributions that must agree about a value of 5, and the share of them below x, by hand.
CASES: dict[str, tuple[Distribution, Distribution, Callable[[float], float]]] = {
    "uniform": (Uniform(0.4), Uniform((3.0, 7.0)), lambda x: (x - 3) / 4),
    "log_uniform": (LogUniform(1.0), LogUniform((2.5, 10.0)), lambda x: math.log(x / 2.5) / math.log(4)),
    "normal": (Normal(0.1), Normal((5.0, 0.5)), lambda x: float(ndtr((x - 5) / 0.5))),
    "log_normal": (LogNormal(0.2), LogNormal((5.0, 0.2)), lambda x: float(ndtr(math.log(x / 5) / math.log(1.2)))),
}
SHARES = np.linspace(0.01, 0.99, 25)


def test_every_distribution_has_a_row_here() -> None:
    assert CASES.keys() == DISTRIBUTIONS.keys()


@pytest.mark.parametrize("word", CASES)
def test_a_distribution_is_that_of_its_formula(word: str) -> None:
    free, (by_fraction, by_numbers, below) = Parameter(5.0, "kg"), CASES[word]
    assert type(by_fraction) is DISTRIBUTIONS[word]
    for distribution in (by_fraction, by_numbers):
        values = quantiles(distribution, "load.mass", free, SHARES)
        assert [below(v) for v in values] == pytest.approx(SHARES.tolist(), abs=1e-9)


@pytest.mark.parametrize("word", CASES)
def test_bounds_cut_a_distribution_off_and_leave_its_shape(word: str) -> None:
    bounded, (distribution, _, below) = Parameter(5.0, "kg", 4.5, 5.2), CASES[word]
    values = quantiles(distribution, "load.mass", bounded, SHARES)
    low, high = below(4.5), below(5.2)
    assert [(below(v) - low) / (high - low) for v in values] == pytest.approx(SHARES.tolist(), abs=1e-9)
    ends = quantiles(distribution, "load.mass", bounded, np.array([0.0, 1.0]))
    assert ((ends >= 4.5) & (ends <= 5.2)).all()


@pytest.mark.parametrize("word", CASES)
def test_a_distribution_far_from_the_bounds_is_refused(word: str) -> None:
    with pytest.raises(InputError, match=r"load\.mass: .* leaves its bounds, 50 to 60 kg"):
        quantiles(CASES[word][1], "load.mass", Parameter(55.0, "kg", 50.0, 60.0), SHARES)


@pytest.mark.parametrize("word", CASES)
@pytest.mark.parametrize("spread", [0.0, -0.1, math.inf, math.nan, (math.nan, 1.0), (1.0, math.inf), (1.0, -1.0)])
def test_a_spread_that_cannot_be_is_refused(word: str, spread: float | tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"^(Log)?(Uniform|Normal): "):
        DISTRIBUTIONS[word](spread)


def test_a_fraction_of_nothing_is_refused() -> None:
    for distribution in (Normal(0.1), Uniform(0.1), LogNormal(0.1), LogUniform(0.1)):
        with pytest.raises(InputError, match=r"a fraction of 0|must be positive, got 0"):
            samples(RIG_SAMPLING, {"load.force": distribution}, 3)


@pytest.mark.parametrize("sampling", Sampling)
@pytest.mark.parametrize("count", [1, 7, 100, 1000])
def test_points_fill_the_cube_and_repeat_with_the_seed(sampling: Sampling, count: int) -> None:
    axes = ("mass", "force", "friction")
    points = unit_points(sampling, count, axes, 5, "samples")
    assert points.shape == (count, 3)
    assert ((points >= 0) & (points < 1)).all()
    assert (points == unit_points(sampling, count, axes, 5, "samples")).all()
    for seed, kind in ((6, "samples"), (5, "draws")):
        assert (points != unit_points(sampling, count, axes, seed, kind)).any()
    if count == 1000:
        assert points.mean(axis=0) == pytest.approx([0.5] * 3, abs=0.03)
        assert np.corrcoef(points.T) == pytest.approx(np.eye(3), abs=0.12)


def test_even_samplings_leave_no_gap() -> None:
    hypercube, sobol = (unit_points(s, 64, "abcd", 1, "samples") for s in (Sampling.LATIN_HYPERCUBE, Sampling.SOBOL))
    for points in (hypercube, sobol):
        assert (np.sort((64 * points).astype(int), axis=0) == np.arange(64)[:, None]).all()
    quarters = (4 * sobol[:, :2]).astype(int)
    assert np.unique(quarters, axis=0, return_counts=True)[1].tolist() == [4] * 16


@pytest.mark.parametrize("sampling", Sampling)
def test_samples_by_distributions_vary_together_on_one_axis(sampling: Sampling) -> None:
    spreads: dict[str, Distribution] = {"load.mass": Normal(0.05), "friction.*": Uniform(0.5)}
    cases = samples(RIG_SAMPLING, spreads, 256, seed=2, sampling=sampling)
    masses = np.array([case["load.mass"] for case in cases.values()])
    assert (masses.mean(), masses.std()) == (pytest.approx(5, abs=0.06), pytest.approx(0.25, rel=0.15))
    assert {round(c["friction.static"] / c["friction.coulomb"], 9) for c in cases.values()} == {1.75}
    assert samples(RIG_SAMPLING, spreads, 256, seed=2, sampling=sampling) == cases


def test_a_certificate_does_without_the_statistics_of_scipy() -> None:
    """They take as long to import as all else that it needs, and each worker of a study imports it."""
    code = "import sys, pneuopt; pneuopt.evaluate; print('scipy.stats' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
