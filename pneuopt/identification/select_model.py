"""`select_model`: the model that a set of logs supports, by likelihood-ratio tests, BIC and held-out runs."""

import fnmatch
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

from pneuopt.dynamics.runnable import HasSystem, as_system
from pneuopt.dynamics.system import System, names
from pneuopt.identification.candidates import Candidate, Refutation, fit_candidates
from pneuopt.identification.checks import as_experiments
from pneuopt.identification.excitation import remedy
from pneuopt.identification.identify import check_options, validate
from pneuopt.identification.result import AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE, IdentificationResult
from pneuopt.identification.statistics import bayes_information, likelihood_ratio_p
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arguments import as_tuple, check_argument, check_parameters
from pneuopt.quantities.errors import ConvergenceError, UnknownNameError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress, ProgressReporter
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.shown import Result
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    import pandas as pd

# probability [1] below which a likelihood-ratio test rejects the simpler model: higher keeps terms that are chance,
# lower drops weak true ones
NESTED_TEST_LEVEL = 0.01
# difference of the BIC [1] below which held-out runs, or simplicity, decide: a ratio of the likelihoods of 20 (Kass and
# Raftery 1995); higher lets few samples decide, lower takes chance for evidence
TIE = 6.0
# held-out NRMSE over a simpler model's [1] above which the richer one is not recommended: higher recommends models that
# predict worse, lower lets noise decide
MAX_HELD_OUT_RATIO = 1.02


@dataclass(frozen=True, eq=False, repr=False)
class ModelSelection(Result):
    """The fits of several models to the same logs, ranked, and the recommended one; prints its `summary()`.

    Attributes
    ----------
    table : DataFrame
        A row a candidate, the best first: converged, refuted (by short searches, without a fit), free (number of
        estimates), deviance, bic, bic_above (the best's; all three estimated for a refuted one, as is p_value),
        contains (the richest candidate nested in it), p_value (its extra terms are chance), held_out_nrmse,
        unidentifiable and at_bound (names of parameters), unphysical (which order of
        `Excitation.at_least` it breaks), message.
    recommended : str
        A candidate's name.
    reason : str
        One sentence.
    fits : mapping of str to IdentificationResult
        The fit of every candidate that short searches have not refuted, whatever its status.
    """

    table: "pd.DataFrame"
    recommended: str
    reason: str
    fits: Mapping[str, IdentificationResult]

    def summary(self) -> Report:
        """The recommendation and its reason, then a row a candidate."""
        rows = []
        for row in self.table.reset_index(names="model").to_dict(orient="records"):
            unidentifiable = row["unidentifiable"]
            missing = f"{UNIDENTIFIABLE_NOTE}: {unidentifiable}" if unidentifiable else ""
            why = str(row["message"]).partition(";")[0]
            note = "" if row["converged"] else f"refuted: {why}" if row["refuted"] else f"not converged: {why}"
            bound = f"{AT_BOUND_NOTE}: {row['at_bound']}" if row["at_bound"] else ""
            figures = str(row["free"]), format_number(row["bic_above"], 4), str(row["contains"])
            remark = note or row["unphysical"] or bound or missing
            rows.append((str(row["model"]), *figures, format_number(row["p_value"], 2), str(remark)))
        free, contains = number_columns("free", "BIC above best"), text_columns("contains")
        columns = *text_columns("model"), *free, *contains, *number_columns("p of chance"), *text_columns("")
        return Report((Line(self.reason, Tone.GOOD), Table(columns, tuple(rows))))


def select_model(
    candidates: Mapping[str, HasSystem],
    experiments: Experiment | Sequence[Experiment],
    parameters: ParameterSet,
    *,
    free: Sequence[str],
    held_out: Experiment | Sequence[Experiment] = (),
    method: LeastSquares | None = None,
    window: float | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ModelSelection:
    """Fit every candidate alike and recommend one.

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
        As of `identify`; by default whole logs, or the windows of the candidate that follows them best.
    progress : callable, optional
        Receives a `Progress`, a line of text with the time, a candidate and an iteration.

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
    All are fitted in the same windows and at the same widths (`fit_candidates` says why). The deviance is the squared
    residuals over their variance in the best candidate, and over the factor by which that candidate's variances exceed
    those of white residuals: as if only independent samples counted. Between nested candidates it falls as chi-square
    with the extra parameters (Wilks 1938); over all, ``bic = deviance + k ln n`` (Schwarz 1978). Unidentifiable
    parameters count among the k, so that a candidate with such parameters gives way to a simpler one that fits as well.
    A candidate that did not converge, ends at a bound or breaks its model's `Excitation.at_least` is not recommended
    while there is another. Among those within `TIE` of the lowest BIC the held-out runs decide, and without any the
    fewer parameters.
    """
    check_options(method=method, window=window)
    free = as_tuple("free", free, str, 'names or patterns of parameters, as ["friction.*"]')
    check_argument("candidates", candidates, Mapping, "a mapping of names to drives or their systems")
    require(len(candidates) >= 2, f"{len(candidates)} candidate leaves nothing to select; give at least two")
    systems = {name: as_system(model, f"candidates[{name!r}]") for name, model in candidates.items()}
    experiments, held_out = as_experiments(experiments), as_experiments(held_out)
    check_parameters(parameters)
    given = {name: _candidate_parameters(system, parameters, free) for name, system in systems.items()}
    _check_names(given, parameters, free)
    if progress is not None:
        method = replace(method or LeastSquares(), progress=ProgressReporter(progress, "select_model"))
    found = fit_candidates({n: Candidate(s, given[n]) for n, s in systems.items()}, experiments, method, window)
    fits = {n: fit for n, fit in found.items() if isinstance(fit, IdentificationResult)}
    converged = [n for n, fit in fits.items() if fit.status.converged]
    if not converged:
        message = "; ".join(f"{n}: {fit.status.verdict}" for n, fit in fits.items())
        raise ConvergenceError(f"none of the candidates converged: {message}", fits)
    predicted = {n: _mean_nrmse(systems[n], held_out, fits[n]) for n in converged}
    rows = _candidate_rows(systems, found, predicted)
    chosen, why = _choose(rows)
    reason = _selection_reason(rows, chosen, why, _separate(rows, chosen, fits, systems))
    return ModelSelection(_selection_table(rows), chosen, reason, fits)


@dataclass(frozen=True)
class _CandidateRow:
    """A row of the table: one candidate."""

    converged: bool
    refuted: bool
    free: int
    deviance: float
    bic: float
    contains: str
    p_value: float
    held_out_nrmse: float
    unidentifiable: str
    at_bound: str
    unphysical: str
    message: str

    @property
    def is_sound(self) -> bool:
        """Whether it converged to values that a drive may have."""
        return self.converged and not (self.at_bound or self.unphysical)

    @property
    def defect(self) -> str:
        """Why it is not recommended, in a few words."""
        if self.refuted:
            return "by short searches"
        if not self.converged:
            return self.message.partition(";")[0]
        return f"{self.at_bound} at a bound" if self.at_bound else self.unphysical


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
    candidates: Mapping[str, System],
    found: Mapping[str, IdentificationResult | Refutation],
    predicted: Mapping[str, float],
) -> dict[str, _CandidateRow]:
    """A row for each candidate, the lowest BIC first, those that did not converge last."""
    fits = {n: fit for n, fit in found.items() if isinstance(fit, IdentificationResult)}
    best = min(predicted, key=lambda n: _chi_square(fits[n]))
    scale = _variance(fits[best]) * fits[best].stats["variance_inflation"]
    count = _residual_count(fits[best]) / fits[best].stats["variance_inflation"]
    comparable = {n: fit for n, fit in found.items() if n in predicted or n not in fits}
    rows = {}
    for name, fit in found.items():
        k, deviance, inside, p, bic = len(_free_names(fit)), _chi_square(fit, fits) / scale, "", math.nan, math.nan
        if name in comparable:
            inside, bic = _largest_submodel(name, candidates, comparable), bayes_information(deviance, k, count)
        if inside and name in predicted:
            less = k - len(_free_names(found[inside]))
            p = likelihood_ratio_p(_chi_square(found[inside], fits) / scale - deviance, less)
        rows[name] = _CandidateRow(
            name in predicted,
            name not in fits,
            k,
            deviance,
            bic,
            inside,
            p,
            predicted.get(name, math.nan),
            *_said(candidates[name], fit),
        )
    return dict(sorted(rows.items(), key=lambda row: (not row[1].converged, row[1].bic)))


def _said(system: System, fit: IdentificationResult | Refutation) -> tuple[str, str, str, str]:
    """What is unidentifiable, what is at a bound, what is unphysical, and the message."""
    if isinstance(fit, Refutation):
        return "", "", "", fit.reason
    notes = ", ".join(_names_noted(fit, UNIDENTIFIABLE_NOTE)), ", ".join(_names_noted(fit, AT_BOUND_NOTE))
    return *notes, _unphysical(fit, system.excitation.at_least), fit.status.message


def _free_names(fit: IdentificationResult | Refutation) -> set[str]:
    return {*fit.free} if isinstance(fit, Refutation) else {str(n) for n in fit.estimates.index}


def _unphysical(fit: IdentificationResult, at_least: Mapping[str, str]) -> str:
    """Which parameters are below those that no plant has them below, where the logs identify them; empty if none is."""
    found = fit.parameters.select(n for n in fit.parameters if n not in _names_noted(fit, UNIDENTIFIABLE_NOTE))
    below = [(n, m) for n, m in at_least.items() if n in found and m in found and found.value(n) < found.value(m)]
    return ", ".join(f"{n} ({found.value(n):.4g}) below {m} ({found.value(m):.4g})" for n, m in below)


def _names_noted(fit: IdentificationResult, note: str) -> list[str]:
    """The names of the parameters with a note."""
    return [str(n) for n, own in fit.estimates["note"].items() if own == note]


def _largest_submodel(
    name: str, candidates: Mapping[str, System], fits: Mapping[str, IdentificationResult | Refutation]
) -> str:
    """The richest candidate whose free parameters and states are among this one's; "" if there is none."""
    own, states = _free_names(fits[name]), set(names(candidates[name].states))
    simpler = [n for n in fits if _free_names(fits[n]) < own and set(names(candidates[n].states)) <= states]
    return max(simpler, key=lambda n: len(_free_names(fits[n])), default="")


def _chi_square(
    fit: IdentificationResult | Refutation, fits: Mapping[str, IdentificationResult] = MappingProxyType({})
) -> float:
    """The sum of squared residuals, in variances of the declared noise; an estimate for a candidate that is refuted."""
    if isinstance(fit, Refutation):
        return fit.ratio * _chi_square(fits[fit.leader])
    return float(((fit.fit["rmse"] / fit.fit["noise"]) ** 2 * fit.fit["samples"]).sum())


def _variance(fit: IdentificationResult) -> float:
    return _chi_square(fit) / max(1.0, _residual_count(fit) - len(fit.estimates))


def _residual_count(fit: IdentificationResult) -> float:
    return float(fit.fit["samples"].sum())


def _choose(rows: Mapping[str, _CandidateRow]) -> tuple[str, str]:
    """The recommended candidate, and why it comes before that of the lowest BIC; "" where it is that one."""
    sound = {n: row for n, row in rows.items() if row.is_sound} or {n: row for n, row in rows.items() if row.converged}
    lowest = next(iter(sound))
    tied = [n for n, row in sound.items() if row.bic - sound[lowest].bic < TIE]
    name, why = _break_tie(sound, tied)
    while inside := sound[name].contains:
        row = sound[name]
        by_chance = row.p_value > NESTED_TEST_LEVEL
        if inside not in sound or not (
            by_chance or row.held_out_nrmse > MAX_HELD_OUT_RATIO * sound[inside].held_out_nrmse
        ):
            break
        how = f"may be chance (p = {row.p_value:.2g})" if by_chance else "predict the held-out runs worse"
        why, name = why or f"for {name}'s extra terms {how}", inside
    return name, why


def _break_tie(rows: Mapping[str, _CandidateRow], tied: Sequence[str]) -> tuple[str, str]:
    """Of candidates with about the same BIC the one that predicts held-out runs best, or the one with fewest terms."""
    lowest = tied[0]
    best = min(tied, key=lambda n: rows[n].held_out_nrmse)
    if rows[best].held_out_nrmse * MAX_HELD_OUT_RATIO < rows[lowest].held_out_nrmse:
        return best, f"as held-out runs decide between it and {lowest}, whose BIC is within {TIE:g}"
    level = [n for n in tied if not rows[n].held_out_nrmse > MAX_HELD_OUT_RATIO * rows[best].held_out_nrmse]
    simplest = min(level, key=lambda n: rows[n].free)
    if rows[simplest].free < rows[lowest].free:
        return simplest, f"as {lowest}, whose BIC is within {TIE:g}, has more parameters and predicts no better"
    return lowest, ""


def _separate(
    rows: Mapping[str, _CandidateRow],
    chosen: str,
    fits: Mapping[str, IdentificationResult],
    systems: Mapping[str, System],
) -> str:
    """What separates the chosen candidate from the next sound one, or would; "" where there is no other."""
    others = [n for n, row in rows.items() if row.is_sound and n != chosen]
    if not others:
        return ""
    other = min(others, key=lambda n: abs(rows[n].bic - rows[chosen].bic))
    fall, extra = abs(rows[other].deviance - rows[chosen].deviance), abs(rows[other].free - rows[chosen].free)
    if abs(rows[other].bic - rows[chosen].bic) >= TIE:
        return f"{other} is next"
    terms = sorted(set(fits[other].estimates.index) ^ set(fits[chosen].estimates.index))
    if not terms:
        return ""
    run = remedy(systems[max(other, chosen, key=lambda n: rows[n].free)].excitation, terms)
    if fall <= 2 * max(1, extra):
        return f"these logs do not tell it from {other}, nor would more of the same: {run}"
    times = max(2.0, (TIE + extra * math.log(_residual_count(fits[chosen]))) / fall)
    return f"to tell it from {other}, log about {times:.0f} times as much; or {run}"


def _selection_reason(rows: Mapping[str, _CandidateRow], chosen: str, why: str, separation: str) -> str:
    """The sentence that justifies the choice."""
    row, good = rows[chosen], [n for n, r in rows.items() if r.converged]
    message = f"{chosen}, of {len(good)} converged candidates"
    behind = [n for n in good if n != chosen and rows[n].bic >= row.bic]
    if why:
        message += f", {why}"
    elif behind:
        message += f", has the lowest BIC, {rows[behind[0]].bic - row.bic:.4g} below {behind[0]}"
    if row.contains:
        message += f"; the simpler {row.contains} is rejected (p = {row.p_value:.2g})"
    if math.isfinite(row.held_out_nrmse):
        message += f"; it predicts held-out runs with an NRMSE of {row.held_out_nrmse:.2%}"
    if row.unidentifiable:
        message += f"; the logs do not identify its {row.unidentifiable}"
    if row.is_sound:
        message += f"; {separation}" if separation else ""
    else:
        message += f"; no candidate is without a defect, nor is this one: {row.defect}"
    refuted = [f"{n} ({r.defect})" for n, r in rows.items() if n != chosen and not r.is_sound]
    return message + (f"; refuted: {', '.join(refuted)}" if refuted else "")
