"""The [method] of a tuning.toml: which way of tuning, and that method's options."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from pneuopt.files.budget import MAX_OPTION
from pneuopt.files.toml import construct_at
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.keys import Key, Takes, argument_meanings, choice, table
from pneuopt.quantities.units import read_value
from pneuopt.tuning.method import Method
from pneuopt.tuning.methods import METHODS

REPLACED_METHODS = {
    "screening": "racing",
    "condensed": "racing",
}  # in files of older versions


def _option_keys(name: str) -> dict[str, Key]:
    """The options of a method that a file can state: numbers, and lists of them."""
    kind, forms = METHODS[name], {int: Takes.COUNT, float: Takes.NUMBER, tuple: Takes.LIST}
    meanings, own = argument_meanings(kind), (f for f in fields(kind) if isinstance(f.default, int | float | tuple))
    return {
        f.name: Key(
            meanings.get(f.name, ""), forms[type(f.default)], usual=f.default, condition=f'with kind = "{name}"'
        )
        for f in own
    }


METHOD_KEYS: Mapping[str, Mapping[str, Key]] = {name: _option_keys(name) for name in METHODS}
"""The options of each method."""


def _join_options() -> dict[str, Key]:
    """The options of all methods; one that several have says of which its usual value is."""
    found: dict[str, Key] = {}
    for keys in METHOD_KEYS.values():
        found |= {n: replace(key, condition=f"usual {key.condition}") if n in found else key for n, key in keys.items()}
    return found


METHOD_SECTION = table(
    "how the search goes; by default the loop decides", {"kind": choice("method", METHODS), **_join_options()}
)


def read_method(entries: Mapping[str, Any], where: str) -> Method | None:
    """Read a tuning method.

    Parameters
    ----------
    entries : mapping
        "kind", a key of `METHODS`, and options of that class: numbers, or lists of them. Empty: no method.
    where : str
        What the message of an error begins with.

    Returns
    -------
    Method or None
        None: the loop decides.

    Raises
    ------
    InputError
        Or its kind; the message names the key.

    Examples
    --------
    >>> read_method({"kind": "racing", "members": 12, "margin": "2 %"}, "[method]").margin
    0.02
    """
    if not entries:
        return None
    require("kind" in entries, f"{where} has no kind; write kind = {' or '.join(map(repr, METHODS))}")
    name = str(entries["kind"])
    if name in REPLACED_METHODS:
        successor = REPLACED_METHODS[name]
        known = ", ".join(METHOD_KEYS[successor])
        raise InputError(f"{where}: {name!r} is gone; write kind = {successor!r}, whose options are {known}")
    check_names("kind", [name], METHODS, where)
    kind, options = METHODS[name], METHOD_KEYS[name]
    check_names("option", entries, ("kind", *options), where)
    given = {n: _read_option(value, options[n].usual, f"{where} {n}") for n, value in entries.items() if n != "kind"}
    return construct_at(lambda: kind(**given), where)


def _read_option(given: Any, default: Any, where: str) -> Any:
    """As a number of the default's type, or several."""
    if isinstance(default, tuple):
        require(isinstance(given, list), f"{where} must be a list, {list(default)} say, got {given!r}")
        return tuple(_read_option(v, default[0], where) for v in given)
    if isinstance(default, float):
        return read_value(given, "1", where=where)
    require(isinstance(given, int) and not isinstance(given, bool), f"{where} must be a whole number, got {given!r}")
    require(abs(given) <= MAX_OPTION, f"{where} may be {MAX_OPTION} at most, got {given!r}")
    return int(given)
