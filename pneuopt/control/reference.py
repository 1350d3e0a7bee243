"""References that a loop shall follow."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

import numpy as np

from pneuopt.errors import require
from pneuopt.trajectories import Trajectory


@dataclass(frozen=True)
class Step:
    """A step of the reference.

    Parameters
    ----------
    size : float
        Height, either sign [unit of the measured signal].
    at : float
        Instant [s].
    initial : float
        Value before [unit of the measured signal]: where it is a speed, the plant moves steadily when the step comes.
    horizon : float
        End of the experiment [s].
    start : mapping of str to float
        What else is known of the plant at time 0, by output: {"position": 0.25} [SI]. A `PneumaticDrive` also takes
        "pressure_b", as in its `rest`.
    """

    size: float
    at: float = 0.0
    initial: float = 0.0
    horizon: float = 1.0
    start: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        values = {"size": self.size, "at": self.at, "initial": self.initial, "horizon": self.horizon}
        values |= {f"start[{n!r}]": value for n, value in self.start.items()}
        for name, value in values.items():
            require(isfinite(value), f"Step: {name} must be a finite number, got {value}")
        require(self.size != 0, "Step: size must not be zero, there would be nothing to follow")
        require(self.at >= 0, f"Step: at must not be negative, got {self.at:g} s; time starts at zero")
        require(self.horizon > self.at, f"Step: horizon {self.horizon:g} s must lie after the step at {self.at:g} s")

    @property
    def final(self) -> float:
        """Value after the step [unit of the measured signal]."""
        return self.initial + self.size

    @property
    def label(self) -> str:
        """How a table heads it.

        Examples
        --------
        >>> Step(-0.2, start={"position": 0.25}).label
        '0 to -0.2, position 0.25'
        """
        return ", ".join([f"{self.initial:g} to {self.final:g}", *(f"{n} {v:g}" for n, v in self.start.items())])

    def trajectory(self, step: float) -> Trajectory:
        """The column "reference" on the grid 0, step, 2 step, ... to the horizon, held from sample to sample.

        Parameters
        ----------
        step : float
            Spacing of the grid [s]; the step's instant must lie on it.

        Returns
        -------
        Trajectory

        Raises
        ------
        InputError
            If the instant lies between two samples, or the grid is coarser than the horizon.

        Examples
        --------
        >>> Step(0.2, at=0.1, horizon=0.3).trajectory(0.1)["reference"].tolist()
        [0.0, 0.2, 0.2, 0.2]
        """
        require(0 < step < self.horizon, f"the grid's spacing {step:g} s must lie between 0 and {self.horizon:g} s")
        first = round(self.at / step)
        require(
            abs(first * step - self.at) <= 1e-9 * max(self.at, step),
            f"Step: at = {self.at:g} s falls between two samples of {step:g} s; use {first * step:g} s",
        )
        k = np.arange(int(np.ceil(self.horizon / step - 1e-9)) + 1)
        return Trajectory(k * step, {"reference": np.where(k >= first, self.final, self.initial)})
