"""`DesignSearch`: blocks of an excitation by exchange, then refined whole; what is best is an `ExperimentDesign`.

A short run is simulated in a fraction of the time: the search also begins with a quarter of the duration, whose
information counts four times. Where that does better, it is refined, played twice in a row, and refined again.
"""

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pneuopt.dynamics.system import names
from pneuopt.identification.criteria import Criterion
from pneuopt.identification.experiment_design import ExperimentDesign, tabulate_design
from pneuopt.identification.planned_run import MIN_SUBSTEPS, PlannedRun
from pneuopt.identification.waveforms import CYCLES_A_SAMPLE, Block, join_blocks, library, vary_run
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import ProgressReporter
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value
from pneuopt.shooting.least_squares import CpuBudget

BLOCKS = 8  # of the shortest run: more are refined longer, fewer make poorer mixtures
MOST_REPEATS = 4  # times that the shortest run fits into the duration: more make runs without slow motions
BEGIN_SHARE = 0.08  # of the time [1] for each of the lengths a search begins with: less tells them apart wrongly
PART_SHARE = 0.6  # of the time left [1] for a part of the run: more leaves none to mend what its repetition spoils
MIN_BLOCK_SAMPLES = 50  # of a block: shorter ones hold no slow motion
VARIATIONS = 12  # of a block at once, in SIMD lanes: more are better and take longer
SPREADS = (0.5, 0.2, 0.08)
"""Of a change [1], in turn: the largest leave an optimum that is not the best, the smallest find its bottom."""
ROUNDS_A_SPREAD = 3  # changes of each of them, over the number of blocks: fewer do not find what they can
QUIET_CYCLES = 2  # cycles over all spreads without a gain of `MIN_GAIN`, after which a search has ended
QUIET_ROUNDS = 2  # exchanges of each block of the start: a third one changes none
MIN_GAIN = 0.01  # of the criterion [1] over a cycle: less is not worth the time
VAGUE = 10.0
"""Relative standard deviation [1] of what nothing tells, which keeps covariances finite: less passes for knowledge."""


@dataclass(frozen=True, eq=False)
class Judge:
    """The criterion of information matrices."""

    criterion: Criterion
    free: tuple[str, ...]
    targets: tuple[str, ...]
    parameters: ParameterSet
    worst_case: bool

    @cached_property
    def sizes(self) -> Array:
        """What each standard deviation is divided by: the value, or of an offset at zero its range or 1."""
        return np.array([value_size(self.parameters, n) for n in self.free])

    def covariance(self, information: Array) -> Array:
        """The covariance of all free parameters, in units of their sizes."""
        scaled = information * np.outer(self.sizes, self.sizes) + np.eye(len(self.free)) / VAGUE**2
        return np.asarray(np.linalg.inv(scaled))

    def deviation(self, information: Array) -> Array:
        """The criterion's figure, over plants along the first axis; shape (plants, ..., k, k) -> (...)."""
        chosen = [self.free.index(n) for n in self.targets]
        figures = self.criterion.deviation(self.covariance(information)[..., chosen, :][..., :, chosen])
        with np.errstate(divide="ignore"):
            every = np.log(np.where(np.isnan(figures), np.inf, figures))
        return np.asarray(np.exp(every.max(axis=0) if self.worst_case else every.mean(axis=0)))


@dataclass(eq=False)
class DesignSearch:
    """The search for the blocks of all runs."""

    run: PlannedRun
    plants: tuple[ParameterSet, ...]
    known: Array
    judge: Judge
    samples: int
    runs: int
    rng: np.random.Generator
    budget: CpuBudget
    progress: ProgressReporter
    repeats: int = 1  # times that the run's information counts
    _parts: "dict[int, DesignSearch]" = field(default_factory=dict)
    tried: int = 0
    substeps: int = MIN_SUBSTEPS

    def design(self) -> ExperimentDesign:
        """Choose blocks, refine the runs, and predict what they tell."""
        self.substeps = max(self.run.stable_substeps(p) for p in self.plants)
        chosen = self._find_blocks()
        signals = np.stack([self._signal(blocks) for blocks in chosen])
        nominal, fine = self.plants[0], 2 * self.substeps
        shown = self.run.simulate(signals, nominal, fine)
        gained = self.run.information(shown, nominal, fine).sum(axis=0)
        every = [self.run.violations(self.run.simulate(signals, p, self.substeps), p) for p in self.plants]
        room = {n: float(max(np.max(v[n]) for v in every)) for n in every[0]}
        channels = names(self.run.channels)
        runs = tuple(Trajectory(self._grid, dict(zip(channels, r.T, strict=True))) for r in shown)
        table = tabulate_design(nominal, self.run.free, self.judge.targets, self.known, gained)
        origin = self.run.origin
        steps = tuple(tuple(b.describe(self.run.excitation.unit) for b in blocks) for blocks in chosen)
        units, tried = {q.name: q.unit for q in self.run.channels}, sum(s.tried for s in (self, *self._parts.values()))
        before, after = (float(self.judge.deviation(f[None])) for f in (self.known, self.known + gained))
        figures = {"before": before, "after": after, "tried": float(tried), "origin": origin}
        figures |= {"plants": float(len(self.plants)), "cpu_seconds": self.budget.seconds}
        return ExperimentDesign(
            self.run.excitation.name,
            runs,
            steps,
            table,
            self.run.all_limits(nominal),
            room,
            repr(self.judge.criterion),
            figures,
            units,
        )

    def _find_blocks(self) -> list[list[Block]]:
        """The blocks of all runs, found in the whole duration or in a part of it, whichever has begun better."""
        whole = self._begin()
        search, runs = self, whole
        if (part := self._part(MOST_REPEATS)) is not self:
            with suppress(InputError):  # a part may allow no wave, or end where the next one breaks a limit
                begun = part._begin()
                if part._figure(begun) < self._figure(whole):
                    search, runs = part, begun
        try:
            while search is not self:
                runs = search._refine(runs, self.budget.part(PART_SHARE))
                search = self._part(search.repeats // 2)
                runs = search._fit_into_limits([blocks * 2 for blocks in runs])
        except InputError:
            runs = whole
        return self._refine(min(runs, whole, key=self._figure), self.budget)

    def _begin(self) -> list[list[Block]]:
        """Blocks of the library, refined for a while."""
        return self._refine(self._fit_into_limits(self._choose_blocks()), self.budget.part(BEGIN_SHARE))

    def _part(self, repeats: int) -> "DesignSearch":
        """The search for runs that are so many times shorter; this one where they would be too short."""
        samples = self.samples // repeats
        if repeats == 1 or samples < BLOCKS * MIN_BLOCK_SAMPLES:
            return self
        coarse = -(-self.substeps // 2)
        part = replace(self, samples=samples, repeats=repeats, substeps=coarse, tried=0)
        return self._parts.setdefault(repeats, part)

    @cached_property
    def _grid(self) -> Array:
        return np.asarray(np.arange(self.samples) * self.run.sample_time, dtype=np.float64)

    @property
    def _blocks(self) -> int:
        return max(1, min(BLOCKS, self.samples // MIN_BLOCK_SAMPLES))

    @cached_property
    def _reach(self) -> tuple[float, float]:
        """How far the excitation may go down and up from the start."""
        low, high = self.run.excited_limits()
        origin = self.run.origin
        return low - origin, high - origin

    @property
    def _amplitude(self) -> float:
        """The largest amplitude."""
        return max(abs(v) for v in self._reach)

    @cached_property
    def _waves(self) -> list[Block]:
        """Blocks of every kind."""
        t = self._grid[: self.samples // self._blocks]
        return library(self._amplitude, float(t[-1]) or self.run.sample_time, self.run.sample_time)

    def _choose_blocks(self) -> list[list[Block]]:
        """The blocks of all runs by exchange: their information adds up."""
        t = self._grid[: self.samples // self._blocks]
        waves = self._waves
        gains, keeps = self._evaluate(np.stack([np.clip(b.samples(t), *self._reach) for b in waves]))
        if not keeps.any():
            raise self._infeasible(waves, t)
        waves = [b for b, good in zip(waves, keeps, strict=True) if good]
        gains = gains[:, keeps]
        picked = list[int]()
        total = np.repeat(self.known[None], len(self.plants), axis=0)
        for _ in range(self._blocks * self.runs):
            best = int(np.argmin(self.judge.deviation(total[:, None] + gains)))
            picked.append(best)
            total = total + gains[:, best]
        for _ in range(QUIET_ROUNDS):
            for k, old in enumerate(picked):
                rest = total - gains[:, old]
                picked[k] = int(np.argmin(self.judge.deviation(rest[:, None] + gains)))
                total = rest + gains[:, picked[k]]
        ordered = sorted(picked, key=lambda i: waves[i].amplitude)
        return [[waves[i] for i in ordered[r :: self.runs]] for r in range(self.runs)]

    def _fit_into_limits(self, runs: list[list[Block]]) -> list[list[Block]]:
        """The blocks of each run in a row, all made smaller until the whole run keeps the limits."""
        return [self._shrink(blocks) for blocks in runs]

    def _shrink(self, blocks: list[Block]) -> list[Block]:
        sizes = np.geomspace(1.0, 1e-3, 25)
        rows = [[replace(b, amplitude=b.amplitude * size) for b in blocks] for size in sizes.tolist()]
        _, keeps = self._evaluate(np.stack([self._signal(row) for row in rows]))
        require(bool(keeps.any()), "the blocks of a run, one behind the other, keep no limits; plan a shorter duration")
        return rows[int(np.argmax(keeps))]

    def _figure(self, runs: list[list[Block]]) -> float:
        """The criterion after these runs."""
        gains = self._evaluate(np.stack([self._signal(blocks) for blocks in runs]))[0]
        return float(self.judge.deviation(self.known + gains.sum(axis=1)))

    def _refine(self, runs: list[list[Block]], budget: CpuBudget) -> list[list[Block]]:
        """Change the runs by chance, far and near in turn, and keep what is better within the limits."""
        every = self._evaluate(np.stack([self._signal(blocks) for blocks in runs]))[0]
        best = float(self.judge.deviation(self.known + every.sum(axis=1)))
        fastest = max(CYCLES_A_SAMPLE / self.run.sample_time, 2 / self._grid[-1])
        ends, quiet = (1 / float(self._grid[-1]), fastest), 0
        while quiet < QUIET_CYCLES and not budget.is_spent:
            before = best
            for r, spread in itertools.product(list(range(self.runs)) * (ROUNDS_A_SPREAD * len(runs[0])), SPREADS):
                if budget.is_spent:
                    break
                others = self.known + every.sum(axis=1) - every[:, r]
                tried = [vary_run(runs[r], self.rng, spread, self._reach, ends, self._waves) for _ in range(VARIATIONS)]
                gains, keeps = self._evaluate(np.stack([self._signal(row) for row in tried]))
                figures = np.where(keeps, self.judge.deviation(others[:, None] + gains), np.inf)
                winner = int(np.argmin(figures))
                if figures[winner] < best:
                    best, runs[r] = float(figures[winner]), tried[winner]
                    every[:, r] = gains[:, winner]
                self.progress(f"relative standard deviation {best:.3g}, {self.tried} runs tried")
            quiet = quiet + 1 if best > (1 - MIN_GAIN) * before else 0
        return runs

    def _evaluate(self, signals: Array) -> tuple[Array, Array]:
        """Information of excitations, shape (plants, m, k, k), and whether all plants keep the limits under them."""
        keeps = np.ones(len(signals), dtype=bool)
        low, high = self._reach
        keeps &= (signals.min(axis=1) >= low - 1e-12) & (signals.max(axis=1) <= high + 1e-12)
        k = len(self.run.free)
        gains = np.zeros((len(self.plants), len(signals), k, k))
        self.tried += len(signals)
        shown = {}
        for i, plant in enumerate(self.plants):
            rows = np.flatnonzero(keeps)
            if not rows.size:
                break
            found = self.run.simulate(signals[rows], plant, self.substeps)
            shown[i] = rows, found
            for beyond in self.run.violations(found, plant).values():
                keeps[rows] &= beyond <= 0
        for i, (rows, found) in shown.items():
            kept = keeps[rows]
            gains[i, rows[kept]] = self.run.information(found[kept], self.plants[i], self.substeps)
        return self.repeats * gains, keeps

    def _signal(self, blocks: Sequence[Block]) -> Array:
        return np.clip(join_blocks(blocks, self._grid), *self._reach)

    def _infeasible(self, waves: Sequence[Block], t: Array) -> InputError:
        """Which limit even the gentlest excitation breaks, and what it would need."""
        gentle = min(waves, key=lambda b: (b.amplitude, b.frequency))
        signal = np.clip(gentle.samples(t), *self._reach)[None]
        worst, name, low, high = -math.inf, "", 0.0, 0.0
        for plant in self.plants:
            shown = self.run.simulate(signal, plant, self.substeps)
            for n, beyond in self.run.violations(shown, plant).items():
                if beyond[0] > worst:
                    values = shown[0, :, names(self.run.channels).index(n)]
                    worst, name, low, high = float(beyond[0]), n, float(values.min()), float(values.max())
        unit = next(q.unit for q in self.run.channels if q.name == name)
        needs = f"it moves from {write_value(low, unit, 3)} to {write_value(high, unit, 3)}"
        remedy = "widen that limit, start elsewhere (start=), or close a loop around a plant that runs away"
        return InputError(f"limits: no excitation keeps {name!r}: under the gentlest one, {needs}; {remedy}")


def value_size(parameters: ParameterSet, name: str) -> float:
    """What a standard deviation of a parameter is compared with [its unit]."""
    p = parameters[name]
    width = p.upper - p.lower
    return abs(p.value) or (width if math.isfinite(width) and width > 0 else 1.0)
