"""`identify`: parameters with confidence intervals from logs, by lifted multiple shooting; `validate`, `predict`.

The system is any ODE with named signals that proposes its own starts (`System.starts`). Below: the fit and its review,
the predictions of logs, and the tables of results.
"""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem, check_smooth
from pneuopt.identification.explanations import explain_misfit
from pneuopt.identification.forecast import agreement_rows, learn_forecast_error
from pneuopt.identification.free_run import predict_logs, refuse_drift
from pneuopt.identification.identifiability import (
    check_content,
    hold_unseen,
    prior_dominated,
    prior_influenced,
)
from pneuopt.identification.losses import Loss, fit_robustly
from pneuopt.identification.misfit import Misfit, degrees_of_freedom, diagnose_misfit, suspect_widths, t_quantile
from pneuopt.identification.problem import (
    EstimationProblem,
    as_estimation_model,
    as_experiments,
    check_free,
    check_logs,
    emit_log_warnings,
    find_centre,
    log_remarks,
    outputs_in_log,
)
from pneuopt.identification.result import ChosenWindow, EstimateRow, IdentificationResult, Mark
from pneuopt.identification.review import FixedValueTest, free_shown_offset, gains_beyond_chance, review_fit
from pneuopt.identification.search import (
    Search,
    Tried,
    check_window,
    enforce_ordering,
    find_fit,
    fit_fixing_unidentifiable,
    fit_from_profiles,
    fit_in_windows,
    mark_order,
    run_freely,
)
from pneuopt.identification.statistics import confidence_interval
from pneuopt.identification.tolerances import HARMLESS_BIAS, MIN_EXPLAINING_SECONDS, MODEL_ERROR_LEVEL
from pneuopt.identification.widths import ESTIMATED_WIDTH, estimated_widths, free_widths, sticking_covariance
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ConvergenceError, PhysicsWarning
from pneuopt.quantities.output import one_blas_thread
from pneuopt.quantities.parameters import ParameterSet, as_tuple, check_argument, check_number, wrong_argument
from pneuopt.quantities.status import Code, Progress, ProgressReporter, Status, provenance
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import CpuBudget, Fit, LeastSquares
from pneuopt.shooting.tolerances import MAX_CHI_SQUARE_RATIO, MAX_GAP_SHARE

if TYPE_CHECKING:
    import pandas as pd


ESTIMATE_COLUMNS = [n for n in EstimateRow.__annotations__ if n != "note"]  # a note comes with the review
NOTHING_IDENTIFIABLE = Status(
    Code.NOT_CONVERGED,
    ("the logs identify none of the free parameters by itself", "fix some, or log runs that separate them"),
)


def identify(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Sequence[Experiment],
    parameters: ParameterSet,
    *,
    method: LeastSquares | None = None,
    loss: Loss | None = None,
    estimate_noise: bool = False,
    window: float | None = None,
    accept: Sequence[str] = (),
    start: IdentificationResult | None = None,
    cpu_seconds: float = math.inf,
    explain: bool = True,
    throw: bool = True,
    progress: Callable[[Progress], None] | None = None,
) -> IdentificationResult:
    """Fit the free parameters and every log's start state to the logs; no guess is needed from the user.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        A loop with its sampled PID, where the logs hold the reference ("speed_reference") but not the command. Where
        they hold the command, identify the plant alone: the controller then adds no information.
    experiments : Experiment or sequence of Experiment
        Each with all inputs and at least one output of the system. Missing outputs and samples do not count.
    parameters : ParameterSet
        The free ones are estimated; the others are known, unless a log's conditions override them.
    method : LeastSquares, optional
        The length of segments, the stages of a search, its integration steps.
    loss : Loss, optional
        For logs with outliers: `Huber()` or `SoftL1()`; by default every residual counts with its square.
    estimate_noise : bool
        Take each channel's noise from its residuals, whatever the logs declare.
    window : float, optional
        Cut the logs into windows of this time [s], each with a start state of its own; by default only where the model
        does not follow whole logs, and as long as those that predict best (`result.window`); math.inf: never.
    accept : sequence of str
        Checks that the logs need not pass, for they are right: "motion", "speed", "work", "command", "scale", "jumps",
        "stops", "mass", "pressures". What these find stands in the status.
    start : IdentificationResult, optional
        A fit of these logs with a model that has the same states, from which the search begins; by default the model's
        own starts.
    cpu_seconds : float
        CPU time of this process after which the search ends [s], within an iteration, with the best values so far; the
        status then says so first, and is `Code.BUDGET`.
    explain : bool
        Where the model misses the logs, try what it may lack (a dead time, friction, a leak), for as much CPU time as
        the fit took; the status names what explains the misfit. Not with a `start` or a `loss`.
    throw : bool
        Raise if the fit did not converge; otherwise its status shows it.
    progress : callable, optional
        Receives a `Progress`, a line of text with the time, an iteration; in place of the method's own.

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
    check_options(method=method, loss=loss, window=window, start=start, cpu_seconds=cpu_seconds)
    accept = as_tuple("accept", accept, str, 'the names of checks, as ["motion"]')
    method, model = method or LeastSquares(), as_estimation_model(system)
    if progress is not None:
        method = replace(method, progress=ProgressReporter(progress, "identify"))
    if cpu_seconds != math.inf:
        method = replace(method, budget=CpuBudget(cpu_seconds))
    check_smooth(model)
    experiments = tuple(e.accepting(*accept) for e in as_experiments(experiments))
    if estimate_noise:
        experiments = [replace(e, noise={}) for e in experiments]
    with one_blas_thread():
        given, experiments = experiments, check_logs(model, experiments, parameters)
        parameters = find_centre(model, experiments, parameters)
        check_free(experiments, parameters)
        log_warnings = check_content(model, experiments, parameters)
        log_warnings += emit_log_warnings(model, experiments, parameters) + log_remarks(model, given, experiments)
        stated = all(channel in e.noise for e in given for channel in outputs_in_log(model, e))
        problem = EstimationProblem(
            model,
            tuple(experiments),
            model.parameters | parameters,
            method,
            noise_is_stated=stated,
            window=math.inf if window is None else window,
            is_whole=window == math.inf,
        )
        check_window(problem)
        result = _fit_and_review(problem, loss, start, estimate_noise=estimate_noise, explain=explain)
    if log_warnings:
        result = replace(result, status=result.status.with_remedies(*log_warnings))
    if throw and not result.status.converged:
        raise ConvergenceError(f"identification {result.status}", result)
    return result


def check_options(
    *,
    method: LeastSquares | None,
    window: float | None,
    loss: Loss | None = None,
    start: IdentificationResult | None = None,
    cpu_seconds: float = math.inf,
) -> None:
    """Refuse what is no option of a fit, before any log is read: `InputError` names the option and what it takes."""
    if method is not None:
        check_argument("method", method, LeastSquares, "LeastSquares(...), with its brackets, or None")
    if isinstance(loss, type) or (loss is not None and not hasattr(loss, "weight")):
        raise wrong_argument("loss", loss, "a loss with its brackets, Huber() or SoftL1(), or None")
    if start is not None:
        check_argument("start", start, IdentificationResult, "what identify returned for these logs, or None")
    _check_window_time(window)
    check_number("cpu_seconds", cpu_seconds, "a time in seconds, as 60.0; leave it out for no limit")


def _check_window_time(window: float | None) -> None:
    """Refuse a window that is no time; `check_window` compares it with the logs."""
    if window is not None:
        check_number("window", window, "a time in seconds, as 0.5, math.inf for whole logs, or None")


def _fit_and_review(
    problem: EstimationProblem,
    loss: Loss | None,
    start: IdentificationResult | None,
    *,
    estimate_noise: bool,
    explain: bool,
) -> IdentificationResult:
    """Free widths, fit from the model's starts or a given one, in windows if need be, and review the intervals."""
    begun, window, problem = time.process_time(), problem.window, free_widths(problem)
    problem, unseen = hold_unseen(problem)
    for sentence in unseen:
        warnings.warn(sentence, PhysicsWarning, stacklevel=3)
    doubts, trail, offset = FixedValueTest(), None, ""
    if start is None:
        problem, (_, held, fit, label, _), doubts, trail, offset = _search(problem, loss, estimate_noise=estimate_noise)
    else:
        began = fit_fixing_unidentifiable(problem, problem.start_from(start))
        (held, fit), label = fit_robustly(*began, loss, estimate_noise=estimate_noise), "a given fit"
    chosen = ChosenWindow(window, window, window, fit.stats["gap_share"]) if math.isfinite(window) else None
    restarts = False
    if not doubts.found and (windowed := fit_in_windows(held, fit)):
        restarts = 2 * fit.stats["cost"] > MAX_CHI_SQUARE_RATIO * fit.count
        held, fit, chosen = windowed
        held, fit = fit_robustly(held, fit, loss, estimate_noise=estimate_noise)
    held, fit = enforce_ordering(held, fit, label)
    result, profiles = review_fit(held, *_result(held, fit, label, loss, restarts=restarts))
    while better := fit_from_profiles(held, fit, profiles):
        fit = better
        result, profiles = review_fit(held, *_result(held, fit, label, loss, restarts=restarts))
    result = replace(mark_order(held, result), window=chosen, trail=trail)
    result = replace(result, status=problem.method.budget.name_end(result.status))
    if result.status.converged and not problem.method.budget.is_spent:  # no other fit forecasts
        error = learn_forecast_error(problem, result.parameters, LeastSquares(budget=problem.method.budget))
        result = replace(result, forecast_error=error)
    why = str(doubts.found) if doubts.found else ""
    if not why and explain and start is None and loss is None and _is_missed(result):
        seconds = max(time.process_time() - begun, MIN_EXPLAINING_SECONDS)
        why, explains = explain_misfit(held, fit, min(seconds, problem.method.budget.part(1.0).seconds))
        if explains:
            result = replace(result, status=refuse_drift(result.status, result.stats))
    return replace(result, status=result.status.with_details(why, offset, str(chosen) if chosen else ""))


def _search(
    problem: EstimationProblem, loss: Loss | None, *, estimate_noise: bool
) -> "tuple[EstimationProblem, Tried, FixedValueTest, pd.DataFrame, str]":
    """The problem, whose offset is freed where logs show one; its best fit, doubts of fixed values, trail, a remark."""
    doubts, offset = FixedValueTest(), problem.system.plant.centre
    search = Search(problem, loss, estimate_noise=estimate_noise, gives_up=doubts.explains)
    found = find_fit(search)
    if freed := free_shown_offset(found.problem, found.fit):
        freed = replace(problem, parameters=freed.parameters)
        freed, better, others, trail, _ = _search(freed, loss, estimate_noise=estimate_noise)
        if better.fit.status.converged and gains_beyond_chance(found.fit, 2 * better.fit.stats["cost"]):
            remark = f"{problem.system.inputs[0].name} counts from another value than 0: {offset} is estimated with the"
            return freed, better, others, trail, f"{remark} rest, unless it is stated"
    if not (found.fit.status.converged or doubts.tests):  # a wrong value drives widths to where no search settles
        doubts.explains(found.problem, found.fit)
    return problem, found, doubts, search.trail, ""


def _is_missed(result: IdentificationResult) -> bool:
    """Whether the residuals of a search that came to its end, or its gaps, are those of another model."""
    if result.status.code not in (Code.CONVERGED, Code.PARTIAL, Code.MISFIT, Code.NOT_CONVERGED):
        return False
    is_absorbed = not result.status.converged and result.stats["gap_share"] > MAX_GAP_SHARE
    is_large = result.stats["chi_square_ratio"] > MODEL_ERROR_LEVEL**2
    return is_absorbed or is_large or result.status.code is Code.MISFIT


def _result(
    problem: EstimationProblem, fit: Fit, label: str, loss: Loss | None, *, restarts: bool
) -> tuple[IdentificationResult, tuple[str, ...]]:
    """The result of a fit, and the names of the parameters that rest on a prior, not on the logs.

    `restarts` says that windows follow logs that the model does not follow from end to end.
    """
    import pandas as pd

    free = fit.parameters.free_names
    estimates = problem.unknowns().with_values({n: fit.parameters.value(n) for n in free}).select(free)
    shared = [n for n in free if n in problem.parameters]
    values = {n: fit.parameters.value(n) for n in shared}
    runs = {e.name: t for e, t in zip(problem.experiments, fit.trajectories, strict=True)}
    squares = fit.chi_square if fit.jumps is None else 2 * fit.stats["cost"]
    dof = degrees_of_freedom(problem, fit)
    variance = squares / dof
    free_runs = run_freely(problem, fit)
    prediction = predict_logs(problem, fit, free_runs)
    diagnosis = suspect_widths(diagnose_misfit(problem, fit, variance, dof), problem, fit, variance)
    misfit = replace(diagnosis, restarts=restarts, is_useless=prediction.is_useless)
    covariance = None if misfit.covariance is None else misfit.covariance + sticking_covariance(problem, fit)
    if covariance is not None and fit.prior_covariance is not None:
        covariance = covariance + fit.prior_covariance
    influenced, resting = _weigh_prior(problem, fit, covariance)
    unidentifiable = tuple(n for n, rests in zip(free, resting, strict=True) if rests or n in problem.fixed)
    widths = estimated_widths(problem.parameters)
    asked = set(free) - set(widths)
    status = prediction.assess(misfit.assess(fit.status))
    if asked and asked <= set(unidentifiable):
        status = NOTHING_IDENTIFIABLE if misfit.level <= MODEL_ERROR_LEVEL else misfit.refusal
    matrix = np.full((len(free), len(free)), math.nan) if covariance is None else covariance
    parameters = problem.parameters.with_values(values)
    result = IdentificationResult(
        parameters | ParameterSet({n: replace(parameters[n], source=ESTIMATED_WIDTH) for n in widths}),
        _estimates(estimates, covariance, fit.at_bound, influenced, status, misfit),
        pd.DataFrame(matrix, index=list(free), columns=list(free)),
        fit_table(problem, fit, free_runs),
        runs,
        status,
        {**fit.stats, "chi_square_ratio": variance, "variance_inflation": misfit.inflation, **prediction.stats},
        _provenance(problem, label, loss),
    )
    return result, unidentifiable


def _weigh_prior(problem: EstimationProblem, fit: Fit, covariance: Array | None) -> tuple[Mask, Mask]:
    """Which free parameters the prior of what is held influences, and which rest on it, shapes (k,)."""
    free = fit.parameters.free_names
    if covariance is None or fit.prior_covariance is None:
        return np.zeros(len(free), dtype=bool), np.zeros(len(free), dtype=bool)
    found = np.array([fit.parameters.value(n) for n in free])
    held = [value for n, value in problem.fixed.items() if n not in problem.unseen]
    resting = prior_dominated(covariance, fit.prior_covariance, found, held)
    return prior_influenced(covariance, fit.prior_covariance), resting


def _provenance(problem: EstimationProblem, label: str, loss: Loss | None) -> dict[str, str]:
    hashes = {f"sha256[{e.name}]": e.sha256 for e in problem.experiments}
    return {**provenance(problem.method, *([loss] if loss else [])), "start": label, **hashes}


def _estimates(
    parameters: ParameterSet,
    covariance: Array | None,
    at_bound: Mask,
    influenced: Mask,
    status: Status,
    misfit: Misfit,
) -> "pd.DataFrame":
    from pneuopt.quantities.frames import WideFrame

    usable = covariance is not None and status.converged and not misfit.is_excessive
    known = np.full(len(parameters), math.nan) if covariance is None else np.sqrt(np.diag(covariance))
    half_widths = np.where(at_bound, math.nan, t_quantile(misfit.dof) * known)
    bias = np.maximum(misfit.bound_bias(half_widths), np.where(influenced, half_widths, 0.0))
    rows = {}
    for i, (name, p) in enumerate(parameters.items()):
        deviation = float(known[i]) if usable and not at_bound[i] else math.nan
        dof, stretch = float(misfit.dof[i]), bias[i] / half_widths[i] if bias[i] > half_widths[i] else 1.0
        low, high = confidence_interval(p.value, stretch * deviation, log=p.log, dof=dof)
        is_harmless = bool(bias[i] <= HARMLESS_BIAS * abs(p.value)) and math.isfinite(deviation)
        mark = misfit.mark if is_harmless and status.converged else Mark.BIAS_POSSIBLE
        shown = [p.value, low, high, p.unit, mark]
        rows[name] = [*shown, deviation, dof, float(bias[i]), p.lower, p.upper, bool(at_bound[i]), p.source]
    return WideFrame.from_dict(rows, orient="index", columns=ESTIMATE_COLUMNS)


def fit_table(problem: EstimationProblem, fit: Fit, free_runs: Sequence[Trajectory]) -> "pd.DataFrame":
    """A row a log and channel of a fit (`IdentificationResult.fit`)."""
    from pneuopt.quantities.frames import WideFrame

    runs = zip(problem.experiments, fit.trajectories, free_runs, strict=True)
    rows = [row for e, run, free in runs for row in agreement_rows(problem.system, e, run, free)]
    return WideFrame(rows).set_index(["log", "channel"])
