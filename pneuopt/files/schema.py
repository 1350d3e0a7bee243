"""A JSON Schema of a file, from the keys by which it is read, so that editors complete and check it."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pneuopt.files.key_list import describe_unit, describe_usual
from pneuopt.quantities.keys import PARAMETER_KEYS, Key, Takes, table

_VALUE: dict[str, Any] = {"type": ["number", "string"]}


def json_schema(title: str, sections: Mapping[str, Key], results: Iterable[str] = ()) -> dict[str, Any]:
    """The schema of a file (draft 7).

    Parameters
    ----------
    title : str
    sections : mapping of str to Key
        What stands at the file's top.
    results : iterable of str
        Sections that a command adds, about which nothing is said.
    """
    schema = _describe_table(table("", sections))
    schema["properties"] |= {name: {"type": "object"} for name in results}
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": title, **schema}


def _describe_entry(key: Key) -> dict[str, Any]:
    """What a key takes, with its meaning and what is usual."""
    unit, usual = describe_unit(key), describe_usual(key)
    remarks = [key.meaning + (f" [{unit}]" if unit else ""), usual and f"default {usual}", key.condition, key.source]
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


def _describe_text(key: Key) -> dict[str, Any]:
    return {"type": "string"} if key.choices is None else {"type": "string", "enum": list(key.choices)}


def _describe_list(key: Key) -> dict[str, Any]:
    return {"type": "array"} if key.choices is None else {"type": "array", "items": {"enum": list(key.choices)}}


def _value_or_table(key: Key) -> dict[str, Any]:
    return {"anyOf": [_VALUE, _describe_table(table("", key.keys or PARAMETER_KEYS))]}


def _spread_or_table(key: Key) -> dict[str, Any]:
    spread: dict[str, Any] = {"type": ["number", "string", "array"]}
    return {"anyOf": [spread, _describe_table(table("", key.keys))]} if key.keys else spread


_FORMS: Mapping[Takes, Callable[[Key], dict[str, Any]]] = {
    Takes.FLAG: lambda _: {"type": "boolean"},
    Takes.TEXT: _describe_text,
    Takes.COUNT: lambda _: {"type": "integer"},
    Takes.SAMPLES: lambda _: {"type": ["integer", "string"]},
    Takes.NUMBER: lambda _: _VALUE,
    Takes.PARAMETER: _value_or_table,
    Takes.LIST: _describe_list,
    Takes.FLAG_OR_LIST: lambda _: {"type": ["boolean", "array"]},
    Takes.SPREAD: _spread_or_table,
    Takes.AXIS: lambda _: {"type": ["array", "object"]},
    Takes.COLUMN: lambda key: {"anyOf": [{"type": ["string", "boolean"]}, _describe_table(table("", key.keys))]},
    Takes.TABLE: _describe_table,
    Takes.TABLES: lambda key: {"type": "array", "items": _describe_table(key)},
}
