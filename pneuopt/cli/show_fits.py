"""What an identification shows: estimates, what is unidentifiable, the models compared, the agreement with logs."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from pneuopt.cli.terminal import format_number, new_table
from pneuopt.identification.result import AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE, ChosenWidth, Mark, Verdict
from pneuopt.identification.select_model import ModelSelection

if TYPE_CHECKING:
    import pandas as pd

MAX_FIT_ROWS = 12
"""Rows of a table of logs: of more, the median and the worst are easier to read."""


def show_estimates(console: Console, estimates: "pd.DataFrame", widths: Sequence[ChosenWidth] = ()) -> None:
    """Value, interval or range, and mark of each free parameter, then the widths that the logs have chosen.

    Parameters
    ----------
    console : Console
    estimates : DataFrame
        Of an `IdentificationResult`.
    widths : sequence of ChosenWidth
    """
    table = new_table("parameter", "value", "95 % interval", "unit", "mark")
    for parameter, row in estimates.iterrows():
        value, interval = _format_interval(*(float(row[k]) for k in ("value", "stderr", "ci_low", "ci_high")))
        if math.isnan(row["ci_low"]) and math.isfinite(row["range_low"]):
            interval = _format_range(float(row["range_low"]), float(row["range_high"]))
        value = "-" if row["mark"] == Mark.UNIDENTIFIABLE else value
        mark = AT_BOUND_NOTE if row["note"] == AT_BOUND_NOTE else row["mark"]
        table.add_row(str(parameter), value, interval, str(row["unit"]), str(mark))
    for width in widths:
        table.add_row(width.name, format_number(width.value, 3), "-", width.unit, "chosen")
    console.print(table)
    for width in widths:
        console.print(str(width), soft_wrap=True)


def show_verdict(console: Console, verdict: Verdict | None) -> None:
    """Which parameters are unidentifiable, why, and which run would help; nothing where all are identifiable."""
    for sentence in verdict.sentences if verdict else ():
        console.print(sentence, soft_wrap=True)


def show_selection(console: Console, chosen: ModelSelection) -> None:
    """The recommendation and its reason, then a row a candidate."""
    console.print(Text(chosen.reason, style="bold green"), soft_wrap=True)
    table = new_table("model", "free", "BIC above best", "contains", "p of chance", "")
    for row in chosen.table.reset_index(names="model").to_dict(orient="records"):
        figures = [
            str(row["free"]),
            format_number(row["bic_above"], 4),
            str(row["contains"]),
            format_number(row["p_value"], 2),
        ]
        unidentifiable = row["unidentifiable"]
        missing = f"{UNIDENTIFIABLE_NOTE}: {unidentifiable}" if unidentifiable else ""
        note = "" if row["converged"] else "not converged"
        bound = f"{AT_BOUND_NOTE}: {row['at_bound']}" if row["at_bound"] else ""
        table.add_row(str(row["model"]), *figures, note or row["unphysical"] or bound or missing)
    console.print(table)


def show_fit(console: Console, fit: "pd.DataFrame") -> None:
    """Agreement of each log and channel; of many logs the median and the worst.

    Parameters
    ----------
    console : Console
    fit : DataFrame
        Of an `IdentificationResult`, or from `validate`.
    """
    if len(fit) > MAX_FIT_ROWS:
        _show_fit_summary(console, fit)
        return
    table = new_table("log", "channel", "NRMSE [%]", "free run", "RMSE", "free run", "unit")
    for row in fit.reset_index().to_dict(orient="records"):
        shares = [format_number(100 * row[n], 4) for n in ("nrmse", "free_run_nrmse")]
        figures = [*shares, *(format_number(row[n], 4) for n in ("rmse", "free_run_rmse"))]
        table.add_row(str(row["log"]), str(row["channel"]), *figures, str(row["unit"]))
    console.print(table)


def _show_fit_summary(console: Console, fit: "pd.DataFrame") -> None:
    table = new_table("channel", "logs", "NRMSE [%]: median", "worst", "free", "in log", "RMSE: median", "unit")
    flat = fit.reset_index()
    for channel in flat["channel"].unique():
        rows = flat[flat["channel"] == channel].sort_values("nrmse", na_position="first")
        worst, middle = rows.iloc[-1], rows[["nrmse", "rmse"]].median()
        figures = [format_number(100 * v, 4) for v in (middle["nrmse"], worst["nrmse"], worst["free_run_nrmse"])]
        rmse = format_number(middle["rmse"], 4)
        table.add_row(str(channel), str(len(rows)), *figures, str(worst["log"]), rmse, str(worst["unit"]))
    console.print(table)


def _format_interval(value: float, spread: float, low: float, high: float) -> tuple[str, str]:
    if math.isfinite(low) and math.isinf(high):
        return format_number(value, 4), f"above {format_number(low, 4)}"
    if math.isinf(low) and math.isfinite(high):
        return format_number(value, 4), f"below {format_number(high, 4)}"
    if not math.isfinite(spread) or high - low > 1e3 * abs(value) > 0:
        return format_number(value, 4), "not determined"
    return _format_to_stderr(value, spread), f"{_format_to_stderr(low, spread)} to {_format_to_stderr(high, spread)}"


def _format_range(low: float, high: float) -> str:
    """A range, which is no confidence interval, with the digits that show a fiftieth of it."""
    return f"range {_format_to_stderr(low, (high - low) / 4)} to {_format_to_stderr(high, (high - low) / 4)}"


def _format_to_stderr(value: float, spread: float) -> str:
    """The value with the digits that show two of its standard error."""
    if not 0 < spread < math.inf or value == 0 or not spread < abs(value):
        return format_number(value, 4)
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(spread)) + 2
    return f"{value:#.{min(digits, 12)}g}".rstrip(".")
