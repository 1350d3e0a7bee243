"""The paper's central claim as a map: the less static and kinetic friction differ, the less a drive crawls.

    python problems/paper/paper_crawl.py [--json FILE] [--out DIR]

Ye, Wang, Chen (IJRES 3(7), 2015) say so and have no friction in their model. Here the paper's drive R25, behind a
spool of 100 Hz, sticks for good (Karnopp: 25 N Coulomb, static friction 1 to 2.2 times that, 20 mm/s Stribeck
velocity), under a PI with the paper's Kp and Ki, from rest to 3 to 80 mm/s. Each point is an event-accurate simulation
of 10 s, or of 400 mm; what is shown is the share of its last 60 %, over whole cycles, for which the piston stands
still.

Rows equal.*: at F_s = F_c nothing sticks or swings at any speed. Rows rising.*: at every speed the share grows with
F_s/F_c. Rows fastest.*: so does the speed up to which the piston does not move evenly. Rows boundary.*: F_s/F_c from
which uniform sliding is unstable, from the eigenvalues of the loop linearised there; every point beyond that boundary
swings or sticks. The reverse does not hold: points on its stable side do so as well, because from rest the first
break-away throws the loop into the cycle. So the paper is right, and the difference is not all: speed and controller
count as much.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.r25 import CLIP, PAPERS_PID, TRANSDUCER, lagging

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

COULOMB = 25.0  # [N] F_c
RATIOS = np.array([1.0, 1.05, 1.1, 1.2, 1.3, 1.4, 1.6, 1.8, 2.0, 2.2])  # F_s/F_c
SPEEDS = np.array([3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 55.0, 80.0])  # [mm/s]
SECONDS, TRAVEL, STEP = 10.0, 400.0, 2e-3  # [s] of a run, for a cycle at 3 mm/s takes 3 s; [mm] at most of it; [s]
SINCE = 0.4  # of a run: what comes before is the start
UNEVEN, EVEN = 0.1, 0.01  # deviation of the speed, of the set one: from there on it swings, up to there it does not
MOST_FALL = 0.01  # of the time stuck, along a rising F_s/F_c: what the samples' time resolves
SMOOTHING = 1e-4  # [m/s] of the friction linearised while sliding: a wider one would damp at 3 mm/s
TOLERANCE = 1e-6  # of a simulation's step, relative
GAINS = {
    "pid.Kp": TRANSDUCER * PAPERS_PID["Kp"],
    "pid.Ki": TRANSDUCER * PAPERS_PID["Ki"],
    "pid.c": 0.0,
    "pid.lower": -CLIP,
    "pid.upper": CLIP,
}
BOUNDARIES = {5.0: 1.256, 12.0: 1.144, 27.0: 1.276}  # F_s/F_c by speed [mm/s]
SHOWN = {1.0: BLUE, 1.2: ORANGE, 1.6: RED}  # of the curves at 12 mm/s
LEVELS = (0.02, 0.2, 0.4, 0.6, 0.8)  # of the map's contours


@dataclass(frozen=True, eq=False)
class Map:
    """Share of time stuck and deviation of the speed, of the set one, by ratio and speed.

    `boundary` is by speed the ratio from which uniform sliding is unstable.
    """

    stuck: Array
    deviation: Array
    boundary: Array

    @property
    def unstable(self) -> NDArray[np.bool_]:
        """Whether uniform sliding is unstable, by ratio and speed: by 2 %, beyond which growth is not slow."""
        return np.asarray(RATIOS[:, None] > 1.02 * self.boundary)


def run() -> Map:
    found = np.array([[unevenness(float(ratio), float(v)) for v in SPEEDS] for ratio in RATIOS])
    return Map(found[..., 0], found[..., 1], np.array([unstable_from(float(v)) for v in SPEEDS]))


def main(found: Map) -> "DataFrame":
    fall, uneven = -np.diff(found.stuck, axis=0).min(), found.deviation >= UNEVEN
    rows = [
        Claim("equal.stuck", float(found.stuck[RATIOS == 1.0].max()), "1", None, "<= 0"),
        Claim("equal.deviation", float(found.deviation[RATIOS == 1.0].max()), "1", None, f"<= {EVEN}"),
        Claim("rising.largest_fall", float(fall), "1", None, f"<= {MOST_FALL}"),
        Claim("rising.uneven", int(uneven.sum()), "1", None, ">= 40"),
    ]
    before = 0.0
    for ratio in (1.2, 1.4, 1.8, 2.2):
        fastest = float(SPEEDS[uneven[np.isclose(RATIOS, ratio)][0]].max(initial=0.0))
        rows.append(Claim(f"fastest.{ratio:g}", fastest, "mm/s", None, f">= {max(before, 1.0):g}"))
        before = fastest
    for v, ratio in BOUNDARIES.items():
        rows.append(Claim(f"boundary.{v:g}", unstable_from(v), "1", None, f"{ratio} +- 0.005"))
    beyond = found.unstable
    return frame(
        [
            *rows,
            Claim("boundary.beyond", int(beyond.sum()), "1", None, ">= 20"),
            Claim("boundary.beyond_and_even", int((beyond & ~uneven).sum()), "1", None, "<= 0"),
            Claim("boundary.before_and_uneven", int((~beyond & uneven).sum()), "1", None, ">= 1"),
        ]
    )


@cache
def crawl(ratio: float, v: float) -> po.Trajectory:
    """From rest at mid stroke to a set speed [mm/s], sticking for good."""
    loop, p = controlled(po.Karnopp(po.Stribeck()), ratio)
    t = np.arange(round(min(SECONDS, TRAVEL / v) / STEP) + 1) * STEP
    inputs = po.Trajectory(t, {"reference": np.full(len(t), 1e-3 * v)})
    return po.simulate_stick_slip(loop, inputs, p, rtol=TOLERANCE).trajectory


def unevenness(ratio: float, v: float) -> tuple[float, float]:
    """The share of the time stuck, over whole cycles, and the speed's deviation over the set one."""
    found = crawl(ratio, v)
    late = found.t >= SINCE * found.duration
    stuck, speed = found["stuck"][late] > 0, found["speed"][late]
    stops = np.flatnonzero(stuck[1:] & ~stuck[:-1])
    whole = slice(stops[0], stops[-1]) if len(stops) > 1 else slice(None)
    return float(stuck[whole].mean()), float(speed.std()) / (1e-3 * v)


def controlled(friction: po.Karnopp | po.Stribeck, ratio: float) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The drive with static friction `ratio` times Coulomb's, under the paper's PI."""
    loop, p = _about(friction)
    own = {"friction.coulomb": COULOMB, "friction.static": ratio * COULOMB, "friction.smoothing": SMOOTHING}
    given = loop.parameters | p
    return loop, given.with_values({n: v for n, v in {**GAINS, **own}.items() if n in given})


@cache
def _about(friction: po.Karnopp | po.Stribeck) -> tuple[po.ClosedLoop, po.ParameterSet]:
    drive, p = lagging(friction)
    return po.ClosedLoop(drive.system(), po.PID(), measured="speed"), p


def unstable_from(v: float) -> float:
    """F_s/F_c from which the loop that slides at a speed [mm/s] is unstable; infinite if up to 4 it is not."""
    low, high = (fastest_growth(ratio, v) for ratio in (1.0, 4.0))
    if low >= 0 or high <= 0:
        return 1.0 if low >= 0 else float("inf")
    return float(optimize.brentq(fastest_growth, 1.0, 4.0, args=(v,), xtol=1e-6))


def fastest_growth(ratio: float, v: float) -> float:
    """The largest real part of an eigenvalue of the loop linearised while sliding [1/s], the position left out."""
    loop, p = controlled(po.Stribeck(), ratio)
    x = loop.initial(p, reference=1e-3 * v)
    A = loop.system().linearise(x, {"reference": 1e-3 * v}, p).A
    kept = [k for k, q in enumerate(loop.states) if q.name != "position"]
    return float(np.linalg.eigvals(A[np.ix_(kept, kept)]).real.max())


def figures(found: Map) -> "Mapping[str, Figure]":
    picture, ((left, right),) = axes_grid(1, 2, (3.6,))
    _draw_map(left, found)
    v = float(SPEEDS[np.argmin(np.abs(SPEEDS - 12.0))])
    for ratio, colour in SHOWN.items():
        run_ = crawl(ratio, v)
        right.plot(run_.t, 1e3 * run_["speed"], color=colour, lw=1.2, label=f"$F_s/F_c$ = {ratio:g}")
    right.axhline(v, color=GREY, lw=0.8, ls="--", zorder=0)
    right.set(
        xlabel="time [s]", ylabel="speed [mm/s]", title=f"From rest to {v:g} mm/s", xlim=(0, SECONDS), ylim=(-3, 80)
    )
    right.legend(frameon=False, fontsize=8, loc="upper right")
    return {"paper_crawl": picture}


def _draw_map(axes: "Axes", found: Map) -> None:
    """Contours of the share of time stuck, and the edge beyond which uniform sliding is unstable."""
    axes.grid(False)
    axes.set_xscale("log")
    axes.contourf(SPEEDS, RATIOS, found.stuck, levels=[*LEVELS, 1.0], cmap="YlOrRd", alpha=0.85)
    lines = axes.contour(SPEEDS, RATIOS, found.stuck, levels=LEVELS, colors="black", linewidths=0.7)
    axes.clabel(lines, fmt=lambda share: f"{100 * share:.0f} %", fontsize=8)
    fine = np.geomspace(SPEEDS[0], SPEEDS[-1], 60)
    axes.plot(
        fine, [unstable_from(float(v)) for v in fine], color=BLUE, ls="--", label="uniform sliding unstable above"
    )
    speeds, ratios = np.meshgrid(SPEEDS, RATIOS)
    axes.plot(speeds.ravel(), ratios.ravel(), ".", color=GREY, ms=2)
    axes.set(xlabel="set speed [mm/s]", ylabel="static over Coulomb friction, $F_s/F_c$", ylim=(RATIOS[0], RATIOS[-1]))
    axes.set_xticks(SPEEDS, [f"{v:g}" for v in SPEEDS], minor=False)
    axes.set_xticks([], minor=True)
    axes.set_title("Share of the time that the piston stands still")
    axes.legend(frameon=False, fontsize=8, loc="lower right")


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    done = run()
    sys.exit(finish(main(done), options, lambda: figures(done)))
