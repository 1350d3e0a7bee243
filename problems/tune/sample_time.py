"""How slow may the controller be: what a tuning is worth from 0.5 to 10 ms between two samples.

    python problems/tune/sample_time.py [--json FILE] [--out DIR]

A speed PID is tuned anew at each sample time on a 32 mm cylinder (catalogue set, LuGre friction) for a slow and a fast
step, with one sample of delay, overshoot up to 5 % and Ms up to 1.6; each search begins from the gains of the next
shorter time. The sample time is a part of the loop's structure, no parameter: a case of this study builds a loop.

Rows price.*: what the samples cost, the certified settling time over that of the shortest time: at 2 ms half as long
again at most, at 10 ms more than two and a half times as long. `kept.*`: the gains that were tuned at 1 ms, run at 5 ms
as they are: their Ms is far beyond the 1.6 that was asked for, and they overshoot.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.claims import Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

TIMES = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3)  # [s]
STEPS = [po.Step(0.1, horizon=0.8), po.Step(0.25, horizon=0.8)]  # [m/s]
HAND = {"pid.Kp": 10.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0, "cylinder.start": 0.1}
RANGES = {"pid.Kp": (0.02, 60.0), "pid.Ki": (0.5, 400.0), "pid.Kd": (0.0, 0.5), "pid.Tf": (0.002, 0.05)}
AIM, LIMITS = po.SettlingTime(band=0.02), (po.Overshoot(0.05), po.MaxSensitivity(1.6))
PRICES = {2e-3: "<= 1.5", 10e-3: ">= 2.5"}
SLOW, KEPT = 5e-3, 1e-3  # [s] where gains are run as they are, and the sample time at which they were tuned


@dataclass(frozen=True, eq=False)
class Job:
    """A tuning for each sample time, and the certified metrics of one of them where the samples are slower."""

    tuned: dict[float, po.TuningResult]
    kept: "pd.DataFrame"


def loop_at(sample_time: float) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The loop with this sample time [s], and its parameters, four gains free."""
    drive, rig = po.catalog.s32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=sample_time, delay=1), measured="speed")
    own = loop.parameters.select(loop.parameters.match_names("pid.*"))
    return loop, (rig.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)


def run() -> Job:
    tuned: dict[float, po.TuningResult] = {}
    gains: dict[str, float] = {}
    for sample_time in TIMES:
        loop, given = loop_at(sample_time)
        best = po.tune(loop, STEPS, given.with_values(gains), minimise=AIM, subject_to=LIMITS, plants={})
        tuned[sample_time] = best
        gains = {name: best.parameters.value(name) for name in RANGES}
    kept = {name: tuned[KEPT].parameters.value(name) for name in RANGES}
    loop, given = loop_at(SLOW)
    return Job(tuned, po.evaluate(loop, STEPS, given.with_values(kept)))


def worst(certified: "pd.DataFrame", metric: str) -> float:
    """The largest over the steps; NaN where one has none."""
    return float(np.max(certified.loc[metric].to_numpy(dtype=float)))


def main(job: Job) -> "pd.DataFrame":
    claims = []
    fastest = worst(job.tuned[TIMES[0]].certified, "SettlingTime")
    for sample_time, best in job.tuned.items():
        name = f"{1e3 * sample_time:g}_ms"
        bounds = {"overshoot": "<= 5", "max_sensitivity": "<= 1.6"}
        claims += design(name, best.parameters, best.certified, bounds)
        price = worst(best.certified, "SettlingTime") / fastest
        claims.append(Claim(f"price.{name}", price, "1", None, PRICES.get(sample_time, "")))
    sensitivity = worst(job.kept, "MaxSensitivity")
    claims.append(Claim("kept.max_sensitivity", sensitivity, "1", 1.6, ">= 3"))
    claims.append(Claim("kept.overshoot", worst(job.kept, "Overshoot"), "%", 5.0, ">= 5"))
    return frame(claims)


def figure(job: Job) -> "Figure":
    import matplotlib.pyplot as plt

    from pneuopt.plotting import BLUE, ORANGE

    times = [1e3 * sample_time for sample_time in job.tuned]
    drawn, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(6.4, 5.2), layout="constrained")
    settled = [1e3 * worst(best.certified, "SettlingTime") for best in job.tuned.values()]
    upper.semilogx(times, settled, "o-", color=BLUE)
    upper.set(ylabel="settling time to 2 % [ms]", ylim=(0, None), title="Tuned anew at each sample time, Ms ≤ 1.6")
    lower.semilogx(times, [best.parameters.value("pid.Kp") for best in job.tuned.values()], "o-", color=ORANGE)
    lower.set(xlabel="sample time [ms], one sample of delay", ylabel="Kp [V·s/m]", ylim=(0, None))
    lower.set_xticks(times, [f"{t:g}" for t in times])
    lower.minorticks_off()
    return drawn


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"sample_time": figure(job)}))
