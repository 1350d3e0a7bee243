"""A force loop: how finely a piston that presses on a stop can be told its force, with and without dither.

    python problems/friction/force_loop.py [--json FILE] [--out DIR]

The drive of T32 with Stribeck friction, 40 N and 60 N at rest, presses on a stop of 1 kN/mm; a load cell there is fed
back once a millisecond, with a delay of one sample. The wanted force climbs from 200 N in four steps of 5 N, and back.
The piston moves by micrometres and sticks between two slips, so the event-accurate model decides.

A proportional controller of the valve, which integrates by itself, with the dead zone added back, is compared with the
same and a feedforward of each step that breaks the friction loose, the same and a dither, and all of them. The gains of
each are tuned by SciPy's differential evolution, with the same number of simulations, for the least error at the end of
a step, its ripple included: that is the resolution. Without dither it is the step itself: where the wanted force turns
round, the piston sticks. A feedforward of the step does not change that, nor does an integral: rows integral.*.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.optimize import differential_evolution

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

LEVELS = (200.0, 205.0, 210.0, 215.0, 220.0, 215.0, 210.0, 205.0, 200.0)  # [N]
DWELL, END = 0.3, 0.1  # [s] for which each is held, and of it what counts as its end
NEAR = 4.0  # [N] of a level within which the force has settled
SAMPLE_TIME, DEAD_ZONE = 1e-3, 0.15  # [s], [V]
SIMULATIONS, MEMBERS, SEED = 144, 4, 3  # of each search; members a gain
HARDWARE = {
    "cylinder.stroke": 0.3,
    "load.stiffness": 1e6,
    "load.rest_position": 0.2,
    "friction.coulomb": 40.0,
    "friction.static": 60.0,
    "friction.stribeck_velocity": 0.01,
    "friction.viscous": 80.0,
}
FIXED = {"pid.Ki": 0.0, "pid.Kd": 0.0, "pid.lower": -5.0, "pid.upper": 5.0, "dead_zone_inverse.width": DEAD_ZONE}
BASE = {"pid.Kp": (5e-4, 2e-2), "dead_zone_inverse.smoothing": (5e-4, 5e-2)}
PUSH = {"feedforward.gain": (1e-3, 0.2), "feedforward.time": (2e-3, 0.05)}
SHAKE = {"dither.amplitude": (0.05, 2.0), "dither.frequency": (40.0, 250.0)}
VARIANTS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "proportional": BASE,
    "feedforward": BASE | PUSH,
    "dither": BASE | SHAKE,
    "both": BASE | PUSH | SHAKE,
}
INTEGRAL = 0.05  # [V/(N s)] of rows integral.*
BOUNDS = {"dither.resolution": "<= 4", "dither.finer": ">= 1.5", "integral.resolution": ">= 4"}


@dataclass(frozen=True, eq=False)
class Job:
    """The gains and the run of each variant."""

    gains: Mapping[str, dict[str, float]]
    runs: Mapping[str, po.Trajectory]


def run(simulations: int = SIMULATIONS) -> Job:
    gains = {name: tuned(ranges, simulations) for name, ranges in VARIANTS.items()}
    gains["integral"] = gains["proportional"] | {"pid.Ki": INTEGRAL}
    return Job(gains, {name: follow(values) for name, values in gains.items()})


def tuned(ranges: Mapping[str, tuple[float, float]], simulations: int) -> dict[str, float]:
    """Gains of the finest resolution, searched in their logarithms."""
    box: Any = [tuple(np.log(bounds)) for bounds in ranges.values()]
    cost = partial(_cost, list(ranges))
    rounds = simulations // (MEMBERS * len(box)) - 1
    found = differential_evolution(cost, box, maxiter=rounds, popsize=MEMBERS, rng=SEED, polish=False, tol=0.0)
    return dict(zip(ranges, np.exp(found.x).tolist(), strict=True))


def _cost(order: list[str], point: Any) -> float:
    return resolution(follow(dict(zip(order, np.exp(point).tolist(), strict=True))))


def follow(gains: Mapping[str, float]) -> po.Trajectory:
    """The levels, one after the other, on the model that sticks."""
    base, given = po.catalog.t32()
    friction = po.Karnopp(po.Stribeck())
    drive = po.PneumaticDrive(base.valve, friction, po.Load(spring=True), base.chamber, base.cylinder)
    loop = po.ClosedLoop(
        drive.system(),
        po.PID(SAMPLE_TIME, delay=1),
        po.Dither() if "dither.amplitude" in gains else None,
        measured="load_force",
        feedforward=po.Feedforward() if "feedforward.gain" in gains else None,
        compensators=(po.DeadZoneInverse(),),
    )
    own = {n: given.value(n) for n in drive.parameters if n in given}
    p = loop.parameters.with_values({**own, **HARDWARE, **FIXED, **gains})
    wanted = np.append(np.repeat(LEVELS, samples(DWELL)), LEVELS[-1])
    inputs = po.Trajectory(SAMPLE_TIME * np.arange(len(wanted)), {"reference": wanted})
    start = loop.initial(p, reference=LEVELS[0])
    return po.simulate_stick_slip(loop, inputs, p, initial=start, rtol=1e-7, atol=1e-9).trajectory


def samples(duration: float) -> int:
    return round(duration / SAMPLE_TIME)


def errors(run: po.Trajectory) -> np.ndarray:
    """The force less its level [N], a row a level after the first."""
    force = run["load_force"][:-1].reshape(len(LEVELS), -1)
    return np.asarray(force[1:] - np.array(LEVELS[1:])[:, None])


def resolution(run: po.Trajectory) -> float:
    """The largest error at the end of a level, its ripple included [N]."""
    return float(np.abs(errors(run)[:, -samples(END) :]).max())


def settling(run: po.Trajectory) -> float:
    """The longest time after which the force stays within 4 N of its level [s]; NaN where it never does."""
    outside = np.abs(errors(run)) > NEAR
    last = [int(np.flatnonzero(row)[-1]) + 1 if row.any() else 0 for row in outside]
    return max(last) * SAMPLE_TIME if max(last) < samples(DWELL) else np.nan


def main(job: Job) -> "DataFrame":
    fine = {name: resolution(found) for name, found in job.runs.items()}
    claims = []
    for name, found in job.runs.items():
        claims += [Claim(f"{name}.resolution", fine[name], "N"), Claim(f"{name}.settling", settling(found), "s")]
        claims += [Claim(f"{name}.{n}", value) for n, value in job.gains[name].items() if name != "integral"]
    claims += [Claim(f"{name}.finer", fine["proportional"] / fine[name], "times") for name in ("feedforward", "dither")]
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def figure(job: Job) -> "Figure":
    picture, ((force,), (command,)) = axes_grid(2, 1, (2.6, 1.4), sharex=True)
    shown = {"proportional": (ORANGE, "proportional"), "integral": (GREY, "with an integral")}
    shown |= {"feedforward": (RED, "with feedforward"), "dither": (BLUE, "with dither")}
    for name, (colour, label) in shown.items():
        run = job.runs[name]
        force.plot(run.t, run["load_force"], color=colour, lw=1.0, label=label)
        if name != "dither":
            command.plot(run.t, run["control"], color=colour, lw=0.8)
    t = SAMPLE_TIME * np.arange(len(LEVELS) * samples(DWELL))
    force.plot(t, np.repeat(LEVELS, samples(DWELL)), color="k", lw=0.8, ls="--", label="wanted")
    force.set(ylabel="force [N]", ylim=(196.0, 226.0))
    command.set(xlabel="time [s]", ylabel="valve [V],\nthose without dither")
    legend_above(picture, force, columns=5)
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"force_loop": figure(job)}))
