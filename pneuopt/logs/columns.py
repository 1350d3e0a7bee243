"""What the columns of a log mean, whatever its file format: channels, their units, centres and scales, and checks."""

import difflib
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnitError, UnknownNameError, check_names, require
from pneuopt.quantities.keys import Key, Takes
from pneuopt.quantities.units import read_value, si_conversion

CHANNELS: Mapping[str, str] = {
    "time": "s",
    "valve_voltage": "V",
    "force": "N",
    "position": "m",
    "speed": "m/s",
    "pressure_a": "Pa(a)",
    "pressure_b": "Pa(a)",
    "supply_pressure": "Pa(a)",
    "speed_reference": "m/s",
    "position_reference": "m",
}
"""The channels of a log and their SI units."""

COLUMN_KEYS: Mapping[str, Key] = {
    "column": Key("the column's name", Takes.TEXT, required=True, example='"U valve"'),
    "unit": Key("the column's unit; by default as its name says", Takes.TEXT, example='"V"'),
    "centre": Key("subtracted from the column", unit="{column}", usual=0.0, example='"5 V"'),
    "scale": Key("what the column is multiplied by, or its inverse", unit="{own}/{column}", example='"35 N/V"'),
}
"""The table of a channel: which column it is, and how that is converted."""

MIN_SAMPLES = 10
"""The fewest samples of a log: with fewer its noise level is a guess; a larger bound refuses logs that are enough."""

_SYNONYMS = {"t": "time", "velocity": "speed", "displacement": "position", "voltage": "valve_voltage"}
_BRACKETED_UNIT = re.compile(r"(.+?)\s*\[\s*(.*?)\s*\]|(.+?)\s+\((.+)\)")


def read_channels(
    table: Table, entries: Mapping[str, Any] | None, where: str, channels: Mapping[str, str] = CHANNELS
) -> dict[str, Array]:
    """Read the channels of a log from its columns.

    Parameters
    ----------
    table : Table
    entries : mapping, optional
        Channel to column, as in a sidecar's [columns]; None: the columns' names say it.
    where : str
        Where the entries come from, for messages.
    channels : mapping of str to str
        The channels that a column may be, and their SI units.

    Returns
    -------
    dict of str to ndarray, each of shape (n,)
        In SI units, "time" among them, strictly increasing; NaN where a sample is missing.

    Raises
    ------
    LogError, UnitError, UnknownNameError
        If the log cannot be understood beyond doubt.
    """
    if entries is None:
        found = _columns_from_names(table, channels)
    else:
        found = _columns_from_entries(table, entries, where, channels)
    require("time" in found, f'{table.path}: no time; name a column "time [s]", or say which in a sidecar', LogError)
    require(len(found) > 1, f"{table.path}: no channel but time; known: {', '.join(channels)}", LogError)
    numbers = table.read([column.name for column in found.values()])
    _check_finite(table, numbers)
    values = {channel: c.factor * numbers[c.name] + c.offset for channel, c in found.items()}
    _check_samples(table, found, values)
    return values


class _Column(NamedTuple):
    """The name of a channel's column, and ``si = factor * raw + offset``."""

    name: str
    factor: float
    offset: float


def _columns_from_names(table: Table, channels: Mapping[str, str]) -> dict[str, _Column]:
    """Columns whose name is a channel and its unit; a name that nearly is a channel is an error."""
    found: dict[str, _Column] = {}
    for name in filter(None, table.names):
        channel, unit = _split_channel(name, channels)
        if not channel:
            _check_misspelling(table, name, channels)
            continue
        where = f"{table.path}: column {name!r}"
        require(channel not in found, f"{where}: {channel!r} has another column; name one in a sidecar", LogError)
        entry = {"column": name, "unit": unit} if unit else name
        try:
            found[channel] = _resolve_column(table, channel, entry, where, channels)
        except UnitError as error:
            raise UnitError(f"{error} (or list the columns to use in a sidecar)") from None
    return found


def _split_channel(name: str, channels: Mapping[str, str]) -> tuple[str, str]:
    """Split "position [mm]" or "position_mm" into channel and unit; ("", "") if it names no channel."""
    bare, unit = _split_unit(name)
    plain = bare.casefold().replace(" ", "_")
    if plain in channels:
        return plain, unit
    for channel in sorted(channels, key=len, reverse=True):
        if plain.startswith(channel + "_") and not unit:
            return channel, bare[len(channel) + 1 :]
    return "", ""


def _split_unit(name: str) -> tuple[str, str]:
    match = _BRACKETED_UNIT.fullmatch(name)
    return (match[1] or match[3], match[2] or match[4] or "") if match else (name, "")


def _check_misspelling(table: Table, name: str, channels: Mapping[str, str]) -> None:
    bare, unit = _split_unit(name)
    parts = bare.casefold().replace(" ", "_").split("_")
    for n in range(len(parts), 0 if not unit else len(parts) - 1, -1):
        head = "_".join(parts[:n])
        near = difflib.get_close_matches(head, channels, n=1, cutoff=0.85) or [_SYNONYMS.get(head, "")]
        require(
            not near[0],
            f"{table.path}: column {name!r} looks like the channel {near[0]!r}; write it so, "
            "or list the columns to use in a sidecar",
            LogError,
        )


def _columns_from_entries(
    table: Table, entries: Mapping[str, Any], where: str, channels: Mapping[str, str]
) -> dict[str, _Column]:
    check_names("channel", entries, channels, where)
    return {name: _resolve_column(table, name, entry, f"{where}.{name}", channels) for name, entry in entries.items()}


def _resolve_column(table: Table, channel: str, entry: Any, where: str, channels: Mapping[str, str]) -> _Column:
    column = dict(entry) if isinstance(entry, Mapping) else {"column": entry}
    check_names("key", column, COLUMN_KEYS, where)
    require(isinstance(column.get("column"), str), f'{where}: say which column: {{ column = "U valve" }}', LogError)
    name = column["column"]
    bare, unit = _split_unit(name)
    if name not in table.names:
        name = bare
    if name not in table.names:
        raise UnknownNameError("column", column["column"], filter(None, table.names), where)
    unit = str(column.get("unit") or unit or _split_channel(name, channels)[1])
    require(bool(unit), f'{where}: no unit; write "{bare} [{channels[channel]}]", or unit = "..."', UnitError)
    raw_centre = read_value(column["centre"], unit, where=f"{where}.centre") if "centre" in column else 0.0
    factor, offset = _column_scaling(unit, column.get("scale"), channels[channel], where)
    return _Column(name, factor, offset - factor * raw_centre)


def _column_scaling(unit: str, scale: str | float | None, target: str, where: str) -> tuple[float, float]:
    if scale is None:
        return si_conversion(unit, target, where=where)
    # A sensor's "1 bar(g)/V" says where the pressure counts from; the gain itself is a difference.
    level = re.search(r"\([ag]\)", f"{unit} {scale}")
    require(
        bool(level) or "(" not in target,
        f'{where}.scale: {scale!r} does not say from where the pressure counts; write "2 bar(g)/V" or "2 bar(a)/V"',
        UnitError,
    )
    bare, bare_target = (re.sub(r"\([ag]\)", "", text) for text in (unit, target))
    gain = _read_gain(re.sub(r"\([ag]\)", "", str(scale)), bare, bare_target, f"{where}.scale")
    return gain, si_conversion(bare_target + (level[0] if level else ""), target, where=f"{where}.scale")[1]


def _read_gain(scale: str, unit: str, target: str, where: str) -> float:
    """A sensor's "35 N/V", or its inverse, as data sheets of encoders have it: "8192 count/rev"."""
    try:
        return read_value(scale, f"({target})/({unit})", where=where)
    except UnitError:
        try:
            inverse = read_value(scale, f"({unit})/({target})")
        except UnitError:
            inverse = 0.0
        if not inverse:
            raise
        return 1 / inverse


def _check_finite(table: Table, numbers: Mapping[str, Array]) -> None:
    """Refuse an infinite sample; NaN stands for a missing one."""
    for name, column in numbers.items():
        infinite = np.isinf(column)
        if infinite.any():
            row = int(np.argmax(infinite))
            raise LogError(
                f"{table.path}: row {row + table.first_row}, column {name!r}: {column[row]} is not a number; "
                "leave the cell empty if the sample is missing"
            )


def _check_samples(table: Table, found: Mapping[str, _Column], values: Mapping[str, Array]) -> None:
    t = values["time"]
    require(
        t.size >= MIN_SAMPLES,
        f"{table.path}: {t.size} samples are too few; at least {MIN_SAMPLES} are needed",
        LogError,
    )
    for channel, column in values.items():
        missing = np.isnan(column)
        where = f"column {found[channel].name!r}"
        require(not missing.all(), f"{table.path}: {where} is empty; leave it out", LogError)
        if channel == "time":
            row = int(np.argmax(missing)) + table.first_row
            require(
                not missing.any(), f"{table.path}: row {row}, {where}: the time is missing; delete the row", LogError
            )
    late = np.flatnonzero(np.diff(t) <= 0)
    if late.size:
        before, after = t[late[0]], t[late[0] + 1]
        kind = "repeats" if after == before else "runs backwards"
        row = int(late[0]) + 1 + table.first_row
        raise LogError(
            f"{table.path}: row {row}: time {kind} ({before:.9g} s, then {after:.9g} s); "
            "delete the row, or cut the log there"
        )
