"""`certify_on_rig`: a certified design once more, on the event-accurate model of the rig that it is for."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import metric_name, requirement_values, upper_limit, user_value
from pneuopt.evaluation.rest_check import NoHunting, RestKind, check_rest
from pneuopt.evaluation.rig import Rig
from pneuopt.quantities.errors import ConvergenceError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import write_value
from pneuopt.tuning.method import TuningTask
from pneuopt.tuning.result import TuningResult

if TYPE_CHECKING:
    import pandas as pd


def check_rig(rig: Rig | None, task: TuningTask) -> None:
    """Refuse a rig that is not one of this loop, and a limit that only a rig shows without one.

    Raises
    ------
    InputError
    """
    if rig is None:
        told = "NoHunting is read on the event-accurate model of the rig, which sticks; give rig=, or --rig rig.toml"
        require(task.spec.rest is None, told)
        return
    compares = task.spec.rest is not None and np.isfinite(task.spec.rest.repeatability)
    told = "NoHunting: repeatability is a range over references, and there is one; give more, from several starts"
    require(not compares or len(task.references) > 1, told)
    require(rig.loop is not None, "the rig has no controller; make it of the loop, Rig(ClosedLoop(...), sensors)")
    signals = [(own.feedback.name, own.command.name, own.pid) for own in (rig.loop, task.loop) if own is not None]
    message = f"the rig's loop controls {signals[0][:2]}, the loop to be tuned {signals[-1][:2]}, or with another PID"
    require(signals[0] == signals[-1], f"{message}; make the rig of the same loop, with Karnopp's friction")


def certify_on_rig(task: TuningTask, result: TuningResult, rig: Rig) -> TuningResult:
    """The result with what the rig shows of its design; where a limit breaks there, it is no longer certified.

    Every reference is followed on the nominal plant. Margins are those of the smooth loop, which a rig does not have.

    Parameters
    ----------
    task : TuningTask
    result : TuningResult
        Certified.
    rig : Rig
    """
    assert rig.loop is not None
    parameters = task.space.parameters | result.parameters
    own = parameters.select(n for n in parameters if n in rig.loop.parameters)
    spec = task.spec
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            found = evaluate(rig, task.references, own, band=spec.band, envelope=spec.envelope, max_steps=np.inf)
    except ConvergenceError as error:
        return _reject(task, result, None, (f"the simulation of the rig stops: {error}",))
    contacts = [str(w.message) for w in caught if issubclass(w.category, PhysicsWarning)]
    breaks = tuple(dict.fromkeys((*contacts, *_breaks(task, found))))
    if breaks:
        return _reject(task, result, found, breaks)
    result = replace(result, on_rig=found)
    return result if spec.rest is None else _watch_rest(task, result, rig, own, spec.rest)


def _watch_rest(
    task: TuningTask, result: TuningResult, rig: Rig, parameters: ParameterSet, wanted: NoHunting
) -> TuningResult:
    """The result with how the loop ends on the rig; where it does not end as wanted, it is no longer certified."""
    rest = check_rest(rig, task.references, parameters, duration=wanted.duration)
    breaks = tuple(f"on the rig {case.sentence}" for case in rest.cases if case.kind is not RestKind.RESTS)
    if rest.rests and rest.repeatability > wanted.repeatability:
        reached, limit = (write_value(v, rest.unit, 3) for v in (rest.repeatability, wanted.repeatability))
        breaks = (f"on the rig its errors at rest range over {reached}, the limit of repeatability is {limit}",)
    if breaks:
        return replace(_reject(task, result, result.on_rig, breaks), rest=rest)
    told = f"on the rig it comes to rest, watched for {wanted.duration:g} s"
    return replace(result, rest=rest, status=result.status.with_details(told))


def _breaks(task: TuningTask, found: "pd.DataFrame") -> Iterator[str]:
    """What breaks on the rig, a sentence each."""
    rows = found.to_dict()
    never = [str(case) for case, row in rows.items() if not np.isfinite(row["SettlingTime"])]
    if never:
        yield f"on the rig it never settles at {' and '.join(never)}{_hunting(rows[never[0]], task)}"
    for q in task.spec.limits:
        values = _requirement_rows(metric_name(q), found)
        worst = max(values, key=lambda case: values[case], default="")
        if worst and not (metric_name(q) == "SettlingTime" and never) and not values[worst] <= upper_limit(q):
            value, limit = (_shown(q, v, task) for v in (values[worst], upper_limit(q)))
            yield f"on the rig {metric_name(q)} is {value} at {worst}, the limit is {limit}"


def _remedies(task: TuningTask, result: TuningResult, found: "pd.DataFrame") -> Iterator[str]:
    """With which limit the search would leave the room that the rig needs, if the rig adds as much again.

    A relaxed limit is named only where the loop settles on the rig, for it mends nothing else.
    """
    settles = bool(np.isfinite(found.loc["SettlingTime"].to_numpy(dtype=float)).all())
    for q in task.spec.limits:
        n = metric_name(q)
        on_rig, smooth = (max(_requirement_rows(n, f).values(), default=-np.inf) for f in (found, result.certified))
        room = upper_limit(q) - (on_rig - smooth)
        if np.isfinite(on_rig) and on_rig > upper_limit(q) and q.metric.sense is Sense.AT_MOST:
            added = f"the rig adds {_shown(q, on_rig - smooth, task)} to {n}"
            if room > 0:
                yield f"{added}: tune with at most {_shown(q, room, task)}"
            elif settles:
                yield f"{added}: relax its limit"


def _requirement_rows(metric: str, found: "pd.DataFrame") -> dict[str, float]:
    """A requirement's value by case; empty where there is no such metric."""
    rows = {str(case): row for case, row in found.to_dict().items() if metric in row}
    return {case: float(requirement_values({metric: row[metric]})[metric]) for case, row in rows.items()}


def _shown(requirement: Requirement, value: float, task: TuningTask) -> str:
    """A value with its unit, in percent where tables have percent."""
    unit = requirement.metric.shown_unit(task.loop.command.unit, task.loop.feedback.unit)
    return f"{requirement.metric.factor * user_value(requirement, value):.3g} {unit}".strip()


def _hunting(row: dict[str, float], task: TuningTask) -> str:
    """The limit cycle in words; empty where there is none."""
    if not row["LimitCycleAmplitude"] > 0:
        return ""
    unit = task.loop.feedback.unit
    return f": it hunts by +-{row['LimitCycleAmplitude']:.3g} {unit} at {row['LimitCycleFrequency']:.3g} Hz"


def _reject(
    task: TuningTask, result: TuningResult, found: "pd.DataFrame | None", breaks: tuple[str, ...]
) -> TuningResult:
    """The result of a design that the rig refutes: the given gains stand."""
    smooth = f"on the smooth model it is certified: {result.status.verdict}"
    remedies = () if found is None else tuple(_remedies(task, result, found))
    status = Status(Code.NOT_CERTIFIED, (*breaks, smooth, *remedies))
    return replace(result.refuse(status, task.space.parameters, task.space.names), on_rig=found)
