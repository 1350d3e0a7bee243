"""drive.toml, and fit.toml made from it: its keys by the kinds of drive, its reader and its writer; comments kept.

A value is "32 mm", or a table where it may be free: { value = "40 N", lower = "5 N", upper = "90 N", free = true }.
Which kinds of drive there are, and which sections and keys each has, is declared beside the drives.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomlkit

from pneuopt.dynamics.system import System
from pneuopt.files.tolerances import COVARIANCE_ROUNDING, FILE_DIGITS
from pneuopt.files.toml import FileLocations, inline_table, read_parameter, read_toml, toml_table, write_parameter
from pneuopt.identification.checkup import AMBIENT_PRESSURE, DRIVE_FILE, Assumption
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.models.declaration import Alias, Drive, DriveKind, DriveSections, Sections
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import HardwareError, InputError, ModelError, UnknownNameError, check_names, require
from pneuopt.quantities.keys import Key, Takes, choice, parameter_key, table
from pneuopt.quantities.output import plain_value, write_text
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import ATMOSPHERE, count_gauge_from, read_value, write_value

if TYPE_CHECKING:
    import pandas as pd


KIND_KEY = choice("what drives the load", DRIVE_KINDS)
SECTION_MEANINGS: Mapping[str, str] = {
    "cylinder": "the cylinder; positions count from the end at which chamber a is smallest",
    "valve": "the proportional valve: positive voltage opens supply to chamber a",
    "supply": "the air before the valve",
    "gas": "the air itself",
    "chamber": "how the air in the chambers changes its state",
    "ambient": "the surroundings",
    "load": "what is moved",
    "friction": "friction of seals and guides",
    "rig": "the friction rig",
    "plant": "the transfer function",
}
Option = tuple[str, str]
"""Section and key of an option."""


@cache
def drive_keys(name: str) -> Mapping[str, Key]:
    """The sections with all keys that a drive of the kind may have; a key's condition says under which options."""
    kind = DRIVE_KINDS[name]
    sections: dict[str, dict[str, Key]] = {section: dict(keys) for section, keys in kind.sections.items()}
    for alias in kind.aliases:
        sections[alias.section][alias.key] = alias.as_key()
    variants, found = list(_build_variants(kind)), dict[str, Parameter]()
    for variant in variants:
        found = {**variant.parameters, **found}
    for whole, parameter in found.items():
        section, _, key = whole.partition(".")
        condition = _describe_condition(whole, kind, variants)
        sections.setdefault(section, {})[key] = parameter_key(parameter, condition)
    tables = {section: table(SECTION_MEANINGS.get(section, ""), keys) for section, keys in sections.items()}
    return {"drive": table("the kind of drive", {"kind": KIND_KEY}, required=True), **tables}


def usual_plant(kind: DriveKind, sections: Sections) -> System:
    """The plant of a drive that a file's sections describe, with the usual parameters."""
    return kind.build(DriveSections(sections, kind.sections, lambda *_: "")).system()


class _DriveOptions(NamedTuple):
    """A drive with a word for each required option, and at most one other option that is not as usual."""

    words: Mapping[Option, str]
    changed: Option | None
    value: Any
    parameters: ParameterSet


def _build_variants(kind: DriveKind) -> Iterator[_DriveOptions]:
    """Drives that together have every parameter: each law, and of each section one option after the other."""
    known = {(section, key): k for section, keys in kind.sections.items() for key, k in keys.items()}
    needed = {option: tuple(k.choices or ()) for option, k in known.items() if k.required}
    bases = [dict(zip(needed, words, strict=True)) for words in product(*needed.values())]
    changes: list[tuple[Option | None, Any]] = [(None, None)]
    for spot, key in known.items():
        if key.choices is not None and not key.required:
            changes += [(spot, word) for word in key.choices if word != key.usual]
        elif key.takes in (Takes.FLAG, Takes.FLAG_OR_LIST):
            changes.append((spot, not key.usual))
        elif key.takes is Takes.COUNT:
            changes.append((spot, 1))
    for option, value in changes:
        own_laws = option is None or option[0] in (section for section, _ in needed)
        for base in bases if own_laws else bases[:1]:
            try:
                options = base if option is None else {**base, option: value}
                sections = {s: {k: v for (own, k), v in options.items() if own == s} for s, _ in options}
                yield _DriveOptions(base, option, value, usual_plant(kind, sections).parameters)
            except ModelError:  # options that exclude each other
                continue


def _describe_condition(name: str, kind: DriveKind, variants: Sequence[_DriveOptions]) -> str:
    """The options under which a drive has a parameter: 'model = "stribeck" or "lugre"'."""
    parts = []
    for section, keys in kind.sections.items():
        for key, known in keys.items():
            option = (section, key)
            has: dict[Any, bool] = {}  # for each value of the option whether there is the parameter
            if known.required:  # the others as the parameter needs them
                needs = {(v.changed, v.value) for v in variants if name in v.parameters}
                for variant in (v for v in variants if (v.changed, v.value) in needs):
                    word = variant.words[option]
                    has[word] = has.get(word, False) or name in variant.parameters
            elif known.takes is not Takes.COUNT:
                usual = {tuple(v.words.items()): name in v.parameters for v in variants if v.changed is None}
                changed = [(v, usual.get(tuple(v.words.items()), False)) for v in variants if v.changed == option]
                if all((name in v.parameters) == before for v, before in changed):
                    continue  # the option makes no difference
                has[known.usual] = any(before for _, before in changed)
                for variant, _ in changed:
                    has[variant.value] = has.get(variant.value, False) or name in variant.parameters
            if not all(has.values()):
                own = "" if name.startswith(f"{section}.") else f"[{section}] "
                words = (f'"{v}"' if isinstance(v, str) else str(v).lower() for v, there in has.items() if there)
                parts.append(f"{own}{key} = {' or '.join(words)}")
    return " and ".join(parts)


FIT_SECTIONS = ("estimates", "covariance", "agreement", "forecast_error", "status", "verdict", "provenance")
"""Sections that a result adds to a drive's file; reading the drive passes over them."""

_AGREEMENT = ["rmse", "nrmse", "free_run_rmse", "free_run_nrmse", "unit"]
_KNOWN_SECTIONS = {"drive", *(section for kind in DRIVE_KINDS.values() for section in kind.sections)}
_DRIVE_SECTION = {"drive": {"kind": KIND_KEY}}


def read_drive(path: str | Path) -> tuple[Drive, ParameterSet]:
    """Read a drive and its numbers.

    Parameters
    ----------
    path : str or Path
        A drive.toml, or a fit.toml made from one.

    Returns
    -------
    drive : PneumaticDrive, ForceDrive or another
        By [drive] kind and the other sections.
    parameters : ParameterSet
        All of `drive.system().parameters`; one that the file leaves out keeps the model's default.

    Raises
    ------
    InputError
        UnitError, UnknownNameError or other; the message names file, section and key.
    """
    fit = read_fit(path)
    return fit.drive, fit.parameters


@dataclass(frozen=True, eq=False)
class StoredFit:
    """A fit.toml, or the drive.toml that it was made from, parsed once for all that a command needs of it."""

    path: Path
    drive: Drive
    parameters: ParameterSet  # all of `drive.system().parameters`
    # as parsed; the properties raise `InputError` for what pneuopt does not write so
    toml: Mapping[str, Any]

    @property
    def status(self) -> Status | None:
        """How the fit ended; None for a file that no fit has written."""
        return stored_status(self.toml, self.path)

    @property
    def marks(self) -> dict[str, Mark]:
        """How far each estimate can be trusted, by parameter; empty for a file that no fit has written."""
        marks = {n: str(entry["mark"]) for n, entry in self._estimates.items() if "mark" in entry}
        for name, mark in marks.items():
            check_names("mark", [mark], [m.value for m in Mark], f"{self.path}: [estimates] {name}")
        return {n: Mark(mark) for n, mark in marks.items()}

    @property
    def covariance(self) -> "pd.DataFrame | None":
        """Covariance of the estimates, as `IdentificationResult.covariance`, without what the logs do not identify.

        From a file without [covariance] come the variances of its [estimates] alone; None where there are none.
        """
        import pandas as pd

        rows = self.toml.get("covariance")
        if rows is None:
            deviations = {n: e.get("stderr", nan) for n, e in self._estimates.items()}
            known = {n: float(v) for n, v in deviations.items() if isinstance(v, int | float) and isfinite(v)}
            return pd.DataFrame(np.diag(np.square(list(known.values()))), list(known), list(known)) if known else None
        message = f"{self.path}: [covariance] must hold a row of numbers for each of its parameters; run identify again"
        require(isinstance(rows, dict) and all(isinstance(row, list) for row in rows.values()), message)
        try:
            matrix = np.array(list(rows.values()), dtype=float).reshape(len(rows), len(rows))
        except ValueError:
            raise InputError(message) from None
        variances = np.diag(matrix)
        require(bool(np.isfinite(matrix).all() and (variances >= 0).all()), message)
        scale = np.sqrt(np.outer(variances, variances))  # symmetric, with no correlation beyond 1
        require(bool((abs(matrix - matrix.T) <= COVARIANCE_ROUNDING * scale).all()), message)
        require(bool((abs(matrix) <= (1 + COVARIANCE_ROUNDING) * scale).all()), message)
        return pd.DataFrame(matrix, list(rows), list(rows))

    @property
    def forecast_error(self) -> "pd.DataFrame | None":
        """As of `IdentificationResult`; None where the file has none."""
        import pandas as pd

        columns = self.toml.get("forecast_error")
        if columns is None:
            return None
        message = (
            f"{self.path}: [forecast_error] must hold times and an error of each output at each; run identify again"
        )
        try:
            table = pd.DataFrame(columns, dtype=float).set_index("time")
        except (KeyError, TypeError, ValueError):
            raise InputError(message) from None
        rises = bool((np.diff(table.index, prepend=-1.0) > 0).all())
        require(len(table) > 1 and rises and bool((table > 0).all(axis=None)), message)
        return table

    @property
    def estimates(self) -> "pd.DataFrame | None":
        """The estimates with what is uncertain about them; None for a file that no fit has written.

        A row a parameter with stderr, dof and bias as in `IdentificationResult.estimates`; NaN where the file has none.
        """
        import pandas as pd

        columns = ("stderr", "dof", "bias")
        table = pd.DataFrame.from_dict(self._estimates, orient="index").reindex(columns=columns)
        return table.apply(pd.to_numeric, errors="coerce") if self._estimates else None

    @property
    def noise(self) -> dict[str, float]:
        """Of each channel of the logs the larger of noise and residuals, the median over the logs [SI]."""
        levels: dict[str, list[float]] = {}
        for channels in self.toml.get("agreement", {}).values():
            for name, row in channels.items() if isinstance(channels, dict) else ():
                fields = row if isinstance(row, dict) else {}
                own = [fields[k] for k in ("noise", "rmse") if isinstance(fields.get(k), int | float)]
                levels.setdefault(str(name), []).extend([max(own)] if own else [])
        return {n: float(np.median(own)) for n, own in levels.items() if own}

    @property
    def assumed_options(self) -> tuple[Assumption, ...]:
        """The options of the drive that the file leaves out; those of parameters: `list_assumptions`."""
        return tuple(
            Assumption(f"{section}.{name}", key.usual, "", f"[{section}] {name}", DRIVE_FILE, key.meaning)
            for section, keys in DRIVE_KINDS[self.drive.kind].sections.items()
            if section in self.toml or not any(key.required for key in keys.values())
            for name, key in keys.items()
            if name not in self.toml.get(section, {}) and isinstance(key.usual, str | bool)
        )

    @property
    def _estimates(self) -> dict[str, Mapping[str, Any]]:
        rows = self.toml.get("estimates", {})
        require(isinstance(rows, dict), f"{self.path}: estimates must be a section, [estimates]")
        return {str(n): row for n, row in rows.items() if isinstance(row, dict)}


def read_fit(path: str | Path) -> StoredFit:
    """Read a fit.toml or a drive.toml; errors as for `read_drive`."""
    document = read_toml(path)
    places = FileLocations(path, document.as_string())
    sections = {name: section for name, section in document.unwrap().items() if name not in FIT_SECTIONS}
    for name, section in sections.items():
        check_names("section", [name], _KNOWN_SECTIONS, places.location(name))
        require(isinstance(section, dict), f"{places.location(name)}: {name} must be a section, [{name}]")
    kind: DriveKind = DriveSections(sections, _DRIVE_SECTION, places.location).options("drive")["kind"]
    try:
        drive = kind.build(DriveSections(sections, kind.sections, places.location))
        system = drive.system()
    except ModelError as error:  # a law that asks for what its base, or this plant, has not
        raise ModelError(f"{places.location('friction')}: [friction]: {error}") from None
    return StoredFit(Path(path), drive, _read_parameters(system, kind, sections, places), document.unwrap())


def ambient_pressure(parameters: ParameterSet) -> float:
    """What gauge pressures of a drive and its logs count from [Pa]: its ambient, or the standard atmosphere."""
    return parameters.value(AMBIENT_PRESSURE) if AMBIENT_PRESSURE in parameters else ATMOSPHERE


def read_status(path: str | Path) -> Status | None:
    """How the fit or the tuning in a file ended; None for a file that no result has written."""
    return stored_status(read_toml(path).unwrap(), path)


def stored_status(toml: Mapping[str, Any], path: str | Path) -> Status | None:
    """The status in a parsed file; see `read_status`."""
    stated = toml.get("status")
    if stated is None:
        return None
    codes = [code.value for code in Code]
    require(isinstance(stated, dict), f"{path}: status must be a section, [status]")
    check_names("status", [str(stated.get("code"))], codes, f"{path}: [status] code")
    return Status(Code(stated["code"]), tuple(filter(None, [str(stated.get("message", ""))])))


def write_fit(path: str | Path, source: str | Path, result: IdentificationResult) -> None:
    """Write a drive's file with the values found: the user's text and comments, [estimates], [covariance], ...

    An unidentifiable parameter keeps its given value and text (see `IdentificationResult`).

    Parameters
    ----------
    path : str or Path
        `read_drive` reads it; a result that did not converge is written, too, and `read_status` says so.
    source : str or Path
        The drive.toml that the result was made from.
    result : IdentificationResult

    Raises
    ------
    InputError
        If one of the files cannot be read or written.
    """
    document, (drive, given) = read_toml(source), read_drive(source)
    for alias in DRIVE_KINDS[drive.kind].aliases:
        # what an alias says is wrong once its parameter, or one that it is converted by, is estimated
        is_wrong = any(n in given and result.parameters[n] != given[n] for n in (alias.parameter, *alias.uses))
        section: Any = document.get(alias.section, {})
        if is_wrong and section.pop(alias.key, None) is not None:
            given |= drive.system().parameters.select([alias.parameter])
    if AMBIENT_PRESSURE in given and result.parameters[AMBIENT_PRESSURE].value != given.value(AMBIENT_PRESSURE):
        _write_absolute(document, given)
    for name, found in result.parameters.items():
        if name in given and found != given[name]:
            write_parameter(document, name, found, given[name])
    rows = result.estimates.to_dict(orient="index")
    document["estimates"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    covariance = result.covariance
    known = [n for n in covariance.index if np.isfinite(covariance.to_dict()[n][n])]  # the others have none
    document["covariance"] = toml_table({str(n): covariance.loc[n, known].to_list() for n in known})
    logs = result.fit[_AGREEMENT].groupby(level="log", sort=False) if len(result.fit) else ()
    agreement = {str(log): rows.droplevel("log").to_dict(orient="index") for log, rows in logs}
    document["agreement"] = toml_table(
        {log: toml_table({str(c): inline_table(row) for c, row in own.items()}) for log, own in agreement.items()}
    )
    if result.forecast_error is not None:
        document["forecast_error"] = toml_table(
            {str(n): column for n, column in result.forecast_error.reset_index().to_dict(orient="list").items()}
        )
    document["status"] = toml_table({"code": result.status.code.value, "message": result.status.message})
    if result.verdict is not None:
        document["verdict"] = toml_table(result.verdict.to_dict())
    document["provenance"] = toml_table(plain_value(result.provenance))
    write_text(path, tomlkit.dumps(document))


def _write_absolute(document: tomlkit.TOMLDocument, given: ParameterSet) -> None:
    """Write gauge pressures as absolute ones, for a found ambient pressure is another zero than the one they had."""
    for name, p in given.items():
        section, _, key = name.partition(".")
        entries: Any = document.get(section, {})
        stated = entries.get(key)
        if isinstance(stated, dict):
            for part in ("value", "lower", "upper"):
                if "(g)" in str(stated.get(part)):
                    stated[part] = write_value(getattr(p, part), p.unit, FILE_DIGITS)
        elif "(g)" in str(stated):
            entries[key] = write_value(p.value, p.unit, FILE_DIGITS)


def _read_parameters(system: System, kind: DriveKind, sections: Sections, places: FileLocations) -> ParameterSet:
    defaults = system.parameters
    known = {"drive", *(name.partition(".")[0] for name in defaults)}
    for section, stated in sections.items():
        if section not in known:
            raise UnknownNameError("section", section, known, f"{places.location(section)}: kind {kind.name!r}")
        structure = {**_DRIVE_SECTION, **kind.sections}.get(section, {})
        keys = [name.partition(".")[2] for name in defaults if name.startswith(f"{section}.")]
        others = [alias.key for alias in kind.aliases if alias.section == section]
        for key in stated:
            check_names("key", [key], [*structure, *keys, *others], f"{places.location(section, key)}: [{section}]")
    entries = {f"{s}.{k}": v for s, stated in sections.items() for k, v in stated.items() if f"{s}.{k}" in defaults}

    def read(name: str) -> Parameter:
        return read_parameter(entries[name], defaults[name], _parameter_place(name, places))

    zero = read(AMBIENT_PRESSURE).value if AMBIENT_PRESSURE in entries else ambient_pressure(defaults)
    with count_gauge_from(zero):
        _check_hardware(system, entries, places)
        for alias in kind.aliases:
            entries |= _read_alias(alias, sections, entries, defaults, places)
        edits = {name: read(name) for name in entries}
    return defaults | ParameterSet({name: edits[name] for name in defaults if name in edits})


def _check_hardware(system: System, entries: Mapping[str, Any], places: FileLocations) -> None:
    """Refuse impossible values first, for the model's bounds do not say what would be possible."""
    stated = {n: entry.get("value") if isinstance(entry, dict) else entry for n, entry in entries.items()}
    units = {n: system.parameters[n].unit for n in stated}
    given = {n: read_value(v, units[n], where=_parameter_place(n, places)) for n, v in stated.items() if v is not None}
    try:
        system.check(system.parameters | ParameterSet({n: Parameter(v, units[n]) for n, v in given.items()}))
    except HardwareError as error:
        if error.parameter not in given:
            raise InputError(f"{places}: {error} (the model's own value; the file has none)") from None
        written = f"{_parameter_place(error.parameter, places)} = {tomlkit.item(stated[error.parameter]).as_string()}"
        raise InputError(f"{written} is impossible; {error.remedy}") from None


def _read_alias(
    alias: Alias, sections: Sections, entries: Mapping[str, Any], defaults: ParameterSet, places: FileLocations
) -> dict[str, Any]:
    """The entry of the parameter that an alias says; nothing where the file does not hold the alias."""
    stated = sections.get(alias.section, {}).get(alias.key)
    if stated is None:
        return {}
    where, own = _parameter_place(f"{alias.section}.{alias.key}", places), alias.parameter.partition(".")[2]
    require(alias.parameter not in entries, f"{where} and {own} say the same; leave one of them out")
    values = {
        n: read_parameter(entries[n], defaults[n], _parameter_place(n, places)).value
        if n in entries
        else defaults.value(n)
        for n in alias.uses
        if n in defaults
    }

    def convert(entry: Any) -> str:
        return f"{alias.convert(entry, values, where)!r} {defaults[alias.parameter].unit}"

    fields = stated if isinstance(stated, dict) else {"value": stated}
    return {alias.parameter: {f: convert(v) if f in ("value", "lower", "upper") else v for f, v in fields.items()}}


def _parameter_place(name: str, places: FileLocations) -> str:
    """Of a parameter: file, line, section and key."""
    section, _, key = name.partition(".")
    return f"{places.location(section, key)}: [{section}] {key}"
