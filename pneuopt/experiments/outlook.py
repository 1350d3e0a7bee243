"""`predict_loss`: what a tuned loop is worth as its plant drifts, and when it violates a requirement."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.requirements import larger_is_better, metric_name, requirement_values
from pneuopt.evaluation.specification import Objective, Specification, specify
from pneuopt.experiments.tolerances import SLACK
from pneuopt.identification.tracking import Tracking
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Column, Line, Report, Table, Tone, format_number
from pneuopt.quantities.results import Shown

if TYPE_CHECKING:
    from datetime import datetime


@dataclass(frozen=True, eq=False, repr=False)
class DesignOutlook(Shown):
    """A design over the dates of a history, and beyond.

    Attributes
    ----------
    table : DataFrame
        A row a date: ahead, whether it is extrapolated; each limited or minimised metric, the worst over the
        references; fails, the limits that are violated and the defects, in words, empty where there are none.
    """

    table: pd.DataFrame

    @property
    def fails(self) -> "datetime | None":
        """The first date from which on the design fails at every later one; None: it holds at the last."""
        bad = (self.table["fails"] != "").to_numpy()
        begin = len(bad) - int(np.argmin(bad[::-1])) if not bad.all() else 0
        return None if begin == len(bad) else self.table.index[begin].to_pydatetime()

    def summary(self) -> Report:
        """Whether and when to tune again, then a row a date."""
        last = f"{self.table.index[-1]:%Y-%m-%d}"
        verdict = Line(f"the tuned loop keeps its requirements until {last}", Tone.GOOD)
        if (begin := self.fails) is not None:
            ahead = bool(self.table["ahead"][begin])
            when = "will fail by" if ahead else "fails since"
            why = self.table["fails"][begin]
            verdict = Line(f"tune again: the tuned loop {when} {begin:%Y-%m-%d} ({why})", Tone.BAD)
        names = [str(n) for n in self.table.columns if n not in ("ahead", "fails")]
        columns = (Column("date", is_text=True), *map(Column, names), Column("fails", is_text=True))
        rows = []
        for row in self.table.reset_index().to_dict(orient="records"):
            date = f"{row['date']:%Y-%m-%d}" + (" (ahead)" if row["ahead"] else "")
            rows.append((date, *(format_number(float(row[n]), 4) for n in names), str(row["fails"])))
        return Report((verdict, Table(columns, tuple(rows))))


def predict_loss(
    tracking: Tracking,
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    objective: Objective,
    *,
    ahead: int = 4,
) -> DesignOutlook:
    """Certify a design at the estimates of each log, and along the drift into the future.

    Parameters
    ----------
    tracking : Tracking
        Whose drift moves the plant.
    loop : ClosedLoop
        The loop that was tuned, with its gains among the parameters.
    references : Reference or sequence of Reference
        As of `tune`.
    parameters : ParameterSet
        The design's gains and the plant's other values.
    objective : Specification, Requirement or mapping
        What was tuned for, with its limits.
    ahead : int
        Dates beyond the last log: they reach as far ahead as the logs reach back. Parameters with an alarm go on along
        their line there; the others stay at their line's value at the last log.

    Returns
    -------
    DesignOutlook

    Raises
    ------
    InputError
        If a tracked parameter is none of the loop's.
    """
    spec = objective if isinstance(objective, Specification) else specify(objective)
    unknown = [n for n in tracking.table.index if n not in loop.plant.parameters]
    require(not unknown, f"{', '.join(map(str, unknown))}: no parameter of the loop's plant; track what it has")
    rows = {}
    for date, is_ahead, values in _plants(tracking, ahead):
        known = parameters.with_values({n: v for n, v in values.items() if np.isfinite(v)})
        rows[date] = {"ahead": is_ahead, **_certify(loop, references, known, spec)}
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("date")
    return DesignOutlook(table)


def _plants(tracking: Tracking, ahead: int) -> "list[tuple[pd.Timestamp, bool, dict[str, float]]]":
    """Date, whether it is ahead, and the values of the tracked parameters."""
    own = {str(n): tracking.history.loc[n].to_dict(orient="list") for n in tracking.table.index}
    dates = [pd.Timestamp(d) for d in tracking.history.loc[tracking.table.index[0]].index]
    plants = [(d, False, {n: float(column["value"][k]) for n, column in own.items()}) for k, d in enumerate(dates)]
    for share in np.arange(1, ahead + 1) / max(ahead, 1):
        moved = {}
        for name, column in own.items():
            first, last = float(column["line"][0]), float(column["line"][-1])
            moved[name] = last + (share * (last - first) if name in tracking.drifting else 0.0)
        plants.append((dates[-1] + share * (dates[-1] - dates[0]), True, moved))
    return plants


def _certify(
    loop: ClosedLoop, references: Reference | Sequence[Reference], parameters: ParameterSet, spec: Specification
) -> dict[str, float | str]:
    """The worst metrics of a design, and why it fails."""
    proof = certificate(loop, references, parameters, band=spec.band, envelope=spec.envelope)
    failures = list(dict.fromkeys(finding.defect.value for finding in proof.findings))
    for case in proof.metrics:
        violated = spec.violations(
            requirement_values({str(n): float(v) for n, v in proof.metrics[case].items()}), SLACK
        )
        failures += [n for n in map(metric_name, violated) if n not in failures]
    row: dict[str, float | str] = {}
    for name in (n for n in spec.metric_names if n in proof.metrics.index):
        worst = np.min if larger_is_better(name) else np.max
        row[name] = float(worst(proof.metrics.loc[name].to_numpy(dtype=float)))
    return {**row, "fails": ", ".join(failures)}
