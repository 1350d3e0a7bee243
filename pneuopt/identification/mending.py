"""`mend_findings`: what the log doctor finds in a log, mended where a rule is certain and the finding is gone then.

A newcomer writes ``rule(mended, finding, ambient) -> MendedLog | None`` and a row in `RULES`.
"""

from collections.abc import Callable

import numpy as np

from pneuopt.dynamics.runnable import Fittable
from pneuopt.identification.examination import axis_from_model, exchange, find_exchange, is_accepted
from pneuopt.identification.problem import check_logs
from pneuopt.logs.doctor import LogFinding, examine
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.mending import MendedLog, convert, empty_cells, leave_out
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.parameters import ParameterSet

Rule = Callable[[MendedLog, LogFinding, float], MendedLog | None]


def mend_findings(model: Fittable, mended: MendedLog, parameters: ParameterSet, ambient: float) -> MendedLog:
    """Mend the faults of a log for which there is a rule; a rule after which the fault is still found is taken back.

    Parameters
    ----------
    model : Fittable
    mended : MendedLog
    parameters : ParameterSet
        As for `identify`.
    ambient : float
        Pressure from which gauge pressures count [Pa].

    Raises
    ------
    LogError
        If motion and force are both wrong as a whole: nobody can tell what is right.
    """
    several = len({f.channel for f in _faults(model, mended.log, parameters)}) > 1
    pair = find_exchange(model, mended.log, parameters) if several else None
    if pair is not None:
        why = f"columns of {pair[0]} and {pair[1]} exchanged, for with them so nothing is wrong"
        return MendedLog(exchange(mended.log, *pair), mended.rows, (*mended.changes, why))
    tried, used = set[tuple[str, str]](), set[str]()
    while True:
        found = [f for f in _faults(model, mended.log, parameters) if _name(f) not in tried and f.check in RULES]
        if not found:
            break
        tried.add(_name(found[0]))
        changed = RULES[found[0].check](mended, found[0], ambient)
        if changed and _name(found[0]) not in {_name(f) for f in _faults(model, changed.log, parameters)}:
            mended = changed
            used.add(found[0].check)
    both = "the signs or sizes of two channels are wrong at once: is a column another channel? say in [columns] which"
    require(not used >= {"work", "scale"}, f"{mended.log.name}: {both}", LogError)
    return mended


def _name(finding: LogFinding) -> tuple[str, str]:
    return finding.check, finding.channel


def _faults(model: Fittable, log: Experiment, parameters: ParameterSet) -> list[LogFinding]:
    (full,) = check_logs(model, log, parameters)
    found = examine(full, axis_from_model(model.plant, full, parameters))
    return [f for f in found if f.fault and not is_accepted(f, [full])]


def _between_jumps(mended: MendedLog, finding: LogFinding, _: float) -> MendedLog | None:
    """A counter that loses steps and finds them again: nothing is known of the position in between."""
    if finding.evidence is None:
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finding.evidence.contradiction, [False]]).astype(int)))
    begins, ends = edges[::2] + 1, edges[1::2] - 1  # first sample behind a jump, last sample of its mark
    if begins.size % 2:
        return None
    lost = np.zeros(len(mended.log.trajectory), dtype=bool)
    for begin, end in zip(begins[::2], ends[1::2], strict=True):
        lost[begin:end] = True
    return empty_cells(mended, finding.channel, lost, "between two jumps")


def _at_stop(mended: MendedLog, finding: LogFinding, _: float) -> MendedLog | None:
    lost = None if finding.evidence is None else finding.evidence.contradiction
    return None if lost is None else leave_out(mended, lost, "at an end stop that the model has not")


def _turn_sign(mended: MendedLog, finding: LogFinding, _: float) -> MendedLog | None:
    """Of a force that brakes on balance; of two pressures, nobody knows which sensor is meant."""
    if finding.channel not in mended.log.trajectory:
        return None
    return convert(mended, finding.channel, -1.0, 0.0, "for it brakes the motion on balance")


def _to_metres(mended: MendedLog, finding: LogFinding, _: float) -> MendedLog | None:
    return convert(mended, finding.channel, 1e-3, 0.0, "for it moves as fast as mm that are read as m")


def _to_absolute(mended: MendedLog, finding: LogFinding, ambient: float) -> MendedLog | None:
    if "a vacuum" not in finding.message:
        return None
    return convert(mended, finding.channel, 1.0, ambient, "for it is a gauge pressure that is read as absolute")


RULES: dict[str, Rule] = {
    "jumps": _between_jumps,
    "stops": _at_stop,
    "work": _turn_sign,
    "scale": _to_metres,
    "pressures": _to_absolute,
}
"""By the name of the check."""
