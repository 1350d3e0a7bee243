"""A positioning axis from log to certificate: one excitation run, identified, a state feedback tuned, on the rig.

    python problems/demo/positioning.py [--json FILE] [--out DIR]

Of a 25 mm cylinder its data sheets are known, friction is a guess, and valve and load are not what the sheets say. A
plain position controller plays the moves that `excitation_run` plans for the guess (in a shell `pneuopt init --run`).
They are logged on a rig that has what no model here has: it truly sticks, its valve has .2 % of hysteresis, pressures
come late, with noise and in steps of 100 Pa, the position in steps of 10 um. From that one log friction, valve and load
are identified; on the smooth model of the fit a cascade with differential pressure and feedforward of motion and
friction is tuned for moves of 100 mm, there and back, and 20 mm.

No search sees the rig. What the rig is to keep is split in two before anything is tried: half of the tolerance of 1 mm
is asked of the model, half is left to what the model lacks. Rows fit.*: the estimates beside the true values. Rows
predicted.*: the certificate on the model, for half the tolerance. Rows achieved.*: the same gains on the event-accurate
rig, beside what was predicted: for the whole tolerance it is to settle no later, to overshoot by less than the
tolerance, and to stay within it, watched for a minute after the first move and for 10 s after the others;
achieved.apart is the largest distance between the two motions. It need not come to rest: beyond tuned.dead_band from
the end the gains open the valve, so that a piston that sticks there is pushed until it breaks away once more;
achieved.hunts, achieved.amplitude and achieved.period say how. The figure has the excitation run's controller on the
same moves of the rig, too; rows that begin with "before" are its.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.progress import ProgressLines

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SAMPLE, ENCODER = 1e-3, po.Encoder(1e-5, 1e-3)
TOLERANCE, ASKED = 1e-3, 0.5  # [m] that the rig is to keep, and the share of it that the search is asked for
SPAN = 5.0  # [V] of the command that opens the valve wholly
GUESS = {"friction.coulomb": 30.0, "friction.static": 30.0, "friction.stribeck_velocity": 0.01}
# What the rig truly has, those of valve and load as multiples of the data sheets, and how near the estimates shall be.
TRUTH = {
    "friction.coulomb": (22.0, 0.04),
    "friction.static": (35.0, 0.06),
    "friction.stribeck_velocity": (0.02, 0.2),
    "friction.viscous": (65.0, 0.05),
    "valve.dead_zone": (0.02, 0.25),
    "valve.conductance": (1.3, 0.1),
    "load.mass": (1.25, 0.03),
}
SHEETS = ("valve.conductance", "load.mass")
MOVES = [
    po.Move(way, speed=0.4, acceleration=4.0, jerk=100.0, initial=begin, dwell=0.5)
    for begin, way in ((0.05, 0.1), (0.15, -0.1), (0.09, 0.02))
]
START = {  # by hand
    "pid.Kp": 3.0,
    "pid.Ki": 0.0,
    "pid.lower": -5.0,
    "pid.upper": 5.0,
    "position_loop.Kp": 60.0,
    "motion_feedforward.speed": 2.0,
    "motion_feedforward.acceleration": 0.03,
    "friction_feedforward.level": 0.15,
    "friction_feedforward.smoothing": 5e-3,
    "pressure_feedback.gain": 1e-5,
    "pressure_feedback.time": 0.5,
}
RANGES = {
    "pid.Kp": (0.5, 5.0),
    "position_loop.Kp": (5.0, 120.0),
    "motion_feedforward.speed": (0.0, 4.0),
    "motion_feedforward.acceleration": (0.0, 0.1),
    "friction_feedforward.level": (0.0, 0.4),
    "pressure_feedback.gain": (0.0, 2e-5),
    "pressure_feedback.time": (0.02, 1.0),
}
# [m/s] over which the search's friction turns over: the tenth of a mm/s that the log asks for takes shorter steps, with
# a whole one the piston creeps out of the tolerance.
SMOOTHING = 3e-4
LIMITS = (po.OvershootDistance(ASKED * TOLERANCE), po.MaxSensitivity(2.0))
SEARCH = po.Racing(members=16, trials=100, polish=0)
STANDING = {0: 60.0, 1: 10.0, 2: 10.0}  # [s] for which each move is watched on the rig
BOUNDS = {
    "tuned.certified": ">= 1",
    "predicted.overshoot": f"<= {1e3 * ASKED * TOLERANCE:g}",
    "predicted.max_sensitivity": "<= 2",
    "achieved.overshoot": f"<= {1e3 * TOLERANCE:g}",
    "achieved.apart": f"<= {1e3 * (1 - ASKED) * TOLERANCE:g}",
    "achieved.error": f"<= {1e3 * TOLERANCE:g}",
}
METRICS = {"settling_time": ("SettlingTime", 1.0, "s"), "overshoot": ("OvershootDistance", 1e3, "mm")}
METRICS |= {"following_error": ("FollowingError", 1e3, "mm")}
SHOWN = {
    "before": (GREY, "-", "excitation run's controller, on the rig"),
    "predicted": (BLUE, "-", "predicted, on the identified model"),
    "achieved": (ORANGE, "--", "achieved, on the event-accurate rig"),
}


@dataclass(frozen=True, eq=False)
class Played:
    """The moves under one controller on one plant: metrics, a column a move, and each move's response."""

    metrics: "pd.DataFrame"
    responses: Sequence[po.Trajectory]


@dataclass(frozen=True, eq=False)
class Job:
    """What each step gave; `rests` says how the rig ends."""

    fit: po.IdentificationResult
    truth: Mapping[str, float]
    best: po.TuningResult
    played: Mapping[str, Played]
    rests: Sequence[po.RestCase]
    seconds: Mapping[str, float]


def data_sheets() -> tuple[po.PneumaticDrive, po.ParameterSet]:
    """The drive as its owner knows it."""
    drive, known = po.PneumaticDrive(friction=po.Stribeck()), po.catalog.s25()[1]
    own = known.select(n for n in drive.parameters if n in known)
    return drive, (drive.parameters | own).with_values(GUESS)


def true_values(known: po.ParameterSet) -> dict[str, float]:
    return {n: value * (known.value(n) if n in SHEETS else 1.0) for n, (value, _) in TRUTH.items()}


def controlled(system: po.System) -> po.ClosedLoop:
    """The state feedback: position and speed in a cascade, differential pressure, feedforwards."""
    parts = (po.MotionFeedforward(), po.FrictionFeedforward(), po.PressureFeedback())
    pid, outer = po.PID(SAMPLE, delay=1), po.PositionLoop()
    return po.ClosedLoop(system, pid, measured="position", outer=outer, sensor=ENCODER, compensators=parts)


def the_rig(loop: po.ClosedLoop) -> po.Rig:
    gauge = po.Sensor(lag=1e-3, noise=500.0, resolution=100.0)
    sensors = {"position": po.Sensor(resolution=1e-5), "pressure_a": gauge, "pressure_b": gauge}
    return po.Rig(loop, sensors, po.Actuator(hysteresis=0.02), ENCODER)


def sticking() -> po.System:
    return po.PneumaticDrive(friction=po.Karnopp(po.Stribeck())).system()


def record_run(run: po.ExcitationRun, truth: Mapping[str, float]) -> tuple[po.Experiment, po.Rig, po.ParameterSet]:
    """The excitation run's log, the rig under its controller, and the rig's values."""
    rig = the_rig(po.ClosedLoop(sticking(), po.PID(SAMPLE), measured="position"))
    p = on_the_rig(rig, run.parameters, truth)
    wanted = run.moves.trajectory(SAMPLE).select(["reference"])
    assert rig.loop is not None
    begin = rig.loop.initial(p, reference=float(wanted["reference"][0]))
    log = po.record(rig, wanted, p, seed=1, initial=begin).experiment
    own = log.select(["valve_voltage", "position", "pressure_a", "pressure_b"])
    return replace(own, noise={}), rig, p


def on_the_rig(rig: po.Rig, design: po.ParameterSet, truth: Mapping[str, float]) -> po.ParameterSet:
    """A design's controller on the true hardware."""
    assert rig.loop is not None
    full = rig.loop.parameters
    return full.with_values({n: design.value(n) for n in full if n in design} | dict(truth))


def run(search: po.Racing = SEARCH) -> Job:
    drive, known = data_sheets()
    truth = true_values(known)
    log, plain, plain_values = record_run(po.excitation_run(drive.system(), known), truth)
    began = time.process_time()
    fit = po.identify(drive.system(), [log], known.freed(*TRUTH), progress=ProgressLines("identify"))
    seconds, began = {"identify": time.process_time() - began}, time.process_time()
    loop = controlled(drive.system())
    best = tune(loop, fit.parameters, search)
    seconds["tune"] = time.process_time() - began
    rig = the_rig(controlled(sticking()))
    own = on_the_rig(rig, best.parameters, truth)
    played = {
        "before": play(plain, plain_values, TOLERANCE),
        "predicted": play(loop, best.parameters, ASKED * TOLERANCE),
        "achieved": play(rig, own, TOLERANCE),
    }
    rests = [c for k, t in STANDING.items() for c in po.check_rest(rig, MOVES[k], own, duration=t).cases]
    return Job(fit, truth, best, played, rests, seconds)


def tune(loop: po.ClosedLoop, fitted: po.ParameterSet, search: po.Racing) -> po.TuningResult:
    """The design that comes to half the tolerance first, on the smooth model."""
    values = {n: fitted.value(n) for n in loop.parameters if n in fitted} | START | {"friction.smoothing": SMOOTHING}
    given = loop.parameters.with_values(values).fixed("*").with_bounds(RANGES).freed(*RANGES)
    aim, progress = po.SettlingTime(po.Tolerance(ASKED * TOLERANCE)), ProgressLines("tune")
    return po.tune(loop, MOVES, given, minimise=aim, subject_to=LIMITS, method=search, plants={}, progress=progress)


def play(plant: po.ClosedLoop | po.Rig, values: po.ParameterSet, tolerance: float) -> Played:
    metrics = po.evaluate(plant, MOVES, values, band=po.Tolerance(tolerance))
    return Played(metrics, [po.respond(plant, move, values) for move in MOVES])


def main(job: Job) -> "pd.DataFrame":
    claims = [Claim(f"{n}.cpu_seconds", value, "s") for n, value in job.seconds.items()]
    for name, (_, within) in TRUTH.items():
        true, found = job.truth[name], job.fit.parameters[name]
        bound = f"{true:.6g} +- {within * true:.3g}"
        claims.append(Claim(f"fit.{name}", found.value, found.unit, true, bound))
    claims.append(Claim("tuned.certified", float(job.best.status.converged)))
    claims += [Claim(n, job.best.parameters.value(n), job.best.parameters[n].unit) for n in RANGES]
    gain = job.best.parameters.value("pid.Kp") * job.best.parameters.value("position_loop.Kp")
    claims.append(Claim("tuned.dead_band", 1e3 * SPAN * job.truth["valve.dead_zone"] / gain, "mm"))
    promised = {n: worst(job.played["predicted"], metric) for n, (metric, _, _) in METRICS.items()}
    for name, own in job.played.items():
        for row, (metric, scale, unit) in METRICS.items():
            reference = scale * promised[row] if name == "achieved" else None
            claims.append(Claim(f"{name}.{row}", scale * worst(own, metric), unit, reference))
    claims.append(Claim("predicted.max_sensitivity", worst(job.played["predicted"], "MaxSensitivity")))
    claims.append(Claim("achieved.apart", 1e3 * apart(job.played["predicted"], job.played["achieved"]), "mm"))
    hunting = [c for c in job.rests if c.slips]
    claims.append(Claim("achieved.hunts", len(hunting), f"of {len(job.rests)}"))
    claims.append(Claim("achieved.amplitude", 1e3 * max((c.amplitude for c in hunting), default=0.0), "mm"))
    claims.append(Claim("achieved.period", max((c.period for c in hunting), default=np.nan), "s"))
    claims.append(Claim("achieved.error", 1e3 * max(abs(c.error) for c in job.rests), "mm"))
    bounds = {"achieved.settling_time": f"<= {promised['settling_time']:.6g}", **BOUNDS}
    return frame([replace(c, bound=bounds.get(c.name, c.bound)) for c in claims])


def worst(own: Played, metric: str) -> float:
    """Over the moves; NaN where one never settles."""
    return float(np.max(own.metrics.loc[metric].to_numpy(dtype=float)))


def apart(one: Played, other: Played) -> float:
    """The largest distance between two plants' positions at the same instant, over the moves [m]."""
    pairs = zip(one.responses, other.responses, strict=True)
    return max(float(np.abs(np.interp(a.t, b.t, b["position"]) - a["position"]).max()) for a, b in pairs)


def figure(job: Job) -> "Figure":
    """Each move over time, and what is missing to its end, on the scale of the tolerance."""
    picture, (ways, errors) = axes_grid(2, len(MOVES), (2.2, 2.2), sharex="col")
    for way, error, move, k in zip(ways, errors, MOVES, range(len(MOVES)), strict=True):
        error.axhspan(-1e3 * TOLERANCE, 1e3 * TOLERANCE, color=GREY, alpha=0.15, lw=0, label="tolerance")
        for edge in (-1, 1):
            label = "half of it, asked of the model" if edge > 0 else None
            error.axhline(edge * 1e3 * ASKED * TOLERANCE, color=GREY, lw=0.8, ls=":", label=label)
        for name, (colour, style, label) in SHOWN.items():
            run = job.played[name].responses[k]
            way.plot(run.t, 1e3 * run["position"], color=colour, lw=1.3, ls=style, label=label)
            error.plot(run.t, 1e3 * (run["position"] - move.final), color=colour, lw=1.3, ls=style)
        way.set_title(f"{1e3 * move.initial:.0f} to {1e3 * move.final:.0f} mm in {move.duration:.2f} s", fontsize=9)
        error.set(ylim=(-2.5, 2.5), xlabel="time from the move's beginning [s]")
    ways[0].set(ylabel="position [mm]")
    errors[0].set(ylabel="position less end [mm]")
    legend_above(picture, ways[0], errors[0], columns=3)
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"positioning": figure(job)}))
