"""What a tuning, a simulation or a study of loops shows: gains, metrics, limits, the dither, cases."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from pneuopt.cli.terminal import format_number, new_table
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

MAX_REFERENCE_COLUMNS = 3
"""References beside each other: more do not fit a terminal of 80 columns, so that the worst of all is shown."""
MAX_CASE_ROWS, MAX_FAILURE_REASONS = 40, 5
"""Rows and reasons that a study shows: more scroll the verdict away."""
MAX_GAIN_COLUMNS = 6
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
    console.print(_other_form(after), soft_wrap=True)


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
    before: "pd.DataFrame | None" = None,
    limits: Sequence[Requirement] = (),
) -> None:
    """Certified metrics, a column a reference.

    Parameters
    ----------
    console : Console
    metrics : DataFrame
        Of `evaluate`, or a `TuningResult`: a row a metric, a column a reference.
    loop : ClosedLoop
        Gives the units.
    title : str
        What the figures are.
    before : DataFrame, optional
        The same with the gains before.
    limits : sequence of Requirement
    """
    units, allowed = metric_units(loop), {metric_name(q): _format_limit(q) for q in limits}
    several = len(metrics.columns) > MAX_REFERENCE_COLUMNS
    columns = [f"worst of {len(metrics.columns)}"] if several else [f"{c} {loop.feedback.unit}" for c in metrics]
    table = new_table(title, *columns, *(["limit"] if allowed else []), "unit")
    for metric in (m for m in units if m in metrics.index and _is_relevant(m, metrics, loop)):
        now, was = (_metric_values(frame, metric, several) for frame in (metrics, before))
        cells = [
            _metric_cell(metric, v) + (f" (was {_metric_cell(metric, was[k])})" if was else "")
            for k, v in enumerate(now)
        ]
        limit = [allowed.get(metric, "")] if allowed else []
        table.add_row(metric, *cells, *limit, units[metric])
    console.print(table)


def show_requirements(console: Console, table: "pd.DataFrame", active: Sequence[str], loop: ClosedLoop) -> None:
    """The room to each limit, and which limits and bounds are active.

    Parameters
    ----------
    console : Console
    table : DataFrame
        Of a `TuningResult`, "requirements".
    active : sequence of str
        Likewise.
    loop : ClosedLoop
        Gives the units.
    """
    units, grid = metric_units(loop), new_table("requirement", "claimed", "certified", "limit", "room", "", "unit")
    for row in table.reset_index(names="requirement").to_dict(orient="records"):
        metric = str(row["requirement"])
        values = [percent_factor(metric) * row[n] for n in ("claimed", "certified", "allowed")]
        figures = [_metric_cell(metric, v) for v in values[:2]] + [format_number(values[2], 4)]
        room = "-" if math.isnan(row["room"]) else f"{100 * row['room']:.3g} %"
        grid.add_row(metric, *figures, room, "active" if row["active"] else "", units[metric])
    console.print(grid)
    others = [n for n in active if n not in table.index]
    if others:
        console.print(f"also held back by: {', '.join(others)}", soft_wrap=True)


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


def show_validation(console: Console, found: DesignValidation, loop: ClosedLoop) -> None:
    """On how many plants a design holds, what they differ by, what breaks and would help; then the figures."""
    units = metric_units(loop)
    console.print(Text(found.verdict, style="bold yellow" if found.broken else "bold green"), soft_wrap=True)
    breaks = ", ".join(f"{word} on {count}" for word, count in found.breaks.items())
    for sentence in (*found.varied, *([f"what breaks: {breaks}"] if breaks else []), *found.advice):
        console.print(f"  {sentence}", soft_wrap=True)
    if found.suggested:
        console.print(f"  in the tuning's file: {'; '.join(_scenario_lines(found.suggested))}", soft_wrap=True)
    table = new_table("new plants", "median", "95 %", "worst", "certified", "limit", "broken by", "unit")
    for row in found.summary.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [_metric_cell(metric, row[n]) for n in ("median", "p95", "worst", "certified")]
        limit = "" if math.isnan(row["limit"]) else format_number(row["limit"], 4)
        table.add_row(metric, *figures, limit, str(row["violations"]), units[metric])
    console.print(table)


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
    colours = {Usefulness.USEFUL: "bold green", Usefulness.HARMFUL: "bold red", Usefulness.USELESS: "bold yellow"}
    head, *reasons = str(verdict).splitlines()
    console.print(Text(head, style=colours[verdict.usefulness]), soft_wrap=True)
    for reason in reasons:
        console.print(reason, soft_wrap=True)


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
    return f"standard form: Kp {form.Kp:.4g}{integral}{derivative}"


def _format_limit(requirement: Requirement) -> str:
    limit, relation = user_limit(requirement), ">=" if requirement.metric.sense is Sense.AT_LEAST else "<="
    return "" if limit is None else f"{relation} {format_number(requirement.metric.factor * limit, 4)}"


def _metric_cell(metric: str, value: float) -> str:
    return "never" if metric in ("SettlingTime", "SettlingTimeRaw") and math.isnan(value) else format_number(value, 4)
