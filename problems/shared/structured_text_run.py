"""A function block in structured text, run over the tree of blark's parser; it knows nothing of our writer."""

import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

from blark.parse import parse_source_code

OPERATORS: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
    "<>": operator.ne,
    "AND": lambda a, b: a and b,
    "OR": lambda a, b: a or b,
}
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "MIN": min,
    "MAX": max,
    "ABS": abs,
    "EXP": math.exp,
    "LN": math.log,
    "SIN": math.sin,
    "COS": math.cos,
    "SQRT": math.sqrt,
    "SEL": lambda chosen, no, yes: yes if chosen else no,
    "LREAL_TO_LINT": round,
    "LINT_TO_LREAL": float,
}


class FunctionBlock:
    """An instance of the only block of a source."""

    def __init__(self, source: str) -> None:
        parsed = parse_source_code(source)
        assert parsed.exception is None, parsed.exception
        (self.block,) = parsed.transform().items
        self.variables: dict[str, Any] = {}
        for section in self.block.declarations:
            for item in section.items:
                for variable in item.variables:
                    name = str(variable).partition(" ")[0]
                    assert name.lower() not in {n.lower() for n in self.variables}, f"{name} is declared twice"
                    self.variables[name] = self.first_value(item.init)

    def first_value(self, init: Any) -> Any:
        """Of a declaration."""
        kind, _, value = str(init).partition(":=")
        assert kind.strip() in ("LREAL", "BOOL")
        return float(value) if value.strip() else {"LREAL": 0.0, "BOOL": False}[kind.strip()]

    def call(self, **inputs: float) -> Mapping[str, Any]:
        """Call it once with these inputs; returns all its variables."""
        for name, value in inputs.items():
            assert name in self.variables
            self.variables[name] = value
        self.run(self.block.body.statements)
        return self.variables

    def run(self, statements: Any) -> None:
        """Run assignments and conditions."""
        for s in statements:
            if type(s).__name__ == "IfStatement":
                if self.value(s.if_expression):
                    self.run(s.statements.statements)
                continue
            assert type(s).__name__ == "AssignmentStatement", type(s).__name__
            (target,) = s.variables
            value = self.value(s.expression)
            assert type(value) is type(self.variables[str(target.name)]), f"{target.name} gets another type"
            self.variables[str(target.name)] = value

    def value(self, e: Any) -> Any:
        """Of an expression, which never mixes types."""
        kind = type(e).__name__
        if kind == "SimpleVariable":
            return self.variables[str(e.name)]
        if kind == "ParenthesizedExpression":
            return self.value(e.expr)
        if kind == "BinaryOperation":
            left, right = self.value(e.left), self.value(e.right)
            assert type(left) is type(right), f"{e}: mixes types"
            return OPERATORS[str(e.op).upper()](left, right)
        if kind == "UnaryOperation":
            inner = self.value(e.expr)
            return (not inner) if str(e.op).upper() == "NOT" else -inner
        if kind == "FunctionCall":
            return FUNCTIONS[str(e.name)](*(self.value(p.value) for p in e.parameters))
        text = str(e).strip()
        if re.fullmatch("(?i)true|false", text):
            return text.lower() == "true"
        assert re.fullmatch(r"-?\d+\.\d+(E-?\d+)?", text), f"{kind}: {text}"
        return float(text)
