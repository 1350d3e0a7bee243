"""What all TOML files share: a value, or a table where it may be free; the user's comments are kept.

A value is "32 mm", or { value = "40 N", lower = "5 N", upper = "90 N", free = true }.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

from pneuopt.files.tolerances import FILE_DIGITS
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.keys import PARAMETER_KEYS, Takes, read_table
from pneuopt.quantities.output import MAX_REASON, plain_value, read_toml_source
from pneuopt.quantities.parameters import Parameter
from pneuopt.quantities.units import read_value, write_value

Made = TypeVar("Made")

_PARAMETER_WORDS = tuple(name for name, key in PARAMETER_KEYS.items() if key.takes is not Takes.NUMBER)
_PARAMETER_NUMBERS = tuple(name for name, key in PARAMETER_KEYS.items() if key.takes is Takes.NUMBER)
_SECTION_HEAD = re.compile(r"\s*\[+([^\[\]]+)\]")
_KEY_LINE = re.compile(r"\s*([\w\"'. -]+?)\s*=")


def read_toml(path: str | Path) -> tomlkit.TOMLDocument:
    """Read a TOML file with its comments."""
    raw = read_toml_source(path)
    try:
        return tomlkit.parse(raw.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file in UTF-8; save it so") from None
    except (TOMLKitError, ValueError, RecursionError) as error:  # ValueError: a number of thousands of digits
        raise InputError(f"{path}: not valid TOML: {' '.join(str(error).split())[:MAX_REASON]}") from None


@dataclass(frozen=True)
class FileLocations:
    """The lines of sections and keys in a TOML file, for messages; as text it is the file's name."""

    path: str | Path
    text: str  # what the file holds

    def __str__(self) -> str:
        return str(self.path)

    def location(self, section: str, key: str = "") -> str:
        r"""File and line of a section's head or of one of its keys: "drive.toml:14"; the file where it has no such."""
        head: tuple[str, ...] = ()
        wanted = (section, key) if key else (section,)
        for number, line in enumerate(self.text.splitlines(), 1):
            entry, table = _KEY_LINE.match(line), _SECTION_HEAD.match(line)
            head = _key_parts(table[1]) if table else head
            parts = head + _key_parts(entry[1]) if entry and not table else head
            if parts[: len(wanted)] == wanted:
                return f"{self.path}:{number}"
        return str(self.path) if not key else self.location(section)


def read_parameter(entry: Any, default: Parameter, where: str) -> Parameter:
    """Read a value, or a table with bounds and flags, in the unit of `default`, which says what it leaves out."""
    fields = entry if isinstance(entry, dict) else {"value": entry}

    def place(key: str) -> str:
        return f"{where}: {key}" if key in _PARAMETER_WORDS else where

    read = read_table(PARAMETER_KEYS, fields, place, units={"own": default.unit})
    changed: dict[str, Any] = {"source": "", "stated": True} if "value" in fields else {}
    changed |= {name: read[name] for name in fields}
    return construct_at(lambda: replace(default, **changed), where)


def write_parameter(document: tomlkit.TOMLDocument, name: str, found: Parameter, given: Parameter) -> None:
    """Write what differs from `given`, as a table only where the user chose one or more than the value differs."""
    section, _, key = name.partition(".")
    if section not in document:
        document[section] = tomlkit.table()
    entries: Any = document[section]
    named = {f: getattr(found, f) for f in (*_PARAMETER_NUMBERS, *_PARAMETER_WORDS)}
    changed = {f: value for f, value in named.items() if value != getattr(given, f)}
    fields = {f: _format_value(value, found) if f in _PARAMETER_NUMBERS else value for f, value in changed.items()}
    entry = entries.get(key)
    if isinstance(entry, InlineTable | Table):
        entry.update(fields)
    elif fields.keys() == {"value"}:
        entries[key] = fields["value"]
    else:
        entries[key] = inline_table({"value": entry or _format_value(found.value, found)} | fields)


def put_parameter(document: tomlkit.TOMLDocument, name: str, p: Parameter) -> None:
    """Write a parameter in place of what stands there: with its bounds where it is free, else its value."""
    section, _, key = name.partition(".")
    if section not in document:
        document[section] = tomlkit.table()
    entries: Any = document[section]
    text = {n: _format_value(getattr(p, n), p) for n in ("value", "lower", "upper")}
    flags = {"log": True, "free": True} if p.log else {"free": True}
    entries.pop(key, None)
    entries[key] = inline_table({**text, **flags}) if p.free else text["value"]


def construct_at(make: Callable[[], Made], where: str) -> Made:
    """Call `make`; an `InputError` that it raises gets the place in the file before its message."""
    try:
        return make()
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def toml_table(entries: Mapping[str, Any]) -> Table:
    """A section made from a mapping."""
    table = tomlkit.table()
    table.update(entries)
    return table


def inline_table(entries: Mapping[Any, Any]) -> InlineTable:
    """A table in one line, of plain values."""
    table = tomlkit.inline_table()
    table.update(plain_value(entries))
    return table


def _key_parts(dotted: str) -> tuple[str, ...]:
    """The parts of a dotted key, unquoted."""
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def _format_value(value: float, parameter: Parameter) -> str:
    """Round to `FILE_DIGITS`, unless the rounded value would cross a bound."""
    text = write_value(value, parameter.unit, FILE_DIGITS)
    inside = parameter.lower <= read_value(text, parameter.unit) <= parameter.upper
    return text if inside else write_value(value, parameter.unit, 17)
