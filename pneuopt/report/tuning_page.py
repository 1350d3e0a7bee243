"""The pages of a tuned loop, and of one that is simulated with the gains it has."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.certificate import Certificate, report_notes
from pneuopt.evaluation.evaluate import metric_cell, report_metrics
from pneuopt.evaluation.requirements import larger_is_better
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.status import report_status
from pneuopt.report.data import provenance_section
from pneuopt.report.fit_page import Source
from pneuopt.report.gains import report_forms, report_settings
from pneuopt.report.live import live_script
from pneuopt.report.loop_figures import diagram_picture, loop_figures, loop_pictures
from pneuopt.report.page import Page, Picture, Section
from pneuopt.tuning.result import TuningResult, report_active, report_certificate_status, report_gains, report_refusal
from pneuopt.tuning.validation import report_validation, report_validation_verdict

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.plotting.canvas import Figure

MARGINS = {
    "MaxSensitivity": "Ms",
    "MaxComplementarySensitivity": "Mt",
    "PhaseMargin": "phase margin\n[deg]",
    "GainMargin": "gain margin\n[1]",
}
"""What a page shows of an operating point's linear loop, and how it is called there."""
DOUBTS = (Tone.DOUBTFUL, Tone.BAD)
"""Tones of a verdict on a dither that belongs beside the verdict on the design."""


@dataclass(frozen=True, eq=False)
class LoopView:
    """What figures, forms and the diagram of a loop are made from.

    Attributes
    ----------
    loop : ClosedLoop
    references : sequence of Reference
    parameters : ParameterSet
        Every parameter of the loop.
    before : ParameterSet, optional
        With the gains before tuning.
    band : float
        Half width of the settling band, a fraction of the step.
    """

    loop: ClosedLoop
    references: Sequence[Reference]
    parameters: ParameterSet
    before: ParameterSet | None = None
    band: Band = 0.02

    def figures(self) -> dict[str, "Figure"]:
        """The steps and the Bode plot, see `loop_figures`."""
        return loop_figures(self.loop, self.references, self.parameters, self.before, band=self.band)

    def pictures(self) -> tuple[Picture, Picture]:
        """The steps and the Bode plot for a page."""
        return loop_pictures(self.figures, compared=self.before is not None)

    def script(self, limits: Mapping[str, float], certified: "pd.DataFrame | None") -> str:
        """What moves the page's last part, see `live_script`."""
        return live_script(
            self.loop, self.references, self.parameters, band=self.band, limits=limits, certified=certified
        )


def tuning_page(
    source: Source,
    result: TuningResult,
    view: LoopView | None = None,
    *,
    stands: str = "the given gains",
    was: "pd.DataFrame | None" = None,
    dither: Report | None = None,
    exports: Report | None = None,
) -> Page:
    """The page of a tuning, of a design that was found or of gains that stand.

    Parameters
    ----------
    source : Source
    result : TuningResult
    view : LoopView, optional
        For figures, forms and diagram.
    stands : str
        What stands where the tuning failed; empty where the given gains were certified or refused.
    was : DataFrame, optional
        Metrics with the gains before.
    dither : Report, optional
        The verdict on the dither.
    exports : Report, optional
        How the design gets to a controller, of `report_exports`.
    """
    found, certificate, tried = result.status.converged, result.certificate, result.validation
    verdict = report_status(result.status) if stands else report_certificate_status(result.status)
    if found and tried is not None:
        verdict += report_validation_verdict(tried)
    if dither:
        verdict += Report(tuple(p for p in dither.parts[:1] if isinstance(p, Line) and p.tone in DOUBTS))
    steps, bode = view.pictures() if view is not None else (None, None)
    outcome = _design_sections(result, was, steps) if found else _refusal_sections(result, stands, steps)
    sections = (
        *outcome,
        _form_section(view),
        Section("To the controller", (exports,) if exports else ()),
        _margin_section(certificate, bode),
        Section("Other plants", (report_validation(tried),) if tried is not None and found else ()),
        Section("Dither", (dither,) if dither else ()),
        _loop_section(view),
        provenance_section(result.provenance, source.hashes),
    )
    defects = tuple(f.sentence for f in certificate.findings) if certificate is not None else ()
    script = None if view is None else partial(view.script, result.limits, result.certified if found else None)
    return Page(source.title, verdict, sections, (*defects, *source.warnings), script)


def simulation_page(
    source: Source,
    found: Certificate,
    view: LoopView | None = None,
    limits: Mapping[str, float] | None = None,
    *,
    standing: Report | None = None,
) -> Page:
    """The page of a loop with the gains it has.

    Parameters
    ----------
    source : Source
    found : Certificate
    view : LoopView, optional
        For figures, forms and diagram.
    limits : mapping of str to float, optional
        Of `metric_limits`.
    standing : Report, optional
        Whether the certificate that the gains were written with holds.
    """
    count, cases = len(found.findings), len(found.metrics.columns)
    word = f"{count} defect{'s' if count > 1 else ''}" if count else "no defect"
    lead = Line(f"simulated: {word} in {cases} case{'s' if cases > 1 else ''}", Tone.BAD if count else Tone.GOOD)
    broken = tuple(Line(text, Tone.BAD, 2) for text in _broken_limits(found.metrics, limits or {}))
    verdict = (standing or Report()) + Report((lead, *(Line(f.sentence, indent=2) for f in found.findings), *broken))
    steps, bode = view.pictures() if view is not None else (None, None)
    figures = report_metrics(found.metrics, found.units, title="simulated", limits=limits)
    sections = (
        Section("Metrics", (figures, report_notes(found.notes), *_some(steps))),
        _form_section(view),
        _margin_section(found, bode),
        _loop_section(view),
        provenance_section({}, source.hashes),
    )
    script = None if view is None else partial(view.script, limits or {}, found.metrics)
    return Page(source.title, verdict, sections, source.warnings, script)


def _design_sections(
    result: TuningResult, was: "pd.DataFrame | None", steps: Picture | None
) -> tuple[Section, Section]:
    """Gains before and after; certified metrics beside those before, and what holds them back."""
    beside = ("was", was) if result.on_rig is None else ("on rig", result.on_rig)
    metrics = report_metrics(result.certified, result.units, beside=beside, limits=result.limits)
    held = report_active(result.requirements, result.active, result.parameters)
    notes = report_notes(result.certificate.notes) if result.certificate is not None else Report()
    gains = Section("Gains", (report_gains(result.given, result.parameters),))
    return gains, Section("Before and after", (metrics, held, notes, *_some(steps)))


def _refusal_sections(result: TuningResult, stands: str, steps: Picture | None) -> tuple[Section, ...]:
    """What was tried and refused; below it the response with the gains that stand."""
    return (
        Section("What was tried" if stands else "Figures", (report_refusal(result, stands),)),
        Section("The gains that stand" if stands else "The response", _some(steps)),
    )


def _form_section(view: LoopView | None) -> Section:
    parts = () if view is None else (report_forms(view.loop.controller, view.parameters),)
    return Section("Gains in every form", parts)


def _margin_section(found: Certificate | None, bode: Picture | None) -> Section:
    """The worst case of each operating point, and the Bode plot."""
    if found is None or found.margins.empty:
        return Section("Margins", _some(bode))
    rows = []
    for point, own in found.margins.groupby("point", sort=False):
        worst = own.fillna({"MaxSensitivity": math.inf}).sort_values("MaxSensitivity").iloc[-1]
        figures = (format_number(float(worst.get(n, math.nan)), 4) for n in MARGINS)
        rows.append((str(point), str(worst["case"]), *figures, "" if worst["stable"] else "unstable"))
    columns = *text_columns("operating point", "worst case"), *number_columns(*MARGINS.values()), *text_columns("")
    return Section("Margins", (Report((Table(columns, tuple(rows)),)), *_some(bode)))


def _loop_section(view: LoopView | None) -> Section:
    if view is None:
        return Section("The loop", ())
    return Section("The loop", (diagram_picture(view.loop), report_settings(view.loop.controller, view.parameters)))


def _broken_limits(metrics: "pd.DataFrame", limits: Mapping[str, float]) -> Iterator[str]:
    """A sentence a limit that the worst case breaks."""
    for name, limit in limits.items():
        if name not in metrics.index:
            continue
        least = larger_is_better(name)
        nothing = -math.inf if least else math.inf  # a case without a figure keeps no limit
        row = metrics.T[name].astype(float).to_dict()
        values = {str(case): nothing if math.isnan(v) else v for case, v in row.items()}
        case = (min if least else max)(values, key=lambda c: values[c])
        if values[case] < limit if least else values[case] > limit:
            shown = metric_cell(name, row[case])
            yield f"{name} {shown} breaks its limit of {limit:.4g} at {case}"


def _some(picture: Picture | None) -> tuple[Picture, ...]:
    return () if picture is None else (picture,)
