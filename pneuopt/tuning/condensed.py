"""Search by gradients: a short screening over ever narrower settling bands, then condensed multiple shooting.

For many gains and many scenarios. Gradients find the nearest optimum only, and directly at a narrow band nothing that
settles is in sight: the screening finds where to start. Programs at the wider bands too (`generations` of 0 from some
band on) found as good optima of T32 with eight gains, but with five ended in worse ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.reference import Step
from pneuopt.errors import require
from pneuopt.nlp.sqp import SQP, Point, descend
from pneuopt.requirements import MaxSensitivity, Overshoot, PeakControl, SettlingTime, SteadyStateError, name
from pneuopt.specification import Specification
from pneuopt.tuning.candidates import Space, Tell
from pneuopt.tuning.linearised import Linearised, differentiated
from pneuopt.tuning.screening import Judge, Screened, first_population, generation, merit
from pneuopt.tuning.simulator import Simulator, each

Array = NDArray[np.float64]
SMOOTH = (SettlingTime, Overshoot, SteadyStateError, PeakControl, MaxSensitivity)  # what gradients are there for
UNFELT = ("dither.frequency", "pid.Tt", "pid.lower", "pid.upper")  # gradients are wrong or useless there
APART = 0.03  # of a gain's range: two points closer than that are one
INSIDE = 0.005  # by which the programs' band and limits are tighter: a solution lies on them, and grazes them
STIFFER = 2  # times that the penalties are raised tenfold, where they did not keep the limits
FEW = 12  # points that rank the scenarios


@dataclass(frozen=True)
class Condensed:
    """Condensed multiple shooting: sequential quadratic programs on compiled simulations with sensitivities.

    Parameters
    ----------
    members : int
        Of the screening by differential evolution.
    bands : tuple of float
        Settling bands on the way, as far as they are wider than the one asked for, which comes last.
    generations : tuple of int
        Of the screening, at each of `bands` and the one asked for; the programs begin at the last band that has some.
    keep, iterations : tuple of int
        Points that the programs improve at each band, and how often.
    working : int
        Cases, the worst, that the programs see at a time.
    rounds : int
        Of taking in cases that turn out to be worse.
    nodes : tuple of int
        At which a response is read: on the way, and in the final polish.
    polish : int
        Iterations on the finer nodes.
    margin : float
        How much tighter the search's limits are than those asked for.
    seed : int
    digits : int, optional
        Significant digits of the gains handed out; None: all.
    steps : SQP
    """

    members: int = 40
    bands: tuple[float, ...] = (0.1, 0.05, 0.03)
    generations: tuple[int, ...] = (8, 6, 6, 8)
    keep: tuple[int, ...] = (6, 5, 5, 5)
    iterations: tuple[int, ...] = (6, 6, 6, 25)
    working: int = 12
    rounds: int = 3
    nodes: tuple[int, int] = (500, 2000)
    polish: int = 10
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4
    steps: SQP = field(default_factory=SQP)

    def __post_init__(self) -> None:
        stages = len(self.bands) + 1
        told = (
            f"Condensed: generations, keep and iterations need {stages} numbers, one a band and one for that asked for"
        )
        require(len(self.generations) == len(self.keep) == len(self.iterations) == stages, told)
        require(
            max(self.generations) >= 1, "Condensed: without a generation at any band there is nothing to start from"
        )
        require(min(self.keep) >= 1, f"Condensed: keep must be at least 1, got {self.keep}")
        require(self.members >= 5, f"Condensed: members must be at least 5, got {self.members}")
        require(self.working >= 1, f"Condensed: working must be at least 1, got {self.working}")
        require(min(self.nodes) >= 50, f"Condensed: nodes must be at least 50, got {self.nodes}")
        require(0 <= self.margin < 1, f"Condensed: margin is a fraction below 1, got {self.margin}")
        require(self.digits is None or self.digits >= 2, f"Condensed: digits must be at least 2, got {self.digits}")


def check_differentiable(space: Space, spec: Specification) -> None:
    """Refuse what gradients cannot do: `InputError` names it and the remedy."""
    strange = [*_strange(spec), *_unfelt(space)]
    require(not strange, f"Condensed has no gradient for {', '.join(strange)}; use method=Screening()")


def is_differentiable(space: Space, spec: Specification) -> bool:
    """Whether there are gradients of all requirements to all that is free."""
    return not _strange(spec) and not _unfelt(space)


def _strange(spec: Specification) -> list[str]:
    return [name(q) for q in (*spec.weights, *spec.limits) if not isinstance(q, SMOOTH)]


def _unfelt(space: Space) -> list[str]:
    return [n for n in space.names if n in UNFELT]


def condense(
    simulator: Simulator,
    references: Sequence[Step],
    space: Space,
    spec: Specification,
    method: Condensed,
    start: Array,
    tell: Tell,
) -> Screened:
    """The best point found; Ctrl-C ends the search with the best so far.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        Already tightened.
    start : ndarray, shape (n,)
        A member of the first population.
    tell : callable
        Hears of each stage.
    """
    check_differentiable(space, spec)
    scale = min(r.horizon - r.at for r in references)
    search = _Condensing(simulator, spec, method, scale, space.unit(start), tell)
    try:
        search.run()
    except KeyboardInterrupt:
        return Screened(space.draw(search.best), search.count, is_complete=False)
    return Screened(space.draw(search.best), search.count, is_complete=True)


class _Condensing:
    """The search's state: the best point by exact merit over all cases, and what it took."""

    def __init__(
        self, simulator: Simulator, spec: Specification, method: Condensed, scale: float, start: Array, tell: Tell
    ) -> None:
        self._simulator, self._spec, self._method, self._scale, self._tell = simulator, spec, method, scale, tell
        self._rollout = differentiated(simulator)
        self._rng = np.random.default_rng(method.seed)
        self.best, self._least, self.count, self._size = np.clip(start, 0.0, 1.0), np.inf, 0, 1.0

    def run(self) -> None:
        method, spec = self._method, self._spec
        population = first_population(method.members, self.best, self._rng)
        cases = self._hardest(population[:FEW])
        stages = list(zip((*method.bands, spec.band), method.generations, method.keep, method.iterations, strict=True))
        stages = [s for s in stages if s[0] > spec.band] + stages[-1:]
        begin = max((k for k, stage in enumerate(stages) if stage[1]), default=0)
        points = self._screened(population, cases, [stage[:2] for stage in stages[: begin + 1]])
        for band, _, keep, most in stages[begin:]:
            points = self._descended(points[:keep], cases, spec.with_band(band), most, method.nodes[0])
        self._judge(points)
        for _ in range(STIFFER):
            if not self._breaks():
                break
            self._size *= 10.0
            points = self._descended(points, cases, spec, method.iterations[-1], method.nodes[0])
            self._judge(points)
        for _ in range(method.rounds - 1):
            missed = self._missed(cases, points)
            if not missed:
                break
            cases = [*cases, *missed]
            points = self._descended(points, cases, spec, method.iterations[-1], method.nodes[0])
            self._judge(points)
        if method.polish:
            self._judge(self._descended(self.best[None], cases, spec, method.polish, method.nodes[1]))

    def _screened(self, population: Array, cases: Sequence[int], stages: Sequence[tuple[float, int]]) -> Array:
        """The best points of a short differential evolution, apart from each other."""
        simulator, space = self._simulator.only(cases), self._simulator.space
        judge = Judge(simulator, space, self._spec, self._scale, self.best)
        merits = np.zeros(len(population))
        for band, count in stages:
            judge.ask(self._spec.with_band(band))
            merits, worst = judge.race(population, np.full(len(population), np.inf), None)
            for _ in range(count):
                population, merits, worst = generation(population, merits, worst, judge, self._rng)
            self.best = judge.best
            self._tell(f"screening at a band of {band:.3g}: best {merits.min():.4g}")
        self.count += judge.count
        self._size = self._objective(judge.best)
        return _apart(population, merits)

    def _objective(self, unit: Array) -> float:
        """What the objective is of the order of: the horizon for a settling time, for what else there is a value."""
        simulator, spec = self._simulator, self._spec
        values = each(simulator.values(simulator.space.draw(unit[None]), spec))[0]
        known = {n: v if np.isfinite(v) else 1.0 for n, v in values.items()}
        return spec.objective({**known, "SettlingTime": self._scale})

    def _descended(self, unit: Array, cases: Sequence[int], spec: Specification, most: int, nodes: int) -> Array:
        """Improved points, the best first."""
        inside = spec.tightened(INSIDE, INSIDE)
        problem = Linearised(self._simulator.only(cases), self._rollout, inside, nodes, self._size)
        found: list[Point] = descend(problem, problem.start(unit), most, self._method.steps)
        self.count += problem.count
        merits = np.array([point.merit for point in found])
        self._tell(f"band {spec.band:.3g}, {len(cases)} cases: best {merits.min():.4g}")
        return _apart(np.array([point.z[:-1] for point in found]), merits)

    def _judge(self, unit: Array) -> None:
        """Exact merits over all cases; the best is kept."""
        merits = merit(self._simulator.values(self._simulator.space.draw(unit), self._spec), self._spec, self._scale)
        self.count += len(unit)
        if merits.min() < self._least:
            self.best, self._least = unit[np.argmin(merits)], float(merits.min())

    def _breaks(self) -> bool:
        """Whether the best point breaks a limit: then the penalties were too small."""
        values = self._simulator.values(self._simulator.space.draw(self.best[None]), self._spec)
        return bool(self._spec.violated(each(values)[0]))

    def _by_case(self, unit: Array) -> Array:
        """Merits of each case, the sensitivity left out, shape (m, n_cases)."""
        responses = self._simulator.respond(self._simulator.space.draw(unit), self._spec.band)
        self.count += len(unit)
        plain = self._spec.without(MaxSensitivity)
        if plain.weight(MaxSensitivity):
            return np.zeros((len(unit), len(self._simulator.cases)))
        return responses.spread(merit(responses.by_case(), plain, self._scale))

    def _hardest(self, unit: Array) -> list[int]:
        """The cases that rank worst for most of some points; all if they are few."""
        count = len(self._simulator.cases)
        if count <= self._method.working:
            return list(range(count))
        ranks = np.argsort(np.argsort(self._by_case(unit), axis=1), axis=1).mean(axis=0)
        return sorted(np.argsort(-ranks, kind="stable")[: self._method.working].tolist())

    def _missed(self, cases: Sequence[int], unit: Array) -> list[int]:
        """Cases outside the working set that are worse for the best point than all within."""
        if len(cases) == len(self._simulator.cases):
            return []
        merits = self._by_case(np.vstack([self.best[None], unit])).max(axis=0)
        others = [k for k in range(len(merits)) if k not in set(cases) and merits[k] > merits[list(cases)].max()]
        return sorted(others, key=lambda k: -merits[k])[: self._method.working // 2]


def _apart(unit: Array, merits: Array) -> Array:
    """The points in order of merit, without those that lie close to a better one."""
    found = list[Array]()
    for k in np.argsort(merits, kind="stable"):
        if all(np.max(np.abs(unit[k] - other)) > APART for other in found):
            found.append(unit[k])
    return np.array(found)
