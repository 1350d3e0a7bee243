"""`find_date`: when a log was taken, as sidecar, time stamps or name say; a file's own time is that of a copy."""

import re
import tomllib
from collections.abc import Mapping
from datetime import date, datetime, time
from pathlib import Path

from pneuopt.logs.sidecar_keys import DATE
from pneuopt.quantities.errors import LogError

_NAMED_DAY = r"(?P<year>20\d\d)(?P<mark>[-_.]?)(?P<month>\d\d)(?P=mark)(?P<day>\d\d)"
_NAMED_TIME = r"(?:[T _-]?(?P<hour>[01]\d|2[0-3])[-:_.h]?(?P<minute>[0-5]\d)(?!\d{3}))?"
_IN_NAME = re.compile(rf"(?<!\d){_NAMED_DAY}(?:(?!\d)|(?=[T _-])){_NAMED_TIME}")
_IN_TEXT = re.compile(r"(?<![\w-])(20\d\d-\d\d-\d\d)[T ,;\t]\s*([0-2]\d:[0-5]\d(?::[0-5]\d)?)")
STAMP_BYTES = 20_000
"""Bytes of a log in which its first time stamp is looked for: longer heads are none of a log."""


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
