"""What users read of a fit, an optimal control problem or a bad problem; other tests assert codes, places and types."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.system import discretise
from pneuopt.quantities.status import Status
from pneuopt.shooting.full_space import solve_full_space
from pneuopt.shooting.least_squares import LeastSquares, Stage, solve_least_squares
from pneuopt.shooting.transcription import Residuals, Transcription
from tests.shooting.test_full_space import settling
from tests.shooting.test_least_squares import shaken, two_logs
from tests.shooting.test_transcription import DRIVE, phase, problem


def fit(posed: Transcription, *stages: Stage) -> Status:
    return solve_least_squares(posed, LeastSquares(stages=stages) if stages else None).status


def with_stiffness(value: float) -> Transcription:
    posed = two_logs(nodes=2)
    return replace(posed, parameters=posed.parameters.fixed("stiffness").with_values({"stiffness": value}))


def with_damping(value: float) -> Transcription:
    posed = two_logs()
    wide = posed.parameters.with_bounds({"damping": (0.0, 1e6)})
    return replace(posed, parameters=wide.with_values({"damping": value}))


def without_effect() -> Transcription:
    posed = two_logs(extra=True)
    return replace(posed, parameters=posed.parameters.fixed("factor").freed("idle"))


def with_noise_over(factor: float) -> Transcription:
    posed = two_logs()
    return replace(posed, residuals=tuple(replace(r, noise=r.noise / factor) for r in posed.residuals))


def far_off() -> Transcription:
    posed = two_logs()
    guess = np.full((posed.phases[0].n, 2), 1e300)
    return replace(posed, phases=(replace(posed.phases[0], guess=guess), posed.phases[1]))


@pytest.mark.parametrize(
    ("ended", "words"),
    [
        (lambda: fit(two_logs(extra=True)), ("do not determine damping and factor",)),
        (lambda: fit(without_effect()), ("do not depend on idle",)),
        (lambda: fit(with_stiffness(150.0), Stage(1e-2, 60)), ("gaps between segments carry",)),
        (lambda: fit(shaken(2e-3)), ("does not explain the log to its noise", "speed jumps by")),
        (lambda: fit(with_noise_over(3.0)), ("residuals are 2.9 times the noise of position",)),
        (lambda: fit(two_logs(), Stage(1e-5, 1)), ("would still move by",)),
        (lambda: fit(with_damping(3e4)), ("takes 300 integration steps",)),
        (lambda: fit(far_off()), ("not finite at the start",)),
        (lambda: solve_full_space(settling(0.02, least=1.5)).status, ("NOT converged", "limit 'speed at the end' in")),
    ],
)
def test_a_status_says_what_has_ended_the_search(ended: Callable[[], Status], words: tuple[str, ...]) -> None:
    said = str(ended())
    assert all(part in said for part in words), said


def test_a_good_fit_has_nothing_to_explain() -> None:
    assert "explain" not in str(fit(two_logs()))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: replace(phase(), h=np.ones(9)), "run: t, h and inputs differ in length"),
        (lambda: replace(phase(), nodes=np.array([1, 4])), "run: nodes must begin at 0 and increase below 10"),
        (lambda: replace(phase(), follows=True, start=np.zeros(2)), "run: it follows a phase, so no start"),
        (lambda: Transcription(discretise(DRIVE), DRIVE.parameters, ()), "at least one phase"),
        (lambda: problem(replace(phase(), follows=True)), "first phase cannot follow"),
        (lambda: problem(replace(phase(), duration="Ts")), "run: unknown parameter 'Ts'"),
        (
            lambda: problem(residuals=(Residuals(0, ("positon",), np.zeros((10, 1)), np.ones(1)),)),
            "run: unknown output 'positon'; did you mean 'position'",
        ),
        (lambda: LeastSquares(stages=()), "LeastSquares(stages=()): give one Stage or more"),
        (lambda: LeastSquares(segment_time=-1.0), "segment_time=-1.0): give seconds above 0"),
        (lambda: LeastSquares(substeps=0), "substeps=0): give a whole number from 1"),
        (lambda: LeastSquares(tolerance=0.0), "tolerance=0.0): give a positive number"),
        (lambda: Stage(-1e-3, 8), "Stage(gap=-0.001): give a positive fraction"),
        (lambda: Stage(1e-3, -1), "Stage(iterations=-1): give 0 or more"),
        (lambda: Stage(1e-3, 8, refine=0), "Stage(refine=0): give 1 (no finer steps) or more"),
    ],
)
def test_what_is_refused_is_said_with_its_remedy(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=r".") as refused:
        make()
    assert words in str(refused.value)
