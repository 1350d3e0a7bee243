"""What the columns of a foreign log may be, by their names, units and values; where that leaves a doubt, it asks."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pneuopt.logs.columns import split_unit
from pneuopt.logs.table import Table
from pneuopt.logs.tolerances import CENTRES, MIN_SAMPLES, RANGE, SHOWN_CENTRES, VACUUM_LIMIT
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, UnitError, require
from pneuopt.quantities.parameters import COMMAND_SUFFIX
from pneuopt.quantities.units import si_conversion

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
    """A channel's column, its unit, "" where the reader knows it, and what is subtracted from it, "" for nothing.

    `centre_is_estimated`: the column is a command of 0 to 10 V, whose centre `identify` finds.
    """

    channel: str
    column: str
    unit: str
    centre: str = ""
    centre_is_estimated: bool = False

    @property
    def entry(self) -> str:
        """The line of a sidecar: { column = "U valve", unit = "V", centre = "5 V" }."""
        parts = {"column": self.column, "unit": self.unit, "centre": self.centre}
        return "{ " + ", ".join(f"{n} = {_toml_text(text)}" for n, text in parts.items() if text) + " }"


@dataclass(frozen=True)
class LogGuess:
    """What a log holds: its channels, columns that are none, and the time from sample to sample [s]."""

    columns: tuple[ColumnGuess, ...]
    unused: tuple[str, ...]
    sample_time: float


Ask = Callable[[Question], str]


def guess_channels(names: Sequence[str], channels: Mapping[str, str]) -> dict[str, list[str]]:
    """By channel the columns whose names may mean it, the surest first.

    Examples
    --------
    >>> guess_channels(["t_ms", "U valve", "x [mm]", "x soll"], {"time": "s", "valve_voltage": "V", "position": "m"})
    {'time': ['t_ms'], 'valve_voltage': ['U valve'], 'position': ['x [mm]']}
    """
    found: dict[str, list[tuple[int, str]]] = {}
    for name in filter(None, names):
        channel, doubt = _guess_channel(name, channels)
        if channel:
            found.setdefault(channel, []).append((doubt, name))
    return {c: [name for _, name in sorted(own, key=lambda pair: pair[0])] for c, own in found.items()}


def guess_log(table: Table, channels: Mapping[str, str], ask: Ask, has_centre: bool = False) -> LogGuess:
    """Guess what a log's columns are.

    Parameters
    ----------
    channels : mapping of str to str
        Those of the drive, and their SI units.
    ask : callable
        Takes a `Question`, and returns one of its options.
    has_centre : bool
        Whether the drive has a parameter for its valve's centre, which is estimated where a log shows one.

    Raises
    ------
    LogError
        If no column may be the time, or there is nothing else.
    """
    found = guess_channels([n for n in table.names if n not in table.stamps], channels)
    if "time" not in found and table.stamps:
        found = {"time": [next(iter(table.stamps))], **found}
    require("time" in found, f'{table.path}: no column may be the time; name one "time [s]"', LogError)
    require(len(found) > 1, f"{table.path}: no column but the time is understood: {', '.join(table.names)}", LogError)
    guesses = []
    for channel, names in found.items():
        text = f"Which column is the {_plain(channel)}?"
        name = names[0] if len(names) == 1 else ask(Question(channel, text, tuple(names)))
        guesses += _guess_column(table, channel, name, channels[channel], ask, has_centre)
    used = {guess.column for guess in guesses}
    time = f'{table.path}: column {found["time"][0]!r} holds no time that is understood; name one "time [s]"'
    require("time" in {g.channel for g in guesses}, time, LogError)
    step = _sample_time(table, next(g for g in guesses if g.channel == "time"))
    return LogGuess(tuple(guesses), tuple(n for n in table.names if n and n not in used), step)


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


def _guess_column(table: Table, channel: str, name: str, target: str, ask: Ask, has_centre: bool) -> list[ColumnGuess]:
    """A channel's column with unit and centre; nothing where its unit does not measure the channel."""
    values = _read_numbers(table, name)
    if values is None:
        return []
    enough = int(np.isfinite(values).sum()) >= MIN_SAMPLES
    few = f"{table.path}: {values.size} samples are too few; at least {MIN_SAMPLES} are needed"
    require(enough or channel != "time", few, LogError)
    if name in table.stamps:
        return [ColumnGuess(channel, name, "")]
    stated = split_unit(name)[1] or table.units.get(name, "") or _unit_suffix(name, target)
    unit = _settle_unit(channel, name, stated, target, values, ask)
    if not unit:
        return []
    low, high, middle = (float(f(values)) for f in (np.nanmin, np.nanmax, np.nanmedian))
    is_offset = channel == "valve_voltage" and unit == "V" and RANGE[0] <= low and high <= RANGE[1] and high > 1
    if not is_offset:
        return [ColumnGuess(channel, name, unit)]
    if has_centre and SHOWN_CENTRES[0] < middle < SHOWN_CENTRES[1]:
        return [ColumnGuess(channel, name, unit, centre_is_estimated=True)]
    options = ("5 V", "0 V") if CENTRES[0] < middle < CENTRES[1] else ("0 V", "5 V")
    centre = options[0]
    if low >= 0 and options[0] == "0 V":
        centre = ask(Question(channel, f"{name!r} goes from {low:.3g} to {high:.3g} V. Where is its centre?", options))
    return [ColumnGuess(channel, name, unit, "" if centre == "0 V" else centre)]


def _read_numbers(table: Table, name: str) -> Array | None:
    """A column's values; None where it holds words, or nothing."""
    try:
        values = table.read([name])[name]
    except LogError:
        return None
    return values if np.isfinite(values).any() else None


def _settle_unit(channel: str, name: str, stated: str, target: str, values: Array, ask: Ask) -> str:
    """The unit of a column: stated, or guessed by its values; empty where the stated one does not measure it."""
    if stated and _measures(stated, target):
        return stated
    if target == "Pa(a)" and (not stated or _measures(f"{stated}(a)", target)):
        return _settle_level(channel, name, stated, values, ask)
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


def _settle_level(channel: str, name: str, stated: str, values: Array, ask: Ask) -> str:
    """The unit of a pressure, with what it counts from."""
    most, least = float(np.nanmax(values)), float(np.nanmin(values))
    unit = stated or ("Pa" if most > 5e3 else "kPa" if most > 50 else "bar")
    absolute, gauge = f"{unit}(a)", f"{unit}(g)"
    if least * si_conversion(absolute, "Pa(a)")[0] < VACUUM_LIMIT:
        return gauge  # an absolute pressure is not so low
    text = f"{name!r} goes from {least:.3g} to {most:.3g}{' ' + stated if stated else ''}. Absolute (a), or gauge (g)?"
    return ask(Question(channel, text, (absolute, gauge)))


def _measures(unit: str, target: str) -> bool:
    try:
        si_conversion(unit, target)
    except UnitError:
        return False
    return True


def _unit_suffix(name: str, target: str) -> str:
    """The unit at the end of a name, "t_ms" for example."""
    last = re.split(r"[ _]", name.strip())[-1]
    is_unit = last != name.strip() and (_measures(last, target) or _measures(f"{last}(a)", target))
    return last if is_unit and not last.isdigit() else ""


def _sample_time(table: Table, time: ColumnGuess) -> float:
    """The median step of the time, to three digits [s]."""
    steps = _steps(table.read([time.column])[time.column])
    factor = si_conversion(time.unit, "s")[0] if time.unit else 1.0
    return float(f"{factor * float(np.median(steps)):.3g}")


def _steps(stamps: Array) -> Array:
    """From row to row, where both have a time."""
    return np.diff(stamps[np.isfinite(stamps)])


def _toml_text(text: str) -> str:
    """A text in quotes; JSON escapes as TOML does, but for one character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(channel: str) -> str:
    return channel.replace("_", " ")
