"""The loop in a tuning.toml: [loop], [pid], [sensor], [dither] and [feedforward]."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import System
from pneuopt.files.toml import read_parameter
from pneuopt.quantities.errors import InputError, check_known, require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.units import read_value, write_value

Sections = Mapping[str, Any]
T = TypeVar("T")

SECTIONS = ("loop", "sensor", "pid", "dither", "feedforward")
TUNABLE = ("pid", "dither", "feedforward")
"""Those whose values may be free."""

_STRUCTURE: Mapping[str, tuple[str, ...]] = {
    "loop": ("measured", "actuated"),
    "pid": ("form", "sample_time", "delay", "limits"),
    "dither": ("waveform", "analogue"),
    "feedforward": (),
}
_SHARED = ("b", "c", "Tt")
_MEANT: Mapping[Form, Mapping[str, str]] = {
    Form.PARALLEL: {"K": "Kp", "Ti": "Ki = Kp/Ti", "Td": "Kd = Kp Td", "N": "Tf = Td/N"},
    Form.STANDARD: {"K": "Kp", "Ki": "Ti = Kp/Ki", "Kd": "Td = Kd/Kp", "Tf": "N = Td/Tf"},
    Form.SERIES: {"Kp": "K", "Ki": "Ti = K/Ki", "Kd": "Td = Kd/K", "N": "Tf"},
}


def read_loop(said: Sections, plant: System, path: str | Path) -> tuple[ClosedLoop, ParameterSet]:
    """The loop of a tuning's sections.

    Parameters
    ----------
    said : mapping of str to mapping
        The sections; others than `SECTIONS` are not read.
    plant : System
    path : str or Path
        What the messages of errors begin with.

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
    loop = _loop(said, plant, path)
    return loop, _parameters(said, loop, path)


def value_of(entries: Mapping[str, Any], key: str, unit: str, where: str) -> float:
    """A value that cannot be free [unit]."""
    return read_value(entries[key], unit, where=f"{where} {key}")


def checked(make: Callable[[], T], where: str) -> T:
    """Say where, when what was read does not fit together."""
    try:
        return make()
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _loop(said: Sections, plant: System, path: str | Path) -> ClosedLoop:
    wiring = said.get("loop", {})
    check_known("key", wiring, _STRUCTURE["loop"], f"{path}: [loop]")
    for key, signal in wiring.items():
        require(isinstance(signal, str), f"{path}: [loop] {key} must be a signal's name, got {signal!r}")
    pid = _pid(said["pid"], f"{path}: [pid]")
    dither = _dither(said["dither"], f"{path}: [dither]") if "dither" in said else None
    sensor = _sensor(said["sensor"], plant, f"{path}: [sensor]") if "sensor" in said else None
    lead = _feedforward(said["feedforward"], f"{path}: [feedforward]") if "feedforward" in said else None
    return checked(lambda: ClosedLoop(plant, pid, dither, **wiring, sensor=sensor, feedforward=lead), str(path))


def _pid(said: Mapping[str, Any], where: str) -> PID:
    form = str(said.get("form", "parallel"))
    check_known("form", [form], [f.value for f in Form], where)
    _check_gains(said, Form(form), where)
    sample_time = value_of(said, "sample_time", "s", where) if "sample_time" in said else None
    delay = _samples(said.get("delay", 0), f"{where} delay")
    banded = "dead_band" in said
    return checked(lambda: PID(sample_time, "limits" in said, Form(form), delay, banded), where)


def _samples(said: Any, where: str) -> int:
    match = re.fullmatch(r"\s*(\d+)\s*samples?\s*", said) if isinstance(said, str) else None
    plainly = isinstance(said, int) and not isinstance(said, bool)
    require(match is not None or plainly, f'{where}: {said!r} is no number of samples; write delay = "1 sample"')
    return int(match[1]) if match else int(said)


def _check_gains(said: Mapping[str, Any], form: Form, where: str) -> None:
    own, first = (*form.gains, *_SHARED), form.gains[0]
    for key in said:
        meant = _MEANT[form].get(key)
        told = f"{key} does not belong to the {form.value} form, which has {', '.join(own)}; say {meant}"
        require(meant is None, f"{where} {told}")
    require(first in said, f"{where} says no gain; write at least {first}")
    require("Tt" not in said or "limits" in said, f"{where} Tt unwinds the integral at limits; write limits, too")


def _dither(said: Mapping[str, Any], where: str) -> Dither:
    shape = str(said.get("waveform", "sine"))
    check_known("waveform", [shape], [w.value for w in Waveform], where)
    require(isinstance(said.get("analogue", False), bool), f"{where} analogue must be true or false")
    require("frequency" in said, f'{where} says no frequency; write frequency = "160 Hz"')
    given = read_parameter(said["frequency"], Parameter(1.0, "Hz"), f"{where} frequency")
    return checked(lambda: Dither(given.value, said.get("analogue", False), Waveform(shape)), where)


def _sensor(said: Mapping[str, Any], plant: System, where: str) -> SensorLag | Encoder:
    check_known("key", said, ("lag", "resolution", "filter"), where)
    told = 'write lag = "5 ms", or of an encoder resolution = "10 um" and filter = "5 ms"'
    require(bool(said), f"{where} says no lag; {told}")
    require("lag" not in said or len(said) == 1, f"{where} has a lag or an encoder, not both; {told}")
    if "lag" in said:
        lag = value_of(said, "lag", "s", where)
        return checked(lambda: SensorLag(lag), where)
    usual = Encoder()
    unit = {q.name: q.unit for q in plant.outputs}.get(usual.position, "m")
    resolution = value_of(said, "resolution", unit, where) if "resolution" in said else usual.resolution
    filter_time = value_of(said, "filter", "s", where) if "filter" in said else usual.filter
    return checked(lambda: Encoder(resolution, filter_time), where)


def _feedforward(said: Mapping[str, Any], where: str) -> Feedforward:
    require("gain" in said, f"{where} says no gain; write gain and time")
    if "time" not in said:
        return Feedforward()
    time = read_parameter(said["time"], Parameter(1.0, "s"), f"{where} time").value
    return checked(lambda: Feedforward(time), where)


def _parameters(said: Sections, loop: ClosedLoop, path: str | Path) -> ParameterSet:
    own = loop.parameters.select(n for n in loop.parameters if n.startswith(tuple(f"{s}." for s in SECTIONS)))
    read = _clip(said["pid"], own, f"{path}: [pid] limits")
    for section in TUNABLE:
        read |= _entries(said.get(section, {}), section, own, f"{path}: [{section}]")
    for name in (n for n, p in read.items() if p.free):
        section, _, key = name.partition(".")
        finite = abs(read[name].lower) < float("inf") and abs(read[name].upper) < float("inf")
        require(finite, f"{path}: [{section}] {key} is free, so it needs both bounds: lower and upper")
    parameters = own | ParameterSet(read)
    checked(lambda: loop.check(parameters), str(path))
    return parameters


def _entries(entries: Mapping[str, Any], section: str, own: ParameterSet, where: str) -> dict[str, Parameter]:
    keys = [n.removeprefix(f"{section}.") for n in own if n.startswith(f"{section}.")]
    keys = [k for k in keys if k not in ("lower", "upper")]
    check_known("key", entries, (*_STRUCTURE[section], *keys), where)
    names = {k: f"{section}.{k}" for k in keys if k in entries}
    return {name: read_parameter(entries[k], own[name], f"{where} {k}") for k, name in names.items()}


def _clip(entries: Mapping[str, Any], own: ParameterSet, where: str) -> dict[str, Parameter]:
    if "limits" not in entries:
        return {}
    ends, unit = entries["limits"], own["pid.lower"].unit
    require(
        isinstance(ends, list) and len(ends) == 2,
        f'{where} must be a pair: ["{write_value(-5.0, unit)}", "{write_value(5.0, unit)}"]',
    )
    low, high = (read_value(end, unit, where=where) for end in ends)
    require(low < high, f"{where}: {ends[0]} is not below {ends[1]}")
    return {"pid.lower": replace(own["pid.lower"], value=low), "pid.upper": replace(own["pid.upper"], value=high)}
