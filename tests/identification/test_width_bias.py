"""Widths over which a smooth model turns friction round, and which the logs reject."""

from dataclasses import replace

import numpy as np
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification import width_bias
from pneuopt.identification.checks import check_logs
from pneuopt.identification.misfit import Misfit, diagnose_misfit
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.repairs import input_behaviour
from pneuopt.identification.width_bias import RejectedWidth, score_widths, suspect_widths
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, FrictionModel, Viscous
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares, solve_least_squares

WIDTH = "friction.smoothing"
FREE = ("friction.coulomb", "friction.viscous")
NOISE = 2e-6  # of the position [m]


def fitted(friction: FrictionModel, width: float = 1.0) -> tuple[EstimationProblem, Fit]:
    """Friction found in a pushed drive's log by a model whose width is so many times the drive's."""
    system, t = ForceDrive(friction).system(), np.arange(1000) * 1e-3
    truth = {n: v for n, v in {"friction.coulomb": 30.0, "friction.viscous": 60.0}.items() if n in system.parameters}
    own = system.parameters.with_values(truth)
    force = Trajectory(t, {"force": 60 * np.sin(2 * np.pi * 4 * t)})
    behaviour = input_behaviour(system, Experiment(force.with_columns({"position": t}), {}, name="run"))
    run = simulate(system, force, own, initial={"position": 0.0, "speed": 0.0}, intersample=behaviour)
    position = run["position"] + NOISE * np.random.default_rng(3).standard_normal(1000)
    log = Experiment(force.with_columns({"position": position}), {"position": NOISE}, name="run")
    given = own.freed(*truth)
    if WIDTH in given:
        given = given.with_values({WIDTH: width * own.value(WIDTH)})
    problem = EstimationProblem(system, tuple(check_logs(system, [log], given)), given, LeastSquares())
    return problem, solve_least_squares(problem.transcription(problem.candidates()[0]), problem.method)


def test_the_width_that_made_the_log_is_not_rejected() -> None:
    (found,) = score_widths(*fitted(Coulomb()))
    assert found.name == WIDTH
    assert found.fall < 10.8


def test_the_fall_and_the_shifts_are_those_of_a_fit_that_estimates_the_width() -> None:
    problem, fit = fitted(Coulomb(), 1.1)
    (found,) = score_widths(problem, fit)
    freed = replace(problem, parameters=problem.parameters.freed(WIDTH))
    refit = solve_least_squares(freed.transcription(freed.start_from(fit)), freed.method)
    assert refit.parameters.value(WIDTH) == pytest.approx(problem.system.parameters.value(WIDTH), rel=0.02)
    assert found.fall > 10.8
    assert found.fall == pytest.approx(2 * (fit.stats["cost"] - refit.stats["cost"]), rel=0.2)
    shifts = [refit.parameters.value(n) - fit.parameters.value(n) for n in FREE]
    assert dict(zip(FREE, found.shifts, strict=True)) == pytest.approx(dict(zip(FREE, shifts, strict=True)), rel=0.2)


def test_noise_of_the_states_has_other_weights_and_a_model_without_a_width_none_to_reject() -> None:
    problem, fit = fitted(Coulomb())
    assert not list(score_widths(problem, replace(fit, jumps=np.zeros((1, 2)))))
    assert not list(score_widths(*fitted(Viscous())))
    free = replace(problem, parameters=problem.parameters.freed(WIDTH))
    assert not list(score_widths(free, solve_least_squares(free.transcription(free.start_from(fit)), free.method)))


@pytest.mark.parametrize(
    ("fall", "shift", "inflation", "marked"),
    [
        (10.9, 0.6, 1.0, True),
        (10.7, 0.6, 1.0, False),  # chi-square with one degree of freedom exceeds 10.8 once in a thousand
        (10.9, 0.4, 1.0, False),  # no harm
        (10.9, 0.6, 1.1, False),  # what scatters more between parts of the logs is told apart with more
        (-1.0, 0.6, 1.0, False),
    ],
)
def test_a_rejected_width_marks_the_estimates_that_it_moves(
    fall: float, shift: float, inflation: float, marked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, fit = fitted(Coulomb())
    plain = diagnose_misfit(problem, fit, 1.0, 900.0)
    assert plain.covariance is not None
    spread = np.sqrt(np.diag(plain.covariance))
    suspect = replace(plain, widened=True, signals=(), inflation=inflation)
    moved = RejectedWidth(WIDTH, fall, np.array([shift, 0.1]) * spread)
    monkeypatch.setattr(width_bias, "score_widths", lambda *_: iter([moved]))
    found = suspect_widths(suspect, problem, fit, 1.0)
    assert (found.rejected_widths == (WIDTH,)) is marked
    assert (None if found.biased is None else found.biased.tolist()) == ([True, False] if marked else None)
    told = any(WIDTH in sentence for sentence in found.sentences)
    assert told is marked


def test_widths_are_asked_for_where_parts_of_the_logs_disagree_and_no_signal_is_behind_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, fit = fitted(Coulomb())
    agreeing: Misfit = replace(diagnose_misfit(problem, fit, 1.0, 900.0), widened=False, signals=())
    monkeypatch.setattr(width_bias, "score_widths", lambda *_: pytest.fail("asked"))
    assert suspect_widths(agreeing, problem, fit, 1.0) is agreeing
    signalled = replace(agreeing, widened=True, signals=("speed",))
    assert suspect_widths(signalled, problem, fit, 1.0) is signalled
