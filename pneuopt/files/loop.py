"""The loop in a tuning.toml: [loop], its controller and sensor, and what is added to the command."""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pneuopt.control.compensators import COMPENSATORS, Compensator
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import FAULT_SAMPLES, PID, AntiWindup, Form
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System
from pneuopt.files.toml import construct_at, read_fixed_value, read_parameter
from pneuopt.files.tuning_keys import LOOP_KEYS
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.keys import Key
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.units import read_value, write_value

TuningSections = Mapping[str, Any]

TUNABLE_SECTIONS = ("pid", PositionLoop.section, "dither", "feedforward", *COMPENSATORS, GainSchedule.section)
"""Sections whose values may be free."""
LOOP_SECTIONS = tuple(LOOP_KEYS)

_SHARED_PID_KEYS = ("b", "c", "Tt")
_GAIN_CORRECTIONS: Mapping[Form, Mapping[str, str]] = {
    Form.PARALLEL: {"K": "Kp", "Ti": "Ki = Kp/Ti", "Td": "Kd = Kp Td", "N": "Tf = Td/N"},
    Form.STANDARD: {"K": "Kp", "Ki": "Ti = Kp/Ki", "Kd": "Td = Kd/Kp", "Tf": "N = Td/Tf"},
    Form.SERIES: {"Kp": "K", "Ki": "Ti = K/Ki", "Kd": "Td = Kd/K", "N": "Tf"},
}


def read_loop_sections(
    table: TuningSections, plant: System, path: str | Path, centre: float = 0.0
) -> tuple[ClosedLoop, ParameterSet]:
    """The loop of a tuning's sections.

    Parameters
    ----------
    table : mapping of str to mapping
        The sections; others than `LOOP_SECTIONS` are not read.
    plant : System
    path : str or Path
        What the messages of errors begin with.
    centre : float
        Of the plant's valve [the command's unit]; limits in the file are those of the wire, the loop's are about it.

    Returns
    -------
    loop : ClosedLoop
    parameters : ParameterSet
        Those of its controller, sensor and dither, the free ones within finite bounds.

    Raises
    ------
    InputError
        Or its kind; the message names file, section and key.
    """
    loop = _loop(table, plant, path)
    return loop, _parameters(table, loop, path, centre)


def _loop(table: TuningSections, plant: System, path: str | Path) -> ClosedLoop:
    wiring = table.get("loop", {})
    check_names("key", wiring, LOOP_KEYS["loop"], f"{path}: [loop]")
    for key, signal in wiring.items():
        require(isinstance(signal, str), f"{path}: [loop] {key} must be a signal's name, got {signal!r}")
    pid = _pid(table["pid"], f"{path}: [pid]")
    dither = _dither(table["dither"], f"{path}: [dither]") if "dither" in table else None
    sensor = _sensor(table["sensor"], plant, f"{path}: [sensor]") if "sensor" in table else None
    lead = _feedforward(table["feedforward"], f"{path}: [feedforward]") if "feedforward" in table else None
    parts = tuple(_compensator(n, table[n], f"{path}: [{n}]") for n in COMPENSATORS if n in table)
    outer = (
        _position_loop(table[PositionLoop.section], f"{path}: [{PositionLoop.section}]")
        if PositionLoop.section in table
        else None
    )
    schedule = _schedule(table["schedule"], plant, f"{path}: [schedule]") if "schedule" in table else None
    loop = partial(ClosedLoop, plant, pid, dither, **wiring, sensor=sensor, schedule=schedule)
    return construct_at(lambda: loop(feedforward=lead, compensators=parts, outer=outer), str(path))


def _pid(table: Mapping[str, Any], where: str) -> PID:
    keys = LOOP_KEYS["pid"]
    form = _read_choice(table, "form", keys, where)
    _check_gains(table, form, where)
    sample_time = _read_value(table, "sample_time", keys, where)
    delay = _sample_count(table.get("delay", keys["delay"].usual), f"{where} delay")
    banded, resets = "dead_band" in table, "reset_ratio" in table
    told = "reset_band is that of resets; write reset_ratio, too, 1 for the whole integral"
    require(resets or "reset_band" not in table, f"{where} {told}")
    unwinds = _read_choice(table, "anti_windup", keys, where)
    told = "Tt is back-calculation's; clamping has none; leave it out"
    require("Tt" not in table or unwinds is AntiWindup.BACK_CALCULATION, f"{where} {told}")
    return construct_at(lambda: PID(sample_time, "limits" in table, form, delay, banded, unwinds, resets), where)


def _read_choice(table: Mapping[str, Any], key: str, keys: Mapping[str, Key], where: str) -> Any:
    """What the word of a key stands for, of the usual one where the section leaves it out."""
    word, words = str(table.get(key, keys[key].usual)), keys[key].choices or {}
    check_names(key, [word], words, where)
    return words[word]


def _read_value(
    table: Mapping[str, Any], key: str, keys: Mapping[str, Key], where: str, units: Mapping[str, str] | None = None
) -> Any:
    """A value that cannot be free, in its declared unit; the usual one where the section leaves it out."""
    if key not in table:
        return keys[key].usual
    return read_fixed_value(table, key, keys[key].unit.format_map(units or {}), where)


def _sample_count(table: Any, where: str) -> int:
    match = re.fullmatch(r"\s*(\d+)\s*samples?\s*", table) if isinstance(table, str) else None
    plainly = isinstance(table, int) and not isinstance(table, bool)
    require(match is not None or plainly, f'{where}: {table!r} is no number of samples; write delay = "1 sample"')
    return int(match[1]) if match else int(table)


def _check_gains(table: Mapping[str, Any], form: Form, where: str) -> None:
    own, first = (*form.gains, *_SHARED_PID_KEYS), form.gains[0]
    for key in table:
        meant = _GAIN_CORRECTIONS[form].get(key)
        message = f"{key} does not belong to the {form.value} form, which has {', '.join(own)}; say {meant}"
        require(meant is None, f"{where} {message}")
    require(first in table, f"{where} has no gain; write at least {first}")
    require("Tt" not in table or "limits" in table, f"{where} Tt unwinds the integral at limits; write limits, too")


def _dither(table: Mapping[str, Any], where: str) -> Dither:
    keys, analogue = LOOP_KEYS["dither"], table.get("analogue", LOOP_KEYS["dither"]["analogue"].usual)
    shape = _read_choice(table, "waveform", keys, where)
    require(isinstance(analogue, bool), f"{where} analogue must be true or false")
    require("frequency" in table, f'{where} has no frequency; write frequency = "160 Hz"')
    given = read_parameter(table["frequency"], Parameter(1.0, "Hz"), f"{where} frequency")
    return construct_at(lambda: Dither(given.value, analogue, shape), where)


def _sensor(table: Mapping[str, Any], plant: System, where: str) -> SensorLag | Encoder:
    keys = LOOP_KEYS["sensor"]
    check_names("key", table, keys, where)
    message = 'write lag = "5 ms", or of an encoder resolution = "10 um" and filter = "5 ms"'
    require(bool(table), f"{where} has no lag; {message}")
    require("lag" not in table or len(table) == 1, f"{where} has a lag or an encoder, not both; {message}")
    if "lag" in table:
        lag = _read_value(table, "lag", keys, where)
        return construct_at(lambda: SensorLag(lag), where)
    usual = Encoder() if plant.axis is None else Encoder(position=plant.axis.position)
    units = {"position": {q.name: q.unit for q in plant.outputs}.get(usual.position, "m")}
    read = {key: _read_value(table, key, keys, where, units) for key in table}
    return construct_at(lambda: replace(usual, **read), where)


def _feedforward(table: Mapping[str, Any], where: str) -> Feedforward:
    require("gain" in table, f"{where} has no gain; write gain and time")
    if "time" not in table:
        return Feedforward()
    time = read_parameter(table["time"], Parameter(1.0, "s"), f"{where} time").value
    return construct_at(lambda: Feedforward(time), where)


def _position_loop(table: Mapping[str, Any], where: str) -> PositionLoop:
    require("Kp" in table, f'{where} has no gain; write Kp = "10 1/s"')
    return PositionLoop()


def _schedule(table: Mapping[str, Any], plant: System, where: str) -> GainSchedule:
    """A schedule of the gains whose coefficients are stated."""
    told = 'has no {}, an end of the stroke; write low = "0 mm" and high = "200 mm", say'
    for key in ("low", "high"):
        require(key in table, f"{where} {told.format(key)}")
    axis, units = plant.axis or Axis(), {q.name: q.unit for q in plant.outputs}
    unit = units.get(axis.position, "m")
    low, high = (read_parameter(table[key], Parameter(0.0, unit), f"{where} {key}").value for key in ("low", "high"))
    load = None
    if "load" in table:
        inertia = plant.parameters.get(axis.inertia)
        load = read_parameter(table["load"], Parameter(1.0, inertia.unit if inertia else "1"), f"{where} load").value
    gains = GainSchedule.stated_gains(table)
    told = "schedules no gain; write a coefficient such as Kp_slope = { value = 0, lower = -1, upper = 1, free = true }"
    require(bool(gains), f"{where} {told}")
    return construct_at(lambda: GainSchedule(gains, low, high, load, axis.position), where)


def _compensator(section: str, table: Mapping[str, Any], where: str) -> Compensator:
    """A compensator, whose fields are choices of an enum."""
    kind, keys = COMPENSATORS[section], LOOP_KEYS[section]
    require(kind.size in table, f"{where} has no {kind.size}, without which it adds nothing; write {kind.size}")
    chosen = {key: _read_choice(table, key, keys, where) for key in keys}
    return construct_at(lambda: kind(**chosen), where)


def _parameters(table: TuningSections, loop: ClosedLoop, path: str | Path, centre: float) -> ParameterSet:
    own = loop.controller.parameters
    read = _read_limits(table["pid"], own, centre, f"{path}: [pid] limits")
    for section in TUNABLE_SECTIONS:
        read |= _section_parameters(table.get(section, {}), section, own, f"{path}: [{section}]")
    read = _fault_values(read, loop, centre, f"{path}: [pid]")
    for name in (n for n, p in read.items() if p.free):
        section, _, key = name.partition(".")
        finite = abs(read[name].lower) < float("inf") and abs(read[name].upper) < float("inf")
        require(finite, f"{path}: [{section}] {key} is free, so it needs both bounds: lower and upper")
    parameters = own | ParameterSet(read)
    construct_at(lambda: loop.check(parameters), str(path))
    return parameters


def _fault_values(read: dict[str, Parameter], loop: ClosedLoop, centre: float, where: str) -> dict[str, Parameter]:
    """The parameters with the safe output about the valve's centre, from that on the wire; none of a fault is free."""
    for key in loop.pid.fixed_parameters:
        given = read.get(f"pid.{key}")
        told = f"{where} {key} says what the machine does in a fault, which no search decides; take free = true out"
        require(given is None or not given.free, told)
    count = read.get("pid.fault_samples")
    whole = count is None or (count.value >= 1 and count.value == round(count.value))
    require(whole, f"{where} fault_samples is a whole number of samples, 1 at least; the default is {FAULT_SAMPLES:g}")
    safe = read.get("pid.fault_output")
    return read | ({"pid.fault_output": replace(safe, value=safe.value - centre)} if safe else {})


def _section_parameters(
    entries: Mapping[str, Any], section: str, own: ParameterSet, where: str
) -> dict[str, Parameter]:
    keys = [n.removeprefix(f"{section}.") for n in own if n.startswith(f"{section}.")]
    keys = [k for k in keys if k not in ("lower", "upper")]
    check_names("key", entries, (*LOOP_KEYS[section], *keys), where)
    names = {k: f"{section}.{k}" for k in keys if k in entries}
    return {name: read_parameter(entries[k], own[name], f"{where} {k}") for k, name in names.items()}


def _read_limits(entries: Mapping[str, Any], own: ParameterSet, centre: float, where: str) -> dict[str, Parameter]:
    """Limits of the command about the valve's centre, from those on the wire."""
    if "limits" not in entries:
        return {}
    ends, unit = entries["limits"], own["pid.lower"].unit
    require(
        isinstance(ends, list) and len(ends) == 2,
        f'{where} must be a pair: ["{write_value(-5.0, unit)}", "{write_value(5.0, unit)}"]',
    )
    low, high = (read_value(end, unit, where=where) for end in ends)
    require(low < high, f"{where}: {ends[0]} is not below {ends[1]}")
    wire = [write_value(v, unit, 2) for v in (0.0, 2 * centre)]
    remedy = f'write what the wire may carry, limits = ["{wire[0]}", "{wire[1]}"] for instance'
    inside, own_centre = centre == 0 or low < centre < high, write_value(centre, unit, 3)
    require(
        inside, f"{where}: the valve's centre, {own_centre}, does not lie between {ends[0]} and {ends[1]}; {remedy}"
    )
    ends = {"pid.lower": low - centre, "pid.upper": high - centre}
    return {name: replace(own[name], value=value) for name, value in ends.items()}
