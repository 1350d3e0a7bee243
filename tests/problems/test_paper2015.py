from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq

import pneuopt as po
from pneuopt.quantities.errors import InputError
from problems.shared.paper2015 import (
    KAPPA,
    OperatingPoint,
    R,
    constant_term,
    leak_rate,
    natural_frequency,
    operating_point,
    paper_plant,
    second_order,
    state_space,
    third_order,
)

K_D, K_S = 2e-4, 20.0
factor = st.floats(0.3, 3.0)


@st.composite
def points(draw: st.DrawFn) -> OperatingPoint:
    base = OperatingPoint()
    names = ("K_ma", "K_mb", "K_ca", "K_cb", "A_a", "n", "m", "p_ai", "V_0a", "T_s", "M_L", "k_v")
    return replace(base, **{name: getattr(base, name) * draw(factor) for name in names})


def response(point: OperatingPoint, s: complex) -> complex:
    """Speed over spool travel from equations (3), (4), (9), (10), (11) as they stand, for v, p_a, p_b, M_a, M_b."""
    q, RT = point, R * point.T_s
    p_bi, A_b, V_0b = q.p_ai / q.n, q.n * q.A_a, q.m * q.V_0a
    equations = np.array(
        [
            [0, q.K_ca, 0, 1, 0],  # (3)
            [0, 0, -q.K_cb, 0, 1],  # (4)
            [-KAPPA * q.p_ai * q.A_a / (KAPPA * RT), -q.V_0a * s / (KAPPA * RT), 0, 1, 0],  # (9)
            [-KAPPA * p_bi * A_b / (KAPPA * RT), 0, V_0b * s / (KAPPA * RT), 0, 1],  # (10)
            [-(q.M_L * s + q.k_v), q.A_a, -A_b, 0, 0],  # (11)
        ],
        dtype=complex,
    )
    scale = np.array([1.0, 1e5, 1e5, 1.0, 1.0])
    return complex(np.linalg.solve(equations * scale, np.array([q.K_ma, q.K_mb, 0, 0, 0], dtype=complex))[0])


def value(polynomials: tuple[NDArray[np.float64], NDArray[np.float64]], s: complex) -> complex:
    numerator, denominator = polynomials
    return complex(np.polyval(numerator, s) / np.polyval(denominator, s))


@given(points(), st.floats(0.1, 100.0))
def test_the_chain_gives_third_order(point: OperatingPoint, w: float) -> None:
    s = complex(0.3, w)
    A, B, C = state_space(point)
    exact = response(point, s)
    assert value(third_order(point), s) == pytest.approx(exact, rel=1e-9)
    assert (C @ np.linalg.solve(s * np.eye(3) - A, B)).item() == pytest.approx(exact, rel=1e-9)


@given(points(), st.floats(0.1, 100.0))
def test_it_collapses_where_the_coefficients_match_the_volumes(point: OperatingPoint, w: float) -> None:
    matched = replace(point, K_cb=point.m * point.K_ca)
    s = 1j * w
    assert value(second_order(matched), s) == pytest.approx(response(matched, s), rel=1e-9)
    A, _, _ = state_space(matched)
    assert np.min(np.abs(np.linalg.eigvals(A) + leak_rate(matched))) < 1e-6 * np.max(np.abs(A[0, 0]))


def test_no_pressure_b_is_no_legal_assumption() -> None:
    single_rod = OperatingPoint(n=0.86, K_cb=1.3 * OperatingPoint().K_ca)
    s = 2j
    assert abs(value(second_order(single_rod), s) / response(single_rod, s) - 1) > 0.01


def test_golden_r25() -> None:
    numerator, denominator = second_order(OperatingPoint())
    assert numerator * K_D * K_S == pytest.approx([1270.12], rel=1e-9)
    assert denominator == pytest.approx([1.0, 17.5, 86.34], rel=1e-9)
    assert leak_rate(OperatingPoint()) == pytest.approx(0.83333, abs=1e-5)


def test_the_dropped_constant() -> None:
    point = OperatingPoint()
    assert natural_frequency(point) ** 2 == pytest.approx(72.45, abs=0.01)
    assert constant_term(point) / natural_frequency(point) ** 2 == pytest.approx(1.19, abs=0.005)
    printed, true = second_order(point, dropped_constant=True), second_order(point)
    assert value(printed, 0) / value(true, 0) == pytest.approx(1.19, abs=0.005)
    assert value(true, 0) == pytest.approx(response(point, 1e-9), rel=1e-6)


def test_golden_r25_from_the_valve_without_smoothing() -> None:
    """Equations (1) and (2) at the null, differentiated by hand: 17.50012, 86.3445, 1270.166."""
    p_s, p_o, T, C_d, W, delta = 6.0e5, 1.01325e5, 293.15, 0.7, 1.5472759716e-2, 8.1499939196e-5
    critical = (2 / (KAPPA + 1)) ** (KAPPA / (KAPPA - 1))

    def flow(high: float, low: float) -> float:
        r = max(low / high, critical)
        psi = sqrt(2 * KAPPA / (R * (KAPPA - 1))) * sqrt(r ** (2 / KAPPA) - r ** ((KAPPA + 1) / KAPPA))
        return C_d * W * high / sqrt(T) * psi

    def mass(x: float, p: float) -> float:
        opening = 0.5 * (x + sqrt(x**2 + delta**2))
        return opening * flow(p_s, p) - (opening - x) * flow(p, p_o)

    p_i = float(brentq(lambda p: mass(0.0, p), 2e5, 5.9e5, xtol=1e-3))
    K_m = (mass(1e-7, p_i) - mass(-1e-7, p_i)) / 2e-7
    K_c = -(mass(0.0, p_i + 10.0) - mass(0.0, p_i - 10.0)) / 20.0
    numerator, denominator = second_order(OperatingPoint(K_m, K_m, K_c, K_c, p_ai=p_i))
    assert numerator[0] * K_D * K_S == pytest.approx(1270.166, abs=2e-3)
    assert denominator == pytest.approx([1.0, 17.50012, 86.3445], abs=1e-4)


def test_equation_16_as_printed() -> None:
    system, parameters = paper_plant(loop_gain=0.5)
    linear = system.linearise(np.zeros(2), {}, parameters)
    assert np.poly(linear.A) == pytest.approx([1.0, 17.5, 86.34])
    assert (linear.C @ linear.A @ linear.B).item() == pytest.approx(635.06)
    assert (system.inputs[0].unit, system.outputs[0].unit) == ("V", "V")


def test_the_symbols_read_off_the_nonlinear_drive() -> None:
    found, record = operating_point(*po.catalog.r25(), half_travel=1e-3), OperatingPoint()
    for name in ("K_ma", "K_mb", "K_ca", "K_cb", "A_a", "n", "m", "p_ai", "V_0a", "T_s", "M_L", "k_v"):
        assert getattr(found, name) == pytest.approx(getattr(record, name), rel=2e-9), name
    drive, p = po.catalog.r25()
    off = operating_point(drive, p.with_values({"cylinder.start": 0.3}), half_travel=1e-3)
    assert off.m == pytest.approx((1.3051087903e-4 + 0.7 * record.A_a) / (1.3051087903e-4 + 0.3 * record.A_a))
    assert off.K_ma == pytest.approx(record.K_ma, rel=1e-9)  # the valve knows no volume


def test_another_drive_has_no_such_symbols() -> None:
    with pytest.raises(InputError, match="rodless, with Viscous"):
        operating_point(*po.catalog.s32(), half_travel=1e-3)
    with pytest.raises(InputError, match="rodless, with Viscous"):
        operating_point(*po.catalog.r25(lugre=True), half_travel=1e-3)
