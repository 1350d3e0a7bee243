"""A controller that samples, and computes for a sample: tuned as it runs, against tuned continuous and then sampled.

    python problems/tune/sampled_tuning.py [--samples MS ...] [--json FILE] [--out DIR]

The drive is the benchmark T32 (LuGre friction, a dead zone of 3 %), the step 0.2 m/s from rest. Kp, Ki, Kd, Tf and the
offset of the command are free; what is minimised is the settling time to 2 %, overshoot at most 5 %, Ms at most 1.6;
the best of three searches counts.
"continuous" is tuned and run without sampling; "<h>ms.continuous" are its gains in a PID that samples every h with one
sample of computing delay, "<h>ms.tuned" is tuned as that PID. Every figure is certified, by a simulation that holds the
command between samples; a loop that never settles shows none. "kept" is 1 where a design keeps all limits and settles.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, design, finish, frame
from problems.shared.t32 import RANGES, STEP, VALUES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SAMPLES = (1.0, 2.0, 5.0, 10.0)  # [ms]
DELAY = 1  # [samples]
SEEDS = (0, 1, 2)
BAND, OVERSHOOT, SENSITIVITY = 0.02, 0.05, 1.6
LIMITS = (po.Overshoot(OVERSHOOT), po.MaxSensitivity(SENSITIVITY))
FREE = {n: r for n, r in RANGES.items() if n != "dither.amplitude"} | {"pid.Tf": (0.002, 0.05)}


@dataclass(frozen=True, eq=False)
class Run:
    """A design in the loop that it runs in, and its certificate."""

    loop: po.ClosedLoop
    parameters: po.ParameterSet
    certified: "pd.DataFrame"

    @property
    def settling_time(self) -> float:
        """[s]; NaN where it never settles."""
        return float(self.certified.loc["SettlingTime"].to_numpy(dtype=float)[0])

    @property
    def is_kept(self) -> bool:
        """Whether it settles and keeps the limits."""
        figures = self.certified.iloc[:, 0]
        kept = figures["Overshoot"] <= 100 * OVERSHOOT and figures["MaxSensitivity"] <= SENSITIVITY
        return bool(np.isfinite(self.settling_time) and kept)


def run(samples: Sequence[float] = SAMPLES) -> dict[str, Run]:
    """By name: the continuous design, then two for each sample time [ms]."""
    loop, given = benchmark(None)
    found = {"continuous": _tuned(loop, given)}
    gains = {n: found["continuous"].parameters.value(n) for n in FREE}
    for milliseconds in samples:
        loop, given = benchmark(1e-3 * milliseconds)
        copied = given.with_values(gains)
        found[f"{milliseconds:g}ms.continuous"] = Run(loop, copied, po.evaluate(loop, STEP, copied, band=BAND))
        found[f"{milliseconds:g}ms.tuned"] = _tuned(loop, given)
    return found


def benchmark(sample_time: float | None) -> tuple[po.ClosedLoop, po.ParameterSet]:
    drive, hardware = po.catalog.t32()
    pid = po.PID() if sample_time is None else po.PID(sample_time=sample_time, delay=DELAY)
    loop = po.ClosedLoop(drive.system(), pid, po.Dither(frequency=20.0))  # of which the offset alone is used
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    given = (hardware.fixed("*") | own).with_values(VALUES | {"dither.amplitude": 0.0})
    return loop, given.with_bounds(FREE).freed(*FREE)


def _tuned(loop: po.ClosedLoop, given: po.ParameterSet) -> Run:
    """The best of some seeds."""
    found = []
    for seed in SEEDS:
        method = po.Racing(seed=seed)
        best = po.tune(
            loop, STEP, given, minimise=po.SettlingTime(BAND), subject_to=LIMITS, method=method, plants={}, throw=False
        )
        found.append(Run(loop, best.parameters, best.certified))
    return min(found, key=lambda r: r.settling_time if r.is_kept else np.inf)


def main(runs: dict[str, Run]) -> "pd.DataFrame":
    claims = []
    for name, found in runs.items():
        is_tuned = not name.endswith(".continuous")
        bounds = {"overshoot": f"<= {100 * OVERSHOOT:g}", "max_sensitivity": f"<= {SENSITIVITY:g}"} if is_tuned else {}
        claims += design(name, found.parameters, found.certified, bounds)
        claims.append(Claim(f"{name}.kept", int(found.is_kept), "1", None, ">= 1" if is_tuned else ""))
    for name in (n.removesuffix(".tuned") for n in runs if n.endswith(".tuned")):
        ours, theirs = (runs[f"{name}.{kind}"].settling_time for kind in ("tuned", "continuous"))
        held = "<= 1" if runs[f"{name}.continuous"].is_kept else ""
        claims.append(Claim(f"{name}.tuned_over_continuous", ours / theirs, "1", None, held))
    return frame(claims)


def figure(runs: dict[str, Run]) -> "Figure":
    """Speed and valve, a column a sample time: the continuous design's gains, and those tuned for it."""
    names = [n.removesuffix(".tuned") for n in runs if n.endswith(".tuned")]
    picture, (speeds, valves) = axes_grid(2, len(names), (2.4, 1.8), sharex="col", width=3.2 * len(names))
    for axes, valve, name in zip(speeds, valves, names, strict=True):
        shown = {
            "continuous": (GREY, "continuous, as tuned"),
            f"{name}.continuous": (ORANGE, "the same gains, sampled"),
            f"{name}.tuned": (BLUE, "tuned as it samples"),
        }
        for run_name, (colour, label) in shown.items():
            found = runs[run_name]
            response = po.respond(found.loop, STEP, found.parameters)
            axes.plot(1e3 * response.t, 1e3 * response["speed"], color=colour, lw=1.1, label=label)
            valve.plot(1e3 * response.t, response["control"], color=colour, lw=0.9)
        axes.axhspan(*(1e3 * STEP.final * (1 + k * BAND) for k in (-1, 1)), color=GREY, alpha=0.3, lw=0)
        axes.set(title=f"{name.removesuffix('ms')} ms, one sample of delay", ylim=(0, 1.6e3 * STEP.final))
        axes.title.set_fontsize(9)
        valve.set(xlabel="time [ms]", xlim=(0, 400), ylim=(-5.3, 5.3))
    speeds[0].set_ylabel("speed [mm/s]")
    valves[0].set_ylabel("valve [V]")
    legend_above(picture, speeds[0])
    return picture


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--samples", nargs="+", type=float, default=SAMPLES, metavar="MS", help="sample times")
    options = parser.parse_args()
    runs = run(options.samples)
    sys.exit(finish(main(runs), options, lambda: {"sampled_tuning": figure(runs)}))
