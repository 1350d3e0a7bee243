from math import sqrt

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.models.pneumatic.gas import (
    CRITICAL_RATIO,
    GAS_CONSTANT,
    REFERENCE_TEMPERATURE,
    FlowLaw,
    IsentropicNozzle,
    Iso6358,
    Smoothing,
    conductance_of_area,
    conductance_of_nominal_flow,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.units import ANR_DENSITY

LAWS: dict[str, FlowLaw] = {"iso": Iso6358(), "iso 0.6": Iso6358(0.6), "nozzle": IsentropicNozzle()}
RATIOS = np.concatenate([np.linspace(0.02, 0.999, 4000), 1 - np.geomspace(1e-3, 1e-9, 400)])
pressure = st.floats(0.0, 1.2e6)
# from 300 times the 100 Pa that round the higher pressure p: a choked flow rises by (100 Pa / p)^2 / 2 with it, 6e-6
above_rounding = st.floats(3e4, 1.2e6)


def function(law: FlowLaw, smoothing: Smoothing | None = None) -> ca.Function:
    """(p1, p2, b) -> flow, its gradient, its Hessian."""
    x = ca.SX.sym("x", 3)
    flow = law.flow(x[0], x[1], {"critical_ratio": x[2]}, smoothing or Smoothing())
    return ca.Function("flow", [x], [flow, ca.gradient(flow, x), ca.hessian(flow, x)[0]])


FLOWS = {name: function(law) for name, law in LAWS.items()}


def kernel(smoothing: Smoothing, b: float = 0.3, law: FlowLaw | None = None) -> Array:
    """Flow at RATIOS over the choked one."""
    flow = function(law or Iso6358(), smoothing)
    points = np.vstack([np.full(len(RATIOS), 7e5), 7e5 * RATIOS, np.full(len(RATIOS), b)])
    return np.array(flow.map(len(RATIOS))(points)[0]).ravel() / 7e5


def ellipse(r: Array, b: float) -> Array:
    return np.asarray(np.sqrt(1 - (np.maximum(r - b, 0) / (1 - b)) ** 2))


def psi(r: Array) -> Array:
    """Of eq. (1) and (2), over its largest value."""
    r = np.maximum(r, CRITICAL_RATIO)
    top = CRITICAL_RATIO ** (2 / 1.4) - CRITICAL_RATIO ** (2.4 / 1.4)
    return np.asarray(np.sqrt((r ** (2 / 1.4) - r ** (2.4 / 1.4)) / top))


def test_golden_constants() -> None:
    assert pytest.approx(0.5282818, abs=1e-7) == CRITICAL_RATIO
    assert sqrt(1.4) * (2 / 2.4) ** 3 == pytest.approx(0.6847315, abs=1e-7)
    choked = conductance_of_area(1.0) * ANR_DENSITY * sqrt(REFERENCE_TEMPERATURE)  # kg/s per m^2 Pa/sqrt(K)
    assert choked == pytest.approx(0.0404149, abs=1e-7)
    assert choked == pytest.approx(0.6847315 / sqrt(GAS_CONSTANT), rel=1e-7)


def test_catalogue_flows() -> None:
    for flow, conductance in ((350, 1.38e-8), (700, 2.75e-8), (1400, 5.5e-8)):
        assert conductance_of_nominal_flow(flow / 60e3) == pytest.approx(conductance, rel=5e-3)
    assert 1 / (conductance_of_nominal_flow(1 / 60e3) * 60e3 * 1e5) == pytest.approx(4.242, abs=0.01)


@pytest.mark.parametrize(
    ("zero", "worst", "below"), [(1e-2, 0.036, 0.016), (1e-3, 0.0114, 2.3e-4), (1e-4, 0.0036, 1e-4)]
)
def test_the_smoothing_costs_what_it_is_said_to(zero: float, worst: float, below: float) -> None:
    error = np.abs(kernel(Smoothing(zero=zero)) - ellipse(RATIOS, 0.3))
    assert worst * 0.9 < error.max() <= worst * 1.02
    assert error[RATIOS < 0.99].max() <= below * 1.02
    assert error[RATIOS < 0.28].max() <= (6e-5 if zero > 1e-3 else 5e-5)
    assert np.abs(kernel(Smoothing(corner=0.1)) - ellipse(RATIOS, 0.3))[RATIOS < 0.3].max() <= 1.3e-3


def test_the_nozzle_is_equations_1_and_2_and_nearly_the_ellipse() -> None:
    fine = Smoothing(1e-6, 1e-8, 1e-3)
    nozzle = kernel(fine, law=IsentropicNozzle())
    steady = RATIOS < 1 - 1e-6
    assert nozzle[steady] == pytest.approx(psi(RATIOS)[steady], abs=1e-6)
    difference = np.abs(nozzle - kernel(fine, b=CRITICAL_RATIO))
    assert difference.max() == pytest.approx(0.0015, abs=2e-4)
    assert (difference[1:] / nozzle[1:]).max() == pytest.approx(0.003, abs=2e-4)


def test_the_subsonic_index() -> None:
    fine, r = Smoothing(1e-6, 1e-8, 1e-3), RATIOS[RATIOS < 0.999]
    expected = (1 - (np.maximum(r - 0.3, 0) / 0.7) ** 2) ** 0.6
    assert kernel(fine, law=Iso6358(0.6))[: len(r)] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", LAWS)
@given(pressure, pressure, st.floats(0.05, 0.6))
def test_no_nan_anywhere(name: str, p1: float, p2: float, b: float) -> None:
    for point in ([p1, p2, b], [p1, p1, b], [p1, 0.0, b], [0.0, 0.0, b]):
        for value in FLOWS[name](point):
            assert np.all(np.isfinite(np.array(value)))


@pytest.mark.parametrize("name", LAWS)
@given(above_rounding, above_rounding, above_rounding, st.floats(0.05, 0.6))
def test_flow_is_odd_rises_upstream_and_falls_downstream(name: str, p1: float, p2: float, p3: float, b: float) -> None:
    flow = FLOWS[name]
    assert float(flow([p1, p2, b])[0]) == pytest.approx(-float(flow([p2, p1, b])[0]), abs=1e-9)
    assert float(flow([p1, p1, b])[0]) == 0.0
    low, high = sorted((p2, p3))
    slack = 1e-5 * max(p1, high, 1.0)
    assert float(flow([high, p1, b])[0]) >= float(flow([low, p1, b])[0]) - slack
    assert float(flow([p1, high, b])[0]) <= float(flow([p1, low, b])[0]) + slack


def test_choked_flow_is_proportional_to_the_upstream_pressure_alone() -> None:
    flow = FLOWS["iso"]
    for p1 in (2e5, 4e5, 8e5):
        for r in (0.02, 0.1, 0.25):
            assert float(flow([p1, r * p1, 0.3])[0]) == pytest.approx(p1, rel=6e-5)


@pytest.mark.parametrize("name", LAWS)
@given(st.floats(1e4, 1e6), st.floats(1e4, 1e6), st.floats(0.1, 0.6))
def test_gradients_are_the_differences(name: str, p1: float, p2: float, b: float) -> None:
    flow, point = FLOWS[name], np.array([p1, p2, b])
    exact = np.array(flow(point)[1]).ravel()
    for k, step in enumerate((0.03, 0.03, 1e-6)):
        shift = step * np.eye(3)[k]
        difference = (float(flow(point + shift)[0]) - float(flow(point - shift)[0])) / (2 * step)
        assert exact[k] == pytest.approx(difference, rel=1e-4, abs=1e-7 * (1.0 if k < 2 else 1e6))


@pytest.mark.parametrize(("zero", "rate"), [(1e-2, 3.9e3), (1e-3, 1.2e4)])
def test_stiffness_at_zero_flow(zero: float, rate: float) -> None:
    slope = float(function(Iso6358(), Smoothing(zero=zero, pressure=1e-3))([5e5, 5e5, 0.3])[1][0])
    found = 1.4 * GAS_CONSTANT * 293.15 * 2.75e-8 * ANR_DENSITY * slope / 20e-6
    assert found == pytest.approx(rate, rel=0.03)
