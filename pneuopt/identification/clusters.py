"""`robust_covariance`: the covariance of estimates whose residuals are correlated in time, or differ from log to log.

Residuals count in clusters: blocks of time, and logs. Where the clusters agree on the parameters as chance lets them
(after Chow, Econometrica 28, 1960), the covariance of white residuals stays. Otherwise the estimates' changes when one
cluster is left out measure their variance: CR3, the jackknife, over blocks of time, CR2 over logs, each with the
degrees of freedom of Bell and McCaffrey (Survey Methodology 28(2), 2002), so that few clusters give a wide interval and
not a lucky one. `problems/identify/interval_coverage.py` measures the coverage.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, t

from pneuopt.quantities.arrays import Array, Indices, Mask

# blocks of time at the finest level, halved twice: more miss slow residuals, fewer leave hardly a degree of freedom
TIME_BLOCKS = 24
# probability [1] that chance makes the clusters disagree so much, below which intervals are widened: higher widens
# those of exact models, lower leaves a slow misfit unseen
GATE_LEVEL = 0.05
# degrees of freedom [1] that a level needs to count: with fewer its intervals are wide whatever the residuals are
MIN_TIME_DOF, MIN_LOG_DOF = 3.0, 1.3
# degrees of freedom [1] with which the best level counts where none has enough: fewer make an interval of nothing,
# more trust a parameter that one moment of the log determines
LEAST_TIME_DOF = 2.0
# share of the whole information [1] that is added to what is left without a cluster: smaller lets a cluster that alone
# determines a parameter have a change without limit, larger hides its weight
LEFT_OUT_REGULARISATION = 1e-3
# information that every cluster counts as having, in its average share [1]: less lets scores count that hardly tell
# anything, more hides a disagreement of short clusters
ASSUMED_SHARE = 0.1
SIMULATIONS = 40  # of white residuals: fewer misjudge what chance does, more cost time
SLOW_RATIO = 2.0  # variance by the coarsest blocks over that by the finest [1] that shows a misfit as slow as the log
LEVEL = 0.95  # of the intervals by which the levels are compared [1]


@dataclass(frozen=True, eq=False)
class Clusters:
    """Residuals in K clusters, as k parameters see them.

    Parameters
    ----------
    scores : ndarray, shape (K, k)
        Gradient of half the squared residuals of each cluster by the parameters; they sum to zero at an optimum.
    information : ndarray, shape (K, k, k)
        J'J of each cluster, for residuals in noise standard deviations.
    logs : ndarray of int, shape (K,)
        The log that each cluster is of, in ascending order; a log's clusters are in the order of time.
    by_chance : ndarray, shape (n, K, k), optional
        Scores of n fits to white residuals of unit variance; by default those of independent residuals.
    """

    scores: Array
    information: Array
    logs: Indices
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
    """The variance of estimates by one set of clusters.

    Attributes
    ----------
    covariance : ndarray, shape (k, k)
    dof : ndarray, shape (k,)
        Bell and McCaffrey's degrees of freedom of each variance.
    changes : ndarray, shape (K, k)
        What each cluster adds to the estimates, by which the covariance is made.
    """

    covariance: Array
    dof: Array
    changes: Array


@dataclass(frozen=True, eq=False)
class RobustCovariance:
    """The covariance of estimates, and what it rests on.

    Attributes
    ----------
    covariance : ndarray, shape (k, k)
    dof : ndarray, shape (k,)
        Degrees of freedom of each variance: of Student's t for an interval.
    widened : bool
        Whether the clusters disagree more than chance lets them.
    is_slow : bool
        Whether the misfit varies as slowly as the logs, or from log to log.
    lone : ndarray of bool, shape (k,)
        Parameters that one of several logs alone determines: how they scatter between logs is unknown.
    """

    covariance: Array
    dof: Array
    widened: bool
    is_slow: bool
    lone: Mask


def robust_covariance(
    blocks: Clusters, white: Array, variance: float, dof: float, classes: Sequence[Clusters] = ()
) -> RobustCovariance:
    """The covariance that makes each parameter's interval the widest among those of white residuals and of clusters.

    Parameters
    ----------
    blocks : Clusters
        Blocks of time, `TIME_BLOCKS` or so over all logs.
    white : ndarray, shape (k, k)
        The covariance for white residuals.
    variance, dof : float
        Of the residuals, in noise variances, and its degrees of freedom.
    classes : sequence of Clusters
        Further clusters, by a motion on which the residuals depend; with any, the gate does not count.

    Returns
    -------
    RobustCovariance
    """
    times = [c for c in _distinct([blocks, blocks.halve(), blocks.halve().halve()]) if c.count > 1]
    logs = [blocks.by_log()] if len(np.unique(blocks.logs)) > 1 else []
    levels = [*times, *logs]
    none = np.zeros(len(white), dtype=bool)
    agree = min((disagreement_p(c, variance) for c in levels), default=1.0) * len(levels) >= GATE_LEVEL
    if not levels or (agree and not classes):
        return RobustCovariance(white, np.full(len(white), dof), widened=False, is_slow=False, lone=none)
    within = [jackknife(c) for c in (*times, *classes) if c.count > 1]
    between = [between_clusters(c) for c in logs]
    enough = np.minimum(np.max([s.dof for s in within], axis=0), MIN_TIME_DOF)
    spreads = [(s._replace(dof=np.maximum(s.dof, LEAST_TIME_DOF)), s.dof >= enough) for s in within]
    spreads += [(s, s.dof >= MIN_LOG_DOF) for s in between]
    covariance, degrees = _widest(white, dof, spreads)
    lone = between[0].dof < MIN_LOG_DOF if between else none
    slow = len(times) > 1 and _is_slow(within[len(times) - 1], within[0])
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

    Parameters
    ----------
    clusters : Clusters
    variance : float
        Of the residuals, in noise variances.

    Returns
    -------
    float
        Of Chow's statistic, the decrease of squared residuals if each cluster had its own parameters; it counts as
        chi-square with the mean and the variance that it has by chance (Satterthwaite 1946).
    """
    scale, own = _whiten(clusters)
    scores = _simulate_scores(own) if clusters.by_chance is None else clusters.by_chance @ scale.T
    assumed = ASSUMED_SHARE / clusters.count * np.eye(len(scale))
    seen, *chance = _chow(
        np.concatenate([(clusters.scores @ scale.T)[None], scores]),
        np.asarray(np.linalg.inv(own + assumed), dtype=np.float64),
    )
    mean, spread = float(np.mean(chance)), float(np.var(chance, ddof=1))
    return float(chi2.sf(seen / variance * 2 * mean / spread, 2 * mean**2 / spread)) if spread > 0 else 1.0


def t_quantile(dof: Array | float, level: float = LEVEL) -> Array:
    """Half width of an interval in standard deviations, by Student's t."""
    return np.asarray(t.ppf(0.5 + level / 2, dof))


def _chow(scores: Array, inverse: Array) -> Array:
    """Chow's statistic of sets of whitened scores, shape (n, K, k), with the inverse information of each cluster."""
    return np.asarray(np.einsum("ngi,gij,ngj->n", scores, inverse, scores, optimize=True))


def _simulate_scores(own: Array) -> Array:
    """Whitened scores of fits to independent residuals, shape (SIMULATIONS, K, k), by each cluster's share H_g.

    The scores z_g at the true parameters have the covariance H_g; at the estimates they are z_g - H_g sum(z).
    """
    values, vectors = np.linalg.eigh(own)
    normal = np.random.default_rng(0).standard_normal((SIMULATIONS, *own.shape[:2]))
    true = np.einsum("gij,gj,ngj->ngi", vectors, np.sqrt(np.maximum(values, 0.0)), normal)
    return np.asarray(true - np.einsum("gij,nj->ngi", own, true.sum(axis=1)))


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


def _widest(white: Array, dof: float, spreads: Sequence[tuple[Spread, Mask]]) -> tuple[Array, Array]:
    """For each parameter the variance with the widest interval, and its degrees of freedom.

    The mask tells for which parameters a spread counts.
    """
    variance, freedom, together = np.diag(white).copy(), np.full(len(white), dof), white.copy()
    for spread, counts in spreads:
        own, own_dof = np.diag(spread.covariance), np.where(counts, spread.dof, dof)
        wider = counts & (t_quantile(own_dof) * np.sqrt(own) > t_quantile(freedom) * np.sqrt(variance))
        variance, freedom = np.where(wider, own, variance), np.where(wider, own_dof, freedom)
        together += spread.covariance
    stretch = np.sqrt(variance / np.diag(together))
    return together * np.outer(stretch, stretch), freedom


def _is_slow(coarse: Spread, fine: Spread) -> bool:
    """Whether coarser blocks see clearly more variance: the residuals vary as slowly as the blocks last."""
    return bool(np.median(np.diag(coarse.covariance) / np.diag(fine.covariance)) > SLOW_RATIO)


def _distinct(levels: Sequence[Clusters]) -> list[Clusters]:
    """The levels without those of as many clusters as one before: halving ends at one cluster a log."""
    return [c for i, c in enumerate(levels) if c.count not in [known.count for known in levels[:i]]]
