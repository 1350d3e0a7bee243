"""SX Functions as operations on arrays give what CasADi gives, operation by operation.

A step of many segments, its sensitivities' columns together, is the one of each segment alone.
"""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pneuopt.dynamics.compiled import vm as array_program
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.compiled.vm import ArrayProgram
from pneuopt.dynamics.system import System, discretise
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.arrays import Array

ODD = [-np.inf, -2.5, -1.0, -0.3, -0.0, 0.0, 0.2, 1.0, 1.5, 3.0, 710.0, np.inf, np.nan]
UNARY = "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh erf fabs floor ceil sign"
BINARY = "power atan2 hypot fmod copysign fmin fmax lt le eq ne logic_and logic_or if_else_zero"


def evaluate(function: ca.Function, *inputs: Array) -> Array:
    """By a program, of one output."""
    out = np.empty((function.size1_out(0), inputs[0].shape[1]))
    with np.errstate(all="ignore"):
        ArrayProgram(function).bind(inputs, [out])()
    return out


def by_casadi(function: ca.Function, *inputs: Array) -> Array:
    return np.array([np.array(function(*column)).ravel() for column in zip(*(i.T for i in inputs), strict=True)]).T


@pytest.mark.parametrize("name", [*UNARY.split(), *BINARY.split(), "not", "div", "inv", "sq", "twice", "neg"])
def test_an_operation_is_casadi_s_on_odd_numbers_too(name: str) -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    others = {
        "not": lambda: ca.logic_not(x),
        "div": lambda: x / y,
        "inv": lambda: 1 / x,
        "sq": lambda: x * x,
        "twice": lambda: 2 * x,
        "neg": lambda: -x,
        "if_else_zero": lambda: ca.if_else(x > y, ca.log(y), 0),
        "power": lambda: ca.power(x, y) + x**2.5,
    }
    value = others[name]() if name in others else getattr(ca, name)(x, *([y] if name in BINARY.split() else []))
    function = ca.Function("f", [x, y], [value])
    points = np.array([[a, b] for a in ODD for b in ODD]).T.copy()
    ours, theirs = evaluate(function, points[:1], points[1:]), by_casadi(function, points[:1], points[1:])
    assert_allclose(ours, theirs, rtol=1e-14, atol=1e-300)


def test_an_operation_that_numpy_has_not_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(array_program.OPERATIONS, ca.OP_TANH)
    x = ca.SX.sym("x")
    with pytest.raises(NotImplementedError, match="operation"):
        ArrayProgram(ca.Function("f", [x], [ca.tanh(x)]))


def test_rows_are_taken_over_and_inputs_stay() -> None:
    x = ca.SX.sym("x", 2)
    value = x
    for _ in range(50):
        value = ca.sin(value) + x[::-1]
    function = ca.Function("f", [x], [ca.vertcat(value, x, 3.0)])
    given = np.linspace(-1, 1, 8).reshape(2, 4)
    kept = given.copy()
    assert_allclose(evaluate(function, given), by_casadi(function, given), rtol=1e-14)
    assert_allclose(given, kept, rtol=0)
    assert ArrayProgram(function).n_rows < 8


SEGMENTS = 400


@pytest.mark.parametrize("start", [True, False])
def test_many_segments_as_arrays_are_each_of_them_in_casadi_s_machine(axis: System, start: bool) -> None:
    for system, wrt in ((axis, [0, 2]), (ForceDrive(Stribeck()).system(), [0, 1, 3])):
        rng, n = np.random.default_rng(0), 5
        x0, u = rng.normal(0, 0.1, (SEGMENTS, len(system.states))), rng.normal(0, 20, (SEGMENTS, n, len(system.inputs)))
        t, h = np.tile(np.arange(n) * 1e-3, (SEGMENTS, 1)), np.full((SEGMENTS, n), 1e-3)
        h[::7, -2:] = 0.0  # short segments
        p = np.array([system.parameters.value(name) for name in system.parameters])
        rollout = Rollout(discretise(system).pieces, wrt, start, threads=1, lanes=0)
        together = rollout.run(x0, u, p, t, h, substeps=3)
        alone = [rollout.run(x0[[i]], u[[i]], p, t[:1], h[[i]], substeps=3) for i in range(15)]
        assert together.dy is not None
        assert together.dx_end is not None
        assert_allclose(together.x_end[:15], np.concatenate([r.x_end for r in alone]), rtol=1e-12, atol=1e-14)
        for name in ("dy", "dx_end"):
            expected = np.concatenate([getattr(r, name) for r in alone])
            scale = np.abs(expected).max()
            assert_allclose(getattr(together, name)[:15] / scale, expected / scale, rtol=1e-10, atol=1e-13)
