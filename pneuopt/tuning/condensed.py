"""`Condensed`: a search by gradients, a short screening over several settling bands and then condensed shooting.

It is for many gains and many scenarios. Gradients find the nearest optimum only, and each number of times that the
response leaves a narrow band makes an optimum of its own. The mean settling time over wide and narrow bands leads a
screening across these optima: on the corners of the friction drive in problems/speed/t32.py ten seeds ended at 0.159 s,
with a sequence of narrowing bands at 0.184 s. The dither makes further optima beside each other: `restarts` screens
again and jumps from the best point to other dithers (eight more seeds: median 0.155 s, against 0.183 s where the dither
was only varied about the best point).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import ROBUSTNESS_REQUIREMENTS
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.polish import PROGRAM_MARGIN, nonsmooth_terms
from pneuopt.tuning.responses import to_records
from pneuopt.tuning.screening import (
    SIMULATION_PEAK_MARGIN,
    BestPoint,
    MeritFunction,
    Screening,
    compute_merits,
    evolve,
    first_population,
    screening_result,
    short_screening,
)
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space
from pneuopt.tuning.sqp import SQP, LinearisedPoint, descend

# Gains up to which one plant is tuned without gradients. A lower number sends small problems, which a screening solves
# as well, to the gradients; a higher one costs time: with eight gains on a drive with friction it takes twice as long.
MAX_SCREENING_GAINS = 6
# Distance below which two points count as one, a fraction of each gain's range. A smaller one lets one optimum take
# several of the places in `keep`; a larger one merges optima that differ in the dither.
MIN_POINT_DISTANCE = 0.03
MAX_PENALTY_RAISES = 2  # times that the penalties are raised tenfold where limits stay broken; more slow each program
# Points by which the scenarios are ranked. Fewer rank them by chance; each more costs a simulation of every case.
RANKING_POINTS = 12
# Places in the range of a parameter that is not the PID's, to which a restart jumps. Fewer miss optima of the dither;
# each one costs `JUMP_ITERATIONS` iterations.
RESTART_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Iterations before the best of the jumps are chosen. Fewer choose before the gains have adapted to the new dither; more
# cost time for jumps that are dropped.
JUMP_ITERATIONS = 8


@dataclass(frozen=True)
class Condensed:
    """Tune many gains, or for many scenarios, by quadratic programs on compiled simulations with sensitivities.

    Parameters
    ----------
    members, generations : int
        Population and generations of the screening by differential evolution.
    bands : tuple of float
        Settling bands over which the screening takes the mean settling time, beside the one asked for, as far as they
        are wider.
    keep, iterations : int
        Points that the programs improve, and iterations for each.
    restarts : int
        Times that another population is screened, and the programs begin again from the best point with the dither's
        amplitude, then its offset, and every other free parameter that is not the PID's, put to `RESTART_FRACTIONS` of
        its range.
    working : int
        Cases, the worst ones, that the programs see at a time.
    rounds : int
        Rounds of programs; after each, cases that turn out to be worse are taken in.
    nodes : tuple of int
        Instants at which a response is read: during the search, and in the final polish.
    polish : int
        Iterations on the finer nodes.
    margin : float
        How much tighter the search's limits are than those asked for, a fraction.
    seed : int
        Of the random numbers.
    digits : int, optional
        Significant digits to which the gains are rounded; None: all.
    steps : SQP
        Step control of the programs.
    """

    members: int = 40
    generations: int = 28
    bands: tuple[float, ...] = (0.1, 0.05, 0.03)
    keep: int = 5
    iterations: int = 25
    restarts: int = 1
    working: int = 12
    rounds: int = 3
    nodes: tuple[int, int] = (500, 2000)
    polish: int = 10
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4
    steps: SQP = field(default_factory=SQP)

    peak_margin: ClassVar[float] = SIMULATION_PEAK_MARGIN
    parameters_without_effect: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for n, least in (("generations", 1), ("keep", 1), ("iterations", 1), ("restarts", 0)):
            value = getattr(self, n)
            message = f"Condensed: {n} must be a whole number, at least {least}, got {value}"
            require(isinstance(value, int) and value >= least, message)
        require(all(0 < band < 1 for band in self.bands), f"Condensed: bands are fractions below 1, got {self.bands}")
        require(self.members >= 5, f"Condensed: members must be at least 5, got {self.members}")
        require(self.working >= 1, f"Condensed: working must be at least 1, got {self.working}")
        require(min(self.nodes) >= 50, f"Condensed: nodes must be at least 50, got {self.nodes}")
        require(0 <= self.margin < 1, f"Condensed: margin is a fraction below 1, got {self.margin}")
        require(self.digits is None or self.digits >= 2, f"Condensed: digits must be at least 2, got {self.digits}")

    @property
    def successor(self) -> None:
        """No method follows this one: its answer is final."""

    def check(self, task: TuningTask) -> None:
        """Refuse requirements and parameters without a gradient: `InputError` names them and the remedy."""
        strange = nonsmooth_terms(task.loop, task.space, task.spec)
        require(not strange, f"Condensed has no gradient for {', '.join(strange)}; use method=Racing()")

    def suits(self, task: TuningTask) -> bool:
        """Whether there are scenarios or many gains, and gradients of all requirements to all that is free."""
        many = bool(task.scenarios) or len(task.space.names) > MAX_SCREENING_GAINS
        return many and not nonsmooth_terms(task.loop, task.space, task.spec)

    def find(
        self,
        task: TuningTask,
        simulator: Simulator,
        spec: Specification,
        start: Array,
        attempt: int,  # noqa: ARG002
        progress: ProgressCallback,
    ) -> SearchResult:
        """Search for the best point; see `Method.find`."""
        best = run_gradient_search(simulator, task.references, task.space, spec, self, start, progress)
        return screening_result(task, simulator, spec, best)

    def shorten(self, margin: float) -> Screening:
        """The method for a short search from a point that is close."""
        return short_screening(margin, self.digits)

    def limit_path(self, task: TuningTask, spec: Specification) -> None:
        """No path: each set of limits needs a new search."""


def run_gradient_search(
    simulator: Simulator,
    references: Sequence[Step],
    space: Space,
    spec: Specification,
    method: Condensed,
    start: Array,
    report_progress: ProgressCallback,
) -> BestPoint:
    """Search by screening and gradients; Ctrl-C ends the search with the best point so far.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        Already tightened.
    start : ndarray, shape (n,)
        A member of the first population.
    report_progress : callable
        Receives a line of text a stage.
    """
    scale = min(r.horizon - r.at for r in references)
    search = _CondensedSearch(simulator, spec, method, scale, space.to_unit(start), report_progress)
    try:
        search.run()
    except KeyboardInterrupt:
        return BestPoint(space.from_unit(search.best), search.count, is_complete=False)
    return BestPoint(space.from_unit(search.best), search.count, is_complete=True)


class _CondensedSearch:
    """A search in progress: the best point by its merit over all cases, and the number of candidates simulated."""

    def __init__(
        self,
        simulator: Simulator,
        spec: Specification,
        method: Condensed,
        scale: float,
        start: Array,
        report_progress: ProgressCallback,
    ) -> None:
        self._simulator, self._spec, self._method, self._scale = simulator, spec, method, scale
        self._report_progress = report_progress
        self._rollout = sensitivity_rollout(simulator)
        self._rng = np.random.default_rng(method.seed)
        self.best, self._best_merit, self.count, self._objective_scale = np.clip(start, 0.0, 1.0), np.inf, 0, 1.0

    def run(self) -> None:
        """Screen, descend, restart, raise penalties and take in worse cases, in that order, then polish."""
        method, spec = self._method, self._spec
        population = first_population(method.members, self.best, self._rng)
        cases = self._worst_cases(population[:RANKING_POINTS])
        points = self._search(population, cases)
        for _ in range(method.restarts):
            anew = first_population(method.members, self._rng.random(len(self.best)), self._rng)
            points = self._select_best(np.vstack([points, self._search(anew, cases)]))
            self._polish(cases)
            points = self._select_best(np.vstack([points, self.best[None], *self._jump(points, cases)]))
        for _ in range(MAX_PENALTY_RAISES):
            if not self._violates_limits():
                break
            self._objective_scale *= 10.0
            points = self._select_best(self._descend(points, cases, spec, method.iterations))
        for _ in range(method.rounds - 1):
            missed = self._worse_cases(cases, points)
            if not missed:
                break
            cases = [*cases, *missed]
            points = self._select_best(self._descend(points, cases, spec, method.iterations))
        self._polish(cases)

    def _search(self, population: Array, cases: Sequence[int]) -> Array:
        """Screen a population and descend from its best points; the optima, the best first."""
        method = self._method
        starts = self._screen(population, cases, method.generations)
        return self._select_best(self._descend(starts, cases, self._spec, method.iterations))

    def _polish(self, cases: Sequence[int]) -> None:
        """Improve the best point on the finer nodes."""
        if self._method.polish:
            self._select_best(self._descend(self.best[None], cases, self._spec, self._method.polish, is_last=True))

    def _screen(self, population: Array, cases: Sequence[int], generations: int) -> Array:
        """Evolve a population over several bands at once; its best points, at a distance from each other."""
        simulator, space = self._simulator.select_cases(cases), self._simulator.space
        merit = MeritFunction(simulator.coarse(self._spec, self._bands), space, self._spec, self._scale, population[0])
        merits, worst = merit.race(population, np.full(len(population), np.inf), None)
        for _ in range(generations):
            population, merits, worst = evolve(population, merits, worst, merit, self._rng)
        if self._best_merit == np.inf:
            self.best, self._objective_scale = merit.best, self._objective(merit.best)
        self._report_progress(f"screening over {1 + len(self._bands)} bands: best {merits.min():.4g}")
        self.count += merit.count + len(population)
        merits = MeritFunction(simulator.coarse(self._spec), space, self._spec, self._scale, merit.best)(population)
        return _distinct_points(population, merits)[: self._method.keep]

    def _jump(self, points: Array, cases: Sequence[int]) -> list[Array]:
        """Descend from the best point with one parameter that is not the PID's put elsewhere; only new optima count."""
        names, method = self._simulator.space.names, self._method
        others = [k for k, n in enumerate(names) if not n.startswith("pid.")]
        jumps = [
            (k, place) for k in others for place in RESTART_FRACTIONS if abs(place - self.best[k]) > MIN_POINT_DISTANCE
        ]
        if not jumps:
            return []
        starts = np.tile(self.best, (len(jumps), 1))
        for start, (k, place) in zip(starts, jumps, strict=True):
            start[k] = place
        found = self._descend(starts, cases, self._spec, JUMP_ITERATIONS)
        known = np.vstack([points, self.best[None]])
        new = found[np.abs(found[:, None] - known).max(axis=2).min(axis=1) > MIN_POINT_DISTANCE][: method.keep]
        return [self._descend(new, cases, self._spec, method.iterations)] if len(new) else []

    @cached_property
    def _bands(self) -> list[float]:
        """The method's settling bands that are wider than the one asked for."""
        return [band for band in self._method.bands if band > self._spec.band]

    def _objective(self, unit: Array) -> float:
        """The objective's size at a point, which sets that of the penalties.

        Penalties ten times as large hold a search in the first basin that it meets.
        """
        simulator, spec = self._simulator, self._spec
        values = to_records(simulator.values(simulator.space.from_unit(unit[None]), spec))[0]
        unknown = {"SettlingTime": self._scale}
        return spec.objective({n: v if np.isfinite(v) else unknown.get(n, 1.0) for n, v in values.items()})

    def _descend(
        self, unit: Array, cases: Sequence[int], spec: Specification, most: int, *, is_last: bool = False
    ) -> Array:
        """Improve points by quadratic programs, on coarse samples but for the last time; distinct, the best first."""
        inside, simulator = spec.tighten(PROGRAM_MARGIN, PROGRAM_MARGIN), self._simulator.select_cases(cases)
        simulator = simulator if is_last else simulator.coarse(spec)
        problem = LinearisedProblem(
            simulator, self._rollout, inside, self._method.nodes[is_last], self._objective_scale
        )
        found: list[LinearisedPoint] = descend(problem, problem.start(unit), most, self._method.steps)
        self.count += problem.count
        merits = np.array([point.merit for point in found])
        self._report_progress(f"programs on {len(cases)} cases: best {merits.min():.4g}")
        return _distinct_points(np.array([point.z[:-1] for point in found]), merits)

    def _select_best(self, unit: Array) -> Array:
        """Rank points by their merits over all cases, keep the best as `best`, and return the best few in order."""
        merits = compute_merits(
            self._simulator.values(self._simulator.space.from_unit(unit), self._spec), self._spec, self._scale
        )
        self.count += len(unit)
        if merits.min() < self._best_merit:
            self.best, self._best_merit = unit[np.argmin(merits)], float(merits.min())
        return _distinct_points(unit, merits)[: self._method.keep]

    def _violates_limits(self) -> bool:
        """Whether the best point breaks a limit, for then the penalties were too small."""
        values = self._simulator.values(self._simulator.space.from_unit(self.best[None]), self._spec)
        return bool(self._spec.violations(to_records(values)[0]))

    def _merits_by_case(self, unit: Array) -> Array:
        """The merit of each point on each case, margins left out, shape (m, n_cases)."""
        responses = self._simulator.respond(self._simulator.space.from_unit(unit), self._spec.band)
        self.count += len(unit)
        plain = self._spec.without(ROBUSTNESS_REQUIREMENTS)
        if plain.weight(ROBUSTNESS_REQUIREMENTS):
            return np.zeros((len(unit), len(self._simulator.cases)))
        return responses.to_table(compute_merits(responses.by_case(), plain, self._scale))

    def _worst_cases(self, unit: Array) -> list[int]:
        """The cases with the worst mean rank over some points; all of them if they are few."""
        count = len(self._simulator.cases)
        if count <= self._method.working:
            return list(range(count))
        ranks = np.argsort(np.argsort(self._merits_by_case(unit), axis=1), axis=1).mean(axis=0)
        return sorted(np.argsort(-ranks, kind="stable")[: self._method.working].tolist())

    def _worse_cases(self, cases: Sequence[int], unit: Array) -> list[int]:
        """Cases outside the working set that are worse, at their worst over these points, than every case within."""
        if len(cases) == len(self._simulator.cases):
            return []
        merits = self._merits_by_case(np.vstack([self.best[None], unit])).max(axis=0)
        others = [k for k in range(len(merits)) if k not in set(cases) and merits[k] > merits[list(cases)].max()]
        return sorted(others, key=lambda k: -merits[k])[: self._method.working // 2]


def _distinct_points(unit: Array, merits: Array) -> Array:
    """The points in order of merit; one that lies close to a better one is dropped."""
    found = list[Array]()
    for k in np.argsort(merits, kind="stable"):
        if all(np.max(np.abs(unit[k] - other)) > MIN_POINT_DISTANCE for other in found):
            found.append(unit[k])
    return np.array(found)
