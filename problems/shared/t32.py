"""The tuning benchmark T32s: the drive, its step, the gains that are free, the plants and what is asked for.

A 32 mm cylinder with LuGre friction and a valve with a dead zone steps from rest to 0.2 m/s under a continuous PID and
a dither of 1000 rad/s. With five gains Kp, Ki, Kd, the dither's amplitude and its offset are free; with ten also the
derivative's filter Tf, the set-point weights b and c, and the transient feedforward's gain and time.

What is minimised is the settling time to 2 %, with overshoot up to 5 %, Ms up to 2 at every operating point that the
step passes, and a certificate that follows the response beyond the horizon. Without the last two conditions
the best designs of the nominal plant are unstable loops.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import pi
from typing import Any

import pneuopt as po

STEP = po.Step(0.2, horizon=1.0, start={"position": 0.05, "pressure_b": 3.5e5})
VALUES = {"pid.Kp": 10.0, "pid.Ki": 40.0, "pid.Tf": 0.01, "pid.Tt": 0.1, "pid.lower": -5.0, "pid.upper": 5.0}
RANGES = {
    "pid.Kp": (0.2, 60.0),
    "pid.Ki": (0.5, 400.0),
    "pid.Kd": (0.0, 0.5),
    "dither.amplitude": (0.0, 3.0),
    "dither.offset": (-1.5, 1.5),
}
MORE = {"pid.Tf": (5e-4, 0.05), "pid.b": (0.0, 1.5), "pid.c": (0.0, 1.5)}
MORE |= {"feedforward.gain": (-20.0, 40.0), "feedforward.time": (2e-3, 0.2)}
FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
SPREADS: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, FRICTION: 0.3, "supply.pressure": 0.1}
DRAWN = 32
MINIMISE, OVERSHOOT, SENSITIVITY = po.SettlingTime(band=0.02, mean=True), po.Overshoot(0.05), po.MaxSensitivity(2.0)

Scenarios = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Row:
    """A row of the benchmark: how many gains are free, and for which plants beside the nominal one."""

    gains: int
    scenarios: Callable[[po.ParameterSet], Scenarios]


ROWS = {
    "5_nominal": Row(5, lambda _: {}),
    "5_corners": Row(5, lambda given: po.corners(given, SPREADS)),
    "10_corners": Row(10, lambda given: po.corners(given, SPREADS)),
    "10_plants": Row(10, lambda given: po.samples(given, SPREADS, DRAWN)),
}


def benchmark(gains: int = 5) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The loop and its parameters, with five gains free, or ten."""
    drive, hardware = po.catalog.t32()
    feedforward = po.Feedforward() if gains > len(RANGES) else None
    loop = po.ClosedLoop(drive.system(), po.PID(), po.Dither(frequency=1000 / (2 * pi)), feedforward=feedforward)
    ranges = RANGES | (MORE if feedforward else {})
    own = loop.parameters.select([n for n in loop.parameters if n not in loop.plant.parameters])
    return loop, (hardware.fixed("*") | own).with_values(VALUES).with_bounds(ranges).freed(*ranges)
