"""Figures of a step response, with python-control's keys, relative to the step's size."""

from dataclasses import dataclass
from enum import Enum
from math import nan

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.errors import require

Array = NDArray[np.float64]

PERIODS_AT_END = 5
TAIL = 0.05


class About(Enum):
    """What the settling band lies around."""

    FINAL = "the final value, as python-control; the band is a fraction of the change"
    REFERENCE = "the reference; the band is a fraction of the step"


def step_metrics(
    t: ArrayLike,
    y: ArrayLike,
    reference_final: float,
    initial: float,
    *,
    start: float = 0.0,
    band: float = 0.02,
    about: About = About.FINAL,
    dither_period: float | None = None,
    control: ArrayLike | None = None,
    final: float | None = None,
) -> dict[str, float]:
    """Measure a step response.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time, strictly increasing [s]; samples before `start` are left out.
    y : array_like, shape (n,)
        The measured signal [unit].
    reference_final, initial : float
        The reference after the step, and the value before it [unit].
    start : float
        Instant of the step [s].
    band : float
        Half width of the settling band, as a fraction.
    about : About
        Centre of the band.
    dither_period : float, optional
        Average over this time first, without phase shift [s]: a whole number of dither periods (`Dither.period`).
    control : array_like, shape (n,), optional
        The command, for PeakControl [its unit]; it is not averaged.
    final : float, optional
        The final value where it is known (a dc gain) [unit]; by default the last sample, with dither the mean over the
        last periods (five, or as many as there are).

    Returns
    -------
    dict of str to float
        RiseTime
            From 10 to 90 % of the change from `initial` to the final value [s].
        SettlingTime
            From `start` until the response is in the band for good, interpolated linearly [s]; NaN if it never settles:
            it ends outside, or, where the final value is read off the record, it enters only in its last 5 %.
        SettlingMin, SettlingMax
            Range after 90 % is reached [unit].
        Overshoot, OvershootFinal
            Beyond the reference, in % of the step; beyond the final value, in % of the change (python-control's).
        Undershoot
            Below `initial`, in % of the step.
        Peak, PeakTime
            Extreme in the step's direction [unit], and when, from `start` [s].
        SteadyStateValue, SteadyStateError
            The final value [unit]; its distance from the reference, in % of the step.
        Ripple
            Peak to peak of the signal as it is, over the last periods, without dither over the last 5 % [unit].
        PeakControl
            Largest absolute command [its unit]; NaN without `control`.

    Raises
    ------
    InputError
        If the record does not fit together, holds NaN, or is too short for the dither's period.

    Examples
    --------
    A first-order lag of 1 s settles to 2 % after ln 50 = 3.912 s:

    >>> t = np.linspace(0.0, 20.0, 2001)
    >>> m = step_metrics(t, 1.0 - np.exp(-t), 1.0, 0.0)
    >>> round(m["SettlingTime"], 3), round(m["RiseTime"], 3), m["Overshoot"]
    (3.912, 2.197, 0.0)
    """
    raw = _record(t, y, reference_final, initial, start, band)
    size = reference_final - initial
    smooth = raw if dither_period is None else _averaged(raw, initial, dither_period)
    tail = _tail(raw, dither_period)
    steady = final if final is not None else float(smooth.y[-1] if dither_period is None else _mean(tail))
    change = steady - initial
    k = int(np.argmax(smooth.y * np.sign(size)))
    rise, after = _rise(smooth, initial, change)
    centre, width = (steady, band * abs(change)) if about is About.FINAL else (reference_final, band * abs(size))
    estimated = final is None and about is About.FINAL
    return {
        "RiseTime": rise,
        "SettlingTime": _settling(smooth, centre, width, estimated),
        "SettlingMin": float(min(after.min(), steady)) if after.size else nan,
        "SettlingMax": float(max(after.max(), steady)) if after.size else nan,
        "Overshoot": 100 * max(0.0, float(smooth.y[k] - reference_final) / size),
        "OvershootFinal": 100 * max(0.0, float(smooth.y[k] - steady) / change) if change * size > 0 else nan,
        "Undershoot": 100 * max(0.0, float(np.max((initial - smooth.y) / size))),
        "Peak": float(smooth.y[k]),
        "PeakTime": float(smooth.t[k]),
        "SteadyStateValue": steady,
        "SteadyStateError": 100 * abs(reference_final - steady) / abs(size),
        "Ripple": float(np.ptp(tail.y)),
        "PeakControl": _peak(t, control, start),
    }


@dataclass(frozen=True)
class _Record:
    """Samples from the step on; t is counted from the step."""

    t: Array
    y: Array


def _record(t: ArrayLike, y: ArrayLike, reference: float, initial: float, start: float, band: float) -> _Record:
    grid, values = np.asarray(t, dtype=float), np.asarray(y, dtype=float)
    require(grid.ndim == 1 and grid.shape == values.shape, f"t and y differ in shape: {grid.shape} and {values.shape}")
    require(bool(np.all(np.diff(grid) > 0)), "time must increase strictly")
    require(
        bool(np.all(np.isfinite(values))), "the response holds NaN or infinite values; a simulation that fails has none"
    )
    require(reference != initial, f"no step: the reference stays at {initial:g}")
    require(0 < band < 1, f"band is a fraction between 0 and 1, got {band:g}; 2 % is 0.02")
    kept = grid >= start - 1e-12 * max(1.0, abs(start))
    require(int(kept.sum()) >= 3, f"fewer than three samples after the step at {start:g} s")
    return _Record(grid[kept] - start, values[kept])


def _averaged(record: _Record, initial: float, period: float) -> _Record:
    """Centred mean over one period of a signal that is linear between samples, and `initial` before the step."""
    last = record.t[-1] - period / 2
    require(
        period > 0 and last > record.t[0] + period,
        f"the record of {record.t[-1]:g} s is too short to average over {period:g} s; simulate longer",
    )
    t = record.t[record.t <= last]
    mean = (_integral(record, initial, t + period / 2) - _integral(record, initial, t - period / 2)) / period
    return _Record(t, mean)


def _integral(record: _Record, initial: float, at: Array) -> Array:
    """From the step to `at`, of the signal that is linear between samples and `initial` before the first one."""
    t, y = record.t, record.y
    whole = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (y[1:] + y[:-1]))])
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    ahead = at - t[k]
    inside: Array = whole[k] + ahead * (y[k] + 0.5 * ahead * (y[k + 1] - y[k]) / (t[k + 1] - t[k]))
    return np.where(at < t[0], initial * (at - t[0]), inside)


def _tail(record: _Record, period: float | None) -> _Record:
    end, length = float(record.t[-1]), float(record.t[-1] - record.t[0])
    duration = TAIL * length if period is None else period * min(PERIODS_AT_END, int(length / period))
    inner = record.t > end - duration
    first = np.interp(end - duration, record.t, record.y)
    return _Record(np.concatenate([[end - duration], record.t[inner]]), np.concatenate([[first], record.y[inner]]))


def _mean(record: _Record) -> float:
    return float(np.trapezoid(record.y, record.t) / (record.t[-1] - record.t[0]))


def _rise(record: _Record, initial: float, change: float) -> tuple[float, Array]:
    """Time from 10 to 90 %, and the samples after 90 %; NaN and none where 90 % is never reached."""
    if change == 0:
        return nan, np.empty(0)
    z = (record.y - initial) / change
    reached = np.flatnonzero(z >= 0.9)
    if not reached.size:
        return nan, np.empty(0)
    return _first(record.t, z, 0.9) - _first(record.t, z, 0.1), record.y[reached[0] :]


def _first(t: Array, z: Array, level: float) -> float:
    k = int(np.flatnonzero(z >= level)[0])
    if k == 0:
        return float(t[0])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - z[k - 1]) / (z[k] - z[k - 1]))


def _settling(record: _Record, centre: float, width: float, estimated: bool) -> float:
    """The last crossing of the band, linear between samples."""
    t, distance = record.t, np.abs(record.y - centre)
    outside = np.flatnonzero(distance > width)
    if not outside.size:
        return 0.0
    k = int(outside[-1])
    if k == len(t) - 1:
        return nan
    edge = centre + width * np.sign(record.y[k] - centre)
    settled = float(t[k] + (t[k + 1] - t[k]) * (edge - record.y[k]) / (record.y[k + 1] - record.y[k]))
    return nan if estimated and settled > (1 - TAIL) * t[-1] else settled


def _peak(t: ArrayLike, control: ArrayLike | None, start: float) -> float:
    if control is None:
        return nan
    grid, values = np.asarray(t, dtype=float), np.asarray(control, dtype=float)
    require(grid.shape == values.shape, f"t and control differ in shape: {grid.shape} and {values.shape}")
    return float(np.max(np.abs(values[grid >= start - 1e-12 * max(1.0, abs(start))])))
