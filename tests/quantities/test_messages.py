"""The words of what `quantities` refuses, beside what triggers them; other tests assert the type and the place."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pneuopt.files.toml import read_toml
from pneuopt.quantities.errors import InputError, UnitError, UnknownNameError, check_names
from pneuopt.quantities.output import MAX_TOML_BYTES, check_output_paths, read_source, write_text
from pneuopt.quantities.parameters import Parameter
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import read_si, read_value, si_conversion, unit_ratio
from tests.quantities.test_keys import read
from tests.quantities.test_parameters import RIG
from tests.quantities.test_trajectories import RUN


class Refusal(NamedTuple):
    """What triggers an error, in a folder for its files, of which type it is, and its words."""

    trigger: Callable[[Path], object]
    error: type[InputError]
    words: str


UNITS: list[tuple[str | float, str, str]] = [
    ("40", "N", "d.toml: '40' has no unit; write \"40 N\""),
    (40, "N", 'd.toml: 40 has no unit; write "40 N"'),
    ("6", "Pa(a)", 'write "6 bar(a)"'),
    ("0,5 mm", "m", 'has a decimal comma; write "0.5 mm"'),
    ("0,5", "1", 'write "0.5"'),
    ("1.234,5 mm", "m", "digits without separators"),
    ("1 000 mm", "m", "digits without separators"),
    ("1_000 mm", "m", "digits without separators"),
    ("1e9999 m", "m", "not one number"),
    ("6 bar", "Pa(a)", 'may be absolute or gauge; write "bar(a)" or "bar(g)"'),
    ("6e5 Pa", "Pa(g)", 'write "Pa(a)" or "Pa(g)"'),
    ("6 bar(g)", "Pa", "mark a pressure level, which is not meant here; write 'bar'"),
    ("6 mm(g)", "m", "write 'mm'"),
    ("6 mm", "Pa(a)", 'write for instance "bar(a)"'),
    ("-2 bar(g)", "Pa(a)", "below vacuum"),
    ("-2 bar(g)", "Pa(g)", "below vacuum"),
    ("-300 degC", "K", "'-300 degC' lies below absolute zero, -273.15 degC; check sign and unit"),
    ("-300 °C", "K", "below absolute zero"),
    ("6 barg", "Pa(a)", "did you mean 'bar(g)'?"),
    ("6 psia", "Pa(a)", "did you mean 'psi(a)'?"),
    ("6 KPA", "Pa", "did you mean 'kPa'?"),
    ("3 MM", "m", "did you mean 'mm'?"),
    ("3 m3", "m^3", "did you mean 'm^3'?"),
    ("3 Newton", "N", "did you mean 'newton'?"),
    ("3 furlong", "m", "unknown unit 'furlong'; write for instance mm"),
    ("3 dB", "1", "unknown unit 'dB'"),
    ("3 m/", "m", "unknown unit 'm/'"),
    ("3 m**1000000000", "m", "unknown unit"),
    ("5 V", "N", "unit 'V' does not measure 'N'"),
    ("80 Hz", "rad/s", "1 Hz is 2 pi rad/s"),
    ("80 Hz", "1/s", "write it in 1/s"),
    ("80 rad/s", "Hz", "write it in Hz"),
    ("80 1/s", "Hz", "write it in Hz"),
    ("3 deg", "1", "does not measure '1'"),
    ("five mm", "m", "is not a number with a unit"),
    ("nan m", "m", "is not a number with a unit"),
    ("", "m", "is not a number with a unit"),
    (True, "1", "is not a number with a unit"),
]
KEYS: list[tuple[dict[str, Any], str]] = [
    ({"nam": "left"}, "f.toml: [part]: unknown key 'nam'; did you mean 'name'?"),
    ({"name": 3}, "f.toml: [part] name must be text, got 3; write name = \"left\""),
    ({"softly": 1}, "f.toml: [part] softly must be true or false, got 1"),
    ({"shape": "sin"}, "f.toml: [part]: unknown shape 'sin'; did you mean 'sine'?"),
    ({"shape": ["sine"]}, "f.toml: [part] shape must be text, got ['sine']"),
    ({"shapes": "sine"}, "f.toml: [part] shapes must be a list, got 'sine'"),
    ({"shapes": ["sin"]}, "f.toml: [part] shapes: unknown shape 'sin'; did you mean 'sine'?"),
    ({"count": True}, "f.toml: [part] count must be a whole number, got True"),
    ({"count": 1}, "f.toml: [part] count must be from 2 to 9, got 1"),
    ({"count": 10}, "f.toml: [part] count must be from 2 to 9, got 10"),
    ({"seed": -1}, "f.toml: [part] seed must be at least 0, got -1"),
    ({"weight": 0}, "f.toml: [part] weight must be positive, got 0"),
    ({"weight": float("inf")}, "f.toml: [part] weight"),
    ({"share": "100 %"}, "f.toml: [part] share must be above 0 and below 1, got 100 %"),
    ({"delay": "2 ms"}, "f.toml: [part] delay: '2 ms' is no number of samples; write delay = \"1 sample\""),
    ({"limits": ["1 V"]}, "f.toml: [part] limits must be a list of 2, got ['1 V']; write limits = [\"-5 V\", \"5 V\"]"),
    ({"limits": ["1 V", "2 m"]}, "f.toml: [part] limits: unit 'm' does not measure 'V'"),
    ({"move": {"speed": "1 m/s"}}, 'f.toml: [part] move has no distance; write distance = "..."'),
    ({"move": "1 m"}, "f.toml: [part] move: unit 'm' does not measure 'V'"),
    ({"moves": []}, "f.toml: [part] moves must be a list of 1 to 9, got []"),
    ({"moves": ["1 V", {}]}, 'f.toml: [part] moves 2 has no distance; write distance = "..."'),
    ({"inner": {"gian": 1}}, "f.toml: [part] inner: unknown key 'gian'; did you mean 'gain'?"),
    ({"inner": {"gain": "1 A"}}, "f.toml: [part] inner gain: unit 'A' does not measure 'V'"),
    ({"inner": 3}, "f.toml: [part] inner must be a table, got 3"),
]  # fmt: skip
PARAMETERS: list[tuple[dict[str, Any], str]] = [
    ({"value": math.nan}, "value is NaN"),
    ({"value": 1.0, "lower": 2.0}, "value 1 N lies outside its bounds [2, inf]; move the value or the bounds"),
    ({"value": 1.0, "lower": 2.0, "upper": 0.0}, "lower bound 2 lies above upper bound 0 N"),
    ({"value": 0.0, "log": True}, "log parameter must be positive, got 0 N"),
    ({"value": 1.0, "upper": math.nan}, "bound"),
]
TRAJECTORIES: list[tuple[Any, dict[str, Any], str]] = [
    ([], {}, "time grid of shape (n,)"),
    ([[0.0, 1.0]], {}, "got (1, 2)"),
    ([0.0, 1.0, 1.0], {}, "sample 2 at 1 s follows 1 s"),
    ([0.0, 2.0, 1.0], {}, "must increase strictly; sample 2 at 1 s follows 2 s"),
    ([0.0, math.nan], {}, "must be finite"),
    ([0.0, math.inf], {}, "must be finite"),
    ([0.0, 1.0], {"speed": [0.0]}, "column 'speed' has shape (1,), time has (2,)"),
]
TOML = [
    (b"a = " + b"[" * 3000 + b"]" * 3000, "too many brackets in brackets"),
    (b"a = " + b"9" * 5000, "not valid TOML"),
    (b"#" * (MAX_TOML_BYTES + 1), "is larger than 128 KiB"),
    (b"a = \xff", "not a text file in UTF-8"),
    (b"a = 1\na = 2", "not valid TOML"),
    (b"a = 1979-99-99", "not valid TOML"),
]


def parse_toml(text: bytes, folder: Path) -> object:
    (folder / "drive.toml").write_bytes(text)
    return read_toml(folder / "drive.toml")


def call(make: Callable[[], object], _: Path) -> object:
    return make()


NAMES = {"speed", "position"}
REFUSALS = [
    *(Refusal(partial(call, partial(read_value, t, u, where="d.toml")), UnitError, said) for t, u, said in UNITS),
    *(Refusal(partial(call, partial(read, e)), InputError, said) for e, said in KEYS),
    *(Refusal(partial(call, partial(Parameter, unit="N", **f)), InputError, said) for f, said in PARAMETERS),
    *(Refusal(partial(call, partial(Trajectory, t, c)), InputError, said) for t, c, said in TRAJECTORIES),
    *(Refusal(partial(parse_toml, t), InputError, said) for t, said in TOML),
    Refusal(lambda _: read_value("1e999 N", "N"), UnitError, "1e999 is larger than any number that is measured"),
    Refusal(lambda _: read_value("9" * 4301 + " N", "N"), UnitError, "a number of 4301 characters; round it"),
    Refusal(lambda _: read_value("2 %%", "1"), UnitError, "unknown unit '%%'"),
    Refusal(lambda _: read_si("-300 degC"), UnitError, "below absolute zero"),
    Refusal(lambda _: read_si("6 bar", where="run.toml"), UnitError, "run.toml: a pressure level in 'bar' may be"),
    Refusal(lambda _: si_conversion("mmm", "m", where="log.csv"), UnitError, "log.csv: unknown unit 'mmm'"),
    Refusal(lambda _: si_conversion("mm**9e9", "m"), UnitError, "unknown unit 'mm**9e9'"),
    Refusal(lambda _: unit_ratio("V", "m**2"), UnitError, "cannot read the unit 'm**2'"),
    Refusal(
        lambda _: check_names("channel", ["speed", "postion"], NAMES, "run_01"),
        UnknownNameError,
        "run_01: unknown channel 'postion'; did you mean 'position'?",
    ),
    Refusal(
        lambda _: check_names("channel", ["xyz"], NAMES),
        UnknownNameError,
        "unknown channel 'xyz'; known: position, speed",
    ),
    Refusal(lambda _: check_names("channel", ["xyz"], []), UnknownNameError, "unknown channel 'xyz'; known: none"),
    Refusal(lambda _: RUN["sped"], UnknownNameError, "unknown channel 'sped'; did you mean 'speed'"),
    Refusal(lambda _: RIG.freed("fricton.*"), UnknownNameError, "unknown parameter 'fricton.*'; did you mean"),
    Refusal(lambda _: RIG.value("load.mas"), UnknownNameError, "'load.mas'; did you mean 'load.mass'"),
    Refusal(
        lambda _: RIG.with_values({"load.mass": 50.0}),
        InputError,
        "load.mass: value 50 kg lies outside its bounds [1, 10]; move the value or the bounds",
    ),
    Refusal(
        lambda _: RIG.with_bounds({"friction.coulomb": (50.0, 60.0)}),
        InputError,
        "friction.coulomb: value 40 N lies outside",
    ),
    Refusal(lambda d: write_text(d / "none" / "a", ""), InputError, "a: the folder does not exist; make it first"),
    Refusal(lambda d: write_text(d, ""), InputError, "is a folder; name a file in it"),
    Refusal(lambda d: check_output_paths([d / "x"], [d / "x"]), InputError, "x: is an input of this command"),
    Refusal(lambda d: check_output_paths([d / "x", d / "x"], []), InputError, "x: is named for two outputs"),
    Refusal(lambda d: check_output_paths([d / ("x" * 300)], []), InputError, "File name too long"),
    Refusal(lambda d: check_output_paths([d / "a\0b"], []), InputError, "a\\x00b: cannot be written"),
    Refusal(lambda _: write_text("/dev/null", ""), InputError, "is a pipe or a device, no file; name a file"),
    Refusal(lambda _: read_source("/dev/zero", 9, ""), InputError, "is a pipe or a device; give the name of a file"),
    Refusal(read_toml, InputError, ": cannot be read"),
    Refusal(lambda _: read_toml(Path("a\0b")), InputError, "a\\x00b: cannot be read"),
    Refusal(lambda _: read_toml("x" * 300), InputError, "File name too long"),
]


@pytest.mark.parametrize("refusal", REFUSALS, ids=[refusal.words[:60] for refusal in REFUSALS])
def test_a_refusal_says_where_and_what_to_do(refusal: Refusal, tmp_path: Path) -> None:
    with pytest.raises(refusal.error) as error:
        refusal.trigger(tmp_path)
    assert refusal.words in str(error.value)


@pytest.mark.parametrize(("text", "unit"), [(text, unit) for text, unit, _ in UNITS])
def test_a_unit_s_error_begins_with_its_place(text: str | float, unit: str) -> None:
    with pytest.raises(UnitError, match=r"^d\.toml: "):
        read_value(text, unit, where="d.toml")
