"""Every registered kind of drive goes through one mill: a new kind is a new row in `ROWS`."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
import tomlkit
from numpy.testing import assert_allclose

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.files.drive import read_drive, write_fit
from pneuopt.identification.result import IdentificationResult
from pneuopt.models.declaration import Drive
from pneuopt.models.drive_kinds import DRIVE_KINDS, stick_slip_drive
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Karnopp, LuGre, Stribeck, Viscous, friction_ladder
from pneuopt.models.linear import SecondOrder
from pneuopt.plotting import has_friction_map
from pneuopt.quantities.errors import InputError, UnknownNameError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import si_conversion, write_value

# The least that such a file says, with every section that has keys of its own.
ROWS: dict[str, str] = {
    "pneumatic": "[cylinder]\n[valve]\n[chamber]\n[load]\n[friction]\nmodel = 'stribeck'",
    "force": "[load]\n[friction]\nmodel = 'lugre'",
    "motion": "[rig]\n[friction]\nmodel = 'coulomb'",
    "rotary": "[load]\n[friction]\nmodel = 'stribeck'",
    "linear": "[plant]\nmodel = 'second_order'\npade_order = 1\n[friction]\nmodel = 'coulomb'",
}


def row_document(kind: str) -> tomlkit.TOMLDocument:
    return tomlkit.parse(f"[drive]\nkind = '{kind}'\n{ROWS[kind]}\n")


def read_document(document: tomlkit.TOMLDocument, folder: Path) -> tuple[Drive, ParameterSet]:
    (folder / "drive.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    return read_drive(folder / "drive.toml")


@pytest.fixture(scope="module", params=sorted(DRIVE_KINDS))
def kind(request: pytest.FixtureRequest) -> str:
    name = str(request.param)
    assert name in ROWS, f"drive kind {name!r} has no row in this table"
    return name


@pytest.fixture(scope="module")
def drive(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return read_document(row_document(kind), tmp_path_factory.mktemp("drive"))[0]


@pytest.fixture(scope="module")
def system(drive: Drive) -> System:
    return drive.system()


def test_its_name_and_sections_are_declared(kind: str, drive: Drive, system: System) -> None:
    sections = DRIVE_KINDS[kind].sections
    assert (drive.kind, DRIVE_KINDS[kind].name) == (kind, kind)
    assert {n.partition(".")[0] for n in system.parameters} <= {*sections, "ambient", "gas", "supply"}
    assert {n for n, keys in sections.items() if keys} <= {*row_document(kind)}


def test_every_signal_and_parameter_has_a_unit_that_reads(system: System) -> None:
    signals = [(q.name, q.unit) for q in (*system.states, *system.inputs, *system.outputs)]
    for name, unit in [*signals, *((n, p.unit) for n, p in system.parameters.items())]:
        assert unit, f"{name} has no unit"
        assert si_conversion(unit, unit) == (1.0, 0.0), f"{name} [{unit}] is not in SI units"


def test_every_parameter_says_what_it_is(system: System) -> None:
    assert [n for n, p in system.parameters.items() if not p.meaning] == []


def test_derivatives_are_finite_and_equal_the_central_differences(system: System) -> None:
    rng = np.random.default_rng(1)
    sizes = [system.ode.size1_in(i) for i in range(4)]
    point = [ca.SX.sym(f"i{i}", n) for i, n in enumerate(sizes)]
    jacobian = ca.Function("J", point, [ca.jacobian(ca.vertcat(*system.ode(*point)), ca.vertcat(*point[1:3]))])
    p = parameter_vector(system.parameters, system.parameters)
    nominal = [np.array([q.nominal for q in group]) for group in (system.states, system.inputs)]
    x, u = (n * (0.6 + 0.2 * rng.random(len(n))) for n in nominal)
    exact, at = np.array(jacobian(0, x, u, p)), np.concatenate([x, u])
    assert np.isfinite(exact).all()
    for column, step in enumerate(1e-6 * np.concatenate(nominal)):
        shift = step * (np.arange(len(at)) == column)
        high, low = (
            np.concatenate([np.array(o).ravel() for o in system.ode(0, *np.split(w, [sizes[1]]), p)])
            for w in (at + shift, at - shift)
        )
        rounding = 1e-15 * np.abs(high).max() / step
        assert_allclose(exact[:, column], (high - low) / (2 * step), rtol=1e-4, atol=rounding + 1e-9)


def test_every_parameter_is_a_key_that_reads_back(kind: str, system: System, tmp_path: Path) -> None:
    document, wanted = row_document(kind), {}
    for name, p in system.parameters.items():
        section, _, key = name.partition(".")
        if section not in document:
            document[section] = tomlkit.table()
        entries: Any = document[section]
        value = p.value if name in ("load.inclination", "cylinder.rod") else p.value * (1 + 1e-3)
        if p.lower <= value <= p.upper:
            entries[key], wanted[name] = write_value(value, p.unit, 17), value
    found = read_document(document, tmp_path)[1]
    assert {n: found.value(n) for n in wanted} == pytest.approx(wanted, rel=1e-12)
    assert len(wanted) >= len(system.parameters) - 1


def test_a_fit_reads_back(kind: str, drive: Drive, tmp_path: Path) -> None:
    given = read_document(row_document(kind), tmp_path)[1]
    found = given.freed("friction.*").with_values({"friction.coulomb": 1.25 * given.value("friction.coulomb")})
    table = pd.DataFrame()
    fit = IdentificationResult(found, table, table, table, {}, Status(Code.CONVERGED), {}, {})
    write_fit(tmp_path / "fit.toml", tmp_path / "drive.toml", fit)
    again, values = read_drive(tmp_path / "fit.toml")
    assert again == drive
    assert values.free_names == found.free_names
    assert {n: values.value(n) for n in values} == pytest.approx({n: found.value(n) for n in found}, rel=1e-8)


def test_every_declared_key_is_read(kind: str, tmp_path: Path) -> None:
    """A key that takes no number refuses one, by its name; each of its words builds a drive."""
    for section, keys in DRIVE_KINDS[kind].sections.items():
        for key, known in keys.items():
            document = row_document(kind)
            entries: Any = document[section]
            entries[key] = 3.5
            with pytest.raises(
                InputError, match=rf"drive.toml:\d+: \[{section}\] {key} must be {known.takes.value}, got 3.5"
            ):
                read_document(document, tmp_path)
            for word in known.choices or ():
                entries[key] = word
                if kind == "linear" and word != "second_order":
                    document.pop("friction", None)
                assert read_document(document, tmp_path)[0].kind == kind


def test_an_unknown_key_is_refused_with_the_nearest(kind: str, system: System, tmp_path: Path) -> None:
    for section in row_document(kind):
        own = [n.partition(".")[2] for n in system.parameters if n.startswith(f"{section}.")]
        key = ([*DRIVE_KINDS[kind].sections.get(section, {}), *own] or ["kind"])[0]
        document = row_document(kind)
        entries: Any = document[section]
        entries[f"{key}x"] = "1"
        message = rf"drive.toml:\d+: \[{section}\]: unknown key '{key}x'; did you mean '{key}'"
        with pytest.raises(UnknownNameError, match=message):
            read_document(document, tmp_path)


def test_a_log_that_the_drive_made_starts_it(system: System) -> None:
    t = np.linspace(0.0, 0.3, 301)
    swings = {
        q.name: q.nominal * (0.6 * np.sin(60 * t) if not q.unit.startswith("Pa") else 1 + 0 * t) for q in system.inputs
    }
    free = [n for n in system.parameters if n in ("friction.coulomb", "friction.viscous", "plant.gain", "load.mass")]
    parameters = system.parameters.freed(*free)
    run = simulate(system, Trajectory(t, swings), parameters)
    measured = Trajectory(t, {**swings, **{n: run[n] for n in names(system.outputs)}})
    starts = system.starts({"run": Log(measured, parameters)})
    assert len(starts) > 0
    for start in starts:
        for state in names(system.states):
            assert np.isfinite(start.states["run"][state]).all(), state
        for name, value in start.parameters.items():
            assert parameters[name].lower <= value <= parameters[name].upper, name


def test_what_it_moves_is_named_as_it_is(system: System) -> None:
    """An axis names states and a parameter that are there, with the units that belong together."""
    if system.axis is None:
        assert not has_friction_map(system) or not system.states
        return
    units = {q.name: q.unit for q in system.states} | {n: p.unit for n, p in system.parameters.items()}
    axis = system.axis
    assert si_conversion(f"({units[axis.position]})/s", units[axis.speed]) == (1.0, 0.0)
    turns = {"rad": "rad"}.get(units[axis.position], "1")
    balance = f"({units[axis.inertia]})*({units[axis.speed]})/s/({turns})"
    assert si_conversion(balance, axis.force) == (1.0, 0.0)
    assert has_friction_map(system)


def test_every_friction_law_fits_where_it_is_declared(kind: str, drive: Drive) -> None:
    if not DRIVE_KINDS[kind].any_friction:
        return
    built: Any = drive
    for law in friction_ladder().values():
        other = replace(built, friction=law).system()
        assert {n for n in other.parameters if n.startswith("friction.")} == {f"friction.{n}" for n in law.parameters}
        assert all(math.isfinite(p.value) for p in other.parameters.values())


def test_dry_friction_sticks_and_what_has_none_stays() -> None:
    assert stick_slip_drive(ForceDrive(Stribeck())) == ForceDrive(Karnopp(Stribeck()))
    for drive in (ForceDrive(LuGre()), ForceDrive(Viscous()), SecondOrder()):
        assert stick_slip_drive(drive) is drive
