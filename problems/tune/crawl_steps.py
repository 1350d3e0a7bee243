"""Speed steps in the falling part of the Stribeck curve: tuned by defaults and certified, drive by drive.

    python problems/tune/crawl_steps.py [--drives NAME ...] [--ratios R ...] [--json FILE] [--out DIR]

There friction falls with speed, so the drive alone runs away from a constant command and its gain at rest is negative,
while the gains that hold it are positive. Each drive (force, rotary, pneumatic: R25 behind a spool of 100 Hz) goes from
rest to .3, .7, 1 and 2 times its Stribeck velocity, under a PID that samples every millisecond, tuned for the least
settling time within an overshoot and Ms. Friction is Stribeck's curve, LuGre's, and in rows *.karnopp.* a design for
Stribeck's curve that is also run on the event-accurate model that sticks (`rig=`).

Rows *.certified: 1 where the design is certified. Rows *.settling and *.seconds: its settling time, and the CPU time of
the tuning. Rows *.count: designs certified of each friction law. Row sign_refusals.count: tunings refused before the
search, of which there may be none. What is not certified is printed with the program's own words.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.r25 import CLIP, lagging

if TYPE_CHECKING:
    import pandas as pd

RATIOS = (0.3, 0.7, 1.0, 2.0)  # speed wanted, of the Stribeck velocity
SAMPLE = 1e-3  # [s]
MOST_SECONDS = 60.0  # [s] of CPU time of a tuning
LAWS = ("stribeck", "lugre", "karnopp")
FRICTIONS: Mapping[str, po.Stribeck | po.LuGre | po.Karnopp] = {
    "stribeck": po.Stribeck(),
    "lugre": po.LuGre(),
    "karnopp": po.Karnopp(po.Stribeck()),
}


@dataclass(frozen=True)
class Drive:
    """Hardware, Stribeck velocity, gains' ranges and start, horizon, settling band and largest sensitivity of a drive.

    SI units; the Stribeck velocity in m/s or rad/s.
    """

    hardware: Mapping[str, float]
    stribeck: float
    ranges: Mapping[str, tuple[float, float]]
    start: Mapping[str, float]
    horizon: float
    band: float
    sensitivity: float


DRIVES = {
    "force": Drive(
        {"load.mass": 5.0, "friction.coulomb": 25.0, "friction.static": 45.0, "friction.viscous": 30.0},
        0.02,
        {"pid.Kp": (50.0, 5000.0), "pid.Ki": (100.0, 1e5)},
        {"pid.Kp": 1500.0, "pid.Ki": 2e4, "pid.lower": -300.0, "pid.upper": 300.0},
        0.8,
        0.02,
        1.6,
    ),
    "rotary": Drive(
        {
            "load.inertia": 2e-3,
            "friction.coulomb": 0.1,
            "friction.static": 0.18,
            "friction.viscous": 2e-3,
            "friction.smoothing": 0.01,
        },
        0.5,
        {"pid.Kp": (0.02, 2.0), "pid.Ki": (0.05, 40.0)},
        {"pid.Kp": 0.4, "pid.Ki": 4.0, "pid.lower": -2.0, "pid.upper": 2.0},
        0.8,
        0.02,
        1.6,
    ),
    "pneumatic": Drive(
        {},
        0.02,
        {"pid.Kp": (1.0, 10.0), "pid.Ki": (5.0, 60.0), "pid.Kd": (0.0, 2.0), "pid.Tf": (0.001, 0.01)},
        {"pid.Kp": 4.5, "pid.Ki": 24.6, "pid.Kd": 0.6, "pid.Tf": 0.002, "pid.lower": -CLIP, "pid.upper": CLIP},
        1.5,
        0.1,
        2.5,
    ),
}


@dataclass(frozen=True, eq=False)
class Tuning:
    """One tuning: its result, or the words with which it was refused, and its CPU time [s]."""

    result: po.TuningResult | None
    words: str
    seconds: float

    @property
    def is_certified(self) -> bool:
        """Whether a design was certified."""
        return self.result is not None and self.result.status.converged

    @property
    def settling_time(self) -> float:
        """[s]; NaN without a certified design."""
        if self.result is None or not self.is_certified:
            return float("nan")
        return float(self.result.certified.loc["SettlingTime"].to_numpy(dtype=float).max())


Runs = Mapping[tuple[str, str, float], Tuning]


def run(drives: Sequence[str] = tuple(DRIVES), ratios: Sequence[float] = RATIOS) -> Runs:
    """Every tuning, by drive, friction law and speed over the Stribeck velocity."""
    return {(name, law, ratio): tuned(name, law, ratio) for name in drives for law in LAWS for ratio in ratios}


def tuned(name: str, law: str, ratio: float) -> Tuning:
    """Tune one step by defaults."""
    drive, began = DRIVES[name], time.process_time()
    loop, given = controlled(name, "stribeck" if law == "karnopp" else law)
    limits = [po.Overshoot(0.2), po.MaxSensitivity(drive.sensitivity)]
    step, aim = po.Step(ratio * drive.stribeck, horizon=drive.horizon), po.SettlingTime(drive.band)
    rig = po.Rig(controlled(name, law)[0], {"speed": po.Sensor()}) if law == "karnopp" else None
    try:
        best = po.tune(loop, step, given, minimise=aim, subject_to=limits, plants={}, rig=rig, throw=False)
    except po.InputError as error:
        return Tuning(None, str(error), time.process_time() - began)
    return Tuning(best, best.status.message, time.process_time() - began)


def controlled(name: str, law: str) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The sampled loop of a drive, and its parameters with the gains free."""
    drive, friction, hardware = DRIVES[name], FRICTIONS[law], dict(DRIVES[name].hardware)
    if name == "pneumatic":
        pneumatic, p = lagging(friction)
        plant, own = pneumatic.system(), {n: p.value(n) for n in p}
    else:
        plant = (po.ForceDrive if name == "force" else po.RotaryDrive)(friction).system()
        own = hardware | {"friction.stribeck_velocity": drive.stribeck}
    loop = po.ClosedLoop(plant, po.PID(sample_time=SAMPLE), measured="speed")
    values = {n: v for n, v in {**own, **drive.start}.items() if n in loop.parameters}
    return loop, loop.parameters.fixed("*").with_values(values).with_bounds(drive.ranges).freed(*drive.ranges)


def main(runs: Runs) -> "pd.DataFrame":
    claims = []
    for (name, law, ratio), found in runs.items():
        row, within = f"{name}.{law}.{ratio:g}", f"<= {DRIVES[name].horizon:g}"
        claims.append(Claim(f"{row}.certified", int(found.is_certified), "1", None, ">= 1"))
        claims.append(Claim(f"{row}.settling", found.settling_time, "s", None, within))
        claims.append(Claim(f"{row}.seconds", found.seconds, "s", None, f"<= {MOST_SECONDS:g}"))
    for law in LAWS:
        own = [found.is_certified for (_, other, _), found in runs.items() if other == law]
        claims.append(Claim(f"{law}.count", sum(own), "1", float(len(own)), f">= {len(own)}"))
    refused = [found for found in runs.values() if found.result is None]
    return frame([*claims, Claim("sign_refusals.count", len(refused), "1", None, "<= 0")])


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--drives", nargs="+", choices=tuple(DRIVES), default=tuple(DRIVES), metavar="NAME")
    parser.add_argument("--ratios", nargs="+", type=float, default=RATIOS, metavar="R")
    options = parser.parse_args()
    runs = run(options.drives, options.ratios)
    for key, found in runs.items():
        if not found.is_certified:
            print(*key, found.words, sep="  ")
    sys.exit(finish(main(runs), options))
