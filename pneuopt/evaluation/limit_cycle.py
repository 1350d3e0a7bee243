"""Detection of limit cycles, hunting and crawl, in a response or a log.

A limit cycle repeats (its autocorrelation has a second peak), keeps its amplitude (a decaying ringing is none) and
remains in the mean over a dither period.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import log

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.evaluation.metric import period_mean, remove_ripple
from pneuopt.evaluation.tolerances import (
    CROSSING_HYSTERESIS,
    DECAY_RATIO,
    MAX_PERIOD_SPREAD,
    MIN_AUTOCORRELATION,
    MIN_CYCLES,
    MIN_RELATIVE_AMPLITUDE,
    PHASES_PER_CYCLE,
    STANDSTILL_FRACTION,
    SUSTAINED_RATIO,
    TRANSIENT_SHARE,
    WINDOWS_PER_PERIOD,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import require


@dataclass(frozen=True)
class LimitCycle:
    """A sustained oscillation.

    Attributes
    ----------
    amplitude : float
        Half the peak-to-peak value of the mean cycle [unit of the signal].
    frequency : float
        [Hz]
    stick_share : float
        Share of the time at a standstill, where the signal is a speed.
    cycles : int
        Number of cycles in the record.
    """

    amplitude: float
    frequency: float
    stick_share: float
    cycles: int

    def describe(self, unit: str) -> str:
        """Describe the limit cycle in a clause.

        Examples
        --------
        >>> LimitCycle(0.012, 2.34, 0.4, 7).describe("m/s")
        'a limit cycle of +-0.012 m/s at 2.34 Hz, at a standstill 40 % of the time'
        """
        sticks = f", at a standstill {100 * self.stick_share:.0f} % of the time" if self.stick_share >= 0.005 else ""
        return f"a limit cycle of +-{self.amplitude:.3g} {unit} at {self.frequency:.3g} Hz{sticks}"


def find_limit_cycle(
    t: ArrayLike,
    y: ArrayLike,
    *,
    start: float | None = None,
    dither_period: float | None = None,
    min_amplitude: float | None = None,
    standstill_speed: float | None = None,
) -> LimitCycle | None:
    """Find a limit cycle in a signal under a constant reference.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time, strictly increasing [s].
    y : array_like, shape (n,)
        The signal, a speed for example [unit].
    start : float, optional
        Where the search starts [s]; by default after the first 40 % of the record, the transient.
    dither_period : float, optional
        The ripple of a dither with this period is removed first [s] (`ClosedLoop.dither_period`): it is no limit cycle.
    min_amplitude : float, optional
        Smallest amplitude that counts [unit]; by default 1 % of the record's range.
    standstill_speed : float, optional
        Largest absolute speed that counts as standstill [unit]; by default 2 % of the largest after `start`.

    Returns
    -------
    LimitCycle or None
        None for noise, for a ringing that decays, and for fewer than three cycles.

    Raises
    ------
    InputError
        If t and y differ in shape, time does not increase, y holds NaN, or the record is too short to average.

    Examples
    --------
    >>> t = np.linspace(0.0, 4.0, 2001)
    >>> hunting = 0.05 + 0.02 * np.sin(2 * np.pi * 2.5 * t)
    >>> print(find_limit_cycle(t, hunting).describe("m/s"))
    a limit cycle of +-0.02 m/s at 2.5 Hz
    >>> find_limit_cycle(t, 0.05 + 0.02 * np.exp(-t) * np.sin(2 * np.pi * 2.5 * t)) is None
    True
    """
    grid, values = np.asarray(t, dtype=float), np.asarray(y, dtype=float)
    require(grid.ndim == 1 and grid.shape == values.shape, f"t and y differ in shape: {grid.shape} and {values.shape}")
    require(
        len(grid) > 2 and bool(np.all(np.diff(grid) > 0)), "time must increase strictly, over at least three samples"
    )
    require(bool(np.all(np.isfinite(values))), "the signal holds NaN; cut the record, or fill it")
    begin = grid[0] + TRANSIENT_SHARE * (grid[-1] - grid[0]) if start is None else start
    require(begin < grid[-1], f"start = {begin:g} s lies behind the record's end, {grid[-1]:g} s")
    at, swing = _detrend_signal(grid, values, begin, dither_period)
    smallest = MIN_RELATIVE_AMPLITUDE * np.ptp(values) if min_amplitude is None else min_amplitude
    lag = _period_in_samples(swing) if np.ptp(swing) >= 2 * smallest > 0 else 0
    if lag == 0:
        return None
    # the trend is the straight line through the means over whole periods, on which part of a period has no effect
    whole = np.convolve(swing, np.ones(lag) / lag, "valid")
    line = np.polyfit(np.arange(len(whole)) + (lag - 1) / 2, whole, 1)
    swing = swing - np.polyval(line, np.arange(len(swing)))
    smooth = np.convolve(swing, np.ones(1 + lag // WINDOWS_PER_PERIOD) / (1 + lag // WINDOWS_PER_PERIOD), "same")
    crossings = _rising_crossings(at, smooth)
    if len(crossings) <= MIN_CYCLES or np.std(np.diff(crossings)) > MAX_PERIOD_SPREAD * np.mean(np.diff(crossings)):
        return None
    phases = np.array([np.linspace(a, b, PHASES_PER_CYCLE) for a, b in pairwise(crossings)])
    amplitude = float(np.ptp(np.interp(phases, at, swing).mean(axis=0)) / 2)
    if amplitude < smallest or _is_decaying(np.ptp(np.interp(phases, at, smooth), axis=1)):
        return None
    size = np.abs(values[grid >= begin])
    share = float(np.mean(size <= (STANDSTILL_FRACTION * size.max() if standstill_speed is None else standstill_speed)))
    count = len(crossings) - 1
    return LimitCycle(amplitude, float(count / (crossings[-1] - crossings[0])), share, count)


def _detrend_signal(t: Array, y: Array, begin: float, period: float | None) -> tuple[Array, Array]:
    """Time and signal on an even grid from `begin` on, without its dither's ripple, less its straight line."""
    edge = 0.0 if period is None else period / 2
    first, last = max(begin, t[0] + edge), t[-1]
    require(first + edge < last, f"the record of {t[-1] - t[0]:g} s is too short to average over {2 * edge:g} s")
    at = np.linspace(first, last, max(3, int((last - first) / np.median(np.diff(t))) + 1))
    if period is not None:
        means = period_mean(t, y[None], y[0], period, t[t <= last - edge])
        y = remove_ripple(t, y[None], means, period).signal[0]
    level = np.interp(at, t, y)
    return at, level - np.polyval(np.polyfit(at - at[0], level, 1), at - at[0])


def _period_in_samples(swing: Array) -> int:
    """Period in samples: the autocorrelation's second peak within a third of the record; 0 where there is none."""
    n = len(swing)
    power = np.abs(np.fft.rfft(swing, 2 * n)) ** 2
    r = np.fft.irfft(power)[: n // MIN_CYCLES] * n / (n - np.arange(n // MIN_CYCLES))
    below = np.flatnonzero(r < 0)
    if not len(below) or r[below[0] :].max() < MIN_AUTOCORRELATION * r[0]:
        return 0
    return int(below[0] + np.argmax(r[below[0] :]))


def _rising_crossings(t: Array, swing: Array) -> Array:
    """Instants of the rising zero crossings that pass `CROSSING_HYSTERESIS` standard deviations on both sides."""
    level = CROSSING_HYSTERESIS * np.std(swing)
    side = np.where(swing > level, 1, np.where(swing < -level, -1, 0))
    far = np.flatnonzero(side)
    up = np.flatnonzero(np.diff(side[far]) > 0)
    found = []
    for before, after in zip(far[up], far[up + 1], strict=True):
        k = before + np.flatnonzero((swing[before:after] < 0) & (swing[before + 1 : after + 1] >= 0))[-1]
        found.append(t[k] - swing[k] * (t[k + 1] - t[k]) / (swing[k + 1] - swing[k]))
    return np.array(found)


def _is_decaying(sizes: Array) -> bool:
    """Whether the peak-to-peak values of the cycles decay, by the slope of their logarithm and its standard error."""
    k = np.arange(len(sizes)) - (len(sizes) - 1) / 2
    logs = np.log(np.maximum(sizes, 1e-300))
    slope = float(k @ logs / (k @ k))
    left = logs - logs.mean() - slope * k
    error = float(np.sqrt(left @ left / max(1, len(sizes) - 2) / (k @ k)))
    return slope < log(DECAY_RATIO) or slope + 2 * error < log(SUSTAINED_RATIO)
