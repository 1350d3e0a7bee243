"""The pages that `pneuopt study --report` writes: of cases, of a sensitivity, and of a Pareto front."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

from pneuopt.cli.shared import describe_status, file_hashes
from pneuopt.control.loop import ClosedLoop
from pneuopt.files.drive import read_fit
from pneuopt.files.study import Study
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report
from pneuopt.report.fit_page import Source
from pneuopt.report.page import Page
from pneuopt.report.study_page import study_page

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure

Design: TypeAlias = tuple[ClosedLoop, ParameterSet]
"""The loop of all cases, and its parameters."""
MAX_MAP_AXES = 2
"""Axes up to which a study has a map: of more no figure can be read."""


def case_page(
    study: Study,
    report: Report,
    draw: Callable[[], "Figure"],
    axes: Mapping[str, str],
    metrics: Mapping[str, str],
    design: Design,
) -> Page:
    """The page of a study's cases; a map of one or two axes, or how other cases are distributed."""
    alt = f"{', '.join(metrics)} over {' and '.join(axes)}, a cell or a point a case; what failed is marked."
    if study.cases:
        alt = f"Share of the cases that keep a bound, over the bound: {', '.join(metrics)}."
    drawn = draw if study.cases or len(axes) <= MAX_MAP_AXES else None
    shared = None if study.tune else design
    return study_page(_page_source(study), report, drawn, what="Cases", alt=alt, design=shared)


def front_page(study: Study, report: Report, draw: Callable[[], "Figure"], pair: Mapping[str, str]) -> Page:
    """The page of a Pareto front."""
    first, second = pair
    alt = f"{first} of certified designs over {second}; limits at which none was certified are marked."
    return study_page(_page_source(study), report, draw, what="Pareto front", alt=alt)


def sensitivity_page(study: Study, report: Report, draw: Callable[[], "Figure"], design: Design) -> Page:
    """The page of a study that asks which tolerances matter."""
    alt = "Share of a metric's variance that each parameter brings, by itself and with others, as bars with intervals."
    return study_page(_page_source(study), report, draw, what="Sensitivity", alt=alt, design=design)


def _page_source(study: Study) -> Source:
    """The title of a study's page, its hashes and warnings."""
    files = (study.path, study.drive, study.tuning)
    warnings = (*describe_status(read_fit(study.drive)), *describe_status(study.tuning))
    title = f"Study of {study.drive.name} with {study.tuning.name}"
    return Source(title, file_hashes(*files), warnings)
