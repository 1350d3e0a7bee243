"""Files that people edit: drive.toml, and fit.toml made from it; whole or not at all, comments kept.

A value is "32 mm", or a table where it may be free: { value = "40 N", lower = "5 N", upper = "90 N", free = true }.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import tomlkit

from pneuopt.errors import InputError, UnknownNameError, check_known, require
from pneuopt.experiments import CHANNELS
from pneuopt.models.chamber import ChamberModel, Polytropic, Thermal
from pneuopt.models.cylinder import Cylinder
from pneuopt.models.drive import FORCE, POSITION, ForceDrive, MotionDrive
from pneuopt.models.friction import Asymmetric, Coulomb, FrictionModel, LuGre, PressureDependent, Stribeck, Viscous
from pneuopt.models.gas import FlowLaw, IsentropicNozzle, Iso6358
from pneuopt.models.linear import SPEED, VALVE_VOLTAGE, FirstOrder, Integrator, SecondOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic_drive import PneumaticDrive
from pneuopt.models.valve import ProportionalValve, Spool
from pneuopt.nlp.status import Code, Status
from pneuopt.output import plain, write_text
from pneuopt.parameters import Parameter, ParameterSet, Quantity
from pneuopt.system import System
from pneuopt.tomlfile import inline_table, read_parameter, read_toml, toml_table, write_parameter

if TYPE_CHECKING:
    import pandas as pd

Sections = Mapping[str, Mapping[str, Any]]

FRICTION: Mapping[str, Callable[[], FrictionModel]] = {
    "viscous": Viscous,
    "coulomb": Coulomb,
    "stribeck": Stribeck,
    "lugre": LuGre,
}
LAWS: Mapping[str, Callable[[], FlowLaw]] = {"iso6358": Iso6358, "isentropic": IsentropicNozzle}
SPOOLS = {spool.name.lower(): spool for spool in Spool}
PLANTS = ("first_order", "second_order", "integrator")
CHAMBERS = ("pressure_a", "pressure_b")
RESULTS = ("estimates", "status", "provenance")
"""Sections that a result adds to a drive's file; reading the drive passes over them."""

# What a section says about the drive's structure; every other key of it is a parameter.
_STRUCTURE: Sections = {
    "drive": {"kind": "text"},
    "cylinder": {"stops": "true or false"},
    "valve": {"law": "text", "spool": "text"},
    "supply": {},
    "gas": {},
    "chamber": {"model": "text", "mixed": "true or false"},
    "ambient": {},
    "load": {"spring": "true or false", "inclined": "true or false"},
    "friction": {"model": "text", "asymmetric": "true or false", "pressure_dependent": "true, false or a list"},
    "plant": {"model": "text", "input": "text", "output": "text", "pade_order": "a whole number"},
    "rig": {"chamber": "true or false"},
}
_TYPES: Mapping[str, tuple[type, ...]] = {
    "text": (str,),
    "true or false": (bool,),
    "true, false or a list": (bool, list),
    "a whole number": (int,),
}


class Drive(Protocol):
    """What a drive.toml describes."""

    def system(self) -> System:
        """Its equations, with every parameter's default."""
        ...


class Fitted(Protocol):
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
    said = read_toml(path).unwrap()
    sections = {name: section for name, section in said.items() if name not in RESULTS}
    check_known("section", sections, _STRUCTURE, str(path))
    for name, section in sections.items():
        require(isinstance(section, dict), f"{path}: {name} must be a section, [{name}]")
    drive = _build(sections, path)
    parameters = _filled(drive.system().parameters, sections, path)
    if isinstance(drive, PneumaticDrive):
        _check(drive, parameters, path)
    return drive, parameters


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
    check_known("status", [str(said.get("code"))], codes, f"{path}: [status] code")
    return Status(Code(said["code"]), str(said.get("message", "")))


def write_fit(path: str | Path, source: str | Path, result: Fitted) -> None:
    """Write a drive's file with the values found: the user's text and comments, [estimates], [status], [provenance].

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
    document, given = read_toml(source), read_drive(source)[1]
    for name, found in result.parameters.items():
        if name in given and found != given[name]:
            write_parameter(document, name, found, given[name])
    rows = result.estimates.to_dict(orient="index")
    document["estimates"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    document["status"] = toml_table({"code": result.status.code.value, "message": result.status.message})
    document["provenance"] = toml_table(plain(result.provenance))
    write_text(path, tomlkit.dumps(document))


def _build(sections: Sections, path: str | Path) -> Drive:
    for name, known in _STRUCTURE.items():
        for key in known.keys() & sections.get(name, {}).keys():
            right = type(sections[name][key]) in _TYPES[known[key]]
            require(right, f"{path}: [{name}] {key} must be {known[key]}, got {sections[name][key]!r}")
    kind = _choice(sections, "drive", "kind", _KINDS, path)
    return _KINDS[kind](sections, path)


def _check(drive: PneumaticDrive, parameters: ParameterSet, path: str | Path) -> None:
    try:
        drive.check(parameters)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _pneumatic(sections: Sections, path: str | Path) -> Drive:
    law = LAWS[_choice(sections, "valve", "law", LAWS, path, "iso6358")]()
    spool = SPOOLS[_choice(sections, "valve", "spool", SPOOLS, path, "second_order")]
    cylinder = Cylinder(**_said(sections, "cylinder"))
    return PneumaticDrive(
        ProportionalValve(law, spool), _friction(sections, path), _load(sections), _chamber(sections, path), cylinder
    )


def _chamber(sections: Sections, path: str | Path) -> ChamberModel:
    said = _said(sections, "chamber")
    if _choice(sections, "chamber", "model", ("polytropic", "thermal"), path, "polytropic") == "polytropic":
        return Polytropic(said.get("mixed", False))
    require("mixed" not in said, f"{path}: [chamber] mixed: a thermal chamber has no exponents; leave it out")
    return Thermal()


def _force(sections: Sections, path: str | Path) -> Drive:
    return ForceDrive(_friction(sections, path), _load(sections))


def _load(sections: Sections) -> Load:
    return Load(**_said(sections, "load"))


def _motion(sections: Sections, path: str | Path) -> Drive:
    return MotionDrive(_friction(sections, path), chamber=sections.get("rig", {}).get("chamber", True))


def _linear(sections: Sections, path: str | Path) -> Drive:
    plant = sections.get("plant", {})
    model = _choice(sections, "plant", "model", PLANTS, path)
    signals = [plant.get("input", "valve_voltage"), plant.get("output", "speed")]
    check_known("channel", signals, CHANNELS, f"{path}: [plant]")
    known = {q.name: q for q in (VALVE_VOLTAGE, SPEED, POSITION, FORCE)}
    u, y = (known.get(name, Quantity(name, CHANNELS[name])) for name in signals)
    # Order 3 follows a delay up to 4.6 rad of phase and adds three states; 0 leaves the dead time out.
    order = plant.get("pade_order", 3 if "dead_time" in plant else 0)
    if model == "second_order":
        return SecondOrder(order, _friction(sections, path) if "friction" in sections else None, u, y)
    return (FirstOrder if model == "first_order" else Integrator)(order, u, y)


_KINDS: Mapping[str, Callable[[Sections, str | Path], Drive]] = {
    "pneumatic": _pneumatic,
    "force": _force,
    "motion": _motion,
    "linear": _linear,
}


def _said(sections: Sections, name: str) -> dict[str, Any]:
    """What a section says of the structure."""
    return {key: value for key, value in sections.get(name, {}).items() if key in _STRUCTURE[name]}


def _friction(sections: Sections, path: str | Path) -> FrictionModel:
    said = sections.get("friction", {})
    model = FRICTION[_choice(sections, "friction", "model", FRICTION, path)]()
    if said.get("asymmetric", False):
        model = Asymmetric(model)
    dependent = said.get("pressure_dependent", False)
    if not dependent:
        return model
    chambers = CHAMBERS if dependent is True else tuple(dependent)
    check_known("chamber", chambers, CHAMBERS, f"{path}: [friction] pressure_dependent")
    return PressureDependent(model, chambers)


def _choice(
    sections: Sections,
    section: str,
    key: str,
    known: Sequence[str] | Mapping[str, Any],
    path: str | Path,
    usual: str | None = None,
) -> str:
    value = sections.get(section, {}).get(key, usual)
    if value is None:
        raise InputError(f'{path}: [{section}] says no {key}; write {key} = "...", one of: {", ".join(known)}')
    check_known(key, [value], known, f"{path}: [{section}]")
    return str(value)


def _filled(defaults: ParameterSet, sections: Sections, path: str | Path) -> ParameterSet:
    known = {name.partition(".")[0] for name in defaults} | {"drive"}
    known |= {name for name in ("friction", "plant") if any(n.startswith(f"{name}.") for n in defaults)}
    edits: dict[str, Parameter] = {}
    for section, entries in sections.items():
        if section not in known:
            raise UnknownNameError("section", section, known, f"{path}: kind {sections['drive']['kind']!r}")
        structure = _STRUCTURE.get(section, {})
        keys = [name.partition(".")[2] for name in defaults if name.startswith(f"{section}.")]
        check_known("key", entries, [*structure, *keys], f"{path}: [{section}]")
        for key in (k for k in entries if k not in structure):
            name = f"{section}.{key}"
            edits[name] = read_parameter(entries[key], defaults[name], f"{path}: [{section}] {key}")
    return defaults | ParameterSet({name: edits[name] for name in defaults if name in edits})
