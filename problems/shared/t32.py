"""The tuning benchmark T32: the drive, its step, and the five gains that are free.

A 32 mm cylinder with LuGre friction and a valve with a dead zone steps from rest to 0.2 m/s under a continuous PID and
a dither of 1000 rad/s. Kp, Ki, Kd, the dither's amplitude and its offset are free.
"""

from math import pi

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


def benchmark() -> tuple[po.ClosedLoop, po.ParameterSet]:
    drive, hardware = po.catalog.t32()
    loop = po.ClosedLoop(drive.system(), po.PID(), po.Dither(frequency=1000 / (2 * pi)))
    own = loop.parameters.select(loop.parameters.match_names("pid.*", "dither.*"))
    return loop, (hardware.fixed("*") | own).with_values(VALUES).with_bounds(RANGES).freed(*RANGES)
