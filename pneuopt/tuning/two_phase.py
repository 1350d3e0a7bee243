"""`TwoPhase`: exact tuning of a linear loop; the settling time is the free duration of a multiple-shooting problem."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import casadi as ca
import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.requirements import (
    METRICS,
    PeakControl,
    metric_name,
    upper_limit,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback
from pneuopt.shooting.full_space import FullSpace, FullSpaceProblem, follow_path, prepare_full_space, solve_from
from pneuopt.shooting.solution import Solution
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, clip_level, fastest_eigenvalue
from pneuopt.tuning.two_phase_transcription import BAND_PARAMETER, transcribe_two_phase, without_clip

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
    problem = prepare_full_space(transcribe_two_phase(loop, references, space, spec, method.nodes), method.solver)
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
    transcription = transcribe_two_phase(loop, references, space, spec, method.nodes)
    return TwoPhasePath(prepare_full_space(transcription, method.solver, warm_start=True), space.names, spec.band)


def _objective_value(solution: Solution) -> float:
    return float(solution.stats["cost"])
