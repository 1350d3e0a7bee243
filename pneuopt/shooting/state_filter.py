"""`filter_nodes`: the states at the nodes of segments by an iterated extended Kalman filter, the parameters known.

States that a filter reads off the measurements do not fit together where a drive sticks and slips, and a search over
all nodes at once frees one such place after the other. The Kalman filter follows the model from node to node (Bell and
Cathey, IEEE Transactions on Automatic Control 38(2), 1993, for its iteration), in pieces of the log side by side.
"""

import numpy as np

from pneuopt.quantities.arrays import Array, Indices
from pneuopt.shooting.integration_steps import choose_integration
from pneuopt.shooting.segments import Segments

PIECE_SEGMENTS = 300  # segments a piece: more take more steps one after the other, fewer waste more on the lead
# segments before a piece from which its states come: fewer leave it the error of its start, more cost time
LEAD_SEGMENTS = 300
START_DEVIATION = 0.1  # of the state where a piece or a log begins, in nominal sizes [1]: about that of rough states
# deviation that a state gathers from one node to the next, in nominal sizes [1]: lower follows wrong parameters away
# from the measurements, higher leaves states that do not fit together
GATHERED_DEVIATION = 1e-4
KNOWN_DEVIATION = 1e-6  # of a state that is given, likewise
UPDATES = 4  # linearisations a segment: fewer miss a slip, more cost time


def filter_nodes(segments: Segments, nodes: Array, q: Array) -> Array:
    """Filter the states at the nodes.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n_states)
        Rough states, from which the pieces start.
    q : ndarray, shape (k,)
        Values of all parameters of the problem.

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
        updated, x, P = _filter_segments(segments, at, x, P, q, substeps)
        own = np.flatnonzero((step >= 0) & (first + step < segments.count) & np.isfinite(updated).all(axis=1))
        found[at[own]] = updated[own]
    return np.asarray(found * segments.nominal)


def _filter_segments(
    segments: Segments, at: Indices, before: Array, P: Array, q: Array, substeps: int
) -> tuple[Array, Array, Array]:
    """The states of some segments with their data, and those at their ends with the covariance (all scaled)."""
    n, nominal = before.shape[1], segments.nominal
    prior, measured = np.linalg.inv(P), segments.measured[at]
    known, weights = np.isfinite(measured), np.where(np.isfinite(measured), segments.weights[at], 0.0)
    given = segments.inputs[at], q[segments.parameter_positions[at]], segments.t[at], segments.h[at]
    x, best = before.copy(), np.full(len(at), np.inf)
    kept = before.copy(), before.copy(), np.zeros_like(P), prior.copy()
    for _ in range(UPDATES):
        with np.errstate(all="ignore"):  # a step too far may overflow; it is not kept
            run = segments.sensitivities.run(x * nominal, *given, substeps=substeps)
            assert run.dy is not None
            assert run.dx_end is not None
            residuals = (weights * (np.where(known, measured, 0.0) - run.y)).reshape(len(at), -1)
            slopes = (weights[..., None] * run.dy[..., :n] * nominal).reshape(len(at), -1, n)
            away = x - before
            cost = np.sum(residuals**2, axis=1) + np.einsum("gi,gij,gj->g", away, prior, away)
        better = np.flatnonzero(cost < best)
        if not better.size:
            break
        best[better] = cost[better]
        information = prior + slopes.transpose(0, 2, 1) @ slopes
        news = (x, run.x_end / nominal, run.dx_end[..., :n] * nominal / nominal[:, None], information)
        for old, new in zip(kept, news, strict=True):
            old[better] = new[better]
        gradient = np.einsum("gri,gr->gi", slopes, residuals) - np.einsum("gij,gj->gi", prior, away)
        x = x.copy()
        x[better] += np.linalg.solve(information[better], gradient[better][..., None])[..., 0]
    state, end, moved, posterior = kept
    spread = moved @ np.linalg.inv(posterior) @ moved.transpose(0, 2, 1) + GATHERED_DEVIATION**2 * np.eye(n)
    return state, np.where(np.isfinite(best)[:, None], end, np.nan), spread
