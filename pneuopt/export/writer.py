"""`write_expressions`: the operations of an SX Function as assignments in any language, readable by its engineers.

A walk over the graph, whose operations a `Syntax` words. Symbols keep their names; what has a label gets its name; what
is used once stands where it is used. Each value is computed at the rarer of two rates: when the parameters are set, or
at every sample; a division by what is known before the sample becomes a multiplication by its reciprocal, which moves a
result by a rounding.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import NamedTuple

import casadi as ca

from pneuopt.dynamics.compiled.c_writer import DIVISIONS, Instruction, read_instructions
from pneuopt.export.identifiers import Identifiers

MAX_INLINE = 70
"""Length of an expression that stands within another [character]: a longer one gets a name of its own; below some 40
each operation has a line, above some 100 lines are too long to read."""

SELECT = -1  # the operation "where a condition holds, this, else that", which CasADi has in four parts
COMPARISONS = frozenset({ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE})
LOGIC = frozenset({ca.OP_NOT, ca.OP_AND, ca.OP_OR})
STEPS = COMPARISONS | {ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN}  # operations that jump: a rounding before them may show


class Binding(IntEnum):
    """How tightly an expression holds together: what is looser than its place asks for gets parentheses."""

    SELECT = 0
    OR = 1
    AND = 2
    COMPARISON = 3
    SUM = 4
    PRODUCT = 5
    ATOM = 7


class Form(NamedTuple):
    """How a language words an operation: a template with {0}, {1}, {2}, how tightly it and its operands bind."""

    template: str
    binding: Binding = Binding.ATOM
    needs: tuple[Binding, ...] = (Binding.SELECT, Binding.SELECT, Binding.SELECT)


_LEFT_TO_RIGHT = {Binding.SUM: Binding.PRODUCT, Binding.PRODUCT: Binding.ATOM, Binding.COMPARISON: Binding.SUM}


def infix(sign: str, binding: Binding) -> Form:
    """An operation between its two operands, read from left to right."""
    tighter = _LEFT_TO_RIGHT.get(binding, Binding.ATOM)
    return Form(f"{{0}} {sign} {{1}}", binding, (tighter if binding is Binding.COMPARISON else binding, tighter))


def unary_calls(names: str, template: str = "{}") -> dict[int, Form]:
    """Functions of one argument that a language calls as CasADi does, but for the template around the name."""
    return {getattr(ca, f"OP_{n.upper()}"): Form(f"{template.format(n)}({{0}})") for n in names.split()}


COMPARED = (Binding.COMPARISON, Binding.COMPARISON)  # what "and" and "or" need of their operands
ARITHMETIC: Mapping[int, Form] = {
    ca.OP_ASSIGN: Form("{0}"),
    ca.OP_ADD: infix("+", Binding.SUM),
    ca.OP_SUB: infix("-", Binding.SUM),
    ca.OP_MUL: infix("*", Binding.PRODUCT),
    ca.OP_DIV: infix("/", Binding.PRODUCT),
    ca.OP_NEG: Form("-{0}", Binding.SUM, (Binding.ATOM,)),
    ca.OP_SQ: Form("{0} * {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_TWICE: Form("2.0 * {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_INV: Form("1.0 / {0}", Binding.PRODUCT, (Binding.ATOM,)),
    ca.OP_LT: infix("<", Binding.COMPARISON),
    ca.OP_LE: infix("<=", Binding.COMPARISON),
}
"""What is worded alike in C, structured text, Python and JavaScript."""


@dataclass(frozen=True)
class Syntax:
    """What a language calls the operations.

    Attributes
    ----------
    forms : mapping of int to Form
        By CasADi's operation, and `SELECT`.
    infinity : str
        A number larger than all others.
    truth : Form
        1 where a condition holds, else 0.
    condition : Form
        Whether a number is not 0.
    """

    forms: Mapping[int, Form]
    infinity: str
    truth: Form
    condition: Form

    def literal(self, value: float) -> str:
        """A number that reads back as the same double."""
        if math.isinf(value):
            return self.infinity if value > 0 else f"-{self.infinity}"
        return repr(float(value))


class Assignment(NamedTuple):
    """A name and the expression of its value."""

    name: str
    text: str


@dataclass
class Written:
    """What `write_expressions` gives.

    Attributes
    ----------
    coefficients : list of Assignment
        What depends on the parameters alone.
    statements : list of Assignment
        What is computed at every sample before the results.
    results : dict of str to str
        The expression of each result.
    operations : set of int
        The operations in them.
    """

    coefficients: list[Assignment] = field(default_factory=list)
    statements: list[Assignment] = field(default_factory=list)
    results: dict[str, str] = field(default_factory=dict)
    operations: set[int] = field(default_factory=set)


class Names(NamedTuple):
    """What the numbers of a Function are called.

    Attributes
    ----------
    inputs : sequence of sequence of str
        The entries of each argument.
    results : sequence of str
        The entries of the first output.
    labels : sequence of str
        Those of the second, which only gives names to values on the way; a Function may have but one output.
    parameters : frozenset of str
        Which inputs are known before the sample.
    constants : mapping of float to str
        Names of constants.
    coefficient : str
        How a value that depends on the parameters alone is reached, {} being its name.
    taken : frozenset of str
        Names besides that no value on the way may have.
    """

    inputs: Sequence[Sequence[str]]
    results: Sequence[str]
    labels: Sequence[str] = ()
    parameters: frozenset[str] = frozenset()
    constants: Mapping[float, str] = {}
    coefficient: str = "{}"
    taken: frozenset[str] = frozenset()


def write_expressions(function: ca.Function, names: Names, syntax: Syntax) -> Written:
    """Write a Function in a language.

    Parameters
    ----------
    function : casadi.Function
        SX, with dense results.
    names : Names
    syntax : Syntax

    Raises
    ------
    NotImplementedError
        For an operation of CasADi that the language has no word for.

    Examples
    --------
    >>> from pneuopt.export.python_class import PYTHON
    >>> x, T = ca.SX.sym("x"), ca.SX.sym("T")
    >>> f = ca.Function("f", [x, T], [2 / T * (x - 1)])
    >>> found = write_expressions(f, Names([["x"], ["T"]], ["y"], parameters=frozenset({"T"})), PYTHON)
    >>> found.coefficients, found.results
    ([Assignment(name='k1', text='2.0 / T')], {'y': 'k1 * (x - 1.0)'})
    """
    writer = _Writer(names, syntax, _simplify(list(read_instructions(function))))
    return writer.write()


@dataclass(frozen=True)
class _Value:
    text: str
    binding: Binding
    is_condition: bool = False
    varies: bool = False  # from sample to sample
    is_atom: bool = False  # a name or a number


class _Writer:
    """The state of one walk."""

    def __init__(self, names: Names, syntax: Syntax, instructions: list[Instruction]) -> None:
        self.names, self.syntax, self.instructions = names, syntax, instructions
        self.written = Written()
        self.values: dict[int, _Value] = {}
        self.reciprocals: dict[int, int] = {}
        labelled = [i for i in instructions if i.operation == ca.OP_OUTPUT and i.target[0] == 1]
        self.uses = Counter(k for i in instructions if i not in labelled for k in _operands(i))
        results = [i for i in instructions if i.operation == ca.OP_OUTPUT and i.target[0] == 0]
        self.labels = {i.sources[0]: names.results[i.target[1]] for i in reversed(results)}
        self.labels |= {i.sources[0]: names.labels[i.target[1]] for i in reversed(labelled)}
        self.exact = _before_jumps(instructions)
        given = (n for entries in (*names.inputs, names.results, names.labels) for n in entries)
        self.identifiers = Identifiers([*given, *names.constants.values(), *names.taken])

    def write(self) -> Written:
        for i in self.instructions:
            if i.operation == ca.OP_OUTPUT:
                if i.target[0] == 0:
                    self.written.results[self.names.results[i.target[1]]] = self._number(i.sources[0]).text
            else:
                self.values[i.target[0]] = self._shorten(i.target[0], self._evaluate(i))
        return self.written

    def _evaluate(self, i: Instruction) -> _Value:
        if i.operation == ca.OP_INPUT:
            name = self.names.inputs[i.sources[0]][i.sources[1]]
            return _Value(name, Binding.ATOM, varies=name not in self.names.parameters, is_atom=True)
        if i.operation == ca.OP_CONST:
            known = self.names.constants.get(i.constant)
            literal = self.syntax.literal(i.constant)
            return _Value(known or literal, Binding.SUM if literal.startswith("-") else Binding.ATOM, is_atom=True)
        if i.operation in DIVISIONS and i.target[0] not in self.exact:
            factor = self._factor(i)
            if factor is not None:
                return factor
        return self._apply(i.operation, i.sources)

    def _factor(self, i: Instruction) -> _Value | None:
        """A division of what varies by what does not, as a multiplication; None for another one."""
        divisor = self._number(i.sources[-1])
        if divisor.varies or i.operation == ca.OP_INV or not self._number(i.sources[0]).varies:
            return None
        if i.sources[-1] not in self.reciprocals:
            place = -2 - len(self.reciprocals)  # a place that no instruction has
            self.values[place] = self._apply(ca.OP_INV, [i.sources[-1]])
            self.reciprocals[i.sources[-1]] = place
        return self._apply(ca.OP_MUL, [i.sources[0], self.reciprocals[i.sources[-1]]])

    def _apply(self, operation: int, sources: Sequence[int]) -> _Value:
        form = self.syntax.forms.get(operation)
        if form is None:
            raise NotImplementedError(f"CasADi's operation {operation}")
        self.written.operations.add(operation)
        conditional = operation in (SELECT, ca.OP_IF_ELSE_ZERO)
        asks = [operation in LOGIC or (conditional and k == 0) for k in range(len(sources))]
        found = [self._condition(k) if asked else self._number(k) for k, asked in zip(sources, asks, strict=True)]
        varies = any(v.varies for v in found)
        if varies:
            found = [v if v.varies else self._keep(k, v) for k, v in zip(sources, found, strict=True)]
        if form.template.count("{0}") > 1 and not found[0].is_atom:
            found[0] = self._name(sources[0], found[0])
        texts = (v.text if v.binding >= need else f"({v.text})" for v, need in zip(found, form.needs, strict=False))
        return _Value(form.template.format(*texts), form.binding, operation in COMPARISONS | LOGIC, varies)

    def _shorten(self, place: int, value: _Value) -> _Value:
        """The value, under a name of its own where it has a label, is used again, or is long."""
        if value.is_atom:
            return value
        again = self.uses[place] > 1
        wanted = self.labels.get(place) in self.names.labels or again or len(value.text) > MAX_INLINE
        return self._name(place, value) if wanted and not value.is_condition else value

    def _keep(self, place: int, value: _Value) -> _Value:
        """What is computed when parameters are set, for a sample's use."""
        if value.is_atom or value.is_condition:
            return value
        named = self._name(place, value)
        self.values[place] = named
        return named

    def _name(self, place: int, value: _Value) -> _Value:
        written = self.written
        own = self.labels.get(place)
        taken = {a.name for a in (*written.coefficients, *written.statements)}
        if own is None or own in taken:
            own = self.identifiers.claim_next("v" if value.varies else "k")
        (written.statements if value.varies else written.coefficients).append(Assignment(own, value.text))
        text = own if value.varies else self.names.coefficient.format(own)
        return replace(value, text=text, binding=Binding.ATOM, is_atom=True)

    def _number(self, place: int) -> _Value:
        value = self.values[place]
        return self._wrap(self.syntax.truth, value, False) if value.is_condition else value

    def _condition(self, place: int) -> _Value:
        value = self.values[place]
        return value if value.is_condition else self._wrap(self.syntax.condition, value, True)

    def _wrap(self, form: Form, value: _Value, is_condition: bool) -> _Value:
        text = value.text if value.binding >= form.needs[0] else f"({value.text})"
        return _Value(form.template.format(text), form.binding, is_condition, value.varies)


def _simplify(instructions: list[Instruction]) -> list[Instruction]:
    """The four parts of a choice as one operation, and nothing that no result needs."""
    made = {i.target[0]: i for i in instructions if i.operation != ca.OP_OUTPUT}
    found = [_select(i, made) if i.operation == ca.OP_ADD else i for i in instructions]
    needed: set[int] = set()
    kept = []
    for i in reversed(found):
        if i.operation == ca.OP_OUTPUT or i.target[0] in needed:
            kept.append(i)
            needed |= set(_operands(i))
    return kept[::-1]


def _operands(i: Instruction) -> Sequence[int]:
    """The places of what an operation is done with."""
    return () if i.operation == ca.OP_INPUT else i.sources


def _select(i: Instruction, made: Mapping[int, Instruction]) -> Instruction:
    """``a where c, plus b where not c`` as one choice."""
    first, second = (made[k] for k in i.sources)
    if not first.operation == second.operation == ca.OP_IF_ELSE_ZERO:
        return i
    for one, other in ((first, second), (second, first)):
        negation = made[other.sources[0]]
        if negation.operation == ca.OP_NOT and negation.sources[0] == one.sources[0]:
            return i._replace(operation=SELECT, sources=(one.sources[0], one.sources[1], other.sources[1]))
    return i


def _before_jumps(instructions: list[Instruction]) -> set[int]:
    """Values from which an operation that jumps is computed: there a rounding could show."""
    found: set[int] = set()
    for i in reversed(instructions):
        if i.operation not in (ca.OP_OUTPUT, ca.OP_INPUT, ca.OP_CONST) and (
            i.operation in STEPS or i.target[0] in found
        ):
            found |= set(i.sources)
    return found
