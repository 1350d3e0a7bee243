"""Metrics under dither: the signal's where the dither is nothing, those of its mean where the ripple is steady."""

from math import log, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.dither_ripple import describe_ripple
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.metric import Source
from pneuopt.evaluation.metrics import BandCentre, step_metrics
from pneuopt.evaluation.requirements import METRICS
from pneuopt.models.catalog import t32
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.parameters import ParameterSet

PERIOD = 0.05
T = np.linspace(0.0, 12.0, 6001)
READ = ("SettlingTime", "RiseTime", "Overshoot", "Peak", "SteadyStateError", "IAE", "ITAE", "Ripple")


def measure(y: np.ndarray, period: float | None = PERIOD, initial: float = 0.0) -> dict[str, float]:
    return step_metrics(T, y, 1.0, initial, band_centre=BandCentre.REFERENCE, dither_period=period)


def sine(frequency: float, amplitude: float, phase: float = 0.0) -> np.ndarray:
    wave: np.ndarray = amplitude * np.sin(2 * pi * frequency * T + phase)
    return wave


def friction_drive(dither: Dither | None, amplitude: float) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(), dither, measured="speed")
    values = {"pid.Kp": 150.0, "pid.Ki": 3000.0, "friction.viscous": 80.0, "load.mass": 5.0}
    values |= {"dither.amplitude": amplitude} if dither else {}
    return loop, loop.parameters.with_values(values)


def t32_drive(dither: Dither | None, amplitude: float) -> tuple[ClosedLoop, ParameterSet]:
    drive, hardware = t32()
    loop = ClosedLoop(drive.system(), PID(), dither, measured="speed")
    values = {"pid.Kp": 28.47, "pid.Ki": 264.7, "pid.Kd": 0.3219, "pid.Tf": 5e-4, "load.mass": 3.5, "pid.c": 0.0}
    values |= {"dither.amplitude": amplitude} if dither else {}
    return loop, (loop.parameters | hardware).with_values(values)


START = {"position": 0.05, "pressure_b": 3.5e5}
DRIVES = {
    "friction": (friction_drive, Step(0.1, initial=0.02, horizon=0.6), 30.0),
    "t32": (t32_drive, Step(0.2, horizon=0.3, start=START), 1000 / (2 * pi)),
}


@pytest.mark.parametrize("drive", DRIVES)
def test_a_dither_of_nothing_changes_no_metric(drive: str) -> None:
    """The mean over a period alone has the loop on T32 settle in 41 instead of 58 ms under a dither of a picovolt."""
    build, step, frequency = DRIVES[drive]
    loop, p = build(None, 0.0)
    plain = evaluate(loop, step, p).iloc[:, 0]
    for amplitude in (0.0, 1e-12, 1e-3):
        loop, p = build(Dither(frequency), amplitude)
        found = evaluate(loop, step, p).iloc[:, 0]
        for name in (n for n, metric in METRICS.items() if metric.source is Source.RESPONSE and n in plain):
            near = 1e-3 * (1.0 if METRICS[name].percent else step.size)
            assert found[name] == pytest.approx(plain[name], rel=1e-3, abs=near, nan_ok=True), (name, amplitude)


@settings(deadline=None, max_examples=50)
@given(
    lag=st.floats(0.5, 2.0),
    amplitude=st.floats(1e-9, 0.3),
    phase=st.floats(0.0, 2 * pi),
    overtone=st.floats(0.0, 0.5),
)
def test_a_lag_under_a_steady_ripple_settles_as_without(
    lag: float, amplitude: float, phase: float, overtone: float
) -> None:
    ripple = sine(1 / PERIOD, amplitude, phase) + sine(2 / PERIOD, amplitude * overtone)
    plain, found = measure(1 - np.exp(-T / lag), None), measure(1 - np.exp(-T / lag) + ripple)
    assert found["SettlingTime"] == pytest.approx(lag * log(50), rel=2e-3)
    begun = (
        amplitude * (1 + overtone) / pi * lag / 0.9
    )  # the first period's mean holds half a wave more, where 10 % is met
    for name in READ[1:-1]:
        near = 0.03 + (begun if name == "RiseTime" else 0.0)
        assert found[name] == pytest.approx(plain[name], rel=5e-3, abs=near), name
    assert found["Ripple"] == pytest.approx(np.ptp(ripple), rel=0.02, abs=2e-3)


@settings(deadline=None, max_examples=50)
@given(frequency=st.floats(0.5, 12.0), hunting=st.floats(0.03, 0.3), rise=st.floats(0.02, 0.5))
def test_hunting_is_no_ripple(frequency: float, hunting: float, rise: float) -> None:
    """A loop that hunts without dither is read under a dither of nothing as it is without one."""
    y = 1 - np.exp(-T / rise) + sine(frequency, hunting)
    plain, found = measure(y, None), measure(y)
    for name in READ:
        assert found[name] == pytest.approx(plain[name], rel=0.02, abs=2 * hunting, nan_ok=True), name


def test_a_ripple_that_changes_along_the_stroke_is_still_ripple() -> None:
    y = 1 - np.exp(-T / 0.3) + sine(1 / PERIOD, 0.1) * (1.6 - 0.05 * T)
    assert measure(y)["SettlingTime"] == pytest.approx(0.3 * log(50), rel=0.01)


def test_a_jump_in_the_last_periods_is_no_ripple() -> None:
    """The mean would smooth it over half a period to either side."""
    y = np.where(T < 11.8, 0.5, 1.0) + sine(1 / PERIOD, 1e-6)
    assert measure(y)["Ripple"] == pytest.approx(0.5, rel=1e-3)
    late = np.where(T < 11.3, 0.5, 1.0) + sine(1 / PERIOD, 1e-6)
    assert measure(late)["SettlingTime"] == pytest.approx(11.3, abs=2e-3)


def test_the_raw_signal_settles_too_or_a_sentence_says_that_it_does_not() -> None:
    """A lag of .3 s under a ripple of 1 and of 9 %: the raw signal is in the band where the lag is within 1 %."""
    small, large = (measure(1 - np.exp(-T / 0.3) + sine(1 / PERIOD, share)) for share in (0.01, 0.09))
    for found in (small, large):
        assert found["SettlingTime"] == pytest.approx(0.3 * log(50), rel=2e-3)
    assert small["SettlingTimeRaw"] == pytest.approx(0.3 * log(100), abs=PERIOD)
    assert np.isnan(large["SettlingTimeRaw"])
    assert describe_ripple(small, 1.0, 0.02) is None
    text = describe_ripple(large, -1.0, 0.02)
    assert text is not None
    assert "only the mean settles, in 1.17 s: a ripple of 18 % of the step" in text
    hunting = measure(1 - np.exp(-T / 0.3) + sine(2.0, 0.09))
    assert describe_ripple(hunting, 1.0, 0.02) is None


@pytest.mark.parametrize(("amplitude", "exceeds"), [(60.0, True), (1.0, False)])
def test_a_certificate_says_that_only_the_mean_settles(amplitude: float, exceeds: bool) -> None:
    loop, p = friction_drive(Dither(60.0), amplitude)
    found = certificate(loop, Step(0.2, horizon=0.5), p)
    assert found.metrics.loc["SettlingTime"].notna().all()
    assert found.metrics.loc["SettlingTimeRaw"].isna().all() == exceeds
    assert any("at 0 to 0.2 only the mean settles" in note for note in found.notes) == exceeds


def test_before_a_step_from_motion_the_signal_is_the_old_reference() -> None:
    """Taken as 0 before it, the mean would begin at half the speed and count as undershoot."""
    y = 2.0 - np.exp(-T) + sine(1 / PERIOD, 0.2) * (T > 0)
    found = step_metrics(T, y, 2.0, 1.0, dither_period=PERIOD)
    assert found["Undershoot"] < 6.5


def test_a_loop_that_hunts_between_its_limits_differs_in_the_reading_only() -> None:
    """Under a picovolt the responses are one; of the metrics the hunting that five periods do not tell from ripple is
    left out, less than 1 % of the step.
    """
    build, step, frequency = DRIVES["t32"]
    runs, found = [], []
    for amplitude in (0.0, 1e-12):
        loop, p = build(Dither(frequency), amplitude)
        p = p.with_values({"pid.Kp": 300.0, "pid.lower": -5.0, "pid.upper": 5.0})
        runs.append(respond(loop, step, p))
        found.append(evaluate(loop, step, p).iloc[:, 0])
    at = np.linspace(0.0, step.horizon, 301)
    signals = [np.interp(at, run.t, run["speed"]) for run in runs]
    assert np.ptp(signals[0][150:]) > step.size
    assert np.mean(np.abs(runs[0]["control"]) > 4.99) > 0.9
    np.testing.assert_allclose(signals[0], signals[1], atol=1e-6 * step.size)
    for name in ("Overshoot", "SteadyStateError"):
        assert found[0][name] == pytest.approx(found[1][name], abs=1.0)
        assert found[0][name] != found[1][name]
    assert all(np.isnan(metrics["SettlingTime"]) for metrics in found)
