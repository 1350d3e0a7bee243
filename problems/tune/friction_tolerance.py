"""How much may the friction of a batch of seals vary before the specification fails?

    python problems/tune/friction_tolerance.py [--count N] [--json FILE] [--out DIR]

A sampled speed PID is tuned on a 32 mm cylinder (catalogue set, LuGre friction) for two steps, once on the nominal
plant alone, once also on the corners of friction +-40 %. Coulomb, static and viscous friction then vary together, as
from seal to seal, by a factor of 0.4 to 1.6; load +-10 % and supply +-5 % are drawn beside it (Latin hypercube,
the same plants for both designs). The specification: both steps settle to 5 % within 1.5 times the nominal design's
time, and overshoot by 10 % at most.

Rows nominal.*, corners.*: `.friction_low` and `.friction_high` are the factors between which at least 95 % of the
plants keep it (bins of a tenth, from the nominal one outwards); `.held` is the share of all. The nominal design stands
at the edge of its overshoot: with a little more friction it leaves the band again. The design on corners holds on at
least as many plants.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, design, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT, BINS, KEPT = 120, 12, 0.95
FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
RANGE = (0.4, 1.6)  # factor of friction
RANGE_SPREAD = 0.6  # its half width
LABELS = {"nominal": "tuned on the nominal plant", "corners": "tuned on friction ± 40 % as well"}
BESIDE: Mapping[str | tuple[str, ...], float] = {"load.mass": 0.1, "supply.pressure": 0.05}
CORNERS: Mapping[str | tuple[str, ...], float] = {FRICTION: 0.4}
STEPS = [po.Step(0.1, horizon=0.8), po.Step(0.25, horizon=0.8)]  # [m/s]
HAND = {"pid.Kp": 2.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.lower": -5.0, "pid.upper": 5.0, "cylinder.start": 0.1}
RANGES = {"pid.Kp": (0.02, 60.0), "pid.Ki": (0.5, 400.0), "pid.Kd": (0.0, 0.5), "pid.Tf": (0.002, 0.05)}
AIM, LIMITS = po.SettlingTime(band=0.05), (po.Overshoot(0.05), po.MaxSensitivity(1.6))
SLACK, OVERSHOOT = 1.5, 10.0  # of the nominal design's settling time; [%]


@dataclass(frozen=True, eq=False)
class Job:
    """The designs by name, the plants' friction factors, the cases of each design, and the limit of settling [s]."""

    designs: Mapping[str, po.TuningResult]
    factors: Array
    cases: Mapping[str, "pd.DataFrame"]
    limit: float


def run(count: int = COUNT) -> Job:
    drive, rig = po.catalog.s32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), measured="speed")
    own = loop.parameters.select(loop.parameters.match_names("pid.*"))
    given = (rig.fixed("*") | own).with_values(HAND).with_bounds(RANGES).freed(*RANGES)
    plants: Mapping[str, Mapping[str, Mapping[str, float]]] = {"nominal": {}, "corners": po.corners(given, CORNERS)}
    designs = {
        name: po.tune(loop, STEPS, given, minimise=AIM, subject_to=LIMITS, scenarios=scenarios, plants={})
        for name, scenarios in plants.items()
    }
    limit = SLACK * worst(designs["nominal"].certified, "SettlingTime")
    drawn = po.samples(given, {FRICTION: RANGE_SPREAD, **BESIDE}, count, seed=1, sampling=po.Sampling.LATIN_HYPERCUBE)
    factors = np.array([row[FRICTION[0]] / given.value(FRICTION[0]) for row in drawn.values()])
    certify = partial(po.evaluate, loop, STEPS, band=AIM.band)
    cases = {name: po.sweep(certify, best.parameters, drawn) for name, best in designs.items()}
    return Job(designs, factors, cases, limit)


def worst(certified: "pd.DataFrame", metric: str) -> float:
    """The largest over the steps; NaN where one has none."""
    return float(np.max(certified.loc[metric].to_numpy(dtype=float)))


def worst_of_steps(cases: "pd.DataFrame", metric: str) -> Array:
    """For each case the largest over the steps; infinite where one has none."""
    own = cases[[c for c in cases if str(c).startswith(f"{metric}[")]].to_numpy(dtype=float)
    largest: Array = np.where(np.isnan(own), np.inf, own).max(axis=1)
    return largest


def keeps(cases: "pd.DataFrame", limit: float) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    """Whether each case keeps the specification; a case that failed does not."""
    in_time = worst_of_steps(cases, "SettlingTime") <= limit
    return in_time & (worst_of_steps(cases, "Overshoot") <= OVERSHOOT)


def tolerated(factors: Array, held: Array) -> tuple[float, float]:
    """The factors of friction around 1 between which the plants hold, by bins from the nominal one outwards."""
    edges = np.linspace(*RANGE, BINS + 1)
    shares = [float(np.mean(held[(factors >= a) & (factors <= b)])) for a, b in pairwise(edges)]
    low = high = BINS // 2
    while low > 0 and shares[low - 1] >= KEPT:
        low -= 1
    while high < BINS and shares[high] >= KEPT:
        high += 1
    return float(edges[low]), float(edges[high])


def main(job: Job) -> "pd.DataFrame":
    claims = [Claim("plants", len(job.factors)), Claim("limit", job.limit, "s")]
    held = {name: keeps(cases, job.limit) for name, cases in job.cases.items()}
    for name, best in job.designs.items():
        low, high = tolerated(job.factors, held[name].astype(float))
        claims += design(name, best.parameters, best.certified, {"overshoot": "<= 5", "max_sensitivity": "<= 1.6"})
        claims += [
            Claim(f"{name}.failed", int((job.cases[name]["error"] != "").sum()), "1", None, "<= 0"),
            Claim(f"{name}.held", 100 * float(np.mean(held[name])), "%"),
            Claim(f"{name}.friction_low", low),
            Claim(f"{name}.friction_high", high),
        ]
    gain = float(np.sum(held["corners"])) - float(np.sum(held["nominal"]))
    claims.append(Claim("corners.more_plants", gain, "1", None, ">= 0"))
    return frame(claims)


def figure(job: Job) -> "Figure":
    import matplotlib.pyplot as plt

    from pneuopt.plotting import BLUE, GREY, ORANGE, legend_above

    drawn, axes = plt.subplots(2, 1, sharex=True, figsize=(6.4, 5.6), layout="constrained")
    for metric, scale, limit, label, ax in (
        ("SettlingTime", 1e3, 1e3 * job.limit, "settling time to 5 % [ms]", axes[0]),
        ("Overshoot", 1.0, OVERSHOOT, "overshoot [%]", axes[1]),
    ):
        for (name, cases), colour in zip(job.cases.items(), (ORANGE, BLUE), strict=True):
            values = scale * worst_of_steps(cases, metric)
            ax.plot(job.factors, np.where(np.isfinite(values), values, np.nan), ".", color=colour, label=LABELS[name])
        ax.axhline(limit, color=GREY, linewidth=1)
        ax.annotate("limit", (RANGE[1], limit), xytext=(-4, 4), textcoords="offset points", color=GREY, ha="right")
        ax.set(ylabel=label, ylim=(0, None))
    legend_above(drawn, axes[0])
    axes[1].set_xlabel("friction over its nominal value [1]")
    return drawn


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="plants of the batch")
    options = parser.parse_args()
    job = run(options.count)
    sys.exit(finish(main(job), options, lambda: {"friction_tolerance": figure(job)}))
