"""A start state that is known costs the parameters no information: nothing is eliminated for it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.system import Symbols, define, discretise
from pneuopt.identification.identifiability import _log_root_information
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.shooting.segments import segment, start_nodes
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

N, H, NOISE, RATE = 40, 0.1, 0.05, 0.3


@pytest.mark.parametrize("known", [True, False])
def test_the_information_about_a_rate_counts_whether_the_start_is_known(known: bool) -> None:
    """Of y = x0 + rate t the sum of t^2 with x0 known, and of (t - mean t)^2 without."""

    def rhs(t: object, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        return {"x": p["rate"] + u["push"]}, {"x": x["x"]}

    x, free = [Quantity("x", "m")], ParameterSet({"rate": Parameter(RATE, "m/s", -5.0, 5.0, free=True)})
    system, t = discretise(define(x, [Quantity("push", "m/s")], x, free, rhs), 1), H * np.arange(N, dtype=float)
    start, guess = np.array([0.0]) if known else None, RATE * t[:, None]
    phase = Phase("log", t, np.full(N, H), np.zeros((N, 1)), regular_nodes(N, 8), start, guess=guess)
    residuals = Residuals(0, ("x",), guess, np.array([NOISE]))
    segments = segment(Transcription(system, system.parameters, (phase,), (residuals,)))
    run = segments.run(start_nodes(segments), np.array([RATE]), 1, sensitivities=True)
    assert run.dy is not None
    assert run.dx_end is not None
    root = _log_root_information(segments, run.dy / NOISE, run.dx_end, 0, np.ones(1))
    expected = np.sum(t**2) if known else np.sum((t - t.mean()) ** 2)
    assert_allclose(root.T @ root, [[expected / NOISE**2]], rtol=1e-9)
