"""`certificate`: what an independent simulation and the linear loop say about gains, and what is wrong with them.

A certificate without findings means, for the gains as printed and on every reference and scenario:

* The loop, integrated by LSODA to 1e-10, has the metrics that are shown; where it was tuned, they keep every limit,
  without slack, and the objective agrees with the search's claim to 1 %, neither worse nor better, or to the
  `Metric.resolution` of its terms where it is nearly zero.
* The linear loop is stable, with the margins that are shown, at every operating point of `Certificate.margins`.
* The response has come to rest, or to a periodic orbit inside the settling band, at the reference. A horizon can end
  too early to tell, so the response is continued, its length doubled again and again, until signal and command stand,
  to sixteen horizons, or to the end of the stroke, which a note then says. The metrics stay those of the horizon, but
  for a SettlingTime that the continuation refutes, which is NaN, and an Overshoot that it exceeds.

A design with a finding is never "converged", unless `tune(..., accept=...)` names the defect. Other plants than the
scenarios may behave otherwise, and the model may be wrong.

The certificate shares the model with the search, its equations, parameters, rest, linearisation and compiled right-hand
side; the definitions of the metrics; and the formulas of frequency responses and stability. It shares no step of the
search: the search integrates by steps of RK4 on its own samples and reads the margins of many loops at once off a grid;
the certificate integrates by SciPy's LSODA with step control on a closer grid, and refines each margin to machine
precision. That what is shared is right is shown by tests against hand-written plants, SciPy and python-control.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import ceil, floor, isfinite, isnan, log10, nan
from typing import TYPE_CHECKING

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
    EDGE_ROUNDING,
    EDGE_SHARE,
    GROWTH_SHARE,
    LATEST_SETTLING,
    MAX_CONTINUATION_INSTANTS,
    MAX_HORIZONS,
    MIN_DRIFT_SHARE,
    MIN_EXIT,
    MIN_GROWTH,
    MIN_LATER_OVERSHOOT,
    MIN_MOTION,
    RUNAWAY_ERROR,
    SIMULATION_TOLERANCE,
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


class Defect(Enum):
    """A fault of gains, whatever was asked of them; the value is the word that files use."""

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


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Result):
    """Findings of `certificate`; prints its `summary()`.

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
    """The certificate of evaluated gains, whose loops may rest a fraction `rest_error` of the step off the reference.

    Without `continues`, for gains that are refused already, it is of the linear loop only.
    """
    import pandas as pd

    margins = [{"case": found.case.label, **row} for found in evaluations for row in found.margins]
    findings, notes = list[Finding](), list[str]()
    for case, point in ((row["case"], row["point"]) for row in margins if not row["stable"]):
        findings.append(Finding(Defect.UNSTABLE, case, f"the linear loop is unstable {point} in {case}"))
    metrics = tabulate_metrics(evaluations)
    for found in evaluations if continues else ():
        share = band_share(band, found.case.reference)
        ending = Ending(continue_response(found, share), share, found.case.label, rest_error)
        findings += ending.findings()
        notes += ending.notes(found.metrics)
        counts = describe_counts(found.loop, found.parameters, found.case.reference, band)
        notes += [f"at {ending.case} {counts}"] if counts else []
        metrics[ending.case] = pd.Series(ending.correct(found.metrics))
    units = relevant_units(evaluations[0].loop)
    return Certificate(metrics, tuple(findings), tuple(notes), pd.DataFrame(margins), units)


def report_margins(margins: "pd.DataFrame") -> Report:
    """Largest sensitivity of the loop, operating point by operating point, off `Certificate.margins`."""
    if margins.empty:
        return Report()
    worst = margins.groupby("point", sort=False)["MaxSensitivity"].max().to_dict()
    parts = ", ".join(f"{value:.4g} {point}" for point, value in worst.items())
    phase = margins["PhaseMargin"].min() if "PhaseMargin" in margins else nan
    also = "" if isnan(phase) else f"; phase margin at least {phase:.3g} deg"
    return Report((Line(f"MaxSensitivity, the worst of all cases: {parts}{also}"),))


def report_notes(notes: Sequence[str], shown: int = 4) -> Report:
    """Notes of a certificate beside its figures, the first few in full."""
    more = len(notes) - shown
    rest = f"{more} more notes of this kind on other cases; --json FILE holds all, and so does `Certificate.notes`"
    return Report((*map(Line, notes[:shown]), *([Line(rest)] if more > 0 else [])))


@dataclass(frozen=True, eq=False)
class ContinuedResponse:
    """Response from the step on, as far as it was simulated."""

    loop: ClosedLoop
    reference: Reference
    period: float | None  # over which dither is averaged [s]
    t: Array  # since the step, shape (n,) [s]
    signal: Array  # the measured one, shape (n,) [its unit]
    command: Array  # dither included, shape (n,) [its unit]
    contact: str = ""  # the validity limit that ended the simulation in words, the end of the stroke for example
    stops: str = ""  # why the integration stopped, where it did
    is_cut: bool = False  # whether the budget of simulated instants ended it
    is_stable: bool = True  # of the linear loop: where that is unstable, a response stands for a while only

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
    def times(self) -> Array:
        """Instants of `before_contact` at which the mean over a dither's period is known [s]."""
        t = self.t[self.before_contact]
        return np.asarray(t[t <= self.t[-1] - (self.period or 0.0) / 2])

    @cached_property
    def error(self) -> Array:
        """The mean signal's distance from the reference in steps, positive beyond it, at the instants `times`."""
        return (self._mean(self.signal, self.reference.initial) - self.reference.final) / self.reference.nominal_size

    def since(self, share: float) -> slice:
        """The instants of `times` from this share of the record on."""
        return slice(int(np.searchsorted(self.times, share * self.times[-1])), None)

    def stands(self, band: float) -> bool:
        """Whether the mean signal stands over the second half of the record, wherever that is."""
        return bool(np.ptp(self.error[self.since(0.5)]) <= STANDING_SHARE * band)

    def is_decided(self, band: float) -> bool:
        """Whether signal and command stand and the linear loop is stable, or nothing is left to simulate."""
        ahead = 2 * (MAX_HORIZONS * self.horizon / self.t[-1] - 1)  # halves of the record still to come
        drift = np.ptp(self._mean(self.command, float(self.command[0]))[self.since(0.5)]) * ahead
        quiet = self.is_stable and self.stands(band) and drift <= COMMAND_DRIFT_SHARE * np.abs(self.command).max()
        return self.is_over or bool(quiet)

    def _mean(self, values: Array, initial: float) -> Array:
        if self.period is None:
            return values[: len(self.times)]
        return np.asarray(period_mean(self.t, values[None], initial, self.period, self.times)[0])


def continue_response(found: CaseEvaluation, band: float) -> ContinuedResponse:
    """Continue a response by its own length again and again, until it is decided or nothing is left to simulate.

    The half width `band` of the settling band is a fraction of the step.
    """
    loop, run, reference = found.loop, found.response, found.case.reference
    since = run.t >= reference.at - 1e-12 * max(1.0, reference.at)
    period = loop.dither_period(found.parameters)
    t, y, u = (run.t[since] - reference.at, run[loop.feedback.name][since], run["control"][since])
    stable, contact = bool(np.isfinite(found.metrics["MaxSensitivity"])), ""
    for limit in loop.plant.validity_limits:  # beyond one that is met within the horizon there is no model
        if not contact and np.any(limit.side * (limit.limit(found.parameters) - run[limit.state][1:]) <= 0):
            contact = f"{limit.event} within the horizon"
    continued = ContinuedResponse(loop, reference, period, t, y, u, contact=contact, is_stable=stable)
    left, spacing = MAX_CONTINUATION_INSTANTS, sample_spacing(loop, reference, found.parameters)
    readings = 1 if loop.pid.sample_time is None else readings_a_sample(loop, reference)
    held = {"reference": reference.final, **{disturbance_input(n): v for n, v in reference.disturbance.items()}}
    while not continued.is_decided(band):  # the inputs stay as they were after the step
        length = min(continued.t[-1], MAX_HORIZONS * continued.horizon - continued.t[-1])
        count = max(1, int(np.ceil(length / spacing - 1e-9)))
        at = run.t[-1] + spacing * np.arange(count + 1)
        inputs = Trajectory(at, {q.name: np.full(len(at), held.get(q.name, 0.0)) for q in loop.inputs})
        instants = np.linspace(at[0], at[-1], readings * count + 1)
        left -= len(instants)
        if left < 0:
            return replace(continued, is_cut=True)
        x = np.array([run[q.name][-1] for q in loop.states])
        try:
            rtol, atol = SIMULATION_TOLERANCE, SIMULATION_TOLERANCE / 100
            run, met = continue_simulation(loop, inputs, found.parameters, x, t_out=instants, rtol=rtol, atol=atol)
        except ConvergenceError as error:
            return replace(continued, stops=str(error))
        t, y, u = (run.t[1:] - reference.at, run[loop.feedback.name][1:], run["control"][1:])
        known = (continued.t, continued.signal, continued.command)
        t, y, u = (np.concatenate(parts) for parts in zip(known, (t, y, u), strict=True))
        continued = replace(continued, t=t, signal=y, command=u, contact=str(met[0]) if met else "")
    return continued


@dataclass(frozen=True, eq=False)
class Ending:
    """The one answer to "how does a response end", read against a settling band; certificate and verdicts read it."""

    response: ContinuedResponse
    band: float  # half width, a fraction of the step
    case: str  # the case's label
    rest_error: float = 0.0  # distance from the reference at which it may rest outside the band, a fraction of the step

    @property
    def defect(self) -> Defect | None:
        """Defect of a response that neither settles nor rests where it may; None without one."""
        return self.description[0] if self.description else None

    @property
    def hunts(self) -> bool:
        """Whether it goes on to and fro, out of the band."""
        return self.defect is Defect.HUNTS

    @cached_property
    def description(self) -> tuple[Defect, str] | None:
        """The defect and its predicate, "hunts: ..."; None without one."""
        response, cycle, horizon = self.response, self.cycle, self.response.horizon
        moved, until = max(1 + float(response.error.max()), 0.0), f"{response.t[-1]:.3g} s after the step"
        if response.runs_away:
            return Defect.GROWS, f"runs away: {until} it is {abs(response.error[-1]):.3g} steps off"
        if response.stops:
            return Defect.UNDECIDED, f"is undecided: {response.stops}"
        if response.reference.changes and moved < MIN_MOTION:
            return Defect.STANDS_STILL, f"stands still: {until} it has moved by {100 * moved:.2g} % of the step"
        if cycle is not None and self.growth > MIN_GROWTH:
            return Defect.GROWS, f"swings more and more: {until} it has {cycle.describe(response.loop.feedback.unit)}"
        if self.is_settled and self.settling_time > LATEST_SETTLING * horizon:
            late = f"{self.settling_time:.3g} s after the step, {self.settling_time / horizon:.2g} times its horizon"
            return Defect.CREEPS, f"creeps: it is in the band for good only {late}"
        rests = self.stands and abs(self.final_error) <= max(self.rest_error, self.band)
        return None if self.is_settled or rests else self._describe_unrest(cycle, until)

    def _describe_unrest(self, cycle: LimitCycle | None, until: str) -> tuple[Defect, str]:
        """The defect of a response that does not settle where it should, and its predicate."""
        off, returns = f"{100 * abs(self.final_error):.3g} % of the step", self.returns(0.5)
        if self.response.is_cut:
            return Defect.UNDECIDED, f"is undecided: the budget of simulated instants ends {until}, it is {off} off"
        if self.stands:
            return Defect.MISSES_REFERENCE, f"misses the reference: it rests {off} away from it"
        if cycle is not None:
            return Defect.HUNTS, f"hunts: it ends in {cycle.describe(self.response.loop.feedback.unit)}"
        if returns > 1:
            return Defect.HUNTS, f"hunts: {until} it has left the band {returns} times in half that time"
        if self.drifts:
            return Defect.CREEPS, f"creeps: {until} it is {off} away from the reference, and still moving"
        return Defect.NEVER_SETTLES, f"never settles: {until} it is {off} away from the reference"

    @cached_property
    def settling_time(self) -> float:
        """Instant after the step from which the mean stays in the band, to the grid [s]; inf where it does not."""
        return entry_for_good(self.response.times, self.is_inside(self.response.error))

    @property
    def is_settled(self) -> bool:
        """Whether the mean enters the band for good."""
        return isfinite(self.settling_time)

    def is_inside(self, error: Array) -> Mask:
        """Which errors, in steps, lie in the band."""
        return SettlingBand(0.0, self.band).contains(error)

    def returns(self, share: float) -> int:
        """Number of times that the mean leaves the band, having been inside, from this share of the record on."""
        inside = self.is_inside(self.response.error[self.response.since(share)])
        return int(np.sum(inside[:-1] & ~inside[1:]))

    def refutes(self, settling_time: float) -> bool:
        """Whether the mean leaves the band after this instant, beyond the horizon [s]."""
        return settling_time <= self.response.horizon and self.leaves(self.response.times, self.response.error)

    def leaves(self, t: Array, error: Array) -> bool:
        """Whether errors, in steps, clearly leave the band beyond the horizon; a touch of its edge does not."""
        beyond = error[t > self.response.horizon]
        return not SettlingBand(0.0, (1 + MIN_EXIT) * self.band).contains(beyond).all()

    @property
    def stands(self) -> bool:
        """Whether the mean stands, wherever that is."""
        return self.response.stands(self.band)

    @property
    def final_error(self) -> float:
        """Distance from the reference at the end, in steps, with its sign."""
        late = self.response.error[self.response.since(1 - TAIL_SHARE)]
        return float(late.mean())

    @cached_property
    def cycle(self) -> LimitCycle | None:
        """An oscillation that does not decay in the second half of the record [measured unit]."""
        t, size = self.response.times, abs(self.response.reference.nominal_size)
        least = GROWTH_SHARE * self.band * size
        return find_limit_cycle(t, size * self.response.error, start=t[-1] / 2, min_amplitude=least)

    @property
    def growth(self) -> float:
        """Ratio of the mean's range in the last quarter of the record to that in the quarter before."""
        at, error = self.response.times, self.response.error
        before = error[(at >= 0.5 * at[-1]) & (at < 0.75 * at[-1])]
        return float(np.ptp(error[self.response.since(0.75)]) / max(np.ptp(before), 1e-300))

    @property
    def drifts(self) -> bool:
        """Whether the mean moves in one direction over the second half of the record."""
        late = self.response.error[self.response.since(0.5)]
        return bool(abs(late[-1] - late[0]) >= MIN_DRIFT_SHARE * np.ptp(late))

    def findings(self) -> Iterator[Finding]:
        """The defect with which the response ends, if any."""
        if self.description is not None:
            defect, words = self.description
            yield Finding(defect, self.case, f"at {self.case} the loop {words}")

    def correct(self, metrics: Mapping[str, float]) -> dict[str, float]:
        """The metrics of the horizon, less what the continuation refutes.

        SettlingTime is NaN where the mean leaves the band again; the overshoot is the continuation's if that is larger.
        """
        error = self.response.error
        largest = float(max(0.0, (error if self.response.reference.changes else np.abs(error)).max()))
        times = [n for n in ("SettlingTime", "SettlingTimeRaw") if n in metrics]
        refuted = dict.fromkeys(times, nan) if self.refutes(metrics["SettlingTime"]) else {}
        higher = {"Overshoot": 100 * largest, "OvershootDistance": largest * abs(self.response.reference.nominal_size)}
        if largest <= metrics["Overshoot"] / 100 + MIN_LATER_OVERSHOOT * self.band:
            higher = {}
        return {**metrics, **refuted, **higher}

    def notes(self, metrics: Mapping[str, float]) -> Iterator[str]:
        """Sentences on an ending that a user should know, and that name no defect."""
        response, band, begins = self.response, f"the band of {100 * self.band:.3g} %", f"at {self.case} the loop"
        if response.contact:
            yield f"at {self.case} the certificate ends {response.t[-1]:.3g} s after the step: {response.contact}"
        if self.refutes(metrics["SettlingTime"]):
            yield f"{begins} leaves {band} again after its horizon"
        if self.is_settled and not self.settling_time <= response.horizon:
            yield f"{begins} is in {band} for good only {self.settling_time:.3g} s after the step, beyond the horizon"
        cycle = self.cycle
        if cycle is not None and self.is_settled:
            yield f"{begins} keeps {cycle.describe(response.loop.feedback.unit)}, inside {band}"
        if self.stands and EDGE_SHARE * self.band < abs(self.final_error) <= self.band:
            yield f"{begins} rests {100 * abs(self.final_error):.3g} % off the reference, near the edge of {band}"
        ripple = describe_ripple(metrics, response.reference.nominal_size, self.band)
        if ripple is not None:
            yield f"at {self.case} {ripple}"


def describe_counts(loop: ClosedLoop, parameters: ParameterSet, reference: Reference, band: Band) -> str | None:
    """Sentence for a settling band narrower than half of what one count changes the reading by; None for others.

    A position inside half a count of the reference reads as the reference, inside the band or outside, so that nothing
    holds it in a narrower band. Of a speed only the instants are that coarse: over many samples the counts add up.
    """
    count, size, unit = loop.controller.sensor_resolution(parameters), abs(reference.nominal_size), loop.feedback.unit
    half = band_share(band, reference) * size
    if count / 2 <= half * (1 + EDGE_ROUNDING):
        return None
    narrow = f"the settling band of +-{write_value(half, unit, 3)} is narrower than half"
    measures = isinstance(band, Tolerance)
    least, most = (count / 2, size) if measures else (count / 2 / size, 1.0)
    digit = 10.0 ** (floor(log10(least)) - 2)
    enough = ceil(least / digit * (1 - EDGE_ROUNDING)) * digit  # rounded up to three digits
    shown = write_value(enough, unit, 3) if measures else f"{enough:.3g}"
    change, wider = write_value(count, unit, 3), f"take band = {shown} or more, " if enough < most else "take "
    if sees_speed(loop):
        remedy = "a finer encoder or a longer filter of the sensor"
        return f"{narrow} the {change} by which one count changes the reading; {wider}{remedy}"
    ripple = loop.dither_period(parameters) is not None
    tells = "tells inside from outside only by its dither's ripple" if ripple else "cannot tell inside from outside"
    remedy = "a larger step or a finer encoder"
    return f"{narrow} the encoder's count of {change}, the controller {tells}; {wider}{remedy}"


def sees_speed(loop: ClosedLoop) -> bool:
    """Whether the controller sees a speed that an encoder differentiates."""
    return isinstance(loop.sensor, Encoder) and loop.feedback.name != loop.sensor.position
