"""What a `Checkup` shows, whether a fit takes the logs, what was read, assumed and found, and what a file holds."""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.identification.assumptions import Assumption
from pneuopt.identification.marks import UNIDENTIFIABLE_NOTE
from pneuopt.logs.checks.findings import LogFinding, Severity
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.report import TIED, Line, Report, Table, Tone, text_columns
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    from pneuopt.identification.checkup import Checkup

MIN_PERCENT = 0.1
"""Standard deviation over the value [%] below which the model's errors count, and not the noise: a lower one promises
what no rig keeps, a higher one hides what quiet sensors give."""
MAX_PERCENT = 100.0
"""Standard deviation over the value [%] beyond which its digits say nothing."""
_NUMBER_AND_UNIT = re.compile(r"(?<=\d) (?=(?:[a-zA-Z]?(?:m|s|N|V|g|Hz|Pa|bar|rad|J|K|W)|%)(?![a-z]))")
_TONES = {Severity.FAULT: Tone.BAD, Severity.DOUBT: Tone.DOUBTFUL, Severity.NOTE: Tone.PLAIN}


def report_checkup(found: "Checkup") -> Report:
    """The verdict, and below it what was read, assumed and found, and what the logs identify."""
    blocks: dict[str, list[Line | Table]] = {
        "read": [*itertools.chain.from_iterable(map(_log_lines, found.logs))],
        "assumed, for it stands in no file; written so, it states the same": [*_assumption_lines(found.assumptions)],
        "found": [*map(finding_line, found.findings)],
        "identifiable, by sensitivities at the start values, if the model is right": [*_verdict_parts(found)],
        "what would help": [_line(f"{run}: for {', '.join(names)}", 2) for run, names in found.runs.items()],
    }
    parts: list[Line | Table] = [headline(found)]
    for title, block in blocks.items():
        if block:
            parts += [Line(""), Line(title, Tone.HEADING), *block]
    return Report(tuple(parts))


def headline(found: "Checkup") -> Line:
    """Whether a fit would take the logs, in a sentence."""
    count = {s: sum(f.severity is s for f in found.findings) for s in Severity}
    doubts = _count(count[Severity.DOUBT], "doubt")
    if count[Severity.FAULT]:
        faults = _count(count[Severity.FAULT], "fault")
        return Line(f"a fit would refuse this: {', '.join(filter(None, (faults, doubts)))}", Tone.BAD)
    unknown = found.verdict.unidentifiable if found.verdict else ()
    total = len(found.verdict.table) if found.verdict else 0
    known = f"the logs identify {total - len(unknown) if unknown else 'all'} of {total} free parameters"
    remarks = ", ".join(filter(None, (doubts, _count(count[Severity.NOTE], "note"))))
    if remarks:
        return Line(f"a fit takes this, with {remarks}: {known}", Tone.DOUBTFUL if doubts else Tone.GOOD)
    return Line(f"nothing is wrong: {known}", Tone.GOOD)


def finding_line(finding: LogFinding) -> Line:
    """Severity, log and rows, and what was found."""
    place = finding.log
    if finding.rows is not None:
        first, last = finding.rows
        place += f", row {first}" if first == last else f", rows {first} to {last}"
    lead = f"{finding.severity}{f' in {place}' if place else ''}"
    return replace(_line(f"{lead}: {finding.message}", 2), tone=_TONES[finding.severity])


def as_dict(found: "Checkup") -> dict[str, Any]:
    """What a JSON file holds."""
    verdict = found.verdict
    rows = verdict.table.reset_index(names="name").to_dict(orient="records") if verdict else []
    return {
        "verdict": headline(found).text,
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


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number > 1 else ''}" if number else ""


def _line(text: str, indent: int) -> Line:
    """A line that does not end between a number and its unit."""
    return Line(_NUMBER_AND_UNIT.sub(TIED, text), indent=indent)


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


def _log_lines(log: Experiment) -> Iterator[Line]:
    """File, rows and rate of a log, then its channels, and what is not read."""
    source, t = log.source, log.trajectory.t
    step, count = float(np.median(np.diff(t))), len(log.trajectory)
    rows = (
        f"rows {source.first_row} to {source.first_row + count - 1} of {source.path}" if source else f"{count} samples"
    )
    rate = f"every {write_value(step, 's', 4)} ({write_value(1 / step, 'Hz', 5)})"
    yield _line(f"{log.name or 'log'}: {rows}, {t[0]:.6g} s to {t[-1]:.6g} s, {rate}", 2)
    for channel in log.trajectory:
        yield _line(f"{channel}: {_range(log, channel)}{_origin(log, channel)}", 4)
    if source and "time" in source.columns:
        yield _line(f"time: column {source.columns['time'].name!r}", 4)
    if source and source.sidecar:
        yield _line(f"{source.sidecar} says {', '.join(source.sections)}", 4)
    if source and source.unread:
        yield _line(f"not read: {', '.join(source.unread)}", 4)
    for name, value in log.conditions.items():
        yield _line(f"{name} = {value:g} in this log", 4)
    yield from (_line(remark, 4) for remark in log.remarks)


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


def _assumption_lines(assumptions: Sequence[Assumption]) -> Iterator[Line]:
    """As a file would say it, with the reason."""
    file, sections = "", list(dict.fromkeys(a.key.partition("]")[0] for a in assumptions))
    for a in sorted(assumptions, key=lambda a: sections.index(a.key.partition("]")[0])):
        if a.file != file:
            file = a.file
            yield _line(f"in {file}:", 2)
        yield _line(f"{a.key} = {a.text}: {a.reason}", 4)


def _verdict_parts(found: "Checkup") -> Iterator[Line | Table]:
    """A row a parameter, then why some are not identifiable."""
    if found.verdict is None:
        return
    rows = []
    for name, row in found.verdict.table.iterrows():
        unit = found.parameters[str(name).partition("[")[0]].unit
        known = _deviation(float(row["value"]), float(row["relative"]), float(row["stderr"]), unit)
        value = write_value(float(row["value"]), unit, 4)
        rows.append((str(name), value, known if row["identifiable"] else UNIDENTIFIABLE_NOTE))
    yield Table(text_columns("parameter", "start", "deviation"), tuple(rows))
    yield from (_line(sentence, 2) for sentence in found.verdict.sentences)


def _deviation(value: float, relative: float, stderr: float, unit: str) -> str:
    """The standard deviation; of less than `MIN_PERCENT` of the value only that."""
    share = 100 * (relative if math.isfinite(relative) else stderr / abs(value) if value else math.inf)
    if share < MIN_PERCENT:
        return f"+-{MIN_PERCENT} % or better"
    if math.isfinite(relative) and share < MAX_PERCENT:
        return f"+-{share:.2g} %"
    return f"+-{write_value(stderr, unit, 2)}" if math.isfinite(stderr) else "not computed"
