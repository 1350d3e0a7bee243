"""The sensitivity peak from poles is that of python-control's frequency response, resonances included."""

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.evaluation.batch_margins import sensitivity_peaks
from pneuopt.evaluation.tolerances import LOOPS_AT_A_TIME


@pytest.mark.parametrize("damping", [0.003, 0.05, 0.5])
def test_peaks_are_those_of_a_dense_frequency_response(damping: float) -> None:
    rng, s, plants = np.random.default_rng(3), control.tf("s"), []
    for _ in range(12):
        w, lag, gain = rng.uniform(5, 80), rng.uniform(0.001, 0.05), damping * 10 ** rng.uniform(-1, 0.5)
        L = gain * w**2 / (s**2 + 2 * damping * w * s + w**2) / (lag * s + 1) * (1 + damping * rng.uniform(0.1, 20) / s)
        closed = control.feedback(L, 1).poles()
        if closed.real.max() < 0:
            plants.append((L, closed))
    assert len(plants) >= 6
    found = sensitivity_peaks(
        np.array([L.poles() for L, _ in plants]), np.array([q for _, q in plants]), low=1e-3, high=1e5
    )
    grid = np.geomspace(1e-3, 1e5, 20000)
    for (L, closed), peak in zip(plants, found.tolist(), strict=True):
        near = np.concatenate([abs(q) * np.geomspace(0.9, 1.1, 4001) for q in closed])
        exact = max(float(np.abs(1 / (1 + L(1j * w))).max()) for w in (grid, near))
        assert peak == pytest.approx(exact, rel=2e-5)


def test_every_loop_has_its_own_peak_however_many_there_are() -> None:
    """``L = w0^2/(s (s + w0))`` peaks at the same height for every w0, which lies at another frequency."""
    w0 = np.geomspace(0.1, 1e3, 2 * LOOPS_AT_A_TIME + 7)[:, None]
    peaks = sensitivity_peaks(w0 * np.array([0j, -1.0]), w0 * np.roots([1.0, 1.0, 1.0]).astype(complex), 1e-4, 1e6)
    w = np.geomspace(0.01, 100, 200001)
    exact = np.abs(1j * w * (1j * w + 1) / ((1j * w) ** 2 + 1j * w + 1)).max()
    assert_allclose(peaks, exact, rtol=1e-6)
