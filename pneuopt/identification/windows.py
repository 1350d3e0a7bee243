"""`fit_in_windows`: a long log that the model does not follow from end to end, fitted in windows that it follows.

A plant that integrates adds up whatever its model misses: the position runs away from the log, and the gaps of a fit
that links its segments take the misfit in their place. In windows with a start state each the model runs freely for a
limited time only. Short windows show little of slow terms, long ones gather what the model misses; the length is that
with the narrowest intervals among those that agree with all shorter ones (the rule of Lepski, Theory of Probability and
its Applications 35(3), 1991; problems/identify/windows.py holds its estimates to the truth).
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.misfit import Misfit, degrees_of_freedom, diagnose_misfit, t_quantile
from pneuopt.identification.problem import EstimationProblem, outputs_in_log
from pneuopt.identification.result import ChosenWindow
from pneuopt.identification.search import fit_fixing_unidentifiable
from pneuopt.identification.tolerances import (
    FIRST_ITERATIONS,
    MIN_KNOWN_SHARE,
    MIN_WINDOW_SAMPLES,
    MIN_WINDOWS,
    NEXT_ITERATIONS,
    WINDOW_FACTOR,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.status import Code
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, close_gaps
from pneuopt.shooting.segments import choose_integration, segment, start_nodes
from pneuopt.shooting.tolerances import MAX_GAP_SHARE

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
    """The fit in windows of the length with the narrowest intervals; None unless whole logs failed by their gaps."""
    if not _has_failed_by_gaps(problem, fit):
        return None
    lengths = [problem.window] if math.isfinite(problem.window) else _lengths(problem)
    trials, start, iterations = list[_Trial](), problem.start_from(fit), FIRST_ITERATIONS
    for length in reversed(lengths):
        trials.append(_try_length(problem, start, length, iterations))
        if trials[-1].fit.status.code is Code.INTERRUPTED:
            break
        start, iterations = trials[-1].problem.start_from(trials[-1].fit), NEXT_ITERATIONS
    found = [trial for trial in trials if trial.is_answer]
    if not found:
        return None
    agreeing = [trial for trial in found if all(trial.agrees(other) for other in found if other.length < trial.length)]
    best = min(agreeing, key=lambda trial: trial.rank)
    window = ChosenWindow(best.length, lengths[0], lengths[-1], fit.stats["gap_share"])
    return best.problem, best.fit.with_effort_of(fit), window


def run_freely(problem: EstimationProblem, fit: Fit) -> tuple[Trajectory, ...]:
    """Each log simulated from its fitted start to its end without gaps; only a hole in its inputs starts anew.

    Not finite where the model diverges.
    """
    if not problem.system.states:
        return fit.trajectories
    if math.isinf(problem.window) and fit.optimum is not None and (y := close_gaps(fit.optimum)) is not None:
        return fit.optimum.equations.segments.output_trajectories(y)
    whole = replace(problem, window=math.inf, method=replace(problem.method, segment_time=math.inf))
    segments = segment(whole.transcription(whole.start_from(fit)))
    nodes, q = start_nodes(segments), np.array([p.value for p in segments.transcription.parameters.values()])
    segments, substeps = choose_integration(segments, nodes, q, int(fit.stats["substeps"]))
    return segments.trajectories(segments.run(nodes, q, substeps, states=True))


class _Trial(NamedTuple):
    """The fit in windows of one length."""

    length: float
    problem: EstimationProblem
    fit: Fit
    misfit: Misfit

    @property
    def rank(self) -> tuple[int, bool, float]:
        """Parameters without a variance, whether residuals are too large for intervals, and the mean log of these."""
        if self.misfit.covariance is None:
            return len(self.fit.parameters.free_names), True, math.inf
        half_widths = self.half_widths[np.isfinite(self.half_widths)]
        unknown = len(self.half_widths) - len(half_widths)
        return unknown, self.misfit.is_excessive, float(np.log(half_widths).sum())

    @property
    def half_widths(self) -> Array:
        """Half of each interval, infinite where a parameter has no variance, shape (k,)."""
        if self.misfit.covariance is None:
            return np.full(len(self.fit.parameters.free_names), np.inf)
        variances = np.diag(self.misfit.covariance)
        widths = t_quantile(self.misfit.dof) * np.sqrt(np.maximum(variances, 0.0))
        return np.where(variances > 0, widths, np.inf)

    @property
    def is_answer(self) -> bool:
        """Whether it is an optimum that tells most parameters better than their own size."""
        sizes = np.abs([self.fit.parameters.value(n) for n in self.fit.parameters.free_names])
        known = float(np.mean(self.half_widths < sizes)) if sizes.size else 1.0
        return self.fit.status.converged and known > MIN_KNOWN_SHARE

    def agrees(self, shorter: "_Trial") -> bool:
        """Whether its estimates agree with those of shorter windows, in which the model's errors add up less."""
        names = [n for n in self.fit.parameters.free_names if n in shorter.fit.parameters.free_names]
        apart = np.abs([self.fit.parameters.value(n) - shorter.fit.parameters.value(n) for n in names])
        free, others = self.fit.parameters.free_names, shorter.fit.parameters.free_names
        own, other = self.half_widths, shorter.half_widths
        widths = [own[free.index(n)] + other[others.index(n)] for n in names]
        return bool(np.all(apart <= np.array(widths)))


def _has_failed_by_gaps(problem: EstimationProblem, fit: Fit) -> bool:
    """Whether gaps have taken the misfit of a search that ended by itself, of a plant that windows can cut."""
    absorbed = fit.stats["gap_share"] > MAX_GAP_SHARE and math.isfinite(fit.stats["cost"])
    can_cut = not problem.is_whole and bool(problem.system.states) and problem.system.motion().sample_time is None
    return fit.status.code is Code.NOT_CONVERGED and absorbed and can_cut


def _lengths(problem: EstimationProblem) -> list[float]:
    """Lengths of windows to try, the shortest first; at least one [s]."""
    shortest, total = 0.0, 0.0
    for e in problem.experiments:
        known = np.isfinite(e.trajectory.matrix(outputs_in_log(problem.system, e))).any(axis=1)
        shortest = max(shortest, MIN_WINDOW_SAMPLES * e.trajectory.duration / max(1, int(known.sum())))
        total += e.trajectory.duration
    count = max(1, 1 + math.floor(math.log(max(1.0, total / MIN_WINDOWS / shortest), WINDOW_FACTOR)))
    return [shortest * WINDOW_FACTOR**k for k in range(count)]


def _try_length(problem: EstimationProblem, start: Start, length: float, iterations: int) -> _Trial:
    """The fit in windows of one length, a segment each, and what its residuals tell."""
    # without gaps all stages are alike; steps are refined where the search has converged
    last = replace(problem.method.stages[-1], iterations=iterations, refine=1)
    cut = replace(problem, window=length, method=replace(problem.method, segment_time=length, stages=(last,)))
    held, found = fit_fixing_unidentifiable(cut, start)
    held = replace(held, method=replace(held.method, stages=problem.method.stages))
    freedom = degrees_of_freedom(held, found)
    return _Trial(length, held, found, diagnose_misfit(held, found, found.chi_square / freedom, freedom))
