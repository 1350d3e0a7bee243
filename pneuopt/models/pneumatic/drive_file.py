"""Sections and keys of a pneumatic drive in a file, with a catalogue's nominal flow in place of a conductance."""

from collections.abc import Mapping
from typing import Any

from pneuopt.models.declaration import Alias, DriveKind, DriveSections, FirstFiles
from pneuopt.models.friction_section import FRICTION_KEYS, STRIBECK_UNKNOWNS, read_friction
from pneuopt.models.load import LOAD_KEYS, Load
from pneuopt.models.pneumatic.chamber import ChamberModel, Polytropic, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import (
    CRITICAL_RATIO,
    IsentropicNozzle,
    Iso6358,
    Smoothing,
    conductance_of_nominal_flow,
)
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.errors import UnitError, require
from pneuopt.quantities.keys import Key, choice, flag, table
from pneuopt.quantities.units import read_value

_CRITICAL_RATIO = "valve.critical_ratio"
_SMOOTHING_KEYS = {
    "corner": Key("rounding of the corner where the flow chokes", usual=Smoothing.corner, least=0.0, is_open=True),
    "zero": Key("rounding of the flow law at no flow", usual=Smoothing.zero, least=0.0, is_open=True),
    "pressure": Key(
        "rounding of the larger of two pressures", unit="Pa", usual=Smoothing.pressure, least=0.0, is_open=True
    ),
}
_SECTIONS: Mapping[str, Mapping[str, Key]] = {
    "cylinder": {"stops": flag("whether the covers stop the piston", usual=True)},
    "valve": {
        "law": choice("flow law of the edges", {"iso6358": Iso6358, "isentropic": IsentropicNozzle}, "iso6358"),
        "spool": choice("lag of the spool", {spool.name.lower(): spool for spool in Spool}, "second_order"),
        "smoothing": table("widths over which the flow law is rounded", _SMOOTHING_KEYS),
    },
    "supply": {},
    "gas": {},
    "chamber": {
        "model": choice("change of state of the air", {"polytropic": Polytropic, "thermal": Thermal}, "polytropic"),
        "mixed": flag("whether inflow, outflow and volume have an exponent each"),
    },
    "ambient": {},
    "load": LOAD_KEYS,
    "friction": FRICTION_KEYS,
}


def _build_drive(sections: DriveSections) -> PneumaticDrive:
    options = sections.options("valve")
    valve = ProportionalValve(options["law"](), options["spool"], Smoothing(**options["smoothing"]))
    cylinder, load = Cylinder(**sections.options("cylinder")), Load(**sections.options("load"))
    return PneumaticDrive(valve, read_friction(sections), load, _read_chamber(sections), cylinder)


def _read_chamber(sections: DriveSections) -> ChamberModel:
    options = sections.options("chamber")
    if options["model"] is Polytropic:
        return Polytropic(options["mixed"])
    message = f"{sections.place('chamber', 'mixed')}: a thermal chamber has no exponents; leave it out"
    require(not sections.has("chamber", "mixed"), message)
    return Thermal()


def _read_nominal_flow(entry: Any, values: Mapping[str, float], where: str) -> float:
    """Conductance [m^3/(s*Pa)] of a nominal flow in l/min(ANR), 6 to 5 bar(g), at the critical ratio in `values`."""
    is_anr = isinstance(entry, str) and entry.strip().endswith("(ANR)")
    advice = 'a nominal flow, 6 to 5 bar(g), is written at ANR (20 degC, 100 kPa): "700 l/min(ANR)"'
    require(is_anr, f"{where}: {entry!r}: {advice}", UnitError)
    flow = read_value(entry.strip().removesuffix("(ANR)"), "m^3/s", where=where)
    require(flow > 0, f"{where}: a flow is positive, got {entry!r}")
    return conductance_of_nominal_flow(flow, values.get(_CRITICAL_RATIO, CRITICAL_RATIO))


PNEUMATIC_KIND = DriveKind(
    PneumaticDrive.kind,
    _SECTIONS,
    _build_drive,
    aliases=(
        Alias(
            "valve",
            "nominal_flow",
            "valve.conductance",
            (_CRITICAL_RATIO,),
            _read_nominal_flow,
            "nominal flow of a catalogue, from 6 to 5 bar(g)",
            "l/min(ANR)",
            '"700 l/min(ANR)"',
        ),
    ),
    first=FirstFiles(
        options={"friction": {"model": "stribeck"}},
        unknowns=("valve.conductance", "valve.dead_zone", *STRIBECK_UNKNOWNS),
        gains={"Kp": (0.5, 0.05, 4), "Ki": (5, 0.5, 60), "Kd": (0, 0, 0.15), "Tf": (5e-3, 2e-3, 0.02)},
        limit=5.0,
        dither=(100.0, 1.5),
        steps=(0.1, 0.25),
        horizon=0.45,
        swept="load.mass",
        values={"cylinder.start": 0.25},
    ),
)
