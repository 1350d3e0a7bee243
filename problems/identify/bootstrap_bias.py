"""What a model without stick-slip, hysteresis and sensors does to its estimates, told by `bootstrap` without the truth.

    python problems/identify/bootstrap_bias.py [--count N] [--rigs SEED ...] [--json FILE] [--out DIR]

The log of data/pneumatic_rig is identified with the smooth model; then its logs are simulated on the drive with that
fit's estimates, which truly sticks, behind the valve's hysteresis and the sensors that its data sheets state, and are
identified again. `demo.right_signs` counts the estimates with a bound of their bias of which it is told with the sign
that it has. Then the same on rigs drawn at random (other_rigs.py), whose hysteresis is half to one and a half times
what is stated; their mass is stated as it is. `.error` is an estimate's distance from the truth, `.corrected` that of
the estimate less its bias; `left` is the root mean square of the second over that of the first, over all estimates of
all rigs.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.demo import other_rigs
from problems.demo.rig_demo import DATA, RIG, TRUTH, the_rig
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT, RIGS = 6, (1, 2, 3, 4)  # draws a rig; seeds of the rigs
DEMO = "demo"
Found = dict[str, "pd.DataFrame"]


def main(found: Found) -> "pd.DataFrame":
    claims: list[Claim] = []
    for name, table in found.items():
        for parameter, row in table.iterrows():
            claims += [Claim(f"{name}.{parameter}.{part}", float(row[part]), "%") for part in ("error", "corrected")]
    marked = found[DEMO][found[DEMO]["bias"] > 0]
    right = int((np.sign(marked["error"]) == np.sign(marked["error"] - marked["corrected"])).sum())
    before, after = (np.concatenate([t[part] for t in found.values()]) for part in ("error", "corrected"))
    left = float(np.linalg.norm(after) / np.linalg.norm(before))
    claims.append(Claim("demo.right_signs", right, "1", len(marked), f">= {len(marked)}"))
    return frame([*claims, Claim("left", left, "1", None, "<= 0.5")])


def run(count: int = COUNT, rigs: Sequence[int] = RIGS) -> Found:
    """By rig a row an estimate: error and corrected [% of the truth], bound of the bias."""
    drive, given = po.read_drive(DATA / "drive.toml")
    found = {DEMO: tried(drive, po.read_log(DATA / "run_01.csv"), given, TRUTH, count)}
    for seed in rigs:
        _, truth, beyond = other_rigs.draw(np.random.default_rng(seed))
        stated = given.with_values({"load.mass": truth["load.mass"]})
        found[f"rig_{seed}"] = tried(drive, other_rigs.record(stated, truth, beyond, seed), stated, truth, count)
    return found


def tried(
    drive: Any, log: po.Experiment, given: po.ParameterSet, truth: Mapping[str, float], count: int
) -> "pd.DataFrame":
    """The estimates of a log, before and after they are corrected, against the truth [%]."""
    began = time.process_time()
    fit = po.identify(drive, log, given, throw=False)
    hardware = the_rig(RIG)
    plant = po.stick_slip_drive(drive).system()
    rig = po.Rig(plant, hardware.sensors, hardware.actuator, actuated="valve_voltage")
    result = po.bootstrap(drive, log, fit, rig=rig, count=count)
    print(
        f"{log.name}: {fit.status.verdict}; {time.process_time() - began:.1f} CPU s in this process", result, sep="\n"
    )
    table = result.table[["value", "corrected"]].astype(float)
    true = np.array([truth[str(n)] for n in table.index])
    table = 100 * (table.div(true, axis=0) - 1)
    table.insert(0, "bias", fit.estimates["bias"].loc[table.index])
    return table.rename(columns={"value": "error"})


def figure(found: Found) -> "Figure":
    """Each estimate's error before and after, a panel a rig."""
    from pneuopt.plotting import BLUE, GREY, axes_grid, legend_above

    names = list(next(iter(found.values())).index)
    fig, axes = axes_grid(1, len(found), [2.6], width=max(6.4, 2.4 * len(found) + 1.5))
    for ax, (name, table) in zip(axes[0], found.items(), strict=True):
        at = np.arange(len(names))
        ax.axvline(0, color="0.6", linewidth=0.8)
        ax.scatter(table["error"].loc[names], at, color=GREY, label="as fitted")
        ax.scatter(table["corrected"].loc[names], at, color=BLUE, label="less the bias that bootstrap tells")
        ax.set_yticks(at, names if ax is axes[0][0] else [""] * len(names))
        ax.set_title(name.replace("_", " "))
        ax.set_xlabel("error [%]")
        ax.invert_yaxis()
    legend_above(fig, axes[0][0])
    return fig


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--rigs", type=int, nargs="*", default=RIGS)
    options = parser.parse_args()
    rows = run(options.count, options.rigs)
    sys.exit(finish(main(rows), options, lambda: {"bootstrap_bias": figure(rows)}))
