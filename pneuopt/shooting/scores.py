"""`fit_scores`: what each segment of a fit says about the parameters, with the nodes following them.

A segment's score is the gradient of half its squared residuals (its data, and the gap behind it) by the parameters; at
an optimum the scores sum to zero. Its information J'J is that of the same residuals.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.equations import NormalEquations
from pneuopt.shooting.solution import Optimum

MAX_BATCH_NUMBERS = 4_000_000  # numbers of 8 bytes in a batch: more take memory, fewer time


@dataclass(frozen=True, eq=False)
class FitScores:
    """The scores and the information of m segments about the k parameters that a fit has kept free, in their own units.

    Attributes
    ----------
    optimum : Optimum
    directions : ndarray, shape (m, n_columns, k)
        How a segment's start state (in nominal sizes) and sensitivity columns move with the parameters.
    """

    optimum: Optimum
    directions: Array

    @cached_property
    def scores(self) -> Array:
        """Score of each segment, shape (m, k)."""
        gaps = self._equations.gaps / self.optimum.gap_deviations
        data = np.einsum("mck,mc->mk", self.directions, self._equations.linearisation.grams[:, :-1, -1])
        linked = np.einsum("mnk,mn->mk", self._gap_directions, gaps)
        return np.asarray(data + linked)

    def information(self, groups: Indices) -> Array:
        """Information of groups of segments, shape (n_groups, k, k); `groups` has each segment's, in any order."""
        members = [np.flatnonzero(groups == g) for g in range(int(groups.max()) + 1)]
        return np.array([self._group_information(rows) for rows in members])

    def simulate_white(self, count: int, groups: Indices) -> Array:
        """Scores of groups in linear fits to white residuals of unit variance, shape (count, n_groups, k).

        The nodes follow the residuals of a few segments before and behind them, so that the scores of neighbours are
        not independent even where the residuals are.
        """
        rng, grams = np.random.default_rng(0), self._equations.linearisation.grams[:, :-1, :-1]
        values, vectors = np.linalg.eigh(grams)
        roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        order, batches = np.argsort(groups, kind="stable"), -(-count * grams[..., 0].size // MAX_BATCH_NUMBERS)
        first, out = np.searchsorted(groups[order], np.arange(int(groups.max()) + 1)), list[Array]()
        for draws in np.array_split(np.arange(count), min(count, batches)):
            found = self._respond(roots @ rng.standard_normal((*grams.shape[:2], len(draws))))
            out.append(np.add.reduceat(found[order], first))
        return np.moveaxis(np.concatenate(out, axis=2), 2, 0)

    def residual_sums(self) -> tuple[Array, Array]:
        """Sum of each segment's residuals by output, shape (m, n_outputs), and its derivatives, (m, n_outputs, k).

        In noise standard deviations; gaps do not count.
        """
        segments, run = self._equations.segments, self.optimum.run
        weights = np.where(np.isfinite(segments.measured), segments.weights, 0.0)
        sums = np.sum(weights * (run.y - np.nan_to_num(segments.measured)), axis=1)
        return sums, self._equations.linearisation.sums @ self.directions

    @cached_property
    def whole_information(self) -> Array:
        """Information of all segments, shape (k, k)."""
        return self._group_information(np.arange(len(self.directions)))

    @property
    def _equations(self) -> NormalEquations:
        return self.optimum.equations

    @cached_property
    def _gap_directions(self) -> Array:
        """How the gap behind each segment moves, in its standard deviations, shape (m, n_states, k)."""
        linear, n = self._equations.linearisation, self._equations.gaps.shape[1]
        moved = linear.end_sensitivities @ self.directions
        moved[:-1] -= self.directions[1:, :n]
        moved[~self._equations.segments.linked] = 0.0
        return np.asarray(moved / self.optimum.gap_deviations[:, None])

    def _group_information(self, rows: Indices) -> Array:
        E, gaps = self.directions[rows], self._gap_directions[rows]
        data = np.tensordot(E, self._equations.linearisation.grams[rows, :-1, :-1] @ E, ((0, 1), (0, 1)))
        return np.asarray(data + np.tensordot(gaps, gaps, ((0, 1), (0, 1))))

    def _respond(self, noise: Array) -> Array:
        """Scores, shape (m, k, count), of fits to noise: the gradient of each segment's data, (m, n_columns, count)."""
        linear, (m, n, count) = self._equations.linearisation, (*self._equations.gaps.shape, noise.shape[2])
        step = np.zeros_like(noise)
        step[:, :n] = -self._equations.arrow.solve_nodes(noise[:, :n].reshape(m * n, count), 0.0).reshape(m, n, count)
        step -= self.directions @ np.linalg.solve(
            self.whole_information, np.tensordot(self.directions, noise, ((0, 1), (0, 1)))
        )
        ends = linear.end_sensitivities @ step
        ends[:-1] -= step[1:, :n]
        ends[~self._equations.segments.linked] = 0.0
        gaps = ends / self.optimum.gap_deviations[:, None]
        data = np.swapaxes(self.directions, 1, 2) @ (noise + linear.grams[:, :-1, :-1] @ step)
        return np.asarray(data + np.swapaxes(self._gap_directions, 1, 2) @ gaps)


def fit_scores(optimum: Optimum) -> FitScores | None:
    """The scores of a fit's segments.

    Parameters
    ----------
    optimum : Optimum

    Returns
    -------
    FitScores or None
        None where the nodes' equations cannot be eliminated.
    """
    equations, keep = optimum.equations, np.flatnonzero(optimum.keep)
    reduced, linear = equations.arrow.eliminate(0.0), equations.linearisation
    if reduced is None or not len(keep):
        return None
    m, n, columns = *equations.gaps.shape, linear.end_sensitivities.shape[2]
    directions = np.zeros((m, columns, len(optimum.keep)))
    directions[:, :n] = -reduced.node_sensitivity
    for rows, own, unknowns in equations.segments.blocks:
        directions[rows, n + own, unknowns] = linear.chain[unknowns]
    return FitScores(optimum, directions[:, :, keep] / linear.chain[keep])
