"""`MotionPath`: a reference through given points, as a cam or a recorded motion has them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from pneuopt.control.moves import sample_motion
from pneuopt.control.reference import describe_circumstances
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory


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
