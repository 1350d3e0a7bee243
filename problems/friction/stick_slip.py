"""What smoothing does to friction: event-accurate stick-slip (Karnopp) beside the smooth model, over its width.

    python problems/friction/stick_slip.py [--json FILE] [--out DIR]

A pneumatic drive (32 mm, 5 kg) creeps under a plain PI at 20 mm/s, sampled at 1 kHz, and sticks and slips. Karnopp's
friction sticks at rest, its events are located; the smooth model, which fits and tunings use, turns its friction round
over a width of speeds.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

WIDTHS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)  # [m/s]
VALUES = {
    "pid.Kp": 10.0,
    "pid.Ki": 100.0,
    "pid.lower": -5.0,
    "pid.upper": 5.0,
    "friction.coulomb": 25.0,
    "friction.static": 40.0,
    "friction.viscous": 70.0,
    "friction.stribeck_velocity": 0.02,
}
SPEED, SECONDS, MOVING = 0.02, 1.0, 5e-3  # [m/s], [s], [m/s]


@dataclass(frozen=True)
class Job:
    """The event-accurate run, and the smooth ones by their width [m/s]; the seconds each took."""

    exact: po.StickSlipResult
    smooth: dict[float, po.Trajectory]
    seconds: dict[float, float]


def run() -> Job:
    t = np.linspace(0, SECONDS, round(SECONDS * 1000) + 1)
    inputs = po.Trajectory(t, {"reference": np.full(len(t), SPEED)})
    fine = np.linspace(0, SECONDS, 10 * (len(t) - 1) + 1)
    seconds, runs = {}, {}
    loop = crawl(po.Stribeck())
    for width in WIDTHS:
        values = loop.parameters.with_values(VALUES | {"friction.smoothing": width})
        begin = perf_counter()
        runs[width] = po.simulate(loop, inputs, values, t_out=fine)
        seconds[width] = perf_counter() - begin
    loop = crawl(po.Karnopp(po.Stribeck()))
    begin = perf_counter()
    exact = po.simulate_stick_slip(loop, inputs, loop.parameters.with_values(VALUES), t_out=fine)
    return Job(exact, runs, {0.0: perf_counter() - begin, **seconds})


def main(job: Job) -> "DataFrame":
    truth, finest = figures_of(job.exact.trajectory), figures_of(job.smooth[WIDTHS[-1]])
    bounds = {"break_away": 2e-5, "share_at_rest": 1e-3, "mean_speed": 1e-5}
    units = {"break_away": "s", "share_at_rest": "1", "mean_speed": "m/s"}
    claims = [Claim(f"exact.{n}", v, units[n]) for n, v in truth.items()]
    claims.append(Claim("exact.events", len(job.exact.events), "1", None, ">= 10"))
    claims.append(Claim("exact.time", job.seconds[0.0], "s"))
    for width in WIDTHS:
        found = figures_of(job.smooth[width])
        claims += [Claim(f"{n}.error_at_{width:g}", abs(found[n] - truth[n]), units[n]) for n in truth]
    claims += [Claim(f"smooth.{n}", finest[n], units[n], truth[n], f"{truth[n]:.9g} +- {bounds[n]:g}") for n in truth]
    apart = np.abs(job.smooth[WIDTHS[-1]]["position"] - job.exact.trajectory["position"]).max()
    return frame([*claims, Claim("smooth.position_apart", apart, "m", None, "<= 5e-6")])


def crawl(friction: po.Stribeck | po.Karnopp) -> po.ClosedLoop:
    return po.ClosedLoop(po.PneumaticDrive(friction=friction).system(), po.PID(sample_time=1e-3))


def figures_of(run: po.Trajectory) -> dict[str, float]:
    """When the piston first moves faster than 5 mm/s [s], its share of time slower than that, its mean speed [m/s]."""
    v, fast = run["speed"], run["speed"] > MOVING
    k = int(np.argmax(fast))
    first = np.interp(MOVING, v[k - 1 : k + 1], run.t[k - 1 : k + 1])
    mean = (run["position"][-1] - run["position"][0]) / run.duration
    return {"break_away": float(first), "share_at_rest": float(1 - fast.mean()), "mean_speed": float(mean)}


def figure(job: Job) -> "Figure":
    picture, ((speed,), (apart,), (errors,)) = axes_grid(3, 1, (2.4, 1.8, 2.4))
    exact = job.exact.trajectory
    speed.fill_between(exact.t, 0, 1, where=exact["stuck"] > 0, transform=speed.get_xaxis_transform(), color="0.93")
    speed.plot(exact.t, 1e3 * exact["speed"], color=BLUE, label="Karnopp, events located (grey: sticks)")
    for width, colour in ((1e-2, RED), (1e-3, ORANGE)):
        speed.plot(exact.t, 1e3 * job.smooth[width]["speed"], color=colour, lw=1, label=f"smooth, {1e3 * width:g} mm/s")
    for event in job.exact.events:
        if event.kind is po.EventKind.BREAK_AWAY:
            speed.axvline(event.t, color=GREY, lw=0.5)
    speed.axhline(1e3 * SPEED, color="k", lw=0.8, ls="--", label="set")
    speed.set(ylabel="speed [mm/s]")
    for width, colour in ((1e-3, ORANGE), (1e-4, GREY), (1e-6, BLUE)):
        gap = np.abs(job.smooth[width]["position"] - exact["position"])
        apart.semilogy(exact.t, 1e6 * np.maximum(gap, 1e-14), color=colour, lw=1, label=f"{1e3 * width:g} mm/s")
    apart.legend(frameon=False, fontsize=8, ncols=3, loc="lower right")
    apart.set(xlabel="time [s]", ylabel="position apart [um]", ylim=(1e-3, None))
    apart.sharex(speed)
    truth = figures_of(exact)
    for name, marker in {"break_away": "o", "share_at_rest": "s", "mean_speed": "^"}.items():
        gaps = [abs(figures_of(job.smooth[w])[name] - truth[name]) / abs(truth[name]) for w in WIDTHS]
        errors.loglog(
            [1e3 * w for w in WIDTHS], [gap or np.nan for gap in gaps], marker=marker, label=name.replace("_", " ")
        )
    errors.legend(frameon=False, fontsize=8)
    errors.set(xlabel="smoothing width [mm/s]", ylabel="relative error")
    legend_above(picture, speed)
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    done = run()
    sys.exit(finish(main(done), options, lambda: {"stick_slip": figure(done)}))
