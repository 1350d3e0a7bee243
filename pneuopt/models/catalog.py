"""Drives with cited numbers, built afresh at each call; a range in brackets is the published one."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import pi

from pneuopt.models.friction import FrictionModel, LuGre, Stribeck, Viscous
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import IsentropicNozzle, Smoothing, conductance_of_area
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.errors import check_names
from pneuopt.quantities.parameters import ParameterSet

DriveSet = tuple[PneumaticDrive, ParameterSet]
CATALOGUE_SOURCE = "sizes as in catalogues (ISO 6432, ISO 15552), friction from published ranges; no single product"
PAPER_SOURCE = "reconstructed so that Ye, Wang, Chen (IJRES 3(7), 2015) eq. (1)-(15) give eq. (16)"
BENCHMARK_SOURCE = "pneuopt benchmark {}, chosen"


def s25() -> DriveSet:
    """25 mm bore, 10 mm rod, 0.2 m stroke, 350 l/min(ANR) valve.

    Source: sizes as in catalogues; load [0.5-5 kg], dead volume [5-30 cm^3], F_c [8-25 N], F_s [12-40 N],
    v_s [5-50 mm/s], bristles [5e3-3e5 N/m, 50-600 N s/m], viscous [20-100 N s/m], lap rounding [0.01-0.1].
    """
    return _catalogue_drive((0.025, 0.010, 0.2), 2.0, 12e-6, 1.38e-8, (15.0, 25.0, 0.02, 3e4, 150.0, 50.0))


def s32() -> DriveSet:
    """32 mm bore, 12 mm rod, 0.3 m stroke, 700 l/min(ANR) valve.

    Source: sizes as in catalogues; load [1-15 kg], dead volume [10-60 cm^3], F_c [12-40 N], F_s [20-65 N], viscous
    [30-120 N s/m].
    """
    return _catalogue_drive((0.032, 0.012, 0.3), 5.0, 25e-6, 2.75e-8, (25.0, 40.0, 0.02, 5e4, 250.0, 70.0))


def s40() -> DriveSet:
    """40 mm bore, 16 mm rod, 0.5 m stroke, 1400 l/min(ANR) valve.

    Source: sizes as in catalogues; load [2-30 kg], dead volume [20-120 cm^3], F_c [20-65 N], F_s [30-100 N], viscous
    [40-180 N s/m].
    """
    return _catalogue_drive((0.040, 0.016, 0.5), 15.0, 60e-6, 5.5e-8, (40.0, 65.0, 0.025, 8e4, 400.0, 110.0))


SIZES: Mapping[str, Callable[[], DriveSet]] = {"s25": s25, "s32": s32, "s40": s40}
"""Drives of catalogue sizes by name."""
CYLINDERS: Mapping[str, str] = {"25": "s25", "32": "s32", "40": "s40"}
"""By bore [mm] the size whose cylinder has it."""
VALVES: Mapping[str, str] = {"350": "s25", "700": "s32", "1400": "s40"}
"""By nominal flow [l/min(ANR)] the size whose valve has it."""


def catalogue_values(size: str, cylinder: str | None = None, valve: str | None = None) -> ParameterSet:
    """Parameters, each with its source, of one of `SIZES` with a cylinder of `CYLINDERS` or a valve of `VALVES`."""
    values = ParameterSet()
    for what, name, known, sections in (
        ("size", size, {n: n for n in SIZES}, ""),
        ("cylinder", cylinder, CYLINDERS, "cylinder."),
        ("valve", valve, VALVES, "valve."),
    ):
        if name is not None:
            check_names(what, [name], known, "catalogue")
            part = SIZES[known[name]]()[1]
            values |= part.select(n for n, p in part.items() if n.startswith(sections) and p.source == CATALOGUE_SOURCE)
    return values


def r25(lugre: bool = False) -> DriveSet:
    """25 mm rodless, 1 m stroke: at rest it linearises to eq. (16), ``1270.12/(s^2 + 17.5 s + 86.34)`` [V/V].

    In eq. (16) the speed is measured by a transducer of 20 V/(m/s), which belongs to the feedback, not to this drive.

    Source: reconstructed from Ye, Wang, Chen, IJRES 3(7), 2015; the paper prints no hardware. The dead volumes are
    about 2.5 m of 8 mm hose, the valve is about 650 l/min(ANR).

    Parameters
    ----------
    lugre : bool
        LuGre friction (25 N, 40 N, 20 mm/s) instead of the viscous friction alone that the paper has.
    """
    friction: FrictionModel = LuGre() if lugre else Viscous()
    valve = ProportionalValve(IsentropicNozzle(), Spool.RIGID)
    drive = PneumaticDrive(valve, friction, cylinder=Cylinder(stops=False))
    bristles = (25.0, 40.0, 0.02, 5e4, 300.0, 200.0)
    values = _cylinder_values((0.025, 0.0, 1.0), 1.3051087903e-4) | (
        _lugre_values(bristles) if lugre else {"friction.viscous": 200.0}
    )
    values |= {
        "valve.conductance": conductance_of_area(0.7 * 1.5472759716e-2 * 1e-3),
        "valve.rounding": 8.1499939196e-2,
        "supply.pressure": 6e5,
        "chamber.exponent": 1.4,
        "load.mass": 12.0,
    }
    return drive, _with_source(drive, values, PAPER_SOURCE)


def b32(lugre: bool = False) -> DriveSet:
    """The identification benchmark: 32/12 mm, 0.2 m stroke, 5 kg, spool of first order at 50 Hz, command -1 to 1 V.

    Source: chosen. The corner of the flow law is rounded by 1e-3 where the benchmark clips, a difference of at most
    2.5e-7 of the choked flow; with the default rounding it would be 1e-4.

    Parameters
    ----------
    lugre : bool
        LuGre friction on the same Stribeck curve.
    """
    friction: FrictionModel = LuGre() if lugre else Stribeck()
    drive = PneumaticDrive(
        ProportionalValve(spool=Spool.FIRST_ORDER, smoothing=_SHARP_SMOOTHING),
        friction,
        cylinder=_CYLINDER_WITHOUT_STOPS,
    )
    values = _benchmark_values(0.2, None, friction) | {"valve.rounding": 0.01, "valve.leak": 0.01, "valve.span": 1.0}
    values |= {"valve.bandwidth": 50.0, **({"friction.damping_velocity": 1e3} if lugre else {})}
    return drive, _with_source(drive, values, BENCHMARK_SOURCE.format("B32"))


def t32() -> DriveSet:
    """The tuning benchmark: 32/12 mm, 0.5 m stroke, 5 kg, LuGre friction, a spool of 80 Hz with a dead zone of 3 %.

    Source: chosen. It starts at 50 mm with 3.5 bar(a) in chamber b: ``drive.rest(parameters, pressure_b=3.5e5)``.
    """
    friction = LuGre()
    drive = PneumaticDrive(ProportionalValve(smoothing=_SHARP_SMOOTHING), friction, cylinder=_CYLINDER_WITHOUT_STOPS)
    values = _benchmark_values(0.5, 20e-6, friction) | {
        "valve.rounding": 0.002,
        "valve.dead_zone": 0.03,
        "valve.leak": 0.0,
    }
    values |= {"valve.bandwidth": 80.0, "valve.damping": 0.8, "cylinder.start": 0.1, "friction.bristle_damping": 424.0}
    return drive, _with_source(drive, values, BENCHMARK_SOURCE.format("T32"))


_SHARP_SMOOTHING = Smoothing(corner=1e-3, zero=0.005, pressure=1.0)
_CYLINDER_WITHOUT_STOPS = Cylinder(stops=False)


def _catalogue_drive(
    size: tuple[float, float, float], mass: float, dead: float, conductance: float, friction: tuple[float, ...]
) -> DriveSet:
    drive = PneumaticDrive(friction=LuGre())
    values = _cylinder_values(size, dead) | _lugre_values(friction)
    values |= {"load.mass": mass, "valve.conductance": conductance, "valve.critical_ratio": 0.3, "valve.rounding": 0.04}
    values |= {"supply.pressure": 7.013e5, "valve.bandwidth": 100.0, "valve.damping": 0.7, "chamber.exponent": 1.4}
    return drive, _with_source(drive, values, CATALOGUE_SOURCE)


def _benchmark_values(stroke: float, dead: float | None, friction: FrictionModel) -> dict[str, float]:
    bore, rod = 0.032, 0.012
    a, b = pi / 4 * bore**2, pi / 4 * (bore**2 - rod**2)
    curve = {"coulomb": 40.0, "static": 70.0, "stribeck_velocity": 0.02, "viscous": 80.0, "smoothing": 1e-3}
    curve |= {"bristle_stiffness": 1e5, "bristle_damping": 300.0, "damping_velocity": 0.05}
    return {
        **_cylinder_values((bore, rod, stroke), dead or 0.05 * stroke * a),
        "cylinder.dead_volume_b": dead or 0.05 * stroke * b,
        "valve.conductance": 2e-8,
        "valve.critical_ratio": 0.3,
        "supply.pressure": 7e5,
        "ambient.pressure": 1e5,
        "gas.constant": 287.0,
        "chamber.exponent": 1.2,
        "load.mass": 5.0,
        **{f"friction.{n}": value for n, value in curve.items() if n in friction.parameters},
    }


def _cylinder_values(size: tuple[float, float, float], dead: float) -> dict[str, float]:
    keys = ("bore", "rod", "stroke", "dead_volume_a", "dead_volume_b")
    return {f"cylinder.{n}": value for n, value in zip(keys, (*size, dead, dead), strict=True)}


def _lugre_values(numbers: tuple[float, ...]) -> dict[str, float]:
    keys = ("coulomb", "static", "stribeck_velocity", "bristle_stiffness", "bristle_damping", "viscous")
    return {f"friction.{n}": value for n, value in zip(keys, numbers, strict=True)} | {
        "friction.damping_velocity": 0.05
    }


def _with_source(drive: PneumaticDrive, values: Mapping[str, float], source: str) -> ParameterSet:
    parameters = drive.parameters.with_values(values)
    sourced = parameters | ParameterSet({n: replace(parameters[n], source=source) for n in values})
    drive.check(sourced)
    return sourced
