"""`Racing`: the search by simulation, success-history differential evolution whose trials race over the cases.

It tunes any loop, with friction, clip and sampling, for any requirements and scenarios. Each number of times that a
response leaves a narrow band makes an optimum of its own: the mean settling time over wide and narrow bands leads the
search across them, on coarse samples; then the band asked for counts, and at last, for the best points only, on fine
samples.

`Race`: a trial runs first on the case that its parent finds worst, then on those that lately beat the most others, and
is dropped as soon as it is certain to lose: by machine code within a response, where the bounds of `RACE_VALUES` pass
the rival's merit, by the CasADi VM after its first case. Neither changes an answer.

`SuccessHistory`: differential evolution that learns its step lengths and crossover rates from what succeeded, by
R. Tanabe, A. Fukunaga, Success-history based parameter adaptation for differential evolution (SHADE), IEEE Congress on
Evolutionary Computation 2013, 71-78. It knows no merit function, so that a race may answer with a bound.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import ClassVar, NamedTuple

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.race import RACE_VALUES, RaceCourse, RaceField, RaceMerit, race
from pneuopt.evaluation.metric import Band, Requirement, band_number, band_share, band_unit
from pneuopt.evaluation.requirements import (
    REQUIREMENT_KINDS,
    ROBUSTNESS_REQUIREMENTS,
    ControlRate,
    Overshoot,
    PeakControl,
    SettlingTime,
    describe_value,
    metric_name,
    upper_limit,
    user_value,
)
from pneuopt.evaluation.specification import Specification
from pneuopt.evaluation.tolerances import EDGE_ROUNDING, STABILITY_SENSITIVITY
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import check_argument, check_number
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.tuning.feasibility import plant_integrates
from pneuopt.tuning.gradients import Polish
from pneuopt.tuning.method import Agreement, SearchResult, TuningTask, check_method_options
from pneuopt.tuning.simulator import Responses, Simulator, to_records
from pneuopt.tuning.space import penalty_settling_time
from pneuopt.tuning.tolerances import (
    ACTIVE_ROOM,
    BAND_SHARES,
    BEST_SHARE,
    CUT_SETTLING_TIMES,
    FEW_BEST,
    FINALIST_SHARE,
    FINE_MEMBERS,
    FINE_SHARE,
    KEPT_STATES,
    LAGGING,
    LEAST_CUT,
    LEAST_IMPROVEMENT,
    LEAST_MEMBERS,
    LEAST_SHORT_TRIALS,
    LEAST_SPREAD,
    LIMIT_TOLERANCE,
    MAX_FINALISTS,
    MEMORY_OF_KILLS,
    MEMORY_SIZE,
    MIN_DISTANCE,
    MOST_STARTS,
    NEARBY,
    NO_DITHER,
    POLISHED,
    POLISHED_NEARBY,
    REPORT_SECONDS,
    RUNAWAY_LEVEL,
    SAME_OBJECTIVE,
    SHORT_MEMBERS,
    STALLED_GENERATIONS,
    VIOLATION_PENALTY,
    WORST_MERIT,
)


@dataclass(frozen=True)
class Racing:
    """Tune any loop by success-history differential evolution on compiled simulations, trials racing over the cases.

    Parameters
    ----------
    members : int
        Candidates in the population.
    trials : int
        Trials of a start for each free gain, at most: it ends sooner where it no longer advances. There are starts
        until two end within 1 % of each other, three at most.
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
    trials: int = 1000
    bands: tuple[float, ...] = (1.5, 2.5, 5.0)
    polish: int = 20
    margin: float = 0.015
    seed: int = 0
    digits: int | None = 4

    peak_margin: ClassVar[float] = 1 / 5  # of which coarse samples miss as much
    linear_margin: ClassVar[float] = 0.0  # peaks that no sample blurs are exact
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
        return replace(
            result,
            simulations=best.count,
            agreement=Agreement(best.starts, best.agreeing, spread=best.spread),
            is_complete=best.is_complete,
            uses_simulator=True,
            others=tuple(best.others),
            finalists=best.finalists,
        )

    def shorten(self, margin: float, share: float = 1.0) -> "Racing":
        """The method for a short search from a point that is close; see `Method.shorten`."""
        trials = max(1, round(share * min(self.trials, max(LEAST_SHORT_TRIALS, self.trials // 6))))
        members, polish = max(LEAST_MEMBERS, round(SHORT_MEMBERS * self.members)), round(share * self.polish)
        return replace(self, members=members, trials=trials, bands=(), polish=polish, margin=margin)

    def limit_path(self, task: TuningTask, spec: Specification) -> None:
        """No path: each set of limits needs a new search."""


@dataclass(frozen=True, eq=False)
class RacingResult:
    """The gains (n,) of least merit, candidates simulated, and how many starts ended within 1 % of the best.

    `spread` is the relative excess of the second best start, `others` (k, n) are ends apart, `finalists` (k, n)
    gains apart from each other that are hardly worse.
    """

    point: Array
    count: int
    is_complete: bool
    starts: int
    agreeing: int
    spread: float
    others: Array
    finalists: Array


def run_racing(
    task: TuningTask,
    simulator: Simulator,
    spec: Specification,
    method: Racing,
    start: Array,
    progress: ProgressCallback,
) -> RacingResult:
    """Search in phases from starts that differ in kind; Ctrl-C ends the search with the best point so far.

    `start` (n,) is a member of the first population; a method without `bands` searches about it.
    """
    rng, space = np.random.default_rng(method.seed), simulator.space
    search = _RacingSearch(simulator, spec, task.horizon, space.to_unit(start), rng, progress, task.spec)
    search.most = LAGGING * task.to_beat
    try:
        search.run(method)
    except KeyboardInterrupt:
        best = space.from_unit(search.best_so_far())
        nothing = np.empty((0, len(best)))
        return RacingResult(
            best, search.count, False, search.starts, search.agreeing, search.spread, nothing, best[None]
        )
    point, others, near = (space.from_unit(p) for p in (search.best, search.other_ends(), search.finalists()))
    return RacingResult(point, search.count, True, search.starts, search.agreeing, search.spread, others, near)


# What may be asked for where responses are cut short: nothing of it grows after the response has settled.
CUT_REQUIREMENTS = (SettlingTime, Overshoot, PeakControl, ControlRate, *ROBUSTNESS_REQUIREMENTS)


class Race:
    """Races on one simulator for one specification.

    `scale`, the horizon [s], stands for the settling time of what never settles; `is_cut` says that races see less than
    the whole of a response, `most_numbers` how many numbers of 8 bytes it records, at most.
    """

    most_numbers: ClassVar[int] = 2**25

    def __init__(self, simulator: Simulator, spec: Specification, scale: float) -> None:
        self._whole, self._spec, self._scale, self.count = simulator, spec, scale, 0
        self._plain = spec.without(ROBUSTNESS_REQUIREMENTS)
        self._kills, self._records = np.zeros(len(simulator.cases)), np.empty(0)
        self._uses_bounds = simulator.rollout.uses_machine_code and not spec.weight(ROBUSTNESS_REQUIREMENTS)
        self.cut(np.inf)

    def cut(self, duration: float) -> None:
        """Let races see so much of each response after the step only [s]."""
        self._simulator = self._whole if duration == np.inf else self._whole.cut(duration)
        self.is_cut = any(len(a.t) < len(b.t) for a, b in zip(self._simulator.grids, self._whole.grids, strict=True))
        self._course = _course(self._simulator, self._spec.band)

    def merits(self, points: Array, rivals: Array | None = None) -> tuple[Array, Indices]:
        """The merit of each point on every case and on the whole response, and its worst case, shapes (m,).

        Where `rivals`, shape (m,), are given, a point that is certain to be worse gets a bound above its rival's merit.
        """
        self.count += len(points)
        responses = self._whole.respond(points, self._spec.band)
        return self._complete_merits(responses, np.full(len(points), np.inf) if rivals is None else rivals)

    def race(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """Merits and worst cases (m,) of points (m, n) no worse than their rivals; of others more than the rival's.

        `first` (m,) is the case on which each point is simulated first; a loser's worst case is that by which it lost.
        """
        self.count += len(points)
        compete, most = self._race_cases, len(points)
        if self._uses_bounds:
            numbers = len(self._course.length) * self._course.t.shape[1] * self._simulator.rollout.n_outputs
            compete, most = self._race_lanes, max(1, self.most_numbers // numbers)
        merits, worst = np.full(len(points), np.inf), first.copy()
        for k in range(0, len(points), most):
            part = slice(k, k + most)
            merits[part], worst[part] = compete(points[part], rivals[part], first[part])
        lost = np.bincount(worst[merits > rivals], minlength=len(self._kills))
        self._kills = MEMORY_OF_KILLS * self._kills + lost
        return merits, worst

    def _race_lanes(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """Race in machine code, and read the responses of what comes through."""
        simulator, (m, C) = self._simulator, (len(points), len(self._kills))
        row, case = np.divmod(np.arange(m * C), C)
        p, starts = simulator.lanes(points, row, case)
        n, outputs = self._course.t.shape[1], simulator.rollout.n_outputs
        if self._records.size < m * C * n * outputs:
            self._records = np.empty(m * C * n * outputs)
        y = self._records[: m * C * n * outputs].reshape(m, C, n, outputs)
        rank = np.tile(-self._kills, (len(first), 1))
        rank[np.arange(len(first)), first] = -np.inf
        order = np.argsort(rank, axis=1, kind="stable")  # the first case, then those that beat the most points
        field = RaceField(p, starts, simulator.sampled.periods(p), order, rivals)
        kinds = [next(kind for kind in REQUIREMENT_KINDS if kind.metric.name == n) for n in RACE_VALUES]
        weights, limits = np.array([[self._plain.weight(kind), self._plain.limit(kind)] for kind in kinds]).T
        edges = (1 + EDGE_ROUNDING) * np.array([band_number(band) for band in simulator.bands(self._spec.band)])
        merit = RaceMerit(edges, weights, limits, WORST_MERIT, VIOLATION_PENALTY, RUNAWAY_LEVEL)
        outcome = race(simulator.rollout, self._course, merit, field, y)
        merits, worst, through = np.full(m, np.inf), outcome.loser.copy(), outcome.loser < 0
        if through.any():
            lanes = through[row]
            states, ends = (a[through].reshape(-1, *a.shape[2:]) for a in (outcome.x, outcome.x_end))
            run = states, y[through].reshape(-1, n, outputs), ends
            responses = simulator.read(p[lanes], case[lanes], run, (int(through.sum()), C), self._spec.band)
            merits[through], worst[through] = self._complete_merits(responses, rivals[through])
        return merits, worst

    def _race_cases(self, points: Array, rivals: Array, first: Indices) -> tuple[Array, Indices]:
        """Race case by case: the first one of every point, then all cases of those that are not beaten by it."""
        merits, worst, C = np.full(len(points), np.inf), first.copy(), len(self._kills)
        ahead = np.ones(len(points), dtype=bool)
        if C > 1 and not self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            opening = self._simulator.respond(points, self._spec.band, np.arange(C) == first[:, None])
            ahead = compute_merits(opening.values, self._plain, self._scale) <= rivals
        if ahead.any():
            responses = self._simulator.respond(points[ahead], self._spec.band)
            merits[ahead], worst[ahead] = self._complete_merits(responses, rivals[ahead])
        return merits, worst

    def _complete_merits(self, responses: Responses, rivals: Array) -> tuple[Array, Indices]:
        """Merits and worst cases of points that ran on every case, margins left out of the latter.

        Margins cost as much as a simulation and only raise a merit: they are read of points that may beat their rival.
        """
        merits = np.full(len(rivals), -np.inf)
        if not self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            merits = compute_merits(responses.values, self._plain, self._scale)
        if self._spec.concerns(ROBUSTNESS_REQUIREMENTS):
            ahead = merits <= rivals
            if ahead.any():
                merits[ahead] = compute_merits(responses.with_margins(ahead), self._spec, self._scale)
        if len(self._kills) == 1 or self._spec.weight(ROBUSTNESS_REQUIREMENTS):
            return merits, np.zeros(len(rivals), dtype=np.intp)
        table = responses.to_table(compute_merits(responses.by_case(), self._plain, self._scale))
        return merits, np.asarray(np.argmax(table, axis=1))


def may_be_cut(spec: Specification) -> bool:
    """Whether nothing is asked for that happens after a response has settled."""
    kinds = (*spec.weights, *spec.limits)
    return all(isinstance(q, SettlingTime) for q in spec.weights) and all(
        isinstance(q, CUT_REQUIREMENTS) for q in kinds
    )


def _course(simulator: Simulator, band: Band) -> RaceCourse:
    """The cases of a simulator, as a race in machine code takes them."""
    grids = simulator.grids
    n, grid = max(len(g.t) for g in grids), np.array([simulator.grid_index(k) for k in range(len(simulator.cases))])
    u, t, h = (np.array(arrays) for arrays in zip(*(g.pad(n) for g in grids), strict=True))
    settings = [
        (r.final, r.nominal_size, r.initial, g.spacing, g.t[g.step_index] - r.at, float(r.changes), band_unit(band, r))
        for g, r in ((g, g.reference) for g in grids)
    ]
    length, first = np.array([[len(g.t), g.step_index] for g in grids]).T
    return RaceCourse(
        u, t, h, grid, length[grid], first[grid], np.array(settings)[grid], max(simulator.substeps), KEPT_STATES
    )


class SuccessHistory:
    """Points of the unit cube (m, n) with merits (m,), of which small ones are good, and what trials have taught."""

    def __init__(self, population: Array, merits: Array, rng: np.random.Generator) -> None:
        self.population, self.merits, self._rng = population.copy(), merits.copy(), rng
        self._archive = np.empty((0, population.shape[1]))
        self._lengths, self._rates, self._entry = np.full(MEMORY_SIZE, 0.5), np.full(MEMORY_SIZE, 0.5), 0
        self._drawn = (np.empty(0), np.empty(0))

    def propose(self) -> Array:
        """Draw a trial point for each member, shape (m, n), towards one of the best."""
        rng, x = self._rng, self.population
        m, n = x.shape
        entry: Indices = rng.integers(0, MEMORY_SIZE, len(x))
        F = np.zeros(m)  # Cauchy, and rates normal, about the memory with a spread of 0.1, as published
        while (none := F <= 0).any():
            F[none] = self._lengths[entry[none]] + 0.1 * rng.standard_cauchy(int(none.sum()))
        F, rates = np.minimum(F, 1.0), np.clip(rng.normal(self._rates[entry], 0.1), 0.0, 1.0)
        best = np.argsort(self.merits, kind="stable")[: max(2, round(BEST_SHARE * m))]
        towards = x[rng.choice(best, m)]
        pool, own = np.vstack([x, self._archive]), np.arange(m)
        one = (own + rng.integers(1, m, size=m)) % m  # neither it nor `other` is the member itself
        other: Indices = rng.integers(0, len(pool) - 2, size=len(x))
        for lower in (np.minimum(own, one), np.maximum(own, one)):
            other += other >= lower
        mutant = x + F[:, None] * (towards - x) + F[:, None] * (x[one] - pool[other])
        mutant = np.where(mutant < 0, x / 2, np.where(mutant > 1, (1 + x) / 2, mutant))
        taken = rng.random((m, n)) < rates[:, None]
        taken[np.arange(m), rng.integers(n, size=m)] = True
        self._drawn = F, rates
        return np.where(taken, mutant, x)

    def select(self, trials: Array, merits: Array) -> Mask:
        """Put trials (m, n) that are no worse in their parents' place, learn from the better ones; who was replaced.

        Of a trial that has lost a bound above its parent's merit is enough.
        """
        replaced, better = merits <= self.merits, merits < self.merits
        if better.any():
            # what succeeded is remembered by its relative improvement, which is free of the merit's unit
            F, rates = (drawn[better] for drawn in self._drawn)
            old, new = self.merits[better], merits[better]
            with np.errstate(invalid="ignore"):
                gain = np.where(np.isfinite(old), (old - new) / (np.abs(old) + np.abs(new)), 1.0)
            weights = gain / gain.sum()
            self._lengths[self._entry] = (weights @ F**2) / (weights @ F)
            self._rates[self._entry] = weights @ rates
            self._entry = (self._entry + 1) % MEMORY_SIZE
            archive = np.vstack([self._archive, self.population[better]])
            kept = self._rng.permutation(len(archive))[: len(trials)]
            self._archive = archive[np.sort(kept)]
        self.population[replaced], self.merits[replaced] = trials[replaced], merits[replaced]
        return np.asarray(replaced)


def first_population(members: int, start: Array, rng: np.random.Generator) -> Array:
    """Draw a Latin hypercube of the unit cube, with the start as its first point, shape (members, n)."""
    cells = np.array([rng.permutation(members) for _ in start]).T
    found: Array = (cells + rng.random(cells.shape)) / members
    found[0] = np.clip(start, 0.0, 1.0)
    return found


def add_structure(population: Array, simulator: Simulator, share: float = 0.5) -> Array:
    """Put designs of each kind into a population (m, n): without integral or dither, filters at both ends.

    Each kind takes the place of two members, one of which has the first member's other gains. Where the plant
    integrates a share of all members is without integral: any may be too much there.
    """
    found, space, members = population.copy(), simulator.space, len(population)
    for k, (gain, at) in enumerate(space.structure[: (members - 1) // 2]):
        found[1 + k] = found[0]
        found[[1 + k, -1 - k], gain] = at
        if space.names[gain] == "pid.Ki" and plant_integrates(simulator.loop, simulator.cases[0], space):
            found[members - round(share * members) :, gain] = at
    return found


WIDEN_BOUNDS = "widen the gains' bounds, or lower their lower ends"  # the remedy where no stable loop is found


def compute_merits(values: Mapping[str, Array], spec: Specification, scale: float) -> Array:
    """The objective (m,) of points that keep all limits; of others more than any objective, graded by violations.

    So limits come first, whatever unit the objective has: K. Deb, An efficient constraint handling method for genetic
    algorithms, Comput. Methods Appl. Mech. Engrg. 186 (2000) 311-338. Where a settling time is minimised, a response
    that never settles counts as a violation, the larger the further from the reference it ends, on the `scale` of the
    horizon [s], so that a search can start.
    """
    filled = {n: np.where(np.isfinite(value), value, WORST_MERIT) for n, value in values.items()}
    settling = spec.settling.metric.name
    settles, late = np.isfinite(values[settling]), penalty_settling_time(scale, filled["Excess"])
    filled[settling] = np.where(settles, filled[settling], late)
    missed = np.where(settles, 0.0, late / scale) if spec.weight(SettlingTime) else np.zeros_like(late)
    for share in spec.excess(filled).values():
        missed += VIOLATION_PENALTY * np.maximum(0.0, share)
    total = np.zeros_like(late)
    for q, weight in spec.weights.items():
        total += weight * filled[metric_name(q)]
    return np.where(missed > 0, WORST_MERIT * (1 + missed), np.minimum(total, WORST_MERIT))


def search_result(task: TuningTask, simulator: Simulator, spec: Specification, point: Array) -> SearchResult:
    """The result of a search by simulation for a tightened `spec`: its best point (n,), what is active and broken."""
    values = to_records(simulator.values(point[None], spec))[0]
    limits = [metric_name(q) for q in spec.limits if values[metric_name(q)] >= (1 - ACTIVE_ROOM) * upper_limit(q)]
    low, up = task.space.bounds.T
    near = np.minimum(point - low, up - point) <= 1e-3 * (up - low)
    active = (*limits, *(n for n, held in zip(task.space.names, near, strict=True) if held))
    asked, status = task.spec, Status(Code.CONVERGED)
    broken = [
        f"{metric_name(q)} {', '.join(describe_value(q, values[metric_name(q)]))}"
        for q in asked.violations(values, LIMIT_TOLERANCE)
    ]
    if broken:
        verdict = f"the closest found has {' and '.join(broken)}"
        status = Status(Code.INFEASIBLE, (verdict, "relax a limit or widen the bounds"))
    elif asked.with_stability().violations(values):
        Ms = values["MaxSensitivity"]
        nearly = f"nearly unstable, with a MaxSensitivity of {Ms:.3g}, more than {STABILITY_SENSITIVITY:g}"
        verdict = f"the closest found is {nearly if np.isfinite(Ms) else 'no stable loop'}"
        status = Status(Code.INFEASIBLE, (verdict, WIDEN_BOUNDS))
    elif not np.isfinite(asked.objective(values)):
        remedy = "widen the band or the bounds, or lengthen the horizon"
        status = Status(Code.NOT_CONVERGED, ("nothing found settles", remedy))
    return SearchResult(point, status, active, optimum=spec.objective(values))


class _Phase(NamedTuple):
    """A part of a search: what it reads, on which samples, how many trials it may take, and which merit is enough."""

    name: str
    simulator: Simulator
    trials: int
    enough: float = -np.inf


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
        asked: Specification | None = None,
    ) -> None:
        self._simulator, self._space, self._spec, self._scale = simulator, simulator.space, spec, scale
        self._rng, self._progress, self._coarse, self._asked = rng, progress, simulator.coarse(spec), asked or spec
        self._begun, self._planned, self._figures, self._figures_at = time.perf_counter(), 0, "", -np.inf
        self._polisher = Polish(simulator, spec)
        self.best, self.count, self.starts, self.agreeing = np.clip(start, 0.0, 1.0), 0, 0, 0
        self.spread, self._wide = np.nan, np.inf
        self._ends, self._polished, self._bests = list[Array](), list[Array](), list[Array]()
        self._points = POLISHED
        self.most = np.inf  # merit above which it is given up

    def run(self, method: Racing) -> None:
        """Search from starts on coarse samples until two agree, at most `MOST_STARTS`; from the ends on fine ones."""
        names, given = self._space.names, self.best
        trials, most = method.trials * len(names), MOST_STARTS if method.bands else 1
        bests = list[float]()
        while len(bests) < most and self.agreeing < 2:
            self._planned = round((min(2, most) + FINE_SHARE) * trials) if len(bests) < 2 else self.count + trials
            population = self._next_population(method)
            population, merits = self._search(population, method, trials, min(bests, default=-np.inf))
            self._ends.append(population)
            bests = sorted([*bests, float(merits[0])])
            self.starts, self.agreeing = len(bests), sum(b <= bests[0] * (1 + SAME_OBJECTIVE) for b in bests)
            if bests[0] > self.most:
                self.best = self._best_first(np.array([end[0] for end in self._ends]), self._coarse)[0][0]
                return
        if len(bests) > 1 and bests[0] > 0 and bests[1] < WORST_MERIT:
            self.spread = bests[1] / bests[0] - 1
        fine = _Phase("fine samples", self._simulator, round(FINE_SHARE * trials))
        population = self._best_first(np.vstack([*self._ends, given]), self._coarse)[0][:FINE_MEMBERS]
        population, merits = self._best_first(np.vstack([population, *self._polished]), fine.simulator)
        best = merits[0] * (1 - LEAST_IMPROVEMENT)
        population, merits = self.evolve(population[:FINE_MEMBERS], fine)
        if merits[0] < best or not self._polished:
            population = self._polish(population, merits, fine.simulator, method.polish)[0]
        self._ends.append(population)

    def _next_population(self, method: Racing) -> Array:
        """The population of the next start: the given gains among designs of each kind; then others.

        The second start of a loop with dither has hardly any; the first of a plant that integrates has no integral.
        """
        names, members, number, given = self._space.names, method.members, len(self._ends), self.best
        if number == 1 and "dither.amplitude" in names:
            return self._hardly_dithered(self._ends[0])
        drawn = first_population(members, self._rng.random(len(names)) if number else given, self._rng)
        if not method.bands:
            others = drawn[1:]  # every other one lies close to the start
            others[::2] = np.clip(given + NEARBY * self._rng.standard_normal(others.shape), 0.0, 1.0)[::2]
            self._points = POLISHED_NEARBY
        return add_structure(drawn, self._simulator, 0.5 if number or not method.bands else 1.0)

    def other_ends(self) -> Array:
        """The best points of the starts, before gradients and after, that keep all limits and lie apart; best first."""
        found, merits = self._best_first(np.array([*self._bests, *(end[0] for end in self._ends)]), self._coarse)
        kept = np.vstack([self.best, found[merits < WORST_MERIT]])
        return kept[distinct_points(kept, MIN_DISTANCE)[1:]]

    def _hardly_dithered(self, end: Array) -> Array:
        """A start of another kind: the gains of an end's best points, hardly any dither, an offset drawn anew."""
        found = end[np.arange(len(end)) % min(FEW_BEST, len(end))]
        found = np.clip(found + NEARBY * self._rng.standard_normal(found.shape), 0.0, 1.0)
        for name, most in (("dither.amplitude", NO_DITHER), ("dither.offset", 1.0)):
            if name in self._space.names:
                found[:, self._space.names.index(name)] = most * self._rng.random(len(found))
        return found

    def best_so_far(self) -> Array:
        """The best of the present phase, which may ask for another band, and of the starts that have ended."""
        points = np.array([self.best, *(end[0] for end in self._ends)])
        merits, _ = Race(self._coarse, self._spec, self._scale).merits(self._space.from_unit(points))
        return np.asarray(points[np.argmin(merits)])

    def finalists(self) -> Array:
        """Points of all phases that lie apart from each other, hardly worse than the best."""
        population, merits = self._best_first(np.vstack([self.best, *self._ends, *self._polished]), self._simulator)
        near = population[merits <= (1 + FINALIST_SHARE) * merits[0]]
        return np.asarray(near[distinct_points(near, NEARBY)][:MAX_FINALISTS])

    def _search(self, population: Array, method: Racing, trials: int, best: float) -> tuple[Array, Array]:
        """Search from one start on coarse samples: over wide bands first, then in the band asked for, by gradients.

        It ends after the wide bands where it lags behind the first start there, on coarse samples where it comes as
        near to the `best` merit of the starts before as two have to agree, and without gradients where it lags behind
        that; there are no bands without a settling time.
        """
        simulator, spec = self._simulator, self._spec
        widest = max(band_share(spec.band, grid.reference) for grid in simulator.grids)
        wider = [spec.band * b for b in sorted(method.bands) if widest * b < 1] if spec.concerns(SettlingTime) else []
        stages = [bands for bands in (wider, wider[:1]) if bands]
        for bands, part in zip(stages, BAND_SHARES, strict=False):
            phase = _Phase("wide bands", simulator.coarse(spec, bands), round(part * trials))
            population, merits = self.evolve(population, phase)
        if stages:
            if self._ends and merits[0] > LAGGING * self._wide:
                return self._best_first(population, simulator)
            self._wide = self._wide if self._ends else float(merits[0])
        left = round((1 - sum(BAND_SHARES[: len(stages)])) * trials)
        phase = _Phase("coarse samples", simulator.coarse(spec), left, best * (1 + SAME_OBJECTIVE))
        population, merits = self.evolve(population, phase)
        self._bests.append(population[0])
        if not self._ends or merits[0] <= LAGGING * best:
            population, merits = self._polish(*self._best_first(population, simulator), simulator, method.polish)
            self._polished.append(population[: self._points])
        return population, merits

    def _best_first(self, population: Array, simulator: Simulator) -> tuple[Array, Array]:
        """A population in the order of its merits on whole responses, and these."""
        merits, _ = Race(simulator, self._spec, self._scale).merits(self._space.from_unit(population))
        order = np.argsort(merits, kind="stable")
        return population[order], merits[order]

    def _polish(self, population: Array, merits: Array, simulator: Simulator, iterations: int) -> tuple[Array, Array]:
        """Improve the best points of a population, apart from each other, by gradients; the best first."""
        if not iterations or not self._polisher.is_possible:
            return population, merits
        chosen = distinct_points(population[merits <= LAGGING * merits[0]], MIN_DISTANCE)[: self._points]
        self.best = population[0].copy()
        unit, count = self._polisher.improve(population[chosen], simulator, iterations)
        self.count += count
        found = Race(simulator, self._spec, self._scale).merits(self._space.from_unit(unit))[0]
        better = found < merits[chosen]
        population[chosen[better]], merits[chosen[better]] = unit[better], found[better]
        order = np.argsort(merits, kind="stable")
        self.best = population[order[0]].copy()
        self._report(f"gradients from {len(chosen)} points")
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
            better = (merits < best) & race.is_cut
            if better.any():  # a new best is proved on its whole response
                merits[better] = race.merits(self._space.from_unit(trials[better]))[0]
            worst = np.where(history.select(trials, merits), cases, worst)
            self.count = before + race.count
            if history.merits.min() < best:
                best, self.best = float(history.merits.min()), history.population[np.argmin(history.merits)].copy()
                self._cut(race)
            stand.append((best, float(np.median(history.merits))))
            self._report(f"{phase.name}, generation {number + 1}")
            if best <= phase.enough or is_stalled(stand, history.merits):
                break
        order = np.argsort(history.merits, kind="stable")
        return history.population[order], history.merits[order]

    def _report(self, doing: str) -> None:
        """Report what is done, the best so far in the user's figures, a second old at most, and the time left."""
        now = time.perf_counter()
        if now - self._figures_at >= REPORT_SECONDS:
            values = to_records(self._coarse.values(self._space.from_unit(self.best[None]), self._spec))[0]
            self._figures, self._figures_at = describe_candidate(values, self._asked, self._simulator.loop), now
        left = (now - self._begun) * max(0, self._planned - self.count) / max(1, self.count)
        self._progress(f"{doing}: {self._figures}, about {timedelta(seconds=round(left))} left")

    def _cut(self, race: Race) -> None:
        """Cut a race's responses at a multiple of the best settling time, where later samples change no merit."""
        settled = np.inf
        if may_be_cut(self._spec):
            values = self._coarse.respond(self._space.from_unit(self.best[None]), self._spec.band).values
            settled = float(values[self._spec.settling.metric.name][0])
        race.cut(max(CUT_SETTLING_TIMES * settled, LEAST_CUT * self._scale) if np.isfinite(settled) else np.inf)


def describe_candidate(values: Mapping[str, float], asked: Specification, loop: ClosedLoop) -> str:
    """The objective of a candidate that keeps all limits, or the limit that it breaks most, as the user writes them."""

    def show(q: Requirement, value: float) -> str:
        return f"{q.metric.factor * user_value(q, value):.4g}"

    def tell(q: Requirement, limit: str = "") -> str:
        unit = q.metric.shown_unit(loop.command.unit, loop.feedback.unit)
        return f"{metric_name(q)} {show(q, values[metric_name(q)])}{limit} {unit}".strip()

    broken = {q: share for q, share in asked.excess(values).items() if not share <= LIMIT_TOLERANCE}
    lacking = [q for q in (*broken, *asked.weights) if not np.isfinite(values[metric_name(q)])]
    if lacking:
        return f"closest: no {metric_name(lacking[0])} yet"
    if broken:
        q = max(broken, key=lambda q: float(broken[q]))
        return f"closest: {tell(q, f' of {show(q, upper_limit(q))}')}"
    return f"best: {' and '.join(tell(q) for q in asked.weights)}"


def distinct_points(unit: Array, distance: float, most: int | None = None) -> Indices:
    """Indices of points in their order, at most so many; one within a distance of one before it is left out."""
    found = list[int]()
    for k in range(len(unit)):
        if len(found) == most:
            break
        if all(np.max(np.abs(unit[k] - unit[other])) > distance for other in found):
            found.append(k)
    return np.array(found, dtype=np.intp)


def is_stalled(stand: Sequence[tuple[float, float]], merits: Array) -> bool:
    """Whether a population no longer advances: its best and its median stand still, or all its members are alike."""
    stands = len(stand) > STALLED_GENERATIONS and all(
        now > before * (1 - LEAST_IMPROVEMENT)
        for now, before in zip(stand[-1], stand[-1 - STALLED_GENERATIONS], strict=True)
    )
    return stands or bool(np.ptp(merits) <= LEAST_SPREAD * abs(merits.min()))
