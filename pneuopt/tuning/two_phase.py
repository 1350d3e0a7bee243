"""The exact settling-time problem of a linear loop, as a transcription: free duration, then inside the band for good.

Phase "transient" is [0, Ts] with Ts unknown, phase "settled" the rest, where |y - r| <= band is a path limit; so the
settling time is a smooth function of the gains. What is minimised beside it enters through one more unknown each (the
overshoot and so on) that its path limit may not exceed. Fast dither leaves a linear loop's average alone; its offset is
a step at the command.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step, disturbance_input
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.dynamics.system import DiscreteSystem, System, discretise, names
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.evaluation.margins import frequency_grid, sensitivity_terms
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
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import ProgressCallback
from pneuopt.shooting.full_space import FullSpace, FullSpaceProblem, follow_path, prepare_full_space, solve_from
from pneuopt.shooting.solution import Solution
from pneuopt.shooting.transcription import Cost, Limit, Phase, Transcription, Where, regular_nodes
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, clip_level, fastest_eigenvalue, rk4_substeps

EXACT_REQUIREMENTS = tuple(kind for kind in REQUIREMENT_KINDS if kind.metric.exact and kind is not SettlingTime)
UNKNOWN_UPPER_BOUNDS = {"Overshoot": 10.0, "SteadyStateError": 10.0, "PeakControl": 1e6, "MaxSensitivity": 100.0}
SETTLING_PARAMETER = "SettlingTime"
BAND_PARAMETER = "band.share"  # of the settling band as transcribed: a number that a continuation may move
MAX_STEPS_A_SEGMENT = 12  # between two nodes; the paper's loop takes 3, a lag with dead time and wide bounds 50
EXACT_PEAK_MARGIN = 1 / 300  # share of the margin for peaks of command and sensitivity: an exact problem misses none
# On these the average of a linear loop does not depend.
PARAMETERS_WITHOUT_EFFECT = ("dither.amplitude", "dither.frequency", "pid.Tt", "pid.lower", "pid.upper")
OPTIMA_TOLERANCE = 1e-3  # relative difference of two optima that count as one


@dataclass(frozen=True)
class TwoPhase:
    """Solve the two-phase problem by full-space multiple shooting from several starts. For linear, continuous loops.

    Parameters
    ----------
    nodes : tuple of int
        Shooting nodes of the transient and of the settled phase.
    margin : float
        How much tighter the problem's limits are than those asked for; an optimum without it grazes the band.
    starts : int
        The given gains, then random ones within the bounds.
    seed : int
    digits : int, optional
        Significant digits of the gains handed out; None: all.
    solver : FullSpace
    """

    nodes: tuple[int, int] = (40, 50)
    margin: float = 0.03
    starts: int = 4
    seed: int = 0
    digits: int | None = 4
    solver: FullSpace = field(default_factory=lambda: FullSpace(max_iterations=400, first_barrier=1e-2))

    peak_margin: ClassVar[float] = EXACT_PEAK_MARGIN
    parameters_without_effect: ClassVar[tuple[str, ...]] = PARAMETERS_WITHOUT_EFFECT

    def __post_init__(self) -> None:
        require(min(self.nodes) >= 4, f"TwoPhase: each phase needs at least 4 nodes, got {self.nodes}")
        require(0 <= self.margin < 1, f"TwoPhase: margin is a fraction below 1, got {self.margin}")
        require(self.starts >= 1, f"TwoPhase: starts must be at least 1, got {self.starts}")
        require(self.digits is None or self.digits >= 2, f"TwoPhase: digits must be at least 2, got {self.digits}")

    @property
    def successor(self) -> Screening:
        """A search by simulation: the exact problem keeps its band at its nodes only."""
        return Screening()

    def check(self, task: TuningTask) -> None:
        """Refuse what the problem has no equation for: `InputError` names it and the remedy."""
        message = (
            "TwoPhase needs a linear loop with a continuous controller, and this one is not; use method=Screening()"
        )
        require(is_linear(task.loop), message)
        require(not task.scenarios, "TwoPhase tunes for one plant, not for scenarios; leave method= out")
        inexact = _inexact_requirements(task.spec)
        require(not inexact, f"TwoPhase has no equation for {', '.join(inexact)}; use method=Screening()")

    def suits(self, task: TuningTask) -> bool:
        """For a linear loop on one plant that no clip can hold back, if there are equations for all that is asked."""
        clip = clip_level(task.loop, task.space.parameters)
        clipped = clip < math.inf and not task.spec.limit(PeakControl) < clip  # designs that saturate are as welcome
        can = is_linear(task.loop) and not clipped and not task.scenarios and not _inexact_requirements(task.spec)
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
        """The best optimum of the starts; see `Method.find`."""
        method = self if attempt == 0 else replace(self, starts=1)
        space = Space(task.space.parameters_at(start), task.space.names)
        optima = solve_two_phase(task.loop, task.references, space, spec, method, progress)
        best, values = optima.best, optima.best.parameters
        stats = {
            "starts": float(optima.starts),
            "starts_converged": float(optima.converged),
            "starts_agreeing": float(optima.agreeing),
            "optimum": best.stats.get("cost", np.nan),
            "iterations": best.stats.get("iterations", 0.0),
        }
        point = np.array([values.value(n) for n in task.space.names])
        return SearchResult(point, best.status, tuple(best.multipliers), stats)

    def shorten(self, margin: float) -> "TwoPhase":
        """A short search, from a point that is close."""
        return replace(self, starts=2, margin=margin, solver=replace(self.solver, max_iterations=150))

    def limit_path(self, task: TuningTask, spec: Specification) -> "TwoPhasePath":
        """The problem, differentiated once, whose limits and settling band then move."""
        return two_phase_path(task.loop, task.references, task.space, spec, self)


@dataclass(frozen=True, eq=False)
class Optima:
    """What the starts ended in: the best, and how many of them agree with it."""

    best: Solution
    starts: int
    converged: int
    agreeing: int


def is_linear(loop: ClosedLoop) -> bool:
    """Whether the loop, its clip aside, is a linear ODE: no state and no input is in its Jacobian."""
    if loop.pid.sample_time is not None:
        return False
    ode = without_clip(loop).system().ode
    t, x, u, p = (ca.SX.sym(k, ode.size1_in(i)) for i, k in enumerate("txup"))
    signals = ca.vertcat(x, u)
    return not ca.depends_on(ca.jacobian(ca.vertcat(*ode(t, x, u, p)), signals), signals)


def has_few_steps(loop: ClosedLoop, references: Sequence[Step], space: Space, method: TwoPhase) -> bool:
    """Whether the steps between two nodes are few; with many the problem takes minutes, where a screening takes one."""
    own = Space(space.parameters, tuple(n for n in space.names if n not in ("pid.Tt", "pid.lower", "pid.upper")))
    rate = fastest_eigenvalue(loop, own.vectors(own.corners()), [np.zeros(len(loop.states))]).max()
    longest = max(r.horizon for r in references) / min(method.nodes)
    return bool(rate * longest <= MAX_STEPS_A_SEGMENT * RK4_MAX_H_LAMBDA)


def _inexact_requirements(spec: Specification) -> list[str]:
    return [n for n in spec.kinds if not METRICS[n].exact]


def without_clip(loop: ClosedLoop) -> ClosedLoop:
    """The loop without its clip."""
    return replace(loop, pid=replace(loop.pid, limits=False))


def solve_two_phase(
    loop: ClosedLoop,
    references: Sequence[Step],
    space: Space,
    spec: Specification,
    method: TwoPhase,
    tell: ProgressCallback,
) -> Optima:
    """Solve from every start; `tell` hears of each.

    Raises
    ------
    InputError
        If the loop's rest depends on the gains, or a mode is too fast for the grid.
    """
    problem = prepare_full_space(transcribe_two_phase(loop, references, space, spec, method), method.solver)
    parameters = problem.graph.transcription.parameters
    rng = np.random.default_rng(method.seed)
    found = []
    for k in range(method.starts):
        point = space.from_unit(rng.random(len(space.names))) if k else space.start
        gains = dict(zip(space.names, point.tolist(), strict=True))
        found.append(solve_from(problem, parameters.with_values(gains)))
        value, ended = _objective_value(found[-1]), found[-1].status.code.value
        tell(f"start {k + 1} of {method.starts}: objective {value:.4g}, {ended}")
    good = [s for s in found if s.status.converged]
    if not good:
        return Optima(min(found, key=lambda s: s.stats.get("largest_violation", math.inf)), len(found), 0, 0)
    best = min(good, key=_objective_value)
    agreeing = sum(
        _objective_value(s) - _objective_value(best) <= OPTIMA_TOLERANCE * abs(_objective_value(best)) for s in good
    )
    return Optima(best, len(found), len(good), agreeing)


@dataclass(frozen=True, eq=False)
class TwoPhasePath:
    """A two-phase problem to be solved for one set of limits after the other, all of the same kinds.

    Parameters
    ----------
    problem : Problem
    names : tuple of str
        The gains.
    band : float
        The settling band as transcribed.
    """

    problem: FullSpaceProblem
    names: tuple[str, ...]
    band: float

    def follow(self, start: Array, specs: Sequence[Specification]) -> list[Solution]:
        """Solve for one after the other, the first from gains of shape (n,)."""
        parameters = self.problem.graph.transcription.parameters
        gains = dict(zip(self.names, start.tolist(), strict=True))
        path = [
            {metric_name(q): upper_limit(q) for q in spec.limits} | {BAND_PARAMETER: spec.band / self.band}
            for spec in specs
        ]
        return follow_path(self.problem, parameters.with_values(gains), path)


def two_phase_path(
    loop: ClosedLoop, references: Sequence[Step], space: Space, spec: Specification, method: TwoPhase
) -> TwoPhasePath:
    """Prepare a problem whose limits and settling band will move; `spec` already tightened."""
    transcription = transcribe_two_phase(loop, references, space, spec, method)
    return TwoPhasePath(prepare_full_space(transcription, method.solver, warm_start=True), space.names, spec.band)


def transcribe_two_phase(
    loop: ClosedLoop, references: Sequence[Step], space: Space, spec: Specification, method: TwoPhase
) -> Transcription:
    """Write the two-phase problem; the references share one settling time, the worst of them."""
    free_loop = without_clip(loop)
    averaged = space.parameters.select(free_loop.parameters)
    if loop.dither:
        averaged = averaged.with_values({"dither.amplitude": 0.0}).fixed("dither.amplitude")
    extra = _extra_unknowns(references, spec)
    system = _extend_system(free_loop, extra, space, references, method)
    parameters = (averaged | extra).select(system.parameters)
    phases = [p for i, r in enumerate(references) for p in _reference_phases(loop, space, i, r, method)]
    parameters = parameters | _durations(references)
    limits = [
        *(q for i, r in enumerate(references) for q in _path_limits(loop, space, spec, system, i, r)),
        *_sensitivity_limit(free_loop, averaged, space, spec, parameters),
    ]
    return Transcription(system, parameters, tuple(phases), (), _costs(spec, parameters), tuple(limits))


def _objective_value(solution: Solution) -> float:
    return float(solution.stats["cost"])


def _extra_unknowns(references: Sequence[Step], spec: Specification) -> ParameterSet:
    """The settling time, an unknown for each further term of the objective, and a number for each other limit."""
    horizon = min(r.horizon - r.at for r in references)
    most = min(spec.limit(SettlingTime), (1 - TAIL_SHARE) * horizon)  # in the rest a metric would not call it settled
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


def _durations(references: Sequence[Step]) -> ParameterSet:
    rest = {f"rest.{i}": Parameter(r.horizon - r.at, "s") for i, r in enumerate(references)}
    return ParameterSet(rest | {f"before.{i}": Parameter(r.at, "s") for i, r in enumerate(references) if r.at > 0})


def _extend_system(
    loop: ClosedLoop, extra: ParameterSet, space: Space, references: Sequence[Step], method: TwoPhase
) -> DiscreteSystem:
    """The loop with the extra unknowns among its parameters, so that path limits may depend on them."""
    system = loop.system()
    t, x, u, p = (ca.SX.sym(k, system.ode.size1_in(i)) for i, k in enumerate("txup"))
    more = ca.SX.sym("more", len(extra))
    ode = ca.Function(
        "ode", [t, x, u, ca.vertcat(p, more)], [*system.ode(t, x, u, p)], ["t", "x", "u", "p"], ["xdot", "y"]
    )
    longest = max(
        max(extra[SETTLING_PARAMETER].upper / method.nodes[0], r.horizon / method.nodes[1]) for r in references
    )
    own = Space(space.parameters.select(loop.parameters), space.names)
    rates = fastest_eigenvalue(loop, own.vectors(own.corners()), [np.zeros(len(loop.states))])
    steps = rk4_substeps(float(rates.max()), longest)
    return discretise(
        System(system.states, system.inputs, system.outputs, system.parameters | extra, ode), max(2, steps)
    )


def _reference_phases(loop: ClosedLoop, space: Space, i: int, reference: Step, method: TwoPhase) -> list[Phase]:
    start = _state_before_step(loop, space, reference)
    disturbed = {disturbance_input(n): v for n, v in reference.disturbance.items()}
    after = [disturbed.get(n, 0.0) for n in names(loop.inputs)[1:]]

    def make_phase(name: str, n: int, value: float, duration: str, first: Array | None) -> Phase:
        inputs = np.tile([value, *(np.zeros(len(after)) if name == "before" else after)], (n, 1))
        grid, step = np.arange(n) / n, np.full(n, 1 / n)
        return Phase(f"{name}.{i}", grid, step, inputs, regular_nodes(n, 1), first, first is None, duration)

    moved = reference.at > 0
    before = [make_phase("before", method.nodes[0], reference.initial, f"before.{i}", start)] if moved else []
    transient = make_phase("transient", method.nodes[0], reference.final, SETTLING_PARAMETER, None if moved else start)
    return [*before, transient, make_phase("settled", method.nodes[1], reference.final, f"rest.{i}", None)]


def _state_before_step(loop: ClosedLoop, space: Space, reference: Step) -> Array:
    first = loop.initial(space.parameters, reference=reference.initial, start=reference.start)
    for share in (0.3, 0.8):
        gains = space.parameters_at(space.from_unit(np.full(len(space.names), share)))
        other = loop.initial(gains, reference=reference.initial, start=reference.start)
        scale = np.array([q.nominal for q in loop.states])
        require(
            bool(np.all(np.abs(first - other) <= 1e-9 * scale)),
            f"before the step the loop rests in a state that depends on its gains (reference {reference.initial:g}, or "
            "a load): the two-phase problem needs one that does not; step from zero, or use method=Screening()",
        )
    return first


def _path_limits(
    loop: ClosedLoop, space: Space, spec: Specification, system: DiscreteSystem, i: int, reference: Step
) -> list[Limit]:
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
        """Value and, where it has a sign, its negative, at most the limit or the unknown."""
        if not spec.concerns(kind):
            return []
        return [path_limit(kind.__name__, value - p[at(kind.__name__)], -math.inf, 0.0, where, phases)]

    found = []
    if spec.concerns(SettlingTime):
        inside, both_ends = error / p[at(BAND_PARAMETER)], (Where.NODES, Where.END)
        found += [path_limit("settling band", inside, -spec.band, spec.band, w, (settled,)) for w in both_ends]
    beyond = error if reference.is_step else ca.vertcat(error, -error)
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
    if not spec.concerns(MaxSensitivity):
        return []
    grid = np.unique(
        np.concatenate(
            [
                _sensitivity_frequencies(loop, averaged, space.from_unit(np.full(len(space.names), k)), space)
                for k in (0.2, 0.8)
            ]
        )
    )
    terms = sensitivity_terms(loop, grid, averaged)
    q = ca.SX.sym("q", len(parameters))
    Ms = q[list(parameters).index("MaxSensitivity")]
    value = terms(q[: len(loop.parameters)]) * Ms**2
    return [Limit("MaxSensitivity", ca.Function("limit", [q], [value]), 1.0, math.inf, Where.PARAMETERS)]


def _sensitivity_frequencies(loop: ClosedLoop, averaged: ParameterSet, point: Array, space: Space) -> Array:
    """Frequencies around those of the loop's modes, where the sensitivity peaks."""
    own = Space(averaged, space.names).parameters_at(point)
    full = frequency_grid(open_loop(loop, own), 40)
    return np.asarray(full[(full > 30 * full[0]) & (full < full[-1] / 30)], dtype=float)


def _costs(spec: Specification, parameters: ParameterSet) -> tuple[Cost, ...]:
    q = ca.SX.sym("q", len(parameters))
    terms = {kind.metric.name: spec.weight(kind) for kind in REQUIREMENT_KINDS if kind.metric.exact}
    return tuple(
        Cost(n, ca.Function("cost", [q], [q[list(parameters).index(n)]]), Where.PARAMETERS, weight=weight)
        for n, weight in terms.items()
        if weight > 0
    )
