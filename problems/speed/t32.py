"""T32s, the tuning benchmark: what `tune`'s search finds, beside rivals that get the same CPU time, over ten seeds.

    python problems/speed/t32.py [--seeds N] [--rows NAME ...] [--rivals [NAME ...]] [--times K ...]
                                  [--without-conditions] [--json FILE] [--out DIR]

The plant, its gains and what is asked for are those of problems/shared/t32.py: settling to 2 %, overshoot 5 %, Ms 2 at
every operating point, settled beyond the horizon. "corners" are the eight of mass and friction +-30 % and supply
pressure +-10 %, beside the nominal plant; "plants" are 32 drawn from their box. --without-conditions leaves out Ms and
what lies beyond the horizon.

All methods get one warm compiled simulator, one merit, the same first member and the same margins. "racing" is the
search of `tune` up to its first certificate, with its own stop; what it repeats with shorter steps counts. The rivals
run for the median of its CPU times (x1), or --times it: "de", SciPy's differential evolution with its defaults but no
polish and no stop of its own; "de_own", the best of 48 settings of it (`OWN`); "shade", success-history differential
evolution as published, without a race; "cma", CMA-ES of the package cmaes, 16 members, restarted where it stops. A
rival searches on coarse samples and reads margins only of candidates that its last batch's median does not beat
already; the twenty best are read again on fine samples with steps half as long, and the best of them is its answer.

Each answer is printed to four digits and certified; the worst over the plants counts, and a design without certificate
counts as infinite. "reference" is the best design that any method has found here.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from math import inf
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from cmaes import CMA
from scipy.optimize import differential_evolution

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import BLUE, GREY, RED, axes_grid, legend_above
from pneuopt.tuning.racing import Race, SuccessHistory, first_population
from pneuopt.tuning.search import Search
from pneuopt.tuning.tune import prepare_search, prepare_task
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import MINIMISE, OVERSHOOT, ROWS, SENSITIVITY, STEP, benchmark

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

SEEDS, FIRST_SEED = 3, 20  # the shares and patience of `Racing` were chosen on lower seeds
TIMES = (1,)  # CPU time of the rivals, over racing's
REREAD = 20  # points of a rival that are read again on fine samples
OWN: dict[str, Any] = {"popsize": 4, "strategy": "randtobest1bin", "mutation": (0.3, 0.9), "recombination": 0.9}
BOUNDS = {
    "5_corners.racing.within_5_percent": ">= 90",
    "10_corners.racing.within_5_percent": ">= 90",
    "10_plants.racing.within_5_percent": ">= 90",
}


@dataclass(frozen=True)
class Run:
    """What one method found with one seed: the certified settling time, inf without certificate, and its CPU time."""

    settling_time: float
    overshoot: float
    max_sensitivity: float
    cpu_seconds: float


@dataclass
class Study:
    """Runs by row and method, one a seed."""

    runs: dict[str, dict[str, list[Run]]] = field(default_factory=dict)

    def reference(self, row: str) -> float:
        """The certified settling time of the best design that any method has found for a row [s]."""
        return min(r.settling_time for runs in self.runs[row].values() for r in runs)


class OutOfTimeError(Exception):
    """A rival's CPU time is over."""


@dataclass
class Clock:
    """A rival's merit function, which keeps its best points, and ends the search when its CPU time is over."""

    merit: Callable[[Array, Array], Array]  # of points (m, n) and the merits (m,) above which a bound will do
    limit: float
    begun: float = field(default_factory=time.process_time)
    threshold: float = inf
    kept: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)

    def __call__(self, unit: Array) -> Array:
        """The merits of points of the unit cube, shape (m, n); for hopeless ones a bound above the threshold."""
        if time.process_time() - self.begun > self.limit:
            raise OutOfTimeError
        found = self.merit(unit, np.full(len(unit), self.threshold))
        self.threshold = float(np.median(found)) if len(found) > 1 else inf
        points = [(float(m), tuple(p)) for m, p in zip(found, np.clip(unit, 0.0, 1.0).tolist(), strict=True)]
        self.kept = sorted({*self.kept, *points})[:REREAD]
        return found


def scipy_search(options: dict[str, Any]) -> Callable[[Clock, Array, int], None]:
    """SciPy's differential evolution, a generation a batch; begun again where all its members are alike."""

    def search(clock: Clock, start: Array, seed: int) -> None:
        settings: dict[str, Any] = {"bounds": [(0.0, 1.0)] * len(start), "vectorized": True, "updating": "deferred"}
        settings |= {"maxiter": 10**9, "tol": 0, "atol": 0, "polish": False, "x0": start, **options}
        solve: Any = differential_evolution  # its stub knows scalar costs only
        for again in count():
            solve(lambda unit: clock(np.atleast_2d(unit.T)), seed=seed + 1000 * again, **settings)

    return search


def shade_search(clock: Clock, start: Array, seed: int) -> None:
    """Success-history differential evolution with 40 members."""
    rng = np.random.default_rng(seed)
    population = first_population(40, start, rng)
    history = SuccessHistory(population, clock(population), rng)
    while True:
        trials = history.propose()
        history.select(trials, clock(trials))


def cma_search(clock: Clock, start: Array, seed: int) -> None:
    """CMA-ES with 16 members, restarted at random where it stops."""
    rng, bounds = np.random.default_rng(seed), np.array([[0.0, 1.0]] * len(start))
    while True:
        optimiser = CMA(mean=start, sigma=0.25, bounds=bounds, population_size=16, seed=int(rng.integers(2**31)))
        while not optimiser.should_stop():
            points = np.array([optimiser.ask() for _ in range(optimiser.population_size)])
            optimiser.tell(list(zip(points, clock(points).tolist(), strict=True)))
        start = rng.random(len(start))


RIVALS: dict[str, Callable[[Clock, Array, int], None]] = {
    "de": scipy_search({}),
    "de_own": scipy_search(OWN),
    "shade": shade_search,
    "cma": cma_search,
}


def run(
    names: Sequence[str],
    seeds: int,
    spec: Specification,
    rivals: Sequence[str] = tuple(RIVALS),
    times: Sequence[int] = TIMES,
) -> Study:
    study = Study()
    for name in names:
        search = prepare(name, spec, po.Racing())
        for method, seed, result in compete(search, seeds, rivals, times):
            study.runs.setdefault(name, {}).setdefault(method, []).append(result)
            print(
                f"{name} seed {seed} {method}: {result.settling_time:.4f} s, {result.cpu_seconds:.1f} s CPU", flush=True
            )
    return study


def prepare(name: str, spec: Specification, method: Any) -> Search:
    """A row of the benchmark with its compiled simulator, warm."""
    loop, given = benchmark(ROWS[name].gains)
    task = prepare_task(loop, STEP, given, spec, ROWS[name].scenarios(given))
    search = prepare_search(task, method)
    search.simulator.values(task.space.from_unit(np.full((8, len(task.space.names)), 0.5)), task.spec)
    return search


def compete(
    search: Search, seeds: int, rivals: Sequence[str] = tuple(RIVALS), multiples: Sequence[int] = TIMES
) -> Iterator[tuple[str, int, Run]]:
    """Every method with every seed."""
    spent = []
    every = range(FIRST_SEED, FIRST_SEED + seeds)
    for seed in every:
        begun = time.process_time()
        found = with_seed(search, seed).find(search.method.margin, search.space.start, 0)
        spent.append(time.process_time() - begun)
        yield "racing", seed, certified(search, found.point, spent[-1])
    for seed in every:
        for rival in rivals:
            for times in multiples:
                limit = times * median(spent)
                yield f"{rival}.x{times}", seed, certified(search, best_of(search, RIVALS[rival], limit, seed), limit)


def with_seed(search: Search, seed: int) -> Search:
    """The search with other random numbers, on the same warm simulator."""
    return search.with_specification(search.spec, po.Racing(seed=seed))


def tight(search: Search) -> Specification:
    """What is asked of a search, tightened by the margin of the first attempt."""
    return search.tighten(search.method.margin)


def best_of(search: Search, find: Callable[[Clock, Array, int], None], limit: float, seed: int) -> Array:
    """The answer of a rival after a CPU time: the best, read closely, of its best on coarse samples."""
    space, spec = search.space, tight(search)
    start = space.to_unit(space.start)
    simulators = (search.simulator.coarse(spec), search.simulator.shorten_steps())
    coarse, fine = (Race(s, spec, search.task.horizon) for s in simulators)

    def merit(unit: Array, rivals: Array) -> Array:
        return coarse.merits(space.from_unit(np.clip(unit, 0.0, 1.0)), rivals)[0]

    clock = Clock(merit, limit)
    with suppress(OutOfTimeError):
        find(clock, start, seed)
    points = space.from_unit(np.array([point for _, point in clock.kept]))
    return np.asarray(points[np.argmin(fine.merits(points)[0])])


def certified(search: Search, point: Array, seconds: float) -> Run:
    """The certificate of a point, rounded."""
    result = search.certify_point(point)
    worst = result.certified.max(axis=1)
    time_ = float(worst["SettlingTime"]) if result.status.converged else inf
    return Run(time_, float(worst["Overshoot"]), float(worst["MaxSensitivity"]), seconds)


def main(study: Study) -> "DataFrame":
    claims = []
    for row, methods in study.runs.items():
        reference = study.reference(row)
        claims.append(Claim(f"{row}.reference", reference, "s"))
        for method, runs in methods.items():
            times = [r.settling_time for r in runs]
            claims += [Claim(f"{row}.{method}.{label}", pick(times), "s") for label, pick in PICKS.items()]
            for name, share in (("within_2_percent", 1.02), ("within_5_percent", 1.05)):
                value = 100 * float(np.mean([t <= share * reference < inf for t in times]))
                claims.append(
                    Claim(f"{row}.{method}.{name}", value, "% of seeds", None, BOUNDS.get(f"{row}.{method}.{name}", ""))
                )
            claims.append(Claim(f"{row}.{method}.cpu", median([r.cpu_seconds for r in runs]), "s"))
            refused = sum(t == inf for t in times)
            claims.append(Claim(f"{row}.{method}.without_certificate", refused, "1"))
        others = [median([r.settling_time for r in runs]) for m, runs in methods.items() if m.endswith(".x1")]
        ours = median([r.settling_time for r in methods["racing"]])
        if not others:
            continue
        ahead = min(others) / ours if ours < inf else 0.0
        claims.append(Claim(f"{row}.best_rival_over_racing", ahead, "1", None, ">= 1"))
    return frame(claims)


PICKS: dict[str, Callable[[list[float]], float]] = {"best": min, "median": lambda v: float(np.median(v)), "worst": max}


def figure(study: Study) -> "Figure":
    """Certified settling times of every seed, by method; a cross at the top has no certificate."""
    picture, (all_axes,) = axes_grid(1, len(study.runs), (3.2,), width=1.5 + 3.5 * len(study.runs))
    for axes, (row, methods) in zip(all_axes, study.runs.items(), strict=True):
        certified_times = [r.settling_time for runs in methods.values() for r in runs if r.settling_time < inf]
        top = 1.03e3 * max(certified_times, default=STEP.horizon)
        points = [
            (k + 0.1 * (i - 0.5 * (len(runs) - 1)), m == "racing", r.settling_time)
            for k, (m, runs) in enumerate(methods.items())
            for i, r in enumerate(runs)
        ]
        rivals = [(x, t) for x, is_ours, t in points if not is_ours and t < inf]
        for label, style, colour, chosen in (
            ("racing", "o", BLUE, [(x, t) for x, is_ours, t in points if is_ours and t < inf]),
            ("rivals, the same CPU time", "o", GREY, rivals),
            ("without certificate", "x", RED, [(x, t) for x, _, t in points if t == inf]),
        ):
            times = [min(1e3 * t, top) for _, t in chosen]
            axes.plot([x for x, _ in chosen], times, style, ms=5, color=colour, alpha=0.7, label=label)
        axes.axhline(min(1e3 * study.reference(row), top), color="k", lw=0.8, ls="--", label="best found")
        axes.set_title(row.replace("_", " gains, "), fontsize=10)
        axes.set_xticks(range(len(methods)), [m.removesuffix(".x1") for m in methods], rotation=30, ha="right")
        axes.margins(x=0.12)
    all_axes[0].set_ylabel("certified settling time [ms]")
    legend_above(picture, all_axes[0], columns=2 if len(study.runs) == 1 else 4)
    return picture


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, metavar="N", help="runs of each method (3; the study has 10)"
    )
    parser.add_argument("--rivals", nargs="*", choices=list(RIVALS), default=list(RIVALS), help="which rivals, if any")
    parser.add_argument(
        "--times", type=int, nargs="+", default=list(TIMES), help="CPU time of the rivals, over racing's"
    )
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="which rows of the study")
    parser.add_argument("--without-conditions", action="store_true", help="ask for no Ms")
    options = parser.parse_args()
    asked = specify(MINIMISE, [OVERSHOOT] if options.without_conditions else [OVERSHOOT, SENSITIVITY])
    study = run(options.rows, options.seeds, asked, options.rivals, options.times)
    sys.exit(finish(main(study), options, lambda: {"t32": figure(study)}))
