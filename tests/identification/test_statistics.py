import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pneuopt.identification.statistics import agreement, confidence_interval, correlation


def test_agreement_of_a_known_error() -> None:
    figures = agreement([0.0, 1.0, math.nan, 2.0, 3.0], [0.0, 1.0, 99.0, 2.0, 2.0])
    assert figures["rmse"] == pytest.approx(0.5)
    assert figures["nrmse"] == pytest.approx(1 / math.sqrt(5))
    assert figures["fit_percent"] == pytest.approx(100 - 100 / math.sqrt(5))
    assert figures["samples"] == 4


def test_agreement_where_there_is_nothing_to_explain() -> None:
    assert math.isnan(agreement([1.0, 1.0], [1.0, 2.0])["nrmse"])
    assert agreement([1.0, 1.0], [1.0, 2.0])["rmse"] == pytest.approx(math.sqrt(0.5))
    assert math.isnan(agreement([math.nan], [1.0])["rmse"])


def test_predicting_the_mean_explains_nothing() -> None:
    y = np.random.default_rng(0).standard_normal(100)
    assert agreement(y, np.full(100, y.mean()))["fit_percent"] == pytest.approx(0, abs=1e-9)
    assert agreement(y, y)["fit_percent"] == 100


@given(value=st.floats(1e-3, 1e3), ratio=st.floats(1e-6, 2.0))
def test_intervals_hold_the_value(value: float, ratio: float) -> None:
    low, high = confidence_interval(value, ratio * value, log=False)
    assert (low + high) / 2 == pytest.approx(value)
    assert high - low == pytest.approx(2 * 1.959964 * ratio * value, rel=1e-5)
    low, high = confidence_interval(value, ratio * value, log=True)
    assert 0 < low < value < high
    assert low * high == pytest.approx(value**2)


def test_small_deviations_do_not_care_for_the_logarithm() -> None:
    assert_allclose(confidence_interval(5.0, 1e-4, log=True), confidence_interval(5.0, 1e-4, log=False), rtol=1e-8)


def test_no_deviation_no_interval_and_a_huge_one_no_overflow() -> None:
    for log in (False, True):
        assert np.isnan(confidence_interval(5.0, math.nan, log=log)).all()
    low, high = confidence_interval(1.0, 1e6, log=True)
    assert low >= 0
    assert high > 1e100


def test_levels() -> None:
    assert confidence_interval(0.0, 1.0, log=False, level=0.6827)[1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("dof", "quantile"), [(1.5, 6.0), (3.0, 3.18245), (10.0, 2.22814), (math.inf, 1.95996)])
def test_few_degrees_of_freedom_take_students_quantile(dof: float, quantile: float) -> None:
    """The table of Student's t; 1.5 lies between 12.71 and 4.30."""
    low, high = confidence_interval(5.0, 2.0, log=False, dof=dof)
    assert (high - low) / 4 == pytest.approx(quantile, rel=0.06 if dof == 1.5 else 1e-5)


def test_correlation_matrix() -> None:
    assert_allclose(correlation(np.array([[4.0, 1.0], [1.0, 1.0]])), [[1, 0.5], [0.5, 1]])
    assert np.isnan(correlation(np.array([[0.0, 0.0], [0.0, 1.0]]))[0]).all()


def test_a_prediction_that_diverged_is_infinitely_far_without_a_warning() -> None:
    found = agreement([0.0, 1.0, 2.0], [0.0, 1e200, 2.0])
    assert (found["rmse"], found["fit_percent"]) == (np.inf, -np.inf)
