"""Full-space multiple shooting with IPOPT: every node's state is an unknown, derivatives are exact. The reference path.

`prepare_full_space` makes the graph and its derivatives once; `solve_from` solves it from any start, `follow_path`
along a path.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.dynamics.system import names
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.graph import (
    ConstraintRows,
    Graph,
    flatten,
    node_guesses,
    parameter_scale,
    to_unknowns,
    to_values,
    variable_bounds,
)
from pneuopt.shooting.solution import Solution
from pneuopt.shooting.transcription import Transcription

# scalar operations up to which the whole graph is flattened to scalars: higher takes long to flatten, lower evaluates
# slowly
MAX_EXPANDED_OPERATIONS = 200_000
# barrier and distances from bounds [1] with which a solution's neighbour starts, in 9 iterations instead of 18: higher
# forgets the solution, lower starts on the bounds
WARM_START_BARRIER = 1e-5
# extrapolation along a path, in its last steps [1]: higher overshoots where the path bends, lower takes more iterations
MAX_EXTRAPOLATION = 1.5
_PUSH_OPTIONS = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")


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
class FullSpaceProblem:
    """A graph, its solver, and on request a second solver that starts from a neighbour's solution."""

    graph: Graph
    solver: ca.Function
    warm_solver: ca.Function | None = None


def solve_full_space(transcription: Transcription, method: FullSpace | None = None) -> Solution:
    """Solve a multiple-shooting problem with all nodes as unknowns.

    Parameters
    ----------
    transcription : Transcription
        Each phase starts from its `guess`, or from a simulation with the given parameters where it has none. The
        physical ranges of the states (`Quantity.lower`, `upper`) bound the nodes.
    method : FullSpace, optional

    Returns
    -------
    Solution
        Its status names the limit, state or equation at fault where the solver did not converge.
    """
    return solve_from(prepare_full_space(transcription, method), transcription.parameters)


def prepare_full_space(
    transcription: Transcription, method: FullSpace | None = None, *, warm_start: bool = False
) -> FullSpaceProblem:
    """Flatten and differentiate a problem once for any number of starts; with `warm_start` for `follow_path`, too."""
    graph, method = flatten(transcription), method or FullSpace()
    cold = _ipopt_solver(graph, method, {"mu_init": method.first_barrier})
    pushes = {f"warm_start_{n}": WARM_START_BARRIER for n in _PUSH_OPTIONS}
    near = {"mu_init": WARM_START_BARRIER, "warm_start_init_point": "yes", **pushes}
    return FullSpaceProblem(graph, cold, _ipopt_solver(graph, method, near) if warm_start else None)


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
    nlp: Any = {"x": graph.w, "p": graph.q, "f": ca.sum1(graph.terms), "g": graph.g}
    options: Any = {
        "print_time": False,
        "show_eval_warnings": False,
        "expand": _operation_count(graph.transcription) <= MAX_EXPANDED_OPERATIONS,
        "ipopt": ipopt,
    }
    return ca.nlpsol("full_space", "ipopt", nlp, options)


def solve_from(problem: FullSpaceProblem, start: ParameterSet, guesses: Sequence[Array | None] = ()) -> Solution:
    """Solve a prepared problem from the given parameters.

    Parameters
    ----------
    problem : FullSpaceProblem
    start : ParameterSet
        Names as in the problem; the values may differ, those of the fixed ones too.
    guesses : sequence of ndarray, shape (n, n_states), optional
        States to start from, one a phase, in place of the phases' own.

    Returns
    -------
    Solution
    """
    transcription = problem.graph.transcription
    require(tuple(start) == tuple(transcription.parameters), "the start's names are not the problem's", ModelError)
    q = np.array([p.value for p in start.values()])
    low, up = variable_bounds(transcription)
    nodes = node_guesses(transcription, q, guesses)
    w = np.clip(np.concatenate([to_unknowns(transcription, q), *nodes]), low, up)
    fault = _find_nan(problem, w, q)
    if fault:
        return _solution(problem, w, q, Status(Code.DIVERGED, (f"at the start {fault}", "start elsewhere")), {}, {})
    return _run_solver(problem, w, q)[0]


def follow_path(problem: FullSpaceProblem, start: ParameterSet, path: Sequence[Mapping[str, float]]) -> list[Solution]:
    """Solve along a path of fixed parameters, each problem from its neighbours' solutions, carried on along the path.

    Parameters
    ----------
    problem : FullSpaceProblem
        One made by ``prepare_full_space(..., warm_start=True)``.
    start : ParameterSet
        Parameters that start the first problem; names as in the problem.
    path : sequence of mapping of str to float
        Values of fixed parameters.

    Returns
    -------
    list of Solution
        One a step; a step that fails starts the next one from the last that did not.
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
            last = done[-1][1]
            w = np.clip(_extrapolate(done[-2:], q), low, up)
            solution, raw = _run_solver(warm, w, q, {"lam_x0": last["lam_x"], "lam_g0": last["lam_g"]})
        done += [(q, raw)] if solution.status.converged else []
        found.append(solution)
    return found


def _extrapolate(done: Sequence[tuple[Array, Mapping[str, Array]]], q: Array) -> Array:
    """The unknowns at q, extrapolated from the last two solutions along the difference of their parameters."""
    (before, x), (last, y) = ((known, raw["x"]) for known, raw in (done[0], done[-1]))
    step = last - before
    length = float(step @ step)
    share = min(max(float(step @ (q - last)) / length, 0.0), MAX_EXTRAPOLATION) if length else 0.0
    return np.asarray(y + share * (y - x))


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
    stats = problem.solver.stats()
    figures = {
        "iterations": float(stats.get("iter_count", 0)),
        "seconds": time.perf_counter() - begun,
        "cost": float(found["f"][0]),
        "largest_gap": _largest_violation(problem, found["g"], continuity=True),
        "largest_violation": _largest_violation(problem, found["g"], continuity=False),
    }
    status = _solver_status(problem, str(stats["return_status"]), found, q, figures)
    return _solution(problem, found["x"], q, status, figures, _multipliers(problem, found, low, up)), found


def _operation_count(transcription: Transcription) -> int:
    """Estimated scalar operations of one evaluation."""
    samples = sum(phase.n for phase in transcription.phases)
    return int(samples * transcription.system.substeps * transcription.system.step.n_instructions())


# The solver's outcome as a status.


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


def _largest_violation(problem: FullSpaceProblem, g: Array, continuity: bool) -> float:
    pieces = [
        float(np.max(_row_violation(r, g), initial=0.0))
        for r in problem.graph.constraint_rows
        if r.continuity is continuity
    ]
    return max(pieces, default=0.0)


def _describe_worst_row(problem: FullSpaceProblem, g: Array) -> str:
    """A sentence on the constraint that is violated most, relative to the size of its bound."""
    table = [r for r in problem.graph.constraint_rows if r.rows.stop > r.rows.start]
    if not table:
        return "there are no limits"
    relative = [float(np.max(_row_violation(r, g) / _limit_size(r))) for r in table]
    rows = table[int(np.argmax(relative))]
    if max(relative) < 1e-6:
        return "no limit is violated"
    k = int(np.argmax(_row_violation(rows, g)))
    allowed = _format_range(rows.lower[k], rows.upper[k])
    return f"worst is {_row_title(problem, rows, k)}: {g[rows.rows][k]:.6g}, allowed {allowed}"


def _limit_size(rows: ConstraintRows) -> Array:
    finite = [np.where(np.isfinite(side), np.abs(side), 0.0) for side in (rows.lower, rows.upper)]
    return np.maximum(*finite) + 1e-3


def _format_range(lower: float, upper: float) -> str:
    return f"{lower:.6g}" if lower == upper else f"{lower:.6g} to {upper:.6g}"


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


def _solution(
    problem: FullSpaceProblem,
    w: Array,
    q: Array,
    status: Status,
    figures: Mapping[str, float],
    multipliers: Mapping[str, float],
) -> Solution:
    transcription = problem.graph.transcription
    columns = (*names(transcription.system.states), *names(transcription.system.outputs))
    trajectories = []
    for rollout in problem.graph.rollouts:
        t, x, y = (np.array(v) for v in rollout(w, q))
        trajectories.append(Trajectory(t.ravel(), dict(zip(columns, (*x, *y), strict=True))))
    given = dict(zip(transcription.parameters, q.tolist(), strict=True))
    parameters = transcription.parameters.with_values({**given, **to_values(transcription, w)})
    return Solution(tuple(trajectories), parameters, status, figures, multipliers)
