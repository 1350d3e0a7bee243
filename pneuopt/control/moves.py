"""References with a motion: `Move` from rest to rest, `MoveSequence` with dwells, `MotionPath` through points."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import cbrt, copysign, inf, isfinite, sqrt
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from pneuopt.control.reference import Reference, describe_circumstances, disturbance_columns, reference_samples
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory


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


class MoveProfile(Enum):
    """Shape of a move over time."""

    S_CURVE = "s-curve"
    TRAPEZOID = "trapezoid"
    MINIMUM_JERK = "minimum jerk"


@dataclass(frozen=True)
class Move:
    """A move of the reference from rest to rest: the fastest of its profile within the limits.

    Metrics count from its beginning; SettlingTime is the time from there until the signal is in the band about its end.

    Parameters
    ----------
    distance : float
        How far, either sign [unit of the measured signal].
    speed, acceleration : float
        Limits [measured unit/s, measured unit/s^2].
    jerk : float
        Limit [measured unit/s^3]; without one the acceleration of an S-curve steps.
    profile : MoveProfile
        An S-curve, a trapezoid of speed, or the polynomial of fifth order with the least jerk.
    at : float
        Instant at which it begins [s].
    initial : float
        Value before [unit of the measured signal].
    dwell : float
        From its end to the end of the experiment [s]; negative where the experiment ends before.
    start : mapping of str to float
        What else is known of the plant at time 0, as for `Step`.
    disturbance : mapping of str to float
        By how much parameters or inputs of the plant change at the instant `at`, as for `Step`.

    Raises
    ------
    InputError
        If there is no distance, a limit is not positive, or a trapezoid has a limit of jerk, which it cannot keep.

    Examples
    --------
    >>> Move(0.2, speed=0.5, acceleration=5.0, jerk=100.0).duration
    0.55
    """

    distance: float
    _: KW_ONLY
    speed: float
    acceleration: float
    jerk: float = inf
    profile: MoveProfile = MoveProfile.S_CURVE
    at: float = 0.0
    initial: float = 0.0
    dwell: float = 1.0
    start: Mapping[str, float] = field(default_factory=dict, hash=False)
    disturbance: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        values = {n: getattr(self, n) for n in ("distance", "speed", "acceleration", "at", "initial", "dwell")}
        values |= {f"start[{n!r}]": value for n, value in self.start.items()}
        values |= {f"disturbance[{n!r}]": value for n, value in self.disturbance.items()}
        for name, value in values.items():
            require(isfinite(value), f"Move: {name} must be a finite number, got {value}")
        require(self.distance != 0, "Move: distance must not be zero, there would be nothing to follow")
        for name in ("speed", "acceleration", "jerk"):
            limit = getattr(self, name)
            require(limit > 0, f"Move: {name} is a limit on its size and must be positive, got {limit:g}")
        told = "Move: the acceleration of a trapezoid steps, which no limit of jerk allows; leave jerk out, or take"
        require(self.profile is not MoveProfile.TRAPEZOID or self.jerk == inf, f"{told} an S-curve")
        require(self.at >= 0, f"Move: at must not be negative, got {self.at:g} s; time starts at zero")
        ends = f"Move: the experiment ends at {self.horizon:g} s, before the move begins; raise dwell"
        require(self.horizon > self.at, ends)

    @cached_property
    def plan(self) -> PlannedMotion:
        """The move over time, forwards from 0."""
        fastest = plan_minimum_jerk if self.profile is MoveProfile.MINIMUM_JERK else plan_s_curve
        return fastest(abs(self.distance), self.speed, self.acceleration, self.jerk)

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return self.plan.duration

    @property
    def horizon(self) -> float:
        """End of the experiment [s]."""
        return self.at + self.duration + self.dwell

    @property
    def origin(self) -> float:
        """Value at time 0 [unit of the measured signal]."""
        return self.initial

    @property
    def final(self) -> float:
        """Value after the move [unit of the measured signal]."""
        return self.initial + self.distance

    @property
    def size(self) -> float:
        """The distance, as every reference calls it [unit of the measured signal]."""
        return self.distance

    @property
    def nominal_size(self) -> float:
        """The distance, of which fractions are [unit of the measured signal]."""
        return self.distance

    @property
    def changes(self) -> bool:
        """A move always does."""
        return True

    @property
    def label(self) -> str:
        """How a table heads it.

        Examples
        --------
        >>> Move(-0.2, speed=0.5, acceleration=5.0, start={"position": 0.25}).label
        '0 to -0.2 in 0.5 s, position 0.25'
        """
        lead = f"{self.initial:g} to {self.final:g} in {self.duration:.3g} s"
        return ", ".join([lead, *describe_circumstances(self)])

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """The reference, its speed and its acceleration at any instants [s], each of shape (n,)."""
        forwards = self.plan.motion(np.asarray(t, dtype=float) - self.at)
        s, v, a = (copysign(1.0, self.distance) * each for each in forwards)
        return np.where(t >= self.at + self.duration, self.final, self.initial + s), v, a

    def values(self, t: Array) -> Array:
        """The reference itself at any instants, shape (n,) [s]."""
        return self.motion(t)[0]

    def trajectory(self, step: float) -> Trajectory:
        """The reference on the grid 0, step, 2 step, ... to the horizon, held from sample to sample.

        Parameters
        ----------
        step : float
            Spacing of the grid [s]; the instant at which the move begins must lie on it.

        Returns
        -------
        Trajectory
            "reference", its first and second derivative, "reference_speed" and "reference_acceleration", and each
            disturbance by `disturbance_input`.

        Raises
        ------
        InputError
            If that instant lies between two samples, or the grid is coarser than the horizon.

        Examples
        --------
        >>> Move(1.0, speed=1.0, acceleration=1.0, dwell=1.0).trajectory(1.0)["reference"].tolist()
        [0.0, 0.5, 1.0, 1.0]
        """
        return sample_motion(self, self.motion, step, between=False)

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""
        return replace(self, dwell=horizon - self.at - self.duration)


@dataclass(frozen=True)
class MoveSequence:
    """Moves of which each begins where and when the one before has ended, after its dwell.

    Metrics are those of the last move: they count from its beginning, after all that came before it has left its mark
    on friction and integral. `parts` gives the sequences that end with each move.

    Parameters
    ----------
    moves : sequence of Move
        The first says when and where the sequence begins, and how the plant starts; a disturbance comes with the last.

    Raises
    ------
    InputError
        If there is none, a later one has a beginning or a start of its own, or one before the last a disturbance.

    Examples
    --------
    >>> there = Move(0.2, speed=0.5, acceleration=5.0, dwell=0.5)
    >>> both = MoveSequence([there, replace(there, distance=-0.2)])
    >>> both.label, both.at, both.horizon
    ('0 to 0.2 to 0', 1.0, 2.0)
    """

    moves: tuple[Move, ...]

    def __init__(self, moves: Sequence[Move]) -> None:
        object.__setattr__(self, "moves", tuple(moves))
        require(len(self.moves) > 0, "MoveSequence: there is no move; give at least one Move")
        told = "MoveSequence: move {} begins where the one before ends; only the first has at, initial and start"
        for k, move in enumerate(self.moves[1:], 2):
            require(move.at == 0 and move.initial == 0 and not move.start, told.format(k))
        for k, move in enumerate(self.moves[:-1], 1):
            require(move.dwell >= 0, f"MoveSequence: move {k} ends by its dwell, which must not be negative")
            require(not move.disturbance, f"MoveSequence: only the last move may have a disturbance, move {k} has one")

    @cached_property
    def chain(self) -> tuple[Move, ...]:
        """The moves, each with the instant and the value at which it begins."""
        found = [self.moves[0]]
        for move in self.moves[1:]:
            found.append(replace(move, at=found[-1].horizon, initial=found[-1].final))
        return tuple(found)

    @property
    def parts(self) -> tuple["MoveSequence", ...]:
        """The sequences up to each move, so that each is once the last."""
        return tuple(MoveSequence(self.moves[:k]) for k in range(1, len(self.moves) + 1))

    @property
    def at(self) -> float:
        """Instant at which the last move begins [s]."""
        return self.chain[-1].at

    @property
    def origin(self) -> float:
        """Value at time 0 [unit of the measured signal]."""
        return self.moves[0].initial

    @property
    def initial(self) -> float:
        """Value before the last move [unit of the measured signal]."""
        return self.chain[-1].initial

    @property
    def final(self) -> float:
        """Value after the last move [unit of the measured signal]."""
        return self.chain[-1].final

    @property
    def size(self) -> float:
        """Distance of the last move [unit of the measured signal]."""
        return self.moves[-1].distance

    @property
    def nominal_size(self) -> float:
        """Distance of the last move, of which fractions are [unit of the measured signal]."""
        return self.moves[-1].distance

    @property
    def horizon(self) -> float:
        """End of the experiment [s]."""
        return self.chain[-1].horizon

    @property
    def start(self) -> Mapping[str, float]:
        """What else is known of the plant at time 0, by output [SI]."""
        return self.moves[0].start

    @property
    def disturbance(self) -> Mapping[str, float]:
        """By how much parameters or inputs of the plant change with the last move [their units]."""
        return self.moves[-1].disturbance

    @property
    def changes(self) -> bool:
        """A sequence always does."""
        return True

    @property
    def label(self) -> str:
        """How a table heads it."""
        # sums of distances leave digits of a zero, which no label shows
        stops = [f"{round(stop, 9) + 0.0:g}" for stop in (self.origin, *(move.final for move in self.chain))]
        is_long = len(stops) > 4
        lead, shown = (f"move {len(self.moves)}, ", stops[-2:]) if is_long else ("", stops)
        return ", ".join([lead + " to ".join(shown), *describe_circumstances(self)])

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """The reference, its speed and its acceleration at any instants [s], each of shape (n,)."""
        found = self.chain[0].motion(t)
        for move in self.chain[1:]:
            begun = t >= move.at
            s, v, a = (np.where(begun, new, old) for new, old in zip(move.motion(t), found, strict=True))
            found = s, v, a
        return found

    def values(self, t: Array) -> Array:
        """The reference itself at any instants, shape (n,) [s]."""
        return self.motion(t)[0]

    def trajectory(self, step: float) -> Trajectory:
        """The columns of `Move.trajectory`, over all moves; they may begin between two samples."""
        return sample_motion(self, self.motion, step)

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""
        last = self.chain[-1]
        return type(self)([*self.moves[:-1], replace(self.moves[-1], dwell=horizon - last.at - last.duration)])


@dataclass(frozen=True, eq=False)
class MotionPath:
    """A reference through points over time, which rests before and after them.

    Between two points it is a cubic that leaves their range nowhere, with a continuous speed: F. N. Fritsch and R. E.
    Carlson, Monotone piecewise cubic interpolation, SIAM J. Numer. Anal. 17(2) (1980) 238-246. What counts of it is
    how well it is followed: `FollowingError`, `FollowingErrorRMS`. Metrics count from its beginning, about its end.

    Parameters
    ----------
    t : array_like, shape (n,)
        Instants, from 0 on, strictly increasing [s].
    points : array_like, shape (n,)
        The reference there [unit of the measured signal].
    dwell : float
        From the last point to the end of the experiment [s]; negative where the experiment ends before.
    name : str
        How a table heads it.
    start : mapping of str to float
        What else is known of the plant at time 0, as for `Step`.
    disturbance : mapping of str to float
        By how much parameters or inputs of the plant change at time 0, as for `Step`.

    Raises
    ------
    InputError
        If there are fewer than two points, one is not finite, time does not increase from 0, or nothing moves.
    """

    t: Array
    points: Array
    dwell: float = 0.5
    name: str = "path"
    start: Mapping[str, float] = field(default_factory=dict)
    disturbance: Mapping[str, float] = field(default_factory=dict)

    def __init__(
        self,
        t: ArrayLike,
        points: ArrayLike,
        *,
        dwell: float = 0.5,
        name: str = "path",
        start: Mapping[str, float] | None = None,
        disturbance: Mapping[str, float] | None = None,
    ) -> None:
        values = {"t": np.array(t, dtype=float), "points": np.array(points, dtype=float), "dwell": dwell, "name": name}
        for key, value in (values | {"start": dict(start or {}), "disturbance": dict(disturbance or {})}).items():
            object.__setattr__(self, key, value)
        shape = self.t.ndim == 1 and self.t.shape == self.points.shape and len(self.t) > 1
        require(
            shape,
            f"MotionPath: t and points are rows of two or more, got shapes {self.t.shape} and {self.points.shape}",
        )
        require(bool(np.isfinite([self.t, self.points]).all()), "MotionPath: an instant or a point is not finite")
        back = np.flatnonzero(np.diff(self.t) <= 0)
        told = f"MotionPath: time must increase, and does not at point {back[0] + 2}" if back.size else ""
        require(not back.size, told)
        require(float(self.t[0]) == 0.0, f"MotionPath: time begins at 0, got {self.t[0]:g} s")
        require(bool(np.ptp(self.points) > 0), f"MotionPath: nothing moves, every point is {self.points[0]:g}")
        require(
            isfinite(dwell) and self.horizon > 0, f"MotionPath: dwell {dwell:g} s ends the experiment before it begins"
        )

    @property
    def at(self) -> float:
        """Instant at which it begins: 0 [s]."""
        return 0.0

    @property
    def origin(self) -> float:
        """The first point [unit of the measured signal]."""
        return float(self.points[0])

    @property
    def initial(self) -> float:
        """The first point [unit of the measured signal]."""
        return self.origin

    @property
    def final(self) -> float:
        """The last point [unit of the measured signal]."""
        return float(self.points[-1])

    @property
    def size(self) -> float:
        """From the first point to the last [unit of the measured signal]."""
        return self.final - self.origin

    @property
    def nominal_size(self) -> float:
        """What fractions are of: the way from the first point to the last, or the range of a path that returns."""
        return self.size or float(np.ptp(self.points))

    @property
    def changes(self) -> bool:
        """Whether it ends elsewhere than it begins."""
        return self.size != 0

    @property
    def horizon(self) -> float:
        """End of the experiment [s]."""
        return float(self.t[-1]) + self.dwell

    @property
    def label(self) -> str:
        """How a table heads it."""
        return ", ".join([self.name, *describe_circumstances(self)])

    @cached_property
    def _curves(self) -> tuple[PchipInterpolator, PchipInterpolator, PchipInterpolator]:
        curve = PchipInterpolator(self.t, self.points)
        return curve, curve.derivative(1), curve.derivative(2)

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """The reference, its speed and its acceleration at any instants [s], each of shape (n,)."""
        at = np.clip(t, self.t[0], self.t[-1])
        inside = (np.asarray(t) >= self.t[0]) & (np.asarray(t) < self.t[-1])
        s, v, a = (np.asarray(curve(at), dtype=np.float64) for curve in self._curves)
        return s, np.where(inside, v, 0.0), np.where(inside, a, 0.0)

    def values(self, t: Array) -> Array:
        """The reference itself at any instants, shape (n,) [s]."""
        return self.motion(t)[0]

    def trajectory(self, step: float) -> Trajectory:
        """The columns of `Move.trajectory` on the grid 0, step, 2 step, ... to the horizon [s]."""
        return sample_motion(self, self.motion, step)

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""
        return replace(self, dwell=horizon - float(self.t[-1]))


def sample_motion(
    reference: Reference, motion: Callable[[Array], tuple[Array, Array, Array]], step: float, *, between: bool = True
) -> Trajectory:
    """A reference and its rates on a grid of `step` [s], with disturbances; `between`: it may begin off the grid."""
    k, first = reference_samples(reference, step, between=between)
    t: Array = np.asarray(k * step, dtype=np.float64)
    columns = dict(zip(("reference", REFERENCE_SPEED, REFERENCE_ACCELERATION), motion(t), strict=True))
    return Trajectory(t, columns | disturbance_columns(reference, k >= first))


@dataclass(frozen=True)
class SCurve:
    """Seven segments of constant jerk, symmetric in time; those that a short move has no room for take no time."""

    distance: float  # [measured unit], positive
    peak_speed: float  # [measured unit/s]
    acceleration_time: float  # from rest to the peak speed [s]
    jerk_time: float  # from no acceleration to the largest [s]; 0 makes it a trapezoid of speed

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        at_peak_speed = max(0.0, self.distance / self.peak_speed - self.acceleration_time)
        return 2 * self.acceleration_time + at_peak_speed

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """See `PlannedMotion`; the second half is the first, mirrored, so that the end is met exactly."""
        T, Tj, Ta, peak = self.duration, self.jerk_time, self.acceleration_time, self.peak_speed
        top = peak / (Ta - Tj)
        jerk = top / Tj if Tj else 0.0
        late, moves = t > T / 2, (t >= 0) & (t < T)
        since = np.clip(np.where(late, T - t, t), 0.0, None)
        when, left = [since < Tj, since < Ta - Tj, since < Ta], Ta - since
        s = np.select(
            when,
            [
                jerk * since**3 / 6,
                top * (since * (since - Tj) / 2 + Tj**2 / 6),
                peak * (since - Ta / 2) + jerk * left**3 / 6,
            ],
            peak * (since - Ta / 2),
        )
        v = np.select(when, [jerk * since**2 / 2, top * (since - Tj / 2), peak - jerk * left**2 / 2], peak)
        a = np.select(when, [jerk * since, np.full_like(since, top), jerk * left], 0.0)
        return (
            np.where(late, self.distance - s, s),
            np.where(moves, v, 0.0),
            np.where(moves, np.where(late, -a, a), 0.0),
        )


@dataclass(frozen=True)
class MinimumJerk:
    """The polynomial of fifth order from rest to rest, which has the least integral of the squared jerk.

    T. Flash and N. Hogan, The coordination of arm movements, J. Neurosci. 5(7) (1985) 1688-1703.
    """

    distance: float  # [measured unit], positive
    duration: float  # [s]

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """See `PlannedMotion`."""
        d, T = self.distance, self.duration
        z = np.clip(t / T, 0.0, 1.0)
        speed, acceleration = 30 * z**2 * (1 - z) ** 2, 60 * z * (1 - z) * (1 - 2 * z)
        return d * z**3 * (10 - z * (15 - 6 * z)), d / T * speed, d / T**2 * acceleration


def plan_s_curve(distance: float, speed: float, acceleration: float, jerk: float = inf) -> SCurve:
    """The fastest move from rest to rest within limits of speed, acceleration and jerk; without jerk's a trapezoid.

    L. Biagiotti and C. Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), sections 3.2 and 3.4.
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

    Examples
    --------
    >>> round(plan_minimum_jerk(0.2, speed=0.5, acceleration=5.0).duration, 12)
    0.75
    """
    times = 15 / 8 * distance / speed, sqrt(10 / sqrt(3) * distance / acceleration), cbrt(60 * distance / jerk)
    return MinimumJerk(distance, max(times))
