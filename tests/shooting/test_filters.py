"""The extended Kalman filter of the nodes, against the plain one of a linear plant; and its prediction errors."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled.rollout import Gram, Rollout
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting import filters
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.filters import PredictionErrors
from pneuopt.shooting.segments import Segments, start_nodes
from pneuopt.shooting.tolerances import GATHERED_DEVIATION, ROBUST_SQUARES, START_DEVIATION
from tests.shooting.first_order import GAIN, NOISE, ROUGH, SAMPLE, SAMPLES, TIME_CONSTANT, first_order_log, forced

FILTERED = 60  # samples


def values(segments: Segments) -> Array:
    return np.array([p.value for p in segments.transcription.parameters.values()])


def test_pieces_side_by_side_give_the_filter_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The segments before a piece forget where it starts, here within four time constants; fewer would show it."""
    segments = first_order_log(FILTERED).segments
    rough, q = start_nodes(segments), values(segments)
    whole = filters.filter_nodes(segments, rough, q)
    monkeypatch.setattr(filters, "PIECE_SEGMENTS", 8)
    pieces = filters.filter_nodes(segments, rough, q)
    np.testing.assert_allclose(pieces, whole, atol=1e-4)
    monkeypatch.setattr(filters, "PIECE_SEGMENTS", 1)
    assert np.abs(filters.filter_nodes(segments, rough, q) - whole).max() > 1e-3


def test_logs_are_filtered_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each begins anew: the starts of four forecasts took six hundred steps, of forty-seven segments each."""
    segments, taken, update = first_order_log(FILTERED).segments, list[Indices](), filters.update_states
    linked = segments.linked.copy()
    linked[7] = False
    cut = replace(segments, linked=linked)

    def record(given: Segments, at: Indices, *others: Any) -> filters.StateUpdate:
        taken.append(at)
        return update(given, at, *others)

    monkeypatch.setattr(filters, "update_states", record)
    found = filters.filter_nodes(cut, start_nodes(cut), values(cut))
    assert len(taken) == segments.count - 8
    assert np.array_equal(np.sort(np.concatenate(taken)), np.arange(segments.count))
    whole = filters.filter_nodes(segments, start_nodes(segments), values(segments))
    assert_allclose(found[:8], whole[:8])
    assert np.abs(found[8] - whole[8]).max() > 1e-4


@pytest.mark.parametrize("gathered", [GATHERED_DEVIATION, 1e-2])
def test_the_filter_of_a_linear_plant_is_the_kalman_filter(gathered: float) -> None:
    """By hand: sample by sample through each segment, the state's own deviation added from segment to segment."""
    (segments, u, y, scale), a = first_order_log(FILTERED), np.exp(-SAMPLE / TIME_CONSTANT)
    found = filters.filter_nodes(segments, start_nodes(segments), values(segments), gathered)

    mean, variance, expected = ROUGH, (START_DEVIATION * scale) ** 2, []
    for begin in range(0, FILTERED, SAMPLES):
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
    segments, taken, gram = first_order_log(FILTERED).segments, list[int](), Rollout.gram

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


PREDICTED = 120  # samples
GATHERED = 1e-3


def errors_of(segments: Segments, part: Indices | None = None) -> PredictionErrors:
    own = np.arange(segments.count) if part is None else part
    return PredictionErrors(segments, start_nodes(segments), ParameterScaling(segments.transcription), own)


def searched(errors: PredictionErrors, *gains: float) -> Array:
    return np.array([[np.log(g) if errors.scaling.log[0] else g] for g in gains])


def by_hand(u: Array, y: Array, gain: float, scale: float) -> float:
    """The cost: innovations of each segment over their covariance, the large ones by their logarithm."""
    a, cost = np.exp(-SAMPLE / TIME_CONSTANT), 0.0
    mean, variance = ROUGH, (START_DEVIATION * scale) ** 2
    for begin in range(0, PREDICTED, SAMPLES):
        decay, own = a ** np.arange(SAMPLES), u[begin : begin + SAMPLES]
        driven = np.array([forced(own, gain, k) for k in range(SAMPLES)])
        innovation = y[begin : begin + SAMPLES] - driven - decay * mean
        covariance = NOISE**2 * np.eye(SAMPLES) + variance * np.outer(decay, decay)
        squares = float(innovation @ np.linalg.solve(covariance, innovation))
        cost += ROBUST_SQUARES * SAMPLES * np.log1p(squares / (ROBUST_SQUARES * SAMPLES))
        filtered = mean + variance * decay @ np.linalg.solve(covariance, innovation)
        left = variance - variance**2 * decay @ np.linalg.solve(covariance, decay)
        mean = a**SAMPLES * filtered + forced(own, gain)
        variance = a ** (2 * SAMPLES) * left + (GATHERED * scale) ** 2
    return cost


def test_the_cost_is_that_of_the_innovations_of_a_kalman_filter() -> None:
    segments, u, y, scale = first_order_log(PREDICTED)
    errors, gains = errors_of(segments), (0.5, 0.95, 1.0)
    found = errors.evaluate(searched(errors, *gains), GATHERED).costs
    expected = [by_hand(u, y, gain, scale) for gain in gains]
    assert_allclose(found, expected, rtol=3e-4)  # the integration of a sample leaves 3e-6 of a state
    assert errors.count == PREDICTED


def test_gradient_and_curvature_are_those_of_half_the_cost() -> None:
    """The gain of this filter depends on no parameter, so that nothing is left out; the curvature is Gauss-Newton's."""
    segments = first_order_log(PREDICTED).segments
    errors, step = errors_of(segments), 1e-4
    for gain in (0.6, 1.05, 1.0):
        (z,) = searched(errors, gain)
        below, at, above = errors.evaluate(np.array([z - step, z, z + step]), GATHERED).costs
        found = errors.evaluate(np.array([z]), GATHERED)
        assert found.gradients[0, 0] == pytest.approx((above - below) / (4 * step), rel=1e-3)
    assert found.curvatures[0, 0, 0] == pytest.approx((below + above - 2 * at) / (2 * step**2), rel=0.3)


def test_a_descent_finds_the_gain_from_both_sides_at_once() -> None:
    segments = first_order_log(PREDICTED).segments
    errors = errors_of(segments)
    z, costs = errors.descend(searched(errors, 0.15, 4.0), GATHERED, 12)
    found = np.exp(z) if errors.scaling.log[0] else z
    assert_allclose(found, GAIN, rtol=0.02)
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)
    alone, _ = errors.descend(searched(errors, 4.0), GATHERED, 12)
    assert_allclose(alone[0], z[1], rtol=1e-9)


def test_the_stiffest_set_counts_for_the_integration_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the steps of a softer start, slips were lost at the right parameters, which cost more than wrong ones."""
    segments = first_order_log(PREDICTED).segments
    errors = errors_of(segments)
    z, stiff = searched(errors, 1.0, 3.0), segments.with_implicit_state(0)

    def choose(_: Segments, __: Array, q: Array) -> tuple[Segments, int]:
        return (stiff, 12) if q.max() > 2.0 else (segments, 4)

    monkeypatch.setattr(filters, "choose_integration", choose)
    errors.adapt_steps(z[:1])
    assert (errors.segments.implicit_state, errors.substeps) == (None, 4)
    errors.descend(z, GATHERED, 0)
    assert (errors.segments.implicit_state, errors.substeps) == (0, 12)


def test_a_part_that_is_interrupted_begins_anew() -> None:
    """The states behind a hole of the part are not those before it, though a filter could run on."""
    segments = first_order_log(PREDICTED).segments
    first, last = np.arange(8), np.arange(25, 40)
    z = searched(errors_of(segments), 1.0)
    parts = [errors_of(segments, part).evaluate(z, GATHERED) for part in (first, last, np.concatenate([first, last]))]
    for one, other, both in zip(*parts, strict=True):
        assert_allclose(one + other, both, rtol=1e-12)


@pytest.mark.filterwarnings("error")  # a user would read an overflow of numbers that are not kept
def test_a_set_that_is_lost_costs_infinity_and_nothing_to_its_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    segments = first_order_log(PREDICTED).segments
    errors = errors_of(segments)
    z = searched(errors, 1.0, 3.5)
    alone = errors.evaluate(z[:1], GATHERED)
    values = ParameterScaling.values

    def broken(scaling: ParameterScaling, each: Array) -> Array:
        return np.full_like(values(scaling, each), np.inf) if each >= z[1] else values(scaling, each)

    monkeypatch.setattr(ParameterScaling, "values", broken)
    found = errors.evaluate(z, GATHERED)
    assert found.costs[1] == np.inf
    assert found.costs[0] == pytest.approx(alone.costs[0])
    assert_allclose(found.gradients[0], alone.gradients[0])
    ended, costs = errors.descend(z, GATHERED, 2)
    assert costs[1] == np.inf
    assert ended[1] == z[1]
