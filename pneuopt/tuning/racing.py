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

from pneuopt.evaluation.band import band_share
from pneuopt.evaluation.requirements import SettlingTime
from pneuopt.evaluation.specification import Specification
from pneuopt.quantities.arguments import check_argument, check_number
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import require
from pneuopt.quantities.status import ProgressCallback
from pneuopt.tuning.merit import SIMULATION_PEAK_MARGIN, search_result
from pneuopt.tuning.method import SearchResult, TuningTask, check_method_options
from pneuopt.tuning.polish import Polish
from pneuopt.tuning.race import Race, may_be_cut
from pneuopt.tuning.shade import SuccessHistory, first_population
from pneuopt.tuning.simulator import Simulator

# Shares of the trials that the starts get on coarse samples; the rest is for fine ones. Less for the first ends in the
# nearest optimum, less for the second is no second opinion, less for the rest leaves an optimum of the coarse samples.
START_SHARES = (0.5, 0.35)
# Shares of a start's trials over all bands, and over the nearest wider one. Less ends in the nearest optimum; more
# leaves the band asked for too few.
BAND_SHARES = (0.4, 0.25)
# Generations over which the best merit, or the median, must improve by this share for a phase to go on, and the spread
# of the whole population, a share of its best, below which it ends. Shorter or larger ends a search that still
# advances; so does to look at the best alone, which stands while the others catch up.
PATIENCE, LEAST_PROGRESS, LEAST_SPREAD = 25, 1e-3, 1e-4
# Members of the phase on fine samples. Fewer lose the optimum where coarse and fine samples rank points differently;
# each more costs fine simulations.
FINE_MEMBERS = 20
# Best points of the first start from which the second one begins, and its amplitudes, a share of their range: hardly
# any dither, where optima lie that a population with dither does not see.
FEW_BEST, NO_DITHER = 6, 0.02
# Points, as far from each other as this share of a gain's range, that gradients improve at a time, on whole responses:
# cut ones end at other operating points, whose margins they meet. Fewer or farther points miss basins; each more costs
# a descent, and closer ones end in the same point. A search near its start has fewer trials, so it gets more points.
POLISHED, POLISHED_NEARBY, MIN_DISTANCE = 2, 4, 0.03
AGREEMENT = 0.01  # relative difference of two starts' merits that count as one: larger ones hide a second optimum
# Best merit after the wide bands, over that with which the first start ended, from which on a start is given up; and a
# point's merit over the best, from which on gradients leave it. A smaller one gives up what gradients may still bring
# to the front; a larger one searches on behind it.
LAGGING = 1.3
# Best settling times, and shares of the horizon, that a race sees of each response, whichever is longer. Less takes for
# settled what leaves the band later; more simulates what seldom changes a merit. Each new best is proved on the whole.
CUT_SETTLING_TIMES, LEAST_CUT = 3.0, 0.15
# Trials for each free gain of a short search, unless the whole one has fewer. With 200 the smallest relaxation of one
# gain's limit came out 4 % too large; more cost time where there are many gains.
LEAST_SHORT_TRIALS = 400
# Members of a search, at least: a trial mixes four of them. Share of them in a short search: more take generations
# from its trials, fewer leave it to its start.
LEAST_MEMBERS, SHORT_MEMBERS = 5, 0.6
NEARBY = 0.05  # spread about a start that is close, a share of each range: a wider one leaves it, a narrower one sticks


@dataclass(frozen=True)
class Racing:
    """Tune any loop by success-history differential evolution on compiled simulations, trials racing over the cases.

    Parameters
    ----------
    members : int
        Candidates in the population.
    trials : int
        Trials for each free gain, at most: a search ends sooner where it no longer advances. On the corners of the
        drive in problems/shared/t32.py two seeds that ended at 0.185 s with 600 came to 0.154 s with 1200.
    bands : tuple of float
        Settling bands over which the first phase takes the mean settling time, as multiples of the one asked for.
    polish : int
        Iterations by gradients from each of the best points, where there are gradients of all that is asked for.
    margin : float
        How much tighter the search's limits are than those asked for, a fraction.
    seed : int
        Of the random numbers.
    digits : int, optional
        Significant digits to which the gains are rounded; None: all.
    """

    members: int = 40
    trials: int = 1200
    bands: tuple[float, ...] = (1.5, 2.5, 5.0)
    polish: int = 20
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4

    peak_margin: ClassVar[float] = SIMULATION_PEAK_MARGIN
    parameters_without_effect: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for option in ("members", "trials", "polish"):
            check_number(f"Racing: {option}", getattr(self, option), "a whole number, as 40", whole=True)
        meant = "multiples of the settling band, as (1.5, 2.5)"
        check_argument("Racing: bands", self.bands, (tuple, list), meant)
        for band in self.bands:
            check_number("Racing: bands", band, meant)
        object.__setattr__(self, "bands", tuple(self.bands))
        check_method_options(self)
        require(self.members >= LEAST_MEMBERS, f"Racing: members must be at least {LEAST_MEMBERS}, got {self.members}")
        require(self.trials >= 1, f"Racing: trials must be at least 1, got {self.trials}")
        require(self.polish >= 0, f"Racing: polish must not be negative, got {self.polish}")
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
        result = search_result(task, simulator, spec, best.point)
        counts = {"simulations": best.count, "starts": best.starts, "starts_agreeing": best.agreeing}
        stats = {**result.stats, **{n: float(count) for n, count in counts.items()}}
        return replace(result, stats=stats, is_complete=best.is_complete, uses_simulator=True)

    def shorten(self, margin: float) -> "Racing":
        """The method for a short search from a point that is close."""
        trials = min(self.trials, max(LEAST_SHORT_TRIALS, self.trials // 6))
        members = max(LEAST_MEMBERS, round(SHORT_MEMBERS * self.members))
        return replace(self, members=members, trials=trials, bands=(), margin=margin)

    def limit_path(self, task: TuningTask, spec: Specification) -> None:
        """No path: each set of limits needs a new search."""


@dataclass(frozen=True, eq=False)
class RacingResult:
    """What a search found.

    Parameters
    ----------
    point : ndarray, shape (n,)
        The gains with the least merit.
    count : int
        Candidates simulated.
    is_complete : bool
        False where Ctrl-C cut the search short.
    starts, agreeing : int
        Starts, and how many of them ended within 1 % of the best.
    """

    point: Array
    count: int
    is_complete: bool
    starts: int
    agreeing: int


class _Phase(NamedTuple):
    """A part of a search: what it reads, on which samples, and how many trials it may take."""

    name: str
    simulator: Simulator
    trials: int


def run_racing(
    task: TuningTask,
    simulator: Simulator,
    spec: Specification,
    method: Racing,
    start: Array,
    progress: ProgressCallback,
) -> RacingResult:
    """Search in phases from starts that differ in kind; Ctrl-C ends the search with the best point so far.

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
    try:
        search.run(method)
    except KeyboardInterrupt:
        best = space.from_unit(search.best_so_far())
        return RacingResult(best, search.count, False, search.starts, search.agreeing)
    return RacingResult(space.from_unit(search.best), search.count, True, search.starts, search.agreeing)


def _phases(simulator: Simulator, spec: Specification, method: Racing, share: float) -> Iterator[_Phase]:
    """The phases of a start on coarse samples; wider bands only where a settling time is asked for."""
    trials = share * method.trials * len(simulator.space.names)
    widest = max(band_share(spec.band, grid.reference) for grid in simulator.grids)
    wider = [spec.band * b for b in sorted(method.bands) if widest * b < 1] if spec.concerns(SettlingTime) else []
    stages = [bands for bands in (wider, wider[:1]) if bands]
    for bands, part in zip(stages, BAND_SHARES, strict=False):
        yield _Phase("wide bands", simulator.coarse(spec, bands), round(part * trials))
    yield _Phase("coarse samples", simulator.coarse(spec), round((1 - sum(BAND_SHARES[: len(stages)])) * trials))


def _other_population(method: Racing, names: Sequence[str], best: Array, rng: np.random.Generator) -> Array:
    """A population of another kind than the one that found `best`: with hardly any dither, where it is free.

    Its gains are those of the first one's best points, its offset is drawn anew; without a free dither all is.
    """
    if "dither.amplitude" not in names:
        return first_population(method.members, rng.random(len(names)), rng)
    population = best[np.arange(method.members) % min(FEW_BEST, len(best))]
    population = np.clip(population + NEARBY * rng.standard_normal(population.shape), 0.0, 1.0)
    population[:, names.index("dither.amplitude")] = NO_DITHER * rng.random(method.members)
    if "dither.offset" in names:
        population[:, names.index("dither.offset")] = rng.random(method.members)
    return np.asarray(population)


class _RacingSearch:
    """A search in progress: the best point so far, the number of trials simulated, and how many starts agree."""

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
        self._rng, self._progress, self._coarse = rng, progress, simulator.coarse(spec)
        self._polisher = Polish(simulator, spec)
        self.best, self.count, self.starts, self.agreeing = np.clip(start, 0.0, 1.0), 0, 0, 0
        self._ends, self._polished, self._points = list[Array](), list[Array](), POLISHED

    def run(self, method: Racing) -> None:
        """Search from each start on coarse samples, then from the best of all on fine ones."""
        names, given = self._space.names, self.best
        population = first_population(method.members, given, self._rng)
        if not method.bands:
            population[1:] = _near(given, population[1:], self._rng)
            self._points = POLISHED_NEARBY
        bests = list[float]()
        for share in START_SHARES:
            population, merits = self._search(population, method, share, LAGGING * min(bests, default=np.inf))
            self._ends.append(population)
            bests.append(float(merits[0]))
            self.starts, self.agreeing = len(bests), sum(b <= min(bests) * (1 + AGREEMENT) for b in bests)
            population = _other_population(method, names, population, self._rng)
            if "dither.amplitude" in names:  # the next one begins near the best
                method = replace(method, bands=tuple(sorted(method.bands)[:1]))
        trials = (1 - sum(START_SHARES)) * method.trials * len(names)
        fine = _Phase("fine samples", self._simulator, round(trials))
        self._finish(np.vstack([*self._ends, given]), fine, method.polish)

    def _finish(self, population: Array, fine: _Phase, iterations: int) -> None:
        """Search on fine samples: by gradients from the best points, then by trials, and again where those got on."""
        few = np.vstack([self._best_first(population, self._coarse)[0][:FINE_MEMBERS], *self._polished])
        population, merits = self._polish(*self._best_first(few, fine.simulator), fine.simulator, iterations)
        best = merits[0] * (1 - LEAST_PROGRESS)
        population, merits = self.evolve(population[:FINE_MEMBERS], fine)
        if merits[0] < best:
            self._polish(population, merits, fine.simulator, iterations)

    def best_so_far(self) -> Array:
        """The best of the present phase, which may ask for another band, and of the starts that have ended."""
        points = np.array([self.best, *(end[0] for end in self._ends)])
        merits, _ = Race(self._coarse, self._spec, self._scale).merits(self._space.from_unit(points))
        return np.asarray(points[np.argmin(merits)])

    def _search(self, population: Array, method: Racing, share: float, most: float) -> tuple[Array, Array]:
        """Search from one start on coarse samples: over wide bands first, by gradients, and in the band asked for.

        It ends after the wide bands where the best merit is above `most`.
        """
        *wide, last = _phases(self._simulator, self._spec, method, share)
        for phase in wide:
            population, _ = self.evolve(population, phase)
        if wide:
            population, merits = self._best_first(population, self._simulator)
            if merits[0] > most:
                return population, merits
            population = self._polish(population, merits, self._simulator, method.polish)[0]
            self._polished.append(population[: self._points])
        return self.evolve(population, last)

    def _best_first(self, population: Array, simulator: Simulator) -> tuple[Array, Array]:
        """A population in the order of its merits on whole responses, and these."""
        merits, _ = Race(simulator, self._spec, self._scale).merits(self._space.from_unit(population))
        order = np.argsort(merits, kind="stable")
        return population[order], merits[order]

    def _polish(self, population: Array, merits: Array, simulator: Simulator, iterations: int) -> tuple[Array, Array]:
        """Improve the best points of a population, apart from each other, by gradients; the best first."""
        if not iterations or not self._polisher.is_possible:
            return population, merits
        chosen = _distinct_points(population[merits <= LAGGING * merits[0]])[: self._points]
        self.best = population[0].copy()
        unit, count = self._polisher.improve(population[chosen], simulator, iterations)
        self.count += count
        found = Race(simulator, self._spec, self._scale).merits(self._space.from_unit(unit))[0]
        better = found < merits[chosen]
        population[chosen[better]], merits[chosen[better]] = unit[better], found[better]
        order = np.argsort(merits, kind="stable")
        self.best = population[order[0]].copy()
        self._progress(f"gradients from {len(chosen)} points: best {merits[order[0]]:.4g}")
        return population[order], merits[order]

    def evolve(self, population: Array, phase: _Phase) -> tuple[Array, Array]:
        """Evolve a population through a phase; where it ends, the best first, and their merits."""
        race, before, stand = Race(phase.simulator, self._spec, self._scale), self.count, list[tuple[float, float]]()
        merits, worst = race.merits(self._space.from_unit(population))
        history = SuccessHistory(population, merits, self._rng)
        self.best, best = history.population[0].copy(), float(history.merits[0])
        self._cut(race)
        for number in range(-(-phase.trials // len(population))):
            trials = history.propose()
            merits, cases = race.race(self._space.from_unit(trials), history.merits, worst)
            merits = self._prove(race, trials, merits, best)
            worst = np.where(history.select(trials, merits), cases, worst)
            self.count = before + race.count
            if history.merits.min() < best:
                best, self.best = float(history.merits.min()), history.population[np.argmin(history.merits)].copy()
                self._cut(race)
            stand.append((best, float(np.median(history.merits))))
            self._progress(f"{phase.name}, generation {number + 1}: best {best:.4g}")
            if _is_done(stand, history.merits):
                break
        order = np.argsort(history.merits, kind="stable")
        return history.population[order], history.merits[order]

    def _prove(self, race: Race, trials: Array, merits: Array, best: float) -> Array:
        """Merits, those that beat the best one on responses cut short replaced by those on whole responses."""
        better = (merits < best) & race.is_cut
        if better.any():
            merits[better] = race.merits(self._space.from_unit(trials[better]))[0]
        return merits

    def _cut(self, race: Race) -> None:
        """Cut the responses of a race."""
        race.cut(self._cut_time())

    def _cut_time(self) -> float:
        """A multiple of the best settling time [s], where later samples change no merit; elsewhere infinity."""
        if not may_be_cut(self._spec):
            return np.inf
        values = self._coarse.respond(self._space.from_unit(self.best[None]), self._spec.band)
        settled = float(values.values["SettlingTime"][0])
        return max(CUT_SETTLING_TIMES * settled, LEAST_CUT * self._scale) if np.isfinite(settled) else np.inf


def _distinct_points(unit: Array) -> Indices:
    """Indices of points in their order; one that lies close to one before it is left out."""
    found = list[int]()
    for k in range(len(unit)):
        if all(np.max(np.abs(unit[k] - unit[other])) > MIN_DISTANCE for other in found):
            found.append(k)
    return np.array(found)


def _near(best: Array, others: Array, rng: np.random.Generator) -> Array:
    """Points about the best one, in place of half of the others."""
    close = np.clip(best + NEARBY * rng.standard_normal(others.shape), 0.0, 1.0)
    return np.where((np.arange(len(others)) % 2 == 0)[:, None], close, others)


def _is_done(stand: Sequence[tuple[float, float]], merits: Array) -> bool:
    """Whether a population no longer advances: its best and its median stand still, or all its members are alike."""
    stands = len(stand) > PATIENCE and all(
        now > before * (1 - LEAST_PROGRESS) for now, before in zip(stand[-1], stand[-1 - PATIENCE], strict=True)
    )
    return stands or bool(np.ptp(merits) <= LEAST_SPREAD * abs(merits.min()))
