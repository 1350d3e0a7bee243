"""Sine dither: a fast small oscillation added to the command, so that spool and piston do not stick."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import inf, nextafter, pi

import casadi as ca

from pneuopt.errors import require
from pneuopt.parameters import Parameter, ParameterSet

Symbols = Mapping[str, ca.SX]


@dataclass(frozen=True)
class Dither:
    """``offset + amplitude sin(2 pi frequency t)``, added after the PID and before the clip.

    Parameters
    ----------
    frequency : float
        Default of the parameter of that name [Hz].
    analogue : bool
        With a sampled controller: a generator behind the controller adds the sine at all times, and the actuator
        clips the sum; the controller knows only the offset. Otherwise the sine is sampled and held with the command.
    """

    frequency: float = 160.0
    analogue: bool = False

    def __post_init__(self) -> None:
        require(0 < self.frequency < inf, f"Dither: frequency must be positive, got {self.frequency} Hz")

    def parameters(self, unit: str, sample_time: float | None = None) -> ParameterSet:
        """Amplitude (the peak) and offset [unit], zero by default, and frequency [Hz].

        Raises
        ------
        InputError
            If a sampled sine's frequency is not below the Nyquist frequency; that is also the parameter's upper bound.
        """
        self.check(self.frequency, sample_time)
        upper = inf if sample_time is None or self.analogue else nextafter(0.5 / sample_time, 0.0)
        return ParameterSet(
            {
                "amplitude": Parameter(0.0, unit, lower=0.0),
                "offset": Parameter(0.0, unit),
                "frequency": Parameter(self.frequency, "Hz", lower=0.0, upper=upper),
            }
        )

    def check(self, frequency: float, sample_time: float | None) -> None:
        """Raise `InputError` if a sampled sine of `frequency` [Hz] is at or above the Nyquist frequency."""
        if sample_time is None or self.analogue:
            return
        nyquist = 0.5 / sample_time
        require(
            frequency < nyquist,
            f"dither.frequency {frequency:g} Hz cannot be sampled every {sample_time * 1e3:g} ms: it must lie below "
            f"the Nyquist frequency {nyquist:g} Hz; lower it, sample faster, or use Dither(analogue=True)",
        )

    def sine(self, t: ca.SX, p: Symbols) -> ca.SX:
        """The oscillation alone at time t [s], in the unit of the command."""
        return p["amplitude"] * ca.sin(2 * pi * p["frequency"] * t)

    def period(self, frequency: float, sample_time: float | None) -> float:
        """Shortest time over which averaging removes the dither [s]: whole periods, and samples where it is sampled.

        At most 20 periods are joined; beyond that the beat between dither and sampling is left.

        Examples
        --------
        >>> Dither().period(160.0, None), Dither().period(160.0, 1e-3)
        (0.00625, 0.025)
        """
        if sample_time is None or self.analogue:
            return 1 / frequency
        return Fraction(1 / (frequency * sample_time)).limit_denominator(20).denominator / frequency
