"""What a nominal tuning is worth elsewhere: its certified settling time and overshoot over supply pressure and load.

    python problems/tune/supply_and_load.py [--json FILE] [--out DIR]

A sampled speed PID with dither is tuned on a 32 mm cylinder (catalogue set, LuGre friction) at 6 bar(g) and 5 kg for a
slow and a fast step, then simulated, gains as printed, over 4 to 8 bar(g) and 2 to 10 kg: `grid`, `sweep`, `plot_map`.

Rows map.*: it keeps the overshoot that it was tuned for in fewer than half of the 25 cases, half of them take half as
long again to settle, and in the worst one it takes more than five times as long or never settles. A case that never
settles counts so in the median and in the worst: its settling time is infinite.

Rows retuned.*: what a tuning of its own is worth in nine of these cases, each begun from the gains of the best case
beside it (`sweep_from_neighbours`): all are certified, and the worst settles sooner than the nominal gains do in half
of the map. A case that breaks with its neighbours is searched again from theirs: at 8 bar 5 kg take three times as
long as 10 kg, whose overshoot just stays inside the band, so that it settles as soon as it comes into it.
"""

import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.claims import Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STEPS = [po.Step(0.1, horizon=0.8), po.Step(0.25, horizon=0.8)]  # [m/s] from 30 mm of 300 mm
HAND = {"pid.Kp": 10.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
RANGES = {
    "pid.Kp": (0.2, 60.0),
    "pid.Ki": (0.5, 400.0),
    "pid.Kd": (0.0, 0.5),
    "pid.Tf": (0.002, 0.05),
    "dither.amplitude": (0.0, 2.0),
    "dither.offset": (-1.5, 1.5),
}
LIMITS = (po.Overshoot(0.05), po.MaxSensitivity(1.6))
# Of the design of 0.0768 s 0.08 s was asked; it passes the reference by 7.2 %, and its Ms is 1.82 as the piston slides.
BOUNDS = {"settling_time": "<= 0.085", "overshoot": "<= 5", "max_sensitivity": "<= 1.6"}
ATMOSPHERE = 1.01325e5  # [Pa(a)]
PRESSURES = [1e5 * gauge + ATMOSPHERE for gauge in (4.0, 5.0, 6.0, 7.0, 8.0)]  # [Pa(a)]
MASSES = [2.0, 3.5, 5.0, 7.5, 10.0]  # [kg]
METRICS = {"SettlingTime": "s", "Overshoot": "%"}
RETUNED = {"supply.pressure": PRESSURES[::2], "load.mass": MASSES[::2]}
STARTS = {f"found {name}": name for name in RANGES}


@dataclass(frozen=True, eq=False)
class Job:
    """What was tuned, and its study: a row a case, each metric the worst of the steps; cells that were tuned."""

    best: po.TuningResult
    study: "pd.DataFrame"
    retuned: "pd.DataFrame"
    seconds: float


def run() -> Job:
    drive, rig = po.catalog.s32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), po.Dither(frequency=100.0), measured="speed")
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    nominal = {"supply.pressure": 6e5 + ATMOSPHERE, "load.mass": 5.0, "cylinder.start": 0.1}
    given = (rig.fixed("*") | own).with_values(nominal | HAND).with_bounds(RANGES).freed(*RANGES)
    best = po.tune(loop, STEPS, given, minimise=po.SettlingTime(band=0.02), subject_to=LIMITS, plants={})
    began = time.perf_counter()
    cases = po.grid(best.parameters, {"supply.pressure": PRESSURES, "load.mass": MASSES})
    study = po.sweep(partial(po.evaluate, loop, STEPS), best.parameters, cases)
    seconds = time.perf_counter() - began
    for metric in METRICS:
        study[metric] = study[[c for c in study if str(c).startswith(f"{metric}[")]].max(axis=1, skipna=False)
    cell = partial(tune_case, loop)
    retuned = po.sweep_from_neighbours(cell, best.parameters, RETUNED, value="SettlingTime", starts=STARTS)
    return Job(best, study, retuned, seconds)


def tune_case(loop: po.ClosedLoop, parameters: po.ParameterSet) -> dict[str, float]:
    """The certified settling time of a tuning for one case, the worst of the steps, and its gains."""
    aim = po.SettlingTime(band=0.02)
    found = po.tune(loop, STEPS, parameters, minimise=aim, subject_to=LIMITS, plants={})
    settled = float(np.max(found.certified.loc["SettlingTime"].to_numpy(dtype=float)))
    return {"SettlingTime": settled} | {column: found.parameters.value(n) for column, n in STARTS.items()}


def main(job: Job) -> "pd.DataFrame":
    study, good = job.study, job.study[job.study["error"] == ""]
    claims = design("tuned", job.best.parameters, job.best.certified, BOUNDS)
    fewest = f"<= {len(study) // 2}"
    claims += [
        Claim("map.cases", len(study)),
        Claim("map.failed", len(study) - len(good), "1", None, "<= 0"),
        Claim("map.never_settle", int(good["SettlingTime"].isna().sum())),
        Claim("map.overshoot_within_5", int((good["Overshoot"] <= 5).sum()), "1", None, fewest),
        Claim("map.seconds", job.seconds, "s"),
    ]
    nominal = float(np.max(job.best.certified.loc["SettlingTime"].to_numpy(dtype=float)))
    bounds = {"settling_time.median": f">= {1.5 * nominal:.3g}", "settling_time.worst": f">= {5 * nominal:.3g}"}
    median = np.nan
    for metric, unit in METRICS.items():
        values = good[metric].to_numpy(dtype=float)
        counted = np.where(np.isnan(values), np.inf, values)
        worst = good.iloc[int(np.argmax(counted))]
        name = "settling_time" if metric == "SettlingTime" else "overshoot"
        for figure_of, value in {
            "best": np.min(counted),
            "median": np.median(counted),
            "worst": np.max(counted),
        }.items():
            row = f"{name}.{figure_of}"
            claims.append(Claim(f"map.{row}", float(value), unit, None, bounds.get(row, "")))
            median = float(value) if row == "settling_time.median" else median
        claims.append(Claim(f"map.{name}.worst.pressure", worst["supply.pressure"] / 1e5, "bar"))
        claims.append(Claim(f"map.{name}.worst.mass", worst["load.mass"], "kg"))
    return frame([*claims, *retuned_claims(job.retuned, median)])


def retuned_claims(cells: "pd.DataFrame", median: float) -> list[Claim]:
    """The rows of the cells that were tuned, beside the median of the nominal gains."""
    settled = cells["SettlingTime"].fillna(np.inf)
    return [
        Claim("retuned.cells", len(cells)),
        Claim("retuned.failed", int((cells["error"] != "").sum()), "1", None, "<= 0"),
        Claim("retuned.again", int(cells["again"].sum())),
        Claim("retuned.breaks", int(cells["breaks"].sum())),
        Claim("retuned.settling_time.median", float(settled.median()), "s"),
        Claim("retuned.settling_time.worst", float(settled.max()), "s", median, f"<= {median:.3g}"),
    ]


def figure(job: Job) -> "Figure":
    shown = job.study.assign(**{"supply.pressure": (job.study["supply.pressure"] - ATMOSPHERE) / 1e5})
    return po.plot_map(shown, {"supply.pressure": "bar(g)", "load.mass": "kg"}, METRICS)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"supply_and_load": figure(job)}))
