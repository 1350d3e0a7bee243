"""`Screening`: a search by compiled simulation, differential evolution over narrowing bands and then Nelder-Mead.

It tunes any loop, with friction, clip and sampling. A search that begins with a narrow settling band stalls where no
candidate settles within it; candidates that settle within 10 % lead it to those that settle within 2 %.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.optimize import minimize

from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import ROBUSTNESS_REQUIREMENTS
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.merit import SIMULATION_PEAK_MARGIN, BestPoint, compute_merits, screening_result
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.responses import Responses
from pneuopt.tuning.shade import first_population
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space


@dataclass(frozen=True)
class Screening:
    """Tune any loop by differential evolution on compiled simulations, then by Nelder-Mead from the best point.

    Parameters
    ----------
    members : int
        Candidates in the population.
    generations : int
        Generations in each stage; there is one for each of `bands`, and two for the band asked for.
    bands : tuple of float
        Settling bands of the first stages, as far as they are wider than the one asked for.
    refinements : int
        Simulations of the local search, at most.
    margin : float
        How much tighter the search's limits are than those asked for, a fraction.
    seed : int
        Of the random numbers.
    digits : int, optional
        Significant digits to which the gains are rounded; None: all.
    """

    members: int = 40
    generations: int = 15
    bands: tuple[float, ...] = (0.1, 0.05)
    refinements: int = 300
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4

    peak_margin: ClassVar[float] = SIMULATION_PEAK_MARGIN
    parameters_without_effect: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        require(self.members >= 5, f"Screening: members must be at least 5, got {self.members}")
        require(self.generations >= 1, f"Screening: generations must be at least 1, got {self.generations}")
        require(self.refinements >= 0, f"Screening: refinements must not be negative, got {self.refinements}")
        require(0 <= self.margin < 1, f"Screening: margin is a fraction below 1, got {self.margin}")
        require(self.digits is None or self.digits >= 2, f"Screening: digits must be at least 2, got {self.digits}")

    @property
    def successor(self) -> None:
        """No method follows this one: its answer is final."""

    def check(self, task: TuningTask) -> None:
        """Accept every task: a simulation can be searched whatever the loop."""

    def suits(self, task: TuningTask) -> bool:  # noqa: ARG002
        """Whether it could be chosen: always."""
        return True

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
        best = run_screening(simulator, task.references, task.space, spec, self, start, progress)
        return screening_result(task, simulator, spec, best)

    def shorten(self, margin: float) -> "Screening":
        """The method for a short search from a point that is close."""
        return short_screening(margin, self.digits)

    def limit_path(self, task: TuningTask, spec: Specification) -> None:
        """No path: each set of limits needs a new search."""


def run_screening(
    simulator: Simulator,
    references: Sequence[Step],
    space: Space,
    spec: Specification,
    method: Screening,
    start: Array,
    report_progress: ProgressCallback,
) -> BestPoint:
    """Search by differential evolution and Nelder-Mead; Ctrl-C ends the search with the best point so far.

    Parameters
    ----------
    simulator : Simulator
    spec : Specification
        Already tightened.
    start : ndarray, shape (n,)
        A member of the first population.
    report_progress : callable
        Receives a line of text a generation.
    """
    merit = MeritFunction(simulator, space, spec, min(r.horizon - r.at for r in references), space.to_unit(start))
    try:
        _search(merit, spec, method, report_progress)
    except KeyboardInterrupt:
        return BestPoint(space.from_unit(merit.best), merit.count, is_complete=False)
    return BestPoint(space.from_unit(merit.best), merit.count, is_complete=True)


def _search(merit: "MeritFunction", spec: Specification, method: Screening, report_progress: ProgressCallback) -> None:
    """Evolve a population over the bands, from wide to narrow, and refine the best; `merit` keeps it."""
    rng = np.random.default_rng(method.seed)
    population = first_population(method.members, merit.best, rng)
    for band in [*(b for b in method.bands if b > spec.band), spec.band, spec.band]:
        merit.set_specification(spec.with_band(band))
        merits, worst = merit.race(population, np.full(len(population), np.inf), None)
        for number in range(method.generations):
            population, merits, worst = evolve(population, merits, worst, merit, rng)
            report_progress(
                f"band {band:.3g}, generation {number + 1} of {method.generations}: best {merits.min():.4g}"
            )
    if method.refinements:
        _refine(merit.best, merit, method.refinements)


def short_screening(margin: float, digits: int | None) -> Screening:
    """The settings of a short search from a point that is close, which wide bands would lead away from."""
    return Screening(24, 8, (), 200, margin, digits=digits)


class MeritFunction:
    """The merit of points of the unit cube, one a row; it counts them and keeps the best by the present specification.

    Attributes
    ----------
    best : ndarray, shape (n,)
    count : int
        Candidates simulated, on one case or more.
    """

    def __init__(self, simulator: Simulator, space: Space, spec: Specification, scale: float, start: Array) -> None:
        self._simulator, self._space, self._spec, self._scale = simulator, space, spec, scale
        self.best, self._best_merit, self.count = start, np.inf, 0

    def set_specification(self, spec: Specification) -> None:
        """Use another specification from now on; the best point so far no longer counts."""
        self._spec, self._best_merit = spec, np.inf

    def __call__(self, unit: Array) -> Array:
        """The merit of each point, on every case."""
        return self.race(unit, np.full(len(unit), np.inf), None)[0]

    def race(self, unit: Array, rivals: Array, first: Indices | None) -> tuple[Array, Indices]:
        """Compute the merit of points that beat their rivals, and for the others a lower bound above their rival's.

        Parameters
        ----------
        unit : ndarray, shape (m, n)
        rivals : ndarray, shape (m,)
            The merits to beat.
        first : ndarray of int, shape (m,), or None
            The case on which each point is simulated first, its rival's worst: most losers need no other.

        Returns
        -------
        merits : ndarray, shape (m,)
        worst : ndarray of int, shape (m,)
            Each point's worst case.
        """
        self.count += len(unit)
        points, C = self._space.from_unit(np.clip(unit, 0.0, 1.0)), len(self._simulator.cases)
        if first is None or C == 1:
            merits, worst, _ = self._evaluate(points, None, rivals, {})
        else:
            opening = np.arange(C) == first[:, None]
            merits, worst, seen = self._evaluate(points, opening, rivals, {})
            able = merits <= rivals
            if able.any():
                seen = {n: value[able] for n, value in seen.items()}
                merits[able], worst[able], _ = self._evaluate(points[able], ~opening[able], rivals[able], seen)
        k = int(np.argmin(merits))
        if merits[k] < self._best_merit:
            self.best, self._best_merit = unit[k], float(merits[k])
        return merits, worst

    def _evaluate(
        self, points: Array, lanes: Mask | None, rivals: Array, seen: Mapping[str, Array]
    ) -> tuple[Array, Indices, dict[str, Array]]:
        """Compute merits, worst cases and values over the cases of `lanes` and the values `seen` on others before.

        Margins, a frequency response each, cost as much as a simulation. A limit on them can only raise a merit, so
        they are computed for points that can still beat their rival.
        """
        given = () if lanes is None else (lanes,)
        responses = self._simulator.respond(points, self._spec.band, *given)
        plain = self._spec.without(ROBUSTNESS_REQUIREMENTS)
        values = _elementwise_max(responses.values, seen)
        merits = np.full(len(points), -np.inf)
        if not self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            merits = compute_merits(values, plain, self._scale)
        if self._spec.concerns(ROBUSTNESS_REQUIREMENTS):
            ahead = merits <= rivals
            margins = {n: np.full(len(points), -np.inf) for n in self._simulator.margin_metrics}
            robust = responses.with_margins(ahead)
            for n, value in margins.items():
                value[ahead] = robust[n]
            values = _elementwise_max({**values, **margins}, seen)
            merits[ahead] = compute_merits({n: value[ahead] for n, value in values.items()}, self._spec, self._scale)
        return merits, self._worst_case(responses, plain), values

    def _worst_case(self, responses: Responses, plain: Specification) -> Indices:
        """Each point's case with the largest merit, margins left out, shape (m,)."""
        if len(self._simulator.cases) == 1 or self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            return np.zeros(len(responses.values["Excess"]), dtype=np.intp)
        table = responses.to_table(compute_merits(responses.by_case(), plain, self._scale))
        return np.asarray(np.argmax(table, axis=1))


def _elementwise_max(values: Mapping[str, Array], seen: Mapping[str, Array]) -> dict[str, Array]:
    """The larger of both, by name; a name that was not `seen` keeps its values."""
    return {n: np.maximum(value, seen[n]) if n in seen else value for n, value in values.items()}


def evolve(
    population: Array, merits: Array, worst: Indices, merit: MeritFunction, rng: np.random.Generator
) -> tuple[Array, Array, Indices]:
    """Advance a population by one generation of differential evolution.

    About half of the trial points lie between a member and the best, the others about a member drawn at random.

    Returns
    -------
    population : ndarray, shape (m, n)
    merits : ndarray, shape (m,)
    worst : ndarray of int, shape (m,)
        Each member's worst case.
    """
    m, n = population.shape
    a, b, c = (rng.permutation(m) for _ in range(3))
    factor = rng.uniform(0.4, 0.9, (m, 1))
    best = population[np.argmin(merits)]
    towards = population + factor * (best - population) + factor * (population[a] - population[b])
    away = population[c] + factor * (population[a] - population[b])
    mutant = np.where(rng.random((m, 1)) < 0.5, towards, away)
    mutant = np.where((mutant < 0) | (mutant > 1), rng.random((m, n)) * 0.5 + 0.5 * population, mutant)
    kept = rng.random((m, n)) < 0.1
    kept[np.arange(m), rng.integers(n, size=m)] = False
    trial = np.where(kept, population, mutant)
    found, cases = merit.race(trial, merits, worst)
    better = found <= merits
    population = np.where(better[:, None], trial, population)
    return population, np.where(better, found, merits), np.where(better, cases, worst)


def _refine(best: Array, merit: MeritFunction, most: int) -> None:
    """Search by Nelder-Mead from a small simplex about the best point; `merit` keeps the best it sees."""
    steps = np.where(best < 0.5, 0.03, -0.03) * np.eye(len(best))
    options = {"maxfev": most, "initial_simplex": np.vstack([best, best + steps]), "xatol": 1e-5, "fatol": 1e-7}
    settings: Any = {"method": "Nelder-Mead", "bounds": [(0.0, 1.0)] * len(best), "options": options}

    def cost(unit: Array) -> float:
        return float(merit(unit[None])[0])

    minimize(cost, best, **settings)
