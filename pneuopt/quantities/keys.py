"""The declaration of a file's keys, by which it is read; templates, schemas and lists of keys come from it, too.

A file is a table whose keys are its sections, a section is a table of keys, and so on down.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from math import inf
from typing import Any

from pneuopt.quantities.errors import MAX_SHOWN, InputError, check_names, require
from pneuopt.quantities.parameters import Parameter
from pneuopt.quantities.units import read_value


class Takes(Enum):
    """What a key takes, in the words of messages."""

    FLAG = "true or false"
    TEXT = "text"
    COUNT = "a whole number"
    NUMBER = "a value with its unit"
    PARAMETER = "a value with its unit, or a table with bounds"
    LIST = "a list"
    FLAG_OR_LIST = "true, false or a list"
    TABLE = "a table"
    TABLES = "sections [[...]]"
    SAMPLES = "a number of samples"
    SPREAD = "a fraction, two values, or a distribution"
    AXIS = "a list of values, or a range"
    COLUMN = "a column's name, a table, or false"


_TYPES: Mapping[Takes, tuple[type, ...]] = {
    Takes.FLAG: (bool,),
    Takes.TEXT: (str,),
    Takes.COUNT: (int,),
    Takes.NUMBER: (str, int, float),
    Takes.PARAMETER: (str, int, float, dict),
    Takes.LIST: (list,),
    Takes.FLAG_OR_LIST: (bool, list),
    Takes.TABLE: (dict,),
    Takes.TABLES: (list,),
    Takes.SAMPLES: (int, str),
    Takes.SPREAD: (str, int, float, list, dict),
    Takes.AXIS: (list, dict),
    Takes.COLUMN: (str, dict, bool),
}


@dataclass(frozen=True)
class Key:
    """A key of a file: what it means, what it takes, and what holds where the file leaves it out."""

    meaning: str
    takes: Takes = Takes.NUMBER
    unit: str = "1"  # of a value; words in braces stand for the units of a loop's signals: "{command}/s"
    usual: Any = None  # what holds without the key: a value in `unit`, or the word that the file would say
    choices: Mapping[str, Any] | None = None  # the words that the key takes, and the object that each stands for
    required: bool = False
    keys: Mapping[str, "Key"] = field(default_factory=dict)  # those of a table
    others: "Key | None" = None  # what further keys of a table take: names that come from the user, each a `named`
    named: str = ""  # what such a name, or a word of a list, is: "parameter"
    example: str = ""  # as a file may write it; needed where nothing is usual
    source: str = ""  # where the usual value comes from
    condition: str = ""  # when the file may have the key: 'form = "standard"'
    least: float = -inf  # bounds of a number, or of a whole one [unit]
    most: float = inf
    is_open: bool = False  # whether the bounds themselves are excluded
    of: "Key | None" = None  # what each entry of a list is
    counts: tuple[int, float] = (0, inf)  # least and largest number of entries of a list
    # Takes entry, place and units, and returns the value of an entry that no other key is like, or raises `InputError`.
    read: "Callable[[Any, str, Mapping[str, str]], Any] | None" = None

    @property
    def usual_value(self) -> Any:
        """What the reader gives where the file leaves the key out."""
        if self.takes is Takes.TABLE and self.usual is None and not any(key.required for key in self.keys.values()):
            return {name: key.usual_value for name, key in self.keys.items()}
        if isinstance(self.usual, list):
            return tuple(self.choices[word] for word in self.usual) if self.choices else tuple(self.usual)
        return self.choices[self.usual] if self.choices and self.usual is not None else self.usual

    @property
    def limits(self) -> str:
        """Its bounds in words, "from 2 to 9"; empty where it has none."""
        if self.is_open and self.least == 0 and self.most == inf:
            return "positive"
        lower, upper = ("above", "below") if self.is_open else ("at least", "at most")
        if not self.is_open and abs(self.least) < inf and self.most < inf:
            return f"from {self.least:.10g} to {self.most:.10g}"
        parts = [f"{lower} {self.least:.10g}"] if self.least > -inf else []
        return " and ".join(parts + ([f"{upper} {self.most:.10g}"] if self.most < inf else []))

    def walk(self, prefix: str = "") -> Iterator[tuple[str, "Key"]]:
        """Yield each key below this one by its full name: "pid.Kp"; a key that the user names, as "noise.<channel>"."""
        named = {f"<{self.named}>": self.others} if self.others else {}
        for name, key in {**self.keys, **named}.items():
            yield f"{prefix}{name}", key
            yield from key.walk(f"{prefix}{name}.")


def read_table(
    keys: Mapping[str, Key],
    toml: Mapping[str, Any],
    where: str | Callable[[str], str],
    *,
    units: Mapping[str, str] | None = None,
    partial: bool = False,
) -> dict[str, Any]:
    """Read a table by the keys that declare it: of each its value in its unit, or what holds without it.

    `where` begins an error's message, as file and section, or says so of a key; `units` are what the words in braces of
    the keys' units stand for; with `partial` the table has keys of another reader. A key that is unknown or missing, or
    has a value that it does not take, is an `InputError`.
    """

    def place(key: str) -> str:
        return where(key) if callable(where) else f"{where} {key}" if key else where

    if not partial:
        for name in toml:
            check_names("key", [name], keys, place("") if not callable(where) else where(str(name)))
    missing = next((name for name, key in keys.items() if key.required and name not in toml), None)
    if missing is not None:
        known = keys[missing]
        words = known.example or (f'"...", one of: {", ".join(known.choices)}' if known.choices else '"..."')
        raise InputError(f"{place('')} has no {missing}; write {missing} = {words}")
    return {
        name: read_entry(key, toml[name], place(name), units) if name in toml else key.usual_value
        for name, key in keys.items()
    }


def read_entry(key: Key, entry: Any, where: str, units: Mapping[str, str] | None = None) -> Any:
    """Read the entry of one key; `where` says file, section and key. Values and errors are `read_table`'s."""
    units = units or {}
    if key.read is not None:
        return key.read(entry, where, units)
    if key.takes is Takes.PARAMETER and key.keys:  # a value that stands for the first key of its table
        single = not isinstance(entry, dict)
        fields = {next(iter(key.keys)): entry} if single else entry
        return read_table(key.keys, fields, (lambda _: where) if single else where, units=units)
    if key.takes is Takes.NUMBER:
        return _in_bounds(key, read_value(entry, key.unit.format_map(units), where=where), entry, where)
    if key.takes is Takes.SAMPLES:
        match = re.fullmatch(r"\s*(\d+)\s*samples?\s*", entry) if isinstance(entry, str) else None
        message = f'{where}: {entry!r} is no number of samples; write {where.rpartition(" ")[2]} = "1 sample"'
        require(match is not None or type(entry) is int, message)
        return int(match[1]) if match else int(entry)
    proper = type(entry) in _TYPES[key.takes]
    require(proper, f"{where} must be {key.takes.value}, got {repr(entry)[:MAX_SHOWN]}{_remedy(key, where)}")
    if key.takes is Takes.COUNT:
        return _in_bounds(key, entry, entry, where)
    if key.takes is Takes.LIST:
        return _read_list(key, entry, where, units)
    if key.takes is Takes.TABLE and key.keys:
        return read_table(key.keys, entry, where, units=units)
    if key.choices is not None:
        section, _, name = where.rpartition(" ")
        check_names(key.named or name, [entry], key.choices, where if key.named else section.rstrip(":"))
        return key.choices[entry]
    return entry


def read_named(key: Key, toml: Any, units: Mapping[str, str], where: str) -> dict[str, Any]:
    """Read a table whose keys the user names, each one of `key.others`; "{own}" stands for its unit in `units`."""
    require(isinstance(toml, dict), f"{where} must be {Takes.TABLE.value}, got {toml!r}{_remedy(key, where)}")
    check_names(key.named, toml, units, where)
    assert key.others is not None
    return {n: read_entry(key.others, entry, f"{where} {n}", {"own": units[n]}) for n, entry in toml.items()}


def check_sections(sections: Mapping[str, Key], toml: Mapping[str, Any], path: object) -> None:
    """Refuse an unknown section of a file, one that is no table, and a file without a required one."""
    check_names("section", toml, sections, str(path))
    for name, key in sections.items():
        if key.takes is Takes.TABLE:
            require(isinstance(toml.get(name, {}), dict), f"{path}: {name} must be a section, [{name}]")
        head = f"[[{name}]]" if key.takes is Takes.TABLES else f"[{name}]"
        require(name in toml or not key.required, f"{path}: no {name}; add a section {head}: {key.meaning}")


def _in_bounds(key: Key, value: Any, entry: Any, where: str) -> Any:
    inside = key.least < value < key.most if key.is_open else key.least <= value <= key.most
    require(inside, f"{where} must be {key.limits}, got {entry}")
    return value


def _read_list(key: Key, entries: list[Any], where: str, units: Mapping[str, str]) -> tuple[Any, ...]:
    least, most = key.counts
    count = f"{least}" if least == most else f"{least} at least" if most == inf else f"{least} to {most:g}"
    require(
        least <= len(entries) <= most,
        f"{where} must be a list of {count}, got {entries}{_remedy(key, where)}",
    )
    item = key.of or (Key("", Takes.TEXT, choices=key.choices, named=key.named) if key.choices else None)
    if item is None:
        return tuple(entries)
    spots = (f"{where} {k}" if isinstance(entry, dict) else where for k, entry in enumerate(entries, 1))
    return tuple(read_entry(item, entry, spot, units) for spot, entry in zip(spots, entries, strict=True))


def _remedy(key: Key, where: str) -> str:
    return f"; write {where.rpartition(' ')[2]} = {key.example}" if key.example else ""


def flag(meaning: str, usual: bool = False) -> Key:
    """Key that is true or false."""
    return Key(meaning, Takes.FLAG, usual=usual)


def choice(meaning: str, choices: Mapping[str, Any], usual: str | None = None) -> Key:
    """Key that is one of several words; without a usual one it is required."""
    return Key(meaning, Takes.TEXT, usual=usual, choices=choices, required=usual is None)


def table(meaning: str, keys: Mapping[str, Key], **options: Any) -> Key:
    """Key that is a table, or a section, of other keys."""
    return replace(Key(meaning, Takes.TABLE, keys=keys), **options)


def first_sentence(kind: object) -> str:
    """What a class or a function is, by its docstring; empty where Python was told to leave docstrings out."""
    first = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
    return _plain(re.split(r"[.;] ", first)[0])


def argument_meanings(kind: type) -> dict[str, str]:
    """What each argument of a class means, the first sentence of its docstring's section Parameters."""
    section = (kind.__doc__ or "").partition("----------\n")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    for names, lines in re.findall(r"^    (\w[\w, ]*) : .*\n((?:^        .*\n?)+)", section, re.MULTILINE):
        meaning = _plain(re.split(r"[.;:] ", " ".join(lines.split()))[0])
        found |= dict.fromkeys(names.split(", "), meaning)
    return found


def _plain(sentence: str) -> str:
    """Without markup, unit and full stop, and small where it begins with a whole word."""
    words = re.sub(r" \[[^]]*\]$", "", sentence.removesuffix(".").replace("`", ""))
    return words[:1].lower() + words[1:] if re.match(r"[A-Z][a-z]+ (?!=)", words) else words


def parameter_key(parameter: Parameter, condition: str = "") -> Key:
    """The key of a parameter: its value, or a table with its bounds and flags."""
    p = parameter
    return Key(p.meaning, Takes.PARAMETER, p.unit, p.value, source=p.source, condition=condition)


PARAMETER_KEYS: Mapping[str, Key] = {
    "value": Key("where a search starts, or what holds", unit="{own}", example='"5 kg"'),
    "lower": Key("lower bound", unit="{own}", example='"1 kg"'),
    "upper": Key("upper bound", unit="{own}", example='"20 kg"'),
    "free": flag("whether it is identified, or tuned"),
    "log": flag("whether searches work on its logarithm"),
    "per_log": flag("whether each log has its own value"),
    "source": Key("where the value comes from", Takes.TEXT, example='"data sheet"'),
}
"""The table of a parameter; value and bounds are in the parameter's unit."""
