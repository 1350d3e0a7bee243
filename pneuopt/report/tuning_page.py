"""`write_report`, and the pages of loops: tuned, simulated, studied; and of results that have no page of their own."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.evaluation.certificate import Certificate, report_notes
from pneuopt.evaluation.evaluate import metric_cell, report_metrics
from pneuopt.evaluation.metric import Band
from pneuopt.evaluation.requirements import larger_is_better
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import Tracking
from pneuopt.logs.experiment import Experiment
from pneuopt.plotting import plot_sensitivity, plot_tracking
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet, as_tuple
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import report_status
from pneuopt.report.fit_page import PageHead, fit_page
from pneuopt.report.live import live_script
from pneuopt.report.page import (
    Page,
    Picture,
    Section,
    data_section,
    diagram_picture,
    log_hashes,
    loop_figures,
    loop_pictures,
    provenance_section,
    report_forms,
    report_settings,
    write_page,
)
from pneuopt.studies.sensitivity import Sensitivity
from pneuopt.tuning.result import TuningResult, report_active, report_certificate_status, report_gains, report_refusal
from pneuopt.tuning.validation import report_validation, report_validation_verdict

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.plotting.canvas import Figure


LOGS = "an Experiment or several, as read_log(path) gives them"


_TITLES: dict[type, str] = {IdentificationResult: "Identification", TuningResult: "Tuning", Certificate: "Certificate"}


def write_report(
    result: Shown,
    path: str | Path,
    *,
    title: str = "",
    model: HasSystem | ClosedLoop | None = None,
    experiments: Experiment | Sequence[Experiment] = (),
    held_out: Experiment | Sequence[Experiment] = (),
    references: Reference | Sequence[Reference] = (),
    parameters: ParameterSet | None = None,
    band: Band = 0.02,
) -> None:
    """Write a result as one page of HTML that needs no network: verdict first, figures where they belong, hashes.

    The same result gives the same page, to the letter. A result that did not converge gets its page, too, which says
    so first. Results hold no models and no logs: what is to be drawn of these is given here. The page of a loop ends
    with sliders, which a script within it follows by simulating the loop; without scripts only they are missing.

    Parameters
    ----------
    result : Shown
        Whatever `identify`, `tune`, `certificate`, `bootstrap`, `track` or another verb returns.
    path : str or Path
    title : str
        By default the kind of the result.
    model : drive, System or ClosedLoop, optional
        Of a fit: draws its friction, and predicts held-out logs. Of a tuning or a certificate the loop: draws steps,
        the Bode plot and the diagram, and gives the gains in every form.
    experiments : Experiment or sequence of Experiment
        Of a fit: the logs that it was made from, in their order.
    held_out : Experiment or sequence of Experiment
        Logs that the fit has not seen.
    references : Reference or sequence of Reference
        Those of the loop.
    parameters : ParameterSet, optional
        Of a certificate: every parameter of its loop. Of a tuning: those before, to be drawn beside.
    band : float
        Half width of the settling band, a fraction of the step.

    Raises
    ------
    InputError
        If the result is no such object, a figure lacks what it is drawn from, or the file cannot be written; no file is
        left then.

    Examples
    --------
    >>> import tempfile
    >>> from pneuopt.quantities.report import Line, Report
    >>> class Found(Shown):
    ...     def summary(self):
    ...         return Report((Line("nothing is wrong"),))
    >>> place = Path(tempfile.mkdtemp()) / "found.html"
    >>> write_report(Found(), place)
    >>> "nothing is wrong" in place.read_text("utf-8")
    True
    """
    require(isinstance(result, Shown), f"a report is written of a result, got {type(result).__name__}")
    steps = as_references(references)
    logs, others = (
        as_tuple(n, given, Experiment, LOGS) for n, given in (("experiments", experiments), ("held_out", held_out))
    )
    require(not others or model is not None, "held-out logs are predicted with the model: give both")
    head = PageHead(title or _TITLES.get(type(result), type(result).__name__))
    if isinstance(result, IdentificationResult):
        page = fit_page(head, result, logs, model, held_out=others)
    elif isinstance(result, TuningResult):
        page = tuning_page(head, result, _view(model, steps, result.parameters, parameters, band))
    elif isinstance(result, Certificate):
        require(model is None or parameters is not None, "a certificate holds no gains: give parameters with the loop")
        page = simulation_page(head, result, _view(model, steps, parameters, None, band))
    else:
        pictures = (tracking_picture(result),) if isinstance(result, Tracking) else ()
        if isinstance(result, Sensitivity):
            alt = "For each figure the share of its variance that each parameter brings, with its 95 % interval."
            pictures = (Picture(partial(plot_sensitivity, result), alt, "Shares of the variance."),)
        page = summary_page(head, result.summary(), pictures, (), getattr(result, "provenance", {}))
    write_page(path, page)


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
    """What figures, forms and the diagram of a loop are made from."""

    loop: ClosedLoop
    references: Sequence[Reference]
    parameters: ParameterSet  # every parameter of the loop
    before: ParameterSet | None = None  # with the gains before tuning
    band: Band = 0.02  # half width of the settling band, a fraction of the step

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


def _view(
    model: object, steps: Sequence[Reference], parameters: ParameterSet | None, before: ParameterSet | None, band: Band
) -> LoopView | None:
    """What a loop's figures are drawn from; None without a loop."""
    if model is None or parameters is None:
        return None
    require(isinstance(model, ClosedLoop), f"the model of this result is a ClosedLoop, got {type(model).__name__}")
    assert isinstance(model, ClosedLoop)
    require(bool(steps), "a loop is drawn with its references: give both")
    earlier = None if before is None else model.complete(before)
    return LoopView(model, steps, model.complete(parameters), earlier, band)


def tuning_page(
    head: PageHead,
    result: TuningResult,
    view: LoopView | None = None,
    *,
    stands: str = "the given gains",
    was: "pd.DataFrame | None" = None,
    dither: Report | None = None,
    exports: Report | None = None,
) -> Page:
    """The page of a tuning: of a design, or of the gains that stand; of certified given ones `stands` is empty."""
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
        provenance_section(result.provenance, head.hashes),
    )
    defects = tuple(f.sentence for f in certificate.findings) if certificate is not None else ()
    script = None if view is None else partial(view.script, result.limits, result.certified if found else None)
    return Page(head.title, verdict, sections, (*defects, *head.warnings), script)


def simulation_page(
    head: PageHead,
    found: Certificate,
    view: LoopView | None = None,
    limits: Mapping[str, float] | None = None,
    *,
    standing: Report | None = None,
) -> Page:
    """The page of a loop with the gains it has."""
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
        provenance_section({}, head.hashes),
    )
    script = None if view is None else partial(view.script, limits or {}, found.metrics)
    return Page(head.title, verdict, sections, head.warnings, script)


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


def study_page(
    head: PageHead,
    report: Report,
    draw: "Callable[[], Figure] | None",
    *,
    what: str,
    alt: str,
    design: tuple[ClosedLoop, ParameterSet] | None = None,
) -> Page:
    """The page of a study: its verdict, a map or a front, its tables, and the design that all cases share."""
    verdict, table = Report(report.parts[:1]), Report(report.parts[1:])
    pictures = () if draw is None else (Picture(draw, alt, alt),)
    settings = () if design is None else (report_settings(design[0].controller, design[1].fixed("*")),)
    sections = Section(what, (*pictures, table)), Section("The design", settings)
    return Page(head.title, verdict, (*sections, provenance_section({}, head.hashes)), head.warnings)


def summary_page(
    head: PageHead,
    found: Report,
    pictures: Sequence[Picture] = (),
    experiments: Sequence[Experiment] = (),
    provenance: Mapping[str, str] | None = None,
) -> Page:
    """The page of a summary, whose first line is the verdict."""
    first, *others = found.parts or (Line(""),)
    is_line = isinstance(first, Line)
    details = Report(tuple(others) if is_line else (first, *others))
    sections = (
        Section("Figures", tuple(pictures)),
        Section("Result", (details,)),
        *((data_section(experiments),) if experiments else ()),
        provenance_section(dict(provenance or {}), {**head.hashes, **log_hashes(experiments)}),
    )
    return Page(head.title, Report((first,) if is_line else ()), sections, head.warnings)


def tracking_picture(found: Tracking) -> Picture:
    """Of a drive's parameters over dated logs."""
    alt = "Estimates with their intervals over dates, the line through them and its band."
    return Picture(partial(plot_tracking, found), alt, "Estimates over time.")


def title_of(what: str, file: Path, logs: Sequence[Path], most: int = 3) -> str:
    """What a page is of: "Check of drive.toml with run_01.csv"; of many logs their number."""
    names = ", ".join(log.name for log in logs) if len(logs) <= most else f"{len(logs)} logs"
    return f"{what} of {file.name}" + (f" with {names}" if logs else "")
