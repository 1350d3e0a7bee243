"""The C writer: C for SIMD lanes from SX Functions, every operation on a vector of lanes.

Each value is computed at the rarest of three rates that its inputs allow: once a segment (parameters), once a sample
(held inputs, step size), or at every call. What divides twice, or changes less often than what it divides, does so by a
reciprocal computed once: that moves a result by a rounding.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import casadi as ca

RATES = ("segment", "sample", "call")
C_OPERATORS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "ALL(1.0) / {0}",
    ca.OP_CONSTPOW: "v_pow({0}, {1})",
}
UNARY_FUNCTIONS = (
    "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh erf fabs floor ceil sign not"
)
BINARY_FUNCTIONS = "pow atan2 hypot fmod copysign fmin fmax lt le eq ne and or if_else_zero"
C_FUNCTIONS = {getattr(ca, f"OP_{name.upper()}"): f"v_{name}({{0}})" for name in UNARY_FUNCTIONS.split()}
C_FUNCTIONS |= {getattr(ca, f"OP_{name.upper()}"): f"v_{name}({{0}}, {{1}})" for name in BINARY_FUNCTIONS.split()}
DIVISIONS = (ca.OP_DIV, ca.OP_INV)


class CFunction(NamedTuple):
    """One CasADi Function to write as C."""

    name: str
    function: ca.Function  # SX, with dense results
    # inputs, outputs: the members of the C struct that hold its arguments and results
    inputs: Sequence[str]
    outputs: Sequence[str]


class Instruction(NamedTuple):
    """One operation of an SX Function: its kind, its operands, its result's place, and the number of a constant."""

    operation: int
    sources: Sequence[int]
    target: Sequence[int]
    constant: float


class CValue(NamedTuple):
    """A number in C, and how often it changes."""

    rate: int
    text: str


def write_c(c_function: CFunction, rates: Mapping[str, int]) -> tuple[str, int]:
    """C functions ``NAME_segment``, ``NAME_sample``, ``NAME_call`` on a struct ``Segment *s``; size of ``NAME_kept``.

    `rates` are indices into `RATES`; `NotImplementedError` for an operation of CasADi that has no C here.
    """
    writer = _CWriter(c_function, rates)
    functions = []
    for rate, statements in zip(RATES, writer.statements, strict=True):
        body = "".join(f"  {line}\n" for line in statements)
        functions.append(f"static void {c_function.name}_{rate}(Segment *s) {{\n{body}}}\n")
    return "\n".join(functions), len(writer.storage)


class _CWriter:
    """The C statements of one Function."""

    def __init__(self, c_function: CFunction, rates: Mapping[str, int]) -> None:
        self.c_function, self.rates = c_function, rates
        self.statements: tuple[list[str], ...] = tuple([] for _ in RATES)
        self.storage: dict[str, str] = {}  # what a rarer rate hands on, and its place
        self.values: dict[int, CValue] = {}
        self.reciprocals: dict[int, CValue] = {}
        instructions = list(read_instructions(c_function.function))
        self.divisors = Counter(i.sources[-1] for i in instructions if i.operation in DIVISIONS)
        for instruction in instructions:
            self._add(instruction)

    def _add(self, i: Instruction) -> None:
        if i.operation == ca.OP_OUTPUT:
            result = self._read(self.values[i.sources[0]], len(RATES) - 1)
            self.statements[-1].append(f"s->{self.c_function.outputs[i.target[0]]}[{i.target[1]}] = {result};")
            return
        if i.operation == ca.OP_INPUT:
            name = self.c_function.inputs[i.sources[0]]
            value = CValue(self.rates[name], f"s->{name}[{i.sources[1]}]")
        elif i.operation == ca.OP_CONST:
            infinite = "NAN" if math.isnan(i.constant) else "INFINITY" if i.constant > 0 else "-INFINITY"
            value = CValue(0, f"ALL({repr(i.constant) if math.isfinite(i.constant) else infinite})")
        else:
            values, operation = [self.values[k] for k in i.sources], i.operation
            if operation in DIVISIONS:
                divisor, rarer = i.sources[-1], values[-1].rate < max(v.rate for v in values)
                if operation == ca.OP_INV or rarer or self.divisors[divisor] > 1:
                    if divisor not in self.reciprocals:
                        self.reciprocals[divisor] = self._assign(f"r{divisor}", ca.OP_INV, [self.values[divisor]])
                    values[-1] = self.reciprocals[divisor]
                    operation = ca.OP_ASSIGN if operation == ca.OP_INV else ca.OP_MUL
            value = self._assign(f"a{i.target[0]}", operation, values)
        self.values[i.target[0]] = value

    def _assign(self, name: str, operation: int, values: Sequence[CValue]) -> CValue:
        form = C_OPERATORS.get(operation) or C_FUNCTIONS.get(operation)
        if form is None:
            raise NotImplementedError(f"CasADi's operation {operation}")
        rate = max(v.rate for v in values)
        expression = form.format(*(self._read(v, rate) for v in values))
        self.statements[rate].append(f"const Lanes {name} = {expression};")
        return CValue(rate, name)

    def _read(self, value: CValue, rate: int) -> str:
        """The value as a statement of this rate sees it."""
        if value.rate == rate or not value.text.isidentifier():
            return value.text
        if value.text not in self.storage:
            self.storage[value.text] = f"s->{self.c_function.name}_kept[{len(self.storage)}]"
            self.statements[value.rate].append(f"{self.storage[value.text]} = {value.text};")
        return self.storage[value.text]


def read_instructions(function: ca.Function) -> Iterator[Instruction]:
    """The Function's operations, each result in a place of its own."""
    symbols = function.sx_in()
    f = ca.Function(function.name(), symbols, function.call(symbols), {"live_variables": False, "cse": True})
    for k in range(f.n_instructions()):
        operation = f.instruction_id(k)
        constant = f.instruction_constant(k) if operation == ca.OP_CONST else math.nan
        yield Instruction(operation, f.instruction_input(k), f.instruction_output(k), constant)
