"""What an identification shows: verdict, estimates with intervals and marks, models compared, agreement with logs."""

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pneuopt.identification.marks import AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE, Mark
from pneuopt.quantities.report import (
    TIED,
    Column,
    Line,
    Report,
    Table,
    Tone,
    format_number,
    number_columns,
    text_columns,
)
from pneuopt.quantities.status import report_status

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.identification.compare_logs import LogComparison
    from pneuopt.identification.result import ChosenWidth, IdentificationResult
    from pneuopt.identification.select_model import ModelSelection

MAX_FIT_ROWS = 12
"""Rows of a table of logs: of more, the median and the worst are easier to read."""


def report_fit(result: "IdentificationResult") -> Report:
    """How a fit ended, its estimates, what is unidentifiable and why, and how well it agrees with the logs."""
    sentences = tuple(map(Line, result.verdict.sentences if result.verdict else ()))
    estimates = report_estimates(result.estimates, result.widths)
    return report_status(result.status) + estimates + Report(sentences) + report_agreement(result.fit)


def report_estimates(estimates: "pd.DataFrame", widths: Sequence["ChosenWidth"] = ()) -> Report:
    """Value, interval or range, and mark of each free parameter, then the widths that the logs have chosen.

    Parameters
    ----------
    estimates : DataFrame
        Of an `IdentificationResult`.
    widths : sequence of ChosenWidth
    """
    rows = [_estimate_row(str(n), row) for n, row in estimates.to_dict(orient="index").items()]
    rows += [(w.name, format_number(w.value, 3), "-", w.unit, "chosen") for w in widths]
    columns = *text_columns("parameter"), *number_columns("value", f"95{TIED}% interval"), *text_columns("unit", "mark")
    table = (Table(columns, tuple(rows)),) if rows else ()
    return Report((*table, *(Line(str(width)) for width in widths)))


def report_selection(chosen: "ModelSelection") -> Report:
    """The recommendation and its reason, then a row a candidate."""
    rows = []
    for row in chosen.table.reset_index(names="model").to_dict(orient="records"):
        unidentifiable = row["unidentifiable"]
        missing = f"{UNIDENTIFIABLE_NOTE}: {unidentifiable}" if unidentifiable else ""
        why = str(row["message"]).partition(";")[0]
        note = "" if row["converged"] else f"refuted: {why}" if row["refuted"] else f"not converged: {why}"
        bound = f"{AT_BOUND_NOTE}: {row['at_bound']}" if row["at_bound"] else ""
        figures = str(row["free"]), format_number(row["bic_above"], 4), str(row["contains"])
        remark = note or row["unphysical"] or bound or missing
        rows.append((str(row["model"]), *figures, format_number(row["p_value"], 2), str(remark)))
    free, contains = number_columns("free", "BIC above best"), text_columns("contains")
    columns = *text_columns("model"), *free, *contains, *number_columns("p of chance"), *text_columns("")
    return Report((Line(chosen.reason, Tone.GOOD), Table(columns, tuple(rows))))


def report_comparison(found: "LogComparison") -> Report:
    """Whether logs agree, and a row a parameter and log."""
    rows = []
    for row in found.table.reset_index().to_dict(orient="records"):
        figures = format_number(row["value"], 5), format_number(row["stderr"], 2), format_number(row["others"], 5)
        name, log = str(row["parameter"]), str(row["log"])
        rows.append((name, log, *figures, format_number(row["deviation"], 3), str(row["unit"])))
    heads = number_columns("value", "stderr", "others", "deviation")
    table = Table((*text_columns("parameter", "log"), *heads, *text_columns("unit")), tuple(rows))
    return Report((Line(found.reason, Tone.GOOD if found.agree else Tone.DOUBTFUL), *([table] if rows else [])))


def report_agreement(fit: "pd.DataFrame") -> Report:
    """Agreement of each log and channel; of many logs the median and the worst.

    Parameters
    ----------
    fit : DataFrame
        Of an `IdentificationResult`, or from `validate`.
    """
    if fit.empty:  # no channel was compared
        return Report()
    if len(fit) > MAX_FIT_ROWS:
        return Report((_agreement_in_short(fit),))
    rows = []
    for row in fit.reset_index().to_dict(orient="records"):
        shares = [format_number(100 * row[n], 4) for n in ("nrmse", "free_run_nrmse")]
        figures = [*shares, *(format_number(row[n], 4) for n in ("rmse", "free_run_rmse"))]
        rows.append((str(row["log"]), str(row["channel"]), *figures, str(row["unit"])))
    figures_heads = number_columns("NRMSE [%]", "free run", "RMSE", "free run")
    return Report((Table((*text_columns("log", "channel"), *figures_heads, *text_columns("unit")), tuple(rows)),))


def _agreement_in_short(fit: "pd.DataFrame") -> Table:
    rows, flat = [], fit.reset_index()
    for channel in flat["channel"].unique():
        own = flat[flat["channel"] == channel].sort_values("nrmse", na_position="first")
        worst, middle = own.iloc[-1], own[["nrmse", "rmse"]].median()
        figures = [format_number(100 * v, 4) for v in (middle["nrmse"], worst["nrmse"], worst["free_run_nrmse"])]
        rmse = format_number(middle["rmse"], 4)
        rows.append((str(channel), str(len(own)), *figures, str(worst["log"]), rmse, str(worst["unit"])))
    columns = (
        *(Column("channel", is_text=True), *number_columns("logs", "NRMSE [%]: median", "worst", "free")),
        *(Column("in log", is_text=True), Column("RMSE: median"), Column("unit", is_text=True)),
    )
    return Table(columns, tuple(rows))


def _estimate_row(name: str, row: Mapping[Hashable, Any]) -> tuple[str, str, str, str, str]:
    value, interval = _format_interval(*(float(row[k]) for k in ("value", "stderr", "ci_low", "ci_high")))
    if math.isnan(row["ci_low"]) and math.isfinite(row["range_low"]):
        interval = _format_range(float(row["range_low"]), float(row["range_high"]))
    value = "-" if row["mark"] == Mark.UNIDENTIFIABLE else value
    mark = AT_BOUND_NOTE if row["note"] == AT_BOUND_NOTE else row["mark"]
    return name, value, interval, str(row["unit"]), str(mark)


def _format_interval(value: float, spread: float, low: float, high: float) -> tuple[str, str]:
    if math.isfinite(low) and math.isinf(high):
        return format_number(value, 4), f"above{TIED}{format_number(low, 4)}"
    if math.isinf(low) and math.isfinite(high):
        return format_number(value, 4), f"below{TIED}{format_number(high, 4)}"
    if not math.isfinite(spread) or high - low > 1e3 * abs(value) > 0:
        return format_number(value, 4), "not determined"
    return _format_to_stderr(value, spread), _join_ends(_format_to_stderr(low, spread), _format_to_stderr(high, spread))


def _format_range(low: float, high: float) -> str:
    """A range, which is no confidence interval, with the digits that show a fiftieth of it."""
    spread = (high - low) / 4
    return f"range{TIED}{_join_ends(_format_to_stderr(low, spread), _format_to_stderr(high, spread))}"


def _join_ends(low: str, high: str) -> str:
    return f"{low}{TIED}to {high}"


def _format_to_stderr(value: float, spread: float) -> str:
    """The value with the digits that show two of its standard error."""
    if not 0 < spread < math.inf or value == 0 or not spread < abs(value):
        return format_number(value, 4)
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(spread)) + 2
    return f"{value:#.{min(digits, 12)}g}".rstrip(".")
