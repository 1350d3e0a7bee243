"""The walk over a graph: its text computes what the graph computes, in its order, with divisions where needed."""

import casadi as ca
import numpy as np
import pytest

from pneuopt.export.python_class import PYTHON
from pneuopt.export.writer import Names, Written, write_expressions

a, b, c = (ca.SX.sym(n) for n in "abc")
EXPRESSIONS = [
    a - (b - c), a - b - c, a - (b + c), a / (b / c), a / b / c, a * (b / c), -(a + b) * c, -a - -b, (a * b) ** 2,
    (a - b) * (a + b), 2 * (a + b), 1 / (a + b), ca.if_else(a > b, a - b, c), (a < b) * c, ca.fmin(ca.fmax(a, -b), c),
    ca.if_else(ca.logic_and(a > 0, b < c), a, b + c), ca.if_else(ca.logic_not(a > b), 1, ca.fabs(c)), (a + b) + (c + a),
]  # fmt: skip


def write(expression: ca.SX, parameters: frozenset[str] = frozenset()) -> Written:
    function = ca.Function("f", [ca.vertcat(a, b, c)], [expression])
    return write_expressions(function, Names([["a", "b", "c"]], ["y"], parameters=parameters), PYTHON)


def value(written: Written, given: dict[str, float]) -> float:
    space = dict(given)
    for line in (*written.coefficients, *written.statements):
        space[line.name] = eval(line.text, {"math": __import__("math")}, space)
    return float(eval(written.results["y"], {"math": __import__("math")}, space))


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
@pytest.mark.parametrize("parameters", [frozenset(), frozenset("b"), frozenset("bc")], ids=len)
def test_the_text_is_the_expression(expression: ca.SX, parameters: frozenset[str]) -> None:
    function = ca.Function("f", [ca.vertcat(a, b, c)], [expression])
    for given in np.random.default_rng(0).normal(size=(5, 3)):
        own = value(write(expression, parameters), dict(zip("abc", given.tolist(), strict=True)))
        assert own == pytest.approx(float(function(given)), rel=1e-14)


def test_a_division_by_a_parameter_is_a_factor_but_not_before_a_jump() -> None:
    assert "/" not in write(a / b, frozenset("b")).results["y"]
    exact = write(ca.floor(a / b), frozenset("b"))
    assert value(exact, {"a": 49.0, "b": 49.0, "c": 0.0}) == 1.0
    assert 49.0 * (1 / 49.0) < 1.0  # which a factor would have made 0
