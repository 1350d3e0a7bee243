"""References that a loop shall follow, and disturbances against which it shall hold them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite

import numpy as np

from pneuopt.quantities.arguments import as_tuple
from pneuopt.quantities.errors import require
from pneuopt.quantities.trajectories import Trajectory


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
    def final(self) -> float:
        """Value after the step [unit of the measured signal]."""
        return self.initial + self.size

    @property
    def is_step(self) -> bool:
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
        lead = f"{self.initial:g} to {self.final:g}" if self.is_step else f"{self.initial:g} held"
        told = [f"{n} {v:g}" for n, v in self.start.items()] + [f"{n} {v:+g}" for n, v in self.disturbance.items()]
        return ", ".join([lead, *told])

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
        columns = {"reference": np.where(k >= first, self.final, self.initial)}
        columns |= {disturbance_input(n): np.where(k >= first, v, 0.0) for n, v in self.disturbance.items()}
        return Trajectory(k * step, columns)


def as_steps(references: Step | Iterable[Step]) -> tuple[Step, ...]:
    """One Step as well as several, as a tuple; an `InputError` where something else came."""
    return as_tuple("references", references, Step, "a Step or several, such as Step(0.1)")


def disturbance_input(name: str) -> str:
    """The loop's input by which a parameter or input of the plant is disturbed."""
    return f"disturbance.{name}"
