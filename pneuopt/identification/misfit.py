"""`diagnose_misfit`: what the residuals of a fit say about its intervals, beyond their size.

`robust_covariance`: residuals count in clusters, blocks of time and logs. Where the clusters agree on the parameters as
chance lets them (after Chow, Econometrica 28, 1960), the covariance of white residuals stays. Otherwise the estimates'
changes when one cluster is left out measure their variance: CR3, the jackknife, over blocks of time, CR2 over logs,
with the degrees of freedom of Bell and McCaffrey (Survey Methodology 28(2), 2002), so that few clusters give a wide
interval and not a lucky one. `problems/identify/interval_coverage.py` measures the coverage.

`suspect_widths`: a width that the user has stated counts as one more parameter, and the gradient of the cost by it at
the estimates decides (Rao's score test, Proc. Cambridge Philos. Soc. 44, 1948), without another fit. After true
stiction the Stribeck velocity was 7 % off, 5.6 of its deviations, with residuals of 1.006 times the noise
(`problems/identify/mismatch.py`).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, t
from scipy.stats import f as f_distribution

from pneuopt.dynamics.system import names
from pneuopt.identification.problem import EstimationProblem, outputs_in_log, window_runs
from pneuopt.identification.result import Mark, join_names
from pneuopt.identification.statistics import agreement
from pneuopt.identification.tolerances import (
    ASSUMED_SHARE,
    BIAS_HALF_WIDTHS,
    BIAS_SHIFTS,
    LEAST_TIME_DOF,
    LEFT_OUT_REGULARISATION,
    LEVEL,
    MAX_MISFIT,
    MAX_NRMSE,
    MIN_LOG_DOF,
    MIN_SIGNAL_SPREAD,
    MIN_TIME_DOF,
    MODEL_ERROR_LEVEL,
    MOTION_BLOCKS,
    MOTION_CLASSES,
    MOTION_LEVEL,
    SIGNIFICANT_FALL,
    SIMULATIONS,
    SLOW_RATIO,
    TIME_BLOCKS,
)
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.status import Code, Status
from pneuopt.shooting.filters import FitScores, fit_scores
from pneuopt.shooting.least_squares import Fit, solve_least_squares
from pneuopt.shooting.segments import Segments, segment
from pneuopt.shooting.tolerances import MAX_CHI_SQUARE_RATIO


@dataclass(frozen=True, eq=False)
class Misfit:
    """The diagnosis of a fit's residuals, for its intervals."""

    covariance: Array | None  # of all free parameters; NaN for those that the fit has not determined
    dof: Array  # degrees of freedom of each variance, for Student's t
    inflation: float  # mean ratio of the variances to those of white residuals
    level: float  # residuals over the noise, root mean squares [1]
    noisy_states: bool  # whether gaps between segments stand for noise of the states
    is_excessive: bool  # whether the residuals are so large that there is no interval
    widened: bool = False  # whether parts of the logs disagree on the parameters more than chance lets them
    signals: tuple[str, ...] = ()  # the simulated signals on which the residuals depend, the clearest first
    is_slow: bool = False  # whether it varies as slowly as the logs, or from log to log
    lone: tuple[str, ...] = ()
    rejected_widths: tuple[str, ...] = ()  # the stated widths of the model that the logs reject
    shifts: Array | None = None  # how far these move the estimates; None without one
    restarts: bool = False  # whether windows that start anew follow the logs where the model, over whole logs, does not
    is_useless: bool = False  # whether the fit does not predict its own logs (`predict_logs`)

    @property
    def mark(self) -> Mark:
        """The mark of an estimate without harmful bias."""
        return Mark.WIDENED if self.widened or self.level**2 > MAX_CHI_SQUARE_RATIO else Mark.EXACT

    @property
    def is_of_the_model(self) -> bool:
        """Whether the residuals show an error of the model, which no interval of chance holds."""
        is_missed = self.restarts or self.is_useless or self.level > MODEL_ERROR_LEVEL
        return bool(self.signals) or self.noisy_states or is_missed

    def bound_bias(self, half_widths: Array) -> Array:
        """How far errors of the model may have moved each estimate, at half widths of its 95 % interval of chance."""
        by_residuals = BIAS_HALF_WIDTHS * half_widths if self.is_of_the_model else np.zeros_like(half_widths)
        return by_residuals if self.shifts is None else np.maximum(by_residuals, BIAS_SHIFTS * np.abs(self.shifts))

    def assess(self, status: Status) -> Status:
        """The status of a fit with the diagnosis of its residuals."""
        status = status.with_details(*self.sentences)
        if not (self.is_excessive and status.converged):
            return status
        verdict = f"residuals are {self.level:.3g} times the noise, so that estimates have no intervals"
        return Status(Code.MISFIT, (verdict, *status.sentences))

    @property
    def refusal(self) -> Status:
        """The status of a fit whose residuals leave no parameter identified."""
        verdict = f"residuals are {self.level:.3g} times the noise, and beside such the logs identify no parameter"
        return Status(Code.NOT_CONVERGED, (verdict, *self.sentences))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences for the user on the misfit."""
        found = []
        if self.signals:
            found.append(f"residuals depend on {join_names(self.signals)}: model error, estimates may be biased")
        if self.restarts:
            found.append("over whole logs the misfit exceeds the noise: estimates from windows may be biased")
        if self.rejected_widths:
            widths = join_names(self.rejected_widths)
            found.append(f"the stated {widths} is rejected by a score test: where it is not stated, it is estimated")
        if self.is_slow:
            found.append("the misfit is as slow as the logs, or different from log to log")
        if self.lone:
            found.append(
                f"one log alone determines {join_names(self.lone)}: how it scatters from log to log is unknown"
            )
        return tuple(found)


def diagnose_misfit(problem: EstimationProblem, fit: Fit, variance: float, dof: float) -> Misfit:
    """Diagnose the residuals of a fit from their variance, in noise variances, and its degrees of freedom."""
    k, free = len(fit.parameters.free_names), fit.parameters.free_names
    scores = None if fit.optimum is None else fit_scores(fit.optimum)
    white = None if fit.covariance is None else fit.covariance * variance * fit.variance_inflation
    size = math.sqrt(variance), fit.jumps is not None, _is_excessive(problem, fit, variance)
    if fit.optimum is None or scores is None or white is None:
        return Misfit(white, np.full(k, dof), 1.0, *size)
    keep = np.flatnonzero(fit.optimum.keep)
    blocks = cluster_segments(
        scores, _split_in_time(fit.optimum.equations.segments, TIME_BLOCKS), simulate=fit.jumps is None
    )
    signals = _signals_behind_residuals(scores, names((*problem.system.states, *problem.system.inputs)))
    classes = [cluster_segments(scores, _classes(signals[0].values, of_size=True))] if signals else []
    square = np.ix_(keep, keep)
    found = robust_covariance(blocks, white[square], variance * fit.variance_inflation, dof, classes=classes)
    covariance, degrees = white.copy(), np.full(k, dof)
    covariance[square], degrees[keep] = found.covariance, found.dof
    own = {n for n in free if n not in problem.parameters}
    return Misfit(
        covariance,
        degrees,
        float(np.mean(np.diag(found.covariance) / np.diag(white[square]))),
        *size,
        found.widened,
        tuple(s.name for s in signals),
        found.is_slow,
        tuple(free[i] for i, alone in zip(keep, found.lone, strict=True) if alone and free[i] not in own),
    )


def degrees_of_freedom(problem: EstimationProblem, fit: Fit) -> int:
    """Residuals of a fit less its parameters and start states, of each part of a log; at least one.

    States that no output shows are not fitted, and a part takes no more than it has samples.
    """
    if fit.optimum is None:
        segments = segment(problem.transcription(problem.start_from(fit)))
    else:
        segments = fit.optimum.equations.segments
    heads = np.flatnonzero(np.append(True, ~segments.linked[:-1]))
    samples = np.add.reduceat(np.isfinite(segments.measured).sum(axis=(1, 2)), heads)
    starts = np.minimum(np.isnan(segments.fixed_start[heads]).sum(axis=1), samples)
    return max(1, fit.count - len(fit.parameters.free_names) - int(starts.sum()))


@dataclass(frozen=True, eq=False)
class Clusters:
    """Residuals in K clusters, as k parameters see them."""

    # gradient of half the squared residuals of each cluster by the parameters; they sum to zero at an optimum
    scores: Array
    information: Array  # J'J of each cluster, for residuals in noise standard deviations
    logs: Indices  # the log that each cluster is of, in ascending order; a log's clusters are in the order of time
    # scores of n fits to white residuals of unit variance; by default those of independent residuals
    by_chance: Array | None = None

    @property
    def count(self) -> int:
        """Number of clusters K."""
        return len(self.scores)

    def merge(self, groups: Indices) -> "Clusters":
        """The clusters with those of the same group, 0, 1, ..., as one."""
        first = np.unique(groups, return_index=True)[1]
        scores = np.zeros((len(first), self.scores.shape[1]))
        information = np.zeros((len(first), *self.information.shape[1:]))
        np.add.at(scores, groups, self.scores)
        np.add.at(information, groups, self.information)
        by_chance = None
        if self.by_chance is not None:
            member = np.arange(len(first)) == groups[:, None]
            by_chance = np.einsum("ngk,gh->nhk", self.by_chance, member.astype(float))
        return Clusters(scores, information, self.logs[first], by_chance)

    def halve(self) -> "Clusters":
        """The clusters with neighbours in time as one, never across logs."""
        start = np.searchsorted(self.logs, self.logs)
        pair = (np.arange(self.count) - start) // 2
        return self.merge(np.unique(np.stack([self.logs, pair]), axis=1, return_inverse=True)[1].ravel())

    def by_log(self) -> "Clusters":
        """Each log as one cluster."""
        return self.merge(np.unique(self.logs, return_inverse=True)[1])


class Spread(NamedTuple):
    """The variance of estimates by one set of clusters."""

    covariance: Array
    dof: Array  # Bell and McCaffrey's degrees of freedom of each variance
    changes: Array  # what each cluster adds to the estimates, by which the covariance is made


@dataclass(frozen=True, eq=False)
class RobustCovariance:
    """The covariance of estimates, and what it rests on."""

    covariance: Array
    dof: Array  # degrees of freedom of each variance: of Student's t for an interval
    widened: bool  # whether the clusters disagree more than chance lets them
    is_slow: bool  # whether the misfit varies as slowly as the logs, or from log to log
    lone: Mask  # parameters that one of several logs alone determines: how they scatter between logs is unknown


def robust_covariance(
    blocks: Clusters, white: Array, variance: float, dof: float, classes: Sequence[Clusters] = ()
) -> RobustCovariance:
    """The covariance (k, k) that gives each parameter its widest interval among white residuals and clusters.

    `classes` are clusters by a motion on which the residuals depend; with any, agreement of the blocks is no excuse.
    """
    halves = [blocks, blocks.halve(), blocks.halve().halve()]  # halving ends at one cluster a log
    times = [c for i, c in enumerate(halves) if c.count > 1 and c.count not in [h.count for h in halves[:i]]]
    logs = [blocks.by_log()] if len(np.unique(blocks.logs)) > 1 else []
    levels = [*times, *logs]
    none = np.zeros(len(white), dtype=bool)
    agree = min((disagreement_p(c, variance) for c in levels), default=1.0) * len(levels) >= 1 - LEVEL
    if not levels or (agree and not classes):
        return RobustCovariance(white, np.full(len(white), dof), widened=False, is_slow=False, lone=none)
    within = [jackknife(c) for c in (*times, *classes) if c.count > 1]
    between = [between_clusters(c) for c in logs]
    enough = np.minimum(np.max([s.dof for s in within], axis=0), MIN_TIME_DOF)
    spreads = [(s._replace(dof=np.maximum(s.dof, LEAST_TIME_DOF)), s.dof >= enough) for s in within]
    spreads += [(s, s.dof >= MIN_LOG_DOF) for s in between]
    # for each parameter the widest interval among those that count for it
    variances, degrees, together = np.diag(white).copy(), np.full(len(white), dof), white.copy()
    for spread, counts in spreads:
        own, own_dof = np.diag(spread.covariance), np.where(counts, spread.dof, dof)
        wider = counts & (t_quantile(own_dof) * np.sqrt(own) > t_quantile(degrees) * np.sqrt(variances))
        variances, degrees = np.where(wider, own, variances), np.where(wider, own_dof, degrees)
        together += spread.covariance
    stretch = np.sqrt(variances / np.diag(together))
    lone = between[0].dof < MIN_LOG_DOF if between else none
    fine, coarse = (np.diag(spread.covariance) for spread in (within[0], within[max(len(times) - 1, 0)]))
    slow = len(times) > 1 and bool(np.median(coarse / fine) > SLOW_RATIO)
    covariance = together * np.outer(stretch, stretch)
    return RobustCovariance(covariance, degrees, widened=True, is_slow=slow, lone=lone)


def jackknife(clusters: Clusters) -> Spread:
    """CR3: the variance by the changes when one cluster is left out (Bell and McCaffrey 2002, without recentring)."""
    K = clusters.count
    found = _spread(clusters, lambda own: 1 / (1 + LEFT_OUT_REGULARISATION - own))
    return Spread((K - 1) / K * found.covariance, found.dof, found.changes)


def between_clusters(clusters: Clusters) -> Spread:
    """CR2: the variance between clusters, without bias where the residuals are white (Bell and McCaffrey 2002)."""
    return _spread(clusters, lambda own: 1 / np.sqrt(np.maximum(1 - own, LEFT_OUT_REGULARISATION)))


def disagreement_p(clusters: Clusters, variance: float) -> float:
    """Probability that chance makes clusters of white residuals disagree so much on the parameters.

    Of Chow's statistic, the decrease of squared residuals if each cluster had its own parameters; it counts as chi-
    square with the mean and the variance that it has by chance (Satterthwaite 1946).
    """
    scale, own = _whiten(clusters)
    if clusters.by_chance is None:
        # scores z_g at the true parameters have the covariance H_g, a cluster's share; fitted, z_g - H_g sum(z)
        values, vectors = np.linalg.eigh(own)
        normal = np.random.default_rng(0).standard_normal((SIMULATIONS, *own.shape[:2]))
        true = np.einsum("gij,gj,ngj->ngi", vectors, np.sqrt(np.maximum(values, 0.0)), normal)
        scores = true - np.einsum("gij,nj->ngi", own, true.sum(axis=1))
    else:
        scores = clusters.by_chance @ scale.T
    assumed = ASSUMED_SHARE / clusters.count * np.eye(len(scale))
    every = np.concatenate([(clusters.scores @ scale.T)[None], scores])
    seen, *chance = np.einsum("ngi,gij,ngj->n", every, np.linalg.inv(own + assumed), every, optimize=True)
    mean, spread = float(np.mean(chance)), float(np.var(chance, ddof=1))
    return float(chi2.sf(seen / variance * 2 * mean / spread, 2 * mean**2 / spread)) if spread > 0 else 1.0


def t_quantile(dof: Array | float, level: float = LEVEL) -> Array:
    """Half width of an interval in standard deviations, by Student's t."""
    return np.asarray(t.ppf(0.5 + level / 2, dof))


def _whiten(clusters: Clusters) -> tuple[Array, Array]:
    """S with S A S' = 1 for the whole information A, and each cluster's share of it, S A_g S'."""
    whole = clusters.information.sum(axis=0)
    size = 1 / np.sqrt(np.diag(whole))
    scale = np.linalg.inv(np.linalg.cholesky(whole * np.outer(size, size))) * size
    return scale, scale @ clusters.information @ scale.T


def _spread(clusters: Clusters, weigh: Callable[[Array], Array]) -> Spread:
    """The variance by changes d_g = S' f(H_g) S s_g; `weigh` is f on the eigenvalues of a cluster's share H_g."""
    scale, own = _whiten(clusters)
    values, vectors = np.linalg.eigh(own)
    maps = np.einsum("gij,gj,gkj->gik", vectors, weigh(values), vectors)
    changes = np.einsum("gij,gj->gi", maps, clusters.scores @ scale.T) @ scale
    dof = np.array([_degrees_of_freedom(maps @ column, own) for column in scale.T])
    return Spread(changes.T @ changes, dof, changes)


def _degrees_of_freedom(directions: Array, own: Array) -> float:
    """Bell and McCaffrey's degrees of freedom of the sum of squares of u_g' S s_g, for white residuals.

    The covariance M of these K terms is u_g' H_g u_g on its diagonal, less (H_g u_g)' (H_h u_h) everywhere, for the
    scores of a fit sum to zero. A sum of squares with such terms has tr(M)^2 / tr(M M) degrees of freedom.
    """
    seen = np.einsum("gij,gj->gi", own, directions)
    M = np.diag(np.einsum("gi,gi->g", directions, seen)) - seen @ seen.T
    squares = float(np.sum(M**2))
    return float(np.trace(M)) ** 2 / squares if squares > 0 else 0.0


class Signal(NamedTuple):
    """A simulated signal, its mean in each segment, and the probability that the residuals depend on it by chance."""

    name: str
    values: Array
    p: float


def motion_p(values: Array, residuals: Array, derivatives: Array, scores: FitScores, blocks: Indices) -> float:
    """Probability by chance of Hotelling's T^2 (1931) of one output's residuals (m,) summed over classes of a signal.

    Less what a change of the parameters explains (`derivatives`, (m, k)); blocks of time count as independent.
    """
    members = _classes(values) == np.arange(MOTION_CLASSES)[:, None]
    explained = np.linalg.solve(scores.whole_information, (members @ derivatives).T)
    each = (members * residuals).T - scores.scores @ explained
    sums = np.zeros((int(blocks.max()) + 1, len(members)))
    np.add.at(sums, blocks, each)
    return _hotelling_p(sums)


def _is_excessive(problem: EstimationProblem, fit: Fit, variance: float) -> bool:
    """Whether residuals exceed the noise so far, or the variation of a channel where its noise is estimated.

    Within windows the variation is what the start of each does not explain.
    """
    if variance <= MAX_MISFIT**2:
        return False
    shares = []
    for e, run in zip(problem.experiments, fit.trajectories, strict=True):
        for channel in outputs_in_log(problem.system, e):
            measured = e.trajectory[channel]
            if math.isinf(problem.window):
                shares.append(agreement(measured, run[channel])["nrmse"])
                continue
            size = 0.0
            for begin, end in window_runs(e, problem.window):
                at = np.flatnonzero(np.isfinite(measured[begin:end]))
                values = measured[begin:end][at]
                if at.size >= 3:  # a start state explains a straight line
                    size += float(np.sum((values - np.polyval(np.polyfit(at, values, 1), at)) ** 2))
            rest = float(np.nansum((measured - run[channel]) ** 2))
            shares.append(math.sqrt(rest / size) if size > 0 else math.nan)
    return problem.noise_is_stated or float(np.nanmean(shares)) > MAX_NRMSE


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
    x = scores.optimum.run.x
    assert x is not None
    real = np.arange(segments.t.shape[1]) < segments.lengths[:, None]
    signals = np.concatenate([x, segments.inputs], axis=2)
    means = np.sum(signals * real[..., None], axis=1) / segments.lengths[:, None]
    columns = zip(names((*segments.system.states, *segments.system.inputs)), means.T, strict=True)
    found = []
    for name, values in columns:
        if name not in known or not np.ptp(values) > MIN_SIGNAL_SPREAD * np.abs(values).max(initial=0.0):
            continue  # it does not vary
        ps = [motion_p(values, sums[:, i], derivatives[:, i], scores, blocks) for i in measured]
        found.append(Signal(name, values, min(ps)))
    level = MOTION_LEVEL / max(1, len(found) * len(measured))
    return sorted((s for s in found if s.p < level), key=lambda s: s.p)


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


def cluster_segments(scores: FitScores, groups: Indices, *, simulate: bool = False) -> Clusters:
    """The clusters of groups of segments, with what chance does if asked for."""
    first = np.unique(groups, return_index=True)[1]
    sums = np.zeros((len(first), scores.scores.shape[1]))
    np.add.at(sums, groups, scores.scores)
    by_chance = scores.simulate_white(SIMULATIONS, groups) if simulate else None
    return Clusters(sums, scores.information(groups), scores.optimum.equations.segments.phase[first], by_chance)


class RejectedWidth(NamedTuple):
    """A width that the logs reject."""

    name: str
    fall: float  # of the squared residuals, in noise variances, to the width of the best fit
    shifts: Array  # what each free parameter of the fit changes by to there, to first order; at most to a width of zero


def suspect_widths(misfit: Misfit, problem: EstimationProblem, fit: Fit, variance: float) -> Misfit:
    """The misfit, with the stated widths that the logs reject, where they move an estimate beyond its interval."""
    if not fit.status.converged or misfit.covariance is None:
        return misfit
    level = SIGNIFICANT_FALL * max(1.0, variance) * max(1.0, misfit.inflation)
    half_widths = t_quantile(misfit.dof) * np.sqrt(np.diag(misfit.covariance))
    rejected = [width for width in score_widths(problem, fit) if width.fall > level]
    found = [width for width in rejected if (BIAS_SHIFTS * np.abs(width.shifts) > half_widths).any()]
    shifts = np.sum([np.abs(width.shifts) for width in found], axis=0) if found else None
    return replace(misfit, rejected_widths=tuple(w.name for w in found), shifts=shifts)


def score_widths(problem: EstimationProblem, fit: Fit) -> Iterator[RejectedWidth]:
    """The changes by each width of a model, if a converged fit estimated it, too.

    Nothing where gaps stand for noise of the states, whose costs have other weights.
    """
    names = fixed_widths(problem)
    if not names or fit.jumps is not None:
        return
    freed = replace(problem, parameters=problem.parameters.freed(*names))
    here = replace(problem.method, stages=(replace(problem.method.stages[-1], iterations=0),), progress=None)
    found = solve_least_squares(freed.transcription(freed.start_from(fit)), here)
    free = found.parameters.free_names
    scales = np.array([p.value if p.log else 1.0 for p in (found.parameters[n] for n in free)])
    own = [free.index(n) for n in fit.parameters.free_names]
    if found.optimum is None:
        return
    for name in names:
        arrow, keep = found.optimum.equations.arrow, found.optimum.keep.copy()
        reduced, place = arrow.eliminate(0.0), free.index(name)
        keep[[free.index(n) for n in names]] = False
        without = reduced and reduced.step(keep)
        keep[place] = found.optimum.keep[place]
        step = reduced and reduced.step(keep)
        if step and without:
            fall, moves = arrow.descent_rate(step) - arrow.descent_rate(without), scales * step.parameters
            yield RejectedWidth(name, fall, moves[own] / max(1.0, -moves[place] / found.parameters.value(name)))


def fixed_widths(problem: EstimationProblem) -> list[str]:
    """The widths of the model that are not free; a free one is an estimate itself."""
    names = [w.name for w in problem.system.plant.identification_hints.widths]
    return [n for n in names if n in problem.parameters and not problem.parameters[n].free]
