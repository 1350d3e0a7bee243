"""`Racing`: the search by simulation, success-history differential evolution whose trials race over the cases.

It tunes any loop, with friction, clip and sampling, for any requirements and scenarios. A trial is simulated first on
the case that its parent finds worst, and is dropped as soon as it is certain to lose. Each number of times that a
response leaves a narrow band makes an optimum of its own: the mean settling time over wide and narrow bands leads the
search across them, on coarse samples; then the band asked for counts, and at last, for the best points only, on fine
samples.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.method import SearchResult, TuningTask
from pneuopt.tuning.race import Race, may_be_cut
from pneuopt.tuning.screening import (
    SIMULATION_PEAK_MARGIN,
    BestPoint,
    first_population,
    screening_result,
)
from pneuopt.tuning.shade import SuccessHistory
from pneuopt.tuning.simulator import Simulator

# Shares of the trials that the phases get: wide bands and the band asked for on coarse samples, then fine samples. Less
# for the first ends in the nearest optimum; less for the last leaves an optimum of the coarse samples.
PHASE_SHARES = (0.5, 0.3, 0.2)
# Generations over which the best merit must improve by this share for a phase to go on, and the spread of the whole
# population, a share of its best, below which it ends. Shorter or larger ends a search that still advances.
PATIENCE, LEAST_PROGRESS, LEAST_SPREAD = 25, 1e-3, 1e-4
# Share of the population that the phase on fine samples keeps. Fewer lose the optimum where coarse and fine samples
# rank points differently; each more costs fine simulations.
FINE_SHARE = 0.5
# Best settling times, and shares of the horizon, that a race sees of each response, whichever is longer. Less takes for
# settled what leaves the band later; more simulates what seldom changes a merit. Each new best is proved on the whole.
CUT_SETTLING_TIMES, LEAST_CUT = 3.0, 0.15
NEARBY = 0.05  # spread about a start that is close, a share of each range: a wider one leaves it, a narrower one sticks


@dataclass(frozen=True)
class Racing:
    """Tune any loop by success-history differential evolution on compiled simulations, trials racing over the cases.

    Parameters
    ----------
    members : int
        Candidates in the population.
    trials : int
        Trials for each free gain, at most: a search ends sooner where it no longer advances.
    bands : tuple of float
        Settling bands over which the first phase takes the mean settling time, as multiples of the one asked for.
    margin : float
        How much tighter the search's limits are than those asked for, a fraction.
    seed : int
        Of the random numbers.
    digits : int, optional
        Significant digits to which the gains are rounded; None: all.
    """

    members: int = 40
    trials: int = 900
    bands: tuple[float, ...] = (1.5, 2.5, 5.0)
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4

    peak_margin: ClassVar[float] = SIMULATION_PEAK_MARGIN
    parameters_without_effect: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        require(self.members >= 5, f"Racing: members must be at least 5, got {self.members}")
        require(self.trials >= 1, f"Racing: trials must be at least 1, got {self.trials}")
        require(all(b > 1 for b in self.bands), f"Racing: bands are multiples of the one asked for, got {self.bands}")
        require(0 <= self.margin < 1, f"Racing: margin is a fraction below 1, got {self.margin}")
        require(self.digits is None or self.digits >= 2, f"Racing: digits must be at least 2, got {self.digits}")

    @property
    def successor(self) -> None:
        """No method follows this one: its answer is final."""

    def check(self, task: TuningTask) -> None:
        """Accept every task: a simulation can be searched whatever the loop."""

    def suits(self, task: TuningTask) -> bool:  # noqa: ARG002
        """Whether it is the one to choose: always."""
        return True

    def find(
        self,
        task: TuningTask,
        simulator: Simulator,
        spec: Specification,
        start: Array,
        attempt: int,
        progress: ProgressCallback,
    ) -> SearchResult:
        """Search for the best point, from one that is close where a certificate has failed; see `Method.find`."""
        method = replace(self, bands=(), trials=max(1, self.trials // 3)) if attempt else self
        best = run_racing(task, simulator, spec, method, start, progress)
        return screening_result(task, simulator, spec, best)

    def shorten(self, margin: float) -> "Racing":
        """The method for a short search from a point that is close."""
        return Racing(24, max(1, self.trials // 6), (), margin, digits=self.digits)

    def limit_path(self, task: TuningTask, spec: Specification) -> None:
        """No path: each set of limits needs a new search."""


class _Phase(NamedTuple):
    """A part of a search: what it reads, on which samples, how many members it keeps and trials it may take."""

    name: str
    simulator: Simulator
    members: int
    trials: int


def run_racing(
    task: TuningTask,
    simulator: Simulator,
    spec: Specification,
    method: Racing,
    start: Array,
    progress: ProgressCallback,
) -> BestPoint:
    """Search in phases; Ctrl-C ends the search with the best point so far.

    Parameters
    ----------
    task : TuningTask
    simulator : Simulator
    spec : Specification
        Already tightened.
    method : Racing
        Without `bands` it searches about the start.
    start : ndarray, shape (n,)
        A member of the first population.
    progress : callable
        Receives a line of text a generation.
    """
    rng, space = np.random.default_rng(method.seed), simulator.space
    search = _RacingSearch(simulator, spec, task.horizon, space.to_unit(start), rng, progress)
    population = first_population(method.members, search.best, rng)
    if not method.bands:
        population[1:] = _near(search.best, population[1:], rng)
    try:
        for phase in _phases(simulator, spec, method):
            population = search.evolve(population, phase)
    except KeyboardInterrupt:
        return BestPoint(space.from_unit(search.best), search.count, is_complete=False)
    return BestPoint(space.from_unit(search.best), search.count, is_complete=True)


def _phases(simulator: Simulator, spec: Specification, method: Racing) -> Iterator[_Phase]:
    """The phases of a search; the wide bands only where a settling time is asked for."""
    trials, (wide, narrow, fine) = method.trials * len(simulator.space.names), PHASE_SHARES
    bands = [spec.band * b for b in method.bands if spec.band * b < 1] if spec.concerns(SettlingTime) else []
    if bands:
        yield _Phase("wide bands", simulator.coarse(spec, bands), method.members, round(wide * trials))
    else:
        narrow += wide
    yield _Phase("coarse samples", simulator.coarse(spec), method.members, round(narrow * trials))
    few = max(5, round(FINE_SHARE * method.members))
    yield _Phase("fine samples", simulator, few, round(fine * trials))


def _near(best: Array, others: Array, rng: np.random.Generator) -> Array:
    """Points about the best one, in place of half of the others."""
    close = np.clip(best + NEARBY * rng.standard_normal(others.shape), 0.0, 1.0)
    return np.where((np.arange(len(others)) % 2 == 0)[:, None], close, others)


class _RacingSearch:
    """A search in progress: the best point of the present phase, and the number of trials simulated."""

    def __init__(
        self,
        simulator: Simulator,
        spec: Specification,
        scale: float,
        start: Array,
        rng: np.random.Generator,
        progress: ProgressCallback,
    ) -> None:
        self._simulator, self._space, self._spec, self._scale = simulator, simulator.space, spec, scale
        self._rng, self._progress = rng, progress
        self.best, self.count = np.clip(start, 0.0, 1.0), 0

    def evolve(self, population: Array, phase: _Phase) -> Array:
        """Evolve a population through a phase; the points in which it ends, the best first."""
        race, before, bests = Race(phase.simulator, self._spec, self._scale), self.count, list[float]()
        merits, worst = race.merits(self._space.from_unit(population))
        order = np.argsort(merits, kind="stable")[: phase.members]
        history, worst = SuccessHistory(population[order], merits[order], self._rng), worst[order]
        self.best, best = history.population[0].copy(), float(history.merits[0])
        self._cut(race)
        for number in range(-(-phase.trials // len(order))):
            trials = history.propose()
            merits, cases = race.race(self._space.from_unit(trials), history.merits, worst)
            merits = self._prove(race, trials, merits, best)
            worst = np.where(history.select(trials, merits), cases, worst)
            self.count = before + race.count
            if history.merits.min() < best:
                best, self.best = float(history.merits.min()), history.population[np.argmin(history.merits)].copy()
                self._cut(race)
            bests.append(best)
            self._progress(f"{phase.name}, generation {number + 1}: best {best:.4g}")
            if _is_done(bests, history.merits):
                break
        return history.population[np.argsort(history.merits, kind="stable")]

    def _prove(self, race: Race, trials: Array, merits: Array, best: float) -> Array:
        """Merits, those that beat the best one on responses cut short replaced by those on whole responses."""
        better = (merits < best) & race.is_cut
        if better.any():
            merits[better] = race.merits(self._space.from_unit(trials[better]))[0]
        return merits

    def _cut(self, race: Race) -> None:
        """Cut the responses of a race to a multiple of the best settling time, where that changes no merit."""
        if not may_be_cut(self._spec):
            return
        values = self._simulator.coarse(self._spec).respond(self._space.from_unit(self.best[None]), self._spec.band)
        settled = float(values.values["SettlingTime"][0])
        if np.isfinite(settled):
            race.cut(max(CUT_SETTLING_TIMES * settled, LEAST_CUT * self._scale))


def _is_done(bests: Sequence[float], merits: Array) -> bool:
    """Whether a population no longer advances: its best stands still, or all its members are alike."""
    stands = len(bests) > PATIENCE and bests[-1] > bests[-1 - PATIENCE] * (1 - LEAST_PROGRESS)
    return stands or bool(np.ptp(merits) <= LEAST_SPREAD * abs(merits.min()))
