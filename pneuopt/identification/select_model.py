"""`select_model`: the model that a set of logs supports, by likelihood-ratio tests, BIC and held-out runs.

`fit_candidates` fits all alike, for residuals compare only so: over whole logs or windows of one length, that of the
leader, the simplest of those that short searches find best. The widths of its kinks each estimates, and they count.

`try_candidate`, such a search, has loose gaps, which only relax a fit: a model that leaves many times the squares of
another one's whole fit cannot explain the logs.
"""

import fnmatch
import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.dynamics.hooks import Start
from pneuopt.dynamics.runnable import HasSystem, as_system
from pneuopt.dynamics.system import System, names
from pneuopt.identification.forecast import validate
from pneuopt.identification.identifiability import pose_problem
from pneuopt.identification.identify import check_options, identify
from pneuopt.identification.problem import EstimationProblem, as_experiments
from pneuopt.identification.result import AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE, IdentificationResult, remedy
from pneuopt.identification.statistics import bayes_information, likelihood_ratio_p
from pneuopt.identification.tolerances import (
    HOPELESS_RATIO,
    LEADER_RATIO,
    MAX_HELD_OUT_RATIO,
    MIN_WINDOW_SAMPLES,
    NESTED_TEST_LEVEL,
    TIE,
)
from pneuopt.identification.widths import estimated_widths
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.errors import ConvergenceError, PhysicsWarning, UnknownNameError, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple, check_argument, check_parameters
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result
from pneuopt.quantities.status import Code, Progress, ProgressReporter, Status
from pneuopt.shooting.least_squares import LeastSquares, Stage, solve_least_squares

if TYPE_CHECKING:
    import pandas as pd


# gaps and iterations of a trial: with tighter gaps, or more iterations, it takes as long as a search; with looser ones
# a wrong model looks as good as a right one
TRIAL_STAGES = (Stage(3e-3, 12), Stage(1e-3, 8), Stage(1e-4, 12))


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
        `IdentificationHints.at_least` it breaks), message.
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
        The logs that all candidates are fitted to.
    parameters : ParameterSet
        Known values; a candidate takes those that it has. What is free among them stays so.
    free : sequence of str
        Names, or patterns, freed in each candidate that has them.
    held_out : Experiment or sequence of Experiment, optional
        Runs that no fit sees; a richer model that predicts them worse than a simpler one is not recommended.
    method : LeastSquares, optional
        As of `identify`, for all candidates.
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
    All are fitted in the same windows, and each estimates the widths of its kinks. The deviance is the squared
    residuals over their variance in the best candidate, and over the factor by which that candidate's variances exceed
    those of white residuals: as if only independent samples counted. Between nested candidates it falls as chi-square
    with the extra parameters (Wilks 1938); over all, ``bic = deviance + k ln n`` (Schwarz 1978). Unidentifiable
    parameters count among the k, so that a candidate with such parameters gives way to a simpler one that fits as well.
    A candidate that did not converge, ends at a bound or breaks its model's `IdentificationHints.at_least` is not
    recommended while there is another. Among those within `TIE` of the lowest BIC the held-out runs decide, and without
    any the fewer parameters.
    """
    import pandas as pd

    check_options(method=method, window=window)
    free = as_tuple("free", free, str, 'names or patterns of parameters, as ["friction.*"]')
    check_argument("candidates", candidates, Mapping, "a mapping of names to drives or their systems")
    require(len(candidates) >= 2, f"{len(candidates)} candidate leaves nothing to select; give at least two")
    systems = {name: as_system(model, f"candidates[{name!r}]") for name, model in candidates.items()}
    experiments, held_out = as_experiments(experiments), as_experiments(held_out)
    check_parameters(parameters)
    given = {}
    for name, system in systems.items():
        own = system.parameters | parameters.select(n for n in parameters if n in system.parameters)
        matched = [n for n in own if any(fnmatch.fnmatch(n, pattern) for pattern in free)]
        given[name] = own.freed(*matched) if matched else own
    every = sorted({n for own in given.values() for n in own})
    unknown = [n for n in parameters if n not in every] + [p for p in free if not fnmatch.filter(every, p)]
    if unknown:
        raise UnknownNameError("parameter", unknown[0], every)
    if progress is not None:
        method = replace(method or LeastSquares(), progress=ProgressReporter(progress, "select_model"))
    found = fit_candidates({n: Candidate(s, given[n]) for n, s in systems.items()}, experiments, method, window)
    fits = {n: fit for n, fit in found.items() if isinstance(fit, IdentificationResult)}
    converged = [n for n, fit in fits.items() if fit.status.converged]
    if not converged:
        message = "; ".join(f"{n}: {fit.status.verdict}" for n, fit in fits.items())
        raise ConvergenceError(f"none of the candidates converged: {message}", fits)
    predicted = {
        n: float(validate(systems[n], held_out, fits[n].parameters)["nrmse"].mean()) if held_out else math.nan
        for n in converged
    }
    rows = _candidate_rows(systems, found, predicted)
    chosen, why = _choose(rows)
    reason = _selection_reason(rows, chosen, why, _separate(rows, chosen, fits, systems))
    table = pd.DataFrame.from_dict({n: asdict(row) for n, row in rows.items()}, orient="index")
    table.insert(4, "bic_above", table["bic"] - table["bic"].min())
    return ModelSelection(table, chosen, reason, fits)


@dataclass(frozen=True)
class Trial:
    """The best short search of a model."""

    # squared residuals and gaps, in noise variances; infinite where no start is finite, or none was searched to the end
    squares: float = math.inf
    least: float = math.inf  # what these would still fall to, by the linearised equations; zero where these say nothing
    by_stage: tuple[float, ...] = ()  # the squares after each stage, at least the noise's
    # the least squares over those that were allowed after the same stage, where no start kept within these; else 0
    ratio: float = 0.0

    @property
    def is_hopeless(self) -> bool:
        """Whether each start was left for its squares, or is not finite."""
        return math.isinf(self.squares)

    def better(self, other: "Trial") -> "Trial":
        """The one of fewer squares; of two that were left, the one that was nearer."""
        return min(self, other, key=lambda trial: (trial.squares, trial.ratio or math.inf))


def try_candidate(
    system: System,
    experiments: Sequence[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
    *,
    window: float = math.inf,
    near: IdentificationResult | None = None,
    known: Trial | None = None,
    allowed: Sequence[float] = (),
) -> Trial:
    """Search shortly from a model's first start, and from `near`, a fit with another model of the same states.

    A start is left where its squares exceed those `allowed` after a stage; `known` is the first start's trial.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # a fit says them
        problem = replace(pose_problem(system, experiments, parameters, method), window=window)
    candidates, best = problem.candidates, known or Trial()
    others = [problem.start_from(near)] if near and candidates[0].trial_parameters else []
    for start in others if known else [*others, candidates[0]]:
        best = best.better(_try_start(problem, start, allowed))
        if not (allowed and best.is_hopeless):
            break
    return best


def _try_start(problem: EstimationProblem, start: Start, allowed: Sequence[float]) -> Trial:
    """The trial from one start, until its squares exceed what is allowed."""
    stages = TRIAL_STAGES if problem.has_gaps else TRIAL_STAGES[-1:]
    trial = Trial(0.0, 0.0)
    for stage, enough in itertools.zip_longest(stages, allowed[: len(stages)], fillvalue=math.inf):
        assert isinstance(stage, Stage)
        # an empty last stage: the last one of a method would iterate to its end
        method = replace(problem.method, stages=(stage, replace(stage, iterations=0)))
        fit = solve_least_squares(problem.transcription(start), method)
        if fit.status.code is Code.INTERRUPTED:
            raise KeyboardInterrupt
        squares, optimum = 2 * fit.stats["cost"], fit.optimum
        if not squares < math.inf:
            return Trial()
        least = max(0.0, optimum.equations.promised_squares(optimum.keep)) if optimum else 0.0
        trial = Trial(squares, least, (*trial.by_stage, max(squares, fit.count)))
        if least > enough:
            return replace(trial, squares=math.inf, ratio=least / enough)
        start = problem.start_from(fit)
    return trial


@dataclass(frozen=True)
class Candidate:
    """A model and its parameters, of which the free ones are estimated."""

    system: System
    parameters: ParameterSet

    def extends(self, other: "Candidate") -> bool:
        """Whether the other has the same states, and a part of this one's free parameters."""
        return self.has_states_of(other) and set(other.parameters.free_names) < set(self.parameters.free_names)

    def has_states_of(self, other: "Candidate") -> bool:
        """Whether a start of the other's states is one of this one's."""
        return names(other.system.states) == names(self.system.states)


@dataclass(frozen=True)
class Refutation:
    """Why a candidate was not fitted: its squares over the leader's in short searches, and a few words."""

    leader: str
    ratio: float
    free: tuple[str, ...]  # the parameters that it would estimate
    reason: str


Fits = dict[str, IdentificationResult | Refutation]
Trials = dict[str, Trial]


def fit_candidates(
    candidates: Mapping[str, Candidate],
    experiments: tuple[Experiment, ...],
    method: LeastSquares | None,
    window: float | None,
) -> Fits:
    """Fit every candidate alike, or refute it; one that does not converge begins again at the richest one within it."""
    alike = _Alike(experiments, method or LeastSquares(), window)
    trials, allowed, out = Trials(), tuple[float, ...](), Fits()
    for name in _richest_first(candidates):  # which leaves the others the fewest squares
        alike.announce("trying", name, len(trials), len(candidates))
        trials[name] = alike.try_shortly(candidates[name], allowed=allowed)
        allowed = _hopeless_squares(min(trials.values(), key=lambda trial: trial.squares))
    # the leader first, the simplest of those near the least squares, the others by their squares
    near = [n for n, trial in trials.items() if trial.squares <= LEADER_RATIO * min(t.squares for t in trials.values())]
    leader = min(near or trials, key=lambda n: len(candidates[n].parameters.free_names))
    for name in sorted(trials, key=lambda n: (n != leader, trials[n].squares)):
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = fit = alike.fit(candidates[name])
        if fit.status.converged:
            out = _fit_beside(name, fit, candidates, trials, alike)
            break
    return {n: out[n] for n in candidates}


def _richest_first(candidates: Mapping[str, Candidate]) -> list[str]:
    return sorted(candidates, key=lambda n: -len(candidates[n].parameters.free_names))


def _hopeless_squares(best: Trial) -> tuple[float, ...]:
    """The squares after each stage beyond which another candidate is hopeless."""
    return tuple(HOPELESS_RATIO * squares for squares in best.by_stage)


def _fit_beside(
    leader: str,
    fit: IdentificationResult,
    candidates: Mapping[str, Candidate],
    trials: Trials,
    alike: "_Alike",
) -> Fits:
    """The fit of the leader and those of the others, as alike to it as can be, the simplest first."""
    out = Fits({leader: fit})
    out |= _refute_hopeless(leader, fit, candidates, trials, alike)
    others = sorted(candidates.keys() - out.keys(), key=lambda n: (len(candidates[n].parameters.free_names), n))
    if others and alike.window is None:
        alike = alike.with_window_of(fit)
        if fit.window is None and alike.window != math.inf:
            out[leader] = alike.fit(candidates[leader], fit)
    for name in others:
        alike.announce("fitting", name, len(out), len(candidates))
        out[name] = _fit_one(candidates[name], leader, candidates, alike, out)
    return out


def _refute_hopeless(
    leader: str, fit: IdentificationResult, candidates: Mapping[str, Candidate], trials: Trials, alike: "_Alike"
) -> dict[str, Refutation]:
    """The refutations of candidates beside the leader's fit; a case of a refuted one needs no more than its own trial.

    A static map is always fitted, for that is as short.
    """
    out = dict[str, Refutation]()
    for name in _richest_first({n: c for n, c in candidates.items() if n != leader and c.system.states}):
        candidate, trial = candidates[name], trials[name]
        is_tried = bool(trial.by_stage)
        if is_tried and not trial.is_hopeless:
            continue
        if not (is_tried and any(candidates[n].extends(candidate) for n in out)):
            near = fit if candidate.has_states_of(candidates[leader]) else None
            trial = alike.try_shortly(candidate, near, trial if is_tried else None, _hopeless_squares(trials[leader]))
        if trial.ratio:
            ratio = HOPELESS_RATIO * trial.ratio
            words = f"short searches with loose gaps leave {ratio:.3g} times the squares of {leader}"
            out[name] = Refutation(leader, ratio, candidate.parameters.free_names, words)
    return out


def _fit_one(
    candidate: Candidate, leader: str, candidates: Mapping[str, Candidate], alike: "_Alike", fits: Fits
) -> IdentificationResult:
    """The fit of a candidate, from the leader's where one is nested in the other, or else from its own starts."""
    within = {
        n: fit
        for n, fit in fits.items()
        if isinstance(fit, IdentificationResult) and fit.status.converged and candidate.extends(candidates[n])
    }
    own = fits[leader]
    assert isinstance(own, IdentificationResult)
    is_near = candidate.has_states_of(candidates[leader]) and (
        leader in within or candidates[leader].extends(candidate) or math.isfinite(alike.length)
    )
    fit = alike.fit(candidate, own) if is_near else alike.fit(candidate)
    if is_near and not fit.status.converged:
        fit = alike.fit(candidate)
    if within and not fit.status.converged:
        richest = max(within, key=lambda n: len(candidates[n].parameters.free_names))
        again = alike.fit(candidate, within[richest])
        fit = again if again.status.converged else fit
    return fit


@dataclass(frozen=True)
class _Alike:
    """The way in which all candidates are fitted."""

    experiments: tuple[Experiment, ...]
    method: LeastSquares
    window: float | None

    @property
    def length(self) -> float:
        """The duration of a window [s]; infinite for whole logs."""
        return math.inf if self.window is None else self.window

    @property
    def _own_method(self) -> LeastSquares:
        """The method, with windows in one segment each, which a start follows well."""
        return self.method if math.isinf(self.length) else replace(self.method, segment_time=self.length)

    def fit(self, candidate: Candidate, start: IdentificationResult | None = None) -> IdentificationResult:
        """The fit of a candidate; one whose states jump within whole logs has not converged."""
        given, logs, method = candidate.parameters, self.experiments, self._own_method
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="before the search")  # the table says what is unidentifiable
            fit = identify(
                candidate.system,
                logs,
                given,
                method=method,
                window=self.window,
                start=start,
                explain=False,
                throw=False,
            )
        if self.window == math.inf and fit.status.converged and _has_jumps(fit, self.method):
            words = "it follows whole logs only with jumps of its states", *fit.status.sentences
            fit = replace(fit, status=Status(Code.NOT_CONVERGED, words))
        return fit

    def try_shortly(
        self,
        candidate: Candidate,
        near: IdentificationResult | None = None,
        known: Trial | None = None,
        allowed: Sequence[float] = (),
    ) -> Trial:
        """The short search of a candidate."""
        given = candidate.system, self.experiments, candidate.parameters, self._own_method
        return try_candidate(*given, window=self.length, near=near, known=known, allowed=allowed)

    def announce(self, action: str, name: str, done: int, count: int) -> None:
        """Say whose search begins."""
        if self.method.progress is not None:
            self.method.progress(f"{action} {name}, {done + 1} of {count} candidates")

    def with_window_of(self, fit: IdentificationResult) -> "_Alike":
        """The same with the window that a fit has needed, or whole logs; a fit whose states jump needs one, too."""
        if _has_jumps(fit, self.method):
            step = max(float(np.median(np.diff(e.trajectory.t))) for e in self.experiments)
            return replace(self, window=MIN_WINDOW_SAMPLES * step)
        return replace(self, window=fit.window.duration if fit.window else math.inf)


def _has_jumps(fit: IdentificationResult, method: LeastSquares) -> bool:
    """Whether gaps stand for noise of the states in a fit of whole logs."""
    return fit.window is None and fit.stats["gap_deviation"] > method.stages[-1].gap


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


def _candidate_rows(
    candidates: Mapping[str, System],
    found: Mapping[str, IdentificationResult | Refutation],
    predicted: Mapping[str, float],
) -> dict[str, _CandidateRow]:
    """A row for each candidate, the lowest BIC first, those that did not converge last."""
    fits = {n: fit for n, fit in found.items() if isinstance(fit, IdentificationResult)}
    best = min(predicted, key=lambda n: _chi_square(fits[n]))
    samples, inflation = _residual_count(fits[best]), fits[best].stats["variance_inflation"]
    scale = _chi_square(fits[best]) / max(1.0, samples - len(fits[best].estimates)) * inflation
    count = samples / inflation
    comparable = {n: fit for n, fit in found.items() if n in predicted or n not in fits}
    rows = {}
    for name, fit in found.items():
        k, deviance, inside, p, bic = len(_free_names(fit)), _chi_square(fit, fits) / scale, "", math.nan, math.nan
        if name in comparable:
            own, states = _free_names(fit), set(names(candidates[name].states))
            simpler = [
                n for n in comparable if _free_names(found[n]) < own and set(names(candidates[n].states)) <= states
            ]
            inside = max(simpler, key=lambda n: len(_free_names(found[n])), default="")
            bic = bayes_information(deviance, k, count)
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
            *_notes(candidates[name], fit),
        )
    return dict(sorted(rows.items(), key=lambda row: (not row[1].converged, row[1].bic)))


def _notes(system: System, fit: IdentificationResult | Refutation) -> tuple[str, str, str, str]:
    """Notes on what is unidentifiable, at a bound or unphysical, and the message."""
    if isinstance(fit, Refutation):
        return "", "", "", fit.reason
    widths = estimated_widths(fit.parameters)
    unknown, bound = (
        [str(n) for n, own in fit.estimates["note"].drop(widths).items() if own == note]
        for note in (UNIDENTIFIABLE_NOTE, AT_BOUND_NOTE)
    )
    order = system.identification_hints.at_least
    found = fit.parameters.select(n for n in fit.parameters if n not in unknown)
    below = [(n, m) for n, m in order.items() if n in found and m in found and found.value(n) < found.value(m)]
    unphysical = ", ".join(f"{n} ({found.value(n):.4g}) below {m} ({found.value(m):.4g})" for n, m in below)
    return ", ".join(unknown), ", ".join(bound), unphysical, fit.status.message


def _free_names(fit: IdentificationResult | Refutation) -> set[str]:
    return {*fit.free} if isinstance(fit, Refutation) else {str(n) for n in fit.estimates.index}


def _chi_square(
    fit: IdentificationResult | Refutation, fits: Mapping[str, IdentificationResult] = MappingProxyType({})
) -> float:
    """The sum of squared residuals, in variances of the declared noise; an estimate for a candidate that is refuted."""
    if isinstance(fit, Refutation):
        return fit.ratio * _chi_square(fits[fit.leader])
    return float(((fit.fit["rmse"] / fit.fit["noise"]) ** 2 * fit.fit["samples"]).sum())


def _residual_count(fit: IdentificationResult) -> float:
    return float(fit.fit["samples"].sum())


def _choose(rows: Mapping[str, _CandidateRow]) -> tuple[str, str]:
    """The recommended candidate, and why it comes before that of the lowest BIC; "" where it is that one."""
    sound = {n: row for n, row in rows.items() if row.is_sound} or {n: row for n, row in rows.items() if row.converged}
    lowest = next(iter(sound))
    tied = [n for n, row in sound.items() if row.bic - sound[lowest].bic < TIE]
    best = min(tied, key=lambda n: sound[n].held_out_nrmse)
    level = [n for n in tied if not sound[n].held_out_nrmse > MAX_HELD_OUT_RATIO * sound[best].held_out_nrmse]
    simplest = min(level, key=lambda n: sound[n].free)
    name, why = lowest, ""
    if sound[best].held_out_nrmse * MAX_HELD_OUT_RATIO < sound[lowest].held_out_nrmse:
        name, why = best, f"as held-out runs decide between it and {lowest}, whose BIC is within {TIE:g}"
    elif sound[simplest].free < sound[lowest].free:
        name = simplest
        why = f"as {lowest}, whose BIC is within {TIE:g}, has more parameters and predicts no better"
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


def _separate(
    rows: Mapping[str, _CandidateRow],
    chosen: str,
    fits: Mapping[str, IdentificationResult],
    systems: Mapping[str, System],
) -> str:
    """Words on what separates the chosen candidate from the next sound one, or would; "" where there is no other."""
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
    run = remedy(systems[max(other, chosen, key=lambda n: rows[n].free)].identification_hints, terms)
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
