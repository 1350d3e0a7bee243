"""What an evaluation shows: metrics beside their limits, margins, notes, findings, the verdict on a dither."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.evaluate import LIMIT_CYCLE_METRICS
from pneuopt.evaluation.metric import Requirement
from pneuopt.evaluation.requirements import METRICS, larger_is_better, metric_name, percent_factor, user_limit
from pneuopt.quantities.report import TIED, Line, Report, Table, Tone, format_number, number_columns, text_columns

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.evaluation.certificate import Certificate

MAX_REFERENCE_COLUMNS, MAX_COMPARED_COLUMNS = 3, 2
"""References beside each other, alone and with other figures: more do not fit 80 columns; their worst is shown."""
MIN_SHOWN_PERCENT = 1e-3
"""Least figure in percent that is shown as it is: below, digits of rounding errors hide the others."""
MAX_NOTES = 4
"""Notes of a certificate that are shown: fewer hide kinds of notes; more repeat one of them for each case."""
DITHER_METRICS = ("Ripple", "SettlingTimeRaw")
"""Metrics that say something of a loop with dither only."""
TIMES_OR_NEVER = ("SettlingTime", "SettlingTimeRaw")


def metric_units(loop: ClosedLoop) -> dict[str, str]:
    """The metrics that are shown, in that order, with their units."""
    units = (loop.command.unit, loop.feedback.unit)
    return {metric.name: metric.shown_unit(*units) for metric in METRICS.values() if metric.shown}


def relevant_units(loop: ClosedLoop) -> dict[str, str]:
    """As `metric_units`, less those of a dither or a position that the loop has not; the step's size has the key ""."""
    left_out = {n for n, metric in METRICS.items() if metric.positions and loop.sensed_signal.order != 0}
    left_out |= set() if loop.dither is not None else set(DITHER_METRICS)
    units = {n: unit for n, unit in metric_units(loop).items() if n not in left_out}
    return {"": loop.feedback.unit, **units}


def metric_limits(limits: Sequence[Requirement]) -> dict[str, float]:
    """Each limit by its metric, in the unit in which that is shown; those without a bound are left out."""
    bounds = {metric_name(q): (user_limit(q), q.metric.factor) for q in limits}
    return {n: factor * bound for n, (bound, factor) in bounds.items() if bound is not None}


def report_metrics(
    metrics: "pd.DataFrame",
    units: Mapping[str, str],
    *,
    title: str = "certified",
    beside: tuple[str, "pd.DataFrame | None"] = ("", None),
    limits: Mapping[str, float] | None = None,
) -> Report:
    """Metrics, a column a reference, or their worst where there are many.

    Parameters
    ----------
    metrics : DataFrame
        Of `evaluate`, or a `TuningResult`: a row a metric, a column a reference.
    units : mapping of str to str
        Of `relevant_units`.
    title : str
        What the figures are.
    beside : (str, DataFrame or None)
        Figures of the same references that stand beside them, and their heading: "was", with the gains before.
    limits : mapping of str to float, optional
        Of `metric_limits`.
    """
    (heading, other), allowed = beside, {n: _format_limit(n, limit) for n, limit in (limits or {}).items()}
    several = len(metrics.columns) > (MAX_REFERENCE_COLUMNS if other is None else MAX_COMPARED_COLUMNS)
    unit = units.get("", "")
    names = [f"worst of {len(metrics.columns)}"] if several else [f"{c}\n{unit}" if unit else str(c) for c in metrics]
    figures = [word for name in names for word in ((name,) if other is None else (name, heading))]
    rows = []
    for metric in (m for m in units if m in metrics.index and _is_relevant(m, metrics)):
        now, then = (_metric_values(frame, metric, several) for frame in (metrics, other))
        cells = [metric_cell(metric, v) for v in now]
        if other is not None:
            beside_cells = [metric_cell(metric, v, 3) for v in then] or [""] * len(cells)
            cells = [cell for pair in zip(cells, beside_cells, strict=True) for cell in pair]
        rows.append((metric, *cells, *([allowed.get(metric, "")] if allowed else []), units[metric]))
    limit = number_columns(*(["limit"] if allowed else []))
    columns = *text_columns(title), *number_columns(*figures), *limit, *text_columns("unit")
    return Report((Table(columns, tuple(rows)),) if rows else ())


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
    phase = margins["PhaseMargin"].min() if "PhaseMargin" in margins else math.nan
    also = "" if math.isnan(phase) else f"; phase margin at least {phase:.3g} deg"
    return Report((Line(f"MaxSensitivity, the worst of all cases: {parts}{also}"),))


def report_notes(notes: Sequence[str]) -> Report:
    """What a certificate notes beside its figures, the first few in full."""
    more = len(notes) - MAX_NOTES
    rest = f"{more} more notes of this kind on other cases; --json FILE holds all, and so does `Certificate.notes`"
    return Report((*map(Line, notes[:MAX_NOTES]), *([Line(rest)] if more > 0 else [])))


def report_certificate(found: "Certificate") -> Report:
    """The defects, or that there is none, metrics, margins and notes."""
    count = len(found.findings)
    word = f"{count} defect{'s' if count > 1 else ''}" if count else "no defect"
    cases = len(found.metrics.columns)
    lead = Line(f"{word} in {cases} case{'s' if cases != 1 else ''}", Tone.BAD if count else Tone.GOOD)
    defects = Report((lead, *(Line(finding.sentence, indent=2) for finding in found.findings)))
    return (
        defects + report_metrics(found.metrics, found.units) + report_margins(found.margins) + report_notes(found.notes)
    )


def report_verdict(text: str, tone: Tone) -> Report:
    """A verdict in its first line, and a reason in each further line."""
    head, *reasons = text.splitlines()
    return Report((Line(head, tone), *(Line(reason.strip(), indent=2) for reason in reasons)))


def metric_cell(metric: str, value: float, digits: int = 4) -> str:
    """A metric's figure in a table."""
    if metric in TIMES_OR_NEVER and math.isnan(value):
        return "never"
    if percent_factor(metric) == 100 and 0 < abs(value) < MIN_SHOWN_PERCENT:
        return f"<{TIED}{MIN_SHOWN_PERCENT:g}"
    return format_number(value, digits)


def _format_limit(metric: str, limit: float) -> str:
    return f"{'>=' if larger_is_better(metric) else '<='}{TIED}{format_number(limit, 4)}"


def _is_relevant(metric: str, metrics: "pd.DataFrame") -> bool:
    """A limit cycle only where there is one."""
    return metric not in LIMIT_CYCLE_METRICS or bool((metrics.loc[LIMIT_CYCLE_METRICS[0]] > 0).any())


def _metric_values(frame: "pd.DataFrame | None", metric: str, several: bool) -> list[float]:
    if frame is None or metric not in frame.index:
        return []
    values: list[float] = frame.T[metric].tolist()
    worst = min if larger_is_better(metric) else max
    unknown = any(math.isnan(v) for v in values)
    return [math.nan if unknown else worst(values)] if several else values
