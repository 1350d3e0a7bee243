"""What a tuning, a simulation or a study of loops shows: gains, metrics, limits, the dither, cases."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from pneuopt.cli.terminal import format_number, new_table, show_sentence
from pneuopt.control.forms import Form, ParallelForm, SeriesForm, StandardForm, to_parallel, to_standard
from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.dither_verdict import DitherVerdict, Usefulness
from pneuopt.evaluation.evaluate import LIMIT_CYCLE_METRICS
from pneuopt.evaluation.expected_plants import PlantAxis
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import METRICS, larger_is_better, metric_name, percent_factor, user_limit
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value
from pneuopt.studies.outcome import INTERRUPTED_CASE
from pneuopt.tuning.validation import DesignValidation

if TYPE_CHECKING:
    import pandas as pd

MAX_REFERENCE_COLUMNS, MAX_COMPARED_COLUMNS = 3, 2
"""References beside each other, alone and with other figures: more do not fit 80 columns; their worst is shown."""
MIN_SHOWN_PERCENT = 1e-3
"""Least figure in percent that is shown as it is: below, digits of rounding errors hide the others."""
MIN_DERIVATIVE_RATIO = 0.01
"""Td/Tf below which a derivative adds less than 1 % to Kp at any frequency: its time would be a riddle."""
MAX_CASE_ROWS, MAX_FAILURE_REASONS = 40, 5
"""Rows and reasons that a study shows: more scroll the verdict away."""
MAX_GAIN_COLUMNS = 6
# Notes of a certificate on the screen: fewer hide kinds of notes; more repeat one of them for each case.
MAX_NOTES = 4
"""Gains that a front shows: more do not fit a terminal of 80 columns."""


def show_gains(console: Console, before: ParameterSet, after: ParameterSet) -> None:
    """Each free parameter before and after tuning, within its bounds."""
    table = new_table("parameter", "before", "tuned", "bounds", "")
    for n in after.free_names:
        p, unit = after[n], after[n].unit
        bounds = f"{format_number(p.lower, 4)} to {format_number(p.upper, 4)}"
        mark = "at its bound" if p.value in (p.lower, p.upper) else ""
        table.add_row(n, write_value(before.value(n), unit), write_value(p.value, unit), bounds, mark)
    console.print(table)
    show_sentence(console, _other_form(after))


def show_rejection(console: Console, tuning: Path, stats: Mapping[str, float], given: ParameterSet, word: str) -> None:
    """Say that the given gains remain when a tuning failed or was interrupted, and what it had found.

    Parameters
    ----------
    console : Console
    tuning : Path
        Where the given gains are from.
    stats : mapping of str to float
        Of a `TuningResult`, "rejected.pid.Kp" and so on among them.
    given : ParameterSet
    word : str
        What it is, "rejected" or "best so far".
    """
    found = {n.removeprefix("rejected."): v for n, v in stats.items() if n.startswith("rejected.")}
    tried = ", ".join(f"{n} {write_value(v, given[n].unit)}" for n, v in found.items() if not math.isnan(v))
    console.print(f"the gains of {tuning} stand; {word}: {tried or 'none was found'}", soft_wrap=True)


def show_metrics(
    console: Console,
    metrics: "pd.DataFrame",
    loop: ClosedLoop,
    *,
    title: str = "certified",
    beside: tuple[str, "pd.DataFrame | None"] = ("", None),
    limits: Sequence[Requirement] = (),
) -> None:
    """Certified metrics, a column a reference, or their worst where there are many.

    Parameters
    ----------
    console : Console
    metrics : DataFrame
        Of `evaluate`, or a `TuningResult`: a row a metric, a column a reference.
    loop : ClosedLoop
        Gives the units.
    title : str
        What the figures are.
    beside : (str, DataFrame or None)
        Figures of the same references that stand beside them, and their heading: "was", with the gains before.
    limits : sequence of Requirement
    """
    units, allowed = metric_units(loop), {metric_name(q): _format_limit(q) for q in limits}
    heading, other = beside
    several = len(metrics.columns) > (MAX_REFERENCE_COLUMNS if other is None else MAX_COMPARED_COLUMNS)
    names = [f"worst of {len(metrics.columns)}"] if several else [f"{c}\n{loop.feedback.unit}" for c in metrics]
    columns = [title for name in names for title in ((name,) if other is None else (name, heading))]
    table = new_table(title, *columns, *(["limit"] if allowed else []), "unit")
    for metric in (m for m in units if m in metrics.index and _is_relevant(m, metrics, loop)):
        now, then = (_metric_values(frame, metric, several) for frame in (metrics, other))
        cells = [_metric_cell(metric, v) for v in now]
        if other is not None:
            beside_cells = [_metric_cell(metric, v, 3) for v in then] or [""] * len(cells)
            cells = [cell for pair in zip(cells, beside_cells, strict=True) for cell in pair]
        table.add_row(metric, *cells, *([allowed.get(metric, "")] if allowed else []), units[metric])
    console.print(table)


def show_active(console: Console, table: "pd.DataFrame", active: Sequence[str], parameters: ParameterSet) -> None:
    """What keeps the objective from being smaller: limits with the room that is left, and bounds of the gains.

    Parameters
    ----------
    console : Console
    table : DataFrame
        Of a `TuningResult`, "requirements".
    active : sequence of str
        Likewise.
    parameters : ParameterSet
        The tuned ones.
    """
    limits = [f"{n} ({100 * row['room']:.2g} % of room left)" for n, row in table.iterrows() if row["active"]]
    at_bounds = [n for n in parameters.free_names if parameters.value(n) in (parameters[n].lower, parameters[n].upper)]
    bounds = [f"{n} (at its bound)" for n in dict.fromkeys((*at_bounds, *(a for a in active if a not in table.index)))]
    if limits or bounds:
        show_sentence(console, f"held back by: {', '.join((*limits, *bounds))}")


def show_notes(console: Console, notes: Sequence[str]) -> None:
    """What a certificate notes beside its figures, the first few in full."""
    for note in notes[:MAX_NOTES]:
        show_sentence(console, note)
    if len(notes) > MAX_NOTES:
        show_sentence(
            console, f"{len(notes) - MAX_NOTES} more notes of this kind on other cases; --json FILE holds all"
        )


def show_margins(console: Console, margins: "pd.DataFrame") -> None:
    """Where the loop's sensitivity is largest, operating point by operating point.

    Parameters
    ----------
    console : Console
    margins : DataFrame
        Of a `Certificate`.
    """
    if margins.empty:
        return
    worst = margins.groupby("point", sort=False)["MaxSensitivity"].max().to_dict()
    parts = ", ".join(f"{value:.4g} {point}" for point, value in worst.items())
    phase = margins["PhaseMargin"].min() if "PhaseMargin" in margins else math.nan
    also = "" if math.isnan(phase) else f"; phase margin at least {phase:.3g} deg"
    show_sentence(console, f"MaxSensitivity, the worst of all cases: {parts}{also}")


def show_relaxations(console: Console, table: "pd.DataFrame") -> None:
    """How far limits that contradict each other must be relaxed; nothing where there is no such table."""
    if table.empty:
        return
    grid = new_table("relaxed alone", "asked", "would do", "by")
    for row in table.reset_index(names="limit").to_dict(orient="records"):
        share = "-" if math.isnan(row["share"]) else f"{100 * row['share']:.3g} %"
        factor = percent_factor(row["limit"])
        unit = " %" if factor == 100 else ""
        asked, needed = (format_number(factor * row[n], 4) + unit for n in ("asked", "needed"))
        if row["limit"] == "all":
            grid.add_row("all together", "", "", share)
        else:
            grid.add_row(row["limit"], asked, "none found" if math.isnan(row["needed"]) else needed, share)
    console.print(grid)


def show_validation_verdict(console: Console, found: DesignValidation) -> None:
    """On how many plants a design holds, and what breaks on the others."""
    breaks = ", ".join(
        f"{word} breaks on {count}" if word in METRICS else f"it {word} on {count}"
        for word, count in found.breaks.items()
    )
    text = f"{found.verdict}: {breaks}" if breaks else found.verdict
    show_sentence(console, text, style="bold yellow" if found.broken else "bold green")


def show_validation(console: Console, found: DesignValidation, loop: ClosedLoop) -> None:
    """What the plants differ by, the figures on them, and what would help."""
    units = metric_units(loop)
    show_sentence(console, f"tried on {found.count} plants that no search has seen, each off by")
    for sentence in found.varied:
        show_sentence(console, sentence, indent=2)
    table = new_table("new plants", "median", "95 %", "worst", "limit", "broken by", "unit")
    for row in found.summary.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [_metric_cell(metric, row[n]) for n in ("median", "p95", "certified")]
        limit = "" if math.isnan(row["limit"]) else format_number(row["limit"], 4)
        table.add_row(metric, *figures, limit, str(row["violations"]), units[metric])
    console.print(table)
    for sentence in found.advice:
        show_sentence(console, sentence)
    if found.suggested:
        show_sentence(console, f"to do so, add to the tuning's file: {'; '.join(_scenario_lines(found.suggested))}")


def _scenario_lines(axes: Sequence[PlantAxis]) -> list[str]:
    """What to write under [scenarios] to tune over these: [scenarios.corners] "load.mass" = "5 %"."""
    kinds = {"corners": [a for a in axes if not a.is_gain], "tolerances": [a for a in axes if a.is_gain]}
    return [
        f"[scenarios.{kind}] " + ", ".join(f'"{n}" = "{100 * a.share:.2g} %"' for a in own for n in a.names)
        for kind, own in kinds.items()
        if own
    ]


def show_dither(console: Console, verdict: DitherVerdict) -> None:
    """Whether a dither is useful, and why, a sentence a line."""
    colours = {Usefulness.USEFUL: "bold green", Usefulness.HARMFUL: "bold red"}
    head, *reasons = str(verdict).splitlines()
    show_sentence(console, head, style=colours.get(verdict.usefulness, "bold yellow"))
    for reason in reasons:
        show_sentence(console, reason.strip(), indent=2)


def show_cases(console: Console, table: "pd.DataFrame", axes: Mapping[str, str], metrics: Mapping[str, str]) -> None:
    """A study, a row a case; of many the worst, by the first metric; then the reasons of those that failed.

    Parameters
    ----------
    console : Console
    table : DataFrame
        A column an axis and a metric, and "error".
    axes, metrics : mapping of str to str
        The columns, and their units.
    """
    first = next(iter(metrics))
    ordered = table.sort_values(first, ascending=larger_is_better(first), na_position="first", kind="stable")
    shown = table if len(table) <= MAX_CASE_ROWS else ordered.head(MAX_CASE_ROWS)
    grid = new_table(*(f"{n}\n[{unit}]" if unit not in ("", "1") else n for n, unit in {**axes, **metrics}.items()))
    for row in shown.to_dict(orient="records"):
        figures = [_metric_cell(m, row[m]) for m in metrics]
        if row["error"]:
            figures = ["failed" if row["error"] != INTERRUPTED_CASE else INTERRUPTED_CASE] + [""] * (len(metrics) - 1)
        grid.add_row(*(format_number(row[n], 6) for n in axes), *figures)
    console.print(grid)
    if len(shown) < len(table):
        console.print(f"the {len(shown)} worst of {len(table)} cases by {first}; -o FILE writes all")
    reasons = table["error"][~table["error"].isin(["", INTERRUPTED_CASE])].value_counts()
    for reason, count in list(reasons.items())[:MAX_FAILURE_REASONS]:
        console.print(f"failed ({count} of {len(table)}): {reason}", soft_wrap=True)


def show_front(
    console: Console, table: "pd.DataFrame", requirements: Mapping[str, str], gains: Mapping[str, str]
) -> None:
    """A front, a row a design, of those that are not certified the limit; then the reasons.

    Parameters
    ----------
    console : Console
    table : DataFrame
        A column a requirement and a gain, "limit" and "error".
    requirements, gains : mapping of str to str
        The two requirements, the limited one last, and the gains, with their units.
    """
    first, second = requirements
    shown = dict(list(gains.items())[:MAX_GAIN_COLUMNS])
    grid = new_table(*(_narrow_heading(n, unit) for n, unit in {**requirements, **shown}.items()))
    grid.padding = (0, 1, 0, 0)
    relation = ">=" if larger_is_better(second) else "<="
    for row in table.to_dict(orient="records"):
        figures = [format_number(row[n], 4) for n in (first, second)]
        if row["error"]:
            word = INTERRUPTED_CASE if row["error"] == INTERRUPTED_CASE else "failed"
            figures = [word, "-" if math.isnan(row["limit"]) else f"{relation} {format_number(row['limit'], 4)}"]
        grid.add_row(*figures, *(_format_gain(row[n]) for n in shown))
    console.print(grid)
    if len(shown) < len(gains):
        console.print(f"{len(shown)} of {len(gains)} gains; -o FILE writes all")
    for row in table[~table["error"].isin(["", INTERRUPTED_CASE])].to_dict(orient="records"):
        console.print(f"failed ({second} {relation} {format_number(row['limit'], 4)}): {row['error']}", soft_wrap=True)


def metric_units(loop: ClosedLoop) -> Mapping[str, str]:
    """The metrics that are shown, in that order, with their units."""
    units = (loop.command.unit, loop.feedback.unit)
    return {metric.name: metric.shown_unit(*units) for metric in METRICS.values() if metric.shown}


def _format_gain(value: float) -> str:
    """Four digits, as gains are rounded, and no exponent where it is the longer one: 68130."""
    return f"{float(format_number(value, 4)):.0f}" if 1e4 <= abs(value) < 1e7 else format_number(value, 4)


def _narrow_heading(column: str, unit: str) -> str:
    """A heading in narrow lines, "Peak / Control / [V]" or "pid. / Kp / [V*s/m]"."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=\.)", "\n", column)
    return words if unit in ("", "1") else f"{words}\n[{unit}]"


def _is_relevant(metric: str, metrics: "pd.DataFrame", loop: ClosedLoop) -> bool:
    """Ripple and the settling with it only under dither, a limit cycle only where there is one."""
    if metric in ("Ripple", "SettlingTimeRaw"):
        return loop.dither is not None
    return metric not in LIMIT_CYCLE_METRICS or bool((metrics.loc[LIMIT_CYCLE_METRICS[0]] > 0).any())


def _metric_values(frame: "pd.DataFrame | None", metric: str, several: bool) -> list[float]:
    if frame is None or metric not in frame.index:
        return []
    values: list[float] = frame.T[metric].tolist()
    worst = min if larger_is_better(metric) else max
    unknown = any(math.isnan(v) for v in values)
    return [math.nan if unknown else worst(values)] if several else values


def _other_form(parameters: ParameterSet) -> str:
    given = next(f for f in Form if all(f"pid.{n}" in parameters for n in f.gains))
    own = [parameters.value(f"pid.{n}") for n in given.gains]
    if given is not Form.PARALLEL:
        same = to_parallel(StandardForm(*own) if given is Form.STANDARD else SeriesForm(*own))
        derivative = f"Kd {same.Kd:.4g}, Tf {same.Tf:.4g} s" if same.Kd else "no derivative"
        return f"parallel form: Kp {same.Kp:.4g}, Ki {same.Ki:.4g}, {derivative}"
    gains = ParallelForm(*own)
    if gains.Kp == 0:
        return "no standard form: Kp is zero"
    form = to_standard(gains)
    integral = f", Ti {form.Ti:.4g} s" if gains.Ki else ", no integral"
    derivative = f", Td {form.Td:.4g} s, N {form.N:.4g} (ISA's ratio Td/Tf)" if gains.Kd else ", no derivative"
    if 0 < abs(form.N) < MIN_DERIVATIVE_RATIO:
        derivative = f", next to no derivative (Kd/Tf is {100 * abs(form.N):.2g} % of Kp)"
    return f"standard form: Kp {form.Kp:.4g}{integral}{derivative}"


def _format_limit(requirement: Requirement) -> str:
    limit, relation = user_limit(requirement), ">=" if requirement.metric.sense is Sense.AT_LEAST else "<="
    return "" if limit is None else f"{relation} {format_number(requirement.metric.factor * limit, 4)}"


def _metric_cell(metric: str, value: float, digits: int = 4) -> str:
    if metric in ("SettlingTime", "SettlingTimeRaw") and math.isnan(value):
        return "never"
    if percent_factor(metric) == 100 and 0 < abs(value) < MIN_SHOWN_PERCENT:
        return f"< {MIN_SHOWN_PERCENT:g}"
    return format_number(value, digits)
