"""`bind_array_step`: an RK4 step of many segments with its sensitivities, all columns of these in one operation.

Written out, a step takes an operation of NumPy for each column of the sensitivities, and half a microsecond for each:
more than half of its time.
"""

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from pneuopt.dynamics.compiled.array_program import ArrayProgram
from pneuopt.quantities.arrays import Array

LATER_STAGES = ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0))
"""Where a step's later stages stand, a fraction of it, and their weights."""


def bind_array_step(
    rate: ca.Function, program: ArrayProgram, inputs: Sequence[Array], results: Sequence[Array]
) -> Callable[[], None]:
    """A call without arguments that takes a step of all segments from inputs to results.

    Parameters
    ----------
    rate : casadi.Function
        ``(t, x, u, p) -> (xdot, d(xdot)/dx, d(xdot)/d(chosen parameters))``, the last two sparse.
    program : ArrayProgram
        Its program.
    inputs, results : sequence of ndarray
        t, h, x, u, p, S and x, S after the step, of shape (numbers, segments); S column by column.
    """
    at, size, x, u, p, flat = inputs
    nx, m = x.shape
    S, S_next = (a.reshape(-1, nx, m) for a in (flat, results[1]))
    time, stage_x, stage_S, k, slope = (np.empty_like(a) for a in (at, x, S, x, S))
    share, part_x, part_S = np.empty_like(size), np.empty_like(x), np.empty_like(S)
    sums, jacobians = (np.empty_like(x), np.empty_like(S)), [np.empty((rate.nnz_out(i), m)) for i in (1, 2)]
    evaluate = program.bind((time, stage_x, u, p), (k, *jacobians))

    def call() -> None:
        time[:], stage_x[:] = at, x
        evaluate()
        spread(S)
        sums[0][:], sums[1][:] = k, slope
        for fraction, weight in LATER_STAGES:
            np.multiply(size, fraction, out=share)
            np.add(at, share, out=time)
            np.add(x, np.multiply(k, share, out=stage_x), out=stage_x)
            np.add(S, np.multiply(slope, share, out=stage_S), out=stage_S)
            evaluate()
            spread(stage_S)
            for total, own, part in ((sums[0], k, part_x), (sums[1], slope, part_S)):
                np.add(total, np.multiply(own, weight, out=part) if weight != 1 else own, out=total)
        np.divide(size, 6, out=share)
        np.add(x, np.multiply(sums[0], share, out=part_x), out=results[0])
        np.add(S, np.multiply(sums[1], share, out=part_S), out=S_next)

    spread = _bind_spread(rate, jacobians, slope)
    return call


def _bind_spread(rate: ca.Function, jacobians: Sequence[Array], slope: Array) -> Callable[[Array], None]:
    """What computes the slope of sensitivities S, of shape (columns, states, segments), from the rate's Jacobians."""
    of_states, of_parameters = (list(zip(*rate.sparsity_out(i).get_triplet(), strict=True)) for i in (1, 2))
    starts, part = slope.shape[0] - rate.size2_out(2), np.empty_like(slope[:, 0])
    empty = sorted(set(range(slope.shape[1])) - {row for row, _ in of_states})

    def spread(S: Array) -> None:
        begun = set[int]()
        for (row, column), value in zip(of_states, jacobians[0], strict=True):
            if row in begun:
                slope[:, row] += np.multiply(S[:, column], value, out=part)
            else:
                np.multiply(S[:, column], value, out=slope[:, row])
                begun.add(row)
        slope[:, empty] = 0.0
        for (row, column), value in zip(of_parameters, jacobians[1], strict=True):
            slope[starts + column, row] += value

    return spread
