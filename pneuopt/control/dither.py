"""Dither: a fast small oscillation added to the command, so that moving parts do not stick."""

from dataclasses import dataclass
from enum import Enum
from fractions import Fraction
from math import inf, nextafter, pi

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pneuopt.control.tolerances import MAX_AVERAGED_PERIODS, MAX_BEAT_AMPLITUDE
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet

DITHER_AMPLITUDE, DITHER_OFFSET, DITHER_FREQUENCY = "dither.amplitude", "dither.offset", "dither.frequency"


class Waveform(Enum):
    """The oscillation's shape; both begin at zero, rising, and have amplitude for their peak.

    A square is not among them: it dwells at two values, and its average smooths no relay (Iannelli, Johansson,
    Jonsson & Vasca, Automatica 42(4), 2006).
    """

    SINE = "sine"
    TRIANGLE = "triangle"

    def at(self, phase: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Its value, of amplitude 1, at a phase [rad].

        Examples
        --------
        >>> Waveform.TRIANGLE.at(np.pi * np.array([0.0, 0.25, 0.5, 1.0, 1.5])).round(12).tolist()
        [0.0, 0.5, 1.0, 0.0, -1.0]
        """
        turns = np.asarray(phase, dtype=float) / (2 * pi) + 0.25
        wave = np.sin(phase) if self is Waveform.SINE else 1 - 4 * np.abs(turns - np.floor(turns) - 0.5)
        return np.asarray(wave, dtype=float)


@dataclass(frozen=True)
class Dither:
    """``offset + amplitude w(frequency t)``, w a sine or a triangle, added after the PID and before the clip.

    Parameters
    ----------
    frequency : float
        Default of the parameter of that name [Hz].
    analogue : bool
        With a sampled controller: a generator behind the controller adds the wave at all times, and the actuator
        clips the sum; the controller knows only the offset. Otherwise the wave is sampled and held with the command.
    waveform : Waveform
        A sine or a triangle of the same peak.
    """

    frequency: float = 160.0
    analogue: bool = False
    waveform: Waveform = Waveform.SINE

    def __post_init__(self) -> None:
        require(0 < self.frequency < inf, f"Dither: frequency must be positive, got {self.frequency} Hz")
        known = ", ".join(str(w) for w in Waveform)
        require(isinstance(self.waveform, Waveform), f"Dither: waveform is one of {known}, got {self.waveform!r}")

    def parameters(self, unit: str, sample_time: float | None = None) -> ParameterSet:
        """Amplitude (the peak) and offset [unit], zero by default, and frequency [Hz].

        Raises
        ------
        InputError
            If a sampled wave's frequency is not below the Nyquist frequency; that is also the parameter's upper bound.
        """
        self.check(self.frequency, sample_time)
        upper = inf if sample_time is None or self.analogue else nextafter(0.5 / sample_time, 0.0)
        return ParameterSet(
            {
                "amplitude": Parameter(0.0, unit, lower=0.0, meaning="peak of the oscillation"),
                "offset": Parameter(0.0, unit, meaning="constant added with it"),
                "frequency": Parameter(
                    self.frequency, "Hz", lower=0.0, upper=upper, meaning="frequency of the oscillation"
                ),
            }
        )

    def check(self, frequency: float, sample_time: float | None) -> None:
        """Raise `InputError` for a frequency [Hz] of zero, and for one that cannot be sampled."""
        require(frequency > 0, f"dither.frequency must be positive, got {frequency:g} Hz; for no dither: amplitude 0")
        if sample_time is None or self.analogue:
            return
        nyquist = 0.5 / sample_time
        require(
            frequency < nyquist,
            f"dither.frequency {frequency:g} Hz cannot be sampled every {sample_time * 1e3:g} ms: it must lie below "
            f"the Nyquist frequency {nyquist:g} Hz; lower it, sample faster, or let a generator behind the "
            "controller add it (analogue = true)",
        )

    def wave(self, t: ca.SX, p: Symbols) -> ca.SX:
        """The oscillation alone at time t [s], in the unit of the command."""
        if self.waveform is Waveform.SINE:
            return p["amplitude"] * ca.sin(2 * pi * p["frequency"] * t)
        turns = p["frequency"] * t + 0.25
        return p["amplitude"] * (1 - 4 * ca.fabs(turns - ca.floor(turns) - 0.5))

    def period(self, frequency: float, sample_time: float | None) -> float:
        """Shortest time over which averaging removes the dither [s]: whole periods, and samples where it is sampled.

        As few periods as leave a thousandth of the amplitude; at most 20, beyond that the beat between dither and
        sampling is left.

        Examples
        --------
        >>> Dither().period(160.0, None), Dither().period(160.0, 1e-3)
        (0.00625, 0.025)
        """
        if sample_time is None:
            return 1 / frequency
        step = frequency * sample_time
        for joined in range(1, MAX_AVERAGED_PERIODS + 1):
            beyond = (joined / step) % 1.0
            if (
                20 * step**3 * beyond * (1 - beyond) <= MAX_BEAT_AMPLITUDE * joined
            ):  # (w h)^2/8 of the part of a sample at the end
                return joined / frequency
        return Fraction(1 / step).limit_denominator(MAX_AVERAGED_PERIODS).denominator / frequency
