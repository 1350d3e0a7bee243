"""Figures of a step response, with python-control's keys, relative to the step's size."""

from dataclasses import dataclass
from enum import Enum
from math import nan

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.errors import require

Array = NDArray[np.float64]

PERIODS_AT_END = 5
PERIODS_INSIDE = 2  # of the dither, at least, of a response that has settled
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
            it ends outside, or enters for good only in the last 5 % of the record after `start`, with dither in its
            last two periods if those are longer: what passes through the band looks so as well.
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
    grid, values = np.asarray(t, dtype=float), np.asarray(y, dtype=float)
    require(grid.ndim == 1 and grid.shape == values.shape, f"t and y differ in shape: {grid.shape} and {values.shape}")
    commands = None if control is None else np.asarray(control, dtype=float)
    found = batch_metrics(
        grid,
        values[None],
        reference_final,
        initial,
        start=start,
        band=band,
        about=about,
        dither_period=dither_period,
        control=commands if commands is None else commands[None],
        final=final,
    )
    return {name: float(value[0]) for name, value in found.items()}


def batch_metrics(
    t: Array,
    y: Array,
    reference_final: float,
    initial: float,
    *,
    start: float = 0.0,
    band: float = 0.02,
    about: About = About.FINAL,
    dither_period: float | None = None,
    control: Array | None = None,
    final: float | None = None,
) -> dict[str, Array]:
    """Measure many step responses on one grid at once; see `step_metrics`.

    Parameters
    ----------
    t : ndarray, shape (n,)
    y, control : ndarray, shape (m, n)
        A row a response.

    Returns
    -------
    dict of str to ndarray, shape (m,)
    """
    raw = _record(t, y, reference_final, initial, start, band)
    size = reference_final - initial
    smooth = raw if dither_period is None else _averaged(raw, initial, dither_period)
    tail = _tail(raw, dither_period)
    last = smooth.y[:, -1] if dither_period is None else _mean(tail)
    steady = last if final is None else np.full(len(raw.y), final)
    change = steady - initial
    peak = _at(smooth.y, np.argmax(smooth.y * np.sign(size), axis=1))
    rise, lowest, highest = _rise(smooth, initial, change)
    centre, width = (steady, band * np.abs(change))
    if about is About.REFERENCE:
        centre, width = np.full_like(steady, reference_final), np.full_like(steady, band * abs(size))
    latest = raw.t[-1] - max(TAIL * raw.t[-1], PERIODS_INSIDE * (dither_period or 0.0))
    with np.errstate(all="ignore"):
        beyond = np.where(change * size > 0, 100 * np.maximum(0.0, (peak - steady) / change), nan)
    return {
        "RiseTime": rise,
        "SettlingTime": _settling(smooth, centre, width, latest),
        "SettlingMin": np.minimum(lowest, steady),
        "SettlingMax": np.maximum(highest, steady),
        "Overshoot": 100 * np.maximum(0.0, (peak - reference_final) / size),
        "OvershootFinal": beyond,
        "Undershoot": 100 * np.maximum(0.0, np.max((initial - smooth.y) / size, axis=1)),
        "Peak": peak,
        "PeakTime": smooth.t[np.argmax(smooth.y * np.sign(size), axis=1)],
        "SteadyStateValue": steady,
        "SteadyStateError": 100 * np.abs(reference_final - steady) / abs(size),
        "Ripple": np.ptp(tail.y, axis=1),
        "PeakControl": _peak(t, control, start, len(raw.y)),
    }


@dataclass(frozen=True)
class _Record:
    """Samples from the step on, a row a response; t is counted from the step."""

    t: Array
    y: Array


def _record(t: Array, y: Array, reference: float, initial: float, start: float, band: float) -> _Record:
    require(bool(np.all(np.diff(t) > 0)), "time must increase strictly")
    require(bool(np.all(np.isfinite(y))), "the response holds NaN or infinite values; a simulation that fails has none")
    require(reference != initial, f"no step: the reference stays at {initial:g}")
    require(0 < band < 1, f"band is a fraction between 0 and 1, got {band:g}; 2 % is 0.02")
    kept = _since(t, start)
    require(int(kept.sum()) >= 3, f"fewer than three samples after the step at {start:g} s")
    return _Record(t[kept] - start, y[:, kept])


def _since(t: Array, start: float) -> NDArray[np.bool_]:
    return np.asarray(t >= start - 1e-12 * max(1.0, abs(start)))


def _averaged(record: _Record, initial: float, period: float) -> _Record:
    """Centred mean over one period of a signal that is linear between samples, and `initial` before the step."""
    last = record.t[-1] - period / 2
    require(
        period > 0 and last > record.t[0] + period,
        f"the record of {record.t[-1]:g} s is too short to average over {period:g} s; simulate longer",
    )
    t = record.t[record.t <= last]
    steps = 0.5 * np.diff(record.t) * (record.y[:, 1:] + record.y[:, :-1])
    whole = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    ends = (_integral(record, whole, initial, t + side * period / 2) for side in (1, -1))
    return _Record(t, (next(ends) - next(ends)) / period)


def _integral(record: _Record, whole: Array, initial: float, at: Array) -> Array:
    """From the step to `at`, of the signal that is linear between samples and `initial` before the first one."""
    t, y = record.t, record.y
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    ahead = at - t[k]
    inside: Array = whole[:, k] + ahead * (y[:, k] + 0.5 * ahead * (y[:, k + 1] - y[:, k]) / (t[k + 1] - t[k]))
    return np.where(at < t[0], initial * (at - t[0]), inside)


def _tail(record: _Record, period: float | None) -> _Record:
    t, y = record.t, record.y
    duration = TAIL * (t[-1] - t[0]) if period is None else period * min(PERIODS_AT_END, int((t[-1] - t[0]) / period))
    begin = t[-1] - duration
    k = min(max(int(np.searchsorted(t, begin, side="right")) - 1, 0), len(t) - 2)
    first = y[:, [k]] + (begin - t[k]) / (t[k + 1] - t[k]) * (y[:, [k + 1]] - y[:, [k]])
    return _Record(np.append(begin, t[t > begin]), np.concatenate([first, y[:, t > begin]], axis=1))


def _mean(record: _Record) -> Array:
    return np.asarray(np.trapezoid(record.y, record.t, axis=1) / (record.t[-1] - record.t[0]))


def _rise(record: _Record, initial: float, change: Array) -> tuple[Array, Array, Array]:
    """Time from 10 to 90 %, and the range from there on; NaN where 90 % is never reached."""
    with np.errstate(all="ignore"):
        z = (record.y - initial) / np.where(change == 0, nan, change)[:, None]
    reached = (z >= 0.9).any(axis=1)
    after = np.arange(len(record.t)) >= np.argmax(z >= 0.9, axis=1)[:, None]
    rise = _first(record.t, z, 0.9) - _first(record.t, z, 0.1)
    lowest, highest = np.where(after, record.y, np.inf).min(axis=1), np.where(after, record.y, -np.inf).max(axis=1)
    return np.where(reached, rise, nan), np.where(reached, lowest, nan), np.where(reached, highest, nan)


def _first(t: Array, z: Array, level: float) -> Array:
    """When each row first reaches the level, if it does."""
    k = np.argmax(z >= level, axis=1)
    before = np.maximum(k - 1, 0)
    low, high = _at(z, before), _at(z, k)
    with np.errstate(all="ignore"):
        between = t[before] + (t[k] - t[before]) * (level - low) / (high - low)
    return np.asarray(np.where(k == 0, t[0], between))


def _settling(record: _Record, centre: Array, width: Array, latest: float) -> Array:
    """The last crossing of the band, linear between samples; NaN for one after `latest`."""
    t, y = record.t, record.y
    outside = np.abs(y - centre[:, None]) > width[:, None]
    k = len(t) - 1 - np.argmax(outside[:, ::-1], axis=1)
    after = np.minimum(k + 1, len(t) - 1)
    last, following = _at(y, k), _at(y, after)
    edge = centre + width * np.sign(last - centre)
    with np.errstate(all="ignore"):
        settled = t[k] + (t[after] - t[k]) * (edge - last) / (following - last)
    settled = np.where(outside[:, -1] | ~(settled <= latest), nan, settled)
    return np.where(outside.any(axis=1), settled, 0.0)


def _at(rows: Array, k: NDArray[np.intp]) -> Array:
    """One sample of each row."""
    return np.asarray(rows[np.arange(len(rows)), k], dtype=float)


def _peak(t: Array, control: Array | None, start: float, rows: int) -> Array:
    if control is None:
        return np.full(rows, nan)
    fits = control.shape[-1:] == t.shape
    require(fits, f"t and control differ in shape: {t.shape} and {control.shape[-1:]}")
    return np.asarray(np.max(np.abs(control[:, _since(t, start)]), axis=1))
