"""`are_stable`: which closed loops are stable, each pole judged by how far rounding may have moved it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig, matrix_balance
from scipy.sparse.csgraph import connected_components

from pneuopt.quantities.arrays import Array

ComplexArray = NDArray[np.complex128]
# Share of a matrix's size by which rounding moves its well conditioned poles. With a smaller one the drift of a piston
# under speed control makes it unstable; with a larger one slow instabilities beside fast filters pass.
POLE_ROUNDING = 1e-13
# Share of the fastest pole beyond which no rounding moves even a double pole at zero, the root of a double's precision.
MOST_POLE_ROUNDING = 1e-7


def are_stable(closed: Array, poles: ComplexArray | None = None) -> NDArray[np.bool_]:
    """Which closed loops are stable, by their state matrices, shape (m, n, n), and their poles where they are known.

    Poles at zero are allowed: a position in a speed loop, an unused integral. A pole counts as zero where rounding may
    have moved it that far, whatever the fastest pole (`_has_stable_poles`).
    """
    found = np.linalg.eigvals(closed).astype(complex) if poles is None else poles
    growth, size = found.real.max(axis=-1, initial=-1.0), np.abs(found).max(axis=-1, initial=1.0)
    stable = np.asarray(growth <= 0)
    for k in np.flatnonzero(~stable & (growth <= MOST_POLE_ROUNDING * size)):
        label = connected_components(closed[k] != 0, connection="strong")[1]
        parts = (np.flatnonzero(label == part) for part in range(label.max() + 1))
        stable[k] = all(_has_stable_poles(closed[k][np.ix_(part, part)]) for part in parts)
    return stable


def _has_stable_poles(A: Array) -> bool:
    """Whether no pole of a matrix, none of whose parts stands alone, lies further right of zero than rounding moves it.

    That is `POLE_ROUNDING` times the size of the balanced matrix times the pole's condition number: G. H. Golub & C. F.
    Van Loan, Matrix Computations, 4th ed., Johns Hopkins 2013, section 7.2.2.
    """
    balanced = matrix_balance(A)[0]
    parts: Any = eig(balanced, left=True, right=True)
    poles, left, right = parts
    with np.errstate(divide="ignore"):
        condition = 1 / np.abs((left.conj() * right).sum(axis=0))
    return bool((poles.real <= POLE_ROUNDING * np.linalg.norm(balanced) * condition).all())
