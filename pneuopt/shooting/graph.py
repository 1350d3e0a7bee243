"""A `Transcription` as one MX graph of unknowns, objective and constraints, for full-space solvers.

The unknowns are the free parameters, in units of their range or as logarithms, and the states at the nodes, in units
of their nominal size.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter
from pneuopt.shooting.transcription import Cost, Limit, Phase, Residuals, Transcription, Where, phases_of

ArrayOrMX = TypeVar("ArrayOrMX", NDArray[np.float64], ca.MX)
# integration steps up to which a segment is flattened to scalars, which evaluate faster: higher takes long to flatten
MAX_EXPANDED_STEPS = 400


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """A named piece of the constraints g: continuity at the nodes of a phase, or a limit."""

    name: str
    phase: str
    rows: slice
    lower: Array
    upper: Array
    continuity: bool = False


@dataclass(frozen=True, eq=False)
class Graph:
    """Minimise the sum of `terms` (of w and q) subject to lower <= g(w, q) <= upper; `constraint_rows` names the rows.

    Attributes
    ----------
    transcription : Transcription
    w, q, terms, g : casadi.MX
        Unknowns, given parameter values, pieces of the objective, constraints.
    evaluate : casadi.Function
        ``(w, q) -> (terms, g)``.
    rollouts : tuple of casadi.Function
        ``(w, q) -> (t, states, outputs)`` at the samples, one a phase.
    constraint_rows : tuple of ConstraintRows
    term_names : tuple of str
        The name of each term.
    """

    transcription: Transcription
    w: ca.MX
    q: ca.MX
    terms: ca.MX
    g: ca.MX
    evaluate: ca.Function
    rollouts: tuple[ca.Function, ...]
    constraint_rows: tuple[ConstraintRows, ...]
    term_names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _PhaseGraph:
    """One phase in symbols: columns are samples, or segments for `nodes` and `ends`."""

    phase: Phase
    p: ca.MX
    t: ca.MX
    h: ca.MX
    u: ca.DM
    nodes: ca.MX
    ends: ca.MX
    states: ca.MX
    outputs: ca.MX


def flatten(transcription: Transcription) -> Graph:
    """Write a multiple-shooting problem as one graph."""
    system, phases = transcription.system, transcription.phases
    given = ca.MX.sym("q", len(transcription.parameters))
    theta = ca.MX.sym("theta", len(transcription.free))
    scaled = [ca.MX.sym(f"x{i}", len(system.states), len(phase.nodes)) for i, phase in enumerate(phases)]
    q = _physical_values(transcription, given, theta)
    nominal = np.array([s.nominal for s in system.states])
    runs = [_build_phase(transcription, phase, x * nominal, q) for phase, x in zip(phases, scaled, strict=True)]
    table, rows = _constraints(transcription, runs, q)
    costs, pieces = _objective(transcription, runs, q)
    w, parts, g = ca.vertcat(theta, *map(ca.vec, scaled)), ca.vertcat(0, *pieces), ca.vertcat(ca.MX(0, 1), *rows)
    evaluate = ca.Function("evaluate", [w, given], [parts, g])
    rollouts = tuple(ca.Function("rollout", [w, given], [run.t, run.states, run.outputs]) for run in runs)
    return Graph(transcription, w, given, parts, g, evaluate, rollouts, table, ("nothing", *costs))


# The unknowns: the free parameters first, then the nodes, phase by phase.


def parameter_scale(parameter: Parameter) -> float:
    """The unit in which the solver measures a parameter: its range, or its size."""
    span = parameter.upper - parameter.lower
    return span if 0 < span < math.inf else abs(parameter.value) or 1.0


def _physical_values(transcription: Transcription, given: ca.MX, theta: ca.MX) -> ca.MX:
    q = ca.vertsplit(given)
    for k, i in enumerate(transcription.free):
        parameter = list(transcription.parameters.values())[i]
        q[i] = ca.exp(theta[k]) if parameter.log else theta[k] * parameter_scale(parameter)
    return ca.vertcat(*q)


def to_unknowns(transcription: Transcription, q: Array) -> Array:
    """The free parameters in the solver's units."""
    parameters = list(transcription.parameters.values())
    return np.array([_to_unknown(parameters[i], q[i]) for i in transcription.free])


def to_values(transcription: Transcription, w: Array) -> dict[str, float]:
    """The free parameters' values, by name, inside their bounds."""
    found = {}
    for k, name in enumerate(transcription.parameters.free_names):
        parameter = transcription.parameters[name]
        value = math.exp(w[k]) if parameter.log else w[k] * parameter_scale(parameter)
        found[name] = min(max(value, parameter.lower), parameter.upper)
    return found


def _to_unknown(parameter: Parameter, value: float) -> float:
    if not parameter.log:
        return value / parameter_scale(parameter)
    return math.log(value) if value > 0 else -math.inf


def variable_bounds(transcription: Transcription) -> tuple[Array, Array]:
    """Bounds of the unknowns; a known start state is pinned."""
    free = [list(transcription.parameters.values())[i] for i in transcription.free]
    bounds = [np.array([[_to_unknown(p, p.lower), _to_unknown(p, p.upper)] for p in free]).reshape(-1, 2)]
    states = transcription.system.states
    for phase in transcription.phases:
        nodes = np.tile([[s.lower / s.nominal, s.upper / s.nominal] for s in states], (len(phase.nodes), 1))
        if phase.start is not None:
            nodes[: len(states)] = np.array([[x / s.nominal] for x, s in zip(phase.start, states, strict=True)])
        bounds.append(nodes)
    low, up = np.concatenate(bounds).T
    return low, up


def node_guesses(transcription: Transcription, q: Array, guesses: Sequence[Array | None] = ()) -> list[Array]:
    """The nodes' scaled states to start from: `guesses`, the phases' own, or a simulation."""
    nominal = np.array([s.nominal for s in transcription.system.states])
    x, found = np.zeros(len(nominal)), []
    for i, phase in enumerate(transcription.phases):
        guess = guesses[i] if i < len(guesses) else phase.guess
        x = x if phase.follows else np.zeros(len(nominal)) if phase.start is None else phase.start
        if guess is None:
            guess, x = _simulate_guess(transcription, phase, q, x, 1e3 * nominal)
        else:
            x = guess[-1]
        found.append((guess[phase.nodes] / nominal).ravel())
    return found


def _simulate_guess(transcription: Transcription, phase: Phase, q: Array, x: Array, most: Array) -> tuple[Array, Array]:
    """States at the samples, and after the last; a state that runs away is held where it is."""
    sample = _sample_function(transcription)
    length = _duration(transcription, phase, q)
    p, states = q[transcription.parameter_positions(phase)], np.empty((phase.n, len(x)))
    for k in range(phase.n):
        states[k] = x
        x_next = np.array(sample(phase.t[k] * length, phase.h[k] * length, x, phase.inputs[k], p)[0]).ravel()
        x = x_next if bool(np.all(np.abs(x_next) < most)) else x
    return states, x


# The graph of one phase.


def _build_phase(transcription: Transcription, phase: Phase, nodes: ca.MX, q: ca.MX) -> _PhaseGraph:
    require(not phase.breaks.size, f"{phase.name}: a phase with breaks needs another method", ModelError)
    length = _duration(transcription, phase, q)
    t, h, u = ca.MX(ca.DM(phase.t).T) * length, ca.MX(ca.DM(phase.h).T) * length, ca.DM(phase.inputs).T
    p = q[transcription.parameter_positions(phase).tolist()]
    lengths = np.diff([*phase.nodes, phase.n])
    pieces = []
    cuts = [0, *(np.flatnonzero(np.diff(lengths)) + 1).tolist(), len(lengths)]
    for first, last in itertools.pairwise(cuts):  # runs of segments of equal length
        count, begin = last - first, int(phase.nodes[first])
        end = begin + count * int(lengths[first])
        segment = _segment_function(transcription, int(lengths[first])).map(count)
        pieces.append(
            segment(t[begin:end], h[begin:end], nodes[:, first:last], u[:, begin:end], ca.repmat(p, 1, count))
        )
    ends, states, outputs = (ca.horzcat(*part) for part in zip(*pieces, strict=True))
    return _PhaseGraph(phase, p, t, h, u, nodes, ends, states, outputs)


def _segment_function(transcription: Transcription, samples: int) -> ca.Function:
    system, sample = transcription.system, _sample_function(transcription)
    n = {k: sample.size1_in(i) for i, k in enumerate("thxup")}
    t, h, u = ca.MX.sym("t", 1, samples), ca.MX.sym("h", 1, samples), ca.MX.sym("u", n["u"], samples)
    x, p = ca.MX.sym("x", n["x"]), ca.MX.sym("p", n["p"])
    states, outputs, x_k = [], [], x
    for k in range(samples):
        states.append(x_k)
        x_k, y = sample(t[k], h[k], x_k, u[:, k], p)
        outputs.append(y)
    segment = ca.Function("segment", [t, h, x, u, p], [x_k, ca.horzcat(*states), ca.horzcat(*outputs)])
    return segment.expand() if samples * system.substeps <= MAX_EXPANDED_STEPS else segment


def _sample_function(transcription: Transcription) -> ca.Function:
    step = transcription.system.step
    arguments = [ca.MX.sym(k, step.size1_in(i)) for i, k in enumerate("thxup")]
    return ca.Function("sample", arguments, list(transcription.system.advance_sample(*arguments)))


def _duration(transcription: Transcription, phase: Phase, q: ArrayOrMX) -> ArrayOrMX | float:
    return 1.0 if phase.duration is None else q[list(transcription.parameters).index(phase.duration)]


def _constraints(
    transcription: Transcription, runs: Sequence[_PhaseGraph], q: ca.MX
) -> tuple[tuple[ConstraintRows, ...], list[ca.MX]]:
    nominal = np.array([s.nominal for s in transcription.system.states])
    found: list[tuple[str, str, ca.MX, float, float, bool]] = []
    for i, run in enumerate(runs):
        before = [runs[i - 1].ends[:, -1]] if run.phase.follows else []
        first = 0 if run.phase.follows else 1
        gaps = ca.horzcat(*before, run.ends[:, :-1]) - run.nodes[:, first:]
        if gaps.size2():
            found.append(("continuity", run.phase.name, gaps / nominal, 0.0, 0.0, True))
    for limit in transcription.limits:
        for phase, value in _term_values(limit, transcription, runs, q):
            found.append((limit.name, phase, value, limit.lower, limit.upper, False))
    table, begin = [], 0
    for name, phase, value, lower, upper, continuity in found:
        n = value.numel()
        rows = slice(begin, begin + n)
        table.append(ConstraintRows(name, phase, rows, np.full(n, lower), np.full(n, upper), continuity))
        begin += n
    return tuple(table), [ca.vec(piece[2]) for piece in found]


def _objective(
    transcription: Transcription, runs: Sequence[_PhaseGraph], q: ca.MX
) -> tuple[tuple[str, ...], list[ca.MX]]:
    parts: dict[str, ca.MX] = {}
    for residual in transcription.residuals:
        run = runs[residual.phase]
        for k, name in enumerate(residual.outputs):
            parts[f"the residual of {name!r} in phase {run.phase.name!r}"] = _residual_cost(
                transcription, residual, run, k
            )
    for cost in transcription.costs:
        for phase, value in _term_values(cost, transcription, runs, q):
            where = f" in phase {phase!r}" if phase else ""
            parts[f"the cost {cost.name!r}{where}"] = cost.weight * ca.sum1(ca.vec(value))
    return tuple(parts), list(parts.values())


def _residual_cost(transcription: Transcription, residual: Residuals, run: _PhaseGraph, k: int) -> ca.MX:
    seen = np.flatnonzero(np.isfinite(residual.measured[:, k])).tolist()
    y = run.outputs[names(transcription.system.outputs).index(residual.outputs[k]), seen]
    return 0.5 * ca.sumsqr((y - ca.DM(residual.measured[seen, k]).T) / float(residual.noise[k]))


def _term_values(
    term: Cost | Limit, transcription: Transcription, runs: Sequence[_PhaseGraph], q: ca.MX
) -> list[tuple[str, ca.MX]]:
    """The values of a term wherever it holds, with the phase's name."""
    if term.where is Where.PARAMETERS:
        return [("", term.function(q))]
    return [(runs[i].phase.name, _phase_values(term, runs[i])) for i in phases_of(term, transcription)]


def _phase_values(term: Cost | Limit, run: _PhaseGraph) -> ca.MX:
    if term.where is Where.END:
        return term.function(run.t[-1] + run.h[-1], run.ends[:, -1], run.u[:, -1], run.p)
    nodes = run.phase.nodes.tolist() if term.where is Where.NODES else [0]
    n = len(nodes)
    return term.function.map(n)(run.t[nodes], run.nodes[:, :n], run.u[:, nodes], ca.repmat(run.p, 1, n))
