"""`Move`: from rest at one value to rest at another, within limits of speed, acceleration and jerk."""

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import copysign, inf, isfinite
from typing import Self

import numpy as np

from pneuopt.control.profiles import PlannedMotion, plan_minimum_jerk, plan_s_curve
from pneuopt.control.reference import Reference, describe_circumstances, disturbance_columns, reference_samples
from pneuopt.control.sensor import REFERENCE_ACCELERATION, REFERENCE_SPEED
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory

Motion = Callable[[Array], tuple[Array, Array, Array]]


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


def sample_motion(reference: Reference, motion: Motion, step: float, *, between: bool = True) -> Trajectory:
    """The reference, its speed and its acceleration held on a grid, and its disturbances; as `Move.trajectory`.

    Parameters
    ----------
    reference : Reference
    motion : callable
        Of instants [s] the reference, its speed and its acceleration.
    step : float
        Spacing of the grid [s].
    between : bool
        Whether the reference may begin to change between two samples.
    """
    k, first = reference_samples(reference, step, between=between)
    t: Array = np.asarray(k * step, dtype=np.float64)
    columns = dict(zip(("reference", REFERENCE_SPEED, REFERENCE_ACCELERATION), motion(t), strict=True))
    return Trajectory(t, columns | disturbance_columns(reference, k >= first))
