"""The keys of a tuning.toml, by which `loop` and `tuning` read it.

The values of a loop's parts are parameters ("pid.Kp" is the key Kp of [pid]), which the parts declare themselves.
Words in braces in a unit stand for the units of the loop's signals (`signal_units`).
"""

from collections.abc import Mapping
from dataclasses import fields
from enum import Enum

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.controller import PositionLoop
from pneuopt.control.dither import Waveform
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.pid import AntiWindup, Form
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import MAX_STEPS
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.requirements import SettlingTime, StepEnvelope
from pneuopt.evaluation.rest_check import NoHunting
from pneuopt.files.method import METHOD_SECTION
from pneuopt.files.reference_keys import REFERENCE_KEYS
from pneuopt.files.requirements import REQUIREMENTS_BY_KEY
from pneuopt.files.spreads import CORNERS_KEY, SAMPLES_KEY
from pneuopt.quantities.keys import Key, Takes, choice, first_sentence, flag, table
from pneuopt.quantities.unit_algebra import difference_unit

ACCEPT_KEY = "accept"
"""Top-level key of the defects with which a design is certified all the same."""


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
        "limits": Key("least and largest command", Takes.LIST, "{command}", example='["-5 V", "5 V"]'),
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

OBJECTIVE_KEYS: Mapping[str, Key] = {"weight": Key("its share of the objective", usual=1.0)}
_ENVELOPE = Key("rows of instant, lower and upper bound", Takes.LIST, example='[["0 s", "-10 %", "110 %"]]')
EXTRA_KEYS: Mapping[str, Mapping[str, Key]] = {
    "settling_time": {
        "band": Key('half width of the band, a fraction of the step or as "0.1 mm"', usual=SettlingTime.band)
    },
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
    "steps": Key("steps of the simulations that are refused as too many", usual=MAX_STEPS),
}


NO_HUNTING_KEY = "no_hunting"
"""Key under [limits] of `NoHunting`, which has no metric."""
_REPEATABILITY = Key("largest range of its errors at rest over the references", unit="{measured}", example='"0.1 mm"')
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
    keys = {bound: Key("the bound", unit=unit, usual=usual, example=example), **EXTRA_KEYS.get(name, {})}
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


TUNING_KEYS: Mapping[str, Key] = {
    ACCEPT_KEY: Key(
        "defects with which a design is certified all the same", Takes.LIST, choices=_words(Defect), usual=[]
    ),
    **{n: table(LOOP_MEANINGS[n], keys, required=n == "pid") for n, keys in LOOP_KEYS.items()},
    "reference": table("a step or a move to follow; one or more", REFERENCE_KEYS, takes=Takes.TABLES, required=True),
    "minimise": table("what shall be small, weighted", {n: objective_key(n) for n in REQUIREMENTS_BY_KEY}),
    "limits": table(
        "what shall be kept", {n: limit_key(n) for n in REQUIREMENTS_BY_KEY} | {NO_HUNTING_KEY: _NO_HUNTING}
    ),
    "scenarios": table("other plants and gains for which it shall hold, too", SCENARIO_KEYS),
    "method": METHOD_SECTION,
    "budget": table("what a search may take", BUDGET_KEYS),
}
"""All sections; the parameters of the loop's parts come beside the keys of their sections."""
