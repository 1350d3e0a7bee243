import math

import numpy as np
import pytest

from pneuopt.logs.noise import noise_level


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_noise_is_told_from_motion(noise: float) -> None:
    rng, t = np.random.default_rng(0), np.linspace(0, 5, 5000)
    column = np.sin(3 * t) + noise * rng.standard_normal(t.size)
    column[rng.random(t.size) < 0.05] = math.nan
    assert noise_level(column) == pytest.approx(noise, rel=0.1)


def test_a_step_and_outliers_do_not_count_as_noise() -> None:
    column = 0.01 * np.random.default_rng(0).standard_normal(4000)
    column[2000:] += 5.0
    column[::400] += 3.0
    assert noise_level(column) == pytest.approx(0.01, rel=0.1)


def test_quantisation_is_the_floor() -> None:
    t = np.linspace(0, 5, 5000)
    assert noise_level(np.round(np.sin(t) / 1e-3) * 1e-3) == pytest.approx(1e-3 / math.sqrt(12), rel=1e-6)


@pytest.mark.parametrize("column", [[1.0] * 10, [math.nan] * 10, [2.0], []])
def test_a_constant_channel_shows_no_noise(column: list[float]) -> None:
    assert math.isnan(noise_level(column))
