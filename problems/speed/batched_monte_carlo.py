"""A fixed design on 10 000 plants, many at once in SIMD lanes, beside one compiled simulation and scipy's solve_ivp.

    python problems/speed/batched_monte_carlo.py [--plants 10000] [--recertify .001] [--json FILE] [--out DIR]

The loop T32 of problems/shared/t32.py with dither, 1 s, one gain set; mass and friction +-30 %, supply +-10 %. CPU
seconds a plant, all in one run: the whole of `evaluate_batch` without its certificates, drawn plants to table
("batch"); the same compiled simulation of one plant at a time, same steps, outputs only ("scalar"); and solve_ivp's
LSODA at a tolerance of 1e-6, as one writes it first, on the model's CasADi Function ("solve_ivp"), and on the compiled
right-hand side ("solve_ivp_compiled"). The last has no bound: a hundred times is asked of solve_ivp as users have it,
and this one runs on pneuopt's own machine code. A million plants on paper: core-hours at the measured rate. The
differences are the largest ones between lanes and certificate, over the plants that were certified. The claims are
ratios: the seconds are the machine's.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.integrate import solve_ivp

import pneuopt as po
from pneuopt.dynamics.compiled.functions import compile_rate
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.tolerances import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.tolerances import SAMPLES_A_DITHER_PERIOD
from pneuopt.studies.tolerances import RATE_MARGIN
from pneuopt.tuning.space import fastest_eigenvalue, loop_pieces, rk4_substeps
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import SPREADS, STEP, benchmark

if TYPE_CHECKING:
    import pandas as pd

PLANTS, RECERTIFY, MILLION = 10_000, 0.001, 1e6
SINGLE = 32  # plants that run one at a time [1]: fewer jump, more only take time
INTEGRATED = 2  # plants that solve_ivp integrates
GAINS = {"pid.Kp": 2.806, "pid.Ki": 83.63, "pid.Kd": 0.1103, "dither.amplitude": 0.6155, "dither.offset": -0.07758}


def main(plants: int = PLANTS, recertify: float = RECERTIFY) -> "pd.DataFrame":
    loop, given = benchmark()
    design = given.with_values(GAINS)
    drawn = po.samples(given, SPREADS, plants)
    batch = _batch_seconds(loop, design, drawn)
    scalar = _scalar_seconds(loop, design, drawn)
    system = loop.system()
    rival = _solve_ivp_seconds(loop, design, lambda *given: system.ode(*given)[0].full().ravel())
    compiled = _solve_ivp_seconds(loop, design, compile_rate(system.ode))
    alone = ThreadPoolExecutor(1)
    found = po.evaluate_batch(loop, STEP, design, drawn, recertify=recertify, executor=alone)
    checks = found.checks
    largest = checks.groupby("metric", sort=False)["difference"].max().to_dict()
    return frame(
        [
            Claim("plants", plants),
            Claim("batch", 1e3 * batch, "ms"),
            Claim("scalar", 1e3 * scalar, "ms"),
            Claim("solve_ivp", 1e3 * rival, "ms"),
            Claim("solve_ivp_compiled", 1e3 * compiled, "ms"),
            Claim("plants_a_core_second", 1 / batch, "1/s"),
            Claim("batch_over_scalar", batch / scalar, "1", None, "<= 0.3"),
            Claim("solve_ivp_over_batch", rival / batch, "1", None, ">= 100"),
            Claim("solve_ivp_compiled_over_batch", compiled / batch),
            Claim("million", MILLION * batch / 3600, "h"),
            Claim("failed", int((found.table["error"] != "").sum()), "1", None, "<= 0"),
            Claim("certified", checks["case"].nunique()),
            Claim("apart", checks["case"][~checks["agrees"]].nunique(), "1", None, "<= 0"),
            *(Claim(f"{metric}.difference", float(value)) for metric, value in largest.items()),
        ]
    )


def _batch_seconds(loop: po.ClosedLoop, design: po.ParameterSet, plants: Any) -> float:
    """CPU seconds a plant of the lanes, with all that begins a batch but compiling and imports; no certificates."""
    few = dict(list(plants.items())[:SINGLE])
    po.evaluate_batch(loop, STEP, design, few, recertify=0.0, executor=ThreadPoolExecutor(1))  # compiles and imports
    clock = _LaneClock()
    po.evaluate_batch(loop, STEP, design, plants, recertify=0.0, executor=clock.idle, progress=clock)
    return clock.seconds / len(plants)


class _LaneClock:
    """CPU time up to the last chunk of a batch, before certificates begin."""

    def __init__(self) -> None:
        self.idle, self._begun, self.seconds = ThreadPoolExecutor(1), time.process_time(), nan

    def __call__(self, _: po.Progress) -> None:
        self.seconds = time.process_time() - self._begun


def _scalar_seconds(loop: po.ClosedLoop, design: po.ParameterSet, plants: Any) -> float:
    """CPU seconds of one compiled simulation, one plant at a time, on the steps that the lanes take."""
    full = loop.complete(design)
    period = 1 / full.value("dither.frequency")
    count = round(STEP.horizon * SAMPLES_A_DITHER_PERIOD / period)
    t = np.linspace(0.0, STEP.horizon, count + 1)[None]
    h, u = np.append(np.diff(t), [[0.0]], axis=1), np.zeros((1, count + 1, len(loop.inputs)))
    u[:, :, 0] = STEP.final
    start = loop.initial(full, reference=STEP.initial, start=STEP.start)
    p = np.array([[v.get(n, full.value(n)) for n in loop.parameters] for v in list(plants.values())[:SINGLE]])
    rate = RATE_MARGIN * float(fastest_eigenvalue(loop, p, [start]).max())
    substeps = rk4_substeps(min(rate, RK4_MAX_H_LAMBDA / h[0, 0]), h[0, 0])
    rollout = Rollout(loop_pieces(loop), threads=1, lanes=1)
    rows = p[:, None]

    def run() -> None:
        for row in rows:
            rollout.run(np.append(start, 0.0)[None], u, row, t, h, substeps=substeps)

    return _fastest(run, 3) / len(p)


def _solve_ivp_seconds(loop: po.ClosedLoop, design: po.ParameterSet, rate: Callable[..., Array]) -> float:
    """CPU seconds of scipy's LSODA on one plant, with a right-hand side (t, x, u, p)."""
    full, system = loop.complete(design), loop.system()
    p, u = loop.parameter_vector(full), np.zeros(len(loop.inputs))
    u[0] = STEP.final
    start = loop.initial(full, reference=STEP.initial, start=STEP.start)
    scale = 1e-6 * np.array([q.nominal for q in system.states])

    def slope(t: float, x: Array) -> Array:
        return rate(t, x, u, p)

    def run() -> None:
        for _ in range(INTEGRATED):
            period = 1 / full.value("dither.frequency")
            solve_ivp(slope, (0.0, STEP.horizon), start, method="LSODA", rtol=1e-6, atol=scale, max_step=period / 10)

    return _fastest(run, 2) / INTEGRATED


def _fastest(run: Callable[[], None], times: int) -> float:
    """CPU seconds of the fastest of several runs."""
    found = []
    for _ in range(times):
        begun = time.process_time()
        run()
        found.append(time.process_time() - begun)
    return min(found)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--plants", type=int, default=PLANTS, help="how many plants")
    parser.add_argument("--recertify", type=float, default=RECERTIFY, help="share that is certified")
    options = parser.parse_args()
    sys.exit(finish(main(options.plants, options.recertify), options))
