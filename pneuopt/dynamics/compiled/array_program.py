"""`ArrayProgram`: an SX Function as calls of NumPy, each for one number of many segments at once.

CasADi's virtual machine takes 3 to 6 ns for an operation of one segment. NumPy takes half a microsecond for a call, and
then a tenth of that for a segment: some hundred segments at once run several times as fast.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from pneuopt.dynamics.compiled.c_writer import Instruction, read_instructions
from pneuopt.quantities.arrays import Array

Operation = Callable[..., Any]


def _if_else_zero(condition: Array, value: Array, out: Array) -> None:
    """The value where the condition holds, 0 elsewhere, even where the value is not a number."""
    out[...] = np.where(condition != 0, value, 0.0)


def _twice(value: Array, out: Array) -> None:
    np.add(value, value, out)


def _erf(value: Array, out: Array) -> None:
    from scipy.special import erf

    erf(value, out)


OPERATIONS: dict[int, Operation] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: _twice,
    ca.OP_INV: np.reciprocal,
    ca.OP_CONSTPOW: np.power,
    ca.OP_POW: np.power,
    ca.OP_SQRT: np.sqrt,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_ERF: _erf,
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
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
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
    """An SX Function as operations on arrays, each result in a row that a later one may take over.

    Parameters
    ----------
    function : casadi.Function
        SX, with dense results.

    Attributes
    ----------
    n_rows : int
        Numbers of a segment that it holds at once, constants included.

    Raises
    ------
    NotImplementedError
        For an operation of CasADi that NumPy has not.
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
        self._free += {self._places[s].row for s in i.sources if self._last_use[s] == k and self._is_reusable(s)}
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

    def _is_reusable(self, value: int) -> bool:
        place = self._places[value]
        return place.owner == "own" and place.row not in self._constants
