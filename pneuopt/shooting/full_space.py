"""Full-space multiple shooting with IPOPT: every node's state is an unknown, derivatives are exact. The reference path.

The unknowns are the free parameters, in units of their range or as logarithms, and the states at the nodes, in units
of their nominal size; a transcription becomes one MX graph of unknowns, objective and constraints.
"""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.tolerances import (
    MAX_EXPANDED_OPERATIONS,
    MAX_EXPANDED_STEPS,
    MAX_EXTRAPOLATION,
    WARM_START_BARRIER,
)
from pneuopt.shooting.transcription import Cost, Limit, Phase, Transcription, Where, phases_of


@dataclass(frozen=True)
class FullSpace:
    """Full-space multiple shooting with IPOPT and exact second derivatives.

    Parameters
    ----------
    max_iterations : int
    tolerance : float
        IPOPT's `tol`, on the scaled problem.
    max_seconds : float
        Wall time after which the solver gives up [s].
    first_barrier : float
        IPOPT's `mu_init`: how far from the limits the first iterates keep.
    verbose : bool
        Print IPOPT's own table.
    """

    max_iterations: int = 500
    tolerance: float = 1e-8
    max_seconds: float = 3600.0
    first_barrier: float = 0.1
    verbose: bool = False

    def __post_init__(self) -> None:
        require(self.max_iterations >= 1, f"max_iterations must be at least 1, got {self.max_iterations}")
        require(0 < self.tolerance < 1, f"tolerance must lie between 0 and 1, got {self.tolerance}")
        require(self.first_barrier > 0, f"first_barrier must be positive, got {self.first_barrier}")
        require(self.max_seconds > 0, f"max_seconds must be positive, got {self.max_seconds}")


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution of a problem with costs and limits; cost NaN and violation inf: the solver could not start."""

    trajectories: tuple[Trajectory, ...]  # states and outputs, one a phase
    parameters: ParameterSet  # the problem's parameters with the free ones solved for
    status: Status
    cost: float = math.nan
    largest_violation: float = math.inf
    seconds: float = 0.0  # wall time [s]
    stats: Mapping[str, float] = field(default_factory=dict)  # iterations and largest gap
    multipliers: Mapping[str, float] = field(default_factory=dict)  # largest of each active limit and bound


def solve_full_space(transcription: Transcription, method: FullSpace | None = None) -> Solution:
    """Solve a problem with all nodes as unknowns, from each phase's guess or, where it has none, from a simulation.

    The physical ranges of the states bound the nodes. The status names the limit, state or equation at fault.
    """
    return solve_from(prepare_full_space(transcription, method), transcription.parameters)


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
    """Minimise the sum of `terms` (of w and q) subject to lower <= g(w, q) <= upper, the rows of `constraint_rows`."""

    transcription: Transcription
    # w, q, terms, g: unknowns, given parameter values, pieces of the objective, constraints
    w: ca.MX
    q: ca.MX
    terms: ca.MX
    g: ca.MX
    evaluate: ca.Function  # ``(w, q) -> (terms, g)``
    rollouts: tuple[ca.Function, ...]  # ``(w, q) -> (t, states, outputs)`` at the samples, one a phase
    constraint_rows: tuple[ConstraintRows, ...]
    term_names: tuple[str, ...]  # the name of each term


@dataclass(frozen=True, eq=False)
class FullSpaceProblem:
    """A graph, its solver, and on request a second solver that starts from a neighbour's solution."""

    graph: Graph
    solver: ca.Function
    warm_solver: ca.Function | None = None


def prepare_full_space(
    transcription: Transcription, method: FullSpace | None = None, *, warm_start: bool = False
) -> FullSpaceProblem:
    """Flatten and differentiate a problem once for any number of starts; with `warm_start` for `follow_path`, too."""
    graph, method = flatten(transcription), method or FullSpace()
    cold = _ipopt_solver(graph, method, {"mu_init": method.first_barrier})
    pushes = {f"warm_start_{n}": WARM_START_BARRIER for n in _PUSH_OPTIONS}
    near = {"mu_init": WARM_START_BARRIER, "warm_start_init_point": "yes", **pushes}
    return FullSpaceProblem(graph, cold, _ipopt_solver(graph, method, near) if warm_start else None)


_PUSH_OPTIONS = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")


def _ipopt_solver(graph: Graph, method: FullSpace, own: Mapping[str, Any]) -> ca.Function:
    ipopt = {
        "print_level": 5 if method.verbose else 0,
        "sb": "yes",
        "max_iter": method.max_iterations,
        "tol": method.tolerance,
        "acceptable_iter": 0,
        "max_wall_time": method.max_seconds,
        **own,
    }
    system, samples = graph.transcription.system, sum(phase.n for phase in graph.transcription.phases)
    operations = samples * system.substeps * system.step.n_instructions()
    nlp: Any = {"x": graph.w, "p": graph.q, "f": ca.sum1(graph.terms), "g": graph.g}
    options: Any = {
        "print_time": False,
        "show_eval_warnings": False,
        "expand": operations <= MAX_EXPANDED_OPERATIONS,
        "ipopt": ipopt,
    }
    return ca.nlpsol("full_space", "ipopt", nlp, options)


def solve_from(problem: FullSpaceProblem, start: ParameterSet, guesses: Sequence[Array | None] = ()) -> Solution:
    """Solve a prepared problem from these parameters, and from `guesses` (n, n_states) in place of the phases' own."""
    transcription = problem.graph.transcription
    require(tuple(start) == tuple(transcription.parameters), "the start's names are not the problem's", ModelError)
    q = np.array([p.value for p in start.values()])
    low, up = variable_bounds(transcription)
    nodes = node_guesses(transcription, q, guesses)
    w = np.clip(np.concatenate([to_unknowns(transcription, q), *nodes]), low, up)
    fault = _find_nan(problem, w, q)
    if fault:
        return _solution(problem, w, q, Status(Code.DIVERGED, (f"at the start {fault}", "start elsewhere")))
    return _run_solver(problem, w, q)[0]


def follow_path(problem: FullSpaceProblem, start: ParameterSet, path: Sequence[Mapping[str, float]]) -> list[Solution]:
    """Solve along a path of fixed parameters' values, each problem from its neighbours' solutions, extrapolated.

    The problem is prepared with `warm_start`. A step that fails starts the next one from the last that did not.
    """
    if problem.warm_solver is None:
        raise ModelError("the problem has no warm-start solver: prepare_full_space(..., warm_start=True)")
    transcription, warm = problem.graph.transcription, replace(problem, solver=problem.warm_solver)
    (low, up), found, done = variable_bounds(transcription), list[Solution](), list[tuple[Array, dict[str, Array]]]()
    for step in path:
        q = np.array([p.value for p in start.with_values(step).values()])
        if not done:
            w = np.clip(np.concatenate([to_unknowns(transcription, q), *node_guesses(transcription, q, ())]), low, up)
            solution, raw = _run_solver(problem, w, q)
        else:
            # extrapolated from the last two solutions along the difference of their parameters
            (before, earlier), (there, last) = done[-2:][0], done[-1]
            way = there - before
            length = float(way @ way)
            share = min(max(float(way @ (q - there)) / length, 0.0), MAX_EXTRAPOLATION) if length else 0.0
            w = np.clip(last["x"] + share * (last["x"] - earlier["x"]), low, up)
            solution, raw = _run_solver(warm, w, q, {"lam_x0": last["lam_x"], "lam_g0": last["lam_g"]})
        done += [(q, raw)] if solution.status.converged else []
        found.append(solution)
    return found


def _run_solver(
    problem: FullSpaceProblem, w: Array, q: Array, multipliers: Mapping[str, Array] | None = None
) -> tuple[Solution, dict[str, Array]]:
    """Run the solver: the solution, and the solver's raw output."""
    begun, (low, up) = time.perf_counter(), variable_bounds(problem.graph.transcription)
    low_g, up_g = (
        np.concatenate([np.zeros(0), *(getattr(r, s) for r in problem.graph.constraint_rows)])
        for s in ("lower", "upper")
    )
    raw = problem.solver(x0=w, p=q, lbx=low, ubx=up, lbg=low_g, ubg=up_g, **(multipliers or {}))
    found = {k: np.array(v).ravel() for k, v in raw.items()}
    ended, seconds = problem.solver.stats(), time.perf_counter() - begun
    gap, violation = (
        max((float(np.max(_row_violation(r, found["g"]), initial=0.0)) for r in rows), default=0.0)
        for rows in ([r for r in problem.graph.constraint_rows if r.continuity is each] for each in (True, False))
    )
    stats = {"iterations": float(ended.get("iter_count", 0)), "largest_gap": gap}
    status = _solver_status(problem, str(ended["return_status"]), found, q, {**stats, "seconds": seconds})
    solution = _solution(problem, found["x"], q, status)
    figures: Any = {"cost": float(found["f"][0]), "largest_violation": violation, "seconds": seconds, "stats": stats}
    return replace(solution, **figures, multipliers=_multipliers(problem, found, low, up)), found


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
    entries = ca.vertsplit(given)
    for k, i in enumerate(transcription.free):
        parameter = list(transcription.parameters.values())[i]
        entries[i] = ca.exp(theta[k]) if parameter.log else theta[k] * parameter_scale(parameter)
    q = ca.vertcat(*entries)
    nominal = np.array([s.nominal for s in system.states])
    runs = [_build_phase(transcription, phase, x * nominal, q) for phase, x in zip(phases, scaled, strict=True)]
    table, rows = _constraints(transcription, runs, q)
    costs, pieces = _objective(transcription, runs, q)
    w, parts, g = ca.vertcat(theta, *map(ca.vec, scaled)), ca.vertcat(0, *pieces), ca.vertcat(ca.MX(0, 1), *rows)
    evaluate = ca.Function("evaluate", [w, given], [parts, g])
    rollouts = tuple(ca.Function("rollout", [w, given], [run.t, run.states, run.outputs]) for run in runs)
    return Graph(transcription, w, given, parts, g, evaluate, rollouts, table, ("nothing", *costs))


ArrayOrMX = TypeVar("ArrayOrMX", NDArray[np.float64], ca.MX)


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
            seen = np.flatnonzero(np.isfinite(residual.measured[:, k])).tolist()
            y = run.outputs[names(transcription.system.outputs).index(residual.outputs[k]), seen]
            parts[f"the residual of {name!r} in phase {run.phase.name!r}"] = 0.5 * ca.sumsqr(
                (y - ca.DM(residual.measured[seen, k]).T) / float(residual.noise[k])
            )
    for cost in transcription.costs:
        for phase, value in _term_values(cost, transcription, runs, q):
            where = f" in phase {phase!r}" if phase else ""
            parts[f"the cost {cost.name!r}{where}"] = cost.weight * ca.sum1(ca.vec(value))
    return tuple(parts), list(parts.values())


def _term_values(
    term: Cost | Limit, transcription: Transcription, runs: Sequence[_PhaseGraph], q: ca.MX
) -> list[tuple[str, ca.MX]]:
    """The values of a term wherever it holds, with the phase's name."""
    if term.where is Where.PARAMETERS:
        return [("", term.function(q))]
    found = []
    for run in (runs[i] for i in phases_of(term, transcription)):
        if term.where is Where.END:
            value = term.function(run.t[-1] + run.h[-1], run.ends[:, -1], run.u[:, -1], run.p)
        else:
            nodes = run.phase.nodes.tolist() if term.where is Where.NODES else [0]
            n = len(nodes)
            value = term.function.map(n)(run.t[nodes], run.nodes[:, :n], run.u[:, nodes], ca.repmat(run.p, 1, n))
        found.append((run.phase.name, value))
    return found


def parameter_scale(parameter: Parameter) -> float:
    """The unit in which the solver measures a parameter: its range, or its size."""
    span = parameter.upper - parameter.lower
    return span if 0 < span < math.inf else abs(parameter.value) or 1.0


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
            sample, length = _sample_function(transcription), _duration(transcription, phase, q)
            p, guess = q[transcription.parameter_positions(phase)], np.empty((phase.n, len(x)))
            for k in range(phase.n):
                guess[k] = x
                after = np.array(sample(phase.t[k] * length, phase.h[k] * length, x, phase.inputs[k], p)[0]).ravel()
                x = after if bool(np.all(np.abs(after) < 1e3 * nominal)) else x  # one that runs away stays where it is
        else:
            x = guess[-1]
        found.append((guess[phase.nodes] / nominal).ravel())
    return found


def _solver_status(
    problem: FullSpaceProblem, ended: str, found: Mapping[str, Array], q: Array, figures: Mapping[str, float]
) -> Status:
    worst = _describe_worst_row(problem, found["g"])
    taken = f"after {figures['iterations']:.0f} iterations and {figures['seconds']:.2f} s"
    if ended == "Solve_Succeeded" and bool(np.all(np.isfinite(found["x"]))):
        gap = f"{figures['largest_gap']:.1e} of the states' nominal size"
        return Status(Code.CONVERGED, (f"{taken}, largest gap {gap}",))
    if ended in {"Infeasible_Problem_Detected", "Restoration_Failed"}:
        return Status(Code.INFEASIBLE, (taken, worst, "relax this limit or widen the parameters' bounds"))
    if ended in {"Maximum_Iterations_Exceeded", "Maximum_WallTime_Exceeded"}:
        return Status(Code.ITERATION_LIMIT, (taken, worst, "start nearer or allow more"))
    if ended in {"Invalid_Number_Detected", "Diverging_Iterates"}:
        fault = _find_nan(problem, found["x"], q) or f"the iterates diverge, {worst}"
        return Status(Code.DIVERGED, (taken, fault, "bound the parameters or refine the integration"))
    if ended == "User_Requested_Stop":
        return Status(Code.INTERRUPTED, (taken,))
    return Status(Code.NOT_CONVERGED, (f"IPOPT ended with {ended} {taken}", worst, "rescale or start elsewhere"))


def _row_violation(rows: ConstraintRows, g: Array) -> Array:
    values = g[rows.rows]
    return np.maximum(np.maximum(rows.lower - values, values - rows.upper), 0.0)


def _describe_worst_row(problem: FullSpaceProblem, g: Array) -> str:
    """A sentence on the constraint that is violated most, relative to the size of its bound."""
    table = [r for r in problem.graph.constraint_rows if r.rows.stop > r.rows.start]
    if not table:
        return "there are no limits"
    finite = ([np.where(np.isfinite(side), np.abs(side), 0.0) for side in (r.lower, r.upper)] for r in table)
    relative = [
        float(np.max(_row_violation(r, g) / (np.maximum(*f) + 1e-3))) for r, f in zip(table, finite, strict=True)
    ]
    rows = table[int(np.argmax(relative))]
    if max(relative) < 1e-6:
        return "no limit is violated"
    k = int(np.argmax(_row_violation(rows, g)))
    lower, upper = rows.lower[k], rows.upper[k]
    allowed = f"{lower:.6g}" if lower == upper else f"{lower:.6g} to {upper:.6g}"
    return f"worst is {_row_title(problem, rows, k)}: {g[rows.rows][k]:.6g}, allowed {allowed}"


def _row_title(problem: FullSpaceProblem, rows: ConstraintRows, k: int) -> str:
    if not rows.continuity:
        return f"limit {rows.name!r}" + (f" in phase {rows.phase!r}" if rows.phase else "")
    states = problem.graph.transcription.system.states
    return f"the continuity of state {states[k % len(states)].name!r} in phase {rows.phase!r}"


def _find_nan(problem: FullSpaceProblem, w: Array, q: Array) -> str:
    """A sentence on the first equation that is not a number; empty if all are finite."""
    f, g = (np.array(v).ravel() for v in problem.graph.evaluate(w, q))
    for name, value in zip(problem.graph.term_names, f, strict=False):
        if not math.isfinite(value):
            return f"{name} is {value}"
    jacobian = np.array(problem.solver.get_function("nlp_jac_g")(w, q)[1])
    for rows in problem.graph.constraint_rows:
        bad = ~np.isfinite(g[rows.rows]) | ~np.isfinite(jacobian[rows.rows]).all(axis=1)
        if bad.any():
            return f"{_row_title(problem, rows, int(np.argmax(bad)))} or its derivative is not a number"
    return ""


def _multipliers(problem: FullSpaceProblem, found: Mapping[str, Array], low: Array, up: Array) -> dict[str, float]:
    """Multipliers of active limits and bounds: those that exceed their slack."""
    transcription, active = problem.graph.transcription, dict[str, float]()

    def keep_active(name: str, multiplier: Array, slack: Array, unit: float = 1.0) -> None:
        held = np.abs(multiplier) > np.maximum(slack, 1e-8)
        if held.any():
            active[name] = max(active.get(name, 0.0), float(np.max(np.abs(multiplier[held]))) / unit)

    slack, multiplier = np.minimum(found["x"] - low, up - found["x"]), np.where(low < up, found["lam_x"], 0.0)
    values = to_values(transcription, found["x"])
    for k, (name, value) in enumerate(values.items()):
        parameter = transcription.parameters[name]
        keep_active(name, multiplier[[k]], slack[[k]], value if parameter.log else parameter_scale(parameter))
    n_states = len(transcription.system.states)
    for j, state in enumerate(transcription.system.states):
        nodes = slice(len(values) + j, None, n_states)
        keep_active(state.name, multiplier[nodes], slack[nodes], state.nominal)
    for rows in problem.graph.constraint_rows:
        if not rows.continuity:
            room = np.minimum(found["g"][rows.rows] - rows.lower, rows.upper - found["g"][rows.rows])
            keep_active(rows.name, found["lam_g"][rows.rows], room)
    return active


def _solution(problem: FullSpaceProblem, w: Array, q: Array, status: Status) -> Solution:
    transcription = problem.graph.transcription
    columns = (*names(transcription.system.states), *names(transcription.system.outputs))
    trajectories = []
    for rollout in problem.graph.rollouts:
        t, x, y = (np.array(v) for v in rollout(w, q))
        trajectories.append(Trajectory(t.ravel(), dict(zip(columns, (*x, *y), strict=True))))
    given = dict(zip(transcription.parameters, q.tolist(), strict=True))
    parameters = transcription.parameters.with_values({**given, **to_values(transcription, w)})
    return Solution(tuple(trajectories), parameters, status)
