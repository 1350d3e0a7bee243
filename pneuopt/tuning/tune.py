"""`tune`: find PID gains and dither together, and certify them by a simulation that shares no step with the search.

A linear loop whose response shooting nodes follow closely is tuned by them (`TwoPhase`); any other, with friction, clip
or sampling, by compiled simulation (`Racing`). `certify` proves given gains likewise, `certify_on_rig` once more on the
event-accurate model of the rig. A new method is registered in `METHODS`; the first that suits is chosen.

`tune_without_dither`: the rival with which `judge_dither` compares a dithered design.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.dither import DITHER_AMPLITUDE
from pneuopt.control.loop import ClosedLoop, add_disturbances, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.dynamics.system import with_pade_order
from pneuopt.dynamics.tolerances import MAX_STEPS, SIMULATED_PADE_ORDER
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.dither import describe_swing
from pneuopt.evaluation.evaluate import evaluate, metric_limits, relevant_units
from pneuopt.evaluation.limit_cycle import NoHunting, RestKind, check_rest
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.plants import ExpectedPlants, expected_plants
from pneuopt.evaluation.requirements import (
    PeakControl,
    SettlingTime,
    metric_name,
    requirement_values,
    upper_limit,
    user_value,
)
from pneuopt.evaluation.response import cases, check_steps
from pneuopt.evaluation.rig import Rig
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.specification import Objective, Specification, specify, specify_limits
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple, check_parameters
from pneuopt.quantities.status import Code, Progress, ProgressCallback, ProgressReporter, Status
from pneuopt.quantities.units import write_value
from pneuopt.tuning.feasibility import check_feasibility
from pneuopt.tuning.method import Method, TuningTask
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.result import TuningResult, state_promise
from pneuopt.tuning.rival import DitherChoice, switch_off_dither, weigh_dither
from pneuopt.tuning.robust import harden
from pneuopt.tuning.search import UNTRIED, Certifier, Search, certified_objective, confirm_refusal, relax
from pneuopt.tuning.space import Space, clip_level, search_space, whole_space
from pneuopt.tuning.structure import StructureTrials, friction_rules, try_structures
from pneuopt.tuning.two_phase import TwoPhase
from pneuopt.tuning.validation import validate_design

if TYPE_CHECKING:
    import pandas as pd


__all__ = ["TuningResult", "certify", "prepare_search", "prepare_task", "tune"]
# Endings of a search whose limits perhaps no design keeps: `tune` then seeks how far they have to give way.
INFEASIBILITY_CODES = (Code.INFEASIBLE, Code.NOT_CONVERGED, Code.ITERATION_LIMIT)


def tune(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: Objective,
    subject_to: Sequence[Requirement | NoHunting] = (),
    scenarios: Scenarios = NO_SCENARIOS,
    accept: Defect | Sequence[Defect] = (),
    plants: ExpectedPlants | Scenarios | None = None,
    robust: bool = True,
    structure: bool = False,
    rig: Rig | None = None,
    max_steps: float = MAX_STEPS,
    method: Method | None = None,
    throw: bool = True,
    progress: Callable[[Progress], None] | None = None,
) -> TuningResult:
    """Find the free gains, and dither, with the least objective on the references within the limits.

    The design holds on plants like the model, too, where one is found that does: it is chosen on plants that are drawn
    for that, at a price in the objective that the status states, and its `validation` is on others.

    Parameters
    ----------
    loop : ClosedLoop
        The requirements are read on its true measured signal; the controller acts on what the loop's sensor shows.
    references : Reference or sequence of Reference
        Each from rest, or from steady motion, and with a label of its own; the worst counts.
    parameters : ParameterSet
        Of plant, controller and dither. The free ones ("pid.*", "dither.*", "feedforward.*", a compensator's) are tuned
        and need two finite bounds each.
    minimise : Requirement, mapping of Requirement to weight, or Specification
        A Specification, such as a tuning's file holds, brings its limits along: `subject_to` is then left out.
    subject_to : sequence of Requirement
        Each with its bound, `max` or `min`; with a `rig` also `NoHunting`.
    scenarios : mapping of str to mapping, optional
        Plants beside the nominal one, or tolerances of the gains: of `corners`, `samples`, `draws`, `tolerances`, or
        several of them joined with ``|``. The worst over references and scenarios counts.
    accept : Defect or sequence of Defect
        Defects with which a design is certified all the same; any other is refused, whatever is minimised.
    plants : ExpectedPlants or mapping, optional
        Plants that no search sees, on which the certified design is tried: the result's `validation` says on how many
        it holds. By default those of `expected_plants`, with usual tolerances; after a fit give
        ``expected_plants(parameters, fit.covariance, estimates=fit.estimates)``. ``{}``: none.
    robust : bool
        Seek a design that holds on plants like these, by `ExpectedPlants.vetting`, of which a plain mapping has none;
        otherwise the best one on the model is the answer.
    structure : bool
        Try other structures of the controller, a part more or no integral, as the plant admits them, and adopt the best
        that is certified and better; the result's `loop` is then the loop with it. They are also tried, and named in
        the status, where no design is certified, or one that hunts or creeps; `structures` has the figures. They take
        about as much CPU time as the tuning itself, at most.
    rig : Rig, optional
        The event-accurate model of the rig that the design is for, with its own friction, sensors and actuator: what
        breaks a limit there is not certified. The result's `on_rig` has its figures.
    max_steps : float
        Steps of one certificate's simulations together that are refused as too many; the search takes about as long.
    method : TwoPhase, Racing or another Method, optional
        By default the first that suits: `TwoPhase` for one linear plant with a continuous controller that no clip can
        hold back, if it has equations for all that is asked for and its nodes follow the response closely, for between
        them nothing holds it in the band; else, or where `TwoPhase` fails, `Racing`.
    throw : bool
        Raise an error if no design is certified; otherwise the result's status says so.
    progress : callable, optional
        Receives a `Progress`, a line of text with the time, a generation, start or program.

    Returns
    -------
    TuningResult

    Raises
    ------
    InputError
        If parameters, bounds and requirements do not fit together; the message names the one.
    ConvergenceError
        If the limits cannot be kept, the independent simulation does not confirm them, or Ctrl-C cuts the search
        short; the error's `solution` is the result, with the given gains unchanged: `claimed` and `certified` are
        those of the best point found, which is its `best`.

    Warns
    -----
    PhysicsWarning
        Before the search, if the given dither moves the measured signal out of the settling band.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import Overshoot, PeakControl, SettlingTime
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> limits = [Overshoot(0.05), PeakControl(4.0)]
    >>> best = tune(loop, Step(1.0), given, minimise=SettlingTime(), subject_to=limits)
    >>> best.status.converged, bool(best.certified.loc["PeakControl", "0 to 1"] <= 4.0)
    (True, True)
    """
    begun, cpu = time.perf_counter(), time.process_time()
    specification = specify(minimise, subject_to)
    task = prepare_task(loop, references, parameters, specification, scenarios, accept, max_steps)
    check_rig(rig, task)
    _warn_of_swing(task)
    search, choice, is_doubtful, stopped = _find(task, method, ProgressReporter(progress, "tune"))
    given, tried = {n: parameters.value(n) for n in parameters.free_names}, StructureTrials()
    if not stopped and (structure or is_doubtful):
        tried = try_structures(choice.search, choice.result, time.process_time() - cpu)
        stopped = tried.stopped
    adopted = tried.better[0] if structure and tried.better and not stopped else None
    if adopted is not None:
        search, choice, task = adopted.search, DitherChoice(adopted.search, adopted.result), adopted.search.task
        parameters |= adopted.change.parameters
    result = choice.result
    plants = expected_plants(task.space.parameters, scenarios=task.scenarios) if plants is None else plants
    if robust and not stopped and result.status.converged and isinstance(plants, ExpectedPlants) and plants.vetting:
        result, stopped = _harden(choice.search, result, plants.vetting)
    tuned = search.space.names
    spec = choice.search.spec
    found = {n: result.parameters.value(n) for n in tuned} if result.status.converged else {}
    result = replace(
        result,
        parameters=parameters.with_values(found),
        status=result.status.with_details(choice.words).with_remedies(_describe_untuned(task, tuned)),
        dither=choice.verdict,
        rival=choice.rival,
        given=given,
        limits=metric_limits(spec.limits),
    )
    result = tried.record(result, adopted, loop)
    result = _interrupt(task, result, stopped) if stopped else result
    result = _prove_further(replace(task, spec=spec), result, rig, plants, search.progress, begun)
    if throw and not result.status.converged:
        raise ConvergenceError(f"tuning {result.status.with_remedies('the given gains stand')}", result)
    return result


def certify(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: Objective | None = None,
    subject_to: Sequence[Requirement | NoHunting] = (),
    scenarios: Scenarios = NO_SCENARIOS,
    accept: Defect | Sequence[Defect] = (),
    plants: ExpectedPlants | Scenarios | None = None,
    rig: Rig | None = None,
    max_steps: float = MAX_STEPS,
    throw: bool = True,
    progress: Callable[[Progress], None] | None = None,
) -> TuningResult:
    """Certify gains as they stand, by what `tune` certifies its designs by, without any search.

    Parameters
    ----------
    loop, references, scenarios, accept, plants, rig, max_steps, progress
        As for `tune`.
    parameters : ParameterSet
        Of plant, controller and dither, with the gains to be certified. Whether any is free does not matter, but for
        the tolerance of free gains in `plants`.
    minimise : Requirement, mapping of Requirement to weight, or Specification, optional
        What a design was tuned for; here it only says which metrics must have a value.
    subject_to : sequence of Requirement
        The limits that are to be kept.
    throw : bool
        Raise an error if the gains are not certified; otherwise the result's status says so.

    Returns
    -------
    TuningResult
        With the given parameters; nothing is `claimed`.

    Raises
    ------
    InputError
        If loop, references, parameters and requirements do not fit together; the message names the one.
    ConvergenceError
        If a limit is broken or a defect is found; its message says which, and by how much; its `solution` is the
        result.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import FirstOrder
    >>> from pneuopt.evaluation.requirements import Overshoot
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    >>> gains = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 20.0})
    >>> certify(loop, Step(1.0), gains, subject_to=[Overshoot(0.05)]).status.converged
    True
    >>> certify(loop, Step(1.0), gains.with_values({"pid.Kp": 0.1}), subject_to=[Overshoot(0.05)], throw=False).status
    Status(code=<Code.NOT_CERTIFIED: ...
    """
    begun = time.perf_counter()
    if minimise is None or isinstance(minimise, Specification):
        spec = minimise or specify_limits(subject_to)
        require(minimise is None or not subject_to, "minimise is a Specification, which holds its limits")
    else:
        spec = specify(minimise, subject_to)
    task = _make_task(loop, references, parameters, spec, scenarios, accept, max_steps, whole_space)
    check_rig(rig, task)
    reporter = ProgressReporter(progress, "certify")
    reporter("simulating the loop independently")
    result = replace(Certifier(task).certify_given(), parameters=parameters, limits=metric_limits(spec.limits))
    plants = expected_plants(task.space.parameters, scenarios=task.scenarios) if plants is None else plants
    result = _prove_further(task, result, rig, plants, reporter, begun)
    if throw and not result.status.converged:
        raise ConvergenceError(f"the gains are {result.status}", result)
    return result


def _prove_further(
    task: TuningTask,
    result: TuningResult,
    rig: Rig | None,
    plants: ExpectedPlants | Scenarios,
    progress: ProgressCallback,
    begun: float,
) -> TuningResult:
    """The result with what the rig's model and other plants show of a certified design; other results as they are."""
    result = replace(result, units=relevant_units(task.loop))
    if result.status.converged and rig is not None:
        progress("certifying on the rig's model")
        try:
            result = certify_on_rig(task, result, rig)
        except KeyboardInterrupt:
            result = _interrupt(task, result, "the simulation of the rig was interrupted")
    if result.status.converged:
        count = len(plants.scenarios if isinstance(plants, ExpectedPlants) else plants)
        try:
            if count:
                progress(f"trying the design on {count} plants")
                given = task.loop, task.references, result.parameters
                found = validate_design(*given, minimise=task.spec, scenarios=plants, accept=task.accept)
                result = replace(result, validation=found)
            result = state_promise(result, task.spec, task.loop)
        except KeyboardInterrupt:
            result = _interrupt(task, result, "the trial on other plants was interrupted")
        except ConvergenceError as error:
            result = replace(result, status=result.status.with_details(f"not tried on other plants: {error}"))
    return replace(result, stats={**result.stats, "seconds": time.perf_counter() - begun})


def _weigh_dither(choice: DitherChoice, asked: Specification) -> tuple[DitherChoice, str]:
    """The choice between the design and its rival without dither, and in words by what the search was cut short."""
    try:
        return weigh_dither(choice.search, choice.result, asked), ""
    except KeyboardInterrupt:
        return choice, "the search without dither was interrupted"


def _harden(search: Search, result: TuningResult, plants: Scenarios) -> tuple[TuningResult, str]:
    """The design that holds on most of the plants, or the one given, and in words by what the search was cut short."""
    try:
        return harden(search, result, plants), ""
    except KeyboardInterrupt:
        return result, "the search for a design that also holds on other plants was interrupted"
    except (ConvergenceError, InputError):  # the loop rests on none of them: so the validation will say
        return result, ""


def _interrupt(task: TuningTask, result: TuningResult, reason: str) -> TuningResult:
    """The result of a certified design that Ctrl-C kept from its last trials; any other result as it is."""
    if not result.status.converged:
        return result
    lead = f"it keeps every limit on the model: {result.status.verdict}"
    sentences = (lead, f"{reason}: {UNTRIED}", *result.status.sentences[1:], "run again for an answer")
    return result.refuse(Status(Code.INTERRUPTED, sentences), task.space.parameters, task.space.names)


def _search(task: TuningTask, method: Method | None, progress: ProgressCallback) -> tuple[Search, TuningResult, bool]:
    """The search of a method, by default the first that suits, and where its answer is in doubt the better of two.

    The third says whether the second was interrupted while the first one's design stands.
    """
    search = _on_signal(prepare_search(task, method, progress))
    result = search.run()
    successor = search.method.successor
    found_once = result.agreement is not None and result.agreement.agreeing < 2  # perhaps the nearest of many optima
    doubtful = not result.status.converged or found_once
    if method is not None or successor is None or not doubtful or result.status.code is Code.INTERRUPTED:
        return search, result, False
    other = _on_signal(prepare_search(task, successor, progress))
    found = other.run()
    before, after = (certified_objective(task.spec, r) for r in (result, found))
    worse = not found.status.converged or after >= before
    if result.status.converged and worse:
        return search, result, found.status.code is Code.INTERRUPTED
    return other, found, False


def _warn_of_swing(task: TuningTask) -> None:
    """Warn the caller of `tune` where the given dither moves the measured signal out of the settling band."""
    settles = task.spec.concerns(SettlingTime)
    swing = describe_swing(task.loop, task.references, task.space.parameters, task.spec.band) if settles else None
    if swing is not None:
        warnings.warn(swing, PhysicsWarning, stacklevel=3)


def _find(
    task: TuningTask, method: Method | None, progress: ProgressCallback
) -> tuple[Search, DitherChoice, bool, str]:
    """The search, and the design that it finds, with its dither or without.

    The third says whether another structure may be needed, as no design is certified or friction rules it; the fourth
    by what it was cut short.
    """
    search, result, is_stopped = _search(task, method, progress)
    rules = friction_rules(result)
    result = relax(search, result) if search.spec.limits and result.status.code in INFEASIBILITY_CODES else result
    if result.status.code is Code.NOT_CERTIFIED:
        result, is_stopped = confirm_refusal(search, result)
    stopped, choice = "a second search was interrupted" if is_stopped else "", DitherChoice(search, result)
    if not stopped:
        try:
            choice = weigh_dither(search, result, task.spec)
        except KeyboardInterrupt:
            stopped = "the search without dither was interrupted"
    found = choice.result
    stopped = "the search was interrupted" if found.status.code is Code.INTERRUPTED else stopped
    return search, choice, rules or friction_rules(found) or not found.status.converged, stopped


def _describe_untuned(task: TuningTask, tuned: Sequence[str]) -> str:
    """Which free parameters the search has left as given, in words; empty where there are none."""
    untuned = [n for n in task.space.names if n not in tuned]
    return f"{', '.join(untuned)} left as given: without effect on a linear loop's average" if untuned else ""


def _on_signal(search: Search) -> Search:
    """The search, in which the signal with its ripple has to settle where the dither's amplitude is chosen."""
    if DITHER_AMPLITUDE not in search.space.names:
        return search
    return replace(search, task=replace(search.task, spec=search.spec.on_signal()))


def check_rig(rig: Rig | None, task: TuningTask) -> None:
    """Refuse a rig that is not one of this loop, and a limit that only a rig shows without one, by an `InputError`."""
    if rig is None:
        message = "NoHunting is read on the event-accurate model of the rig, which sticks; give rig=, or --rig rig.toml"
        require(task.spec.rest is None, message)
        return
    compares = task.spec.rest is not None and np.isfinite(task.spec.rest.repeatability)
    message = "NoHunting: repeatability is a range over references, and there is one; give more, from several starts"
    require(not compares or len(task.references) > 1, message)
    require(rig.loop is not None, "the rig has no controller; make it of the loop, Rig(ClosedLoop(...), sensors)")
    signals = [(own.feedback.name, own.command.name, own.pid) for own in (rig.loop, task.loop) if own is not None]
    message = f"the rig's loop controls {signals[0][:2]}, the loop to be tuned {signals[-1][:2]}, or with another PID"
    require(signals[0] == signals[-1], f"{message}; make the rig of the same loop, with Karnopp's friction")


def certify_on_rig(task: TuningTask, result: TuningResult, rig: Rig) -> TuningResult:
    """The certified result with what the rig shows of it on every reference; a limit that breaks there refutes it.

    Margins are those of the smooth loop, which a rig does not have.
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
    message = f"on the rig it comes to rest, watched for {wanted.duration:g} s"
    return replace(result, rest=rest, status=result.status.with_details(message))


def _breaks(task: TuningTask, found: "pd.DataFrame") -> Iterator[str]:
    """What breaks on the rig, a sentence each."""
    rows = found.to_dict()
    never = [str(case) for case, row in rows.items() if not np.isfinite(row["SettlingTime"])]
    if never:
        size, rate = (rows[never[0]][f"LimitCycle{n}"] for n in ("Amplitude", "Frequency"))
        hunts = f": it hunts by +-{size:.3g} {task.loop.feedback.unit} at {rate:.3g} Hz" if size > 0 else ""
        yield f"on the rig it never settles at {' and '.join(never)}{hunts}"
    for q in task.spec.limits:
        values = _requirement_rows(metric_name(q), found)
        worst = max(values, key=lambda case: values[case], default="")
        if worst and not (metric_name(q) == "SettlingTime" and never) and not values[worst] <= upper_limit(q):
            value, limit = (_shown(q, v, task) for v in (values[worst], upper_limit(q)))
            yield f"on the rig {metric_name(q)} is {value} at {worst}, the limit is {limit}"


def _requirement_rows(metric: str, found: "pd.DataFrame") -> dict[str, float]:
    """A requirement's value by case; empty where there is no such metric."""
    rows = {str(case): row for case, row in found.to_dict().items() if metric in row}
    return {case: float(requirement_values({metric: row[metric]})[metric]) for case, row in rows.items()}


def _shown(requirement: Requirement, value: float, task: TuningTask) -> str:
    """A value with its unit, in percent where tables have percent."""
    unit = requirement.metric.shown_unit(task.loop.command.unit, task.loop.feedback.unit)
    return f"{requirement.metric.factor * user_value(requirement, value):.3g} {unit}".strip()


def _reject(
    task: TuningTask, result: TuningResult, found: "pd.DataFrame | None", breaks: tuple[str, ...]
) -> TuningResult:
    """The result of a design that the rig refutes: the given gains stand.

    A relaxed limit is named only where the loop settles on the rig, for it mends nothing else.
    """
    smooth, remedies = f"on the smooth model it is certified: {result.status.verdict}", list[str]()
    if found is not None:
        settles = bool(np.isfinite(found.loc["SettlingTime"].to_numpy(dtype=float)).all())
        for q in task.spec.limits:  # the room that the rig needs if it adds as much again
            n, allowed = metric_name(q), upper_limit(q)
            ours, theirs = (max(_requirement_rows(n, f).values(), default=-np.inf) for f in (result.certified, found))
            added, room = theirs - ours, allowed - (theirs - ours)
            broken = np.isfinite(theirs) and theirs > allowed and q.metric.sense is Sense.AT_MOST
            if broken and (room > 0 or settles):
                remedy = f"tune with at most {_shown(q, room, task)}" if room > 0 else "relax its limit"
                remedies.append(f"the rig adds {_shown(q, added, task)} to {n}: {remedy}")
    status = Status(Code.NOT_CERTIFIED, (*breaks, smooth, *remedies))
    return replace(result.refuse(status, task.space.parameters, task.space.names), on_rig=found)


def prepare_task(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    spec: Specification,
    scenarios: Scenarios = NO_SCENARIOS,
    accept: Defect | Sequence[Defect] = (),
    max_steps: float = MAX_STEPS,
) -> TuningTask:
    """Check what is to be tuned, and that its limits can be kept at all; parameters and errors as for `tune`."""
    task = _make_task(loop, references, parameters, spec, scenarios, accept, max_steps, search_space)
    space = task.space
    every = cases(task.references, scenarios, space.parameters, space.names)
    check_feasibility(task.loop, every, space, task.spec)
    return task


def _make_task(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    spec: Specification,
    scenarios: Scenarios,
    accept: Defect | Sequence[Defect],
    max_steps: float,
    span: Callable[[ClosedLoop, ParameterSet], Space],
) -> TuningTask:
    """The checked task, its space as `span` makes it of the loop and its parameters."""
    check_closed_loop(loop)
    check_parameters(parameters)
    check_smooth(loop.plant)
    steps = as_references(references)
    loop = replace(loop, plant=with_pade_order(loop.plant, SIMULATED_PADE_ORDER))
    loop = add_disturbances(loop, steps)
    require(len(steps) > 0, "no reference to tune for; give a Step or a Move")
    check_steps(loop, steps, loop.complete(parameters), plants=1 + len(scenarios), max_steps=max_steps)
    space = span(loop, parameters)
    spec = spec.without(PeakControl) if clip_level(loop, space.parameters) <= spec.limit(PeakControl) else spec
    known = ", ".join(str(defect) for defect in Defect)
    accept = as_tuple("accept", accept, Defect, f"one of {known}, or several")
    return TuningTask(loop, steps, scenarios, space, spec, accept)


def prepare_search(task: TuningTask, method: Method | None = None, progress: ProgressCallback | None = None) -> Search:
    """The search of a method, by default the first that suits, over the free parameters that have an effect on it.

    An `InputError` where the method cannot tune the task, or nothing that is free has an effect.
    """
    if method is None:
        method = choose_method(task)
    else:
        method.check(task)
    names = tuple(n for n in task.space.names if n not in method.parameters_without_effect)
    free = ", ".join(task.space.names)
    require(len(names) > 0, f"{free}: without effect on a linear loop; free a gain as well")
    space = Space(task.space.parameters, names)
    return Search(replace(task, space=space), method, progress or (lambda _: None))


# By their key in a tuning's file; the first that suits a task is chosen: `Racing` suits every task.
METHODS: Mapping[str, type[TwoPhase] | type[Racing]] = MappingProxyType({"two_phase": TwoPhase, "racing": Racing})


def choose_method(task: TuningTask) -> Method:
    """Choose the first method in `METHODS` that suits a task."""
    return next(method for method in (kind() for kind in METHODS.values()) if method.suits(task))


def tune_without_dither(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    minimise: Objective,
    **options: Any,
) -> TuningResult:
    """Tune the same loop with the dither's amplitude fixed at 0: the rival of a dithered design in `judge_dither`.

    It is a whole search, and takes about as long as that for the design with dither; a warm start at the dithered
    gains alone would favour the dither.

    Parameters
    ----------
    loop : ClosedLoop
    references : Reference or sequence of Reference
    parameters : ParameterSet
        As given to `tune` for the design with dither; the dither's offset stays free if it is.
    minimise : Requirement, mapping of Requirement to weight, or Specification
    **options
        Those of `tune`: `subject_to`, `scenarios`, `method`, `throw` and so on. `plants` are by default none.

    Raises
    ------
    InputError
        If the loop has no dither, or no gain beside the dither's amplitude and frequency is free.
    ConvergenceError
        As `tune`: if no gains without dither keep the limits, for example.

    Examples
    --------
    >>> from pneuopt.control.dither import Dither
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.evaluation.requirements import SettlingTime
    >>> from pneuopt.models.linear import FirstOrder
    >>> loop = ClosedLoop(FirstOrder().system(), PID(limits=False), Dither(50.0))
    >>> given = loop.parameters.with_values({"dither.amplitude": 0.1})
    >>> given = given.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    >>> rival = tune_without_dither(loop, Step(1.0), given, minimise=SettlingTime())
    >>> rival.parameters.value("dither.amplitude")
    0.0
    """
    check_closed_loop(loop)
    check_parameters(parameters)
    require(loop.dither is not None, "this loop has no dither to leave out: tune it with `tune`")
    plain = switch_off_dither(loop.complete(parameters))
    return tune(loop, references, plain, minimise=minimise, **{"plants": {}, **options})
