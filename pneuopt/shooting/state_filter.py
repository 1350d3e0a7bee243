"""`filter_nodes`: the states at the nodes of segments by an iterated extended Kalman filter, the parameters known.

States that a filter reads off the measurements do not fit together where a drive sticks and slips, and a search over
all nodes at once frees one such place after the other. The Kalman filter follows the model from node to node (Bell and
Cathey, IEEE Transactions on Automatic Control 38(2), 1993, for its iteration), in pieces of the log side by side.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.integration_steps import choose_integration
from pneuopt.shooting.segments import Segments

PIECE_SEGMENTS = 300  # segments a piece: more take more steps one after the other, fewer waste more on the lead
# segments before a piece from which its states come: fewer leave it the error of its start, more cost time
LEAD_SEGMENTS = 300
START_DEVIATION = 0.1  # of the state where a piece or a log begins, in nominal sizes [1]: about that of rough states
# deviation that a state gathers from one node to the next, in nominal sizes [1], by parameters that are not known well:
# lower follows wrong ones away from the measurements, higher leaves states that do not fit together
GATHERED_DEVIATION = 1e-4
KNOWN_DEVIATION = 1e-6  # of a state that is given, likewise
UPDATES = 4  # linearisations a segment: fewer miss a slip, more cost time
SETTLED_SQUARES = 0.01  # change of the squares [1] by which no state counts: lower takes updates that move none
STEP_CUT = 0.3  # of a step that has not helped [1]: higher tries it again too far, lower hardly moves


def filter_nodes(segments: Segments, nodes: Array, q: Array, gathered: float = GATHERED_DEVIATION) -> Array:
    """Filter the states at the nodes.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
        Rough states, from which the pieces start.
    q : ndarray, shape (k,)
        Values of all parameters of the problem.
    gathered : float
        Deviation that a state gathers from one node to the next, in nominal sizes.

    Returns
    -------
    ndarray, shape (m, n_states)
        Estimates from the measurements up to each segment's end.
    """
    first = np.arange(0, segments.count, PIECE_SEGMENTS)
    segments, substeps = choose_integration(segments, nodes, q)
    rough, found = nodes / segments.nominal, nodes / segments.nominal
    heads = np.append(True, ~segments.linked[:-1])
    start = np.where(np.isfinite(segments.fixed_start), KNOWN_DEVIATION, START_DEVIATION) ** 2
    x, P = rough[first], np.zeros((len(first), nodes.shape[1], nodes.shape[1]))
    for step in range(-LEAD_SEGMENTS, PIECE_SEGMENTS):
        at = np.clip(first + step, 0, segments.count - 1)
        begins = (step == -LEAD_SEGMENTS) | heads[at] | ~np.isfinite(x).all(axis=1) | ~np.isfinite(P).all(axis=(1, 2))
        x = np.where(begins[:, None], rough[at], x)
        P = np.where(begins[:, None, None], start[at][:, None] * np.eye(nodes.shape[1]), P)
        updated = update_states(segments, at, x, P, q[segments.parameter_positions[at]], substeps)
        x, P = updated.end, updated.spread(gathered)
        own = np.flatnonzero((step >= 0) & (first + step < segments.count) & np.isfinite(updated.state).all(axis=1))
        found[at[own]] = updated.state[own]
    return np.asarray(found * segments.nominal)


class StateUpdate(NamedTuple):
    """The states of g segments by what was known of them before and by their data; n of them, of nominal size 1.

    Attributes
    ----------
    state, end : ndarray, shape (g, n)
        At the node, and at the segment's end; NaN there where the model is not finite.
    squares : ndarray, shape (g,)
        Those of the residuals, and of the state's change over what was known of it.
    gram : ndarray, shape (g, n + n_columns + 1, n + n_columns + 1)
        Of the slopes of what is predicted, in the states and the parameters, and of its errors, in noise deviations.
    moved : ndarray, shape (g, n, n + n_columns)
        Slopes of the end.
    prior, information : ndarray, shape (g, n, n)
        The inverse covariance of the states, without these data and with them.
    """

    state: Array
    end: Array
    squares: Array
    gram: Array
    moved: Array
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

    Parameters
    ----------
    segments : Segments
    at : ndarray of int, shape (g,)
        Positions of the segments, one of which may be there several times.
    before, P : ndarray, shape (g, n) and (g, n, n)
        The states and their covariance without these data, of nominal size 1.
    values : ndarray, shape (g, n_system_parameters)
        The parameters of each.
    substeps : int
        Integration steps a sample.

    Returns
    -------
    StateUpdate
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
