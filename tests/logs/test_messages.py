"""The words of every refusal of a log, beside what triggers it; other tests assert its type and its place."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from pneuopt.logs.doctor import PISTON, examine
from pneuopt.logs.experiment import Experiment, differentiate, resample, split
from pneuopt.logs.read_log import find_date, read_log
from pneuopt.logs.text import seconds_from_first
from pneuopt.quantities.errors import InputError, LogError, UnitError
from tests.logs.bad_logs import BAD_LOGS, STATED
from tests.logs.test_experiment import FRAME, ramp
from tests.logs.test_experiment import UNITS as UNIT_NAMES
from tests.logs.test_foreign import TIME, write_frame, write_variables, write_workbook
from tests.logs.test_read_log import BODY, HEADER, RENAMED, SIDECAR, written


class Refusal(NamedTuple):
    """What triggers an error, in a folder for its files, of which type it is, and its words."""

    trigger: Callable[[Path], object]
    error: type[InputError]
    words: tuple[str, ...]


LOGS: list[tuple[str | bytes, str]] = [
    (HEADER + BODY + "1.2,abc\n", "row 14, column 'position [mm]': 'abc' is not a number"),
    (HEADER + BODY + "1.2,n/a\n", "'n/a' is not a number (decimal mark '.'); leave the cell empty"),
    (HEADER + BODY + "1.2,9.91e37\n", "9.91e+37 is no measured value; leave the cell empty"),
    (HEADER + BODY + "1.2,1e999\n", "row 14, column 'position [mm]': '1e999' is not a number"),
    (HEADER + BODY + "1.2,inf\n", "'inf' is not a number"),
    (HEADER + BODY + "1.2,1_0\n", "'1_0' is not a number"),
    (HEADER + BODY + ",3\n", "row 14, column 'time [s]': the time is missing; delete the row"),
    (HEADER + BODY + "1.1,3\n", "row 14: time repeats (1.1 s, then 1.1 s); delete the row"),
    (HEADER + BODY + "0.5,3\n", "row 14: time runs backwards (1.1 s, then 0.5 s)"),
    (HEADER + BODY + "1.2\n", "row 14 has 1 field, the header 2; mend or delete the row"),
    (HEADER + BODY + "1.2;3\n", "row 14 has 1 field"),
    (HEADER + BODY + "\n1.3,4\n", "row 14 has 1 field"),
    (HEADER + BODY.replace(".", ","), "row 2 has 3 fields, the header 2; is ',' the decimal mark, too?"),
    (HEADER.replace(",", ";") + "0.5;1,5\n" * 12, "row 2, column 'time [s]': '0.5' is not a number"),
    (HEADER.replace(",", ";") + "0;1.234,5\n" * 12, "'1.234,5' is not a number"),
    (HEADER + "0,1\n1,2\n", "2 samples are too few; at least 10"),
    (HEADER + "".join(f"{k},\n" for k in range(12)), "column 'position [mm]' is empty; leave it out"),
    ("", "row 1 is empty"),
    (HEADER, "a header, but no samples"),
    (BODY, "row 1 holds the number '0.0', not a column's name"),
    ("time [s]\n" + "".join(f"{k}\n" for k in range(12)), "one column only; put ',', ';' or a tab"),
    ("time [s],position [mm],position [mm]\n" + BODY, "two columns are named 'position [mm]'; rename one"),
    ("time [s],position [mm],position_mm\n" + BODY.replace("\n", ",1\n"), "'position' has another column"),
    ("\n" + "time [s] mass\n" + BODY.replace(",", " "), "no channel but time"),
    ("a,b\n" + BODY, 'no time; name a column "time [s]"'),
    ("time [s],b\n" + BODY, "no channel but time; known: time, valve_voltage"),
    ("time [s],presure_a_bar(g)\n" + BODY, "'presure_a_bar(g)' looks like the channel 'pressure_a'"),
    ("time [s],Pressure_c [bar(g)]\n" + BODY, "looks like the channel 'pressure_"),
    ("time [s],velocity [m/s]\n" + BODY, "looks like the channel 'speed'"),
    ("t [s],position [mm]\n" + BODY, "'time'; write it so, or list the columns to use in a sidecar: pneuopt init"),
    (b"PK\x03\x04\0\0", "not a text file"),
    ((HEADER + BODY).encode("utf-16")[2:], "export the log as CSV in UTF-8"),
]
UNITS = [
    ("time [s],position", 'no unit; write "position [m]", or unit = "..."'),
    ("time [s],position [kg]", "unit 'kg' does not measure 'm'"),
    ("time [s],position_raw", "unknown unit 'raw'"),
    ("time [s],pressure_a [bar]", 'write "bar(a)" or "bar(g)"'),
    ("time [s],speed [bar(g)]", "does not measure 'm/s'"),
]
SIDECARS = [
    ("valve_voltage", "valve_volts", "[columns]: unknown channel 'valve_volts'; did you mean 'valve_voltage'?"),
    ('"t [ms]"', '"tt [ms]"', "[columns] time: unknown column 'tt [ms]'; did you mean 't [ms]'?"),
    ("centre = ", "center = ", "unknown key 'center'; did you mean 'centre'?"),
    (
        'column = "U valve", unit = "V", centre = "5 V"',
        'unit = "V"',
        '[columns] valve_voltage has no column; write column = "U valve"',
    ),
    ("[noise]", "[noises]", "unknown section 'noises'; did you mean 'noise'?"),
    ("[noise]\nforce", "[noise]\nposition", "[noise]: unknown channel 'position'; known: force, valve_voltage"),
    ('"2 N"', '"2 mm"', "[noise] force: unit 'mm' does not measure 'N'"),
    ('"2 N"', '"-2 N"', "run_01.toml: [noise] force must be positive, got -2 N"),
    ('"2 N"', "2", '[noise] force: 2 has no unit; write "2 N"'),
    ("N/V", "N/m", "[columns] force scale: unit 'N/m' does not measure"),
    ('"5 V"', '"5 N"', "[columns] valve_voltage centre: unit 'N' does not measure 'V'"),
    ('unit = "V", centre = "5 V"', 'centre = "5 V"', "[columns] valve_voltage: no unit"),
    ("6.3 bar(g)", "6.3 bar", "[conditions] supply.pressure: a pressure level in 'bar'"),
    ("[columns]", 'accept = "work"\n[columns]', "accept must be a list, got 'work'; write accept = [\"work\"]"),
    ("[columns]", 'accept = ["work", 3]\n[columns]', "accept must be text, got 3"),
    ("[noise]", "[noise", "not valid TOML: "),
    ("[columns]", "noise = 3\n[columns]", "noise must be a section, [noise]"),
    (
        "force = { column",
        "pressure_a = { column",
        "[columns] pressure_a scale: '-35.15065 N/V' does not say from where",
    ),
]
STAMPS = [
    (["10:00:00", "10 o'clock"], "run.csv: row 3, column 'time': \"10 o'clock\" is not a time stamp; write it as"),
    (["10:61:00"], "row 2, column 'time': '10:61:00' is no time of day; write it as 2026-03-12T10:00:00.000"),
    (["13:00:00 PM"], "is no time of day"),
    (["2026-02-30 10:00:00"], "row 2, column 'time': '2026-02-30' is no date; write it as 2026-03-12"),
    (["3/4/2026 10:00", "3/5/2026 10:00"], "column 'time': '3/4/2026' may be two days; write dates as 2026-03-12"),
]
VARIABLES: list[tuple[dict[str, object], str]] = [
    (
        {"time_s": TIME, "force_N": TIME[:-1]},
        "column 'force_N' has 11 samples, column 'time_s' has 12; export them",
    ),
    ({"mass": 5.0}, "no vector of numbers; in MATLAB, save"),
    ({"force_N": TIME, "log": {"force_N": TIME}}, "two columns are named 'force_N'; rename one"),
    ({"time_s": TIME, "force_N": 1j * TIME}, "no channel but time"),
]
CELLS: list[tuple[str, object, str]] = [
    ("A5", 1e9, "row 5, column 'time [s]': 1e+09 is no date of Excel; write a date with its time"),
    ("A2", None, "row 2, column 'time [s]': the time is missing; delete the row"),
    ("B3", 10**100, "row 3, column 'position [mm]': inf is not a number; leave the cell empty"),
    ("B3", "12,5", "row 3, column 'position [mm]': '12,5' is not a number; leave the cell empty"),
    ("B90000", 1.0, "10001 rows are empty; delete them, or what is below them"),
    ("XFD1048576", 1.0, "10001 rows are empty; delete them, or what is below them"),
    ("B3", "#DIV/0!", "row 3, column 'position [mm]': '#DIV/0!' is not a number; leave the cell empty"),
    ("C3", 1.0, "row 3 has 3 cells, the header 2; mend it"),
]


NOTE: dict[str, str | bool | dict[str, str | float]] = {"time": "time [s]", "force": {"column": "note", "unit": "N"}}


def sidecar(old: str, new: str) -> str:
    """The sidecar with one change; a section that becomes a number does not stand there as well."""
    text = SIDECAR.replace('[noise]\nforce = "2 N"\n', "") if new.startswith("noise =") else SIDECAR
    assert old in text
    return text.replace(old, new, 1)


INCHES = "".join(('"' if k == 3 else "") + f"ok,{row}\n" for k, row in enumerate(BODY.splitlines()))
LONG_NAME = f"time [s],position [mm],{'a' * 300}\n" + BODY.replace("\n", ",1\n")
LONG_CELL = 'time [s],position [mm],note\n0,1,"' + "a" * 200_000 + '"\n1,1,\n'
WIDE = f"time [s],{','.join(f'c{i}' for i in range(20_000))}\n" + f"0{',1' * 20_000}\n" * 12
COARSE = HEADER + "".join(f"{k // 10},{k}\n" for k in range(300))
NO_VERSION = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" + bytes(512)
BLOCKS = HEADER + BODY + "time [s],position [mm],force [N]\n" + "".join(f"{k},{k},{k}\n" for k in range(20))
MORE_LOGS: list[tuple[str, str]] = [
    (WIDE, "20001 columns are more than 4096; export fewer channels"),
    (LONG_NAME, "the name of column 'aaaaaaaaaaaaaaaaaaaa'... has 300 characters; shorten it"),
    (LONG_CELL, "row 2: a cell has more than 131072 characters; cut it"),
    (f"remark,time [s],position [mm]\n{INCHES}", 'row 5: a quote (") is opened and not closed; mend the row'),
    (COARSE, "(270 in all): time repeats (0 s, then 0 s); the time is too coarse for the samples; export it with more"),
    (BLOCKS, "rows 2 to 13 hold numbers, but other columns than the rows below; make two files of it"),
]
MORE_SIDECARS = [
    ('[drive]\nkind = "force"\n', "is a drive, but has the name of the sidecar of run_01.csv; rename one"),
    ("[columns]\ntime = " + "[" * 3000 + "]" * 3000, "too many brackets in brackets"),
    ("#" * 2**21, "is larger than 128 KiB"),
    ('date = "12.3.26"\n', "date must be a date, as date = \"2026-03-12\"; got '12.3.26'"),
    ('[intersample]\nposition = "foh"\n', "[intersample] position: unknown choice 'foh'; known: held, linear"),
    ("[intersample]\nposition = 1\n", '[intersample] position must be text, got 1; write position = "held"'),
]
EXPERIMENTS: list[tuple[Callable[[], object], str]] = [
    (lambda: split(ramp(), 2.0), "samples of run, which has 1001, one every 0.001 s; choose between 0.002 and 1.001 s"),
    (lambda: resample(ramp(), 2.0), "a step of 2 s does not fit a log of 1 s"),
    (
        lambda: differentiate(ramp(), window=1e-3),
        "a window of 0.001 s holds fewer than 3 samples; take 0.004 s or more",
    ),
    (lambda: differentiate(differentiate(ramp(), window=0.01), window=0.01), "the log has a speed already"),
    (
        lambda: differentiate(ramp(), window=0.01, position="positon"),
        "unknown channel 'positon'; did you mean 'position'",
    ),
    (lambda: ramp().with_noise({"positon": 1e-5}), "run: noise: unknown channel 'positon'; did you mean 'position'"),
    (lambda: ramp().with_noise({"position": 0.0}), "run: noise of 'position' must be positive, got 0"),
    (lambda: ramp().with_conditions({"load.mass": float("nan")}), "run: condition 'load.mass' must be finite"),
    (
        lambda: ramp().with_intersample({"position": "linear"}),  # type: ignore[dict-item]
        "intersample['position'] takes Intersample.HELD or Intersample.LINEAR",
    ),
    (lambda: Experiment.from_frame(FRAME, units={"time": "s"}), "frame: column 'position': no unit"),
    (
        lambda: Experiment.from_frame(FRAME, units={"postion": "mm"}),
        "frame: units: unknown column 'postion'; did you mean 'position'",
    ),
    (
        lambda: Experiment.from_frame(FRAME.drop(columns="time"), units={"position": "mm"}),
        "frame: no time; name a column",
    ),
    (
        lambda: Experiment.from_frame(FRAME.set_axis(["time", "position", "position"], axis=1), units=UNIT_NAMES),
        "two columns are named 'position'; rename one",
    ),
    (lambda: Experiment.from_frame(FRAME.set_axis([0, 1, 2], axis=1)), "frame: columns need names, as text"),
]


def write_bytes(folder: Path, name: str, raw: bytes) -> Path:
    (folder / name).write_bytes(raw)
    return folder / name


def read_written(text: str | bytes, side: str, folder: Path) -> object:
    return read_log(written(folder, text, side))


def read_stamps(cells: list[str], _: Path) -> object:
    return seconds_from_first(cells, "run.csv", "time", 2)


def read_variables(variables: dict[str, object], folder: Path) -> object:
    return read_log(write_variables(folder, variables))


def read_cell(place: str, value: object, folder: Path) -> object:
    return read_log(write_workbook(folder, {place: value}, "yyyy-mm-dd hh:mm:ss.000"))


def call(make: Callable[[], object], _: Path) -> object:
    return make()


REFUSALS = [
    *(Refusal(partial(read_written, t, ""), LogError, ("run_01.csv: ", said)) for t, said in (*LOGS, *MORE_LOGS)),
    *(
        Refusal(partial(read_written, HEADER + BODY, s), InputError, ("run_01.toml: ", said))
        for s, said in MORE_SIDECARS
    ),
    *(Refusal(partial(call, make), InputError, (said,)) for make, said in EXPERIMENTS),
    Refusal(lambda d: read_log(d / "none.csv"), LogError, ("none.csv: cannot be read (No such file",)),
    Refusal(read_log, LogError, ("cannot be read",)),
    Refusal(lambda _: read_log("/dev/zero"), LogError, ("/dev/zero: is a pipe or a device; give the name of a file",)),
    Refusal(
        lambda d: find_date(written(d, HEADER + BODY)),
        LogError,
        ("run_01.csv: neither its time column nor its name says when", "give --dates 2026-03-12"),
    ),
    Refusal(
        lambda d: read_log(write_bytes(d, "run.mat", NO_VERSION)),
        LogError,
        ("version 7.3 (HDF5) is not read; in MATLAB, save it with the option '-v7'",),
    ),
    Refusal(
        lambda d: read_log(write_bytes(d, "run.mat", b"x" * 200)),
        LogError,
        ("run.mat: cannot be read as a .mat file (its head names no version from 4 to 7); save the log again",),
    ),
    Refusal(
        lambda d: read_log(write_frame(d, note=["", "good", *[""] * 10]), columns=NOTE),
        LogError,
        ("row 1, column 'note': '' is not a number, as the column's type is ", "; store the column as float64"),
    ),
    *(
        Refusal(
            partial(read_written, f"{h}\n{BODY}", ""),
            UnitError,
            (f"column {h.split(',')[1]!r}", said, "list the columns to use in a sidecar"),
        )
        for h, said in UNITS
    ),
    *(
        Refusal(partial(read_written, RENAMED, sidecar(a, b)), InputError, ("run_01.toml: ", said))
        for a, b, said in SIDECARS
    ),
    *(Refusal(partial(read_stamps, c), LogError, (said,)) for c, said in STAMPS),
    *(Refusal(partial(read_variables, v), LogError, (f"run.mat: {said}",)) for v, said in VARIABLES),
    *(Refusal(partial(read_cell, p, v), LogError, ("run.xlsx: ", said)) for p, v, said in CELLS),
]


@pytest.mark.parametrize("refusal", REFUSALS, ids=[refusal.words[-1][:60] for refusal in REFUSALS])
def test_a_refusal_says_where_and_what_to_do(refusal: Refusal, tmp_path: Path) -> None:
    with pytest.raises(refusal.error) as error:
        refusal.trigger(tmp_path)
    for words in refusal.words:
        assert words in str(error.value)


FINDINGS = {
    "motion": ("'position' shows noise and no motion", ": log a run in which the drive moves"),
    "speed": ("position and speed run against each other (at ", ": change the sign of one"),
    "work": ("the force brakes the motion on balance (", ", which no drive does: change the sign of 'force'"),
    "command": (
        "the piston runs against the valve's command (correlation -",
        ": change the sign of 'valve_voltage', or",
    ),
    "scale": ("'position' moves at 308 m/s", ": is its unit mm, and read as m?"),
    "jumps": (
        "'position' jumps by 49.7 mm within a sample at 1.501 s (",
        "leave the cells of 'position' in between empty",
    ),
    "stops": (
        "'position' stays at 130 mm from 0.109 s to 0.391 s",
        "as at an end stop that the model has not: leave these",
    ),
    "mass": (
        "force and acceleration are those of 2.65 kg, 0.265 times",
        "correct mass, or the unit of the force, or free mass",
    ),
    "offset": ("the drive pushes with 20 N more than the motion needs", "free load.force, which takes it"),
    "pressures": ("'pressure_b' falls to -0.06 bar(a), a vacuum", "a gauge sensor's unit is written bar(g)"),
    "sampling": ("'position' has only 21 levels", "the resolution is coarse for the motion"),
    "dwells": ("'position' moves in 23% of the log, 0.931 of 4 s, in 4 moves", "static friction from how each begins"),
}


@pytest.mark.parametrize("check", FINDINGS)
def test_a_finding_says_what_is_seen_and_what_to_do(check: str) -> None:
    (finding,) = examine(BAD_LOGS[check], STATED.get(check, PISTON))
    for words in FINDINGS[check]:
        assert words in finding.message
