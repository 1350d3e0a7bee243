"""A CPU budget ends a search with the best values so far, and the status says so first."""

import math
from typing import Any

import numpy as np
import pytest

from pneuopt.dynamics.compiled.rollout import Gram, Rollout
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import ConvergenceError, InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from tests.identification.test_identify import FREE, pushed

DRIVE = ForceDrive(Coulomb())
PARAMETERS = DRIVE.parameters.freed(*FREE)


def fit(budget: float, parameters: ParameterSet = PARAMETERS) -> IdentificationResult:
    return identify(DRIVE, [pushed(Coulomb())], parameters, cpu_seconds=budget, throw=False)


def test_a_spent_budget_leaves_the_best_values_and_says_so_first() -> None:
    result = fit(1e-9)
    assert result.status.code is Code.BUDGET
    assert not result.status.converged
    assert result.status.verdict.startswith("the CPU budget of 1e-09 s is spent")
    assert str(result.status).startswith("NOT converged (the CPU budget is spent)")
    assert np.isfinite(result.estimates["value"]).all()
    assert result.estimates["ci_low"].isna().all()
    assert result.widths == ()


def test_a_search_begins_again_where_a_budget_has_ended_it(monkeypatch: pytest.MonkeyPatch) -> None:
    gram, evaluations = Rollout.gram, list[Gram]()

    def evaluate(*given: Any, **options: Any) -> Gram:
        evaluations.append(gram(*given, **options))  # each takes a second
        return evaluations[-1]

    monkeypatch.setattr(Rollout, "gram", evaluate)
    monkeypatch.setattr("pneuopt.shooting.least_squares.time.process_time", lambda: float(len(evaluations)))
    stated = PARAMETERS.with_values({"friction.smoothing": 1.1e-3})  # no width is left to choose before the search
    ended = fit(4.0, stated)
    monkeypatch.undo()
    assert ended.status.code is Code.BUDGET
    assert ended.stats["iterations"] == 2
    again = identify(DRIVE, [pushed(Coulomb())], stated, start=ended, throw=False)
    assert again.status.converged
    assert again.estimates["value"]["friction.coulomb"] == pytest.approx(30, rel=0.05)


def test_a_budget_that_suffices_changes_nothing() -> None:
    with_budget, without = fit(1e3), fit(math.inf)
    assert with_budget.status == without.status
    assert (with_budget.estimates["value"] == without.estimates["value"]).all()


def test_a_spent_budget_is_no_convergence() -> None:
    with pytest.raises(ConvergenceError, match="CPU budget of 1e-09 s") as caught:
        identify(DRIVE, [pushed(Coulomb())], PARAMETERS, cpu_seconds=1e-9)
    assert isinstance(caught.value.solution, IdentificationResult)


def test_a_budget_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="cpu_seconds must be positive, got 0"):
        fit(0.0)
