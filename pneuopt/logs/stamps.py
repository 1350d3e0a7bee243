"""Time stamps as loggers write them: ISO 8601, 12.03.2026 10:00:00,5, 3/12/2026 10:00:00.5 AM, 10:00:00.5."""

import re
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

_STAMP = re.compile(
    r"(?:(?P<date>\d{4}([-/.])\d\d?\2\d\d?|\d\d?([-/.])\d\d?\3(?:\d{4}|\d\d))(?:[T,_]\s*|\s+))?"
    r"(?P<h>\d\d?):(?P<m>\d\d)(?::(?P<s>\d\d)(?:[.,:](?P<f>\d{1,9}))?)?"
    r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?(?:\s*(?P<zone>Z|[+-]\d\d(?::?\d\d)?))?"
)
_EXAMPLE = "2026-03-12T10:00:00.000"
_DAY = 86400 * 10**9  # ns


def is_stamp(cell: str) -> bool:
    """Whether a cell is a time of day, with its date or without.

    Examples
    --------
    >>> is_stamp("2026-03-12T10:00:00.25Z"), is_stamp("10:00:00,5"), is_stamp("12.5")
    (True, True, False)
    """
    return _STAMP.fullmatch(cell) is not None


def seconds_from_first(cells: Sequence[str], path: Path | str, name: str, first_row: int) -> Array:
    """Read a column of stamps.

    Parameters
    ----------
    cells : sequence of str
        An empty one is a missing stamp. Without dates, a leap back by more than half a day is midnight.
    path : Path or str
    name : str
        Of the column.
    first_row : int
        Number of the first row, for messages.

    Returns
    -------
    ndarray, shape (n,)
        Seconds from the first stamp, exact to 1 ns; NaN where it is missing.

    Raises
    ------
    LogError
        If a cell is no stamp, or its date may be read in two ways.

    Examples
    --------
    >>> seconds_from_first(["23:59:59.5", "00:00:00.25"], "run.csv", "time", 2).tolist()
    [0.0, 0.75]
    """
    matches = [_STAMP.fullmatch(cell) for cell in cells]
    places = [f"{path}: row {first_row + k}, column {name!r}" for k in range(len(cells))]
    bad = next((k for k, cell in enumerate(cells) if cell and matches[k] is None), None)
    if bad is not None:
        raise LogError(f"{places[bad]}: {cells[bad][:40]!r} is not a time stamp; write it as {_EXAMPLE}")
    month_first = _month_first([m for m in matches if m], f"{path}: column {name!r}")
    days: dict[str, int] = {}
    moments: list[int | None] = []
    for k, match in enumerate(matches):
        moments.append(_nanoseconds(match, days, month_first, places[k]) if match else None)
    if not any(days):
        moments = _unwrap_midnights(moments)
    start = next((moment for moment in moments if moment is not None), 0)
    return np.array([np.nan if m is None else (m - start) / 1e9 for m in moments])


def _month_first(matches: Sequence[re.Match[str]], place: str) -> bool:
    """Whether 3/12/2026 is the 12th of March, by what is possible; either will do where the date stays the same."""
    texts = {m["date"]: bool(m["half"]) for m in matches if re.match(r"\d\d?[-/]", m["date"] or "")}
    parts = [[int(n) for n in re.split("[-/]", text)] for text in texts]
    if any(first > 12 for first, _, _ in parts):
        return False
    if any(texts.values()) or any(second > 12 for _, second, _ in parts):
        return True
    require(len(texts) < 2, f"{place}: {next(iter(texts), '')!r} may be two days; write dates as 2026-03-12", LogError)
    return False


def _nanoseconds(match: re.Match[str], days: dict[str, int], month_first: bool, place: str) -> int:
    text = match["date"] or ""
    if text not in days:
        days[text] = _day_number(text, month_first, place)
    hour, minute, second = int(match["h"]), int(match["m"]), int(match["s"] or 0)
    half = (match["half"] or "").lower()
    fits = hour < (13 if half else 25) and minute < 60 and second < 61
    require(fits, f"{place}: {match[0]!r} is no time of day; write it as {_EXAMPLE}", LogError)
    hour = hour % 12 + 12 * (half == "p") if half else hour
    zone = (match["zone"] or "Z").replace(":", "").replace("Z", "+0000").ljust(5, "0")
    shift = (int(zone[1:3]) * 60 + int(zone[3:5])) * (-1 if zone[0] == "-" else 1)
    fraction = int((match["f"] or "0").ljust(9, "0"))
    return days[text] * _DAY + ((hour * 60 + minute - shift) * 60 + second) * 10**9 + fraction


def _day_number(text: str, month_first: bool, place: str) -> int:
    if not text:
        return 0
    parts = [int(part) for part in re.split("[-/.]", text)]
    if re.match(r"\d{4}", text):
        year, month, day = parts
    elif "." in text or not month_first:
        day, month, year = parts
    else:
        month, day, year = parts
    try:
        return date(year + 2000 * (year < 100), month, day).toordinal()
    except ValueError:
        raise LogError(f"{place}: {text!r} is no date; write it as 2026-03-12") from None


def _unwrap_midnights(moments: Sequence[int | None]) -> list[int | None]:
    unwrapped: list[int | None] = []
    shift, last = 0, None
    for moment in moments:
        if moment is not None:
            shift += _DAY if last is not None and moment + _DAY // 2 < last else 0
            last = moment
        unwrapped.append(None if moment is None else moment + shift)
    return unwrapped
