"""The extended Kalman filter of the nodes, against the plain Kalman filter of a linear plant."""

import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import RolloutResult
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


@pytest.mark.parametrize("gathered", [state_filter.GATHERED_DEVIATION, 1e-2])
def test_the_filter_of_a_linear_plant_is_the_kalman_filter(gathered: float) -> None:
    """By hand: sample by sample through each segment, the state's own deviation added from segment to segment."""
    (u, y, gain, scale), segments, rough, q = problem()
    a = np.exp(-SAMPLE / TIME_CONSTANT)
    found = state_filter.filter_nodes(segments, rough, q, gathered)

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
        variance = a ** (2 * SAMPLES) / information + (gathered * scale) ** 2
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-5)  # the integration of a sample leaves 3e-6


class Kink:
    """A system of one state, whose output turns where it is positive: a Gauss-Newton step from below leads too far."""

    nominal = np.ones(1)
    weights, measured = np.full((1, 1, 1), 1e3), np.full((1, 1, 1), 0.1)
    inputs, t, h = np.zeros((1, 1, 1)), np.zeros((1, 1)), np.ones((1, 1))

    @property
    def sensitivities(self) -> "Kink":
        return self

    def run(self, x: Array, *_: Array, **__: int) -> RolloutResult:
        slope = np.where(x > 0, 0.8, 0.05)
        dy = slope[:, None, :, None]
        return RolloutResult((slope * x)[:, None, :], x.copy(), None, dy, np.ones((len(x), 1, 1)))


def test_a_step_over_a_kink_is_cut() -> None:
    """Before, the same step was linearised where it had led to, and a slip was lost: 1300 times the noise in it."""
    before, P = np.array([[-0.01]]), np.array([[[1.0]]])
    given = Kink(), np.zeros(1, dtype=np.intp), before, P, np.zeros((1, 0)), 1
    found = state_filter.update_states(*given)  # type: ignore[arg-type]
    first = float(1e6 * (0.1 + 0.05 * 0.01) ** 2)
    assert found.squares[0] < first / 2
    assert found.end == found.state
    far = Kink()
    far.weights = np.full((1, 1, 1), np.nan)
    lost = state_filter.update_states(far, *given[1:])  # type: ignore[arg-type]
    assert np.isnan(lost.end).all()


def test_a_singular_system_spoils_no_other() -> None:
    """Rounding left one of forty sets of parameters without a state, and a search ended with a traceback."""
    A, b = np.stack([2 * np.eye(2), np.ones((2, 2)), np.eye(2)]), np.ones((3, 2, 1))
    found = state_filter.solve_each(A, b)
    np.testing.assert_allclose(found[[0, 2], :, 0], [[0.5, 0.5], [1.0, 1.0]])
    assert np.isnan(found[1]).all()
