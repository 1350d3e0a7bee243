"""The tuning benchmark T32: `tune`'s screening beside SciPy's differential evolution, on the same simulator.

    python problems/speed/t32.py [--json FILE] [--out DIR]

A 32 mm cylinder with LuGre friction and a valve with a dead zone steps from rest to 0.2 m/s under a continuous PID and
a dither of 1000 rad/s. Kp, Ki, Kd, the dither's amplitude and its offset are free; what is minimised is the settling
time to 2 %, overshoot at most 5 %. Both methods get one compiled simulator, one merit function, the same first member
and the same margins; both results are printed to four digits and certified by the same independent simulation.

"settling_time" is that of the speed averaged over the dither's period, which is what both minimise; "raw" is that of
the speed as it is.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.optimize import differential_evolution

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from pneuopt.tuning.responses import Responses
from pneuopt.tuning.screening import compute_merits, run_screening
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import Space, search_space
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import STEP, benchmark

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

SPEC = specify(po.SettlingTime(band=0.02), [po.Overshoot(0.05)])
SEEDS = (0, 1, 2)
DIGITS, MARGIN, PEAKS = 4, 0.015, 0.003
TIMES = (1, 2, 4)  # the simulations that differential evolution gets, over the screening's
# The screening's own population and mutation, without its wide bands and its local search.
TUNED: dict[str, Any] = {"popsize": 8, "strategy": "randtobest1bin", "mutation": (0.4, 0.9), "recombination": 0.9}


@dataclass
class Counter:
    """A simulator that counts and times what a method asks of it, and keeps the best point by merit."""

    simulator: Simulator
    space: Space
    spec: Specification
    limits: tuple[float, ...] = (inf,)
    simulations: int = 0
    best: float = inf
    point: Array = field(default_factory=lambda: np.zeros(0))
    trace: list[tuple[int, float]] = field(default_factory=list)
    kept: list[tuple[Array, float, int, float, float]] = field(default_factory=list)
    begun: tuple[float, float] = field(default_factory=lambda: (time.perf_counter(), time.process_time()))

    @property
    def cases(self) -> Sequence[object]:
        """As `Simulator.cases`."""
        return self.simulator.cases

    def respond(self, points: Array, band: float) -> Responses:
        """As `Simulator.respond`; the merit that is kept is always that of the narrow band."""
        if len(self.kept) < len(self.limits) and self.simulations + len(points) > self.limits[len(self.kept)]:
            self.keep()
        found = self.simulator.respond(points, band)
        self.simulations += len(points)
        if band == self.spec.band:
            merits = compute_merits(found.values, self.spec, STEP.horizon)
            k = int(np.argmin(merits))
            if merits[k] < self.best:
                self.best, self.point = float(merits[k]), points[k]
            self.trace.append((self.simulations, self.best))
        return found

    def keep(self) -> None:
        """The best point so far, its merit, simulations, wall and CPU seconds."""
        wall, cpu = self.begun
        self.kept.append(
            (self.point, self.best, self.simulations, time.perf_counter() - wall, time.process_time() - cpu)
        )


@dataclass(frozen=True)
class Run:
    """What one method found with one seed: settling time claimed, certified, and of the raw speed [s]; its cost."""

    claimed: float
    settling_time: float
    raw: float
    overshoot: float
    max_sensitivity: float
    simulations: float
    seconds: float
    cpu_seconds: float


@dataclass(frozen=True)
class Job:
    """Runs by method, one a seed; the best merit over the simulations, likewise."""

    runs: dict[str, list[Run]]
    traces: dict[str, list[list[tuple[int, float]]]]


def run() -> Job:
    loop, given = benchmark()
    space = search_space(loop, given)
    simulator, spec = Simulator(loop, [STEP], space), SPEC.tighten(MARGIN, PEAKS)
    simulator.values(space.from_unit(np.full((8, len(space.names)), 0.5)), spec)  # compiled and warm
    runs, traces = dict[str, list[Run]](), dict[str, list[list[tuple[int, float]]]]()
    for seed in SEEDS:
        ours = Counter(simulator, space, spec)
        method = po.Screening(seed=seed)
        run_screening(ours, [STEP], space, spec, method, space.start, lambda _: None)  # type: ignore[arg-type]  # counts
        ours.keep()
        budget = ours.kept[-1][2]
        rivals: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
            "de": (TIMES, {"polish": False}),
            "de_tuned": ((1, 2), {"polish": False, **TUNED}),
            "de_polished": ((1,), {"polish": True}),
        }
        found = {"screening": ours.kept[-1]}
        traces.setdefault("screening", []).append(ours.trace)
        for name, (times, options) in rivals.items():
            limits = tuple(k * budget for k in times) if not options["polish"] else (inf,)
            counter = Counter(simulator, space, spec, limits)
            evolve(counter, times[-1] * budget, seed, options)
            while len(counter.kept) < len(times):
                counter.keep()
            found |= {f"{name}.x{k}": kept for k, kept in zip(times, counter.kept, strict=True)}
            traces.setdefault(name, []).append(counter.trace)
        for name, (point, claimed, *cost) in found.items():
            runs.setdefault(name, []).append(Run(claimed, *certified(loop, space, point), *cost))
    return Job(runs, traces)


def evolve(counter: Counter, budget: int, seed: int, options: dict[str, Any]) -> None:
    """SciPy's differential evolution, a generation a batch, stopped at so many simulations or by its own tolerance."""
    space = counter.space

    def cost(unit: Array) -> Array:
        points = space.from_unit(np.clip(np.atleast_2d(unit.T), 0.0, 1.0))
        return compute_merits(counter.respond(points, counter.spec.band).values, counter.spec, STEP.horizon)

    members = options.get("popsize", 15) * len(space.names)
    settings: dict[str, Any] = {"bounds": [(0.0, 1.0)] * len(space.names), "vectorized": True, "updating": "deferred"}
    settings |= {"maxiter": max(1, budget // members - 1), "x0": space.to_unit(space.start), "seed": seed, **options}
    solve: Any = differential_evolution  # its stub knows scalar costs only
    solve(cost, **settings)


def certified(loop: po.ClosedLoop, space: Space, point: Array) -> tuple[float, float, float, float]:
    parameters = space.parameters_at(space.round_point(point, DIGITS))
    found = po.evaluate(loop, STEP, parameters, band=SPEC.band)[STEP.label]
    response = po.respond(loop, STEP, parameters)
    raw = settled(response.t, response["speed"])
    return found["SettlingTime"], raw, found["Overshoot"], found["MaxSensitivity"]


def settled(t: Array, speed: Array) -> float:
    """The settling time of the speed as it is [s]; NaN where the ripple keeps it out of the band."""
    about = po.step_metrics(t, speed, STEP.final, STEP.initial, band=SPEC.band, final=STEP.final)
    return about["SettlingTime"]


def main(job: Job) -> "DataFrame":
    claims = []
    for name, runs in job.runs.items():
        for label, pick in PICKS.items():
            value = float(pick([r.settling_time for r in runs]))
            claims.append(Claim(f"{name}.settling_time.{label}", value, "s", None, BOUNDS.get(f"{name}.{label}", "")))
        for row, unit in {"claimed": "s", "raw": "s", "seconds": "s", "cpu_seconds": "s", "simulations": "1"}.items():
            claims.append(Claim(f"{name}.{row}.median", float(np.median([getattr(r, row) for r in runs])), unit))
        claims.append(Claim(f"{name}.overshoot.worst", max(r.overshoot for r in runs), "%", None, "<= 5"))
        claims.append(Claim(f"{name}.max_sensitivity.median", float(np.median([r.max_sensitivity for r in runs]))))
    return frame(claims)


PICKS: dict[str, Callable[[list[float]], float]] = {"best": min, "median": lambda v: float(np.median(v)), "worst": max}
BOUNDS = {"screening.best": "<= 0.07", "screening.median": "<= 0.075"}


def figure(job: Job) -> "Figure":
    picture, ((axes,),) = axes_grid(1, 1, (3.2,), width=8.0)
    for (name, traces), colour in zip(job.traces.items(), (BLUE, ORANGE, GREY, "k"), strict=True):
        for number, trace in enumerate(traces):
            count, best = np.array(trace).T
            axes.semilogy(count, best, color=colour, lw=1.2, label=name if number == 0 else None)
    axes.set(xlabel="simulations", ylabel="best merit [s]", ylim=(0.04, 5))
    legend_above(picture, axes)
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"t32": figure(job)}))
