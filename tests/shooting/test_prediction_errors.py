"""Prediction errors of several parameter sets side by side, against a Kalman filter by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting import filters
from pneuopt.shooting.equations import ParameterScaling
from pneuopt.shooting.filters import PredictionErrors
from pneuopt.shooting.segments import Segments, start_nodes
from pneuopt.shooting.tolerances import ROBUST_SQUARES, START_DEVIATION
from tests.shooting.first_order import GAIN, NOISE, ROUGH, SAMPLE, SAMPLES, TIME_CONSTANT, first_order_log, forced

N = 120  # samples
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
    for begin in range(0, N, SAMPLES):
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
    segments, u, y, scale = first_order_log(N)
    errors, gains = errors_of(segments), (0.5, 0.95, 1.0)
    found = errors.evaluate(searched(errors, *gains), GATHERED).costs
    expected = [by_hand(u, y, gain, scale) for gain in gains]
    assert_allclose(found, expected, rtol=3e-4)  # the integration of a sample leaves 3e-6 of a state
    assert errors.count == N


def test_gradient_and_curvature_are_those_of_half_the_cost() -> None:
    """The gain of this filter depends on no parameter, so that nothing is left out; the curvature is Gauss-Newton's."""
    segments = first_order_log(N).segments
    errors, step = errors_of(segments), 1e-4
    for gain in (0.6, 1.05, 1.0):
        (z,) = searched(errors, gain)
        below, at, above = errors.evaluate(np.array([z - step, z, z + step]), GATHERED).costs
        found = errors.evaluate(np.array([z]), GATHERED)
        assert found.gradients[0, 0] == pytest.approx((above - below) / (4 * step), rel=1e-3)
    assert found.curvatures[0, 0, 0] == pytest.approx((below + above - 2 * at) / (2 * step**2), rel=0.3)


def test_a_descent_finds_the_gain_from_both_sides_at_once() -> None:
    segments = first_order_log(N).segments
    errors = errors_of(segments)
    z, costs = errors.descend(searched(errors, 0.15, 4.0), GATHERED, 12)
    found = np.exp(z) if errors.scaling.log[0] else z
    assert_allclose(found, GAIN, rtol=0.02)
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)
    alone, _ = errors.descend(searched(errors, 4.0), GATHERED, 12)
    assert_allclose(alone[0], z[1], rtol=1e-9)


def test_the_stiffest_set_counts_for_the_integration_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the steps of a softer start, slips were lost at the right parameters, which cost more than wrong ones."""
    segments = first_order_log(N).segments
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
    segments = first_order_log(N).segments
    first, last = np.arange(8), np.arange(25, 40)
    z = searched(errors_of(segments), 1.0)
    parts = [errors_of(segments, part).evaluate(z, GATHERED) for part in (first, last, np.concatenate([first, last]))]
    for one, other, both in zip(*parts, strict=True):
        assert_allclose(one + other, both, rtol=1e-12)


@pytest.mark.filterwarnings("error")  # a user would read an overflow of numbers that are not kept
def test_a_set_that_is_lost_costs_infinity_and_nothing_to_its_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    segments = first_order_log(N).segments
    errors = errors_of(segments)
    z = searched(errors, 1.0, 3.5)
    alone = errors.evaluate(z[:1], GATHERED)
    values = ParameterScaling.values

    def broken(scaling: ParameterScaling, each: Array) -> Array:
        return values(scaling, each) * (np.inf if each >= z[1] else 1.0)

    monkeypatch.setattr(ParameterScaling, "values", broken)
    found = errors.evaluate(z, GATHERED)
    assert found.costs[1] == np.inf
    assert found.costs[0] == pytest.approx(alone.costs[0])
    assert_allclose(found.gradients[0], alone.gradients[0])
    ended, costs = errors.descend(z, GATHERED, 2)
    assert costs[1] == np.inf
    assert ended[1] == z[1]
