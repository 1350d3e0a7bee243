"""`certificate`: what an independent simulation and the linear loop say about gains, and what is wrong with them.

A certificate without findings means, for the gains as printed and on every reference and scenario:

* The loop, integrated by LSODA to 1e-10, has the metrics that are shown; where it was tuned, they keep every limit,
  without slack, and the objective agrees with the search's claim to 1 %, neither worse nor better, or to the
  `Metric.resolution` of its terms where it is nearly zero.
* The linear loop is stable, with the margins that are shown, at every operating point of `Certificate.margins`.
* The response has come to rest, or to a periodic orbit inside the settling band, at the reference. A horizon can end
  too early to tell. So the response is continued, its length doubled again and again, until signal and command stand,
  to sixteen horizons, or to the end of the stroke, which a note then says. Growth, hunting and creep that begin beyond
  the horizon are findings, and so is a response that a budget of simulated instants leaves undecided. The metrics stay
  those of the horizon, but for a SettlingTime that the continuation refutes, which is NaN, and an Overshoot that it
  exceeds.

A design with a finding is never "converged", whatever was asked, unless `tune(..., accept=...)` names the defect. A
rest off the reference is none where a limit on SteadyStateError allows it.

What it does not mean: other plants than the scenarios may behave otherwise, and the model may be wrong.

The certificate shares the model with the search, its equations, parameters, rest, linearisation and compiled right-hand
side; the definitions of the metrics, which read both responses; and the formulas of frequency responses and stability.
It shares no step of the search: the search integrates by steps of RK4 on its own samples and reads the margins of many
loops at once off a grid; the certificate integrates by SciPy's LSODA with step control on a closer grid, and refines
each margin to machine precision. That what is shared is right is shown by tests against hand-written plants, SciPy and
python-control.

`Defect`, and `find_defects`: how a response ends that was continued until it was decided, in words.

`continue_response`: a response beyond its horizon, until it is plain whether it has come to rest.

`describe_counts`: a settling band that a controller cannot see, because its sensor reads in coarser counts.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import ceil, floor, isfinite, isnan, log10, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference, as_references, disturbance_input
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import continue_simulation
from pneuopt.evaluation.evaluate import CaseEvaluation, evaluate_cases, relevant_units, report_metrics, tabulate_metrics
from pneuopt.evaluation.limit_cycle import LimitCycle, find_limit_cycle
from pneuopt.evaluation.metric import (
    Band,
    SettlingBand,
    Tolerance,
    band_share,
    describe_ripple,
    entry_for_good,
    period_mean,
)
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.response import cases, check_travel, readings_a_sample, sample_spacing
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.tolerances import (
    COMMAND_DRIFT_SHARE,
    CONTACT_SHARE,
    CONTINUATION_TOLERANCE,
    COUNT_TOLERANCE,
    EDGE_SHARE,
    GROWTH_SHARE,
    LATEST_SETTLING,
    MAX_CONTINUATION_INSTANTS,
    MAX_HORIZONS,
    MAX_NOTES,
    MIN_DRIFT_SHARE,
    MIN_GROWTH,
    MIN_LATER_OVERSHOOT,
    MIN_MOTION,
    RUNAWAY_ERROR,
    STANDING_SHARE,
    TAIL_SHARE,
)
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import ConvergenceError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.results import Result
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class ContinuedResponse:
    """What a response does from the step on, as far as it was simulated.

    Attributes
    ----------
    loop : ClosedLoop
    reference : Reference
    period : float or None
        The time over which dither is averaged [s].
    t : ndarray, shape (n,)
        Time since the step [s].
    signal, command : ndarray, shape (n,)
        The measured signal and the command, dither included [their units].
    contact : str
        The validity limit that ended the simulation, the end of the stroke say, in words; empty where none did.
    stops : str
        Why the integration stopped, where it did.
    is_cut : bool
        Whether the budget of simulated instants ended it.
    is_stable : bool
        Whether the linear loop is stable: where it is not, a response that stands does so for a while only.
    """

    loop: ClosedLoop
    reference: Reference
    period: float | None
    t: Array
    signal: Array
    command: Array
    contact: str = ""
    stops: str = ""
    is_cut: bool = False
    is_stable: bool = True

    @property
    def horizon(self) -> float:
        """The stated horizon, counted from the step [s]."""
        return self.reference.horizon - self.reference.at

    @property
    def is_over(self) -> bool:
        """Whether there is nothing left to simulate."""
        over = self.t[-1] >= (1 - 1e-9) * MAX_HORIZONS * self.horizon
        return bool(over or self.contact or self.stops or self.is_cut or self.runs_away)

    @property
    def runs_away(self) -> bool:
        """Whether the error has left every sensible size."""
        return bool(np.abs(self.error[-1]) > RUNAWAY_ERROR)

    @property
    def before_contact(self) -> slice:
        """The instants of `t` that are judged: those shortly before a contact are left out."""
        left_out = CONTACT_SHARE * self.t[-1] if self.contact else 0.0
        return slice(int(np.searchsorted(self.t, self.t[-1] - left_out, side="right")))

    @cached_property
    def at(self) -> Array:
        """Instants of `before_contact` at which the mean over a dither's period is known [s]."""
        t = self.t[self.before_contact]
        return np.asarray(t[t <= self.t[-1] - (self.period or 0.0) / 2])

    @cached_property
    def error(self) -> Array:
        """The mean signal's distance from the reference in steps, positive beyond it, at the instants `at`."""
        return (self._mean(self.signal, self.reference.initial) - self.reference.final) / self.reference.nominal_size

    @cached_property
    def mean_command(self) -> Array:
        """The command's mean at the instants `at` [its unit]."""
        return self._mean(self.command, float(self.command[0]))

    def since(self, share: float) -> slice:
        """The instants of `at` from this share of the record on."""
        return slice(int(np.searchsorted(self.at, share * self.at[-1])), None)

    def stands(self, band: float) -> bool:
        """Whether the mean signal stands over the second half of the record, wherever that is."""
        return bool(np.ptp(self.error[self.since(0.5)]) <= STANDING_SHARE * band)

    def is_decided(self, band: float) -> bool:
        """Whether signal and command stand and the linear loop is stable, or nothing is left to simulate."""
        ahead = 2 * (MAX_HORIZONS * self.horizon / self.t[-1] - 1)  # halves of the record still to come
        drift = np.ptp(self.mean_command[self.since(0.5)]) * ahead
        quiet = self.is_stable and self.stands(band) and drift <= COMMAND_DRIFT_SHARE * np.abs(self.command).max()
        return self.is_over or bool(quiet)

    def _mean(self, values: Array, initial: float) -> Array:
        if self.period is None:
            return values[: len(self.at)]
        return np.asarray(period_mean(self.t, values[None], initial, self.period, self.at)[0])


def continue_response(found: CaseEvaluation, band: float) -> ContinuedResponse:
    """Continue a response by its own length again and again until it is decided.

    Parameters
    ----------
    found : CaseEvaluation
        Of a loop, with its response up to the horizon.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    ContinuedResponse
        It ends where signal and command stand, at `MAX_HORIZONS` horizons, at a contact with a validity limit, or
        where the budget of simulated instants ends.
    """
    loop, run, reference = found.loop, found.response, found.case.reference
    since = run.t >= reference.at - 1e-12 * max(1.0, reference.at)
    period = loop.dither_period(found.parameters)
    t, y, u = (run.t[since] - reference.at, run[loop.feedback.name][since], run["control"][since])
    stable = bool(np.isfinite(found.metrics["MaxSensitivity"]))
    course = ContinuedResponse(loop, reference, period, t, y, u, contact=_limit_in_horizon(found), is_stable=stable)
    left = MAX_CONTINUATION_INSTANTS
    while not course.is_decided(band):
        inputs, instants = _next_inputs(found, run.t[-1], course)
        left -= len(instants)
        if left < 0:
            return replace(course, is_cut=True)
        x = np.array([run[q.name][-1] for q in loop.states])
        try:
            run, met = continue_simulation(
                loop,
                inputs,
                found.parameters,
                x,
                t_out=instants,
                rtol=CONTINUATION_TOLERANCE,
                atol=CONTINUATION_TOLERANCE / 100,
            )
        except ConvergenceError as error:
            return replace(course, stops=str(error))
        course = _append(course, run, str(met[0]) if met else "")
    return course


def _limit_in_horizon(found: CaseEvaluation) -> str:
    """The validity limit that the response meets within its horizon, in words; beyond it there is no model."""
    for limit in found.loop.plant.validity_limits:
        values, edge = found.response[limit.state], limit.limit(found.parameters)
        if np.any(limit.side * (edge - values[1:]) <= 0):
            return f"{limit.event} within the horizon"
    return ""


def _append(course: ContinuedResponse, run: Trajectory, contact: str) -> ContinuedResponse:
    t, y, u = (run.t[1:] - course.reference.at, run[course.loop.feedback.name][1:], run["control"][1:])
    return replace(
        course,
        t=np.concatenate([course.t, t]),
        signal=np.concatenate([course.signal, y]),
        command=np.concatenate([course.command, u]),
        contact=contact,
    )


def _next_inputs(found: CaseEvaluation, begin: float, course: ContinuedResponse) -> tuple[Trajectory, Array]:
    """Inputs that stay as they were after the step for once more the record's length, and instants to report."""
    loop, reference, h = found.loop, found.case.reference, found.loop.pid.sample_time
    length = min(course.t[-1], MAX_HORIZONS * course.horizon - course.t[-1])
    spacing = sample_spacing(loop, reference, found.parameters)
    count = max(1, int(np.ceil(length / spacing - 1e-9)))
    t = begin + spacing * np.arange(count + 1)
    held = {"reference": reference.final, **{disturbance_input(n): v for n, v in reference.disturbance.items()}}
    columns = {q.name: np.full(len(t), held.get(q.name, 0.0)) for q in loop.inputs}
    readings = 1 if h is None else readings_a_sample(loop, reference)
    return Trajectory(t, columns), np.linspace(t[0], t[-1], readings * count + 1)


class Defect(Enum):
    """What can be wrong with gains whatever was asked of them; the value is the word that files use."""

    UNSTABLE = "unstable"
    GROWS = "grows"
    HUNTS = "hunts"
    CREEPS = "creeps"
    NEVER_SETTLES = "never settles"
    STANDS_STILL = "stands still"
    MISSES_REFERENCE = "misses reference"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """A defect in one case.

    Attributes
    ----------
    defect : Defect
    case : str
        The case's label, a column of `evaluate`.
    sentence : str
        The defect in words, with its figures.
    """

    defect: Defect
    case: str
    sentence: str


@dataclass(frozen=True, eq=False)
class Ending:
    """The one answer to "how does a response end", read against a settling band; certificate and verdicts read it.

    Parameters
    ----------
    course : ContinuedResponse
    band : float
        Half width, a fraction of the step.
    case : str
        Its label.
    rest_error : float
        Distance from the reference at which it may rest outside the band, a fraction of the step.
    """

    course: ContinuedResponse
    band: float
    case: str
    rest_error: float = 0.0

    @property
    def defect(self) -> Defect | None:
        """How it ends where it neither settles nor rests where it may."""
        return self.description[0] if self.description else None

    @property
    def hunts(self) -> bool:
        """Whether it goes on to and fro, out of the band."""
        return self.defect is Defect.HUNTS

    @cached_property
    def description(self) -> tuple[Defect, str] | None:
        """The defect and its predicate, "hunts: ..."."""
        return _describe_defect(self)

    @cached_property
    def settling_time(self) -> float:
        """Instant after the step from which the mean stays in the band, to the grid [s]; inf where it does not."""
        return entry_for_good(self.course.at, self.is_inside(self.course.error))

    @property
    def is_settled(self) -> bool:
        """Whether the mean enters the band for good."""
        return isfinite(self.settling_time)

    def is_inside(self, error: Array) -> Mask:
        """Which errors, in steps, lie in the band."""
        return SettlingBand(0.0, self.band).contains(error)

    def returns(self, share: float) -> int:
        """How often the mean leaves the band from this share of the record on, having been inside."""
        inside = self.is_inside(self.course.error[self.course.since(share)])
        return int(np.sum(inside[:-1] & ~inside[1:]))

    @property
    def largest_overshoot(self) -> float:
        """The mean's largest distance beyond the reference, in steps; on either side where only a disturbance steps."""
        error = self.course.error
        return float(max(0.0, (error if self.course.reference.changes else np.abs(error)).max()))

    def refutes(self, settling_time: float) -> bool:
        """Whether the mean leaves the band after this instant, beyond the horizon [s]."""
        course = self.course
        return not self.is_inside(course.error[course.at > course.horizon]).all() and settling_time <= course.horizon

    @property
    def stands(self) -> bool:
        """Whether the mean stands, wherever that is."""
        return self.course.stands(self.band)

    @property
    def final_error(self) -> float:
        """Distance from the reference at the end, in steps, with its sign."""
        late = self.course.error[self.course.since(1 - TAIL_SHARE)]
        return float(late.mean())

    @cached_property
    def cycle(self) -> LimitCycle | None:
        """An oscillation that does not decay in the second half of the record [measured unit]."""
        course, size = self.course, abs(self.course.reference.nominal_size)
        least = GROWTH_SHARE * self.band * size
        return find_limit_cycle(course.at, size * course.error, start=course.at[-1] / 2, min_amplitude=least)

    @property
    def growth(self) -> float:
        """Ratio of the mean's range in the last quarter of the record to that in the quarter before."""
        at, error = self.course.at, self.course.error
        before = error[(at >= 0.5 * at[-1]) & (at < 0.75 * at[-1])]
        return float(np.ptp(error[self.course.since(0.75)]) / max(np.ptp(before), 1e-300))

    @property
    def drifts(self) -> bool:
        """Whether the mean moves in one direction over the second half of the record."""
        late = self.course.error[self.course.since(0.5)]
        return bool(abs(late[-1] - late[0]) >= MIN_DRIFT_SHARE * np.ptp(late))


def find_defects(ending: Ending) -> Iterator[Finding]:
    """The defect with which a response ends, if any."""
    if ending.description is not None:
        defect, words = ending.description
        yield Finding(defect, ending.case, f"at {ending.case} the loop {words}")


def _describe_defect(ending: Ending) -> tuple[Defect, str] | None:
    """The defect and its predicate, "hunts: ..."."""
    course, cycle = ending.course, ending.cycle
    moved, until = 1 + float(course.error.max()), f"{course.t[-1]:.3g} s after the step"
    if course.runs_away:
        return Defect.GROWS, f"runs away: {until} it is {abs(course.error[-1]):.3g} steps off"
    if course.stops:
        return Defect.UNDECIDED, f"is undecided: {course.stops}"
    if course.reference.changes and moved < MIN_MOTION:
        return Defect.STANDS_STILL, f"stands still: {until} it has moved by {100 * max(moved, 0.0):.2g} % of the step"
    if cycle is not None and ending.growth > MIN_GROWTH:
        return Defect.GROWS, f"swings more and more: {until} it has {cycle.describe(course.loop.feedback.unit)}"
    if ending.is_settled and ending.settling_time > LATEST_SETTLING * course.horizon:
        times = f"{ending.settling_time / course.horizon:.2g} times its horizon"
        return (
            Defect.CREEPS,
            f"creeps: it is in the band for good only {ending.settling_time:.3g} s after the step, {times}",
        )
    rests = ending.stands and abs(ending.final_error) <= max(ending.rest_error, ending.band)
    return None if ending.is_settled or rests else _describe_unrest(ending, cycle, until)


def _describe_unrest(ending: Ending, cycle: LimitCycle | None, until: str) -> tuple[Defect, str]:
    """The defect of a response that does not settle where it should, and its predicate."""
    off, returns = f"{100 * abs(ending.final_error):.3g} % of the step", ending.returns(0.5)
    if ending.course.is_cut:
        return Defect.UNDECIDED, f"is undecided: the budget of simulated instants ends {until}, it is {off} off"
    if ending.stands:
        return Defect.MISSES_REFERENCE, f"misses the reference: it rests {off} away from it"
    if cycle is not None:
        return Defect.HUNTS, f"hunts: it ends in {cycle.describe(ending.course.loop.feedback.unit)}"
    if returns > 1:
        return Defect.HUNTS, f"hunts: {until} it has left the band {returns} times in half that time"
    if ending.drifts:
        return Defect.CREEPS, f"creeps: {until} it is {off} away from the reference, and still moving"
    return Defect.NEVER_SETTLES, f"never settles: {until} it is {off} away from the reference"


def correct_metrics(ending: Ending, metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics of the horizon, less what the continuation refutes.

    SettlingTime is NaN where the mean leaves the band again or the loop does not settle, and the overshoot is that of
    the continuation where it is larger.
    """
    largest = ending.largest_overshoot
    times = [n for n in ("SettlingTime", "SettlingTimeRaw") if n in metrics]
    refuted = dict.fromkeys(times, nan) if ending.refutes(metrics["SettlingTime"]) else {}
    higher = {"Overshoot": 100 * largest, "OvershootDistance": largest * abs(ending.course.reference.nominal_size)}
    if largest <= metrics["Overshoot"] / 100 + MIN_LATER_OVERSHOOT * ending.band:
        higher = {}
    return {**metrics, **refuted, **higher}


def describe_ending(ending: Ending, metrics: Mapping[str, float]) -> Iterator[str]:
    """What a user should know of an ending that is no defect."""
    course, band, begins = ending.course, f"the band of {100 * ending.band:.3g} %", f"at {ending.case} the loop"
    if course.contact:
        yield f"at {ending.case} the certificate ends {course.t[-1]:.3g} s after the step: {course.contact}"
    if ending.refutes(metrics["SettlingTime"]):
        yield f"{begins} leaves {band} again after its horizon"
    if ending.is_settled and not ending.settling_time <= course.horizon:
        yield f"{begins} is in {band} for good only {ending.settling_time:.3g} s after the step, beyond the horizon"
    cycle = ending.cycle
    if cycle is not None and ending.is_settled:
        yield f"{begins} keeps {cycle.describe(course.loop.feedback.unit)}, inside {band}"
    if ending.stands and EDGE_SHARE * ending.band < abs(ending.final_error) <= ending.band:
        yield f"{begins} rests {100 * abs(ending.final_error):.3g} % off the reference, near the edge of {band}"
    ripple = describe_ripple(metrics, course.reference.nominal_size, ending.band)
    if ripple is not None:
        yield f"at {ending.case} {ripple}"


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Result):
    """What `certificate` found; prints its `summary()`.

    Attributes
    ----------
    metrics : DataFrame
        As `evaluate` returns them, but for what the continuation refutes.
    findings : tuple of Finding
        The defects; empty where the gains hold on every case.
    notes : tuple of str
        What a user should know and what is no defect, a sentence each.
    margins : DataFrame
        A row a case and operating point: "case", "point", the margins' metrics, and "stable".
    units : mapping of str to str
        The metrics that a table shows, in that order, with their units; the reference's has the key "".
    """

    metrics: "pd.DataFrame"
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    margins: "pd.DataFrame"
    units: Mapping[str, str] = field(default_factory=dict)

    def summary(self) -> Report:
        """The defects, or that there is none, then metrics, margins and notes."""
        count = len(self.findings)
        word = f"{count} defect{'s' if count > 1 else ''}" if count else "no defect"
        cases = len(self.metrics.columns)
        lead = Line(f"{word} in {cases} case{'s' if cases != 1 else ''}", Tone.BAD if count else Tone.GOOD)
        defects = Report((lead, *(Line(finding.sentence, indent=2) for finding in self.findings)))
        return (
            defects + report_metrics(self.metrics, self.units) + report_margins(self.margins) + report_notes(self.notes)
        )


def certificate(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    scenarios: Scenarios = NO_SCENARIOS,
    band: Band = 0.02,
    envelope: Envelope = (),
) -> Certificate:
    """Evaluate gains on every case and look for defects; parameters, errors and warnings as for `evaluate`.

    Returns
    -------
    Certificate

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.models.linear import SecondOrder
    >>> loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    >>> found = certificate(loop, Step(1.0), loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 30.0}))
    >>> found.findings[0].defect
    <Defect.UNSTABLE: 'unstable'>
    """
    check_closed_loop(loop)
    full = loop.complete(parameters)
    for case in cases(as_references(references), scenarios, full):
        check_travel(loop, case, full)
    found = evaluate_cases(loop, references, parameters, scenarios=scenarios, band=band, envelope=envelope)
    return judge_evaluations(tuple(found), band)


def judge_evaluations(
    evaluations: Sequence[CaseEvaluation], band: Band, rest_error: float = 0.0, *, continues: bool = True
) -> Certificate:
    """The certificate of gains that have been evaluated on every case.

    Parameters
    ----------
    evaluations : sequence of CaseEvaluation
    band : float or Tolerance
        Half width of the settling band, a fraction of the step or in the measured unit.
    rest_error : float
        Distance from the reference at which the loop may rest outside the band, a fraction of the step.
    continues : bool
        Whether to continue the responses beyond their horizons. Without, the certificate is of the linear loop only,
        for gains that are refused already.
    """
    import pandas as pd

    margins = [{"case": found.case.label, **row} for found in evaluations for row in found.margins]
    findings, notes = [finding for row in margins for finding in _find_instability(row)], list[str]()
    metrics = tabulate_metrics(evaluations)
    for found in evaluations if continues else ():
        share = band_share(band, found.case.reference)
        ending = Ending(continue_response(found, share), share, found.case.label, rest_error)
        findings += find_defects(ending)
        notes += describe_ending(ending, found.metrics)
        counts = describe_counts(found.loop, found.parameters, found.case.reference, band)
        notes += [f"at {ending.case} {counts}"] if counts else []
        metrics[ending.case] = pd.Series(correct_metrics(ending, found.metrics))
    units = relevant_units(evaluations[0].loop)
    return Certificate(metrics, tuple(findings), tuple(notes), pd.DataFrame(margins), units)


def _find_instability(row: dict[str, Any]) -> Iterator[Finding]:
    if not row["stable"]:
        yield Finding(Defect.UNSTABLE, row["case"], f"the linear loop is unstable {row['point']} in {row['case']}")


def report_margins(margins: "pd.DataFrame") -> Report:
    """Where the loop's sensitivity is largest, operating point by operating point.

    Parameters
    ----------
    margins : DataFrame
        Of a `Certificate`.
    """
    if margins.empty:
        return Report()
    worst = margins.groupby("point", sort=False)["MaxSensitivity"].max().to_dict()
    parts = ", ".join(f"{value:.4g} {point}" for point, value in worst.items())
    phase = margins["PhaseMargin"].min() if "PhaseMargin" in margins else nan
    also = "" if isnan(phase) else f"; phase margin at least {phase:.3g} deg"
    return Report((Line(f"MaxSensitivity, the worst of all cases: {parts}{also}"),))


def report_notes(notes: Sequence[str]) -> Report:
    """What a certificate notes beside its figures, the first few in full."""
    more = len(notes) - MAX_NOTES
    rest = f"{more} more notes of this kind on other cases; --json FILE holds all, and so does `Certificate.notes`"
    return Report((*map(Line, notes[:MAX_NOTES]), *([Line(rest)] if more > 0 else [])))


def describe_counts(loop: ClosedLoop, parameters: ParameterSet, reference: Reference, band: Band) -> str | None:
    """Sentence for a settling band narrower than half of what one count changes the reading by; None for others.

    A position inside half a count of the reference reads as the reference, inside the band or outside, so that nothing
    holds it in a narrower band. Of a speed only the instants are that coarse: over many samples the counts add up.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Every parameter of the loop.
    reference : Reference
    band : float or Tolerance
        Half width, a fraction of the step or in the measured unit.
    """
    count, size, unit = loop.controller.sensor_resolution(parameters), abs(reference.nominal_size), loop.feedback.unit
    half = band_share(band, reference) * size
    if count / 2 <= half * (1 + COUNT_TOLERANCE):
        return None
    told = f"the settling band of +-{write_value(half, unit, 3)} is narrower than half"
    change, wider = write_value(count, unit, 3), _wider_band(count / 2, size, band, unit)
    if sees_speed(loop):
        remedy = "a finer encoder or a longer filter of the sensor"
        return f"{told} the {change} by which one count changes the reading; {wider}{remedy}"
    ripple = loop.dither_period(parameters) is not None
    tells = "tells inside from outside only by its dither's ripple" if ripple else "cannot tell inside from outside"
    remedy = "a larger step or a finer encoder"
    return f"{told} the encoder's count of {change}, the controller {tells}; {wider}{remedy}"


def _wider_band(half: float, size: float, band: Band, measured: str) -> str:
    """The words that name a wide enough band, rounded up to three digits; none where none is within the step."""
    measures = isinstance(band, Tolerance)
    least, most = (half, size) if measures else (half / size, 1.0)
    unit = 10.0 ** (floor(log10(least)) - 2)
    rounded = ceil(least / unit * (1 - COUNT_TOLERANCE)) * unit
    shown = write_value(rounded, measured, 3) if measures else f"{rounded:.3g}"
    return f"take band = {shown} or more, " if rounded < most else "take "


def sees_speed(loop: ClosedLoop) -> bool:
    """Whether the controller sees a speed that an encoder differentiates."""
    return isinstance(loop.sensor, Encoder) and loop.feedback.name != loop.sensor.position
