"""The extended Kalman filter of the nodes, against the plain Kalman filter of a linear plant."""

import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import Gram, Rollout
from pneuopt.quantities.arrays import Array
from pneuopt.shooting import filters
from pneuopt.shooting.segments import Segments, start_nodes
from pneuopt.shooting.tolerances import GATHERED_DEVIATION, START_DEVIATION
from tests.shooting.first_order import GAIN, NOISE, ROUGH, SAMPLE, SAMPLES, TIME_CONSTANT, first_order_log, forced

N = 60  # samples


def values(segments: Segments) -> Array:
    return np.array([p.value for p in segments.transcription.parameters.values()])


def test_pieces_side_by_side_give_the_filter_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lead forgets where a piece starts, here within four time constants; without one it would show."""
    segments = first_order_log(N).segments
    rough, q = start_nodes(segments), values(segments)
    whole = filters.filter_nodes(segments, rough, q)
    monkeypatch.setattr(filters, "PIECE_SEGMENTS", 4)
    monkeypatch.setattr(filters, "LEAD_SEGMENTS", 8)
    pieces = filters.filter_nodes(segments, rough, q)
    np.testing.assert_allclose(pieces, whole, atol=1e-4)
    monkeypatch.setattr(filters, "LEAD_SEGMENTS", 0)
    assert np.abs(filters.filter_nodes(segments, rough, q) - whole).max() > 1e-3


@pytest.mark.parametrize("gathered", [GATHERED_DEVIATION, 1e-2])
def test_the_filter_of_a_linear_plant_is_the_kalman_filter(gathered: float) -> None:
    """By hand: sample by sample through each segment, the state's own deviation added from segment to segment."""
    (segments, u, y, scale), a = first_order_log(N), np.exp(-SAMPLE / TIME_CONSTANT)
    found = filters.filter_nodes(segments, start_nodes(segments), values(segments), gathered)

    mean, variance, expected = ROUGH, (START_DEVIATION * scale) ** 2, []
    for begin in range(0, N, SAMPLES):
        decay, own = a ** np.arange(SAMPLES), u[begin : begin + SAMPLES]
        driven = np.array([forced(own, GAIN, k) for k in range(SAMPLES)])
        information = 1 / variance + np.sum(decay**2) / NOISE**2
        mean = (mean / variance + np.sum(decay * (y[begin : begin + SAMPLES] - driven)) / NOISE**2) / information
        expected.append(mean)
        mean = a**SAMPLES * mean + forced(own, GAIN)
        variance = a ** (2 * SAMPLES) / information + (gathered * scale) ** 2
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-5)  # the integration of a sample leaves 3e-6


class Kink:
    """A system of one state, whose output turns where it is positive: a Gauss-Newton step from below leads too far."""

    nominal = np.ones(1)
    weights, measured = np.full((1, 1, 1), 1e3), np.full((1, 1, 1), 0.1)
    inputs, t, h = np.zeros((1, 1, 1)), np.zeros((1, 1)), np.ones((1, 1))
    n_columns = 1

    @property
    def sensitivities(self) -> "Kink":
        return self

    def gram(self, x: Array, *_: Array, **__: int) -> Gram:
        slope = np.where(x > 0, 0.8, 0.05)
        y, weight = slope * x, self.weights[:, 0]
        e = np.stack([slope, y - self.measured[:, 0]], axis=2) * weight[..., None]
        grams = e.transpose(0, 2, 1) @ e
        return Gram(grams, grams[:, -1:, -1], e[..., :-1], y[:, None], x.copy(), np.ones((len(x), 1, 1)))


def test_a_step_over_a_kink_is_cut() -> None:
    """Before, the same step was linearised where it had led to, and a slip was lost: 1300 times the noise in it."""
    before, P = np.array([[-0.01]]), np.array([[[1.0]]])
    given = Kink(), np.zeros(1, dtype=np.intp), before, P, np.zeros((1, 0)), 1
    found = filters.update_states(*given)  # type: ignore[arg-type]
    first = float(1e6 * (0.1 + 0.05 * 0.01) ** 2)
    assert found.squares[0] < first / 2
    assert found.end == found.state
    far = Kink()
    far.weights = np.full((1, 1, 1), np.nan)
    lost = filters.update_states(far, *given[1:])  # type: ignore[arg-type]
    assert np.isnan(lost.end).all()


def test_updates_end_where_they_move_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a linear plant the second is the optimum, and the third shows it."""
    segments, taken, gram = first_order_log(N).segments, list[int](), Rollout.gram

    def count(rollout: Rollout, *given: Array, **options: int) -> Gram:
        taken.append(len(given[0]))
        return gram(rollout, *given, **options)

    at, before = np.arange(4), np.full((4, 1), ROUGH)
    monkeypatch.setattr(Rollout, "gram", count)
    given = before, np.ones((4, 1, 1)), values(segments)[segments.parameter_positions[at]], 1
    filters.update_states(segments, at, *given)
    assert taken == [4, 4, 4]


def test_a_singular_system_spoils_no_other() -> None:
    """Rounding left one of forty sets of parameters without a state, and a search ended with a traceback."""
    A, b = np.stack([2 * np.eye(2), np.ones((2, 2)), np.eye(2)]), np.ones((3, 2, 1))
    found = filters.solve_each(A, b)
    np.testing.assert_allclose(found[[0, 2], :, 0], [[0.5, 0.5], [1.0, 1.0]])
    assert np.isnan(found[1]).all()
