"""The lifted least squares at one iterate: data and gap residuals of all segments as normal equations.

`normal_equations` runs the segments; `weigh_gaps` and `correct_residuals` change the equations without a run.
`ParameterScaling` holds the free parameters as they are searched, with their bounds and priors.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dtbtrs

from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.shooting.arrow import (
    ArrowEquations,
    ReducedEquations,
    indistinguishable_parameters,
    positive_definite_inverse,
    unit_diagonal,
)
from pneuopt.shooting.segments import IntegrationCorrection, Segments
from pneuopt.shooting.tolerances import (
    CURVATURE_RESOLUTION,
    FLAT_PRIOR_WIDTH,
    MAX_NODE_DAMPING,
    MAX_OVERSHOOTING_SHARE,
    MIN_LOCAL_EXCESS,
    MIN_LOG_INFORMATION,
    MIN_OVERSHOOTING_NODES,
    RANK_TOLERANCE,
    SCHUR_ROUNDING,
    START_PRIOR_DEVIATION,
    WEAK_PRIOR_DEVIATION,
)
from pneuopt.shooting.transcription import Transcription


@dataclass(frozen=True, eq=False)
class SegmentLinearisation:
    """Data and gaps at an iterate with their derivatives, before the gaps are weighed."""

    # (m, n + c + 1, n + c + 1): Gram matrix of each segment's data residuals by its states (in nominal sizes), its
    # sensitivity columns, and last the residuals themselves
    grams: Array
    squares: Array  # (m, n_outputs): squared data residuals
    # (m, n_outputs, n + c): derivatives of each segment's summed data residuals, by its states (in nominal sizes) and
    # sensitivity columns
    sums: Array
    end_sensitivities: Array  # (m, n, n + c): sensitivity of each segment's end, in nominal sizes
    y: Array  # (m, n_samples, n_outputs): the outputs, without the correction
    x_end: Array  # (m, n): where each segment ends, likewise
    # gaps, start_errors (m, n): gap behind each segment, zero where nothing follows; distance from a known start; in
    # nominal sizes
    gaps: Array
    start_errors: Array
    chain: Array  # (k,): d(parameter)/d(searched parameter)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The problem linearised at an iterate."""

    segments: Segments
    linearisation: SegmentLinearisation
    arrow: ArrowEquations  # the equations of data and gaps together
    # chi_square, cost: squared data residuals; half the sum of all squares
    chi_square: float
    cost: float

    @property
    def gaps(self) -> Array:
        """Gap behind each segment in nominal sizes; zero where nothing follows."""
        return self.linearisation.gaps

    @property
    def largest_gap(self) -> float:
        """The largest gap, in nominal sizes."""
        return float(np.max(np.abs(self.gaps), initial=0.0))

    @property
    def gap_share(self) -> float:
        """The share of the cost that the gaps carry, 0 to 1."""
        return 1 - self.chi_square / (2 * self.cost) if 0 < self.cost < math.inf else 0.0

    @property
    def count(self) -> int:
        """Number of data residuals."""
        return int(self.segments.counts.sum())

    @property
    def misfit(self) -> Array:
        """Root mean square of each output's residuals, in noise standard deviations; 0 where nothing was measured."""
        return np.asarray(np.sqrt(self.linearisation.squares.sum(axis=0) / np.maximum(self.segments.counts, 1)))

    def promised_squares(self, keep: Mask) -> float:
        """The squares after an undamped step in the kept parameters, by these equations, NaN if there is none."""
        reduced = self.arrow.eliminate(0.0)
        step = reduced and reduced.step(keep)
        return 2 * self.cost - self.arrow.descent_rate(step) if step else math.nan

    def unidentifiable_parameters(self, reduced: ReducedEquations, keep: Mask) -> Indices:
        """Positions, among the kept parameters, of those that the data do not separate; empty if they do."""
        square = np.ix_(keep, keep)
        return indistinguishable_parameters(reduced.schur[square], self.arrow.corner[square])

    def covariance(self, keep: Mask, *, noisy_gaps: bool = False) -> Array | None:
        """Covariance of the kept parameters (own units, unit noise; None: undetermined), NaN for others: the sandwich.

        True gaps carry no noise, so the plain inverse is too wide; with the sandwich (H. White, Econometrica 50 (1982)
        1-25) 95 % intervals hold the truth 95 times in 100 (problems/identify/interval_coverage.py).
        """
        reduced = self.arrow.eliminate(0.0)
        if reduced is None or self.unidentifiable_parameters(reduced, keep).size:
            return None
        bread = positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])
        found = bread if noisy_gaps else bread @ self._meat(reduced)[np.ix_(keep, keep)] @ bread
        out = np.full((len(keep), len(keep)), np.nan)
        out[np.ix_(keep, keep)] = (found + found.T) / 2  # rounding of the sum, which a narrow bread magnifies
        return np.asarray(out * np.outer(self.linearisation.chain, self.linearisation.chain))

    def _meat(self, reduced: ReducedEquations) -> Array:
        """The information (k, k) of the data alone, with the nodes following the parameters."""
        n, meat = self.gaps.shape[1], np.zeros_like(reduced.schur)
        for rows, columns, unknowns in self.segments.blocks:
            E = np.zeros((rows.stop - rows.start, self.linearisation.end_sensitivities.shape[2], len(meat)))
            E[:, :n] = -reduced.node_sensitivity[rows]
            E[:, n + columns, unknowns] = self.linearisation.chain[unknowns]
            meat += np.tensordot(E, self.linearisation.grams[rows, :-1, :-1] @ E, ((0, 1), (0, 1)))
        return meat

    def root_information(self) -> Array:
        """A root R (k, k) of the information R'R in the searched parameters that `covariance` inverts; NaN: none.

        A direction that rounding hides keeps the information of that rounding, so that no other loses its own.
        """
        reduced = self.arrow.eliminate(0.0)
        if reduced is None or not np.isfinite(reduced.schur).all():
            return np.full_like(self.arrow.corner, np.nan)
        left = np.diag(reduced.schur) / np.maximum(np.diag(self.arrow.corner), 1e-300)
        seen = np.flatnonzero(left > SCHUR_ROUNDING)
        scaled, scale = unit_diagonal(reduced.schur[np.ix_(seen, seen)])
        least = max(RANK_TOLERANCE, SCHUR_ROUNDING / float(left[seen].min(initial=1.0)))
        values, vectors = np.linalg.eigh(scaled)
        hidden, whole = (
            (vectors * v) @ vectors.T for v in (np.maximum(least - values, 0.0), np.maximum(values, least))
        )
        sizes, axes = np.linalg.eigh(self._meat(reduced)[np.ix_(seen, seen)] * np.outer(scale, scale) + hidden)
        root = np.zeros_like(self.arrow.corner)
        root[: seen.size, seen] = (axes / np.sqrt(np.maximum(sizes, least))).T @ whole / scale
        return root

    def prior_covariance(self, keep: Mask, fixed: Mask, prior: Array) -> Array | None:
        """Covariance (k, k), own units, that the kept parameters take over from a prior of the fixed ones; or None.

        `prior` (k,) are standard deviations as searched; an infinite one counts as `FLAT_PRIOR_WIDTH`.
        """
        reduced = self.arrow.eliminate(0.0)
        if reduced is None or self.unidentifiable_parameters(reduced, keep).size:
            return None
        out = np.zeros((len(keep), len(keep)))
        left = np.maximum(np.diag(reduced.schur), SCHUR_ROUNDING * np.diag(self.arrow.corner))
        alone = 1 / np.sqrt(np.maximum(left[fixed], 1e-300))
        spread = np.where(np.isfinite(prior[fixed]), prior[fixed], FLAT_PRIOR_WIDTH * alone)
        bread = positive_definite_inverse(reduced.schur[np.ix_(keep, keep)])
        moved = self.linearisation.chain[keep, None] * (bread @ reduced.schur[np.ix_(keep, fixed)]) * spread
        out[np.ix_(keep, keep)] = moved @ moved.T
        return out


def normal_equations(
    segments: Segments,
    nodes: Array,
    q: Array,
    chain: Array,
    sigma: Array,
    substeps: int,
    correction: IntegrationCorrection | None = None,
) -> NormalEquations:
    """Run all segments with sensitivities from their nodes (m, n), and assemble data and gap residuals.

    `chain` (k,) are the parameters' slopes over those searched, `sigma` (n,) the gaps' deviations in nominal sizes.
    """
    run = segments.gram(nodes, q, substeps, correction)
    scale = np.concatenate([segments.nominal, np.ones(run.grams.shape[1] - nodes.shape[1])])
    ends = run.dx_end * (scale[:-1] / segments.nominal[:, None])
    start_errors = np.where(np.isfinite(segments.fixed_start), nodes - segments.fixed_start, 0.0) / segments.nominal
    gaps = segment_gaps(segments, nodes, run.x_end if correction is None else run.x_end + correction.x_end)
    slopes = SegmentLinearisation(
        run.grams * np.outer(scale, scale),
        run.squares,
        run.sums * scale[:-1],
        ends,
        run.y,
        run.x_end,
        gaps,
        start_errors,
        chain,
    )
    return weigh_gaps(segments, slopes, sigma)


def weigh_gaps(segments: Segments, slopes: SegmentLinearisation, sigma: Array) -> NormalEquations:
    """The normal equations with gaps of standard deviation `sigma`, shape (n,), in nominal sizes."""
    chi_square = float(np.sum(slopes.squares))
    with np.errstate(all="ignore"):  # a step too far may overflow; its cost is infinite then
        squares = chi_square + float(np.sum((slopes.gaps / sigma) ** 2) + np.sum((slopes.start_errors / sigma) ** 2))
        arrow = _assemble(segments, slopes, 1 / sigma)
    finite = math.isfinite(squares) and bool(np.isfinite(slopes.grams).all())
    return NormalEquations(segments, slopes, arrow, chi_square, 0.5 * squares if finite else math.inf)


def _assemble(segments: Segments, slopes: SegmentLinearisation, weight: Array) -> ArrowEquations:
    """Data, the gaps between linked segments, and the distances from known starts, as one arrow."""
    (m, n), k = slopes.gaps.shape, len(slopes.chain)
    W = np.concatenate([slopes.end_sensitivities, slopes.gaps[..., None]], axis=2)
    W *= np.tile(weight[:, None], W.shape[2])
    W[~segments.linked] = 0.0
    G = slopes.grams + np.swapaxes(W, 1, 2) @ W
    diagonal, node_gradient = G[:, :n, :n].copy(), G[:, :n, -1].copy()
    coupling = -np.swapaxes(W[:, :, :n], 1, 2) * weight
    is_next = np.append(False, segments.linked[:-1])[:, None]
    diagonal[:, range(n), range(n)] += (is_next + 1.0 * np.isfinite(segments.fixed_start)) * weight**2
    node_gradient[1:] -= weight * W[:-1, :, -1]
    node_gradient += slopes.start_errors * weight**2
    between = G[:, :n, n:-1]
    between[1:] -= weight[:, None] * W[:-1, :, n:-1]
    border, corner, gradient = np.zeros((m, n, k)), np.zeros((k, k)), np.zeros(k)
    for rows, columns, unknowns in segments.blocks:
        chain, own = slopes.chain[unknowns], n + columns
        border[rows, :, unknowns] = between[rows][:, :, columns] * chain
        total = G[rows].sum(axis=0)
        corner[np.ix_(unknowns, unknowns)] += total[np.ix_(own, own)] * np.outer(chain, chain)
        gradient[unknowns] += total[own, -1] * chain
    return ArrowEquations(diagonal, coupling, border, corner, node_gradient, gradient)


def correct_residuals(
    equations: NormalEquations, nodes: Array, correction: IntegrationCorrection, sigma: Array
) -> NormalEquations:
    """The normal equations with residuals by finer integration steps; sensitivities and the data's gradient stay.

    That moves no parameter by more standard deviations than the root of the squares by which residuals change.
    """
    segments, slopes = equations.segments, equations.linearisation
    squares = np.nansum(((slopes.y + correction.y - segments.measured) * segments.weights) ** 2, axis=1)
    grams = slopes.grams.copy()
    grams[:, -1, -1] = squares.sum(axis=1)
    gaps = segment_gaps(segments, nodes, slopes.x_end + correction.x_end)
    return weigh_gaps(segments, replace(slopes, grams=grams, squares=squares, gaps=gaps), sigma)


def segment_gaps(segments: Segments, nodes: Array, x_end: Array) -> Array:
    """Gap behind each segment in nominal sizes, shape (m, n); zero where nothing follows."""
    gaps = np.zeros_like(nodes)
    gaps[:-1] = np.where(segments.linked[:-1, None], (x_end[:-1] - nodes[1:]) / segments.nominal, 0.0)
    return gaps


def propagate_shifts(own: Array, excess: Array) -> Array:
    """Shifts s of the nodes with s[0] = 0 and s[i + 1] = own[i] s[i] + excess[i], as one banded triangle."""
    m, n, _ = own.shape
    band = np.zeros((2 * n, m * n))
    for a in range(n):
        for b in range(n):
            band[n + a - b, b::n] = -own[:, a, b]
    right = np.concatenate([np.zeros(n), excess[:-1].ravel()])
    return np.asarray(dtbtrs(band, right[:, None], uplo="L", diag="U")[0]).reshape(m, n)


def missed_curvature(
    equations: NormalEquations, step: Array, moved: Array, trial: NormalEquations, sigma: Array
) -> Array:
    """The curvature that Gauss-Newton's model has missed along a step, by node (m,), where a few missed nearly all.

    It is the term ``damping * diagonal`` of a node which, added to the model, would have promised the cost that came.
    """
    if not math.isfinite(trial.cost):
        return np.zeros(len(step))
    linear, linked, n = equations.linearisation, equations.segments.linked, step.shape[1]
    change = np.zeros(linear.end_sensitivities.shape[::2])  # of each segment's start state, and of its columns
    change[:, :n] = step
    for rows, columns, unknowns in equations.segments.blocks:
        change[rows, n + columns] = (linear.chain * moved)[unknowns]
    gaps = linear.gaps + (linear.end_sensitivities @ change[..., None])[..., 0]
    gaps[:-1] -= change[1:, :n]
    own = np.concatenate([change, np.ones((len(change), 1))], axis=1)
    squares = np.einsum("mi,mi->m", own, (linear.grams @ own[..., None])[..., 0])
    promised = squares + np.sum((np.where(linked[:, None], gaps, 0.0) / sigma) ** 2, axis=1)
    found = trial.linearisation.squares.sum(axis=1) + np.sum((trial.gaps / sigma) ** 2, axis=1)
    diagonal = np.einsum("mii,mi->m", equations.arrow.diagonal, step**2)
    excess = np.where(found - promised > CURVATURE_RESOLUTION * np.sum(diagonal), found - promised, 0.0)
    few = max(MIN_OVERSHOOTING_NODES, round(MAX_OVERSHOOTING_SHARE * len(excess)))
    if not np.sort(excess)[-few:].sum() > MIN_LOCAL_EXCESS * excess.sum():
        return np.zeros(len(excess))  # the parameters' step is too long, or all is well
    return np.asarray(np.minimum(excess / np.maximum(diagonal, 1e-300), MAX_NODE_DAMPING))


def describe_misfit(equations: NormalEquations, level: float, *, noisy_gaps: bool) -> tuple[str, ...]:
    """Sentences on residuals beyond `level` (mean squares, in noise variances), or on gaps as noise of the states."""
    segments = equations.segments
    lead = "the model does not explain the log to its noise: "
    tail = "the intervals count that"
    if noisy_gaps:
        sizes = np.sqrt(np.mean(equations.gaps[segments.linked] ** 2, axis=0))
        state = segments.system.states[int(np.argmax(sizes))]
        size = f"{np.max(sizes) * state.nominal:.2g} {state.unit}"
        return f"{lead}from segment to segment {state.name} jumps by {size} (rms)", tail
    misfit = equations.misfit
    worst = int(np.argmax(misfit))
    if misfit[worst] ** 2 <= level:
        return ()
    output = segments.system.outputs[worst].name
    return f"{lead}residuals are {misfit[worst]:.2g} times the noise of {output}", tail


class ParameterScaling:
    """Free parameters as searched (z, shape (k,)), and all the problem's values at them."""

    def __init__(self, transcription: Transcription) -> None:
        self._free = [p for p in transcription.parameters.values() if p.free]
        self._positions = transcription.free
        self._given = np.array([p.value for p in transcription.parameters.values()])
        self.log = np.array([p.log for p in self._free], dtype=bool)
        self.lower, self.upper = (
            self._to_search_units(np.array([getattr(p, b) for p in self._free])) for b in ("lower", "upper")
        )
        self.fixed = np.array([p.lower == p.upper for p in self._free], dtype=bool)  # (k,), as all of these
        self.start = self.project_to_bounds(self._to_search_units(self._given[self._positions]))

    def project_to_bounds(self, z: Array) -> Array:
        """The nearest point within the bounds."""
        return np.asarray(np.clip(z, self.lower, self.upper))

    def values(self, z: Array) -> Array:
        """All the problem's parameter values."""
        q = self._given.copy()
        own = np.where(self.log, np.exp(np.where(self.log, z, 0.0)), z)
        # at a bound exactly the bound, which a logarithm there and back would miss by a rounding
        low, up = ([getattr(p, b) for p in self._free] for b in ("lower", "upper"))
        own = np.where(z <= self.lower, low, np.where(z >= self.upper, up, own))
        q[self._positions] = [min(max(v, p.lower), p.upper) for v, p in zip(own, self._free, strict=True)]
        return q

    def chain(self, z: Array) -> Array:
        """d(parameter)/d(searched parameter), shape (k,)."""
        return np.where(self.log, np.exp(np.where(self.log, z, 0.0)), 1.0)

    def at_bound(self, z: Array) -> Mask:
        """The mask of parameters on a bound."""
        return np.asarray((z <= self.lower) | (z >= self.upper))

    def weak_prior(self, z: Array) -> Array:
        """Standard deviation of a weak prior: a factor of ten, or for linear parameters ten times their size."""
        size = np.abs(np.where(self.log, 0.0, z))
        sized = size > np.finfo(float).tiny  # a start at a bound of 0 may leave rounding only
        return np.where(self.log, WEAK_PRIOR_DEVIATION, np.where(sized, 10 * size, np.inf))

    def start_prior_cost(self, z: Array) -> float:
        """What a prior that draws log parameters to their start adds to the cost at z."""
        return 0.5 * float(self._prior_weight @ (z - self.start) ** 2)

    def add_start_prior(self, equations: NormalEquations, z: Array) -> NormalEquations:
        """Equations at z that draw log parameters to their start, where the data hardly tell of them."""
        weight, arrow = self._prior_weight, equations.arrow
        gradient = arrow.gradient + weight * (z - self.start)
        drawn = replace(arrow, corner=arrow.corner + np.diag(weight), gradient=gradient)
        return replace(equations, arrow=drawn, cost=equations.cost + self.start_prior_cost(z))

    @property
    def _prior_weight(self) -> Array:
        """One over the prior's variance, shape (k,); zero where it draws nothing."""
        return np.where(self.log & ~self.fixed, START_PRIOR_DEVIATION**-2, 0.0)

    def has_effect(self, equations: NormalEquations) -> Mask:
        """The mask of parameters that have an effect on the residuals here."""
        return np.asarray(np.diag(equations.arrow.corner) > np.where(self.log, MIN_LOG_INFORMATION, 0.0))

    def movable(self, z: Array, equations: NormalEquations, reduced: ReducedEquations) -> Mask:
        """The mask of parameters with an effect on the residuals that are neither fixed nor pressed against a bound."""
        below, above = (z <= self.lower) & (reduced.gradient > 0), (z >= self.upper) & (reduced.gradient < 0)
        # a fixed one may have no gradient that presses it
        return np.asarray(self.has_effect(equations) & ~(below | above | self.fixed))

    def _to_search_units(self, values: Array) -> Array:
        """Logarithms of log parameters; a bound that is not positive is minus infinity there."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.where(values > 0, np.log(values), -np.inf), values)
