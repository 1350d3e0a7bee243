"""`remove_ripple`: a response without the steady ripple of its dither, on which metrics under dither are read.

The mean over a dither period is the wrong signal to read where the dither is small: it smooths the response itself, so
a loop under a dither of a picovolt seems to settle earlier than the same loop without. So the mean counts only as far
as the ripple explains its distance from the signal: the signal is moved towards its mean by at most `RIPPLE_ALLOWANCE`
times the ripple's amplitude. Where the ripple is steady that gives the mean; without ripple it gives the signal.

The ripple's amplitude is read at the end of the record, off the wave that repeats with the dither. A transient does not
repeat, and an oscillation of the loop itself repeats with another period, so that neither counts as ripple. Where a
loop hunts with a period of few dither periods, the last of these tell the two apart to about 1 % of the step only: the
metrics of such a loop, which no certificate lets through, differ by that from those without dither.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan

import numpy as np

from pneuopt.evaluation.dither_mean import FINAL_PERIODS, TAIL_SHARE, end_mean
from pneuopt.evaluation.step_record import ValuesAndSlopes
from pneuopt.quantities.arrays import Array

# Largest distance by which the signal is moved towards its mean, in amplitudes of the ripple at the end. Below 1 some
# of a steady ripple stays; at 1 all that it grows by does, where the stroke is passed or the valve is wide open; far
# above it a small ripple lets the mean smooth the transient.
RIPPLE_ALLOWANCE = 2.0
# Least instants in a period at which the wave is read: fewer cut its peaks, more cost time.
MIN_WAVE_PHASES = 20


@dataclass(frozen=True, eq=False)
class RippleFree:
    """Responses without their dither's ripple.

    Attributes
    ----------
    signal : ndarray, shape (m, n)
        The signal moved towards its mean over a dither period, by at most the allowance.
    final : ndarray, shape (m,)
        The last sample, moved likewise towards the mean over the last periods.
    ripple : ndarray, shape (m,)
        Peak to peak of the ripple [unit of the signal].
    """

    signal: Array
    final: Array
    ripple: Array


def remove_ripple(t: Array, y: Array, means: Array, period: float) -> RippleFree:
    """Move signals towards their means over a dither period, as far as their ripple at the end allows.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    y : ndarray, shape (m, n)
    means : ndarray, shape (m, k)
        Centred means over the period at the first k samples; those of the last half period have none.
    period : float
        [s]

    Returns
    -------
    RippleFree

    Examples
    --------
    >>> t = np.linspace(0.0, 2.0, 2001)
    >>> y = np.array([1.0 + a * np.sin(20 * np.pi * t) for a in (0.3, 0.0)])
    >>> found = remove_ripple(t, y, np.ones((2, 1950)), 0.1)
    >>> found.ripple.round(3).tolist(), np.ptp(found.signal, axis=1).round(9).tolist()
    ([0.6, 0.0], [0.0, 0.0])
    """
    k = means.shape[1]
    ripple = measure_ripple(t[:k], y[:, :k] - means, period)
    reach = RIPPLE_ALLOWANCE / 2 * ripple
    signal = move_towards(
        y, np.concatenate([means, extend_means(t, y, means[:, -1], k, period)], axis=1), reach[:, None]
    )
    return RippleFree(signal, move_towards(y[:, -1], end_mean(t, y, period), reach), ripple)


def describe_ripple(metrics: Mapping[str, float], size: float, band: float) -> str | None:
    """Sentence for a response of which only the mean over the dither's period settles; None for others.

    Parameters
    ----------
    metrics : mapping of str to float
        A column of `evaluate`.
    size : float
        The step's size [measured unit].
    band : float
        Half width of the settling band, a fraction of the step.

    Examples
    --------
    >>> from math import nan
    >>> print(describe_ripple({"SettlingTime": 0.0931, "SettlingTimeRaw": nan, "Ripple": 0.018}, 0.1, 0.02))
    only the mean settles, in 0.0931 s: a ripple of 18 % of the step takes the signal itself out of the band of +-2 %
    """
    settled, raw, ripple = (metrics[n] for n in ("SettlingTime", "SettlingTimeRaw", "Ripple"))
    if isnan(settled) or not isnan(raw):
        return None
    within = f"the band of +-{100 * band:.3g} %"
    share = f"a ripple of {100 * ripple / abs(size):.2g} % of the step"
    return f"only the mean settles, in {settled:.3g} s: {share} takes the signal itself out of {within}"


def measure_ripple(t: Array, rest: Array, period: float) -> Array:
    """Peak to peak of what repeats with the dither in the last whole periods of signals, shape (m,).

    It is that of the mean over the periods, in which an oscillation with another period averages out, or that of the
    calmest period, which a late transient leaves alone, whichever is smaller.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    rest : ndarray, shape (m, n)
        Signals less their means over the period.
    period : float
        [s]
    """
    return ripple_and_slopes(t, (rest, np.zeros((len(rest), 0, len(t)))), *wave_instants(t, period))[0]


def ripple_and_slopes(t: Array, rest: ValuesAndSlopes, at: Array, weights: Array) -> ValuesAndSlopes:
    """`measure_ripple`, shape (m,), and its derivatives, shape (m, C).

    Parameters
    ----------
    t : ndarray, shape (n,)
        Instants of a record, or of its end [s].
    rest : tuple of ndarray, shapes (m, n) and (m, C, n)
        Signals less their means, and the derivatives.
    at, weights : ndarray
        As `wave_instants` gives them for the whole record.
    """
    rows, slope_rows = (_interpolate(t, a, at).reshape(*a.shape[:-1], *weights.shape) for a in rest)
    wave = np.einsum("mcp,cp->mp", rows, weights)
    by_period, of_wave = np.ptp(rows, axis=2), np.ptp(wave, axis=1)
    calmest, lane = by_period.argmin(axis=1), np.arange(len(rows))
    shape = np.where((of_wave <= by_period.min(axis=1))[:, None], wave, rows[lane, calmest])
    share = np.where((of_wave <= by_period.min(axis=1))[:, None, None], weights, 0.0)
    share[lane, calmest] += (of_wave > by_period.min(axis=1))[:, None]
    ends = [
        np.einsum("mnc,mc->mn", slope_rows[lane, :, :, k], share[lane, :, k])
        for k in (shape.argmax(axis=1), shape.argmin(axis=1))
    ]
    return np.asarray(np.ptp(shape, axis=1)), ends[0] - ends[1]


def wave_instants(t: Array, period: float) -> tuple[Array, Array]:
    """Instants in the last whole periods, and their weights in the mean over the periods, shape (periods, phases)."""
    length = t[-1] - t[0]
    count = max(1, min(int(max(FINAL_PERIODS, TAIL_SHARE * length / period)), int(length / period + 1e-9)))
    phases = max(MIN_WAVE_PHASES, int(np.ceil(period / np.median(np.diff(t)) - 1e-9)))
    at = t[-1] + period * count * (np.arange(1 - count * phases, 1) / (count * phases))
    hann = np.sin(np.pi * (np.arange(count * phases) + 0.5) / (count * phases)).reshape(count, phases) ** 2
    return at, hann / hann.sum(axis=0)


def extend_means(t: Array, y: Array, last: Array, k: int, period: float) -> Array:
    """Means from sample k on, in the last half period, with the slope that the mean has at `last`, sample k - 1."""
    change = y[..., -1:] - _interpolate(t, y, np.array([t[-1] - period]))
    return np.asarray(last[..., None] + change * ((t[k:] - t[k - 1]) / period))


def move_towards(y: Array, mean: Array, reach: Array) -> Array:
    """The mean where it is within reach of the signal, elsewhere the signal moved towards it by the reach."""
    return np.asarray(np.clip(mean, y - reach, y + reach))


def _interpolate(t: Array, rows: Array, at: Array) -> Array:
    """Rows at other instants, linear between samples."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    share = (at - t[k]) / (t[k + 1] - t[k])
    return np.asarray(rows[..., k] + share * (rows[..., k + 1] - rows[..., k]))
