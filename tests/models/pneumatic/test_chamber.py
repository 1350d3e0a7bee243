import casadi as ca
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.models.pneumatic.chamber import ChamberModel, Inflow, Polytropic, Surroundings, Thermal, convection

R, T, V = 287.05, 293.15, 2e-4
flow = st.floats(-0.01, 0.01)


def rates(
    model: ChamberModel, z: dict[str, float], flows: list[tuple[float, float]], swept: float = 0.0, **given_: float
) -> dict[str, float]:
    p = {n: ca.SX(given_.get(n, q.value)) for n, q in model.parameters.items()}
    around = Surroundings(*(ca.SX(v) for v in (V, swept, T, R)))
    inflows = [Inflow(ca.SX(w), ca.SX(t)) for w, t in flows]
    return {n: float(v) for n, v in model.rates({n: ca.SX(v) for n, v in z.items()}, inflows, around, p).items()}


def passing(w: float, inward: float, outward: float) -> float:
    return float(convection(ca.SX(w), ca.SX(inward), ca.SX(outward)))


@given(flow, flow, st.floats(-1e-3, 1e-3), st.floats(1e5, 8e5))
def test_isothermal_chambers_keep_the_mass(w1: float, w2: float, swept: float, p: float) -> None:
    rate = rates(Polytropic(), {"pressure": p}, [(w1, T), (w2, T)], swept, exponent=1.0)["pressure"]
    assert (rate * V + p * swept) / (R * T) == pytest.approx(w1 + w2, abs=1e-12)


@given(flow, flow, st.floats(-1e-3, 1e-3), st.floats(1e5, 8e5), st.floats(250.0, 350.0))
def test_thermal_chambers_keep_mass_and_energy(w1: float, w2: float, swept: float, p: float, t: float) -> None:
    found = rates(Thermal(), {"pressure": p, "temperature": t}, [(w1, T), (w2, 310.0)], swept, wall_conductance=0.7)
    mass = p * V / (R * t)
    assert mass * (found["pressure"] / p + swept / V - found["temperature"] / t) == pytest.approx(w1 + w2, abs=1e-10)
    enthalpy = 1.4 * R / 0.4 * sum(passing(w, source, t) for w, source in ((w1, T), (w2, 310.0)))
    inner = (found["pressure"] * V + p * swept) / 0.4
    assert inner == pytest.approx(enthalpy + 0.7 * (T - t) - p * swept, abs=1e-6)


def test_exponents() -> None:
    mixed = Polytropic(mixed=True)
    base = R * T / V
    assert rates(mixed, {"pressure": 3e5}, [(0.005, T)])["pressure"] == pytest.approx(1.4 * base * 0.005, rel=1e-5)
    assert rates(mixed, {"pressure": 3e5}, [(-0.005, T)])["pressure"] == pytest.approx(-1.0 * base * 0.005, rel=1e-5)
    swept = rates(mixed, {"pressure": 3e5}, [], 1e-4)["pressure"]
    assert swept == pytest.approx(-1.2 * 3e5 * 1e-4 / V)
    assert set(Polytropic().parameters) == {"exponent"}


def test_a_null_that_leaks_rests_where_as_much_air_enters_as_leaves() -> None:
    for model in (Polytropic(), Polytropic(mixed=True)):
        assert rates(model, {"pressure": 3e5}, [(0.004, T), (-0.004, T)])["pressure"] == 0.0


def test_between_isothermal_and_adiabatic() -> None:
    """Compressed without flow, an isolated chamber follows the adiabat; a warm one loses heat to the wall."""
    found = rates(Thermal(), {"pressure": 3e5, "temperature": T}, [], -1e-4, wall_conductance=0.0)
    assert found["pressure"] == pytest.approx(1.4 * 3e5 * 1e-4 / V)
    assert found["temperature"] == pytest.approx(0.4 * T * 1e-4 / V)
    warm = rates(Thermal(), {"pressure": 3e5, "temperature": T + 10}, [], wall_conductance=2.0)
    assert warm["pressure"] == pytest.approx(-0.4 / V * 2.0 * 10)


@given(st.floats(1e-9, 1.0))
def test_what_a_flow_carries_turns_with_it_however_small_the_drive(w: float) -> None:
    assert passing(w, 1.4, 1.0) == pytest.approx(1.4 * w, rel=1e-12)
    assert passing(-w, 1.4, 1.0) == pytest.approx(-1.0 * w, rel=1e-12)
    assert passing(0.0, 1.4, 1.0) == 0.0
