"""All keys of all files, from the declarations by which they are read: as a list, as a JSON Schema, as a template."""

import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from math import inf
from typing import Any

from pneuopt.files.drive import drive_keys
from pneuopt.files.loop import tuning_keys
from pneuopt.files.rig import RIG_KEYS
from pneuopt.files.study import STUDY_KEYS
from pneuopt.logs.read_log import SIDECAR_KEYS
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import UnitError
from pneuopt.quantities.keys import PARAMETER_KEYS, Key, Takes, table
from pneuopt.quantities.units import read_value, write_value

FILE_MEANINGS: Mapping[str, str] = {
    "drive.toml": "the hardware: what is known of it, and what is free",
    "tuning.toml": "the controller, what it is asked to follow, and what counts",
    "study.toml": "a grid of plants, samples, corners or a table of them, or a front between two requirements",
    "rig.toml": "what the hardware has and its model has not, for `tune --rig`",
    "log.toml": "the sidecar of log.csv: it has the log's name",
}
_SIGNAL_WORDS = {"command": "command", "measured": "measured", "difference": "measured", "position": "position"}


@dataclass(frozen=True)
class KeyRow:
    """A key in the list."""

    file: str
    section: str
    name: str  # within its section, "smoothing.corner"; empty for the section itself
    key: Key
    unit: str  # as text; of drives that differ, each with its kind
    usual: str
    kinds: tuple[str, ...] = ()  # the kinds of drive that have it; empty where all have it that have the section

    @property
    def full_name(self) -> str:
        """Section and key."""
        return ".".join(filter(None, [self.section, self.name]))

    @property
    def heading(self) -> str:
        """Full name, unit and default in one line."""
        return f"{self.full_name}{f' [{self.unit}]' if self.unit else ''}{f' = {self.usual}' if self.usual else ''}"

    @property
    def remarks(self) -> str:
        """Meaning, words, condition, kinds and source in one line."""
        words = "" if self.key.choices is None else ", ".join(f'"{word}"' for word in self.key.choices)
        kinds = f"{', '.join(self.kinds)} only" if self.kinds else ""
        needed = "required" if self.key.required else ""
        example = f"say {self.key.example}" if self.key.example and not self.usual and not words else ""
        parts = [
            self.key.meaning,
            words and f"one of {words}",
            self.key.limits,
            example,
            self.key.condition,
            kinds,
            needed,
            self.key.source,
        ]
        return "; ".join(filter(None, parts))


@cache
def list_keys() -> tuple[KeyRow, ...]:
    """Every key of every file."""
    others = {"tuning.toml": tuning_keys(), "study.toml": STUDY_KEYS, "rig.toml": RIG_KEYS, "log.toml": SIDECAR_KEYS}
    rows, kinds = list[KeyRow](), {kind: dict(table("", drive_keys(kind)).walk()) for kind in DRIVE_KINDS}
    for name in dict.fromkeys(n for keys in kinds.values() for n in keys):  # a row, which says where kinds differ
        of_kind = {kind: keys[name] for kind, keys in kinds.items() if name in keys}
        section, _, own = name.partition(".")
        known = {kind for kind, keys in kinds.items() if section in keys}
        units, usual = ({kind: text(key) for kind, key in of_kind.items()} for text in (describe_unit, describe_usual))
        condition = _join({kind: key.condition for kind, key in of_kind.items()})
        only = tuple(of_kind) if set(of_kind) != known or (not own and set(of_kind) != set(kinds)) else ()
        key = replace(next(iter(of_kind.values())), condition=condition)
        rows.append(KeyRow("drive.toml", section, own, key, _join(units), _join(usual), only))
    for file, sections in others.items():
        for name, key in _merge_shared(sections):
            section, _, own = name.partition(".")
            rows.append(KeyRow(file, section, own, key, describe_unit(key), describe_usual(key)))
    return tuple(rows)


def describe_usual(key: Key) -> str:
    """What holds where a file leaves the key out, as the file would say it; empty where nothing does."""
    usual = key.usual
    if usual is None or usual == {}:
        return ""
    if isinstance(usual, bool):
        return str(usual).lower()
    if isinstance(usual, str):
        return f'"{usual}"'
    if isinstance(usual, list | tuple):
        return f"[{', '.join(describe_usual(Key('', usual=entry)) for entry in usual)}]"
    if isinstance(usual, int) and key.takes in (Takes.COUNT, Takes.SAMPLES):
        return str(usual)
    try:
        text = write_value(usual, key.unit)
    except UnitError:  # of a signal that is not known yet
        return f"{usual:g}"
    return text if key.unit == "1" else f'"{text}"'


def describe_unit(key: Key) -> str:
    """The unit of a key's value, with words for the units of signals; empty for what has none."""
    unit = key.unit.replace("{own}", "its own").replace("{signal}", "its own").replace("{column}", "the column's")
    unit = unit.format_map(_SIGNAL_WORDS)
    return "" if unit == "1" else unit


def _merge_shared(sections: Mapping[str, Key], least: int = 3) -> Iterable[tuple[str, Key]]:
    """Keys by full name; what several requirements of a section share has one row, "minimise.*.weight"."""
    walked = list(table("", sections).walk())
    counts: dict[tuple[str, str, str], int] = {}
    for name, key in walked:
        if name.count(".") == 2:
            counts[_shape(name, key)] = counts.get(_shape(name, key), 0) + 1
    done = set()
    for name, key in walked:
        shape = _shape(name, key) if name.count(".") == 2 else None
        if shape is None or counts[shape] < least:
            yield name, key
        elif shape not in done:
            done.add(shape)
            several = len({k.unit for n, k in walked if n.count(".") == 2 and _shape(n, k) == shape}) > 1
            yield f"{shape[0]}.*.{shape[1]}", replace(key, unit="{own}") if several else key


def _shape(name: str, key: Key) -> tuple[str, str, str]:
    section, _, own = name.split(".")
    return section, own, key.meaning


def _join(texts: Mapping[str, str]) -> str:
    """One text, and of each kind that differs its own: "N; rotary: N*m"."""
    first = next(iter(texts.values()))
    others = [f"{kind}: {text}" for kind, text in texts.items() if text not in (first, "")]
    return "; ".join(filter(None, [first, *others]))


_VALUE: dict[str, Any] = {"type": ["number", "string"]}
_SPREAD: dict[str, Any] = {"type": ["number", "string", "array"]}


def json_schema(title: str, sections: Mapping[str, Key], results: Iterable[str] = ()) -> dict[str, Any]:
    """The schema (draft 7) of a file with these sections, and with others, `results`, that a command adds."""
    schema = _describe_table(table("", sections))
    schema["properties"] |= {name: {"type": "object"} for name in results}
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": title, **schema}


def _describe_entry(key: Key) -> dict[str, Any]:
    """What a key takes, with its meaning and what is usual."""
    unit, usual = describe_unit(key), describe_usual(key)
    head = key.meaning + (f" [{unit}]" if unit else "")
    remarks = [head, key.limits, usual and f"default {usual}", key.condition, key.source]
    return {"description": "; ".join(filter(None, remarks)), **_FORMS[key.takes](key)}


def _describe_table(key: Key) -> dict[str, Any]:
    """A table: its keys, those that it needs, and what others it may have."""
    others: Any = False
    if key.others is not None:  # "load.mass" without quotes is a table in a table
        others = {"anyOf": [_describe_entry(key.others), {"type": "object"}]}
    return {
        "type": "object",
        "properties": {name: _describe_entry(known) for name, known in key.keys.items()},
        "required": [name for name, known in key.keys.items() if known.required],
        "additionalProperties": others,
    }


def _describe_list(key: Key) -> dict[str, Any]:
    items = {"enum": list(key.choices)} if key.choices is not None else _describe_entry(key.of) if key.of else {}
    least, most = key.counts
    counts = {"minItems": least} if least else {}
    return {
        "type": "array",
        **({"items": items} if items else {}),
        **counts,
        **({"maxItems": most} if most < inf else {}),
    }


_FORMS: Mapping[Takes, Callable[[Key], dict[str, Any]]] = {
    Takes.FLAG: lambda _: {"type": "boolean"},
    Takes.TEXT: lambda key: {"type": "string"} | ({} if key.choices is None else {"enum": list(key.choices)}),
    Takes.COUNT: lambda key: (
        {"type": "integer"}
        | {n: bound for n, bound in (("minimum", key.least), ("maximum", key.most)) if abs(bound) < inf}
    ),
    Takes.SAMPLES: lambda _: {"type": ["integer", "string"]},
    Takes.NUMBER: lambda _: _VALUE,
    Takes.PARAMETER: lambda key: {"anyOf": [_VALUE, _describe_table(table("", key.keys or PARAMETER_KEYS))]},
    Takes.LIST: _describe_list,
    Takes.FLAG_OR_LIST: lambda _: {"type": ["boolean", "array"]},
    Takes.SPREAD: lambda key: {"anyOf": [_SPREAD, _describe_table(table("", key.keys))]} if key.keys else _SPREAD,
    Takes.AXIS: lambda _: {"type": ["array", "object"]},
    Takes.COLUMN: lambda key: {"anyOf": [{"type": ["string", "boolean"]}, _describe_table(table("", key.keys))]},
    Takes.TABLE: _describe_table,
    Takes.TABLES: lambda key: {"type": "array", "items": _describe_table(key)},
}


_NO_BREAK = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Template:
    """What a new file says."""

    title: Sequence[str]  # lines of comment at its top
    sections: Mapping[str, Key]  # its keys
    # text of what it states, by full name; a name with dots of its own as '"load.mass"'
    stated: Mapping[str, str] = field(default_factory=dict)
    # of a section that stands there several times, what each states
    repeated: Mapping[str, Sequence[Mapping[str, str]]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)  # what the words in braces of a unit stand for
    # for comments: text of a key by its full name, where neither its default nor its own example would do
    examples: Mapping[str, str] = field(default_factory=dict)
    # for comments: an entry in place of one that the user names, by the table's full name: '"load.mass" = "30 %"'
    names: Mapping[str, str] = field(default_factory=dict)
    schema: str = ""  # where the file's schema is; the first line says it to editors

    def render(self) -> str:
        """The file's text."""
        lines = [f"#:schema {self.schema}"] if self.schema else []
        lines += [line for text in self.title for line in comment_lines(text)]
        for name, key in self.sections.items():
            lines += [""] if lines else []
            lines += self._render_entry("", name, key) if key.takes is Takes.LIST else self._render_section(name, key)
        return "\n".join(lines) + "\n"

    def _render_section(self, name: str, key: Key) -> Iterator[str]:
        if key.takes is Takes.TABLES:
            for number, stated in enumerate(self.repeated[name]):
                yield from ["", f"[[{name}]]"] if number else [*comment_lines(key.meaning), f"[[{name}]]"]
                for own, known in key.keys.items():
                    if own in stated or not number:
                        yield from self._render_entry(name, own, known, stated.get(own))
            return
        said = {n.partition(".")[2]: text for n, text in self.stated.items() if n.partition(".")[0] == name}
        yield from comment_lines(key.meaning)
        yield f"[{name}]" if said or key.required else f"# [{name}]"
        for own, known in key.keys.items():
            yield from self._render_entry(name, own, known, said.get(own))
        for own in (n for n in said if n not in key.keys):
            yield f"{own} = {said[own]}"
        if key.others is not None and name in self.names:
            yield from _line(f"# {self.names[name]}", f"{key.others.meaning}; any {key.named}")

    def _render_entry(self, section: str, name: str, key: Key, text: str | None = None) -> Iterator[str]:
        """A key that is stated, or a comment with what is usual, or with an example."""
        usual = describe_usual(key)
        shown = text if text is not None else self._example_text(f"{section}.{name}", key)
        known = all(word in self.units for word in _words_of(key.unit))
        unit = "" if key.unit == "1" else key.unit.format_map(self.units) if known else describe_unit(key)
        words = f"one of {', '.join(key.choices)}" if key.choices is not None else ""
        standing = f"default {usual}" if text is not None and usual and usual != text else "default" if usual else ""
        standing = "" if key.takes is Takes.TABLE or key.source.startswith(standing) else standing
        remarks = [key.meaning + (f" [{unit}]" if unit else ""), words, key.limits, key.condition, standing, key.source]
        yield from _line(f"{'' if text is not None else '# '}{name} = {shown}", "; ".join(filter(None, remarks)))

    def _example_text(self, name: str, key: Key) -> str:
        if name in self.examples:
            return self.examples[name]
        if key.takes is Takes.TABLE or (key.takes is Takes.PARAMETER and len(key.keys) > 1):
            inner = [f"{n} = {self._example_text(f'{name}.{n}', known)}" for n, known in key.keys.items()]
            inner += [self.names[name]] if name in self.names else []
            return f"{{ {', '.join(inner)} }}"
        words = _words_of(key.unit)
        if words and all(word in self.units for word in words) and key.takes is not Takes.LIST:
            unit = key.unit.format_map(self.units)
            if key.usual is not None:
                return f"{key.usual:g}" if unit == "1" else f'"{key.usual:g} {unit}"'
            try:
                read_value(key.example.strip('"'), unit)
            except UnitError:
                return "1" if unit == "1" else f'"1 {unit}"'
            return key.example
        return describe_usual(key) or key.example or (f'"{next(iter(key.choices))}"' if key.choices else '""')


def _words_of(unit: str) -> list[str]:
    """The words in braces."""
    return [part.partition("}")[0] for part in unit.split("{")[1:]]


def comment_lines(text: str, width: int = 110) -> list[str]:
    """A comment in lines of at most this width."""
    whole = text.replace(" [", f"{_NO_BREAK}[")  # "# [s]" would look like a section
    whole = re.sub(r'"[^"]*"', lambda quoted: quoted[0].replace(" ", _NO_BREAK), whole)  # a value stays in one piece
    lines = textwrap.wrap(whole, width - 2, subsequent_indent="  ", break_on_hyphens=False)
    return [f"# {line}".replace(_NO_BREAK, " ") for line in lines]


def _line(entry: str, remark: str, column: int = 44, width: int = 110) -> list[str]:
    """An entry with its comment beside it, or above where that would be too long."""
    if not remark:
        return [entry]
    beside = f"{entry:<{column}} # {remark}"
    return [beside] if len(beside) <= width else [*comment_lines(remark, width), entry]
