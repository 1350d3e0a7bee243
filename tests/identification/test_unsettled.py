"""`fit_without_unsettled`: what did not settle is held, and the others are fitted, if that tells anything of them."""

from dataclasses import replace

import pytest

from pneuopt.dynamics.hooks import Start
from pneuopt.identification import search as multistart
from pneuopt.identification.problem import EstimationProblem
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import Fit, solve_least_squares
from tests.identification.test_search import VELOCITY, posed


def optimum() -> tuple[EstimationProblem, Fit]:
    problem = posed(Stribeck())
    return problem, solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)


def unsettled(done: Fit, name: str, off: float) -> Fit:
    """A fit that ended with one parameter off and unsettled."""
    status = Status(Code.NOT_CONVERGED, (f"{name} would still move", "try more iterations"))
    return replace(done, status=status, unsettled=(name,), parameters=done.parameters.with_values({name: off}))


def test_a_parameter_that_did_not_settle_is_held_and_the_others_are_fitted() -> None:
    problem, done = optimum()
    assert done.status.converged
    assert multistart.fit_without_unsettled(problem, done, "start") == (problem, done)
    off = 1.05 * done.parameters.value(VELOCITY)
    held, part = multistart.fit_without_unsettled(problem, unsettled(done, VELOCITY, off), "start")
    assert part.status.converged
    assert held.fixed == {VELOCITY: off}
    assert part.parameters.value(VELOCITY) == off
    assert part.parameters.value("friction.coulomb") == pytest.approx(30, rel=0.1)


def test_a_part_that_is_known_by_what_is_held_alone_is_none() -> None:
    """Of a loop that saturates the leak ended on a kink; held within a decade, it made all other estimates vague."""
    problem, done = optimum()
    given = unsettled(done, "friction.static", 1.05 * done.parameters.value("friction.static"))
    held, part = multistart.fit_without_unsettled(problem, given, "start")
    assert part is given
    assert held is problem


def test_ctrl_c_in_the_fit_of_a_part_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was taken for a part that does not settle, and the search went on with the next start."""
    problem, done = optimum()
    given = unsettled(done, VELOCITY, 1.05 * done.parameters.value(VELOCITY))
    monkeypatch.setattr(
        multistart, "solve_least_squares", lambda *_: replace(done, status=Status(Code.INTERRUPTED, ("cut",)))
    )
    held, part = multistart.fit_without_unsettled(problem, given, "start")
    assert held is problem
    assert part.status.code is Code.INTERRUPTED
    assert part.parameters == given.parameters
    starts = list[str]()

    def search(problem: EstimationProblem, start: Start, *_: object) -> tuple[EstimationProblem, Fit]:
        starts.append(start.label)
        return problem, given

    monkeypatch.setattr(multistart, "fit_fixing_unidentifiable", search)
    monkeypatch.setattr(multistart, "is_at_noise", lambda *_: True)
    assert multistart.fit_from_starts(problem)[1].status.code is Code.INTERRUPTED
    assert len(starts) == 1
