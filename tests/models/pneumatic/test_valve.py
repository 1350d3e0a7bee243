from math import pi

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.models.pneumatic.gas import IsentropicNozzle
from pneuopt.models.pneumatic.valve import Port, ProportionalValve, Spool, opening
from pneuopt.quantities.units import ANR_DENSITY

VALVE = ProportionalValve()
NUMBERS = {n: q.value for n, q in VALVE.parameters.items()}
position = st.floats(-1.0, 1.0)


def symbols(valve: ProportionalValve, **given_: float) -> dict[str, ca.SX]:
    return {n: ca.SX(given_.get(n, q.value)) for n, q in valve.parameters.items()}


def flows(
    x: float, a: float, b: float, temperatures: tuple[float, float] = (293.15, 293.15), **given_: float
) -> list[float]:
    inside = [Port(ca.SX(p), ca.SX(t)) for p, t in zip((a, b), temperatures, strict=True)]
    supply, exhaust = (Port(ca.SX(p), ca.SX(293.15)) for p in (7e5, 1e5))
    return [float(w) for w in VALVE.flows(ca.SX(x), supply, exhaust, inside[0], inside[1], symbols(VALVE, **given_))]


def test_which_way_positive_voltage_drives() -> None:
    forwards = flows(0.5, 3e5, 3e5, rounding=1e-6)
    assert forwards[0] > 0
    assert forwards[3] > 0
    assert max(forwards[1:3]) < 1e-9
    assert forwards[0] == pytest.approx(0.5 * 2e-8 * ANR_DENSITY * 7e5, rel=0.02)


@given(position, st.floats(1.5e5, 6.5e5), st.floats(1.5e5, 6.5e5))
def test_both_sides_are_alike(x: float, a: float, b: float) -> None:
    there, back = flows(x, a, b, leak=0.01), flows(-x, b, a, leak=0.01)
    assert there == pytest.approx([back[2], back[3], back[0], back[1]], rel=1e-12)


@given(st.floats(-1.2, 1.2), st.floats(-0.3, 0.3), st.floats(1e-6, 0.3))
def test_edges_open_monotonically_and_never_close_below_nothing(x: float, overlap: float, rounding: float) -> None:
    p = {"dead_zone": ca.SX(overlap), "rounding": ca.SX(rounding), "leak": ca.SX(0.002)}
    here, further = (float(opening(ca.SX(y), p)) for y in (x, x + 0.01))
    assert 0.002 <= here <= further
    assert here - 0.002 >= max(0.0, x - overlap) - 1e-12
    assert float(opening(ca.SX(overlap), p)) == pytest.approx(rounding / 2 + 0.002)


def test_inside_an_underlap_both_lands_act() -> None:
    """The flow gain doubles there; with zero lap and rounding it stays the same (slopes of a half and a half)."""

    def gain(x: float, **p: float) -> float:
        base = {n: ca.SX(v) for n, v in ({"dead_zone": 0.0, "rounding": 1e-4, "leak": 0.0} | p).items()}
        x_ = ca.SX.sym("x")
        slope = ca.jacobian(opening(x_, base) - opening(-x_, base), x_)
        return float(ca.Function("gain", [x_], [slope])(x))

    assert gain(0.0, dead_zone=-0.05) == pytest.approx(2.0, rel=1e-3)
    assert gain(0.2, dead_zone=-0.05) == pytest.approx(1.0, rel=1e-3)
    assert gain(0.0, dead_zone=0.05) == pytest.approx(0.0, abs=1e-3)
    assert [gain(x, rounding=0.08) for x in (0.0, 0.03, 0.5)] == pytest.approx([1.0, 1.0, 1.0])


def test_warm_air_is_thinner_and_the_upstream_side_counts() -> None:
    hot = flows(0.5, 3e5, 3e5, (350.0, 350.0))
    cold = flows(0.5, 3e5, 3e5)
    assert hot[0] == pytest.approx(cold[0], rel=1e-6)  # from the supply
    assert hot[3] == pytest.approx(cold[3] * (293.15 / 350.0) ** 0.5, rel=1e-6)  # from the chamber


def step(spool: Spool, t: float, voltage: float) -> float:
    valve = ProportionalValve(spool=spool)
    x = [ca.SX.sym(q.name) for q in valve.states]
    rates = valve.rates(ca.SX(voltage), {q.name: v for q, v in zip(valve.states, x, strict=True)}, symbols(valve))
    system = {"x": ca.vertcat(*x), "ode": ca.vertcat(*rates.values())}
    end = ca.integrator("I", "cvodes", system, 0.0, t, {"reltol": 1e-10, "abstol": 1e-12})(x0=np.zeros(len(x)))
    return float(end["xf"][0])


def test_the_spool_lags_as_declared() -> None:
    w = 2 * pi * 80.0
    assert step(Spool.FIRST_ORDER, 0.002, 2.5) == pytest.approx(0.5 * (1 - np.exp(-w * 0.002)), rel=1e-6)
    z, t = 0.7, 0.003
    damped = w * np.sqrt(1 - z**2)
    swing = np.exp(-z * w * t) * (np.cos(damped * t) + z * w / damped * np.sin(damped * t))
    assert step(Spool.SECOND_ORDER, t, 2.5) == pytest.approx(0.5 * (1 - swing), rel=1e-6)
    assert step(Spool.FIRST_ORDER, 1.0, 9.0) == pytest.approx(1.0, rel=1e-6)  # the spool stops at its full travel
    rigid = ProportionalValve(spool=Spool.RIGID)
    assert [float(rigid.position(ca.SX(u), {}, symbols(rigid))) for u in (-7.0, 2.0)] == [-1.0, 0.4]


def test_only_what_acts_is_a_parameter() -> None:
    assert "bandwidth" not in ProportionalValve(spool=Spool.RIGID).parameters
    assert "damping" not in ProportionalValve(spool=Spool.FIRST_ORDER).parameters
    assert {"bandwidth", "damping"} <= set(VALVE.parameters)
    assert "critical_ratio" not in ProportionalValve(IsentropicNozzle()).parameters
