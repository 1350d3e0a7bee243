"""Sections and keys of a pneumatic drive in a file, with a catalogue's nominal flow in place of a conductance."""

from collections.abc import Mapping
from typing import Any

from pneuopt.models.declaration import Alias, DriveKind, Key, Structure, choice, flag
from pneuopt.models.friction_section import FRICTION_KEYS, read_friction
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
from pneuopt.quantities.errors import UnitError, check_names, require
from pneuopt.quantities.units import read_value

_CRITICAL_RATIO = "valve.critical_ratio"
_SMOOTHING_UNITS = {"corner": "1", "zero": "1", "pressure": "Pa"}
_SECTIONS: Mapping[str, Mapping[str, Key]] = {
    "cylinder": {"stops": flag(True)},
    "valve": {
        "law": choice({"iso6358": Iso6358, "isentropic": IsentropicNozzle}, "iso6358"),
        "spool": choice({spool.name.lower(): spool for spool in Spool}, "second_order"),
        "smoothing": Key("a table", (dict,), {}),
    },
    "supply": {},
    "gas": {},
    "chamber": {"model": choice({"polytropic": Polytropic, "thermal": Thermal}, "polytropic"), "mixed": flag(False)},
    "ambient": {},
    "load": LOAD_KEYS,
    "friction": FRICTION_KEYS,
}


def _build_drive(structure: Structure) -> PneumaticDrive:
    options = structure.options("valve")
    valve = ProportionalValve(options["law"](), options["spool"], _read_smoothing(options["smoothing"], structure))
    cylinder, load = Cylinder(**structure.options("cylinder")), Load(**structure.options("load"))
    return PneumaticDrive(valve, read_friction(structure), load, _read_chamber(structure), cylinder)


def _read_smoothing(table: Mapping[str, Any], structure: Structure) -> Smoothing:
    """Read the rounding of the flow law: smoothing = { corner = 0.02, zero = 1e-3, pressure = "100 Pa" }."""
    where = structure.place("valve", "smoothing")
    check_names("key", table, _SMOOTHING_UNITS, where)
    widths = {n: read_value(v, _SMOOTHING_UNITS[n], where=f"{where}: {n}") for n, v in table.items()}
    for name, width in widths.items():
        require(width > 0, f"{where}: {name} must be positive, got {table[name]}; smaller is sharper and stiffer")
    return Smoothing(**widths)


def _read_chamber(structure: Structure) -> ChamberModel:
    options = structure.options("chamber")
    if options["model"] is Polytropic:
        return Polytropic(options["mixed"])
    message = f"{structure.place('chamber', 'mixed')}: a thermal chamber has no exponents; leave it out"
    require(not structure.has("chamber", "mixed"), message)
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
    aliases=(Alias("valve", "nominal_flow", "valve.conductance", (_CRITICAL_RATIO,), _read_nominal_flow),),
)
