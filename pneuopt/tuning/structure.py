"""`try_structures`: what another part of the controller would bring where limits are missed, or friction rules.

A row of `STRUCTURES` is a part that the plant may admit, its bounds off the plant and the best design's response: a
feedback takes back at most that response's largest command at the largest value of its signal. Each row is a short
search from the best point so far and is certified before it is named; one is begun only while the CPU time that the
tuning took leaves room for the dearest so far.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.compensators import (
    COMPENSATORS,
    PRESSURES,
    AccelerationFeedback,
    DeadZoneInverse,
    FrictionFeedforward,
    Kind,
    PressureFeedback,
)
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.evaluate import respond
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value
from pneuopt.tuning.result import TuningResult, describe_objective
from pneuopt.tuning.search import Search, certified_objective, end_point
from pneuopt.tuning.space import Space
from pneuopt.tuning.tolerances import EXCHANGE_SHARE, SAME_OBJECTIVE

if TYPE_CHECKING:
    import pandas as pd

FRICTION_DEFECTS = (Defect.HUNTS, Defect.CREEPS)


def friction_rules(result: TuningResult) -> bool:
    """Whether a design's certificate finds that it hunts or creeps, be it accepted."""
    return result.certificate is not None and any(f.defect in FRICTION_DEFECTS for f in result.certificate.findings)


@dataclass(frozen=True, eq=False)
class Ground:
    """The best design so far, of which another structure begins, and how its loop responds."""

    search: Search
    parameters: ParameterSet

    @property
    def loop(self) -> ClosedLoop:
        """The loop without the part."""
        return self.search.task.loop

    @cached_property
    def responses(self) -> tuple[Trajectory, ...]:
        """To each reference, on the nominal plant; what they run into refused the design already."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PhysicsWarning)
            return tuple(respond(self.loop, r, self.parameters) for r in self.search.task.references)

    @property
    def is_position(self) -> bool:
        """Whether the loop is judged by a position, which rests without a command."""
        on = self.loop.controller.sensed_signal
        return on.order == 0 or on.cascade

    @property
    def integral(self) -> str:
        """The parameter of the integral; empty where the loop has none."""
        n = "pid.Ki" if "Ki" in self.loop.pid.form.gains else "pid.Ti"
        p = self.parameters[n]
        return n if n in self.search.space.names or p.value != (0.0 if n == "pid.Ki" else inf) else ""

    def lacks(self, kind: Kind) -> bool:
        """Whether the loop has no such part, or one that adds nothing."""
        size = f"{kind.section}.{kind.size}"
        return size not in self.parameters or (size not in self.search.space.names and not self.parameters.value(size))

    @property
    def largest_command(self) -> float:
        """Of all responses."""
        return max(float(np.abs(run["control"]).max()) for run in self.responses)

    def feedback_gain(self, signal: Callable[[Trajectory], Array]) -> float:
        """The gain that takes back the responses' largest command at the largest value of a signal."""
        most = max(float(np.abs(signal(run)).max()) for run in self.responses)
        require(0 < most < inf, "the response has nothing that it could feed back")
        return self.largest_command / most

    def with_part(self, kind: Kind, bounds: Mapping[str, tuple[float, float]], **values: float) -> "Change":
        """The loop with a part more, its parameters within `bounds` free."""
        for n, (low, up) in bounds.items():
            require(low < up < inf, f"the design found leaves no room for {kind.section}.{n}")
        own = kind().parameters(self.loop.controller.sensed_signal, self.loop.command.unit)
        added = own.with_bounds(bounds).with_values(values).freed(*bounds).with_prefix(kind.section)
        parts = (*(part for part in self.loop.compensators if part.section != kind.section), kind())
        order = list(COMPENSATORS)
        parts = tuple(sorted(parts, key=lambda part: order.index(part.section)))
        return Change(replace(self.loop, compensators=parts), added)


@dataclass(frozen=True, eq=False)
class Change:
    """The loop with another structure, and the parameters that this brings or settles."""

    loop: ClosedLoop
    parameters: ParameterSet

    def on(self, loop: ClosedLoop) -> ClosedLoop:
        """The same change of a loop that was given, whose plant a search has made ready for itself."""
        return replace(loop, pid=self.loop.pid, compensators=self.loop.compensators)


@dataclass(frozen=True)
class Structure:
    """A part to be tried: its name in words, the parameter whose value belongs to it, when it suits, how it is made."""

    name: str
    size: str
    suits: Callable[[Ground], bool]
    make: Callable[[Ground], Change]


def _dead_zone(ground: Ground) -> float:
    """Half the dead zone of the final element, as a command; 0 where it has none."""
    axis, p = ground.loop.plant.axis, ground.parameters
    element = None if axis is None else axis.final_element
    known = element is not None and element.dead_zone in p and element.limit in p
    return max(0.0, p.value(element.dead_zone) * p.value(element.limit)) if element and known else 0.0


def _invert_dead_zone(ground: Ground) -> Change:
    """With the plant's own width: were it tuned, each candidate would wait for its step in a rest of its own."""
    return ground.with_part(DeadZoneInverse, {}, width=_dead_zone(ground))


def _meets_friction(ground: Ground) -> bool:
    """Whether the reference tells a direction of motion: a step of a position has none."""
    moves = not ground.is_position or any(not isinstance(r, Step) for r in ground.search.task.references)
    on = ground.loop.controller.sensed_signal
    return ground.loop.plant.axis is not None and on.order is not None and moves and ground.lacks(FrictionFeedforward)


def _feed_friction(ground: Ground) -> Change:
    """No friction takes more than what holds the slowest speed asked for, or at most drives a move."""
    held = min(abs(float(run["control"][-1])) for run in ground.responses)
    most = ground.largest_command if ground.is_position else held
    return ground.with_part(FrictionFeedforward, {"level": (0.0, most)})


def _swings(ground: Ground) -> bool:
    """Whether a spring, its air say, lies between the command and the body."""
    axis, on = ground.loop.plant.axis, ground.loop.controller.sensed_signal
    return axis is not None and axis.final_element is not None and on.order is not None


def _feed_pressure(ground: Ground) -> Change:
    def swing(run: Trajectory) -> Array:
        d = run[PRESSURES[0]] - run[PRESSURES[1]]
        return np.asarray(d - d[0])

    return ground.with_part(PressureFeedback, {"gain": (0.0, ground.feedback_gain(swing))})


def _feed_acceleration(ground: Ground) -> Change:
    axis = ground.loop.plant.axis
    assert axis is not None

    def acceleration(run: Trajectory) -> Array:
        return np.asarray(np.gradient(run[axis.speed], run.t))

    return ground.with_part(AccelerationFeedback, {"gain": (0.0, ground.feedback_gain(acceleration))})


def _drop_integral(ground: Ground) -> Change:
    n = ground.integral
    p, off = ground.parameters[n], 0.0 if n == "pid.Ki" else inf
    none = replace(p, value=off, lower=min(p.lower, off), upper=max(p.upper, off), log=False, free=False)
    return Change(ground.loop, ParameterSet({n: none}))


def _reset_integral(ground: Ground) -> Change:
    """Of the integral any part may be kept; a count of the sensor is no change of the error's sign."""
    loop = replace(ground.loop, pid=replace(ground.loop.pid, reset=True))
    count = loop.controller.sensor_resolution(loop.complete(ground.parameters))
    own = loop.parameters.select(("pid.reset_ratio", "pid.reset_band"))
    return Change(loop, own.with_values({"pid.reset_band": count}).freed("pid.reset_ratio"))


STRUCTURES = (
    Structure(
        "dead-zone inverse",
        "dead_zone_inverse.width",
        lambda ground: _dead_zone(ground) > 0 and ground.lacks(DeadZoneInverse),
        _invert_dead_zone,
    ),
    Structure("friction feedforward", "friction_feedforward.level", _meets_friction, _feed_friction),
    Structure("no integral", "", lambda ground: ground.is_position and bool(ground.integral), _drop_integral),
    Structure(
        "reset integral",
        "pid.reset_ratio",
        lambda ground: (
            ground.is_position
            and bool(ground.integral)
            and ground.loop.pid.sample_time is not None
            and not ground.loop.pid.reset
        ),
        _reset_integral,
    ),
    Structure(
        "pressure feedback",
        "pressure_feedback.gain",
        lambda ground: (
            _swings(ground)
            and all(n in ground.loop.controller.sensed_signal.outputs for n in PRESSURES)
            and ground.lacks(PressureFeedback)
        ),
        _feed_pressure,
    ),
    Structure(
        "acceleration feedback",
        "acceleration_feedback.gain",
        lambda ground: _swings(ground) and ground.lacks(AccelerationFeedback),
        _feed_acceleration,
    ),
)


@dataclass(frozen=True, eq=False)
class CertifiedStructure:
    """A structure with its certified design, the search that found it, and its objective."""

    structure: Structure
    change: Change
    search: Search
    result: TuningResult
    objective: float

    @property
    def gains(self) -> dict[str, float]:
        """What was tuned."""
        return {n: self.result.parameters.value(n) for n in self.search.space.names}

    @property
    def name(self) -> str:
        """Its name in words, with the size of the part."""
        if not self.structure.size:
            return self.structure.name
        p = self.result.parameters[self.structure.size]
        return f"{self.structure.name} of {write_value(p.value, p.unit, 3)}"

    @property
    def words(self) -> str:
        """Its name, and what is reached with it."""
        reached = describe_objective(self.result, self.search.spec, self.search.task.loop)
        return f"{self.name}: {', '.join(reached) or 'keeps all limits'}"


@dataclass(frozen=True, eq=False)
class StructureTrials:
    """What was tried: the better designs, the best first, how each trial ended, and the table of all of them."""

    better: Sequence[CertifiedStructure] = ()
    endings: Mapping[str, str] = field(default_factory=dict)  # of those that bring nothing, by name
    table: "pd.DataFrame | None" = None
    stopped: str = ""  # by what they were cut short

    def record(self, result: TuningResult, adopted: CertifiedStructure | None, loop: ClosedLoop) -> TuningResult:
        """A tuning's result with what was tried; of the adopted one, if any, with its part in the given loop."""
        result = replace(result, structures=self.table, status=result.status.with_remedies(*self.sentences(adopted)))
        if adopted is None:
            return result
        return replace(result, structure=tuple(adopted.change.parameters), loop=adopted.change.on(loop))

    def sentences(self, adopted: CertifiedStructure | None) -> Iterator[str]:
        """What each would bring, the best first, then those that bring nothing; of the adopted one that it stands."""
        for found in self.better:
            yield f"{found.words} (certified{', adopted' if found is adopted else ''})"
        if self.better and adopted is None:
            yield "tune(structure=True), pneuopt tune --structure, adopts the first of these"
        for ending in dict.fromkeys(self.endings.values()):
            yield f"{', '.join(n for n, e in self.endings.items() if e == ending)}: {ending}"


def try_structures(search: Search, result: TuningResult, budget: float) -> StructureTrials:
    """Try what the plant admits, within a budget of CPU time [s].

    `search` is the one that found the design, or the best candidate, of `result`. Ctrl-C ends it with what was tried.
    """
    import pandas as pd

    before = certified_objective(search.spec, result) if result.status.converged else inf
    ground = Ground(search, search.space.parameters_at(end_point(result, search.space)))
    suiting, begun, dearest, stopped = [s for s in STRUCTURES if s.suits(ground)], time.process_time(), 0.0, ""
    better, endings, rows = list[CertifiedStructure](), dict[str, str](), list[dict[str, Any]]()
    for k, structure in enumerate(suiting, 1):
        spent = time.process_time() - begun
        if spent + dearest > budget:
            endings[structure.name] = "not tried, which would take longer than the tuning itself"
            continue
        try:
            search.progress(f"trying another structure: {structure.name} ({k} of {len(suiting)})")
            found, ending = _try_structure(ground, structure, before)
        except KeyboardInterrupt:
            stopped = "the trial of other structures was interrupted"
            break
        seconds, own = time.process_time() - begun - spent, {} if found is None else found.gains
        dearest, objective = max(dearest, seconds), nan if found is None else found.objective
        row = {"structure": structure.name, "status": ending or "certified", "objective": objective, "seconds": seconds}
        rows.append(row | own)
        if found is not None and not ending:
            better.append(found)
        else:
            endings[structure.name] = ending
    table = pd.DataFrame(rows).set_index("structure") if rows else None
    return StructureTrials(sorted(better, key=lambda found: found.objective), endings, table, stopped)


def _try_structure(ground: Ground, structure: Structure, before: float) -> tuple[CertifiedStructure | None, str]:
    """A short search with the structure from the design without it, given up where it lags behind that.

    What does not come to rest is no cure; the second attempt shows it what comes after the horizon.

    The certified design, if any, and, unless it is better than `before`, how the trial ended.
    """
    search, task = ground.search, ground.search.task
    try:
        change = structure.make(ground)
        parameters = change.loop.complete(ground.parameters) | change.parameters
        kept = (n for n in search.space.names if n not in change.parameters)
        space = Space(parameters, (*kept, *change.parameters.free_names))
        method = search.method.successor or search.method  # the first may know linear loops only
        task = replace(task, loop=change.loop, space=space, to_beat=before)
        short = Search(task, method.shorten(method.margin, EXCHANGE_SHARE), search.progress, rests=True, attempts=2)
        result = short.run(space.start)
    except (ConvergenceError, InputError) as error:
        return None, f"cannot be tried: {error}"
    if result.status.code is Code.INTERRUPTED:
        raise KeyboardInterrupt
    if not result.status.converged:
        found = "no design found keeps the limits" if task.spec.limits else "no design found is certified"
        return None, f"{found} either" if before == inf else found
    objective = certified_objective(task.spec, result)
    is_better = before == inf or objective < before * (1 - SAME_OBJECTIVE)
    found_structure = CertifiedStructure(structure, change, short, result, objective)
    return found_structure, "" if is_better else "certified, but no better"
