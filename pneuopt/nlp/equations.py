"""The lifted least squares at one iterate: data and gap residuals of all segments as normal equations."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pneuopt.nlp.arrow import Arrow, Reduced, indistinct, scaled_inverse
from pneuopt.nlp.segments import Segments

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Equations:
    """The problem linearised at an iterate.

    Attributes
    ----------
    arrow : Arrow
        Of data and gaps together.
    grams : ndarray, shape (m, n + c, n + c)
        The data's own Gram matrix of each segment, in its states and sensitivity columns.
    selection : ndarray, shape (m, c, k)
        d(column)/d(searched parameter).
    ends : ndarray, shape (m, n, n + c)
        Sensitivity of each segment's end, in nominal sizes.
    gaps : ndarray, shape (m, n)
        Gap behind each segment in nominal sizes; zero where nothing follows.
    chain : ndarray, shape (k,)
        d(parameter)/d(searched parameter).
    chi_square, cost, largest_gap : float
        Squared data residuals; half the sum of all squares; largest gap in nominal sizes.
    count : int
        Number of data residuals.
    misfit : ndarray, shape (n_outputs,)
        Root mean square of each output's residuals, in noise standard deviations; 0 where nothing was measured.
    """

    arrow: Arrow
    grams: Array
    selection: Array
    ends: Array
    gaps: Array
    chain: Array
    chi_square: float
    cost: float
    largest_gap: float
    count: int
    misfit: Array

    @property
    def gap_share(self) -> float:
        """Part of the cost that the gaps carry, 0 to 1."""
        return 1 - self.chi_square / (2 * self.cost) if 0 < self.cost < math.inf else 0.0

    def undetermined(self, reduced: Reduced, keep: Mask) -> Indices:
        """Positions, among the kept parameters, of those that the data do not tell apart; empty if they do."""
        square = np.ix_(keep, keep)
        return indistinct(reduced.schur[square], self.arrow.corner[square])

    def covariance(self, keep: Mask, *, noisy_gaps: bool = False) -> Array | None:
        """Covariance of the parameters (own units, unit noise): the sandwich over true data noise only.

        True gaps carry no noise, so the plain inverse is too wide (NUMERICS section 3, step 7); it is right for gaps
        that stand for noise of the states. Rows of parameters that are not kept are NaN; None where the data do not
        determine the kept ones.
        """
        reduced = self.arrow.eliminate(0.0)
        if reduced is None or self.undetermined(reduced, keep).size:
            return None
        bread = scaled_inverse(reduced.schur[np.ix_(keep, keep)])
        out = np.full((len(keep), len(keep)), np.nan)
        if noisy_gaps:
            out[np.ix_(keep, keep)] = bread
            return np.asarray(out * np.outer(self.chain, self.chain))
        E = np.concatenate([-reduced.eliminated, self.selection], axis=1)[:, :, keep]
        meat = np.einsum("mak,mab,mbl->kl", E, self.grams, E, optimize=True)
        out[np.ix_(keep, keep)] = bread @ meat @ bread
        return np.asarray(out * np.outer(self.chain, self.chain))


def normal_equations(
    segments: Segments, nodes: Array, q: Array, chain: Array, sigma: Array, substeps: int
) -> Equations:
    """Run all segments with sensitivities and assemble data and gap residuals.

    Parameters
    ----------
    segments : Segments
    nodes : ndarray, shape (m, n)
    q : ndarray
        All the problem's parameter values.
    chain : ndarray, shape (k,)
        d(parameter)/d(searched parameter) of the free ones.
    sigma : ndarray, shape (n,)
        Standard deviation of a gap, in nominal sizes.
    substeps : int
    """
    run = segments.run(nodes, q, substeps, sensitivities=True)
    assert run.dy is not None
    assert run.dx_end is not None
    m, n = nodes.shape
    scale = np.concatenate([segments.nominal, np.ones(run.dy.shape[-1] - n)])
    known = np.isfinite(segments.measured)
    residual = np.where(known, run.y - segments.measured, 0.0) / segments.noise
    E = np.where(known[..., None], run.dy, 0.0) / segments.noise[..., None] * scale
    E = E.reshape(m, -1, E.shape[-1])
    grams, gradient = np.swapaxes(E, 1, 2) @ E, np.einsum("mra,mr->ma", E, residual.reshape(m, -1))
    selection = np.zeros((m, segments.unknowns.shape[1], len(chain)))
    row, column = np.nonzero(segments.unknowns >= 0)
    unknown = segments.unknowns[row, column]
    selection[row, column, unknown] = chain[unknown]
    arrow = Arrow(
        grams[:, :n, :n].copy(),
        np.zeros((m, n, n)),
        grams[:, :n, n:] @ selection,
        np.einsum("mak,mab,mbl->kl", selection, grams[:, n:, n:], selection, optimize=True),
        gradient[:, :n].copy(),
        np.einsum("mak,ma->k", selection, gradient[:, n:]),
    )
    chi_square = float(np.sum(residual**2))
    ends = run.dx_end * scale / segments.nominal[:, None]
    gaps = gaps_of(segments, nodes, run.x_end)
    off = np.where(np.isfinite(segments.fixed_start), nodes - segments.fixed_start, 0.0) / segments.nominal
    _add_gaps(arrow, segments, gaps, off, ends, selection, sigma)
    cost = 0.5 * (chi_square + float(np.sum((gaps / sigma) ** 2)) + float(np.sum((off / sigma) ** 2)))
    largest = float(np.max(np.abs(gaps), initial=0.0))
    finite = math.isfinite(cost) and bool(np.isfinite(grams).all())
    cost = cost if finite else math.inf
    counts = known.sum(axis=(0, 1))
    misfit = np.sqrt(np.sum(residual**2, axis=(0, 1)) / np.maximum(counts, 1))
    return Equations(arrow, grams, selection, ends, gaps, chain, chi_square, cost, largest, int(counts.sum()), misfit)


def gaps_of(segments: Segments, nodes: Array, x_end: Array) -> Array:
    """Gap behind each segment in nominal sizes, shape (m, n); zero where nothing follows."""
    gaps = np.zeros_like(nodes)
    here = np.flatnonzero(segments.linked)
    gaps[here] = (x_end[here] - nodes[here + 1]) / segments.nominal
    return gaps


def reconnected(
    segments: Segments, equations: Equations, step: Array, moved: Array, nodes: Array, x_end: Array
) -> Array:
    """Second-order correction of a step: shift the nodes so that the gaps become what the linear model promised.

    Parameters
    ----------
    segments : Segments
    equations : Equations
        Where the step (nodes `step`, shape (m, n) in nominal sizes; parameters `moved`, shape (k,)) was computed.
    nodes, x_end : ndarray, shape (m, n)
        The nodes after the step, and where their segments end.

    Returns
    -------
    ndarray, shape (m, n)
    """
    n = nodes.shape[1]
    here = np.flatnonzero(segments.linked)
    own = equations.ends[:, :, :n]
    promised = equations.gaps + np.einsum("mij,mj->mi", own, step)
    promised += np.einsum("mic,mck,k->mi", equations.ends[:, :, n:], equations.selection, moved, optimize=True)
    promised[here] -= step[here + 1]
    excess = gaps_of(segments, nodes, x_end) - promised
    shift = np.zeros_like(nodes)
    for i in here.tolist():
        shift[i + 1] = own[i] @ shift[i] + excess[i]
    return np.asarray(nodes + shift * segments.nominal)


def _add_gaps(
    arrow: Arrow, segments: Segments, gaps: Array, off: Array, ends: Array, selection: Array, sigma: Array
) -> None:
    """Add the gaps between linked segments, and the distance from known starts, as residuals."""
    n = gaps.shape[1]
    weight = 1 / sigma
    here = np.flatnonzero(segments.linked)
    e = gaps[here] * weight
    own = ends[here, :, :n] * weight[:, None]
    ours = ends[here, :, n:] * weight[:, None] @ selection[here]
    own_t = np.swapaxes(own, 1, 2)
    arrow.diagonal[here] += own_t @ own
    arrow.diagonal[here + 1] += np.diag(weight**2)
    arrow.coupling[here] -= own_t * weight
    arrow.border[here] += own_t @ ours
    arrow.border[here + 1] -= weight[:, None] * ours
    arrow.corner[:] += np.einsum("mak,mal->kl", ours, ours, optimize=True)
    arrow.node_gradient[here] += (own_t @ e[..., None])[..., 0]
    arrow.node_gradient[here + 1] -= weight * e
    arrow.gradient[:] += np.einsum("mak,ma->k", ours, e)
    arrow.diagonal[:, range(n), range(n)] += np.isfinite(segments.fixed_start) * weight**2
    arrow.node_gradient[:] += off * weight**2
