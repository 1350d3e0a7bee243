"""`check`: everything about logs before a fit, in seconds: what was read, assumed and found, and what logs identify.

`list_assumptions`: the values that a fit uses and that nobody has stated, with the keys that state them.
"""

import itertools
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import DEFAULT_WIDTH
from pneuopt.dynamics.runnable import Fittable, HasSystem, check_smooth
from pneuopt.identification.identifiability import (
    QUIET_CHECKS,
    accept_remedy,
    axis_from_model,
    find_exchange,
    foresee,
    is_accepted,
    is_refused,
)
from pneuopt.identification.identify import identify
from pneuopt.identification.problem import (
    EstimationProblem,
    as_estimation_model,
    as_experiments,
    check_free,
    check_logs,
    find_centre,
    find_log_warnings,
    input_behaviour,
    log_remarks,
    outputs_in_log,
)
from pneuopt.identification.result import UNIDENTIFIABLE_NOTE, Verdict
from pneuopt.identification.tolerances import TRIAL_SECONDS
from pneuopt.identification.widths import estimated_widths
from pneuopt.logs.doctor import LogFinding, Severity, evidence, examine
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import estimate_noise
from pneuopt.quantities.errors import ModelError, PhysicsWarning
from pneuopt.quantities.parameters import Intersample, ParameterSet, check_parameters
from pneuopt.quantities.report import TIED, Line, Report, Table, Tone, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Code
from pneuopt.quantities.units import ATMOSPHERE, write_value
from pneuopt.shooting.least_squares import LeastSquares

AMBIENT_PRESSURE = "ambient.pressure"  # the parameter of a drive that its gauge pressures count from
SIDECAR = "the log's sidecar"
DRIVE_FILE = "the drive's file"


@dataclass(frozen=True)
class Assumption:
    """A value that stands in no file.

    Attributes
    ----------
    name : str
        A parameter, an option, or "noise of position".
    value : float, str or bool
        [unit]; a word; a flag.
    unit : str
    key : str
        What states it: "[noise] position".
    file : str
        Where: `SIDECAR` or `DRIVE_FILE`.
    reason : str
        What it is, or where it comes from.
    """

    name: str
    value: float | str | bool
    unit: str
    key: str
    file: str
    reason: str

    @property
    def text(self) -> str:
        """The value with its unit, as a file has it."""
        if isinstance(self.value, bool):
            return str(self.value).lower()
        return f'"{self.value if isinstance(self.value, str) else write_value(self.value, self.unit, 6)}"'


class LogRow(TypedDict):
    """What was read of a log, an entry of "read" in `Checkup.to_dict`.

    Attributes
    ----------
    log : str
        Name of the log.
    file : str
        Path of its file; empty where the log was made in Python.
    rows : int
        Number of samples.
    first_row : int
        Row of the first sample in the file.
    begin : float
        Time of the first sample, in seconds.
    end : float
        Time of the last sample, in seconds.
    sample_time : float
        Median time between samples, in seconds.
    channels : mapping of str to mapping
        By channel the column, its unit and what says so.
    unread : list of str
        Columns that are no channel.
    sidecar : str
        Path of its sidecar, or empty.
    remarks : list of str
        What was mended or skipped.
    """

    log: str
    file: str
    rows: int
    first_row: int
    begin: float
    end: float
    sample_time: float
    channels: Mapping[str, Mapping[str, str]]
    unread: list[str]
    sidecar: str
    remarks: list[str]


@dataclass(frozen=True, eq=False, repr=False)
class Checkup(Shown):
    """The findings of `check`.

    Attributes
    ----------
    logs : tuple of Experiment
        As read; the `source` of each says from where.
    assumptions : tuple of Assumption
        Values in use that stand in no file.
    findings : tuple of LogFinding
        Faults first; each with its severity and rows.
    verdict : Verdict or None
        What the logs identify; None where a fault, or no free parameter, leaves that open.
    parameters : ParameterSet
        As they would be fitted: of the model, and as given.
    is_tried : bool
        Whether a trial fit converged, whose figures the verdict has; else they are those of a right model at its first
        start, which are seldom reached.
    """

    logs: tuple[Experiment, ...]
    assumptions: tuple[Assumption, ...]
    findings: tuple[LogFinding, ...]
    verdict: Verdict | None
    parameters: ParameterSet
    is_tried: bool = False

    @property
    def is_refused(self) -> bool:
        """Whether a fit would refuse the logs."""
        return any(f.severity is Severity.FAULT for f in self.findings)

    @property
    def runs(self) -> Mapping[str, tuple[str, ...]]:
        """The runs, or other remedies, that would identify parameters, and which ones."""
        reasons = self.verdict.reasons if self.verdict else {}
        found: dict[str, list[str]] = {}
        for name, reason in reasons.items():
            found.setdefault(reason.partition("; ")[2], []).append(name)
        return {run: tuple(names) for run, names in found.items() if run}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what the logs do not identify, and on what is wrong with them."""
        doubts = (f for f in self.findings if f.severity is Severity.DOUBT and f.check not in (MODEL_CHECK, LOG_CHECK))
        return (*(self.verdict.sentences if self.verdict else ()), *(f"{f.log}: {f.message}" for f in doubts))

    @property
    def headline(self) -> Line:
        """Whether a fit would take the logs, in a sentence."""
        count = {s: sum(f.severity is s for f in self.findings) for s in Severity}
        doubts = _count(count[Severity.DOUBT], "doubt")
        if count[Severity.FAULT]:
            faults = _count(count[Severity.FAULT], "fault")
            return Line(f"a fit would refuse this: {', '.join(filter(None, (faults, doubts)))}", Tone.BAD)
        unknown = self.verdict.unidentifiable if self.verdict else ()
        total = len(self.verdict.table) if self.verdict else 0
        known = f"the logs identify {total - len(unknown) if unknown else 'all'} of {total} free parameters"
        remarks = ", ".join(filter(None, (doubts, _count(count[Severity.NOTE], "note"))))
        if remarks:
            return Line(f"a fit takes this, with {remarks}: {known}", Tone.DOUBTFUL if doubts else Tone.GOOD)
        return Line(f"nothing is wrong: {known}", Tone.GOOD)

    def to_dict(self) -> dict[str, Any]:
        """The findings as a record, for a file."""
        verdict = self.verdict
        rows = verdict.table.reset_index(names="name").to_dict(orient="records") if verdict else []
        return {
            "verdict": self.headline.text,
            "read": [_log_record(log) for log in self.logs],
            "assumed": [{"name": a.name, "value": a.value, "unit": a.unit, "key": a.key} for a in self.assumptions],
            "found": [
                {"severity": f.severity.value, "log": f.log, "rows": f.rows, "check": f.check, "message": f.message}
                for f in self.findings
            ],
            "identifiable": rows,
            "reasons": dict(verdict.reasons) if verdict else {},
            "runs": {run: list(names) for run, names in self.runs.items()},
        }

    def summary(self) -> Report:
        """Whether a fit takes the logs; what was read, assumed and found; what is identifiable, and what would help."""
        file, sections, assumed = "", [a.key.partition("]")[0] for a in self.assumptions], list[Line | Table]()
        for a in sorted(self.assumptions, key=lambda a: sections.index(a.key.partition("]")[0])):
            assumed += [_line(f"in {a.file}:", 2)] if a.file != file else []
            assumed.append(_line(f"{a.key} = {a.text}: {a.reason}", 4))
            file = a.file
        how = "by a trial fit" if self.is_tried else "if the model is right: a fit takes longer, and may know less"
        blocks: dict[str, list[Line | Table]] = {
            "read": [*itertools.chain.from_iterable(map(_log_lines, self.logs))],
            "assumed, for it stands in no file; written so, it states the same": assumed,
            "found": [*map(finding_line, self.findings)],
            f"identifiable, {how}": [*_verdict_parts(self)],
            "what would help": [_line(f"{run}: for {', '.join(names)}", 2) for run, names in self.runs.items()],
        }
        parts: list[Line | Table] = [self.headline]
        for title, block in blocks.items():
            if block:
                parts += [Line(""), Line(title, Tone.HEADING), *block]
        return Report(tuple(parts))


def check(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Iterable[Experiment],
    parameters: ParameterSet,
    *,
    trial: bool = True,
) -> Checkup:
    """Check logs, a drive and its parameters before a fit, with a trial fit of a few seconds.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`; its own parameters count where none are given.
    experiments : Experiment or sequence of Experiment
        The logs, as read.
    parameters : ParameterSet
        As for `identify`.
    trial : bool
        Whether to try a fit of a few seconds; else the verdict is that of a right model at its first start.

    Returns
    -------
    Checkup
        What was read and assumed, what is wrong, what the logs identify, and which run would help. The figures of what
        they identify are of a trial fit; where it does not converge so soon, of a right model at its first start.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together; the message names log, channel or parameter.
    """
    model, given = as_estimation_model(system), as_experiments(experiments)
    check_smooth(model)
    check_parameters(parameters)
    logs = check_logs(model, given, parameters)
    assumptions = list_assumptions(model, given, logs, parameters)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", PhysicsWarning)
        parameters = find_centre(model, logs, parameters)
    found = [_model_finding(str(w.message), logs) for w in said]
    found += [f for log in logs for f in examine(log, axis_from_model(model.plant, log, parameters))]
    for log in logs:
        several = len({f.channel for f in found if f.fault and f.log == log.name}) > 1
        if several and (pair := find_exchange(model, log, parameters)):
            message = f"with the columns of {pair[0]} and {pair[1]} exchanged nothing is wrong: say so in [columns]"
            found.append(LogFinding(pair[0], message, False, EXCHANGE_CHECK, log.name, evidence(log, *pair)))
    found += [_model_finding(sentence, logs) for sentence in find_log_warnings(model, logs, parameters)]
    found += _log_findings(model, given, logs)
    try:
        check_free(logs, parameters)
    except ModelError as error:
        found.append(LogFinding("", str(error), True, FREE_CHECK))
    ranked = [_locate(_rank(f, found, logs), logs) for f in found]
    ranked.sort(key=lambda f: list(Severity).index(f.severity))
    is_open = any(f.severity is Severity.FAULT for f in ranked)
    problem = EstimationProblem(model, tuple(logs), model.parameters | parameters, LeastSquares())
    tried = None if is_open or not trial else _try_fit(system, problem)
    verdict = None if is_open else tried or foresee(problem)
    return Checkup(given, assumptions, tuple(ranked), verdict, model.parameters | parameters, tried is not None)


def _try_fit(system: HasSystem | ClosedLoop, problem: EstimationProblem) -> Verdict | None:
    """The verdict of a fit of a few seconds, without widths, for which nobody asks; None where none converges."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # of what this check has found
        logs, given = problem.experiments, problem.parameters
        found = identify(system, logs, given, cpu_seconds=TRIAL_SECONDS, explain=False, throw=False)
    if found.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    if found.verdict is None or found.status.code not in (Code.CONVERGED, Code.PARTIAL):
        return None
    asked = [n for n in found.verdict.table.index if n not in estimated_widths(found.parameters)]
    return replace(found.verdict, table=found.verdict.table.loc[asked])


def list_assumptions(
    system: Fittable, given: Sequence[Experiment], checked: Sequence[Experiment], parameters: ParameterSet
) -> tuple[Assumption, ...]:
    """The noise, the behaviour between samples and the fixed parameters that nobody has stated."""
    found, levels = list[Assumption](), dict[str, float]()
    units = {q.name: q.unit.partition("(")[0] for q in system.outputs}
    for log, full in zip(given, checked, strict=True):
        for channel in (n for n in outputs_in_log(system, full) if n not in log.noise and n not in levels):
            levels[channel] = float(f"{full.noise[channel]:.3g}")
            shown = estimate_noise(full.trajectory[channel], full.trajectory.t)
            how = "its resolution, as the logs show" if shown.is_quantisation else "white, as the logs show"
            noise = f"noise of {channel}", levels[channel], units[channel], f"[noise] {channel}"
            found.append(Assumption(*noise, SIDECAR, how))
    behaviour = {
        n: kind for log in given for n, kind in input_behaviour(system, log).items() if n not in log.intersample
    }
    for channel, kind in behaviour.items():
        how = "as a command runs" if kind is Intersample.HELD else "as a measured channel runs"
        name, key = f"{channel} between samples", f"[intersample] {channel}"
        found.append(Assumption(name, kind.value, "", key, SIDECAR, f"{how} between samples"))
    columns = [column for log in given if log.source for column in log.source.columns.values()]
    if AMBIENT_PRESSURE not in system.parameters and any("(g)" in column.unit for column in columns):
        zero = "zero of gauge pressures", ATMOSPHERE, "Pa(a)", "bar(a)", "the log's units", "the standard's"
        found.append(Assumption(*zero))
    for name, usual in system.parameters.items():
        used = parameters.get(name, usual)
        if used.free or used.stated or used != usual:
            continue
        section, _, key = name.partition(".")
        reason = f"{used.meaning} ({used.source})" if used.source else used.meaning
        if used.source == DEFAULT_WIDTH:
            reason = f"{used.meaning}; identify estimates it with the rest"
        found.append(Assumption(name, used.value, used.unit, f"[{section}] {key}", DRIVE_FILE, reason))
    return tuple(found)


MODEL_CHECK, LOG_CHECK, FREE_CHECK, EXCHANGE_CHECK = "model", "log", "free", "exchange"
"""Names of findings that no check of the log doctor makes: by the model's equations, of what was mended in a log, of
parameters of which none is free, and of two columns that are exchanged."""
OTHER_CHECKS = (MODEL_CHECK, LOG_CHECK, FREE_CHECK, EXCHANGE_CHECK)
_NUMBER_AND_UNIT = re.compile(r"(?<=\d) (?=(?:[a-zA-Z]?(?:m|s|N|V|g|Hz|Pa|bar|rad|J|K|W)|%)(?![a-z]))")
_TONES = {Severity.FAULT: Tone.BAD, Severity.DOUBT: Tone.DOUBTFUL, Severity.NOTE: Tone.PLAIN}


def _model_finding(sentence: str, logs: Sequence[Experiment]) -> LogFinding:
    """A finding of the model, with the channels that its sentence names as evidence."""
    about = [e for e in logs if re.search(rf"(^|of ){re.escape(e.name)}:", sentence)] or list(logs[:1])
    log = about[0]
    message = sentence.removeprefix(f"{log.name}: ")
    channels = [n for n in log.trajectory if n in message or f"the {n.partition('_')[0]}s " in message]
    moved = [n for n in ("position", "speed") if n in log.trajectory and n not in channels]
    shown = evidence(log, *channels, *moved[:1]) if channels else None
    return LogFinding(channels[0] if channels else "", message, False, MODEL_CHECK, log.name, shown)


def _log_findings(model: Fittable, given: Sequence[Experiment], logs: Sequence[Experiment]) -> Iterator[LogFinding]:
    """Findings on what was mended in each log, on its noise, and on measured samples that are missing."""
    for log, checked in zip(given, logs, strict=True):
        for sentence in log_remarks(model, [log], [checked]):
            yield LogFinding("", sentence.removeprefix(f"{checked.name}: "), False, LOG_CHECK, checked.name)
        for channel in outputs_in_log(model, log):
            at = np.flatnonzero(np.isnan(log.trajectory[channel]))
            if at.size:
                count = f"{at.size} sample{'s' * (at.size > 1)} of {channel} {'are' if at.size > 1 else 'is'} missing"
                rows = (log.source.first_row + int(at[0]), log.source.first_row + int(at[-1])) if log.source else None
                message = f"{count}; a fit goes without"
                yield LogFinding(channel, message, False, LOG_CHECK, checked.name, rows=rows)


def _rank(finding: LogFinding, found: Sequence[LogFinding], logs: Sequence[Experiment]) -> LogFinding:
    """The finding with what it means for a fit of all logs."""
    if not finding.fault:
        is_doubt = finding.check not in (*QUIET_CHECKS, LOG_CHECK) or "the log itself shows" in finding.message
        return replace(finding, severity=Severity.DOUBT if is_doubt else Severity.NOTE)
    if finding.check == FREE_CHECK:
        return replace(finding, severity=Severity.FAULT)
    if is_refused(finding, found, logs):
        return replace(finding, severity=Severity.FAULT, message=f"{finding.message}; {accept_remedy(finding)}")
    is_right = is_accepted(finding, logs)
    why = "accepted as right" if is_right else "most logs do not show it, so that a fit takes this one, too"
    return replace(finding, severity=Severity.DOUBT, message=f"{finding.message} ({why})")


def _locate(finding: LogFinding, logs: Sequence[Experiment]) -> LogFinding:
    """The finding with the rows of its log's file that show it."""
    log = next((e for e in logs if e.name == finding.log), None)
    if log is None or log.source is None:
        return finding
    if finding.check == LOG_CHECK and log.holes and "is cut" in finding.message:
        first, last = log.holes[0][0] - 1, log.holes[0][1]
    elif finding.evidence is None or finding.evidence.contradiction.all():
        return finding
    else:
        shown, (begin, end) = finding.evidence, finding.evidence.view
        at = np.flatnonzero(shown.contradiction & (shown.t >= begin) & (shown.t <= end))
        if not at.size:
            return finding
        first, last = (int(k) for k in np.searchsorted(log.trajectory.t, shown.t[at[[0, -1]]]))
    first, last = max(first, 0), min(last, len(log.trajectory) - 1)
    return replace(finding, rows=(log.source.first_row + first, log.source.first_row + last))


def finding_line(finding: LogFinding) -> Line:
    """Severity, log and rows, and what was found."""
    place = finding.log
    if finding.rows is not None:
        first, last = finding.rows
        place += f", row {first}" if first == last else f", rows {first} to {last}"
    lead = f"{finding.severity}{f' in {place}' if place else ''}"
    return replace(_line(f"{lead}: {finding.message}", 2), tone=_TONES[finding.severity])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number > 1 else ''}" if number else ""


def _line(text: str, indent: int) -> Line:
    """A line that does not end between a number and its unit."""
    return Line(_NUMBER_AND_UNIT.sub(TIED, text), indent=indent)


def _log_record(log: Experiment) -> LogRow:
    source, t = log.source, log.trajectory.t
    columns = source.columns if source else {}
    return {
        "log": log.name,
        "file": source.path if source else "",
        "rows": len(log.trajectory),
        "first_row": source.first_row if source else 1,
        "begin": float(t[0]),
        "end": float(t[-1]),
        "sample_time": float(np.median(np.diff(t))),
        "channels": {n: {"column": c.name, "unit": c.unit, "said_by": c.said_by} for n, c in columns.items()}
        or {n: {} for n in log.trajectory},
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
        column, unit = log.trajectory[channel], log.unit(channel)
        low, high = (write_value(float(f(column)), unit, 3) for f in (np.nanmin, np.nanmax))
        missing = int(np.isnan(column).sum())
        lost = f", {missing} sample{'s' * (missing > 1)} missing" if missing else ""
        origin, read = "", source.columns.get(channel) if source else None
        if read is not None:  # the column, and what says its unit where the name does not
            of_unit = f" in {read.unit}" if read.unit_from not in ("its name", "its end", "") else ""
            by = f" ({read.unit_from})" if of_unit and read.unit_from == "the file's units" else ""
            origin = f", column {read.name!r}{of_unit}{by}" + (f", as {read.said_by} says" if read.said_by else "")
        yield _line(f"{channel}: {low} to {high}{lost}{origin}", 4)
    if source and "time" in source.columns:
        yield _line(f"time: column {source.columns['time'].name!r}", 4)
    if source and source.sidecar:
        yield _line(f"{source.sidecar} says {', '.join(source.sections)}", 4)
    if source and source.unread:
        yield _line(f"not read: {', '.join(source.unread)}", 4)
    for name, value in log.conditions.items():
        yield _line(f"{name} = {value:g} in this log", 4)
    yield from (_line(remark, 4) for remark in log.remarks)


def _verdict_parts(found: Checkup) -> Iterator[Line | Table]:
    """A row a parameter, then why some are not identifiable."""
    if found.verdict is None:
        return
    rows = []
    for name, row in found.verdict.table.iterrows():
        unit = found.parameters[str(name).partition("[")[0]].unit
        value, stderr = (float(row[k]) for k in ("value", "stderr"))
        share = 100 * stderr / abs(value) if value else math.inf
        known = f"+-{write_value(stderr, unit, 2)}" if math.isfinite(stderr) else "not computed"
        if share < 100:
            known = f"+-{share:.2g} %"
        known = known if row["identifiable"] else UNIDENTIFIABLE_NOTE
        rows.append((str(name), write_value(value, unit, 4), known))
    yield Table(text_columns("parameter", "value", "deviation"), tuple(rows))
    yield from (_line(sentence, 2) for sentence in found.verdict.sentences)
