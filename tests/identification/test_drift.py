"""The line through estimates against SciPy's, its scatter, and how often chance raises an alarm."""

import numpy as np
import pytest
from scipy.stats import linregress

from pneuopt.identification.drift import fit_line, look_level, power

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
