"""`run_in_vm`: a rollout without machine code, for where there is no compiler; the same answers, more slowly.

Few segments run in CasADi's virtual machine, on memory that stays in its place (`bind_function`): a call by CasADi's
matrices takes fifty times as long as the arithmetic of a small model. Many run as calls of NumPy, each for one number
of all segments (`ArrayProgram`): the virtual machine takes 3 to 6 ns for an operation of one segment, NumPy half a
microsecond for a call, and then a tenth of that for a segment. An RK4 step (`bind_array_step`) takes all columns of the
sensitivities in one operation; an operation for each would be more than half of its time.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.special import erf

from pneuopt.dynamics.compiled.c_writer import Instruction, read_instructions
from pneuopt.dynamics.tolerances import ARRAY_SEGMENTS, BLOCK_SEGMENTS, FOLDED_STEPS, OPERATIONS_A_THREAD
from pneuopt.quantities.arrays import Array

Operation = Callable[..., Any]


OPERATIONS: dict[int, Operation] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda value, out: np.add(value, value, out),
    ca.OP_INV: np.reciprocal,
    ca.OP_CONSTPOW: np.power,
    ca.OP_POW: np.power,
    ca.OP_SQRT: np.sqrt,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_ERF: erf,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_HYPOT: np.hypot,
    ca.OP_FABS: np.fabs,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_SIGN: np.sign,
    ca.OP_FMOD: np.fmod,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    # 0 where the condition does not hold, even where the value is not a number
    ca.OP_IF_ELSE_ZERO: lambda condition, value, out: np.copyto(out, np.where(condition != 0, value, 0.0)),
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_NOT: np.logical_not,
}
"""What computes an operation of CasADi, with the array for its result as the last argument."""


class _Place(NamedTuple):
    """Where a number is: in a row of an array, of the program's own, of an input or of a result."""

    owner: str
    array: int
    row: int


class _Step(NamedTuple):
    operation: Operation
    places: tuple[_Place, ...]


class ArrayProgram:
    """An SX Function with dense results as operations on arrays, each result in a row that a later one may take over.

    An operation of CasADi that NumPy has not is a `NotImplementedError`.
    """

    def __init__(self, function: ca.Function) -> None:
        self._places, self._constants, self._steps = dict[int, _Place](), dict[int, float](), list[_Step]()
        self._free = list[int]()
        self.n_rows = 0
        instructions = list(read_instructions(function))
        self._last_use = {s: k for k, i in enumerate(instructions) if i.operation != ca.OP_INPUT for s in i.sources}
        for k, instruction in enumerate(instructions):
            self._add(k, instruction)

    def bind(self, inputs: Sequence[Array], results: Sequence[Array]) -> Callable[[], None]:
        """A call without arguments that computes results from inputs, arrays of shape (numbers, segments)."""
        own = np.empty((self.n_rows, inputs[0].shape[1]))
        for row, value in self._constants.items():
            own[row] = value
        arrays = {"input": inputs, "result": results, "own": [own]}
        calls = [
            (operation, tuple(arrays[place.owner][place.array][place.row] for place in places))
            for operation, places in self._steps
        ]

        def call() -> None:
            for operation, rows in calls:
                operation(*rows)

        return call

    def _add(self, k: int, i: Instruction) -> None:
        """Add the k-th instruction; an input is where it is, a constant stays."""
        if i.operation == ca.OP_INPUT:
            self._places[i.target[0]] = _Place("input", *i.sources)
            return
        if i.operation == ca.OP_CONST:
            self.n_rows += 1
            self._constants[self.n_rows - 1] = i.constant
            self._places[i.target[0]] = _Place("own", 0, self.n_rows - 1)
            return
        sources = tuple(self._places[s] for s in i.sources)
        self._free += {
            self._places[s].row
            for s in i.sources
            if self._last_use[s] == k and self._places[s].owner == "own" and self._places[s].row not in self._constants
        }
        if i.operation == ca.OP_OUTPUT:
            self._steps.append(_Step(np.positive, (*sources, _Place("result", *i.target))))
            return
        if i.operation not in OPERATIONS:
            raise NotImplementedError(f"CasADi's operation {i.operation}")
        if not self._free:
            self.n_rows += 1
            self._free.append(self.n_rows - 1)
        self._places[i.target[0]] = _Place("own", 0, self._free.pop())
        self._steps.append(_Step(OPERATIONS[i.operation], (*sources, self._places[i.target[0]])))


class VmRun(NamedTuple):
    """The results of m segments of n samples, the sensitivity's columns before its rows, as machine code has them."""

    y: Array  # (m, n, n_outputs)
    dy: Array  # (m, n, n_columns, n_outputs)
    x: Array | None  # (m, ceil(n / states), n_states)
    x_end: Array  # (m, n_states)
    dx_end: Array  # (m, n_columns, n_states)


def bind_function(function: ca.Function, inputs: Sequence[Array], results: Sequence[Array]) -> Callable[[], object]:
    """A call without arguments that evaluates a Function from arrays into arrays, which may be fewer than its results.

    They are contiguous, in CasADi's column order; their memory is read and written at each call.
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
    """Integrate as `Rollout.run` does by `prepare_rollout`'s functions; the first `start_columns` are the start's."""
    (m, n), nx = given[3].shape, given[0].shape[1]
    if nx == 0 and n > 1:  # a model without a state: each of its samples is a segment
        x0, u, p, t, h = given
        rows = p if p.ndim == 1 else np.repeat(p, n, axis=0)
        flat = np.empty((m * n, 0)), u.reshape(m * n, 1, -1), rows, t.reshape(-1, 1), h.reshape(-1, 1)
        run = run_in_vm(functions, flat, 0, 1, 0, threads)
        x = np.empty((m, -(-n // states), 0)) if states else None
        return VmRun(run.y.reshape(m, n, -1), run.dy.reshape(m, n, *run.dy.shape[2:]), x, x0, run.dx_end[:m])
    parts = _count_parts(functions["step"].n_instructions(), m, threads)
    if m < ARRAY_SEGMENTS * parts or not all(map(_find_program, functions.values())):
        return _run(functions, given, start_columns, substeps, states, _Machine(m, threads))
    blocks = ([a if a.ndim == 1 else a[i : i + BLOCK_SEGMENTS] for a in given] for i in range(0, m, BLOCK_SEGMENTS))
    with np.errstate(all="ignore"):  # as in machine code
        runs = [_run(functions, b, start_columns, substeps, states, _Arrays(len(b[0]))) for b in blocks]
    y, dy, x_end, dx_end = (np.concatenate([getattr(run, n) for run in runs]) for n in ("y", "dy", "x_end", "dx_end"))
    kept = [run.x for run in runs if run.x is not None]
    return VmRun(y, dy, np.concatenate(kept) if kept else None, x_end, dx_end)


def _run(
    functions: Mapping[str, ca.Function],
    given: Sequence[Array],
    start_columns: int,
    substeps: int,
    states: int,
    engine: "_Machine | _Arrays",
) -> VmRun:
    x0, u, p, t, h = given
    (m, n), (nx, ns), ny = t.shape, functions["step"].size_in(5), functions["output"].size1_out(0)
    x, x_next, S, S_next = (engine.allocate(*shape) for shape in ((nx,), (nx,), (ns, nx), (ns, nx)))
    at, size, held, parameters = (engine.allocate(k) for k in (1, 1, u.shape[2], p.shape[-1]))
    y, dy = engine.allocate(ny), engine.allocate(ns, ny)
    x[:], S[:], parameters[:] = x0, 0.0, p
    S[:, :start_columns] = np.eye(start_columns, nx)
    arguments = (x, held, parameters, S)
    read_output = engine.bind(functions["output"], (at, *arguments), (y, dy))
    step, times = engine.fold(functions["step"], substeps)
    operations = functions["step"].n_instructions() * substeps // times
    advance = engine.bind_step(step, (at, size, *arguments), (x_next, S_next), operations, functions.get("rate"))
    update = engine.bind(functions["update"], (at, *arguments), (x_next, S_next)) if "update" in functions else None
    kept = np.empty((m, -(-n // states), nx)) if states else None
    run = VmRun(np.empty((m, n, ny)), np.empty((m, n, ns, ny)), kept, np.empty((m, nx)), np.empty((m, ns, nx)))
    for j in range(n):
        at[:, 0], size[:, 0], held[:] = t[:, j], h[:, j] / substeps, u[:, j]
        if kept is not None and j % states == 0:
            kept[:, j // states] = x
        if update is not None:
            update()
            x[:], S[:] = x_next, S_next
        read_output()
        run.y[:, j], run.dy[:, j] = y, dy
        for k in range(times):
            at[:, 0] = t[:, j] + k * size[:, 0]
            advance()
            x[:], S[:] = x_next, S_next
    run.x_end[:], run.dx_end[:] = x, S
    return run


class _Machine:
    """Functions of m segments at once in CasADi's machine, one segment after the other in memory."""

    def __init__(self, m: int, threads: int) -> None:
        self._m, self._threads = m, threads

    def allocate(self, *shape: int) -> Array:
        return np.empty((self._m, *shape))

    def fold(self, step: ca.Function, substeps: int) -> tuple[ca.Function, int]:
        """A Function of so many steps, or of one, and how often a sample calls it."""
        if not 1 < substeps <= FOLDED_STEPS:
            return step, substeps
        t, h, x, u, p, S = (ca.MX.sym(f"i{i}", *step.size_in(i)) for i in range(step.n_in()))
        x_next, S_next = x, S
        for k in range(substeps):
            x_next, S_next = step(t + k * h, h, x_next, u, p, S_next)
        return ca.Function("system_steps", [t, h, x, u, p, S], [x_next, S_next]), 1

    def bind(
        self, function: ca.Function, inputs: Sequence[Array], results: Sequence[Array], operations: int = 0
    ) -> Callable[[], object]:
        """A call that evaluates the Function; it has so many operations, or those that it counts itself."""
        parts = _count_parts(operations or function.n_instructions(), self._m, self._threads)
        mapped = function.map(self._m, "thread", parts) if parts > 1 else function.map(self._m)
        return bind_function(mapped, inputs, results)

    def bind_step(
        self,
        step: ca.Function,
        inputs: Sequence[Array],
        results: Sequence[Array],
        operations: int,
        _rate: ca.Function | None,
    ) -> Callable[[], object]:
        return self.bind(step, inputs, results, operations)


class _Arrays:
    """Functions of m segments at once as operations on arrays; in memory, a number of all segments stands together."""

    def __init__(self, m: int) -> None:
        self._m = m

    def allocate(self, *shape: int) -> Array:
        return np.moveaxis(np.empty((*shape, self._m)), -1, 0)

    def fold(self, step: ca.Function, substeps: int) -> tuple[ca.Function, int]:
        return step, substeps

    def bind(
        self, function: ca.Function, inputs: Sequence[Array], results: Sequence[Array], _operations: int = 0
    ) -> Callable[[], None]:
        program = _find_program(function)
        assert program is not None, "asked before"
        return program.bind(self._as_rows(inputs), self._as_rows(results))

    def bind_step(
        self,
        step: ca.Function,
        inputs: Sequence[Array],
        results: Sequence[Array],
        operations: int,
        rate: ca.Function | None,
    ) -> Callable[[], None]:
        """As `bind`; the columns of an ODE's sensitivities together."""
        program = None if rate is None or not inputs[-1].size else _find_program(rate)
        if rate is None or program is None:
            return self.bind(step, inputs, results, operations)
        return bind_array_step(rate, program, self._as_rows(inputs), self._as_rows(results))

    def _as_rows(self, arrays: Sequence[Array]) -> list[Array]:
        return [np.moveaxis(a, 0, -1).reshape(-1, self._m) for a in arrays]


@functools.lru_cache(maxsize=64)
def _find_program(function: ca.Function) -> ArrayProgram | None:
    """The Function as operations on arrays; None where it has one that NumPy has not."""
    try:
        return ArrayProgram(function)
    except NotImplementedError:
        return None


def _count_parts(operations: int, m: int, threads: int) -> int:
    """Threads that pay for so many operations of m segments in CasADi's machine."""
    return max(1, min(threads, m * operations // OPERATIONS_A_THREAD))


def bind_array_step(
    rate: ca.Function, program: ArrayProgram, inputs: Sequence[Array], results: Sequence[Array]
) -> Callable[[], None]:
    """A call without arguments that takes a step of all segments from inputs (t, h, x, u, p, S) to results (x, S).

    Their shapes are (numbers, segments), S column by column; `program` is that of `rate` (`prepare_rollout`).
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
        for fraction, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):  # where RK4's later stages stand, their weights
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
