import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.errors import InputError


@pytest.mark.parametrize("frequency", [500.0, 600.0])
def test_a_sampled_sine_at_or_above_nyquist_is_refused_with_numbers(frequency: float) -> None:
    with pytest.raises(InputError, match=rf"{frequency:g} Hz .* every 1 ms.* 500 Hz.*analogue=True"):
        Dither(frequency).parameters("V", 1e-3)


def test_an_analogue_or_continuous_sine_has_no_such_limit() -> None:
    assert Dither(600.0, analogue=True).parameters("V", 1e-3).value("frequency") == 600.0
    assert Dither(600.0).parameters("V").value("frequency") == 600.0


def test_the_frequency_cannot_be_moved_to_nyquist_later() -> None:
    parameters = Dither().parameters("V", 1e-3)
    with pytest.raises(InputError, match="frequency"):
        parameters.with_values({"frequency": 500.0})


@pytest.mark.parametrize(("frequency", "periods"), [(160.0, 4), (125.0, 1), (100.0, 1), (300.0, 3)])
def test_averaging_over_the_period_removes_the_sampled_sine(frequency: float, periods: int) -> None:
    h = 1e-3
    period = Dither().period(frequency, h)
    assert period == pytest.approx(periods / frequency)
    n = round(period / h)
    assert n * h == pytest.approx(period)
    assert np.mean(np.sin(2 * np.pi * frequency * h * np.arange(n))) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("frequency", [0.0, -1.0, float("inf")])
def test_frequency_must_be_positive(frequency: float) -> None:
    with pytest.raises(InputError, match="frequency must be positive"):
        Dither(frequency)
