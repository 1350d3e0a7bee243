"""What stands between a plant and its controller on a real rig: `Sensor`, `Actuator`; and `control.sensor.Encoder`."""

from dataclasses import dataclass
from math import inf

import numpy as np

from pneuopt.quantities.errors import require


@dataclass(frozen=True)
class Sensor:
    """What a channel's reading does to the truth: a lag of first order, then white noise, then rounding.

    Parameters
    ----------
    lag : float
        Time constant [s].
    noise : float
        Standard deviation [unit of the channel].
    resolution : float
        Step of the digital value [unit of the channel]; 0 is none.
    """

    lag: float = 0.0
    noise: float = 0.0
    resolution: float = 0.0

    def __post_init__(self) -> None:
        for name in ("lag", "noise", "resolution"):
            value = getattr(self, name)
            require(0 <= value < inf, f"Sensor: {name} must not be negative, got {value:g}; 0 is none")

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of noise and rounding together, the rounding taken as uniform [unit of the channel].

        Examples
        --------
        >>> round(Sensor(noise=2e-6, resolution=12e-6).standard_deviation * 1e6, 6)
        4.0
        """
        return float(np.hypot(self.noise, self.resolution / np.sqrt(12)))

    def reading(self, value: float, noise: float) -> float:
        """The digital value, `noise` being a draw of the standard normal distribution."""
        noisy = value + self.noise * noise
        return self.resolution * round(noisy / self.resolution) if self.resolution else noisy


@dataclass(frozen=True)
class Actuator:
    """What a valve, or an amplifier, makes of a command: hysteresis, then a dead zone.

    Parameters
    ----------
    hysteresis : float
        Width of the loop, as catalogues give it [unit of the command]: a play operator of half that width.
    dead_zone : float
        Half width of the commands around zero that do nothing [unit of the command]; beyond it the rest counts. The
        overlap of a `ProportionalValve` has its own parameter.
    """

    hysteresis: float = 0.0
    dead_zone: float = 0.0

    def __post_init__(self) -> None:
        for name in ("hysteresis", "dead_zone"):
            value = getattr(self, name)
            require(0 <= value < inf, f"Actuator: {name} must not be negative, got {value:g}; 0 is none")

    def apply_hysteresis(self, command: float, before: float) -> float:
        """The play operator: where the spool goes from `before` [unit of the command].

        Examples
        --------
        >>> valve = Actuator(hysteresis=0.2)
        >>> round(valve.apply_hysteresis(1.0, 0.0), 9), valve.apply_hysteresis(0.95, 0.9)
        (0.9, 0.9)
        """
        half = self.hysteresis / 2
        return min(max(before, command - half), command + half)

    def apply_dead_zone(self, value: float) -> float:
        """What is left beyond the dead zone [unit of the command]."""
        return value - min(max(value, -self.dead_zone), self.dead_zone)
