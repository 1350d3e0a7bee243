"""Friction of a gear: what its docstring promises of the load's share."""

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.models.friction import (
    Asymmetric,
    Coulomb,
    FrictionModel,
    LoadDependent,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
    stribeck_curve,
)
from pneuopt.quantities.arrays import Array

STATIC: dict[str, FrictionModel] = {"viscous": Viscous(), "coulomb": Coulomb(), "stribeck": Stribeck()}
MODELS: dict[str, FrictionModel] = {
    **STATIC,
    "lugre": LuGre(),
    "asymmetric coulomb": Asymmetric(Coulomb()),
    "asymmetric lugre": Asymmetric(LuGre()),
    "asymmetric viscous": Asymmetric(Viscous()),
    "pressure": PressureDependent(Stribeck()),
    "pressure, one chamber": PressureDependent(LuGre(), ("pressure_a",)),
    "asymmetric pressure": PressureDependent(Asymmetric(Stribeck())),
}


def function(model: FrictionModel) -> ca.Function:
    """(v, z, u, p) -> (force, rates), all vectors in the model's order."""
    v = ca.SX.sym("v")
    z, u, p = (
        {n: ca.SX.sym(n) for n in group}
        for group in ([q.name for q in model.states], [q.name for q in model.inputs], model.parameters)
    )
    force = model.force(v, z, u, p)
    stacked = [ca.vertcat(*group.values()) for group in (z, u, p)]
    return ca.Function("friction", [v, *stacked], [force.value, ca.vertcat(*(force.rates[n] for n in z))])


def force(
    model: FrictionModel, v: float, values: Mapping[str, float] | None = None, u: Mapping[str, float] | None = None
) -> float:
    """The force of a map without states [N]."""
    p = [(values or {}).get(n, q.value) for n, q in model.parameters.items()]
    pressures = [(u or {}).get(q.name, 0.0) for q in model.inputs]
    return float(function(model)(v, [], pressures, p)[0])


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_are_the_central_differences(name: str) -> None:
    model, rng = MODELS[name], np.random.default_rng(0)
    f = function(model)
    sizes = [f.size1_in(i) for i in range(4)]
    inputs = [ca.SX.sym(f"i{i}", n) for i, n in enumerate(sizes)]
    jacobian = ca.Function("J", inputs, [ca.jacobian(ca.vertcat(*f(*inputs)), ca.vertcat(*inputs))])
    p = np.array([q.value for q in model.parameters.values()])
    for v in (0.0, 3e-4, -1.5e-3, 0.02, -0.4):
        point = np.concatenate([[v], 2e-4 * rng.standard_normal(sizes[1]), 3e5 * rng.random(sizes[2]), p])
        scale = np.concatenate([[1e-3], np.full(sizes[1], 1e-4), np.full(sizes[2], 1e5), np.maximum(np.abs(p), 1e-3)])

        def values(w: Array) -> Array:
            return np.concatenate([np.array(o).ravel() for o in f(*np.split(w, np.cumsum(sizes)[:-1]))])

        exact = np.array(jacobian(*np.split(point, np.cumsum(sizes)[:-1])))
        assert np.isfinite(exact).all()
        for column, step in enumerate(1e-5 * scale):
            shift = step * (np.arange(len(point)) == column)
            difference = (values(point + shift) - values(point - shift)) / (2 * step)
            # |v| in LuGre turns within 1e-6 m/s: differences over 1e-8 see its curvature
            assert exact[:, column] == pytest.approx(
                difference, rel=1e-4, abs=1e-5 * np.abs(exact[:, column]).max() + 1e-9
            )


speeds = st.floats(-2.0, 2.0)
levels = st.fixed_dictionaries(
    {
        "coulomb": st.floats(0.0, 200.0),
        "static": st.floats(0.0, 300.0),
        "stribeck_velocity": st.floats(1e-3, 0.5),
        "viscous": st.floats(0.0, 500.0),
        "smoothing": st.floats(1e-5, 0.01),
    }
)


@pytest.mark.parametrize("name", STATIC)
@given(v=speeds, values=levels)
def test_static_maps_are_odd_and_never_push(name: str, v: float, values: dict[str, float]) -> None:
    forward = force(STATIC[name], v, values)
    assert force(STATIC[name], -v, values) == -forward
    assert forward * v >= 0


@given(v=speeds, values=levels, a=st.floats(-0.95, 0.95), b=st.floats(-0.95, 0.95))
def test_an_asymmetric_map_never_pushes_either(v: float, values: dict[str, float], a: float, b: float) -> None:
    own = {**values, "coulomb_asymmetry": a, "viscous_asymmetry": b}
    assert force(Asymmetric(Stribeck()), v, own) * v >= 0


@given(values=levels)
def test_the_stribeck_curve_runs_from_static_to_coulomb(values: dict[str, float]) -> None:
    c, s, width = (values[n] for n in ("coulomb", "static", "stribeck_velocity"))
    assert curve(0.0, c, s, width) == pytest.approx(s)
    assert curve(10 * width, c, s, width) == pytest.approx(c, abs=1e-9)
    middle = curve(width, c, s, width)
    assert min(c, s) - 1e-9 <= middle <= max(c, s) + 1e-9


def test_coulomb_and_viscous_add_up_in_sliding() -> None:
    assert force(Coulomb(), 0.5, {"coulomb": 40.0, "viscous": 80.0}) == pytest.approx(80.0)
    assert force(Viscous(), -0.5, {"viscous": 80.0}) == -40.0
    assert force(Coulomb(), 1e-3 * math.atanh(0.5), {"coulomb": 40.0, "viscous": 0.0}) == pytest.approx(20.0)


def curve(v: float, coulomb: float, static: float, width: float) -> float:
    return float(ca.evalf(stribeck_curve(*map(ca.SX, (v, coulomb, static, width)))))


def steady(v: float, values: Mapping[str, float]) -> tuple[float, float]:
    """LuGre's force at constant speed, with the bristles at rest; and their deflection."""
    f, p = function(LuGre()), [values.get(n, q.value) for n, q in LuGre().parameters.items()]
    rate0, rate1 = (float(f(v, [z], [], p)[1]) for z in (0.0, 1e-4))  # linear in z
    z = -rate0 / (rate1 - rate0) * 1e-4
    return float(f(v, [z], [], p)[0]), z


@given(v=st.floats(1e-3, 1.0), values=levels, sign=st.sampled_from([-1, 1]))
def test_lugre_slides_on_the_stribeck_curve(v: float, values: dict[str, float], sign: int) -> None:
    values = {**values, "coulomb": values["coulomb"] + 1, "static": values["static"] + 1}
    g = curve(v, values["coulomb"], values["static"], values["stribeck_velocity"])
    found, z = steady(sign * v, values)
    assert found == pytest.approx(sign * (g + values["viscous"] * v), rel=1e-5)
    assert abs(z) == pytest.approx(g / LuGre().parameters.value("bristle_stiffness"), rel=1e-5)


@given(v=speeds, fill=st.floats(-1.0, 1.0), values=levels, d=st.floats(1.0, 1e4), width=st.floats(1e-3, 0.05))
def test_lugre_stores_no_more_than_it_is_given(
    v: float, fill: float, values: dict[str, float], d: float, width: float
) -> None:
    """F v >= d/dt (sigma_0 z^2 / 2) where the damping fades: the part that could break it is sigma_1 z' v."""
    values = {**values, "coulomb": values["coulomb"] + 1, "bristle_damping": 1.0, "damping_velocity": width}
    values["static"] = max(values["static"], values["coulomb"])
    p = [values.get(n, q.value) for n, q in LuGre().parameters.items()]
    stiffness = LuGre().parameters.value("bristle_stiffness")
    z = fill * values["coulomb"] / stiffness
    value, rate = (float(o) for o in function(LuGre())(v, [z], [], p))
    damping_power = math.exp(-((v / width) ** 2)) * rate * v  # of 1 N s/m
    assert value * v - damping_power >= stiffness * z * rate - 1e-9 * abs(value)


def test_directions_have_levels_of_their_own() -> None:
    values = {"coulomb": 40.0, "coulomb_asymmetry": 0.2, "viscous": 100.0, "viscous_asymmetry": -0.1}
    assert force(Asymmetric(Coulomb()), 0.5, values) == pytest.approx(40 * 1.2 + 100 * 0.9 * 0.5)
    assert force(Asymmetric(Coulomb()), -0.5, values) == pytest.approx(-(40 * 0.8 + 100 * 1.1 * 0.5))
    static = {**values, "static": 60.0, "stribeck_velocity": 1.0, "viscous": 0.0}
    g = 1.2 * curve(0.5, 40.0, 60.0, 1.0)
    assert force(Asymmetric(Stribeck()), 0.5, static) == pytest.approx(g)


def test_without_asymmetry_nothing_changes() -> None:
    for v in (-0.3, 1e-4, 0.05):
        assert force(Asymmetric(Stribeck()), v) == force(Stribeck(), v)
        assert force(PressureDependent(Stribeck()), v, u={"pressure_a": 6e5}) == force(Stribeck(), v)


def test_levels_rise_with_pressure() -> None:
    values = {"coulomb": 4.0, "viscous": 0.0, "coulomb_pressure_a": 2e-5, "coulomb_pressure_b": 1e-5}
    u = {"pressure_a": 3e5, "pressure_b": 1e5}
    assert force(PressureDependent(Coulomb()), 0.5, values, u) == pytest.approx(4 + 6 + 1)
    assert force(PressureDependent(Coulomb()), -0.5, values, u) == pytest.approx(-11)
    both = {**values, "static": 9.0, "stribeck_velocity": 1e3}
    assert force(PressureDependent(Stribeck()), 0.5, both, u) == pytest.approx(9 + 7, rel=1e-5)


def test_pressure_and_direction_multiply() -> None:
    values = {"coulomb": 4.0, "viscous": 0.0, "coulomb_pressure_a": 2e-5, "coulomb_asymmetry": 0.5}
    model = PressureDependent(Asymmetric(Coulomb()))
    assert force(model, 0.5, values, {"pressure_a": 3e5}) == pytest.approx((4 + 6) * 1.5)


@pytest.mark.parametrize("name", MODELS)
def test_every_default_has_a_unit_and_lies_in_its_bounds(name: str) -> None:
    for parameter in MODELS[name].parameters.values():
        assert parameter.unit
        assert parameter.lower <= parameter.value <= parameter.upper
    assert not MODELS[name].parameters.free_names


LAW = LoadDependent(Coulomb())
VALUES = {"coulomb": 30.0, "viscous": 0.0, "smoothing": 1e-3, "coulomb_load": 0.1, "load_rounding": 1.0}


def load_dependent_force(load: float) -> float:
    """The friction force at 1 m/s, where the sign's smoothing has ended."""
    p = {n: ca.SX(v) for n, v in VALUES.items()}
    return float(ca.evalf(LAW.force(ca.SX(1.0), {}, {"force": ca.SX(load)}, p).value))


def test_without_load_it_is_the_base_model() -> None:
    assert load_dependent_force(0.0) == pytest.approx(30.0, rel=1e-12)


@given(load=st.floats(-1e4, 1e4))
def test_the_rise_is_the_coefficient_times_the_load_less_at_most_the_rounding(load: float) -> None:
    rise = load_dependent_force(load) - 30.0
    assert rise <= 0.1 * abs(load) + 1e-9
    assert rise >= 0.1 * (abs(load) - VALUES["load_rounding"]) - 1e-9
