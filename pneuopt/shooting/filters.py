"""Extended Kalman filters over the segments, and what each segment of a fit says about the parameters.

`filter_nodes`: the states at the nodes, the parameters known. States that are read off the measurements do not fit
together where a drive sticks and slips, and a search over all nodes at once frees one such place after the other. The
Kalman filter follows the model from node to node (Bell and Cathey, IEEE Transactions on Automatic Control 38(2), 1993,
for its iteration), in pieces of the log side by side.

`PredictionErrors`: where sets of parameters had better be. Nodes with wide gaps take over what wrong parameters miss; a
filter has no such unknowns: it predicts each segment from those before it, and its errors lead to the parameters
(Ljung, System Identification, 2nd ed. 1999, chapter 7), past few side minima where states may gather wide deviations.

`fit_scores`: the gradient of half a segment's squares (its data, and the gap behind it) by the parameters, with the
nodes following them, which sum to zero at an optimum; and the information J'J of the same residuals.
"""

import itertools
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.equations import NormalEquations, ParameterScaling
from pneuopt.shooting.least_squares import Optimum
from pneuopt.shooting.segments import Segments, choose_integration
from pneuopt.shooting.tolerances import (
    DAMPINGS,
    FIRST_DAMPING,
    GATHERED_DEVIATION,
    GIVEN_UP_DAMPING,
    KNOWN_DEVIATION,
    LEAST_DAMPING,
    MAX_BATCH_NUMBERS,
    PIECE_SEGMENTS,
    ROBUST_SQUARES,
    SETTLED_DECREASE,
    SETTLED_SQUARES,
    START_DEVIATION,
    STEP_CUT,
    UPDATES,
)


def filter_nodes(segments: Segments, nodes: Array, q: Array, gathered: float = GATHERED_DEVIATION) -> Array:
    """Filter the states at the nodes (m, n_states), rough `nodes` before, by measurements up to each segment's end.

    `q` (k,) holds all parameters; `gathered` is the deviation of a state from node to node, in nominal sizes.
    """
    segments, substeps = choose_integration(segments, nodes, q)
    rough, found = nodes / segments.nominal, nodes / segments.nominal
    heads = np.flatnonzero(np.append(True, ~segments.linked[:-1]))
    runs = itertools.pairwise([*heads.tolist(), segments.count])
    first, ends = np.array([(k, min(k + PIECE_SEGMENTS, b)) for a, b in runs for k in range(a, b, PIECE_SEGMENTS)]).T
    begins = np.maximum(first - PIECE_SEGMENTS, heads[np.searchsorted(heads, first, "right") - 1])
    start = np.where(np.isfinite(segments.fixed_start), KNOWN_DEVIATION, START_DEVIATION) ** 2
    x, P = rough[begins], start[begins][:, None] * np.eye(nodes.shape[1])
    for step in range(int((ends - begins).max())):
        rows = np.flatnonzero(begins + step < ends)
        at = begins[rows] + step
        is_lost = ~np.isfinite(x[rows]).all(axis=1) | ~np.isfinite(P[rows]).all(axis=(1, 2))
        x[rows[is_lost]], P[rows[is_lost]] = rough[at[is_lost]], start[at[is_lost]][:, None] * np.eye(nodes.shape[1])
        updated = update_states(segments, at, x[rows], P[rows], q[segments.parameter_positions[at]], substeps)
        x[rows], P[rows] = updated.end, updated.spread(gathered)
        own = (at >= first[rows]) & np.isfinite(updated.state).all(axis=1)
        found[at[own]] = updated.state[own]
    return np.asarray(found * segments.nominal)


class StateUpdate(NamedTuple):
    """The states of g segments by what was known of them before and by their data; n of them, of nominal size 1."""

    # state, end (g, n): at the node, and at the segment's end; NaN there where the model is not finite
    state: Array
    end: Array
    squares: Array  # (g,): those of the residuals, and of the state's change over what was known of it
    # (g, n + n_columns + 1, n + n_columns + 1): of the slopes of what is predicted, in the states and the parameters,
    # and of its errors, in noise deviations
    gram: Array
    moved: Array  # (g, n, n + n_columns): slopes of the end
    # prior, information (g, n, n): the inverse covariance of the states, without these data and with them
    prior: Array
    information: Array

    @np.errstate(all="ignore")  # as of what it is made from
    def spread(self, gathered: float) -> Array:
        """The covariance at the ends, with a deviation that each state gathers along a segment. Shape (g, n, n)."""
        n = self.state.shape[1]
        moved = self.moved[..., :n]
        kept = solve_each(self.information, moved.transpose(0, 2, 1))
        return np.asarray(moved @ kept + gathered**2 * np.eye(n))


@np.errstate(all="ignore")  # a step too far may overflow; it is not kept
def update_states(
    segments: Segments, at: Indices, before: Array, P: Array, values: Array, substeps: int
) -> StateUpdate:
    """Update the states of some segments by their data: Gauss-Newton, whose steps are cut where they do not help.

    Segment `at` (g,) has states `before` (g, n) of covariance `P` (g, n, n) in nominal sizes, and parameters (g, k).
    """
    n, nominal = before.shape[1], segments.nominal
    prior = solve_each(P, np.tile(np.eye(n), (len(at), 1, 1)))
    given = segments.inputs[at], values, segments.t[at], segments.h[at], segments.measured[at], segments.weights[at]
    scale = np.append(nominal, np.ones(segments.sensitivities.n_columns - n + 1))
    both = np.outer(scale, scale)
    x, step, kept = before.copy(), np.zeros_like(before), None
    for _ in range(UPDATES):
        run = segments.sensitivities.gram(x * nominal, *given, substeps=substeps)
        gram, away = run.grams * both, x - before
        pull = (prior @ away[..., None])[..., 0]
        squares = gram[:, -1, -1] + np.sum(away * pull, axis=1)
        moved = run.dx_end * (scale[:-1] / nominal[:, None])
        trial = StateUpdate(x, run.x_end / nominal, squares, gram, moved, prior, prior + gram[:, :n, :n])
        if kept is None:
            better = np.arange(len(at))
            kept = trial._replace(squares=np.where(np.isfinite(squares), squares, np.inf))
        else:
            is_settled = bool((np.abs(squares - kept.squares) < SETTLED_SQUARES).all())
            better = np.flatnonzero(squares < kept.squares)
            for old, new in zip(kept, trial, strict=True):
                old[better] = new[better]
            if is_settled:
                break
        downhill = -gram[:, :n, -1] - pull
        step *= STEP_CUT
        step[better] = solve_each(trial.information[better], downhill[better][..., None])[..., 0]
        x = kept.state + step
    assert kept is not None
    kept.end[~np.isfinite(kept.squares)] = np.nan
    return kept


def solve_each(A: Array, b: Array) -> Array:
    """The solutions of g systems of equations, shapes (g, n, n) and (g, n, k); NaN of those that are singular."""
    try:
        return np.asarray(np.linalg.solve(A, b))
    except np.linalg.LinAlgError:
        out = np.full(b.shape, np.nan)
        for i in range(len(A)):
            with suppress(np.linalg.LinAlgError):
                out[i] = np.linalg.solve(A[i], b[i])
        return out


class Errors(NamedTuple):
    """The cost of some sets of k parameters with its gradient and curvature: (s,), (s, k), (s, k, k)."""

    costs: Array
    gradients: Array
    curvatures: Array


class PredictionErrors:
    """The prediction errors of an extended Kalman filter over part of a log, for sets of parameters side by side.

    It begins at the rough `nodes` (m, n_states) where a segment of `part`, in order, does not continue the one before.
    """

    def __init__(self, segments: Segments, nodes: Array, scaling: ParameterScaling, part: Indices) -> None:
        self.segments, self.scaling, self.part, self._rough = segments, scaling, part, nodes / segments.nominal
        self._begins = np.append(True, (np.diff(part) > 1) | ~segments.linked[part[:-1]])
        self._counts = np.isfinite(segments.measured).sum(axis=(1, 2))
        self.count = int(self._counts[part].sum())
        self.adapt_steps(scaling.start[None])

    def adapt_steps(self, z: Array) -> None:
        """Take the steps that the stiffest of sets (s, k) asks for: by fewer, right parameters lost their slips."""
        nodes = self._rough * self.segments.nominal
        found = [choose_integration(self.segments, nodes, self.scaling.values(each)) for each in z]
        implicit = [segments for segments, _ in found if segments.implicit_state is not None]
        self.segments, self.substeps = (implicit or [found[0][0]])[0], max(steps for _, steps in found)

    @np.errstate(all="ignore")  # what overflows is lost, and its cost infinite
    def evaluate(self, z: Array, gathered: float) -> Errors:
        """The errors of sets of searched parameters (s, k); the filter's gain counts as constant in the derivatives."""
        (count, k), n = z.shape, self._rough.shape[1]
        q = np.array([self.scaling.values(each) for each in z])
        chain = np.array([self.scaling.chain(each) for each in z])[:, None]
        sums = Errors(np.zeros(count), np.zeros((count, k)), np.zeros((count, k, k)))
        for at, begins in zip(self.part.tolist(), self._begins.tolist(), strict=True):
            if begins:
                x, X = np.tile(self._rough[at], (count, 1)), np.zeros((count, n, k))
                P = np.tile(START_DEVIATION**2 * np.eye(n), (count, 1, 1))
            values = q[:, self.segments.parameter_positions[at]]
            found = update_states(self.segments, np.full(count, at), x, P, values, self.substeps)
            gram, errors, prior = found.gram[:, :-1, :-1], found.gram[:, :-1, -1:], found.prior
            unknowns = self.segments.unknowns[at]
            own = np.flatnonzero(unknowns >= 0)  # the segment's own parameters, which move with those searched
            direct = np.zeros((count, len(unknowns), k))
            direct[:, own, unknowns[own]] = chain[:, 0, unknowns[own]]
            moved = solve_each(found.information, prior @ X - gram[:, :n, n:] @ direct)
            moves, away = np.concatenate([moved, direct], axis=1), moved - X
            turned, pull = moves.transpose(0, 2, 1), prior @ away
            limit = ROBUST_SQUARES * self._counts[at]
            weights = 1 / (1 + found.squares / limit)
            uphill = turned @ errors + pull.transpose(0, 2, 1) @ (found.state - x)[..., None]
            squares = turned @ (gram @ moves) + away.transpose(0, 2, 1) @ pull
            sums.costs[:] += limit * np.log1p(found.squares / limit)
            sums.gradients[:] += weights[:, None] * uphill[..., 0]
            sums.curvatures[:] += weights[:, None, None] * squares
            x, X, P = found.end, found.moved @ moves, found.spread(gathered)
            lost = ~(np.isfinite(x).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & np.isfinite(X).all(axis=(1, 2)))
            sums.costs[lost], x[lost], X[lost], P[lost] = np.inf, self._rough[at], 0.0, START_DEVIATION**2 * np.eye(n)
        return sums

    def descend(self, z: Array, gathered: float, steps: int) -> tuple[Array, Array]:
        """Levenberg-Marquardt from sets of searched parameters (s, k) side by side: their ends, and costs (s,)."""
        self.adapt_steps(z)
        z, damping = z.copy(), np.full(len(z), FIRST_DAMPING)
        costs, gradients, curvatures = (a.copy() for a in self.evaluate(z, gathered))
        active = np.isfinite(costs)
        for _ in range(steps):
            rows = np.flatnonzero(active)
            if not rows.size:
                break
            tries = [(i, each) for i in rows.tolist() for each in (np.array(DAMPINGS) * damping[i]).tolist()]
            trials = np.array([self._step(z[i], gradients[i], curvatures[i], each) for i, each in tries])
            found = self.evaluate(trials, gathered)
            for j, i in enumerate(rows.tolist()):
                best = j * len(DAMPINGS) + int(np.argmin(found.costs[j * len(DAMPINGS) : (j + 1) * len(DAMPINGS)]))
                if found.costs[best] < costs[i]:
                    active[i] = costs[i] - found.costs[best] > SETTLED_DECREASE * costs[i]
                    z[i], damping[i] = trials[best], max(tries[best][1], LEAST_DAMPING)
                    costs[i], gradients[i], curvatures[i] = (part[best] for part in found)
                else:
                    active[i], damping[i] = damping[i] < GIVEN_UP_DAMPING, 1e3 * damping[i]
        return z, costs

    def _step(self, z: Array, gradient: Array, curvature: Array, damping: float) -> Array:
        """Where a damped step of the parameters that are not fixed leads, within the bounds."""
        free = np.flatnonzero(~self.scaling.fixed & (np.diag(curvature) > 0))
        own = curvature[np.ix_(free, free)]
        step = np.zeros(len(z))
        step[free] = -np.linalg.lstsq(own + damping * np.diag(np.diag(own)), gradient[free], rcond=None)[0]
        longest = np.where(self.scaling.log, 1.0, np.maximum(np.abs(z), 1.0))  # a longer step leaves the model's range
        return self.scaling.project_to_bounds(z + np.clip(step, -longest, longest))


@dataclass(frozen=True, eq=False)
class FitScores:
    """The scores and the information of m segments about the k parameters that a fit has kept free, in own units."""

    optimum: Optimum
    # (m, n_columns, k): how a segment's start state (in nominal sizes) and sensitivity columns move with the
    # parameters
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

        Nodes follow the residuals of a few segments around, so that scores of neighbours are not independent.
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
    """The scores of a fit's segments; None where the nodes' equations cannot be eliminated, or leave something open."""
    equations, keep = optimum.equations, np.flatnonzero(optimum.keep)
    reduced, linear = equations.arrow.eliminate(0.0), equations.linearisation
    if reduced is None or not len(keep):
        return None
    m, n, columns = *equations.gaps.shape, linear.end_sensitivities.shape[2]
    directions = np.zeros((m, columns, len(optimum.keep)))
    directions[:, :n] = -reduced.node_sensitivity
    for rows, own, unknowns in equations.segments.blocks:
        directions[rows, n + own, unknowns] = linear.chain[unknowns]
    scores = FitScores(optimum, directions[:, :, keep] / linear.chain[keep])
    size = np.sqrt(np.diag(scores.whole_information))
    rank = np.linalg.matrix_rank(scores.whole_information / np.outer(size, size)) if size.all() else 0
    return scores if rank == len(keep) else None
