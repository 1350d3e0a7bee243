"""Which valve does an axis need: what a larger one brings in settling time and costs in air.

    python problems/tune/valve_sizing.py [--json FILE] [--out DIR]

A 32 mm cylinder moves 10 kg (catalogue set, LuGre friction, supply 6 bar(g)); its valve's conductance goes from a
twentieth to twice that of the 700 l/min(ANR) valve of the set, its bandwidth and dead zone staying as they are. A
sampled speed PID is tuned anew for each valve, from the gains of the size beside it (`sweep_from_neighbours`), for a
slow and a fast step, with overshoot up to 5 % and Ms up to 1.6. The air is that of both steps.

Rows gain.*: the certified settling time over that of the set's own valve. The smallest valve takes at least half as
long again or cannot keep the limits (infinite), for it cannot fill the chambers in time. An eighth of the set's valve
is within a tenth of it: beyond the knee the controller's margins, not the valve, decide; a larger one costs air only.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SIZES = (0.05, 0.125, 0.25, 0.5, 1.0, 2.0)  # conductance over that of the set
NOMINAL_FLOW = 700.0  # [l/min(ANR)] of the set's valve
STEPS = [po.Step(0.1, horizon=0.8), po.Step(0.4, horizon=0.6)]  # [m/s] from 30 mm of 300 mm
HAND = {"pid.Kp": 2.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0, "cylinder.start": 0.1}
RANGES = {"pid.Kp": (0.02, 60.0), "pid.Ki": (0.5, 800.0), "pid.Kd": (0.0, 1.0), "pid.Tf": (0.002, 0.05)}
AIM, LIMITS = po.SettlingTime(band=0.02), (po.Overshoot(0.05), po.MaxSensitivity(1.6))
STARTS = {f"found {name}": name for name in RANGES}
BOUNDS: Mapping[float, str] = {0.05: ">= 1.5", 0.125: "<= 1.1", 2.0: "<= 1.1"}


@dataclass(frozen=True, eq=False)
class Job:
    """A row a valve: its size over that of the set, the certified metrics and the gains that were found."""

    table: "pd.DataFrame"


def run() -> Job:
    drive, rig = po.catalog.s32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), measured="speed")
    own = loop.parameters.select(loop.parameters.match_names("pid.*"))
    given = (rig.fixed("*") | own).with_values(HAND | {"load.mass": 10.0}).with_bounds(RANGES).freed(*RANGES)
    conductance = given.value("valve.conductance")
    axes = {"valve.conductance": [size * conductance for size in SIZES]}
    table = po.sweep_from_neighbours(partial(tune_valve, loop), given, axes, value="SettlingTime", starts=STARTS)
    return Job(table.assign(size=list(SIZES)))


def tune_valve(loop: po.ClosedLoop, parameters: po.ParameterSet) -> dict[str, float]:
    """The certified figures of a tuning for one valve, and its gains."""
    best = po.tune(loop, STEPS, parameters, minimise=AIM, subject_to=LIMITS, plants={})
    names = ("SettlingTime", "Overshoot", "MaxSensitivity")
    figures = {name: float(np.max(best.certified.loc[name].to_numpy(dtype=float))) for name in names}
    evaluated = po.evaluate(loop, STEPS, best.parameters)
    air = {"AirUse": float(np.sum(evaluated.loc["AirUse"].to_numpy(dtype=float)))}
    return figures | air | {column: best.parameters.value(name) for column, name in STARTS.items()}


def main(job: Job) -> "pd.DataFrame":
    settled = {float(size): float(s) for size, s in zip(job.table["size"], job.table["SettlingTime"], strict=True)}
    claims = [Claim("valves.failed", int((job.table["error"] != "").sum()), "1", None, "<= 1")]
    for _, row in job.table.iterrows():
        name = f"{NOMINAL_FLOW * row['size']:g}"
        ratio = settled[float(row["size"])] / settled[1.0]
        ratio = np.inf if np.isnan(ratio) else ratio
        kept = ("<= 5", "<= 1.6") if np.isfinite(ratio) else ("", "")
        claims += [
            Claim(f"settling_time.{name}", float(row["SettlingTime"]), "s"),
            Claim(f"gain.{name}", ratio, "1", None, BOUNDS.get(float(row["size"]), "")),
            Claim(f"air.{name}", float(row["AirUse"]), "l(ANR)"),
            Claim(f"overshoot.{name}", float(row["Overshoot"]), "%", None, kept[0]),
            Claim(f"max_sensitivity.{name}", float(row["MaxSensitivity"]), "1", None, kept[1]),
            Claim(f"breaks.{name}", float(row["breaks"])),
        ]
    return frame(claims)


def figure(job: Job) -> "Figure":
    import matplotlib.pyplot as plt

    from pneuopt.plotting import BLUE, GREY, ORANGE

    flow = NOMINAL_FLOW * job.table["size"].to_numpy(dtype=float)
    drawn, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(6.4, 5.2), layout="constrained")
    settled, air = (job.table[name].to_numpy(dtype=float) for name in ("SettlingTime", "AirUse"))
    upper.semilogx(flow, 1e3 * settled, "o-", color=BLUE)
    for x in flow[np.isnan(settled)]:
        upper.annotate("limits not kept", (x, 0.0), xytext=(4, 6), textcoords="offset points", rotation=90, color=GREY)
    top = 1.1e3 * float(np.nanmax(settled))
    upper.set(
        ylabel="settling time to 2 % [ms]", ylim=(0, top), title="10 kg on a 32 mm cylinder, each valve tuned anew"
    )
    lower.semilogx(flow, air, "o-", color=ORANGE)
    top = 1.1 * float(np.nanmax(air))
    lower.set(xlabel="nominal flow of the valve [l/min(ANR)]", ylabel="air of both steps [l(ANR)]", ylim=(0, top))
    lower.set_xticks(flow, [f"{x:g}" for x in flow])
    lower.minorticks_off()
    return drawn


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"valve_sizing": figure(job)}))
