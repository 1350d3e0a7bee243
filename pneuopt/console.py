"""What the command line shows: tables that are read at 80 columns or piped, and a progress line on a terminal only."""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from pneuopt.certify import HUNTING
from pneuopt.control.forms import Form, ParallelForm, SeriesForm, StandardForm, to_parallel, to_standard
from pneuopt.control.loop import ClosedLoop
from pneuopt.dithering import DitherVerdict, Usefulness
from pneuopt.fresh_plants import DesignValidation
from pneuopt.identifiability import Verdict
from pneuopt.nlp.least_squares import Progress as Tell
from pneuopt.nlp.status import Status
from pneuopt.parameters import ParameterSet
from pneuopt.requirements import AT_LEAST, PERCENT, Requirement, name
from pneuopt.scrutiny import NOT_TOLD
from pneuopt.selection import ModelSelection
from pneuopt.study import INTERRUPTED
from pneuopt.units import write_value

if TYPE_CHECKING:
    import pandas as pd

MOST_ROWS = 12  # of a table of logs
MOST_REFERENCES = 3  # beside each other
MOST_CASES, MOST_REASONS = 40, 5  # of a study
SMALLEST_IS_WORST = ("GainMargin", "PhaseMargin")


def screen(*, error: bool = False) -> Console:
    """Standard output, or standard error; nothing is read as markup, for names of logs have brackets."""
    return Console(file=sys.stderr if error else sys.stdout, markup=False, highlight=False, emoji=False)


@contextmanager
def progress(label: str, *, quiet: bool) -> Iterator[Tell]:
    """A line that shows the latest news and the time; nothing where standard error is no terminal, or if quiet.

    Parameters
    ----------
    label : str
        Shown until there is news.
    quiet : bool

    Yields
    ------
    callable
        Takes a line of text.
    """
    console = screen(error=True)
    silent = quiet or not console.is_terminal
    clock = TimeElapsedColumn(table_column=Column(min_width=7))
    news = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    columns = SpinnerColumn(), clock, news
    with Progress(*columns, console=console, transient=True, disable=silent) as bar:
        task = bar.add_task(label, total=None)
        yield lambda text: bar.update(task, description=text)


def show_status(console: Console, status: Status) -> None:
    """How it ended, before anything else."""
    console.print(Text(str(status), style="bold green" if status.converged else "bold red"), soft_wrap=True)


def show_estimates(console: Console, estimates: "pd.DataFrame") -> None:
    """Value and 95 % confidence interval of each free parameter.

    Parameters
    ----------
    console : Console
    estimates : DataFrame
        Of an `IdentificationResult`.
    """
    table = _table("parameter", "value", "95 % confidence interval", "unit", "")
    for parameter, row in estimates.iterrows():
        value, interval = _interval(*(float(row[k]) for k in ("value", "stderr", "ci_low", "ci_high")))
        value = "-" if row["note"] == NOT_TOLD else value
        table.add_row(str(parameter), value, interval, str(row["unit"]), str(row["note"]))
    console.print(table)


def show_verdict(console: Console, verdict: Verdict | None) -> None:
    """What the logs do not tell, why, and what run would; nothing if nothing is amiss."""
    for sentence in verdict.sentences if verdict else ():
        console.print(sentence, soft_wrap=True)


def show_selection(console: Console, chosen: ModelSelection) -> None:
    """The recommendation and its reason, then a row a candidate."""
    console.print(Text(chosen.reason, style="bold green"), soft_wrap=True)
    table = _table("model", "free", "BIC above best", "contains", "p of chance", "")
    for row in chosen.table.reset_index(names="model").to_dict(orient="records"):
        figures = [str(row["free"]), _figure(row["bic_above"], 4), str(row["contains"]), _figure(row["p_value"], 2)]
        note = "" if row["converged"] else "not converged"
        table.add_row(str(row["model"]), *figures, note or (f"{NOT_TOLD}: {row['untold']}" if row["untold"] else ""))
    console.print(table)


def show_fit(console: Console, fit: "pd.DataFrame") -> None:
    """Agreement of each log and channel; of many logs the median and the worst.

    Parameters
    ----------
    console : Console
    fit : DataFrame
        Of an `IdentificationResult`, or from `validate`.
    """
    if len(fit) > MOST_ROWS:
        _show_many(console, fit)
        return
    table = _table("log", "channel", "NRMSE [%]", "RMSE", "unit")
    for row in fit.reset_index().to_dict(orient="records"):
        figures = [_figure(100 * row["nrmse"], 4), _figure(row["rmse"], 4)]
        table.add_row(str(row["log"]), str(row["channel"]), *figures, str(row["unit"]))
    console.print(table)


def show_gains(console: Console, before: ParameterSet, after: ParameterSet) -> None:
    """Each free parameter before and after tuning, within its bounds."""
    table = _table("parameter", "before", "tuned", "bounds", "")
    for n in after.free_names:
        p, unit = after[n], after[n].unit
        bounds = f"{_figure(p.lower, 4)} to {_figure(p.upper, 4)}"
        mark = "at its bound" if p.value in (p.lower, p.upper) else ""
        table.add_row(n, write_value(before.value(n), unit), write_value(p.value, unit), bounds, mark)
    console.print(table)
    console.print(_other_form(after), soft_wrap=True)


def show_rejected(console: Console, tuning: Path, stats: Mapping[str, float], given: ParameterSet, word: str) -> None:
    """What stands when a tuning failed or was cut short, and what it had found.

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
    units, allowed = metric_units(loop), {name(q): _allowed(q) for q in limits}
    several = len(metrics.columns) > MOST_REFERENCES
    columns = [f"worst of {len(metrics.columns)}"] if several else [f"{c} {loop.feedback.unit}" for c in metrics]
    table = _table(title, *columns, *(["limit"] if allowed else []), "unit")
    for metric in (m for m in units if m in metrics.index and _tells(m, metrics, loop)):
        now, was = (_row(frame, metric, several) for frame in (metrics, before))
        cells = [_metric(metric, v) + (f" (was {_metric(metric, was[k])})" if was else "") for k, v in enumerate(now)]
        limit = [allowed.get(metric, "")] if allowed else []
        table.add_row(metric, *cells, *limit, units[metric])
    console.print(table)


def show_requirements(console: Console, table: "pd.DataFrame", active: Sequence[str], loop: ClosedLoop) -> None:
    """What is left of each limit, and what holds the design back.

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
    units, grid = metric_units(loop), _table("requirement", "claimed", "certified", "limit", "room", "", "unit")
    for row in table.reset_index(names="requirement").to_dict(orient="records"):
        metric = str(row["requirement"])
        values = [100 * row[n] if metric in PERCENT else row[n] for n in ("claimed", "certified", "allowed")]
        figures = [_metric(metric, v) for v in values[:2]] + [_figure(values[2], 4)]
        room = "-" if math.isnan(row["room"]) else f"{100 * row['room']:.3g} %"
        grid.add_row(metric, *figures, room, "active" if row["active"] else "", units[metric])
    console.print(grid)
    others = [n for n in active if n not in table.index]
    if others:
        console.print(f"also held back by: {', '.join(others)}", soft_wrap=True)


def show_relaxations(console: Console, table: "pd.DataFrame") -> None:
    """What limits that contradict each other could give way to; nothing where there is no such table."""
    if table.empty:
        return
    grid = _table("relaxed alone", "asked", "would do", "by")
    for row in table.reset_index(names="limit").to_dict(orient="records"):
        share = "-" if math.isnan(row["share"]) else f"{100 * row['share']:.3g} %"
        needed = "none found" if row["limit"] != "all" and math.isnan(row["needed"]) else _figure(row["needed"], 4)
        grid.add_row("all together" if row["limit"] == "all" else row["limit"], _figure(row["asked"], 4), needed, share)
    console.print(grid)


def show_validation(console: Console, found: DesignValidation, loop: ClosedLoop) -> None:
    """A requirement a row: what it comes to on fresh plants, and how many break its limit."""
    units = metric_units(loop)
    console.print(f"validated on {len(found.plants)} fresh plants, the worst of each requirement certified")
    table = _table("", "median", "95 %", "worst", "certified", "limit", "broken by", "unit")
    for row in found.summary.reset_index(names="metric").to_dict(orient="records"):
        metric = str(row["metric"])
        figures = [_metric(metric, row[n]) for n in ("median", "p95", "worst", "certified")]
        limit = "" if math.isnan(row["limit"]) else _figure(row["limit"], 4)
        table.add_row(metric, *figures, limit, str(row["violations"]), units[metric])
    console.print(table)


def show_dither(console: Console, verdict: DitherVerdict) -> None:
    """Whether a dither is worth having, and why, a sentence a line."""
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
    ordered = table.sort_values(first, ascending=first in SMALLEST_IS_WORST, na_position="first", kind="stable")
    shown = table if len(table) <= MOST_CASES else ordered.head(MOST_CASES)
    grid = _table(*(f"{n}\n[{unit}]" if unit not in ("", "1") else n for n, unit in {**axes, **metrics}.items()))
    for row in shown.to_dict(orient="records"):
        figures = [_metric(m, row[m]) for m in metrics]
        if row["error"]:
            figures = ["failed" if row["error"] != INTERRUPTED else INTERRUPTED] + [""] * (len(metrics) - 1)
        grid.add_row(*(_figure(row[n], 6) for n in axes), *figures)
    console.print(grid)
    if len(shown) < len(table):
        console.print(f"the {len(shown)} worst of {len(table)} cases by {first}; -o FILE writes all")
    reasons = table["error"][~table["error"].isin(["", INTERRUPTED])].value_counts()
    for reason, count in list(reasons.items())[:MOST_REASONS]:
        console.print(f"failed ({count} of {len(table)}): {reason}", soft_wrap=True)


def metric_units(loop: ClosedLoop) -> Mapping[str, str]:
    """The metrics that are shown, in that order, with their units."""
    return {
        "SettlingTime": "s",
        "RiseTime": "s",
        "Overshoot": "%",
        "SteadyStateError": "%",
        "StepEnvelope": "",
        "IAE": "s",
        "ISE": "s",
        "ITAE": "s^2",
        "PeakControl": loop.command.unit,
        "ControlRate": f"{loop.command.unit}/s",
        "Ripple": loop.feedback.unit,
        "LimitCycleAmplitude": loop.feedback.unit,
        "LimitCycleFrequency": "Hz",
        "StickShare": "1",
        "AirUse": "l(ANR)",
        "ValveTravel": "half travels",
        "MaxSensitivity": "",
        "MaxComplementarySensitivity": "",
        "GainMargin": "",
        "PhaseMargin": "deg",
        "FrictionSlope": "N*s/m",
        "NoiseGain": f"{loop.command.unit}/({loop.feedback.unit})",
    }


def show_written(console: Console, paths: Sequence[Any]) -> None:
    """The files that were written."""
    for path in paths:
        console.print(f"wrote {path}", soft_wrap=True)


def show_pairs(console: Console, pairs: Mapping[str, object]) -> None:
    """Names and what they are, a line each."""
    width = max(len(n) for n in pairs)
    for key, value in pairs.items():
        console.print(f"{key:<{width}}  {value}", soft_wrap=True)


def _show_many(console: Console, fit: "pd.DataFrame") -> None:
    table = _table("channel", "logs", "NRMSE [%]: median", "worst", "in log", "RMSE: median", "unit")
    flat = fit.reset_index()
    for channel in flat["channel"].unique():
        rows = flat[flat["channel"] == channel].sort_values("nrmse", na_position="first")
        worst, middle = rows.iloc[-1], rows[["nrmse", "rmse"]].median()
        figures = [_figure(100 * v, 4) for v in (middle["nrmse"], worst["nrmse"])]
        rmse = _figure(middle["rmse"], 4)
        table.add_row(str(channel), str(len(rows)), *figures, str(worst["log"]), rmse, str(worst["unit"]))
    console.print(table)


def _tells(metric: str, metrics: "pd.DataFrame", loop: ClosedLoop) -> bool:
    """Ripple only under dither, a limit cycle only where there is one."""
    if metric == "Ripple":
        return loop.dither is not None
    return metric not in HUNTING or bool((metrics.loc[HUNTING[0]] > 0).any())


def _row(frame: "pd.DataFrame | None", metric: str, several: bool) -> list[float]:
    if frame is None or metric not in frame.index:
        return []
    values: list[float] = frame.T[metric].tolist()
    worst = min if metric in SMALLEST_IS_WORST else max
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


def _table(*columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for column in columns:
        text = column in (
            "parameter",
            "requirement",
            "relaxed alone",
            "model",
            "contains",
            "log",
            "channel",
            "certified",
            "rejected",
            "best so far",
            "unit",
            "in log",
            "",
        )
        whole = column in ("certified", "rejected", "best so far")
        table.add_column(column, justify="left" if text else "right", overflow="fold", no_wrap=whole)
    return table


def _allowed(requirement: Requirement) -> str:
    if isinstance(requirement, AT_LEAST):
        return "" if requirement.min is None else f">= {_figure(requirement.min, 4)}"
    factor = 100 if name(requirement) in PERCENT else 1
    return "" if requirement.max is None else f"<= {_figure(factor * requirement.max, 4)}"


def _metric(metric: str, value: float) -> str:
    return "never" if metric == "SettlingTime" and math.isnan(value) else _figure(value, 4)


def _figure(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}g}"


def _interval(value: float, spread: float, low: float, high: float) -> tuple[str, str]:
    if math.isfinite(low) and math.isinf(high):
        return _figure(value, 4), f"above {_figure(low, 4)}"
    if math.isinf(low) and math.isfinite(high):
        return _figure(value, 4), f"below {_figure(high, 4)}"
    if not math.isfinite(spread) or high - low > 1e3 * abs(value) > 0:
        return _figure(value, 4), "not determined"
    return _to_spread(value, spread), f"{_to_spread(low, spread)} to {_to_spread(high, spread)}"


def _to_spread(value: float, spread: float) -> str:
    """As many digits as two of the standard error say."""
    if not 0 < spread < math.inf or value == 0 or not spread < abs(value):
        return _figure(value, 4)
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(spread)) + 2
    return f"{value:#.{min(digits, 12)}g}".rstrip(".")
