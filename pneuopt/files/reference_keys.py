"""The keys of a [[reference]] in a tuning.toml: of a step, of a move, and of a path from a table."""

from collections.abc import Mapping
from dataclasses import replace

from pneuopt.control.moves import Move, MoveProfile
from pneuopt.control.reference import Step
from pneuopt.quantities.keys import Key, Takes, choice, table

_PUSH = Key("by how much it changes", unit="{own}", example='"50 N"')
_KNOWN = Key("its value at time 0", unit="{own}", example='"250 mm"')
_OF_A_MOVE, _HAS_AN_END = "of a move", "of a move or a path"
_SHARED_KEYS: Mapping[str, Key] = {
    "initial": Key("value before", unit="{measured}", usual=Step.initial),
    "at": Key("when it begins", unit="s", usual=Step.at),
    "start": table("what else is known of the plant at time 0", {}, others=_KNOWN, named="output"),
    "disturbance": table("what changes of the plant at that instant", {}, others=_PUSH, named="parameter or input"),
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
MOVE_KEYS: Mapping[str, Key] = {
    "move": Key(
        "distance of a move from rest to rest",
        unit="{difference}",
        example='"200 mm"',
        condition="in place of step and horizon",
    ),
    "moves": Key(
        "distances of moves one after the other, or tables { distance, speed, dwell, ... } with limits of their own; "
        "metrics are of the last",
        Takes.LIST,
        "{difference}",
        example='["200 mm", "-200 mm"]',
        condition="in place of move",
    ),
    "speed": Key("its largest speed", unit="{measured}/s", example='"0.5 m/s"', condition="required of a move"),
    "acceleration": Key(
        "its largest acceleration", unit="{measured}/s^2", example='"5 m/s^2"', condition="required of a move"
    ),
    "jerk": Key("its largest jerk", unit="{measured}/s^3", example='"100 m/s^3"', condition=_OF_A_MOVE),
    "profile": replace(
        choice("its shape", {kind.value: kind for kind in MoveProfile}, Move.profile.value), condition=_OF_A_MOVE
    ),
    "dwell": Key("from its end to the end of the experiment", unit="s", usual=Move.dwell, condition=_HAS_AN_END),
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
OWN_MOVE_KEYS: Mapping[str, Key] = {
    "distance": replace(MOVE_KEYS["move"], condition="of one of several moves"),
    **{n: MOVE_KEYS[n] for n in ("speed", "acceleration", "jerk", "profile", "dwell")},
}
"""Those of one of several moves."""
REFERENCE_KEYS: Mapping[str, Key] = {**STEP_KEYS, **MOVE_KEYS, **PATH_KEYS}
"""All of them."""
