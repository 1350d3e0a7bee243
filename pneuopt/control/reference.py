"""`Reference`: what a loop shall follow, and disturbances against which it shall hold it; `Step`, the plainest one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import as_tuple
from pneuopt.quantities.trajectories import Trajectory


@runtime_checkable
class Reference(Protocol):
    """What a loop is asked to do in one experiment: its reference over time, its start, and what disturbs it.

    Metrics count from `at` on. They are about `final`, and their fractions are of `nominal_size`.
    """

    @property
    def at(self) -> float:
        """Instant at which the reference begins to change, or the disturbance comes [s]."""

    @property
    def origin(self) -> float:
        """Value at time 0, at which the experiment begins [unit of the measured signal]."""

    @property
    def initial(self) -> float:
        """Value just before the instant `at` [unit of the measured signal]."""

    @property
    def final(self) -> float:
        """Value at the end [unit of the measured signal]."""

    @property
    def size(self) -> float:
        """``final - initial``, 0 for a disturbance alone [unit of the measured signal]."""

    @property
    def horizon(self) -> float:
        """End of the experiment [s]."""

    @property
    def start(self) -> Mapping[str, float]:
        """What else is known of the plant at time 0, by output [SI]."""

    @property
    def disturbance(self) -> Mapping[str, float]:
        """By how much parameters or inputs of the plant change at the instant `at` [their units]."""

    @property
    def changes(self) -> bool:
        """Whether the reference itself changes; otherwise a disturbance comes alone."""

    @property
    def nominal_size(self) -> float:
        """What fractions are of, with the sign of the change [unit of the measured signal]."""

    @property
    def label(self) -> str:
        """How a table heads it."""

    def values(self, t: Array) -> Array:
        """The reference itself at any instants [s], not held between samples."""

    def trajectory(self, step: float) -> Trajectory:
        """The columns "reference" and of each disturbance on the grid 0, step, 2 step, ... to the horizon [s].

        A reference with derivatives has the columns "reference_speed" and "reference_acceleration", too.
        """

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""


@dataclass(frozen=True)
class Step:
    """A step of the reference, of a disturbance, or of both at one instant.

    What a disturbance alone shows is measured as of a step: Overshoot is the largest deviation, either side, and
    SettlingTime the time until the signal is back in the band, each for what `nominal_size` is.

    Parameters
    ----------
    size : float
        Height, either sign [unit of the measured signal]; 0 where only a disturbance steps.
    at : float
        Instant [s].
    initial : float
        Value before [unit of the measured signal]: where it is a speed, the plant moves steadily when the step comes.
    horizon : float
        End of the experiment [s].
    start : mapping of str to float
        What else is known of the plant at time 0, by output: {"position": 0.25} [SI]. A `PneumaticDrive` also takes
        "pressure_b", as in its `rest`.
    disturbance : mapping of str to float
        By how much a parameter or an input of the plant changes at that instant: {"load.force": 50.0} [its unit]; of
        the input that the controller drives, by how much it is off.
    scale : float, optional
        For a disturbance alone: what fractions are of [unit of the measured signal]; by default `initial`.
    """

    size: float
    at: float = 0.0
    initial: float = 0.0
    horizon: float = 1.0
    start: Mapping[str, float] = field(default_factory=dict, hash=False)
    disturbance: Mapping[str, float] = field(default_factory=dict, hash=False)
    scale: float | None = None

    def __post_init__(self) -> None:
        values = {"size": self.size, "at": self.at, "initial": self.initial, "horizon": self.horizon}
        values |= {f"start[{n!r}]": value for n, value in self.start.items()}
        values |= {f"disturbance[{n!r}]": value for n, value in self.disturbance.items()}
        for name, value in values.items():
            require(isfinite(value), f"Step: {name} must be a finite number, got {value}")
        for name, value in self.disturbance.items():
            require(value != 0, f"Step: disturbance[{name!r}] must not be zero, nothing would change; leave it out")
        told = "Step: size must not be zero, there would be nothing to follow; for a disturbance alone name it"
        require(self.size != 0 or bool(self.disturbance), f"{told}, disturbance={{'load.force': 50.0}}")
        alone, given = self.size == 0, self.scale is not None
        require(alone or not given, "Step: scale is for a disturbance alone; fractions of a step are of its size")
        told = "Step: a disturbance of a loop that holds 0 needs a scale, of which its deviations are fractions"
        require(not alone or given or self.initial != 0, f"{told}, scale=0.1 say")
        require(not given or 0 < (self.scale or 0) < inf, f"Step: scale must be positive, got {self.scale}")
        require(self.at >= 0, f"Step: at must not be negative, got {self.at:g} s; time starts at zero")
        require(self.horizon > self.at, f"Step: horizon {self.horizon:g} s must lie after the step at {self.at:g} s")

    @property
    def origin(self) -> float:
        """Value at time 0 [unit of the measured signal]."""
        return self.initial

    @property
    def final(self) -> float:
        """Value after the step [unit of the measured signal]."""
        return self.initial + self.size

    @property
    def changes(self) -> bool:
        """Whether the reference itself steps."""
        return self.size != 0

    @property
    def nominal_size(self) -> float:
        """What fractions are of: the step's size with its sign, or what stands for it [unit of the measured signal]."""
        return self.size or self.scale or abs(self.initial)

    @property
    def label(self) -> str:
        """How a table heads it.

        Examples
        --------
        >>> Step(-0.2, start={"position": 0.25}).label
        '0 to -0.2, position 0.25'
        >>> Step(0.0, initial=0.2, disturbance={"load.force": 50.0}).label
        '0.2 held, load.force +50'
        """
        lead = f"{self.initial:g} to {self.final:g}" if self.changes else f"{self.initial:g} held"
        return ", ".join([lead, *describe_circumstances(self)])

    def values(self, t: Array) -> Array:
        """The value before and after the step at any instants, shape (n,) [s]."""
        return np.where(t >= self.at - 1e-12 * max(1.0, self.at), self.final, self.initial)

    def trajectory(self, step: float) -> Trajectory:
        """The column "reference" on the grid 0, step, 2 step, ... to the horizon, held from sample to sample.

        Each disturbance is a column, too, named by `disturbance_input`.

        Parameters
        ----------
        step : float
            Spacing of the grid [s]; the step's instant must lie on it.

        Returns
        -------
        Trajectory
            From 0 to the horizon, or to the first instant of the grid behind it.

        Raises
        ------
        InputError
            If the instant lies between two samples, or the grid is coarser than the horizon.

        Examples
        --------
        >>> Step(0.2, at=0.1, horizon=0.3).trajectory(0.1)["reference"].tolist()
        [0.0, 0.2, 0.2, 0.2]
        """
        k, first = reference_samples(self, step)
        values = {"reference": np.where(k >= first, self.final, self.initial)}
        return Trajectory(k * step, values | disturbance_columns(self, k >= first))

    def with_horizon(self, horizon: float) -> Self:
        """The same with another end of the experiment [s]."""
        return replace(self, horizon=horizon)


def describe_circumstances(reference: Reference) -> list[str]:
    """What a label says of the start and the disturbance, ["position 0.25", "load.force +50"]."""
    begun = [f"{n} {v:g}" for n, v in reference.start.items()]
    return begun + [f"{n} {v:+g}" for n, v in reference.disturbance.items()]


def reference_samples(reference: Reference, step: float, *, between: bool = False) -> tuple[NDArray[np.int_], int]:
    """The samples of a grid of `step` [s], and the first since the reference changes, which may lie `between` two."""
    kind, at, horizon = type(reference).__name__, reference.at, reference.horizon
    require(0 < step < horizon, f"the grid's spacing {step:g} s must lie between 0 and {horizon:g} s")
    first = int(np.ceil(at / step - 1e-9)) if between else round(at / step)
    require(
        between or abs(first * step - at) <= 1e-9 * max(at, step),
        f"{kind}: at = {at:g} s falls between two samples of {step:g} s; use {first * step:g} s",
    )
    return np.arange(int(np.ceil(horizon / step - 1e-9)) + 1), first


def disturbance_columns(reference: Reference, since: NDArray[np.bool_]) -> dict[str, Array]:
    """Inputs of a reference's disturbances, named by `disturbance_input`, where they act since some samples."""
    return {disturbance_input(n): np.where(since, v, 0.0) for n, v in reference.disturbance.items()}


def as_references(references: Reference | Iterable[Reference]) -> tuple[Reference, ...]:
    """One reference as well as several, as a tuple; an `InputError` where something else came."""
    meant = "a Step or a Move, or several, such as Step(0.1)"
    return as_tuple("references", references, Reference, meant)  # type: ignore[type-abstract]


def disturbance_input(name: str) -> str:
    """The loop's input by which a parameter or input of the plant is disturbed."""
    return f"disturbance.{name}"
