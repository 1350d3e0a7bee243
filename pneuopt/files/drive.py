"""Files that people edit: drive.toml, and fit.toml made from it; whole or not at all, comments kept.

A value is "32 mm", or a table where it may be free: { value = "40 N", lower = "5 N", upper = "90 N", free = true }.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import tomlkit

from pneuopt.dynamics.system import System
from pneuopt.files.toml import FileLocations, inline_table, read_parameter, read_toml, toml_table, write_parameter
from pneuopt.logs.experiments import CHANNELS
from pneuopt.models.drive import FORCE, POSITION, ForceDrive, MotionDrive
from pneuopt.models.friction import Asymmetric, Coulomb, FrictionModel, LuGre, PressureDependent, Stribeck, Viscous
from pneuopt.models.linear import SPEED, VALVE_VOLTAGE, FirstOrder, Integrator, SecondOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic.chamber import ChamberModel, Polytropic, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import (
    CRITICAL_RATIO,
    FlowLaw,
    IsentropicNozzle,
    Iso6358,
    Smoothing,
    conductance_of_nominal_flow,
)
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.quantities.errors import HardwareError, InputError, UnitError, UnknownNameError, check_names, require
from pneuopt.quantities.output import plain_value, write_text
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import read_value

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.identification.identifiability import Verdict

DriveSections = Mapping[str, Mapping[str, Any]]

FRICTION_MODELS: Mapping[str, Callable[[], FrictionModel]] = {
    "viscous": Viscous,
    "coulomb": Coulomb,
    "stribeck": Stribeck,
    "lugre": LuGre,
}
FLOW_LAWS: Mapping[str, Callable[[], FlowLaw]] = {"iso6358": Iso6358, "isentropic": IsentropicNozzle}
SPOOL_MODELS = {spool.name.lower(): spool for spool in Spool}
LINEAR_PLANTS = ("first_order", "second_order", "integrator")
CHAMBER_PRESSURES = ("pressure_a", "pressure_b")
NOMINAL_FLOW_KEY, CONDUCTANCE_NAME, CRITICAL_RATIO_NAME = "nominal_flow", "valve.conductance", "valve.critical_ratio"
FIT_SECTIONS = ("estimates", "status", "verdict", "provenance")
"""Sections that a result adds to a drive's file; reading the drive passes over them."""

# What a section says about the drive's structure; every other key of it is a parameter.
_DRIVE_STRUCTURE: DriveSections = {
    "drive": {"kind": "text"},
    "cylinder": {"stops": "true or false"},
    "valve": {"law": "text", "spool": "text", "smoothing": "a table", "nominal_flow": "text or a table"},
    "supply": {},
    "gas": {},
    "chamber": {"model": "text", "mixed": "true or false"},
    "ambient": {},
    "load": {"spring": "true or false", "inclined": "true or false"},
    "friction": {"model": "text", "asymmetric": "true or false", "pressure_dependent": "true, false or a list"},
    "plant": {"model": "text", "input": "text", "output": "text", "pade_order": "a whole number"},
    "rig": {"chamber": "true or false"},
}
_SMOOTHING_UNITS = {"corner": "1", "zero": "1", "pressure": "Pa"}
_STRUCTURE_TYPES: Mapping[str, tuple[type, ...]] = {
    "text": (str,),
    "true or false": (bool,),
    "true, false or a list": (bool, list),
    "a whole number": (int,),
    "a table": (dict,),
    "text or a table": (str, dict),
}


class Drive(Protocol):
    """What a drive.toml describes."""

    def system(self) -> System:
        """Its equations, with every parameter's default."""
        ...


class WritableFit(Protocol):
    """What `write_fit` needs of a result."""

    @property
    def parameters(self) -> ParameterSet:
        """All parameters, the free ones as found."""
        ...

    @property
    def estimates(self) -> "pd.DataFrame":
        """A row a free parameter."""
        ...

    @property
    def status(self) -> Status:
        """How it ended."""
        ...

    @property
    def verdict(self) -> "Verdict | None":
        """What the logs do not tell, and why."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Versions, options, the data's sha256."""
        ...


def read_drive(path: str | Path) -> tuple[Drive, ParameterSet]:
    """Read a drive and its numbers.

    Parameters
    ----------
    path : str or Path
        A drive.toml, or a fit.toml made from one.

    Returns
    -------
    drive : PneumaticDrive, ForceDrive, MotionDrive, FirstOrder, SecondOrder or Integrator
        By [drive] kind and the other sections.
    parameters : ParameterSet
        All of `drive.system().parameters`; one that the file leaves out keeps the model's default.

    Raises
    ------
    InputError
        UnitError, UnknownNameError or other; the message names file, section and key.
    """
    document = read_toml(path)
    places = FileLocations(path, document.as_string())
    sections = {name: section for name, section in document.unwrap().items() if name not in FIT_SECTIONS}
    for name, section in sections.items():
        check_names("section", [name], _DRIVE_STRUCTURE, places.location(name))
        require(isinstance(section, dict), f"{places.location(name)}: {name} must be a section, [{name}]")
    drive = _build_drive(sections, places)
    return drive, _read_parameters(drive.system(), sections, places)


def read_status(path: str | Path) -> Status | None:
    """How the fit in a file ended; None for a file that no fit has written.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Status or None

    Raises
    ------
    InputError
        If the status is none that pneuopt writes.
    """
    said = read_toml(path).unwrap().get("status")
    if said is None:
        return None
    codes = [code.value for code in Code]
    require(isinstance(said, dict), f"{path}: status must be a section, [status]")
    check_names("status", [str(said.get("code"))], codes, f"{path}: [status] code")
    return Status(Code(said["code"]), str(said.get("message", "")))


def write_fit(path: str | Path, source: str | Path, result: WritableFit) -> None:
    """Write a drive's file with the values found: the user's text and comments, [estimates], [status], [verdict], ...

    A parameter that the logs do not tell keeps its given value and text (see `IdentificationResult`).

    Parameters
    ----------
    path : str or Path
        `read_drive` reads it; a result that did not converge is written, too, and `read_status` says so.
    source : str or Path
        The drive.toml that the result was made from.
    result : Fitted
        An `IdentificationResult`, say.

    Raises
    ------
    InputError
        If one of the files cannot be read or written.
    """
    document, (drive, given) = read_toml(source), read_drive(source)
    if any(n in given and result.parameters[n] != given[n] for n in (CONDUCTANCE_NAME, CRITICAL_RATIO_NAME)):
        given = _without_nominal_flow(document, drive, given)
    for name, found in result.parameters.items():
        if name in given and found != given[name]:
            write_parameter(document, name, found, given[name])
    rows = result.estimates.to_dict(orient="index")
    document["estimates"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    document["status"] = toml_table({"code": result.status.code.value, "message": result.status.message})
    if result.verdict is not None:
        document["verdict"] = toml_table(result.verdict.to_dict())
    document["provenance"] = toml_table(plain_value(result.provenance))
    write_text(path, tomlkit.dumps(document))


def _without_nominal_flow(document: tomlkit.TOMLDocument, drive: Drive, given: ParameterSet) -> ParameterSet:
    """Once the conductance or the critical ratio is estimated, a nominal flow no longer says both; drop it."""
    valve: Any = document.get("valve", {})
    if NOMINAL_FLOW_KEY not in valve:
        return given
    valve.remove(NOMINAL_FLOW_KEY)
    return given | drive.system().parameters.select([CONDUCTANCE_NAME])


def _build_drive(sections: DriveSections, places: FileLocations) -> Drive:
    for name, known in _DRIVE_STRUCTURE.items():
        for key in known.keys() & sections.get(name, {}).keys():
            right = type(sections[name][key]) in _STRUCTURE_TYPES[known[key]]
            require(
                right, f"{places.location(name, key)}: [{name}] {key} must be {known[key]}, got {sections[name][key]!r}"
            )
    kind = _read_choice(sections, "drive", "kind", _DRIVE_KINDS, places)
    return _DRIVE_KINDS[kind](sections, places)


def _pneumatic_drive(sections: DriveSections, places: FileLocations) -> Drive:
    law = FLOW_LAWS[_read_choice(sections, "valve", "law", FLOW_LAWS, places, "iso6358")]()
    spool = SPOOL_MODELS[_read_choice(sections, "valve", "spool", SPOOL_MODELS, places, "second_order")]
    valve = ProportionalValve(law, spool, _smoothing(sections, places))
    cylinder = Cylinder(**_structure_options(sections, "cylinder"))
    return PneumaticDrive(valve, _friction(sections, places), _load(sections), _chamber(sections, places), cylinder)


def _smoothing(sections: DriveSections, places: FileLocations) -> Smoothing:
    """How the orifice's law is rounded: smoothing = { corner = 0.02, zero = 1e-3, pressure = "100 Pa" }."""
    said, where = (
        sections.get("valve", {}).get("smoothing", {}),
        f"{places.location('valve', 'smoothing')}: [valve] smoothing",
    )
    check_names("key", said, _SMOOTHING_UNITS, where)
    widths = {n: read_value(v, _SMOOTHING_UNITS[n], where=f"{where}: {n}") for n, v in said.items()}
    for name, width in widths.items():
        require(width > 0, f"{where}: {name} must be positive, got {said[name]}; smaller is sharper and stiffer")
    return Smoothing(**widths)


def _chamber(sections: DriveSections, places: FileLocations) -> ChamberModel:
    said = _structure_options(sections, "chamber")
    if _read_choice(sections, "chamber", "model", ("polytropic", "thermal"), places, "polytropic") == "polytropic":
        return Polytropic(said.get("mixed", False))
    require(
        "mixed" not in said,
        f"{places.location('chamber', 'mixed')}: [chamber] mixed: a thermal chamber has no exponents; leave it out",
    )
    return Thermal()


def _force_drive(sections: DriveSections, places: FileLocations) -> Drive:
    return ForceDrive(_friction(sections, places), _load(sections))


def _load(sections: DriveSections) -> Load:
    return Load(**_structure_options(sections, "load"))


def _motion_drive(sections: DriveSections, places: FileLocations) -> Drive:
    return MotionDrive(_friction(sections, places), chamber=sections.get("rig", {}).get("chamber", True))


def _linear_plant(sections: DriveSections, places: FileLocations) -> Drive:
    plant = sections.get("plant", {})
    model = _read_choice(sections, "plant", "model", LINEAR_PLANTS, places)
    signals = [plant.get("input", "valve_voltage"), plant.get("output", "speed")]
    check_names("channel", signals, CHANNELS, f"{places.location('plant')}: [plant]")
    known = {q.name: q for q in (VALVE_VOLTAGE, SPEED, POSITION, FORCE)}
    u, y = (known.get(name, Quantity(name, CHANNELS[name])) for name in signals)
    # Order 3 follows a delay up to 4.6 rad of phase and adds three states; 0 leaves the dead time out.
    order = plant.get("pade_order", 3 if "dead_time" in plant else 0)
    if model == "second_order":
        return SecondOrder(order, _friction(sections, places) if "friction" in sections else None, u, y)
    return (FirstOrder if model == "first_order" else Integrator)(order, u, y)


_DRIVE_KINDS: Mapping[str, Callable[[DriveSections, FileLocations], Drive]] = {
    "pneumatic": _pneumatic_drive,
    "force": _force_drive,
    "motion": _motion_drive,
    "linear": _linear_plant,
}


def _structure_options(sections: DriveSections, name: str) -> dict[str, Any]:
    """What a section says of the structure."""
    return {key: value for key, value in sections.get(name, {}).items() if key in _DRIVE_STRUCTURE[name]}


def _friction(sections: DriveSections, places: FileLocations) -> FrictionModel:
    said = sections.get("friction", {})
    model = FRICTION_MODELS[_read_choice(sections, "friction", "model", FRICTION_MODELS, places)]()
    if said.get("asymmetric", False):
        model = Asymmetric(model)
    dependent = said.get("pressure_dependent", False)
    if not dependent:
        return model
    chambers = CHAMBER_PRESSURES if dependent is True else tuple(dependent)
    check_names(
        "chamber",
        chambers,
        CHAMBER_PRESSURES,
        f"{places.location('friction', 'pressure_dependent')}: [friction] pressure_dependent",
    )
    return PressureDependent(model, chambers)


def _read_choice(
    sections: DriveSections,
    section: str,
    key: str,
    known: Sequence[str] | Mapping[str, Any],
    places: FileLocations,
    usual: str | None = None,
) -> str:
    value = sections.get(section, {}).get(key, usual)
    if value is None:
        raise InputError(
            f'{places.location(section)}: [{section}] says no {key}; write {key} = "...", one of: {", ".join(known)}'
        )
    check_names(key, [value], known, f"{places.location(section, key)}: [{section}]")
    return str(value)


def _read_parameters(system: System, sections: DriveSections, places: FileLocations) -> ParameterSet:
    defaults, edits = system.parameters, dict[str, Parameter]()
    known = {name.partition(".")[0] for name in defaults} | {"drive"}
    known |= {name for name in ("friction", "plant") if any(n.startswith(f"{name}.") for n in defaults)}
    for section, entries in sections.items():
        if section not in known:
            where = f"{places.location(section)}: kind {sections['drive']['kind']!r}"
            raise UnknownNameError("section", section, known, where)
        structure = _DRIVE_STRUCTURE.get(section, {})
        keys = [name.partition(".")[2] for name in defaults if name.startswith(f"{section}.")]
        for key in entries:
            check_names("key", [key], [*structure, *keys], f"{places.location(section, key)}: [{section}]")
    entries = {f"{s}.{k}": v for s, said in sections.items() for k, v in said.items() if f"{s}.{k}" in defaults}
    _check_hardware(system, entries, places)
    entries |= _nominal_conductance(sections, entries, defaults, places)
    for name, entry in entries.items():
        edits[name] = read_parameter(entry, defaults[name], _parameter_place(name, places))
    return defaults | ParameterSet({name: edits[name] for name in defaults if name in edits})


def _check_hardware(system: System, entries: Mapping[str, Any], places: FileLocations) -> None:
    """Refuse impossible values first, for the model's bounds do not say what would be possible."""
    said = {n: entry.get("value") if isinstance(entry, dict) else entry for n, entry in entries.items()}
    units = {n: system.parameters[n].unit for n in said}
    given = {n: read_value(v, units[n], where=_parameter_place(n, places)) for n, v in said.items() if v is not None}
    try:
        system.check(system.parameters | ParameterSet({n: Parameter(v, units[n]) for n, v in given.items()}))
    except HardwareError as error:
        if error.parameter not in given:
            raise InputError(f"{places}: {error} (the model's own value; the file says none)") from None
        written = f"{_parameter_place(error.parameter, places)} = {tomlkit.item(said[error.parameter]).as_string()}"
        raise InputError(f"{written} is impossible; {error.remedy}") from None


def _nominal_conductance(
    sections: DriveSections, entries: Mapping[str, Any], defaults: ParameterSet, places: FileLocations
) -> dict[str, Any]:
    """The conductance that [valve] nominal_flow means: 6 to 5 bar(g), in l/min(ANR), at the critical ratio given."""
    said, where = (
        sections.get("valve", {}).get(NOMINAL_FLOW_KEY),
        f"{places.location('valve', NOMINAL_FLOW_KEY)}: [valve] {NOMINAL_FLOW_KEY}",
    )
    if said is None:
        return {}
    require(CONDUCTANCE_NAME not in entries, f"{where} and conductance say the same; leave one of them out")
    b = CRITICAL_RATIO
    if CRITICAL_RATIO_NAME in defaults:
        b = read_parameter(
            entries.get(CRITICAL_RATIO_NAME, defaults.value(CRITICAL_RATIO_NAME)),
            defaults[CRITICAL_RATIO_NAME],
            _parameter_place(CRITICAL_RATIO_NAME, places),
        ).value

    def conductance(text: Any) -> str:
        is_anr = isinstance(text, str) and text.strip().endswith("(ANR)")
        remedy = 'a nominal flow, 6 to 5 bar(g), is written at ANR (20 degC, 100 kPa): "700 l/min(ANR)"'
        require(is_anr, f"{where}: {text!r}: {remedy}", UnitError)
        flow = read_value(text.strip().removesuffix("(ANR)"), "m^3/s", where=where)
        require(flow > 0, f"{where}: a flow is positive, got {text!r}")
        return f"{conductance_of_nominal_flow(flow, b)!r} {defaults[CONDUCTANCE_NAME].unit}"

    fields = said if isinstance(said, dict) else {"value": said}
    flows = ("value", "lower", "upper")
    return {CONDUCTANCE_NAME: {f: conductance(v) if f in flows else v for f, v in fields.items()}}


def _parameter_place(name: str, places: FileLocations) -> str:
    """Of a parameter: file, line, section and key."""
    section, _, key = name.partition(".")
    return f"{places.location(section, key)}: [{section}] {key}"
