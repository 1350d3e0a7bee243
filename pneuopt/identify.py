"""`identify`: parameters with confidence intervals, from logs, by lifted multiple shooting; `validate`: held-out runs.

Nothing here knows what the system is: it hands over its starts (`System.starts`) and is otherwise an ODE with names.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.checks import check_content, check_free, check_logs, check_smooth, measured_outputs
from pneuopt.errors import ConvergenceError
from pneuopt.experiments import Experiment
from pneuopt.nlp.least_squares import NOISE_LEVEL, Fit, LeastSquares, solve_least_squares
from pneuopt.nlp.status import Code, Status
from pneuopt.parameters import ParameterSet
from pneuopt.posing import Problem, conditioned
from pneuopt.provenance import provenance
from pneuopt.simulate import simulate
from pneuopt.statistics import agreement, confidence_interval, correlation_time
from pneuopt.system import System
from pneuopt.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IdentificationResult:
    """What `identify` found.

    Attributes
    ----------
    parameters : ParameterSet
        The system's, with the given values and the estimates; a `per_log` parameter keeps its given value here.
    estimates : DataFrame
        A row a free parameter ("name[log]" for one of a log): value, stderr, ci_low, ci_high (95 %), lower, upper,
        at_bound, unit, source. No interval at a bound or where the data do not determine the parameter.
    covariance : DataFrame
        Of the estimates, scaled by the residuals' own level and correlation.
    fit : DataFrame
        A row a log and channel: rmse, nrmse, fit_percent, samples, noise, unit.
    trajectories : mapping of str to Trajectory
        Fitted states and outputs of each log.
    status : Status
    stats : mapping of str to float
    provenance : mapping of str to str
    """

    parameters: ParameterSet
    estimates: "pd.DataFrame"
    covariance: "pd.DataFrame"
    fit: "pd.DataFrame"
    trajectories: Mapping[str, Trajectory]
    status: Status
    stats: Mapping[str, float]
    provenance: Mapping[str, str]


def identify(
    system: System,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
    throw: bool = True,
) -> IdentificationResult:
    """Fit the free parameters and every log's start state to the logs; no guess is needed from the user.

    Parameters
    ----------
    system : System
    experiments : sequence of Experiment
        Each with all inputs and at least one output of the system. Missing outputs and samples do not count.
    parameters : ParameterSet
        The free ones are estimated; the others are known, unless a log's conditions override them.
    method : LeastSquares, optional
    throw : bool
        Raise if the fit did not converge; otherwise the result says so in its status.

    Returns
    -------
    IdentificationResult

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together; the message names log, channel or parameter.
    ConvergenceError
        If no candidate start converged; the error's `solution` is the result, marked.
    """
    method = method or LeastSquares()
    check_smooth(system)
    experiments = check_logs(system, experiments, parameters)
    check_free(experiments, parameters)
    check_content(experiments)
    problem = Problem(system, tuple(experiments), system.parameters | parameters, method)
    fit, label = _best(problem, method)
    result = _result(problem, fit, label)
    if throw and not result.status.converged:
        raise ConvergenceError(f"identification {result.status}", result)
    return result


def validate(system: System, experiments: Sequence[Experiment], parameters: ParameterSet) -> "pd.DataFrame":
    """Predict logs with known parameters: the start state is fitted, then an independent simulation runs freely.

    Parameters
    ----------
    system : System
    experiments : sequence of Experiment
        Best such as no fit has seen.
    parameters : ParameterSet

    Returns
    -------
    DataFrame
        A row a log and channel: rmse, nrmse, fit_percent, samples, unit.
    """
    import pandas as pd

    fixed = system.parameters | parameters.fixed(*parameters.free_names)
    rows = []
    for experiment in check_logs(system, experiments, fixed):
        rows += _agreements(system, experiment, _predicted(system, experiment, fixed))
    return pd.DataFrame(rows).set_index(["log", "channel"])


def predict(system: System, experiment: Experiment, parameters: ParameterSet) -> Trajectory:
    """The free run that `validate` compares with a log.

    Parameters
    ----------
    system : System
    experiment : Experiment
    parameters : ParameterSet

    Returns
    -------
    Trajectory
        States and outputs on the log's grid.
    """
    fixed = system.parameters | parameters.fixed(*parameters.free_names)
    return _predicted(system, check_logs(system, [experiment], fixed)[0], fixed)


def _predicted(system: System, experiment: Experiment, fixed: ParameterSet) -> Trajectory:
    inputs, known = experiment.trajectory, conditioned(fixed, experiment)
    if not system.states:
        return simulate(system, inputs, known)
    whole = LeastSquares(segment_time=math.inf)
    problem = Problem(system, (experiment,), fixed, whole)
    start = problem.candidates()[0]
    initial = solve_least_squares(problem.transcription(start), whole).solution.trajectories[0]
    state = {s.name: float(initial[s.name][0]) for s in system.states}
    return simulate(system, inputs, known, initial=state)


def _result(problem: Problem, fit: Fit, label: str) -> IdentificationResult:
    """Read the solver's answer back into parameters and tables."""
    solution = fit.solution
    free = solution.parameters.free_names
    shared = [n for n in free if n in problem.parameters]
    values = {n: solution.parameters.value(n) for n in shared}
    runs = {e.name: t for e, t in zip(problem.experiments, solution.trajectories, strict=True)}
    starts = len(problem.experiments) * len(problem.system.states)
    squares = fit.chi_square if fit.jumps is None else 2 * solution.stats["cost"]
    variance = squares / max(1, fit.count - len(free) - starts)
    correlated = max(_correlated(problem.system, problem.experiments, runs), _correlated_jumps(fit.jumps))
    covariance = None if fit.covariance is None else fit.covariance * variance * correlated
    return IdentificationResult(
        problem.parameters.with_values(values),
        _estimates(solution.parameters.select(free), covariance, fit.at_bound, solution.status),
        _square(free, covariance),
        _fit_table(problem.system, problem.experiments, runs),
        runs,
        solution.status,
        {**solution.stats, "chi_square_ratio": variance, "correlation_time": correlated},
        {**provenance(problem.method), "start": label, **{f"sha256[{e.name}]": e.sha256 for e in problem.experiments}},
    )


def _best(problem: Problem, method: LeastSquares) -> tuple[Fit, str]:
    """The first candidate that converges at the noise's level; else the least cost, once two have found it, or of all.

    A wrong basin can converge, too; its residuals then exceed the noise.
    """
    fits: list[tuple[Fit, str]] = []
    for candidate in problem.candidates():
        fit = solve_least_squares(problem.transcription(candidate), method)
        if fit.solution.status.code is Code.INTERRUPTED or (
            fit.solution.status.converged and fit.chi_square <= NOISE_LEVEL * fit.count
        ):
            return fit, candidate.label
        fits.append((fit, candidate.label))
        fits.sort(key=lambda found: _cost(found[0]))
        if len(fits) > 1 and _are_alike(fits[0][0], fits[1][0]):
            break
    fit, label = fits[0]
    status = fit.solution.status
    if not status.converged and len(fits) > 1:
        status = Status(status.code, f"none of {len(fits)} starts will do; in the best, {status.message}")
    return replace(fit, solution=replace(fit.solution, status=status)), label


def _cost(fit: Fit) -> float:
    return fit.solution.stats["cost"]


def _are_alike(best: Fit, second: Fit) -> bool:
    """Whether both converged, at the same cost."""
    converged = best.solution.status.converged and second.solution.status.converged
    return converged and _cost(second) <= 1.001 * _cost(best)


def _fit_table(system: System, experiments: Sequence[Experiment], runs: Mapping[str, Trajectory]) -> "pd.DataFrame":
    import pandas as pd

    rows = [row for e in experiments for row in _agreements(system, e, runs[e.name])]
    return pd.DataFrame(rows).set_index(["log", "channel"])


def _agreements(system: System, experiment: Experiment, run: Trajectory) -> list[dict[str, object]]:
    units = {q.name: q.unit for q in system.outputs}
    rows: list[dict[str, object]] = []
    for channel in measured_outputs(system, experiment):
        figures = agreement(experiment.trajectory[channel], run[channel])
        noise = experiment.noise[channel]
        rows.append({"log": experiment.name, "channel": channel, **figures, "noise": noise, "unit": units[channel]})
    return rows


def _correlated(system: System, experiments: Sequence[Experiment], runs: Mapping[str, Trajectory]) -> float:
    """By how much correlated residuals (model error, not noise) widen a variance: the mean over logs and channels."""
    times = [
        correlation_time(e.trajectory[channel] - runs[e.name][channel])
        for e in experiments
        for channel in measured_outputs(system, e)
    ]
    return float(np.mean(times))


def _correlated_jumps(jumps: Array | None) -> float:
    """The same for what stands for noise of the states."""
    return 1.0 if jumps is None else float(np.mean([correlation_time(column) for column in jumps.T]))


def _estimates(
    parameters: ParameterSet, covariance: Array | None, at_bound: NDArray[np.bool_], status: Status
) -> "pd.DataFrame":
    import pandas as pd

    usable = covariance is not None and status.code is not Code.DIVERGED
    stderr = np.sqrt(np.diag(covariance)) if usable and covariance is not None else np.full(len(parameters), math.nan)
    rows = {}
    for (name, p), spread, bound in zip(parameters.items(), stderr, at_bound, strict=True):
        deviation = math.nan if bound else float(spread)
        low, high = confidence_interval(p.value, deviation, log=p.log)
        rows[name] = [p.value, deviation, low, high, p.lower, p.upper, bool(bound), p.unit, p.source]
    columns = ["value", "stderr", "ci_low", "ci_high", "lower", "upper", "at_bound", "unit", "source"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def _square(free: Sequence[str], covariance: Array | None) -> "pd.DataFrame":
    import pandas as pd

    values = np.full((len(free), len(free)), math.nan) if covariance is None else covariance
    return pd.DataFrame(values, index=list(free), columns=list(free))
