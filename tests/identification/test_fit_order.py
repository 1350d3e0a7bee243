"""Which fits are answers: one that has lost what another parameter bounds is searched again."""

from dataclasses import replace

import pytest

from pneuopt.dynamics.hooks import Start
from pneuopt.identification import multistart
from pneuopt.identification.problem import EstimationProblem
from pneuopt.models.friction import Stribeck
from pneuopt.shooting.least_squares import Fit, solve_least_squares
from tests.identification.test_multistart import posed


@pytest.mark.parametrize(("excess", "starts"), [(0.4, 1), (0.001, 2), (-0.2, 2)])
def test_a_fit_that_has_lost_static_friction_takes_one_more_start(
    excess: float, starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, labels = posed(Stribeck()), list[str]()

    def found(problem: EstimationProblem, start: Start, *_: object) -> tuple[EstimationProblem, Fit]:
        labels.append(start.label)
        fit = solve_least_squares(problem.transcription(start), problem.method)
        values = {"friction.coulomb": 30.0, "friction.static": 30.0 * (1 + excess)}
        return problem, replace(fit, parameters=fit.parameters.with_values(values))

    monkeypatch.setattr(multistart, "fit_holding_unidentifiable", found)
    monkeypatch.setattr(multistart, "ACCEPTED_CHI_SQUARE_RATIO", 2.0)  # this log has 1.6
    assert multistart.fit_from_starts(problem)[1].status.converged
    assert labels == [c.label for c in problem.candidates()[:starts]]
