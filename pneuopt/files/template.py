"""The text of a new file: every key with its unit, default and source; those that are not stated, as comments."""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from pneuopt.files.key_list import describe_unit, describe_usual
from pneuopt.quantities.errors import UnitError
from pneuopt.quantities.keys import Key, Takes
from pneuopt.quantities.units import read_value

COMMENT_COLUMN, MAX_WIDTH = 44, 110  # characters: a comment begins there, or above its key where the line is too long
_NO_BREAK = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Template:
    """What a new file says.

    Attributes
    ----------
    title : tuple of str
        Lines of comment at its top.
    sections : mapping of str to Key
        Its keys.
    stated : mapping of str to str
        Text of what it states, by full name; a name with dots of its own as '"load.mass"'.
    repeated : mapping of str to sequence of mapping
        Of a section that stands there several times, what each states.
    units : mapping of str to str
        What the words in braces of a unit stand for.
    examples : mapping of str to str
        For comments: text of a key by its full name, where neither its default nor its own example would do.
    names : mapping of str to str
        For comments: an entry in place of one that the user names, by the table's full name: '"load.mass" = "30 %"'.
    schema : str
        Where the file's schema is; the first line says it to editors.
    """

    title: Sequence[str]
    sections: Mapping[str, Key]
    stated: Mapping[str, str] = field(default_factory=dict)
    repeated: Mapping[str, Sequence[Mapping[str, str]]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    examples: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    schema: str = ""

    def render(self) -> str:
        """The file's text."""
        lines = [f"#:schema {self.schema}"] if self.schema else []
        lines += [line for text in self.title for line in _comment(text)]
        for name, key in self.sections.items():
            lines += [""] if lines else []
            lines += self._render_entry("", name, key) if key.takes is Takes.LIST else self._render_section(name, key)
        return "\n".join(lines) + "\n"

    def _render_section(self, name: str, key: Key) -> Iterator[str]:
        if key.takes is Takes.TABLES:
            for number, stated in enumerate(self.repeated[name]):
                yield from ["", f"[[{name}]]"] if number else [*_comment(key.meaning), f"[[{name}]]"]
                for own, known in key.keys.items():
                    if own in stated or not number:
                        yield from self._render_entry(name, own, known, stated.get(own))
            return
        said = {n.partition(".")[2]: text for n, text in self.stated.items() if n.partition(".")[0] == name}
        yield from _comment(key.meaning)
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
        unit = self._fill(key)
        words = f"one of {', '.join(key.choices)}" if key.choices is not None else ""
        standing = f"default {usual}" if text is not None and usual and usual != text else "default" if usual else ""
        standing = "" if key.takes is Takes.TABLE or key.source.startswith(standing) else standing
        remarks = [key.meaning + (f" [{unit}]" if unit else ""), words, key.condition, standing, key.source]
        yield from _line(f"{'' if text is not None else '# '}{name} = {shown}", "; ".join(filter(None, remarks)))

    def _fill(self, key: Key) -> str:
        """The unit of a key for this file's signals."""
        known = all(word in self.units for word in _words_of(key.unit))
        return "" if key.unit == "1" else key.unit.format_map(self.units) if known else describe_unit(key)

    def _example_text(self, name: str, key: Key) -> str:
        if name in self.examples:
            return self.examples[name]
        if key.takes is Takes.TABLE or (key.takes is Takes.PARAMETER and len(key.keys) > 1):
            inner = [f"{n} = {self._example_text(f'{name}.{n}', known)}" for n, known in key.keys.items()]
            inner += [self.names[name]] if name in self.names else []
            return f"{{ {', '.join(inner)} }}"
        words = _words_of(key.unit)
        if words and all(word in self.units for word in words) and key.takes is not Takes.LIST:
            return _value_example(key, key.unit.format_map(self.units))
        return describe_usual(key) or key.example or (f'"{next(iter(key.choices))}"' if key.choices else '""')


def _value_example(key: Key, unit: str) -> str:
    """The usual value in the unit of a signal; else the key's own example where it has that unit, or one unit."""
    if key.usual is not None:
        return f"{key.usual:g}" if unit == "1" else f'"{key.usual:g} {unit}"'
    try:
        read_value(key.example.strip('"'), unit)
    except UnitError:
        return "1" if unit == "1" else f'"1 {unit}"'
    return key.example


def _words_of(unit: str) -> list[str]:
    """The words in braces."""
    return [part.partition("}")[0] for part in unit.split("{")[1:]]


def _comment(text: str) -> list[str]:
    whole = text.replace(" [", f"{_NO_BREAK}[")  # "# [s]" would look like a section
    whole = re.sub(r'"[^"]*"', lambda quoted: quoted[0].replace(" ", _NO_BREAK), whole)  # a value stays in one piece
    lines = textwrap.wrap(whole, MAX_WIDTH - 2, subsequent_indent="  ", break_on_hyphens=False)
    return [f"# {line}".replace(_NO_BREAK, " ") for line in lines]


def _line(entry: str, remark: str) -> list[str]:
    """An entry with its comment beside it, or above where that would be too long."""
    if not remark:
        return [entry]
    beside = f"{entry:<{COMMENT_COLUMN}} # {remark}"
    return [beside] if len(beside) <= MAX_WIDTH else [*_comment(remark), entry]
