"""The keys of a drive.toml, collected from what each kind of drive declares, and under which options each exists."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

from pneuopt.models.declaration import DriveKind, Sections, Structure
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.keys import Key, Takes, choice, parameter_key, table
from pneuopt.quantities.parameters import Parameter, ParameterSet

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
    """The sections of a drive's file with all keys that any drive of the kind may have.

    Parameters
    ----------
    name : str
        Of `DRIVE_KINDS`.

    Returns
    -------
    mapping of str to Key
        The condition of a key says under which options there is such a parameter.
    """
    kind = DRIVE_KINDS[name]
    sections: dict[str, dict[str, Key]] = {section: dict(keys) for section, keys in kind.sections.items()}
    for alias in kind.aliases:
        sections[alias.section][alias.key] = alias.as_key()
    for whole, (parameter, condition) in _find_parameters(kind).items():
        section, _, key = whole.partition(".")
        sections.setdefault(section, {})[key] = parameter_key(parameter, condition)
    tables = {section: table(SECTION_MEANINGS.get(section, ""), keys) for section, keys in sections.items()}
    return {"drive": table("the kind of drive", {"kind": KIND_KEY}, required=True), **tables}


def default_parameters(kind: DriveKind, sections: Sections) -> ParameterSet:
    """The parameters of a drive that a file's sections describe."""
    return kind.build(Structure(sections, kind.sections, lambda *_: "")).system().parameters


class _Variant(NamedTuple):
    """A drive with a word for each required option, and at most one other option that is not as usual."""

    words: Mapping[Option, str]
    changed: Option | None
    value: Any
    parameters: ParameterSet


def _find_parameters(kind: DriveKind) -> dict[str, tuple[Parameter, str]]:
    """Each parameter of any drive of the kind, and under which options the drive has it."""
    variants = list(_build_variants(kind))
    found: dict[str, Parameter] = {}
    for variant in variants:
        found = {**variant.parameters, **found}
    return {n: (p, _describe_condition(n, kind, variants)) for n, p in found.items()}


def _build_variants(kind: DriveKind) -> Iterator[_Variant]:
    """Drives that together have every parameter: each law, and of each section one option after the other."""
    known = {(section, key): k for section, keys in kind.sections.items() for key, k in keys.items()}
    needed = {option: tuple(k.choices or ()) for option, k in known.items() if k.required}
    bases = [dict(zip(needed, words, strict=True)) for words in product(*needed.values())]
    changes: list[tuple[Option | None, Any]] = [(None, None)]
    changes += [(option, value) for option, key in known.items() for value in _other_values(key)]
    for option, value in changes:
        own_laws = option is None or option[0] in (section for section, _ in needed)
        for base in bases if own_laws else bases[:1]:
            try:
                options = base if option is None else {**base, option: value}
                yield _Variant(base, option, value, default_parameters(kind, _as_sections(options)))
            except ModelError:  # options that exclude each other
                continue


def _other_values(key: Key) -> Sequence[Any]:
    if key.required or key.takes in (Takes.TABLE, Takes.TABLES):
        return ()
    if key.choices is not None:
        return [word for word in key.choices if word != key.usual]
    if key.takes in (Takes.FLAG, Takes.FLAG_OR_LIST):
        return [not key.usual]
    return [1] if key.takes is Takes.COUNT else ()


def _as_sections(options: Mapping[Option, Any]) -> dict[str, dict[str, Any]]:
    sections: dict[str, dict[str, Any]] = {}
    for (section, key), value in options.items():
        sections.setdefault(section, {})[key] = value
    return sections


def _describe_condition(name: str, kind: DriveKind, variants: Sequence[_Variant]) -> str:
    """The options under which a drive has a parameter: 'model = "stribeck" or "lugre"'."""
    parts = []
    for section, keys in kind.sections.items():
        for key, known in keys.items():
            option = (section, key)
            has = (
                _has_by_word(name, option, variants) if known.required else _has_by_value(name, option, known, variants)
            )
            if not all(has.values()):
                own = "" if name.startswith(f"{section}.") else f"[{section}] "
                parts.append(f"{own}{key} = {' or '.join(_word(value) for value, there in has.items() if there)}")
    return " and ".join(parts)


def _has_by_word(name: str, option: Option, variants: Sequence[_Variant]) -> dict[Any, bool]:
    """For each word of a required option whether there is the parameter, the others as it needs them."""
    needs = {(v.changed, v.value) for v in variants if name in v.parameters}
    has: dict[Any, bool] = {}
    for variant in (v for v in variants if (v.changed, v.value) in needs):
        word = variant.words[option]
        has[word] = has.get(word, False) or name in variant.parameters
    return has


def _has_by_value(name: str, option: Option, key: Key, variants: Sequence[_Variant]) -> dict[Any, bool]:
    """For each value of an option whether there is the parameter; nothing where the option makes no difference."""
    usual = {tuple(v.words.items()): name in v.parameters for v in variants if v.changed is None}
    changed = [(v, usual.get(tuple(v.words.items()), False)) for v in variants if v.changed == option]
    if key.takes is Takes.COUNT or all((name in v.parameters) == before for v, before in changed):
        return {}
    has = {key.usual: any(before for _, before in changed)}
    for variant, _ in changed:
        has[variant.value] = has.get(variant.value, False) or name in variant.parameters
    return has


def _word(value: bool | str) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value).lower()
