"""`find_fit`: the best fit from the model's own starts, with the parameters held that logs cannot identify.

One table, `ATTEMPTS`, is the search: each row says where it suits, how it comes to fits, and when its last try is the
answer. They are made in their order until one is enough; `IdentificationResult.trail` shows what was tried.

    attempt              leads to
    first start          most answers, in one search
    excerpt              those of long logs, from their liveliest part
    prediction errors    those of drives that stick, from the best of many hypotheses that a filter follows
    tighter gaps         the optimum of a model that misses the logs by a little, as by the lag of a sensor
    noise of the states  the best that a model does which misses the logs, marked
    filtered states      those of rough starts, whose nodes would close slowly
    other starts         those of the guesses that the first start did not make

A parameter that the data do not determine is held at its given value: that needs no weight for a prior beside that of
the data, and the prior's spread is counted in the covariance of the others (`Fit.prior_covariance`). What each row is
worth is measured by problems/identify/ablation.py.

`fit_in_windows`: a plant that integrates adds up whatever its model misses: the position runs away from the log, and
the gaps of a fit that links its segments take the misfit in their place. In windows with a start state each the model
runs freely for a limited time only. Long windows gather what the model misses, short ones show little of slow terms:
the estimates of each length predict the parts of the logs that they have not seen, over horizons of all lengths
(cross-validation, by the jackknife's estimates without a part), and the longest within one standard error of the best
is taken, as Breiman et al. (Classification and Regression Trees, 1984) choose the simplest.
problems/identify/windows.py holds its estimates to the truth.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pneuopt.dynamics.compiled.rollout import check_during_runs
from pneuopt.dynamics.hooks import Start
from pneuopt.identification.identifiability import rejects_fixed_values, verdict_from_sensitivities
from pneuopt.identification.losses import Loss, fit_robustly, white_chi_square
from pneuopt.identification.misfit import (
    cluster_segments,
    degrees_of_freedom,
    diagnose_misfit,
    jackknife,
    t_quantile,
)
from pneuopt.identification.problem import EstimationProblem, outputs_in_log, window_runs
from pneuopt.identification.profiles import Profile
from pneuopt.identification.result import ChosenWindow, IdentificationResult, Mark, TrailRow
from pneuopt.identification.tolerances import (
    ACCEPTED_CHI_SQUARE_RATIO,
    ALIKE_SQUARES,
    BEST,
    CLEAR_DEVIATIONS,
    DECIDING,
    EXCERPT_SEGMENTS,
    GAP_FACTOR,
    GUESS_STAGES,
    HOPELESS_MISFIT,
    LEVELS,
    MAX_CLOSED_MISFIT,
    MAX_CLOSED_SHARE,
    MAX_COST,
    MAX_SEGMENTS,
    MAX_STAGES,
    MIN_DOUBTED,
    MIN_EXCESS,
    MIN_KNOWN_SHARE,
    MIN_LENGTH_RATIO,
    MIN_WINDOW_SAMPLES,
    MIN_WINDOWS,
    PART_SEGMENTS,
    REFIT_STAGES,
    SAME_COST_RATIO,
    WINDOW_FACTOR,
    WINDOW_ITERATIONS,
)
from pneuopt.identification.widths import estimated_widths
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.equations import NormalEquations, ParameterScaling, normal_equations
from pneuopt.shooting.filters import PredictionErrors, fit_scores
from pneuopt.shooting.least_squares import Fit, Optimum, SearchEnd, close_gaps, solve_least_squares
from pneuopt.shooting.segments import Segments, choose_integration, segment, start_nodes
from pneuopt.shooting.tolerances import MAX_CHI_SQUARE_RATIO, MAX_GAP_SHARE

if TYPE_CHECKING:
    import pandas as pd

Candidate = tuple[EstimationProblem, Fit, str]


class Tried(NamedTuple):
    """What one try of an attempt came to."""

    attempt: str
    problem: EstimationProblem  # with what it holds
    fit: Fit
    label: str  # of the start
    cpu_seconds: float


@dataclass(eq=False)
class Search:
    """A problem, how it is fitted, and what was tried so far, in that order.

    `gives_up` is called with the best fit so far: whether another start cannot help.
    """

    problem: EstimationProblem
    loss: Loss | None = None
    estimate_noise: bool = False
    gives_up: Callable[[EstimationProblem, Fit], bool] = lambda *_: False
    tried: list[Tried] = field(default_factory=list)

    @property
    def best(self) -> Tried:
        """The best try so far; of those that the logs do not tell apart, one with the fewest values at their bounds."""
        tightest = self.problem.method.stages[-1].gap
        first, *others = sorted(self.tried, key=lambda each: rank(each.fit, tightest))
        (order, cost), alike = rank(first.fit, tightest), [first]
        for place, other in ((rank(each.fit, tightest), each) for each in others):
            alike += [other] if place[0] == order and 2 * (place[1] - cost) <= ALIKE_SQUARES else []
        return min(alike, key=lambda each: int(each.fit.at_bound.sum()))

    @property
    def guesses(self) -> list[Start]:
        """The model's starts that try values of what the logs do not determine."""
        return [c for c in self.problem.candidates if c.trial_parameters]

    @property
    def has_guesses(self) -> bool:
        """Whether there is more than one guess, for which two starts at most are made."""
        return len(list(islice((c for c in self.problem.candidates if c.trial_parameters), 2))) > 1

    @property
    def trail(self) -> "pd.DataFrame":
        """A row a try, a `TrailRow`."""
        from pneuopt.quantities.frames import WideFrame

        rows = list[TrailRow]()
        for attempt, _, fit, label, seconds in self.tried:
            ratio = 2 * fit.stats["cost"] / max(1, fit.count)
            end = fit.status.code.value if fit.status.converged else fit.status.verdict
            rows.append(TrailRow(attempt, label, int(fit.stats["iterations"]), ratio, seconds, end))
        return WideFrame(rows, columns=TrailRow._fields)

    def add(self, attempt: str, candidate: Candidate, cpu_seconds: float) -> None:
        """Add a try, with the weights of a robust loss where there is one."""
        held, fit, label = candidate
        held, fit = fit_robustly(held, fit, self.loss, estimate_noise=self.estimate_noise)
        self.tried.append(Tried(attempt, held, fit, label, cpu_seconds))


class Attempt(NamedTuple):
    """A way to a fit: where it suits, and the fits to which it leads, one after the other."""

    name: str
    suits: Callable[[Search], bool]
    run: Callable[[Search], Iterator[Candidate]]
    is_enough: Callable[[Search], bool]  # whether its last try is the answer


def find_fit(search: Search) -> Tried:
    """Make one attempt after the other until one is the answer; else the best of all, with a status that says so."""
    interrupted = False
    try:
        for attempt, candidate, seconds in _attempts(search):
            search.add(attempt.name, candidate, seconds)
            if attempt.is_enough(search) or _is_beyond_help(search):
                break
    except KeyboardInterrupt:
        if not search.tried:
            raise
        interrupted = True
    best = search.best
    interrupted |= search.tried[-1].fit.status.code is Code.INTERRUPTED
    status = _status(search.problem, best.fit, len(search.tried), interrupted=interrupted)
    return best._replace(fit=replace(best.fit, status=status))


def _attempts(search: Search) -> Iterator[tuple[Attempt, Candidate, float]]:
    """The tries of all attempts that suit, with the CPU seconds of each."""
    for attempt in ATTEMPTS:
        if not attempt.suits(search):
            continue
        began = time.process_time()
        for candidate in attempt.run(search):
            yield attempt, candidate, time.process_time() - began
            began = time.process_time()


def _is_beyond_help(search: Search) -> bool:
    """Whether no other start can help: the search was interrupted, or a fixed value is what the logs reject."""
    best = search.best
    if search.tried[-1].fit.status.code is Code.INTERRUPTED:
        return True
    is_doubtful = best.fit.status.converged or len(search.tried) == MIN_DOUBTED
    return is_doubtful and search.gives_up(best.problem, best.fit)


def _is_at_noise(search: Search) -> bool:
    """Whether the last try explains the logs to their noise; the first of all holds nothing but widths."""
    last = search.tried[-1]
    lost = set(last.problem.fixed) - set(estimated_widths(search.problem.parameters))
    is_sure = len(search.tried) > 1 or (not lost and is_in_order(last.problem, last.fit))
    return is_sure and explains_to_noise(last.problem, last.fit)


def _has_converged(search: Search) -> bool:
    """Whether the last try converged."""
    return search.tried[-1].fit.status.converged


def _is_followed(search: Search) -> bool:
    """Whether the last try converged with tight gaps: it began at the best of many hypotheses."""
    return _has_converged(search) and search.tried[-1].fit.jumps is None


def _is_confirmed(search: Search) -> bool:
    """Whether two tries agree, or the last one explains the logs."""
    best, second = sorted((each.fit for each in search.tried), key=lambda fit: fit.stats["cost"])[:2]
    return are_alike(best, second) or _is_at_noise(search)


def _status(problem: EstimationProblem, fit: Fit, starts: int, *, interrupted: bool) -> Status:
    """The status of the best fit of several starts."""
    status = fit.status
    if interrupted and (starts > 1 or status.code is not Code.INTERRUPTED):
        status = Status(Code.INTERRUPTED, (f"the best of {starts} starts so far", "run again for an answer"))
    elif not status.converged and starts > 1:
        in_the_best = (f"in the best, {status.verdict}", *status.sentences[1:])
        status = Status(status.code, (f"none of {starts} starts converged", *in_the_best))
    if len(problem.experiments) > 1:
        status = status.with_remedies("compare_logs shows whether the logs are of one drive")
    return status


def _from_first_start(search: Search) -> Iterator[Candidate]:
    """The model's first start, left after its first stage where that is far from the logs and others are to come."""
    problem, start = search.problem, search.problem.candidates[0]
    may_wait = search.loss is None and problem.has_gaps and search.has_guesses
    allows = problem.method.allows_state_noise and not may_wait  # with other starts to come, these are tried before
    tried = replace(problem, method=replace(problem.method, allows_state_noise=allows))
    held, fit = fit_fixing_unidentifiable(tried, start, HOPELESS_MISFIT if may_wait else math.inf)
    yield replace(held, method=problem.method), fit, start.label


def _from_other_starts(search: Search) -> Iterator[Candidate]:
    """The other starts, with guesses held for a few stages; the least cost first."""
    problem, candidates = search.problem, search.problem.candidates
    guessed = search.guesses if search.has_guesses else []
    settled = sorted((_settle_start(problem, c) for c in guessed), key=lambda each: each[0])
    for start in [*(start for _, start in settled), *(c for c in candidates[1:] if c not in guessed)]:
        known = search.best.fit.stage_costs if is_optimum(search.best.fit) else ()
        tried = replace(problem, method=replace(problem.method, allows_state_noise=False))
        held, fit = fit_fixing_unidentifiable(tried, start, math.inf, known)
        if fit.end is SearchEnd.DUPLICATE:
            return
        yield replace(held, method=problem.method), fit, start.label


def _from_tighter_gaps(search: Search) -> Iterator[Candidate]:
    """The best fit with tighter gaps, where it is an optimum whose gaps absorb what the model misses by a little.

    None where they lead to no optimum, or to residuals so large that the model does not follow the logs.
    """
    best, problem = search.best, search.problem
    found, stage = best.fit, replace(problem.method.stages[-1], refine=1)  # steps are refined where it has converged
    for _ in range(MAX_STAGES if found.stats["gap_share"] < MAX_CLOSED_SHARE else 0):
        if not (is_optimum(found) and 2 * found.stats["cost"] <= MAX_CLOSED_MISFIT * found.count):
            return
        stage = replace(stage, gap=GAP_FACTOR * stage.gap)
        method = replace(problem.method, stages=(stage,), allows_state_noise=False)
        before, found = found, solve_least_squares(best.problem.transcription(problem.start_from(found)), method)
        found = found.with_effort_of(before)
        if found.status.converged:
            yield best.problem, found, f"{best.label}, tighter gaps"
            return


def _from_state_noise(search: Search) -> Iterator[Candidate]:
    """The fit in which gaps stand for noise of the states, from the best one so far."""
    best, problem = search.best, search.problem
    held, fit = fit_fixing_unidentifiable(problem, problem.start_from(best.fit))
    yield held, fit, f"{best.label}, noise of the states"


def _settle_start(
    problem: EstimationProblem, candidate: Start, width: float = 1e-9
) -> tuple[tuple[float, float], Start]:
    """The cost of a start after some stages with its guesses held, and the start from there.

    Wider gaps cost less, which says nothing: they rank behind. Bounds of some `width` [1] hold a guess, for equal ones
    would compile other equations; with noise of the states a wrong guess would explain any log.
    """
    transcription = problem.transcription(candidate)
    guesses = {n: candidate.parameters[n] for n in candidate.trial_parameters}
    bounds = {n: (v - width * abs(v), v + width * abs(v)) for n, v in guesses.items()}
    held = replace(transcription, parameters=transcription.parameters.with_bounds(bounds))
    stages = problem.method.stages[: GUESS_STAGES if problem.has_gaps else 1]
    method = replace(problem.method, stages=stages, allows_state_noise=False)
    fit = solve_least_squares(held, method)
    if fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    start = problem.start_from(fit, f"{candidate.label}, settled")
    return (fit.stats["gap_deviation"], fit.stats["cost"]), replace(start, parameters={**start.parameters, **guesses})


def fit_fixing_unidentifiable(
    problem: EstimationProblem,
    start: Start,
    max_misfit: float = math.inf,
    known_costs: tuple[tuple[float, float], ...] = (),
) -> tuple[EstimationProblem, Fit]:
    """Fit from one start; while the data do not determine a parameter, hold that one and fit again.

    It is held at its given value, or, if the logs reject that, where the search had left it.
    """
    method = replace(problem.method, max_misfit=max_misfit, known_costs=known_costs)
    first = solve_least_squares(problem.transcription(start), method)
    is_left = first.status.code is Code.INTERRUPTED or 2 * first.stats["cost"] > max_misfit * first.count
    if is_left or not _open_names(problem, first):
        return problem, first
    loose = () if first.unidentifiable else _loose_widths(problem, first)
    for is_given in (True, False) if not first.status.converged else (True,):
        held, fit = _hold_unidentifiable(problem, start.label, first, is_given=is_given)
        is_settled = fit.status.converged and not fit.unidentifiable
        is_taken = is_settled and (bool(loose) or not rejects_fixed_values(fit, first, len(held.fixed)))
        if fit.status.code is Code.INTERRUPTED or is_taken:
            return held, fit
    return problem, first


def _open_names(problem: EstimationProblem, fit: Fit) -> tuple[str, ...]:
    """The parameters to hold: those that the data do not determine, or widths that keep a search from settling."""
    return fit.unidentifiable or _loose_widths(problem, fit)


def _loose_widths(problem: EstimationProblem, fit: Fit) -> tuple[str, ...]:
    """The estimated widths that still move, or at whose lower bound the kinks of the law keep others moving.

    A width is not what a fit is made for: with it held, the others have their answer.
    """
    if not fit.unsettled:
        return ()
    free, widths = fit.parameters.free_names, estimated_widths(problem.parameters)
    sharp = [n for n in widths if n in free and fit.at_bound[free.index(n)]]
    return tuple(n for n in widths if n in fit.unsettled or n in sharp if n not in problem.fixed)


def _hold_unidentifiable(
    problem: EstimationProblem, label: str, first: Fit, *, is_given: bool
) -> tuple[EstimationProblem, Fit]:
    """Hold one undetermined parameter after the other, at its given value or where the first fit has left it."""
    held, fit, given = problem, first, problem.unknowns()
    worst = HOPELESS_MISFIT * max(1.0, 2 * first.stats["cost"] / max(1, first.count))
    warm = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:], max_misfit=worst)
    source = given if is_given else first.parameters
    while (names := _open_names(held, fit)) and len(held.fixed) + len(names) < len(given.free_names):
        held = replace(held, fixed={**held.fixed, **{n: source.value(n) for n in names}})
        before, fit = fit, solve_least_squares(held.transcription(held.start_from(fit, label)), warm)
        fit = fit.with_effort_of(before)
        if fit.status.code in (Code.INTERRUPTED, Code.DIVERGED) or 2 * fit.stats["cost"] > worst * fit.count:
            break
    return held, fit


def explains_to_noise(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether a fit explains the logs to their noise, so that no other start can do better.

    Where a log declares too little noise, the white part of the residuals counts in its place.
    """
    return fit.status.converged and is_at_noise(problem, fit)


def is_at_noise(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether the residuals of a fit, converged or not, are those of the noise."""
    return fit.jumps is None and (
        fit.chi_square <= ACCEPTED_CHI_SQUARE_RATIO * fit.count
        or fit.chi_square <= ACCEPTED_CHI_SQUARE_RATIO * white_chi_square(problem, fit)
    )


def is_optimum(fit: Fit) -> bool:
    """Whether a search ended at an optimum, be it of a model so wrong that the gaps absorb its misfit."""
    is_settled = not (fit.unsettled or fit.unidentifiable)
    is_missed = fit.status.code is Code.NOT_CONVERGED and is_settled and fit.stats["gap_share"] > MAX_GAP_SHARE
    is_missed &= fit.end is not SearchEnd.ABANDONED
    return fit.status.converged or is_missed


def is_in_order(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether each free parameter that another one bounds is clearly above it, as static friction above Coulomb's.

    Else a search may have lost it: one ended so at the noise, its Stribeck velocity 13 times too high.
    """
    order, found = problem.system.plant.identification_hints.at_least, fit.parameters
    bounded = [n for n in found.free_names if n not in problem.fixed and order.get(n) in found]
    return all(found.value(n) >= (1 + MIN_EXCESS) * found.value(order[n]) for n in bounded)


def rank(fit: Fit, tightest: float) -> tuple[int, float]:
    """The order of fits: by cost; after optima that explain the log come others, state noise, misfits, wide gaps."""
    cost = fit.stats["cost"]
    is_cut = fit.end is SearchEnd.ABANDONED or fit.status.code is Code.INTERRUPTED
    if is_cut and fit.stats["gap_deviation"] > tightest:
        return 4, cost
    if fit.jumps is not None:
        return 2, cost
    if 2 * cost > MAX_CHI_SQUARE_RATIO * fit.count:
        return 3, cost
    return (0 if fit.status.converged else 1), cost


def are_alike(best: Fit, second: Fit) -> bool:
    """Whether both ended at an optimum, at the same cost."""
    same = is_optimum(best) and is_optimum(second) and (best.jumps is None) == (second.jumps is None)
    return same and second.stats["cost"] <= SAME_COST_RATIO * best.stats["cost"]


def _from_excerpt(search: Search) -> Iterator[Candidate]:
    """The whole logs from the answer of their liveliest parts, with the states filtered by its parameters."""
    problem, parts = search.problem, cut_excerpts(search.problem)
    if parts is None:
        return
    found = find_fit(Search(parts, gives_up=search.gives_up))
    if found.fit.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    tight = replace(problem, method=replace(problem.method, stages=problem.method.stages[-1:]))
    rough = replace(problem.candidates[0], parameters=parts.start_from(found.fit).parameters)
    held, fit = fit_fixing_unidentifiable(
        tight, tight.filter_states(rough, tight.method.stages[-1].gap), HOPELESS_MISFIT
    )
    yield replace(held, method=problem.method), fit, f"{found.label}, of a part"


def _from_filtered(search: Search) -> Iterator[Candidate]:
    """The fit with tight gaps from states filtered by the parameters of wide ones, whose nodes would close slowly."""
    problem, rough, stages = search.problem, search.problem.candidates[0], search.problem.method.stages
    wide = replace(problem.method, stages=stages[:GUESS_STAGES:2], allows_state_noise=False)
    settled = solve_least_squares(problem.transcription(problem.filter_states(rough)), wide)
    if settled.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    if not 2 * settled.stats["cost"] <= MAX_CHI_SQUARE_RATIO * settled.count:
        return
    tight = replace(problem, method=replace(problem.method, stages=stages[-1:], allows_state_noise=False))
    start = tight.filter_states(replace(rough, parameters=problem.start_from(settled).parameters))
    held, fit = fit_fixing_unidentifiable(tight, start, HOPELESS_MISFIT)
    yield replace(held, method=problem.method), fit.with_effort_of(settled), f"{rough.label}, filtered"


def cut_excerpts(problem: EstimationProblem) -> EstimationProblem | None:
    """The problem with its liveliest part in place of each long log."""
    if math.isfinite(problem.window) or not problem.has_gaps or len(problem.candidates) < 2:
        return None
    if not problem.system.states or any(e.holes for e in problem.experiments) or problem.weights:
        return None
    parts = []
    for e in problem.experiments:
        run, step, part = e.trajectory, float(np.median(np.diff(e.trajectory.t))), e
        count = math.ceil(EXCERPT_SEGMENTS * max(problem.method.segment_time, step) / step)
        if len(run) >= MIN_LENGTH_RATIO * count:
            columns = [run.fill_gaps(name) for name in outputs_in_log(problem.system, e)]
            begin = liveliest_part(np.column_stack(columns), count)
            part = replace(e, trajectory=run.rows(begin, begin + count), source=None)
        parts.append(part)
    whole, kept = (sum(len(e.trajectory) for e in each) for each in (problem.experiments, parts))
    is_huge = sum(e.trajectory.duration for e in problem.experiments) > MAX_SEGMENTS * problem.method.segment_time
    return replace(problem, experiments=tuple(parts)) if whole >= MIN_LENGTH_RATIO * kept and not is_huge else None


def liveliest_part(columns: Array, count: int) -> int:
    """The first row of the part of so many rows with the largest product of the columns' variances.

    A product, for a part in which one output hardly moves shows no friction, however much the others do.
    """
    flat = columns.reshape(len(columns), -1, columns.shape[-1])
    known = np.isfinite(flat)
    # about the mean of all rows and over their spread, sums of squares lose no digits that count
    middle = np.where(known, flat, 0.0).sum(axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)), 1)
    centred = np.where(known, flat - middle, 0.0)
    scaled = centred / np.maximum(np.abs(centred).max(axis=(0, 1)), np.finfo(float).tiny)
    first = np.arange(0, max(1, len(columns) - count + 1), max(1, count // 10))
    last = np.minimum(first + count, len(columns))
    sums = [np.cumsum(np.insert(part.sum(axis=1), 0, 0.0, axis=0), axis=0) for part in (known, scaled, scaled**2)]
    counts, totals, squares = (each[last] - each[first] for each in sums)
    counts = np.maximum(counts, 1)
    variances = np.maximum(squares / counts - (totals / counts) ** 2, np.finfo(float).eps)
    return int(first[np.argmax(np.log(variances).sum(axis=1))])


# a parameter over the one that bounds it [1]: finer and wider ones cost time, others miss the valley
RATIOS = np.geomspace(1.1, 2.4, 8)


def _order_of_unknowns(problem: EstimationProblem) -> dict[str, str]:
    """The free parameters that another free one bounds from below, as Coulomb friction bounds static friction."""
    free = set(problem.parameters.free_names) - set(problem.fixed)
    order = problem.system.plant.identification_hints.at_least
    return {n: m for n, m in order.items() if n in free and m in free}


def _can_predict(search: Search) -> bool:
    """Whether a filter can follow the logs from segment to segment, and there is something for it to decide."""
    problem = search.problem
    is_whole = problem.has_gaps and not np.isfinite(problem.window) and not any(e.holes for e in problem.experiments)
    is_plain = is_whole and bool(problem.system.states) and not problem.weights and search.loss is None
    return is_plain and bool(_order_of_unknowns(problem)) and search.has_guesses


def _from_predictions(search: Search) -> Iterator[Candidate]:
    """The fit with tight gaps from where the prediction errors of a filter lead; none where no guess predicts."""
    problem, guesses = search.problem, search.guesses
    segments = segment(problem.transcription(guesses[0]))
    scaling = ParameterScaling(segments.transcription)
    with check_during_runs(problem.method.budget.check):
        errors = PredictionErrors(segments, start_nodes(segments), scaling, _liveliest(segments, problem))
        z = _best_sets(errors, list(_hypotheses(guesses, _order_of_unknowns(problem))), problem)
        for gathered, steps, count in LEVELS:
            if problem.method.progress is not None:
                problem.method.progress(f"prediction errors, states may gather {gathered:g} of their nominal size")
            z, costs = errors.descend(z, gathered, steps)
            if gathered >= DECIDING and not costs.min() < MAX_COST * errors.count:
                return
            z = z[np.argsort(costs)[:count]]
    values = scaling.values(z[0])
    named = dict(zip(segments.transcription.parameters, values.tolist(), strict=True))
    found = {n: named[n] for n in segments.transcription.parameters.free_names}
    last = problem.method.stages[-1:]
    tight = replace(problem, method=replace(problem.method, stages=last, allows_state_noise=False))
    start = replace(guesses[0], parameters={**guesses[0].parameters, **found}, label="prediction errors")
    held, fit = fit_fixing_unidentifiable(tight, tight.filter_states(start, last[-1].gap), HOPELESS_MISFIT)
    yield replace(held, method=problem.method), fit, "prediction errors"


def _hypotheses(guesses: Sequence[Start], bounded: dict[str, str]) -> Iterator[tuple[tuple[int, int], Start]]:
    """The guesses with each ratio, and the place of both."""
    order = sorted(guesses, key=lambda c: [c.parameters[n] for n in c.trial_parameters])
    for (i, guess), (j, ratio) in product(enumerate(order), enumerate(RATIOS.tolist())):
        raised = {n: ratio * guess.parameters[m] for n, m in bounded.items()}
        yield (i, j), replace(guess, parameters={**guess.parameters, **raised})


def _best_sets(
    errors: PredictionErrors, hypotheses: Sequence[tuple[tuple[int, int], Start]], problem: EstimationProblem
) -> Array:
    """The searched parameters of the best hypotheses, of which no two are neighbours. Shape (at most BEST, k)."""
    z = np.array([ParameterScaling(problem.transcription(start)).start for _, start in hypotheses])
    chosen = list[int]()
    for k in np.argsort(errors.evaluate(z, LEVELS[0][0]).costs).tolist():
        away = [np.abs(np.subtract(hypotheses[k][0], hypotheses[other][0])).max() for other in chosen]
        if len(chosen) < BEST and min(away, default=2) > 1:
            chosen.append(k)
    return z[chosen]


def _liveliest(segments: Segments, problem: EstimationProblem) -> Indices:
    """The liveliest consecutive segments of each log."""
    count, parts = max(1, PART_SEGMENTS // len(problem.experiments)), list[Indices]()
    for phase in range(len(problem.experiments)):
        own = np.flatnonzero(segments.phase == phase)
        begin = liveliest_part(segments.measured[own], count)
        parts.append(own[begin : begin + count])
    return np.concatenate(parts)


def _is_long(search: Search) -> bool:
    """Whether a part of the logs may be enough to find where the answer is."""
    return search.loss is None and not search.estimate_noise and cut_excerpts(search.problem) is not None


def _has_filter(search: Search) -> bool:
    """Whether states can be filtered along whole logs that a model follows with gaps."""
    problem = search.problem
    is_whole = problem.has_gaps and math.isinf(problem.window) and not any(e.holes for e in problem.experiments)
    return is_whole and bool(problem.system.states) and search.loss is None and not problem.weights


def _gaps_absorb_misfit(search: Search) -> bool:
    """Whether gaps absorb what the model misses in the best fit."""
    fit = search.best.fit
    return not fit.status.converged and fit.stats["gap_share"] > MAX_GAP_SHARE


def _allows_state_noise(search: Search) -> bool:
    """Whether gaps absorb what the model misses, and may stand for noise of its states."""
    return search.problem.method.allows_state_noise and _gaps_absorb_misfit(search)


ATTEMPTS: tuple[Attempt, ...] = (
    Attempt("first start", lambda _: True, _from_first_start, _is_at_noise),
    Attempt("excerpt", _is_long, _from_excerpt, _is_at_noise),
    Attempt("prediction errors", _can_predict, _from_predictions, _is_followed),
    Attempt("tighter gaps", _gaps_absorb_misfit, _from_tighter_gaps, _is_followed),
    Attempt("noise of the states", _allows_state_noise, _from_state_noise, _has_converged),
    Attempt("filtered states", _has_filter, _from_filtered, _is_at_noise),
    Attempt("other starts", lambda search: len(search.problem.candidates) > 1, _from_other_starts, _is_confirmed),
)
"""In their order: what leads to the answer most often, for the least, comes first."""


def fit_from_profiles(problem: EstimationProblem, fit: Fit, profiles: Iterable[Profile]) -> Fit | None:
    """The fit that begins with the best values of the first profile whose interval does not hold the estimate.

    None where every estimate lies in its interval; the given fit, not converged, where no better one is found.
    """
    found = next((p for p in profiles if not p.low <= p.estimate <= p.high), None)
    if found is None:
        return None
    start, best = problem.start_from(fit), found.curve.sort_values("deviance").iloc[0]
    value = float(best["value"])
    values = {n: float(best[n]) for n in start.parameters if n != found.name} | {found.name: value}
    method = replace(problem.method, stages=problem.method.stages[-REFIT_STAGES:])
    start = replace(start, parameters={**start.parameters, **values})
    better = solve_least_squares(problem.transcription(start), method).with_effort_of(fit)
    is_better = better.stats["cost"] < fit.stats["cost"]
    if better.status.code is Code.INTERRUPTED:
        return better if is_better else replace(fit, status=better.status)
    if is_better and better.status.converged:
        return better
    verdict = f"{found.name} fits better at {value:.4g} {found.unit}, from where the search finds no better optimum"
    return replace(fit, status=Status(Code.NOT_CONVERGED, (verdict, "try other start values, or fix a parameter")))


def enforce_ordering(problem: EstimationProblem, fit: Fit, label: str) -> tuple[EstimationProblem, Fit]:
    """Hold parameters that no plant has below another one at that one's value, where the logs do not show them."""
    found, bound = fit.parameters, dict(zip(fit.parameters.free_names, fit.at_bound, strict=True))
    order = problem.system.plant.identification_hints.at_least
    below = {n: m for n, m in order.items() if bound.get(n) or n in problem.fixed}
    given = problem.unknowns()
    known = {n: m for n, m in below.items() if m in found and found.value(n) < found.value(m) <= given[n].upper}
    values = {n: found.value(m) for n, m in known.items()}
    if not values or not fit.status.converged:
        return problem, fit
    start = problem.start_from(fit, label)
    start = replace(start, parameters={**start.parameters, **values})
    begun = given.with_values(start.parameters)
    unseen = {n: begun.value(n) for n in verdict_from_sensitivities(problem, start).unidentifiable}
    ordered = replace(problem, fixed={**problem.fixed, **unseen, **values})
    if len(ordered.fixed) >= len(found.free_names):
        return problem, fit
    held, other = fit_fixing_unidentifiable(ordered, start)
    settled = other.status.converged and not other.unidentifiable and (other.jumps is None or fit.jumps is not None)
    rejected = not settled or rejects_fixed_values(other, fit, len(held.fixed))
    return (problem, fit) if rejected else (held, other.with_effort_of(fit))


def mark_order(problem: EstimationProblem, result: IdentificationResult) -> IdentificationResult:
    """Mark estimates that the logs put below another one beyond chance, though no plant has them there."""
    estimates, status = result.estimates.copy(), result.status
    for low, high in problem.system.plant.identification_hints.at_least.items():
        if low not in estimates.index:
            continue
        names = [n for n in (low, high) if n in estimates.index]
        signs = np.array([1.0 if n == high else -1.0 for n in names])
        variance = float(signs @ result.covariance.loc[names, names].to_numpy() @ signs)
        below = result.parameters.value(high) - float(result.estimates["value"][low])
        if variance >= 0 and below > CLEAR_DEVIATIONS * math.sqrt(variance):
            estimates.loc[names, "mark"] = Mark.BIAS_POSSIBLE
            estimates.loc[names, "bias"] = estimates.loc[names, "bias"].clip(lower=below)
            words = f"{low} is below {high}, which no drive has: model error, both may be biased"
            status = status.with_details(words)
    return replace(result, estimates=estimates, status=status)


Windowed = tuple[EstimationProblem, Fit, ChosenWindow]


def check_window(problem: EstimationProblem) -> None:
    """Refuse a window of fewer than two samples, longer than every log, or in a loop whose controller goes on."""
    if problem.window == math.inf:
        return
    logs = [e.trajectory for e in problem.experiments]
    step = max(float(np.median(np.diff(log.t))) for log in logs)
    n, longest = round(problem.window / step), max(len(log) for log in logs)
    require(
        2 <= n <= longest,
        f"windows of {problem.window:g} s hold {n} samples of {problem.experiments[0].name}, which has {len(logs[0])}, "
        f"one every {step:g} s; choose between {2 * step:g} and {longest * step:g} s",
    )
    message = "a sampled controller goes on from window to window; leave the window out"
    require(problem.system.motion().sample_time is None, message, InputError)


def fit_in_windows(problem: EstimationProblem, fit: Fit) -> Windowed | None:
    """The fit in the longest windows that predict as well as any; None unless whole logs failed by their gaps."""
    absorbed = fit.stats["gap_share"] > MAX_GAP_SHARE and math.isfinite(fit.stats["cost"])
    can_cut = not problem.is_whole and bool(problem.system.states) and problem.system.motion().sample_time is None
    if not (fit.status.code is Code.NOT_CONVERGED and absorbed and can_cut):
        return None
    lengths = [problem.window] if math.isfinite(problem.window) else _lengths(problem)
    trials, start, iterations = list[_WindowTrial](), problem.start_from(fit), 2 * WINDOW_ITERATIONS
    for length in reversed(lengths):
        trials.append(_try_length(problem, start, length, iterations))
        if trials[-1].fit.status.code is Code.INTERRUPTED:
            break
        start, iterations = trials[-1].problem.start_from(trials[-1].fit), WINDOW_ITERATIONS
    found = [trial for trial in trials if trial.fit.status.converged]
    while found:
        best = found[-1] if len(found) == 1 or trials[-1].fit.status.code is Code.INTERRUPTED else _choose(found)
        if best.is_answer:
            window = ChosenWindow(best.length, lengths[0], lengths[-1], fit.stats["gap_share"])
            return best.problem, best.fit.with_effort_of(fit), window
        found.remove(best)
    return None


def run_freely(problem: EstimationProblem, fit: Fit, window: float = math.inf) -> tuple[Trajectory, ...]:
    """Each log simulated from its fitted start to its end without gaps; only a hole in its inputs starts anew.

    And so does each window of a finite time, from the fitted state. Not finite where the model diverges.
    """
    if not problem.system.states:
        return fit.trajectories
    is_whole = math.isinf(window) and math.isinf(problem.window)
    if is_whole and fit.optimum is not None and (y := close_gaps(fit.optimum)) is not None:
        return fit.optimum.equations.segments.output_trajectories(y)
    whole = replace(problem, window=window, method=replace(problem.method, segment_time=window))
    segments = segment(whole.transcription(whole.start_from(fit)))
    nodes, q = start_nodes(segments), np.array([p.value for p in segments.transcription.parameters.values()])
    segments, substeps = choose_integration(segments, nodes, q, int(fit.stats["substeps"]))
    return segments.trajectories(segments.run(nodes, q, substeps, states=True))


class _WindowTrial(NamedTuple):
    """The fit in windows of one length."""

    length: float
    problem: EstimationProblem
    fit: Fit

    @property
    def is_answer(self) -> bool:
        """Whether it determines most parameters to better than their own size."""
        freedom, free = degrees_of_freedom(self.problem, self.fit), self.fit.parameters.free_names
        misfit = diagnose_misfit(self.problem, self.fit, self.fit.chi_square / freedom, freedom)
        if misfit.covariance is None:
            return not free
        variances = np.diag(misfit.covariance)
        halves = t_quantile(misfit.dof) * np.sqrt(np.maximum(variances, 0.0))
        sizes = np.abs([self.fit.parameters.value(n) for n in free])
        return not free or float(np.mean((variances > 0) & (halves < sizes))) > MIN_KNOWN_SHARE

    def predict(self, horizons: Sequence[float]) -> Array:
        """Squared errors over each horizon (n_horizons, K) of each part of the logs, by the estimates without it.

        To first order; a part is as long as the longest horizon. Infinite where the logs leave a parameter open.
        """
        optimum, errors, longest = self.fit.optimum, list[Array](), max(horizons)
        scores = optimum and fit_scores(optimum)
        if not (optimum and scores):
            return np.full((len(horizons), 1), math.inf)
        without = jackknife(cluster_segments(scores, self._parts(optimum, longest))).changes
        for horizon in horizons:
            seen = optimum if horizon == self.length else replace(optimum, equations=self._linearise(horizon, optimum))
            reduced = seen.equations.arrow.eliminate(0.0) if math.isfinite(seen.equations.cost) else None
            found, parts = reduced and fit_scores(seen), self._parts(seen, longest)
            if not (found and reduced):
                return np.full((len(horizons), 1), math.inf)
            own = cluster_segments(found, parts)
            start = seen.equations.arrow.node_gradient * reduced.nodes  # what the start states can still explain
            squares = np.bincount(parts, seen.equations.linearisation.squares.sum(axis=1) + start.sum(axis=1))
            changed = np.einsum("gi,gi->g", 2 * own.scores + np.einsum("gij,gj->gi", own.information, without), without)
            errors.append(squares + changed)
        return np.array(errors)

    def _linearise(self, horizon: float, optimum: Optimum) -> NormalEquations:
        """The equations of windows of another length at these estimates, one step of the start states from this fit."""
        cut = replace(self.problem, window=horizon, method=replace(self.problem.method, segment_time=horizon))
        segments = segment(cut.transcription(cut.start_from(self.fit)))
        scaling, nodes = ParameterScaling(segments.transcription), start_nodes(segments)
        q, rest = scaling.values(scaling.start), (scaling.chain(scaling.start), optimum.gap_deviations)
        segments, substeps = choose_integration(segments, nodes, q, int(self.fit.stats["substeps"]))
        with np.errstate(all="ignore"):
            first = normal_equations(segments, nodes, q, *rest, substeps)
            step = first.arrow.eliminate(0.0)
            if step is None:
                return first
            return normal_equations(segments, nodes + step.nodes * segments.nominal, q, *rest, substeps)

    def _parts(self, optimum: Optimum, length: float) -> Indices:
        """The part of the logs, a window of a length, in which each segment begins, shape (m,)."""
        segments, found, count = optimum.equations.segments, list[Indices](), 0
        for phase, log in enumerate(self.problem.experiments):
            begins = log.trajectory.t[[begin for begin, _ in window_runs(log, length)]]
            found.append(count - 1 + np.searchsorted(begins, segments.t[segments.phase == phase, 0], "right"))
            count += len(begins)
        return np.concatenate(found)


def _choose(trials: Sequence[_WindowTrial]) -> _WindowTrial:
    """The longest windows, of these from the longest on, that predict within one standard error of the best.

    Errors over all horizons count alike, by the logarithms of their sums.
    """
    errors = [trial.predict([trial.length for trial in trials]) for trial in trials]
    sums = [each.sum(axis=1) for each in errors]  # not positive where first order is no guide
    levels = [float(np.log(np.where(each > 0, each, math.inf)).sum()) for each in sums]
    best = int(np.argmin(levels))
    for trial, each, level in zip(trials, errors, levels, strict=True):
        if math.isfinite(level):
            shares = each / each.sum(axis=1, keepdims=True) - errors[best] / errors[best].sum(axis=1, keepdims=True)
            parts = shares.sum(axis=0)  # they sum to zero
            if level - levels[best] <= math.sqrt(parts.size) * float(np.std(parts, ddof=1)):
                return trial
    return trials[-1]


def _lengths(problem: EstimationProblem) -> list[float]:
    """Lengths of windows to try, the shortest first; at least one [s]."""
    shortest, total = 0.0, 0.0
    for e in problem.experiments:
        known = np.isfinite(e.trajectory.matrix(outputs_in_log(problem.system, e))).any(axis=1)
        shortest = max(shortest, MIN_WINDOW_SAMPLES * e.trajectory.duration / max(1, int(known.sum())))
        total += e.trajectory.duration
    longest = max(shortest, total / MIN_WINDOWS)
    count = 1 + math.ceil(math.log(longest / shortest) / math.log(WINDOW_FACTOR))
    return [float(length) for length in np.geomspace(shortest, longest, count)]


def _try_length(problem: EstimationProblem, start: Start, length: float, iterations: int) -> _WindowTrial:
    """The fit in windows of one length, a segment each."""
    # without gaps all stages are alike; steps are refined where the search has converged
    last = replace(problem.method.stages[-1], refine=1, iterations=iterations)
    cut = replace(problem, window=length, method=replace(problem.method, segment_time=length, stages=(last,)))
    held, found = fit_fixing_unidentifiable(cut, start)
    return _WindowTrial(length, replace(held, method=replace(held.method, stages=problem.method.stages)), found)
