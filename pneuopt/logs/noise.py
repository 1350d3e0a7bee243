"""A channel's white noise and its resolution, from itself alone.

A difference of k-th order cancels any motion that is a polynomial below that order over k + 1 samples, and keeps white
noise. Which order a log needs depends on how fast it moves for its sampling, so all are tried, in blocks of the log.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.logs.tolerances import (
    BLOCK,
    LATTICE_TOLERANCE,
    MAX_CORRELATION,
    MAX_OFF_PERIOD,
    MIN_SAMPLES,
    MIN_VARIED_SHARE,
    ORDERS,
    ROUNDING,
    WHITE_LAGS,
)
from pneuopt.quantities.arrays import Array, Mask


class NoiseEstimate(NamedTuple):
    """What a channel shows of its noise."""

    random: float  # standard deviation of its white noise [unit of the channel]; NaN for a constant channel
    resolution: float  # step of the lattice on which its values lie [unit of the channel]; 0 where they lie on none
    is_white: bool = True  # otherwise `random` counts motion too fast for the sampling, or hum: the noise is less

    @property
    def level(self) -> float:
        """Standard deviation [unit of the channel], at least the step / sqrt(12) of a rounding to the resolution."""
        return max(self.random, self.resolution / math.sqrt(12))

    @property
    def is_quantisation(self) -> bool:
        """Whether the resolution is what limits the channel."""
        return self.resolution > math.sqrt(12) * self.random


def noise_level(column: ArrayLike, t: ArrayLike | None = None) -> float:
    """The standard deviation of a channel's white noise or of its rounding, the larger one; see `estimate_noise`."""
    return estimate_noise(column, t).level


def estimate_noise(column: ArrayLike, t: ArrayLike | None = None) -> NoiseEstimate:
    """Estimate white noise and resolution from a channel (n,) alone, NaN where a sample is missing; `t` [s] if uneven.

    The level is that of the lowest order of differences which shows hardly more than the least of all orders, in the
    quietest quarter of the log: motion slower than a tenth of the sampling rate, steps and outliers do not count.
    """
    y = np.asarray(column, dtype=float)
    time = np.arange(y.size, dtype=float)
    if t is not None:  # in samples, too, if even but for the rounding of doubles, which is coarse from 1.7e9 s on
        stamps = np.asarray(t, dtype=float)
        steps = np.diff(stamps)
        rounding = max(1e-6 * np.max(steps, initial=0.0), 4 * np.spacing(np.max(np.abs(stamps), initial=0.0)))
        time = time if not steps.size or np.ptp(steps) <= rounding else stamps - stamps[0]
    known = np.isfinite(y)
    if not np.any(np.diff(y[known])):
        return NoiseEstimate(math.nan, 0.0)
    resolution = find_resolution(y[known])
    # a lattice leaves medians on its steps; a uniform dither of its step takes them off, and its variance is known
    dithered = y + resolution * (np.random.default_rng(0).random(y.size) - 0.5)
    # a slow sensor has no neighbours, or too few of them for high orders
    levels = _levels(time, dithered)
    if not known.all():
        levels = max(levels, _levels(time[known], dithered[known]), key=len)
    least = min(level.value for level in levels)
    chosen = next(level for level in levels if level.value <= (1 + level.uncertainty) * least)
    random = math.sqrt(max(chosen.value**2 - resolution**2 / 12, 0.0))
    # white: its differences are uncorrelated beyond their own length
    finite, order = np.isfinite(chosen.off), chosen.order
    e = np.where(finite, np.clip(chosen.off, -4 * chosen.value, 4 * chosen.value), 0.0)
    lags = range(order + 1, min(order + 1 + WHITE_LAGS, e.size - 1))
    correlation = max((abs(float(e[k:] @ e[:-k])) for k in lags), default=0.0)
    chance = 4 * (1 + order) ** 0.25 / math.sqrt(max(1, int(finite.sum())))
    is_white = correlation <= min(MAX_CORRELATION + chance, 0.5) * float(e @ e)
    return NoiseEstimate(random, resolution, is_white)


def find_resolution(values: ArrayLike, bins: int = 50, candidates: int = 6) -> float:
    """The step of a sensor on whose multiples all values (n,) lie, but for their decimals; 0 where there is none.

    The step of an encoder is no round number, and a log writes it with decimals. So it is one of the most frequent
    differences of neighbours: the largest one on whose lattice all values lie. Where there is none, it is that of the
    decimals.

    Examples
    --------
    >>> x = np.sqrt(np.arange(50.0))
    >>> round(find_resolution(np.round(x / 0.02) * 0.02), 9), find_resolution(x)
    (0.02, 0.0)
    """
    values = np.asarray(values, dtype=float)
    smallest = ROUNDING * float(np.max(np.abs(values), initial=0.0))
    decimals, steps = _decimals(values, smallest), list[float]()
    for order in (1, 2):
        sizes = np.abs(np.diff(values, order))
        sizes = sizes[sizes > max(smallest, 0.5 * decimals)]
        if sizes.size:
            unit = max(decimals, float(np.median(sizes)) / bins)
            places, counts = np.unique(np.round(sizes / unit), return_counts=True)
            below = np.concatenate([[0], np.cumsum(counts)])  # decimals move a difference by one place
            near = below[np.searchsorted(places, places + 1, "right")] - below[np.searchsorted(places, places - 1)]
            frequent = places[np.argsort(-near, kind="stable")[:candidates]]
            steps += [float(np.mean(sizes[np.abs(sizes / unit - k) <= 1.5])) for k in frequent]
    written = max(decimals, _last_digit(values), 4 * smallest)
    return max([decimals, *(_fit_lattice(values, step, written) for step in steps if step > 4 * decimals)])


class Refresh(NamedTuple):
    """When a sensor that is slower than its log has a new value."""

    period: float  # [rows] from one to the next
    fresh: Mask  # the rows with a new value, shape (n,)


def find_refresh(column: ArrayLike, t: ArrayLike | None = None) -> Refresh | None:
    """The rows at which a sensor slower than its log is new, from a channel (n,); None where it keeps up.

    A slow sensor changes at multiples of its period only, by a count or by many; an encoder that stands or creeps
    changes at any row, by one count. `t` [s] if rows are missing.

    Examples
    --------
    >>> find_refresh(np.repeat(np.sqrt(np.arange(30.0)), 4)).period
    4
    """
    y = np.asarray(column, dtype=float)
    stamps = np.arange(y.size, dtype=float) if t is None else np.asarray(t, dtype=float)
    rows = np.round((stamps - stamps[0]) / max(float(np.median(np.diff(stamps))), 1e-300))
    known = np.flatnonzero(np.isfinite(y))
    jumps = np.diff(y[known])
    moved = known[1:][(jumps != 0) & (np.diff(rows[known]) == 1)]  # across a lost row nobody knows when it was
    sizes = np.abs(jumps[jumps != 0])
    if moved.size < 2 * MIN_SAMPLES or sizes.max() < 1.5 * sizes.min():  # the same count each time: a slow motion
        return None
    period, phase = _refresh_period(rows[moved])
    is_new = np.asarray((rows - phase) % period < 1)
    off, by_chance = float(np.count_nonzero(~is_new[moved])), moved.size * (1 - 1 / period)
    return Refresh(period, is_new) if off <= MAX_OFF_PERIOD * by_chance and by_chance > MIN_SAMPLES else None


def _refresh_period(at: Array) -> tuple[float, float]:
    """The period [rows] on whose multiples the numbers of the rows that change lie, and its phase: in [phase, +1)."""
    gaps, (sizes, counts) = np.diff(at), np.unique(np.diff(at), return_counts=True)
    usual = sizes[np.argmax(counts)]
    period = float(gaps[np.abs(gaps - usual) <= 1].mean())
    for reach in (8.0, 64.0, 512.0, math.inf):  # a long rest is numbered once the period is known so well
        count = np.concatenate([[0.0], np.cumsum(np.round(gaps / period))])
        part = np.concatenate([[0], np.cumsum(gaps > reach * usual)])
        number = np.bincount(part)
        off, spread = (y - (np.bincount(part, y) / number)[part] for y in (at, count))
        period = float(off @ spread / (spread @ spread)) if spread.any() else period
    period = round(period) if abs(period - round(period)) * count[-1] < 0.5 else period
    low, high = np.quantile(at - period * count, [0.005, 0.995])
    return max(period, 1.0), float(low + high - 1) / 2


def _last_digit(values: Array, most: int = 12) -> float:
    """The last digit of the largest value, where all are written with as many significant digits; else 0."""
    sizes = np.abs(values)
    sizes = sizes[sizes > ROUNDING * sizes.max()]
    places = np.floor(np.log10(sizes)).astype(int)
    for digits in range(3, most):
        scaled = sizes * 10.0 ** (digits - 1 - places)
        if np.all(np.abs(np.round(scaled) - scaled) < 1e-3):
            return float(10.0 ** (int(places.max()) - digits + 1))
    return 0.0


def _decimals(values: Array, smallest: float) -> float:
    """The step of the lattice on which all values lie to their rounding as doubles; 0 where there is none."""
    # second differences are on the same lattice, and small however fast the motion is; of a perfect ramp there are none
    for order in (2, 1):
        sizes = np.sort(np.abs(np.diff(values, order)))
        gaps = np.diff(sizes, prepend=0.0)
        gaps = gaps[gaps > smallest]
        if gaps.size:
            break
    else:
        return 0.0
    step, offsets = float(gaps.min()), values - values[0]
    counts = np.round(offsets / step)
    step = float(offsets @ counts / (counts @ counts)) if counts.any() else 0.0
    lies_on = float(np.max(np.abs(offsets - step * counts))) < LATTICE_TOLERANCE * step
    return step if lies_on and smallest < LATTICE_TOLERANCE * step else 0.0


def _fit_lattice(values: Array, step: float, written: float, most: int = 1000, largest: float = 300.0) -> float:
    """The step of the lattice about a given one on which all values lie, but for their decimals; 0 where they do not.

    Counts of neighbours are added up: they are small, so that a step known to a per cent numbers them. A motion at one
    speed makes steps, too: they are a sensor's only where they vary.
    """
    sizes = np.diff(values)
    used = np.flatnonzero((sizes != 0) & (np.abs(sizes) < largest * step))[:most]
    if not used.size:
        return 0.0
    sizes = sizes[used]
    # the step near the given one by which most differences are whole numbers, to an eighth of a count of the largest
    tried = step * np.linspace(0.95, 1.05, 1 + math.ceil(0.8 * float(np.max(np.abs(sizes))) / step))
    step = float(max(tried, key=lambda s: abs(np.exp(2j * np.pi / s * sizes).sum())))
    part = values[: used[-1] + 2]
    if part.size < values.size and _off_lattice(part, step)[1] > 4 * min(step / 4, written):
        return 0.0  # as most steps that are tried
    moves = np.round(np.diff(values) / step)
    varies = np.count_nonzero(np.diff(moves)) > MIN_VARIED_SHARE * values.size
    step, farthest = _off_lattice(values, step)
    return step if varies and step > 0 and farthest <= min(step / 4, written) else 0.0


def _off_lattice(values: Array, step: float) -> tuple[float, float]:
    """The step that fits the counts by a given one best, and how far the farthest value lies off its lattice."""
    counts = np.concatenate([[0.0], np.cumsum(np.round(np.diff(values) / step))])
    off, spread = values - values.mean(), counts - counts.mean()
    step = float(off @ spread / (spread @ spread)) if spread.any() else 0.0
    return step, float(np.max(np.abs(off - step * spread)))


class _Level(NamedTuple):
    """The standard deviation of white noise that would show as much in the differences `off` of an order.

    The uncertainty is its standard deviation by chance, over itself.
    """

    value: float
    uncertainty: float
    order: int
    off: Array


def _levels(t: Array, y: Array) -> list[_Level]:
    """Levels by order of difference."""
    out = []
    for order in (k for k in ORDERS if 2 * k < y.size):
        off = _differences(t, y, order)
        found = off[np.isfinite(off)]
        if found.size > order:
            out.append(_Level(*_quiet_level(found, order), order, off))
    return out


def _quiet_level(off: Array, order: int) -> tuple[float, float]:
    """The deviation of all differences or of their quietest blocks, and its standard deviation, over itself."""
    # neighbours share samples: this many count as one
    shared = math.comb(4 * order, 2 * order) / math.comb(2 * order, order) ** 2
    # 1.17 / sqrt(n): standard deviation of the median absolute deviation of n normal numbers, over itself
    uncertainty = 1.17 * math.sqrt(shared / off.size)
    sizes, count = np.abs(off), max(1, off.size // BLOCK)
    whole = 1.4826 * float(np.median(sizes))
    if count < 4:  # a quarter of them is none
        return whole, uncertainty
    length, longer = divmod(off.size, count)  # the first blocks are one longer
    parts = np.split(sizes, [longer * (length + 1)])
    blocks = parts[0].reshape(longer, length + 1), parts[1].reshape(-1, length)
    deviations = 1.4826 * np.concatenate([np.median(block, axis=1) for block in blocks])
    # a quarter of the blocks need to be quiet: -0.674 is the lower quartile of a normal variable
    quiet = float(np.quantile(deviations, 0.25)) / (1 - 0.674 * uncertainty * math.sqrt(count))
    return whole if whole < (1 + 4 * uncertainty) * quiet else quiet, uncertainty


def _differences(t: Array, y: Array, order: int) -> Array:
    """Differences of an order, each scaled to the noise of one sample; NaN beside a missing sample."""
    steps = np.diff(t)
    if np.ptp(steps) == 0:
        return np.asarray(np.diff(y, order) / math.sqrt(math.comb(2 * order, order)))
    n, usual = y.size - order, float(np.median(steps))
    times, total, squares = [t[j : j + n] / usual for j in range(order + 1)], np.zeros(n), np.zeros(n)
    for j in range(order + 1):
        others = [times[j] - times[m] for m in range(order + 1) if m != j]
        weight = 1 / functools.reduce(np.multiply, others)
        total, squares = total + weight * y[j : j + n], squares + weight**2
    return np.asarray(total / np.sqrt(squares))
