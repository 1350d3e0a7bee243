import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.logs.noise import estimate_noise, find_refresh, find_resolution, noise_level
from pneuopt.quantities.arrays import Array

FACTOR = 1.6  # of the level, either way, for logs of 1000 samples and more; a shorter one may be off by `SHORT_FACTOR`
SHORT_FACTOR = 2.5


def staircase(t: Array, _rate: float) -> Array:
    """Steps of 50 mm to and fro, each settled after 0.1 s, as a position loop makes them."""
    since = [np.maximum(t - 0.8 * k, 0.0) / 0.02 for k in range(int(t[-1] / 0.8) + 1)]
    return np.asarray(sum(0.05 * (-1) ** k * (1 - (1 + s) * np.exp(-s)) for k, s in enumerate(since)))


def stick_slip(t: Array, _rate: float) -> Array:
    """Two thirds of the time at rest, with jumps of the acceleration at both ends."""
    return np.asarray(0.05 * np.cumsum(np.maximum(np.abs(np.sin(4.4 * t)) - 0.85, 0.0)) / t.size)


def chirp(t: Array, rate: float) -> Array:
    """From 0.2 Hz to 20 Hz, or to a tenth of the sampling rate."""
    end = min(20.0, rate / 10)
    return np.asarray(0.02 * np.sin(2 * math.pi * (0.2 * t + (end - 0.2) * t**2 / (2 * t[-1]))))


MOTIONS: dict[str, Callable[[Array, float], Array]] = {
    "staircase": staircase,
    "stick-slip": stick_slip,
    "chirp": chirp,
    "cruise": lambda t, _: 0.0987 * t,
    "sine of 1 Hz": lambda t, _: 0.1 * np.sin(2 * math.pi * t),
    "rest": lambda t, _: 0.0 * t,
}


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_noise_is_told_from_motion(noise: float) -> None:
    rng, t = np.random.default_rng(0), np.linspace(0, 5, 5000)
    column = np.sin(3 * t) + noise * rng.standard_normal(t.size)
    column[rng.random(t.size) < 0.05] = math.nan
    assert noise_level(column) == pytest.approx(noise, rel=0.1)


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(sorted(MOTIONS)),
    st.floats(50, 1e4),
    st.integers(200, 4000),
    st.floats(-6.5, -3).map(lambda e: 10**e),
    st.sampled_from([0.0, 0.1, 1.0, 10.0]),
    st.booleans(),
    st.integers(0, 1000),
)
def test_the_level_of_white_noise_on_any_motion(
    motion: str, rate: float, n: int, noise: float, steps: float, jitter: bool, seed: int
) -> None:
    """With and without a resolution of `steps` times the noise, from 50 Hz to 10 kHz."""
    rng = np.random.default_rng(seed)
    t = (np.arange(n) + (0.3 * rng.random(n) if jitter else 0.0)) / rate
    exact, resolution = MOTIONS[motion](np.asarray(t), rate), steps * noise
    y = exact + noise * rng.standard_normal(n)
    y = np.round(y / resolution) * resolution if resolution else y
    if not np.any(np.diff(y)):
        return
    found, factor = estimate_noise(y, t if jitter else None), FACTOR if n >= 1000 else SHORT_FACTOR
    # rounding adds its variance where the noise or the motion spreads it, and at rest stands still
    low, high = (
        max(noise if steps < 1 else 0.0, resolution / math.sqrt(12)),
        math.hypot(noise, resolution / math.sqrt(12)),
    )
    assert low / factor < found.level < high * factor


@pytest.mark.parametrize("begin", [0.0, 3.0, 1.7e9])
def test_a_cruise_is_not_noise(begin: float) -> None:
    """0.1 mm a sample, with 10 nm of noise: the smallest step between two samples is the motion's."""
    rng = np.random.default_rng(0)
    t = begin + 1e-3 * np.arange(1000)
    ramp = 1e-4 * np.arange(1000) + 1e-8 * rng.standard_normal(1000)
    found = estimate_noise(ramp, t)
    assert found.level == pytest.approx(1e-8, rel=0.15)
    assert found.resolution == 0


def test_windows_of_250_ms_of_a_fast_servo_read_the_encoder() -> None:
    """A count of 1 um at up to 0.5 m/s: each window's smallest step is hundreds of counts."""
    t = np.arange(20_000) * 1e-3
    axis = np.round((0.1 * np.sin(5 * t) + 2e-7 * np.random.default_rng(0).standard_normal(t.size)) / 1e-6) * 1e-6
    for k in range(0, t.size, 250):
        found = estimate_noise(axis[k : k + 250], t[k : k + 250])
        assert found.resolution == pytest.approx(1e-6, rel=1e-6)
        assert 1e-6 / math.sqrt(12) / 1.1 < found.level < 2 * 1e-6 / math.sqrt(12)


@pytest.mark.parametrize("rate", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("frequency", [0.5, 5.0, 20.0])
def test_motion_too_fast_for_the_sampling_is_not_white(rate: float, frequency: float) -> None:
    """The level is then an upper bound, and says that it is."""
    t = np.arange(round(8 * rate)) / rate
    y = 0.02 * np.sin(2 * math.pi * frequency * t) + 1e-5 * np.random.default_rng(0).standard_normal(t.size)
    found = estimate_noise(y)
    assert found.is_white == (found.level < 2e-5)
    assert found.is_white or frequency > rate / 11


def test_a_step_and_outliers_do_not_count_as_noise() -> None:
    column = 0.01 * np.random.default_rng(0).standard_normal(4000)
    column[2000:] += 5.0
    column[::400] += 3.0
    assert noise_level(column) == pytest.approx(0.01, rel=0.1)


def test_quantisation_is_the_floor() -> None:
    t = np.linspace(0, 5, 5000)
    found = estimate_noise(np.round(np.sin(t) / 1e-3) * 1e-3)
    assert found.level == pytest.approx(1e-3 / math.sqrt(12), rel=0.05)
    assert found.is_quantisation


def test_noise_beyond_the_resolution_is_no_quantisation() -> None:
    column = np.round(3e-3 * np.random.default_rng(0).standard_normal(2000), 3)
    found = estimate_noise(column)
    assert found.resolution == pytest.approx(1e-3)
    assert found.level == pytest.approx(math.hypot(3e-3, 1e-3 / math.sqrt(12)), rel=0.1)
    assert not found.is_quantisation


@settings(deadline=None, max_examples=40)
@given(st.floats(-9, 2).map(lambda e: 10**e), st.floats(-1e3, 1e3), st.integers(20, 500), st.integers(0, 1000))
def test_the_resolution_of_a_lattice(step: float, origin: float, n: int, seed: int) -> None:
    """Also of one that begins anywhere, as far as doubles carry its step."""
    counts = np.random.default_rng(seed).integers(-20, 20, n).cumsum()
    values = step * (counts + origin)
    assert find_resolution(values) == pytest.approx(step, rel=1e-6)


ENCODERS = {
    "ball screw of 5 mm, 8192 counts, in mm": (5 / 8192, ("%.4f", "%.6f", "%.17g")),
    "10 um, in mm": (0.01, ("%.4f",)),
    "4096 counts a turn, in rad": (2 * math.pi / 4096, ("%.6f", "%.10g", "%.17g")),
    "4096 counts a turn, in degrees": (360 / 4096, ("%.4f",)),
    "12 bit of 10 bar": (10 / 4096, ("%.4f",)),
}


@pytest.mark.parametrize(("step", "decimals"), [(s, d) for s, formats in ENCODERS.values() for d in formats])
def test_the_step_of_an_encoder_is_seen_through_the_decimals_of_its_log(step: float, decimals: str) -> None:
    """A ratio of counts is no round number: the lattice of the decimals is not the sensor's."""
    t = np.arange(8000) * 1e-3
    x = 40 * np.clip(np.sin(2 * np.pi * 0.3 * t), -0.8, 0.8)
    written = np.array([float(decimals % v) for v in np.round(x / step) * step])
    found = estimate_noise(written, t)
    assert found.resolution == pytest.approx(step, rel=1e-3)
    assert found.level == pytest.approx(step / math.sqrt(12), rel=0.02)


def test_decimals_coarser_than_the_encoder_are_the_resolution() -> None:
    x = 40 * np.sin(2 * np.pi * 0.3 * np.arange(8000) * 1e-3)
    assert find_resolution(np.round(np.round(x / (5 / 8192)) * (5 / 8192), 3)) == pytest.approx(1e-3)


def test_values_on_no_lattice_have_no_resolution() -> None:
    rng = np.random.default_rng(0)
    for n in (10, 100, 10_000):
        assert find_resolution(rng.standard_normal(n)) == 0
        assert find_resolution(np.arange(n) * 1e-4 + 1e-8 * rng.standard_normal(n)) == 0


def test_every_other_sample_may_be_missing() -> None:
    t = np.arange(2000) * 1e-3
    column = np.sin(6 * t) + 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    column[1::2] = math.nan
    assert noise_level(column, t) == pytest.approx(1e-3, rel=0.15)


@pytest.mark.parametrize("column", [[1.0] * 10, [math.nan] * 10, [2.0], []])
def test_a_constant_channel_shows_no_noise(column: list[float]) -> None:
    assert math.isnan(noise_level(column))


def held(y: Array, period: float, first: float = 0.0) -> Array:
    """A channel as a sensor gives it that is new every so many rows, whole or not; the log repeats what it had."""
    new = (np.arange(y.size) - first) % period < 1
    return np.asarray(y[np.maximum.accumulate(np.where(new, np.arange(y.size), 0))])


def test_a_sensor_slower_than_its_log_is_known_by_the_rows_that_change() -> None:
    """Whole and broken ratios of both rates, with its noise finer or coarser than its step, dwells, lost rows."""
    rng, t = np.random.default_rng(3), np.linspace(0, 8, 8000)
    y = 0.05 * np.clip(np.sin(3 * t), -0.8, 0.8) + 1e-5 * rng.standard_normal(t.size)
    for step in (0.0, 1e-4):
        fine = np.round(y / step) * step if step else y
        for period, first in ((2.0, 0), (4.0, 3), (5.0, 2), (10.0, 7), (10 / 3, 1), (2.5, 0), (4.0007, 2)):
            column = held(fine, period, first)
            found = find_refresh(column)
            assert found is not None, (step, period)
            assert found.period == pytest.approx(period, rel=1e-3)
            changed = np.flatnonzero(np.diff(column)) + 1
            assert found.fresh[changed].mean() > 0.999  # nothing that is new is left out
            assert found.fresh.mean() == pytest.approx(1 / period, rel=0.01)
    column = held(y, 5.0, 2)
    column[rng.random(t.size) < 0.01] = math.nan
    found, lost = find_refresh(column), rng.random(t.size) > 0.02
    assert found is not None
    assert found.period == 5
    found = find_refresh(held(y, 5.0, 2)[lost], t[lost])
    assert found is not None
    assert found.period == pytest.approx(5)


def test_an_encoder_that_stands_or_creeps_is_no_slow_sensor() -> None:
    rng = np.random.default_rng(4)
    for name, motion in MOTIONS.items():
        for rate in (100.0, 1000.0, 4000.0):
            t = np.arange(4000) / rate
            for step in (1e-3, 1e-4, 1e-5, 1e-6):
                for noise in (0.0, 0.3 * step):
                    y = motion(t, rate) + noise * rng.standard_normal(t.size)
                    assert find_refresh(np.round(y / step) * step) is None, (name, rate, step, noise)
    creeping = np.round(np.arange(4000) / 4) * 1e-5  # a count every fourth row, by chance
    assert find_refresh(creeping) is None
    assert find_refresh(np.zeros(100)) is None


def test_the_noise_of_a_slow_sensor_is_that_of_its_new_values() -> None:
    rng, t = np.random.default_rng(5), np.linspace(0, 6, 6000)
    y = np.sin(2 * t) + 0.05 * rng.standard_normal(t.size)
    for period in (1.5, 4.0, 10 / 3):
        column = held(y, period)
        found = find_refresh(column)
        assert found is not None
        level = noise_level(np.where(found.fresh, column, np.nan), t)
        assert level == pytest.approx(0.05, rel=0.15)
