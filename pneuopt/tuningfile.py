"""tuning.toml: the controller, what may be tuned, the steps to follow and what counts; tuned.toml is made from it."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import tomlkit

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, StandardForm, to_parallel
from pneuopt.control.reference import Step
from pneuopt.control.sensor import SensorLag
from pneuopt.errors import InputError, check_known, require
from pneuopt.nlp.status import Status
from pneuopt.output import plain, write_text
from pneuopt.parameters import Parameter, ParameterSet
from pneuopt.requirements import AT_LEAST, KINDS, Bounds, Requirement
from pneuopt.scenariofile import read_scenarios
from pneuopt.scenarios import NOMINAL, Scenarios
from pneuopt.specification import specify
from pneuopt.system import System
from pneuopt.tomlfile import inline_table, read_parameter, read_toml, toml_table, write_parameter
from pneuopt.units import read_value, write_value

if TYPE_CHECKING:
    import pandas as pd

Sections = Mapping[str, Any]
T = TypeVar("T")

RESULTS = ("certified", "status", "provenance")
"""Sections that a result adds to a tuning's file; reading the tuning passes over them."""

_SECTIONS = ("loop", "sensor", "pid", "dither", "reference", "minimise", "limits", "scenarios")
_STRUCTURE: Mapping[str, tuple[str, ...]] = {
    "loop": ("measured", "actuated"),
    "pid": ("form", "sample_time", "limits"),
    "dither": ("waveform", "analogue"),
}
_GAINS: Mapping[str, tuple[str, ...]] = {
    "parallel": ("Kp", "Ki", "Kd", "Tf", "b", "c", "Tt"),
    "standard": ("Kp", "Ti", "Td", "N", "b", "c", "Tt"),
}
_REQUIREMENTS = {re.sub("(?<=[a-z])(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in KINDS}
_OWN: Mapping[str, str] = {"settling_time": "band", "step_envelope": "bounds"}


@dataclass(frozen=True, eq=False)
class Tuning:
    """What a tuning.toml describes.

    Attributes
    ----------
    loop : ClosedLoop
    references : tuple of Step
    parameters : ParameterSet
        "pid.*", "dither.*" and "sensor.lag", the free ones within finite bounds.
    minimise : mapping of Requirement to float
        Weights; empty where the file only describes a loop.
    subject_to : tuple of Requirement
    scenarios : callable
        Of the nominal parameters: the plants and tolerances beside them.
    """

    loop: ClosedLoop
    references: tuple[Step, ...]
    parameters: ParameterSet
    minimise: Mapping[Requirement, float]
    subject_to: tuple[Requirement, ...]
    scenarios: Callable[[ParameterSet], Scenarios] = lambda _: NOMINAL


class Tuned(Protocol):
    """What `write_tuned` needs of a result."""

    @property
    def parameters(self) -> ParameterSet:
        """All parameters, the free ones as tuned."""
        ...

    @property
    def certified(self) -> "pd.DataFrame":
        """A row a metric, a column a reference."""
        ...

    @property
    def status(self) -> Status:
        """How it ended."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Versions, options, what it was made from."""
        ...


def read_tuning(path: str | Path, plant: System) -> Tuning:
    """Read a tuning for a plant, whose signals set the units.

    Parameters
    ----------
    path : str or Path
        A tuning.toml, or a tuned.toml made from one.
    plant : System

    Returns
    -------
    Tuning

    Raises
    ------
    InputError
        UnitError, UnknownNameError, ModelError or other; the message names file, section and key.
    """
    said = {name: entry for name, entry in read_toml(path).unwrap().items() if name not in RESULTS}
    check_known("section", said, _SECTIONS, str(path))
    for name in ("loop", "sensor", "pid", "dither", "minimise", "limits", "scenarios"):
        require(isinstance(said.get(name, {}), dict), f"{path}: {name} must be a section, [{name}]")
    require("pid" in said, f"{path}: no controller; add a section [pid]")
    loop = _loop(said, plant, path)
    minimise, subject_to = _minimise(said, path), _limits(said, loop, path)
    if minimise:
        _checked(lambda: specify(minimise, subject_to), f"{path}: [minimise] and [limits]")
    parameters = _parameters(said, loop, path)
    scenarios = partial(read_scenarios, said.get("scenarios", {}), str(path))
    return Tuning(loop, _references(said, loop, path), parameters, minimise, subject_to, scenarios)


def write_tuned(path: str | Path, source: str | Path, result: Tuned) -> None:
    """Write a tuning's file with the gains found: the user's text and comments, [certified], [status], [provenance].

    Parameters
    ----------
    path : str or Path
        `read_tuning` reads it. A result that is not certified leaves the old gains in it, and the status says so.
    source : str or Path
        The tuning.toml that the result was made from.
    result : Tuned
        A `TuningResult`, say.

    Raises
    ------
    InputError
        If one of the files cannot be read or written.
    """
    document = read_toml(source)
    for name in RESULTS:
        document.pop(name, None)
    status = {"code": result.status.code.value, "message": result.status.message}
    if result.status.converged:
        _fill(document, result.parameters, source)
        rows = result.certified.to_dict(orient="dict")
        document["certified"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    else:
        status["gains"] = f"as in {Path(source).name}: not tuned"
    document["status"] = toml_table(status)
    document["provenance"] = toml_table(plain(result.provenance))
    write_text(path, tomlkit.dumps(document))


def _loop(said: Sections, plant: System, path: str | Path) -> ClosedLoop:
    wiring, pid, dither = (said.get(name, {}) for name in ("loop", "pid", "dither"))
    check_known("key", wiring, _STRUCTURE["loop"], f"{path}: [loop]")
    for key, signal in wiring.items():
        require(isinstance(signal, str), f"{path}: [loop] {key} must be a signal's name, got {signal!r}")
    sample_time = _value(pid, "sample_time", "s", f"{path}: [pid]") if "sample_time" in pid else None
    controller = _checked(lambda: PID(sample_time, limits="limits" in pid), f"{path}: [pid]")
    oscillation = _dither(dither, f"{path}: [dither]") if "dither" in said else None
    sensor = _sensor(said["sensor"], f"{path}: [sensor]") if "sensor" in said else None
    return _checked(lambda: ClosedLoop(plant, controller, oscillation, **wiring, sensor=sensor), str(path))


def _sensor(said: Mapping[str, Any], where: str) -> SensorLag:
    check_known("key", said, ("lag",), where)
    require("lag" in said, f'{where} says no lag; write lag = "5 ms"')
    lag = _value(said, "lag", "s", where)
    return _checked(lambda: SensorLag(lag), where)


def _dither(said: Mapping[str, Any], where: str) -> Dither:
    check_known("waveform", [str(said.get("waveform", "sine"))], ("sine",), where)
    require(isinstance(said.get("analogue", False), bool), f"{where} analogue must be true or false")
    require("frequency" in said, f'{where} says no frequency; write frequency = "160 Hz"')
    given = read_parameter(said["frequency"], Parameter(1.0, "Hz"), f"{where} frequency")
    return _checked(lambda: Dither(given.value, said.get("analogue", False)), where)


def _parameters(said: Sections, loop: ClosedLoop, path: str | Path) -> ParameterSet:
    own = loop.parameters.select(n for n in loop.parameters if n.startswith(("pid.", "dither.", "sensor.")))
    form = said["pid"].get("form", "parallel")
    check_known("form", [str(form)], _GAINS, f"{path}: [pid]")
    read = _standard(said["pid"], own, path) if form == "standard" else _entries(said, "pid", own, path)
    read |= _entries(said, "dither", own, path)
    read |= _clip(said["pid"], own, f"{path}: [pid] limits")
    for name in (n for n, p in read.items() if p.free):
        section, _, key = name.partition(".")
        finite = abs(read[name].lower) < float("inf") and abs(read[name].upper) < float("inf")
        require(finite, f"{path}: [{section}] {key} is free, so it needs both bounds: lower and upper")
    parameters = own | ParameterSet(read)
    _checked(lambda: loop.check(parameters), str(path))
    return parameters


def _entries(said: Sections, section: str, own: ParameterSet, path: str | Path) -> dict[str, Parameter]:
    entries, where = said.get(section, {}), f"{path}: [{section}]"
    keys = [n.removeprefix(f"{section}.") for n in own if n.startswith(f"{section}.")]
    if section == "pid":
        _check_gains(entries, "parallel", where)
        keys = [k for k in keys if k in _GAINS["parallel"]]
    check_known("key", entries, (*_STRUCTURE[section], *keys), where)
    names = {k: f"{section}.{k}" for k in keys if k in entries}
    return {name: read_parameter(entries[k], own[name], f"{where} {k}") for k, name in names.items()}


def _check_gains(entries: Mapping[str, Any], form: str, where: str) -> None:
    other = _GAINS["standard" if form == "parallel" else "parallel"]
    for key in entries:
        foreign = key in other and key not in _GAINS[form]
        require(not foreign, f"{where} {key} does not belong to the {form} form, which has {', '.join(_GAINS[form])}")
    require("Kp" in entries, f"{where} says no gain; write at least Kp")
    require("Tt" not in entries or "limits" in entries, f"{where} Tt unwinds the integral at limits; write limits, too")


def _standard(entries: Mapping[str, Any], own: ParameterSet, path: str | Path) -> dict[str, Parameter]:
    """Gains of the ISA form as those of the parallel form, which is what is tuned: values only."""
    where = f"{path}: [pid]"
    _check_gains(entries, "standard", where)
    check_known("key", entries, (*_STRUCTURE["pid"], *_GAINS["standard"]), where)
    units = {"Kp": own["pid.Kp"].unit, "Ti": "s", "Td": "s", "N": "1"}
    tables = [k for k in units if isinstance(entries.get(k), dict)]
    given = {k: _value(entries, k, unit, where) for k, unit in units.items() if k in entries and k not in tables}
    remedy = 'tune in form = "parallel": Kp, Ki = Kp/Ti, Kd = Kp Td, Tf = Td/N'
    require(not tables, f"{where} {', '.join(tables)}: the standard form takes values only; {remedy}")
    gains = _checked(lambda: to_parallel(StandardForm(**given)), where)
    found = {f"pid.{k}": replace(own[f"pid.{k}"], value=getattr(gains, k)) for k in ("Kp", "Ki", "Kd")}
    if gains.Kd:
        found["pid.Tf"] = _checked(lambda: replace(own["pid.Tf"], value=gains.Tf), f"{where} Td/N")
    shared = [k for k in ("b", "c", "Tt") if k in entries]
    return found | {f"pid.{k}": read_parameter(entries[k], own[f"pid.{k}"], f"{where} {k}") for k in shared}


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


def _references(said: Sections, loop: ClosedLoop, path: str | Path) -> tuple[Step, ...]:
    entries = said.get("reference", [])
    several = isinstance(entries, list) and all(isinstance(e, dict) for e in entries)
    require(several, f"{path}: write each reference as a section of its own, [[reference]]")
    require(bool(entries), f'{path}: no reference; add [[reference]] with step = "0.2 m/s" and horizon = "1 s"')
    steps = [_step(e, loop, f"{path}: [[reference]] {k}") for k, e in enumerate(entries, 1)]
    labels = {s.label for s in steps}
    require(len(labels) == len(steps), f"{path}: two references step between the same values; tables tell them by that")
    return tuple(steps)


def _step(entry: Mapping[str, Any], loop: ClosedLoop, where: str) -> Step:
    unit, outputs = loop.feedback.unit, {q.name: q.unit for q in loop.plant.outputs}
    units = {"step": unit.partition("(")[0], "initial": unit, "at": "s", "horizon": "s"}
    check_known("key", entry, (*units, "start"), where)
    start = entry.get("start", {})
    require(isinstance(start, dict), f'{where} start: write start = {{ position = "250 mm" }}')
    check_known("output", start, outputs, f"{where} start")
    for key in ("step", "horizon"):
        require(key in entry, f"{where} says no {key}")
    read = {("size" if k == "step" else k): _value(entry, k, units[k], where) for k in units if k in entry}
    begun = {n: _value(start, n, outputs[n], f"{where} start") for n in start}
    return _checked(lambda: Step(start=begun, **read), where)


def _minimise(said: Sections, path: str | Path) -> dict[Requirement, float]:
    where = f"{path}: [minimise]"
    check_known("requirement", said.get("minimise", {}), _REQUIREMENTS, where)
    weights = {}
    for key, entry in said.get("minimise", {}).items():
        spot = f"{where} {key}"
        require(isinstance(entry, dict), f"{spot}: write {key} = {{ weight = 1.0 }}; a limit belongs under [limits]")
        check_known("key", entry, ("weight", *_own(key)), spot)
        weight = _value(entry, "weight", "1", spot) if "weight" in entry else 1.0
        require(0 < weight < float("inf"), f"{spot}: weight must be positive, got {weight:g}")
        weights[_requirement(key, entry, {"max": None} if key == "step_envelope" else {}, spot)] = weight
    return weights


def _limits(said: Sections, loop: ClosedLoop, path: str | Path) -> tuple[Requirement, ...]:
    where = f"{path}: [limits]"
    check_known("requirement", said.get("limits", {}), _REQUIREMENTS, where)
    units, found = _units(loop), []
    for key, given in said.get("limits", {}).items():
        spot = f"{where} {key}"
        bound = "min" if issubclass(_REQUIREMENTS[key], AT_LEAST) else "max"
        entry = given if isinstance(given, dict) else {bound: given}
        check_known("key", entry, (bound, *_own(key)), spot)
        require(bound in entry or key == "step_envelope", f"{spot} says no {bound}")
        at = f"{spot} {bound}" if entry is given else spot
        limit = {bound: read_value(entry[bound], units.get(key, "1"), where=at)} if bound in entry else {}
        found.append(_requirement(key, entry, limit, spot))
    return tuple(found)


def _units(loop: ClosedLoop) -> dict[str, str]:
    """The units of what is not a number alone."""
    command, measured = loop.command.unit, loop.feedback.unit.partition("(")[0]
    times = dict.fromkeys(("settling_time", "rise_time", "iae", "ise"), "s")
    return times | {
        "itae": "s^2",
        "ripple": measured,
        "peak_control": command,
        "control_rate": f"{command}/s",
        "phase_margin": "deg",
        "noise_gain": f"{command}/({measured})",
    }


def _requirement(key: str, entry: Mapping[str, Any], limit: Mapping[str, float | None], where: str) -> Requirement:
    own: dict[str, Any] = dict(limit)
    if key == "step_envelope":
        own["bounds"] = _bounds(entry.get("bounds"), f"{where} bounds")
    elif "band" in entry:
        own["band"] = _value(entry, "band", "1", where)
    return _checked(lambda: _REQUIREMENTS[key](**own), where)


def _bounds(said: Any, where: str) -> Bounds:
    rows = said if isinstance(said, list) else []
    proper = len(rows) > 0 and all(isinstance(row, list) and len(row) == 3 for row in rows)
    require(proper, f'{where}: write instants with a lower and an upper bound, [["0 s", "-10 %", "110 %"], ...]')
    return tuple(
        (read_value(t, "s", where=where), read_value(low, "1", where=where), read_value(up, "1", where=where))
        for t, low, up in rows
    )


def _own(key: str) -> tuple[str, ...]:
    return (_OWN[key],) if key in _OWN else ()


def _fill(document: tomlkit.TOMLDocument, tuned: ParameterSet, source: str | Path) -> None:
    for section in ("pid", "dither"):
        for key, entry in document.unwrap().get(section, {}).items():
            if isinstance(entry, dict) and entry.get("free", False):
                found = tuned[f"{section}.{key}"]
                given = read_parameter(entry, replace(found, free=True), f"{source}: [{section}] {key}")
                write_parameter(document, f"{section}.{key}", replace(given, value=found.value), given)


def _value(entries: Mapping[str, Any], key: str, unit: str, where: str) -> float:
    return read_value(entries[key], unit, where=f"{where} {key}")


def _checked(make: Callable[[], T], where: str) -> T:
    """Say where, when what was read does not fit together."""
    try:
        return make()
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
