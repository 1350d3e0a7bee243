"""Friction of a gear: what its docstring promises of the load's share.

Every registered friction law through the same mill; a new law is a row of the registry, and one of `TRUTH`.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Symbols, names
from pneuopt.files.drive import read_drive
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import (
    FRICTION_LAWS,
    FRICTION_WRAPPERS,
    Asymmetric,
    Coulomb,
    Force,
    FrictionModel,
    LoadDependent,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
    stribeck_curve,
)
from pneuopt.plotting import plot_friction
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import read_value

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
VALUES = {"coulomb": 30.0, "viscous": 0.0, "smoothing": 1e-3, "coulomb_load": 0.1}


def load_dependent_force(load: float) -> float:
    """The friction force at 1 m/s, where the sign's smoothing has ended."""
    p = {n: ca.SX(v) for n, v in VALUES.items()}
    return float(ca.evalf(LAW.force(ca.SX(1.0), {}, {"force": ca.SX(load)}, p).value))


def test_without_load_it_is_the_base_model() -> None:
    assert load_dependent_force(0.0) == pytest.approx(30.0, rel=1e-12)


@given(load=st.floats(-1e4, 1e4))
def test_the_rise_is_the_coefficient_times_the_load_however_small(load: float) -> None:
    assert load_dependent_force(load) - 30.0 == pytest.approx(0.1 * abs(load), rel=1e-12, abs=1e-12)


CURVE = {"coulomb": 30.0, "viscous": 60.0, "static": 42.0, "stribeck_velocity": 0.025}
TRUTH: Mapping[str, Mapping[str, float]] = {
    "viscous": {"viscous": 60.0},
    "coulomb": {"coulomb": 30.0, "viscous": 60.0},
    "presliding": {"coulomb": 30.0, "viscous": 60.0, "presliding_speed": 4e-3},
    "stribeck": CURVE,
    "lugre": {**CURVE, "bristle_stiffness": 6e4},
    "asymmetric": {"coulomb_asymmetry": 0.2, "viscous_asymmetry": -0.1},
    "load_dependent": {"coulomb_load": 0.15},
    "pressure_dependent": {"coulomb_pressure_a": 3e-5, "coulomb_pressure_b": 2e-5},
}
EVEN = {
    "asymmetric": {"coulomb_asymmetry": 0.0, "viscous_asymmetry": 0.0}
}  # values with which a law is odd in the speed
START_TOLERANCE = {"asymmetric": 0.3, "lugre": 0.35}  # the directions start alike; bristles smear the reversals
WEIGHT = 60.0  # [N] known load: without one a friction that grows with the force scales mass and levels alike
SPEEDS = (0.0, 3e-4, -1.5e-3, 0.02, -0.4)


def registered() -> dict[str, FrictionModel]:
    """Every law, and every set of wrappers, nested as a file nests them, around each law that takes them."""
    laws = {name: law() for name, law in FRICTION_LAWS.items()}
    sets = [chosen for n in range(1, len(FRICTION_WRAPPERS) + 1) for chosen in combinations(FRICTION_WRAPPERS, n)]
    for chosen, name in product(sets, FRICTION_LAWS):
        with contextlib.suppress(ModelError):  # a law without the level that the wrapper raises
            law = functools.reduce(lambda inner, how: FRICTION_WRAPPERS[how].wrap(inner), chosen, FRICTION_LAWS[name]())
            laws[" ".join((*chosen, name))] = law
    return laws


LAWS = registered()


def truth(name: str, law: FrictionModel) -> dict[str, float]:
    """Every parameter of a law, the rows of its parts over the defaults."""
    said = {n: v for part in name.split() for n, v in TRUTH[part].items()}
    return {n: said.get(n, p.value) for n, p in law.parameters.items()}


def law_function(law: FrictionModel) -> ca.Function:
    """``(v, z, u, p) -> (force, rates)``, all columns in the law's order."""
    groups = [[q.name for q in law.states], [q.name for q in law.inputs], list(law.parameters)]
    v, (z, u, p) = ca.SX.sym("v"), ({n: ca.SX.sym(n) for n in group} for group in groups)
    force = law.force(v, z, u, p)
    stacked = [ca.vertcat(*group.values()) for group in (z, u, p)]
    return ca.Function("law", [v, *stacked], [force.value, ca.vertcat(*(force.rates[n] for n in z))])


def some_inputs(law: FrictionModel) -> Array:
    """Gauge pressures of some bar, a force that pulls backwards."""
    return np.array([3e5 if q.unit == "Pa(g)" else -70.0 for q in law.inputs])


def steady_force(law: FrictionModel, v: float, u: Array, p: Array) -> float:
    """The force at a constant speed, internal states where they stay; their rates are linear in them."""
    f, n = law_function(law), len(law.states)
    straight = np.array(f(v, np.zeros(n), u, p)[1]).ravel()
    slopes = [np.array(f(v, row, u, p)[1]).ravel() - straight for row in 1e-4 * np.eye(n)]
    z = 1e-4 * np.linalg.solve(np.transpose(slopes), -straight) if n else np.zeros(0)
    return float(f(v, z, u, p)[0])


def written(value: float, parameter: Parameter) -> str:
    """A value as a file has it."""
    return repr(value) if parameter.unit == "1" else f"{value!r} {parameter.unit}"


def check_units(name: str, law: FrictionModel) -> None:
    """Every parameter and signal has a unit that can be read, and a default within its bounds."""
    for n, p in law.parameters.items():
        assert p.unit, f"{name}: {n} has no unit"
        assert read_value(written(1.0, p), p.unit) == 1, f"{name}: the unit of {n} cannot be read"
        assert p.lower <= p.value <= p.upper, f"{name}: the default of {n} lies outside its bounds"
        assert not p.free, f"{name}: {n} is free by default"
    assert all(q.unit for q in (*law.states, *law.inputs)), f"{name}: a signal has no unit"


def check_odd(name: str, law: FrictionModel) -> None:
    """Backwards the force is that of forwards with the other sign; bristles bend the other way."""
    even = {n: v for part in name.split() for n, v in EVEN.get(part, {}).items()}
    p, f, u = np.array([even.get(n, v) for n, v in truth(name, law).items()]), law_function(law), some_inputs(law)
    for v in SPEEDS:
        z = np.full(len(law.states), 2e-4)
        there, back = (np.concatenate([np.array(o).ravel() for o in f(s * v, s * z, u, p)]) for s in (1, -1))
        assert back == pytest.approx(-there, rel=1e-12, abs=1e-12), f"{name}: not odd at v = {v:g} m/s"


def check_passive(name: str, law: FrictionModel) -> None:
    """In steady motion friction takes power: F v >= 0."""
    rng, u = np.random.default_rng(0), some_inputs(law)
    for v in rng.uniform(-2, 2, 20):
        p = np.array([*truth(name, law).values()]) * rng.uniform(0.3, 3.0, len(law.parameters))
        power = steady_force(law, v, u, p) * v
        assert power >= 0, f"{name}: friction pushes with {-power:.3g} W at v = {v:g} m/s"


def check_derivatives(name: str, law: FrictionModel) -> None:
    """Derivatives by speed, states, inputs and parameters are finite, and those of differences, at v = 0, too."""
    f, p, rng = law_function(law), np.array([*truth(name, law).values()]), np.random.default_rng(0)
    sizes = [f.size1_in(i) for i in range(4)]
    symbols = [ca.SX.sym(f"i{i}", n) for i, n in enumerate(sizes)]
    jacobian = ca.Function("J", symbols, [ca.jacobian(ca.vertcat(*f(*symbols)), ca.vertcat(*symbols))])
    labels = ["v", *(q.name for q in (*law.states, *law.inputs)), *law.parameters]

    def split(w: Array) -> list[Array]:
        return np.split(w, np.cumsum(sizes)[:-1])

    def values(w: Array) -> Array:
        return np.concatenate([np.array(o).ravel() for o in f(*split(w))])

    for v in SPEEDS:
        point = np.concatenate([[v], 2e-4 * rng.standard_normal(sizes[1]), some_inputs(law), p])
        scale = np.concatenate([[1e-3], np.full(sizes[1], 1e-4), np.abs(some_inputs(law)), np.maximum(np.abs(p), 1e-3)])
        exact = np.array(jacobian(*split(point)))
        for i, (label, step) in enumerate(zip(labels, 1e-5 * scale, strict=True)):
            shift = step * (np.arange(len(point)) == i)
            difference = (values(point + shift) - values(point - shift)) / (2 * step)
            # |v| in LuGre turns within 1e-6 m/s: differences over 1e-8 see its curvature
            near = pytest.approx(difference, rel=1e-4, abs=1e-5 * np.abs(difference).max() + 1e-9)
            found = f"{exact[:, i]} by {label} at v = {v:g} m/s, differences give {difference}"
            assert np.isfinite(exact[:, i]).all(), f"{name} has no derivative: {found}"
            assert exact[:, i] == near, f"{name} has a wrong derivative: {found}"


@functools.cache
def logged(name: str) -> tuple[ForceDrive, ParameterSet, Trajectory, Trajectory]:
    """A drive with the law, its true parameters, a run of 2 s that slides, sticks and turns, and the run as logged."""
    law = LAWS[name]
    drive, t = ForceDrive(law), np.linspace(0, 2, 1000, endpoint=False)
    system, force = drive.system(), WEIGHT + 60 * np.sin(2 * np.pi * t) + 50 * np.sin(2 * np.pi * 2.3 * t)
    true = system.parameters.with_values({f"friction.{n}": v for n, v in truth(name, law).items()})
    true = true.with_values({"load.mass": 3.0, "load.force": WEIGHT})
    pressures = {"pressure_a": 4e5 + 2e5 * np.sin(3 * t), "pressure_b": 3e5 + 1e5 * np.cos(5 * t)}
    inputs = {"force": force, **pressures}
    run = simulate(system, Trajectory(t, {n: inputs[n] for n in names(system.inputs)}), true, rtol=1e-5)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(len(t))
    shown = {n: inputs[n] for n in names(system.inputs)} | {"position": run["position"] + noise}
    return drive, true, run, Trajectory(t, shown)


def check_start(name: str, law: FrictionModel) -> None:
    """One of the starts from a log comes near every parameter that the law has a column for."""
    drive, true, _, log = logged(name)
    start = drive.friction.start
    free = [f"friction.{n}" for n in start.unknowns if f"friction.{n}" in true and not n.endswith("_asymmetry")]
    starts = drive.system().starts({"run": Log(log, true.freed("load.mass", *free))})
    tolerance = max((START_TOLERANCE.get(part, 0.2) for part in name.split()), default=0.2)
    sought = {n: true.value(n) for n in starts[0].parameters if n in free and n != "friction.bristle_damping"}
    assert sought, f"{name}: no start for any of its parameters"
    errors = [{n: s.parameters[n] / v - 1 for n, v in sought.items()} for s in starts]
    best = min(errors, key=lambda e: max(map(abs, e.values())))
    assert max(map(abs, best.values())) < tolerance, f"{name}: starts are off by {best}"


def check_map(name: str, law: FrictionModel) -> None:
    """The friction map's curve runs through the points that the log implies."""
    drive, true, run, log = logged(name)
    empty = pd.DataFrame(dtype=float)
    result = IdentificationResult(
        true,
        pd.DataFrame({"value": [], "dof": []}, dtype=float),
        empty,
        empty,
        {"run": run},
        Status(Code.CONVERGED),
        {},
        {},
    )
    (axes,) = plot_friction(drive.system(), result, [Experiment(log, name="run")]).axes
    drawn = {str(line.get_label()): np.asarray(line.get_xydata(), dtype=float) for line in axes.lines}
    (cloud,), (curve,) = ([xy for n, xy in drawn.items() if n == label] for label in ("from the logs", "fitted"))
    fast = np.isfinite(cloud[:, 1]) & (np.abs(cloud[:, 0]) > 0.05)
    off = np.median(np.abs(np.interp(cloud[fast, 0], *curve.T) - cloud[fast, 1]))
    assert off < 0.2 * np.median(np.abs(cloud[fast, 1])), f"{name}: the map's curve misses its points by {off:.3g} N"


CHECKS: Mapping[str, Callable[[str, FrictionModel], None]] = {
    "units": check_units,
    "odd": check_odd,
    "passive": check_passive,
    "derivatives": check_derivatives,
}
ONCE = {*FRICTION_LAWS, *(f"{how} coulomb" for how in FRICTION_WRAPPERS)}
RUNS = [name for name in LAWS if name in ONCE]  # each law and each wrapper once: they simulate


def test_every_registered_law_has_a_row_and_is_run() -> None:
    assert set(TRUTH) == {*FRICTION_LAWS, *FRICTION_WRAPPERS} == {part for name in RUNS for part in name.split()}


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", LAWS)
def test_every_law_passes_the_mill(name: str, check: str) -> None:
    CHECKS[check](name, LAWS[name])


@pytest.mark.parametrize("name", RUNS)
def test_every_law_starts_from_a_log(name: str) -> None:
    check_start(name, LAWS[name])


@pytest.mark.parametrize("name", RUNS)
def test_every_law_has_a_friction_map(name: str) -> None:
    check_map(name, LAWS[name])


@pytest.mark.parametrize("name", LAWS)
def test_every_law_is_read_from_a_file(name: str, tmp_path: Path) -> None:
    *wrappers, law = name.split()
    values = {n: v for n, v in truth(name, LAWS[name]).items() if v != LAWS[name].parameters.value(n)}
    said = "".join(f'{n} = "{written(v, LAWS[name].parameters[n])}"\n' for n, v in values.items())
    flags = "".join(f"{wrapper} = true\n" for wrapper in wrappers)
    path = tmp_path / "drive.toml"
    path.write_text(f'[drive]\nkind = "force"\n[friction]\nmodel = "{law}"\n{flags}{said}', encoding="utf-8")
    drive, parameters = read_drive(path)
    assert drive == ForceDrive(LAWS[name])
    assert {n: parameters.value(f"friction.{n}") for n in truth(name, LAWS[name])} == truth(name, LAWS[name])


@pytest.mark.parametrize("name", LAWS)
def test_every_unknown_is_a_parameter_with_advice_that_names_parameters(name: str) -> None:
    law = LAWS[name]
    assert set(law.start.unknowns) <= set(law.parameters)
    assert {*law.start.scanned, *law.start.above, *law.start.floors} <= set(law.parameters)
    known = set(law.parameters) | {"viscous_asymmetry", "coulomb_asymmetry"}
    assert set(law.identification_hints.needs) <= known


@dataclass(frozen=True)
class Rough(Coulomb):
    """A law whose force jumps at v = 0."""

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002
        return Force(p["coulomb"] * ca.sign(v), {})


@dataclass(frozen=True)
class Kinked(Coulomb):
    """A law whose derivative is 0/0 at v = 0."""

    def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002
        return Force(p["coulomb"] * v / ca.sqrt(v**2 + 1e-6) * ca.sqrt(ca.sqrt(v**2)), {})


def test_a_law_without_a_derivative_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TRUTH, "rough", {})
    monkeypatch.setitem(TRUTH, "kinked", {})
    with pytest.raises(AssertionError, match=r"rough has a wrong derivative: .* by v at v = 0 m/s"):
        check_derivatives("rough", Rough())
    with pytest.raises(AssertionError, match=r"kinked has no derivative: .*nan.* by v at v = 0 m/s"):
        check_derivatives("kinked", Kinked())


def test_a_law_that_pushes_or_has_no_unit_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Pushing(Coulomb):
        inputs: tuple[Quantity, ...] = ()

        @property
        def parameters(self) -> ParameterSet:
            return ParameterSet({"coulomb": Parameter(30.0, "")})

        def force(self, v: ca.SX, z: Symbols, u: Symbols, p: Symbols) -> Force:  # noqa: ARG002
            return Force(-p["coulomb"] * v, {})

    monkeypatch.setitem(TRUTH, "pushing", {})
    with pytest.raises(AssertionError, match="pushing: friction pushes"):
        check_passive("pushing", Pushing())
    with pytest.raises(AssertionError, match="pushing: coulomb has no unit"):
        check_units("pushing", Pushing())
