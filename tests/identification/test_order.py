"""Static friction that a log does not show is Coulomb friction, not zero; where a log shows less, its answer stays."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import pneuopt as po
from pneuopt.identification.checks import check_logs
from pneuopt.identification.order import hold_order, mark_order
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.result import IdentificationResult
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.least_squares import Fit, solve_least_squares

SYSTEM = po.ForceDrive(po.Stribeck()).system()
COULOMB, STATIC, VELOCITY = (f"friction.{n}" for n in ("coulomb", "static", "stribeck_velocity"))
TRUTH = {"load.mass": 3.0, COULOMB: 30.0, "friction.viscous": 60.0}
T = np.arange(300) * 0.01


def problem_and_fit(
    static: float, velocity: float, given: po.ParameterSet, begin: dict[str, float], held: dict[str, float]
) -> tuple[EstimationProblem, Fit]:
    """A mass that is pushed to and fro, which has this static friction, fitted from a start with these values."""
    truth = SYSTEM.parameters.with_values({**TRUTH, STATIC: static, VELOCITY: velocity})
    push = 60 * np.sin(2 * np.pi * T) + 40 * np.sin(2 * np.pi * 2.3 * T)
    linear = {"force": po.Intersample.LINEAR}
    run = po.simulate(SYSTEM, po.Trajectory(T, {"force": push}), truth, intersample=linear)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(T.size)
    log = po.Experiment(po.Trajectory(T, {"force": push, "position": run["position"] + noise}), {"position": 1e-5})
    problem = EstimationProblem(SYSTEM, tuple(check_logs(SYSTEM, [log], given)), given, po.LeastSquares(), held=held)
    first = problem.candidates()[0]
    start = replace(first, parameters={**first.parameters, **TRUTH, **begin, **held})
    return problem, solve_least_squares(problem.transcription(start), problem.method)


def test_what_was_held_below_coulomb_friction_is_held_at_it() -> None:
    given = SYSTEM.parameters.freed(*TRUTH, STATIC, VELOCITY)
    problem, fit = problem_and_fit(30.0, 0.02, given, {}, {STATIC: 0.01, VELOCITY: 2e-4})
    assert fit.status.converged
    held, found = hold_order(problem, fit, "again")
    assert held.held == {STATIC: fit.parameters.value(COULOMB), VELOCITY: 2e-4}
    assert found.parameters.value(STATIC) == pytest.approx(found.parameters.value(COULOMB), rel=1e-3)
    for name, true in TRUTH.items():
        assert found.parameters.value(name) == pytest.approx(true, rel=1e-3)
    assert found.stats["iterations"] > fit.stats["iterations"]  # the effort of both


def test_what_ended_at_a_bound_below_coulomb_friction_is_held_at_it() -> None:
    """Below 0.3 mm/s the mass is for too short a time to tell 29 N from 30 N."""
    given = SYSTEM.parameters.with_values({VELOCITY: 3e-4, STATIC: 29.0}).with_bounds({STATIC: (29.0, 50.0)})
    problem, fit = problem_and_fit(20.0, 3e-4, given.freed(*TRUTH, STATIC), {STATIC: 29.0}, {})
    at_bound = dict(zip(fit.parameters.free_names, fit.at_bound, strict=True))
    assert at_bound[STATIC]
    held, found = hold_order(problem, fit, "again")
    assert held.held == {STATIC: fit.parameters.value(COULOMB)}
    assert found.parameters.value(COULOMB) == pytest.approx(30.0, rel=1e-3)


def test_a_log_that_shows_less_static_friction_keeps_its_answer() -> None:
    given = SYSTEM.parameters.with_values({VELOCITY: 0.05, STATIC: 15.0}).with_bounds({STATIC: (15.0, 50.0)})
    problem, fit = problem_and_fit(10.0, 0.05, given.freed(*TRUTH, STATIC), {STATIC: 15.0}, {})
    assert fit.parameters.value(STATIC) == pytest.approx(15.0, rel=1e-6)
    assert hold_order(problem, fit, "again") == (problem, fit)


def test_a_fit_in_order_is_not_fitted_again() -> None:
    given = SYSTEM.parameters.freed(*TRUTH, STATIC, VELOCITY)
    problem, fit = problem_and_fit(45.0, 0.02, given, {STATIC: 40.0, VELOCITY: 0.02}, {})
    assert fit.parameters.value(STATIC) == pytest.approx(45.0, abs=1.0)
    assert hold_order(problem, fit, "again") == (problem, fit)


def test_friction_that_no_drive_has_is_named_and_marked() -> None:
    """An answer of 10 +- 1 N beside 30 +- 1 N was "exact" without a word; 27 N is within chance."""
    given = SYSTEM.parameters.freed(COULOMB, STATIC)
    log = po.Experiment(po.Trajectory(T, {"force": 60 * np.sin(T), "position": 0.1 * np.cos(T)}), {"position": 1e-5})
    problem = EstimationProblem(SYSTEM, tuple(check_logs(SYSTEM, [log], given)), given, po.LeastSquares())
    marks = {}
    for static in (10.0, 27.0, 40.0):
        estimates = pd.DataFrame({"value": {COULOMB: 30.0, STATIC: static}, "mark": po.Mark.EXACT})
        covariance = pd.DataFrame(np.eye(2), estimates.index, estimates.index)
        values, status = given.with_values({COULOMB: 30.0, STATIC: static}), Status(Code.CONVERGED, ("converged",))
        fit = IdentificationResult(values, estimates, covariance, pd.DataFrame(), {}, status, {}, {})
        found = mark_order(problem, fit)
        marks[static] = set(found.estimates["mark"])
        assert ("which no drive has" in str(found.status)) == (static == 10.0)
    assert marks == {10.0: {po.Mark.BIAS_POSSIBLE}, 27.0: {po.Mark.EXACT}, 40.0: {po.Mark.EXACT}}
