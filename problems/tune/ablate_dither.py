"""What each part of a dithered controller brings, over the valve's dead zone: one is left out at a time.

    python problems/tune/ablate_dither.py [--json FILE] [--out DIR]

A sampled speed PID on a 32 mm cylinder (catalogue set, LuGre friction) is tuned for a slow step, from rest, whose
command is small beside the dead zone: with dither and its offset, with dither alone, with the offset alone, with
neither, and with the inverse of the dead zone in place of both. Each is tuned anew, for the settling time to 5 % with
overshoot up to 5 % and Ms up to 1.6, with dead zones of 0, 2 and 5 % of the valve's half travel.

Rows: `<dead zone>.<part>.settling_time` and `.ripple`. A search whose limits cannot be kept is a row with no time.
On this drive the offset, a kick at the start, brings nearly all; the sine brings a little with the largest dead zone
only, at a ripple of a twentieth of the step. No worth of the sine is claimed. What is claimed: with each
dead zone all parts together settle, and not a tenth later than the best design that leaves one of them out
(`parts.<dead zone>`), for what may be zero cannot harm.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

DEAD_ZONES = (0.0, 0.02, 0.05)
STEP = po.Step(0.05, horizon=1.0)  # [m/s]
HAND = {"pid.Kp": 2.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0, "cylinder.start": 0.1}
GAINS = {"pid.Kp": (0.02, 60.0), "pid.Ki": (0.5, 800.0), "pid.Kd": (0.0, 1.0), "pid.Tf": (0.002, 0.05)}
AMPLITUDE, OFFSET = {"dither.amplitude": (0.0, 2.0)}, {"dither.offset": (-1.5, 1.5)}
PARTS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "all": GAINS | AMPLITUDE | OFFSET,
    "no_offset": GAINS | AMPLITUDE,
    "no_dither": GAINS | OFFSET,
    "neither": GAINS,
}
LABELS = {"all": "dither and offset", "no_offset": "dither", "no_dither": "offset", "neither": "PID alone"}
LABELS |= {"inverse": "dead-zone inverse"}
FIGURES = ("SettlingTime", "Ripple")
AIM, LIMITS = po.SettlingTime(band=0.05), (po.Overshoot(0.05), po.MaxSensitivity(1.6))


@dataclass(frozen=True, eq=False)
class Job:
    """The figures of each tuning by dead zone and part; NaN where the limits cannot be kept."""

    figures: Mapping[tuple[float, str], Mapping[str, float]]


def run() -> Job:
    figures = {}
    for dead_zone in DEAD_ZONES:
        gains: dict[str, float] = {}
        for part in ("neither", "no_dither", "no_offset", "all", "inverse"):
            found = tune_part(dead_zone, part, gains)
            figures[dead_zone, part] = {name: found[name] for name in FIGURES}
            if part == "neither":
                gains = {name: found[name] for name in GAINS if name in found}
    return Job(figures)


def tune_part(dead_zone: float, part: str, gains: Mapping[str, float]) -> dict[str, float]:
    """The figures and gains of a controller with these parts, tuned from these gains; NaN where limits are not kept."""
    drive, rig = po.catalog.s32()
    inverse = (po.DeadZoneInverse(),) if part == "inverse" else ()
    loop = po.ClosedLoop(
        drive.system(), po.PID(sample_time=1e-3), po.Dither(frequency=100.0), measured="speed", compensators=inverse
    )
    ranges = PARTS.get(part, GAINS)
    own = loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    values = HAND | {"valve.dead_zone": dead_zone} | dict(gains)
    values |= {"dead_zone_inverse.width": dead_zone * rig.value("valve.span")} if inverse else {}
    given = (rig.fixed("*") | own.fixed("*")).with_values(values)
    free = given.with_bounds(ranges).freed(*ranges)
    try:
        best = po.tune(loop, STEP, free, minimise=AIM, subject_to=LIMITS, plants={})
    except po.ConvergenceError:
        return dict.fromkeys(FIGURES, np.nan)
    evaluated = po.evaluate(loop, STEP, best.parameters, band=AIM.band)
    figures = {name: float(evaluated.loc[name].to_numpy(dtype=float)[0]) for name in FIGURES}
    return figures | {name: best.parameters.value(name) for name in GAINS}


def main(job: Job) -> "pd.DataFrame":
    claims = []
    for dead_zone in dict.fromkeys(size for size, _ in job.figures):
        name, rivals = f"{100 * dead_zone:g}_percent", []
        for part in LABELS:
            settled, ripple = (job.figures[dead_zone, part][name] for name in FIGURES)
            rivals += [settled] if part in PARTS and part != "all" else []
            claims.append(Claim(f"{name}.{part}.settling_time", settled, "s"))
            claims.append(Claim(f"{name}.{part}.ripple", 1e3 * ripple, "mm/s"))
        whole = job.figures[dead_zone, "all"]["SettlingTime"]
        least = float(np.nanmin(rivals)) if np.isfinite(rivals).any() else np.inf
        claims.append(Claim(f"parts.{name}", whole / least, "1", None, "<= 1.1"))
    return frame(claims)


def figure(job: Job) -> "Figure":
    import matplotlib.pyplot as plt

    from pneuopt.plotting import BLUE, GREY, ORANGE, RED, legend_above

    drawn, ax = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    sizes = list(dict.fromkeys(size for size, _ in job.figures))
    colours = dict(zip(LABELS, (BLUE, "#7fb3dd", GREY, ORANGE, RED), strict=True))
    for k, (part, label) in enumerate(LABELS.items()):
        places = np.arange(len(sizes)) + 0.16 * (k - 2)
        heights = [1e3 * job.figures[size, part]["SettlingTime"] for size in sizes]
        ax.bar(places, np.nan_to_num(heights), 0.15, color=colours[part], label=label)
        for x, height in zip(places, heights, strict=True):
            ax.annotate(
                "none" if np.isnan(height) else f"{height:.0f}",
                (x, np.nan_to_num(height)),
                ha="center",
                va="bottom",
                fontsize=8,
            )
    ax.set_xticks(range(len(sizes)), [f"{100 * size:g} %" for size in sizes])
    ax.set(xlabel="dead zone of the valve", ylabel="settling time to 5 % [ms]")
    legend_above(drawn, ax, columns=3)
    return drawn


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"ablate_dither": figure(job)}))
