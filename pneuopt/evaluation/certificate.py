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
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan, nan
from typing import TYPE_CHECKING, Any

from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.evaluation.band import Band, band_share
from pneuopt.evaluation.cases import cases
from pneuopt.evaluation.continuation import continue_response
from pneuopt.evaluation.counts import describe_counts
from pneuopt.evaluation.defects import Defect as Defect  # noqa: PLC0414 - who reads a certificate finds it here
from pneuopt.evaluation.defects import Ending, Finding, correct_metrics, describe_ending, find_defects
from pneuopt.evaluation.evaluate import CaseEvaluation, evaluate_cases, relevant_units, report_metrics, tabulate_metrics
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.travel import check_travel
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.shown import Result

if TYPE_CHECKING:
    import pandas as pd

MAX_NOTES = 4
"""Notes of a certificate that are shown: fewer hide kinds of notes; more repeat one of them for each case."""


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
