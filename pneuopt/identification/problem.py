"""`EstimationProblem`: logs, conditions and parameters of an identification, as a multiple-shooting `Transcription`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.hooks import Log, Start
from pneuopt.dynamics.ramps import add_slopes, append_slopes
from pneuopt.dynamics.runnable import Fittable, HasSystem, as_runnable
from pneuopt.dynamics.system import DiscreteSystem, names
from pneuopt.identification.checks import outputs_in_log
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.identification.repairs import input_behaviour, window_runs
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import Fit, LeastSquares
from pneuopt.shooting.transcription import Phase, Residuals, Transcription, regular_nodes

STATIC_SEGMENTS = 100  # segments of a static map's log: fewer make uneven blocks of time, more cost time
REFIT_STAGES = 3  # last stages of a method that a refit runs, near its answer: more cost time, fewer may not converge


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """An estimation problem: a system, logs and parameters; its transcription, and starts from its fits.

    Parameters
    ----------
    system : Fittable
    experiments : tuple of Experiment
    parameters : ParameterSet
    method : LeastSquares
    weights : mapping of str to ndarray, each of shape (n, n_measured_outputs)
        By log, the weight of each sample's squared residual; 1 for logs that are absent.
    held : mapping of str to float
        Values of free parameters that are held, for the logs cannot identify them.
    noise_is_stated : bool
        Whether the logs state the noise of all outputs; otherwise it is estimated from them.
    window : float
        Time after which a log starts anew with a state of its own [s]; math.inf where it never does.
    is_whole : bool
        Whether logs stay whole also where the model does not follow them.
    """

    system: Fittable
    experiments: tuple[Experiment, ...]
    parameters: ParameterSet
    method: LeastSquares
    weights: Mapping[str, Array] = field(default_factory=dict)
    held: Mapping[str, float] = field(default_factory=dict)
    noise_is_stated: bool = False
    window: float = math.inf
    is_whole: bool = False

    @property
    def has_gaps(self) -> bool:
        """Whether some segment continues another; not so in windows of one segment each."""
        return self.method.segment_time < self.window

    def candidates(self) -> Sequence[Start]:
        """The model's own starts from all logs together."""
        return self._candidates

    @cached_property
    def _candidates(self) -> Sequence[Start]:
        """The starts, which several readers share."""
        known = {
            e.name: (apply_conditions(self.parameters, e), input_behaviour(self.system, e)) for e in self.experiments
        }
        return self.system.starts({e.name: Log(e.trajectory, *known[e.name]) for e in self.experiments})

    def start_from(self, fit: Fit | IdentificationResult, label: str = "fit") -> Start:
        """The start from a fit of these logs, by the parameters that both have.

        Parameters without an estimate begin at their given values.
        """
        if isinstance(fit, IdentificationResult):
            runs, found = (
                tuple(fit.trajectories.values()),
                {str(n): float(v) for n, v in fit.estimates["value"].items()},
            )
        else:
            runs, found = fit.trajectories, {n: fit.parameters.value(n) for n in fit.parameters.free_names}
        given = self.unknowns()
        values = {n: v if math.isfinite(v) else given.value(n) for n, v in found.items() if n in given}
        return Start(dict(zip((e.name for e in self.experiments), runs, strict=True)), values, label)

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
        residuals = tuple(self._residuals(i, e) for i, e in enumerate(self.experiments))
        parameters = self.unknowns().with_values(candidate.parameters)
        held = {n: replace(parameters[n], value=v, lower=v, upper=v) for n, v in self.held.items()}
        parameters = parameters | ParameterSet(held)
        return Transcription(self._discrete, parameters, phases, residuals)

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
        breaks = self._breaks(experiment)
        nodes, guess = (
            regular_nodes(len(t), self._samples_a_segment(h), breaks),
            states.matrix(names(self.system.states)),
        )
        for begin, end in experiment.holes:
            h[max(begin - 1, 0) : end] = 0.0  # the state stands still where its inputs are unknown
        driven = self.system.input_matrix(experiment.trajectory, experiment.name)
        driven = append_slopes(t, driven, self._linear, self._rising(experiment))
        start = self.system.unobservable_start(experiment.trajectory, states, self.parameters)
        return Phase(experiment.name, t, h, driven, nodes, start, guess=guess, breaks=np.array(breaks, dtype=np.intp))

    def _breaks(self, experiment: Experiment) -> list[int]:
        """The samples at which a log starts anew: after a hole in its inputs, and at the start of each window."""
        t = experiment.trajectory.t
        holes = [end for begin, end in experiment.holes if begin > 0 and end < len(t)]
        if math.isinf(self.window):
            return holes
        return sorted({*holes, *(begin for begin, _ in window_runs(experiment, self.window) if begin > 0)})

    def _samples_a_segment(self, h: Array) -> int:
        """Samples between two nodes; a static map has no gaps, and is cut only for batches and blocks of time."""
        if not self.system.states:
            return min(max(1, len(h) // STATIC_SEGMENTS), 100)
        samples = self.method.segment_time / float(np.median(h))
        return len(h) if math.isinf(samples) else max(2, round(samples))

    def _residuals(self, index: int, experiment: Experiment) -> Residuals:
        outputs = outputs_in_log(self.system, experiment)
        noise = np.array([experiment.noise[o] for o in outputs])
        if experiment.name in self.weights:
            noise = noise[:, None] / np.sqrt(self.weights[experiment.name].T)
        return Residuals(index, outputs, experiment.trajectory.matrix(outputs), noise)


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
