"""`TwoPhase`: exact tuning of a linear loop; its settling time is a free duration of a multiple-shooting problem."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import casadi as ca
import numpy as np

from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, Step
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.band import Tolerance, band_number
from pneuopt.evaluation.margins import margins
from pneuopt.evaluation.requirements import METRICS, MaxSensitivity, PeakControl, metric_name, upper_limit
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arguments import as_tuple, check_argument, check_number
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.shooting.full_space import (
    FullSpace,
    FullSpaceProblem,
    Solution,
    follow_path,
    prepare_full_space,
    solve_from,
)
from pneuopt.tuning.agreement import Agreement, compare_starts
from pneuopt.tuning.merit import WIDEN_BOUNDS
from pneuopt.tuning.method import SearchResult, TuningTask, check_method_options
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, clip_level, fastest_eigenvalue
from pneuopt.tuning.two_phase_transcription import BAND_PARAMETER, transcribe_two_phase, without_clip

# RK4 steps between two nodes up to which the method is chosen. A lower number leaves loops to the race that are solved
# exactly (the published one takes 3 steps). With a higher one a response leaves its band between two nodes, unseen, and
# a start takes long: of six lags of second order with 4 to 16 steps none was certified in 6 to 20 s, all by the race in
# 1.5 s; of an oscillator with dead time and 10 steps 36 s gave 0.67 s to settle, 2 s of the race 0.30 s.
MAX_STEPS_A_SEGMENT = 3.5
# Share of the margin that limits on peaks of command and sensitivity are tightened by. With less, rounding the gains
# breaks them; more gives performance away, for the exact problem misses no peak.
EXACT_PEAK_MARGIN = 1 / 300
# Parameters on which the average of a linear loop does not depend.
PARAMETERS_WITHOUT_EFFECT = ("dither.amplitude", "dither.frequency", "pid.Tt", "pid.lower", "pid.upper")
# Relative difference of two objectives below which starts agree. A smaller one counts the solver's tolerance as another
# optimum; a larger one hides local optima.
OPTIMA_TOLERANCE = 1e-3
# Starts after which the search ends if most of them have failed. One that fails takes longer than one that succeeds,
# and where most fail the exact problem is hard (of an oscillator with dead time 9 of 10 starts): a lower number gives
# up after a bad draw, a higher one delays the search by simulation that `tune` then makes.
MIN_STARTS = 3


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

    peak_margin: ClassVar[float] = EXACT_PEAK_MARGIN
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
        space = Space(task.space.parameters_at(start), task.space.names)
        optima = _solve_stable(task, replace(task, space=space, spec=spec), method, progress)
        best, values = optima.best, optima.best.parameters
        stats = {
            **optima.agreement.stats,
            "optimum": best.stats.get("cost", np.nan),
            "iterations": best.stats.get("iterations", 0.0),
        }
        point = np.array([values.value(n) for n in task.space.names])
        return SearchResult(point, best.status, tuple(best.multipliers), stats)

    def shorten(self, margin: float) -> "TwoPhase":
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


def _solve_stable(task: TuningTask, tightened: TuningTask, method: TwoPhase, progress: ProgressCallback) -> Optima:
    """Solve the two-phase problem for a stable loop.

    Rows that limit the sensitivity make the problem several times as large. Where nobody asked for them they are left
    out first: most optima are stable all the same.
    """
    loop, references, space, spec = tightened.loop, tightened.references, tightened.space, tightened.spec
    plain = _without_stability(task, spec)
    is_allowed = partial(_is_stable, loop, math.inf if plain is spec else spec.limit(MaxSensitivity))
    optima = solve_two_phase(loop, references, space, plain, method, progress, is_allowed)
    if plain is spec or optima.agreement.converged:
        return optima
    return solve_two_phase(loop, references, space, spec, method, progress, is_allowed)


def _without_stability(task: TuningTask, spec: Specification) -> Specification:
    """The specification without a limit on the sensitivity that nobody asked for."""
    return spec if task.spec.concerns(MaxSensitivity) else spec.without(MaxSensitivity)


def _is_stable(loop: ClosedLoop, most: float, solution: Solution) -> bool:
    """Whether the loop with a solution's gains is stable, its sensitivity not above `most`."""
    free_loop = without_clip(loop)
    found = margins(open_loop(free_loop, solution.parameters.select(free_loop.parameters)))
    return found.stable and found.max_sensitivity <= most


def solve_two_phase(
    loop: ClosedLoop,
    references: Sequence[Reference],
    space: Space,
    spec: Specification,
    method: TwoPhase,
    report_progress: ProgressCallback,
    is_allowed: Callable[[Solution], bool] = lambda _: True,
) -> Optima:
    """Solve the two-phase problem from every start; `report_progress` receives a line of text a start.

    Solutions that are not allowed do not count as converged. The search ends early where most starts fail.

    Raises
    ------
    InputError
        If the loop's rest depends on the gains, or a mode is too fast for the grid.
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
        value, ended = _objective_value(found[-1]), found[-1].status.code.value
        report_progress(f"start {k + 1} of {method.starts}: objective {value:.4g}, {ended}")
        good += [s for s in found[-1:] if s.status.converged and is_allowed(s)]
    failed = [math.inf] * (len(found) - len(good))
    agreement = compare_starts([*map(_objective_value, good), *failed], OPTIMA_TOLERANCE)
    if not good:
        closest = min(found, key=lambda s: s.stats.get("largest_violation", math.inf))
        unstable = Status(Code.INFEASIBLE, ("every optimum found is an unstable loop, or nearly so", WIDEN_BOUNDS))
        closest = replace(closest, status=unstable) if closest.status.converged else closest
        return Optima(closest, agreement)
    return Optima(min(good, key=_objective_value), agreement)


@dataclass(frozen=True, eq=False)
class TwoPhasePath:
    """A two-phase problem that is solved for one set of limits after the other, all of the same kinds.

    Parameters
    ----------
    problem : FullSpaceProblem
    names : tuple of str
        The names of the gains.
    band : float
        The settling band as transcribed.
    """

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


def _objective_value(solution: Solution) -> float:
    """The objective that a solution reached."""
    return float(solution.stats["cost"])
