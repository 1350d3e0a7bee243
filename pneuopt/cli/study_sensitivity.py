"""`pneuopt study` with a [sensitivity]: which tolerances matter for a design."""

from collections.abc import Hashable
from functools import partial
from typing import TYPE_CHECKING, Any

from pneuopt.cli.computing import Computing, keep_cases
from pneuopt.cli.exit_status import EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_SUCCESS
from pneuopt.cli.shared import Outputs, Writers, file_hashes, finish, read_fit_and_tuning, warn_of_status
from pneuopt.cli.show_studies import lead_report, table_writer
from pneuopt.cli.study_pages import Design, sensitivity_page
from pneuopt.cli.terminal import progress
from pneuopt.evaluation.evaluate import evaluate, metric_units
from pneuopt.evaluation.scenarios import axis_labels
from pneuopt.files.study import Study, read_sensitivity
from pneuopt.files.tuning import Tuning
from pneuopt.plotting import plot_sensitivity
from pneuopt.quantities.errors import check_names
from pneuopt.quantities.output import records
from pneuopt.quantities.status import Code, Status
from pneuopt.studies.local_sensitivity import LocalSensitivity, local_sensitivity
from pneuopt.studies.outcome import INTERRUPTED_CASE
from pneuopt.studies.sensitivity import Sensitivity, sensitivity

if TYPE_CHECKING:
    import pandas as pd


def run_sensitivity(study: Study, outputs: Outputs, quiet: bool, computing: Computing) -> int:
    """Tell which tolerances matter for a design; returns the exit status."""
    _, task, parameters = read_fit_and_tuning(study.drive, study.tuning)
    warn_of_status(study.tuning)
    asked, units = read_sensitivity(study, parameters), metric_units(task.loop)
    check_names("metric", study.show, units, f"{study.path}: [metrics] show")
    band, slopes = study.band or task.specification.band, None
    if asked.local:  # at once, as it refuses metrics without a slope
        slopes = local_sensitivity(task.loop, task.references, parameters, asked.spreads, metrics=study.show, band=band)
    count = asked.count * (len(axis_labels(parameters, asked.spreads)) + 2)
    certify = partial(evaluate, task.loop, task.references, band=band, max_steps=task.max_steps)
    with (
        keep_cases(study, outputs, count, computing.resume) as journal,
        computing.open() as executor,
        progress("certifying", quiet=quiet) as report_progress,
    ):
        found = sensitivity(
            certify,
            parameters,
            asked.spreads,
            figures=_figures(study, task),
            count=asked.count,
            seed=asked.seed,
            executor=executor,
            progress=report_progress,
            journal=journal,
        )
    status = _write(study, outputs, found, slopes, (task.loop, parameters))
    if journal is not None and status != EXIT_INTERRUPTED:
        journal.delete()
    return status


def _write(study: Study, outputs: Outputs, found: Sensitivity, slopes: LocalSensitivity | None, design: Design) -> int:
    """Show and write what was found; returns the exit status."""
    verdict, status = _verdict(found.cases)
    report = lead_report(verdict, status) + found.summary()
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = table_writer(outputs.output, _join(found, slopes), {})
    tables: dict[str, Any] = {"verdict": verdict, "shares": records(found.table), "figures": records(found.figures)}
    if slopes is not None:
        report += slopes.summary()
        tables["slopes"] = records(slopes.table)
    tables["cases"] = records(found.cases)
    tables["provenance"] = file_hashes(study.path, study.drive, study.tuning)
    stopped = Status(Code.INTERRUPTED, (verdict,)) if status == EXIT_INTERRUPTED else None
    drawn = partial(plot_sensitivity, found, slopes)
    page = partial(sensitivity_page, study, report, drawn, design)
    finish(outputs, writers, tables, stopped, figures=lambda: {"": drawn()}, report=report, page=page)
    return status


def _figures(study: Study, task: Tuning) -> list[str]:
    """The columns of the metrics that are shown, one a reference."""
    labels = [step.label for step in task.references]
    return [n if len(labels) == 1 else f"{n}[{label}]" for label in labels for n in study.show]


def _verdict(cases: "pd.DataFrame") -> tuple[str, int]:
    """How many points were certified, and the exit status."""
    interrupted = int((cases["error"] == INTERRUPTED_CASE).sum())
    failed = int((cases["error"] != "").sum()) - interrupted
    parts = [f"{n} {what}" for n, what in ((interrupted, "interrupted"), (failed, "failed")) if n]
    status = EXIT_INTERRUPTED if interrupted else EXIT_FAILURE if failed else EXIT_SUCCESS
    return f"{len(cases)} points: {', '.join(parts) or 'all certified'}", status


def _join(found: Sensitivity, slopes: LocalSensitivity | None) -> "pd.DataFrame":
    """A row a metric and axis: the shares, and what the slopes say beside them."""
    table = found.table if slopes is None else found.table.join(slopes.table)
    named: dict[Hashable, str] = {"change": "local_change", "relative": "local_relative", "share": "local_share"}
    return table.rename(columns=named).reset_index()
