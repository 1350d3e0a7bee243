"""`EstimationProblem`: logs, conditions and parameters, as a multiple-shooting `Transcription`.

Below it the checks that logs, system and parameters fit together, each with its remedy; the repair of holes in a log's
inputs (a short one is bridged, at a long one the log is cut); and `find_centre`, for a valve whose command was logged
from 0 to 10 V: read as a command about 0 V it would show a valve that is fully open while the drive rests.
"""

import itertools
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import check_during_runs
from pneuopt.dynamics.hooks import FinalElement, Log, Start
from pneuopt.dynamics.runnable import Fittable, HasSystem, as_runnable, centre_name
from pneuopt.dynamics.system import DiscreteSystem, System, add_slopes, append_slopes, names
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tolerances import (
    MAX_BRIDGE,
    MAX_NOISE_FACTOR,
    MAX_REST_DISTANCE,
    MIN_RUN,
    MOVING_SPEED_SHARE,
    RANGE_TOLERANCE,
    STATIC_SEGMENTS,
)
from pneuopt.logs.doctor import CHECKS
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import estimate_noise, find_refresh, noise_level
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import InputError, LogError, ModelError, PhysicsWarning, check_names, require
from pneuopt.quantities.parameters import (
    Intersample,
    Parameter,
    ParameterSet,
    as_tuple,
    check_parameters,
    usual_intersample,
)
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.filters import filter_nodes
from pneuopt.shooting.least_squares import BudgetSpentError, Fit, LeastSquares
from pneuopt.shooting.segments import choose_integration, segment, start_nodes
from pneuopt.shooting.tolerances import GATHERED_DEVIATION
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """An estimation problem: a system, logs and parameters; its transcription, and starts from its fits."""

    system: Fittable
    experiments: tuple[Experiment, ...]
    parameters: ParameterSet
    method: LeastSquares
    # by log, the weight of each sample's squared residual; 1 for logs that are absent
    weights: Mapping[str, Array] = field(default_factory=dict)
    # values of free parameters that stay fixed, for the logs cannot identify them
    fixed: Mapping[str, float] = field(default_factory=dict)
    # whether the logs state the noise of all outputs; otherwise it is estimated from them
    noise_is_stated: bool = False
    # time after which a log starts anew with a state of its own [s]; math.inf where it never does
    window: float = math.inf
    is_whole: bool = False  # whether logs stay whole also where the model does not follow them
    unseen: frozenset[str] = frozenset()  # of those that stay fixed, the ones that act only together with others
    # the starts that were made so far, with what they are of: trials of one problem share them
    _made: list[tuple[tuple[object, ...], Sequence[Start]]] = field(default_factory=list, repr=False, compare=False)

    @property
    def has_gaps(self) -> bool:
        """Whether some segment continues another; not so in windows of one segment each."""
        return self.method.segment_time < self.window

    @property
    def candidates(self) -> Sequence[Start]:
        """The model's own starts from all logs together; of a model that has none, its states filtered along them."""
        source = (self.system, self.parameters, *self.experiments)
        for others, starts in self._made:
            if len(others) == len(source) and all(a is b for a, b in zip(others, source, strict=True)):
                return starts
        known = {
            e.name: (apply_conditions(self.parameters, e), input_behaviour(self.system, e)) for e in self.experiments
        }
        starts = self.system.starts({e.name: Log(e.trajectory, *known[e.name]) for e in self.experiments})
        if isinstance(self.system, System) and self.system.start_hook is None and self.system.states:
            starts = [self.filter_states(start) for start in starts]
        self._made.append((source, starts))
        return starts

    def start_from(self, fit: Fit | IdentificationResult, label: str = "fit") -> Start:
        """The start from a fit of these logs, by the parameters that both have.

        Parameters without an estimate begin at their given values.
        """
        if isinstance(fit, IdentificationResult):
            runs = tuple(fit.trajectories.values())
            found = {str(n): float(v) for n, v in fit.estimates["value"].items()}
        else:
            runs, found = fit.trajectories, {n: fit.parameters.value(n) for n in fit.parameters.free_names}
        given = self.unknowns()
        values = {n: v if math.isfinite(v) else given.value(n) for n, v in found.items() if n in given}
        return Start(dict(zip((e.name for e in self.experiments), runs, strict=True)), values, label)

    def filter_states(self, start: Start, gathered: float = GATHERED_DEVIATION) -> Start:
        """The start with states along the logs that fit its parameters (`shooting.filters`)."""
        segments = segment(self.transcription(start))
        q = np.array([p.value for p in segments.transcription.parameters.values()])
        try:
            with check_during_runs(self.method.budget.check):
                nodes = filter_nodes(segments, start_nodes(segments), q, gathered)
                segments, substeps = choose_integration(segments, nodes, q)
                run = segments.run(nodes, q, substeps, states=True)
        except BudgetSpentError:
            return start
        names = (e.name for e in self.experiments)
        return replace(start, states=dict(zip(names, segments.trajectories(run), strict=True)))

    def unknowns(self) -> ParameterSet:
        """The problem's parameters: the system's, each log's conditions, each log's own copies."""
        own: dict[str, Parameter] = {}
        shared = dict(self.parameters)
        for experiment in self.experiments:
            for name, value in experiment.conditions.items():
                own[f"{name}[{experiment.name}]"] = Parameter(value, shared[name].unit, source="condition of the log")
        for name in self.parameters.free_names:
            if self.parameters[name].per_log:
                shared[name] = replace(self.parameters[name], free=False)
                unknown = (e.name for e in self.experiments if name not in e.conditions)
                own |= {f"{name}[{log}]": self.parameters[name] for log in unknown}
        return ParameterSet({**shared, **own})

    def transcription(self, candidate: Start) -> Transcription:
        """The problem as multiple shooting, started from a candidate."""
        phases = tuple(self._phase(e, candidate.states[e.name]) for e in self.experiments)
        residuals = []
        for i, e in enumerate(self.experiments):
            outputs = outputs_in_log(self.system, e)
            noise = np.array([e.noise[o] for o in outputs])
            if e.name in self.weights:
                noise = noise[:, None] / np.sqrt(self.weights[e.name].T)
            residuals.append(Residuals(i, outputs, e.trajectory.matrix(outputs), noise))
        parameters = self.unknowns().with_values(candidate.parameters)
        held = {n: replace(parameters[n], value=v, lower=v, upper=v) for n, v in self.fixed.items()}
        parameters = parameters | ParameterSet(held)
        return Transcription(self._discrete, parameters, phases, tuple(residuals))

    @cached_property
    def _discrete(self) -> DiscreteSystem:
        """The system's sampled step, to which the slopes of all inputs that are linear in some log are added."""
        return add_slopes(self._held, self._linear)

    @cached_property
    def _held(self) -> DiscreteSystem:
        """The system's sampled step with every input held."""
        return self.system.discrete()

    @cached_property
    def _linear(self) -> Mask:
        """Which inputs are linear between the samples of some log, shape (n_inputs,)."""
        return np.asarray(np.logical_or.reduce([self._rising(e) for e in self.experiments]))

    def _rising(self, experiment: Experiment) -> Mask:
        """Which inputs of the sampled step are linear between the samples of this log."""
        linear = [n for n, kind in input_behaviour(self.system, experiment).items() if kind is Intersample.LINEAR]
        return np.asarray(np.isin(names(self._held.inputs), linear))

    def _phase(self, experiment: Experiment, states: Trajectory) -> Phase:
        t = experiment.trajectory.t
        h = np.append(np.diff(t), np.diff(t)[-1])
        breaks = [end for begin, end in experiment.holes if begin > 0 and end < len(t)]
        if not math.isinf(self.window):
            breaks = sorted({*breaks, *(begin for begin, _ in window_runs(experiment, self.window) if begin > 0)})
        if self.system.states or math.isinf(self.method.segment_time):
            samples = self.method.segment_time / float(np.median(h))
            a_segment = len(h) if math.isinf(samples) else max(2, round(samples))
        else:  # a static map has no gaps, and is cut only for batches and blocks of time
            a_segment = min(max(1, len(h) // STATIC_SEGMENTS), 100)
        nodes = regular_nodes(len(t), a_segment, breaks)
        guess = states.matrix(names(self.system.states))
        for begin, end in experiment.holes:
            h[max(begin - 1, 0) : end] = 0.0  # the state stands still where its inputs are unknown
        driven = self.system.input_matrix(experiment.trajectory, experiment.name)
        driven = append_slopes(t, driven, self._linear, self._rising(experiment))
        start = self.system.unobservable_start(experiment.trajectory, states, self.parameters)
        return Phase(experiment.name, t, h, driven, nodes, start, guess=guess, breaks=np.array(breaks, dtype=np.intp))


def as_estimation_model(model: HasSystem | ClosedLoop | Fittable) -> Fittable:
    """The model as an identification reads it from a log: of a drive its system, of a loop a `LoggedLoop`."""
    runnable = as_runnable(model)
    return LoggedLoop(runnable) if isinstance(runnable, ClosedLoop) else runnable


def apply_conditions(parameters: ParameterSet, experiment: Experiment) -> ParameterSet:
    """The parameters of one log: its conditions replace values, and are known, not free."""
    try:
        return parameters.with_values(experiment.conditions).fixed(*experiment.conditions)
    except InputError as error:
        raise InputError(f"{experiment.name}: condition {error}") from None


FOREIGN_CHANNELS = "channels"  # the name by which channels that no plant reads are accepted, and left out
# What a fit cannot do without, by the names of the checks, and why no user can accept it.
NEEDED = {
    "length": "fewer hold no start state beside a parameter",
    "inputs": "without it the equations cannot be computed",
    "outputs": "without one there is nothing to compare",
    "noise": "a constant channel shows none; state its [noise] in the sidecar",
}
SETPOINT_CHANNELS = ("speed_reference", "position_reference")  # of a loop; they may stay in a log, no plant reads them


def as_experiments(experiments: Experiment | Iterable[Experiment]) -> tuple[Experiment, ...]:
    """One log as well as several, as a tuple; an `InputError` where something else came."""
    return as_tuple("experiments", experiments, Experiment, "an Experiment or several, as read_log(path) gives them")


def check_logs(
    system: Fittable, experiments: Experiment | Iterable[Experiment], parameters: ParameterSet
) -> list[Experiment]:
    """Check that logs, system and parameters fit together; give every log a name of its own and noise levels."""
    experiments = as_experiments(experiments)
    check_parameters(parameters)
    require(len(experiments) > 0, "no experiments: give at least one log", LogError)
    check_names("parameter", parameters, system.parameters)
    system.check(parameters)
    signals = {*names(system.inputs), *names(system.outputs)}
    known = {*signals, *SETPOINT_CHANNELS, *(f"{n}_reference" for n in names(system.outputs))}
    taken: set[str] = set()
    out = []
    for number, experiment in enumerate(experiments, 1):
        name = experiment.name or f"log {number}"
        name = name if name not in taken else f"{name} ({number})"
        taken.add(name)
        check_accept(experiment, name)
        system.check_log(experiment.trajectory, name)
        read = experiment.trajectory.names
        if FOREIGN_CHANNELS in experiment.accept:
            read = tuple(n for n in read if n in known)
        own = replace(experiment.select(read), name=name)
        _check_channels(system, own, name, known)
        check_names("parameter", own.conditions, system.parameters, f"{name}: condition")
        try:
            system.check((system.parameters | parameters).with_values(own.conditions))
        except InputError as error:
            raise InputError(f"{name}: condition {error}") from None
        out.append(repair_log(system, own)[0])
    return _fill_noise(system, out)


def check_accept(experiment: Experiment, name: str) -> None:
    """Check the names of what a log need not pass: each is a check, and one without which a fit is possible."""
    for check in experiment.accept:
        if check in NEEDED:
            raise LogError(f"{name}: accept: {check!r} cannot be accepted: {NEEDED[check]}")
    check_names("check", experiment.accept, (*CHECKS, FOREIGN_CHANNELS), f"{name}: accept")


def check_free(experiments: Sequence[Experiment], parameters: ParameterSet) -> None:
    """Check that a parameter is free, and that no free parameter is known in every log."""
    free = parameters.free_names
    require(len(free) > 0, "no parameter is free; mark what to estimate, as parameters.freed('friction.*')", ModelError)
    for name in free:
        known = all(name in e.conditions for e in experiments)
        message = f"{name} is free, but every log's conditions give its value; fix it, or drop the condition"
        require(not known, message, ModelError)


def emit_log_warnings(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Warn of faults that only the model can find in logs, as a gauge pressure read as absolute.

    The warnings are returned, too.
    """
    found = find_log_warnings(system, experiments, parameters)
    for sentence in found:
        warnings.warn(sentence, PhysicsWarning, stacklevel=3)
    return found


def find_log_warnings(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> tuple[str, ...]:
    """Sentences on faults that the model finds in logs; see `emit_log_warnings`."""
    every = system.parameters | parameters
    known = {e.name: every.with_values(e.conditions).fixed(*e.conditions) for e in experiments}
    return tuple(system.log_warnings({e.name: Log(e.trajectory, known[e.name]) for e in experiments}))


def log_remarks(system: Fittable, given: Sequence[Experiment], checked: Sequence[Experiment]) -> tuple[str, ...]:
    """Sentences on what was mended in logs, and on stated noise levels that the logs themselves do not show."""
    out: list[str] = []
    for log, named in zip(given, checked, strict=True):
        if ignored := [n for n in log.trajectory if n not in named.trajectory]:
            out.append(f"{named.name}: accepted: {', '.join(ignored)}, which the model does not read")
        out += repair_log(system, replace(log.select(named.trajectory), name=named.name))[1]
        for channel in (n for n in outputs_in_log(system, named) if n in log.noise):
            stated, found = log.noise[channel], estimate_noise(named.trajectory[channel], named.trajectory.t)
            shown, least = found.level, found.level / MAX_NOISE_FACTOR if found.is_white else 0.0
            if not least <= stated <= shown * MAX_NOISE_FACTOR:
                unit = next(q.unit for q in system.outputs if q.name == channel)
                levels = f"stated as {stated:.2g} {unit}, the log itself shows {shown:.2g} {unit}"
                out.append(f"{named.name}: the noise of {channel} is {levels}; leave it out to have it estimated")
    return tuple(out)


def _check_channels(system: Fittable, experiment: Experiment, name: str, known: set[str]) -> None:
    trajectory = experiment.trajectory
    short = f"{name}: {len(trajectory)} samples are too short a log; at least 10, for {NEEDED['length']}"
    require(len(trajectory) >= 10, short, LogError)
    for q in system.inputs:
        needed = f"{name}: the model needs the channel {q.name!r} [{q.unit}] as input; the log has "
        require(q.name in trajectory, f"{needed}{', '.join(trajectory.names)}; {NEEDED['inputs']}", LogError)
    for channel in trajectory:
        out = f"{channel} = false under [columns] of the log's sidecar, or Experiment.select"
        remedy = f"leave it out ({out}), or accept = ['channels']"
        reads = ", ".join(sorted(n for n in known if not n.endswith("_reference")))
        message = f"{name}: the model cannot use channel {channel!r}, it reads {reads}; {remedy}"
        require(channel in known, message, LogError)
    outputs = ", ".join(names(system.outputs))
    missing = f"{name}: none of the outputs is logged: {outputs}; {NEEDED['outputs']}"
    require(bool(outputs_in_log(system, experiment)), missing, LogError)
    for channel in outputs_in_log(system, experiment):
        empty = f"{name}: channel {channel!r} holds no sample; leave it out"
        require(bool(np.isfinite(trajectory[channel]).any()), empty, LogError)


def _fill_noise(system: Fittable, experiments: Sequence[Experiment]) -> list[Experiment]:
    """Add noise levels where a log declares none: each channel's median over all logs, for they share their sensors."""
    found: dict[str, dict[str, float]] = {}
    for experiment in experiments:
        for channel in outputs_in_log(system, experiment):
            if channel not in experiment.noise:
                found.setdefault(channel, {})[experiment.name] = noise_level(
                    experiment.trajectory[channel], experiment.trajectory.t
                )
    pooled = {}
    for channel, levels in found.items():
        shown = [level for level in levels.values() if not math.isnan(level)]
        constant = f"{next(iter(levels))}: channel {channel!r} is constant; leave it out, or state its [noise]"
        require(len(shown) > 0, constant, LogError)
        pooled[channel] = float(np.median(shown))
        silent = f"{next(iter(levels))}: channel {channel!r} shows no noise, not even rounding; state its [noise]"
        require(pooled[channel] > 0, silent, LogError)
    return [
        e.with_noise({n: s for n, s in pooled.items() if n in e.trajectory and n not in e.noise}) for e in experiments
    ]


def outputs_in_log(system: Fittable, experiment: Experiment) -> tuple[str, ...]:
    """The names of the system's outputs that a log holds; an output that is an input, too, is left out."""
    inputs = names(system.inputs)
    return tuple(n for n in names(system.outputs) if n in experiment.trajectory and n not in inputs)


def input_behaviour(system: Fittable, experiment: Experiment) -> dict[str, Intersample]:
    """The behaviour of each of the system's inputs between two samples: as stated for the log, or as is usual."""
    said = experiment.intersample
    return {q.name: said.get(q.name) or usual_intersample(q.name, q.unit) for q in system.inputs}


def repair_log(system: Fittable, experiment: Experiment) -> tuple[Experiment, tuple[str, ...]]:
    """Bridge the short holes of a log's inputs and cut it at the long ones (`holes`); the log and sentences on that.

    A sampled loop is refused at a long one, for its controller goes on. What a sensor repeats is no sample.
    """
    fresh, sentences = _without_repeats(system, experiment)
    log, inputs = fresh.trajectory, names(system.inputs)
    known: Mask = np.asarray(np.isfinite(log.matrix(inputs)).all(axis=1))
    holes = _find_holes(log, known, system) if system.states else []
    lost = np.zeros(len(log), dtype=bool) if system.states else ~known
    for begin, end in holes:
        lost[begin:end] = True
    everything = (
        f"{experiment.name}: no part holds {', '.join(inputs)} and {MIN_RUN} samples of an output; log them together"
    )
    require(not lost.all(), everything, LogError)
    where = ", ".join(f"from {log.t[max(a - 1, 0)]:g} s to {log.t[min(b, len(log) - 1)]:g} s" for a, b in holes[:3])
    where += ", ..." if len(holes) > 3 else ""
    if holes and system.motion().sample_time is not None:
        message = f"{experiment.name}: inputs are unknown {where}, and a sampled controller goes on meanwhile"
        raise LogError(f"{message}; cut the log in two there")
    short = ~known & ~lost
    sentences += [f"{experiment.name}: inputs are unknown {where}; the log is cut there"] if holes else []
    if short.any():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], short, [False]]).astype(int)))
        longest = int(np.max(edges[1::2] - edges[::2]))
        gaps = f"{experiment.name}: {int(short.sum())} samples lack an input, {longest} in a row at most"
        sentences.append(f"{gaps}; they are bridged")
    if not (holes or short.any() or lost.any()):
        return fresh, tuple(sentences)
    values = _bridge(log, input_behaviour(system, experiment), lost)
    return replace(experiment, trajectory=log.with_columns(values), holes=tuple(holes)), tuple(sentences)


def _without_repeats(system: Fittable, experiment: Experiment) -> tuple[Experiment, list[str]]:
    """The log without the values that sensors slower than it repeat from row to row, and a sentence on each sensor."""
    log, columns, sentences = experiment.trajectory, dict[str, Array](), list[str]()
    for channel in outputs_in_log(system, experiment):
        found = find_refresh(log[channel], log.t)
        if found is not None and np.isfinite(log[channel][~found.fresh]).any():
            columns[channel] = np.where(found.fresh, log[channel], np.nan)
            period = f"{found.period:.3g}"
            every = f"{period}{dict(zip('23', ('nd', 'rd'), strict=True)).get(period, 'th')} row"
            every = every if period.isdecimal() else f"{period} rows"
            sentences.append(f"{experiment.name}: {channel} is new every {every}; what the log repeats does not count")
    return replace(experiment, trajectory=log.with_columns(columns)) if columns else experiment, sentences


def known_runs(experiment: Experiment) -> list[tuple[int, int]]:
    """Begin and end of each part of a repaired log, as a range of samples, that no hole interrupts."""
    edges = [0, *(edge for hole in experiment.holes for edge in hole), len(experiment.trajectory)]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]


def window_runs(experiment: Experiment, window: float) -> list[tuple[int, int]]:
    """Begin and end of each window of a repaired log; what is left of a part joins its last one if below half of one.

    Examples
    --------
    >>> log = Experiment(Trajectory(np.arange(11) * 0.1, {"speed": np.zeros(11)}))
    >>> window_runs(log, 0.4), window_runs(log, 0.3)
    ([(0, 4), (4, 8), (8, 11)], [(0, 3), (3, 6), (6, 9), (9, 11)])
    """
    n = max(1, round(window / float(np.median(np.diff(experiment.trajectory.t)))))
    out: list[tuple[int, int]] = []
    for begin, end in known_runs(experiment):
        edges = [begin, *range(begin + n, end - (n + 1) // 2 + 1, n), end]
        out += itertools.pairwise(edges)
    return out


def _find_holes(log: Trajectory, known: Mask, system: Fittable) -> list[tuple[int, int]]:
    """Begin and end of each long hole, as a range of samples: an empty one where only rows are missing."""
    at = np.flatnonzero(known)
    far = np.flatnonzero(np.diff(log.t[at]) > (MAX_BRIDGE + 1.5) * float(np.median(np.diff(log.t))))
    begins, ends = [*at[:1], *at[far + 1]], [*(at[far] + 1), *(at[-1:] + 1)]
    outputs = log.matrix(n for n in names(system.outputs) if n in log)
    measured: Mask = np.asarray(np.isfinite(outputs).any(axis=1))
    runs = [(int(a), int(b)) for a, b in zip(begins, ends, strict=True) if measured[a:b].sum() >= MIN_RUN]
    edges = [0, *(edge for run in runs for edge in run), len(log)]
    inner = range(2, len(edges) - 2, 2)
    outer = [(edges[k], edges[k + 1]) for k in (0, len(edges) - 2) if edges[k + 1] > edges[k]]
    return sorted({*outer, *((edges[k], edges[k + 1]) for k in inner)})


def _bridge(log: Trajectory, behaviour: dict[str, Intersample], lost: Mask) -> dict[str, Array]:
    """The columns of a log without holes in its inputs, and without outputs where the inputs are lost."""
    out = {}
    for name in log:
        column, kind = log[name], behaviour.get(name)
        known = np.isfinite(column)
        if kind is None:
            out[name] = np.where(lost, np.nan, column)
        elif kind is Intersample.LINEAR:
            out[name] = np.interp(log.t, log.t[known], column[known])
        else:
            last = np.maximum.accumulate(np.where(known, np.arange(len(log)), 0))
            out[name] = np.where(known[last], column[last], column[np.argmax(known)])
    return out


def find_centre(system: Fittable, experiments: Sequence[Experiment], parameters: ParameterSet) -> ParameterSet:
    """Free the centre of a plant's valve, with a warning, where logs count its command from 0 and nobody has stated it.

    Logs that count it from different voltages are refused, and so is a log that contradicts a stated centre.
    """
    name, element = centre_name(system.plant), system.plant.axis.final_element if system.plant.axis else None
    if name is None or element is None:
        return parameters
    every = system.parameters | parameters
    stated = every[name]
    commands = [c for e in experiments if name not in e.conditions for c in _commands(system, element, e, every)]
    shown = [c for c in commands if c.is_counted_from(0.0)]
    about = [c for c in commands if c.is_counted_from(-c.half)]
    if stated.value:
        for command in about:  # it has been counted from the stated centre already
            message = f"{command}, which is no command of a valve with {name} = {stated.value:g} {command.unit}"
            remedy = "leave that out of the drive, or of the log's sidecar (or Python) what has subtracted it"
            require(abs(stated.value) < MAX_REST_DISTANCE * command.half, f"{message}; {remedy}", LogError)
        return parameters
    if not shown:
        return parameters
    if about:
        message = f"{shown[0]}, but {about[0]}; subtract the valve's centre in the sidecars of all logs, or of none"
        raise LogError(message)
    rest, most = float(np.median([c.rest for c in shown])), MAX_REST_DISTANCE * shown[0].half
    whole = shown[0]._replace(low=min(c.low for c in shown), high=max(c.high for c in shown))
    is_unseen = not whole.is_two_way(0.0) and every[element.dead_zone].free
    value, source = (shown[0].half, UNSEEN_CENTRE) if is_unseen else (rest, "where the log rests")
    found = replace(stated, value=value, lower=rest - most, upper=rest + most, free=True, source=source)
    middle = f"{shown[0].half:g} {stated.unit}"
    fate = f"is taken as {middle}, for the log uses one side of it only" if is_unseen else "is estimated with the rest"
    warnings.warn(
        f"{shown[0]}: the {element.name} is closed near {middle}; {name} {fate}, or state it, "
        f'centre = "{middle}", under [{name.partition(".")[0]}]',
        PhysicsWarning,
        stacklevel=3,
    )
    return parameters | ParameterSet({name: found})


UNSEEN_CENTRE = "the middle of its range: the log uses one side of it only"
"""Source of a valve's centre that acts only together with its dead zone."""


class _Command(NamedTuple):
    """A valve's command in a log: its range and where it rests, and the size of the valve's own half range."""

    log: str
    channel: str
    unit: str
    low: float
    high: float
    rest: float
    half: float

    def is_counted_from(self, zero: float) -> bool:
        """Whether the command runs about half the range above a voltage, and rests near there."""
        low, high, rest = ((v - zero) / self.half for v in (self.low, self.high, self.rest))
        is_within = low >= -RANGE_TOLERANCE and high <= 2 + RANGE_TOLERANCE
        # one way it never comes near the zero, where the valve would have to be closed for the drive to rest
        is_far = low > 1 - MAX_REST_DISTANCE and high - low > RANGE_TOLERANCE
        return is_within and (self.is_two_way(zero) or is_far) and abs(rest - 1) < MAX_REST_DISTANCE

    def is_two_way(self, zero: float) -> bool:
        """Whether the command runs to both sides of half the range above a voltage."""
        low, high = ((v - zero) / self.half for v in (self.low, self.high))
        return low < 1 - RANGE_TOLERANCE and high > 1 + RANGE_TOLERANCE

    def __str__(self) -> str:
        run = f"runs from {self.low:.3g} to {self.high:.3g} {self.unit}"
        return f"{self.log}: {self.channel} {run} and rests at {self.rest:.3g} {self.unit}"


def _commands(
    system: Fittable, element: FinalElement, experiment: Experiment, parameters: ParameterSet
) -> list[_Command]:
    """The command of a log; none where its channel is missing or empty."""
    limit = parameters[element.limit]
    half, log = experiment.conditions.get(element.limit, limit.value), experiment.trajectory
    channels = [q.name for q in system.plant.inputs if q.unit == limit.unit and q.name in log]
    if not channels or not np.isfinite(log[channels[0]]).any():
        return []
    command, speed = log[channels[0]], np.zeros(0)
    if "speed" in log:
        speed = np.abs(log["speed"])
    elif "position" in log:
        speed = np.abs(np.gradient(log["position"], log.t))
    known = speed[np.isfinite(speed)]
    # the drive rests where it stands; over the whole log where that is not to be seen
    still = speed <= MOVING_SPEED_SHARE * float(np.quantile(known, 0.99)) if known.size else np.zeros(len(log), bool)
    rest = float(np.nanmedian(command[still] if still.any() else command))
    ends = float(np.nanmin(command)), float(np.nanmax(command))
    return [_Command(experiment.name, channels[0], limit.unit, *ends, rest, half)]
