from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pneuopt.dynamics.compiled import c_writer as emission
from pneuopt.dynamics.compiled.c_writer import CFunction, write_c
from pneuopt.dynamics.compiled.compiler import find_compiler
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout
from pneuopt.quantities.arrays import Array

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
EDGES = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 5e-324, 1e-310, 720.0, -720.0, -744.0, -760.0, 1e308])


def computed(function: Callable[..., ca.SX], *inputs: Array) -> Array:
    """An elementwise function of SX, run in SIMD lanes: a number a segment."""
    t, h, x, u, p = (ca.SX.sym(n, k) for n, k in (("t", 1), ("h", 1), ("x", 0), ("u", len(inputs)), ("p", 0)))
    rollout = Rollout(Pieces(ca.Function("step", [t, h, x, u, p], [x, function(*ca.vertsplit(u))])), threads=1)
    m = len(inputs[0])
    zeros = np.zeros((m, 1))
    return rollout.run(np.zeros((m, 0)), np.stack(inputs, axis=1)[:, None], np.zeros(0), zeros, zeros).y[:, 0, 0]


@needs_compiler
@pytest.mark.parametrize(("name", "ulps"), [("exp", 1.1), ("tanh", 3.0), ("sqrt", 0.51)])
def test_own_functions_are_exact_to_the_last_places(name: str, ulps: float) -> None:
    rng = np.random.default_rng(0)
    spans = ((-1e-3, 1e-3), (-1.0, 1.0), (-25.0, 25.0), (-708.0, 709.0))
    x = np.concatenate([rng.uniform(a, b, 50_000) for a, b in spans])
    x = np.abs(x) if name == "sqrt" else x
    found, exact = computed(getattr(ca, name), x), getattr(np, name)(x.astype(np.longdouble))
    if np.finfo(np.longdouble).eps < 1e-18:  # elsewhere there is nothing better to compare with
        off = np.abs(found - exact) / np.spacing(np.abs(exact.astype(float)))
        assert float(off.max()) < ulps
    assert_allclose(found, exact.astype(float), rtol=1e-15)


@needs_compiler
def test_the_sine_is_exact_near_and_far() -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-a, a, 50_000) for a in (1e-3, 2.0, 300.0, 1e6, 1e9)])
    x = np.append(x, [np.pi, -np.pi, 22.0, 355.0, 0.0, 999_999.9])
    assert_allclose(computed(ca.sin, x), np.sin(x), rtol=0, atol=3e-16)
    assert_allclose(computed(ca.sin, x[-6:]), np.sin(x[-6:]), rtol=1e-12)


@needs_compiler
@pytest.mark.parametrize("name", ["exp", "tanh", "fabs", "sign", "sqrt", "sin"])
def test_edges_of_the_range(name: str) -> None:
    with np.errstate(all="ignore"):
        expected = getattr(np, name)(EDGES)
    assert_allclose(computed(getattr(ca, name), EDGES), expected, rtol=1e-15, atol=0)
    assert_array_equal(np.signbit(computed(ca.tanh, EDGES[:2])), [False, True])


CHOICES: dict[str, Callable[[ca.SX, ca.SX], ca.SX]] = {
    "smaller": ca.fmin,
    "larger": ca.fmax,
    "below": lambda a, b: a < b,
    "at most": lambda a, b: a <= b,
    "equal": lambda a, b: a == b,
    "unequal": lambda a, b: a != b,
    "neither": lambda a, b: ca.logic_and(ca.logic_not(a), ca.logic_not(b)),
    "either": ca.logic_or,
    "branches": lambda a, b: ca.if_else(a < b, ca.sqrt(b - a), ca.log(a - b + 1)),
    "copysign": ca.copysign,
    "power": lambda a, b: ca.fabs(a) ** b,
    "remainder": ca.fmod,
    "angle": ca.atan2,
    "length": ca.hypot,
    "waves": lambda a, b: ca.sin(a) + ca.cos(b) * ca.tan(a / 4) + ca.floor(b) - ca.ceil(a),
    "hyperbolas": lambda a, b: ca.sinh(a) + ca.cosh(b) + ca.asinh(a) + ca.log1p(a * a) + ca.expm1(b) + ca.erf(a),
    "quotients": lambda a, b: a / (b * b + 1) + b / (b * b + 1) + 1 / (3 + a * a) + a / 3 - b / 7 + 1 / (a * a + 1),
}


@pytest.mark.parametrize("name", CHOICES)
def test_two_argument_functions_are_those_of_the_casadi_vm(name: str) -> None:
    values = np.array([-2.0, -0.5, -0.0, 0.0, 0.5, 3.0, np.nan])
    values = values if name in ("smaller", "larger", "below", "at most", "unequal", "copysign") else values[:-1]
    a, b = (g.ravel() for g in np.meshgrid(values, values))
    sa, sb = ca.SX.sym("a"), ca.SX.sym("b")
    vm = ca.Function("f", [sa, sb], [CHOICES[name](sa, sb)])
    expected = np.array([float(vm(p, q)) for p, q in zip(a, b, strict=True)])
    assert_allclose(computed(CHOICES[name], a, b), expected, rtol=1e-14, atol=1e-15)


def statements(text: str, name: str) -> list[str]:
    body = text[text.index(f"void {name}(") :]
    return body[body.index("{\n") + 2 : body.index("}")].splitlines()


def test_what_changes_rarely_is_computed_rarely() -> None:
    x, u, p = (ca.SX.sym(n, 2) for n in "xup")
    f = ca.Function("f", [x, u, p], [x / ca.sqrt(p[0]) + ca.sin(u[0] * p[1])])
    text, kept = write_c(CFunction("rate", f, ("x", "u", "p"), ("y",)), {"p": 0, "u": 1, "x": 2})
    once, sampled, always = (" ".join(statements(text, f"rate_{n}")) for n in ("segment", "sample", "call"))
    assert "v_sqrt" in once
    assert "v_sin" in sampled
    assert "/" in once
    assert "/" not in always
    assert "v_" not in always
    assert kept == 2


def test_a_shared_divisor_divides_once() -> None:
    x = ca.SX.sym("x", 4)
    f = ca.Function("f", [x], [ca.vertcat(x[0] / x[3], x[1] / x[3], x[2] / x[1])])
    text, _ = write_c(CFunction("f", f, ("x",), ("y",)), {"x": 2})
    assert text.count(" / ") == 2


def test_an_operation_without_c_is_left_to_the_vm(
    forget: Callable[[], None], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = computed(ca.sin, EDGES[:4])
    forget()
    caplog.clear()  # where this machine has no compiler, that was said
    monkeypatch.delitem(emission.C_FUNCTIONS, ca.OP_SIN)
    assert_allclose(computed(ca.sin, EDGES[:4]), expected, rtol=1e-15)
    messages: list[Any] = [r.getMessage() for r in caplog.records]
    assert len(messages) == 1
    assert "this model runs in the CasADi VM" in messages[0]
