"""`compile_function`."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pneuopt.dynamics.compiled.functions import (
    compile_function,
    compile_held_rate,
    compile_rate,
    compile_rows,
)
from pneuopt.dynamics.system import parameter_vector
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import ModelError

Forget = Callable[[], None]


def mixed() -> ca.Function:
    a, B, c = ca.SX.sym("a"), ca.SX.sym("B", 2, 3), ca.SX.sym("c", 3)
    sparse = ca.SX(2, 2)
    sparse[0, 1] = a
    return ca.Function("f", [a, B, c], [a * B @ c, B.T * a, sparse, ca.SX(0, 1)])


@pytest.mark.parametrize("cc", [None, ""])
def test_compiled_takes_scalars_vectors_and_matrices(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    B, c = np.arange(6.0).reshape(2, 3), np.array([1.0, -1.0, 2.0])
    product, turned, sparse, nothing = compile_function(mixed())(2.0, B, c)
    assert_allclose(product, 2 * B @ c)
    assert_allclose(turned, 2 * B.T)
    assert_allclose(sparse, [[0, 2], [0, 0]])
    assert nothing.shape == (0,)


def test_results_are_the_callers_own() -> None:
    f = compile_function(mixed())
    first = f(1.0, np.ones((2, 3)), np.ones(3))[0]
    f(5.0, np.ones((2, 3)), np.ones(3))
    assert_array_equal(first, [3.0, 3.0])


@pytest.mark.parametrize("cc", [None, ""])
def test_a_rate_is_the_first_result_of_a_right_hand_side(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    system = ForceDrive(Stribeck()).system()
    x, u = np.array([0.02, 0.3]), np.array([40.0])
    p = parameter_vector(system.parameters, system.parameters)
    rate = compile_rate(system.ode)
    first = rate(0.5, x, u, p)
    assert_array_equal(first, compile_function(system.ode)(0.5, x, u, p)[0])
    rate(0.5, -x, u, p)
    assert_array_equal(first[0], 0.3)  # the caller's own


@pytest.mark.parametrize("cc", [None, ""])
def test_a_rate_under_held_inputs_is_that_of_the_right_hand_side(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    t, u = ca.SX.sym("t"), ca.SX.sym("u")
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    ode = ca.Function("ode", [t, x, u, p], [ca.vertcat(t + u, p * x[0]), x[1]])
    hold = compile_held_rate(ode)
    rate = hold(10.0, np.array([3.0]), np.array([5.0]))
    assert_array_equal(rate(1.0, np.array([2.0, 0.0])), [14.0, 10.0])
    rate = hold(0.0, np.array([4.0]), np.array([6.0]))
    assert_array_equal(rate(1.0, np.array([2.0, 0.0])), [5.0, 12.0])


@pytest.mark.parametrize("cc", [None, ""])
def test_rows_are_the_calls_of_the_function_to_the_bit(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    system = ForceDrive(Stribeck()).system()
    p, rng = parameter_vector(system.parameters, system.parameters), np.random.default_rng(0)
    t, x, u = np.linspace(0.0, 1.0, 7)[:, None], rng.normal(size=(7, 2)), rng.normal(size=(7, 1))
    call, rows = compile_function(system.ode), compile_rows(system.ode)
    single = [call(at, z, v, p) for at, z, v in zip(t, x, u, strict=True)]
    for found, wanted in zip(rows(t, x, u, p), zip(*single, strict=True), strict=True):
        assert_array_equal(found, wanted)
    held = rows(t, x, u[0], p)
    assert_array_equal(held[0], [call(at, z, u[0], p)[0] for at, z in zip(t, x, strict=True)])
    with pytest.raises(ModelError, match=r"argument 1 has shape \(7, 1\), expected rows of 2 numbers"):
        rows(t, u, u, p)


@pytest.mark.parametrize("cc", [None, ""])
def test_a_wrong_size_is_refused_rather_than_padded_with_old_numbers(
    cc: str | None, monkeypatch: pytest.MonkeyPatch, forget: Forget
) -> None:
    if cc is not None:
        monkeypatch.setenv("PNEUOPT_CC", cc)
    with pytest.raises(ModelError, match="argument 2 has 2 numbers, expected 3"):
        compile_function(mixed())(1.0, np.ones((2, 3)), np.ones(2))
