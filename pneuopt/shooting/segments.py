"""`Segments`: a transcription as one batch of compiled segments of all phases, with sensitivities.

`segment` cuts it, `start_nodes` and `gap_scales` are what a search begins with, `choose_integration` names its steps.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.compiled.rollout import Gram, Pieces, Rollout, RolloutResult
from pneuopt.dynamics.system import DiscreteSystem, names
from pneuopt.dynamics.tolerances import PARTITIONED_MAX_H_GROWTH, PARTITIONED_MAX_H_LAMBDA, RK4_MAX_H_LAMBDA
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.tolerances import (
    GROWTH_POINTS,
    GROWTH_RANGE,
    IMPLICIT_REFINEMENT,
    MAX_STIFFNESS_NODES,
    MIN_IMPLICIT_GAIN,
    MIN_IMPLICIT_SUBSTEPS,
    STABILITY_RESERVE,
    SUBSTEPS_CAP,
)
from pneuopt.shooting.transcription import Phase, Transcription


class SegmentBlock(NamedTuple):
    """Segments in a row that share their unknowns: sensitivity column `columns[i]` is free parameter `unknowns[i]`."""

    rows: slice
    columns: Indices
    unknowns: Indices


@dataclass(frozen=True, eq=False)
class IntegrationCorrection:
    """The change of a run by finer integration steps."""

    y: Array  # (m, n, n_outputs)
    x_end: Array  # (m, n_states)
    fine_run: RolloutResult  # the run with the finer steps


@dataclass(frozen=True, eq=False)
class Segments:
    """All segments of a transcription, padded to one length of n samples (a padded sample has h = 0 and no data)."""

    transcription: Transcription
    t: Array  # (m, n)
    h: Array  # (m, n)
    inputs: Array  # (m, n, n_inputs)
    # measured, noise (m, n, n_outputs): NaN where nothing was measured
    measured: Array
    noise: Array
    # (m, n_system_parameters): positions of each segment's parameter vector among the problem's parameters
    parameter_positions: Indices
    linked: Mask  # (m,): whether the next segment continues this one
    # (m, n_states): the known start state; NaN where the node is an unknown. A state on which no measured output
    # depends (the position under a logged speed) is held at its guess there.
    fixed_start: Array
    # phase, lengths (m,): the phase of each segment, and its samples without padding
    phase: Indices
    lengths: Indices
    # position of the state in which the integration is implicit; None: all is explicit (RK4)
    implicit_state: int | None = None

    @property
    def system(self) -> DiscreteSystem:
        """The system that runs in each segment."""
        return self.transcription.system

    @cached_property
    def nominal(self) -> Array:
        """The states' nominal sizes, by which nodes and gaps are scaled."""
        return np.array([s.nominal for s in self.system.states])

    @property
    def count(self) -> int:
        """Number of segments m."""
        return len(self.t)

    @cached_property
    def columns(self) -> Indices:
        """Positions, in the system's parameter vector, of those that are free in some segment."""
        free = np.isin(self.parameter_positions, self.transcription.free)
        return np.flatnonzero(free.any(axis=0)).astype(np.intp)

    @cached_property
    def unknowns(self) -> Indices:
        """For each segment and column, which free parameter it is; -1 where it is fixed. Shape (m, n_columns)."""
        index = np.full(len(self.transcription.parameters), -1, dtype=np.intp)
        index[self.transcription.free] = np.arange(len(self.transcription.free))
        return np.asarray(index[self.parameter_positions[:, self.columns]])

    @cached_property
    def blocks(self) -> tuple[SegmentBlock, ...]:
        """All segments, in their order, by what is unknown in them."""
        changes = np.flatnonzero(np.diff(self.unknowns, axis=0).any(axis=1)) + 1
        edges, out = [0, *changes.tolist(), self.count], []
        for a, b in itertools.pairwise(edges):
            columns = np.flatnonzero(self.unknowns[a] >= 0)
            out.append(SegmentBlock(slice(a, b), columns, self.unknowns[a, columns]))
        return tuple(out)

    @cached_property
    def weights(self) -> Array:
        """One over the noise, shape (m, n, n_outputs)."""
        return np.asarray(1 / self.noise)

    @cached_property
    def counts(self) -> Indices:
        """Number of measured samples of each output, shape (n_outputs,)."""
        return np.asarray(np.isfinite(self.measured).sum(axis=(0, 1)))

    @cached_property
    def sensitivities(self) -> Rollout:
        """The compiled run with sensitivities to start states and free parameters."""
        return Rollout(self._pieces, wrt=self.columns.tolist(), start=True)

    @cached_property
    def plain_rollout(self) -> Rollout:
        """The compiled run without sensitivities."""
        return Rollout(self._pieces)

    def with_implicit_state(self, state: int | None) -> "Segments":
        """The same segments, integrated implicitly in this state, or by RK4."""
        return replace(self, implicit_state=state)

    @property
    def _pieces(self) -> Pieces:
        return replace(self.system.pieces, implicit=self.implicit_state)

    def run(
        self, nodes: Array, q: Array, substeps: int, *, sensitivities: bool = False, states: bool = False
    ) -> RolloutResult:
        """Integrate all segments from their nodes, shape (m, n_states), at the problem's parameter values q."""
        rollout = self.sensitivities if sensitivities else self.plain_rollout
        return rollout.run(
            nodes, self.inputs, q[self.parameter_positions], self.t, self.h, substeps=substeps, states=states
        )

    def gram(self, nodes: Array, q: Array, substeps: int, correction: IntegrationCorrection | None = None) -> Gram:
        """Integrate with sensitivities, and form the Gram matrices of the residuals, which alone are corrected."""
        measured = self.measured if correction is None else self.measured - correction.y
        given = (nodes, self.inputs, q[self.parameter_positions], self.t, self.h, measured, self.weights)
        return self.sensitivities.gram(*given, substeps=substeps)

    def trajectories(self, run: RolloutResult) -> tuple[Trajectory, ...]:
        """States and outputs at every sample of a run with states, one trajectory a phase."""
        assert run.x is not None
        own = names((*self.system.states, *self.system.outputs))
        return self._as_trajectories(own, np.concatenate([run.x, run.y], axis=2))

    def output_trajectories(self, y: Array) -> tuple[Trajectory, ...]:
        """Outputs at every sample, shape (m, n, n_outputs), as one trajectory a phase."""
        return self._as_trajectories(names(self.system.outputs), y)

    def _as_trajectories(self, columns: Sequence[str], values: Array) -> tuple[Trajectory, ...]:
        real, out = np.arange(self.t.shape[1]) < self.lengths[:, None], list[Trajectory]()
        for i, phase in enumerate(self.transcription.phases):
            rows = self.phase == i
            out.append(Trajectory(phase.t, dict(zip(columns, values[rows][real[rows]].T, strict=True))))
        return tuple(out)


def segment(transcription: Transcription) -> Segments:
    """Cut a transcription into its segments; `ModelError` for a free duration, which compiled segments do not take."""
    system = transcription.system
    length = max(int(np.diff(np.append(p.nodes, p.n)).max()) for p in transcription.phases)
    position, measured = {n: i for i, n in enumerate(names(system.outputs))}, dict[int, tuple[Array, Array]]()
    for residual in transcription.residuals:
        values = np.full((transcription.phases[residual.phase].n, len(position)), np.nan)
        deviations = np.ones_like(values)
        for column, output in enumerate(residual.outputs):
            values[:, position[output]] = residual.measured[:, column]
            deviations[:, position[output]] = residual.noise[column]
        measured[residual.phase] = values, deviations
    parts = []
    for i, phase in enumerate(transcription.phases):
        require(phase.duration is None, f"{phase.name}: a free duration needs another method", ModelError)
        blank = np.full((phase.n, len(system.outputs)), np.nan)
        data = measured.get(i, (blank, np.ones_like(blank)))
        parts.append(_cut_phase(i, phase, length, data, transcription))
    joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    t, h, inputs, y, noise, gather, linked, start, index, lengths = joined
    for i, phase in enumerate(transcription.phases[1:], 1):
        linked[np.flatnonzero(index == i)[0] - 1] = phase.follows
    nodes = np.concatenate([phase.nodes for phase in transcription.phases])
    heads, observable = np.flatnonzero(np.append(True, ~linked[:-1])), cache(partial(_observable_states, system))
    for head, stop in zip(heads, [*heads[1:], len(index)], strict=True):  # states that no log shows keep their guess
        guess = transcription.phases[index[head]].guess
        outputs = frozenset(o for r in transcription.residuals if r.phase in index[head:stop] for o in r.outputs)
        idle = ~observable(outputs) & np.isnan(start[head])
        start[head, idle] = 0.0 if guess is None else guess[nodes[head], idle]
    return Segments(transcription, t, h, inputs, y, noise, gather, linked, start, index, lengths)


def _cut_phase(
    index: int, phase: Phase, length: int, data: tuple[Array, Array], transcription: Transcription
) -> tuple[NDArray[Any], ...]:
    """One phase's segments, in the order of the fields of `Segments`."""
    measured, noise = data
    ends = np.append(phase.nodes[1:], phase.n)
    rows = phase.nodes[:, None] + np.arange(length)
    real = rows < ends[:, None]
    rows = np.minimum(rows, ends[:, None] - 1)
    m = len(phase.nodes)
    start = np.full((m, len(transcription.system.states)), np.nan)
    if phase.start is not None:
        start[0] = phase.start
    return (
        phase.t[rows],
        np.where(real, phase.h[rows], 0.0),
        phase.inputs[rows],
        np.where(real[:, :, None], measured[rows], np.nan),
        noise[rows],
        np.tile(transcription.parameter_positions(phase), (m, 1)),
        (np.arange(m) < m - 1) & ~np.isin(ends, phase.breaks),
        start,
        np.full(m, index),
        ends - phase.nodes,
    )


def _observable_states(system: DiscreteSystem, outputs: frozenset[str]) -> Mask:
    """The states on which these outputs depend, directly or through other states' rates. Shape (n_states,)."""
    if system.update is not None or not system.states:
        return np.ones(len(system.states), dtype=bool)
    slope, s = _state_rate(system)
    rows = [i for i, name in enumerate(names(system.outputs)) if name in outputs]
    measured = system.step(*s.values())[1][rows]
    reads, affected = (np.array(ca.DM(ca.jacobian_sparsity(f, s["x"]), 1)) > 0 for f in (slope, measured))
    affected = np.asarray(affected.any(axis=0))
    for _ in system.states:
        affected |= reads[affected].any(axis=0)
    return np.asarray(affected)


def start_nodes(segments: Segments) -> Array:
    """States at the nodes from the phases' guesses (zero without one), shape (m, n_states)."""
    states = len(segments.system.states)
    parts = []
    for phase in segments.transcription.phases:
        guess = np.zeros((phase.n, states)) if phase.guess is None else phase.guess
        parts.append(guess[phase.nodes])
    nodes = np.concatenate(parts)
    return np.where(np.isfinite(segments.fixed_start), segments.fixed_start, nodes)


def gap_scales(segments: Segments, kinematic: float) -> Array:
    """Factor on each state's gaps: `kinematic` where its rate holds no free parameter, else 1."""
    slope, symbols = _state_rate(segments.system)
    free = symbols["p"][segments.columns.tolist()]
    depends = [any(ca.which_depends(slope[i], free, 1, True)) for i in range(slope.numel())]
    return np.where(depends, 1.0, kinematic)


def choose_integration(
    segments: Segments, nodes: Array, values: Array, given: int | None = None
) -> tuple[Segments, int]:
    """Segments integrated by RK4, or implicitly in the state that makes RK4 slow; with steps (`given`) a sample."""
    state, steps = None, 1
    if nodes.shape[1]:
        jacobians = stiffness_jacobians(segments, nodes, values)
        steps = substeps_for(segments, largest_rate(jacobians), RK4_MAX_H_LAMBDA)
        if steps > STABILITY_RESERVE * (given or MIN_IMPLICIT_GAIN * MIN_IMPLICIT_SUBSTEPS / STABILITY_RESERVE):
            state, steps = _choose_implicit_state(segments, nodes, values, jacobians, steps)
    if state != segments.implicit_state:
        segments = segments.with_implicit_state(state)
    return segments, given or steps


def _choose_implicit_state(
    segments: Segments, nodes: Array, values: Array, jacobians: Array, steps: int
) -> tuple[int | None, int]:
    """The state whose own rate asks RK4 for so many steps, and the steps with it implicit; None if that is no gain."""
    if segments.system.pieces.ode is None:
        return None, steps
    state = int(np.argmin(np.einsum("kii->ki", jacobians).min(axis=0, initial=0.0)))
    reach = float(np.abs(nodes[:, state]).max())
    sizes = reach * np.geomspace(GROWTH_RANGE, 1.0, GROWTH_POINTS)
    if not 0 < reach < np.inf:
        return None, steps
    moving = stiffness_jacobians(segments, nodes, values, (state, np.concatenate([-sizes, sizes])))
    others = np.concatenate([jacobians, moving])
    growth = float(others[:, state, state].max(initial=0.0))
    others[:, state, state] = 0.0
    needed = max(
        MIN_IMPLICIT_SUBSTEPS,
        substeps_for(segments, largest_rate(others), PARTITIONED_MAX_H_LAMBDA),
        substeps_for(segments, growth, PARTITIONED_MAX_H_GROWTH),
    )
    return (state, needed) if steps >= MIN_IMPLICIT_GAIN * needed else (None, steps)


def fine_steps(segments: Segments, steps: int, refine: int) -> int:
    """The steps a sample that correct the residuals of coarse ones; those implicit in a state are of lower order."""
    return steps * refine * (1 if segments.implicit_state is None else IMPLICIT_REFINEMENT)


def stable_substeps(segments: Segments, nodes: Array, q: Array, step: float = 1.4) -> int:
    """Integration steps a sample that keep ``h |lambda| <= step`` along the start; RK4 is stable below 2.78."""
    return substeps_for(segments, largest_rate(stiffness_jacobians(segments, nodes, q)), step) if nodes.shape[1] else 1


def substeps_for(segments: Segments, rate: float, step: float) -> int:
    """Integration steps a sample that keep h times a rate [1/s] within `step`, `SUBSTEPS_CAP` at most."""
    return min(max(1, math.ceil(float(segments.h.max()) * rate / step)), SUBSTEPS_CAP)


def largest_rate(jacobians: Array) -> float:
    """The largest eigenvalue of matrices of shape (k, n, n), by its absolute value [1/s]."""
    return float(np.abs(np.linalg.eigvals(jacobians)).max(initial=0.0))


def stiffness_jacobians(segments: Segments, nodes: Array, q: Array, speeds: tuple[int, Array] | None = None) -> Array:
    """d(xdot)/dx (k, n, n) at nodes all along, at the extremes of every state and input, and at rest, if finite.

    With `speeds`, a state and values of it, that state has these values at each point in place of its own and of rest.
    """
    m, n = nodes.shape
    given = np.concatenate([nodes, segments.inputs[:, 0]], axis=1)
    even = np.linspace(0, m - 1, min(m, MAX_STIFFNESS_NODES)).astype(int)
    rows = np.unique(np.concatenate([even, given.argmin(axis=0), given.argmax(axis=0)]))
    # the regularised friction is stiffest at rest, which a node may just miss
    points = np.concatenate([nodes[rows], nodes[rows] * 0])
    if speeds is not None:
        points = np.tile(nodes[rows], (len(speeds[1]), 1))
        points[:, speeds[0]] = np.repeat(speeds[1], len(rows))
    p, u, t = (
        np.concatenate([a] * (len(points) // len(rows)))
        for a in (q[segments.parameter_positions[rows]], segments.inputs[rows, 0], segments.t[rows, 0])
    )
    J = (
        np.array(_rate_jacobian(segments.system).map(len(t))(t[None], points.T, u.T, p.T))
        .reshape(n, -1, n)
        .transpose(1, 0, 2)
    )
    return np.asarray(J[np.isfinite(J).all(axis=(1, 2))])


@functools.lru_cache(maxsize=64)
def _rate_jacobian(system: DiscreteSystem) -> ca.Function:
    """The Jacobian of the states' rates: ``(t, x, u, p) -> d(xdot)/dx``, shape (n_states, n_states)."""
    slope, s = _state_rate(system)
    return ca.Function("jacobian", [s["t"], s["x"], s["u"], s["p"]], [ca.densify(ca.jacobian(slope, s["x"]))])


@functools.lru_cache(maxsize=64)
def _state_rate(system: DiscreteSystem) -> tuple[ca.SX, dict[str, ca.SX]]:
    """The rate f(t, x, u, p) behind a step: d(x_next)/dh at h = 0, exact and with f's own sparsity; and its symbols."""
    symbols = {n: ca.SX.sym(n, system.step.size1_in(i)) for i, n in enumerate(("t", "h", "x", "u", "p"))}
    x_next = system.step(*symbols.values())[0]
    return ca.substitute(ca.jacobian(x_next, symbols["h"]), symbols["h"], ca.SX(0)), symbols
