"""`pneuopt study`: a loop certified over a grid of parameters or other cases; a front is in `study_front`."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.cli.computing import Computing, keep_cases
from pneuopt.cli.exit_status import EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_SUCCESS
from pneuopt.cli.shared import (
    Outputs,
    Writers,
    file_hashes,
    finish,
    read_fit_and_tuning,
    warn_of_status,
)
from pneuopt.cli.show_studies import heading, lead_report, report_cases, report_checks, table_writer
from pneuopt.cli.study_front import run_front
from pneuopt.cli.study_pages import MAX_MAP_AXES, case_page
from pneuopt.cli.study_sensitivity import run_sensitivity
from pneuopt.cli.terminal import progress
from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.evaluate import metric_units
from pneuopt.evaluation.requirements import (
    METRICS,
    larger_is_better,
)
from pneuopt.files.drive import read_drive
from pneuopt.files.study import Cases, Study, SweptAxis, read_axes, read_study, read_study_cases, swept_axes
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.plotting import plot_distribution, plot_map
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.output import records
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.source import read_once
from pneuopt.quantities.status import Code, Status
from pneuopt.studies.batch import LANE_METRICS, evaluate_batch
from pneuopt.studies.cases import grid
from pneuopt.studies.journal import Journal
from pneuopt.studies.neighbours import sweep_from_neighbours
from pneuopt.studies.outcome import INTERRUPTED_CASE
from pneuopt.studies.processes import Processes
from pneuopt.studies.sample_time import (
    SAMPLE_TIME_AXIS,
    evaluate_at_sample_time,
    loop_at_sample_time,
    with_sample_time,
)
from pneuopt.studies.sweep import sweep
from pneuopt.tuning.certifier import certified_objective
from pneuopt.tuning.tune import tune

if TYPE_CHECKING:
    import pandas as pd

# Columns of a study that tunes: its objective, and the word before the name of a gain that was found.
OBJECTIVE, FOUND = "objective", "found"


def run_study(file: Path, outputs: Outputs, quiet: bool, computing: Computing) -> int:
    """Compute what a study.toml asks for, a grid, other cases or a front; returns the exit status."""
    study = read_study(file)
    outputs.check([file, study.drive, study.tuning])
    if study.sensitivity is not None:
        return run_sensitivity(study, outputs, quiet, computing)
    if study.pareto is None:
        return run_cases(study, outputs, quiet, computing)
    require(computing == Computing(), f"{file}: a front is one search after another: it takes no option of cases")
    return run_front(study, outputs, quiet)


def run_cases(study: Study, outputs: Outputs, quiet: bool, computing: Computing) -> int:
    """Certify a loop over a grid or other cases; returns the exit status."""
    file, count = study.path, len(study.axes)
    many = f"{file}: --plot draws one or two axes, there are {count}; leave it out"
    require(outputs.plot is None or count <= MAX_MAP_AXES, many)
    _, task, parameters = read_fit_and_tuning(study.drive, study.tuning)
    warn_of_status(study.tuning)
    (cases, axes), units = _read_cases(study, task, parameters), metric_units(task.loop)
    if any(SAMPLE_TIME_AXIS in values for values in cases.values()):
        parameters = with_sample_time(task.loop, parameters)
    check_names("metric", study.show, units, f"{file}: [metrics] show")
    column_units = partial(_column_unit, {axis.name: parameters[axis.name].unit for axis in axes}, task.loop)
    heads = partial(_cell_heading, column_units)
    with keep_cases(study, outputs, len(cases), computing.resume, heads) as journal, computing.open() as executor:
        table, checks = _compute_cases(study, task, parameters, (cases, axes), quiet, journal, executor)
    verdict, status = _grid_verdict(table, len(task.references))
    if checks is not None:
        verdict, status = _batch_verdict(checks, verdict, status)
    seen = _worst_of_references(table, axes, study.show, parameters)
    written, metrics = {axis.name: axis.unit for axis in axes}, {name: units[name] for name in study.show}
    breaks = table["case"][table["breaks"]] if study.tune else ()
    flags = tuple(Line(f"{case}: breaks with its neighbours, also searched from their gains") for case in breaks)
    report = lead_report(verdict, status) + report_cases(seen, written, metrics) + Report(flags)
    if checks is not None:
        report += report_checks(checks)
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = table_writer(outputs.output, table, {str(c): column_units(str(c)) for c in table})
    tables = {"verdict": verdict, "cases": records(table), "provenance": file_hashes(file, study.drive, study.tuning)}
    tables |= {} if checks is None else {"checks": records(checks)}
    stopped = Status(Code.INTERRUPTED, (verdict,)) if status == EXIT_INTERRUPTED else None
    drawn = partial(plot_distribution, seen, metrics) if study.cases else partial(plot_map, seen, written, metrics)
    page = partial(case_page, study, report, drawn, written, metrics, (task.loop, parameters))
    finish(outputs, writers, tables, stopped, figures=lambda: {"": drawn()}, report=report, page=page)
    if journal is not None and stopped is None:
        journal.delete()
    return status


def _compute_cases(
    study: Study,
    task: Tuning,
    parameters: ParameterSet,
    given: tuple[Cases, Sequence[SweptAxis]],
    quiet: bool,
    journal: Journal | None,
    executor: Executor | Processes,
) -> "tuple[pd.DataFrame, pd.DataFrame | None]":
    """A row a case; and of a batch the certificates of some of them."""
    cases, axes = given
    if study.tune:
        return _tune_cells(study, task, parameters, axes, quiet, journal, executor), None
    band = study.band or task.specification.band
    if study.batch:
        left = [n for n in study.show if n not in LANE_METRICS]
        remedy = "leave it out, or leave out [study] batch"
        require(not left, f"{study.path}: [metrics] show: {', '.join(left)} is not read off responses; {remedy}")
        alike = SAMPLE_TIME_AXIS not in parameters
        require(alike, f"{study.path}: [study] a batch has one sample time: leave out batch, or {SAMPLE_TIME_AXIS}")
        with progress("running", quiet=quiet) as report_progress:
            found = evaluate_batch(
                task.loop,
                task.references,
                parameters,
                cases,
                metrics=study.show,
                band=band,
                executor=executor,
                progress=report_progress,
                journal=journal,
            )
        return found.table, found.checks
    certify = partial(evaluate_at_sample_time, task.loop, task.references, band=band, max_steps=task.max_steps)
    with progress("certifying", quiet=quiet) as report_progress:
        table = sweep(certify, parameters, cases, executor=executor, progress=report_progress, journal=journal)
    return table, None


def _read_cases(study: Study, task: Tuning, parameters: ParameterSet) -> tuple[Cases, tuple[SweptAxis, ...]]:
    """The cases of a study, and the parameters in which they differ; a sample time can be named, but not spread."""
    if SAMPLE_TIME_AXIS in study.axes or ("table" in study.cases and task.loop.pid.sample_time is not None):
        parameters = with_sample_time(task.loop, parameters)
    if study.cases:
        cases = read_study_cases(study, parameters)
        return cases, swept_axes(parameters, cases)
    axes = read_axes(study, parameters)
    try:
        return grid(parameters, {axis.name: axis.points for axis in axes}), axes
    except InputError as error:
        raise InputError(f"{study.path}: [axes] {error}") from None


def _tune_cells(
    study: Study,
    task: Tuning,
    parameters: ParameterSet,
    axes: Sequence[SweptAxis],
    quiet: bool,
    journal: Journal | None,
    executor: Executor | Processes,
) -> "pd.DataFrame":
    """Tune every cell of the grid, each from the gains of its neighbours: a row a cell, with metrics and gains."""
    require(bool(task.specification.weights), f"{study.tuning}: has nothing to minimise; add [minimise]")
    free = task.parameters.free_names
    require(len(free) > 0, f"{study.tuning}: no gain is free; mark what to tune with free = true")
    points = {axis.name: axis.points for axis in axes}
    with progress("tuning", quiet=quiet) as report_progress, read_once() as sources:
        table = sweep_from_neighbours(
            partial(tune_cell, sources, study.drive, study.tuning),
            parameters,
            points,
            value=OBJECTIVE,
            starts={f"{FOUND} {n}": n for n in free},
            executor=executor,
            progress=report_progress,
            journal=journal,
        )
    return table.rename(columns={f"{FOUND} {n}": n for n in free})


def tune_cell(sources: Mapping[str, bytes], drive: Path, tuning: Path, parameters: ParameterSet) -> dict[str, float]:
    """One cell of a study: the certified metrics of the gains tuned for it, the objective and the gains.

    The files are those that the study has read: in another process they may have moved.

    Raises
    ------
    ConvergenceError
        If no design is certified.
    """
    with read_once(sources):
        task = read_tuning(tuning, read_drive(drive)[0].system(), parameters)
    loop, own = loop_at_sample_time(task.loop, parameters)
    result = tune(
        loop,
        task.references,
        own,
        minimise=task.specification,
        scenarios=task.scenarios(own),
        accept=task.accept,
        plants={},
        max_steps=task.max_steps,
        method=task.method,
    )
    metrics = {
        f"{row}[{case}]": float(value) for case, column in result.certified.items() for row, value in column.items()
    }
    found = {f"{FOUND} {n}": result.parameters.value(n) for n in result.parameters.free_names}
    return metrics | {OBJECTIVE: certified_objective(task.specification, result)} | found


def _grid_verdict(table: "pd.DataFrame", references: int) -> tuple[str, int]:
    """How many cases are certified, fail, never settle or break with their neighbours, and the exit status."""
    settling = table[[c for c in table if _metric_name(c) == "SettlingTime"]]
    good = table["error"] == ""
    counts = {
        "interrupted": int((table["error"] == INTERRUPTED_CASE).sum()),
        "failed": int((~good & (table["error"] != INTERRUPTED_CASE)).sum()),
        "never settle": int((good & settling.isna().any(axis=1)).sum()),
        "break with their neighbours": int((good & table["breaks"]).sum()) if "breaks" in table else 0,
    }
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    status = EXIT_INTERRUPTED if counts["interrupted"] else EXIT_FAILURE if parts else EXIT_SUCCESS
    each = f", each the worst of {references} references" if references > 1 else ""
    return f"{len(table)} cases{each}: {', '.join(parts) or 'all settle'}", status


def _batch_verdict(checks: "pd.DataFrame", verdict: str, status: int) -> tuple[str, int]:
    """The verdict on a grid with how many of its cases are certified; where lanes are refuted, that is a failure."""
    differ, certified = checks["case"][~checks["agrees"]].nunique(), checks["case"].nunique()
    said = f"{differ} of {certified} certified differ from the lanes" if differ else f"{certified} certified, all agree"
    return f"{verdict}; {said}", max(status, EXIT_FAILURE) if differ else status


def _worst_of_references(
    table: "pd.DataFrame", axes: Sequence[SweptAxis], metrics: Sequence[str], nominal: ParameterSet
) -> "pd.DataFrame":
    """The table that is shown: the axes in the units of the file, each metric's worst over the references."""
    seen = table[["error"]].copy()
    for axis in axes:  # one that all cases leave at its nominal value has no column
        seen[axis.name] = axis.in_axis_unit(table[axis.name] if axis.name in table else nominal.value(axis.name))
    for metric in metrics:
        own = table[[c for c in table if _metric_name(c) == metric]]
        worst = own.min if larger_is_better(metric) else own.max
        seen[metric] = worst(axis=1, skipna=False) if len(own.columns) else math.nan
    return seen


def _metric_name(column: Hashable) -> str:
    """The metric's name in a column "Overshoot[0 to 0.2]", as columns are called with several references."""
    return str(column).partition("[")[0]


def _column_unit(axes: Mapping[str, str], loop: ClosedLoop, column: str) -> str:
    """The unit of a column of the table; empty for a name or a reason."""
    own = (loop.command.unit, loop.feedback.unit)
    known = {**axes, **{n: metric.shown_unit(*own) for n, metric in METRICS.items()}, "seconds": "s"}
    return known.get(_metric_name(column), "")


def _cell_heading(unit: Callable[[str], str], column: str) -> str:
    """A column of the rows that are written as they come; a gain that was found has its own name in the table."""
    name = column.removeprefix(f"{FOUND} ")
    return heading(name, unit(name))
