"""Detection of limit cycles, hunting and crawl, in a response or a log.

A limit cycle repeats (its autocorrelation has a second peak), keeps its amplitude (a decaying ringing is none) and
remains in the mean over a dither period.

`check_rest`: whether a loop truly comes to rest on a plant that sticks, or hunts, over a minute and more.

A smooth friction has no rest: a body on it creeps under any force, and what its integral will do an hour from now looks
like standing. So this check needs Karnopp's friction, whose break-aways and standstills are located, and reads
how the loop ends off these events: not off a band, which a slow hunting keeps for most of the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from math import inf, isfinite, log, nan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.simulate import simulate_stick_slip
from pneuopt.dynamics.stick_slip import Event, EventKind
from pneuopt.evaluation.metric import period_mean, remove_ripple
from pneuopt.evaluation.response import TuningCase, cases, loop_inputs, sample_spacing
from pneuopt.evaluation.rig import Rig, record
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.tolerances import (
    CROSSING_HYSTERESIS,
    DECAY_RATIO,
    MAX_PERIOD_SPREAD,
    MAX_READINGS,
    MIN_AUTOCORRELATION,
    MIN_CYCLES,
    MIN_KEPT_ERROR,
    MIN_PUSH,
    MIN_RELATIVE_AMPLITUDE,
    PHASES_PER_CYCLE,
    READINGS_A_SECOND,
    SIMULATION_TOLERANCE,
    STANDSTILL_FRACTION,
    STILL_SHARE,
    SUSTAINED_RATIO,
    TRANSIENT_SHARE,
    WINDOWS_PER_PERIOD,
)
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet, check_argument
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Result
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    import pandas as pd


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


@dataclass(frozen=True)
class NoHunting:
    """A limit of a tuning that only an event-accurate model shows: the loop comes to rest and stays, by `check_rest`.

    ``tune(..., subject_to=[NoHunting()], rig=rig)`` certifies no design that does not, and says why.

    Parameters
    ----------
    duration : float
        For how long each reference is watched [s].
    repeatability : float
        Largest range of the errors at rest over the references, such as moves from several starts [measured unit].
    """

    duration: float = 60.0  # hunting of a servo axis has periods of seconds
    repeatability: float = inf

    def __post_init__(self) -> None:
        proper = 0 < self.duration < inf
        require(proper, f"NoHunting: duration must be positive and finite, got {self.duration:g} s; 60 s is usual")
        message = f"NoHunting: repeatability must be positive, got {self.repeatability:g}; leave it out for any"
        require(self.repeatability > 0, message)


class RestKind(Enum):
    """Ending of a loop; the value is the word in tables."""

    RESTS = "rests"
    PUSHED = "pushed"
    HUNTS = "hunts"
    MOVES = "moves"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class RestCase:
    """Ending of a loop in one case.

    Attributes
    ----------
    label : str
    kind : RestKind
    error : float
        Signal less reference at the end; of a hunting loop the largest one over the second half [measured unit].
    amplitude : float
        Half the peak-to-peak value of the signal over the second half [measured unit]; of hunting.
    period : float
        Mean time from a break-away to the second after it, a whole cycle [s]; NaN where there is no hunting.
    slips : int
        Break-aways in the second half.
    last_motion : float
        Instant of the last standstill, from the reference's start on [s]; infinite where it moves at the end.
    push : float
        Rate at which the command changes while the body sticks at the end [command's unit/s]; NaN where it moves.
    sentence : str
        All of it in words.
    """

    label: str
    kind: RestKind
    error: float
    amplitude: float
    period: float
    slips: int
    last_motion: float
    push: float
    sentence: str


@dataclass(frozen=True, eq=False, repr=False)
class RestCheck(Result):
    """Findings of `check_rest`; prints its `summary()`.

    Attributes
    ----------
    cases : tuple of RestCase
    duration : float
        For how long each was watched [s].
    unit : str
        Of the measured signal.
    """

    cases: tuple[RestCase, ...]
    duration: float
    unit: str

    @property
    def rests(self) -> bool:
        """Whether every case comes to rest for good."""
        return all(case.kind is RestKind.RESTS for case in self.cases)

    @property
    def repeatability(self) -> float:
        """Range of the errors at rest over the cases, such as start positions; inf where one does not rest.

        In the measured unit; of one case 0.
        """
        errors = [case.error for case in self.cases]
        return max(errors) - min(errors) if self.rests else inf

    def to_frame(self) -> "pd.DataFrame":
        """A row a case, by its label: "kind", "error", "amplitude", "period", "slips", "last_motion", "push"."""
        import pandas as pd

        wanted = ("error", "amplitude", "period", "slips", "last_motion", "push")
        rows = {case.label: {"kind": case.kind.value, **{n: getattr(case, n) for n in wanted}} for case in self.cases}
        return pd.DataFrame.from_dict(rows, orient="index")

    def summary(self) -> Report:
        """The verdict, a sentence for each case that does not rest, and the table."""
        restless = [case for case in self.cases if case.kind is not RestKind.RESTS]
        count, whole = len(restless), len(self.cases)
        word = f"does not come to rest in {count} of {whole} cases" if count else f"comes to rest in {whole} of {whole}"
        lead = Line(f"the loop {word}, watched for {self.duration:g} s", Tone.BAD if count else Tone.GOOD)
        span = f"repeatability {write_value(self.repeatability, self.unit, 3)}: the range of its errors at rest"
        repeats = (Line(span, indent=2),) if self.rests and whole > 1 else ()
        columns = (*text_columns("case", "ends"), *number_columns(f"error\n{self.unit}", "slips", "last motion\ns"))
        rows = tuple(
            (c.label, c.kind.value, format_number(c.error, 3), str(c.slips), format_number(c.last_motion, 3))
            for c in self.cases
        )
        return Report((lead, *repeats, *(Line(c.sentence, indent=2) for c in restless), Table(columns, rows)))


def check_rest(
    model: ClosedLoop | Rig,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    scenarios: Scenarios = NO_SCENARIOS,
    duration: float = NoHunting.duration,
) -> RestCheck:
    """Watch a loop on a plant that sticks, event by event, long after its reference has come to its end.

    Parameters
    ----------
    model : ClosedLoop or Rig
        With Karnopp's friction: ``stick_slip_drive(drive)`` makes such a plant of a smooth one.
    references : Reference or sequence of Reference
        Each is held at its final value until `duration`.
    parameters : ParameterSet
    scenarios : mapping of str to mapping, optional
        Further plants, as for `certificate`.
    duration : float
        From the reference's start on [s].

    Returns
    -------
    RestCheck

    Raises
    ------
    ModelError
        If the plant has no Karnopp friction.
    InputError
        If the duration is shorter than a reference's horizon.

    Examples
    --------
    A PID on the position of a body with static friction above Coulomb's hunts, and a dead band of its integral ends
    that:

    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Stribeck
    >>> from pneuopt.models.friction import Karnopp
    >>> loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(dead_band=True), measured="position")
    >>> gains = {"pid.Kp": 5000.0, "pid.Ki": 20000.0, "pid.Kd": 200.0, "friction.stribeck_velocity": 1e-3}
    >>> values = loop.parameters.with_values(gains)
    >>> [check_rest(loop, Step(0.1), values.with_values({"pid.dead_band": w})).cases[0].kind.value for w in (0, 0.01)]
    ['hunts', 'rests']
    """
    check_argument(
        "loop", model, (ClosedLoop, Rig), "a ClosedLoop, such as ClosedLoop(drive, PID()), or a Rig with one"
    )
    steps = as_references(references)
    if model.loop is None:
        raise ModelError("this rig has no controller, so it follows no reference; make it of a ClosedLoop")
    require(isfinite(duration), f"check_rest: duration must be finite, got {duration} s")
    for step in steps:
        message = f"check_rest: duration {duration:g} s ends before the horizon of {step.label}, {step.horizon:g} s"
        require(duration >= step.horizon - step.at, message)
    loop = add_disturbances(model.loop, steps)
    rig = replace(model, model=loop) if isinstance(model, Rig) else None
    full = loop.complete(parameters)
    found = tuple(_watch(loop, rig, case, full, duration) for case in cases(steps, scenarios, full))
    return RestCheck(found, duration, loop.feedback.unit)


def _watch(loop: ClosedLoop, rig: Rig | None, case: TuningCase, parameters: ParameterSet, duration: float) -> RestCase:
    p, reference = case.case_parameters(parameters), case.reference
    start = case.initial(loop, parameters)
    inputs = loop_inputs(loop, reference, sample_spacing(loop, reference, p))
    left = reference.at + duration - inputs.t[-1]
    h = loop.pid.sample_time or max(left, 1e-9)
    count = int(np.ceil(left / h - 1e-9))
    if count > 0:  # the last values are held, sample by sample where the controller is sampled
        t = np.concatenate([inputs.t, inputs.t[-1] + h * np.arange(1, count + 1)])
        inputs = Trajectory(t, {n: np.append(inputs[n], np.full(count, inputs[n][-1])) for n in inputs})
    if rig is not None:
        recorded = record(rig, inputs, p, initial=start)
        run, events = recorded.truth, recorded.events
    else:
        t_out = None
        if loop.pid.sample_time is None:
            count = min(MAX_READINGS, int(READINGS_A_SECOND * inputs.t[-1]))
            t_out = np.union1d(inputs.t, np.linspace(0.0, inputs.t[-1], count + 1))
        rtol, atol = SIMULATION_TOLERANCE, SIMULATION_TOLERANCE / 100
        found = simulate_stick_slip(loop, inputs, p, initial=start, t_out=t_out, rtol=rtol, atol=atol)
        run, events = found.trajectory, found.events
    return _read_rest(loop, case, run, [e for e in events if e.t >= reference.at], p)


def _read_rest(
    loop: ClosedLoop, case: TuningCase, run: Trajectory, events: Sequence[Event], p: ParameterSet
) -> RestCase:
    reference = case.reference
    error, middle = run[loop.feedback.name] - reference.final, (reference.at + run.t[-1]) / 2
    late = run.t >= middle
    breaks = [e for e in events if e.kind is EventKind.BREAK_AWAY]
    stands = np.array([e.t for e in events if e.kind is EventKind.STANDSTILL])
    sticks = bool(run["stuck"][-1])
    still = STILL_SHARE * abs(reference.nominal_size)
    kind = _kind(error, run, stands, [e for e in breaks if e.t >= middle], late, still)
    hunts, slips = kind is RestKind.HUNTS, len([e for e in breaks if e.t >= middle])
    push = nan
    if sticks:
        moving = np.flatnonzero(run["stuck"] == 0)
        since = late & (np.arange(len(run.t)) > (moving[-1] if len(moving) else 0))
        t, u = run.t[since], run["control"][since]
        push = float((u[-1] - u[0]) / (t[-1] - t[0])) if len(t) > 1 else 0.0
    period = 2 * float(np.mean(np.diff([e.t for e in breaks if e.t >= stands[0]]))) if hunts else nan
    return RestCase(
        case.label,
        kind,
        float(np.abs(error[late]).max()) if hunts else float(error[-1]),
        float(np.ptp(error[late]) / 2) if hunts else 0.0,
        period,
        slips,
        float(stands[-1] - reference.at) if sticks and len(stands) else 0.0 if sticks else inf,
        push,
        f"at {case.label} the loop {_describe(loop, p, kind, error[late], push, period)}",
    )


def _kind(
    error: Array, run: Trajectory, stands: Array, late_breaks: Sequence[Event], late: Mask, still: float
) -> RestKind:
    """Ending of a run; a body that moves by less than `still` over its second half only dies away."""
    if not late_breaks:
        if not run["stuck"][-1]:
            return RestKind.RESTS if np.ptp(error[late]) <= still else RestKind.MOVES
        command = run["control"]
        pushed = np.ptp(command[late]) > MIN_PUSH * np.abs(command).max()
        return RestKind.PUSHED if pushed else RestKind.RESTS
    if len(stands) < MIN_CYCLES:
        return RestKind.UNDECIDED
    sizes = np.abs(np.interp(stands, run.t, error))[-MIN_CYCLES:]
    return RestKind.HUNTS if np.all(sizes[1:] >= MIN_KEPT_ERROR * sizes[:-1]) else RestKind.UNDECIDED


def _describe(loop: ClosedLoop, p: ParameterSet, kind: RestKind, error: Array, push: float, period: float) -> str:
    """A case in words, without its subject; error over the second half."""
    unit = loop.feedback.unit
    off = write_value(float(abs(error[-1])), unit, 3)
    if kind is RestKind.HUNTS:
        size, cycle, cause = write_value(float(np.ptp(error) / 2), unit, 3), write_value(period, "s", 3), ""
        static, coulomb = (p.value(n) if n in p else nan for n in ("friction.static", "friction.coulomb"))
        if loop.gains(loop.parameter_vector(p))[1] and static > coulomb:  # an integral, friction that falls on sliding
            cause = (
                f": the integral pushes the stuck body until it breaks away, and its static friction, "
                f"{static / coulomb:.3g} times Coulomb's, lets it jump beyond; give the integral a dead band wider "
                "than the error at rest"
            )
        return f"hunts by +-{size}, a cycle in {cycle}{cause}"
    if kind is RestKind.PUSHED:
        return (
            f"sticks {off} from the reference, and its command still changes by {push:.2g} {loop.command.unit}/s: "
            "it will break away; give the integral a dead band wider than that error"
        )
    return {
        RestKind.RESTS: f"rests {off} from the reference",
        RestKind.MOVES: f"still moves at the end, {off} from the reference",
        RestKind.UNDECIDED: f"slips on, {off} from the reference at the end: watch it longer, duration=",
    }[kind]
