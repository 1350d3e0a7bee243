"""A long step along a bent valley of tight gaps is kept, for the nodes settle after it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.system import DiscreteSystem, Symbols, define, discretise
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.shooting.least_squares import LeastSquares, SearchState, Stage, run_search, start_search
from pneuopt.shooting.segments import segment
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

N, H, NOISE = 2000, 0.01, 1e-3
TRUTH, START = {"gain": 3.0, "drag": 1.0}, {"gain": 2.0, "drag": 0.7}


def pushed(values: dict[str, float]) -> Transcription:
    """A body on a hardening spring, whose position is logged; the search begins at a run with wrong values."""

    def rhs(t: object, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {
            "position": x["speed"],
            "speed": p["gain"] * u["push"] - 9 * (x["position"] + x["position"] ** 3) - p["drag"] * x["speed"],
        }, {"y": x["position"]}

    free = ParameterSet({n: Parameter(v, "1", 0.01, 100.0, free=True) for n, v in values.items()})
    states = [Quantity("position", "m"), Quantity("speed", "m/s")]
    system = discretise(define(states, [Quantity("push", "1")], [Quantity("y", "m")], free, rhs), 1)
    t: Array = H * np.arange(N, dtype=float)
    rng = np.random.default_rng(0)
    push: Array = np.sin(2 * t) + np.sin(5.3 * t)
    logged, guess = (run(system, push, each) for each in (TRUTH, values))
    measured = logged[:, :1] + NOISE * rng.standard_normal((N, 1))
    phase = Phase("log", t, np.full(N, H), push[:, None], regular_nodes(N, 10), guess=guess)
    return Transcription(system, system.parameters, (phase,), (Residuals(0, ("y",), measured, np.array([NOISE])),))


def run(system: DiscreteSystem, push: Array, values: dict[str, float]) -> Array:
    """States at all samples from rest, shape (N, 2)."""
    x, out = np.zeros(2), np.zeros((N, 2))
    for i in range(N):
        out[i] = x
        x = np.array(system.step(H * i, H, x, push[i], list(values.values()))[0]).ravel()
    return out


def searched(method: LeastSquares) -> SearchState:
    return run_search(start_search(segment(pushed(START)), method))


def test_nodes_settle_after_a_step_that_opens_the_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    method = LeastSquares(stages=(Stage(1e-5, 60),))
    settling = searched(method)
    monkeypatch.setattr("pneuopt.shooting.least_squares.MAX_NODE_STEPS", 0)
    creeping = searched(method)
    for state in (settling, creeping):
        found = state.setup.scaling.values(state.iterate.z)
        assert dict(zip(TRUTH, found.tolist(), strict=True)) == pytest.approx(TRUTH, rel=1e-3)
        assert state.iterate.cost == pytest.approx(N / 2, rel=0.05)
    assert settling.iterations <= 0.4 * creeping.iterations


def test_a_node_step_is_the_step_with_no_parameter_free() -> None:
    begun = start_search(segment(pushed(START)), LeastSquares(stages=(Stage(1e-2, 1),)))
    arrow = begun.iterate.equations.arrow
    reduced = arrow.eliminate(1e-3)
    step = arrow.node_step(np.full(len(arrow.node_gradient), 1e-3))
    assert reduced is not None
    assert step is not None
    assert_allclose(step, reduced.nodes, rtol=1e-9, atol=1e-12)
