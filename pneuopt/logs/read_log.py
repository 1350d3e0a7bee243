"""`read_log`: an `Experiment` from a log's file, and from the sidecar that says more about it.

`find_date`: when a log was taken, as sidecar, time stamps or name say; a file's own time is that of a copy.
"""

import hashlib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from datetime import date, datetime, time
from pathlib import Path
from typing import Any, NamedTuple

from pneuopt.logs.columns import ACCEPTED_CHECKS, DATE, INTERSAMPLE_KEY, SIDECAR_KEYS, Plant
from pneuopt.logs.experiment import Experiment, experiment_from_table
from pneuopt.logs.foreign import read_table
from pneuopt.logs.table import Table, read_bytes
from pneuopt.logs.tolerances import STAMP_BYTES
from pneuopt.quantities.errors import LogError, check_names, require
from pneuopt.quantities.output import MAX_TOML_BYTES, check_nesting
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, count_gauge_from, read_si, read_value


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
    LogError, UnitError, UnknownNameError
        If anything in the files is missing, ambiguous or not a number; the message names file, row, column, remedy.
    """
    path = Path(path)
    raw = read_bytes(path)
    return assemble_log(path, raw, read_table(path, raw), read_sidecar(path, sidecar, columns), plant, ambient_pressure)


class Sidecar(NamedTuple):
    """What a sidecar, or a caller in its place, says about a log.

    Attributes
    ----------
    path : Path
        For messages; there may be no such file.
    columns : mapping
        Channel to column.
    columns_from : str
        Where these come from.
    """

    path: Path
    sections: Mapping[str, Any]
    columns: Mapping[str, Any]
    columns_from: str


def read_sidecar(path: Path, sidecar: str | Path | None, columns: Mapping[str, Any] | None) -> Sidecar:
    """What stands beside a log; its columns as a caller says, if it does."""
    side, sections = _read_sidecar(path, sidecar)
    if columns is not None:
        return Sidecar(side, sections, columns, "columns")
    return Sidecar(side, sections, sections.get("columns", {}), f"{side}: columns")


def assemble_log(
    path: Path, raw: bytes, table: Table, beside: Sidecar, plant: Plant | None, ambient_pressure: float
) -> Experiment:
    """A log of a table and of what stands beside it; see `read_log`."""
    side, sections, columns, where = beside
    with count_gauge_from(ambient_pressure):
        run = experiment_from_table(table, columns, where, plant, path.stem)
        conditions = {n: read_si(v, where=f"{side}: conditions.{n}") for n, v in sections.get("conditions", {}).items()}
    read = run.source and replace(run.source, sidecar=str(side) if sections else "", sections=tuple(sections))
    return replace(
        run,
        source=read,
        noise=_read_noise(sections.get("noise", {}), run, f"{side}: noise"),
        conditions=conditions,
        sha256=hashlib.sha256(raw).hexdigest(),
        intersample=_read_intersample(sections.get("intersample", {}), run.trajectory, f"{side}: intersample"),
        accept=tuple(sections.get(ACCEPTED_CHECKS, ())),
    )


def _read_sidecar(path: Path, sidecar: str | Path | None) -> tuple[Path, Mapping[str, Any]]:
    side = path.with_suffix(".toml") if sidecar is None else Path(sidecar)
    if sidecar is None and not side.exists():
        return side, {}
    sections = _parse_toml(side, read_bytes(side, MAX_TOML_BYTES))
    other = f"{side}: is a drive, but has the name of the sidecar of {path.name}; rename one of them"
    require(sidecar is not None or "drive" not in sections, other, LogError)
    check_names("key", sections, SIDECAR_KEYS, str(side))
    accept = sections.get(ACCEPTED_CHECKS, SIDECAR_KEYS[ACCEPTED_CHECKS].usual)
    is_list = isinstance(accept, list) and all(isinstance(name, str) for name in accept)
    require(
        is_list,
        f'{side}: {ACCEPTED_CHECKS} must list checks, as {ACCEPTED_CHECKS} = ["work"]; got {str(accept)[:60]!r}',
        LogError,
    )
    read_date(sections, side)
    for key, section in sections.items():
        if key in (ACCEPTED_CHECKS, DATE):
            continue
        require(isinstance(section, dict), f"{side}: {key} must be a section, [{key}]", LogError)
    return side, sections


def _parse_toml(path: Path, raw: bytes) -> dict[str, Any]:
    check_nesting(path, raw, LogError)
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of which TOMLDecodeError and UnicodeDecodeError are
        raise LogError(f"{path}: not valid TOML: {error}") from None


def _read_noise(entries: Mapping[str, Any], run: Experiment, where: str) -> dict[str, float]:
    check_names("channel", entries, run.trajectory, where)
    # A noise is a difference, so a pressure's takes no (a) or (g).
    return {c: read_value(v, run.unit(c).partition("(")[0], where=f"{where}.{c}") for c, v in entries.items()}


def _read_intersample(entries: Mapping[str, Any], trajectory: Trajectory, where: str) -> dict[str, Intersample]:
    check_names("channel", entries, trajectory, where)
    known = INTERSAMPLE_KEY.choices or {}
    for channel, word in entries.items():
        require(
            isinstance(word, str) and word in known,
            f"{where}.{channel} is {str(word)[:60]!r}; it must be " + " or ".join(map(repr, known)),
            LogError,
        )
    return {channel: known[word] for channel, word in entries.items()}


_NAMED_DAY = r"(?P<year>20\d\d)(?P<mark>[-_.]?)(?P<month>\d\d)(?P=mark)(?P<day>\d\d)"
_NAMED_TIME = r"(?:[T _-]?(?P<hour>[01]\d|2[0-3])[-:_.h]?(?P<minute>[0-5]\d)(?!\d{3}))?"
_IN_NAME = re.compile(rf"(?<!\d){_NAMED_DAY}(?:(?!\d)|(?=[T _-])){_NAMED_TIME}")
_IN_TEXT = re.compile(r"(?<![\w-])(20\d\d-\d\d-\d\d)[T ,;\t]\s*([0-2]\d:[0-5]\d(?::[0-5]\d)?)")


def find_date(path: str | Path) -> datetime:
    """When a log was taken.

    Parameters
    ----------
    path : str or Path
        The `date` of its sidecar counts, "run_01.toml" of "run_01.tdms"; else its first time stamp with a date, ISO
        8601, where it is a text; else the date in its name, "run_2026-03-12.csv" or "20260312_1030.csv". When the file
        was changed is not asked: that is often the time of a copy.

    Raises
    ------
    LogError
        If none of them says it, or the sidecar's is no date.

    Examples
    --------
    >>> find_date("run_2026-03-12.csv"), find_date("20260312_1030.csv")
    (datetime.datetime(2026, 3, 12, 0, 0), datetime.datetime(2026, 3, 12, 10, 30))
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


def read_date(sections: Mapping[str, object], side: Path) -> datetime | None:
    """The `date` that a sidecar states, as a text or as TOML's own; None where it states none."""
    given = sections.get(DATE)
    if given is None or isinstance(given, datetime):
        return None if given is None else given.replace(tzinfo=None)
    if isinstance(given, date):
        return datetime.combine(given, time())
    try:
        return datetime.fromisoformat(str(given)).replace(tzinfo=None)
    except ValueError:
        raise LogError(f'{side}: {DATE} must be a date, as {DATE} = "2026-03-12"; got {str(given)[:60]!r}') from None


def _date_in_sidecar(side: Path) -> datetime | None:
    """What a sidecar says; one that cannot be read is refused where the log is read."""
    try:
        return read_date(tomllib.loads(side.read_text("utf-8-sig")), side) if side.is_file() else None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError):
        return None


def _stamp(path: Path) -> datetime | None:
    """The first stamp with a date in a text."""
    try:
        with path.open("rb") as file:
            head = file.read(STAMP_BYTES)
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
