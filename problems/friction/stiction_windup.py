"""Stiction windup: the paper's gains on a drive that sticks, what anti-windup and a dead band do about it, and tuning.

    python problems/friction/stiction_windup.py [--json FILE] [--out DIR]

The paper's PID (derivative on the error) on its own drive R25 overshoots a step of 50 mm/s by 1.4 % without friction
and by 40 % with LuGre friction (25/40 N): while the piston sticks, and until it is up to speed, the integral gathers
what it then takes long to lose. At 10 mm/s the same gains hunt.

Rows antiwindup.*: back-calculation at the valve's limits, from slow to fast, changes nothing: nothing saturates. Rows
dead_band.*: an integral with a dead band, in percent of the set speed, loses overshoot only as the band grows, and
leaves an error for it; hunting becomes smaller and does not end. So neither is a cure here. Rows ours.*: Kp, Ki and Kd
tuned on the friction model for both speeds, overshoot and sensitivity limited. Rows gentle.*: tuned for 50 mm/s with no
more command than the paper's gains take: the overshoot goes, the settling takes long, and 10 mm/s still hunts.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, design, finish, frame
from problems.shared.r25 import CLIP, PAPERS_PID, TRANSDUCER

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

FAST, SLOW = 0.05, 0.01  # [m/s]
SECONDS = {FAST: 2.0, SLOW: 8.0}
SINCE = 0.5  # of a record, from where a limit cycle is looked for
PAPERS = {f"pid.{n}": v if n == "Tf" else TRANSDUCER * v for n, v in PAPERS_PID.items()}
PAPERS |= {"pid.lower": -CLIP, "pid.upper": CLIP}
UNWINDING = (1.0, 0.1, 0.01)  # [s] Tt
BANDS = (10.0, 20.0, 40.0, 60.0)  # [%] of the set speed
RANGES = {"pid.Kp": (1.0, 40.0), "pid.Ki": (1.0, 200.0), "pid.Kd": (0.0, 2.0)}
SEARCH = po.Racing(members=24, trials=200)
STEPS = [po.Step(v, horizon=2.0) for v in (FAST, SLOW)]
LIMITS = (po.Overshoot(0.05), po.MaxSensitivity(1.6))
PAPERS_PEAK = 1.225  # [V] that its gains command for 50 mm/s
BOUNDS = {
    "viscous.50.overshoot": "1.4 +- 0.1", "paper.50.overshoot": "40.2 +- 0.3", "paper.10.amplitude": ">= 5",
    "antiwindup.1.change": "<= 1e-6", "antiwindup.0.1.change": "<= 1e-6", "antiwindup.0.01.change": "<= 1e-6",
    "dead_band.10.overshoot": ">= 30", "dead_band.20.overshoot": ">= 25", "dead_band.60.amplitude": ">= 1",
    "ours.50.overshoot": "<= 5", "ours.10.overshoot": "<= 5", "ours.10.amplitude": "<= 0", "ours.certified": "1 +- 0",
    "gentle.50.overshoot": "<= 5", "gentle.certified": "1 +- 0", "gentle.peak_control": "<= 1.225",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Run:
    """A response to one set speed [m/s], and the limit cycle in it."""

    speed: float
    trajectory: po.Trajectory
    cycle: po.LimitCycle | None

    @property
    def overshoot(self) -> float:
        """[%]"""
        return 100 * max(0.0, float(self.trajectory["speed"].max()) / self.speed - 1)

    @property
    def amplitude(self) -> float:
        """Of the limit cycle [mm/s], 0 without."""
        return 1e3 * self.cycle.amplitude if self.cycle else 0.0

    @property
    def error(self) -> float:
        """Of the mean over the last eighth [%]."""
        late = self.trajectory.t >= 7 / 8 * self.trajectory.t[-1]
        return 100 * abs(float(self.trajectory["speed"][late].mean()) / self.speed - 1)


@dataclass(frozen=True, eq=False)
class Job:
    """Runs by name and set speed, designs, the seconds."""

    runs: Mapping[tuple[str, float], Run]
    designs: Mapping[str, po.TuningResult]
    seconds: float


def run() -> Job:
    began = time.perf_counter()
    runs = {("viscous", FAST): stepped(FAST, PAPERS, lugre=False)}
    runs |= {("paper", v): stepped(v, PAPERS) for v in (FAST, SLOW)}
    runs |= {(f"antiwindup.{Tt:g}", FAST): stepped(FAST, PAPERS | {"pid.Tt": Tt}) for Tt in UNWINDING}
    for share in BANDS:
        for v in (FAST, SLOW):
            runs[f"dead_band.{share:g}", v] = stepped(v, PAPERS | {"pid.dead_band": share / 100 * v})
    designs = {"ours": tuned(STEPS), "gentle": tuned(STEPS[:1], po.PeakControl(PAPERS_PEAK))}
    for name, found in designs.items():
        gains = {n: found.parameters.value(n) for n in PAPERS}
        runs |= {(name, v): stepped(v, gains) for v in (FAST, SLOW)}
    return Job(runs, designs, time.perf_counter() - began)


def stepped(v: float, gains: Mapping[str, float], *, lugre: bool = True) -> Run:
    """From rest at mid stroke, continuous, with ideal sensing."""
    drive, p = po.catalog.r25(lugre)
    loop = po.ClosedLoop(drive.system(), po.PID(dead_band="pid.dead_band" in gains), measured="speed")
    step = po.Step(v, horizon=SECONDS[v]).trajectory(1e-3)
    found = po.simulate(loop, step, (loop.parameters | p).with_values(gains), rtol=1e-8)
    return Run(v, found, po.find_limit_cycle(found.t, found["speed"], start=SINCE * SECONDS[v]))


def tuned(steps: list[po.Step], *limits: Any) -> po.TuningResult:
    """Minimises the settling time to 2 % on the LuGre model."""
    drive, p = po.catalog.r25(lugre=True)
    loop = po.ClosedLoop(drive.system(), po.PID(), measured="speed")
    given = (loop.parameters | p).with_values(PAPERS).with_bounds(RANGES).freed(*RANGES)
    asked = (*LIMITS, *limits)
    return po.tune(
        loop, steps, given, minimise=po.SettlingTime(), subject_to=asked, method=SEARCH, plants={}, throw=False
    )


def main(job: Job) -> "DataFrame":
    claims = []
    paper = job.runs["paper", FAST]
    for (name, v), found in job.runs.items():
        row = f"{name}.{1e3 * v:g}" if not name.startswith("dead_band") else name
        if name.startswith("antiwindup"):
            change = np.abs(found.trajectory["speed"] - paper.trajectory["speed"]).max() / v
            claims.append(Claim(f"{name}.change", float(change)))
            continue
        if v == FAST:
            claims += [Claim(f"{row}.overshoot", found.overshoot, "%"), Claim(f"{row}.error", found.error, "%")]
            continue
        claims.append(Claim(f"{row}.amplitude", found.amplitude, "mm/s"))
        claims += [Claim(f"{row}.frequency", found.cycle.frequency, "Hz")] if found.cycle else []
        claims += [Claim(f"{row}.overshoot", found.overshoot, "%")] if name in job.designs else []
    for name, result in job.designs.items():
        claims += design(name, result.parameters, result.certified)
        claims.append(Claim(f"{name}.certified", float(result.status.converged)))
    claims.append(Claim("seconds", job.seconds, "s"))
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def figure(job: Job) -> "Figure":
    picture, grid = axes_grid(2, 2, (2.6, 1.8), sharex="col")
    shown = {
        "viscous": (GREY, "the paper's gains, no friction"),
        "paper": (RED, "the paper's gains, LuGre friction"),
        "dead_band.20": (ORANGE, "with a dead band of 20 % of the speed"),
        "ours": (BLUE, "tuned"),
    }
    for column, v in enumerate((FAST, SLOW)):
        for name, (colour, label) in shown.items():
            if (name, v) in job.runs:
                found = job.runs[name, v].trajectory
                grid[0][column].plot(found.t, 1e3 * found["speed"], color=colour, lw=1.2, label=label)
                grid[1][column].plot(found.t, found["control"], color=colour, lw=1.0)
        grid[0][column].axhline(1e3 * v, color="k", lw=0.6, ls="--")
        grid[0][column].set_title(f"{1e3 * v:g} mm/s")
        grid[1][column].set(xlabel="time [s]", xlim=(0, 2.0 if v == FAST else 4.0))
    grid[0][0].set_ylabel("speed [mm/s]")
    grid[1][0].set_ylabel("valve [V]")
    legend_above(picture, grid[0][0])
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"stiction_windup": figure(job)}))
