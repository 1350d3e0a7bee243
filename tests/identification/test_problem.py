"""The estimation problem: a fit, or a result, becomes the start of the next one."""

from dataclasses import replace

import numpy as np
import pandas as pd

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares, solve_least_squares

TIME = np.arange(200) * 1e-3
DRIVE = ForceDrive(Viscous())


def problem() -> EstimationProblem:
    force = 50 * np.sin(20 * TIME)
    run = simulate(
        DRIVE.system(), Trajectory(TIME, {"force": force}), DRIVE.parameters, intersample={"force": Intersample.LINEAR}
    )
    log = Experiment(Trajectory(TIME, {"force": force, "position": run["position"]}), {"position": 1e-5}, name="run")
    free = DRIVE.parameters.freed("load.mass", "friction.viscous")
    return EstimationProblem(DRIVE.system(), (log,), free, LeastSquares())


def test_a_fit_becomes_the_start_of_the_next_one() -> None:
    posed = problem()
    fit = solve_least_squares(posed.transcription(posed.candidates()[0]))
    start = posed.start_from(fit, "again")
    assert start.label == "again"
    assert start.parameters == {n: fit.parameters.value(n) for n in fit.parameters.free_names}
    assert start.states["run"] is fit.trajectories[0]
    again = solve_least_squares(posed.transcription(start))
    assert again.with_effort_of(fit).stats["iterations"] == fit.stats["iterations"] + again.stats["iterations"]
    assert again.stats["cost"] <= 1.001 * fit.stats["cost"] + 1e-9


def test_a_result_without_a_value_starts_at_the_given_one() -> None:
    posed = problem()
    fit = solve_least_squares(posed.transcription(posed.candidates()[0]))
    estimates = pd.DataFrame({"value": {"load.mass": 4.5, "friction.viscous": np.nan}})
    table, runs = pd.DataFrame(), {"run": fit.trajectories[0]}
    result = IdentificationResult(fit.parameters, estimates, table, table, runs, fit.status, fit.stats, {})
    given = posed.parameters.value("friction.viscous")
    assert posed.start_from(result).parameters == {"load.mass": 4.5, "friction.viscous": given}
    held = replace(posed, held={"friction.viscous": 7.0})
    assert held.transcription(held.start_from(result)).parameters.value("friction.viscous") == 7.0
