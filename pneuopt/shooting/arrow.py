"""The linear algebra of lifted least squares: a block-tridiagonal matrix of the nodes with an arrow of the parameters.

[ D   B ] [ds]     [g_s]
[ B'  H ] [dq] = - [g_q]     D block-tridiagonal (banded Cholesky), B and H of the parameters (Schur complement)
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.shooting.tolerances import RANK_TOLERANCE, SCHUR_ROUNDING, STATE_REGULARISATION


class GaussNewtonStep(NamedTuple):
    """A Gauss-Newton step: nodes (m, n) scaled, parameters (k,)."""

    nodes: Array
    parameters: Array


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """The normal equations with the nodes eliminated."""

    nodes: Array  # (m, n): the nodes' step with the parameters fixed, - D^-1 g_s
    node_sensitivity: Array  # (m, n, k): D^-1 B, the negative derivative of the nodes' step by the parameters' step
    schur: Array  # (k, k)
    gradient: Array  # (k,): the gradient by the parameters, with the nodes following them

    def step(self, keep: Mask) -> GaussNewtonStep | None:
        """Gauss-Newton step with the parameters of mask `keep` free, shape (k,); None if not positive definite."""
        moved = np.zeros(len(keep))
        try:
            if keep.any():
                scaled, scale = unit_diagonal(self.schur[np.ix_(keep, keep)])
                factor = cho_factor(scaled, check_finite=False)
                moved[keep] = scale * cho_solve(factor, scale * -self.gradient[keep], check_finite=False)
        except LinAlgError:
            return None
        return GaussNewtonStep(self.back_substitute(moved), moved)

    def back_substitute(self, moved: Array) -> Array:
        """The nodes' step when the parameters move by `moved`, shape (k,)."""
        with np.errstate(all="ignore"):
            return np.asarray(self.nodes - self.node_sensitivity @ moved)


@dataclass(frozen=True, eq=False)
class ArrowEquations:
    """Normal equations of m nodes with n states each, and k parameters."""

    diagonal: Array  # (m, n, n)
    coupling: Array  # (m, n, n): block between a node (rows) and the next (columns); the last is zero
    border: Array  # (m, n, k)
    corner: Array  # (k, k)
    node_gradient: Array  # (m, n)
    gradient: Array  # (k,)

    def eliminate(self, damping: float, node_damping: Array | float = 0.0) -> ReducedEquations | None:
        """Eliminate the nodes, the diagonal damped as Marquardt does; None where it is not positive definite.

        `node_damping` (m,) adds to the damping at each node.
        """
        if damping == 0 and not np.any(node_damping):
            return self._undamped_elimination
        return self._eliminate(damping, node_damping)

    @cached_property
    def _undamped_elimination(self) -> ReducedEquations | None:
        """Without damping, as convergence, covariance and scores of one iterate all ask for it."""
        return self._eliminate(0.0, 0.0)

    def _eliminate(self, damping: float, node_damping: Array | float) -> ReducedEquations | None:
        m, n, k = self.border.shape
        flat = self.border.reshape(m * n, k)
        right = np.concatenate([flat, self.node_gradient.reshape(m * n, 1)], axis=1)
        with np.errstate(all="ignore"):  # of an absurd start what overflows is no number, and its step is refused
            try:
                solved = self.solve_nodes(right, damping + node_damping)
            except LinAlgError:
                return None
            corner = self.corner + np.diag(damping * np.diag(self.corner) + 1e-300)
            eliminated, node_part = solved[:, :k], solved[:, k]
            return ReducedEquations(
                -node_part.reshape(m, n),
                eliminated.reshape(m, n, k),
                corner - flat.T @ eliminated,
                self.gradient - flat.T @ node_part,
            )

    def node_step(self, damping: Array) -> Array | None:
        """The Gauss-Newton step of the nodes alone (m, n), damped by node; None where D is not positive definite."""
        with np.errstate(all="ignore"):  # as in an elimination
            try:
                return -self.solve_nodes(self.node_gradient.reshape(-1, 1), damping).reshape(self.node_gradient.shape)
            except LinAlgError:
                return None

    def descent_rate(self, step: GaussNewtonStep) -> float:
        """Rate at which the cost falls along a step."""
        with np.errstate(all="ignore"):
            return -float(np.sum(self.node_gradient * step.nodes) + self.gradient @ step.parameters)

    def solve_nodes(self, right: Array, damping: Array | float) -> Array:
        """Solve D x = right, shape (m n, any); raises `LinAlgError` where D is not positive definite."""
        if not right.size:
            return right
        # D in upper banded storage, for LAPACK's pbtrf
        m, n, _ = self.diagonal.shape
        upper = 2 * n - 1
        banded = np.zeros((upper + 1, m * n))
        for a in range(n):
            for b in range(a, n):
                banded[upper + a - b, b::n] = self.diagonal[:, a, b]
            for b in range(n):
                banded[upper + a - n - b, n + b :: n] = self.coupling[:-1, a, b]
        banded[upper] *= 1 + np.repeat(np.broadcast_to(damping, m), n)
        banded[upper] += STATE_REGULARISATION
        factor = cholesky_banded(banded, overwrite_ab=True, check_finite=False)
        return np.asarray(cho_solve_banded((factor, False), right, check_finite=False))


def positive_definite_inverse(matrix: Array) -> Array:
    """Inverse of a positive definite matrix, whatever the units of its rows."""
    scaled, scale = unit_diagonal(matrix)
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale))


def indistinguishable_parameters(schur: Array, corner: Array) -> Indices:
    """Positions of parameters that act only together, the worst last: the weakest direction, if only rounding.

    The diagonal of the Schur complement (k, k) over the corner's (k, k) gives the digits that elimination left.
    """
    if not schur.size:
        return np.arange(0)
    left = np.diag(schur) / np.maximum(np.diag(corner), 1e-300)
    lost = np.flatnonzero(~(left > SCHUR_ROUNDING))
    if lost.size or not np.isfinite(schur).all():
        return lost if lost.size else np.arange(len(schur))
    values, vectors = np.linalg.eigh(unit_diagonal(schur)[0])
    if values[0] > max(RANK_TOLERANCE, SCHUR_ROUNDING / float(left.min())):
        return np.arange(0)
    weakest = np.abs(vectors[:, 0])
    members = np.flatnonzero(weakest > 0.1 * weakest.max())
    severity = weakest.round(6) if values[0] <= RANK_TOLERANCE else 1 / left
    return members[np.argsort(severity[members], kind="stable")]


def unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    """The matrix scaled to unit diagonal, so that units do not decide its rank, and the scales."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        return np.asarray(matrix * np.outer(scale, scale)), scale
