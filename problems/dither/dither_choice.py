"""Drawn rigs whose dither is free: what `tune` hands out, with its ripple, beside the best PID without a dither.

    python problems/dither/dither_choice.py [--count N] [--first SEED] [--json FILE] [--out DIR]

Half of the rigs are loads pushed by a force, the others the T32 benchmark's pneumatic drive with another load, friction
and dead zone, with a dither of 40 to 160 Hz. Gains, the amplitude and the offset of the dither are free; the settling
time is minimised within overshoot and sensitivity. The rival is tuned by the same call with the amplitude fixed at 0,
and has as many trials as the whole.

Rows *.settles: the settling time of the signal with its ripple, the rival's beside. Rows *.no_worse: 1 where it is not
later than the rival's by more than 5 %, the change that a verdict counts. Rows *.useful: 1 where no dither was handed
out, or `judge_dither` finds it useful against that rival. Rows *.seconds: CPU time of the tuning. Row dithered.count:
on how many rigs a dither was handed out.
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared import t32
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

LATER = 1.05  # ratio of settling times from which on one is later, as in a verdict


@dataclass(frozen=True, eq=False)
class Rig:
    """A drawn loop with its gains free, its step, and what limits it."""

    loop: po.ClosedLoop
    parameters: po.ParameterSet
    step: po.Step
    limits: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Choice:
    """What was handed out, the rival without dither, the verdict if there is a dither, and CPU time [s]."""

    best: po.TuningResult
    rival: po.TuningResult
    verdict: po.DitherVerdict | None
    seconds: float


def draw_rig(seed: int) -> Rig:
    """A force drive for even seeds, a pneumatic one for odd seeds."""
    rng = np.random.default_rng((seed, 39))
    frequency = float(np.round(np.exp(rng.uniform(math.log(40.0), math.log(160.0)))))
    if seed % 2:
        drive, hardware = po.catalog.t32()
        scale = {n: float(hardware.value(n) * np.exp(rng.uniform(-0.6, 0.6))) for n in ("load.mass", *t32.FRICTION)}
        scale["valve.dead_zone"] = float(rng.uniform(0.01, 0.06))
        loop = po.ClosedLoop(drive.system(), po.PID(), po.Dither(frequency))
        p = (loop.parameters | hardware).select(loop.parameters)
        given = p.with_values({**t32.VALUES, **scale}).with_bounds(t32.RANGES).freed(*t32.RANGES)
        return Rig(loop, given, t32.STEP, (t32.OVERSHOOT, t32.SENSITIVITY))
    coulomb = float(rng.uniform(15.0, 60.0))
    values = {"load.mass": float(rng.uniform(2.0, 10.0)), "friction.coulomb": coulomb}
    values |= {"friction.static": coulomb * float(rng.uniform(1.2, 1.9)), "friction.stribeck_velocity": 0.02}
    values |= {"friction.viscous": float(rng.uniform(30.0, 120.0)), "pid.Kp": 300.0, "pid.Ki": 3000.0}
    values |= {"pid.lower": -300.0, "pid.upper": 300.0}
    ranges = {"pid.Kp": (20.0, 3000.0), "pid.Ki": (100.0, 1e5)}
    ranges |= {"dither.amplitude": (0.0, 60.0), "dither.offset": (-60.0, 60.0)}
    loop = po.ClosedLoop(po.ForceDrive(po.Stribeck()), po.PID(sample_time=1e-3), po.Dither(frequency))
    given = loop.parameters.with_values(values).with_bounds(ranges).freed(*ranges)
    return Rig(
        loop, given, po.Step(float(rng.uniform(0.05, 0.3)), horizon=0.6), (po.Overshoot(0.05), po.MaxSensitivity(1.6))
    )


def choose(rig: Rig) -> Choice:
    """Tune a rig by defaults, and its rival; the nominal designs, for the price of robustness is another question."""
    asked: dict[str, Any] = {"minimise": po.SettlingTime(), "subject_to": rig.limits, "throw": False, "plants": {}}
    began = time.process_time()
    best = po.tune(rig.loop, rig.step, rig.parameters, **asked)
    seconds = time.process_time() - began
    rival = po.tune_without_dither(rig.loop, rig.step, rig.parameters, **asked)
    verdict = None
    if best.parameters.value("dither.amplitude") > 0:
        without = rival.parameters if rival.status.converged else None
        verdict = po.judge_dither(rig.loop, rig.step, best.parameters, without=without)
    return Choice(best, rival, verdict, seconds)


def settles(rig: Rig, found: po.TuningResult) -> float:
    """The settling time of the signal with its ripple [s]; inf without a certified design."""
    if not found.status.converged:
        return math.inf
    value = float(po.evaluate(rig.loop, rig.step, found.parameters).loc["SettlingTimeRaw"].to_numpy(dtype=float)[0])
    return value if math.isfinite(value) else math.inf


def main(choices: dict[int, tuple[Rig, Choice]]) -> "pd.DataFrame":
    claims = []
    for seed, (rig, found) in choices.items():
        own, other = settles(rig, found.best), settles(rig, found.rival)
        within = f"<= {rig.step.horizon:g}"
        useful = {"USEFUL"} if found.rival.status.converged else {"USEFUL", "HELPS_THESE_GAINS"}
        is_useful = found.verdict is None or found.verdict.usefulness.name in useful
        claims.append(Claim(f"rig{seed}.settles", own, "s", other if math.isfinite(other) else None, within))
        claims.append(Claim(f"rig{seed}.no_worse", int(own <= LATER * other), "1", None, ">= 1"))
        claims.append(Claim(f"rig{seed}.useful", int(is_useful), "1", None, ">= 1"))
        claims.append(Claim(f"rig{seed}.seconds", found.seconds, "s", None, "<= 120"))
    dithered = sum(found.verdict is not None for _, found in choices.values())
    return frame([*claims, Claim("dithered.count", dithered, "1", None, ">= 0")])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=10, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    options = parser.parse_args()
    rigs = {seed: draw_rig(seed) for seed in range(options.first, options.first + options.count)}
    sys.exit(finish(main({seed: (rig, choose(rig)) for seed, rig in rigs.items()}), options))
