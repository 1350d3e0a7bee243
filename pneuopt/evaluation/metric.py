"""`Metric`: a record for each figure of a loop, which requirements, searches, files and tables read; `Requirement`.

A metric is the largest of its rows, which are read off a `StepRecord`: responses to a step with their derivatives.
`evaluate` reads that largest value. A gradient search reads every row with its derivative, because the maximum of
several rows is not smooth where another row becomes the largest.

Then what the rows are read from. First, a response without the steady ripple of its dither (`remove_ripple`). The mean
over a dither period (`period_mean` of signals that are linear between samples, twenty samples a period;
`DitherPeriodMean` of a simulated integral, ten) is the wrong signal where the dither is small: it smooths the response
itself, so a loop under a dither of a picovolt seems to settle earlier than the same loop without. So the mean counts
only as far as the ripple explains its distance from the signal: the signal is moved towards its mean by at most
`RIPPLE_ALLOWANCE` times the ripple's amplitude. Where the ripple is steady that gives the mean; without ripple it gives
the signal. The amplitude is read at the end of the record, off the wave that repeats with the dither: a transient does
not repeat, and an oscillation of the loop itself repeats with another period. Where a loop hunts with a period of few
dither periods, the last of these tell the two apart to about 1 % of the step only: the metrics of such a loop, which no
certificate lets through, differ by that from those without dither.

Last, instants at which a response crosses a level or stays in its `SettlingBand`, whose half width users state as a
`Band`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from math import inf, isnan, nan
from numbers import Real
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pneuopt.control.reference import Reference
from pneuopt.evaluation.tolerances import (
    EDGE_ROUNDING,
    FINAL_PERIODS,
    MIN_STAY_RATIO,
    RIPPLE_ALLOWANCE,
    SAMPLE_SHARE,
    SAMPLES_A_DITHER_PERIOD,
    TAIL_SHARE,
)
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import check_argument
from pneuopt.quantities.units import write_value

ValuesAndSlopes = tuple[Array, Array]
RowReader = Callable[["StepRecord"], ValuesAndSlopes]


def without_slopes(values: Array) -> ValuesAndSlopes:
    """Values with derivatives to no unknowns, shape (..., 0)."""
    return values, np.zeros((*values.shape, 0))


@dataclass(frozen=True, eq=False)
class StepRecord:
    """Responses of m loops to one step on one grid, and derivatives to N unknowns; N is 0 without a gradient search."""

    t: Array  # since the step, shape (n,) [s]
    # Distance of the signal without ripple from the reference at the K nodes, which are every `stride`-th sample
    # [steps], shape (m, K), and its derivatives to the unknowns, shape (m, K, N); the same at the end, K = 1.
    error: ValuesAndSlopes
    final_error: ValuesAndSlopes
    chain: Array  # derivatives of the C simulated columns to the unknowns, shape (m, C, N)
    command: ValuesAndSlopes | None = None  # shapes (m, n) and, to the columns, (m, n, C) [its unit]
    meter: Mapping[str, ValuesAndSlopes] = field(default_factory=dict)  # its channels by name, as the command
    stride: int = 1  # samples between two nodes
    sample_time: float | None = None  # of the controller that holds the command [s]
    envelope: Sequence[tuple[float, float, float]] = ()  # instants [s] with lower and upper bound from then on [steps]
    is_step: bool = True  # False where the reference stays and a disturbance moves the signal
    size: float = 1.0  # of a step, with the sign of the reference's change [measured unit]
    wanted: Array | None = None  # distance of the reference from its end at the nodes, shape (K,) [steps]
    push: float = 0.0  # by how much the load's force steps [N]

    @cached_property
    def nodes(self) -> Array:
        """Instants at which the error is known, shape (K,) [s]."""
        return self.t[:: self.stride][: self.error[0].shape[1]]

    def largest(self, values: Array, slopes: Array) -> ValuesAndSlopes:
        """Largest absolute value between each two nodes; without derivatives, of the whole record."""
        edges = np.arange(0, values.shape[1], max(1, self.stride)) if self.chain.shape[-1] else np.zeros(1, dtype=int)
        parts = np.split(np.abs(values), edges[1:], axis=1)
        k = np.array([edge + part.argmax(axis=1) for edge, part in zip(edges, parts, strict=True)]).T
        rows = np.arange(len(values))[:, None]
        return np.abs(values[rows, k]), np.sign(values[rows, k])[..., None] * self._to_unknowns(slopes[rows, k])

    def integrate_meter(self, channel: str) -> ValuesAndSlopes:
        """Integral of a channel of the meter over time, a row a response."""
        (values, slopes), weights = self.meter[channel], trapezoidal_weights(self.t)
        by_column = _sum_rows(np.broadcast_to(weights, values.shape), slopes)
        return _integrate(weights, values), self._to_unknowns(by_column)

    def error_integral(
        self, weights: Array, of: Callable[[Array], Array], slope: Callable[[Array], Array]
    ) -> ValuesAndSlopes:
        """Weighted sum over the nodes of a function of the error, a row a response."""
        error, slopes = self.error
        return _integrate(weights, of(error)), _sum_rows(slope(error) * weights, slopes)

    def error_between(self, begin: float, end: float) -> ValuesAndSlopes:
        """Error at the nodes of a time span and at its ends, linear between nodes."""
        (error, by_unknown), t = self.error, self.nodes
        at = np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k]) / (t[k + 1] - t[k])
        slopes = by_unknown[:, k] * (1 - share)[:, None] + by_unknown[:, k + 1] * share[:, None]
        return error[:, k] * (1 - share) + error[:, k + 1] * share, slopes

    def _to_unknowns(self, by_column: Array) -> Array:
        return np.asarray(by_column @ self.chain)


def _integrate(weights: Array, values: Array) -> Array:
    """Weighted sums, shape (m, 1), of values (m, K); on one core, as a thread of BLAS waits for more work for 20 ms."""
    return np.asarray(np.einsum("k,mk->m", weights, values))[:, None]


def _sum_rows(weights: Array, slopes: Array) -> Array:
    """Weighted sums of slopes, shape (m, 1, N), of (m, K) and (m, K, N); not walked through where N = 0."""
    m, _, count = slopes.shape
    return np.asarray(np.einsum("mk,mkn->mn", weights, slopes))[:, None] if count else np.zeros((m, 1, 0))


def trapezoidal_weights(t: Array) -> Array:
    """Weights of samples with which a sum is the integral by the trapezoidal rule [s]."""
    h = np.diff(t)
    return np.asarray(0.5 * (np.append(h, 0.0) + np.append(0.0, h)))


def overshoot_rows(record: StepRecord) -> ValuesAndSlopes:
    """The error beyond the reference; under a disturbance, where the signal should not move, on either side."""
    error, slopes = record.error
    if record.is_step:
        return error, slopes
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def steady_state_rows(record: StepRecord) -> ValuesAndSlopes:
    """The absolute error at the end."""
    error, slopes = record.final_error
    return np.abs(error), np.sign(error)[..., None] * slopes


def iae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the absolute error."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.abs, np.sign)


def ise_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the squared error."""
    return record.error_integral(trapezoidal_weights(record.nodes), np.square, lambda error: 2 * error)


def itae_rows(record: StepRecord) -> ValuesAndSlopes:
    """The integral of the absolute error times the time since the step."""
    return record.error_integral(trapezoidal_weights(record.nodes) * record.nodes, np.abs, np.sign)


def envelope_rows(record: StepRecord) -> ValuesAndSlopes:
    """Distance from the middle of the envelope over its half width, a row each side."""
    last, first = record.nodes[-1], record.error
    values, slopes = [np.zeros((len(first[0]), 1))], [np.zeros((len(first[0]), 1, first[1].shape[-1]))]
    ends = [*(begin for begin, _, _ in record.envelope[1:]), np.inf]
    for (begin, lower, upper), end in zip(record.envelope, ends, strict=True):
        if begin < last:
            error, by_unknown = record.error_between(begin, min(end, last))
            used, half = error + 1 - (lower + upper) / 2, (upper - lower) / 2
            values += [used / half, -used / half]
            slopes += [by_unknown / half, -by_unknown / half]
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def peak_control_rows(record: StepRecord) -> ValuesAndSlopes:
    """The absolute command."""
    assert record.command is not None
    return record.largest(*record.command)


def control_rate_rows(record: StepRecord) -> ValuesAndSlopes:
    """Rate of change of the command from sample to sample; of a held command over the controller's sample time."""
    assert record.command is not None
    (u, slopes), t, h = record.command, record.t, record.sample_time
    if h is None:
        step = np.diff(t)
        return record.largest(np.diff(u, axis=1) / step, np.diff(slopes, axis=1) / step[:, None])
    begin = np.flatnonzero(t <= t[-1] - SAMPLE_SHARE * h)
    require(len(begin) > 0, f"the record of {t[-1] - t[0]:g} s is shorter than the controller's sample time")
    end = np.searchsorted(t, t[begin] + SAMPLE_SHARE * h)
    return record.largest((u[:, end] - u[:, begin]) / h, (slopes[:, end] - slopes[:, begin]) / h)


class Sense(Enum):
    """Direction of a limit on a metric; the value is the name of the field that holds it."""

    AT_MOST = "max"
    AT_LEAST = "min"


class Source(Enum):
    """The signal or model that a metric is computed from."""

    RESPONSE = "the measured signal from the step on"
    COMMAND = "the command from the step on"
    METER = "the plant's meter from the step on"
    LINEAR_LOOP = "the loop linearised about the end of the response"


@dataclass(frozen=True, eq=False)
class Metric:
    """Name, unit and source of a figure of a loop, and how a requirement on it is checked."""

    name: str  # the row of `evaluate`, and the class of the requirement, if there is one
    unit: str  # of a limit on it, SI; "1" for a pure number; "{command}" and "{measured}" stand for the loop's units
    source: Source
    percent: bool = False  # whether tables show it in percent; a limit on it is a fraction all the same
    sense: Sense = Sense.AT_MOST
    limits: tuple[float, float] = (0.0, inf)  # between which a limit must lie, both excluded
    advice: str = ""  # the remedy that ends the message about a limit outside them
    floor: float = -inf  # smaller values count as this one in an objective
    # Difference on the scale of `requirement_value` below which two simulations agree, whatever the value: a share of a
    # measured signal that no instrument shows, and more than the rounding of an integration.
    resolution: float = 1e-6
    cost: Callable[[Any], Any] | None = None  # to a value that shall be small, where the metric itself shall be large
    headline: bool = False  # whether every table of a tuning shows it, even where no requirement names it
    # Maps a `StepRecord` to rows and derivatives, shapes (m, R) and (m, R, N), as fractions where it is shown in
    # percent; a gradient search cannot use a metric without one.
    slope: RowReader | None = None
    channels: tuple[str, ...] = ()  # of the plant's meter that it needs
    exact: bool = False  # whether `TwoPhase` has an equation for it
    shown: bool = True  # whether the screen shows it and a study may ask for it
    positions: bool = False  # whether it says something of a loop on a position only

    def __post_init__(self) -> None:
        require(bool(self.name), f"a metric needs a name, the one in {self.unit!r} has none")
        require(bool(self.unit), f"{self.name}: a metric needs a unit; for a pure number write '1'")

    def unit_in(self, command: str, measured: str) -> str:
        """Unit of a limit in a loop, given the units of its command and its measured signal."""
        return self.unit.format(command=command, measured=measured)

    def shown_unit(self, command: str, measured: str) -> str:
        """Unit of the metric in a table, "%" or "l(ANR)" for example; empty for a pure number."""
        unit = self.unit_in(command, measured)
        return "%" if self.percent else "" if unit == "1" else unit

    @property
    def factor(self) -> float:
        """Ratio of the metric to its limit's scale: 100 for a metric in percent, whose limit is a fraction, else 1."""
        return 100 if self.percent else 1

    def largest(self, record: StepRecord) -> Array:
        """Metric of each response, the largest of its rows, shape (m,), in the unit that `evaluate` shows."""
        assert self.slope is not None
        return np.asarray(self.factor * np.maximum(self.floor, self.slope(record)[0].max(axis=1)))

    def requirement_value(self, metric: Any) -> Any:
        """Value that shall be small, from a metric or an array of them: percent as a fraction, a margin as 1/margin."""
        with np.errstate(divide="ignore"):
            return metric / self.factor if self.cost is None else self.cost(metric)

    def check_limit(self, limit: float | None) -> None:
        """Refuse a limit that no loop can keep, or that every loop keeps."""
        if limit is None:
            return
        check_argument(f"{self.name}: {self.sense.value}", limit, Real, "a number, as 0.05 for 5 %")
        (least, most), unit = self.limits, "" if self.unit == "1" or "{" in self.unit else f" {self.unit}"
        room = f"above {least:g}{unit}" + (" and finite" if most == inf else f" and below {most:g}, a fraction")
        message = f"{self.name}: {self.sense.value} must be {room}, got {limit}"
        require(least < limit < most, f"{message}; {self.advice}" if self.advice else message)


class Requirement:
    """A requirement on a loop: an objective, a weighted term of one, or, with a bound, a limit; a class each metric."""

    metric: ClassVar[Metric]

    def __post_init__(self) -> None:
        self.metric.check_limit(getattr(self, self.metric.sense.value))


@dataclass(frozen=True)
class AtMost(Requirement):
    """A metric that shall be small; `max` is in its unit, a fraction where it counts in percent."""

    max: float | None = None


@dataclass(frozen=True)
class AtLeast(Requirement):
    """A metric that shall be large; as a term its reciprocal is minimised, and `min` is in the metric's unit."""

    min: float | None = None


def period_mean(t: Array, y: Array, initial: float, period: float, at: Array) -> Array:
    """Centred means over a period at k instants, shape (m, k), of signals (m, n), linear in between, or `initial`."""
    steps = 0.5 * np.diff(t) * (y[:, 1:] + y[:, :-1])
    whole = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    ends = list[Array]()
    for to in (at + period / 2, at - period / 2):  # the integral from the first sample on
        k = np.clip(np.searchsorted(t, to, side="right") - 1, 0, len(t) - 2)
        ahead = to - t[k]
        inside = whole[:, k] + ahead * (y[:, k] + 0.5 * ahead * (y[:, k + 1] - y[:, k]) / (t[k + 1] - t[k]))
        ends.append(np.where(to < t[0], initial * (to - t[0]), inside))
    return np.asarray((ends[0] - ends[1]) / period)


def end_mean(t: Array, y: Array, period: float) -> Array:
    """Mean over the last five periods, or as many as the record has, of signals whose last axis is time."""
    span = period * min(FINAL_PERIODS, int((t[-1] - t[0]) / period))
    t, y = _cut_end(t, y, span)
    return np.asarray(np.trapezoid(y, t, axis=-1) / (t[-1] - t[0]))


def tail(t: Array, y: Array) -> Array:
    """Signals in the last 5 % of a record, from an interpolated first value on."""
    return _cut_end(t, y, TAIL_SHARE * (t[-1] - t[0]))[1]


def _cut_end(t: Array, y: Array, span: float) -> tuple[Array, Array]:
    begin = t[-1] - span
    k = min(max(int(np.searchsorted(t, begin, side="right")) - 1, 0), len(t) - 2)
    first = y[..., [k]] + (begin - t[k]) / (t[k + 1] - t[k]) * (y[..., [k + 1]] - y[..., [k]])
    return np.append(begin, t[t > begin]), np.concatenate([first, y[..., t > begin]], axis=-1)


@dataclass(frozen=True)
class DitherPeriodMean:
    """Centred mean over a period, from an integral that is taken as cubic between samples."""

    period: float  # [s]
    spacing: float  # of the samples [s]

    @property
    def half_period_samples(self) -> int:
        """Number of whole samples in half a period."""
        return int(self.period / 2 / self.spacing + 1e-9)

    def mean_count(self, n: int) -> int:
        """Number of samples, of n from the first on, that have a mean."""
        return max(0, n - self.half_period_samples - 1)

    def means(self, signal: Array, integral: Array, initial: float, stride: int = 1) -> Array:
        """Means, shape (m, ceil(mean_count(n) / stride)), of signals (m, n) with their integrals, `initial` before.

        Examples
        --------
        >>> t = np.linspace(0.0, 2.0, 21)[None]
        >>> DitherPeriodMean(0.5, 0.1).means(3 * t**2, t**3, 0.0)[0, 5].round(9).item()  # (0.75^3 - 0.25^3)/0.5
        0.8125
        """
        m, h, n = self.half_period_samples, self.spacing, signal.shape[1]
        s = self.period / 2 / h - m
        before = np.arange(-m - 1, 0) * (h * initial)
        Y = np.concatenate([np.broadcast_to(before, (len(signal), m + 1)), integral - integral[:, :1]], axis=1)
        y = np.concatenate([np.full((len(signal), m + 1), initial), signal], axis=1)
        near, far = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
        slope_near, slope_far = h * s * (1 - s) ** 2, h * s * s * (s - 1)

        def shift(rows: Array, ahead: int) -> Array:
            return rows[:, m + 1 + ahead : m + 1 + ahead + self.mean_count(n) : stride]

        total = near * (shift(Y, m) - shift(Y, -m)) + far * (shift(Y, m + 1) - shift(Y, -m - 1))
        total += slope_near * (shift(y, m) + shift(y, -m)) + slope_far * (shift(y, m + 1) + shift(y, -m - 1))
        return np.asarray(total / self.period)


@dataclass(frozen=True, eq=False)
class RippleFree:
    """Responses without their dither's ripple."""

    signal: Array  # moved towards its mean over a dither period, by at most the allowance, shape (m, n)
    final: Array  # the last sample, moved likewise towards the mean over the last periods, shape (m,)
    ripple: Array  # peak to peak, shape (m,) [unit of the signal]


def remove_ripple(t: Array, y: Array, means: Array, period: float) -> RippleFree:
    """Move signals (m, n) towards their means over a dither period at the first k samples (m, k), as far as it may.

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
    """Sentence for a response of which only the mean over the dither's period settles; None for others."""
    settled, raw, ripple = (metrics[n] for n in ("SettlingTime", "SettlingTimeRaw", "Ripple"))
    if isnan(settled) or not isnan(raw):
        return None
    within = f"the band of +-{100 * band:.3g} %"
    share = f"a ripple of {100 * ripple / abs(size):.2g} % of the step"
    return f"only the mean settles, in {settled:.3g} s: {share} takes the signal itself out of {within}"


def measure_ripple(t: Array, rest: Array, period: float) -> Array:
    """Peak to peak of what repeats with the dither in the last periods, shape (m,), of signals less their means (m, n).

    The smaller of that of the mean over the periods and that of the calmest one, which a late transient leaves alone.
    """
    return ripple_and_slopes(t, (rest, np.zeros((len(rest), 0, len(t)))), *wave_instants(t, period))[0]


def ripple_and_slopes(t: Array, rest: ValuesAndSlopes, at: Array, weights: Array) -> ValuesAndSlopes:
    """`measure_ripple`, shape (m,), and its derivatives (m, C), of a record or its end and those (m, C, n)."""
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
    phases = max(SAMPLES_A_DITHER_PERIOD, int(np.ceil(period / np.median(np.diff(t)) - 1e-9)))
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


@dataclass(frozen=True)
class Samples:
    """Samples from the step on, a row a response; t is counted from the step."""

    t: Array
    y: Array


def first_crossing_times(t: Array, z: Array, level: float) -> Array:
    """Instants at which each row first reaches the level; meaningless in rows that never do."""
    k = np.argmax(z >= level, axis=1)
    before = np.maximum(k - 1, 0)
    low, high = pick_samples(z, before), pick_samples(z, k)
    with np.errstate(all="ignore"):
        between = t[before] + (t[k] - t[before]) * (level - low) / (high - low)
    return np.asarray(np.where(k == 0, t[0], between))


def pick_samples(rows: Array, k: NDArray[np.intp]) -> Array:
    """One sample of each row."""
    return np.asarray(rows[np.arange(len(rows)), k], dtype=float)


@dataclass(frozen=True, eq=False)
class SettlingBand:
    """The one answer to "is it in the band": a signal is, up to and on the edge; NaN is not. Both may be (m,).

    Examples
    --------
    >>> SettlingBand(0.2, 0.004).contains(np.array([0.19, 0.196, 0.2, 0.204, 0.20401, np.nan])).tolist()
    [False, True, True, True, False, False]
    """

    centre: float | Array
    half_width: float | Array

    def contains(self, y: Array) -> Mask:
        """Which values are in the band, shape (n,) or (m, n) as y."""
        centre, reach = (np.expand_dims(a, -1) for a in (self.centre, self.half_width))
        return np.asarray(np.abs(y - centre) <= (1 + EDGE_ROUNDING) * reach)

    def settling_times(self, t: Array, y: Array) -> Array:
        """Instants from which responses (m, n) stay in the band, linear between samples, shape (m,) [s since the step].

        NaN where one ends outside, or comes in for good only in the record's last share, where it may just pass.
        """
        outside = ~self.contains(y)
        k = len(t) - 1 - np.argmax(outside[:, ::-1], axis=1)
        after = np.minimum(k + 1, len(t) - 1)
        last, following = pick_samples(y, k), pick_samples(y, after)
        edge = self.centre + self.half_width * np.sign(last - self.centre)
        with np.errstate(all="ignore"):
            settled = t[k] + (t[after] - t[k]) * (edge - last) / (following - last)
        settled = np.where(outside[:, -1] | ~(settled <= (1 - TAIL_SHARE) * t[-1]), nan, settled)
        return np.where(outside.any(axis=1), settled, 0.0)


def entry_for_good(t: Array, inside: Mask) -> float:
    """Last instant outside the band of a continued response [s]; inf where it came in so late that it may leave."""
    outside, end = np.flatnonzero(~inside), float(t[-1])
    last = float(t[outside[-1]]) if len(outside) else 0.0
    late = last > end / 2 and end - last < MIN_STAY_RATIO * longest_stay(t, inside)
    return inf if late or last > (1 - TAIL_SHARE) * end else last


def longest_stay(t: Array, inside: Mask) -> float:
    """The longest time in the band before it is left for the last time [s]; 0 where it never is."""
    padded = np.concatenate([[False], inside, [False]])
    enters, leaves = np.flatnonzero(~padded[:-1] & padded[1:]), np.flatnonzero(padded[:-1] & ~padded[1:])
    ended = leaves < len(t)
    return float(np.max(t[leaves[ended]] - t[enters[ended]], initial=0.0))


@dataclass(frozen=True)
class Tolerance:
    """A settling band as wide for every reference: the accuracy that a positioning task asks for.

    Parameters
    ----------
    half_width : float
        [measured unit]

    Raises
    ------
    InputError
        If it is not positive and finite.
    """

    half_width: float

    def __post_init__(self) -> None:
        require(0 < self.half_width < inf, f"Tolerance: half_width must be positive and finite, got {self.half_width}")

    def __mul__(self, factor: float) -> "Tolerance":
        return Tolerance(self.half_width * factor)


Band: TypeAlias = float | Tolerance


def band_unit(band: Band, reference: Reference) -> float:
    """Ratio of what a band's number counts to the reference's size: 1 of a fraction."""
    return 1 / abs(reference.nominal_size) if isinstance(band, Tolerance) else 1.0


def band_number(band: Band) -> float:
    """The number of a band: a fraction, or the half width of a tolerance [measured unit]."""
    return band.half_width if isinstance(band, Tolerance) else band


def band_share(band: Band, reference: Reference) -> float:
    """Half width of a band as a fraction of the reference's size; refused where the response would begin settled."""
    if not isinstance(band, Tolerance):
        require(0 < band < 1, f"band is a fraction between 0 and 1, got {band:g}; 2 % is 0.02")
        return band
    size = abs(reference.nominal_size)
    message = f"reference {reference.label}: its size of {size:g} lies within the tolerance of +-{band.half_width:g}"
    require(band.half_width < size, f"{message}; narrow the tolerance, or leave the reference out")
    return band.half_width / size


def describe_band(band: Band, unit: str) -> str:
    """Write a band with its unit, given the measured one.

    Examples
    --------
    >>> describe_band(0.02, "m"), describe_band(Tolerance(1e-4), "m")
    ('2 % of the step', '0.1 mm')
    """
    return write_value(band.half_width, unit, 3) if isinstance(band, Tolerance) else f"{100 * band:g} % of the step"
