"""Hunting: every PID on a position hunts where static friction exceeds Coulomb's and falls at once; what cures it.

    python problems/friction/hunting.py [--json FILE] [--out DIR]

B. Armstrong and B. Amin, PID control in the presence of static friction, Automatica 32(5), 1996, 679-692: under PID
control of a position no gains that stabilise the loop come to rest where static friction exceeds Coulomb's; where it
does not, they do. Here 30 random PIDs, whose poles are placed, move a body of 5 kg with 30 N of Coulomb friction by
100 mm, on the event-accurate model, watched for 60 s, and for an hour where that does not decide, because the integral
still pushes a stuck body or the hunting is slow.

Rows coulomb.*: no static friction beyond Coulomb's; what error is left fades as the integral takes it up. Rows
static.*: 1.5 times, gone within 1 mm/s. Rows gentle.*: the same 1.5 times, but falling so gently, over .2 m/s, that
viscous friction covers it: the statement is about the fall, and not about the two levels. Rows dead_band.*: the PIDs of
static.* whose integral has a dead band as wide as the largest error of their hunting: they rest, and leave an error.
Rows without_integral.*: likewise, with Ki = 0. Rows reset_*: five of the PIDs, those that 5 ms sample fast enough, on
each of the three frictions, with an integral that is reset where the error turns its sign: none breaks away once more
in the second half of a minute. On a static friction that falls at once it is still pushed then, some tenths of a
millimetre from the reference, and will slip again after minutes.
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

COUNT, SEED = 30, 1996
MINUTE, HOUR = 60.0, 3600.0  # [s]
STEP = po.Step(0.1)  # [m]
BODY = {"load.mass": 5.0, "friction.coulomb": 30.0, "friction.viscous": 70.0}
FRICTIONS: Mapping[str, dict[str, float]] = {
    "coulomb": {"friction.static": 30.0},
    "static": {"friction.static": 45.0, "friction.stribeck_velocity": 1e-3},
    "gentle": {"friction.static": 45.0, "friction.stribeck_velocity": 0.2},
}
SPEEDS, DAMPINGS, SHARES = (5.0, 40.0), (0.5, 1.2), (0.1, 1.0)  # [rad/s], of the pair, third pole over its speed
# [s] of the PIDs with a reset, which is decided once a sample: the first of those whose filter is as slow; the share of
# the integral that a reset keeps.
SAMPLE_TIME, RESET_COUNT, RESET_RATIO = 5e-3, 5, 0.5
SHOWN = 4  # which PID is drawn: one that hunts some ten times a minute
BOUNDS = {
    "coulomb.hunting": "<= 0", "coulomb.largest_error": "<= 0.1", "static.hunting": ">= 30", "gentle.hunting": "<= 0",
    "gentle.largest_error": "<= 0.1", "dead_band.resting": ">= 30", "without_integral.resting": ">= 30",
    "reset_coulomb.slips": "<= 0", "reset_static.slips": "<= 0", "reset_gentle.slips": "<= 0",
    "reset_coulomb.largest_error": "<= 1", "reset_static.largest_error": "<= 1", "reset_gentle.largest_error": "<= 1",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Job:
    """How each PID ends, by the row's name."""

    found: Mapping[str, list[po.RestCase]]
    gains: list[dict[str, float]]


def run(count: int = COUNT) -> Job:
    gains = list(random_pids(count))
    found = {name: [watch(g | friction) for g in gains] for name, friction in FRICTIONS.items()}
    static = FRICTIONS["static"]
    bands = [{"pid.dead_band": 1.01 * end.error} for end in found["static"]]
    found["dead_band"] = [watch(g | static | band) for g, band in zip(gains, bands, strict=True)]
    found["without_integral"] = [watch(g | static | {"pid.Ki": 0.0}) for g in gains]
    slow = [g for g in gains if g["pid.Tf"] >= SAMPLE_TIME][:RESET_COUNT]
    found |= {f"reset_{name}": [watch_reset(g | friction) for g in slow] for name, friction in FRICTIONS.items()}
    return Job(found, gains)


def random_pids(count: int) -> Iterator[dict[str, float]]:
    """Gains that place a pair of poles and a third one; the derivative's filter is 20 times faster."""
    rng, mass, viscous = np.random.default_rng(SEED), BODY["load.mass"], BODY["friction.viscous"]
    for _ in range(count):
        w, share = (float(np.exp(rng.uniform(*np.log(bounds)))) for bounds in (SPEEDS, SHARES))
        d = float(rng.uniform(*DAMPINGS))
        Kp, Ki, Kd = mass * w**2 * (1 + 2 * d * share), mass * share * w**3, mass * w * (2 * d + share) - viscous
        Kd, Tf = max(0.0, Kd), 0.05 / w
        poles = np.roots([Tf * mass, mass + Tf * viscous, viscous + Kd + Tf * Kp, Kp + Tf * Ki, Ki])
        assert poles.real.max() < 0
        yield {"pid.Kp": Kp, "pid.Ki": Ki, "pid.Kd": Kd, "pid.Tf": Tf}


def axis(pid: po.PID | None = None) -> po.ClosedLoop:
    drive = po.ForceDrive(po.Karnopp(po.Stribeck()))
    return po.ClosedLoop(drive.system(), pid or po.PID(limits=False, dead_band=True), measured="position")


def watch(values: Mapping[str, float]) -> po.RestCase:
    """A minute, and an hour where the integral still pushes a stuck body then."""
    loop = axis()
    p = loop.parameters.with_values({**BODY, **values})
    (end,) = po.check_rest(loop, STEP, p, duration=MINUTE).cases
    if end.kind in (po.RestKind.PUSHED, po.RestKind.UNDECIDED):
        (end,) = po.check_rest(loop, STEP, p, duration=HOUR).cases
    return end


def watch_reset(values: Mapping[str, float]) -> po.RestCase:
    """A minute with an integral that is reset."""
    loop = axis(po.PID(SAMPLE_TIME, limits=False, reset=True))
    p = loop.parameters.with_values({**BODY, **values, "pid.reset_ratio": RESET_RATIO})
    return po.check_rest(loop, STEP, p, duration=MINUTE).cases[0]


def main(job: Job) -> "DataFrame":
    claims = []
    for name, ends in job.found.items():
        hunting = [end for end in ends if end.kind is po.RestKind.HUNTS]
        claims.append(Claim(f"{name}.hunting", len(hunting), f"of {len(ends)}"))
        claims.append(Claim(f"{name}.resting", sum(end.kind is po.RestKind.RESTS for end in ends), f"of {len(ends)}"))
        if name.startswith("reset_"):
            claims.append(Claim(f"{name}.slips", sum(end.slips for end in ends)))
        claims.append(Claim(f"{name}.largest_error", 1e3 * max(abs(end.error) for end in ends), "mm"))
        if hunting:
            periods = [end.period for end in hunting]
            claims += [Claim(f"{name}.{n}_period", f(periods), "s") for n, f in (("shortest", min), ("longest", max))]
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def figure(job: Job) -> "Figure":
    picture, ((error,), (command,)) = axes_grid(2, 1, (2.2, 1.6), sharex=True)
    loop, gains = axis(), job.gains[min(SHOWN, len(job.gains) - 1)]
    band = 1.01 * job.found["static"][min(SHOWN, len(job.gains) - 1)].error
    shown = {
        "static friction 1.5 times Coulomb's, gone within 1 mm/s": (RED, FRICTIONS["static"]),
        "the same, integral with a dead band": (BLUE, FRICTIONS["static"] | {"pid.dead_band": band}),
        "falling over 0.2 m/s": (ORANGE, FRICTIONS["gentle"]),
        "Coulomb's alone": (GREY, FRICTIONS["coulomb"]),
    }
    inputs = po.Trajectory([0.0, MINUTE], {"reference": [STEP.size, STEP.size]})
    for label, (colour, values) in shown.items():
        p = loop.parameters.with_values({**BODY, **gains, **values})
        found = po.simulate(loop, inputs, p, t_out=np.linspace(0.0, MINUTE, 12001), rtol=1e-8)
        error.plot(found.t, 1e3 * (found["position"] - STEP.size), color=colour, lw=1.1, label=label)
        command.plot(found.t, found["control"], color=colour, lw=1.0)
    reach = 2e3 * job.found["static"][min(SHOWN, len(job.gains) - 1)].error
    error.set(ylabel="error [mm]", ylim=(-reach, reach))
    command.set(xlabel="time [s]", ylabel="force [N]", ylim=(-60.0, 60.0))
    legend_above(picture, error, columns=2)
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"hunting": figure(job)}))
