"""`compile_function`: a CasADi Function that is called on arrays, as machine code where a compiler is found.

`compile_rate` is its form for an integrator's inner loop, `compile_rows` that for many points at once.
"""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.dynamics.compiled.compiler import compile_library
from pneuopt.dynamics.compiled.vm import bind_function
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError

ROWS_SOURCE = """
CASADI_SYMBOL_EXPORT void system_rows(const casadi_real** arg, casadi_real** res, const casadi_int* arg_steps,
                                      const casadi_int* res_steps, const casadi_int* sizes, casadi_real* w) {
  casadi_int k, i;
  for (k = 0; k < sizes[2]; ++k) {
    system_function(arg, res, 0, w, 0);
    for (i = 0; i < sizes[0]; ++i) arg[i] += arg_steps[i];
    for (i = 0; i < sizes[1]; ++i) res[i] += res_steps[i];
  }
}
"""
"""Calls the function row by row; sizes: how many arguments, results and rows; steps: numbers from row to row."""


def compile_function(function: ca.Function) -> Callable[..., tuple[Array, ...]]:
    """Make an SX Function callable on arrays, as machine code where a compiler is found; not thread-safe.

    Vectors are flat, matrices of shape (rows, columns).
    """
    code = _BoundCode.of(_with_dense_outputs(function, "system_function"))
    buffers, results, call, pointers = code.buffers, code.results, code.call, code.pointers

    def call_function(*inputs: ArrayLike) -> tuple[Array, ...]:
        for i, (buffer, value) in enumerate(zip(buffers, inputs, strict=True)):
            size = value.size if isinstance(value, np.ndarray) else 1 if isinstance(value, float) else np.size(value)
            if size != buffer.size:
                raise ModelError(f"argument {i} has {size} numbers, expected {buffer.size}")
            buffer[...] = value
        call(*pointers)
        return tuple([result.copy() for result in results])

    call_function.keep_alive = code  # type: ignore[attr-defined]
    return call_function


def compile_rate(ode: ca.Function) -> Callable[[float, Array, Array, Array], Array]:
    """``f(t, x, u, p) -> xdot``, a right-hand side's first output, in a fifth of the time of `compile_function`.

    For an integrator's inner loop: the arrays' lengths are not checked. Not thread-safe.
    """
    code = _BoundCode.of(_with_dense_outputs(ode, "system_function"), wanted=1)
    (at, states, inputs, parameters), (rate,), call, pointers = code.buffers, code.results, code.call, code.pointers

    def call_rate(t: float, x: Array, u: Array, p: Array) -> Array:
        at[0], states[:], inputs[:], parameters[:] = t, x, u, p
        call(*pointers)
        return rate.copy()

    call_rate.keep_alive = code  # type: ignore[attr-defined]
    return call_rate


def compile_held_rate(ode: ca.Function) -> Callable[[float, Array, Array], Callable[[float, Array], Array]]:
    """``hold(origin, u, p) -> f``, ``f(t, x) -> xdot`` at ``origin + t``: `compile_rate` in two thirds of its time.

    The next call of any f overwrites its array; the inputs are those of the last `hold`. Not thread-safe.
    """
    code = _BoundCode.of(_with_dense_outputs(ode, "system_function"), wanted=1)
    (at, states, inputs, parameters), (rate,), call, pointers = code.buffers, code.results, code.call, code.pointers

    def hold(origin: float, u: Array, p: Array) -> Callable[[float, Array], Array]:
        inputs[:], parameters[:] = u, p

        def call_held_rate(t: float, x: Array) -> Array:
            at[0], states[:] = origin + t, x
            call(*pointers)
            return rate

        return call_held_rate

    hold.keep_alive = code  # type: ignore[attr-defined]
    return hold


def compile_rows(function: ca.Function) -> Callable[..., tuple[Array, ...]]:
    """Make an SX Function callable on many points at once: the code of `compile_function`, and its numbers to the bit.

    An input has a row a point, (n, k), or is the same for all, (k,); at least one has rows. Not thread-safe.
    """
    code = _BoundCode.of(_with_dense_outputs(function, "system_function"))

    def call_rows(*inputs: ArrayLike) -> tuple[Array, ...]:
        given = [np.ascontiguousarray(value, dtype=float) for value in inputs]
        (count,) = {len(rows) for rows in given if rows.ndim == 2}
        for i, (buffer, rows) in enumerate(zip(code.buffers, given, strict=True)):
            if rows.shape[rows.ndim == 2 :] != buffer.shape:
                raise ModelError(f"argument {i} has shape {rows.shape}, expected rows of {buffer.size} numbers")
        results = tuple(np.empty((count, result.size)) for result in code.results)
        if code.library is not None:
            library, arg, res, work = code.keep_alive
            sources = (ctypes.c_void_p * len(arg))(*(rows.ctypes.data for rows in given))
            targets = (ctypes.c_void_p * len(res))(*(rows.ctypes.data for rows in results))
            steps = [[a.shape[1] if a.ndim == 2 else 0 for a in arrays] for arrays in (given, results)]
            sizes = [np.array(each, dtype=np.int64) for each in (*steps, [len(given), len(results), count])]
            library.system_rows.restype = None
            library.system_rows(sources, targets, *(ctypes.c_void_p(a.ctypes.data) for a in (*sizes, work)))
            return results
        for k in range(count):
            for buffer, rows in zip(code.buffers, given, strict=True):
                buffer[:] = rows[k] if rows.ndim == 2 else rows
            code.call(*code.pointers)
            for target, result in zip(results, code.results, strict=True):
                target[k] = result
        return results

    return call_rows


@dataclass(frozen=True, eq=False)
class _BoundCode:
    """A Function's code with the memory that it reads and writes: machine code, or the VM's where there is none."""

    call: Callable[..., object]
    pointers: tuple[object, ...]
    buffers: list[Array]
    results: list[Array]
    keep_alive: tuple[Any, ...]
    library: ctypes.CDLL | None = None

    @classmethod
    def of(cls, function: ca.Function, wanted: int | None = None) -> "_BoundCode":
        """Of a Function of which only the first `wanted` results are kept."""
        buffers = [_buffer(function.size_in(i)) for i in range(function.n_in())]
        results = [_buffer(function.size_out(i)) for i in range(function.n_out())][:wanted]
        generator = ca.CodeGenerator("generated.c", {"with_header": False, "verbose": False})
        generator.add(function)
        library = compile_library(str(generator.dump()) + ROWS_SOURCE)
        if library is None:
            return cls(bind_function(function, buffers, results), (), buffers, results, ())
        work = np.zeros(max(1, function.sz_w()))
        arg = (ctypes.c_void_p * max(1, function.sz_arg()))(*(b.ctypes.data for b in buffers))
        res = (ctypes.c_void_p * max(1, function.sz_res()))(*(r.ctypes.data for r in results))
        call = library.system_function
        call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
        pointers = (ctypes.addressof(arg), ctypes.addressof(res), None, work.ctypes.data, 0)
        return cls(call, pointers, buffers, results, (library, arg, res, work), library)


def _with_dense_outputs(function: ca.Function, name: str) -> ca.Function:
    inputs = [ca.SX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    outputs = function.call(inputs)
    return ca.Function(name, inputs, [ca.densify(o) for o in outputs], {"cse": True})


def _buffer(shape: tuple[int, int]) -> Array:
    """Vectors flat, matrices in CasADi's column order."""
    return np.zeros(shape[0] * shape[1]) if 1 in shape else np.zeros(shape, order="F")
