"""`select_model`: the model that a set of logs supports, by likelihood-ratio tests, BIC and held-out runs."""

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from pneuopt.dynamics.runnable import HasSystem, as_system
from pneuopt.dynamics.system import System, names
from pneuopt.identification.checks import as_experiments
from pneuopt.identification.identify import identify, validate
from pneuopt.identification.result import AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE, IdentificationResult
from pneuopt.identification.statistics import bayes_information, likelihood_ratio_p
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arguments import check_argument, check_parameters
from pneuopt.quantities.errors import ConvergenceError, UnknownNameError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    import pandas as pd

# probability [1] below which a likelihood-ratio test rejects the simpler model: higher keeps terms that are chance,
# lower drops weak true ones
NESTED_TEST_LEVEL = 0.01
# held-out NRMSE over a simpler model's [1] above which the richer one is not recommended: higher recommends models that
# predict worse, lower lets noise decide
MAX_HELD_OUT_RATIO = 1.02


@dataclass(frozen=True, eq=False)
class ModelSelection:
    """The fits of several models to the same logs, ranked, and the recommended one.

    Attributes
    ----------
    table : DataFrame
        A row a candidate, the best first: converged, free (number of estimates), deviance, bic, bic_above (the best's),
        contains (the richest candidate nested in it), p_value (its extra terms are chance), held_out_nrmse,
        unidentifiable and at_bound (names of parameters), message.
    recommended : str
        A candidate's name.
    reason : str
        One sentence.
    fits : mapping of str to IdentificationResult
        The fit of every candidate, whatever its status.
    """

    table: "pd.DataFrame"
    recommended: str
    reason: str
    fits: Mapping[str, IdentificationResult]

    def __repr__(self) -> str:
        return f"ModelSelection {self.reason}\n{self.table.drop(columns='message').to_string()}"


def select_model(
    candidates: Mapping[str, HasSystem],
    experiments: Experiment | Sequence[Experiment],
    parameters: ParameterSet,
    *,
    free: Sequence[str],
    held_out: Experiment | Sequence[Experiment] = (),
    method: LeastSquares | None = None,
    window: float | None = None,
) -> ModelSelection:
    """Fit every candidate and recommend one.

    Parameters
    ----------
    candidates : mapping of str to drive or System
        By name, say ``{n: ForceDrive(f) for n, f in friction_ladder().items()}``.
    experiments : Experiment or sequence of Experiment
    parameters : ParameterSet
        Known values; a candidate takes those that it has. What is free among them stays so.
    free : sequence of str
        Names, or patterns, freed in each candidate that has them.
    held_out : Experiment or sequence of Experiment, optional
        Runs that no fit sees; a richer model that predicts them worse than a simpler one is not recommended.
    method : LeastSquares, optional
    window : float, optional
        As of `identify`.

    Returns
    -------
    ModelSelection

    Raises
    ------
    InputError
        If there are fewer than two candidates, or a parameter or pattern belongs to none.
    ConvergenceError
        If no candidate converged; `solution` maps each name to its marked result.

    Notes
    -----
    The deviance is the squared residuals over their variance in the best candidate, and over the factor by which that
    candidate's variances exceed those of white residuals: as if only independent samples counted. Between nested
    candidates it falls as chi-square with the extra parameters
    (Wilks 1938); over all, ``bic = deviance + k ln n`` (Schwarz 1978). Unidentifiable parameters count among the k, so
    that a candidate with such parameters gives way to a simpler one that fits as well.
    """
    check_argument("candidates", candidates, Mapping, "a mapping of names to drives or their systems")
    require(len(candidates) >= 2, f"{len(candidates)} candidate leaves nothing to select; give at least two")
    systems = {name: as_system(model, f"candidates[{name!r}]") for name, model in candidates.items()}
    experiments, held_out = as_experiments(experiments), as_experiments(held_out)
    check_parameters(parameters)
    given = {name: _candidate_parameters(system, parameters, free) for name, system in systems.items()}
    _check_names(given, parameters, free)
    fits = {
        n: identify(s, experiments, given[n], method=method, window=window, throw=False) for n, s in systems.items()
    }
    converged = [n for n, fit in fits.items() if fit.status.converged]
    if not converged:
        message = "; ".join(f"{n}: {fit.status.verdict}" for n, fit in fits.items())
        raise ConvergenceError(f"none of the candidates converged: {message}", fits)
    predicted = {n: _mean_nrmse(systems[n], held_out, fits[n]) for n in converged}
    rows = _candidate_rows(systems, fits, predicted)
    chosen, passed_over = _choose(rows)
    return ModelSelection(_selection_table(rows), chosen, _selection_reason(rows, chosen, passed_over), fits)


@dataclass(frozen=True)
class _CandidateRow:
    """A row of the table: one candidate."""

    converged: bool
    free: int
    deviance: float
    bic: float
    contains: str
    p_value: float
    held_out_nrmse: float
    unidentifiable: str
    at_bound: str
    message: str


def _candidate_parameters(system: System, parameters: ParameterSet, free: Sequence[str]) -> ParameterSet:
    own = system.parameters | parameters.select(n for n in parameters if n in system.parameters)
    matched = [n for n in own if any(fnmatch.fnmatch(n, pattern) for pattern in free)]
    return own.freed(*matched) if matched else own


def _check_names(given: Mapping[str, ParameterSet], parameters: ParameterSet, free: Sequence[str]) -> None:
    every = sorted({n for own in given.values() for n in own})
    for name in parameters:
        if name not in every:
            raise UnknownNameError("parameter", name, every)
    for pattern in free:
        if not fnmatch.filter(every, pattern):
            raise UnknownNameError("parameter", pattern, every)


def _selection_table(rows: Mapping[str, _CandidateRow]) -> "pd.DataFrame":
    import pandas as pd

    table = pd.DataFrame.from_dict({n: asdict(row) for n, row in rows.items()}, orient="index")
    table.insert(4, "bic_above", table["bic"] - table["bic"].min())
    return table


def _mean_nrmse(system: System, held_out: Sequence[Experiment], fit: IdentificationResult) -> float:
    """Mean NRMSE over the held-out runs and channels; NaN without any."""
    if not held_out:
        return math.nan
    return float(validate(system, held_out, fit.parameters)["nrmse"].mean())


def _candidate_rows(
    candidates: Mapping[str, System], fits: Mapping[str, IdentificationResult], predicted: Mapping[str, float]
) -> dict[str, _CandidateRow]:
    """A row for each candidate, the lowest BIC first, those that did not converge last."""
    best = min(predicted, key=lambda n: _chi_square(fits[n]))
    scale = _variance(fits[best]) * fits[best].stats["variance_inflation"]
    count = _residual_count(fits[best]) / fits[best].stats["variance_inflation"]
    rows = {}
    for name, fit in fits.items():
        k, deviance = len(fit.estimates), _chi_square(fit) / scale
        inside, p, bic = "", math.nan, math.nan
        if name in predicted:
            inside, bic = _largest_submodel(name, candidates, fits, predicted), bayes_information(deviance, k, count)
        if inside:
            p = likelihood_ratio_p(_chi_square(fits[inside]) / scale - deviance, k - len(fits[inside].estimates))
        held_out = predicted.get(name, math.nan)
        notes = _names_with_note(fit, UNIDENTIFIABLE_NOTE), _names_with_note(fit, AT_BOUND_NOTE), fit.status.message
        rows[name] = _CandidateRow(fit.status.converged, k, deviance, bic, inside, p, held_out, *notes)
    return dict(sorted(rows.items(), key=lambda row: (not row[1].converged, row[1].bic)))


def _names_with_note(fit: IdentificationResult, note: str) -> str:
    """The names of the parameters with a note, in a sentence."""
    return ", ".join(str(n) for n, own in fit.estimates["note"].items() if own == note)


def _largest_submodel(
    name: str,
    candidates: Mapping[str, System],
    fits: Mapping[str, IdentificationResult],
    converged: Mapping[str, float],
) -> str:
    """The richest converged candidate whose free parameters and states are among this one's; "" if there is none."""
    own, states = set(fits[name].estimates.index), set(names(candidates[name].states))
    simpler = [
        n for n in converged if set(fits[n].estimates.index) < own and set(names(candidates[n].states)) <= states
    ]
    return max(simpler, key=lambda n: len(fits[n].estimates), default="")


def _chi_square(fit: IdentificationResult) -> float:
    """The sum of squared residuals, in variances of the declared noise."""
    return float(((fit.fit["rmse"] / fit.fit["noise"]) ** 2 * fit.fit["samples"]).sum())


def _variance(fit: IdentificationResult) -> float:
    return _chi_square(fit) / max(1.0, _residual_count(fit) - len(fit.estimates))


def _residual_count(fit: IdentificationResult) -> float:
    return float(fit.fit["samples"].sum())


def _choose(rows: Mapping[str, _CandidateRow]) -> tuple[str, str]:
    """The candidate of lowest BIC that passes its nested test and predicts held-out runs; the first that failed."""
    passed_over, name = "", next(iter(rows))
    while inside := rows[name].contains:
        row = rows[name]
        if (
            row.p_value <= NESTED_TEST_LEVEL
            and not row.held_out_nrmse > MAX_HELD_OUT_RATIO * rows[inside].held_out_nrmse
        ):
            break
        passed_over, name = passed_over or name, inside
    return name, passed_over


def _selection_reason(rows: Mapping[str, _CandidateRow], chosen: str, passed_over: str) -> str:
    """The sentence that justifies the choice."""
    row, good = rows[chosen], [n for n, r in rows.items() if r.converged]
    message = f"{chosen}, of {len(good)} converged candidates"
    if passed_over:
        p = rows[passed_over].p_value
        why = f"may be chance (p = {p:.2g})" if p > NESTED_TEST_LEVEL else "predict the held-out runs worse"
        message += f", for {passed_over}'s extra terms {why}"
    elif len(good) > 1:
        message += f", has the lowest BIC, {rows[good[1]].bic - row.bic:.4g} below {good[1]}"
    if row.contains:
        message += f"; the simpler {row.contains} is rejected (p = {row.p_value:.2g})"
    if math.isfinite(row.held_out_nrmse):
        message += f"; it predicts held-out runs with an NRMSE of {row.held_out_nrmse:.2%}"
    if row.unidentifiable:
        message += f"; the logs do not identify its {row.unidentifiable}"
    if row.at_bound:
        message += f"; at a bound: {row.at_bound}"
    failed = [n for n in rows if n not in good]
    return message + (f"; not converged: {', '.join(failed)}" if failed else "")
