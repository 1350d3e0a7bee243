"""The extended Kalman filter of the nodes, against the plain Kalman filter of a linear plant."""

import numpy as np
import pytest

from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.arrays import Array
from pneuopt.shooting import state_filter
from pneuopt.shooting.segments import Segments, segment
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

N, SAMPLES, SAMPLE, TIME_CONSTANT, NOISE = 60, 3, 0.01, 0.05, 0.02  # samples, samples a segment, [s], [s], [m/s]


def problem() -> tuple[tuple[Array, Array, float, float], Segments, Array, Array]:
    """The input, the output, the gain and the state's size of a linear plant; its segments, rough states and values."""
    system = FirstOrder().system().discrete()
    parameters = FirstOrder().system().parameters.with_values({"plant.time_constant": TIME_CONSTANT})
    parameters = parameters.freed("plant.gain")
    gain, scale = parameters.value("plant.gain"), system.states[0].nominal
    rng = np.random.default_rng(1)
    t, u, a = np.arange(N) * SAMPLE, rng.standard_normal(N), np.exp(-SAMPLE / TIME_CONSTANT)
    x = [0.3]
    for k in range(N - 1):
        x.append(a * x[-1] + gain * (1 - a) * u[k])
    y = np.array(x) + NOISE * rng.standard_normal(N)
    rough = np.full((N, 1), 0.1)
    phase = Phase("run", t.astype(np.float64), np.full(N, SAMPLE), u[:, None], regular_nodes(N, SAMPLES), guess=rough)
    residuals = Residuals(0, (system.outputs[0].name,), y[:, None], np.array([NOISE]))
    segments = segment(Transcription(system, parameters, (phase,), (residuals,)))
    q = np.array([p.value for p in parameters.values()])
    return (u, y, gain, scale), segments, rough[::SAMPLES], q


def test_pieces_side_by_side_give_the_filter_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lead forgets where a piece starts, here within four time constants; without one it would show."""
    _, segments, rough, q = problem()
    whole = state_filter.filter_nodes(segments, rough, q)
    monkeypatch.setattr(state_filter, "PIECE_SEGMENTS", 4)
    monkeypatch.setattr(state_filter, "LEAD_SEGMENTS", 8)
    pieces = state_filter.filter_nodes(segments, rough, q)
    np.testing.assert_allclose(pieces, whole, atol=1e-4)
    monkeypatch.setattr(state_filter, "LEAD_SEGMENTS", 0)
    assert np.abs(state_filter.filter_nodes(segments, rough, q) - whole).max() > 1e-3


def test_the_filter_of_a_linear_plant_is_the_kalman_filter() -> None:
    """By hand: sample by sample through each segment, the state's own deviation added from segment to segment."""
    (u, y, gain, scale), segments, rough, q = problem()
    a = np.exp(-SAMPLE / TIME_CONSTANT)
    found = state_filter.filter_nodes(segments, rough, q)

    mean, variance, expected = 0.1, (state_filter.START_DEVIATION * scale) ** 2, []
    for begin in range(0, N, SAMPLES):
        decay = a ** np.arange(SAMPLES)
        forced = np.array(
            [gain * (1 - a) * sum(a ** (k - 1 - i) * u[begin + i] for i in range(k)) for k in range(SAMPLES)]
        )
        information = 1 / variance + np.sum(decay**2) / NOISE**2
        mean = (mean / variance + np.sum(decay * (y[begin : begin + SAMPLES] - forced)) / NOISE**2) / information
        expected.append(mean)
        mean = a**SAMPLES * mean + gain * (1 - a) * sum(a ** (SAMPLES - 1 - i) * u[begin + i] for i in range(SAMPLES))
        variance = a ** (2 * SAMPLES) / information + (state_filter.GATHERED_DEVIATION * scale) ** 2
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-5)  # the integration of a sample leaves 3e-6
