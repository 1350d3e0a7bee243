"""`summary_page`: the page of a result that has none of its own, its summary and what may be drawn of it."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from pneuopt.identification.tracking import Tracking
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting import plot_tracking
from pneuopt.quantities.report import Line, Report
from pneuopt.report.data import data_section, provenance_section
from pneuopt.report.fit_page import Source
from pneuopt.report.page import Page, Picture, Section


def summary_page(
    source: Source,
    found: Report,
    pictures: Sequence[Picture] = (),
    experiments: Sequence[Experiment] = (),
    provenance: Mapping[str, str] | None = None,
) -> Page:
    """The page of a summary, whose first line is the verdict.

    Parameters
    ----------
    source : Source
    found : Report
    pictures : sequence of Picture
    experiments : sequence of Experiment
        Logs of which the page lists what was read, and their hashes.
    provenance : mapping of str to str, optional
        The result's own.
    """
    first, *others = found.parts or (Line(""),)
    is_line = isinstance(first, Line)
    details = Report(tuple(others) if is_line else (first, *others))
    sections = (
        Section("Figures", tuple(pictures)),
        Section("Result", (details,)),
        *((data_section(experiments),) if experiments else ()),
        provenance_section(dict(provenance or {}), {**source.hashes, **_hashes(experiments)}),
    )
    return Page(source.title, Report((first,) if is_line else ()), sections, source.warnings)


def _hashes(experiments: Sequence[Experiment]) -> dict[str, str]:
    return {f"sha256[{e.name}]": e.sha256 for e in experiments if e.sha256}


def tracking_picture(found: Tracking) -> Picture:
    """Of a drive's parameters over dated logs."""
    alt = "Estimates with their intervals over dates, the line through them and its band."
    return Picture(partial(plot_tracking, found), alt, "Estimates over time.")


def title_of(what: str, file: Path, logs: Sequence[Path]) -> str:
    """What a page is of: "Check of drive.toml with run_01.csv"; of many logs their number."""
    names = ", ".join(log.name for log in logs) if len(logs) <= MOST_NAMES else f"{len(logs)} logs"
    return f"{what} of {file.name}" + (f" with {names}" if logs else "")


MOST_NAMES = 3
"""Logs that a title names: more make it longer than a line."""
