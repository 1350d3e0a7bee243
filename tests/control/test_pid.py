from math import inf

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.pid import PID
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Quantity

MEASURED, COMMAND = Quantity("speed", "m/s"), Quantity("valve_voltage", "V")
GAINS = {"Kp": 2.0, "Ki": 9.0, "Kd": 0.05, "Tf": 0.004, "b": 0.7, "c": 0.4, "Tt": 0.06, "lower": -1.0, "upper": 1.5}


@pytest.mark.parametrize("sample_time", [0.0, -1e-3, inf])
def test_sample_time_must_be_positive(sample_time: float) -> None:
    with pytest.raises(InputError, match="sample_time must be positive"):
        PID(sample_time=sample_time)


def test_without_limits_there_is_nothing_to_saturate() -> None:
    assert tuple(PID(limits=False).parameters("m", "N")) == ("Kp", "Ki", "Kd", "Tf", "b", "c")


def run_sampled(r: np.ndarray, y: np.ndarray, h: float) -> np.ndarray:
    """The law of `PID`'s docstring in plain Python, for comparison."""
    g = GAINS
    integral = derivative = previous = 0.0
    sent = []
    for rk, yk in zip(r, y, strict=True):
        error = g["c"] * rk - yk
        derivative = g["Tf"] / (g["Tf"] + h) * derivative + g["Kd"] / (g["Tf"] + h) * (error - previous)
        previous = error
        integral += g["Ki"] * h * (rk - yk)
        w = g["Kp"] * (g["b"] * rk - yk) + integral + derivative
        u = min(max(w, g["lower"]), g["upper"])
        integral += h / g["Tt"] * (u - w)
        sent.append(u)
    return np.array(sent)


def sampled_function(pid: PID) -> ca.Function:
    x = {q.name: ca.SX.sym(q.name) for q in pid.states(MEASURED, COMMAND)}
    p = {n: ca.SX.sym(n) for n in GAINS}
    r, y, d = ca.SX.sym("r"), ca.SX.sym("y"), ca.SX.sym("d")
    after = pid.update(x, r, y, d, p)
    assert list(after) == list(x)
    return ca.Function(
        "pid", [ca.vertcat(*x.values()), r, y, d, ca.vertcat(*p.values())], [ca.vertcat(*after.values())]
    )


def test_sampled_law_is_the_documented_difference_equation() -> None:
    h, rng = 2e-3, np.random.default_rng(3)
    r, y = np.repeat(rng.normal(size=20), 25), np.cumsum(rng.normal(size=500)) * 0.05
    law = sampled_function(PID(sample_time=h))
    x, sent = np.zeros(6), []
    for rk, yk in zip(r, y, strict=True):
        x = np.array(law(x, rk, yk, 0.0, list(GAINS.values()))).ravel()
        sent.append(x[3])
    expected = run_sampled(r, y, h)
    assert expected.max() == GAINS["upper"]
    assert expected.min() == GAINS["lower"]
    np.testing.assert_allclose(sent, expected, atol=1e-12)


def test_anti_windup_sees_command_plus_dither() -> None:
    pid = PID(sample_time=1e-3)
    law = sampled_function(pid)
    p = list({**GAINS, "Kp": 0.0, "Ki": 1e-9, "Kd": 0.0}.values())
    free = np.array(law([1.0, *[0] * 5], 0.0, 0.0, 0.4, p)).ravel()
    stopped = np.array(law([1.0, *[0] * 5], 0.0, 0.0, 0.8, p)).ravel()
    assert free[[0, 3]] == pytest.approx([1.0, 1.4])
    assert stopped[[0, 3]] == pytest.approx([1.0 - 1e-3 / 0.06 * 0.3, 1.5])


def test_derivatives_agree_with_finite_differences() -> None:
    pid, p = PID(), {n: ca.SX.sym(n) for n in GAINS}
    x = {q.name: ca.SX.sym(q.name) for q in pid.states(MEASURED, COMMAND)}
    r, y, d = ca.SX.sym("r"), ca.SX.sym("y"), ca.SX.sym("d")
    rates, u = pid.rates(x, r, y, d, p)
    z = ca.vertcat(*x.values(), r, y, d, *p.values())
    f = ca.Function("f", [z], [ca.vertcat(*rates.values(), u)])
    jacobian = ca.Function("J", [z], [ca.jacobian(f(z), z)])
    for level in (0.2, 5.0):
        point = np.array([0.1, 0.02, level, 0.05, 0.03, *GAINS.values()])
        step = 1e-6
        columns = [(np.array(f(point + e)) - np.array(f(point - e))).ravel() / 2e-6 for e in step * np.eye(len(point))]
        np.testing.assert_allclose(np.array(jacobian(point)), np.column_stack(columns), rtol=1e-5, atol=1e-6)
