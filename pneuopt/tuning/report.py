"""What a tuning shows: verdict, gains, certified metrics, what holds the design back, other plants, relaxations."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pneuopt.control.pid import Form, ParallelForm, SeriesForm, StandardForm, to_parallel, to_standard
from pneuopt.evaluation.expected_plants import PlantAxis
from pneuopt.evaluation.report import metric_cell, report_margins, report_metrics, report_notes
from pneuopt.evaluation.requirements import METRICS, percent_factor
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.status import Code, Status, report_status
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.tuning.result import TuningResult
    from pneuopt.tuning.validation import DesignValidation

MIN_DERIVATIVE_RATIO = 0.01
"""Td/Tf below which a derivative adds less than 1 % to Kp at any frequency: its time would be a riddle."""


def report_tuning(
    result: "TuningResult", *, was: "pd.DataFrame | None" = None, source: str = "the given gains"
) -> Report:
    """How a tuning ended, and its design; of one that failed what was refused, and how far limits have to give way.

    Parameters
    ----------
    result : TuningResult
    was : DataFrame, optional
        Metrics with the gains before, to stand beside the certified ones.
    source : str
        What stands where the tuning failed; empty where nothing was sought.
    """
    head = report_status(result.status) if source else report_certificate_status(result.status)
    return head + (_report_design(result, was) if result.status.converged else report_refusal(result, source))


def report_certificate_status(status: Status) -> Report:
    """Whether gains are certified that nobody has sought, then why not, a line each."""
    good = status.converged
    lead = f"{'certified' if good else 'NOT CERTIFIED'}: {status.verdict}"
    details = (Line(text, indent=2) for text in status.sentences[1:])
    return Report((Line(lead, Tone.GOOD if good else Tone.BAD), *details))


def report_gains(given: Mapping[str, float], tuned: ParameterSet) -> Report:
    """Each free parameter before and after tuning, within its bounds, and the gains in another form.

    Parameters
    ----------
    given : mapping of str to float
        Values before; empty where they are unknown.
    tuned : ParameterSet
    """
    rows = []
    for n in tuned.free_names:
        p, before = tuned[n], [write_value(given[n], tuned[n].unit)] if n in given else [""] * bool(given)
        bounds = f"{format_number(p.lower, 4)} to {format_number(p.upper, 4)}"
        mark = "at its bound" if p.value in (p.lower, p.upper) else ""
        rows.append((n, *before, write_value(p.value, p.unit), bounds, mark))
    figures = number_columns(*(["before", "tuned"] if given else ["value"]), "bounds")
    table = Table((*text_columns("parameter"), *figures, *text_columns("")), tuple(rows))
    form = _other_form(tuned)
    return Report((*([table] if rows else []), *([Line(form)] if form else [])))


def report_active(requirements: "pd.DataFrame", active: Sequence[str], parameters: ParameterSet) -> Report:
    """What keeps the objective from being smaller: limits with the room that is left, and bounds of the gains.

    Parameters
    ----------
    requirements : DataFrame
    active : sequence of str
        As of a `TuningResult`.
    parameters : ParameterSet
        The tuned ones.
    """
    limits = [f"{n} ({100 * row['room']:.2g} % of room left)" for n, row in requirements.iterrows() if row["active"]]
    at_bounds = [n for n in parameters.free_names if parameters.value(n) in (parameters[n].lower, parameters[n].upper)]
    others = (*at_bounds, *(a for a in active if a not in requirements.index))
    bounds = [f"{n} (at its bound)" for n in dict.fromkeys(others)]
    return Report((Line(f"held back by: {', '.join((*limits, *bounds))}"),) if limits or bounds else ())


def report_relaxations(table: "pd.DataFrame") -> Report:
    """How far limits that no design found keeps must be relaxed; nothing where there is no such table."""
    if table.empty:
        return Report()
    rows = []
    for row in table.reset_index(names="limit").to_dict(orient="records"):
        share = "-" if math.isnan(row["share"]) else f"{100 * row['share']:.3g} %"
        factor = percent_factor(row["limit"])
        unit = " %" if factor == 100 else ""
        asked, needed = (format_number(factor * row[n], 4) + unit for n in ("asked", "needed"))
        would_do = "none found" if math.isnan(row["needed"]) else needed
        rows.append(
            ("all together", "", "", share) if row["limit"] == "all" else (row["limit"], asked, would_do, share)
        )
    columns = *text_columns("relaxed alone"), *number_columns("asked", "would do", "by")
    return Report((Table(columns, tuple(rows)),))


def report_validation_verdict(found: "DesignValidation") -> Report:
    """On how many plants a design holds, and what breaks on the others."""
    breaks = ", ".join(
        f"{word} breaks on {count}" if word in METRICS else f"it {word} on {count}"
        for word, count in found.breaks.items()
    )
    text = f"{found.verdict}: {breaks}" if breaks else found.verdict
    return Report((Line(text, Tone.DOUBTFUL if found.broken else Tone.GOOD),))


def report_validation(found: "DesignValidation") -> Report:
    """What the plants differ by, the figures on them, and what would help."""
    rows = []
    for row in found.figures.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [metric_cell(metric, row[n]) for n in ("median", "p95", "certified")]
        limit = "" if math.isnan(row["limit"]) else format_number(row["limit"], 4)
        rows.append((metric, *figures, limit, str(row["violations"]), found.units.get(metric, "")))
    figures_heads = number_columns("median", "95 %", "worst", "limit", "broken by")
    table = Table((*text_columns("new plants"), *figures_heads, *text_columns("unit")), tuple(rows))
    lead = Line(f"tried on {found.count} plants that no search has seen, each off by")
    suggestion = f"to do so, add to the tuning's file: {'; '.join(_scenario_lines(found.suggested))}"
    advice = (*found.advice, *([suggestion] if found.suggested else []))
    return Report((lead, *(Line(text, indent=2) for text in found.varied), table, *map(Line, advice)))


def _report_design(result: "TuningResult", was: "pd.DataFrame | None") -> Report:
    tried, certificate = result.validation, result.certificate
    beside = ("was", was) if result.on_rig is None else ("on rig", result.on_rig)
    found = report_validation_verdict(tried) if tried else Report()
    found += report_gains(result.given, result.parameters)
    found += report_metrics(result.certified, result.units, beside=beside, limits=result.limits)
    found += report_active(result.requirements, result.active, result.parameters)
    if certificate is not None:
        found += report_margins(certificate.margins) + report_notes(certificate.notes)
    return found + report_validation(tried) if tried else found


def report_refusal(result: "TuningResult", source: str) -> Report:
    """The gains that stand, and what was refused, or is the best so far, with its figures.

    Parameters
    ----------
    result : TuningResult
    source : str
        What stands; empty where nothing was sought.
    """
    word = "best so far" if result.status.code is Code.INTERRUPTED else "rejected" if source else "simulated"
    tried = ", ".join(f"{n} {write_value(v, result.parameters[n].unit)}" for n, v in result.best.items())
    lead = Report((Line(f"{source} stand; {word}: {tried or 'none was found'}"),)) if source else Report()
    beside = "on rig", result.on_rig
    figures = report_metrics(result.certified, result.units, title=word, beside=beside, limits=result.limits)
    return lead + figures + report_relaxations(result.relaxations)


def _scenario_lines(axes: Sequence[PlantAxis]) -> list[str]:
    """What to write under [scenarios] to tune over these: [scenarios.corners] "load.mass" = "5 %"."""
    kinds = {"corners": [a for a in axes if not a.is_gain], "tolerances": [a for a in axes if a.is_gain]}
    return [
        f"[scenarios.{kind}] " + ", ".join(f'"{n}" = "{100 * a.share:.2g} %"' for a in own for n in a.names)
        for kind, own in kinds.items()
        if own
    ]


def _other_form(parameters: ParameterSet) -> str:
    """The gains in another form in a sentence; empty where there are none."""
    given = next((f for f in Form if all(f"pid.{n}" in parameters for n in f.gains)), None)
    if given is None:
        return ""
    own = [parameters.value(f"pid.{n}") for n in given.gains]
    if given is not Form.PARALLEL:
        same = to_parallel(StandardForm(*own) if given is Form.STANDARD else SeriesForm(*own))
        derivative = f"Kd {same.Kd:.4g}, Tf {same.Tf:.4g} s" if same.Kd else "no derivative"
        return f"parallel form: Kp {same.Kp:.4g}, Ki {same.Ki:.4g}, {derivative}"
    gains = ParallelForm(*own)
    return f"standard form: {_standard_form(gains)}" if gains.Kp else "no standard form: Kp is zero"


def _standard_form(gains: ParallelForm) -> str:
    form = to_standard(gains)
    integral = f", Ti {form.Ti:.4g} s" if gains.Ki else ", no integral"
    derivative = f", Td {form.Td:.4g} s, N {form.N:.4g} (ISA's ratio Td/Tf)" if gains.Kd else ", no derivative"
    if 0 < abs(form.N) < MIN_DERIVATIVE_RATIO:
        derivative = f", next to no derivative (Kd/Tf is {100 * abs(form.N):.2g} % of Kp)"
    return f"Kp {form.Kp:.4g}{integral}{derivative}"
