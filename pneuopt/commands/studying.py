"""`pneuopt study`: a loop certified over a grid of parameters."""

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.certify import evaluate
from pneuopt.commands.shared import (
    GOOD,
    INTERRUPTED,
    NOT_GOOD,
    Outputs,
    Writers,
    band_of,
    figure_writers,
    finish,
    hashes,
    read_loop,
    warn_of,
)
from pneuopt.console.loops import SMALLEST_IS_WORST, metric_units, show_cases
from pneuopt.console.terminal import progress, screen
from pneuopt.control.loop import ClosedLoop
from pneuopt.errors import InputError, check_known, require
from pneuopt.output import records, write_text
from pneuopt.plotting import plot_map
from pneuopt.study import INTERRUPTED as CUT_SHORT
from pneuopt.study import grid, sweep
from pneuopt.studyfile import Axis, read_axes, read_study

if TYPE_CHECKING:
    import pandas as pd


def run_study(file: Path, outputs: Outputs, quiet: bool) -> int:
    """Certify a loop over a grid of parameters; returns the exit status."""
    study = read_study(file)
    outputs.check([file, study.drive, study.tuning])
    count = len(study.axes)
    require(
        outputs.plot is None or count <= 2, f"{file}: --plot draws one or two axes, there are {count}; leave it out"
    )
    asked, parameters = read_loop(study.drive, study.tuning)
    warn_of(study.tuning, "tuning")
    axes, units = read_axes(study, parameters), metric_units(asked.loop)
    check_known("metric", study.show, units, f"{file}: [metrics] show")
    try:
        cases = grid(parameters, {axis.name: axis.points for axis in axes})
    except InputError as error:
        raise InputError(f"{file}: [axes] {error}") from None
    certify = partial(evaluate, asked.loop, asked.references, band=study.band or band_of(asked))
    with progress("certifying", quiet=quiet) as tell:
        table = sweep(certify, parameters, cases, progress=tell)
    verdict, status = _verdict(table, len(asked.references))
    screen().print(verdict, style="bold red" if status else "bold green", soft_wrap=True)
    seen = _worst_of_references(table, axes, study.show)
    written, metrics = {axis.name: axis.unit for axis in axes}, {name: units[name] for name in study.show}
    show_cases(screen(), seen, written, metrics)
    writers: Writers = {}
    if outputs.output is not None:
        text = _in_si(table, {n: parameters[n].unit for n in written}, asked.loop)
        writers[outputs.output] = partial(write_text, outputs.output, text)
    if outputs.plot is not None:
        writers |= figure_writers(outputs.plot, {"": plot_map(seen, written, metrics)})
    tables = {"verdict": verdict, "cases": records(table), "provenance": hashes(file, study.drive, study.tuning)}
    finish(outputs, writers, tables, None)
    return status


def _verdict(table: "pd.DataFrame", references: int) -> tuple[str, int]:
    """How a study went, and the exit status."""
    settling = table[[c for c in table if _metric_of(c) == "SettlingTime"]]
    good = table["error"] == ""
    counts = {
        "interrupted": int((table["error"] == CUT_SHORT).sum()),
        "failed": int((~good & (table["error"] != CUT_SHORT)).sum()),
        "never settle": int((good & settling.isna().any(axis=1)).sum()),
    }
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    status = INTERRUPTED if counts["interrupted"] else NOT_GOOD if parts else GOOD
    each = f", each the worst of {references} references" if references > 1 else ""
    return f"{len(table)} cases{each}: {', '.join(parts) or 'all settle'}", status


def _worst_of_references(table: "pd.DataFrame", axes: Sequence[Axis], metrics: Sequence[str]) -> "pd.DataFrame":
    """What is shown of a study: the axes in the units of the file, each metric at its worst."""
    seen = table[["error"]].copy()
    for axis in axes:
        seen[axis.name] = axis.shown(table[axis.name])
    for metric in metrics:
        own = table[[c for c in table if _metric_of(c) == metric]]
        worst = own.min if metric in SMALLEST_IS_WORST else own.max
        seen[metric] = worst(axis=1, skipna=False) if len(own.columns) else math.nan
    return seen


def _metric_of(column: Hashable) -> str:
    """What "Overshoot[0 to 0.2]" is, as it is called where there are several references."""
    return str(column).partition("[")[0]


def _in_si(table: "pd.DataFrame", axes: Mapping[str, str], loop: ClosedLoop) -> str:
    """As CSV, each column with its unit."""
    known = {**axes, **metric_units(loop), "PeakTime": "s", "OvershootFinal": "%", "Undershoot": "%", "seconds": "s"}
    known |= dict.fromkeys(("SettlingMin", "SettlingMax", "Peak", "SteadyStateValue"), loop.feedback.unit)
    header = {c: f"{c} [{known[_metric_of(c)]}]" for c in table if known.get(_metric_of(c))}
    return str(table.rename(columns=header).to_csv(index=False, float_format="%.9g", lineterminator="\n"))
