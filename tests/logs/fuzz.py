"""Reads mutated logs and sidecars: ``python -m tests.logs.fuzz CASES [SEED [STYLE]]`` prints what came of them.

Valid files of every style are mutated in values, rows, names, units, nesting and bytes. A case passes if it is read,
with a row a line and the values of the cells that were left alone, or refused by one of our own errors in one line.
"""

import io
import random
import re
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pneuopt.logs.read_log import read_log
from tests.fuzzing import Report
from tests.logs.binary_styles import BINARY_STYLES
from tests.logs.styles import POSITION, ROWS, TEXT_STYLES, Style

CELLS = (
    *("", "NaN", "nan", "inf", "-inf", "1e300", "1e999", "-0", "+.5", "5.", "1e", "0x10", "1_000", "1.234,5", "1,5"),
    *("--", "9" * 5000, "a" * 140_000, "OL", "1.#QNAN", "12:00:00", "2026-03-12", "31.02.2026 10:00:00", '"', '"a'),
    *('a"b', "'", "=", "\t", ";", ",", "\u0661", "\ufeff", "\x1f", "\x1a", "\x0b", "\u2028", "#", "mm", "time [s]"),
    *("0", "50.5", "1e-5"),
)
NAMES = (
    *("", "t", "time", "time [s]", "speed [m/s]", "speed [mm**9e9]", "speed [m^(99)^99]", "speed [" + "(" * 500 + "]"),
    *("a" * 300, "pressure_b [bar]", "pressure_b [bar(g)]", "force_N", "force [kN]", "velocity [m/s]", "1", "#"),
    *("speed_", "time [ms]"),
)
SIDE_VALUES = (
    *('"mm"', '"5 V"', "false", "true", "3", "-1e400", "inf", '"9e999 V"', "[]", "{}", '""', '"1 bar(g)/V"'),
    *('"mm**9e9"', "[" * 60 + "]" * 60, "[" * 2000 + "]" * 2000, "{ column = 3 }", '{ column = "p" }', "1979-05-27"),
    *('"\\u0000"', "'" + "a" * 9999 + "'"),
)
SIDE_KEYS = (
    *("columns", "noise", "conditions", "intersample", "accept", "drive", "time", "position", "speed", "a.b", '""'),
    "x" * 500,
)
SLOW = [name for name in BINARY_STYLES if "Excel" in name]
ODD_LINES = ("Rig,B", "Gain;1.5;V", "", "2026-03-12,10:00:00", "#", "a\tb\tc\td", "1,2,3,4", "s,mm,V,bar(g)")
SIDECAR = """accept = ["work"]
[columns]
valve_voltage = { column = "valve_voltage [V]", unit = "V", centre = "5 V" }
[noise]
position = "20 um"
[conditions]
"load.mass" = "5 kg"
[intersample]
position = "held"
"""


@dataclass(frozen=True)
class Case:
    """A mutated file: its bytes, its sidecar, and, where that is known, how many rows it has and which are as was."""

    raw: bytes
    side: str = ""
    rows: int | None = None
    whole: tuple[int, ...] = ()


def fuzz(cases: int, seed: int, styles: str = "") -> Report:
    """Read mutated files of the styles whose name holds a text."""
    rng, report = random.Random(seed), Report()
    all_styles = {**TEXT_STYLES, **BINARY_STYLES}
    chosen = [name for name in all_styles if styles in name]
    weights = [0.002 if "MDF" in name else 0.25 if name in SLOW else 1.0 for name in chosen]  # a process a file; XML
    with tempfile.TemporaryDirectory() as folder:
        bases = {name: _written(all_styles[name], Path(folder)) for name in chosen}
        for name in rng.choices(chosen, weights, k=cases):
            _try(report, name, all_styles[name], _mutate(rng, all_styles[name], bases[name]), Path(folder))
    return report


def _written(style: Style, folder: Path) -> bytes:
    path = folder / f"base{style.suffix}"
    style.write(path)
    return path.read_bytes()


def _try(report: Report, name: str, style: Style, case: Case, folder: Path) -> None:
    path = folder / f"run{style.suffix}"
    path.write_bytes(case.raw)
    side = path.with_suffix(".toml")
    side.unlink(missing_ok=True)
    if case.side:
        side.write_text(case.side, encoding="utf-8", errors="surrogatepass")

    def read() -> str:
        run = read_log(path, columns=None if case.side else style.columns or None)
        return _wrong(run.trajectory.values.get("position"), len(run.trajectory), case)

    report.count(name, read, case.raw, case.side)


def _wrong(position: "np.ndarray[tuple[int], np.dtype[np.float64]] | None", n: int, case: Case) -> str:
    if case.rows is not None and n != case.rows:
        return f"{n} rows of {case.rows}"
    if position is not None and case.rows is not None:
        for row in case.whole:
            if not np.isclose(position[row], 1e-3 * POSITION[row], rtol=1e-9):
                return f"row {row}: {position[row]} for {1e-3 * POSITION[row]}"
    return ""


def _mutate(rng: random.Random, style: Style, base: bytes) -> Case:
    if rng.random() < 0.1:
        return Case(base, _mutated_sidecar(rng))
    if style in TEXT_STYLES.values() or style.suffix == ".lvm":
        kinds: list[Callable[[random.Random, bytes], Case]] = [_cells, _rows, _head, _cells, _rows, _bytes]
        return rng.choice(kinds)(rng, base)
    if style.suffix == ".xlsx" and rng.random() < 0.8:
        return _members(rng, base)
    return _bytes(rng, base)


def _lines(base: bytes) -> tuple[list[str], str, str]:
    """Lines, encoding and line end; the last lines are the samples."""
    encoding = "utf-16" if base[:2] == b"\xff\xfe" else "utf-8"
    try:
        text = base.decode(encoding)
    except UnicodeDecodeError:
        text, encoding = base.decode("cp1252"), "cp1252"
    end = "\r\n" if "\r\n" in text else "\n"
    return text.rstrip("\r\n").split(end), encoding, end


def _joined(lines: list[str], encoding: str, end: str) -> bytes:
    return (end.join(lines) + end).encode(encoding, errors="replace")


def _delimiter(line: str) -> str:
    return next((d for d in (";", "\t", ",", "  ") if d in line), ",")


def _cells(rng: random.Random, base: bytes) -> Case:
    """Another value in some cells."""
    lines, encoding, end = _lines(base)
    first, touched = len(lines) - len(ROWS), set()
    for _ in range(rng.choice([1, 1, 2, 20])):
        row = rng.randrange(len(ROWS))
        line = lines[first + row]
        cells = line.split(_delimiter(line))
        place = rng.randrange(len(cells))
        cells[place] = rng.choice(["", "NaN", f"{rng.gauss(50, 30):.3f}", rng.choice(CELLS)])
        lines[first + row] = _delimiter(line).join(cells)
        touched.add(row)
    blank = next((k for k in range(len(ROWS)) if not lines[-1 - k].strip(" \n")), None)
    whole = tuple(row for row in range(len(ROWS)) if row not in touched)
    return Case(_joined(lines, encoding, end), rows=len(ROWS) if blank is None else None, whole=whole)


def _rows(rng: random.Random, base: bytes) -> Case:
    """Rows less, twice, swapped, cut, or strange ones between."""
    lines, encoding, end = _lines(base)
    first, n = len(lines) - len(ROWS), len(ROWS)
    row = first + rng.randrange(1, n)
    kind = rng.randrange(7)
    whole: tuple[int, ...] = ()
    if kind == 0:
        n = rng.randrange(1, n)
        del lines[first + n :]
        whole = tuple(range(n))
    elif kind == 1:
        del lines[row]
        n -= 1
    elif kind == 2:
        lines.insert(row, lines[row])
        n += 1
    elif kind == 3:
        lines[row - 1], lines[row] = lines[row], lines[row - 1]
    elif kind == 4:
        lines.insert(row, rng.choice(["", "#", "# event", ",", ";;;", "end", lines[max(first - 1, 0)], "\t\t\t"]))
        n += 1
    elif kind == 5:
        lines[row] = lines[row][: rng.randrange(len(lines[row]))]
    else:
        lines = [*lines[:first], *(line + rng.choice([";", ",", " "]) for line in lines[first:])]
    return Case(_joined(lines, encoding, end), rows=n if lines[-1].strip() else None, whole=whole)


def _head(rng: random.Random, base: bytes) -> Case:
    """Other names and units, and other rows above them."""
    lines, encoding, end = _lines(base)
    first = len(lines) - len(ROWS)
    line = rng.randrange(first) if first else 0
    kind = rng.randrange(4)
    if kind == 0:
        cells = lines[line].split(_delimiter(lines[line]))
        cells[rng.randrange(len(cells))] = rng.choice(NAMES)
        lines[line] = _delimiter(lines[line]).join(cells)
    elif kind == 1:
        lines.insert(line, rng.choice(ODD_LINES))
    elif kind == 2:
        del lines[line]
    else:
        text = lines[line]
        lines[line] = rng.choice((text.upper(), text.title(), text.replace("_", " "), f" {text} ", f"# {text}"))
    return Case(_joined(lines, encoding, end))


def _bytes(rng: random.Random, base: bytes) -> Case:
    return Case(damage_bytes(rng, base))


def damage_bytes(rng: random.Random, base: bytes) -> bytes:
    """Bytes changed, cut out, put in, repeated, or the file cut."""
    raw = bytearray(base)
    for _ in range(rng.choice([1, 1, 2, 8])):
        i = rng.randrange(max(len(raw), 1))
        kind = rng.randrange(6)
        if kind == 0 and raw:
            raw[i : i + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            del raw[i : i + rng.choice([1, 2, 50])]
        elif kind == 2:
            raw[i:i] = rng.randbytes(rng.choice([1, 4, 50]))
        elif kind == 3:
            raw[i:i] = raw[i : i + rng.choice([4, 100])]
        elif kind == 4:
            raw[i : i + 8] = rng.choice([b"\xff" * 8, b"\0" * 8, b"\x7f" + b"\xff" * 7, b"\0\0\0\x40" * 2])
        else:
            del raw[i:]
    return bytes(raw)


def _members(rng: random.Random, base: bytes) -> Case:
    """A workbook whose XML is mutated in one member, packed again."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(base)) as old, zipfile.ZipFile(packed, "w") as new:
        likely = [name for name in old.namelist() if "sheet" in name or rng.random() < 0.2]
        chosen = rng.choice(likely)
        for name in old.namelist():
            text = old.read(name)
            new.writestr(name, _xml(rng, text) if name == chosen else text)
    return Case(packed.getvalue())


def _xml(rng: random.Random, text: bytes) -> bytes:
    for _ in range(rng.choice([1, 1, 4])):
        numbers = list(_find_numbers(text))
        if rng.random() < 0.8 and numbers:
            start, stop = rng.choice(numbers)
            value = rng.choice([b"", b"1e999", b"-1", b"99999999", b"12.5", b"40.25", b"abc", b"0", b"1e300", b"3"])
            text = text[:start] + value + text[stop:]
        else:
            text = damage_bytes(rng, text)
    return text


def _find_numbers(text: bytes) -> list[tuple[int, int]]:
    return [match.span() for match in re.finditer(rb"(?<=[\">A-Z])[0-9.]+(?=[\"<])", text)]


def _mutated_sidecar(rng: random.Random) -> str:
    lines = SIDECAR.splitlines()
    for _ in range(rng.choice([1, 1, 3])):
        i = rng.randrange(len(lines))
        key, equals, value = lines[i].partition(" = ")
        kind = rng.randrange(5)
        if kind == 0 and equals:
            lines[i] = f"{key} = {rng.choice(SIDE_VALUES)}"
        elif kind == 1 and equals:
            lines[i] = f"{rng.choice(SIDE_KEYS)} = {value}"
        elif kind == 2:
            lines.insert(i, f"{rng.choice(SIDE_KEYS)} = {rng.choice(SIDE_VALUES)}")
        elif kind == 3:
            del lines[i]
            lines = lines or [""]
        else:
            lines[i] = "".join(c for c in lines[i] if rng.random() > 0.05)
    return "\n".join(lines)


if __name__ == "__main__":
    _, count, start, style = (*sys.argv, *("", "0", "")[len(sys.argv) - 1 :])
    result = fuzz(int(count), int(start), style)
    sys.stdout.write(f"{result}\n")
    for style_name, fault, raw, side in result.failures[:40]:
        sys.stdout.write(f"\n{style_name}: {fault}\n{raw[:400]!r}\n{side}\n")
