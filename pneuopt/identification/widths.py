"""`choose_widths`: the widths over which a model rounds its kinks, chosen by the logs before the search.

Friction's sign and a valve's edges are sharp; a model rounds them, for its integration. Which width serves depends on
the log: a wide one creeps where the drive sticks and hides a dead zone, a narrow one takes many integration steps. So
each width that nobody has stated is narrowed, or else widened, as long as that lowers the cost of a short search with
loose gaps (problems/identify/foreign_rig.py); a search that narrows on its way would stay in the wide one's optimum. A
wider one must explain the logs, or it would take a missing term's place (problems/identify/seal_friction.py).
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from math import inf, sqrt

import numpy as np

from pneuopt.dynamics.hooks import Width
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.identification.problem import EstimationProblem, known_runs
from pneuopt.identification.result import ChosenWidth
from pneuopt.identification.tolerances import (
    CONFIRMING_STAGES,
    FORESEEN_RATIO,
    MAX_HIDING_SHARE,
    MAX_TRIAL_SAMPLES,
    MIN_RELATIVE_FALL,
    MODEL_ERROR_LEVEL,
    SIGNIFICANT_FALL,
)
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.shooting.equations import weigh_gaps
from pneuopt.shooting.least_squares import BudgetSpentError, LeastSquares, Stage, solve_least_squares
from pneuopt.shooting.segments import choose_integration, segment, stable_substeps, start_nodes
from pneuopt.shooting.tolerances import MAX_SEARCH_SUBSTEPS
from pneuopt.shooting.transcription import Transcription

CHOSEN_WIDTH = "chosen by identify from the logs"
"""Source of a width that `choose_widths` has set."""

COMMON_WIDTH = "common to all candidates"
"""Source of a width that is the same in all candidates of a selection."""

# gaps and iterations of a trial: with tighter gaps, or more iterations, it takes as long as a search; with looser gaps,
# or fewer, a wrong width looks as good as a right one
TRIAL_STAGE = Stage(3e-3, 6)


def choose_widths(problem: EstimationProblem) -> tuple[EstimationProblem, tuple[ChosenWidth, ...]]:
    """Choose the widths that nobody has stated."""
    open_names = {n for w in _present(problem) if _is_open(problem, w.name) for n in _names(w) if _is_open(problem, n)}
    if not open_names:
        return problem, ()
    given = problem.parameters
    try:
        best, too_stiff = _race_widths(problem, open_names)
    except BudgetSpentError:
        return problem, ()
    edits = {n: replace(given[n], value=v, source=CHOSEN_WIDTH) for n, v in best.widths.items() if v != given.value(n)}
    chosen = (ChosenWidth(n, v, given[n].unit, given.value(n), n in too_stiff) for n, v in best.widths.items())
    return replace(problem, parameters=given | ParameterSet(edits)), tuple(chosen)


def advise_widths(problem: EstimationProblem) -> tuple[str, ...]:
    """Better values for the widths that the user has stated, by short searches; empty if the CPU budget ends before."""
    given = problem.parameters
    known = [w.name for w in _present(problem) if given[w.name].source != COMMON_WIDTH]
    stated = {n for n in known if not given[n].free and not _is_open(problem, n)}
    if not stated:
        return ()
    try:
        found = _race_widths(problem, stated)[0].widths
    except BudgetSpentError:
        return ()
    reason = "a short search then follows the logs better; left out, it is chosen by the logs"
    return tuple(
        f"try {n} = {v:.3g} {given[n].unit} in place of {given.value(n):g} {given[n].unit}: {reason}"
        for n, v in found.items()
        if v != given.value(n)
    )


@dataclass(frozen=True, eq=False)
class _WidthTrial:
    """A short search with some widths: its cost, that foreseen with the gaps that confirm a width, what it found."""

    widths: dict[str, float]
    cost: float
    foreseen: float
    count: int
    parameters: ParameterSet
    too_stiff: bool

    def is_better_than(self, other: "_WidthTrial") -> bool:
        """Whether the cost is lower beyond chance."""
        if not self.cost < inf:
            return False
        return other.cost - self.cost > self.significant_fall

    @property
    def significant_fall(self) -> float:
        return max(0.5 * SIGNIFICANT_FALL * max(1.0, self.misfit), MIN_RELATIVE_FALL * self.cost)

    @property
    def misfit(self) -> float:
        """Squared residuals over the noise's [1]."""
        return 2 * self.cost / max(1, self.count)


def _race_widths(problem: EstimationProblem, names: Set[str]) -> tuple[_WidthTrial, set[str]]:
    """The best trial over the named widths, and the widths of which a narrower one would be too stiff."""
    race, too_stiff = _Race(problem), set[str]()
    best = race.run({n: problem.parameters.value(n) for n in sorted(names)})
    for width in _present(problem):
        if width.name in names:
            best, is_stiff = _search_width(race, width, best)
            too_stiff |= {width.name} if is_stiff else set()
    return best, too_stiff


def _names(width: Width) -> tuple[str, ...]:
    """The parameters that a search over a width moves."""
    return (width.name, *width.follows)


def _present(problem: EstimationProblem) -> list[Width]:
    """The widths of the model, of which each is a parameter."""
    return [w for w in problem.system.plant.identification_hints.widths if w.name in problem.parameters]


def _is_open(problem: EstimationProblem, name: str) -> bool:
    """Whether nobody has stated a width: it stands where the model, or an earlier choice, has put it."""
    if name not in problem.parameters or any(name in e.conditions for e in problem.experiments):
        return False
    said = problem.parameters[name]
    return not said.free and (said == problem.system.parameters[name] or said.source == CHOSEN_WIDTH)


def _search_width(race: "_Race", width: Width, best: _WidthTrial) -> tuple[_WidthTrial, bool]:
    """Narrow a width as long as that lowers the cost, or shows what it hides; else widen it as long."""
    given, too_stiff = best, False
    for factor in (1 / width.factor, 1 / sqrt(width.factor)):
        best, too_stiff = _follow(race, width, best, factor)
        if not too_stiff:
            break
    if best is given:
        best = _follow(race, width, best, width.factor)[0]
    return (best if _is_confirmed(race, width, given, best) else given), too_stiff


def _follow(race: "_Race", width: Width, best: _WidthTrial, factor: float) -> tuple[_WidthTrial, bool]:
    """Multiply a width by a factor until that helps no more."""
    while True:
        trial = race.run_scaled(best, width, factor)
        if trial is None:
            return best, False
        if not _is_better(width, trial, best):
            return best, trial.too_stiff
        best = trial


def _is_confirmed(race: "_Race", width: Width, given: _WidthTrial, best: _WidthTrial) -> bool:
    """Whether tighter gaps, too, prefer a width to the given one; they are searched only where that is not foreseen."""
    if best is given:
        return True
    if best.widths[width.name] < given.widths[width.name] and 0 < best.foreseen < inf:
        # by the linearised equations; far better, or as good and a width that hides less
        tight, wide = (replace(t, cost=t.foreseen) for t in (best, given))
        if tight.cost < FORESEEN_RATIO * wide.cost or _is_too_wide(width, tight, wide):
            return True
    trial, other = (race.run(t.widths, confirms=True) for t in (best, given))
    is_wider = trial.widths[width.name] > other.widths[width.name]
    if is_wider and other.cost < inf and trial.misfit > MODEL_ERROR_LEVEL**2:
        return False
    return _is_better(width, trial, other)


def _is_better(width: Width, trial: _WidthTrial, other: _WidthTrial) -> bool:
    """Whether a trial follows the logs better than another, or as well while it shows what the other hides."""
    return trial.is_better_than(other) or _is_too_wide(width, trial, other)


def _is_too_wide(width: Width, trial: _WidthTrial, best: _WidthTrial) -> bool:
    """Whether a width is too wide for what it hides, and a narrower one follows the logs as well."""
    is_narrower = trial.widths[width.name] < best.widths[width.name]
    if width.hides not in best.parameters or not (is_narrower and trial.cost <= best.cost + best.significant_fall):
        return False
    return best.widths[width.name] > MAX_HIDING_SHARE * abs(trial.parameters.value(width.hides)) > 0


class _Race:
    """Trials of one problem, in stretches of its logs where these are long."""

    def __init__(self, problem: EstimationProblem) -> None:
        method = replace(problem.method, progress=None)
        self.confirming_stages = method.stages[:CONFIRMING_STAGES]
        self._problem = replace(problem, experiments=excerpts(problem.experiments), weights={}, method=method)

    def run_scaled(self, trial: _WidthTrial, width: Width, factor: float) -> _WidthTrial | None:
        """A trial with a width and its followers multiplied by a factor; None beyond the bounds."""
        p = self._problem.parameters
        scaled = {n: trial.widths[n] * factor for n in _names(width) if n in trial.widths}
        if any(not p[n].lower <= v <= p[n].upper for n, v in scaled.items()):
            return None
        return self.run({**trial.widths, **scaled})

    def run(self, widths: dict[str, float], *, confirms: bool = False) -> _WidthTrial:
        """A short search from the model's first start; one that confirms goes on to gaps whose costs compare."""
        stages = self.confirming_stages if confirms else (TRIAL_STAGE,)
        problem = replace(self._problem, parameters=self._problem.parameters.with_values(widths))
        # an empty last stage: the last one of a method would iterate to its end
        stages = (*stages, replace(stages[-1], iterations=0))
        method = replace(problem.method, stages=stages, allows_state_noise=not confirms)
        transcription = problem.transcription(problem.candidates[0])
        is_narrower = any(v < self._problem.parameters.value(n) for n, v in widths.items())
        if is_narrower and is_too_stiff(transcription, method, implicit=False):
            return _WidthTrial(widths, inf, inf, 0, problem.parameters, too_stiff=True)
        fit = solve_least_squares(transcription, method)
        if fit.status.code is Code.INTERRUPTED:
            method.budget.check()
            raise KeyboardInterrupt
        too_stiff = fit.stats["iterations"] == 0 and is_too_stiff(transcription, method)
        cost = inf if too_stiff or not fit.stats["cost"] < inf else fit.stats["cost"]
        foreseen = inf
        if fit.optimum is not None and not too_stiff:  # by the equations at the end of the search, with other gaps
            gap, equations = self.confirming_stages[-1].gap, fit.optimum.equations
            sigma = fit.optimum.gap_deviations * (gap / fit.stats["gap_deviation"])
            tight = weigh_gaps(equations.segments, equations.linearisation, sigma)
            foreseen = 0.5 * max(0.0, tight.promised_squares(fit.optimum.keep))
        return _WidthTrial(widths, cost, foreseen, fit.count, fit.parameters, too_stiff)


def is_too_stiff(transcription: Transcription, method: LeastSquares, *, implicit: bool = True) -> bool:
    """Whether a start takes more integration steps than a search allows."""
    segments = segment(transcription)
    nodes, q = start_nodes(segments), np.array([p.value for p in segments.transcription.parameters.values()])
    if implicit:
        return choose_integration(segments, nodes, q, method.substeps)[1] > MAX_SEARCH_SUBSTEPS
    return (method.substeps or stable_substeps(segments, nodes, q, RK4_MAX_H_LAMBDA)) > MAX_SEARCH_SUBSTEPS


def excerpts(experiments: Sequence[Experiment], stretches: int = 4) -> tuple[Experiment, ...]:
    """The logs, or evenly spread stretches of them where they are long."""
    total = sum(len(e.trajectory) for e in experiments)
    if total <= MAX_TRIAL_SAMPLES:
        return tuple(experiments)
    share, out = MAX_TRIAL_SAMPLES / total, list[Experiment]()
    for e in experiments:
        n = len(e.trajectory)
        size, each = n // stretches, round(share * n / stretches)
        for k in range(stretches):
            begin, end = k * size, k * size + max(10, each)
            holes = [(max(a, begin) - begin, min(b, end) - begin) for a, b in e.holes if a < end and b > begin]
            run = e.trajectory.rows(begin, end)
            part = replace(e, trajectory=run, holes=tuple(holes), name=f"{e.name}@{k}")
            out += [part] if known_runs(part) else []
    return tuple(out)
