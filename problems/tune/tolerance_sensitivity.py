"""Which tolerances matter for a tuned drive: derivatives at its design beside Sobol's indices over the whole box.

    python problems/tune/tolerance_sensitivity.py [--count 64] [--json FILE] [--out DIR]

The loop T32 of problems/shared/t32.py without its sine: settling time, overshoot and IAE of a step to 0.2 m/s,
with the mass +-30 %, the friction +-30 %, the supply pressure +-10 % and the valve's dead zone +-20 %. A local figure
comes from one simulation with its sensitivities; a global one takes count * 6 certified cases.

Rows `<metric>.<axis>.change`: the figure's change for one standard deviation of the axis, the reference its central
difference by `evaluate` over a hundredth of that. Rows *.apart: the largest distance of the two over the axes, as a
share of the standard deviation that all axes make together. Rows `<metric>.<axis>.share` and `.first`: shares of the
variance by the slopes and by Sobol. They differ where a figure is not linear over the box, as a settling time is not.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.t32 import SPREADS, STEP, benchmark
from problems.speed.batched_monte_carlo import GAINS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

METRICS = ("SettlingTime", "Overshoot", "IAE")
UNITS = {"SettlingTime": "s", "Overshoot": "%", "IAE": "s"}
BOX = {**SPREADS, "valve.dead_zone": 0.2}
COUNT, SIDE = 64, 1e-2
APART = 0.03  # share of a figure's standard deviation by which slope and central difference may differ [1]


@dataclass(frozen=True, eq=False)
class Job:
    """The two studies, and central differences by metric and axis."""

    local: po.LocalSensitivity
    box: po.Sensitivity
    differences: Mapping[tuple[str, str], float]


def run(count: int = COUNT) -> Job:
    loop, given = benchmark()
    design = given.with_values(GAINS | {"dither.amplitude": 0.0})
    local = po.local_sensitivity(loop, STEP, design, BOX, metrics=METRICS)
    certify = partial(po.evaluate, loop, STEP)
    box = po.sensitivity(certify, design, BOX, figures=METRICS, count=count)
    differences = dict[tuple[str, str], float]()
    for axis, half in BOX.items():
        names = (axis,) if isinstance(axis, str) else axis
        ends = [
            certify(design.with_values({n: design.value(n) * (1 + s * SIDE * half / sqrt(3.0)) for n in names}))
            for s in (1, -1)
        ]
        for metric in METRICS:
            high, low = (end.iloc[:, 0].to_dict()[metric] for end in ends)
            differences[metric, " + ".join(names)] = (high - low) / (2 * SIDE)
    return Job(local, box, differences)


def main(job: Job) -> "pd.DataFrame":
    table: dict[Any, dict[str, float]] = job.local.table.to_dict("index")  # type: ignore[assignment]
    figures: dict[Any, dict[str, float]] = job.local.figures.to_dict("index")  # type: ignore[assignment]
    claims, first = list[Claim](), job.box.table["first"].to_dict()
    for metric, about in figures.items():
        claims.append(Claim(f"{metric}.value", about["value"], UNITS[metric]))
        own = {axis: row for (m, axis), row in table.items() if m == metric}
        for axis, row in own.items():
            name = f"{metric}.{axis.partition(' ')[0]}"
            claims += [
                Claim(f"{name}.change", row["change"], UNITS[metric], job.differences[metric, axis]),
                Claim(f"{name}.share", row["share"]),
                Claim(f"{name}.first", first[metric, axis]),
            ]
        apart = max(abs(row["change"] - job.differences[metric, axis]) for axis, row in own.items())
        claims.append(Claim(f"{metric}.apart", apart / about["std"], "1", None, f"<= {APART}"))
    return frame(claims)


def figure(job: Job) -> "Figure":
    return po.plot_sensitivity(job.box, job.local)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="points of the Sobol design, a power of two")
    options = parser.parse_args()
    job = run(options.count)
    sys.exit(finish(main(job), options, lambda: {"tolerance_sensitivity": figure(job)}))
