"""`fit_table`, `agreement_rows`, `residual_diagnosis`: how well runs agree with logs, and what is left of these."""

from typing import TYPE_CHECKING

from pneuopt.dynamics.runnable import Fittable
from pneuopt.dynamics.system import names
from pneuopt.identification.checks import outputs_in_log
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.statistics import agreement, cross_correlation, ljung_box
from pneuopt.identification.windows import run_freely
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit

if TYPE_CHECKING:
    import pandas as pd


def fit_table(problem: EstimationProblem, fit: Fit) -> "pd.DataFrame":
    """A row a log and channel of a fit (`IdentificationResult.fit`)."""
    from pneuopt.quantities.frames import WideFrame

    runs = zip(problem.experiments, fit.trajectories, run_freely(problem, fit), strict=True)
    rows = [row for e, run, free in runs for row in agreement_rows(problem.system, e, run, free)]
    return WideFrame(rows).set_index(["log", "channel"])


def agreement_rows(
    system: Fittable, experiment: Experiment, run: Trajectory, free_run: Trajectory
) -> list[dict[str, object]]:
    """A row a channel of a log: how well a run agrees with it, and a simulation from end to end."""
    units = {q.name: q.unit for q in system.outputs}
    rows: list[dict[str, object]] = []
    for channel in outputs_in_log(system, experiment):
        figures, measured = agreement(experiment.trajectory[channel], run[channel]), experiment.trajectory[channel]
        free = agreement(measured, free_run[channel])
        free_figures = {f"free_run_{n}": free[n] for n in ("rmse", "nrmse")}
        known = {"noise": experiment.noise[channel], "unit": units[channel]}
        rows.append({"log": experiment.name, "channel": channel, **figures, **free_figures, **known})
    return rows


def residual_diagnosis(system: Fittable, experiment: Experiment, run: Trajectory, channel: str) -> dict[str, object]:
    """Whiteness of a channel's residuals, and their correlation with each input."""
    log = experiment.trajectory
    residuals = log[channel] - run[channel]
    found: dict[str, object] = {"whiteness_p": ljung_box(residuals)[1]}
    for name in (n for n in names(system.inputs) if n in log):
        size, lag = cross_correlation(residuals, log[name])
        found |= {f"correlation[{name}]": size, f"lag[{name}]": lag}
    return found
