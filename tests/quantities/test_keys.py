"""Entries that a key takes; the words for those that it does not take, which all files share, are in test_messages."""

from enum import Enum
from typing import Any

import pytest

from pneuopt.quantities.errors import InputError, UnitError
from pneuopt.quantities.keys import Key, Takes, check_sections, choice, flag, read_named, read_table, table


class Shape(Enum):
    SINE = "sine"
    SQUARE = "square"


SHAPES = {shape.value: shape for shape in Shape}
MOVE = {"distance": Key("how far", unit="{own}", required=True), "speed": Key("how fast", unit="m/s")}
KEYS = {
    "name": Key("its name", Takes.TEXT, example='"left"'),
    "softly": flag("whether it brakes softly"),
    "shape": choice("its shape", SHAPES, "sine"),
    "shapes": Key("several", Takes.LIST, choices=SHAPES, usual=["sine"], named="shape"),
    "count": Key("how many", Takes.COUNT, usual=3, least=2, most=9),
    "seed": Key("of a draw", Takes.COUNT, least=0),
    "weight": Key("its weight", usual=1.0, least=0.0, is_open=True),
    "share": Key("of the step", least=0.0, most=1.0, is_open=True),
    "delay": Key("from reading to acting", Takes.SAMPLES, usual=0),
    "limits": Key("both ends", Takes.LIST, of=Key("an end", unit="{own}"), counts=(2, 2), example='["-5 V", "5 V"]'),
    "move": Key("a distance, or a table", Takes.PARAMETER, keys=MOVE),
    "moves": Key("several", Takes.LIST, of=Key("a move", Takes.PARAMETER, keys=MOVE), counts=(1, 9)),
    "own": Key("read by a function", read=lambda entry, where, units: (entry, where, units["own"])),
    "inner": table("a table", {"gain": Key("a gain", unit="V", usual=2.0)}),
}
READ = {
    "name": ("left", "left"),
    "softly": (True, True),
    "shape": ("square", Shape.SQUARE),
    "shapes": (["square", "sine"], (Shape.SQUARE, Shape.SINE)),
    "count": (9, 9),
    "seed": (0, 0),
    "weight": ("20 %", 0.2),
    "share": (0.5, 0.5),
    "delay": ("1 sample", 1),
    "limits": (["-5 V", "500 mV"], (-5.0, 0.5)),
    "move": ("3 V", {"distance": 3.0, "speed": None}),
    "moves": (["3 V", {"distance": "1 V", "speed": "1 mm/s"}], None),
    "own": (7, (7, "f.toml: [part] own", "V")),
    "inner": ({"gain": "1 mV"}, {"gain": 1e-3}),
}


def read(entries: dict[str, Any], **options: Any) -> dict[str, Any]:
    return read_table(KEYS, entries, "f.toml: [part]", units={"own": "V"}, **options)


def test_what_is_left_out_is_as_usual() -> None:
    usual = {"softly": False, "shape": Shape.SINE, "shapes": (Shape.SINE,), "count": 3, "weight": 1.0, "delay": 0}
    assert read({}) == dict.fromkeys(KEYS) | usual | {"inner": {"gain": 2.0}}


@pytest.mark.parametrize("name", READ)
def test_an_entry_is_read_as_its_key_declares_it(name: str) -> None:
    entry, value = READ[name]
    value = ({"distance": 3.0, "speed": None}, {"distance": 1.0, "speed": 1e-3}) if name == "moves" else value
    assert read({name: entry})[name] == value


def test_a_required_key_is_asked_for_with_what_it_may_say() -> None:
    keys = {"model": choice("its law", SHAPES), "file": Key("a file", Takes.TEXT, required=True, example='"a.csv"')}
    with pytest.raises(InputError, match=r'^f: \[a\] has no model; write model = "...", one of: sine, square$'):
        read_table(keys, {"file": "b"}, "f: [a]")
    with pytest.raises(InputError, match=r'^f:7: \[a\] has no file; write file = "a.csv"$'):
        read_table(keys, {"model": "sine"}, lambda key: f"f:9: [a] {key}" if key else "f:7: [a]")


def test_what_another_reader_reads_is_passed_over() -> None:
    assert read({"count": 4, "Kp": 2}, partial=True)["count"] == 4


def test_names_of_the_user_are_read_each_in_its_unit() -> None:
    start = table("start", {}, others=Key("", unit="{own}"), named="output", example='{ speed = "1 m/s" }')
    units = {"speed": "m/s", "force": "N"}
    assert read_named(start, {"speed": "1 mm/s", "force": "2 kN"}, units, "f: start") == {"speed": 1e-3, "force": 2e3}
    for entry, said in (
        ({"sped": 1}, "f: start: unknown output 'sped'"),
        (3, "f: start must be a table, got 3; write"),
    ):
        with pytest.raises(InputError, match=said):
            read_named(start, entry, units, "f: start")
    with pytest.raises(UnitError, match="f: start speed: unit 'N' does not measure 'm/s'"):
        read_named(start, {"speed": "1 N"}, units, "f: start")


def test_a_files_sections_are_those_that_are_declared() -> None:
    sections = {"pid": table("the controller", {}, required=True), "method": table("how", {})}
    check_sections(sections, {"pid": {}}, "f.toml")
    for toml, said in (
        ({}, r"^f.toml: no pid; add a section \[pid\]: the controller$"),
        ({"pid": {}, "methd": {}}, "^f.toml: unknown section 'methd'; did you mean 'method'"),
        ({"pid": 3}, r"^f.toml: pid must be a section, \[pid\]$"),
    ):
        with pytest.raises(InputError, match=said):
            check_sections(sections, toml, "f.toml")
