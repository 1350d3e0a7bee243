"""The references of P32: a trapezoid of speed that may end in a creep, out and back again."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.p32 import DISTANCES, DWELL, SAMPLE_TIME, START_PRESSURE, Trip


@dataclass(frozen=True)
class Profile:
    """From rest to rest: faster, slower, and a last part at a low speed.

    A piston that brakes is off its reference by what mass and friction differ from those that the controller knows;
    at a constant speed that dies away, and the low one is still above the fall of static friction.

    Parameters
    ----------
    speed, acceleration : float
        Limits [m/s, m/s^2].
    creep_speed, creep_distance : float
        Of the last part [m/s, m]; of a distance no longer than twice that, half the distance.
    exponent : float
        The acceleration of a distance d is ``acceleration (d/longest)^exponent``, since short moves leave a controller
        less time.
    short : float
        By how much the motion ends before the distance, to which the reference then jumps: of a piston that is slow to
        brake the error at the end is then still one that pulses forwards take away [m].
    """

    speed: float
    acceleration: float
    creep_speed: float
    creep_distance: float
    exponent: float = 0.0
    short: float = 0.0

    def corners(self, distance: float) -> tuple[Array, Array]:
        """Instants at which the acceleration changes [s], and the speeds there [m/s], of a positive distance."""
        a = self.acceleration * (distance / max(DISTANCES)) ** self.exponent
        distance -= self.short
        creep = min(self.creep_distance, distance / 2)
        slow = min(self.creep_speed, sqrt(a * distance))
        stop = slow**2 / (2 * a)
        way = distance - max(creep, stop)
        fast = min(max(self.speed, slow), sqrt(a * way + slow**2 / 2))
        cruise = (way - (2 * fast**2 - slow**2) / (2 * a)) / fast
        spans = [fast / a, max(cruise, 0.0), (fast - slow) / a, max(creep - stop, 0.0) / slow, slow / a]
        return np.concatenate([[0.0], np.cumsum(spans)]), np.array([0.0, fast, fast, slow, slow, 0.0])

    def motion(self, distance: float, t: Array) -> tuple[Array, Array, Array]:
        """The way, its speed and its acceleration at instants from the beginning on [s]."""
        at, speeds = self.corners(abs(distance))
        spans = np.diff(at)
        ways = np.concatenate([[0.0], np.cumsum(spans * (speeds[1:] + speeds[:-1]) / 2)])
        rates = np.divide(np.diff(speeds), spans, out=np.zeros(len(spans)), where=spans > 0)
        k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(spans) - 1)
        since = np.clip(t - at[k], 0.0, spans[k])
        moving = (t >= 0) & (t < at[-1])
        sign = np.sign(distance)
        way = np.where(t >= at[-1], abs(distance), ways[k] + since * (speeds[k] + rates[k] * since / 2))
        return (
            sign * way,
            sign * np.where(moving, speeds[k] + rates[k] * since, 0.0),
            sign * np.where(moving, rates[k], 0),
        )


@dataclass(frozen=True)
class Outing:
    """A trip with a profile: out, a dwell, back, a dwell.

    Parameters
    ----------
    trip : Trip
    profile : Profile or None
        None: the end of each move at once, a step.
    dwell, last : float
        After the first and after the second move [s].
    """

    trip: Trip
    profile: Profile | None
    dwell: float = DWELL
    last: float | None = None

    @property
    def start(self) -> dict[str, float]:
        """How the drive stands before it."""
        return {"pressure_b": START_PRESSURE}

    @property
    def duration(self) -> float:
        """Of each move, in whole samples [s]."""
        if self.profile is None:
            return 0.0
        return SAMPLE_TIME * float(np.ceil(self.profile.corners(self.trip.distance)[0][-1] / SAMPLE_TIME))

    @property
    def moves(self) -> tuple[tuple[int, int, float, float], ...]:
        """Of both: the first and the last sample, the end and the distance [m]."""
        first = round((self.duration + self.dwell) / SAMPLE_TIME)
        last = first + round((self.duration + (self.dwell if self.last is None else self.last)) / SAMPLE_TIME)
        begin, far = self.trip.begin, self.trip.begin + self.trip.distance
        return (0, first, far, self.trip.distance), (first, last, begin, -self.trip.distance)

    def trajectory(self) -> po.Trajectory:
        """The reference, its speed and its acceleration at the samples."""
        (_, first, _, out), (_, last, _, back) = self.moves
        t: Array = np.asarray(SAMPLE_TIME * np.arange(last + 1), dtype=np.float64)
        columns: tuple[Array, ...]
        if self.profile is None:
            ways = np.where(t < t[first], out, 0.0)
            columns = (self.trip.begin + ways, np.zeros_like(t), np.zeros_like(t))
        else:
            there, again = self.profile.motion(out, t), self.profile.motion(back, t - t[first])
            columns = tuple(a + b for a, b in zip(there, again, strict=True))
            columns = (self.trip.begin + columns[0], *columns[1:])
        return po.Trajectory(
            t, dict(zip(("reference", "reference_speed", "reference_acceleration"), columns, strict=True))
        )
