"""Metrics of a step response, with python-control's keys, relative to the step's size.

Then those that are read off a plant's meter, and the instants at which a response is read, so close that its settling
time, peaks and integrals are right: a horizon may be hundreds of times as long as the response, and readings at even
distances miss what happens. From a first reading, `refine_instants` finds where the signal bends between readings, or
where an integral of the error is not exact, and adds instants there.
"""

from collections.abc import Collection, Mapping, Sequence
from enum import Enum
from math import nan

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.compiled.functions import compile_rows
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.metric import (
    Samples,
    SettlingBand,
    Source,
    StepRecord,
    first_crossing_times,
    period_mean,
    pick_samples,
    remove_ripple,
    tail,
    without_slopes,
)
from pneuopt.evaluation.requirements import METRICS, StepEnvelope
from pneuopt.evaluation.tolerances import (
    INTEGRAL_TOLERANCE,
    LINE_TOLERANCE,
    MAX_INSTANTS,
    MIN_SETTLED_PERIODS,
    SPREAD,
)
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

ROW_METRICS = tuple(name for name, metric in METRICS.items() if metric.slope is not None)

Envelope = Sequence[tuple[float, float, float]]
"""Instants after the step [s], each with the lower and upper bound from then on, as fractions of the step."""


class BandCentre(Enum):
    """Centre of the settling band."""

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
    band_centre: BandCentre = BandCentre.FINAL,
    dither_period: float | None = None,
    control: ArrayLike | None = None,
    sample_time: float | None = None,
    final: float | None = None,
    envelope: Envelope = (),
    scale: float | None = None,
    target: ArrayLike | None = None,
    push: float = 0.0,
) -> dict[str, float]:
    """Compute the metrics of a step response.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time, strictly increasing [s]; samples before `start` do not count.
    y : array_like, shape (n,)
        The measured signal [unit].
    reference_final, initial : float
        The reference after the step, and the value before it [unit].
    start : float
        Instant of the step [s].
    band : float
        Half width of the settling band, as a fraction.
    band_centre : BandCentre
        Centre of the band.
    dither_period : float, optional
        The ripple of a dither is removed first [s]: `remove_ripple`, over whole dither periods (`Dither.period`).
    control : array_like, shape (n,), optional
        The command, for PeakControl and ControlRate [its unit]; it is not averaged.
    sample_time : float, optional
        Sample time of the controller that holds the command, over which ControlRate is computed [s]; by default from
        sample to sample of the record.
    final : float, optional
        The final value where it is known, from a dc gain [unit]; by default the last sample, without a dither's ripple.
    envelope : sequence of (float, float, float)
        Instants after the step, in order [s], each with the lower and upper bound that hold from then on, as fractions
        of the step: 0 is `initial`, 1 the reference.
    scale : float, optional
        Stands for the step's size where a disturbance begins at `start` and the reference stays [unit]. Overshoot is
        then the largest deviation on either side, Peak the signal there, SettlingTime the time until the signal is back
        in the band, RiseTime and Undershoot 0. In the envelope, 0 lies by `scale` below the reference.
    target : array_like, shape (n,), optional
        The reference over time, where it moves; by default it is `reference_final` from `start` on [unit].
    push : float
        By how much the load's force steps at `start`, for Compliance [N].

    Returns
    -------
    dict of str to float
        RiseTime
            From 10 to 90 % of the step from `initial` to the reference [s], so that a response that hardly moves has
            none; NaN where 90 % is never reached. python-control's counts to the final value.
        SettlingTime
            From `start` until the response stays in the band, interpolated linearly [s]. NaN if it never settles: it
            ends outside the band, or enters it for good only in the last 5 % of the record after `start`, where a
            response that only passes through looks the same; where a dither's ripple exceeds the band, in the last two
            periods, if those are longer.
        SettlingTimeRaw
            The same of the signal as it is, with a dither's ripple [s]: what an oscilloscope shows. NaN where the
            ripple leaves the band.
        SettlingMin, SettlingMax
            Range after 90 % of the change to the final value is reached [unit].
        Overshoot, OvershootFinal
            Beyond the reference, in % of the step; beyond the final value, in % of the change (python-control's).
        Undershoot
            Below `initial`, in % of the step.
        OvershootDistance
            Beyond the reference, or the largest deviation under a disturbance alone [unit].
        FollowingError, FollowingErrorRMS
            Largest and root mean square distance from `target`, from `start` to the record's end [unit].
        Compliance
            Largest distance from the reference over the size of `push` [unit/N]; 0 without.
        Peak, PeakTime
            Extreme in the step's direction [unit], and when, from `start` [s].
        SteadyStateValue, SteadyStateError
            The final value [unit]; its distance from the reference, in % of the step.
        Ripple
            Peak to peak of the raw signal over the last 5 % of the record, or of a dither's ripple if larger [unit].
        IAE, ISE, ITAE
            Integrals from the step to the record's end of the absolute error [s], of its square [s], and of the
            absolute error times the time since the step [s^2]; errors are relative to the step's size.
        StepEnvelope
            Largest distance from the middle of `envelope` over its half width, at most 1 where the response stays
            inside; only with an envelope.
        PeakControl
            Largest absolute command, dither included [its unit]; NaN without `control`.
        ControlRate
            Largest rate of change of the command, dither included [its unit/s]; NaN without `control`. It starts
            from the first command after the step, so that the jump of a proportional gain does not count.

    Raises
    ------
    InputError
        If shapes differ, time does not increase, the record holds NaN, or it is too short for the dither's period.

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
        band_centre=band_centre,
        dither_period=dither_period,
        control=commands if commands is None else commands[None],
        sample_time=sample_time,
        final=final,
        envelope=envelope,
        scale=scale,
        target=None if target is None else np.asarray(target, dtype=float),
        push=push,
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
    band_centre: BandCentre = BandCentre.FINAL,
    dither_period: float | None = None,
    control: Array | None = None,
    sample_time: float | None = None,
    final: float | None = None,
    envelope: Envelope = (),
    only: Collection[str] | None = None,
    averaged: Array | None = None,
    scale: float | None = None,
    meter: Mapping[str, Array] | None = None,
    wider: Sequence[float] = (),
    target: Array | None = None,
    push: float = 0.0,
) -> dict[str, Array]:
    """Metrics (m,) of many step responses (m, n) on one grid at once; see `step_metrics`.

    `only` names the metrics that are needed; `averaged` (m, k) are known means over the dither's period from the step,
    `meter` has the channels of the plant's meter (m, n), `wider` are further settling bands for "SettlingTimes"; of the
    signal itself where `only` names its settling time.
    """
    require(scale is not None or reference_final != initial, f"no step: the reference stays at {initial:g}")
    shape = t.shape if control is None else control.shape[-1:]
    require(shape == t.shape, f"t and control differ in shape: {t.shape} and {shape}")
    raw, size = _cut_record(t, y, start, band), reference_final - initial if scale is None else scale
    first = len(t) - len(raw.t)
    smooth, last, ripple = _remove_ripple(raw, initial, dither_period, averaged)
    steady = last if final is None else np.full(len(raw.y), final)
    centre, width = steady, band * np.abs(steady - initial)
    if band_centre is BandCentre.REFERENCE:
        centre, width = np.full_like(steady, reference_final), np.full_like(steady, band * abs(size))
    settled, settled_raw = (SettlingBand(centre, width).settling_times(part.t, part.y) for part in (smooth, raw))
    judged = raw if only is not None and "SettlingTimeRaw" in only else smooth
    times = [SettlingBand(centre, other / band * width).settling_times(judged.t, judged.y) for other in wider]
    only_mean = np.isnan(settled_raw) & (settled > raw.t[-1] - MIN_SETTLED_PERIODS * (dither_period or 0.0))
    record = StepRecord(
        raw.t,
        without_slopes((smooth.y - reference_final) / size),
        without_slopes(((steady - reference_final) / size)[:, None]),
        np.zeros((len(y), 0, 0)),
        None if control is None else without_slopes(control[:, first:]),
        {n: without_slopes(values[:, first:]) for n, values in (meter or {}).items()},
        sample_time=sample_time,
        envelope=envelope,
        is_step=scale is None,
        size=size,
        wanted=None if target is None else (target[first:] - reference_final) / size,
        push=push,
    )
    return {
        **_rise_metrics(smooth, initial, reference_final, steady, only),
        "SettlingTime": np.where(only_mean, nan, settled),
        "SettlingTimeRaw": settled_raw,
        **_peak_metrics(smooth, steady, reference_final, initial, scale, only),
        "SteadyStateValue": steady,
        **({"Ripple": np.maximum(ripple, np.ptp(tail(raw.t, raw.y), axis=1))} if _wants(only, "Ripple") else {}),
        **({"SettlingTimes": np.transpose(times)} if wider else {}),
        **_row_metrics(record, only),
    }


def _row_metrics(record: StepRecord, only: Collection[str] | None) -> dict[str, Array]:
    """Metrics that are the largest of their rows; none whose channels or envelope the record has not."""
    found = {}
    for name, metric in ((n, METRICS[n]) for n in ROW_METRICS if _wants(only, n)):
        if name == StepEnvelope.metric.name and not record.envelope:
            continue
        if metric.source is Source.COMMAND and record.command is None:
            found[name] = np.full(len(record.error[0]), nan)
        elif set(metric.channels) <= set(record.meter):
            found[name] = metric.largest(record)
    return found


def _cut_record(t: Array, y: Array, start: float, band: float) -> Samples:
    require(bool(np.all(np.diff(t) > 0)), "time must increase strictly")
    require(bool(np.all(np.isfinite(y))), "the response holds NaN or infinite values; a simulation that fails has none")
    require(0 < band < 1, f"band is a fraction between 0 and 1, got {band:g}; 2 % is 0.02")
    first = int(np.searchsorted(t, start - 1e-12 * max(1.0, abs(start))))
    require(len(t) - first >= 3, f"fewer than three samples after the step at {start:g} s")
    return Samples(t[first:] - start, y[:, first:])


def _wants(only: Collection[str] | None, *metrics: str) -> bool:
    return only is None or any(n in only for n in metrics)


def _remove_ripple(
    raw: Samples, initial: float, period: float | None, averaged: Array | None
) -> tuple[Samples, Array, Array]:
    """The response without its dither's ripple, its final values, and the ripple from peak to peak."""
    if period is None:
        return raw, raw.y[:, -1], np.zeros(len(raw.y))
    if averaged is None:
        last = raw.t[-1] - period / 2
        message = f"the record of {raw.t[-1]:g} s is too short to average over {period:g} s; simulate longer"
        require(period > 0 and last > raw.t[0] + period, message)
        averaged = period_mean(raw.t, raw.y, initial, period, raw.t[raw.t <= last])
    found = remove_ripple(raw.t, raw.y, averaged, period)
    return Samples(raw.t, found.signal), found.final, found.ripple


def _rise_metrics(
    record: Samples, initial: float, reference: float, steady: Array, only: Collection[str] | None
) -> dict[str, Array]:
    """Time from 10 to 90 % of the step, and the range after 90 % of the change to the final value; NaN without."""
    if not _wants(only, "RiseTime", "SettlingMin", "SettlingMax"):
        return {}
    change = steady - initial
    with np.errstate(all="ignore"):
        z = (record.y - initial) / np.where(change == 0, nan, change)[:, None]
        share = (record.y - initial) / np.where(reference == initial, nan, reference - initial)
    reached, rises = (z >= 0.9).any(axis=1), (share >= 0.9).any(axis=1)
    after = np.arange(len(record.t)) >= np.argmax(z >= 0.9, axis=1)[:, None]
    rise = first_crossing_times(record.t, share, 0.9) - first_crossing_times(record.t, share, 0.1)
    lowest, highest = np.where(after, record.y, np.inf).min(axis=1), np.where(after, record.y, -np.inf).max(axis=1)
    return {
        "RiseTime": np.where(rises, rise, nan),
        "SettlingMin": np.where(reached, np.minimum(lowest, steady), nan),
        "SettlingMax": np.where(reached, np.maximum(highest, steady), nan),
    }


def _peak_metrics(
    record: Samples, steady: Array, reference: float, initial: float, scale: float | None, only: Collection[str] | None
) -> dict[str, Array]:
    """The peak of a step and what lies beyond and below; of a disturbance its largest deviation, in place of a rise."""
    if scale is not None:
        k = np.argmax(np.abs(record.y - reference), axis=1)
        peak, none = pick_samples(record.y, k), np.zeros(len(record.y))
        beyond = 100 * np.abs(peak - reference) / abs(scale)
        found = {"OvershootFinal": beyond, "Peak": peak, "PeakTime": record.t[k]}
        return found | {"RiseTime": none, "Undershoot": none}
    if not _wants(only, "OvershootFinal", "Undershoot", "Peak", "PeakTime"):
        return {}
    size, change = reference - initial, steady - initial
    k = np.argmax(record.y * np.sign(size), axis=1)
    peak = pick_samples(record.y, k)
    with np.errstate(all="ignore"):
        beyond = np.where(change * size > 0, 100 * np.maximum(0.0, (peak - steady) / change), nan)
    return {
        "OvershootFinal": beyond,
        "Undershoot": 100 * np.maximum(0.0, np.max((initial - record.y) / size, axis=1)),
        "Peak": peak,
        "PeakTime": record.t[k],
    }


def meter_channels(plant: System) -> tuple[str, ...]:
    """Channels of a plant's meter: "air" [kg/s], "spool" [half travels], "power" [W]; none without a meter."""
    return () if plant.meter is None else tuple(plant.meter.name_out())


def needed_channels(metrics: Collection[str]) -> tuple[str, ...]:
    """Channels of a meter that these metrics need."""
    return tuple(dict.fromkeys(c for name in metrics if name in METRICS for c in METRICS[name].channels))


def check_channels(plant: System, metrics: Collection[str]) -> None:
    """Refuse a metric whose channel the plant's meter lacks."""
    shown = meter_channels(plant)
    for name in metrics:
        for channel in needed_channels([name]):
            if channel not in shown:
                reason = f"its meter shows only {', '.join(shown)}" if shown else "it has no meter"
                raise InputError(f"this plant does not show {name}: {reason}, not {channel!r}; leave {name} out")


def meter_outputs(
    loop: ClosedLoop, channels: Collection[str], x: ca.SX, u: ca.SX, p: ca.SX, control: ca.SX
) -> list[ca.SX]:
    """Symbolic outputs of the plant's meter in terms of the loop's states, inputs, parameters and command."""
    plant = loop.plant
    if plant.meter is None:
        return []
    order, signals = list(loop.parameters), names(loop.inputs)
    inputs = [control if q.name == loop.command.name else u[signals.index(q.name)] for q in plant.inputs]
    plant_parameters = ca.vertcat(*(p[order.index(n)] for n in plant.parameters))
    found = plant.meter.call([0, x[: len(plant.states)], ca.vertcat(*inputs), plant_parameters])
    shown = dict(zip(meter_channels(plant), found, strict=True))
    return [ca.SX(shown[channel]) for channel in channels]


def meter_record(t: Array, channels: Mapping[str, Array], start: float) -> StepRecord:
    """Record of the meter's channels (m, n) alone, for many responses on one grid, from `start` on."""
    kept = t >= start
    shown = {n: without_slopes(np.asarray(values)[:, kept]) for n, values in channels.items()}
    m = len(next(iter(channels.values())))
    none = without_slopes(np.zeros((m, 0)))
    return StepRecord(t[kept], none, none, np.zeros((m, 0, 0)), meter=shown)


def meter_metrics(loop: ClosedLoop, parameters: ParameterSet, response: Trajectory, start: float) -> dict[str, float]:
    """Metrics of one response from `start` on that the plant's meter shows, AirUse [l(ANR)] for example."""
    plant, shown = loop.plant, meter_channels(loop.plant)
    if plant.meter is None:
        return {}
    p = loop.parameter_vector(parameters)[[list(loop.parameters).index(n) for n in plant.parameters]]
    given = {q.name: response[q.name] if q.name in response else np.zeros(len(response)) for q in plant.inputs}
    inputs = np.column_stack([*(given | {loop.command.name: response["control"]}).values()])
    rows = compile_rows(plant.meter)([0.0], response.matrix(names(plant.states)), inputs, p)
    record = meter_record(response.t, {n: row.T for n, row in zip(shown, rows, strict=True)}, start)
    readable = (m for m in METRICS.values() if m.channels and set(m.channels) <= set(shown))
    return {metric.name: float(metric.largest(record)[0]) for metric in readable}


def refine_instants(
    t: Array, signal: Array, target: float, size: float, start: float, tolerance: float = 1.0
) -> Array | None:
    """Instants with others added where readings are too far apart, by a multiple of the tolerances; or None."""
    after, error = np.maximum(t - start, 0.0), np.where(t < start - 1e-12, 0.0, signal - target) / abs(size)
    coarse = np.diff(t) ** 2 / 8 * _curvatures(t, signal / abs(size)) > tolerance * LINE_TOLERANCE
    for integrand in (error, error**2, after * error):
        # all intervals together may contribute this share of the integral of the integrand's size; a corner of that
        # size, where the integrand changes its sign, is a small part of it all
        most = tolerance * INTEGRAL_TOLERANCE * float(np.trapezoid(np.abs(integrand), t)) / (len(t) - 1)
        coarse |= np.diff(t) ** 3 / 12 * _curvatures(t, integrand) > most
    fine = np.diff(t) > 8 * np.spacing(t[-1])
    chosen = np.flatnonzero(coarse & fine)
    finer = _divide(t, chosen) if len(chosen) else None
    return None if finer is None or len(finer) > MAX_INSTANTS else finer


def spread_instants(even: Array, needed: Array, start: float) -> Array:
    """Instants for the responses of other gains, which are as fast as one's, but not at the same instants.

    From the even ones on they come as close as those needed, at a third to three times their time after the step.
    """
    t, begin, width = even, needed[:-1], np.diff(needed)
    closest = width.min()
    while True:
        low, high = start + (t[:-1] - start) / SPREAD, start + (t[1:] - start) * SPREAD
        first, last = np.searchsorted(begin, low, side="right") - 1, np.searchsorted(begin, high)
        finest = [width[max(a, 0) : max(b, a + 1)].min() for a, b in zip(first.tolist(), last.tolist(), strict=True)]
        chosen = np.flatnonzero((np.diff(t) > 1.5 * np.maximum(finest, closest)) & (t[:-1] >= start - 1e-12))
        if not len(chosen):
            return t
        t = _divide(t, chosen)


def _divide(t: Array, chosen: Indices, parts: int = 8) -> Array:
    """Instants with those added that divide the chosen intervals into so many parts."""
    added = t[chosen, None] + np.diff(t)[chosen, None] * np.arange(1, parts) / parts
    return np.sort(np.concatenate([t, added.ravel()]))


def _curvatures(t: Array, y: Array) -> Array:
    """The size of the second derivative in each interval, the larger of those at its ends, shape (n - 1,)."""
    inside = np.abs(np.diff(np.diff(y) / np.diff(t))) / (t[2:] - t[:-2]) * 2
    ends = np.concatenate([[0.0], inside, [0.0]])
    return np.asarray(np.maximum(ends[:-1], ends[1:]))
