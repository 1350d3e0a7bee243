"""`find_date`: when a log was taken, as its time stamps or its name say; a file's own time is that of a copy."""

import re
from datetime import datetime
from pathlib import Path

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
        Its first time stamp with a date counts, ISO 8601; else the date in its name, "run_2026-03-12.csv" or
        "20260312_1030.csv". When the file was changed is not asked: that is often the time of a copy.

    Raises
    ------
    LogError
        If neither says it.

    Examples
    --------
    >>> find_date("run_2026-03-12.csv"), find_date("20260312_1030.csv")
    (datetime.datetime(2026, 3, 12, 0, 0), datetime.datetime(2026, 3, 12, 10, 30))
    """
    path = Path(path)
    found = _stamp(path) or _date_in_name(path.stem)
    if found is None:
        raise LogError(
            f"{path}: neither its time column nor its name says when it was taken; name it as run_2026-03-12"
            f"{path.suffix}, or give --dates 2026-03-12,... with a date a log"
        )
    return found


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
