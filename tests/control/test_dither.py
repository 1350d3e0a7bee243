from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.trajectories import Trajectory


@pytest.mark.parametrize("frequency", [500.0, 600.0])
def test_a_sampled_sine_at_or_above_nyquist_is_refused(frequency: float) -> None:
    with pytest.raises(InputError, match=r"dither\.frequency"):
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
    with pytest.raises(InputError, match="frequency"):
        Dither(frequency)


@pytest.mark.parametrize("waveform", Waveform)
def test_both_waves_begin_at_zero_rise_and_have_amplitude_for_their_peak(waveform: Waveform) -> None:
    t, q = ca.SX.sym("t"), {"amplitude": ca.SX(0.3), "frequency": ca.SX(20.0)}
    wave = ca.Function("wave", [t], [Dither(waveform=waveform).wave(t, q)])
    at = np.linspace(-0.05, 0.1, 3001)
    found = np.array([float(wave(k)) for k in at])
    assert (found.max(), found.min()) == pytest.approx((0.3, -0.3), abs=1e-9)
    assert float(wave(0.0)) == pytest.approx(0.0, abs=1e-12)
    assert float(wave(1e-3)) > 0
    np.testing.assert_allclose(found, 0.3 * waveform.at(2 * np.pi * 20.0 * at), atol=1e-12)
    np.testing.assert_allclose(found[:2001], found[1000:], atol=1e-9)  # a period of 50 ms later


def test_a_triangle_is_straight_between_its_peaks() -> None:
    phase = np.linspace(-np.pi / 2, np.pi / 2, 101)
    np.testing.assert_allclose(Waveform.TRIANGLE.at(phase), 2 * phase / np.pi, atol=1e-12)
    np.testing.assert_allclose(Waveform.TRIANGLE.at(np.pi - phase), 2 * phase / np.pi, atol=1e-12)


@pytest.mark.parametrize("analogue", [False, True])
def test_the_simulation_sees_a_triangles_corners(analogue: bool) -> None:
    """A lag of first order under it, exactly: on a ramp of slope s, ``y = u - s T + (y0 - u0 + s T) exp(-t/T)``."""
    plant = FirstOrder().system()
    pid = PID(1e-2, limits=False) if analogue else PID(limits=False)
    loop = ClosedLoop(plant, pid, Dither(20.0, analogue, Waveform.TRIANGLE))
    given = loop.parameters.with_values({"pid.Kp": 0.0, "dither.amplitude": 0.4})
    t = np.arange(401) * 1e-3
    run = simulate(loop, Trajectory(t, {"reference": np.zeros(len(t))}), given)
    gain, T = (given.value(f"plant.{n}") for n in ("gain", "time_constant"))
    y, corners = 0.0, np.arange(-0.0125, 0.5, 0.025)
    for k, (a, b) in enumerate(pairwise(t)):
        cuts = [a, *corners[(corners > a + 1e-9) & (corners < b - 1e-9)], b]
        for c, d in pairwise(cuts):
            u0, u1 = (0.4 * float(Waveform.TRIANGLE.at(2 * np.pi * 20.0 * s)) for s in (c, d))
            s = gain * (u1 - u0) / (d - c)
            y = gain * u1 - s * T + (y - gain * u0 + s * T) * np.exp(-(d - c) / T)
        assert run["speed"][k + 1] == pytest.approx(y, abs=1e-8), t[k + 1]


def test_joined_periods_are_as_few_as_average_the_sampled_wave_away() -> None:
    """Of a slow one every sample is close to the next: one period; what is left stays below a thousandth."""
    h, t = 1e-3, np.linspace(0.0, 3.0, 3001)
    for frequency in (7.3, 13.37, 29.0, 61.3, 83.0, 97.0, 160.0, 250.0):
        period = Dither().period(frequency, h)
        assert period * frequency == pytest.approx(round(period * frequency))
        y = np.sin(2 * np.pi * frequency * t)
        whole = np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * h)])
        at = t[(t > period) & (t < 3.0 - period)]
        mean = (np.interp(at + period / 2, t, whole) - np.interp(at - period / 2, t, whole)) / period
        assert np.abs(mean).max() < 3e-3, frequency
    assert Dither().period(13.37, h) == pytest.approx(1 / 13.37)
