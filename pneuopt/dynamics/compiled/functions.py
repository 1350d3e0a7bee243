"""`compile_function`: a CasADi Function that is called on arrays, as machine code where a compiler is found."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.dynamics.compiled.compiler import compile_library
from pneuopt.dynamics.compiled.vm import bind_function
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError


def compile_function(function: ca.Function) -> Callable[..., tuple[Array, ...]]:
    """Make an SX Function callable on arrays, as machine code where a compiler is found.

    Parameters
    ----------
    function : casadi.Function
        Inputs and outputs dense vectors, scalars or matrices.

    Returns
    -------
    callable
        ``f(*inputs) -> tuple of ndarray``: vectors flat, matrices of shape (rows, columns). Not thread-safe.
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
    """The first output of a right-hand side, in a fifth of the time of `compile_function`: an integrator's inner loop.

    Parameters
    ----------
    ode : casadi.Function
        ``(t, x, u, p) -> (xdot, ...)``.

    Returns
    -------
    callable
        ``f(t, x, u, p) -> xdot`` on arrays of these lengths, which are not checked. Not thread-safe.
    """
    code = _BoundCode.of(_with_dense_outputs(ode, "system_function"), wanted=1)
    (at, states, inputs, parameters), (rate,), call, pointers = code.buffers, code.results, code.call, code.pointers

    def call_rate(t: float, x: Array, u: Array, p: Array) -> Array:
        at[0], states[:], inputs[:], parameters[:] = t, x, u, p
        call(*pointers)
        return rate.copy()

    call_rate.keep_alive = code  # type: ignore[attr-defined]
    return call_rate


@dataclass(frozen=True, eq=False)
class _BoundCode:
    """A Function's code with the memory that it reads and writes: machine code, or the VM's where there is none."""

    call: Callable[..., object]
    pointers: tuple[object, ...]
    buffers: list[Array]
    results: list[Array]
    keep_alive: tuple[object, ...]

    @classmethod
    def of(cls, function: ca.Function, wanted: int | None = None) -> "_BoundCode":
        """Of a Function of which only the first `wanted` results are kept."""
        buffers = [_buffer(function.size_in(i)) for i in range(function.n_in())]
        results = [_buffer(function.size_out(i)) for i in range(function.n_out())][:wanted]
        library = compile_library(_casadi_source(function))
        if library is None:
            return cls(bind_function(function, buffers, results), (), buffers, results, ())
        work = np.zeros(max(1, function.sz_w()))
        arg = (ctypes.c_void_p * max(1, function.sz_arg()))(*(b.ctypes.data for b in buffers))
        res = (ctypes.c_void_p * max(1, function.sz_res()))(*(r.ctypes.data for r in results))
        call = library.system_function
        call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
        pointers = (ctypes.addressof(arg), ctypes.addressof(res), None, work.ctypes.data, 0)
        return cls(call, pointers, buffers, results, (library, arg, res, work))


def _casadi_source(function: ca.Function) -> str:
    generator = ca.CodeGenerator("generated.c", {"with_header": False, "verbose": False})
    generator.add(function)
    return str(generator.dump())


def _with_dense_outputs(function: ca.Function, name: str) -> ca.Function:
    inputs = [ca.SX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    outputs = function.call(inputs)
    return ca.Function(name, inputs, [ca.densify(o) for o in outputs], {"cse": True})


def _buffer(shape: tuple[int, int]) -> Array:
    """Vectors flat, matrices in CasADi's column order."""
    return np.zeros(shape[0] * shape[1]) if 1 in shape else np.zeros(shape, order="F")
