"""An identification posed as multiple shooting: logs, conditions and own parameters become a `Transcription`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pneuopt.checks import measured_outputs
from pneuopt.errors import InputError
from pneuopt.experiments import Experiment
from pneuopt.nlp.least_squares import LeastSquares
from pneuopt.nlp.transcription import Phase, Residuals, Transcription, every
from pneuopt.parameters import Parameter, ParameterSet
from pneuopt.system import Log, Start, System, discretise, names
from pneuopt.trajectories import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be identified, and its translation to a transcription and back."""

    system: System
    experiments: tuple[Experiment, ...]
    parameters: ParameterSet
    method: LeastSquares

    def candidates(self) -> Sequence[Start]:
        """The model's own starts from all logs together."""
        logs = {e.name: Log(e.trajectory, conditioned(self.parameters, e)) for e in self.experiments}
        return self.system.starts(logs)

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
        """Pose the problem as multiple shooting, started from a candidate."""
        phases = tuple(self._phase(e, candidate.states[e.name]) for e in self.experiments)
        residuals = tuple(self._residuals(i, e) for i, e in enumerate(self.experiments))
        parameters = self.unknowns().with_values(candidate.parameters)
        return Transcription(discretise(self.system), parameters, phases, residuals)

    def _phase(self, experiment: Experiment, states: Trajectory) -> Phase:
        t = experiment.trajectory.t
        h = np.append(np.diff(t), np.diff(t)[-1])
        inputs = experiment.trajectory.matrix(names(self.system.inputs))
        nodes = every(len(t), self._segment(h))
        return Phase(experiment.name, t, h, inputs, nodes, guess=states.matrix(names(self.system.states)))

    def _segment(self, h: Array) -> int:
        """Samples between two nodes; a static map has no gaps, so its cut is only for batching."""
        if not self.system.states:
            return 100
        samples = self.method.segment_time / float(np.median(h))
        return len(h) if math.isinf(samples) else max(2, round(samples))

    def _residuals(self, index: int, experiment: Experiment) -> Residuals:
        outputs = measured_outputs(self.system, experiment)
        noise = np.array([experiment.noise[o] for o in outputs])
        return Residuals(index, outputs, experiment.trajectory.matrix(outputs), noise)


def conditioned(parameters: ParameterSet, experiment: Experiment) -> ParameterSet:
    """The parameters as they are in one log, where its conditions are known and so not free."""
    try:
        return parameters.with_values(experiment.conditions).fixed(*experiment.conditions)
    except InputError as error:
        raise InputError(f"{experiment.name}: condition {error}") from None
