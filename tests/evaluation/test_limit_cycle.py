"""Limit cycles: known signals, an oscillator with a known period, hunting under LuGre friction; and what is none."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.limit_cycle import find_limit_cycle
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import LuGre
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory

T = np.linspace(0.0, 4.0, 2001)


def sine(frequency: float, amplitude: float = 0.02) -> Array:
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * T + 0.4))


@pytest.mark.parametrize("frequency", [2.0, 5.0, 23.0])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_sines_amplitude_and_frequency_are_found_through_noise(frequency: float, noise: float) -> None:
    rough = 0.02 * noise * np.random.default_rng(1).normal(size=len(T))
    found = find_limit_cycle(T, 0.05 + sine(frequency) + rough)
    assert found is not None
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    assert found.amplitude == pytest.approx(0.02, rel=0.02 if noise == 0 else 0.35)


def test_a_triangles_and_a_crawls_peaks_are_their_own() -> None:
    found = find_limit_cycle(T, 0.03 * Waveform.TRIANGLE.at(2 * np.pi * 3.0 * T))
    assert found is not None
    assert found.amplitude == pytest.approx(0.03, rel=0.03)
    phase = (2.5 * T) % 1.0
    crawl = np.where(phase < 0.6, 0.0, 0.04 * np.sin(np.pi * (phase - 0.6) / 0.4))
    found = find_limit_cycle(T, crawl)
    assert found is not None
    assert (found.frequency, found.amplitude) == pytest.approx((2.5, 0.02), rel=0.02)
    assert found.stick_share == pytest.approx(0.6, abs=0.02)
    assert found.describe("m/s").startswith("a limit cycle of +-0.02 m/s at 2.5 Hz, at a standstill 6")


def test_van_der_pols_cycle_has_its_known_period() -> None:
    """Period 11.6122 and amplitude 2.0215 at mu = 5 (Strogatz; Urabe 1960), from a small start."""
    run = solve_ivp(
        lambda _t, z: [z[1], 5 * (1 - z[0] ** 2) * z[1] - z[0]], (0, 150), [0.1, 0.0], rtol=1e-9, max_step=0.1
    )
    found = find_limit_cycle(run.t, run.y[0])
    assert found is not None
    assert found.frequency == pytest.approx(1 / 11.6122, rel=0.01)
    assert found.amplitude == pytest.approx(2.0215, rel=0.01)


@pytest.mark.parametrize("lag", [0, 5, 50, 300])
def test_noise_is_no_limit_cycle_however_it_is_filtered(lag: int) -> None:
    rng, kept = np.random.default_rng(2), lag / (1 + lag)
    for _ in range(20):
        y, noise = np.zeros(len(T)), rng.normal(size=len(T))
        for k in range(1, len(T)):
            y[k] = kept * y[k - 1] + (1 - kept) * noise[k]
        assert find_limit_cycle(T, 1.0 + y) is None


@pytest.mark.parametrize("damping", [0.3, 0.05, 0.01])
def test_a_ringing_that_dies_out_is_none(damping: float) -> None:
    w = 2 * np.pi * 5.0
    assert find_limit_cycle(T, 1 - np.exp(-damping * w * T) * np.cos(w * T), min_amplitude=1e-9) is None


@pytest.mark.parametrize(
    "y", [np.zeros_like(T), np.ones_like(T), T, 1 - np.exp(-3 * T), 0.001 * sine(5.0) + np.exp(-20 * T)]
)
def test_rest_a_ramp_an_approach_and_what_is_too_small_are_none(y: Array) -> None:
    assert find_limit_cycle(T, y) is None


def test_the_dithers_ripple_is_averaged_away_and_a_cycle_beneath_it_is_not() -> None:
    ripple = sine(40.0, 0.05)
    assert find_limit_cycle(T, 0.1 + ripple) is not None
    assert find_limit_cycle(T, 0.1 + ripple, dither_period=1 / 40.0) is None
    found = find_limit_cycle(T, 0.1 + ripple + sine(3.0), dither_period=1 / 40.0)
    assert found is not None
    assert (found.frequency, found.amplitude) == pytest.approx((3.0, 0.02), rel=0.03)


def test_size_and_time_scale_with_the_signal() -> None:
    found, scaled = find_limit_cycle(T, sine(3.0)), find_limit_cycle(7.0 + 10 * T, 5 - 100 * sine(3.0))
    assert found is not None
    assert scaled is not None
    assert scaled.amplitude == pytest.approx(100 * found.amplitude, rel=0.01)
    assert scaled.frequency == pytest.approx(found.frequency / 10, rel=0.01)


def test_an_integrals_hunting_under_lugre_friction_is_found_and_ends_without_the_integral() -> None:
    """A mass under position control sticks, winds up, jumps: the classic hunting of integral action with stiction."""
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID(limits=False), measured="position")
    values = {"friction.coulomb": 10.0, "friction.static": 20.0, "friction.viscous": 10.0, "load.mass": 2.0}
    gains = {"friction.stribeck_velocity": 0.01, "pid.Kp": 1000.0, "pid.Kd": 60.0, "pid.Tf": 0.005}
    t = np.linspace(0.0, 30.0, 3001)
    inputs = Trajectory(t, {q.name: np.full(len(t), 0.02 if q.name == "reference" else 0.0) for q in loop.inputs})
    cycles = []
    for Ki in (6000.0, 0.0):
        p = loop.parameters.with_values({**values, **gains, "pid.Ki": Ki})
        run = simulate(loop, inputs, p, rtol=1e-7)
        cycles.append(find_limit_cycle(t, run["position"], min_amplitude=1e-4))
    assert cycles[0] is not None
    assert cycles[0].amplitude > 1e-3
    assert cycles[1] is None
