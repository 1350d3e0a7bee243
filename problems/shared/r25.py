"""What the scripts about the paper's drive share: the set R25 beside eq. (16), its loop in volts, its linear model.

The paper's loop is in volts: the speed counts 20 V/(m/s) in the feedback. So gains of the paper are per volt of speed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array

TRANSDUCER = 20.0  # [V s/m] K_s
HALF_TRAVEL, PER_VOLT = 1e-3, 2e-4  # [m] of the spool, [m/V] K_d
CLIP = 5.0  # [V]
PAPERS_PID = {"Kp": 0.225, "Ki": 1.23, "Kd": 0.01, "Tf": 0.01}  # [V/V], of Table 2
UNIT_FEEDBACK = {"Kp": 1.0, "Tf": 0.01}


@dataclass(frozen=True)
class Case:
    """A step of the reference [V] of R25's loop: gains per volt, friction, and a sine on the command."""

    volts: float
    pid: bool = False
    lugre: bool = False
    seconds: float = 2.0
    amplitude: float = 0.0  # [V]
    frequency: float = 1000.0  # [rad/s]

    @property
    def gains(self) -> Mapping[str, float]:
        """Of the paper's Table 2, or unit feedback."""
        return PAPERS_PID if self.pid else UNIT_FEEDBACK


@dataclass(frozen=True, eq=False)
class Loop:
    """Time [s], and the speed as the transducer shows it [V]."""

    t: Array
    volts: Array = field(repr=False)


@cache
def simulated(case: Case, rtol: float = 1e-8) -> Loop:
    """The nonlinear loop from rest; derivative on the error, valve clipped at 5 V."""
    drive, p = po.catalog.r25(case.lugre)
    loop = po.ClosedLoop(drive.system(), po.PID(), po.Dither(), measured="speed")
    scaled = {f"pid.{n}": v if n == "Tf" else TRANSDUCER * v for n, v in case.gains.items()}
    chatter = {"dither.amplitude": case.amplitude, "dither.frequency": case.frequency / (2 * np.pi)}
    given = (loop.parameters | p).with_values({"pid.lower": -CLIP, "pid.upper": CLIP, **scaled, **chatter})
    step = po.Step(case.volts / TRANSDUCER, horizon=case.seconds).trajectory(5e-4)
    run = po.simulate(loop, step, given, rtol=rtol, atol=1e-4 * rtol)
    return Loop(run.t, TRANSDUCER * run["speed"])


def linearised(given: po.catalog.DriveSet) -> po.Linearisation:
    """The drive at rest, by AD; position left out, which moves nothing at mid stroke."""
    drive, p = given
    rest = drive.rest(p)
    found = drive.system().linearise(np.array(list(rest.states.values())), rest.inputs, p)
    assert found.states[0] == "position"
    return po.Linearisation(
        found.A[1:, 1:], found.B[1:], found.C[1:2, 1:], found.D[1:2], found.states[1:], found.inputs, ("speed",)
    )


def polynomials(given: po.catalog.DriveSet) -> tuple[float, float, float, float, float]:
    """Of speed [V] over command [V]: the denominator's s and 1, the numerator, then the third pole and its zero."""
    found = linearised(given)
    poles, plain = np.linalg.eigvals(found.A), np.poly(found.A)
    numerator = TRANSDUCER * (np.poly(found.A - found.B @ found.C) - plain)
    third = float(np.real(poles[np.argmax(poles.real)]))
    second = np.polydiv(plain, [1.0, -third])[0]
    return float(second[1]), float(second[2]), float(numerator[2]), third, float(-numerator[3] / numerator[2])


def lagging(friction: po.Viscous | po.Stribeck | po.LuGre | po.Karnopp) -> po.catalog.DriveSet:
    """R25 behind a spool of 100 Hz, damping 0.7; friction of the same numbers by any model."""
    drive, p = po.catalog.r25(lugre=True)
    slow = replace(drive, friction=friction, valve=replace(drive.valve, spool=po.Spool.SECOND_ORDER))
    own = p.select(n for n in p if n in slow.parameters)
    return slow, (slow.parameters | own).with_values({"valve.bandwidth": 100.0, "valve.damping": 0.7})


def averaged(t: Array, y: Array, period: float) -> Array:
    """Centred mean over a period of a signal that is linear between its samples; half a period is lost at each end."""
    whole = np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * np.diff(t))])
    mean: Array = (np.interp(t + period / 2, t, whole) - np.interp(t - period / 2, t, whole)) / period
    return mean
