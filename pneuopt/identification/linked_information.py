"""`linked_information`: what a log that is cut into linked segments tells about parameters, once it is identified.

`identify` weighs the gaps between segments as if the states jumped there a little, and its covariance is the sandwich
B^-1 M B^-1 (`Equations.covariance`): B is the Gram matrix of data and gaps with the nodes eliminated, M that of the
data alone with the nodes where B puts them, since true gaps carry no noise. Its inverse B M^-1 B is the information
here: with B itself, a planned run of an EMPS axis promised intervals three times as wide as its fit had, and the search
took other runs for the best (problems/identify/next_experiment.py). The sum over logs is that of a joint fit where the
weights of the gaps lose little.
"""

import numpy as np

from pneuopt.quantities.arrays import Array

STATE_RIDGE = 1e-6  # information about a node's state that is always there, in nominal sizes: only keeps it invertible
SINGULAR = 1e-13
"""Share of the largest information about a start state [1] below which it is rounding: more keeps what is none."""
UNINFORMED = 1e-12  # the same of the parameters [1]: less takes rounding for knowledge


def linked_information(grams: Array, ends: Array, jumps: Array, eliminated: int = 0) -> Array:
    """The information of linked segments about parameters, as the estimates of `identify` have it; shape (m, k, k).

    Parameters
    ----------
    grams : ndarray, shape (m, count, n + w, n + w)
        Of m logs and their segments: the data's Gram matrices about start state and parameters, in unit noise.
    ends : ndarray, shape (m, count, n, n + w)
        Derivatives of each segment's end state by the same.
    jumps : ndarray, shape (n,)
        Standard deviations that the gaps are weighed with. States and jumps are in nominal sizes.
    eliminated : int
        So many parameters, the first ones, are each log's own; k are the others.
    """
    m, count, n, width = ends.shape
    gaps, follows = _gap_information(ends[:, :-1], 1 / jumps**2), list[Array]()
    found = grams[:, 0]
    for j in range(count - 1):
        ahead, response = _advance(found, gaps[:, j], n)
        follows.append(response)
        found = ahead + grams[:, j + 1]
    last = n + eliminated
    response = _respond(found, last)
    bread = found[:, last:, last:] + np.swapaxes(found[:, :last, last:], 1, 2) @ response
    k = width - last
    parameters = np.concatenate([response[:, n:], np.broadcast_to(np.eye(k), (m, k, k))], axis=1)
    node, meat = response[:, :n], np.zeros((m, k, k))
    for j in reversed(range(count)):
        if j < count - 1:
            node = follows[j][:, :, :n] @ node + follows[j][:, :, n:] @ parameters
        moves = np.concatenate([node, parameters], axis=1)
        meat += np.swapaxes(moves, 1, 2) @ grams[:, j] @ moves
    return _symmetric(bread @ _scaled_inverse(meat, UNINFORMED) @ bread)


def _gap_information(ends: Array, weight: Array) -> Array:
    """What each gap tells about its two nodes' states and the parameters, shape (..., 2 n + w, 2 n + w).

    In nominal sizes: x_next = ends (x, p) + w, with w of variances 1 / `weight`, shape (n,).
    """
    n = len(weight)
    slopes = np.concatenate([ends[..., :n], np.broadcast_to(-np.eye(n), (*ends.shape[:-1], n)), ends[..., n:]], axis=-1)
    out = (np.swapaxes(slopes, -1, -2) * weight) @ slopes
    place = np.arange(n)
    out[..., place, place] += STATE_RIDGE
    return np.asarray(out)


def _advance(information: Array, gap: Array, n: int) -> tuple[Array, Array]:
    """The information about the next node's state and the parameters from that about this node's, shape (m, k, k).

    And how this node's state follows those, shape (m, n, k); `gap` is of `_gap_information`.
    """
    out, mixed = gap[:, n:, n:].copy(), gap[:, :n, n:].copy()
    out[:, n:, n:] += information[:, n:, n:]
    mixed[:, :, n:] += information[:, :n, n:]
    response = np.asarray(-np.linalg.solve(gap[:, :n, :n] + information[:, :n, :n], mixed), dtype=np.float64)
    return _symmetric(out + np.swapaxes(mixed, 1, 2) @ response), response


def _respond(information: Array, count: int) -> Array:
    """How the first `count` unknowns follow the others, shape (m, count, k - count)."""
    return -_scaled_inverse(information[:, :count, :count], SINGULAR) @ information[:, :count, count:]


def _scaled_inverse(information: Array, smallest: float) -> Array:
    """The pseudoinverse of symmetric matrices of mixed units, shape (m, k, k)."""
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    scale = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.pinv(information / scale, rcond=smallest, hermitian=True) / scale)


def _symmetric(values: Array) -> Array:
    return np.asarray((values + np.swapaxes(values, 1, 2)) / 2)
