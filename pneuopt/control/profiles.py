"""Profiles of a move from rest to rest, in closed form: position, speed and acceleration over time."""

from dataclasses import dataclass
from math import cbrt, inf, sqrt
from typing import Protocol

import numpy as np

from pneuopt.quantities.arrays import Array


class PlannedMotion(Protocol):
    """A move from 0 to `distance` that begins at time 0, at rest, and ends at rest."""

    @property
    def distance(self) -> float:
        """How far it leads, positive [measured unit]."""

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """Position, speed and acceleration at instants [s], each of their shape; constant before and after."""


@dataclass(frozen=True)
class SCurve:
    """Seven segments of constant jerk, symmetric in time; those that a short move has no room for take no time.

    Parameters
    ----------
    distance : float
        [measured unit], positive.
    peak_speed : float
        [measured unit/s]
    acceleration_time : float
        From rest to the peak speed [s].
    jerk_time : float
        From no acceleration to the largest [s]; 0 makes it a trapezoid of speed.
    """

    distance: float
    peak_speed: float
    acceleration_time: float
    jerk_time: float

    @property
    def cruise_time(self) -> float:
        """At the peak speed [s]."""
        return max(0.0, self.distance / self.peak_speed - self.acceleration_time)

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return 2 * self.acceleration_time + self.cruise_time

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """See `PlannedMotion`; the second half is the first, mirrored, so that the end is met exactly."""
        T = self.duration
        late = t > T / 2
        s, v, a = self._speeding_up(np.clip(np.where(late, T - t, t), 0.0, None))
        moves = (t >= 0) & (t < T)
        return (
            np.where(late, self.distance - s, s),
            np.where(moves, v, 0.0),
            np.where(moves, np.where(late, -a, a), 0.0),
        )

    def _speeding_up(self, t: Array) -> tuple[Array, Array, Array]:
        """Motion in the first half, segment by segment."""
        Tj, Ta, v = self.jerk_time, self.acceleration_time, self.peak_speed
        a = v / (Ta - Tj)
        jerk = a / Tj if Tj else 0.0
        left = Ta - t
        when = [t < Tj, t < Ta - Tj, t < Ta]
        return (
            np.select(
                when,
                [jerk * t**3 / 6, a * (t * (t - Tj) / 2 + Tj**2 / 6), v * (t - Ta / 2) + jerk * left**3 / 6],
                v * (t - Ta / 2),
            ),
            np.select(when, [jerk * t**2 / 2, a * (t - Tj / 2), v - jerk * left**2 / 2], v),
            np.select(when, [jerk * t, np.full_like(t, a), jerk * left], 0.0),
        )


@dataclass(frozen=True)
class MinimumJerk:
    """The polynomial of fifth order from rest to rest, which has the least integral of the squared jerk.

    T. Flash and N. Hogan, The coordination of arm movements, J. Neurosci. 5(7) (1985) 1688-1703.

    Parameters
    ----------
    distance : float
        [measured unit], positive.
    duration : float
        [s]
    """

    distance: float
    duration: float

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """See `PlannedMotion`."""
        d, T = self.distance, self.duration
        z = np.clip(t / T, 0.0, 1.0)
        speed, acceleration = 30 * z**2 * (1 - z) ** 2, 60 * z * (1 - z) * (1 - 2 * z)
        return d * z**3 * (10 - z * (15 - 6 * z)), d / T * speed, d / T**2 * acceleration


def plan_s_curve(distance: float, speed: float, acceleration: float, jerk: float = inf) -> SCurve:
    """The fastest move from rest to rest within limits of speed, acceleration and jerk.

    Without a limit of jerk it is a trapezoid of speed. L. Biagiotti and C. Melchiorri, Trajectory Planning for
    Automatic Machines and Robots (2008), sections 3.2 and 3.4.

    Parameters
    ----------
    distance : float
        [measured unit], positive, as the limits are.
    speed, acceleration, jerk : float
        Limits [measured unit/s, /s^2, /s^3].

    Examples
    --------
    >>> plan_s_curve(0.2, speed=0.5, acceleration=5.0).duration, plan_s_curve(0.2, 0.5, 5.0, 100.0).duration
    (0.5, 0.55)
    """
    ramp = acceleration / jerk  # [s], from no acceleration to the largest
    if speed >= acceleration * ramp:
        Tj, Ta = ramp, speed / acceleration + ramp
    else:
        Tj = sqrt(speed / jerk)
        Ta = 2 * Tj
    if speed * Ta <= distance:
        return SCurve(distance, speed, Ta, Tj)
    if distance >= 2 * acceleration * ramp**2:  # the largest acceleration is reached, the largest speed is not
        half = ramp / 2
        time = sqrt(half**2 + distance / acceleration) + half  # Ta, from peak Ta = distance, peak = a (Ta - Tj)
        return SCurve(distance, distance / time, time, ramp)
    Tj = cbrt(distance / (2 * jerk))
    return SCurve(distance, distance / (2 * Tj), 2 * Tj, Tj)


def plan_minimum_jerk(distance: float, speed: float, acceleration: float, jerk: float = inf) -> MinimumJerk:
    """The shortest polynomial of fifth order within limits of speed, acceleration and jerk.

    Its peaks are 15/8 d/T of speed, 10/sqrt(3) d/T^2 of acceleration and 60 d/T^3 of jerk (Flash and Hogan 1985).

    Parameters
    ----------
    distance : float
        [measured unit], positive, as the limits are.
    speed, acceleration, jerk : float
        Limits [measured unit/s, /s^2, /s^3].

    Examples
    --------
    >>> round(plan_minimum_jerk(0.2, speed=0.5, acceleration=5.0).duration, 12)
    0.75
    """
    times = 15 / 8 * distance / speed, sqrt(10 / sqrt(3) * distance / acceleration), cbrt(60 * distance / jerk)
    return MinimumJerk(distance, max(times))
