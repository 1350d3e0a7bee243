"""`PlannedRun`: candidates of an experiment, simulated many at once in SIMD lanes; their limits and their information.

The information about the parameters is that of the log that the run would leave: the plant's command and its measured
outputs. So a loop only makes the run; it is the plant that is identified, along short segments whose sensitivities are
chained, the start state eliminated, as `identify` does.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.identification.linked_information import linked_information
from pneuopt.identification.logged_loop import REFERENCE_CHANNELS
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.shooting.segments import Segments, gap_scales, segment, stable_substeps, start_nodes
from pneuopt.shooting.transcription import Phase, Transcription

BATCH_SAMPLES = 400_000  # samples simulated at once: more take memory (100 bytes a sample and signal), fewer lanes
MIN_SUBSTEPS = 8  # integration steps a sample: fewer miss how a bristle lets go
Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """The plant, or the loop that moves it, as a planned experiment runs it.

    Attributes
    ----------
    plant : System
    loop : ClosedLoop or None
    free : tuple of str
        Parameters of the plant whose information counts.
    per_log : tuple of str
        Free ones that each log has for itself, which are eliminated.
    noise : mapping of str to float
        Of the outputs that will be logged [unit].
    limits : mapping of str to (float, float)
        Of outputs, states, the command or the reference.
    sample_time : float
        [s]
    start : mapping of str to float
        Outputs at the rest from which each run begins.
    origin : float
        The excitation there [its unit].
    """

    plant: System
    loop: ClosedLoop | None
    free: tuple[str, ...]
    per_log: tuple[str, ...]
    noise: Mapping[str, float]
    limits: Limits
    sample_time: float
    start: Mapping[str, float]
    origin: float = 0.0

    @cached_property
    def command(self) -> Quantity:
        """The plant's input."""
        require(len(self.plant.inputs) == 1, _SEVERAL_INPUTS.format(", ".join(names(self.plant.inputs))), ModelError)
        return self.plant.inputs[0]

    @cached_property
    def excitation(self) -> Quantity:
        """What the excitation is: the loop's reference as logs name it, or the plant's command."""
        if self.loop is None:
            return self.command
        seen = self.loop.feedback
        name = REFERENCE_CHANNELS.get(seen.name, f"{seen.name}_reference")
        return Quantity(name, seen.unit, seen.nominal)

    @property
    def channels(self) -> tuple[Quantity, ...]:
        """What a run shows: the excitation, the command, the plant's outputs, then states that are no outputs."""
        shown = [self.excitation, self.command, *self.plant.outputs, *self.plant.states]
        return tuple({q.name: q for q in reversed(shown)}[n] for n in dict.fromkeys(names(shown)))

    def rest_excitation(self, parameters: ParameterSet) -> float:
        """The excitation at the start: the reference there, or the command that holds the plant at rest."""
        if self.loop is not None:
            return self.start.get(self.loop.feedback.name, 0.0)
        hook, known = self.plant.rest_hook, self.plant.parameters | parameters
        return 0.0 if hook is None else hook(known, self.start).inputs.get(self.command.name, 0.0)

    def excited_limits(self) -> tuple[float, float]:
        """The range of the excitation; a reference has that of its output if none of its own."""
        name = self.excitation.name
        given = [n for n in (name, self.loop.feedback.name if self.loop else name) if n in self.limits]
        ends = self.limits[given[0]] if given else (-math.inf, math.inf)
        finite = math.isfinite(ends[0]) and math.isfinite(ends[1])
        require(finite, f"limits: give the least and greatest value of {name!r}, which is excited")
        return ends

    def rest(self, parameters: ParameterSet) -> Array:
        """The state from which a run begins, shape (n_states,)."""
        if self.loop is None:
            return self.plant.rest_state(parameters, self.start)
        others = {n: v for n, v in self.start.items() if n != self.loop.feedback.name}
        return self.loop.initial(parameters, reference=self.rest_excitation(parameters), start=others)

    def simulate(self, signals: Array, parameters: ParameterSet, substeps: int) -> Array:
        """Run excitations of shape (m, n), counted from the start; returns all `channels`, shape (m, n, n_channels)."""
        m, n = signals.shape
        size, given = max(1, BATCH_SAMPLES // n), signals[:, :, None] + self.origin
        p, x0 = parameter_vector((self.loop or self.plant).parameters, parameters), self.rest(parameters)
        t, h = np.arange(n) * self.sample_time, np.full(n, self.sample_time)
        parts = []
        for u in np.split(given, range(size, m, size)):
            run = self._run.run(np.tile(x0, (len(u), 1)), u, p, t, h, substeps=substeps, states=1)
            assert run.x is not None
            parts.append(self._gather(u, run.y, run.x))
        return np.concatenate(parts)

    def _gather(self, u: Array, y: Array, x: Array) -> Array:
        """The channels of a run, in their order."""
        held = y[:, :, -1:] if self.loop is not None else u
        columns = {self.excitation.name: u[..., 0], self.command.name: held[..., 0]}
        columns |= {n: x[:, :, i] for i, n in enumerate(names(self.plant.states))}
        columns |= {n: y[:, :, i] for i, n in enumerate(names(self.plant.outputs))}
        return np.stack([columns[q.name] for q in self.channels], axis=2)

    def violations(self, runs: Array, parameters: ParameterSet) -> Mapping[str, Array]:
        """How far each run leaves each limit, as a share of its width, shape (m,); below zero: the room left."""
        out, position = {}, {q.name: i for i, q in enumerate(self.channels)}
        for name, (low, high) in self.all_limits(parameters).items():
            values = runs[:, :, position[name]]
            with np.errstate(invalid="ignore"):
                beyond = np.maximum(low - values.min(axis=1), values.max(axis=1) - high)
            width = high - low if np.isfinite(high - low) else max(abs(v) for v in (low, high) if np.isfinite(v))
            out[name] = np.where(np.isfinite(values).all(axis=1), beyond / width, np.inf)
        return out

    def all_limits(self, parameters: ParameterSet) -> Limits:
        """The given limits, and those of the plant's equations: the ends of the stroke, a vacuum."""
        out: dict[str, tuple[float, float]] = {n: (float(low), float(high)) for n, (low, high) in self.limits.items()}
        whole = self.plant.parameters | parameters
        for limit in self.plant.validity_limits:
            low, high = out.get(limit.state, (-np.inf, np.inf))
            end = float(limit.limit(whole))
            out[limit.state] = (low, min(high, end)) if limit.side > 0 else (max(low, end), high)
        return out

    def information(self, runs: Array, parameters: ParameterSet, substeps: int) -> Array:
        """What `identify` will know of the free parameters from the log of each run, in their units; (m, k, k)."""
        m, n = runs.shape[:2]
        size = max(1, BATCH_SAMPLES // n)
        parts = [self._information(runs[i : i + size], parameters, substeps) for i in range(0, m, size)]
        k = len(self.free)
        return np.concatenate(parts) if parts else np.zeros((0, k, k))

    def _information(self, runs: Array, parameters: ParameterSet, substeps: int) -> Array:
        m, n = runs.shape[:2]
        method = LeastSquares()  # as `identify` places its nodes and weighs its gaps in the end
        length = max(2, round(method.segment_time / self.sample_time))
        count = -(-n // length)
        padded = np.pad(runs, ((0, 0), (0, count * length - n), (0, 0)), mode="edge")
        cut = padded.reshape(m * count, length, -1)
        x = cut[:, 0, self._positions(self.plant.states)]
        grid = np.arange(count * length) * self.sample_time
        real = np.tile((np.arange(len(grid)) < n).reshape(count, -1), (m, 1))
        t, h = np.tile(grid.reshape(count, -1), (m, 1)), np.where(real, self.sample_time, 0.0)
        weight = np.array([1 / self.noise[q.name] if q.name in self.noise else 0.0 for q in self.plant.outputs])
        u, p = cut[:, :, self._positions([self.command])], parameter_vector(self.plant.parameters, parameters)
        blank = np.where(real[..., None], 0.0, np.nan) + np.zeros(len(weight))
        found = self._sensitivities.gram(x, u, p, t, h, blank, np.broadcast_to(weight, blank.shape), substeps=substeps)
        grams = found.grams[:, :-1, :-1].reshape(m, count, *found.grams[0, :-1, :-1].shape)
        ends = found.dx_end.reshape(m, count, *found.dx_end.shape[1:])
        good = np.isfinite(grams).all(axis=(1, 2, 3)) & np.isfinite(ends).all(axis=(1, 2, 3))
        own = self._parameter_sizes(parameters)
        nominal = np.array([q.nominal for q in self.plant.states])
        scale, jumps = np.concatenate([nominal, own]), method.stages[-1].gap * self._jumps(parameters)
        out = np.zeros((m, len(self.free), len(self.free)))
        kept = own[len(self.per_log) :]
        given = grams[good] * np.outer(scale, scale), ends[good] * scale / nominal[:, None]
        out[good] = linked_information(*given, jumps, len(self.per_log)) / np.outer(kept, kept)
        return out

    def stable_substeps(self, parameters: ParameterSet) -> int:
        """Integration steps a sample that are stable about the rest, at every state's usual size."""
        if not self.plant.states:
            return 1
        segments = self._segments_about_rest(parameters)
        q = np.array([v.value for v in segments.transcription.parameters.values()])
        return max(MIN_SUBSTEPS, 2 * stable_substeps(segments, start_nodes(segments), q, RK4_MAX_H_LAMBDA))

    def _jumps(self, parameters: ParameterSet) -> Array:
        """The size of each state's jump at a node beside the others': smaller where kinematics give its rate."""
        return np.asarray(gap_scales(self._segments_about_rest(parameters), LeastSquares().kinematic))

    def _segments_about_rest(self, parameters: ParameterSet) -> Segments:
        x = self.plant.rest_state(self.plant.parameters | parameters, self.start)
        usual = np.diag([q.nominal for q in self.plant.states])
        guess = np.concatenate([[x], x + usual, x - usual])
        n = len(guess)
        t, h = self.sample_time * np.arange(n, dtype=np.float64), np.full(n, self.sample_time)
        phase = Phase("rest", t, h, np.zeros((n, 1)), np.arange(n), guess=guess)
        known = self.plant.parameters | parameters.select(q for q in parameters if q in self.plant.parameters)
        return segment(Transcription(self.plant.discrete(), known, (phase,)))

    def _parameter_sizes(self, parameters: ParameterSet) -> Array:
        """By which the parameters are scaled, so that numbers of all units meet in one matrix."""
        known = self.plant.parameters | parameters
        return np.array([abs(known.value(n)) or 1.0 for n in (*self.per_log, *self.free)])

    @cached_property
    def _run(self) -> Rollout:
        return Rollout((self.loop or self.plant).discrete().pieces)

    @cached_property
    def _sensitivities(self) -> Rollout:
        order = list(self.plant.parameters)
        wrt = [order.index(n) for n in (*self.per_log, *self.free)]
        return Rollout(self.plant.discrete().pieces, wrt=wrt, start=True)

    def _positions(self, quantities: Sequence[Quantity]) -> Indices:
        place = {q.name: i for i, q in enumerate(self.channels)}
        return np.array([place[q.name] for q in quantities], dtype=np.intp)


_SEVERAL_INPUTS = "a planned run excites one input, the plant has {}; plan it with a friction model that needs one"
