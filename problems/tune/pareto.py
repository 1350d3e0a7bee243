"""What settling fast costs: Pareto fronts by continuation on the paper's linear plant, and on T32.

    python problems/tune/pareto.py [--json FILE] [--out DIR]

The linear plant is the paper's at half its loop gain, band 0.1 %, overshoot at most 0.02 %. "linear" is settling time
against the command's peak, from the paper's 1.225 down, with a sensitivity of at most 1.4, 15 designs; "sensitivity" is
settling time against maximum sensitivity with that peak as limit. The solver's CPU time is that of one continuation
through the 15 limits, each problem from its neighbours' solutions, as `pareto_front` runs it, without the two full
tunings that find its ends, the making of the problem, and the certificates; it is what it is on a machine with nothing
else to do. Brute force is differential evolution for each design's limit, on the search's own
simulator, many times as long; "beaten_by" is by how much its best settling time is better than the front's.

On T32 (t32.py: LuGre friction, dead zone, dither; overshoot at most 5 %) settling time against the command's peak, 5
designs by short searches from their neighbours.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.optimize import differential_evolution

import pneuopt as po
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import plot_front
from pneuopt.tuning.racing import compute_merits
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.two_phase import two_phase_path
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.paper2015 import paper_plant
from problems.shared.t32 import STEP, benchmark

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

LINEAR = po.Step(1.0)
BAND = 0.001
PAPER = {"pid.Kp": 0.225, "pid.Ki": 1.23, "pid.Kd": 0.01, "pid.Tf": 0.01}
RANGES = {"pid.Kp": (0.0, 1.0), "pid.Ki": (0.0, 5.0), "pid.Kd": (0.0, 0.05), "pid.Tf": (0.005, 0.05)}
OVERSHOOT, PEAK, SENSITIVITY = po.Overshoot(2e-4), po.PeakControl(1.225), po.MaxSensitivity(1.4)
POINTS, SOME, FEW = 15, 7, 5
PROBED = (3, 7, 11)  # designs that brute force is set on
# Of brute force, and the band of its first half: within a narrow one next to nothing settles that it begins with.
EVOLUTION: dict[str, Any] = {"popsize": 15, "maxiter": 120, "tol": 0, "atol": 0, "polish": False, "seed": 1}
WIDE = 0.005
UNITS = {
    "linear": {"SettlingTime": "s", "PeakControl": ""},
    "sensitivity": {"SettlingTime": "s", "MaxSensitivity": ""},
    "t32": {"SettlingTime": "s", "PeakControl": "V"},
}


@dataclass(frozen=True, eq=False)
class Job:
    """The fronts; CPU seconds of the solver along the linear one; by how much brute force beats its designs."""

    fronts: dict[str, "pd.DataFrame"]
    solver: float
    beaten: dict[int, float]


def run() -> Job:
    loop, given = paper_loop()
    settle = po.SettlingTime(BAND)
    linear = po.pareto_front(
        loop,
        LINEAR,
        given,
        minimise=(settle, PEAK),
        subject_to=[OVERSHOOT, SENSITIVITY],
        points=POINTS,
        progress=told,
    )
    robust = po.pareto_front(
        loop,
        LINEAR,
        given,
        minimise=(settle, po.MaxSensitivity()),
        subject_to=[OVERSHOOT, PEAK],
        points=SOME,
        progress=told,
    )
    friction, hardware = benchmark()
    pair_t32 = (po.SettlingTime(0.02), po.PeakControl())
    t32 = po.pareto_front(
        friction, STEP, hardware, minimise=pair_t32, subject_to=[po.Overshoot(0.05)], points=FEW, progress=told
    )
    solver, probed = continuation(loop, given, linear), {k: beaten(loop, given, linear, k) for k in PROBED}
    return Job({"linear": linear, "sensitivity": robust, "t32": t32}, solver, probed)


def told(line: str) -> None:
    print(line[:100], end="\r", file=sys.stderr)


def paper_loop() -> tuple[po.ClosedLoop, po.ParameterSet]:
    plant, printed = paper_plant(0.5)
    loop = po.ClosedLoop(plant, po.PID(limits=False))
    return loop, (loop.parameters | printed).with_values(PAPER).with_bounds(RANGES).freed(*RANGES)


def continuation(loop: po.ClosedLoop, given: po.ParameterSet, front: "pd.DataFrame") -> float:
    """CPU seconds of the solver along the front's limits, each solved from its neighbours; inf if one fails."""
    space, method, limits = search_space(loop, given), po.TwoPhase(), front["limit"].to_numpy(dtype=float).tolist()
    limits[-1] *= 1 + 1e-3  # the least that can be, which leaves no room for the search's margin
    specs = [asked(limit).tighten(method.margin, method.margin / 300) for limit in limits]
    path = two_phase_path(loop, [LINEAR], space, specs[0], method)
    start = front[list(space.names)].to_numpy(dtype=float)[0]
    path.follow(start, specs[:1])  # warm
    begun = time.process_time()
    solutions = path.follow(start, specs)
    spent = time.process_time() - begun
    return spent if all(s.status.converged for s in solutions) else float("inf")


def asked(limit: float) -> Specification:
    return specify(po.SettlingTime(BAND), [OVERSHOOT, SENSITIVITY, po.PeakControl(limit)])


def beaten(loop: po.ClosedLoop, given: po.ParameterSet, front: "pd.DataFrame", k: int) -> float:
    """By how much differential evolution settles faster than a design within its limit, as a fraction."""
    space, spec = search_space(loop, given), asked(front["limit"].to_numpy(dtype=float)[k])
    simulator = Simulator(loop, [LINEAR], space, spec=spec)
    unit = space.to_unit(space.start)
    for band in (WIDE, BAND):
        unit = evolve(simulator, spec.with_band(band), unit)
    values = {n: float(v[0]) for n, v in simulator.values(space.from_unit(unit)[None], spec).items()}
    ours = front["SettlingTime"].to_numpy(dtype=float)[k]
    return 1 - values["SettlingTime"] / ours if not spec.violations(values, 1e-4) else -np.inf


def evolve(simulator: Simulator, spec: Specification, start: np.ndarray) -> np.ndarray:
    """SciPy's differential evolution from a point of the unit cube, which it keeps unless it finds a better one."""

    def cost(unit: np.ndarray) -> np.ndarray:
        points = simulator.space.from_unit(np.clip(np.atleast_2d(unit.T), 0.0, 1.0))
        return compute_merits(simulator.values(points, spec), spec, LINEAR.horizon)

    solve: Any = differential_evolution  # its stub knows scalar costs only
    bounds = [(0.0, 1.0)] * len(start)
    return np.asarray(solve(cost, bounds, x0=start, vectorized=True, updating="deferred", **EVOLUTION).x)


def main(job: Job) -> "pd.DataFrame":
    claims = []
    for name, front in job.fronts.items():
        first, second = UNITS[name]
        good = front[front["error"] == ""]
        a, b = (good[n].to_numpy(dtype=float) for n in (first, second))
        dominated = sum(bool(np.any((a < a[k] * (1 - 1e-3)) & (b <= b[k]))) for k in range(len(good)))
        claims += [
            Claim(f"{name}.designs", len(front), "1"),
            Claim(f"{name}.certified", len(good), "1", None, f">= {len(front)}"),
            Claim(f"{name}.dominated", dominated, "1", None, "<= 0"),
            Claim(
                f"{name}.deviation",
                1e3 * float(np.max(np.abs(a - good[f"claimed {first}"].to_numpy(dtype=float)))),
                "ms",
                None,
                "<= 1",
            ),
            Claim(f"{name}.seconds", float(front["seconds"].sum()), "s"),
        ]
        for end, k in {"fastest": 0, "gentlest": len(good) - 1}.items():
            claims += [
                Claim(f"{name}.{end}.{n}", good[n].to_numpy(dtype=float)[k], unit or "1")
                for n, unit in UNITS[name].items()
            ]
    claims.append(Claim("linear.solver_cpu_seconds", job.solver, "s", None, "<= 1"))
    claims += [Claim(f"linear.design_{k}.beaten_by", 100 * by, "%", None, "<= 3") for k, by in job.beaten.items()]
    return frame(claims)


def figures(job: Job) -> Mapping[str, "Figure"]:
    return {f"pareto_{name}": plot_front(front, UNITS[name]) for name, front in job.fronts.items()}


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: figures(job)))
