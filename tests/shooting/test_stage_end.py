"""A search of a model that misses its log ends where nothing moves by the deviations of the residuals."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pneuopt.shooting import least_squares as lifted
from pneuopt.shooting.least_squares import LeastSquares, is_negligible_step
from pneuopt.shooting.tolerances import PATIENT_ITERATIONS


def negligible(
    monkeypatch: pytest.MonkeyPatch,
    *,
    misfit: float,
    step: float,
    promised: float,
    iterations: int = PATIENT_ITERATIONS,
) -> bool:
    """Whether a step of a parameter [deviations by the noise] ends the last stage of a search with 1000 residuals."""
    monkeypatch.setattr(lifted, "largest_parameter_step", lambda *_: step)
    arrow = SimpleNamespace(descent_rate=lambda _: 2 * promised)
    equations = SimpleNamespace(arrow=arrow, count=1000, chi_square=1000 * misfit)
    method = LeastSquares()
    transcription = SimpleNamespace(parameters=SimpleNamespace(free_names=("a",)))
    state: Any = SimpleNamespace(
        stage=method.stages[-1],
        method=method,
        noisy_gaps=False,
        is_coarse=False,
        iterations=5 + iterations,
        stage_began=5,
        setup=SimpleNamespace(scaling=SimpleNamespace(movable=lambda *_: None)),
        segments=SimpleNamespace(transcription=transcription),
    )
    current: Any = SimpleNamespace(equations=equations, cost=500 * misfit, z=np.zeros(1))
    nothing: Any = SimpleNamespace(parameters=None)
    return is_negligible_step(state, current, nothing, nothing)


@pytest.mark.parametrize(
    ("misfit", "step", "promised", "ends"),
    [
        (1.0, 0.015, 1e-3, False),  # a model that explains its log is searched to a thousandth of a deviation
        (1.0, 0.0005, 1e-3, True),
        (49.0, 0.015 * 7, 1.0, True),  # 7 times the noise: Gauss-Newton steps that go to and fro
        (49.0, 0.025 * 7, 1.0, False),
        (49.0, 0.015 * 7, 50.0, False),  # the cost would still fall by .2 %
    ],
)
def test_deviations_are_those_of_the_residuals(
    misfit: float, step: float, promised: float, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert negligible(monkeypatch, misfit=misfit, step=step, promised=promised) == ends


def test_a_quick_search_goes_to_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    few = PATIENT_ITERATIONS - 1
    assert not negligible(monkeypatch, misfit=49.0, step=0.015 * 7, promised=0.3, iterations=few)
    assert negligible(monkeypatch, misfit=49.0, step=0.015 * 7, promised=0.3)
