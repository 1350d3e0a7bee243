"""`check`: everything about logs before a fit, in seconds: what was read, assumed and found, and what logs identify."""

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import Fittable, HasSystem, check_smooth
from pneuopt.identification.assumptions import Assumption, list_assumptions
from pneuopt.identification.checks import (
    as_experiments,
    check_free,
    check_logs,
    find_log_warnings,
    log_remarks,
    outputs_in_log,
)
from pneuopt.identification.command_centre import find_centre
from pneuopt.identification.examination import QUIET_CHECKS, accept_remedy, is_accepted, is_refused
from pneuopt.identification.exchange import find_exchange
from pneuopt.identification.identifiability import verdict_from_sensitivities
from pneuopt.identification.problem import EstimationProblem, as_estimation_model
from pneuopt.identification.result import Verdict
from pneuopt.identification.stated_axis import stated_axis
from pneuopt.logs.checks.findings import LogFinding, Severity, evidence
from pneuopt.logs.doctor import examine
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.errors import ModelError, PhysicsWarning
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report
from pneuopt.quantities.shown import Shown
from pneuopt.shooting.least_squares import LeastSquares

MODEL_CHECK, LOG_CHECK, FREE_CHECK, EXCHANGE_CHECK = "model", "log", "free", "exchange"
"""Names of findings that no check of the log doctor makes: by the model's equations, of what was mended in a log, of
parameters of which none is free, and of two columns that are exchanged."""
OTHER_CHECKS = (MODEL_CHECK, LOG_CHECK, FREE_CHECK, EXCHANGE_CHECK)


@dataclass(frozen=True, eq=False, repr=False)
class Checkup(Shown):
    """What `check` finds.

    Attributes
    ----------
    logs : tuple of Experiment
        As read; the `source` of each says from where.
    assumptions : tuple of Assumption
        Values in use that stand in no file.
    findings : tuple of LogFinding
        Faults first; each with its severity and rows.
    verdict : Verdict or None
        What the logs identify, from sensitivities at the start; None where a fault, or no free parameter, leaves that
        open.
    parameters : ParameterSet
        As they would be fitted: of the model, and as given.
    """

    logs: tuple[Experiment, ...]
    assumptions: tuple[Assumption, ...]
    findings: tuple[LogFinding, ...]
    verdict: Verdict | None
    parameters: ParameterSet

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
        """What matters for a fit: what the logs do not identify, and what is wrong with them, a sentence each."""
        doubts = (f for f in self.findings if f.severity is Severity.DOUBT and f.check not in (MODEL_CHECK, LOG_CHECK))
        return (*(self.verdict.sentences if self.verdict else ()), *(f"{f.log}: {f.message}" for f in doubts))

    def to_dict(self) -> dict[str, Any]:
        """What was found, for a file."""
        from pneuopt.identification.checkup_report import as_dict

        return as_dict(self)

    def summary(self) -> Report:
        """Whether a fit takes the logs; what was read, assumed and found; what is identifiable, and what would help."""
        from pneuopt.identification.checkup_report import report_checkup

        return report_checkup(self)


def check(
    system: HasSystem | ClosedLoop, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> Checkup:
    """Check logs, a drive and its parameters before a fit: no search is run.

    Parameters
    ----------
    system : drive, System or ClosedLoop
    experiments : Experiment or sequence of Experiment
    parameters : ParameterSet
        As for `identify`.

    Returns
    -------
    Checkup
        What was read and assumed, what is wrong, what the logs identify, and which run would help. The figures of what
        they identify are those of a right model and white noise: no estimate is better.

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
    parameters, found = _find_centre(model, logs, parameters)
    found += [f for log in logs for f in examine(log, stated_axis(model.plant, log, parameters))]
    found += [f for log in logs for f in _exchange_findings(model, log, parameters, found)]
    found += [*_model_findings(model, logs, parameters), *_log_findings(model, given, logs), *_free(logs, parameters)]
    ranked = sorted(
        (_locate(_rank(f, found, logs), logs) for f in found), key=lambda f: list(Severity).index(f.severity)
    )
    is_open = any(f.severity is Severity.FAULT for f in ranked)
    verdict = None if is_open else _find_verdict(model, logs, parameters)
    return Checkup(given, assumptions, tuple(ranked), verdict, model.parameters | parameters)


def _find_verdict(model: Fittable, logs: Sequence[Experiment], parameters: ParameterSet) -> Verdict:
    problem = EstimationProblem(model, tuple(logs), model.parameters | parameters, LeastSquares())
    return verdict_from_sensitivities(problem, problem.candidates()[0])


def _find_centre(
    model: Fittable, logs: Sequence[Experiment], parameters: ParameterSet
) -> tuple[ParameterSet, list[LogFinding]]:
    """The parameters with the valve's centre, and what is to be said of it."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", PhysicsWarning)
        parameters = find_centre(model, logs, parameters)
    return parameters, [_model_finding(str(w.message), logs) for w in said]


def _model_findings(model: Fittable, logs: Sequence[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    """What only the equations see: a gauge pressure read as absolute, a sensor before the line."""
    for sentence in find_log_warnings(model, logs, parameters):
        yield _model_finding(sentence, logs)


def _model_finding(sentence: str, logs: Sequence[Experiment]) -> LogFinding:
    """A finding of the model, with the channels that its sentence names as evidence."""
    about = [e for e in logs if re.search(rf"(^|of ){re.escape(e.name)}:", sentence)] or list(logs[:1])
    log = about[0]
    message = sentence.removeprefix(f"{log.name}: ")
    channels = [n for n in log.trajectory if n in message or f"the {n.partition('_')[0]}s " in message]
    moved = [n for n in ("position", "speed") if n in log.trajectory and n not in channels]
    shown = evidence(log, *channels, *moved[:1]) if channels else None
    return LogFinding(channels[0] if channels else "", message, False, MODEL_CHECK, log.name, shown)


def _exchange_findings(
    model: Fittable, log: Experiment, parameters: ParameterSet, found: Sequence[LogFinding]
) -> Iterator[LogFinding]:
    """That two columns are exchanged, where a log has faults in two channels, and none once they are."""
    several = len({f.channel for f in found if f.fault and f.log == log.name}) > 1
    pair = find_exchange(model, log, parameters) if several else None
    if pair is not None:
        message = f"with the columns of {pair[0]} and {pair[1]} exchanged nothing is wrong: say so in [columns]"
        yield LogFinding(pair[0], message, False, EXCHANGE_CHECK, log.name, evidence(log, *pair))


def _log_findings(model: Fittable, given: Sequence[Experiment], logs: Sequence[Experiment]) -> Iterator[LogFinding]:
    """What was mended in each log, or doubted of its noise, and which measured samples are missing."""
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


def _free(logs: Sequence[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    """The fault that nothing is to be identified."""
    try:
        check_free(logs, parameters)
    except ModelError as error:
        yield LogFinding("", str(error), True, FREE_CHECK)


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
