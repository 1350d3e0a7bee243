"""Fixed gains against scheduled ones, in a map: what a schedule over position and load brings a soft pneumatic axis.

    python problems/tune/gain_schedule.py [--json FILE] [--out DIR]

A 40 mm cylinder of 500 mm (catalogue set) carries 5 to 20 kg: its air spring swings with 2.5 Hz under the heavy load in
the middle of the stroke, with 7 Hz under the light one near its ends. A cascade with feedback of the differential
pressure and feedforward moves it by 100 mm, near an end and in the middle, to +-1 mm; friction is viscous, the question
being that of the spring. Both designs are tuned jointly over three loads and two places for the worst time, with an
overshoot of 1 mm and Ms of 2 at most: once with the same gains for all, once with a `GainSchedule` of the cascade's two
gains and the pressure's. Both begin from the same search of fixed gains and get as many trials as that one had. What
is gained is little, and even over the loads: the fixed gains are slow with the light load, so that the heavy one keeps
Ms. A load that the controller is told wrong by a fifth costs more than that.

Rows fixed.*, scheduled.*: the certified designs, the worst over what they were tuned for. Rows fixed.map.*,
scheduled.map.*: three places and five loads, some between those of the tuning; kept: how many of the 15 cells settle
within the limits. Rows told.*: the scheduled design where the load that the controller is told is wrong by a fifth.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.plotting import axes_grid
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.progress import ProgressLines

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

WAY, TOLERANCE, SENSITIVITY = 0.1, 1e-3, 2.0  # [m], [m], [1]
PLACES, LOADS = (0.1, 0.25), (5.0, 10.0, 20.0)  # [m] middle of each move, [kg]; the nominal load is the middle one
MAP_PLACES, MAP_LOADS = np.array([0.1, 0.175, 0.25]), np.geomspace(5.0, 20.0, 5)
WRONG = 0.2  # share by which the load is told wrong
AIM = po.SettlingTime(po.Tolerance(TOLERANCE))
LIMITS = (po.OvershootDistance(TOLERANCE), po.MaxSensitivity(SENSITIVITY))
HAND = {
    "pid.Kp": 2.0,
    "pid.Ki": 0.0,
    "pid.lower": -5.0,
    "pid.upper": 5.0,
    "position_loop.Kp": 12.0,
    "motion_feedforward.speed": 0.5,
    "motion_feedforward.acceleration": 0.1,
    "pressure_feedback.gain": 1e-5,
    "pressure_feedback.time": 0.15,
}
RANGES = {
    "pid.Kp": (0.1, 10.0),
    "position_loop.Kp": (1.0, 40.0),
    "motion_feedforward.speed": (0.0, 4.0),
    "motion_feedforward.acceleration": (0.0, 0.3),
    "pressure_feedback.gain": (0.0, 3e-5),
    "pressure_feedback.time": (0.02, 1.0),
}
SCHEDULED = ("pid.Kp", "position_loop.Kp", "pressure_feedback.gain")
COEFFICIENTS = {
    f"schedule.{gain.removeprefix('pid.').replace('.', '_')}_{term}": bounds
    for gain in SCHEDULED
    for term, bounds in (("curve", (-1.0, 1.0)), ("load", (-1.0, 1.0)))  # the spring is nearly symmetric: no slope
}
TRIALS, SEARCH = 2400, po.Racing(members=24, polish=0)  # trials of each search, whatever the number of its gains
BOUNDS = {
    "fixed.certified": ">= 1",
    "scheduled.certified": ">= 1",
    "scheduled.worst_time.share": "<= 1",
    "fixed.map.kept": ">= 12",
    "scheduled.map.kept": ">= 12",
    "told.max_sensitivity": "<= 2.4",
}


@dataclass(frozen=True, eq=False)
class Job:
    """The two designs, their metrics over the map (metric, place, load), and where the load is told wrong."""

    designs: Mapping[str, po.TuningResult]
    maps: Mapping[str, Mapping[str, Array]]
    told: "pd.DataFrame"
    seconds: Mapping[str, float]


def axis(*, scheduled: bool) -> po.ClosedLoop:
    base = po.catalog.s40()[0]
    drive = po.PneumaticDrive(base.valve, po.Viscous(), base.load, base.chamber, base.cylinder)
    return po.ClosedLoop(
        drive.system(),
        po.PID(1e-3, delay=1),
        measured="position",
        outer=po.PositionLoop(),
        sensor=po.Encoder(1e-5, 2e-3),
        compensators=(po.MotionFeedforward(), po.PressureFeedback()),
        schedule=po.GainSchedule(SCHEDULED, 0.0, 0.5, load=LOADS[1]) if scheduled else None,
    )


def move(place: float) -> po.Move:
    """By 100 mm about a place, inwards from beyond the middle."""
    way = WAY if place <= PLACES[1] else -WAY
    return po.Move(way, speed=0.5, acceleration=4.0, jerk=100.0, initial=place - way / 2, dwell=1.0)


def loads(masses: Mapping[str, float], *, scheduled: bool) -> dict[str, dict[str, float]]:
    """A scenario a load, which the controller of a schedule is told."""
    return {label: {"load.mass": m, **({"schedule.load": m} if scheduled else {})} for label, m in masses.items()}


def run(trials: int = TRIALS) -> Job:
    hardware, fixed = po.catalog.s40()[1], axis(scheduled=False)
    known = fixed.complete(hardware.select(n for n in hardware if n in fixed.parameters)).fixed("*")
    given = known.with_values({"load.mass": LOADS[1], **HAND}).with_bounds(RANGES).freed(*RANGES)
    first = tune("first", given, trials).parameters
    starts = {"fixed": first, "scheduled": axis(scheduled=True).complete(first)}
    starts["scheduled"] = starts["scheduled"].with_bounds(COEFFICIENTS).freed(*COEFFICIENTS)
    designs, seconds = {}, {}
    for name, start in starts.items():
        began = time.process_time()
        designs[name] = tune(name, start, trials)
        seconds[name] = time.process_time() - began
    maps = {name: evaluate_map(name, found.parameters) for name, found in designs.items()}
    return Job(designs, maps, tell_wrong(designs["scheduled"].parameters), seconds)


def tune(name: str, given: po.ParameterSet, trials: int) -> po.TuningResult:
    """A design for every place and load."""
    scheduled = name == "scheduled"
    others = loads({"light": LOADS[0], "heavy": LOADS[2]}, scheduled=scheduled)
    return po.tune(
        axis(scheduled=scheduled),
        [move(place) for place in PLACES],
        given,
        minimise=AIM,
        subject_to=LIMITS,
        scenarios=others,
        method=replace(SEARCH, trials=trials // len(given.free_names)),
        plants={},
        throw=False,
        progress=ProgressLines(name),
    )


def evaluate_map(name: str, design: po.ParameterSet) -> dict[str, Array]:
    """Certified metrics, shape (places, loads) each."""
    scheduled = name == "scheduled"
    plants = loads({f"{m:.3g} kg": m for m in MAP_LOADS}, scheduled=scheduled)
    moves = [move(place) for place in MAP_PLACES]
    found = po.evaluate(axis(scheduled=scheduled), moves, design, scenarios=plants, band=po.Tolerance(TOLERANCE))
    order = [[f"{m.label} [{label}]" for label in plants] for m in moves]
    metrics = ("SettlingTime", "OvershootDistance", "MaxSensitivity")
    return {n: np.array([[found.loc[n, label] for label in row] for row in order], dtype=float) for n in metrics}


def tell_wrong(design: po.ParameterSet) -> "pd.DataFrame":
    """The scheduled design where it is told a fifth less or more than the load."""
    plants = {
        f"{m:g} kg, told {share:g} of it": {"load.mass": m, "schedule.load": share * m}
        for m in LOADS
        for share in (1 - WRONG, 1 + WRONG)
    }
    moves = [move(place) for place in PLACES]
    found = po.evaluate(axis(scheduled=True), moves, design, scenarios=plants, band=po.Tolerance(TOLERANCE))
    return found[[c for c in found if "told" in str(c)]]


def main(job: Job) -> "pd.DataFrame":
    claims = []
    for name, found in job.designs.items():
        certified, own = found.certified, job.maps[name]
        claims.append(Claim(f"{name}.certified", float(found.status.converged)))
        claims.append(Claim(f"{name}.cpu_seconds", job.seconds[name], "s"))
        claims.append(Claim(f"{name}.simulations", found.stats["simulations"]))
        claims += rows(name, certified)
        claims += [Claim(f"{name}.{n}", found.parameters.value(n)) for n in RANGES]
        claims.append(Claim(f"{name}.map.kept", int(kept(own).sum()), f"of {own['SettlingTime'].size}"))
        claims.append(Claim(f"{name}.map.worst_time", float(np.max(settled(own))), "s"))
        claims.append(Claim(f"{name}.map.median_time", float(np.median(settled(own))), "s"))
        claims.append(Claim(f"{name}.map.max_sensitivity", float(np.max(own["MaxSensitivity"]))))
    claims += [Claim(n, job.designs["scheduled"].parameters.value(n)) for n in COEFFICIENTS]
    times = {name: worst(found.certified, "SettlingTime") for name, found in job.designs.items()}
    claims.append(Claim("scheduled.worst_time.share", times["scheduled"] / times["fixed"]))
    sooner = settled(job.maps["scheduled"]) < settled(job.maps["fixed"])
    claims.append(Claim("scheduled.map.sooner", int(sooner.sum()), f"of {sooner.size}"))
    claims += rows("told", job.told)
    return frame([replace(c, bound=BOUNDS.get(c.name, c.bound)) for c in claims])


def rows(name: str, found: "pd.DataFrame") -> list[Claim]:
    """The worst of a table over its cases."""
    return [
        Claim(f"{name}.worst_time", worst(found, "SettlingTime"), "s"),
        Claim(f"{name}.overshoot", 1e3 * worst(found, "OvershootDistance"), "mm"),
        Claim(f"{name}.max_sensitivity", worst(found, "MaxSensitivity")),
    ]


def worst(found: "pd.DataFrame", metric: str) -> float:
    """Over the cases; NaN where one never settles."""
    return float(np.max(found.loc[metric].to_numpy(dtype=float)))


def settled(own: Mapping[str, Array]) -> Array:
    """Settling times of a map [s]; infinite where a move never settles."""
    return np.nan_to_num(own["SettlingTime"], nan=np.inf)


def kept(own: Mapping[str, Array]) -> Array:
    """Which cells of a map settle within the limits."""
    within = (own["OvershootDistance"] <= TOLERANCE) * (own["MaxSensitivity"] <= SENSITIVITY)
    return np.isfinite(own["SettlingTime"]) * within


def figure(job: Job) -> "Figure":
    """Settling time over place and load, both designs on one scale; a cross where a limit is broken."""
    picture, (panels,) = axes_grid(1, len(job.maps), (3.2,), width=8.0)
    times = {name: own["SettlingTime"] for name, own in job.maps.items()}
    low, top = (float(extreme(list(times.values()))) for extreme in (np.nanmin, np.nanmax))
    for panel, (name, own) in zip(panels, job.maps.items(), strict=True):
        shown = panel.imshow(times[name].T, origin="lower", cmap="viridis_r", vmin=low, vmax=top, aspect="auto")
        for (i, j), seconds in np.ndenumerate(times[name]):
            mark = "" if kept(own)[i, j] else " x"
            colour = "w" if seconds > (low + top) / 2 else "k"
            panel.text(i, j, f"{seconds:.2f}{mark}", ha="center", va="center", color=colour, fontsize=9)
        panel.grid(visible=False)
        panel.set_xticks(range(len(MAP_PLACES)), [f"{1e3 * x:.0f}" for x in MAP_PLACES])
        panel.set_yticks(range(len(MAP_LOADS)), [f"{m:.3g}" for m in MAP_LOADS])
        panel.set(xlabel="middle of the move [mm]")
        panel.set_title(f"{name} gains", fontsize=10)
    panels[0].set(ylabel="load [kg]")
    picture.colorbar(shown, ax=panels, label="time to $\\pm$1 mm [s]; x: breaks a limit")
    return picture


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    job = run()
    sys.exit(finish(main(job), options, lambda: {"gain_schedule": figure(job)}))
