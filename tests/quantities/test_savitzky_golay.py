"""The Savitzky-Golay filter against SciPy's."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from pneuopt.quantities.savitzky_golay import savitzky_golay


@pytest.mark.parametrize(("window", "order"), [(5, 3), (31, 3), (21, 2), (311, 3)])
@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_it_is_scipys_to_rounding_up_to_both_ends(window: int, order: int, derivative: int) -> None:
    rng = np.random.default_rng(0)
    y = 5.0 + np.cumsum(rng.standard_normal(400))
    expected = savgol_filter(y, window, order, deriv=derivative, delta=1e-3)
    found = savitzky_golay(y, window, order, derivative=derivative, step=1e-3)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_a_column_as_long_as_its_window_has_the_polynomial_through_all() -> None:
    y = np.array([1.0, 4.0, 2.0, 7.0, 5.0])
    np.testing.assert_allclose(savitzky_golay(y, 5, 4), y)
    np.testing.assert_allclose(savitzky_golay(y, 5, 0), y.mean())
