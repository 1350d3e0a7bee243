"""`TwoPhase`: exact tuning of a linear loop; its settling time is a free duration of a multiple-shooting problem.

Phase "transient" is [0, Ts] with Ts unknown, phase "settled" the rest, where |y - r| <= band is a path limit; so the
settling time is a smooth function of the gains. Each further term of the objective (the overshoot and so on) is one
more unknown, which its path limit may not exceed. Fast dither leaves a linear loop's average alone; its offset is a
step at the command. `transcribe_two_phase` writes that problem.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, Step, disturbance_input
from pneuopt.dynamics.system import DiscreteSystem, System, discretise, names
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.margins import frequency_grid, margins, sensitivity_terms
from pneuopt.evaluation.metric import Tolerance, band_number
from pneuopt.evaluation.requirements import (
    METRICS,
    REQUIREMENT_KINDS,
    MaxSensitivity,
    Overshoot,
    PeakControl,
    SettlingTime,
    SteadyStateError,
    metric_name,
    upper_limit,
)
from pneuopt.evaluation.response import TuningCase
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import TAIL_SHARE
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, as_tuple, check_argument, check_number
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.shooting.full_space import (
    FullSpace,
    FullSpaceProblem,
    Solution,
    follow_path,
    prepare_full_space,
    solve_from,
)
from pneuopt.shooting.transcription import Cost, Limit, Phase, Transcription, Where, regular_nodes
from pneuopt.tuning.method import Agreement, SearchResult, TuningTask, check_method_options, compare_starts
from pneuopt.tuning.racing import WIDEN_BOUNDS, Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, clip_level, fastest_eigenvalue, rk4_substeps, starts_before_step
from pneuopt.tuning.tolerances import LEAST_IMPROVEMENT, MAX_STEPS_A_SEGMENT, MIN_STARTS

# Parameters on which the average of a linear loop does not depend.
PARAMETERS_WITHOUT_EFFECT = ("dither.amplitude", "dither.frequency", "pid.Tt", "pid.lower", "pid.upper")


@dataclass(frozen=True)
class TwoPhase:
    """Tune a linear, continuous loop exactly: solve the two-phase problem by multiple shooting from several starts.

    The response is exact at every node, and lies in the band there; a fast one that leaves it between two nodes is left
    to `Racing`.

    Parameters
    ----------
    nodes : tuple of int
        Shooting nodes of the transient and of the settled phase.
    margin : float
        How much tighter the problem's limits are than those asked for, a fraction; without it an optimum's response
        touches the band.
    starts : int
        Number of starts: the given gains, then random ones within the bounds; fewer where most of at least three fail.
    seed : int
        Of the random numbers.
    digits : int, optional
        Significant digits to which the gains are rounded; None: all.
    solver : FullSpace
        Settings of the interior-point solver.
    """

    nodes: tuple[int, int] = (40, 50)
    margin: float = 0.03
    starts: int = 4
    seed: int = 0
    digits: int | None = 4
    solver: FullSpace = field(default_factory=lambda: FullSpace(max_iterations=400, first_barrier=1e-2))

    peak_margin: ClassVar[float] = 1 / 300  # the exact problem misses no peak
    linear_margin: ClassVar[float] = 1 / 300  # of which its frequencies miss as much
    parameters_without_effect: ClassVar[tuple[str, ...]] = PARAMETERS_WITHOUT_EFFECT

    def __post_init__(self) -> None:
        nodes = as_tuple(
            "TwoPhase: nodes", self.nodes, int, "two whole numbers, of the transient and the settled phase"
        )
        require(
            len(nodes) == 2, f"TwoPhase: nodes are two numbers, of the transient and the settled phase, got {nodes}"
        )
        object.__setattr__(self, "nodes", nodes)
        check_number("TwoPhase: starts", self.starts, "a whole number, as 4", whole=True)
        check_argument("TwoPhase: solver", self.solver, FullSpace, "FullSpace(...), with its brackets")
        check_method_options(self)
        require(min(self.nodes) >= 4, f"TwoPhase: each phase needs at least 4 nodes, got {self.nodes}")
        require(0 <= self.margin < 1, f"TwoPhase: margin is a fraction below 1, got {self.margin}")
        require(self.starts >= 1, f"TwoPhase: starts must be at least 1, got {self.starts}")
        require(self.digits is None or self.digits >= 2, f"TwoPhase: digits must be at least 2, got {self.digits}")

    @property
    def successor(self) -> Racing:
        """A search by simulation, for the exact problem keeps the response in the band at its nodes only."""
        return Racing()

    def check(self, task: TuningTask) -> None:
        """Refuse loops that are not linear, scenarios and requirements without an equation, by an `InputError`."""
        message = "TwoPhase needs a linear loop with a continuous controller, and this one is not; use method=Racing()"
        require(is_linear(task.loop), message)
        require(are_steps(task.references), "TwoPhase tunes for steps, not for moves; use method=Racing()")
        fraction = not isinstance(task.spec.band, Tolerance)
        require(fraction, "TwoPhase takes a settling band as a fraction of the step; use method=Racing()")
        require(not task.scenarios, "TwoPhase tunes for one plant, not for scenarios; leave method= out")
        inexact = _inexact_requirements(task.spec)
        require(not inexact, f"TwoPhase has no equation for {', '.join(inexact)}; use method=Racing()")

    def suits(self, task: TuningTask) -> bool:
        """Whether the loop is linear, not clipped, on one plant and asked for steps and what has an equation."""
        clip = clip_level(task.loop, task.space.parameters)
        clipped = clip < math.inf and not task.spec.limit(PeakControl) < clip  # designs that saturate are as welcome
        steps = are_steps(task.references) and not task.scenarios and not isinstance(task.spec.band, Tolerance)
        can = is_linear(task.loop) and steps and not clipped and not _inexact_requirements(task.spec)
        return can and has_few_steps(task.loop, task.references, task.space, self)

    def find(
        self,
        task: TuningTask,
        simulator: Simulator,  # noqa: ARG002
        spec: Specification,
        start: Array,
        attempt: int,
        progress: ProgressCallback,
    ) -> SearchResult:
        """Solve from every start and return the best optimum; see `Method.find`."""
        method = self if attempt == 0 else replace(self, starts=1)
        loop, space = task.loop, Space(task.space.parameters_at(start), task.space.names)
        # Rows that limit the sensitivity make the problem several times as large. Where nobody asked for them they are
        # left out first: most optima are stable all the same.
        plain, free_loop = _without_stability(task, spec), without_clip(loop)
        most = math.inf if plain is spec else spec.limit(MaxSensitivity)

        def is_allowed(solution: Solution) -> bool:
            found = margins(open_loop(free_loop, solution.parameters.select(free_loop.parameters)))
            return found.stable and found.max_sensitivity <= most

        optima = solve_two_phase(loop, task.references, space, plain, method, progress, is_allowed)
        if plain is not spec and not optima.agreement.converged:
            optima = solve_two_phase(loop, task.references, space, spec, method, progress, is_allowed)
        best, values = optima.best, optima.best.parameters
        stats = {"iterations": best.stats.get("iterations", 0.0)}
        point, cost = np.array([values.value(n) for n in task.space.names]), best.cost
        active = tuple(best.multipliers)
        return SearchResult(point, best.status, active, stats, optimum=cost, agreement=optima.agreement)

    def shorten(self, margin: float, share: float = 1.0) -> "TwoPhase":  # noqa: ARG002
        """The method for a short search from a point that is close."""
        solver = replace(self.solver, max_iterations=min(150, self.solver.max_iterations))
        return replace(self, starts=min(2, self.starts), margin=margin, solver=solver)

    def limit_path(self, task: TuningTask, spec: Specification) -> "TwoPhasePath":
        """The problem, prepared once, to be solved for moving limits and settling bands.

        It leaves out a limit on the sensitivity that nobody asked for: a design's certificate finds it unstable.
        """
        return two_phase_path(task.loop, task.references, task.space, _without_stability(task, spec), self)


@dataclass(frozen=True, eq=False)
class Optima:
    """The best solution of several starts, and how far they agree."""

    best: Solution
    agreement: Agreement


def is_linear(loop: ClosedLoop) -> bool:
    """Whether the loop without its clip is a linear ODE: its Jacobian depends on neither states nor inputs."""
    if loop.pid.sample_time is not None or loop.is_composed or loop.controller.acting_always:
        return False
    ode = without_clip(loop).system().ode
    t, x, u, p = (ca.SX.sym(k, ode.size1_in(i)) for i, k in enumerate("txup"))
    signals = ca.vertcat(x, u)
    return not ca.depends_on(ca.jacobian(ca.vertcat(*ode(t, x, u, p)), signals), signals)


def are_steps(references: Sequence[Reference]) -> bool:
    """Whether every reference is constant after an instant, as the phases of the problem need it."""
    return all(isinstance(r, Step) for r in references)


def has_few_steps(loop: ClosedLoop, references: Sequence[Reference], space: Space, method: TwoPhase) -> bool:
    """Whether few enough RK4 steps lie between two nodes for the problem to take less time than a simulated one."""
    own = Space(space.parameters, tuple(n for n in space.names if n not in ("pid.Tt", "pid.lower", "pid.upper")))
    rate = fastest_eigenvalue(loop, own.vectors(own.corners()), [np.zeros(len(loop.states))]).max()
    longest = max(r.horizon for r in references) / min(method.nodes)
    return bool(rate * longest <= MAX_STEPS_A_SEGMENT * RK4_MAX_H_LAMBDA)


def _inexact_requirements(spec: Specification) -> list[str]:
    """The names of requirements for which the two-phase problem has no equation."""
    return [n for n in spec.metric_names if not METRICS[n].exact]


def _without_stability(task: TuningTask, spec: Specification) -> Specification:
    """The specification without a limit on the sensitivity that nobody asked for."""
    return spec if task.spec.concerns(MaxSensitivity) else spec.without(MaxSensitivity)


def solve_two_phase(
    loop: ClosedLoop,
    references: Sequence[Reference],
    space: Space,
    spec: Specification,
    method: TwoPhase,
    report_progress: ProgressCallback,
    is_allowed: Callable[[Solution], bool] = lambda _: True,
) -> Optima:
    """Solve the two-phase problem from every start; solutions that are not allowed do not count as converged.

    It ends early where most starts fail; an `InputError` where the rest depends on the gains, or a mode is too fast.
    """
    problem = prepare_full_space(transcribe_two_phase(loop, references, space, spec, method.nodes), method.solver)
    parameters = problem.graph.transcription.parameters
    rng = np.random.default_rng(method.seed)
    found, good = list[Solution](), list[Solution]()
    for k in range(method.starts):
        if k >= MIN_STARTS and 2 * len(good) < k:
            break
        point = space.from_unit(rng.random(len(space.names))) if k else space.start
        gains = dict(zip(space.names, point.tolist(), strict=True))
        found.append(solve_from(problem, parameters.with_values(gains)))
        ended = found[-1].status.code.value
        report_progress(f"start {k + 1} of {method.starts}: objective {found[-1].cost:.4g}, {ended}")
        good += [s for s in found[-1:] if s.status.converged and is_allowed(s)]
    failed = [math.inf] * (len(found) - len(good))
    agreement = compare_starts([*(s.cost for s in good), *failed], LEAST_IMPROVEMENT)
    if not good:
        closest = min(found, key=lambda s: s.largest_violation)
        unstable = Status(Code.INFEASIBLE, ("every optimum found is an unstable loop, or nearly so", WIDEN_BOUNDS))
        closest = replace(closest, status=unstable) if closest.status.converged else closest
        return Optima(closest, agreement)
    return Optima(min(good, key=lambda s: s.cost), agreement)


@dataclass(frozen=True, eq=False)
class TwoPhasePath:
    """A two-phase problem that is solved for one set of limits after the other, and its band as transcribed."""

    problem: FullSpaceProblem
    names: tuple[str, ...]
    band: float

    def follow(self, start: Array, specs: Sequence[Specification]) -> list[Solution]:
        """Solve for one specification after the other, the first from gains of shape (n,), each from the one before."""
        parameters = self.problem.graph.transcription.parameters
        gains = dict(zip(self.names, start.tolist(), strict=True))
        path = [
            {metric_name(q): upper_limit(q) for q in spec.limits if metric_name(q) in parameters}
            | {BAND_PARAMETER: band_number(spec.band) / self.band}
            for spec in specs
        ]
        return follow_path(self.problem, parameters.with_values(gains), path)


def two_phase_path(
    loop: ClosedLoop, references: Sequence[Reference], space: Space, spec: Specification, method: TwoPhase
) -> TwoPhasePath:
    """Prepare a problem whose limits and settling band are going to move; `spec` is already tightened."""
    transcription = transcribe_two_phase(loop, references, space, spec, method.nodes)
    problem = prepare_full_space(transcription, method.solver, warm_start=True)
    return TwoPhasePath(problem, space.names, band_number(spec.band))


# Requirements that the problem has an equation for, beside the settling time, which is its free duration.
EXACT_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.exact and kind is not SettlingTime)
# Upper bounds of the unknowns that stand for terms of the objective, as `Specification.limit` counts (fractions of the
# step, the command's unit, 1). A smaller one may cut off the optimum; a far larger one scales the unknown badly.
UNKNOWN_UPPER_BOUNDS = {"Overshoot": 10.0, "SteadyStateError": 10.0, "PeakControl": 1e6, "MaxSensitivity": 100.0}
SETTLING_PARAMETER = "SettlingTime"  # name of the unknown duration [s]
BAND_PARAMETER = "band.share"  # name of the settling band's factor, 1 as transcribed; a continuation moves it


def transcribe_two_phase(
    loop: ClosedLoop, references: Sequence[Reference], space: Space, spec: Specification, nodes: tuple[int, int]
) -> Transcription:
    """Write the two-phase problem of a linear loop, in which the references share one settling time, the largest.

    An `InputError` where the state before the step depends on the gains, or a mode is too fast for the nodes.
    """
    free_loop = without_clip(loop)
    averaged = space.parameters.select(free_loop.parameters)
    if loop.dither:
        averaged = averaged.with_values({"dither.amplitude": 0.0}).fixed("dither.amplitude")
    extra = _extra_unknowns(references, spec)
    system = _extend_system(free_loop, extra, space, references, nodes)
    parameters = (averaged | extra).select(system.parameters)
    phases = [p for i, r in enumerate(references) for p in _reference_phases(loop, space, i, r, nodes)]
    parameters = parameters | _durations(references, spec, extra[SETTLING_PARAMETER])
    q, at, limits = ca.SX.sym("q", len(parameters)), list(parameters).index, list[Limit]()
    for i, reference in enumerate(references):
        if parameters[_settled_duration(i)].free:  # as the settling time is: together they end with the horizon
            end, record = q[at(SETTLING_PARAMETER)] + q[at(_settled_duration(i))], reference.horizon - reference.at
            function = ca.Function("limit", [q], [end])
            limits.append(Limit(f"horizon {i}", function, record, record, Where.PARAMETERS))
    limits += [q for i, r in enumerate(references) for q in _path_limits(loop, space, spec, system, i, r)]
    limits += _sensitivity_limit(free_loop, averaged, space, spec, parameters)
    weights = {k.metric.name: spec.weight(k) for k in REQUIREMENT_KINDS}
    costs = tuple(  # of the unknowns that stand for the objective's terms
        Cost(n, ca.Function("cost", [q], [q[at(n)]]), Where.PARAMETERS, weight=weight)
        for n, weight in weights.items()
        if METRICS[n].exact and weight > 0
    )
    return Transcription(system, parameters, tuple(phases), (), costs, tuple(limits))


def without_clip(loop: ClosedLoop) -> ClosedLoop:
    """The loop without its clip."""
    return replace(loop, pid=replace(loop.pid, limits=False))


def _extra_unknowns(references: Sequence[Reference], spec: Specification) -> ParameterSet:
    """The settling time, an unknown for each other term of the objective, and a number for each other limit."""
    horizon = min(r.horizon - r.at for r in references)
    most = min(spec.limit(SettlingTime), (1 - TAIL_SHARE) * horizon)  # metrics need the rest as the record's end
    free = spec.weight(SettlingTime) > 0
    given = {
        SETTLING_PARAMETER: Parameter(
            0.5 * most if free or not spec.concerns(SettlingTime) else most, "s", 1e-3 * most, most, free=free
        ),
        BAND_PARAMETER: Parameter(1.0, "1"),
    }
    for kind in EXACT_REQUIREMENTS:
        if spec.weight(kind) > 0:
            least = 1.0 if kind is MaxSensitivity else 0.0
            most = min(spec.limit(kind), UNKNOWN_UPPER_BOUNDS[kind.__name__])
            start = min(2.0, most) if kind is MaxSensitivity else min(1.0, most)
            given[kind.__name__] = Parameter(start, "1", least, most, free=True)
        elif spec.limit(kind) < math.inf:  # a number of the problem, which a continuation may move
            given[kind.__name__] = Parameter(spec.limit(kind), "1")
    return ParameterSet(given)


def _durations(references: Sequence[Reference], spec: Specification, settling: Parameter) -> ParameterSet:
    """The durations [s] of each reference, before its step and of its settled phase.

    The latter is as long as the record, which shows more of the band, unless the error at the end of it counts.
    """
    found = {f"before.{i}": Parameter(r.at, "s") for i, r in enumerate(references) if r.at > 0}
    for i, r in enumerate(references):
        record = r.horizon - r.at
        if not spec.concerns(SteadyStateError):
            found[_settled_duration(i)] = Parameter(record, "s")
        elif settling.free:
            rest, least, most = (record - v for v in (settling.value, settling.upper, settling.lower))
            found[_settled_duration(i)] = Parameter(rest, "s", least, most, free=True)
        else:
            found[_settled_duration(i)] = Parameter(record - settling.value, "s")
    return ParameterSet(found)


def _settled_duration(i: int) -> str:
    """The name of the duration of reference i's settled phase."""
    return f"rest.{i}"


def _extend_system(
    loop: ClosedLoop, extra: ParameterSet, space: Space, references: Sequence[Reference], nodes: tuple[int, int]
) -> DiscreteSystem:
    """Discretise the loop with the extra unknowns among its parameters, so that path limits may depend on them."""
    system = loop.system()
    t, x, u, p = (ca.SX.sym(k, system.ode.size1_in(i)) for i, k in enumerate("txup"))
    more = ca.SX.sym("more", len(extra))
    ode = ca.Function(
        "ode", [t, x, u, ca.vertcat(p, more)], [*system.ode(t, x, u, p)], ["t", "x", "u", "p"], ["xdot", "y"]
    )
    longest = max(max(extra[SETTLING_PARAMETER].upper / nodes[0], r.horizon / nodes[1]) for r in references)
    own = Space(space.parameters.select(loop.parameters), space.names)
    rates = fastest_eigenvalue(loop, own.vectors(own.corners()), [np.zeros(len(loop.states))])
    steps = rk4_substeps(float(rates.max()), longest)
    return discretise(
        System(system.states, system.inputs, system.outputs, system.parameters | extra, ode), max(2, steps)
    )


def _reference_phases(
    loop: ClosedLoop, space: Space, i: int, reference: Reference, nodes: tuple[int, int]
) -> list[Phase]:
    """The phases of reference i: before the step, where there is such a time, transient and settled."""
    (start,) = starts_before_step([TuningCase(reference)], loop, space)
    if start is None:
        message = "before the step the loop rests in a state that depends on its gains"
        needs = "a load): the two-phase problem needs one that does not; step from zero, or use method=Racing()"
        raise InputError(f"{message} (reference {reference.initial:g}, or {needs}")
    disturbed = {disturbance_input(n): v for n, v in reference.disturbance.items()}
    after = [disturbed.get(n, 0.0) for n in names(loop.inputs)[1:]]

    def make_phase(name: str, n: int, value: float, duration: str, first: Array | None) -> Phase:
        inputs = np.tile([value, *(np.zeros(len(after)) if name == "before" else after)], (n, 1))
        grid, step = np.arange(n) / n, np.full(n, 1 / n)
        return Phase(f"{name}.{i}", grid, step, inputs, regular_nodes(n, 1), first, first is None, duration)

    moved = reference.at > 0
    before = [make_phase("before", nodes[0], reference.initial, f"before.{i}", start)] if moved else []
    transient = make_phase("transient", nodes[0], reference.final, SETTLING_PARAMETER, None if moved else start)
    return [*before, transient, make_phase("settled", nodes[1], reference.final, _settled_duration(i), None)]


def _path_limits(
    loop: ClosedLoop, space: Space, spec: Specification, system: DiscreteSystem, i: int, reference: Reference
) -> list[Limit]:
    """The path limits of reference i: settling band, overshoot, steady-state error, peak command and clip."""
    t, x, u, p = (ca.SX.sym(k, system.step.size1_in(j)) for k, j in zip("txup", (0, 2, 3, 4), strict=True))
    y = system.step(t, 0, x, u, p)[1]
    outputs, at = names(system.outputs), list(system.parameters).index
    error = (y[outputs.index(loop.feedback.name)] - u[0]) / reference.nominal_size
    control = y[outputs.index("control")]
    count = 3 if reference.at > 0 else 2
    transient, settled = count * i + count - 2, count * i + count - 1
    both = (transient, settled)

    def path_limit(name: str, value: ca.SX, lower: float, upper: float, where: Where, phases: tuple[int, ...]) -> Limit:
        return Limit(name, ca.Function("limit", [t, x, u, p], [value]), lower, upper, where, phases)

    def upper_limits(kind: type, value: ca.SX, where: Where, phases: tuple[int, ...]) -> list[Limit]:
        """Hold values below the limit of their kind, or below the unknown that stands for it in the objective."""
        if not spec.concerns(kind):
            return []
        return [path_limit(kind.__name__, value - p[at(kind.__name__)], -math.inf, 0.0, where, phases)]

    found = []
    if spec.concerns(SettlingTime):
        width = band_number(spec.band)
        inside, both_ends = error / p[at(BAND_PARAMETER)], (Where.NODES, Where.END)
        found += [path_limit("settling band", inside, -width, width, w, (settled,)) for w in both_ends]
    beyond = error if reference.changes else ca.vertcat(error, -error)
    found += upper_limits(Overshoot, beyond, Where.NODES, both)
    found += upper_limits(SteadyStateError, ca.vertcat(error, -error), Where.END, (settled,))
    found += upper_limits(PeakControl, ca.vertcat(control, -control), Where.NODES, both)
    if loop.pid.limits:
        ends = [space.parameters.value(f"pid.{n}") for n in ("lower", "upper")]
        if np.isfinite(ends).any():
            found.append(path_limit("the command's clip", control, ends[0], ends[1], Where.NODES, both))
    return found


def _sensitivity_limit(
    loop: ClosedLoop, averaged: ParameterSet, space: Space, spec: Specification, parameters: ParameterSet
) -> list[Limit]:
    """The limit on the sensitivity's peak: Ms^2 |1 + L|^2 >= 1 at every frequency of a grid."""
    if not spec.concerns(MaxSensitivity):
        return []
    own, frequencies = Space(averaged, space.names), list[Array]()
    for share in (0.2, 0.8):  # around the loop's modes, where the sensitivity peaks [rad/s]
        point = space.from_unit(np.full(len(space.names), share))
        full = frequency_grid(open_loop(loop, own.parameters_at(point)), 40)
        frequencies.append(full[(full > 30 * full[0]) & (full < full[-1] / 30)])
    grid = np.unique(np.concatenate(frequencies))
    terms = sensitivity_terms(loop, grid, averaged)
    q = ca.SX.sym("q", len(parameters))
    Ms = q[list(parameters).index("MaxSensitivity")]
    value = terms(q[: len(loop.parameters)]) * Ms**2
    return [Limit("MaxSensitivity", ca.Function("limit", [q], [value]), 1.0, math.inf, Where.PARAMETERS)]
