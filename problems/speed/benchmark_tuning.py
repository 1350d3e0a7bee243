"""T32 over one plant and over many: condensed multiple shooting beside differential evolution, by CPU time.

    python problems/speed/benchmark_tuning.py [--seeds N] [--jobs NAME ...] [--cap TIMES] [--json FILE] [--out DIR]

The plant, the step and the five gains are those of t32.py. "corners" are the eight of mass and friction +-30 % and
supply pressure +-10 %, beside the nominal plant; "plants" are 32 drawn from their box. With ten gains the derivative's
filter Tf, the set-point weights b and c, and the transient feedforward's gain and time are free as well.

All methods get one warm compiled simulator, one merit, the same start and the same margins: `condensed`; SciPy's
differential evolution with its defaults, but no polish and no tolerance to stop at, so that it uses its time ("de"),
and with our setting of it (`OWN`, "de_own"). Both run on the search's coarse samples, until they reach the median that
condensed claims, or for `--cap` times (10) the CPU time that it took, but three times at least; "x1" and "x3" are what
they had at once and three times that.

`OWN` is the best of 48 on 10_corners: best1bin, rand1bin, currenttobest1bin, randtobest1bin; popsize 4, 8, 15; Latin
hypercube or Sobol; SciPy's mutation and recombination, or (0.3, 0.9) and 0.9. All had 1.5 s on seed 300, the best nine
4 s on seed 301, the best three 14 s, as condensed then took, on seeds 300-302: medians 0.0477 (`OWN`), 0.0479 (best1bin
in its place) and 0.0484 s (that with Sobol). The early rounds favour what is fast at once.

"reach" is the median of the evolution's times to the median that condensed claims, the cap where it came first,
over condensed's median time to its end. The other way, "reach_of" is the median of condensed's times to the evolution's
certified median (x1), inf for a seed that ends above it, over the same; a seed counts with its whole time, when it was
there is not known. "at_median_of" is the share of seeds that end there.

Results are printed to four digits and certified by the independent simulation in every scenario; the worst of them
counts, and is what best, median and worst of the seeds are taken of ("claimed" and "cpu" are medians). "fresh" are 100
plants from the corners' box that no search has seen, by the compiled simulation.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.optimize import differential_evolution

import pneuopt as po
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from pneuopt.tuning.condensed import run_gradient_search
from pneuopt.tuning.responses import Responses
from pneuopt.tuning.screening import compute_merits
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, search_space
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import RANGES, STEP, benchmark
from problems.speed.t32 import DIGITS, MARGIN, PEAKS, SPEC

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
SPREADS: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, FRICTION: 0.3, "supply.pressure": 0.1}
MORE = {"pid.Tf": (5e-4, 0.05), "pid.b": (0.0, 1.5), "pid.c": (0.0, 1.5)}
MORE |= {"feedforward.gain": (-20.0, 40.0), "feedforward.time": (2e-3, 0.2)}
FRESH, DRAWN = 100, 32
TIMES = (1, 3)  # the CPU time at which SciPy's best is kept, over that of condensed
OWN: dict[str, Any] = {"popsize": 4, "strategy": "randtobest1bin", "mutation": (0.3, 0.9), "recombination": 0.9}
TIGHT = SPEC.tighten(MARGIN, PEAKS)
WARM = po.Condensed(members=5, generations=1, iterations=1, restarts=0, polish=1)
BOUNDS = {
    "5_corners.condensed.median": "<= 0.157",
    "10_corners.condensed.median": "<= 0.075",
    "10_plants.condensed.median": "<= 0.078",
    "10_corners.de.reach": ">= 3",
    "10_corners.de_own.reach": ">= 3",
    "10_plants.de.reach": ">= 10",
    "10_plants.de_own.reach": ">= 10",
}


@dataclass(frozen=True)
class Job:
    """One row of the study."""

    gains: int
    scenarios: Callable[[po.ParameterSet], Scenarios]


JOBS = {
    "5_nominal": Job(5, lambda _: NO_SCENARIOS),
    "5_corners": Job(5, lambda given: po.corners(given, SPREADS)),
    "10_corners": Job(10, lambda given: po.corners(given, SPREADS)),
    "10_plants": Job(10, lambda given: po.samples(given, SPREADS, DRAWN)),
}


@dataclass(frozen=True)
class Run:
    """What one method found with one seed."""

    claimed: float
    settling_time: float
    overshoot: float
    cpu_seconds: float
    fresh_settled: float
    fresh_overshoot: float


@dataclass
class Clock:
    """A simulator that keeps the best point by the merit against CPU time, and stops a search at goal or limit."""

    simulator: Simulator
    limits: tuple[float, ...]
    goal: float
    begun: float = field(default_factory=time.process_time)
    best: float = inf
    point: Array = field(default_factory=lambda: np.zeros(0))
    trace: list[tuple[float, float]] = field(default_factory=list)
    kept: list[Array] = field(default_factory=list)

    def merits(self, points: Array) -> Array:
        """Of candidates on every case; raises StopIteration."""
        found = compute_merits(self.simulator.respond(points, TIGHT.band).values, TIGHT, STEP.horizon)
        spent = time.process_time() - self.begun
        while len(self.kept) < len(TIMES) and spent > self.limits[len(self.kept)]:
            self.kept.append(self.point)
        k = int(np.argmin(found))
        if found[k] < self.best:
            self.best, self.point = float(found[k]), points[k]
        self.trace.append((spent, self.best))
        if len(self.kept) == len(TIMES) and (self.best <= self.goal or spent > self.limits[-1]):
            raise StopIteration
        return found

    @property
    def reached(self) -> float:
        """When the goal was [s CPU]; inf: not at all."""
        return next((seconds for seconds, best in self.trace if best <= self.goal), inf)


@dataclass
class Study:
    """Runs by job and method, one a seed; SciPy's traces; times to the goal over the time of condensed."""

    runs: dict[str, dict[str, list[Run]]] = field(default_factory=dict)
    traces: dict[str, list[Clock]] = field(default_factory=dict)
    reach: dict[str, dict[str, list[float]]] = field(default_factory=dict)


def run(names: list[str], seeds: int, cap: float = 10.0) -> Study:
    study = Study()
    for name in names:
        compete(study, name, seeds, cap)
    return study


def compete(study: Study, name: str, seeds: int, cap: float) -> None:
    """One row of the study: every method, every seed."""
    loop, given = posed(JOBS[name].gains)
    space, scenarios = search_space(loop, given), JOBS[name].scenarios(given)
    simulator = Simulator(loop, [STEP], space, scenarios)
    fresh = Simulator(loop, [STEP], space, po.samples(given, SPREADS, FRESH, seed=999))
    simulator.values(space.from_unit(np.full((8, len(space.names)), 0.5)), TIGHT)  # compiled and warm
    run_gradient_search(simulator, [STEP], space, TIGHT, WARM, space.start, lambda _: None)
    runs, reach = study.runs.setdefault(name, {}), study.reach.setdefault(name, {})

    def note(method: str, seed: int, point: Array, seconds: float) -> None:
        claimed, shown = value(simulator, point), judged(loop, space, scenarios, fresh, point)
        runs.setdefault(method, []).append(Run(claimed, shown[0], shown[1], seconds, shown[2], shown[3]))
        print(f"{name} seed {seed} {method}: {shown[0]:.4f} s, {seconds:.1f} s CPU", flush=True)

    for seed in range(seeds):
        note("condensed", seed, *timed(simulator, space, seed))
    goal, spent = (median([getattr(r, n) for r in runs["condensed"]]) for n in ("claimed", "cpu_seconds"))
    for seed in range(seeds):
        for method, options in (("de", {}), ("de_own", OWN)):
            clock = Clock(simulator.coarse(TIGHT), (*(k * spent for k in TIMES), cap * spent), goal)
            evolve(clock, space, seed, options)
            for k, point in zip(TIMES, [*clock.kept, *[clock.point] * len(TIMES)], strict=False):
                note(f"{method}.x{k}", seed, point, k * spent)
            study.traces.setdefault(name, []).append(clock)
            reach.setdefault(method, []).append(min(clock.reached / spent, max(cap, *TIMES)))


def posed(gains: int) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The benchmark with five gains free, or ten."""
    loop, given = benchmark()
    if gains == len(RANGES):
        return loop, given
    loop = replace(loop, feedforward=po.Feedforward())
    own = loop.parameters.select(loop.parameters.match_names("feedforward.*"))
    return loop, (given | own).with_bounds(MORE).freed(*MORE)


def timed(simulator: Simulator, space: Space, seed: int) -> tuple[Array, float]:
    """What condensed finds, and the CPU time that it takes [s]."""
    begun = time.process_time()
    found = run_gradient_search(simulator, [STEP], space, TIGHT, po.Condensed(seed=seed), space.start, lambda _: None)
    return found.point, time.process_time() - begun


def value(simulator: Simulator, point: Array) -> float:
    responses: Responses = simulator.respond(point[None], TIGHT.band)
    return float(compute_merits(responses.values, TIGHT, STEP.horizon)[0])


def evolve(clock: Clock, space: Space, seed: int, options: dict[str, Any]) -> None:
    """SciPy's differential evolution, a generation a batch, stopped by the clock, or once all its members are alike."""

    def cost(unit: Array) -> Array:
        return clock.merits(space.from_unit(np.clip(np.atleast_2d(unit.T), 0.0, 1.0)))

    settings: dict[str, Any] = {"bounds": [(0.0, 1.0)] * len(space.names), "vectorized": True, "updating": "deferred"}
    settings |= {"maxiter": 10**9, "tol": 0, "atol": 0, "polish": False, "seed": seed}
    settings |= {"x0": space.to_unit(space.start), **options}
    solve: Any = differential_evolution  # its stub knows scalar costs only
    try:
        solve(cost, **settings)
    except StopIteration:
        return


def judged(
    loop: po.ClosedLoop, space: Space, scenarios: Scenarios, fresh: Simulator, point: Array
) -> tuple[float, float, float, float]:
    """Certified settling time and overshoot, the worst; shares of fresh plants that settle, and that keep 5 %."""
    printed = space.round_point(point, DIGITS)
    found = po.evaluate(loop, STEP, space.parameters_at(printed), scenarios=scenarios, band=SPEC.band)
    responses = fresh.respond(printed[None], SPEC.band)
    settled = np.isfinite(responses.table("SettlingTime")[0, 1:]).sum()
    kept = (responses.table("Overshoot")[0, 1:] <= 5.0).sum()
    worst = found.loc[["SettlingTime", "Overshoot"]].to_numpy(dtype=float).max(axis=1)
    return float(worst[0]), float(worst[1]), float(settled), float(kept)


def main(study: Study) -> "DataFrame":
    claims = []
    for job, methods in study.runs.items():
        for method, runs in methods.items():
            for label, pick in PICKS.items():
                row = f"{job}.{method}.{label}"
                claims.append(Claim(row, pick(certified(runs)), "s", None, BOUNDS.get(row, "")))
            claims.append(Claim(f"{job}.{method}.claimed", median([r.claimed for r in runs]), "s"))
            claims.append(Claim(f"{job}.{method}.cpu", median([r.cpu_seconds for r in runs]), "s"))
            is_ours = method == "condensed"
            claims.append(
                Claim(f"{job}.{method}.overshoot", max(r.overshoot for r in runs), "%", None, "<= 5" if is_ours else "")
            )
            if "corners" in job:
                for row, shares in (("settled", "fresh_settled"), ("within_5", "fresh_overshoot")):
                    least = min(getattr(r, shares) for r in runs)
                    claims.append(Claim(f"{job}.{method}.fresh.{row}", least, "1", None, ">= 95" if is_ours else ""))
        for method, times in study.reach.get(job, {}).items():
            row, theirs = f"{job}.{method}.reach", median(certified(methods[f"{method}.x1"]))
            ours = methods["condensed"]
            spent = median([r.cpu_seconds for r in ours])
            claims.append(Claim(row, median(times), "1", None, BOUNDS.get(row, "")))
            share = np.mean([t <= theirs for t in certified(ours)])
            claims.append(Claim(f"{job}.condensed.at_median_of_{method}", float(100 * share), "% of seeds"))
            whole = [r.cpu_seconds if t <= theirs else inf for r, t in zip(ours, certified(ours), strict=True)]
            claims.append(Claim(f"{job}.condensed.reach_of_{method}", median(whole) / spent, "1"))
    return frame(claims)


def certified(runs: list[Run]) -> list[float]:
    """Settling times, inf for what never settles [s]."""
    return [inf if np.isnan(r.settling_time) else r.settling_time for r in runs]


PICKS: dict[str, Callable[[list[float]], float]] = {"best": min, "median": lambda v: float(np.median(v)), "worst": max}


def figure(study: Study) -> "Figure":
    """Best merit so far of SciPy's searches over CPU time, and where condensed ends."""
    picture, ((*all_axes,),) = axes_grid(1, len(study.traces), (3.2,), width=4.0 * len(study.traces))
    for axes, (name, clocks) in zip(all_axes, study.traces.items(), strict=True):
        for number, clock in enumerate(clocks):
            seconds, best = np.array(clock.trace).T
            label = ("SciPy DE, defaults", "SciPy DE, our setting")[number] if number < 2 else None
            axes.loglog(seconds, best, color=(GREY, ORANGE)[number % 2], lw=1.2, label=label)
        runs = study.runs[name]["condensed"]
        axes.loglog([r.cpu_seconds for r in runs], [r.claimed for r in runs], "o", color=BLUE, label="condensed")
        axes.set(xlabel="CPU time [s]", ylabel="settling time claimed [s]", title=name, ylim=(0.03, 3))
    legend_above(picture, all_axes[0])
    return picture


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="runs of each method (3; the study has 10)")
    parser.add_argument("--jobs", nargs="+", choices=list(JOBS), default=list(JOBS), help="which rows of the study")
    parser.add_argument("--cap", type=float, default=10.0, help="times of condensed's CPU time at most (10)")
    options = parser.parse_args()
    study = run(options.jobs, options.seeds, options.cap)
    sys.exit(finish(main(study), options, lambda: {"benchmark_tuning": figure(study)}))
