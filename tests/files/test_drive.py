"""drive.toml and fit.toml: what is read, written and kept, for every kind of drive."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, read_fit, read_status, write_fit
from pneuopt.files.study import read_axes, read_study
from pneuopt.files.toml import read_toml
from pneuopt.files.tuning import read_scenarios
from pneuopt.identification.result import IdentificationResult, Verdict
from pneuopt.models.declaration import Drive
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Asymmetric, Coulomb, LuGre, PressureDependent, Stribeck, Viscous
from pneuopt.models.linear import FirstOrder, Integrator, SecondOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic.chamber import Polytropic, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import IsentropicNozzle, Smoothing
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.errors import InputError, UnitError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, read_value

AXIS = """# my axis, 2024
[drive]
kind = "force"   # pushed by a motor

[load]
mass = { value = "95 kg", lower = "50 kg", upper = "150 kg", free = true }   # weighed
force = "-3 N"

[friction]
model = "stribeck"   # viscous|coulomb|stribeck|lugre
asymmetric = true
coulomb = "20 N"  # guess
smoothing = { value = "1 mm/s", source = "EMPS paper" }
"""


def fit_of(
    parameters: ParameterSet,
    estimates: pd.DataFrame | None = None,
    status: Status | None = None,
    provenance: Mapping[str, Any] | None = None,
    verdict: Verdict | None = None,
) -> IdentificationResult:
    """A result with nothing but what a file shows of it."""
    table = pd.DataFrame()
    status = status or Status(Code.CONVERGED, ("gaps 1e-9",))
    known = table if estimates is None else estimates
    return IdentificationResult(parameters, known, table, table, {}, status, {}, provenance or {}, verdict)


def written(folder: Path, text: str, name: str = "drive.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_reads_a_force_drive(tmp_path: Path) -> None:
    drive, rig = read_drive(written(tmp_path, AXIS))
    assert drive == ForceDrive(Asymmetric(Stribeck()))
    assert tuple(rig) == tuple(drive.system().parameters)
    mass = rig["load.mass"]
    assert (mass.value, mass.lower, mass.upper, mass.free) == (95.0, 50.0, 150.0, True)
    assert (rig.value("load.force"), rig.value("friction.coulomb")) == (-3.0, 20.0)
    assert (rig["friction.smoothing"].value, rig["friction.smoothing"].source) == (1e-3, "EMPS paper")
    assert rig["friction.static"] == drive.system().parameters["friction.static"]
    assert rig.free_names == ("load.mass",)


@pytest.mark.parametrize(
    ("text", "drive"),
    [
        ('[drive]\nkind = "force"\n[friction]\nmodel = "viscous"\n', ForceDrive(Viscous())),
        ('[drive]\nkind="force"\n[load]\nspring=true\n[friction]\nmodel="lugre"\n', ForceDrive(LuGre(), Load(True))),
        (
            '[drive]\nkind = "motion"\n[friction]\nmodel = "coulomb"\npressure_dependent = true\n',
            MotionDrive(PressureDependent(Coulomb())),
        ),
        (
            '[drive]\nkind = "motion"\n[rig]\nchamber = true\narea = "491 mm^2"\n[ambient]\npressure = "1 bar(a)"\n'
            '[friction]\nmodel = "coulomb"\nasymmetric = true\npressure_dependent = ["pressure_a"]\n'
            'coulomb_pressure_a = "10 N/bar"\n',
            MotionDrive(PressureDependent(Asymmetric(Coulomb()), ("pressure_a",))),
        ),
        (
            '[drive]\nkind = "motion"\n[rig]\nchamber = false\n[friction]\nmodel = "viscous"\n',
            MotionDrive(Viscous(), chamber=False),
        ),
        ('[drive]\nkind = "linear"\n[plant]\nmodel = "first_order"\ngain = "0.1 m/(s*V)"\n', FirstOrder()),
        (
            '[drive]\nkind = "linear"\n[plant]\nmodel = "second_order"\ndamping = 0.3\ndead_time = "9 ms"\n',
            SecondOrder(pade_order=3),
        ),
        ('[drive]\nkind = "linear"\n[plant]\nmodel = "second_order"\npade_order = 2\n', SecondOrder(pade_order=2)),
    ],
)
def test_builds_the_drive_that_the_file_says(tmp_path: Path, text: str, drive: object) -> None:
    built, rig = read_drive(written(tmp_path, text))
    assert built == drive
    assert tuple(rig) == tuple(built.system().parameters)


def test_errors_are_of_their_kind(tmp_path: Path) -> None:
    with pytest.raises(UnitError):
        read_drive(written(tmp_path, AXIS.replace('"20 N"', '"20"')))
    with pytest.raises(UnknownNameError):
        read_drive(written(tmp_path, AXIS.replace("coulomb", "coulom")))


def test_a_fit_keeps_the_users_text_and_adds_the_results(tmp_path: Path) -> None:
    source = written(tmp_path, AXIS)
    drive, rig = read_drive(source)
    found = rig.freed("friction.viscous").with_values(
        {"load.mass": 95.1089, "friction.coulomb": 20.25, "friction.viscous": 203.5}
    )
    estimates = pd.DataFrame(
        {"value": [95.1089, 203.5], "stderr": [0.1, math.nan], "upper": [150.0, math.inf], "at_bound": [False, True]},
        index=["load.mass", "friction.viscous"],
    ).assign(unit=["kg", "N*s/m"])
    provenance = {"versions": {"pneuopt": "0.1"}, "sha256": {"run_01": "ab"}, "seconds": np.float64(1.5), "none": None}
    write_fit(tmp_path / "fit.toml", source, fit_of(found, estimates, provenance=provenance))
    text = (tmp_path / "fit.toml").read_text(encoding="utf-8")
    for kept in (
        "# my axis, 2024",
        "# pushed by a motor",
        "# weighed",
        '"20.25 N"  # guess',
        'lower = "50 kg"',
        '"1 mm/s"',
    ):
        assert kept in text
    again, values = read_drive(tmp_path / "fit.toml")
    assert again == drive
    assert values == found
    said = read_toml(tmp_path / "fit.toml").unwrap()
    row = {"value": 95.1089, "stderr": 0.1, "upper": 150.0, "at_bound": False, "unit": "kg"}
    assert said["estimates"]["load.mass"] == row
    assert math.isnan(said["estimates"]["friction.viscous"]["stderr"])
    assert said["provenance"] == {"versions": {"pneuopt": "0.1"}, "sha256": {"run_01": "ab"}, "seconds": 1.5}


def test_a_fit_adds_what_the_file_left_out(tmp_path: Path) -> None:
    source = written(tmp_path, AXIS.partition("[load]")[0] + '[friction]\nmodel = "coulomb"\n\n# the end\n')
    found = read_drive(source)[1].freed("load.mass").with_values({"load.mass": 7.0, "friction.coulomb": 12.0})
    write_fit(tmp_path / "fit.toml", source, fit_of(found, provenance={"logs": ["a", None, np.int64(2)]}))
    assert read_drive(tmp_path / "fit.toml")[1] == found
    assert read_toml(tmp_path / "fit.toml").unwrap()["provenance"] == {"logs": ["a", 2]}


def test_a_fit_of_a_fit_replaces_the_results(tmp_path: Path) -> None:
    source = written(tmp_path, AXIS)
    rig = read_drive(source)[1]
    bad = Status(Code.ITERATION_LIMIT, ("gap of position 3e-3; raise max_iterations",))
    write_fit(tmp_path / "fit.toml", source, fit_of(rig.with_values({"load.mass": 90.0}), status=bad))
    assert read_status(tmp_path / "fit.toml") == bad
    assert read_drive(tmp_path / "fit.toml")[1].value("load.mass") == 90.0
    better = rig.with_values({"load.mass": 91.0}).fixed("load.mass")
    write_fit(tmp_path / "fit.toml", tmp_path / "fit.toml", fit_of(better))
    assert read_status(tmp_path / "fit.toml") == Status(Code.CONVERGED, ("gaps 1e-9",))
    assert read_drive(tmp_path / "fit.toml")[1] == better
    assert read_status(source) is None


def test_an_unknown_status_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"\[status\] code: unknown status 'convergd'; did you mean 'converged'"):
        read_status(written(tmp_path, '[status]\ncode = "convergd"\n'))


@settings(max_examples=40, deadline=None)
@given(
    st.floats(50.0, 150.0),
    st.floats(-1e5, 1e5),
    st.floats(1e-6, 1.0),
    st.sampled_from(["", "identified from run_01"]),
    st.booleans(),
)
def test_any_fit_reads_back(
    tmp_path_factory: pytest.TempPathFactory, mass: float, force: float, smoothing: float, source: str, free: bool
) -> None:
    folder = tmp_path_factory.mktemp("fit")
    rig = read_drive(written(folder, AXIS))[1]
    values = {"load.mass": mass, "load.force": force, "friction.smoothing": smoothing, "friction.static": abs(force)}
    found = rig.with_values(values)
    found = found.freed("friction.*") if free else found
    write_fit(folder / "fit.toml", folder / "drive.toml", fit_of(found))
    again = read_drive(folder / "fit.toml")[1]
    assert again.free_names == found.free_names
    for name, parameter in found.items():
        assert again.value(name) == pytest.approx(parameter.value, rel=1e-8)
        assert (again[name].lower, again[name].upper) == (parameter.lower, parameter.upper)


def test_a_value_at_its_bound_reads_back(tmp_path: Path) -> None:
    source = written(tmp_path, AXIS.replace("50 kg", "53.333333333333336 kg"))
    found = read_drive(source)[1].with_values({"load.mass": 53.333333333333336})
    write_fit(tmp_path / "fit.toml", source, fit_of(found))
    assert read_drive(tmp_path / "fit.toml")[1] == found


CYLINDER = """[drive]
kind = "pneumatic"
[cylinder]
bore = "32 mm"
rod = "12 mm"
stroke = "200 mm"
dead_volume_a = "8 cm^3"
start = "10 %"
[valve]
conductance = "2e-8 m^3/(s*Pa)"   # ISO 6358 C
critical_ratio = 0.3
bandwidth = "80 Hz"
dead_zone = "3 %"
[supply]
pressure = "6 bar(g)"
[ambient]
temperature = "25 degC"
[load]
mass = { value = "5 kg", lower = "3 kg", upper = "8 kg" }
[friction]
model = "stribeck"
coulomb = { value = "40 N", free = true }
"""


CONDUCTANCE, FLOW = 'conductance = "2e-8 m^3/(s*Pa)"', 'nominal_flow = "700 l/min(ANR)"'


def test_reads_a_pneumatic_drive(tmp_path: Path) -> None:
    drive, rig = read_drive(written(tmp_path, CYLINDER))
    assert drive == PneumaticDrive()
    expected = {
        "cylinder.bore": 0.032, "cylinder.start": 0.1, "valve.conductance": 2e-8, "valve.dead_zone": 0.03,
        "supply.pressure": 701325.0, "ambient.temperature": 298.15, "load.mass": 5.0,
    }  # fmt: skip
    assert {n: rig.value(n) for n in expected} == expected
    assert rig.free_names == ("friction.coulomb",)
    write_fit(tmp_path / "fit.toml", tmp_path / "drive.toml", fit_of(rig.with_values({"valve.leak": 0.01})))
    assert read_drive(tmp_path / "fit.toml")[1] == rig.with_values({"valve.leak": 0.01})


def test_reads_a_pneumatic_drive_of_other_parts(tmp_path: Path) -> None:
    text = CYLINDER.replace("critical_ratio = 0.3", 'law = "isentropic"\nspool = "first_order"')
    text = text.replace("[load]", "[chamber]\nmixed = true\n[load]\ninclined = true\nspring = true")
    drive, _ = read_drive(written(tmp_path, text.replace("[valve]", "stops = false\n[valve]")))
    valve = ProportionalValve(IsentropicNozzle(), Spool.FIRST_ORDER)
    assert drive == PneumaticDrive(valve, Stribeck(), Load(True, True), Polytropic(mixed=True), Cylinder(stops=False))
    warm = CYLINDER + '[chamber]\nmodel = "thermal"\nwall_conductance = "0.3 W/K"\n[gas]\nconstant = "287 J/(kg*K)"\n'
    drive, rig = read_drive(written(tmp_path, warm))
    assert drive == PneumaticDrive(chamber=Thermal())
    assert (rig.value("chamber.wall_conductance"), rig.value("gas.constant")) == (0.3, 287.0)


def test_a_start_or_a_load_that_cannot_be_is_refused_with_the_drive_of_a_file(tmp_path: Path) -> None:
    drive, rig = read_drive(written(tmp_path, CYLINDER))
    held = Trajectory([0.0, 0.1], {"valve_voltage": [0.0, 0.0]})
    with pytest.raises(InputError, match=r"position = \S+ m+ lies outside the stroke"):
        simulate(drive.system(), held, rig, initial={"position": 0.3})
    heavy = CYLINDER.replace("mass =", 'force = "600 N"\nmass =')
    drive, rig = read_drive(written(tmp_path, heavy))
    with pytest.raises(InputError, match=r"no equilibrium exists.*lower the load, raise the supply or the bore"):
        simulate(drive.system(), held, rig)


def test_a_nominal_flow_is_a_conductance_at_the_critical_ratio(tmp_path: Path) -> None:
    flows = '{ value = "700 l/min(ANR)", upper = "1400 l/min(ANR)", free = true }'
    text = CYLINDER.replace(CONDUCTANCE, f"nominal_flow = {flows}")
    rig = read_drive(written(tmp_path, text))[1]
    found = rig["valve.conductance"]
    assert found.value == pytest.approx(2.75e-8, rel=2e-3)
    assert found.upper == pytest.approx(2 * found.value, rel=1e-12)
    assert found.free
    nozzle = text.replace("critical_ratio = 0.3", 'law = "isentropic"')
    assert read_drive(written(tmp_path, nozzle))[1].value("valve.conductance") < 0.9 * found.value
    written(tmp_path, text)
    for name, value in {"valve.critical_ratio": 0.4, "valve.conductance": 3e-8, "valve.leak": 0.01}.items():
        fit = rig.with_values({name: value})
        write_fit(tmp_path / "fit.toml", tmp_path / "drive.toml", fit_of(fit))
        again = read_drive(tmp_path / "fit.toml")[1]
        assert [again.value(n) for n in fit] == pytest.approx([fit.value(n) for n in fit], rel=1e-8)
        assert again["valve.conductance"].free
        assert again["valve.conductance"].upper == pytest.approx(found.upper, rel=1e-8)
        assert ("nominal_flow" in (tmp_path / "fit.toml").read_text(encoding="utf-8")) == (name == "valve.leak")


def test_smoothing_widths_are_settable(tmp_path: Path) -> None:
    widths = 'smoothing = { zero = 0.01, pressure = "1 Pa" }\nrounding = "0.2 %"'
    text = CYLINDER.replace("critical_ratio = 0.3", widths).replace("coulomb =", 'smoothing = "2 mm/s"\ncoulomb =')
    drive, rig = read_drive(written(tmp_path, text))
    assert drive == PneumaticDrive(ProportionalValve(smoothing=Smoothing(zero=0.01, pressure=1.0)))
    assert (rig.value("valve.rounding"), rig.value("friction.smoothing")) == (0.002, 0.002)


FORCE_AXIS = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "coulomb"\n'


def fit_with(parameters: ParameterSet, covariance: pd.DataFrame) -> IdentificationResult:
    empty = pd.DataFrame()
    return IdentificationResult(parameters, empty, covariance, empty, {}, Status(Code.CONVERGED), {}, {})


def test_the_covariance_of_a_fit_is_in_its_file_without_what_the_logs_do_not_identify(tmp_path: Path) -> None:
    source = written(tmp_path, FORCE_AXIS)
    _, rig = read_drive(source)
    names = ["load.mass", "load.force", "friction.coulomb"]
    matrix = np.array([[4.0, -1.5, np.nan], [-1.5, 1.0, np.nan], [np.nan, np.nan, np.nan]])
    result = fit_with(rig, pd.DataFrame(matrix, names, names))
    write_fit(tmp_path / "fit.toml", source, result)
    found = read_fit(tmp_path / "fit.toml").covariance
    assert found is not None
    assert list(found.index) == list(found.columns) == names[:2]
    assert found.to_numpy().tolist() == matrix[:2, :2].tolist()
    assert read_drive(tmp_path / "fit.toml")[1] == rig
    assert read_fit(source).covariance is None


def test_a_fit_without_a_covariance_gives_the_variances_of_its_estimates(tmp_path: Path) -> None:
    rows = '[estimates]\n"load.mass" = {value = 5.0, stderr = 0.2}\n"load.force" = {value = 1.0, stderr = nan}\n'
    found = read_fit(written(tmp_path, FORCE_AXIS + rows)).covariance
    assert found is not None
    assert found.to_dict() == {"load.mass": {"load.mass": pytest.approx(0.04)}}


def test_degrees_of_freedom_and_bias_are_read_with_the_estimates(tmp_path: Path) -> None:
    rows = '"load.mass" = {value = 5.0, stderr = nan, dof = 3.5, bias = 0.5, mark = "exact"}\n'
    found = read_fit(written(tmp_path, f'{AXIS}[estimates]\n{rows}"load.force" = {{value = 1.0}}\n')).estimates
    assert found is not None
    assert found.loc["load.mass"].dropna().to_dict() == {"dof": 3.5, "bias": 0.5}
    assert found.loc["load.force"].isna().all()
    assert read_fit(written(tmp_path, FORCE_AXIS)).estimates is None


@pytest.mark.parametrize("rows", ['"load.mass" = 3', '"load.mass" = [1, 2]', '"a" = [1, 2]\n"b" = [3, 1]', "a = ['x']"])
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, rows: str) -> None:
    with pytest.raises(InputError, match=r"fit.toml: \[covariance\] must hold a row of numbers .*run identify again"):
        assert read_fit(written(tmp_path, f"{AXIS}[covariance]\n{rows}\n", "fit.toml")).covariance is None


@pytest.mark.parametrize(
    "rows",
    [
        '"a" = [4e-20, 1e-20]\n"b" = [-1e-20, 1e-20]',  # far below any absolute tolerance, and not symmetric
        '"a" = [-4.0, 0.0]\n"b" = [0.0, 1.0]',
        '"a" = [4e-20, 3e-20]\n"b" = [3e-20, 1e-20]',  # a correlation of 1.5
    ],
)
def test_a_covariance_is_checked_on_the_scale_of_its_variances(tmp_path: Path, rows: str) -> None:
    with pytest.raises(InputError, match=r"fit.toml: \[covariance\] must "):
        assert read_fit(written(tmp_path, f"{AXIS}[covariance]\n{rows}\n", "fit.toml")).covariance is None


def test_a_covariance_may_be_rounded(tmp_path: Path) -> None:
    rows = '"a" = [4e-20, 1.9999999999e-20]\n"b" = [2e-20, 1e-20]'
    assert read_fit(written(tmp_path, f"{AXIS}[covariance]\n{rows}\n", "fit.toml")).covariance is not None


HIGH_PLACE = ParameterSet({"supply.pressure": Parameter(6.84e5, "Pa(a)"), "ambient.pressure": Parameter(84e3, "Pa(a)")})
GAUGE_CYLINDER = """[drive]
kind = "pneumatic"
[cylinder]
[valve]
[load]
[friction]
model = "stribeck"
[supply]
pressure = { value = "6 bar(g)", upper = "9 bar(g)" }
[ambient]
"""


@pytest.mark.parametrize("ambient", ["84 kPa(a)", "1.0 bar(a)", None])
def test_gauge_pressures_count_from_the_drives_own_ambient_pressure(tmp_path: Path, ambient: str | None) -> None:
    _, rig = read_drive(written(tmp_path, GAUGE_CYLINDER + (f'pressure = "{ambient}"\n' if ambient else "")))
    zero = read_value(ambient, "Pa(a)") if ambient else ATMOSPHERE
    assert rig.value("supply.pressure") == pytest.approx(6e5 + zero, rel=1e-12)
    assert rig["supply.pressure"].upper == pytest.approx(9e5 + zero, rel=1e-12)


@pytest.mark.parametrize("said", ['{ value = "6 bar(g)", upper = "9 bar(g)" }', '"6 bar(g)"'])
def test_a_found_ambient_pressure_leaves_the_others_what_they_are(tmp_path: Path, said: str) -> None:
    text = GAUGE_CYLINDER.replace('{ value = "6 bar(g)", upper = "9 bar(g)" }', said)
    rig = read_drive(written(tmp_path, text + 'pressure = "1 bar(a)"\n'))[1]
    found, table = rig.with_values({"ambient.pressure": 0.98e5}), pd.DataFrame()
    result = IdentificationResult(found, table, table, table, {}, Status(Code.CONVERGED, ("gaps 1e-9",)), {}, {})
    write_fit(tmp_path / "fit.toml", tmp_path / "drive.toml", result)
    again = read_drive(tmp_path / "fit.toml")[1]
    assert again.value("ambient.pressure") == 0.98e5
    assert again.value("supply.pressure") == pytest.approx(rig.value("supply.pressure"), rel=1e-9)
    assert again["supply.pressure"].upper == pytest.approx(rig["supply.pressure"].upper, rel=1e-9)


def test_a_corner_of_gauge_pressures_counts_from_the_drives_ambient_pressure() -> None:
    section = {"corners": {"supply.pressure": ["5 bar(g)", "7 bar(g)"]}}
    found = read_scenarios(section, "tuning.toml", HIGH_PLACE)
    assert {round(float(str(case["supply.pressure"]))) for case in found.values()} >= {584_000, 784_000}


def test_an_axis_of_gauge_pressures_counts_from_the_drives_ambient_pressure(tmp_path: Path) -> None:
    text = '[study]\ndrive = "fit.toml"\ntuning = "tuned.toml"\n[axes]\n"supply.pressure" = ["4 bar(g)", "5 bar(g)"]\n'
    (pressure,) = read_axes(read_study(written(tmp_path, text, "study.toml")), HIGH_PLACE)
    assert pressure.points == pytest.approx((484e3, 584e3))
    assert pressure.in_axis_unit(pressure.points).tolist() == pytest.approx([4.0, 5.0])


def read(folder: Path, text: str) -> tuple[Drive, ParameterSet]:
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return read_drive(path)


def test_a_linear_plants_signal_in_a_unit_of_its_own(tmp_path: Path) -> None:
    text = '[drive]\nkind = "linear"\n[plant]\nmodel = "second_order"\noutput_unit = "V"\ngain = 14.7\n'
    drive, p = read(tmp_path, text)
    assert drive == SecondOrder(output=Quantity("speed", "V"))
    assert p.value("plant.gain") == 14.7
    for unit, message in (("mV", "no SI unit without a prefix"), ("bananas", "bananas")):
        with pytest.raises(InputError, match=message):
            read(tmp_path, text.replace('"V"', f'"{unit}"'))


def test_a_linear_plant_between_other_signals(tmp_path: Path) -> None:
    text = '[drive]\nkind = "linear"\n[plant]\nmodel = "integrator"\noutput = "position"\ngain = "50 mm/(V*s)"\n'
    plant, rig = read(tmp_path, text)
    assert isinstance(plant, Integrator)
    assert [q.name for q in (*plant.system().inputs, *plant.system().outputs)] == ["valve_voltage", "position"]
    assert rig.value("plant.gain") == 0.05
