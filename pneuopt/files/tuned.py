"""tuned.toml: a tuning's file with the gains found and their certificate, and whether that certificate still holds.

Section [checksum] holds what the certificate is about, as it was parsed: the controller with its gains, the plant, the
references, limits and scenarios, and a hash of all that, of the certificate's figures and of its status. Comments, the
order of keys and the units in which a value is written do not matter. `check_certificate` computes it anew from the
files as they are. It is a checksum against mistakes, not a signature: whoever wants to can compute another.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from math import isclose
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from tomlkit.items import Table

from pneuopt.evaluation.evaluate import metric_limits
from pneuopt.evaluation.response import cases
from pneuopt.files.drive import StoredFit, read_fit, stored_status
from pneuopt.files.loop import (
    LOOP_KEYS,
    NO_HUNTING_KEY,
    REFERENCE_KEYS,
    REQUIREMENTS_BY_KEY,
    SCENARIO_KEYS,
    TUNABLE_SECTIONS,
    bound_units,
    read_draw,
    read_sample_spreads,
    read_spreads,
    signal_units_of,
)
from pneuopt.files.tolerances import CHECKSUM_DIGITS, FILE_DIGITS
from pneuopt.files.toml import inline_table, put_parameter, read_parameter, read_toml, toml_table, write_parameter
from pneuopt.files.tuning import TUNED_SECTIONS, Tuning, move_paths, read_tuning_table
from pneuopt.quantities.errors import InputError, UnitError, require
from pneuopt.quantities.output import plain_value, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.status import Code
from pneuopt.quantities.units import difference_unit, is_unit, read_unit, read_value, si_conversion, write_value

if TYPE_CHECKING:
    from pneuopt.tuning.result import TuningResult


def write_tuned(
    path: str | Path,
    source: str | Path,
    result: "TuningResult",
    wire: Mapping[str, str] | None = None,
    *,
    fit: str | Path | StoredFit | None = None,
) -> None:
    """Write a tuning's file with the gains found: the user's text and comments, [certified], [status], [provenance].

    Parameters
    ----------
    path : str or Path
        `read_tuning` reads it. Of a result that is not certified it gets the best candidate's gains and no figures, and
        its status says so.
    source : str or Path
        The tuning.toml that the result was made from.
    result : TuningResult
    wire : mapping of str to str, optional
        `Tuning.wire`.
    fit : str, Path or StoredFit, optional
        The plant's file that the result was made with. Without it the certificate gets no checksum: `pneuopt export`
        then takes the gains for uncertified.

    Raises
    ------
    InputError
        If one of the files cannot be read or written, the result has neither design nor candidate, or is about other
        values, references or limits than the files.
    """
    gains = result.candidate
    if gains is None:
        raise InputError(f"{path}: not written, for the tuning found no candidate: {result.status.verdict}")
    document = read_toml(source)
    for name in TUNED_SECTIONS:
        document.pop(name, None)
    move_paths(document.get("reference", []), Path(source).parent, Path(path).parent)
    for n in result.structure:
        put_parameter(document, n, gains[n])
    for section in TUNABLE_SECTIONS:
        for key, entry in document.unwrap().get(section, {}).items():
            if isinstance(entry, dict) and entry.get("free", False):
                found = gains[f"{section}.{key}"]
                given = read_parameter(entry, replace(found, free=True), f"{source}: [{section}] {key}")
                write_parameter(document, f"{section}.{key}", replace(given, value=found.value), given)  # in its unit
    status: dict[str, Any] = {"code": result.status.code.value, "message": result.status.message}
    if result.status.converged:
        rows = result.certified.to_dict(orient="dict")
        document["certified"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    else:
        status["gains"] = "the best candidate that was found; no certificate holds it"
    if wire:
        document["wire"] = toml_table(wire)
    document["status"] = toml_table(status)
    document["provenance"] = toml_table(plain_value(result.provenance))
    if fit is not None:
        stored = fit if isinstance(fit, StoredFit) else read_fit(fit)
        _check_subject(document.unwrap(), path, stored, result, gains)
        document[CHECKSUM] = checksum_section(document.unwrap(), path, stored)
    write_text(path, tomlkit.dumps(document))


def _check_subject(
    table: Mapping[str, Any], path: str | Path, fit: StoredFit, result: "TuningResult", gains: ParameterSet
) -> None:
    """Refuse to bind a certificate to files that say something else than what was certified."""
    plant = fit.parameters
    task = read_tuning_table(table, path, fit.drive.system(), plant)
    known = plant | task.parameters
    for n, p in known.items():
        same = n not in gains or isclose(gains.value(n), p.value, rel_tol=10.0 ** (1 - FILE_DIGITS))
        values = f"{write_value(p.value, p.unit)}, the result was made with {write_value(gains[n].value, p.unit)}"
        require(same, f"{path}: {n} is {values}" if n in task.parameters else f"{fit.path}: {n} is {values}")
    labels = [case.label for case in cases(task.references, task.scenarios(known), known)]
    message = "the result was made with other references or scenarios than its file has"
    require(labels == [str(n) for n in result.certified.columns], f"{path}: {message}")
    same = not result.limits or dict(result.limits) == metric_limits(task.specification.limits)
    require(same, f"{path}: the result was made with other limits than its file has")


Entries = dict[str, str]
Parts = dict[str, Entries]

CHECKSUM = "checksum"
"""The section of a tuned.toml that binds its certificate to what it is about."""


@dataclass(frozen=True)
class CertificateCheck:
    """Whether a tuned.toml's certificate holds for what the file, and the plant's, say now.

    Attributes
    ----------
    holds : bool
    reasons : tuple of str
        Why it does not, a sentence each; empty where it holds.
    """

    holds: bool
    reasons: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """What a file or a screen says of gains that no certificate holds, a line a reason."""
        return tuple(f"NOT CERTIFIED: {reason}" for reason in self.reasons)

    def report(self, tuned: str | Path) -> Report:
        """Whether the certificate in a tuned.toml holds for the gains and the plant that are simulated."""
        good = f"certified: the certificate in {tuned} holds for these gains and this plant"
        return Report((Line(good, Tone.GOOD),) if self.holds else tuple(Line(line, Tone.BAD) for line in self.lines))


def check_certificate(fit: StoredFit, tuned: str | Path, most: int = 8) -> CertificateCheck | None:
    """Whether the certificate in a tuned.toml holds, and if not, what was changed; None for a file without one."""
    table = read_toml(tuned).unwrap()
    if not any(name in table for name in TUNED_SECTIONS):
        return None
    status, stored = stored_status(table, tuned), table.get(CHECKSUM)
    if status is None:
        return CertificateCheck(False, ("its gains were not written by pneuopt tune",))
    ended = () if status.code is Code.CONVERGED else (f"its tuning ended so: {status.code.value}",)
    if not isinstance(stored, dict):
        message = "it was written by an older version, or by hand, and has no checksum"
        return CertificateCheck(False, ended or (f"{message}; run pneuopt certify",))
    parts = _describe(table, tuned, fit)
    if _digest(parts) == stored.get("hash"):
        return CertificateCheck(not ended, ended)
    changes = list(_find_changes(stored, parts, _Writer(table, fit.toml)))
    kept = {part: own.get("hash") for part, own in stored.items() if isinstance(own, dict)}
    others = [part for part, now in parts.items() if kept.get(part) != _digest(now)[:16]]
    changes = changes or [f"its {part} was changed, and its [checksum] with it" for part in others]
    more = f"and {len(changes) - most} more changes"
    told_changes = changes[:most] + ([more] if len(changes) > most else [])
    return CertificateCheck(False, (*ended, *(told_changes or ["its [checksum] was edited, or is damaged"])))


def checksum_section(table: Mapping[str, Any], path: str | Path, fit: StoredFit) -> Table:
    """The [checksum] of a tuned.toml's table, which has its figures and status and is to stand at `path`."""
    parts = _describe(table, path, fit)
    tables = {n: toml_table({"hash": _digest(own)[:16], **own}) for n, own in parts.items()}
    section = toml_table({"hash": _digest(parts), **tables})
    section.comment("of what the certificate is about, as parsed; it is no signature")
    return section


def _describe(table: Mapping[str, Any], path: str | Path, fit: StoredFit) -> Parts:
    """All that a certificate is about, by part and name, as text that depends on the meaning alone."""
    plant = fit.parameters
    task = read_tuning_table(table, path, fit.drive.system(), plant)
    task.scenarios(plant | task.parameters)  # refuses what is no table of scenarios, and says where
    status = table["status"] if isinstance(table.get("status"), dict) else {}
    code, message = str(status.get("code", "")), " ".join(str(status.get("message", "")).split())
    codes = {code.value: code.name for code in Code}
    # the drive's structure, and what its fit leaves uncertain, of which the plants were drawn
    structure, uncertain = _digest(dict(_flatten(fit.drive, fit.drive.kind, {})))[:16], Entries()
    for name, frame in (("covariance", fit.covariance), ("table of estimates", fit.estimates)):
        if frame is not None:
            rows = {str(k): {str(n): _number(v) for n, v in row.items()} for k, row in frame.to_dict("index").items()}
            uncertain[name] = _digest(rows)[:16]
    # a digest of each case's figures, and what a controller adds to the command
    certified, wire, unit = table.get("certified", {}), table.get("wire", {}), task.loop.command.unit
    rows = certified if isinstance(certified, dict) else {"": certified}
    figures = {f"the row of '{case}' in [certified]": _digest(_plain(row))[:16] for case, row in rows.items()}
    for n, value in (wire if isinstance(wire, dict) else {}).items():
        try:
            figures[f"wire.{n}"] = _number(read_value(value, unit), unit)
        except UnitError:
            figures[f"wire.{n}"] = str(value)
    return {
        "loop": _describe_loop(task),
        "plant": {"structure": structure, **uncertain, **{n: _number(p.value, p.unit) for n, p in plant.items()}},
        "references": _describe_references(task),
        "limits": _describe_limits(task),
        "scenarios": dict(_describe_scenarios(table.get("scenarios", {}), str(path), plant | task.parameters)),
        "figures": figures,
        "status": {"the status": codes.get(code, code), "the message of the status": _digest(message)[:16]},
    }


def _describe_loop(task: Tuning) -> Entries:
    loop, units = task.loop, signal_units_of(task.loop)
    found: Entries = {"loop.measured": loop.feedback.name, "loop.actuated": loop.command.name}
    parts = {f.name: getattr(loop, f.name) for f in fields(loop)}
    others = ("plant", "measured", "actuated", "compensators")
    named = {getattr(part, "section", n): part for n, part in parts.items() if n not in others}
    for section, part in (*named.items(), *((c.section, c) for c in loop.compensators)):
        keys = LOOP_KEYS.get(section, {})
        known = {f"{section}.{n}": key.unit.format_map(units) for n, key in keys.items() if key.unit}
        found |= dict(_flatten(part, section, known))
    for n, p in task.parameters.items():
        own = {"pid.lower": task.centre, "pid.upper": task.centre}
        shown = {"pid.lower": "pid.limits, the lower one", "pid.upper": "pid.limits, the upper one"}
        found[shown.get(n, n)] = _number(p.value + own.get(n, 0.0), p.unit)
    return found


def _describe_references(task: Tuning) -> Entries:
    signals, keys = signal_units_of(task.loop), REFERENCE_KEYS.items()
    units = {n: key.unit.format_map({**signals, "own": ""}) for n, key in keys if key.unit}
    units |= dict.fromkeys(("size", "distance"), difference_unit(task.loop.feedback.unit))
    found: Entries = {}
    for k, reference in enumerate(sorted(task.references, key=lambda r: r.label), 1):
        for name, text in _flatten(reference, "", {}):
            field = name.rpartition(".")[2]
            is_number = field in units and text.startswith(("0x", "-0x", "inf"))
            shown = name.removeprefix(".").replace("size", "step").replace("distance", "move")
            found[f"reference {k} {shown}".strip()] = f"{text} {units[field]}" if is_number else text
    return found


def _describe_limits(task: Tuning) -> Entries:
    """Limits, objective, settling band and accepted defects."""
    spec, bounds = task.specification, bound_units(task.loop)
    keys, found = {kind: key for key, kind in REQUIREMENTS_BY_KEY.items()}, dict[str, str]()
    for q in spec.limits:
        key = keys[type(q)]
        unit = dict.fromkeys((f"[limits] {key}.max", f"[limits] {key}.min"), "" if bounds[key] == "1" else bounds[key])
        found |= dict(_flatten(q, f"[limits] {key}", unit))
    for q, weight in spec.weights.items():
        found |= dict(_flatten(q, f"[minimise] {keys[type(q)]}", {}))
        found[f"[minimise] {keys[type(q)]}.weight"] = _number(weight)
    if spec.rest is not None:
        units = {"duration": "s", "repeatability": difference_unit(task.loop.feedback.unit)}
        lead = f"[limits] {NO_HUNTING_KEY}"
        found |= dict(_flatten(spec.rest, lead, {f"{lead}.{n}": unit for n, unit in units.items()}))
    found |= dict(_flatten(spec.band, "the settling band", {}))
    accepted = sorted(defect.name for defect in task.accept)
    return found | ({"accept": ", ".join(accepted)} if accepted else {})


def _describe_scenarios(table: Mapping[str, Any], where: str, parameters: ParameterSet) -> Iterator[tuple[str, str]]:
    """By which shares, between which values and by how many draws the plants differ, as the file states it."""
    for kind, given in table.items():
        spot, own = f"{where}: [scenarios.{kind}]", SCENARIO_KEYS[kind].keys
        entries = {n: entry for n, entry in given.items() if n not in own}
        read = read_sample_spreads if kind == "samples" else read_spreads
        lead = f"[scenarios.{kind}]"
        for axis, spread in read(entries, spot, parameters).items():
            yield from _flatten(spread, f"{lead} {axis}", {})
        if own:
            yield from _flatten(read_draw({n: given[n] for n in own if n in given}, spot), lead, {})


def _find_changes(stored: Mapping[str, Any], parts: Parts, writer: "_Writer") -> Iterator[str]:
    """What differs from what was certified, a sentence each."""
    for part, now in parts.items():
        before = stored.get(part, {})
        was = {str(n): str(v) for n, v in before.items() if n != "hash"} if isinstance(before, dict) else {}
        lead = "the plant's " if part == "plant" else ""
        for n in dict.fromkeys((*now, *was)):
            if was.get(n) == now.get(n):
                continue
            if n in was and n in now:
                yield f"{lead}{n} was changed after tuning{writer.compare(n, was[n], now[n])}"
            elif n in now:
                yield f"{lead}{n} was added after tuning{writer.tell(n, now[n])}"
            else:
                yield f"{lead}{n} was left out after tuning{writer.tell(n, was[n])}"


@dataclass(frozen=True)
class _Writer:
    """Writes a value of the checksum for its reader, in the unit that the files have it in."""

    tuned: Mapping[str, Any]  # both as parsed
    fit: Mapping[str, Any]

    def compare(self, name: str, was: str, now: str) -> str:
        """Both values, " (2 V -> 3 V)"; nothing of digests."""
        if _is_digest(was) or _is_digest(now):
            return ""
        for digits in (6, CHECKSUM_DIGITS):
            texts = [self._write(name, text, digits) for text in (was, now)]
            if texts[0] != texts[1]:
                break
        return f" ({texts[0]} -> {texts[1]})"

    def tell(self, name: str, text: str) -> str:
        """One value, " (2 V)"; nothing of a digest."""
        return "" if _is_digest(text) else f" ({self._write(name, text, 6)})"

    def _write(self, name: str, text: str, digits: int) -> str:
        number, _, unit = text.partition(" ")
        try:
            value = float.fromhex(number)
        except ValueError:  # a word
            return text
        wanted = self._user_unit(name, unit)
        if not is_unit(wanted):  # none, or "1 sample"
            return write_value(value, unit or "1", digits)
        try:
            factor, offset = si_conversion(wanted, unit or "1")
        except UnitError:  # a key of the same name that is something else
            return write_value(value, unit or "1", digits)
        return f"{(value - offset) / factor:.{digits}g} {wanted}"

    def _user_unit(self, name: str, unit: str) -> str:
        """The unit in which a file writes a value; empty where none does."""
        section, _, key = name.removeprefix("[limits] ").partition(".")
        if name.startswith("[limits] "):
            section, key, field = "limits", section, key
        else:
            field = "value"
        for table in (self.tuned, self.fit):
            entries = table.get(section)
            entry = entries.get(key) if isinstance(entries, dict) else None
            stated = entry.get(field) if isinstance(entry, dict) else entry
            if isinstance(stated, str):
                return read_unit(stated, unit or "1")
        return ""


def _flatten(value: Any, name: str, units: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The text of every field of a frozen object, by its path; what is None is left out."""
    if value is None:
        return
    if is_dataclass(value):
        yield name, type(value).__name__
        for f in fields(value):
            yield from _flatten(getattr(value, f.name), f"{name}.{f.name}", units)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            yield from _flatten(value[key], f"{name}.{key}", units)
    elif isinstance(value, np.ndarray):
        yield name, _digest(_plain(value.tolist()))[:16]
    elif isinstance(value, tuple | list):
        if any(is_dataclass(v) for v in value):
            for k, entry in enumerate(value, 1):
                yield from _flatten(entry, f"{name}.{k}", units)
        else:
            yield name, json.dumps(_plain(value))
    else:
        yield name, _scalar(value, units.get(name, ""))


def _scalar(value: Any, unit: str = "") -> str:
    """A word, a choice, a flag or a number as text."""
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Real) and not isinstance(value, bool):
        return _number(float(value), unit)
    if isinstance(value, bool | str):
        return str(value)
    raise TypeError(f"{type(value).__name__} is nothing that a checksum is made of")


def _plain(value: Any) -> Any:
    """Nested tables and lists with their scalars as text."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return _scalar(value) if isinstance(value, Real | Enum) else str(value)


def _number(value: float, unit: str = "") -> str:
    """A number with its SI unit, the same for every way to write it.

    It is hexadecimal, so that whoever replaces a gain's digits in the whole file does not replace the certified ones.
    """
    rounded = float(f"{value:.{CHECKSUM_DIGITS}g}") + 0.0  # -0.0 becomes 0
    return f"{rounded.hex()} {'' if unit == '1' else unit}".strip()


def _digest(content: Any) -> str:
    """The SHA-256 of plain content, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _is_digest(text: str) -> bool:
    return len(text) == 16 and all(c in "0123456789abcdef" for c in text)
