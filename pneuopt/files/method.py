"""The [method] of a tuning.toml: which way of tuning, and that method's options."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pneuopt.files.loop import construct_at
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.units import read_value
from pneuopt.tuning.method import Method
from pneuopt.tuning.methods import METHODS

REPLACED_METHODS = {
    "screening": "racing",
    "condensed": "racing",
}  # in files of older versions


def read_method(table: Mapping[str, Any], where: str) -> Method | None:
    """Read a tuning method.

    Parameters
    ----------
    table : mapping
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
    if not table:
        return None
    require("kind" in table, f"{where} has no kind; write kind = {' or '.join(map(repr, METHODS))}")
    name = str(table["kind"])
    if name in REPLACED_METHODS:
        successor = REPLACED_METHODS[name]
        options = ", ".join(_defaults(successor))
        raise InputError(f"{where}: {name!r} is gone; write kind = {successor!r}, whose options are {options}")
    check_names("kind", [name], METHODS, where)
    kind, defaults = METHODS[name], _defaults(name)
    check_names("option", table, ("kind", *defaults), where)
    given = {n: _read_option(value, defaults[n], f"{where} {n}") for n, value in table.items() if n != "kind"}
    return construct_at(lambda: kind(**given), where)


def _defaults(name: str) -> dict[str, Any]:
    """The options of a method, by their defaults; None: that of one which a file cannot state."""
    return {f.name: f.default for f in fields(METHODS[name]) if isinstance(f.default, int | float | tuple)}


def _read_option(given: Any, default: Any, where: str) -> Any:
    """As a number of the default's type, or several."""
    if isinstance(default, tuple):
        require(isinstance(given, list), f"{where} must be a list, {list(default)} say, got {given!r}")
        return tuple(_read_option(v, default[0], where) for v in given)
    if isinstance(default, float):
        return read_value(given, "1", where=where)
    require(isinstance(given, int) and not isinstance(given, bool), f"{where} must be a whole number, got {given!r}")
    return given
