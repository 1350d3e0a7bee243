import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.shooting.least_squares import LeastSquares, Optimum, Stage, close_gaps, solve_least_squares
from tests.shooting.test_least_squares import propagate, two_logs


def jumping_fit() -> Optimum:
    """The end of a search whose gaps are still wide."""
    optimum = solve_least_squares(two_logs(), LeastSquares(stages=(Stage(1e-1, 4),), substeps=2)).optimum
    assert optimum is not None
    assert optimum.equations.largest_gap > 1e-2
    return optimum


def test_closed_gaps_leave_the_run_from_end_to_end() -> None:
    optimum = jumping_fit()
    y = close_gaps(optimum)
    assert y is not None
    segments = optimum.equations.segments
    values = dict(zip(segments.transcription.parameters, optimum.values, strict=True))
    for i, run in enumerate(segments.output_trajectories(y)):
        start = optimum.nodes[np.flatnonzero(segments.phase == i)[0]]
        force = segments.transcription.phases[i].inputs[:, 0] + values[f"bias[{'ab'[i]}]"]
        by_hand = propagate(values["stiffness"], values["damping"], start, force)
        assert_allclose(run["position"], by_hand, atol=1e-7)


def test_gaps_that_stay_open_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneuopt.shooting.least_squares.MAX_NODE_STEPS", 1)
    assert close_gaps(jumping_fit()) is None
