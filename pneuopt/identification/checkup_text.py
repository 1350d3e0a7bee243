"""The text of a `Checkup`, in lines that end between words, and what a file holds of it."""

import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.identification.assumptions import Assumption
from pneuopt.logs.checks.findings import LogFinding, Severity
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    from pneuopt.identification.checkup import Checkup

MIN_PERCENT = 0.1
"""Standard deviation over the value [%] below which the model's errors count, and not the noise: a lower one promises
what no rig keeps, a higher one hides what quiet sensors give."""
MAX_PERCENT = 100.0
"""Standard deviation over the value [%] beyond which its digits say nothing."""
_NUMBER_AND_UNIT = re.compile(r"(?<=\d) (?=(?:[a-zA-Z]?(?:m|s|N|V|g|Hz|Pa|bar|rad|J|K|W)|%)(?![a-z]))")
_NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


def format_checkup(found: "Checkup", width: int) -> str:
    """The verdict, and below it what was read, assumed and found, and what the logs identify."""
    blocks = [
        [headline(found)],
        ["read", *(line for log in found.logs for line in _log_lines(log))],
        ["assumed, for it stands in no file; written so, it states the same", *_assumption_lines(found.assumptions)],
        ["found", *map(finding_line, found.findings)],
        ["identifiable, by sensitivities at the start values, if the model is right", *_verdict_lines(found)],
        ["what would help", *(f"  {run}: for {', '.join(names)}" for run, names in found.runs.items())],
    ]
    return "\n\n".join(format_lines(lines, width) for lines in blocks if _says_something(lines))


def format_lines(lines: Sequence[str], width: int) -> str:
    """Each line in pieces of at most that width, the further ones indented by two more."""
    return "\n".join(_wrap(line, width) for line in lines)


def headline(found: "Checkup") -> str:
    """Whether a fit would take the logs, in a sentence."""
    count = {s: sum(f.severity is s for f in found.findings) for s in Severity}
    doubts = f"{count[Severity.DOUBT]} doubt{'s' if count[Severity.DOUBT] > 1 else ''}"
    if count[Severity.FAULT]:
        faults = f"{count[Severity.FAULT]} fault{'s' if count[Severity.FAULT] > 1 else ''}"
        return f"a fit would refuse this: {faults}{f', {doubts}' if count[Severity.DOUBT] else ''}"
    unknown = found.verdict.unidentifiable if found.verdict else ()
    total = len(found.verdict.table) if found.verdict else 0
    known = f"the logs identify {total - len(unknown) if unknown else 'all'} of {total} free parameters"
    return f"a fit takes this, with {doubts}: {known}" if count[Severity.DOUBT] else f"nothing is wrong: {known}"


def finding_line(finding: LogFinding) -> str:
    """Severity, log and rows, and what was found."""
    place = finding.log
    if finding.rows is not None:
        first, last = finding.rows
        place += f", row {first}" if first == last else f", rows {first} to {last}"
    return f"  {finding.severity}{f' in {place}' if place else ''}: {finding.message}"


def as_dict(found: "Checkup") -> dict[str, Any]:
    """What a JSON file holds."""
    verdict = found.verdict
    rows = verdict.table.reset_index(names="name").to_dict(orient="records") if verdict else []
    return {
        "verdict": headline(found),
        "read": [_log_record(log) for log in found.logs],
        "assumed": [{"name": a.name, "value": a.value, "unit": a.unit, "key": a.key} for a in found.assumptions],
        "found": [
            {"severity": f.severity.value, "log": f.log, "rows": f.rows, "check": f.check, "message": f.message}
            for f in found.findings
        ],
        "identifiable": rows,
        "reasons": dict(verdict.reasons) if verdict else {},
        "runs": {run: list(names) for run, names in found.runs.items()},
    }


def _says_something(lines: Sequence[str]) -> bool:
    return len(lines) > 1 or not lines[0].startswith(("found", "assumed", "identifiable", "what would"))


def _wrap(line: str, width: int) -> str:
    """The line in pieces that end between words, and not between a number and its unit."""
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    joined = _NUMBER_AND_UNIT.sub(_NO_BREAK_SPACE, line)
    pieces = textwrap.wrap(joined, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join(pieces).replace(_NO_BREAK_SPACE, " ")


def _log_record(log: Experiment) -> dict[str, Any]:
    source, t = log.source, log.trajectory.t
    columns = (
        {n: {"column": c.name, "unit": c.unit, "said_by": c.said_by} for n, c in source.columns.items()}
        if source
        else {}
    )
    return {
        "log": log.name,
        "file": source.path if source else "",
        "rows": len(log.trajectory),
        "first_row": source.first_row if source else 1,
        "begin": float(t[0]),
        "end": float(t[-1]),
        "sample_time": float(np.median(np.diff(t))),
        "channels": columns or {n: {} for n in log.trajectory},
        "unread": list(source.unread) if source else [],
        "sidecar": source.sidecar if source else "",
        "remarks": list(log.remarks),
    }


def _log_lines(log: Experiment) -> Iterator[str]:
    """File, rows and rate of a log, then its channels, and what is not read."""
    source, t = log.source, log.trajectory.t
    step, count = float(np.median(np.diff(t))), len(log.trajectory)
    rows = (
        f"rows {source.first_row} to {source.first_row + count - 1} of {source.path}" if source else f"{count} samples"
    )
    rate = f"every {write_value(step, 's', 4)} ({write_value(1 / step, 'Hz', 5)})"
    yield f"  {log.name or 'log'}: {rows}, {t[0]:.6g} s to {t[-1]:.6g} s, {rate}"
    for channel in log.trajectory:
        yield f"    {channel}: {_range(log, channel)}{_origin(log, channel)}"
    if source and "time" in source.columns:
        yield f"    time: column {source.columns['time'].name!r}"
    if source and source.sidecar:
        yield f"    {source.sidecar} says {', '.join(source.sections)}"
    if source and source.unread:
        yield f"    not read: {', '.join(source.unread)}"
    for name, value in log.conditions.items():
        yield f"    {name} = {value:g} in this log"
    yield from (f"    {remark}" for remark in log.remarks)


def _range(log: Experiment, channel: str) -> str:
    column, unit = log.trajectory[channel], log.unit(channel)
    low, high = (write_value(float(f(column)), unit, 3) for f in (np.nanmin, np.nanmax))
    missing = int(np.isnan(column).sum())
    return f"{low} to {high}" + (f", {missing} sample{'s' * (missing > 1)} missing" if missing else "")


def _origin(log: Experiment, channel: str) -> str:
    """The column of a channel, and what says its unit where the name does not."""
    column = log.source.columns.get(channel) if log.source else None
    if column is None:
        return ""
    unit = f" in {column.unit}" if column.unit_from not in ("its name", "its end", "") else ""
    by = f" ({column.unit_from})" if unit and column.unit_from == "the file's units" else ""
    said = f", as {column.said_by} says" if column.said_by else ""
    return f", column {column.name!r}{unit}{by}{said}"


def _assumption_lines(assumptions: Sequence[Assumption]) -> Iterator[str]:
    """As a file would say it, with the reason."""
    file, sections = "", list(dict.fromkeys(a.key.partition("]")[0] for a in assumptions))
    for a in sorted(assumptions, key=lambda a: sections.index(a.key.partition("]")[0])):
        if a.file != file:
            file = a.file
            yield f"  in {file}:"
        yield f"    {a.key} = {a.text}: {a.reason}"


def _verdict_lines(found: "Checkup") -> Iterator[str]:
    """A line a parameter, then why some are not identifiable."""
    if found.verdict is None:
        return
    table = found.verdict.table
    names = max(len(str(n)) for n in table.index)
    for name, row in table.iterrows():
        unit = found.parameters[str(name).partition("[")[0]].unit
        value = write_value(float(row["value"]), unit, 4)
        known = _deviation(float(row["value"]), float(row["relative"]), float(row["stderr"]), unit)
        yield f"  {name!s:<{names}}  {value:<15}  {known if row['identifiable'] else 'unidentifiable'}"
    yield from (f"  {sentence}" for sentence in found.verdict.sentences)


def _deviation(value: float, relative: float, stderr: float, unit: str) -> str:
    """The standard deviation; of less than `MIN_PERCENT` of the value only that."""
    share = 100 * (relative if math.isfinite(relative) else stderr / abs(value) if value else math.inf)
    if share < MIN_PERCENT:
        return f"+-{MIN_PERCENT} % or better"
    if math.isfinite(relative) and share < MAX_PERCENT:
        return f"+-{share:.2g} %"
    return f"+-{write_value(stderr, unit, 2)}" if math.isfinite(stderr) else "not computed"
