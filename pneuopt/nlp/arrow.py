"""The linear algebra of lifted least squares: a block-tridiagonal matrix of the nodes with an arrow of the parameters.

[ D   B ] [ds]     [g_s]
[ B'  H ] [dq] = - [g_q]     D block-tridiagonal (banded Cholesky), B and H of the parameters (Schur complement)
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
STATE_FLOOR = 1e-6  # on D's diagonal (scaled states): a state that no data reach stays put, the optimum does not move


class Step(NamedTuple):
    """A Gauss-Newton step: nodes (m, n) scaled, parameters (k,), D^-1 B (m, n, k), Schur complement (k, k)."""

    nodes: Array
    parameters: Array
    eliminated: Array
    schur: Array


@dataclass(frozen=True, eq=False)
class Arrow:
    """Normal equations of m nodes with n states each, and k parameters.

    Attributes
    ----------
    diagonal : ndarray, shape (m, n, n)
    coupling : ndarray, shape (m, n, n)
        Block between a node (rows) and the next (columns); the last is zero.
    border : ndarray, shape (m, n, k)
    corner : ndarray, shape (k, k)
    node_gradient : ndarray, shape (m, n)
    gradient : ndarray, shape (k,)
    """

    diagonal: Array
    coupling: Array
    border: Array
    corner: Array
    node_gradient: Array
    gradient: Array

    def solve(self, damping: float, keep: Mask) -> Step | None:
        """Gauss-Newton step with Marquardt's multiplicative damping of the diagonal.

        Parameters
        ----------
        damping : float
        keep : ndarray of bool, shape (k,)
            Parameters that may move; the others stay at their bounds.

        Returns
        -------
        Step or None
            None where a matrix is not positive definite.
        """
        m, n, k = self.border.shape
        corner = self.corner + np.diag(damping * np.diag(self.corner) + 1e-300)
        right = np.concatenate([self.border.reshape(m * n, k), self.node_gradient.reshape(m * n, 1)], axis=1)
        try:
            solved = self._solve_nodes(right, damping) if m * n else right
            eliminated, node_part = solved[:, :k], solved[:, k]
            flat = self.border.reshape(m * n, k)
            schur = corner - flat.T @ eliminated
            step = np.zeros(k)
            if keep.any():
                reduced = -(self.gradient - flat.T @ node_part)[keep]
                step[keep] = _solve_scaled(schur[np.ix_(keep, keep)], reduced)
        except LinAlgError:
            return None
        nodes = -node_part - eliminated @ step
        return Step(nodes.reshape(m, n), step, eliminated.reshape(m, n, k), schur)

    def _solve_nodes(self, right: Array, damping: float) -> Array:
        factor = cholesky_banded(self._banded(damping), overwrite_ab=True, check_finite=False)
        return np.asarray(cho_solve_banded((factor, False), right, check_finite=False))

    def _banded(self, damping: float) -> Array:
        """Upper banded storage of D for LAPACK's pbtrf."""
        m, n, _ = self.diagonal.shape
        upper = 2 * n - 1
        banded = np.zeros((upper + 1, m * n))
        for a in range(n):
            for b in range(a, n):
                banded[upper + a - b, b::n] = self.diagonal[:, a, b]
            for b in range(n):
                banded[upper + a - n - b, n + b :: n] = self.coupling[:-1, a, b]
        banded[upper] *= 1 + damping
        banded[upper] += STATE_FLOOR
        return banded


def _solve_scaled(matrix: Array, right: Array) -> Array:
    scaled, scale = _unit_diagonal(matrix)
    factor = cho_factor(scaled, check_finite=False)
    return np.asarray(scale * cho_solve(factor, scale * right, check_finite=False))


def scaled_inverse(matrix: Array) -> Array | None:
    """Inverse of a positive definite matrix, or None where it is singular to working precision."""
    if not matrix.size:
        return matrix
    scaled, scale = _unit_diagonal(matrix)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return None
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale))


def indistinct(matrix: Array) -> Indices:
    """Positions that make up the weakest direction of a matrix scaled to a unit diagonal."""
    scaled, _ = _unit_diagonal(matrix)
    if not np.all(np.isfinite(scaled)):
        return np.arange(len(matrix))
    weakest = np.abs(np.linalg.eigh(scaled)[1][:, 0])
    return np.flatnonzero(weakest > 0.1 * weakest.max())


def _unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    """The matrix scaled so that units do not decide its rank, and the scales."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        return np.asarray(matrix * np.outer(scale, scale)), scale
