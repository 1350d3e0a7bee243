"""PID and dither tuned together on a pneumatic drive, beside the PID alone: on the smooth model and on a rig.

    python problems/tune/tune_drive.py [--json FILE] [--out DIR]

The drive is a 32 mm cylinder of the catalogue (LuGre friction) under a speed PID sampled at 1 kHz. It is tuned for four
steps at once: small and large, forwards and backwards, from rest and from motion; the controller sees the speed through
the lag of an encoder (difference over a sample, 5 ms of filter). The rig has what the model leaves out: Karnopp
friction of the same levels, 0.4 % of hysteresis in the valve, an encoder of 10 um. All figures are those of the true
speed. What the smooth model does not foretell is a piston that really sticks: on the rig the break-away to 0.1 m/s
settles in 0.21 s, later than the 0.2 s that this script is held to, and the row fails. "blind" is the PID alone, tuned
as if the controller saw the true speed at once.

saved_by_dither compares the settling times on the rig; for a step that never settles its horizon stands, so it is a
lower bound.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import METRICS, Claim, arguments, design, finish, frame
from problems.tune.supply_and_load import RANGES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SLOW, FRONT = {"position": 0.05}, {"position": 0.25}  # [m] of 0.3
HORIZON = 0.6  # [s]
STEPS = [
    po.Step(0.10, horizon=HORIZON, start=SLOW),
    po.Step(0.25, horizon=HORIZON, start=SLOW),
    po.Step(-0.20, horizon=HORIZON, start=FRONT),
    po.Step(0.15, initial=0.10, horizon=HORIZON, start=SLOW),
]
HAND = {"pid.Kp": 1.0, "pid.Ki": 10.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0}
LIMITS = (po.Overshoot(0.02), po.MaxSensitivity(1.6))
SMOOTH = {"settling_time": "<= 0.16", "overshoot": "<= 2", "max_sensitivity": "<= 1.6"}
REAL = {"settling_time": "<= 0.2", "overshoot": "<= 15"}
SAMPLE, HYSTERESIS, COUNT, FILTER = 1e-3, 0.04, 1e-5, 5e-3  # [s], [V] of 10 V, [m], [s]
COLOURS = {"hand": GREY, "pid_only": ORANGE, "tuned": BLUE}
VALVE: dict[str, Any] = {"pid_only": {"lw": 1.4, "zorder": 3}, "tuned": {"lw": 0.8, "alpha": 0.6}}


@dataclass(frozen=True, eq=False)
class Job:
    """The smooth loop and the rig; each design's gains, and its figures on both."""

    loop: po.ClosedLoop
    rig: po.Rig
    designs: dict[str, po.ParameterSet]
    smooth: dict[str, "pd.DataFrame"]
    real: dict[str, "pd.DataFrame"]
    seconds: dict[str, float]


def run() -> Job:
    loop, rig, given = loops()
    designs, seconds, smooth = {"hand": given}, {}, {}
    alone, seeing = given.fixed("dither.amplitude"), replace(loop, sensor=None)
    for name, free in (("pid_only", alone), ("tuned", given)):
        begin = time.perf_counter()
        best = po.tune(loop, STEPS, free, minimise=po.SettlingTime(band=0.02), subject_to=LIMITS, plants={})
        designs[name], smooth[name], seconds[name] = best.parameters, best.certified, time.perf_counter() - begin
    smooth["hand"] = po.evaluate(loop, STEPS, given)
    fast = alone.select(n for n in alone if n in seeing.parameters)
    blind = po.tune(seeing, STEPS, fast, minimise=po.SettlingTime(band=0.02), subject_to=LIMITS, plants={})
    shown = designs | {"blind": given | blind.parameters}
    return Job(loop, rig, designs, smooth, {n: po.evaluate(rig, STEPS, p) for n, p in shown.items()}, seconds)


def loops() -> tuple[po.ClosedLoop, po.Rig, po.ParameterSet]:
    """The loop as it is tuned, the rig that it is tried on, the hand tuning with its ranges."""
    drive, hardware = po.catalog.s32()
    pid, dither = po.PID(sample_time=SAMPLE), po.Dither(frequency=100.0)
    loop = po.ClosedLoop(drive.system(), pid, dither, sensor=po.SensorLag(FILTER + SAMPLE / 2))
    sticking = replace(drive, friction=po.Karnopp(po.Stribeck()))
    rig = po.Rig(
        po.ClosedLoop(sticking.system(), pid, dither),
        {"position": po.Sensor(resolution=COUNT)},
        po.Actuator(hysteresis=HYSTERESIS),
        po.Encoder(filter=FILTER),
    )
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*", "sensor.*"))
    return loop, rig, (hardware.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)


def main(job: Job) -> "pd.DataFrame":
    claims = []
    for name, parameters in job.designs.items():
        claims += design(name, parameters, job.smooth[name], SMOOTH if name == "tuned" else {})
        claims += on_rig(name, job.real[name], REAL if name == "tuned" else {})
    claims += on_rig("blind", job.real["blind"], {})
    claims += [Claim(f"{name}.seconds", value, "s") for name, value in job.seconds.items()]
    alone, both = (float(np.nan_to_num(worst(job.real[n], "SettlingTime"), nan=HORIZON)) for n in ("pid_only", "tuned"))
    return frame([*claims, Claim("rig.settling_time.saved_by_dither", 1 - both / alone, "1", None, ">= 0.25")])


def on_rig(name: str, found: "pd.DataFrame", bounds: dict[str, str]) -> list[Claim]:
    """The worst over the steps of each figure; NaN where one never settles."""
    rows = {row: metric for row, metric in METRICS.items() if metric[0] in found.index}
    return [
        Claim(f"{name}.rig.{row}", worst(found, metric), unit, None, bounds.get(row, ""))
        for row, (metric, unit) in rows.items()
    ]


def worst(found: "pd.DataFrame", metric: str) -> float:
    return float(np.max(found.loc[metric].to_numpy(dtype=float)))


def figure(job: Job) -> "Figure":
    picture, grid = axes_grid(3, len(STEPS), (2.2, 2.2, 1.5), sharex="col", width=13.0)
    for column, step in zip(zip(*grid, strict=True), STEPS, strict=True):
        for model, axes, label in ((job.loop, column[0], "smooth model"), (job.rig, column[1], "rig")):
            for name, parameters in job.designs.items():
                response = po.respond(model, step, parameters)
                axes.plot(1e3 * response.t, 1e3 * response["speed"], color=COLOURS[name], lw=1.1, label=name)
                if model is job.rig and name != "hand":
                    column[2].plot(1e3 * response.t, response["control"], color=COLOURS[name], **VALVE[name])
            axes.axhline(1e3 * step.final, color=RED, lw=0.8, ls="--")
            low, high = sorted([1e3 * step.initial, 1e3 * step.final])
            axes.set_ylim(low - 0.15 * (high - low), high + 0.45 * (high - low))
            if step.size < 0:
                axes.set_ylim(low - 0.45 * (high - low), high + 0.15 * (high - low))
            axes.set(ylabel=f"speed, {label} [mm/s]", xlim=(0, 1e3 * step.horizon))
        column[0].set_title(f"{1e3 * step.initial:g} to {1e3 * step.final:g} mm/s", fontsize=9)
        column[2].set(xlabel="time [ms]", ylabel="valve, rig [V]")
    for row in grid:
        for axes in row[1:]:
            axes.set_ylabel("")
    legend_above(picture, grid[0][0])
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"tune_drive": figure(job)}))
