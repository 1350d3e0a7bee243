"""What a study shows: its cases, or the designs of a front."""

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.evaluation.evaluate import metric_cell
from pneuopt.evaluation.requirements import larger_is_better
from pneuopt.quantities.output import format_table, write_bytes, write_text
from pneuopt.quantities.report import Column, Line, Report, Table, Tone, format_number
from pneuopt.studies.outcome import INTERRUPTED_CASE
from pneuopt.studies.row_file import PARQUET, parquet_bytes

if TYPE_CHECKING:
    import pandas as pd

MAX_CASE_ROWS, MAX_FAILURE_REASONS = 40, 5
"""Rows and reasons that a study shows: more scroll the verdict away."""
MAX_GAIN_COLUMNS = 6
"""Gains that a front shows: more do not fit a terminal of 80 columns."""


def report_cases(table: "pd.DataFrame", axes: Mapping[str, str], metrics: Mapping[str, str]) -> Report:
    """A study, a row a case; of many the worst, by the first metric; then the reasons of those that failed.

    Parameters
    ----------
    table : DataFrame
        A column an axis and a metric, and "error".
    axes, metrics : mapping of str to str
        The columns, and their units.
    """
    first = next(iter(metrics))
    ordered = table.sort_values(first, ascending=larger_is_better(first), na_position="first", kind="stable")
    shown, rows = table if len(table) <= MAX_CASE_ROWS else ordered.head(MAX_CASE_ROWS), []
    for row in shown.to_dict(orient="records"):
        figures = [metric_cell(m, row[m]) for m in metrics]
        if row["error"]:
            figures = ["failed" if row["error"] != INTERRUPTED_CASE else INTERRUPTED_CASE] + [""] * (len(metrics) - 1)
        rows.append((*(format_number(row[n], 6) for n in axes), *figures))
    heads = (f"{n}\n[{unit}]" if unit not in ("", "1") else n for n, unit in {**axes, **metrics}.items())
    lines = []
    if len(shown) < len(table):
        lines.append(f"the {len(shown)} worst of {len(table)} cases by {first}; -o FILE writes all")
    reasons = table["error"][~table["error"].isin(["", INTERRUPTED_CASE])].value_counts()
    for reason, count in list(reasons.items())[:MAX_FAILURE_REASONS]:
        lines.append(f"failed ({count} of {len(table)}): {reason}")
    return Report((Table(tuple(map(Column, heads)), tuple(rows)), *map(Line, lines)))


def report_checks(checks: "pd.DataFrame") -> Report:
    """The certified cases of a batch: the largest difference a metric, and the cases in which lanes are refuted.

    Parameters
    ----------
    checks : DataFrame
        Of a `BatchEvaluation`.
    """
    rows = [(str(m), format_number(float(own["difference"].max()), 2)) for m, own in checks.groupby("metric")]
    lines = [
        Line(f"{row['case']}: {row['metric']} is {row['batch']:.6g} in the lanes, {row['certified']:.6g} certified")
        for row in checks[~checks["agrees"]].head(MAX_FAILURE_REASONS).to_dict(orient="records")
    ]
    table = (
        (Table((Column("metric"), Column("largest difference\nfrom the certificate")), tuple(rows)),) if rows else ()
    )
    left = "margins, stick-slip events and what comes after the horizon are not in the lanes: leave out batch for them"
    return Report((*table, *lines, Line(left)))


def report_front(table: "pd.DataFrame", requirements: Mapping[str, str], gains: Mapping[str, str]) -> Report:
    """A front, a row a design, of those that are not certified the limit; then the reasons.

    Parameters
    ----------
    table : DataFrame
        A column a requirement and a gain, "limit" and "error".
    requirements, gains : mapping of str to str
        The two requirements, the limited one last, and the gains, with their units.
    """
    first, second = requirements
    shown = dict(list(gains.items())[:MAX_GAIN_COLUMNS])
    relation, rows = ">=" if larger_is_better(second) else "<=", []
    for row in table.to_dict(orient="records"):
        figures = [format_number(row[n], 4) for n in (first, second)]
        if row["error"]:
            word = INTERRUPTED_CASE if row["error"] == INTERRUPTED_CASE else "failed"
            figures = [word, "-" if math.isnan(row["limit"]) else f"{relation} {format_number(row['limit'], 4)}"]
        rows.append((*figures, *(_format_gain(row[n]) for n in shown)))
    heads = [_narrow_heading(n, unit) for n, unit in {**requirements, **shown}.items()]
    lines = [f"{len(shown)} of {len(gains)} gains; -o FILE writes all"] if len(shown) < len(gains) else []
    failed = table[~table["error"].isin(["", INTERRUPTED_CASE])].to_dict(orient="records")
    lines += [f"failed ({second} {relation} {format_number(row['limit'], 4)}): {row['error']}" for row in failed]
    return Report((Table(tuple(map(Column, heads)), tuple(rows)), *map(Line, lines)))


def lead_report(verdict: str, status: int) -> Report:
    """The verdict as a report."""
    return Report((Line(verdict, Tone.BAD if status else Tone.GOOD),))


def table_writer(path: Path, table: "pd.DataFrame", units: Mapping[str, str]) -> Callable[[Path], None]:
    """What writes a table with units in its header: as Parquet where the file to be is called so, else as CSV."""
    named = table.rename(columns={n: heading(n, unit) for n, unit in units.items()})
    if path.suffix.lower() == PARQUET:
        columns = {str(n): named[n].tolist() for n in named}
        return partial(write_bytes, content=parquet_bytes(columns))
    return partial(write_text, text=format_table(named))


def heading(name: str, unit: str) -> str:
    """A column's name with its unit, "SettlingTime [s]"."""
    return f"{name} [{unit}]" if unit else name


def _format_gain(value: float) -> str:
    """Four digits, as gains are rounded, and no exponent where it is the longer one: 68130."""
    return f"{float(format_number(value, 4)):.0f}" if 1e4 <= abs(value) < 1e7 else format_number(value, 4)


def _narrow_heading(column: str, unit: str) -> str:
    """A heading in narrow lines, "Peak / Control / [V]" or "pid. / Kp / [V*s/m]"."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=\.)", "\n", column)
    return words if unit in ("", "1") else f"{words}\n[{unit}]"
