"""A log for each check of the log doctor that trips it, and no other check."""

import numpy as np

from pneuopt.logs.doctor import PISTON
from pneuopt.logs.experiment import Experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory

T = np.arange(4000) * 1e-3


def swing(**changed: Array) -> Experiment:
    """A drive under friction going to and fro: pressures and force do work."""
    rng = np.random.default_rng(0)
    v = 0.3 * np.cos(2 * np.pi * T)
    push = 30 * np.sign(v) + 60 * v - 5 * np.sin(2 * np.pi * T)
    columns = {
        "position": 0.1 + 0.3 / (2 * np.pi) * np.sin(2 * np.pi * T) + 1e-5 * rng.standard_normal(T.size),
        "speed": v + 1e-3 * rng.standard_normal(T.size),
        "force": push,
        "pressure_a": 5e5 + 5e2 * push + 1e3 * rng.standard_normal(T.size),
        "pressure_b": 4.5e5 - 5e2 * push + 1e3 * rng.standard_normal(T.size),
    }
    return Experiment(Trajectory(T, {**columns, **changed}), {"position": 1e-5, "speed": 1e-3}, name="swing")


def only(log: Experiment, *channels: str) -> Experiment:
    return log.select(channels)


def stopped() -> Experiment:
    """It runs into a stop at 0.13 m, against which the force then pushes."""
    x, push = RIGHT["position"], RIGHT["force"]
    rest = 1e-5 * np.random.default_rng(2).standard_normal(T.size)
    return swing(position=np.minimum(x, 0.13) + rest, force=np.where(x > 0.13, 250.0, push))


def jumped() -> Experiment:
    """The position is 50 mm off from 1.5 s to 1.6 s."""
    return only(swing(position=RIGHT["position"] + 0.05 * ((T > 1.5) & (T < 1.6))), "position", "force")


def dwelling() -> Experiment:
    """Four moves of 60 mm to and fro, each within .25 s of a second; while it stands, force and pressures hold it."""
    rng, phase = np.random.default_rng(3), np.clip(4 * (T % 1.0), 0.0, 1.0)
    side = np.where(T % 2.0 < 1.0, 1.0, -1.0)
    v = side * 0.24 * (1 - np.cos(2 * np.pi * phase))
    x = 0.1 + np.cumsum(v) * 1e-3
    push = 30 * np.where(phase < 1.0, side, 0.4 * side) + 60 * v + 2.65 * np.gradient(v, T)
    return swing(
        position=x + 1e-5 * rng.standard_normal(T.size),
        speed=v + 1e-3 * rng.standard_normal(T.size),
        force=push,
        pressure_a=5e5 + 5e2 * push + 1e3 * rng.standard_normal(T.size),
        pressure_b=4.5e5 - 5e2 * push + 1e3 * rng.standard_normal(T.size),
    )


RIGHT = swing().trajectory
BAD_LOGS = {
    "motion": only(swing(position=0.1 + 1e-5 * np.random.default_rng(1).standard_normal(T.size)), "position", "force"),
    "speed": only(swing(speed=-RIGHT["speed"]), "position", "speed"),
    "work": only(swing(force=-RIGHT["force"]), "position", "force"),
    "command": only(swing(valve_voltage=-RIGHT["speed"]), "position", "valve_voltage"),
    "scale": only(swing(position=1e3 * RIGHT["position"]), "position", "force"),
    "jumps": jumped(),
    "stops": only(stopped(), "position", "force"),
    "mass": swing(),
    "offset": swing(force=RIGHT["force"] + 20.0),
    "pressures": only(swing(pressure_b=RIGHT["pressure_b"] - 4.3e5), "position", "pressure_b"),
    "sampling": only(swing(position=np.round(RIGHT["position"] / 5e-3) * 5e-3), "position"),
    "dwells": dwelling(),
}
"""By the name of the check."""
STATED = {"mass": PISTON._replace(inertia=10.0), "offset": PISTON._replace(constant=0.0, offset_parameter="load.force")}
"""What is stated beside a log, where the check needs it: `swing` is of 2.65 kg without a load."""
