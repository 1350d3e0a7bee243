"""An estimate outside of its own interval is no optimum: the search begins again where the profile is."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd
import pytest

from pneuopt.identification import identify as identification
from pneuopt.identification import profiled_optimum
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.profiled_optimum import fit_from_profiles
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.review import review_fit
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import Fit, solve_least_squares
from tests.identification.test_multistart import TRUTH, VELOCITY, posed


def optimum() -> tuple[EstimationProblem, Fit]:
    problem = posed(Stribeck())
    return problem, solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)


def profile(estimate: float, best: Mapping[str, float]) -> Profile:
    """A profile of the Stribeck velocity, whose interval is 20 % about the best value."""
    others = {n: v for n, v in best.items() if n != VELOCITY}
    rows = [
        {"value": scale * best[VELOCITY], "deviance": d, **others} for scale, d in ((0.8, 4.0), (1.0, 0.0), (1.2, 4.0))
    ]
    curve = pd.DataFrame([{"value": estimate, "deviance": 30.0, **others}, *rows])
    return Profile(VELOCITY, "m/s", estimate, 0.8 * best[VELOCITY], 1.2 * best[VELOCITY], 0.95, curve)


def test_the_search_begins_again_at_the_best_values_of_the_profile() -> None:
    problem, done = optimum()
    off = done.parameters.with_values({VELOCITY: 0.05, "friction.static": 33.0})
    beside = replace(done, parameters=off, stats={**done.stats, "cost": done.stats["cost"] + 10.0})
    better = fit_from_profiles(problem, beside, [profile(0.012, TRUTH), profile(0.05, TRUTH)])
    assert better is not None
    assert better.status.converged
    for name in TRUTH:
        assert better.parameters.value(name) == pytest.approx(done.parameters.value(name), rel=0.01)
    assert better.stats["iterations"] > done.stats["iterations"]


def test_an_estimate_within_its_interval_stays() -> None:
    problem, done = optimum()
    assert fit_from_profiles(problem, done, []) is None
    assert fit_from_profiles(problem, done, [profile(0.0121, TRUTH)]) is None


def test_a_fit_that_is_bettered_by_its_profile_alone_has_not_converged() -> None:
    problem, done = optimum()
    lucky = replace(done, stats={**done.stats, "cost": done.stats["cost"] - 10.0})
    found = fit_from_profiles(problem, lucky, [profile(0.05, TRUTH)])
    assert found is not None
    assert found.status.code is Code.NOT_CONVERGED
    assert (
        found.status.verdict
        == "friction.stribeck_velocity fits better at 0.012 m/s, from where the search finds no better optimum"
    )
    assert found.parameters == lucky.parameters


@pytest.mark.parametrize("excess", [-10.0, 1e6])
def test_an_interrupted_search_leaves_the_better_of_both(excess: float, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, done = optimum()
    beside = replace(done, stats={**done.stats, "cost": done.stats["cost"] + excess})
    stopped = replace(done, status=Status(Code.INTERRUPTED, ("the best iterate so far",)))
    monkeypatch.setattr(profiled_optimum, "solve_least_squares", lambda *_: stopped)
    found = fit_from_profiles(problem, beside, [profile(0.05, TRUTH)])
    assert found is not None
    assert found.status == stopped.status
    assert found.stats["cost"] == min(beside.stats["cost"], done.stats["cost"])


def test_identify_reviews_the_better_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first review is told of a profile that lies elsewhere; the second one is of the fit from there."""
    problem, reviewed = posed(Stribeck()), list[Code]()

    def told(
        problem: EstimationProblem, result: IdentificationResult, unidentifiable: Sequence[str]
    ) -> tuple[IdentificationResult, tuple[Profile, ...]]:
        result, profiles = review_fit(problem, result, unidentifiable)
        reviewed.append(result.status.code)
        return result, profiles if len(reviewed) > 1 else (profile(0.05, TRUTH),)

    def dearer(problem: EstimationProblem, fit: Fit, profiles: tuple[Profile, ...]) -> Fit | None:
        beside = replace(fit, stats={**fit.stats, "cost": fit.stats["cost"] + 10.0})
        return fit_from_profiles(problem, beside, profiles)

    monkeypatch.setattr(identification, "review_fit", told)
    monkeypatch.setattr(identification, "fit_from_profiles", dearer)
    result = identification.identify(
        ForceDrive(Stribeck()).system(), problem.experiments, problem.parameters, method=problem.method
    )
    assert reviewed == [Code.CONVERGED] * 2
    _, done = optimum()
    assert result.estimates["value"][VELOCITY] == pytest.approx(done.parameters.value(VELOCITY), rel=0.01)
    assert result.stats["iterations"] > done.stats["iterations"]
