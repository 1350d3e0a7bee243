"""A log from its file and from the sidecar that says more about it, and when it was taken."""

import hashlib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from datetime import date, datetime, time
from pathlib import Path
from typing import Any, NamedTuple

from pneuopt.logs.columns import CHANNELS, COLUMN_KEYS, Plant
from pneuopt.logs.experiment import Experiment, experiment_from_table
from pneuopt.logs.foreign import parse_log
from pneuopt.logs.table import LogTable, read_bytes
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.keys import Key, Takes, check_sections, read_named, read_table, table
from pneuopt.quantities.output import MAX_TOML_BYTES, check_nesting
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.units import ATMOSPHERE, count_gauge_from, difference_unit, read_si


def read_log(
    path: str | Path,
    *,
    columns: Mapping[str, str | bool | Mapping[str, str | float]] | None = None,
    sidecar: str | Path | None = None,
    plant: Plant | None = None,
    ambient_pressure: float = ATMOSPHERE,
) -> Experiment:
    """Read a log, and what its sidecar says about it.

    Parameters
    ----------
    path : str or Path
        Its suffix says the format: text (.csv, .txt, .tsv, .dat), LabVIEW's .lvm, MATLAB's .mat (up to version 7), or,
        with the extra of that name, .xlsx, .tdms, .parquet and, with the extra mdf, .mf4 and .mdf. In a text, a
        comma, semicolon, tab or white space separates the columns; the decimal mark is a point or a comma; an empty
        cell or NaN is a missing sample; rows above the one that names the columns are metadata, and one below it may
        hold their units. The time may be stamps (ISO 8601, 12.03.2026 10:00:00,5, a time of day), which count from
        the first.
    columns : mapping, optional
        Channel to column, in place of the sidecar's [columns]: "t [ms]", or a mapping with `column`, `unit`,
        `centre` ("5 V", subtracted) and `scale` ("35 N/V", multiplied, or an encoder's "8192 count/rev"); False leaves
        a channel out. The other columns are read where their names say "position [mm]" or "position_mm".
    sidecar : str or Path, optional
        TOML with [columns], [noise], [conditions], [intersample] (force = "held", or "linear"); by default the file of
        the same name, if there is one. Before them, accept = ["work"] names checks that the log need not pass.
    plant : System, optional
        Its inputs and outputs, and their references, are channels in its units, beside and before the usual ones:
        torque [N*m] and angle [rad], say.
    ambient_pressure : float
        What gauge pressures, bar(g), count from [Pa]: the drive's "ambient.pressure".

    Raises
    ------
    InputError
        LogError, UnitError, UnknownNameError or other: if anything in the files is missing, ambiguous or not a number;
        the message names file, row and column, or section and key, and the remedy.
    """
    path = Path(path)
    raw = read_bytes(path)
    return assemble_log(path, raw, parse_log(path, raw), read_sidecar(path, sidecar, columns), plant, ambient_pressure)


class Sidecar(NamedTuple):
    """What a sidecar, or a caller in its place, says about a log.

    `path` is for messages, and there may be no such file; `columns_from` says where `columns` come from.
    """

    path: Path
    sections: Mapping[str, Any]
    columns: Mapping[str, Any]
    columns_from: str


def read_sidecar(path: Path, sidecar: str | Path | None, columns: Mapping[str, Any] | None) -> Sidecar:
    """What stands beside a log, by default in the file of its name; its columns as a caller says, if it does."""
    side = path.with_suffix(".toml") if sidecar is None else Path(sidecar)
    sections: dict[str, Any] = {}
    if sidecar is not None or side.exists():
        raw = read_bytes(side, MAX_TOML_BYTES)
        check_nesting(side, raw, LogError)
        try:
            sections = tomllib.loads(raw.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:  # of which TOMLDecodeError and UnicodeDecodeError are
            raise LogError(f"{side}: not valid TOML: {error}") from None
        other = f"{side}: is a drive, but has the name of the sidecar of {path.name}; rename one of them"
        require(sidecar is not None or "drive" not in sections, other, LogError)
        check_sections(SIDECAR_KEYS, sections, side)
        above = {n: SIDECAR_KEYS[n] for n in (ACCEPTED_CHECKS, DATE)}
        stated = read_table(above, sections, lambda key: f"{side}: {key}", partial=True)
        sections |= {n: value for n, value in stated.items() if n in sections}
    if columns is not None:
        return Sidecar(side, sections, columns, "columns")
    return Sidecar(side, sections, sections.get("columns", {}), f"{side}: [columns]")


def assemble_log(
    path: Path, raw: bytes, table: LogTable, beside: Sidecar, plant: Plant | None, ambient_pressure: float
) -> Experiment:
    """A log of a table and of what stands beside it; see `read_log`."""
    side, sections, columns, where = beside

    def read(section: str, units: Mapping[str, str]) -> dict[str, Any]:
        return read_named(SIDECAR_KEYS[section], sections.get(section, {}), units, f"{side}: [{section}]")

    with count_gauge_from(ambient_pressure):
        run = experiment_from_table(table, columns, where, plant, path.stem)
        conditions = read("conditions", dict.fromkeys(sections.get("conditions", {}), ""))
    units = {n: difference_unit(run.unit(n)) for n in run.trajectory}  # a noise is a difference, without (a) or (g)
    source = run.source and replace(run.source, sidecar=str(side) if sections else "", sections=tuple(sections))
    return replace(
        run,
        source=source,
        noise=read("noise", units),
        conditions=conditions,
        sha256=hashlib.sha256(raw).hexdigest(),
        intersample=read("intersample", units),
        accept=tuple(sections.get(ACCEPTED_CHECKS, ())),
    )


def find_date(path: str | Path) -> datetime:
    """When a log was taken: by its sidecar, by its first time stamp with a date, or by its name, in this order.

    When the file was changed is not asked: that is often the time of a copy.
    """
    path = Path(path)
    found = _date_in_sidecar(path.with_suffix(".toml")) or _stamp(path) or _date_in_name(path.stem)
    if found is None:
        raise LogError(
            f"{path}: neither its time column nor its name says when it was taken; name it as run_2026-03-12"
            f'{path.suffix}, write date = "2026-03-12" into {path.stem}.toml, or give --dates 2026-03-12,... with a '
            "date a log"
        )
    return found


def _date_in_sidecar(side: Path) -> datetime | None:
    """The sidecar's `date`; None for one that cannot be read, which is refused where the log is read."""
    try:
        sections = tomllib.loads(side.read_text("utf-8-sig")) if side.is_file() else {}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError):
        return None
    return _read_date(sections[DATE], f"{side}: {DATE}", {}) if DATE in sections else None


def _stamp(path: Path, most: int = 20_000) -> datetime | None:
    """The first stamp with a date in the first bytes of a text, so many that no head is longer."""
    try:
        with path.open("rb") as file:
            head = file.read(most)
    except OSError:
        return None
    match = None if b"\0" in head else _IN_TEXT.search(head.decode("utf-8", "replace"))
    try:
        return datetime.fromisoformat(f"{match[1]}T{match[2]}") if match else None
    except ValueError:
        return None


def _date_in_name(stem: str) -> datetime | None:
    for match in _IN_NAME.finditer(stem):
        numbers = [int(match[n] or 0) for n in ("year", "month", "day", "hour", "minute")]
        try:
            return datetime(numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
        except ValueError:  # a number that is no date
            continue
    return None


ACCEPTED_CHECKS = "accept"  # the checks that the log need not pass
DATE = "date"  # when the log was taken


def _read_date(entry: Any, where: str, _: Mapping[str, str]) -> datetime:
    """The date of a text or of TOML's own."""
    if isinstance(entry, datetime):
        return entry.replace(tzinfo=None)
    if isinstance(entry, date):
        return datetime.combine(entry, time())
    try:
        return datetime.fromisoformat(str(entry)).replace(tzinfo=None)
    except ValueError:
        raise LogError(f'{where} must be a date, as {DATE} = "2026-03-12"; got {str(entry)[:60]!r}') from None


SIDECAR_KEYS: Mapping[str, Key] = {
    ACCEPTED_CHECKS: Key(
        "checks that this log need not pass", Takes.LIST, usual=[], example='["work"]', of=Key("a check", Takes.TEXT)
    ),
    DATE: Key(
        "when this log was taken, for track; before its stamps and its name",
        Takes.TEXT,
        example='"2026-03-12"',
        read=_read_date,
    ),
    "columns": table(
        "which column is which channel; false leaves one out; the header says the others",
        {
            channel: Key(
                f"column of the {channel.replace('_', ' ')}",
                Takes.COLUMN,
                unit,
                keys=COLUMN_KEYS,
                example=f'"{channel} [{unit}]"',
            )
            for channel, unit in CHANNELS.items()
        },
        others=Key("column of another signal of the drive", Takes.COLUMN, "{own}", keys=COLUMN_KEYS),
        named="signal",
    ),
    "noise": table(
        "standard deviations; by default as the log shows",
        {},
        others=Key("of that channel", unit="{own}", example='"20 um"', least=0.0, is_open=True),
        named="channel",
    ),
    "conditions": table(
        "known values that hold in this log only",
        {},
        others=Key(
            "its value in this log",
            unit="{own}",
            example='"6.3 bar(g)"',
            read=lambda entry, where, _: read_si(entry, where=where),
        ),
        named="parameter",
    ),
    "intersample": table(
        "how channels run between two samples",
        {},
        others=Key(
            "by default a command is held",
            Takes.TEXT,
            choices={kind.value: kind for kind in Intersample},
            example='"held"',
            named="choice",
        ),
        named="channel",
    ),
}
"""The sections of a sidecar, and what stands before them."""

_NAMED_DAY = r"(?P<year>20\d\d)(?P<mark>[-_.]?)(?P<month>\d\d)(?P=mark)(?P<day>\d\d)"
_NAMED_TIME = r"(?:[T _-]?(?P<hour>[01]\d|2[0-3])[-:_.h]?(?P<minute>[0-5]\d)(?!\d{3}))?"
_IN_NAME = re.compile(rf"(?<!\d){_NAMED_DAY}(?:(?!\d)|(?=[T _-])){_NAMED_TIME}")
_IN_TEXT = re.compile(r"(?<![\w-])(20\d\d-\d\d-\d\d)[T ,;\t]\s*([0-2]\d:[0-5]\d(?::[0-5]\d)?)")
