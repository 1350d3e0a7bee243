"""The keys of a tuning.toml, and the readers of its parts: requirements, spreads, [method], and the loop itself.

The values of a loop's parts are parameters ("pid.Kp" is the key Kp of [pid]), which the parts declare themselves.
Words in braces in a unit stand for the units of the loop's signals (`signal_units`).
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from pneuopt.control.compensators import COMPENSATORS, Compensator
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.gain_schedule import SCHEDULED_GAINS, GainSchedule
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveProfile
from pneuopt.control.pid import PID, AntiWindup, Form
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensedSignal, SensorLag
from pneuopt.control.tolerances import FAULT_SAMPLES
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System
from pneuopt.dynamics.tolerances import MAX_STEPS
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.limit_cycle import NoHunting
from pneuopt.evaluation.metric import Band, Requirement, Tolerance
from pneuopt.evaluation.requirements import REQUIREMENT_KINDS, SettlingTime, StepEnvelope
from pneuopt.evaluation.scenarios import DISTRIBUTIONS, TOGETHER, Distribution, Sampling, Spread
from pneuopt.files.drive import ambient_pressure
from pneuopt.files.tolerances import MAX_CASES, SAMPLE_TIME
from pneuopt.files.toml import construct_at, read_parameter
from pneuopt.quantities.errors import InputError, UnitError, check_names, require
from pneuopt.quantities.keys import (
    Key,
    Takes,
    argument_meanings,
    choice,
    first_sentence,
    flag,
    parameter_key,
    read_entry,
    read_table,
    table,
)
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.units import count_gauge_from, difference_unit, read_value, write_value
from pneuopt.tuning.method import Method
from pneuopt.tuning.tune import METHODS

REQUIREMENTS_BY_KEY: Mapping[str, type[Requirement]] = {
    re.sub("(?<=[a-z])(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in REQUIREMENT_KINDS
}
"""By its key each kind of requirement."""

NORMAL_VOLUME = "(ANR)"  # what a volume of air is followed by that counts at ISO 8778's state


def bound_units(loop: ClosedLoop) -> dict[str, str]:
    """The unit of each requirement's bound, by key; "1" of what is a number alone."""
    command, measured = loop.command.unit, loop.feedback.unit.partition("(")[0]
    units = {key: kind.metric.unit_in(command, measured) for key, kind in REQUIREMENTS_BY_KEY.items()}
    return {key: unit.removesuffix(NORMAL_VOLUME) for key, unit in units.items()}


def read_bound(key: str, given: Any, unit: str, where: str) -> float:
    """Read a requirement's bound, "5 %", 1.4 or "2 l(ANR)", in a unit of `bound_units`."""
    if REQUIREMENTS_BY_KEY[key].metric.unit.endswith(NORMAL_VOLUME):
        normal = isinstance(given, str) and given.strip().endswith(NORMAL_VOLUME)
        require(normal, f'{where}: {given!r}: air is counted at 20 degC and 100 kPa (ANR): "2 l(ANR)"', UnitError)
        given = given.strip().removesuffix(NORMAL_VOLUME)
    return read_value(given, unit, where=where)


_PUSH = Key("by how much it changes", unit="{own}", example='"50 N"')
_KNOWN = Key("its value at time 0", unit="{own}", example='"250 mm"')
_OF_A_MOVE, _HAS_AN_END = "of a move", "of a move or a path"
_SHARED_KEYS: Mapping[str, Key] = {
    "initial": Key("value before", unit="{measured}", usual=Step.initial),
    "at": Key("when it begins", unit="s", usual=Step.at),
    "start": table(
        "what else is known of the plant at time 0",
        {},
        others=_KNOWN,
        named="output",
        example='{ position = "250 mm" }',
    ),
    "disturbance": table(
        "what changes of the plant at that instant",
        {},
        others=_PUSH,
        named="parameter or input",
        example='{ "load.force" = "50 N" }',
    ),
}
STEP_KEYS: Mapping[str, Key] = {
    "step": Key(
        "height of the step; required without a move or a disturbance", unit="{difference}", example='"0.1 m/s"'
    ),
    "horizon": Key("end of the experiment", unit="s", example='"1 s"', condition="required of a step"),
    "scale": Key(
        "what fractions are of", unit="{difference}", example='"0.1 m/s"', condition="for a disturbance alone"
    ),
    **_SHARED_KEYS,
}
_DISTANCE = Key("distance of a move from rest to rest", unit="{difference}", example='"200 mm"', required=True)
_MOTION_KEYS: Mapping[str, Key] = {
    "speed": Key("its largest speed", unit="{measured}/s", example='"0.5 m/s"', condition="required of a move"),
    "acceleration": Key(
        "its largest acceleration", unit="{measured}/s^2", example='"5 m/s^2"', condition="required of a move"
    ),
    "jerk": Key("its largest jerk", unit="{measured}/s^3", example='"100 m/s^3"', condition=_OF_A_MOVE),
    "profile": replace(
        choice("its shape", {kind.value: kind for kind in MoveProfile}, Move.profile.value), condition=_OF_A_MOVE
    ),
    "dwell": Key("from its end to the end of the experiment", unit="s", usual=Move.dwell, condition=_HAS_AN_END),
}
OWN_MOVE_KEYS: Mapping[str, Key] = {"distance": _DISTANCE, **_MOTION_KEYS}
"""Those of one of several moves."""
MOVE_KEYS: Mapping[str, Key] = {
    "move": replace(_DISTANCE, required=False, condition="in place of step and horizon"),
    "moves": Key(
        "distances of moves one after the other, or tables { distance, speed, dwell, ... } with limits of their own; "
        "metrics are of the last",
        Takes.LIST,
        "{difference}",
        example='["200 mm", "-200 mm"]',
        condition="in place of move",
        of=Key("a distance, or a table with it", Takes.PARAMETER, "{difference}", keys=OWN_MOVE_KEYS),
        counts=(1, float("inf")),
    ),
    **_MOTION_KEYS,
    **_SHARED_KEYS,
}
PATH_KEYS: Mapping[str, Key] = {
    "path": Key(
        "a table of time and the measured signal, in any format that a log has, beside this file",
        Takes.TEXT,
        example='"path.csv"',
        condition="in place of step or move",
    ),
    **{n: MOVE_KEYS[n] for n in ("dwell", "start", "disturbance")},
}
REFERENCE_KEYS: Mapping[str, Key] = {**STEP_KEYS, **MOVE_KEYS, **PATH_KEYS}
"""All of them."""


SPREAD_KEY = Key("a fraction, or least and largest value", Takes.SPREAD, unit="{own}", example='"30 %"')
_SECOND_IS_FRACTION = ("log_normal",)  # distributions whose second number has no unit
_SECOND_IS_DIFFERENCE = ("normal",)  # and those whose second number is a difference: no pressure level
SPREAD_KEYS: Mapping[str, Key] = {
    "distribution": choice("how it is drawn", DISTRIBUTIONS, "uniform"),
    "spread": Key(
        "a fraction; or two values: least and largest, of normal mean and deviation, of log_normal median and fraction",
        Takes.SPREAD,
        unit="{own}",
        required=True,
        example='"5 %"',
    ),
}
SAMPLE_KEYS: Mapping[str, Key] = {
    "count": Key("how many", Takes.COUNT, usual=20, least=1, most=MAX_CASES),
    "seed": Key("of the random numbers", Takes.COUNT, usual=0, least=0),
    "sampling": choice("how they fill the box", {s.value: s for s in Sampling}, Sampling.RANDOM.value),
}
SAMPLED_KEY = Key(
    "a fraction, least and largest value, or a distribution",
    Takes.SPREAD,
    unit="{own}",
    keys=SPREAD_KEYS,
    example='"30 %"',
)
SAMPLES_KEY = table(
    "plants drawn from a box, or from distributions", SAMPLE_KEYS, others=SAMPLED_KEY, named="parameter"
)
CORNERS_KEY = table('plants at the corners of a box; "a + b" vary together', {}, others=SPREAD_KEY, named="parameter")


@dataclass(frozen=True)
class Draw:
    """How many plants are drawn, and how."""

    count: int
    seed: int
    sampling: Sampling


def read_draw(given: Mapping[str, Any], where: str) -> Draw:
    """Read how plants are drawn; what is left out is as usual."""
    return Draw(**read_table(SAMPLE_KEYS, given, where))


def read_spreads(entries: Mapping[str, Any], where: str, parameters: ParameterSet) -> dict[str, Spread]:
    """Read by which fraction, "30 %", or between which values, ["3 kg", "7 kg"], each pattern of names spreads."""
    return {
        pattern: _read_spread(given, pattern, where, parameters)
        for pattern, given in _flatten(entries, parameters).items()
    }


def read_sample_spreads(
    entries: Mapping[str, Any], where: str, parameters: ParameterSet
) -> dict[str, Spread | Distribution]:
    """Read spreads as `read_spreads` does, and distributions: { distribution = "normal", spread = "5 %" }."""
    found: dict[str, Spread | Distribution] = {}
    for pattern, given in _flatten(entries, parameters).items():
        if not isinstance(given, dict):
            found[pattern] = _read_spread(given, pattern, where, parameters)
            continue
        spot = f"{where} {pattern}"
        stated = read_table(SPREAD_KEYS, given, spot)
        word = given.get("distribution", SPREAD_KEYS["distribution"].usual)
        spread = _read_spread(stated["spread"], pattern, where, parameters, word)
        found[pattern] = construct_at(partial(stated["distribution"], spread), spot)
    return found


def read_corner_spreads(entries: Mapping[str, Any], where: str, parameters: ParameterSet) -> dict[str, Spread]:
    """Read spreads as `read_spreads` does, of which the corners are not too many."""
    many = len(entries) >= MAX_CASES.bit_length()
    require(not many, f"{where}: {len(entries)} parameters have too many corners; take samples")
    return read_spreads(entries, where, parameters)


def _read_spread(given: Any, pattern: str, where: str, parameters: ParameterSet, word: str = "") -> Spread:
    spot = f"{where} {pattern}"
    if not isinstance(given, list):
        return read_value(given, "1", where=spot)
    unit = parameters[parameters.match_names(pattern.split(TOGETHER, maxsplit=1)[0])[0]].unit
    require(len(given) == 2, f'{spot}: write a fraction, "30 %", or two values, the least first')
    second = difference_unit(unit) if word in _SECOND_IS_DIFFERENCE else "1" if word in _SECOND_IS_FRACTION else unit
    with count_gauge_from(ambient_pressure(parameters)):
        return read_value(given[0], unit, where=spot), read_value(given[1], second, where=spot)


def _flatten(entries: Mapping[str, Any], parameters: ParameterSet, prefix: str = "") -> dict[str, Any]:
    """By full name; without quotes, TOML reads `load.mass` as a table within a table."""
    found: dict[str, Any] = {}
    for key, entry in entries.items():
        name = f"{prefix}{key}"
        is_spread = (
            name in parameters
            or "*" in name
            or TOGETHER in name
            or not isinstance(entry, dict)
            or SPREAD_KEYS.keys() & entry.keys()
        )
        found |= {name: entry} if is_spread else _flatten(entry, parameters, f"{name}.")
    return found


REPLACED_METHODS = {
    "screening": "racing",
    "condensed": "racing",
}  # in files of older versions


def _option_key(usual: Any, meaning: str = "", condition: str = "", most: int = 1_000_000) -> Key:
    """The key of an option; more than `most` would fill the memory."""
    if isinstance(usual, tuple):
        return Key(meaning, Takes.LIST, usual=usual, condition=condition, of=_option_key(usual[0]))
    if isinstance(usual, float):
        return Key(meaning, usual=usual, condition=condition)
    return Key(meaning, Takes.COUNT, usual=usual, condition=condition, least=-most, most=most)


METHOD_KEYS: Mapping[str, Mapping[str, Key]] = {
    name: {
        f.name: _option_key(f.default, argument_meanings(kind).get(f.name, ""), f'with kind = "{name}"')
        for f in fields(kind)
        if isinstance(f.default, int | float | tuple)
    }
    for name, kind in METHODS.items()
}
"""The options of each method that a file can state: numbers, and lists of them."""


_METHODS_BY_OPTION = Counter(n for keys in METHOD_KEYS.values() for n in keys)
METHOD_SECTION = table(
    "how the search goes; by default the loop decides",
    {
        "kind": choice("method", METHODS),
        **{  # an option that several methods have says of which its usual value is
            n: replace(key, condition=f"usual {key.condition}" if _METHODS_BY_OPTION[n] > 1 else key.condition)
            for keys in METHOD_KEYS.values()
            for n, key in keys.items()
        },
    },
)


def read_method(entries: Mapping[str, Any], where: str) -> Method | None:
    """Read a tuning method; None, so that the loop decides, of an empty section."""
    if not entries:
        return None
    name = str(entries.get("kind"))
    if name in REPLACED_METHODS:
        successor = REPLACED_METHODS[name]
        known = ", ".join(METHOD_KEYS[successor])
        raise InputError(f"{where}: {name!r} is gone; write kind = {successor!r}, whose options are {known}")
    chosen = {"kind": METHOD_SECTION.keys["kind"]}
    kind: type[Method] = read_table(chosen, entries, where, partial=True)["kind"]
    values = read_table({**chosen, **METHOD_KEYS[name]}, entries, where)
    return construct_at(lambda: kind(**{n: values[n] for n in entries if n != "kind"}), where)


ACCEPT_KEY = "accept"
"""Top-level key of the defects with which a design is certified all the same."""
ROBUST_KEY = "robust"
"""Top-level key that asks for a design which also holds on other plants."""


def _words(kind: type[Enum]) -> dict[str, Enum]:
    return {member.value: member for member in kind}


LOOP_KEYS: Mapping[str, Mapping[str, Key]] = {
    "loop": {
        "measured": Key("output that is fed back; by default speed, or the only one", Takes.TEXT, example='"speed"'),
        "actuated": Key("input that the controller drives; by default the only one", Takes.TEXT, example='"force"'),
    },
    "pid": {
        "form": choice("which gains are stated", _words(Form), Form.PARALLEL.value),
        "sample_time": Key("time between samples; without it the controller is continuous", unit="s", example='"1 ms"'),
        "delay": Key("samples from reading to acting", Takes.SAMPLES, usual=0, example='"1 sample"'),
        "anti_windup": choice(
            "what keeps the integral at bay at a limit", _words(AntiWindup), AntiWindup.BACK_CALCULATION.value
        ),
        "limits": Key(
            "least and largest command",
            Takes.LIST,
            "{command}",
            example='["-5 V", "5 V"]',
            of=Key("a command", unit="{command}"),
            counts=(2, 2),
        ),
    },
    PositionLoop.section: {},
    "dither": {
        "waveform": choice("shape of the oscillation", _words(Waveform), Waveform.SINE.value),
        "analogue": flag("whether a generator behind the sampled controller adds it"),
    },
    "sensor": {
        "lag": Key("lag with which the controller sees the signal", unit="s", example='"5 ms"'),
        "resolution": Key("one count of an encoder, in place of a lag", unit="{position}", example='"10 um"'),
        "filter": Key("time constant of the encoder's low-pass", unit="s", usual=Encoder.filter),
    },
    "feedforward": {},
    **{
        section: {
            f.name: choice(first_sentence(type(f.default)), _words(type(f.default)), f.default.value)
            for f in fields(part)
        }
        for section, part in COMPENSATORS.items()
    },
    GainSchedule.section: {},
}
"""By section the keys that choose how a loop is built, and those of its sensor."""

LOOP_MEANINGS: Mapping[str, str] = {
    "loop": "which signals the controller connects",
    "pid": "the controller, with its first gain at least",
    PositionLoop.section: "makes it a cascade: the position's error sets the speed that the PID controls",
    "sensor": "what the controller sees of the signal: a lag, or an encoder",
    "dither": "a small oscillation added to the command",
    "feedforward": "what a change of the reference adds to the command",
    **{section: first_sentence(part) for section, part in COMPENSATORS.items()},
    GainSchedule.section: "gains that change with the position and the load",
}


def _read_band(entry: Any, where: str, units: Mapping[str, str]) -> Band:
    """A fraction of the step, or a half width in the measured unit."""
    try:
        return read_value(entry, "1", where=where)
    except UnitError:
        width = units["measured"].partition("(")[0]
    try:
        return construct_at(lambda: Tolerance(read_value(entry, width, where=where)), where)
    except UnitError as error:
        raise UnitError(f'{error}, or as a fraction of the step, band = "2 %"') from None


def _read_envelope_row(row: Any, where: str, _: Mapping[str, str]) -> tuple[float, float, float]:
    proper = isinstance(row, list) and len(row) == 3
    require(proper, f'{where}: write instants with a lower and an upper bound, [["0 s", "-10 %", "110 %"], ...]')
    instant, low, up = (read_value(v, unit, where=where) for v, unit in zip(row, ("s", "1", "1"), strict=True))
    return instant, low, up


OBJECTIVE_KEYS: Mapping[str, Key] = {"weight": Key("its share of the objective", usual=1.0, least=0.0, is_open=True)}
_ENVELOPE = Key(
    "rows of instant, lower and upper bound",
    Takes.LIST,
    example='[["0 s", "-10 %", "110 %"]]',
    required=True,
    of=Key("an instant, its lower and its upper bound", Takes.LIST, read=_read_envelope_row),
    counts=(1, float("inf")),
)
_BAND = Key('half width of the band, a fraction of the step or as "0.1 mm"', usual=SettlingTime.band, read=_read_band)
EXTRA_KEYS: Mapping[str, Mapping[str, Key]] = {
    "settling_time": {"band": _BAND, "mean": flag("whether the mean counts, not the signal with its ripple")},
    "settling_time_raw": {"band": _BAND},
    "step_envelope": {"bounds": _ENVELOPE},
}
"""The keys of some requirements beside their limit and weight."""

_TOLERANCE = Key("a fraction of the gain", example='"1 %"')
SCENARIO_KEYS: Mapping[str, Key] = {
    "corners": CORNERS_KEY,
    "samples": SAMPLES_KEY,
    "tolerances": table("gains off by so much, either way", {}, others=_TOLERANCE, named="gain"),
}

BUDGET_KEYS: Mapping[str, Key] = {
    "steps": Key("steps of the simulations that are refused as too many", usual=MAX_STEPS, least=0.0, is_open=True),
}


NO_HUNTING_KEY = "no_hunting"
"""Key under [limits] of `NoHunting`, which has no metric."""
_REPEATABILITY = Key("largest range of its errors at rest over the references", unit="{difference}", example='"0.1 mm"')
NO_HUNTING_KEYS: Mapping[str, Key] = {
    "duration": Key("for how long it is watched", unit="s", usual=NoHunting.duration),
    "repeatability": _REPEATABILITY,
}
_NO_HUNTING = Key(
    "the loop comes to rest, watched for so long on the rig's model",
    Takes.PARAMETER,
    "s",
    keys=NO_HUNTING_KEYS,
    condition="with --rig",
    example='"60 s"',
)


def objective_key(name: str) -> Key:
    """The key of a requirement under [minimise]."""
    return table(first_sentence(REQUIREMENTS_BY_KEY[name]), {**OBJECTIVE_KEYS, **EXTRA_KEYS.get(name, {})})


def limit_key(name: str) -> Key:
    """The key of a requirement under [limits]: a bound, or a table with it."""
    kind = REQUIREMENTS_BY_KEY[name]
    bound, unit = kind.metric.sense.value, kind.metric.unit
    usual = StepEnvelope.max if name == "step_envelope" else None
    example = '"5 %"' if kind.metric.percent else "1.5" if unit == "1" else f'"1 {unit}"'
    read = None
    if unit.endswith(NORMAL_VOLUME):

        def read(entry: Any, where: str, _: Mapping[str, str]) -> float:
            return read_bound(name, entry, unit.removesuffix(NORMAL_VOLUME), where)

    own = Key("the bound", unit=unit, usual=usual, example=example, required=usual is None, read=read)
    keys = {bound: own, **EXTRA_KEYS.get(name, {})}
    return Key(first_sentence(kind), Takes.PARAMETER, unit, keys=keys, example="" if "{" in unit else example)


def signal_units(command: str, measured: str, position: str = "m") -> dict[str, str]:
    """The units that the words in braces stand for."""
    return {
        "command": command,
        "measured": measured,
        "difference": difference_unit(measured),
        "position": position,
        "own": "its own",
    }


def signal_units_of(loop: ClosedLoop) -> dict[str, str]:
    """The units that the words in braces stand for in a loop."""
    axis, units = loop.plant.axis, {q.name: q.unit for q in loop.plant.outputs}
    position = "m" if axis is None else units.get(axis.position, "m")
    return signal_units(loop.command.unit, loop.feedback.unit, position)


LIMIT_KEYS: Mapping[str, Key] = {**{n: limit_key(n) for n in REQUIREMENTS_BY_KEY}, NO_HUNTING_KEY: _NO_HUNTING}
"""What [limits] may hold."""
TUNING_KEYS: Mapping[str, Key] = {
    ACCEPT_KEY: Key(
        "defects with which a design is certified all the same",
        Takes.LIST,
        choices=_words(Defect),
        usual=[],
        example='["hunts"]',
        named="defect",
    ),
    ROBUST_KEY: flag("whether a design is sought that also holds on other plants; false: the best on the model", True),
    **{n: table(LOOP_MEANINGS[n], keys, required=n == "pid") for n, keys in LOOP_KEYS.items()},
    "reference": table("a step or a move to follow; one or more", REFERENCE_KEYS, takes=Takes.TABLES, required=True),
    "minimise": table("what shall be small, weighted", {n: objective_key(n) for n in REQUIREMENTS_BY_KEY}),
    "limits": table("what shall be kept", LIMIT_KEYS),
    "scenarios": table("other plants and gains for which it shall hold, too", SCENARIO_KEYS),
    "method": METHOD_SECTION,
    "budget": table("what a search may take", BUDGET_KEYS),
}
"""All sections; the parameters of the loop's parts come beside the keys of their sections."""


_CONDITIONS = {"Tt": "with limits, for back-calculation", "reset_band": "with reset_ratio"}
_SECTION_CONDITIONS = {
    "position_loop": "where a position is controlled",
    GainSchedule.section: "with low, high and a coefficient",
    "pressure_feedback": "where the plant shows both pressures",
}
_SAMPLED = "with sample_time; never free"
_LIMITS = ("lower", "upper")  # parameters that a file states as a pair, limits


FIRST_PARAMETERS: Mapping[str, str] = {
    PositionLoop.section: "Kp",
    "dither": "frequency",
    "feedforward": "gain",
    **{section: part.size for section, part in COMPENSATORS.items()},
    GainSchedule.section: "low",
}
"""The parameter that a file must state of each part beside the PID."""


def tuning_keys(command: str = "command", measured: str = "measured") -> Mapping[str, Key]:
    """All sections of a tuning.toml with all their keys, for signals of these units."""
    signal = SensedSignal(Quantity("measured", measured), {}, SAMPLE_TIME)
    gains: dict[str, Key] = {}  # those of every form, and what is shared; those of some forms say which
    for form in Form:
        pid = PID(SAMPLE_TIME, form=form, dead_band=True, reset=True).parameters(measured, command)
        for name in (n for n in pid if n not in _LIMITS and n not in gains):
            forms = [f'"{f.value}"' for f in Form if name in f.gains]
            own = f"form = {' or '.join(forms)}" if 0 < len(forms) < len(Form) else ""
            gains[name] = parameter_key(pid[name], own or _CONDITIONS.get(name, ""))
    gains |= {n: replace(gains[n], takes=Takes.NUMBER, condition=_SAMPLED) for n in ("fault_samples", "fault_output")}
    centre = "safe output after that many, on the wire as limits are; default: where the valve is closed, its centre"
    gains["fault_output"] = replace(gains["fault_output"], meaning=centre, usual=None, example='"0 V"')
    parts = {
        "pid": gains,
        PositionLoop.section: _parameter_keys(PositionLoop().parameters(measured, f"{measured}/s")),
        "dither": _parameter_keys(Dither().parameters(command)),
        "feedforward": _parameter_keys(Feedforward().parameters(measured, command)),
        **{name: _parameter_keys(part().parameters(signal, command)) for name, part in COMPENSATORS.items()},
        GainSchedule.section: _parameter_keys(GainSchedule(SCHEDULED_GAINS, 0.0, 1.0, 1.0).parameters("m", "kg")),
    }
    for section, first in FIRST_PARAMETERS.items():
        parts[section][first] = replace(parts[section][first], required=True)
    for section, condition in _SECTION_CONDITIONS.items():
        parts[section] = {n: replace(key, condition=condition) for n, key in parts[section].items()}
    return {n: replace(key, keys={**key.keys, **parts.get(n, {})}) for n, key in TUNING_KEYS.items()}


def _parameter_keys(parameters: ParameterSet) -> dict[str, Key]:
    return {n: parameter_key(p) for n, p in parameters.items()}


TuningSections = Mapping[str, Any]

TUNABLE_SECTIONS = ("pid", PositionLoop.section, "dither", "feedforward", *COMPENSATORS, GainSchedule.section)
"""Sections whose values may be free."""

_SHARED_PID_KEYS = ("b", "c", "Tt")
_GAIN_CORRECTIONS: Mapping[Form, Mapping[str, str]] = {
    Form.PARALLEL: {"K": "Kp", "Ti": "Ki = Kp/Ti", "Td": "Kd = Kp Td", "N": "Tf = Td/N"},
    Form.STANDARD: {"K": "Kp", "Ki": "Ti = Kp/Ki", "Kd": "Td = Kd/Kp", "Tf": "N = Td/Tf"},
    Form.SERIES: {"Kp": "K", "Ki": "Ti = K/Ki", "Kd": "Td = Kd/K", "N": "Tf"},
}


def read_loop_sections(
    table: TuningSections, plant: System, path: str | Path, centre: float = 0.0
) -> tuple[ClosedLoop, ParameterSet]:
    """The loop and its parameters; limits in the file are those of the wire, the loop's are about `centre`."""
    wiring = {n: s for n, s in read_table(LOOP_KEYS["loop"], table.get("loop", {}), f"{path}: [loop]").items() if s}
    for section, first in FIRST_PARAMETERS.items():
        message = f"{path}: [{section}] has no {first}, without which it does nothing; write {first}"
        require(section not in table or first in table[section], message)
    pid = _pid(table["pid"], f"{path}: [pid]")
    dither, lead = None, None
    if "dither" in table:
        given, where = table["dither"], f"{path}: [dither]"
        read = read_table(LOOP_KEYS["dither"], given, where, partial=True)
        frequency = read_parameter(given["frequency"], Parameter(1.0, "Hz"), f"{where} frequency").value
        dither = construct_at(partial(Dither, frequency, read["analogue"], read["waveform"]), where)
    sensor = _sensor(table["sensor"], plant, f"{path}: [sensor]") if "sensor" in table else None
    if "feedforward" in table:
        given, where, usual = table["feedforward"], f"{path}: [feedforward]", Parameter(1.0, "s")
        stated = (read_parameter(given["time"], usual, f"{where} time").value,) if "time" in given else ()
        lead = construct_at(partial(Feedforward, *stated), where)
    parts = list[Compensator]()
    for section in (n for n in COMPENSATORS if n in table):
        where = f"{path}: [{section}]"
        kind: Callable[..., Compensator] = COMPENSATORS[section]
        chosen = read_table(LOOP_KEYS[section], table[section], where, partial=True)
        parts.append(construct_at(partial(kind, **chosen), where))
    outer = PositionLoop() if PositionLoop.section in table else None
    schedule = _schedule(table["schedule"], plant, f"{path}: [schedule]") if "schedule" in table else None
    made = partial(ClosedLoop, plant, pid, dither, **wiring, sensor=sensor, schedule=schedule)
    loop = construct_at(lambda: made(feedforward=lead, compensators=tuple(parts), outer=outer), str(path))
    return loop, _parameters(table, loop, path, centre)


def _pid(table: Mapping[str, Any], where: str) -> PID:
    keys = {n: key for n, key in LOOP_KEYS["pid"].items() if n != "limits"}  # their unit is the loop's
    read = read_table(keys, table, where, partial=True)
    form: Form = read["form"]
    own, first = (*form.gains, *_SHARED_PID_KEYS), form.gains[0]
    for key in table:
        meant = _GAIN_CORRECTIONS[form].get(key)
        message = f"{key} does not belong to the {form.value} form, which has {', '.join(own)}; say {meant}"
        require(meant is None, f"{where} {message}")
    require(first in table, f"{where} has no gain; write at least {first}")
    require("Tt" not in table or "limits" in table, f"{where} Tt unwinds the integral at limits; write limits, too")
    banded, resets = "dead_band" in table, "reset_ratio" in table
    told = "reset_band is that of resets; write reset_ratio, too, 1 for the whole integral"
    require(resets or "reset_band" not in table, f"{where} {told}")
    unwinds = read["anti_windup"]
    told = "Tt is back-calculation's; clamping has none; leave it out"
    require("Tt" not in table or unwinds is AntiWindup.BACK_CALCULATION, f"{where} {told}")
    made = partial(PID, read["sample_time"], "limits" in table, form, read["delay"], banded, unwinds, resets)
    return construct_at(made, where)


def _sensor(table: Mapping[str, Any], plant: System, where: str) -> SensorLag | Encoder:
    usual = Encoder() if plant.axis is None else Encoder(position=plant.axis.position)
    units = {"position": {q.name: q.unit for q in plant.outputs}.get(usual.position, "m")}
    read = read_table(LOOP_KEYS["sensor"], table, where, units=units)
    message = 'write lag = "5 ms", or of an encoder resolution = "10 um" and filter = "5 ms"'
    require(bool(table), f"{where} has no lag; {message}")
    require("lag" not in table or len(table) == 1, f"{where} has a lag or an encoder, not both; {message}")
    if "lag" in table:
        return construct_at(lambda: SensorLag(read["lag"]), where)
    return construct_at(lambda: replace(usual, **{key: read[key] for key in table}), where)


def _schedule(table: Mapping[str, Any], plant: System, where: str) -> GainSchedule:
    """A schedule of the gains whose coefficients are stated."""
    message = f'{where} has no high, the other end of the stroke; write low = "0 mm" and high = "200 mm", say'
    require("high" in table, message)
    axis, units = plant.axis or Axis(), {q.name: q.unit for q in plant.outputs}
    unit = units.get(axis.position, "m")
    low, high = (read_parameter(table[key], Parameter(0.0, unit), f"{where} {key}").value for key in ("low", "high"))
    load = None
    if "load" in table:
        inertia = plant.parameters.get(axis.inertia)
        load = read_parameter(table["load"], Parameter(1.0, inertia.unit if inertia else "1"), f"{where} load").value
    gains = GainSchedule.stated_gains(table)
    example = "Kp_slope = { value = 0, lower = -1, upper = 1, free = true }"
    require(bool(gains), f"{where} schedules no gain; write a coefficient such as {example}")
    return construct_at(lambda: GainSchedule(gains, low, high, load, axis.position), where)


def _parameters(table: TuningSections, loop: ClosedLoop, path: str | Path, centre: float) -> ParameterSet:
    own = loop.controller.parameters
    read = _read_limits(table["pid"], own, centre, f"{path}: [pid] limits")
    for section in TUNABLE_SECTIONS:
        entries, where, first = table.get(section, {}), f"{path}: [{section}]", len(section) + 1
        keys = [n[first:] for n in own if n.startswith(f"{section}.") and n[first:] not in _LIMITS]
        check_names("key", entries, (*LOOP_KEYS[section], *keys), where)
        names = {k: f"{section}.{k}" for k in keys if k in entries}
        read |= {name: read_parameter(entries[k], own[name], f"{where} {k}") for k, name in names.items()}
    for key in loop.pid.fixed_parameters:
        given = read.get(f"pid.{key}")
        message = f"{key} says what the machine does in a fault, which no search decides; take free = true out"
        require(given is None or not given.free, f"{path}: [pid] {message}")
    count, safe = read.get("pid.fault_samples"), read.get("pid.fault_output")
    whole = count is None or (count.value >= 1 and count.value == round(count.value))
    message = f"fault_samples is a whole number of samples, 1 at least; the default is {FAULT_SAMPLES:g}"
    require(whole, f"{path}: [pid] {message}")
    if safe is not None:  # about the valve's centre, from that on the wire
        read["pid.fault_output"] = replace(safe, value=safe.value - centre)
    for name in (n for n, p in read.items() if p.free):
        section, _, key = name.partition(".")
        finite = abs(read[name].lower) < float("inf") and abs(read[name].upper) < float("inf")
        require(finite, f"{path}: [{section}] {key} is free, so it needs both bounds: lower and upper")
    parameters = own | ParameterSet(read)
    construct_at(lambda: loop.check(parameters), str(path))
    return parameters


def _read_limits(entries: Mapping[str, Any], own: ParameterSet, centre: float, where: str) -> dict[str, Parameter]:
    """Limits of the command about the valve's centre, from those on the wire."""
    if "limits" not in entries:
        return {}
    ends, unit = entries["limits"], own["pid.lower"].unit
    low, high = read_entry(LOOP_KEYS["pid"]["limits"], ends, where, {"command": unit})
    require(low < high, f"{where}: {ends[0]} is not below {ends[1]}")
    wire = [write_value(v, unit, 2) for v in (0.0, 2 * centre)]
    remedy = f'write what the wire may carry, limits = ["{wire[0]}", "{wire[1]}"] for instance'
    inside, own_centre = centre == 0 or low < centre < high, write_value(centre, unit, 3)
    require(
        inside, f"{where}: the valve's centre, {own_centre}, does not lie between {ends[0]} and {ends[1]}; {remedy}"
    )
    ends = {"pid.lower": low - centre, "pid.upper": high - centre}
    return {name: replace(own[name], value=value) for name, value in ends.items()}
