"""T32 over one plant and over many: condensed multiple shooting beside differential evolution, by CPU time.

    python problems/benchmark_tuning.py [--seeds N] [--jobs NAME ...] [--json FILE] [--out DIR]

The plant, the step and the five gains are those of t32.py. "corners" are the eight of mass and friction +-30 % and
supply pressure +-10 %, beside the nominal plant; "plants" are 32 drawn from their box. With eight gains the
derivative's filter Tf and the set-point weights b and c are free as well (a feedforward, which the study has beside
them, the loop does not know).

All methods get one warm compiled simulator, one merit, the same start and the same margins: `condensed`; SciPy's
differential evolution with its defaults, without its polish, for once and three times the CPU time that condensed took
("de.x1", "de.x3"); and pneuopt's own, `screening`, to its end. Results are printed to four digits and certified by the
independent simulation in every scenario; the worst of them counts, and is what best, median and worst of the seeds
are taken of ("claimed" and "cpu" are medians). "fresh" are 100 plants from the corners' box that no search has seen, by
the compiled simulation.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from claims import Claim, arguments, finish, frame
from numpy.typing import NDArray
from scipy.optimize import differential_evolution
from t32 import DIGITS, MARGIN, PEAKS, SPEC, STEP, benchmark

import pneuopt as po
from pneuopt.plotting.canvas import BLUE, GREY, ORANGE, axes_grid, legend_above
from pneuopt.scenarios import NOMINAL, Scenarios
from pneuopt.tuning.candidates import Space, span
from pneuopt.tuning.condensed import condense
from pneuopt.tuning.screening import merit, screen
from pneuopt.tuning.simulator import Responses, Simulator

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Array = NDArray[np.float64]
FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
SPREADS: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, FRICTION: 0.3, "supply.pressure": 0.1}
MORE = {"pid.Tf": (5e-4, 0.05), "pid.b": (0.0, 1.5), "pid.c": (0.0, 1.5)}
FRESH, DRAWN = 100, 32
TIMES = (1, 3)  # the CPU time that SciPy gets, over that of condensed
TIGHT = SPEC.tightened(MARGIN, PEAKS)
WARM = po.Condensed(members=5, generations=1, iterations=1, renewals=0, polish=1)
BOUNDS = {
    "5_corners.condensed.median": "<= 0.157",
    "8_corners.condensed.median": "<= 0.075",
    "8_plants.condensed.median": "<= 0.078",
}


@dataclass(frozen=True)
class Job:
    """One row of the study."""

    gains: int
    scenarios: Callable[[po.ParameterSet], Scenarios]


JOBS = {
    "5_nominal": Job(5, lambda _: NOMINAL),
    "5_corners": Job(5, lambda given: po.corners(given, SPREADS)),
    "8_corners": Job(8, lambda given: po.corners(given, SPREADS)),
    "8_plants": Job(8, lambda given: po.samples(given, SPREADS, DRAWN)),
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
    """A simulator that keeps the best point by the exact merit against CPU time, and stops a search at a limit."""

    simulator: Simulator
    limits: tuple[float, ...] = (inf,)
    begun: float = field(default_factory=time.process_time)
    best: float = inf
    point: Array = field(default_factory=lambda: np.zeros(0))
    trace: list[tuple[float, float]] = field(default_factory=list)
    kept: list[tuple[Array, float, float]] = field(default_factory=list)

    def merits(self, points: Array) -> Array:
        """Of candidates on every case; raises StopIteration at the last limit."""
        found = merit(self.simulator.respond(points, TIGHT.band).values, TIGHT, STEP.horizon)
        spent = time.process_time() - self.begun
        while len(self.kept) < len(self.limits) and spent > self.limits[len(self.kept)]:
            self.kept.append((self.point, self.best, self.limits[len(self.kept)]))
        if len(self.kept) == len(self.limits):
            raise StopIteration
        k = int(np.argmin(found))
        if found[k] < self.best:
            self.best, self.point = float(found[k]), points[k]
        self.trace.append((spent, self.best))
        return found


def run(names: list[str], seeds: int) -> tuple[dict[str, dict[str, list[Run]]], dict[str, list[Clock]]]:
    """Runs by job and method, one a seed; SciPy's traces by job."""
    found: dict[str, dict[str, list[Run]]] = {}
    traces: dict[str, list[Clock]] = {}
    for name in names:
        job = JOBS[name]
        loop, given = benchmark()
        given = given.with_bounds(MORE).freed(*MORE) if job.gains == 8 else given
        space, scenarios = span(loop, given), job.scenarios(given)
        simulator = Simulator(loop, [STEP], space, scenarios)
        fresh = Simulator(loop, [STEP], space, po.samples(given, SPREADS, FRESH, seed=999))
        simulator.values(space.draw(np.full((8, len(space.names)), 0.5)), TIGHT)  # compiled and warm
        condense(simulator, [STEP], space, TIGHT, WARM, space.start, lambda _: None)
        rows = found.setdefault(name, {})
        for seed in range(seeds):
            points = dict(searched(simulator, space, seed, traces.setdefault(name, [])))
            for method, (point, claimed, seconds) in points.items():
                shown = judged(loop, space, scenarios, fresh, point)
                rows.setdefault(method, []).append(Run(claimed, shown[0], shown[1], seconds, shown[2], shown[3]))
                print(
                    f"{name} seed {seed} {method}: {claimed:.4f} s claimed, {shown[0]:.4f} s, {seconds:.1f} s CPU",
                    flush=True,
                )
    return found, traces


def searched(simulator: Simulator, space: Space, seed: int, traces: list[Clock]) -> Any:
    """Each method's point, its merit and what it took [s]."""
    begun, spent = time.process_time(), 0.0
    for name, method in {"condensed": po.Condensed(seed=seed), "screening": po.Screening(seed=seed)}.items():
        begun = time.process_time()
        search: Any = condense if name == "condensed" else screen
        point = search(simulator, [STEP], space, TIGHT, method, space.start, lambda _: None).point
        took = time.process_time() - begun
        spent = took if name == "condensed" else spent
        yield name, (point, value(simulator, point), took)
    clock = Clock(simulator, tuple(k * spent for k in TIMES))
    evolve(clock, space, seed)
    while len(clock.kept) < len(TIMES):
        clock.kept.append((clock.point, clock.best, time.process_time() - clock.begun))
    traces.append(clock)
    yield from ((f"de.x{k}", kept) for k, kept in zip(TIMES, clock.kept, strict=True))


def value(simulator: Simulator, point: Array) -> float:
    responses: Responses = simulator.respond(point[None], TIGHT.band)
    return float(merit(responses.values, TIGHT, STEP.horizon)[0])


def evolve(clock: Clock, space: Space, seed: int) -> None:
    """SciPy's differential evolution, a generation a batch, stopped by the clock or by its own tolerance."""

    def cost(unit: Array) -> Array:
        return clock.merits(space.draw(np.clip(np.atleast_2d(unit.T), 0.0, 1.0)))

    settings: dict[str, Any] = {"bounds": [(0.0, 1.0)] * len(space.names), "vectorized": True, "updating": "deferred"}
    settings |= {"maxiter": 100000, "x0": space.unit(space.start), "seed": seed, "polish": False}
    solve: Any = differential_evolution  # its stub knows scalar costs only
    try:
        solve(cost, **settings)
    except StopIteration:
        return


def judged(
    loop: po.ClosedLoop, space: Space, scenarios: Scenarios, fresh: Simulator, point: Array
) -> tuple[float, float, float, float]:
    """Certified settling time and overshoot, the worst; shares of fresh plants that settle, and that keep 5 %."""
    printed = space.printed(point, DIGITS)
    found = po.evaluate(loop, STEP, space.filled(printed), scenarios=scenarios, band=SPEC.band)
    responses = fresh.respond(printed[None], SPEC.band)
    settled = np.isfinite(responses.table("SettlingTime")[0, 1:]).sum()
    kept = (responses.table("Overshoot")[0, 1:] <= 5.0).sum()
    worst = found.loc[["SettlingTime", "Overshoot"]].to_numpy(dtype=float).max(axis=1)
    return float(worst[0]), float(worst[1]), float(settled), float(kept)


def main(found: dict[str, dict[str, list[Run]]]) -> "DataFrame":
    claims = []
    for job, methods in found.items():
        for method, runs in methods.items():
            for label, pick in PICKS.items():
                row = f"{job}.{method}.{label}"
                times = [inf if np.isnan(r.settling_time) else r.settling_time for r in runs]
                claims.append(Claim(row, pick(times), "s", None, BOUNDS.get(row, "")))
            claims.append(Claim(f"{job}.{method}.claimed", median([r.claimed for r in runs]), "s"))
            claims.append(Claim(f"{job}.{method}.cpu", median([r.cpu_seconds for r in runs]), "s"))
            held = "<= 5" if method == "condensed" else ""
            claims.append(Claim(f"{job}.{method}.overshoot", max(r.overshoot for r in runs), "%", None, held))
            if "corners" in job:
                held = ">= 95" if method == "condensed" else ""
                for row, shares in (("settled", "fresh_settled"), ("within_5", "fresh_overshoot")):
                    least = min(getattr(r, shares) for r in runs)
                    claims.append(Claim(f"{job}.{method}.fresh.{row}", least, "1", None, held))
        if job.startswith("8_"):
            ours, theirs = (
                median([inf if np.isnan(r.settling_time) else r.settling_time for r in methods[m]])
                for m in ("condensed", "de.x3")
            )
            claims.append(Claim(f"{job}.de_x3_over_ours", theirs / ours, "1", None, ">= 1"))
    return frame(claims)


PICKS: dict[str, Callable[[list[float]], float]] = {"best": min, "median": lambda v: float(np.median(v)), "worst": max}


def figure(found: dict[str, dict[str, list[Run]]], traces: dict[str, list[Clock]]) -> "Figure":
    """Best merit so far of SciPy's search over CPU time, and where the others end."""
    picture, ((*all_axes,),) = axes_grid(1, len(traces), (3.2,), width=4.0 * len(traces))
    for axes, (name, clocks) in zip(all_axes, traces.items(), strict=True):
        for number, clock in enumerate(clocks):
            seconds, best = np.array(clock.trace).T
            axes.semilogy(seconds, best, color=GREY, lw=1.2, label="SciPy DE" if number == 0 else None)
        for method, colour in {"condensed": BLUE, "screening": ORANGE}.items():
            runs = found[name][method]
            axes.semilogy([r.cpu_seconds for r in runs], [r.claimed for r in runs], "o", color=colour, label=method)
        axes.set(xlabel="CPU time [s]", ylabel="settling time claimed [s]", title=name, ylim=(0.03, 1))
    legend_above(picture, all_axes[0])
    return picture


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="runs of each method (3; the study has 10)")
    parser.add_argument("--jobs", nargs="+", choices=list(JOBS), default=list(JOBS), help="which rows of the study")
    options = parser.parse_args()
    runs, traces = run(options.jobs, options.seeds)
    sys.exit(finish(main(runs), options, lambda: {"benchmark_tuning": figure(runs, traces)}))
