"""Writes the same log as twenty loggers and programs write it as text: ``python tests/logs/styles.py FOLDER``.

The log: 40 samples, one every 20 ms, of a position, a valve voltage and a chamber's pressure.
"""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

N, STEP = 40, 0.02
TIME = [round(STEP * k, 6) for k in range(N)]  # s
POSITION = [round(50 + 40 * math.sin(0.3 * k), 3) for k in range(N)]  # mm
VOLTAGE = [round(5 + 2 * math.cos(0.3 * k), 4) for k in range(N)]  # V
PRESSURE = [round(4 + 0.5 * math.sin(0.2 * k), 4) for k in range(N)]  # bar above ambient
ROWS = list(zip(TIME, POSITION, VOLTAGE, PRESSURE, strict=True))
START = datetime(2026, 3, 12, 23, 59, 59, 700000, tzinfo=UTC)  # midnight falls into the log
STAMPS = [START + timedelta(seconds=t) for t in TIME]


@dataclass(frozen=True)
class Style:
    """One way to write the log.

    Attributes
    ----------
    suffix : str
    write : callable
        Of the path.
    columns : mapping
        What the user has to say, for headers that do not name channels and units.
    remark : str
        What the reader has to say about the rows that it skips.
    """

    suffix: str
    write: Callable[[Path], object]
    columns: Mapping[str, str | Mapping[str, str | float]] = field(default_factory=dict)
    remark: str = ""


def write_lines(head: str, rows: list[str], encoding: str = "utf-8", end: str = "\n") -> Callable[[Path], object]:
    """Write a head and a line a row."""
    text = end.join([*head.split("\n"), *rows]) + end
    return lambda path: path.write_bytes(text.encode(encoding))


def join(delimiter: str, decimal: str = ".", rows: list[tuple[float, ...]] | None = None) -> list[str]:
    """The rows as text."""
    return [delimiter.join(f"{v!r}" for v in row).replace(".", decimal) for row in rows or ROWS]


def stamped(form: Callable[[datetime], str], delimiter: str, decimal: str = ".") -> list[str]:
    """Rows that begin with a time stamp."""
    rest = join(delimiter, decimal, [row[1:] for row in ROWS])
    return [form(stamp) + delimiter + row for stamp, row in zip(STAMPS, rest, strict=True)]


def excel_day(stamp: datetime) -> float:
    """Days since the end of 1899, as spreadsheets count them."""
    return (stamp - datetime(1899, 12, 30, tzinfo=UTC)) / timedelta(days=1)


CHANNELS = "time [s],position [mm],valve_voltage [V],pressure_a [bar(g)]"
PLAIN = "time,position,valve_voltage,pressure_a"
UNITS = "s,mm,V,bar(g)"
FOREIGN: dict[str, str | Mapping[str, str | float]] = {
    "position": {"column": "Weg", "unit": "mm"},
    "valve_voltage": {"column": "U_Ventil", "unit": "V"},
    "pressure_a": {"column": "p_A", "unit": "bar(g)"},
}
SCOPE: dict[str, str | Mapping[str, str | float]] = {
    "time": "x-axis",
    "position": {"column": "1", "scale": "1 mm/V"},
    "valve_voltage": "2",
    "pressure_a": {"column": "3", "scale": "1 bar(g)/V"},
}

TEXT_STYLES: dict[str, Style] = {
    "plain csv, units in brackets": Style(".csv", write_lines(CHANNELS, join(","))),
    "units behind an underscore, quoted names, CRLF": Style(
        ".csv", write_lines('"time_s","position_mm","valve_voltage_V","pressure_a_bar(g)"', join(","), end="\r\n")
    ),
    "German Excel, semicolons and commas, Windows-1252": Style(
        ".csv",
        write_lines("Zeit [µs];" + CHANNELS.replace(",", ";"), ["0;" + r for r in join(";", ",")], "cp1252", "\r\n"),
    ),
    "Excel's Unicode text, UTF-16 with tabs": Style(
        ".txt", write_lines(CHANNELS.replace(",", "\t"), join("\t", ","), "utf-16", "\r\n")
    ),
    "ISO 8601 stamps with a zone": Style(
        ".csv",
        write_lines(
            CHANNELS.replace("time [s]", "Timestamp"),
            stamped(lambda s: s.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"), ","),
        ),
        remark="the time stamps of column 'Timestamp' are read as the time",
    ),
    "German stamps with a decimal comma": Style(
        ".csv",
        write_lines(
            CHANNELS.replace(",", ";").replace("time [s]", "Datum/Uhrzeit"),
            stamped(lambda s: f"{s:%d.%m.%Y %H:%M:%S},{s.microsecond // 1000:03}", ";", ","),
        ),
        remark="the time stamps of column 'Datum/Uhrzeit' are read as the time",
    ),
    "American stamps with AM and PM": Style(
        ".csv",
        write_lines(
            CHANNELS.replace("time [s]", "Date/Time"),
            stamped(lambda s: f"{s.month}/{s.day}/{s.year} {s:%I:%M:%S}.{s.microsecond // 1000:03} {s:%p}", ","),
        ),
    ),
    "clock times over midnight": Style(
        ".csv",
        write_lines(
            CHANNELS.replace("time [s]", "Time [hh:mm:ss]"), stamped(lambda s: f"{s:%H:%M:%S}.{s.microsecond:06}", ",")
        ),
    ),
    "Excel's days as numbers": Style(
        ".csv",
        write_lines(CHANNELS.replace("time [s]", "time [d]"), stamped(lambda s: f"{excel_day(s):.11f}", ",")),
    ),
    "metadata above the header": Style(
        ".csv",
        write_lines(
            f"Recorder,DAQ-8\nDate,2026-03-12\nSample rate,50,Hz\nChannels,3\n\n{CHANNELS}",
            join(","),
        ),
        remark="rows 1 to 5 are skipped as metadata: 'Recorder' to 'Channels'",
    ),
    "a row of units and an empty one, as PicoScope": Style(
        ".csv",
        write_lines(f"{PLAIN}\n(s),(mm),(V),(bar(g))\n", join(",")),
        remark="row 2 is read as the units of the columns",
    ),
    "an oscilloscope's columns 1, 2, 3 with units in words": Style(
        ".csv", write_lines("x-axis,1,2,3\nsecond,Volt,Volt,Volt", join(",")), SCOPE
    ),
    "comments above, the header among them, as numpy writes": Style(
        ".txt", write_lines(f"# rig B, seal 3\n# gain 1.5\n# {CHANNELS}", join(","))
    ),
    "columns apart by white space, as gnuplot reads": Style(
        ".dat",
        write_lines(
            "# time [s]  position [mm]  valve_voltage [V]  pressure_a [bar(g)]",
            ["  ".join(f"{v:12.6f}" for v in row) for row in ROWS],
        ),
    ),
    "Campbell Scientific TOA5": Style(
        ".dat",
        write_lines(
            '"TOA5","Rig","CR1000X","1234","CR1000X.Std.05","CPU:rig.CR1X","999","Fast"\n'
            '"TIMESTAMP","RECORD","position","valve_voltage","pressure_a"\n"TS","RN","mm","V","bar(g)"\n'
            '"","","Smp","Smp","Avg"',
            [
                f'"{s:%Y-%m-%d %H:%M:%S}.{s.microsecond // 10000:02}",{k},{row}'
                for k, (s, row) in enumerate(zip(STAMPS, join(",", rows=[r[1:] for r in ROWS]), strict=True))
            ],
        ),
        remark="rows 1, 3 and 4 are read as the head of a TOA5 file",
    ),
    "catman's tabs below a long head": Style(
        ".txt",
        write_lines(
            "HBM_CATMAN_DATAFILE_40\nT0\t12.03.2026 23:59:59\nKanal\tMX840\tMX840\tMX840\nKanäle\t4\n"
            "Zeit  [s]\tWeg\tU_Ventil\tp_A",
            join("\t", ","),
            "cp1252",
            "\r\n",
        ),
        {"time": "Zeit  [s]", **FOREIGN},
        remark="rows 1 to 4 are skipped as metadata: 'HBM_CATMAN_DATAFILE_40' to 'Kanäle'",
    ),
    "remarks with inch signs and commas in quotes": Style(
        ".csv",
        write_lines(
            CHANNELS + ",remark",
            [f"{r},{'' if k % 3 else chr(34) + '5, ok' + chr(34)}" for k, r in enumerate(join(","))],
        ),
    ),
    "every cell quoted, decimal commas between commas": Style(
        ".csv",
        write_lines(
            ",".join(f'"{n}"' for n in CHANNELS.split(",")),
            [",".join(f'"{v!r}"'.replace(".", ",") for v in row) for row in ROWS],
        ),
    ),
    "MATLAB's writetable with NaN in another column": Style(
        ".csv", write_lines(CHANNELS + ",flow", [f"{r},NaN" for r in join(",")])
    ),
    "a delimiter at the end of every row, points in a German file": Style(
        ".tsv", write_lines(CHANNELS.replace(",", "\t") + "\t", [r + "\t" for r in join("\t")])
    ),
}


def main(folder: Path) -> None:
    """Write a file a style."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, style in TEXT_STYLES.items():
        style.write(folder / (name.replace("/", " ") + style.suffix))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
