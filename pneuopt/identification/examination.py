"""`examine_logs`: what the log doctor finds in logs of a plant; `check_content` refuses logs for it.

Below: `pose_problem` of logs that pass, what plant and parameters say of the axis (`axis_from_model`), exchanged
columns (`find_exchange`), and `mend_findings`, which mends a fault where a rule is certain and the fault is gone then.
A newcomer adds a rule: ``rule(mended, finding, ambient) -> MendedLog | None`` and its row in `RULES`.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.runnable import Fittable, HasSystem
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.identification.problem import (
    EstimationProblem,
    as_estimation_model,
    as_experiments,
    check_free,
    check_logs,
    find_centre,
)
from pneuopt.identification.tolerances import CHANGE, MIN_FORCE_SHARE, MIN_STOP_FORCE, STOP_DEPTH
from pneuopt.logs.doctor import PISTON, LogFinding, StatedAxis, examine
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.mending import MendedLog, convert, empty_cells, leave_out
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.shooting.least_squares import LeastSquares

QUIET_CHECKS = ("sampling", "dwells")
"""Checks whose notes are no doubts of the log: they would stand in the status of every fit."""


def examine_logs(
    system: HasSystem | ClosedLoop, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> tuple[LogFinding, ...]:
    """Find what is wrong with logs before any fit, as `identify` does, in seconds.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        As of `identify`.
    experiments : Experiment or sequence of Experiment
        The logs, as read.
    parameters : ParameterSet
        Masses and forces that are not free are stated, and a log may contradict them.

    Returns
    -------
    tuple of LogFinding
        Of each log, faults first. `plotting.plot_finding` draws the signals that show one.

    Raises
    ------
    InputError
        If logs, system and parameters do not fit together.
    """
    model = as_estimation_model(system)
    return tuple(_find(model, check_logs(model, as_experiments(experiments), parameters), parameters))


def pose_problem(
    system: HasSystem | ClosedLoop,
    experiments: Experiment | Iterable[Experiment],
    parameters: ParameterSet,
    method: LeastSquares,
) -> EstimationProblem:
    """The estimation problem of logs that `identify` accepts, before any width is chosen."""
    model = as_estimation_model(system)
    logs = check_logs(model, experiments, parameters)
    parameters = find_centre(model, logs, parameters)
    check_free(logs, parameters)
    check_content(model, logs, parameters)
    return EstimationProblem(model, tuple(logs), model.parameters | parameters, method)


def check_content(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Refuse logs of which more than half show the same fault; return a sentence on each accepted fault and each doubt.

    A window of a good log may well stand still.
    """
    found, said = list(_find(system, experiments, parameters)), dict[str, str]()
    for finding in found:
        if not finding.fault and finding.check not in QUIET_CHECKS:
            said.setdefault(finding.channel, f"{finding.log}: {finding.message}")
        elif is_accepted(finding, experiments):
            said.setdefault(finding.channel, f"{finding.log}: accepted as right: {finding.message}")
    for finding in found:
        if is_refused(finding, found, experiments):
            raise LogError(f"{finding.log}: {finding.message}; {accept_remedy(finding)}", finding)
    return tuple(said.values())


def is_accepted(finding: LogFinding, experiments: Sequence[Experiment]) -> bool:
    """Whether a fault's log is right by what its user says."""
    return finding.fault and any(finding.check in e.accept for e in experiments if e.name == finding.log)


def is_refused(finding: LogFinding, found: Iterable[LogFinding], experiments: Sequence[Experiment]) -> bool:
    """Whether a fit refuses the logs for a fault: it is not accepted, and more than half of the logs show it."""
    alike = {f.log for f in found if f.fault and f.channel == finding.channel and not is_accepted(f, experiments)}
    return finding.fault and finding.log in alike and 2 * len(alike) > len(experiments)


def accept_remedy(finding: LogFinding) -> str:
    """How a user says that a log is right all the same."""
    return f"if the log is right, accept = [{finding.check!r}] in its sidecar, or --accept {finding.check}"


def _find(system: Fittable, experiments: Iterable[Experiment], parameters: ParameterSet) -> Iterator[LogFinding]:
    for experiment in experiments:
        yield from examine(experiment, axis_from_model(system.plant, experiment, parameters))


def axis_from_model(plant: System, experiment: Experiment, parameters: ParameterSet) -> StatedAxis:
    """The channels of the plant's axis and the forces on it that are not free; a piston's by default."""
    if plant.axis is None:
        return PISTON._replace(forces={})
    known = plant.parameters | parameters.select(n for n in parameters if n in plant.parameters)
    conditions = {n: value for n, value in experiment.conditions.items() if n in known}
    known = known.with_values(conditions).fixed(*conditions)
    body, axis = _Body(plant, plant.axis, known), plant.axis
    pushes = [q.name for q in plant.inputs if q.unit == axis.force]
    weights, constant = body.forces(body.vector)
    for name in known.free_names:
        others, moved = body.forces(body.with_change(name))
        weights = weights if _agree(others, weights) else {}
        constant = constant if _agree({"": moved}, {"": constant}) else math.nan
    if any(abs(body.asymmetry(p)) > 1e-6 for p in (body.vector, *map(body.with_change, known.free_names))):
        constant = math.nan
    if any(n.startswith("sensor.") and n.endswith(".offset") for n in known):
        constant = math.nan
    return StatedAxis(
        axis.position,
        axis.speed,
        pushes[0] if pushes else PISTON.push,
        forces=weights,
        constant=constant,
        inertia=math.nan if known[axis.inertia].free else known.value(axis.inertia),
        inertia_name=axis.inertia,
        inertia_unit=known[axis.inertia].unit,
        force_unit=axis.force,
        offset_parameter=body.offset_parameter(),
        stops=body.stops(),
    )


def _agree(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return a.keys() == b.keys() and all(math.isclose(a[n], b[n], rel_tol=1e-6, abs_tol=1e-9) for n in a)


class _Body:
    """The body of a plant at rest: which signals push it, and how strongly."""

    def __init__(self, plant: System, axis: Axis, known: ParameterSet) -> None:
        self.plant, self.axis, self.known = plant, axis, known
        self.vector = parameter_vector(plant.parameters, known)
        ends = [limit.limit(known) for limit in plant.validity_limits if limit.state == axis.position]
        self.ends = tuple(ends) if len(ends) == 2 else ()
        middle = {axis.position: sum(self.ends) / 2, axis.speed: 0.0}
        self.x = np.array([middle.get(s.name, s.nominal if s.unit.startswith("Pa") else 0.0) for s in plant.states])

    def force(self, vector: Array, signals: Mapping[str, float]) -> float:
        """The force on the body without friction at values of signals [SI], others at their base."""
        x = [signals.get(n, base) for n, base in zip(names(self.plant.states), self.x, strict=True)]
        u = [signals.get(n, 0.0) for n in names(self.plant.inputs)]
        rate = np.array(self.plant.ode(0, x, u, vector)[0]).ravel()[names(self.plant.states).index(self.axis.speed)]
        return float(rate * vector[list(self.plant.parameters).index(self.axis.inertia)])

    def forces(self, vector: Array) -> tuple[dict[str, float], float]:
        """The force on the body per unit of each signal that pushes it, and what is left without them."""
        states = dict(zip(names(self.plant.states), self.x, strict=True))
        base = {**states, **dict.fromkeys(names(self.plant.inputs), 0.0)}
        at_base, weights = self.force(vector, {}), dict[str, float]()
        for q in (*self.plant.states, *self.plant.inputs):
            if q.name == self.axis.speed or q.name.startswith("friction."):
                continue
            weight = (self.force(vector, {q.name: base[q.name] + CHANGE * q.nominal}) - at_base) / (CHANGE * q.nominal)
            weights[q.name] = weight
        sizes = {q.name: abs(weights.get(q.name, 0.0)) * q.nominal for q in (*self.plant.states, *self.plant.inputs)}
        pushes = {n: weight for n, weight in weights.items() if sizes[n] > MIN_FORCE_SHARE * max(sizes.values())}
        return pushes, float(at_base - sum(weight * base[n] for n, weight in pushes.items()))

    def asymmetry(self, vector: Array) -> float:
        """What friction takes more at the nominal speed one way than the other."""
        fast = next(s.nominal for s in self.plant.states if s.name == self.axis.speed)
        ways = [self.force(vector, {self.axis.speed: speed}) for speed in (fast, -fast)]
        return sum(ways) - 2 * self.force(vector, {})

    def with_change(self, name: str) -> Array:
        """The vector with one parameter changed a little."""
        vector, k = self.vector.copy(), list(self.plant.parameters).index(name)
        vector[k] += CHANGE * (abs(vector[k]) or 1.0)
        return vector

    def offset_parameter(self) -> str:
        """The first parameter that is a constant force on the body."""
        weights, constant = self.forces(self.vector)
        for name in (n for n, p in self.known.items() if p.unit == self.axis.force):
            others, moved = self.forces(self.with_change(name))
            if _agree(others, weights) and not _agree({"": moved}, {"": constant}):
                return name
        return ""

    def stops(self) -> tuple[float, ...]:
        """Both ends of the position at which the model's stops push back; none where it has none."""
        free = self.force(self.vector, {})
        found = []
        for end, other in zip(self.ends, self.ends[::-1], strict=True):
            depth = math.copysign(STOP_DEPTH, end - other)
            found.append(abs(self.force(self.vector, {self.axis.position: end + depth}) - free) > MIN_STOP_FORCE)
        return self.ends if found and all(found) else ()


def find_exchange(model: Fittable, log: Experiment, parameters: ParameterSet) -> tuple[str, str] | None:
    """Two channels with which exchanged the log doctor finds no fault; None where there is no such pair, or several."""
    pairs = [pair for pair in combinations(log.trajectory, 2) if _is_right(model, exchange(log, *pair), parameters)]
    return pairs[0] if len(pairs) == 1 else None


def exchange(log: Experiment, a: str, b: str) -> Experiment:
    """The log with two columns exchanged; each is converted as the channel's own was. Noise levels of both are lost."""
    values, columns = {a: log.trajectory[b], b: log.trajectory[a]}, log.source.columns if log.source else {}
    if a in columns and b in columns:
        for name, other in ((a, b), (b, a)):
            raw = (log.trajectory[other] - columns[other].offset) / columns[other].factor
            values[name] = columns[name].factor * raw + columns[name].offset
    noise = {n: sigma for n, sigma in log.noise.items() if n not in (a, b)}
    return replace(log, trajectory=log.trajectory.with_columns(values), noise=noise, holes=())


def _is_right(model: Fittable, log: Experiment, parameters: ParameterSet) -> bool:
    try:
        (full,) = check_logs(model, log, parameters)
    except InputError:
        return False
    return not any(f.fault for f in examine(full, axis_from_model(model.plant, full, parameters)))


Rule = Callable[[MendedLog, LogFinding, float], MendedLog | None]


def mend_findings(model: Fittable, mended: MendedLog, parameters: ParameterSet, ambient: float) -> MendedLog:
    """Mend the faults of a log for which there is a rule; a rule after which the fault is still found is taken back.

    Gauge pressures count from `ambient` [Pa]. Where motion and force are both wrong nobody can tell what is right:
    `LogError`.
    """
    several = len({f.channel for f in _find_faults(model, mended.log, parameters)}) > 1
    pair = find_exchange(model, mended.log, parameters) if several else None
    if pair is not None:
        why = f"columns of {pair[0]} and {pair[1]} exchanged, for with them so nothing is wrong"
        return MendedLog(exchange(mended.log, *pair), mended.rows, (*mended.changes, why))
    tried, used = set[tuple[str, str]](), set[str]()
    while True:
        found = [f for f in _find_faults(model, mended.log, parameters) if _key(f) not in tried and f.check in RULES]
        if not found:
            break
        tried.add(_key(found[0]))
        changed = RULES[found[0].check](mended, found[0], ambient)
        if changed and _key(found[0]) not in {_key(f) for f in _find_faults(model, changed.log, parameters)}:
            mended = changed
            used.add(found[0].check)
    both = "the signs or sizes of two channels are wrong at once: is a column another channel? say in [columns] which"
    require(not used >= {"work", "scale"}, f"{mended.log.name}: {both}", LogError)
    return mended


def _key(finding: LogFinding) -> tuple[str, str]:
    return finding.check, finding.channel


def _find_faults(model: Fittable, log: Experiment, parameters: ParameterSet) -> list[LogFinding]:
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
