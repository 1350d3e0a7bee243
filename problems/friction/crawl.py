"""Stick-slip at 10 and 20 mm/s: seen, measured, cured; and what each cure costs on a rig.

    python problems/friction/crawl.py [--json FILE] [--out DIR]

The paper's drive R25 behind a spool of 100 Hz, with true sticking (25/40 N, 20 mm/s), an encoder of 10 um whose
difference is filtered over 5 ms, and a valve with 0.4 % hysteresis, under a speed controller at 1 kHz. Rows screen.*:
where friction falls with speed faster than viscous friction rises, uniform sliding is unstable: necessary for crawl,
not sufficient. Rows lugre.*: the smooth model under the same continuous gains hunts at 10 and 20 mm/s, not at 5 and 50.
Rows *.cycle: amplitude and frequency of the limit cycle that `find_limit_cycle` sees in the speed alone, beside the
events of the simulator that knows when the piston sticks (stuck, slips, frequency).

Rows hand.*: a hand-tuned PI (the paper's Kp and Ki) on the rig sticks and slips from 5 to 50 mm/s: at 50 mm/s uniform
sliding is stable, and coming_down.50, from 100 mm/s, stays there, but from rest the first break-away throws the loop
into the cycle. Cured by pid.*, a PID tuned on the smooth Stribeck model with the lag of the encoder's filter in its
loop: derivative action is the damper that friction lacks. Its price: the encoder's counts as spikes on the valve, a
wait for the break-away with an overshoot then, a sensitivity of 2.5, and a slow swing by a tenth in the hysteresis of
the valve. Cured on the average by dithered.*, the same
tuning with 10 Hz of dither, amplitude and offset free; its price is ripple larger than the set speed, and the piston
still sticks once a period. Row p_alone.*: without an integral nothing winds up, and nothing moves. An integral with a
dead band, the other usual remedy: stiction_windup.py.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy import optimize

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, design, finish, frame
from problems.shared.r25 import CLIP, averaged, lagging

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

CRAWL, CONTROLS = (0.01, 0.02), (0.005, 0.05)  # [m/s]
SAMPLE, SECONDS, SINCE, SMOOTH = 1e-3, 6.0, 1.0, 3.0  # [s]; measured from SINCE on, of the smooth model from SMOOTH on
LEAST = 0.05  # of the set speed: amplitude of a limit cycle that counts
FASTER, UNTIL = 0.1, 1.0  # [m/s], [s] before coming down to 50 mm/s, measured SINCE later
TOLERANCE = 1e-6  # of a step: 1e-8 gives the same verdicts and takes a third longer
FREQUENCY = 10.0  # [Hz] of the dither: faster, a valve within its 5 V moves too little (paper_dither.py)
FILTER, RESOLUTION = 5e-3, 1e-5  # [s], [m] of the encoder
HAND = {"pid.Kp": 4.5, "pid.Ki": 24.6, "pid.Tf": 0.01, "pid.c": 0.0, "pid.lower": -CLIP, "pid.upper": CLIP}
P_ALONE = HAND | {"pid.Ki": 0.0}
DAMPER = {"pid.Kd": 0.6, "pid.Tf": 0.002}  # start: 762 N/(s V) times Kd outweighs the screen's 443 N s/m
GAINS = {"pid.Kp": (1.0, 10.0), "pid.Ki": (5.0, 60.0), "pid.Kd": (0.0, 2.0), "pid.Tf": (0.001, 0.01)}
DITHER = {"dither.amplitude": (0.0, 3.0), "dither.offset": (-0.5, 0.5)}
STEPS = [po.Step(v, horizon=1.5) for v in CRAWL]
BAND, SENSITIVITY = 0.1, 2.5
SEARCH = po.Racing(members=24, trials=120)
BOUNDS = {
    "hand.5.stuck": ">= 0.5", "hand.10.stuck": ">= 0.5", "hand.20.stuck": ">= 0.3", "hand.50.stuck": ">= 0.05",
    "hand.10.deviation": ">= 1", "hand.20.deviation": ">= 1",
    "coming_down.50.stuck": "<= 0", "coming_down.50.deviation": "<= 0.1",
    "pid.10.stuck": "<= 0", "pid.20.stuck": "<= 0", "pid.10.deviation": "<= 0.1", "pid.20.deviation": "<= 0.1",
    "dithered.10.averaged": "<= 0.05", "dithered.20.averaged": "<= 0.05",
    "dithered.10.ripple": ">= 10", "dithered.20.ripple": ">= 20", "pid.10.ripple": "<= 5", "pid.20.ripple": "<= 5",
    "p_alone.10.stuck": ">= 0.99",
    "hand.10.cycle": ">= 5", "hand.20.cycle": ">= 5", "pid.10.cycle": "<= 0", "pid.20.cycle": "<= 0",
    "lugre.10.cycle": ">= 5", "lugre.20.cycle": ">= 5", "lugre.5.cycle": "<= 0", "lugre.50.cycle": "<= 0",
    "coming_down.50.cycle": "<= 0",
    "lugre.5.deviation": "<= 0.02", "lugre.10.deviation": ">= 0.5", "lugre.20.deviation": ">= 0.5",
    "lugre.50.deviation": "<= 0.02",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Job:
    """The designs, the rig's recordings by design and speed [m/s], the smooth model's responses, the seconds."""

    designs: Mapping[str, po.TuningResult]
    runs: Mapping[tuple[str, float], po.Recording]
    lugre: Mapping[float, po.Trajectory]
    seconds: float


def run() -> Job:
    began = time.perf_counter()
    pid = tuned({**GAINS}, {})
    dithered = tuned({**GAINS, **DITHER}, {"dither.amplitude": 1.0})
    given = {"hand": HAND, "pid": knobs(pid), "dithered": knobs(dithered), "p_alone": P_ALONE}
    speeds = {"hand": (*CRAWL, *CONTROLS), "pid": (*CRAWL, *CONTROLS), "dithered": CRAWL, "p_alone": CRAWL[:1]}
    runs = {(name, v): on_the_rig(given[name], v) for name in given for v in speeds[name]}
    runs["coming_down", CONTROLS[1]] = on_the_rig(HAND, CONTROLS[1], FASTER)
    lugre = {v: on_the_smooth_model(v) for v in (*CRAWL, *CONTROLS)}
    return Job({"pid": pid, "dithered": dithered}, runs, lugre, time.perf_counter() - began)


def main(job: Job) -> "DataFrame":
    claims = [*screen()]
    for v, smooth in job.lugre.items():
        late = smooth["speed"][smooth.t >= SMOOTH]
        claims.append(Claim(f"lugre.{1e3 * v:g}.deviation", float(late.std()) / v))
        claims += cycle(f"lugre.{1e3 * v:g}", smooth, v, SMOOTH, dithered=False)
    for (name, v), recording in job.runs.items():
        claims += measured(f"{name}.{1e3 * v:g}", recording, v, SINCE + UNTIL * (name == "coming_down"))
    for name, found in job.designs.items():
        certified = found.certified if name == "pid" else found.certified.drop("MaxSensitivity")
        claims += design(f"{name}.tuned", found.parameters, certified)
    claims.append(Claim("seconds", job.seconds, "s"))
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def tuned(ranges: Mapping[str, tuple[float, float]], start: Mapping[str, float]) -> po.TuningResult:
    """Gains for both slow steps on the smooth model, with the encoder's lag; no sensitivity limit under dither.

    Under dither the loop ends at some instant of an oscillation, and a linearisation there says nothing.
    """
    drive, p = lagging(po.Stribeck())
    loop = controlled(drive.system(), dither=bool(start))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "sensor.*", *(["dither.*"] if start else [])))
    given = (p | own).with_values({**HAND, **DAMPER, **start}).with_bounds(ranges).freed(*ranges)
    limits = [] if start else [po.MaxSensitivity(SENSITIVITY)]
    return po.tune(loop, STEPS, given, minimise=po.SettlingTime(BAND), subject_to=limits, method=SEARCH, plants={})


def controlled(plant: po.System, *, dither: bool) -> po.ClosedLoop:
    """The sampled loop about it, as the encoder's filter and differences let it see the speed."""
    own = po.Dither(FREQUENCY) if dither else None
    return po.ClosedLoop(plant, po.PID(sample_time=SAMPLE), own, sensor=po.SensorLag(FILTER + SAMPLE / 2))


def knobs(found: po.TuningResult) -> dict[str, float]:
    """The controller's numbers, as the rig gets them."""
    names = found.parameters.match_names("pid.*")
    names += tuple(n for n in found.parameters if n.startswith("dither."))
    return {n: found.parameters.value(n) for n in names}


def on_the_rig(values: Mapping[str, float], v: float, before: float | None = None) -> po.Recording:
    """From rest at mid stroke to a set speed, at once or by way of another."""
    drive, p = lagging(po.Karnopp(po.Stribeck()))
    loop = controlled(drive.system(), dither="dither.amplitude" in values)
    rig = po.Rig(
        loop, {"position": po.Sensor(resolution=RESOLUTION)}, po.Actuator(hysteresis=0.04), po.Encoder(filter=FILTER)
    )
    t = np.arange(round(SECONDS / SAMPLE) + 1) * SAMPLE
    reference = np.where(t < UNTIL, v if before is None else before, v)
    given = (loop.parameters | p).with_values(values)
    return po.record(rig, po.Trajectory(t, {"reference": reference}), given, rtol=TOLERANCE)


def on_the_smooth_model(v: float) -> po.Trajectory:
    """The hand-tuned PI, continuous and with ideal sensing, under LuGre friction."""
    drive, p = lagging(po.LuGre())
    loop = po.ClosedLoop(drive.system(), po.PID(), measured="speed")
    t = np.linspace(0, 6, 3001)
    step = po.Trajectory(t, {"reference": np.full(len(t), v)})
    return po.simulate(loop, step, (loop.parameters | p).with_values(HAND), rtol=1e-8)


def screen() -> list[Claim]:
    """The speeds between which the Stribeck curve falls faster than viscous friction rises: crawl needs one of them."""
    _, p = lagging(po.Stribeck())
    F_c, F_s, v_s, viscous = (p.value(f"friction.{n}") for n in ("coulomb", "static", "stribeck_velocity", "viscous"))

    def excess(v: float) -> float:
        return float(2 * (F_s - F_c) * v / v_s**2 * np.exp(-((v / v_s) ** 2)) - viscous)

    top = v_s / np.sqrt(2)
    low, high = (float(optimize.brentq(excess, *ends)) for ends in ((1e-6, top), (top, 10 * v_s)))
    return [
        Claim("screen.low", 1e3 * low, "mm/s", 3, "3 +- 0.5"),
        Claim("screen.high", 1e3 * high, "mm/s", 31, "31 +- 0.5"),
        Claim("screen.steepest", excess(top) + viscous, "N s/m", 643, "643 +- 1"),
        Claim("screen.beyond_viscous", excess(top), "N s/m"),
    ]


def measured(name: str, recording: po.Recording, v: float, since: float) -> list[Claim]:
    """Share of time stuck, break-aways, the speed's spread as it is and averaged, peak, ripple, command's range."""
    truth, late = recording.truth, recording.truth.t >= since
    speed, control = truth["speed"][late], truth["control"][late]
    slips = np.array([e.t for e in recording.events if e.kind is po.EventKind.BREAK_AWAY and e.t >= since])
    smooth = averaged(truth.t, truth["speed"], 1 / FREQUENCY)[late & (truth.t <= SECONDS - 1 / FREQUENCY)]
    rows = [Claim(f"{name}.stuck", float(truth["stuck"][late].mean()))]
    rows += cycle(name, truth, v, since, "dither" in name)
    if len(slips) > 1:
        rows.append(Claim(f"{name}.slips", len(slips) / (SECONDS - since), "1/s"))
        rows.append(Claim(f"{name}.frequency", (len(slips) - 1) / float(slips[-1] - slips[0]), "Hz"))
    return [
        *rows,
        Claim(f"{name}.deviation", float(speed.std()) / v),
        Claim(f"{name}.averaged", float(smooth.std()) / v),
        Claim(f"{name}.peak", 1e3 * float(speed.max()), "mm/s"),
        Claim(f"{name}.ripple", 1e3 * float(np.ptp(speed)), "mm/s"),
        Claim(f"{name}.control", float(np.ptp(control)), "V"),
    ]


def cycle(name: str, run_: po.Trajectory, v: float, since: float, dithered: bool) -> list[Claim]:
    """The limit cycle in the speed, as `find_limit_cycle` sees it without knowing of sticking: amplitude 0 is none."""
    period = 1 / FREQUENCY if dithered else None
    found = po.find_limit_cycle(run_.t, run_["speed"], start=since, dither_period=period, min_amplitude=LEAST * v)
    if found is None:
        return [Claim(f"{name}.cycle", 0.0, "mm/s")]
    return [
        Claim(f"{name}.cycle", 1e3 * found.amplitude, "mm/s"),
        Claim(f"{name}.cycle_frequency", found.frequency, "Hz"),
        Claim(f"{name}.cycle_still", found.stick_share),
    ]


def figure(job: Job) -> "Figure":
    picture, grid = axes_grid(3, 2, (2.3, 2.3, 1.8), sharex="col")
    for column, v in enumerate(CRAWL):
        before, after, command = (rows[column] for rows in grid)
        hand = job.runs["hand", v].truth
        stuck = hand["stuck"] > 0
        before.fill_between(hand.t, 0, 1, where=stuck, transform=before.get_xaxis_transform(), color="0.93")
        before.plot(hand.t, 1e3 * hand["speed"], color=RED, lw=1.2, label="hand-tuned PI (grey: sticks)")
        dithered, pid = job.runs["dithered", v].truth, job.runs["pid", v].truth
        mean = averaged(dithered.t, dithered["speed"], 1 / FREQUENCY)
        whole = (dithered.t > 0.5 / FREQUENCY) & (dithered.t < SECONDS - 0.5 / FREQUENCY)
        after.plot(dithered.t, 1e3 * dithered["speed"], color=ORANGE, lw=0.7, alpha=0.5)
        after.plot(dithered.t[whole], 1e3 * mean[whole], color=ORANGE, lw=1.2, label="PID + dither (thick: averaged)")
        after.plot(pid.t, 1e3 * pid["speed"], color=BLUE, lw=1.2, label="PID retuned")
        for run_, colour in ((dithered, ORANGE), (pid, BLUE), (hand, RED)):
            command.plot(run_.t, run_["control"], color=colour, lw=0.7)
        before.set_title(f"{1e3 * v:g} mm/s")
        command.set(xlabel="time [s]", xlim=(0, SECONDS))
        _set_speeds(before, after, v)
    for axes, label in zip((rows[0] for rows in grid), ("speed [mm/s]", "speed [mm/s]", "valve [V]"), strict=True):
        axes.set_ylabel(label)
    legend_above(picture, grid[0][0], grid[1][0])
    return picture


def _set_speeds(before: "Axes", after: "Axes", v: float) -> None:
    """The set speed as a line, and one scale for both."""
    low, high = (f(before.get_ylim()[k], after.get_ylim()[k]) for k, f in enumerate((min, max)))
    for axes in (before, after):
        axes.axhline(1e3 * v, color=GREY, lw=0.8, ls="--")
        axes.set_ylim(low, high)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    done = run()
    sys.exit(finish(main(done), options, lambda: {"crawl": figure(done)}))
