"""`run_in_vm`: a rollout in CasADi's virtual machine, for where there is no compiler; the same answers, more slowly.

A Function is called on memory that stays in its place (`bind_function`): a call by CasADi's matrices takes fifty times
as long as the arithmetic of a small model.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from pneuopt.quantities.arrays import Array

# Operations, segments times those of the model, that a thread is started for, half a millisecond. Fewer, and starting
# it (50 us) takes the time that it saves; more leave cores idle.
OPERATIONS_A_THREAD = 100_000


class VmRun(NamedTuple):
    """The results of m segments of n samples, the sensitivity's columns before its rows, as machine code has them.

    Attributes
    ----------
    y : ndarray, shape (m, n, n_outputs)
    dy : ndarray, shape (m, n, n_columns, n_outputs)
    x : ndarray, shape (m, ceil(n / states), n_states), or None
    x_end : ndarray, shape (m, n_states)
    dx_end : ndarray, shape (m, n_columns, n_states)
    """

    y: Array
    dy: Array
    x: Array | None
    x_end: Array
    dx_end: Array


def bind_function(function: ca.Function, inputs: Sequence[Array], results: Sequence[Array]) -> Callable[[], object]:
    """A call without arguments that evaluates a Function from arrays into arrays.

    Parameters
    ----------
    function : casadi.Function
        Its inputs and outputs are dense.
    inputs, results : sequence of ndarray
        Contiguous, in CasADi's column order; their memory is read and written at each call. Results may be fewer.
    """
    buffer, evaluate = function.buffer()
    for i, array in enumerate(inputs):
        if array.size:
            buffer.set_arg(i, array.reshape(-1, order="A").data)  # type: ignore[call-arg]  # it knows its size
    for i, array in enumerate(results):
        if array.size:
            buffer.set_res(i, array.reshape(-1, order="A").data)  # type: ignore[call-arg]

    def call() -> object:
        return evaluate()

    call.keep_alive = buffer, inputs, results  # type: ignore[attr-defined]
    return call


def run_in_vm(
    functions: Mapping[str, ca.Function],
    given: tuple[Array, Array, Array, Array, Array],
    start_columns: int,
    substeps: int,
    states: int,
    threads: int = 1,
) -> VmRun:
    """Integrate m segments of n samples each, as `Rollout.run` does.

    Parameters
    ----------
    functions : mapping of str to casadi.Function
        "step", "output" and, if there is one, "update", as `prepare_rollout` makes them.
    given : tuple of ndarray
        x0, u, p, t and h, as `Rollout.run` takes them.
    start_columns : int
        How many of the sensitivity's columns are those of the start state.
    substeps, states : int
        As for `Rollout.run`.
    threads : int
        Segments are shared out to so many at most.
    """
    x0, u, p, t, h = given
    (m, n), (nx, ns), ny = t.shape, functions["step"].size_in(5), functions["output"].size1_out(0)
    x, S, at, size, held = x0.copy(), np.zeros((m, ns, nx)), np.empty(m), np.empty(m), np.empty((m, u.shape[2]))
    S[:, :start_columns] = np.eye(start_columns, nx)
    x_next, S_next, y, dy = np.empty_like(x), np.empty_like(S), np.empty((m, ny)), np.empty((m, ns, ny))
    arguments = (x, held, np.ascontiguousarray(np.broadcast_to(p, (m, p.shape[-1]))), S)
    mapped = {name: _map(function, m, threads) for name, function in functions.items()}
    read_output = bind_function(mapped["output"], (at, *arguments), (y, dy))
    step = bind_function(mapped["step"], (at, size, *arguments), (x_next, S_next))
    update = bind_function(mapped["update"], (at, *arguments), (x_next, S_next)) if "update" in mapped else None
    kept = np.empty((m, -(-n // states), nx)) if states else None
    run = VmRun(np.empty((m, n, ny)), np.empty((m, n, ns, ny)), kept, x, S)
    for j in range(n):
        at[:], size[:], held[:] = t[:, j], h[:, j] / substeps, u[:, j]
        if kept is not None and j % states == 0:
            kept[:, j // states] = x
        if update is not None:
            update()
            x[:], S[:] = x_next, S_next
        read_output()
        run.y[:, j], run.dy[:, j] = y, dy
        for k in range(substeps):
            at[:] = t[:, j] + k * size
            step()
            x[:], S[:] = x_next, S_next
    return run


def _map(function: ca.Function, m: int, threads: int) -> ca.Function:
    """A Function of m segments at once, in as many threads as pay."""
    parts = min(threads, m * function.n_instructions() // OPERATIONS_A_THREAD)
    return function.map(m, "thread", parts) if parts > 1 else function.map(m)
