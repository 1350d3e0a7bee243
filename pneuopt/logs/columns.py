"""What the columns of a log mean, whatever its file format: channels, their units, centres and scales.

`read_channels` takes names and a sidecar's entries at their word; `guess_log` says what the columns of a foreign log
may be, by their names, units and values, and asks where that leaves a doubt.
"""

import difflib
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from pneuopt.logs.table import EMPTY_CELL, LogTable, list_rows
from pneuopt.logs.tolerances import (
    CENTRES,
    COMMAND_RANGE,
    MAX_MAGNITUDE,
    MIN_SAMPLES,
    SHOWN_CENTRES,
    VACUUM_LIMIT,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnitError, UnknownNameError, check_names, require
from pneuopt.quantities.keys import Key, Takes, read_table
from pneuopt.quantities.parameters import COMMAND_SUFFIX, Quantity
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
    table: LogTable, entries: Mapping[str, Any], where: str, channels: Mapping[str, str] = CHANNELS
) -> "ReadChannels":
    """Read the channels of a log: `entries` say channel to column, as a sidecar's [columns] does, names the others."""
    found, remarks = find_columns(table, entries, where, channels)
    numbers = table.read([column.name for column in found.values()])
    for name, column in numbers.items():
        wrong = np.abs(column) > MAX_MAGNITUDE  # an infinite sample among them; NaN stands for a missing one
        if wrong.any():
            row = int(np.argmax(wrong))
            what = "is not a number" if np.isinf(column[row]) else "is no measured value"
            raise LogError(
                f"{table.path}: row {row + table.first_row}, column {name!r}: {column[row]:.6g} {what}; {EMPTY_CELL}"
            )
    values = {channel: c.factor * numbers[c.name] + c.offset for channel, c in found.items()}
    _check_samples(table, found, values)
    return ReadChannels(values, found, remarks)


class ReadChannels(NamedTuple):
    """What `read_channels` returns."""

    samples: dict[str, Array]  # each (n,), in SI units, "time" among them, increasing; NaN where a sample is missing
    columns: Mapping[str, "ChannelColumn"]
    remarks: tuple[str, ...]  # the table's, and the columns that are not read although their names nearly are channels


def find_columns(
    table: LogTable, entries: Mapping[str, Any], where: str, channels: Mapping[str, str]
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
    known = f"{table.path}: no channel but time; known: {', '.join(channels)}"
    require(len(found) > 1, known + (f"; {OTHER_PLANT}" if channels == CHANNELS else ""), LogError)
    return found, tuple(remarks)


OTHER_PLANT = "for a rotary drive, or another plant with channels of its own: read_log(path, plant=drive.system())"


class ChannelColumn(NamedTuple):
    """The column of a channel, and ``si = factor * raw + offset``."""

    name: str
    factor: float
    offset: float
    unit: str = ""  # empty for time stamps
    unit_from: str = ""  # what says it: the place of the entry, "its name", "the file's units"
    said_by: str = ""  # what says that it is this channel: the place of the entry; empty: its name


def _columns_from_names(
    table: LogTable, channels: Mapping[str, str], entries: Mapping[str, Any], used: Collection[str], remarks: list[str]
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
                near = "" if name in table.stamps else nearest_channel(name, channels)
                require(
                    not near,
                    f"{table.path}: column {name!r} looks like the channel {near!r}; write it so, "
                    f"or list the columns to use in a sidecar: pneuopt init --from {table.path} writes one",
                    LogError,
                )
                continue
            where = f"{table.path}: column {name!r}"
            column = _resolve_column(table, channel, name, where, channels)
        except (LogError, UnitError) as error:
            if not entries:
                listed = "or list the columns to use in a sidecar" + (
                    f"; {OTHER_PLANT}" if channels == CHANNELS else ""
                )
                remedy = "" if isinstance(error, LogError) else f" ({listed})"
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
    parts = bare.casefold().replace(" ", "_").split("_")
    for n in range(len(parts), 0 if not unit else len(parts) - 1, -1):
        head = "_".join(parts[:n])
        near = difflib.get_close_matches(head, channels, n=1, cutoff=0.85) or [_SYNONYMS.get(head, "")]
        if near[0]:
            return near[0]
    return ""


def _resolve_column(
    table: LogTable, channel: str, entry: Any, where: str, channels: Mapping[str, str], *, entry_from: str = ""
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
        require(channel == "time", f"{where}: column {name!r} holds time stamps, no numbers; name another", LogError)
        remedy = f"{where}: its time stamps are read in seconds; leave out unit, centre and scale"
        require(column.keys() == {"column"}, remedy, LogError)
        return ChannelColumn(name, 1.0, 0.0, said_by=entry_from)
    places = {
        entry_from: column.get("unit"),
        "its name": unit if column["column"] == name else "",
        "its entry": unit,
        "the file's units": table.units.get(name),
        "its end": _split_channel(name, channels)[1],
    }
    unit_from, unit = next(((place, str(said)) for place, said in places.items() if said), ("", ""))
    require(bool(unit), f'{where}: no unit; write "{bare} [{channels[channel]}]", or unit = "..."', UnitError)
    counted = {"centre": COLUMN_KEYS["centre"]}
    centre = read_table(counted, column, where, units={"column": unit}, partial=True)["centre"]
    factor, offset = _column_scaling(unit, column.get("scale"), channels[channel], where)
    return ChannelColumn(name, factor, offset - factor * centre, unit, unit_from, entry_from)


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
    bare, bare_target, said = (re.sub(r"\([ag]\)", "", str(text)) for text in (unit, target, scale))
    try:  # a sensor's "35 N/V", or its inverse, as data sheets of encoders have it: "8192 count/rev"
        gain = read_value(said, f"({bare_target})/({bare})", where=f"{where} scale")
    except UnitError:
        try:
            inverse = read_value(said, f"({bare})/({bare_target})")
        except UnitError:
            inverse = 0.0
        if not inverse:
            raise
        gain = 1 / inverse
    return gain, si_conversion(bare_target + (level[0] if level else ""), target, where=f"{where} scale")[1]


def _check_samples(table: LogTable, found: Mapping[str, ChannelColumn], values: Mapping[str, Array]) -> None:
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
    steps = np.diff(t)
    if (steps > 0).all():
        return
    parts = []
    for kind, late in (("repeats", np.flatnonzero(steps == 0)), ("runs backwards", np.flatnonzero(steps < 0))):
        if late.size:
            before, after = t[late[0]], t[late[0] + 1]
            rows = list_rows((late + 1 + table.first_row).tolist())
            parts.append(f"{rows}: time {kind} ({before:.9g} s, then {after:.9g} s)")
    coarse = 2 * np.count_nonzero(steps == 0) > steps.size
    remedy = "delete the row, or cut the log there"
    if coarse:
        remedy = "the time is too coarse for the samples; export it with more digits"
    raise LogError(f"{table.path}: {'; '.join(parts)}; {remedy}")


class Plant(Protocol):
    """The signals of a plant, say a `System`, that may be channels of a log."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that drive it."""

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Signals that sensors show."""


def plant_channels(plant: Plant) -> dict[str, str]:
    """The channels that a plant's log may hold: its signals, and the references of its outputs."""
    references = {f"{q.name}_reference": q.unit for q in plant.outputs}
    return {**{q.name: q.unit for q in (*plant.inputs, *plant.outputs)}, **references}


_WORDS: Mapping[str, tuple[str, ...]] = {
    "time": ("t", "time", "zeit", "timestamp", "seconds", "sec"),
    "valve_voltage": ("u", "valve", "voltage", "uvalve", "cmd", "command", "control", "ventil", "spannung", "mv"),
    "force": ("f", "force", "kraft", "loadcell"),
    "position": ("x", "y", "pos", "position", "displacement", "weg", "travel"),
    "speed": ("v", "vel", "velocity", "speed", "geschwindigkeit", "xdot", "dx", "omega", "w", "rpm"),
    "pressure_a": ("pa", "p1", "pressurea", "pressure1", "pressa", "press1", "chambera", "chamber1", "druck1"),
    "pressure_b": ("pb", "p2", "pressureb", "pressure2", "pressb", "press2", "chamberb", "chamber2", "druck2"),
    "supply_pressure": ("ps", "p0", "supply", "psupply", "supplypressure", "pressures", "versorgung"),
    "torque": ("m", "tau", "torque", "moment", "drehmoment"),
    "angle": ("phi", "angle", "theta", "winkel"),
}
_REFERENCE_WORDS = frozenset(["ref", "reference", "setpoint", "sp", "soll", "target", "desired", "set"])
_UNITS: Mapping[str, tuple[str, ...]] = {
    "s": ("s", "ms", "us"),
    "m": ("m", "mm"),
    "m/s": ("m/s", "mm/s"),
    "rad": ("rad", "deg"),
    "rad/s": ("rad/s", "rpm", "deg/s"),
    "Pa(a)": ("bar", "Pa", "kPa"),
}
"""Units that a column without one may have."""
LARGEST_SI = {"s": 0.1, "m": 3.0, "m/s": 5.0, "rad": 30.0, "rad/s": 2000.0}
"""Magnitudes above which numbers are hardly in the SI unit, of the time its step: a shaft turns more often than once, a
cylinder is shorter than 3 m and slower than 5 m/s. Smaller ones ask about right logs, larger ones miss millimetres."""


@dataclass(frozen=True)
class Question:
    """A doubt about a column; the first option is the guess."""

    channel: str
    text: str
    options: tuple[str, ...]


@dataclass(frozen=True)
class ColumnGuess:
    """A channel's column, its unit, "" where the reader knows it, and what is subtracted from it, "" for nothing."""

    channel: str
    column: str
    unit: str
    centre: str = ""
    centre_is_estimated: bool = False  # the column is a command of 0 to 10 V, whose centre `identify` finds

    @property
    def entry(self) -> str:
        """The line of a sidecar: { column = "U valve", unit = "V", centre = "5 V" }."""
        parts = {"column": self.column, "unit": self.unit, "centre": self.centre}
        # JSON escapes as TOML does, but for one character
        quoted = {n: json.dumps(s, ensure_ascii=False).replace("\x7f", "\\u007f") for n, s in parts.items() if s}
        return "{ " + ", ".join(f"{n} = {text}" for n, text in quoted.items()) + " }"


@dataclass(frozen=True)
class LogGuess:
    """What a log holds: its channels, columns that are none, and the time from sample to sample [s]."""

    columns: tuple[ColumnGuess, ...]
    unused: tuple[str, ...]
    sample_time: float


Ask = Callable[[Question], str]


def guess_channels(names: Sequence[str], channels: Mapping[str, str]) -> dict[str, list[str]]:
    """By channel the columns whose names may mean it, the surest first."""
    found: dict[str, list[tuple[int, str]]] = {}
    for name in filter(None, names):
        channel, doubt = _guess_channel(name, channels)
        if channel:
            found.setdefault(channel, []).append((doubt, name))
    return {c: [name for _, name in sorted(own, key=lambda pair: pair[0])] for c, own in found.items()}


def guess_log(table: LogTable, channels: Mapping[str, str], ask: Ask, has_centre: bool = False) -> LogGuess:
    """Guess what a log's columns are; `ask` settles a `Question`, `has_centre`: the drive has a valve's centre."""
    found = guess_channels([n for n in table.names if n not in table.stamps], channels)
    if "time" not in found and table.stamps:
        found = {"time": [next(iter(table.stamps))], **found}
    require("time" in found, f'{table.path}: no column may be the time; name one "time [s]"', LogError)
    require(len(found) > 1, f"{table.path}: no column but the time is understood: {', '.join(table.names)}", LogError)
    guesses = []
    for channel, names in found.items():
        text = f"Which column is the {channel.replace('_', ' ')}?"
        name = names[0] if len(names) == 1 else ask(Question(channel, text, tuple(names)))
        guesses += _guess_column(table, channel, name, channels[channel], ask, has_centre)
    used = {guess.column for guess in guesses}
    time = f'{table.path}: column {found["time"][0]!r} holds no time that is understood; name one "time [s]"'
    require("time" in {g.channel for g in guesses}, time, LogError)
    stamps = next(g for g in guesses if g.channel == "time")
    factor = si_conversion(stamps.unit, "s")[0] if stamps.unit else 1.0
    step = factor * float(np.median(_steps(table.read([stamps.column])[stamps.column])))
    unused = tuple(n for n in table.names if n and n not in used)
    return LogGuess(tuple(guesses), unused, float(f"{step:.3g}"))


def _guess_channel(name: str, channels: Mapping[str, str]) -> tuple[str, int]:
    """The channel that a name may mean, and how doubtful that is; ("", 0) for none."""
    bare, unit = split_unit(name)
    words = [w for w in re.split(r"[^a-z0-9]+", bare.casefold()) if w]
    plain = "_".join(words)
    for channel in sorted(channels, key=len, reverse=True):
        if plain == channel or (plain.startswith(f"{channel}_") and not unit and not _REFERENCE_WORDS & set(words)):
            return channel, 0
    suffix = COMMAND_SUFFIX if _REFERENCE_WORDS & set(words) else ""
    words = [w for w in words if w not in _REFERENCE_WORDS]
    joined = ["".join(words[:n]) for n in (3, 2, 1) if n <= len(words)]
    for doubt, candidates in enumerate((joined, words), 1):
        for word in candidates:
            for channel, known in _WORDS.items():
                if word in known and f"{channel}{suffix}" in channels:
                    return f"{channel}{suffix}", doubt
    return "", 0


def _guess_column(
    table: LogTable, channel: str, name: str, target: str, ask: Ask, has_centre: bool
) -> list[ColumnGuess]:
    """A channel's column with unit and centre; nothing where its unit does not measure the channel."""
    try:
        values = table.read([name])[name]
    except LogError:  # it holds words
        return []
    if not np.isfinite(values).any():
        return []
    enough = int(np.isfinite(values).sum()) >= MIN_SAMPLES
    few = f"{table.path}: {values.size} samples are too few; at least {MIN_SAMPLES} are needed"
    require(enough or channel != "time", few, LogError)
    if name in table.stamps:
        return [ColumnGuess(channel, name, "")]
    stated, last = split_unit(name)[1] or table.units.get(name, ""), re.split(r"[ _]", name.strip())[-1]
    if not stated and last != name.strip() and not last.isdigit():  # the end of "t_ms" is a unit
        stated = last if _measures(last, target) or _measures(f"{last}(a)", target) else ""
    unit = _settle_unit(channel, name, stated, target, values, ask)
    if not unit:
        return []
    low, high, middle = (float(f(values)) for f in (np.nanmin, np.nanmax, np.nanmedian))
    is_offset = (
        channel == "valve_voltage" and unit == "V" and COMMAND_RANGE[0] <= low and high <= COMMAND_RANGE[1] and high > 1
    )
    if not is_offset:
        return [ColumnGuess(channel, name, unit)]
    if has_centre and SHOWN_CENTRES[0] < middle < SHOWN_CENTRES[1]:
        return [ColumnGuess(channel, name, unit, centre_is_estimated=True)]
    options = ("5 V", "0 V") if CENTRES[0] < middle < CENTRES[1] else ("0 V", "5 V")
    centre = options[0]
    if low >= 0 and options[0] == "0 V":
        centre = ask(Question(channel, f"{name!r} goes from {low:.3g} to {high:.3g} V. Where is its centre?", options))
    return [ColumnGuess(channel, name, unit, "" if centre == "0 V" else centre)]


def _settle_unit(channel: str, name: str, stated: str, target: str, values: Array, ask: Ask) -> str:
    """The unit of a column, stated or guessed by its values; empty where the stated one does not fit the channel."""
    if stated and _measures(stated, target):
        return stated
    if target == "Pa(a)" and (not stated or _measures(f"{stated}(a)", target)):
        most, least = float(np.nanmax(values)), float(np.nanmin(values))
        unit = stated or ("Pa" if most > 5e3 else "kPa" if most > 50 else "bar")
        if least * si_conversion(f"{unit}(a)", "Pa(a)")[0] < VACUUM_LIMIT:
            return f"{unit}(g)"  # an absolute pressure is not so low
        text = (
            f"{name!r} goes from {least:.3g} to {most:.3g}{' ' + stated if stated else ''}. Absolute (a), or gauge (g)?"
        )
        return ask(Question(channel, text, (f"{unit}(a)", f"{unit}(g)")))
    if stated:
        return ""
    options = _UNITS.get(target, (target,))
    if len(options) == 1:
        return target
    size = float(np.median(np.abs(_steps(values))) if channel == "time" else np.nanmax(np.abs(values)))
    guess = options[1] if size > LARGEST_SI.get(target, np.inf) else options[0]
    ordered = (guess, *(unit for unit in options if unit != guess))
    what = f"is {size:.3g} from row to row" if channel == "time" else f"reaches {size:.3g}"
    return ask(Question(channel, f"{name!r} {what}. In which unit?", ordered))


def _measures(unit: str, target: str) -> bool:
    try:
        si_conversion(unit, target)
    except UnitError:
        return False
    return True


def _steps(stamps: Array) -> Array:
    """From row to row, where both have a time."""
    return np.diff(stamps[np.isfinite(stamps)])
