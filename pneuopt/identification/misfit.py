"""`diagnose_misfit`: what the residuals of a fit tell about its intervals, beyond their size.

Three questions, in this order: do parts of the logs agree on the parameters (`clusters.robust_covariance`); does the
mean of the residuals depend on the simulated motion, which is an error of the model; is the misfit so large that no
interval says anything.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import f as f_distribution

from pneuopt.dynamics.system import names
from pneuopt.identification.checks import outputs_in_log
from pneuopt.identification.clusters import (
    SIMULATIONS,
    TIME_BLOCKS,
    Clusters,
    jackknife,
    robust_covariance,
)
from pneuopt.identification.problem import EstimationProblem
from pneuopt.identification.repairs import window_runs
from pneuopt.identification.result import Mark, join_names
from pneuopt.identification.statistics import agreement
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.filters import FitScores, fit_scores
from pneuopt.shooting.least_squares import MAX_CHI_SQUARE_RATIO, Fit, Optimum
from pneuopt.shooting.segments import Segments, segment

# classes of a simulated signal, equally full: more see finer effects with less certainty
MOTION_CLASSES = 6
# blocks of time over which the means of the residuals by class scatter: fewer have little power, more are correlated
MOTION_BLOCKS = 32
# probability [1], over all signals and outputs, below which residuals depend on a signal: higher blames chance, lower
# misses stick-slip that the model smooths
MOTION_LEVEL = 0.001
# residuals in noise standard deviations [1] from which most of their power is an error of the model: a lower one blames
# the model for noise that a log states too low, a higher one trusts intervals of wrong models
MODEL_ERROR_LEVEL = 2.0
# residuals in standard deviations of the stated noise [1] beyond which there is no interval: the parameters of a model
# that misses so much are not those of the drive, and how far they are off is not in the residuals. Sensors at the wrong
# place have left 26 to 49, friction that depends on load or position 2 to 8
MAX_MISFIT = 20.0
# the same over the channel's own variation [1], where the noise is estimated: that of a fine encoder is far below what
# any model explains
MAX_NRMSE = 0.2
MIN_SIGNAL_SPREAD = 1e-6  # spread of a signal over its size [1]: a smaller one is rounding, and has no classes


@dataclass(frozen=True, eq=False)
class Misfit:
    """What the residuals of a fit tell about its intervals.

    Attributes
    ----------
    covariance : ndarray, shape (k, k), or None
        Of all free parameters; NaN for those that the fit has not determined.
    dof : ndarray, shape (k,)
        Degrees of freedom of each variance, for Student's t.
    inflation : float
        Mean ratio of the variances to those of white residuals.
    ranges : ndarray, shape (k, 2)
        The least and the largest change of each estimate when a sixth of the logs, a log, or a class of the motion is
        left out.
    widened : bool
        Whether parts of the logs disagree on the parameters more than chance lets them.
    level : float
        Residuals over the noise, root mean squares [1].
    noisy_states : bool
        Whether gaps between segments stand for noise of the states.
    is_excessive : bool
        Whether the residuals are so large that there is no interval.
    signals : tuple of str
        The simulated signals on which the residuals depend, the clearest first.
    rejected_widths : tuple of str
        The widths of the model that the logs reject.
    biased : ndarray of bool, shape (k,), or None
        The estimates that such a width biases; None without one.
    restarts : bool
        Whether windows that start anew follow the logs where the model, over whole logs, does not.
    is_slow, lone
        As of a `RobustCovariance`; `lone` by name.
    """

    covariance: Array | None
    dof: Array
    inflation: float
    ranges: Array
    level: float
    noisy_states: bool
    is_excessive: bool
    widened: bool = False
    signals: tuple[str, ...] = ()
    is_slow: bool = False
    lone: tuple[str, ...] = ()
    rejected_widths: tuple[str, ...] = ()
    biased: Mask | None = None
    restarts: bool = False

    @property
    def is_suspect(self) -> bool:
        """Whether parts of the logs disagree, or residuals exceed the noise: a width of the model may be behind it.

        A signal on which residuals depend already marks all estimates.
        """
        return (self.widened or self.level**2 > MAX_CHI_SQUARE_RATIO) and not self.signals

    def mark(self, index: int, *, is_optimum: bool) -> Mark:
        """The mark of an estimate, which may be at an optimum or at a bound."""
        is_missed = self.noisy_states or self.restarts or self.level > MODEL_ERROR_LEVEL
        is_biased = self.biased is not None and bool(self.biased[index])
        if self.signals or is_biased or is_missed or not is_optimum:
            return Mark.BIAS_POSSIBLE
        return Mark.WIDENED if self.widened or self.level**2 > MAX_CHI_SQUARE_RATIO else Mark.EXACT

    def assess(self, status: Status) -> Status:
        """The status of a fit with what its residuals tell."""
        status = status.with_details(*self.sentences)
        if not (self.is_excessive and status.converged):
            return status
        verdict = f"residuals are {self.level:.3g} times the noise, so that estimates have ranges and no intervals"
        remedy = "check sensors, units and conditions; then try a richer model"
        return Status(Code.MISFIT, (verdict, *status.sentences, remedy))

    @property
    def sentences(self) -> tuple[str, ...]:
        """What a user should know, and what would help."""
        found = []
        if self.signals:
            found.append(f"residuals depend on {join_names(self.signals)}: model error, estimates may be biased")
        if self.restarts:
            found.append("over whole logs the model misses more than their noise: estimates from windows may be biased")
        if self.rejected_widths:
            widths = f"{join_names(self.rejected_widths)} that the logs reject"
            found.append(f"the model has a value of {widths}: the estimates that it moves may be biased")
        if self.is_slow:
            found.append("the misfit is as slow as the logs, or different from log to log: log more or longer runs")
        if self.lone:
            found.append(f"one log alone determines {join_names(self.lone)}: log more runs like it")
        return tuple(found)


def diagnose_misfit(problem: EstimationProblem, fit: Fit, variance: float, dof: float) -> Misfit:
    """Diagnose the residuals of a fit.

    Parameters
    ----------
    problem : EstimationProblem
    fit : Fit
    variance, dof : float
        Of the residuals, in noise variances, and its degrees of freedom.

    Returns
    -------
    Misfit
    """
    k, free = len(fit.parameters.free_names), fit.parameters.free_names
    scores = None if fit.optimum is None else fit_scores(fit.optimum)
    white = None if fit.covariance is None else fit.covariance * variance * fit.variance_inflation
    size = math.sqrt(variance), fit.jumps is not None, _is_excessive(problem, fit, variance)
    if fit.optimum is None or scores is None or white is None:
        return Misfit(white, np.full(k, dof), 1.0, np.full((k, 2), np.nan), *size)
    keep = np.flatnonzero(fit.optimum.keep)
    blocks = _clusters(scores, _split_in_time(fit.optimum.equations.segments, TIME_BLOCKS), simulate=fit.jumps is None)
    signals = _signals_behind_residuals(scores, names((*problem.system.states, *problem.system.inputs)))
    classes = [_clusters(scores, _classes(signals[0].values, of_size=True))] if signals else []
    square = np.ix_(keep, keep)
    found = robust_covariance(blocks, white[square], variance * fit.variance_inflation, dof, classes=classes)
    covariance, degrees, ranges = white.copy(), np.full(k, dof), np.full((k, 2), np.nan)
    covariance[square], degrees[keep] = found.covariance, found.dof
    parts = [blocks.halve().halve(), blocks.by_log(), *classes]
    if changes := [jackknife(c).changes for c in parts if c.count > 1]:
        each = np.concatenate(changes)
        ranges[keep] = np.stack([each.min(axis=0), each.max(axis=0)], axis=1)
    own = {n for n in free if n not in problem.parameters}
    return Misfit(
        covariance,
        degrees,
        float(np.mean(np.diag(found.covariance) / np.diag(white[square]))),
        ranges,
        *size,
        found.widened,
        tuple(s.name for s in signals),
        found.is_slow,
        tuple(free[i] for i, alone in zip(keep, found.lone, strict=True) if alone and free[i] not in own),
    )


def degrees_of_freedom(problem: EstimationProblem, fit: Fit) -> int:
    """Residuals of a fit less the parameters and the start states that it has taken from them; at least one.

    A log has a start state, and another one behind each hole in its inputs and in each window. States that no output
    shows are not fitted, and a part takes no more than it has samples.
    """
    if fit.optimum is None:
        segments = segment(problem.transcription(problem.start_from(fit)))
    else:
        segments = fit.optimum.equations.segments
    heads = np.flatnonzero(np.append(True, ~segments.linked[:-1]))
    samples = np.add.reduceat(np.isfinite(segments.measured).sum(axis=(1, 2)), heads)
    starts = np.minimum(np.isnan(segments.fixed_start[heads]).sum(axis=1), samples)
    return max(1, fit.count - len(fit.parameters.free_names) - int(starts.sum()))


class Signal(NamedTuple):
    """A simulated signal, its mean in each segment, and the probability that the residuals depend on it by chance."""

    name: str
    values: Array
    p: float


def motion_p(values: Array, residuals: Array, derivatives: Array, scores: FitScores, blocks: Indices) -> float:
    """Probability that chance makes the mean of residuals depend so much on a signal.

    Parameters
    ----------
    values : ndarray, shape (m,)
        The signal in each segment.
    residuals : ndarray, shape (m,)
        The sum of one output's residuals in each segment.
    derivatives : ndarray, shape (m, k)
        Its derivatives by the parameters.
    scores : FitScores
    blocks : ndarray of int, shape (m,)
        The block of time of each segment.

    Returns
    -------
    float
        Of Hotelling's T^2 of the sums over classes of the signal, less what a change of the parameters explains; they
        count as independent from block to block, not within (Hotelling 1931).
    """
    members = _classes(values) == np.arange(MOTION_CLASSES)[:, None]
    explained = np.linalg.solve(scores.whole_information, (members @ derivatives).T)
    each = (members * residuals).T - scores.scores @ explained
    sums = np.zeros((int(blocks.max()) + 1, len(members)))
    np.add.at(sums, blocks, each)
    return _hotelling_p(sums)


def _is_excessive(problem: EstimationProblem, fit: Fit, variance: float) -> bool:
    """Whether residuals exceed the noise so far, or the variation of a channel where its noise is estimated."""
    if variance <= MAX_MISFIT**2:
        return False
    pairs = zip(problem.experiments, fit.trajectories, strict=True)
    shares = [_missed_share(problem, e, run, c) for e, run in pairs for c in outputs_in_log(problem.system, e)]
    return problem.noise_is_stated or float(np.nanmean(shares)) > MAX_NRMSE


def _missed_share(problem: EstimationProblem, experiment: Experiment, run: Trajectory, channel: str) -> float:
    """Residuals over the variation of a channel; within windows, over what the start of each does not explain."""
    measured = experiment.trajectory[channel]
    if math.isinf(problem.window):
        return agreement(measured, run[channel])["nrmse"]
    bends = np.concatenate([_bend(measured[a:b]) for a, b in window_runs(experiment, problem.window)])
    size = float(np.nansum(bends**2))
    return math.sqrt(float(np.nansum((measured - run[channel]) ** 2)) / size) if size > 0 else math.nan


def _bend(values: Array) -> Array:
    """What a straight line leaves of some samples; NaN where one is missing."""
    known, at = np.isfinite(values), np.arange(len(values), dtype=float)
    if known.sum() < 3:
        return values * math.nan
    return np.asarray(values - np.polyval(np.polyfit(at[known], values[known], 1), at))


def _hotelling_p(rows: Array) -> float:
    """Probability that rows of mean zero have so large a mean; 1 where they are too few."""
    count, mean = len(rows), rows.mean(axis=0)
    spread = np.std(rows, axis=0, ddof=1)
    used = spread > 0
    values, vectors = np.linalg.eigh(np.corrcoef(rows[:, used], rowvar=False).reshape(used.sum(), used.sum()))
    real = values > 1e-8  # an offset among the parameters leaves a sum of zero over all classes
    rank = int(real.sum())
    if rank == 0 or count <= 2 * rank:
        return 1.0
    square = count * float(np.sum((vectors[:, real].T @ (mean[used] / spread[used])) ** 2 / values[real]))
    return float(f_distribution.sf(square * (count - rank) / (rank * (count - 1)), rank, count - rank))


def _signals_behind_residuals(scores: FitScores, known: Sequence[str]) -> list[Signal]:
    """The simulated signals, of those known, on which the residuals depend, the clearest first."""
    segments = scores.optimum.equations.segments
    blocks, (sums, derivatives) = _split_in_time(segments, MOTION_BLOCKS), scores.residual_sums()
    measured = np.flatnonzero(segments.counts)
    means = {n: v for n, v in _segment_means(scores.optimum).items() if n in known}
    found = []
    for name, values in means.items():
        ps = [motion_p(values, sums[:, i], derivatives[:, i], scores, blocks) for i in measured]
        found.append(Signal(name, values, min(ps)))
    level = MOTION_LEVEL / max(1, len(found) * len(measured))
    return sorted((s for s in found if s.p < level), key=lambda s: s.p)


def _segment_means(optimum: Optimum) -> dict[str, Array]:
    """The mean of each state and input over each segment, of those that vary."""
    segments, x = optimum.equations.segments, optimum.run.x
    assert x is not None
    real = np.arange(segments.t.shape[1]) < segments.lengths[:, None]
    signals = np.concatenate([x, segments.inputs], axis=2)
    means = np.sum(signals * real[..., None], axis=1) / segments.lengths[:, None]
    columns = zip(names((*segments.system.states, *segments.system.inputs)), means.T, strict=True)
    return {n: v for n, v in columns if np.ptp(v) > MIN_SIGNAL_SPREAD * np.abs(v).max(initial=0.0)}


def _classes(values: Array, *, of_size: bool = False) -> Indices:
    """The class of each value, 0 to MOTION_CLASSES - 1, equally full; by absolute values if `of_size`."""
    order = np.argsort(np.abs(values) if of_size else values, kind="stable")
    found = np.empty(len(values), dtype=np.intp)
    found[order] = np.arange(len(values)) * MOTION_CLASSES // len(values)
    return found


def _split_in_time(segments: Segments, count: int) -> Indices:
    """The block of each segment: about `count` over all logs, by their lengths, none across two logs."""
    groups, first = [], 0
    for length in np.bincount(segments.phase):
        own = min(int(length), max(1, round(count * length / segments.count)))
        groups.append(first + np.arange(length) * own // length)
        first += own
    return np.concatenate(groups)


def _clusters(scores: FitScores, groups: Indices, *, simulate: bool = False) -> Clusters:
    """The clusters of groups of segments, with what chance does if asked for."""
    first = np.unique(groups, return_index=True)[1]
    sums = np.zeros((len(first), scores.scores.shape[1]))
    np.add.at(sums, groups, scores.scores)
    by_chance = scores.simulate_white(SIMULATIONS, groups) if simulate else None
    return Clusters(sums, scores.information(groups), scores.optimum.equations.segments.phase[first], by_chance)
