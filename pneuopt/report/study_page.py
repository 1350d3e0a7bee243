"""The page of a study: a map over its cases, or a Pareto front."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report
from pneuopt.report.data import provenance_section
from pneuopt.report.fit_page import Source
from pneuopt.report.gains import report_settings
from pneuopt.report.page import Page, Picture, Section

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure


def study_page(
    source: Source,
    report: Report,
    draw: "Callable[[], Figure] | None",
    *,
    what: str,
    alt: str,
    design: tuple[ClosedLoop, ParameterSet] | None = None,
) -> Page:
    """The page of a study.

    Parameters
    ----------
    source : Source
    report : Report
        How many cases hold, in its first line; then the cases, or the designs of a front.
    draw : callable, optional
        Makes the map or the front; None where there are too many axes for one.
    what : str
        Heading: "Pareto front".
    alt : str
        What the figure shows, for those who see it and those who do not.
    design : (ClosedLoop, ParameterSet), optional
        The controller that all cases share, where they do.
    """
    verdict, table = Report(report.parts[:1]), Report(report.parts[1:])
    pictures = () if draw is None else (Picture(draw, alt, alt),)
    settings = () if design is None else (report_settings(design[0].controller, design[1].fixed("*")),)
    sections = Section(what, (*pictures, table)), Section("The design", settings)
    return Page(source.title, verdict, (*sections, provenance_section({}, source.hashes)), source.warnings)
