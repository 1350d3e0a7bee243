"""What stands between the measured signal and the controller."""

from dataclasses import dataclass
from math import inf

from pneuopt.errors import require
from pneuopt.parameters import Parameter, ParameterSet

SHORTEST = 1e-6  # [s]


@dataclass(frozen=True)
class SensorLag:
    """A sensor of first order: ``d(reading)/dt = (signal - reading)/lag``; the controller sees the reading.

    A speed that an encoder's counts are differentiated to lags by the filter's time constant and half a sample.

    Parameters
    ----------
    lag : float
        Default of the parameter "sensor.lag" [s].
    """

    lag: float

    def __post_init__(self) -> None:
        require(
            SHORTEST <= self.lag < inf,
            f"SensorLag: lag must be at least {SHORTEST:g} s, got {self.lag:g} s; without a lag leave the sensor out",
        )

    def parameters(self) -> ParameterSet:
        """The lag [s]."""
        return ParameterSet({"lag": Parameter(self.lag, "s", lower=SHORTEST)})
