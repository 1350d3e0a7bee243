"""What the columns of a log mean, whatever its file format: channels, their units, centres and scales, and checks.

The channels that the log of a plant may hold beside the usual ones.
"""

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from pneuopt.logs.table import EMPTY_CELL, Table
from pneuopt.logs.tolerances import MAX_MAGNITUDE, MAX_NAME_PARTS, MAX_ROWS_SHOWN, MIN_SAMPLES
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnitError, UnknownNameError, check_names, require
from pneuopt.quantities.keys import Key, Takes, read_entry, read_table
from pneuopt.quantities.parameters import Quantity
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


_SYNONYMS = {"t": "time", "velocity": "speed", "displacement": "position", "voltage": "valve_voltage"}
_BRACKETED_UNIT = re.compile(r"(.+?)\s*\[\s*(.*?)\s*\]|(.+?)\s+\((.+)\)")


def read_channels(
    table: Table, entries: Mapping[str, Any], where: str, channels: Mapping[str, str] = CHANNELS
) -> "ReadChannels":
    """Read the channels of a log from its columns.

    Parameters
    ----------
    entries : mapping
        Channel to column, as in a sidecar's [columns]; false leaves a channel out. The other columns' names say what
        they are.
    where : str
        Where the entries come from, for messages.
    channels : mapping of str to str
        The channels that a column may be, and their SI units.

    Raises
    ------
    LogError, UnitError, UnknownNameError
        If the log cannot be understood beyond doubt.
    """
    found, remarks = find_columns(table, entries, where, channels)
    numbers = table.read([column.name for column in found.values()])
    _check_finite(table, numbers)
    values = {channel: c.factor * numbers[c.name] + c.offset for channel, c in found.items()}
    _check_samples(table, found, values)
    return ReadChannels(values, found, remarks)


class ReadChannels(NamedTuple):
    """What `read_channels` returns.

    Attributes
    ----------
    samples : dict of str to ndarray, each of shape (n,)
        In SI units, "time" among them, strictly increasing; NaN where a sample is missing.
    remarks : tuple of str
        What the table says of itself, and the columns that are not read although their names nearly are channels.
    """

    samples: dict[str, Array]
    columns: Mapping[str, "ChannelColumn"]
    remarks: tuple[str, ...]


def find_columns(
    table: Table, entries: Mapping[str, Any], where: str, channels: Mapping[str, str]
) -> tuple[dict[str, "ChannelColumn"], tuple[str, ...]]:
    """The column of each channel, and what the user may want to know of the others; see `read_channels`."""
    check_names("channel", entries, channels, where)
    found = {
        name: _resolve_column(table, name, entry, f"{where} {name}", channels, entry_from=where)
        for name, entry in entries.items()
        if entry is not False
    }
    remarks = list(table.remarks)
    found |= _columns_from_names(table, channels, entries, {column.name for column in found.values()}, remarks)
    if "time" not in found and len(table.stamps) == 1:
        found["time"] = ChannelColumn(next(iter(table.stamps)), 1.0, 0.0)
        remarks.append(f"the time stamps of column {found['time'].name!r} are read as the time")
    require("time" in found, f'{table.path}: no time; name a column "time [s]", or say which in a sidecar', LogError)
    require(len(found) > 1, f"{table.path}: no channel but time; known: {', '.join(channels)}", LogError)
    return found, tuple(remarks)


class ChannelColumn(NamedTuple):
    """The column of a channel, and ``si = factor * raw + offset``.

    Attributes
    ----------
    name : str
        Of the column.
    unit : str
        Of the column; empty for time stamps.
    unit_from : str
        What says the unit: the place of the entry, "its name", "the file's units".
    said_by : str
        What says that it is this channel: the place of the entry; empty: its name.
    """

    name: str
    factor: float
    offset: float
    unit: str = ""
    unit_from: str = ""
    said_by: str = ""


def _columns_from_names(
    table: Table, channels: Mapping[str, str], entries: Mapping[str, Any], used: Collection[str], remarks: list[str]
) -> dict[str, ChannelColumn]:
    """Columns whose name is a channel and its unit; a name that nearly is a channel is an error.

    Beside entries, which name the columns that count, it is a remark.
    """
    found: dict[str, ChannelColumn] = {}
    for name in table.names:
        channel, _ = _split_channel(name, channels)
        if not name or name in used or channel in entries:
            continue
        try:
            if not channel:
                _check_misspelling(table, name, channels)
                continue
            where = f"{table.path}: column {name!r}"
            column = _resolve_column(table, channel, name, where, channels)
        except (LogError, UnitError) as error:
            if not entries:
                remedy = "" if isinstance(error, LogError) else " (or list the columns to use in a sidecar)"
                raise type(error)(f"{error}{remedy}") from None
            remarks.append(f"{str(error).removeprefix(f'{table.path}: ')}; it is not read")
            continue
        require(channel not in found, f"{where}: {channel!r} has another column; name one in a sidecar", LogError)
        found[channel] = column
    return found


def _split_channel(name: str, channels: Mapping[str, str]) -> tuple[str, str]:
    """Split "position [mm]" or "position_mm" into channel and unit; ("", "") if it names no channel."""
    bare, unit = split_unit(name)
    plain = bare.casefold().replace(" ", "_")
    if plain in channels:
        return plain, unit
    for channel in sorted(channels, key=len, reverse=True):
        if plain.startswith(channel + "_") and not unit:
            return channel, bare[len(channel) + 1 :]
    return "", ""


def split_unit(name: str) -> tuple[str, str]:
    """Split "x [mm]" or "x (mm)" into the name and its unit, "" where it has none."""
    match = _BRACKETED_UNIT.fullmatch(name)
    return (match[1] or match[3], match[2] or match[4] or "") if match else (name, "")


def nearest_channel(name: str, channels: Mapping[str, str]) -> str:
    """The channel that a column's name nearly is; "" where it is none, or one without doubt."""
    bare, unit = split_unit(name)
    if _split_channel(name, channels)[0]:
        return ""
    parts = bare.casefold().replace(" ", "_").split("_")[:MAX_NAME_PARTS]
    for n in range(len(parts), 0 if not unit else len(parts) - 1, -1):
        head = "_".join(parts[:n])
        near = difflib.get_close_matches(head, channels, n=1, cutoff=0.85) or [_SYNONYMS.get(head, "")]
        if near[0]:
            return near[0]
    return ""


def _check_misspelling(table: Table, name: str, channels: Mapping[str, str]) -> None:
    near = "" if name in table.stamps else nearest_channel(name, channels)
    require(
        not near,
        f"{table.path}: column {name!r} looks like the channel {near!r}; write it so, "
        f"or list the columns to use in a sidecar: pneuopt init --from {table.path} writes one",
        LogError,
    )


def _resolve_column(
    table: Table, channel: str, entry: Any, where: str, channels: Mapping[str, str], *, entry_from: str = ""
) -> ChannelColumn:
    column = dict(entry) if isinstance(entry, Mapping) else {"column": entry}
    stated = {n: key for n, key in COLUMN_KEYS.items() if key.takes is Takes.TEXT}
    check_names("key", column, COLUMN_KEYS, where)
    name = read_table(stated, column, where, partial=True)["column"]
    bare, unit = split_unit(name)
    if name not in table.names:
        name = bare
    if name not in table.names:
        raise UnknownNameError("column", column["column"], filter(None, table.names), where)
    if name in table.stamps:
        return _stamp_column(name, channel, column, where)._replace(said_by=entry_from)
    places = {
        entry_from: column.get("unit"),
        "its name": unit if column["column"] == name else "",
        "its entry": unit,
        "the file's units": table.units.get(name),
        "its end": _split_channel(name, channels)[1],
    }
    unit_from, unit = next(((place, str(said)) for place, said in places.items() if said), ("", ""))
    require(bool(unit), f'{where}: no unit; write "{bare} [{channels[channel]}]", or unit = "..."', UnitError)
    raw_centre = (
        read_entry(COLUMN_KEYS["centre"], column["centre"], f"{where} centre", {"column": unit})
        if "centre" in column
        else COLUMN_KEYS["centre"].usual
    )
    factor, offset = _column_scaling(unit, column.get("scale"), channels[channel], where)
    return ChannelColumn(name, factor, offset - factor * raw_centre, unit, unit_from, entry_from)


def _stamp_column(name: str, channel: str, entry: Mapping[str, Any], where: str) -> ChannelColumn:
    require(channel == "time", f"{where}: column {name!r} holds time stamps, no numbers; name another", LogError)
    remedy = f"{where}: its time stamps are read in seconds; leave out unit, centre and scale"
    require(entry.keys() == {"column"}, remedy, LogError)
    return ChannelColumn(name, 1.0, 0.0)


def _column_scaling(unit: str, scale: str | float | None, target: str, where: str) -> tuple[float, float]:
    if scale is None:
        return si_conversion(unit, target, where=where)
    # A sensor's "1 bar(g)/V" says where the pressure counts from; the gain itself is a difference.
    level = re.search(r"\([ag]\)", f"{unit} {scale}")
    require(
        bool(level) or "(" not in target,
        f'{where} scale: {scale!r} does not say from where the pressure counts; write "2 bar(g)/V" or "2 bar(a)/V"',
        UnitError,
    )
    bare, bare_target = (re.sub(r"\([ag]\)", "", text) for text in (unit, target))
    gain = _read_gain(re.sub(r"\([ag]\)", "", str(scale)), bare, bare_target, f"{where} scale")
    return gain, si_conversion(bare_target + (level[0] if level else ""), target, where=f"{where} scale")[1]


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
    """Refuse an infinite sample, and one that no sensor gives; NaN stands for a missing one."""
    for name, column in numbers.items():
        wrong = np.abs(column) > MAX_MAGNITUDE
        if wrong.any():
            row = int(np.argmax(wrong))
            what = "is not a number" if np.isinf(column[row]) else "is no measured value"
            raise LogError(
                f"{table.path}: row {row + table.first_row}, column {name!r}: {column[row]:.6g} {what}; {EMPTY_CELL}"
            )


def _check_samples(table: Table, found: Mapping[str, ChannelColumn], values: Mapping[str, Array]) -> None:
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
    _check_order(table, t)


def _check_order(table: Table, t: Array) -> None:
    """Refuse a time that does not increase, and name all rows where it does not."""
    steps = np.diff(t)
    if (steps > 0).all():
        return
    parts = []
    for kind, late in (("repeats", np.flatnonzero(steps == 0)), ("runs backwards", np.flatnonzero(steps < 0))):
        if late.size:
            before, after = t[late[0]], t[late[0] + 1]
            rows = _list_rows((late + 1 + table.first_row).tolist())
            parts.append(f"{rows}: time {kind} ({before:.9g} s, then {after:.9g} s)")
    coarse = 2 * np.count_nonzero(steps == 0) > steps.size
    remedy = "delete the row, or cut the log there"
    if coarse:
        remedy = "the time is too coarse for the samples; export it with more digits"
    raise LogError(f"{table.path}: {'; '.join(parts)}; {remedy}")


def _list_rows(rows: Sequence[int]) -> str:
    """As in "row 14" or "rows 14, 20, ... (57 in all)"."""
    shown = ", ".join(str(row) for row in rows[:MAX_ROWS_SHOWN])
    more = f", ... ({len(rows)} in all)" if len(rows) > MAX_ROWS_SHOWN else ""
    return f"row {shown}" if len(rows) == 1 else f"rows {shown}{more}"


class Plant(Protocol):
    """What a log's reader asks of a plant, say a `System`."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that drive it."""
        ...

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Signals that sensors show."""
        ...


def plant_channels(plant: Plant) -> dict[str, str]:
    """The channels that a plant's log may hold: its signals, and the references of its outputs."""
    references = {f"{q.name}_reference": q.unit for q in plant.outputs}
    return {**{q.name: q.unit for q in (*plant.inputs, *plant.outputs)}, **references}
