"""`pneuopt study`: a loop over a grid or other cases, a front between two requirements, or which tolerances matter."""

import math
import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import (
    Outputs,
    add_to_stem,
    describe_status,
    file_hashes,
    finish,
    progress,
    read_fit_and_tuning,
    warn,
    warn_of_status,
)
from pneuopt.evaluation.evaluate import evaluate, metric_cell, metric_units
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import (
    METRICS,
    SettlingTime,
    StepEnvelope,
    larger_is_better,
    metric_name,
    upper_limit,
    user_limit,
    with_user_limit,
)
from pneuopt.evaluation.scenarios import axis_labels
from pneuopt.files.drive import StoredFit
from pneuopt.files.loop import REQUIREMENTS_BY_KEY, bound_units
from pneuopt.files.study import (
    Cases,
    Pareto,
    Study,
    SweptAxis,
    read_axes,
    read_pareto,
    read_sensitivity,
    read_study,
    read_study_cases,
    swept_axes,
)
from pneuopt.files.toml import construct_at
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.models.declaration import Drive
from pneuopt.plotting import plot_distribution, plot_front, plot_map, plot_sensitivity
from pneuopt.plotting.canvas import STYLE
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.output import format_table, read_once, records, write_bytes, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Column, Line, Report, Table, Tone, format_number
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import write_value
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import Page
from pneuopt.report.tuning_page import study_page
from pneuopt.studies.batch import LANE_METRICS, evaluate_batch
from pneuopt.studies.executors import INTERRUPTED_CASE, Processes, open_executor
from pneuopt.studies.journal import PARQUET, Journal, RowFile, parquet_bytes
from pneuopt.studies.sensitivity import (
    local_sensitivity,
    sensitivity,
    sweep_from_neighbours,
)
from pneuopt.studies.sweep import (
    SAMPLE_TIME_AXIS,
    evaluate_at_sample_time,
    grid,
    loop_at_sample_time,
    sweep,
    with_sample_time,
)
from pneuopt.tuning.front import pareto_front
from pneuopt.tuning.search import certified_objective
from pneuopt.tuning.tune import tune

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.plotting.canvas import Figure


# columns of a study that tunes: its objective, and the word before the name of a gain that was found
OBJECTIVE, FOUND = "objective", "found"


SO_FAR = "so_far"
"""What the name of the file ends in that shows the rows of a study that runs."""


@dataclass(frozen=True)
class Computing:
    """How the cases of a study are computed."""

    executor: str = ""  # as for `open_executor`; empty: one process a CPU
    seconds: float = math.inf  # what a case may take
    megabytes: float = math.inf
    resume: bool = False  # whether there must be a journal of this study

    @contextmanager
    def open(self) -> Iterator[Executor | Processes]:
        """Open the executor."""
        limits = Processes(None, self.seconds, self.megabytes)
        if not self.executor:
            yield limits
            return
        here = self.executor.isdecimal() or limits == Processes()
        require(here, f"--time-limit and --memory-limit hold in processes of this machine, not on {self.executor}")
        with open_executor(self.executor) as executor:
            yield replace(limits, count=executor.count) if isinstance(executor, Processes) else executor


@dataclass(frozen=True, eq=False)
class _Job:
    """A study and what its files hold, read once; the parameters are those of plant and controller."""

    study: Study
    fit: StoredFit
    task: Tuning
    parameters: ParameterSet
    outputs: Outputs
    quiet: bool

    def finish(
        self,
        verdict: str,
        status: int,
        report: Report,
        tables: Mapping[str, Any],
        written: "tuple[pd.DataFrame, Mapping[str, str]]",
        draw: Callable[[], "Figure"],
        page: tuple[str, str],
        *,
        is_drawn: bool = True,
        has_design: bool = True,
    ) -> int:
        """Show and write what was found, the table with its units, and a page with its heading and the figure's words.

        The page shows the figure if `is_drawn`, and the controller if all cases share it; returns the exit status.
        """
        study, output = self.study, self.outputs.output
        report = Report((Line(verdict, Tone.BAD if status else Tone.GOOD),)) + report
        hashes = file_hashes(study.path, study.drive, study.tuning)

        def make_page() -> Page:
            warnings = (*describe_status(self.fit), *describe_status(study.tuning))
            head = PageHead(f"Study of {study.drive.name} with {study.tuning.name}", hashes, warnings)
            design = (self.task.loop, self.parameters) if has_design else None
            return study_page(head, report, draw if is_drawn else None, what=page[0], alt=page[1], design=design)

        finish(
            self.outputs,
            {} if output is None else {output: table_writer(output, *written)},
            {"verdict": verdict, **tables, "provenance": hashes},
            Status(Code.INTERRUPTED, (verdict,)) if status == ExitStatus.INTERRUPTED else None,
            figures=lambda: {"": draw()},
            report=report,
            page=make_page,
        )
        return status


def run_study(file: Path, outputs: Outputs, quiet: bool, computing: Computing) -> int:
    """Compute what a study.toml asks for, a grid, other cases or a front; returns the exit status."""
    study = read_study(file)
    outputs.check([file, study.drive, study.tuning])
    count = len(study.axes)
    many = f"{file}: --plot draws one or two axes, there are {count}; leave it out"
    require(outputs.plot is None or count <= STYLE.map_axes, many)
    plain = study.pareto is None or computing == Computing()
    require(plain, f"{file}: a front is one search after another: it takes no option of cases")
    job = _Job(study, *read_fit_and_tuning(study.drive, study.tuning), outputs, quiet)
    warn_of_status(study.tuning)
    if study.pareto is not None:
        return run_front(job)
    return run_cases(job, computing) if study.sensitivity is None else run_sensitivity(job, computing)


@contextmanager
def keep_cases(
    study: Study, outputs: Outputs, count: int, resume: bool, heading: Callable[[str], str] = str
) -> Iterator[Journal | None]:
    """Keep the cases as they come, beside the file that is asked for; for people to read with these headings."""
    place = outputs.output or outputs.json
    if place is None:
        require(not resume, "--resume goes on where the file of -o or --json was left: name it")
        yield None
        return
    hashes = file_hashes(study.path, study.drive, study.tuning)
    rows = None if outputs.output is None else RowFile(add_to_stem(outputs.output, SO_FAR), heading)
    journal = Journal(place.with_name(f"{place.name}.journal"), hashes, resume=resume, rows=rows)
    if journal.known:
        warn(f"{journal.path}: {len(journal.known)} of {count} cases are known from an earlier run of this study")
    try:
        yield journal
    finally:
        journal.close(finished=False)
        for problem in (journal.problem, rows.problem if rows else ""):
            if problem:
                warn(problem)


def run_cases(job: _Job, computing: Computing) -> int:
    """Certify a loop over a grid or other cases; returns the exit status."""
    study, task, parameters = job.study, job.task, job.parameters
    (cases, axes), units = _read_cases(job), metric_units(task.loop)
    if any(SAMPLE_TIME_AXIS in values for values in cases.values()):
        parameters = with_sample_time(task.loop, parameters)
        job = replace(job, parameters=parameters)
    check_names("metric", study.show, units, f"{study.path}: [metrics] show")
    metric_unit = {n: m.shown_unit(task.loop.command.unit, task.loop.feedback.unit) for n, m in METRICS.items()}
    column_units = {axis.name: parameters[axis.name].unit for axis in axes} | metric_unit | {"seconds": "s"}

    def heads(column: str) -> str:  # a gain that was found has its own name in the table
        name = column.removeprefix(f"{FOUND} ")
        return heading(name, column_units.get(_metric_name(name), ""))

    with keep_cases(study, job.outputs, len(cases), computing.resume, heads) as journal, computing.open() as executor:
        table, checks = _compute_cases(job, (cases, axes), journal, executor)
    verdict, status = _grid_verdict(table, len(task.references), checks)
    seen = _worst_of_references(table, axes, study.show, parameters)
    written, metrics = {axis.name: axis.unit for axis in axes}, {name: units[name] for name in study.show}
    breaks = table["case"][table["breaks"]] if study.tune else ()
    flags = tuple(Line(f"{case}: breaks with its neighbours, also searched from their gains") for case in breaks)
    report, tables = report_cases(seen, written, metrics) + Report(flags), {"cases": records(table)}
    if checks is not None:
        report, tables = report + report_checks(checks), tables | {"checks": records(checks)}
    alt = f"{', '.join(metrics)} over {' and '.join(written)}, a cell or a point a case; what failed is marked."
    if study.cases:
        alt = f"Share of the cases that keep a bound, over the bound: {', '.join(metrics)}."
    job.finish(
        verdict,
        status,
        report,
        tables,
        (table, {str(c): column_units.get(_metric_name(c), "") for c in table}),
        partial(plot_distribution, seen, metrics) if study.cases else partial(plot_map, seen, written, metrics),
        ("Cases", alt),
        is_drawn=bool(study.cases) or len(axes) <= STYLE.map_axes,
        has_design=not study.tune,
    )
    if journal is not None and status != ExitStatus.INTERRUPTED:
        journal.delete()
    return status


def _compute_cases(
    job: _Job, given: tuple[Cases, Sequence[SweptAxis]], journal: Journal | None, executor: Executor | Processes
) -> "tuple[pd.DataFrame, pd.DataFrame | None]":
    """A row a case; and of a batch the certificates of some of them."""
    study, task, parameters, (cases, axes) = job.study, job.task, job.parameters, given
    if study.tune:
        return _tune_cells(job, axes, journal, executor), None
    band = study.band or task.specification.band
    if study.batch:
        left = [n for n in study.show if n not in LANE_METRICS]
        remedy = "leave it out, or leave out [study] batch"
        require(not left, f"{study.path}: [metrics] show: {', '.join(left)} is not read off responses; {remedy}")
        alike = SAMPLE_TIME_AXIS not in parameters
        require(alike, f"{study.path}: [study] a batch has one sample time: leave out batch, or {SAMPLE_TIME_AXIS}")
        with progress("running", quiet=job.quiet) as report_progress:
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
    with progress("certifying", quiet=job.quiet) as report_progress:
        table = sweep(certify, parameters, cases, executor=executor, progress=report_progress, journal=journal)
    return table, None


def _read_cases(job: _Job) -> tuple[Cases, tuple[SweptAxis, ...]]:
    """The cases of a study, and the parameters in which they differ; a sample time can be named, but not spread."""
    study, task, parameters = job.study, job.task, job.parameters
    if SAMPLE_TIME_AXIS in study.axes or ("table" in study.cases and task.loop.pid.sample_time is not None):
        parameters = with_sample_time(task.loop, parameters)
    if study.cases:
        cases = read_study_cases(study, job.fit, parameters)
        return cases, swept_axes(parameters, cases)
    axes = read_axes(study, parameters)
    try:
        return grid(parameters, {axis.name: axis.points for axis in axes}), axes
    except InputError as error:
        raise InputError(f"{study.path}: [axes] {error}") from None


def _tune_cells(
    job: _Job, axes: Sequence[SweptAxis], journal: Journal | None, executor: Executor | Processes
) -> "pd.DataFrame":
    """Tune every cell of the grid, each from the gains of its neighbours: a row a cell, with metrics and gains."""
    study, free = job.study, job.task.parameters.free_names
    require(bool(job.task.specification.weights), f"{study.tuning}: has nothing to minimise; add [minimise]")
    require(len(free) > 0, f"{study.tuning}: no gain is free; mark what to tune with free = true")
    points = {axis.name: axis.points for axis in axes}
    with progress("tuning", quiet=job.quiet) as report_progress, read_once() as sources:
        table = sweep_from_neighbours(
            partial(tune_cell, sources, job.fit.drive, study.tuning),
            job.parameters,
            points,
            value=OBJECTIVE,
            starts={f"{FOUND} {n}": n for n in free},
            executor=executor,
            progress=report_progress,
            journal=journal,
        )
    return table.rename(columns={f"{FOUND} {n}": n for n in free})


def tune_cell(sources: Mapping[str, bytes], drive: Drive, tuning: Path, parameters: ParameterSet) -> dict[str, float]:
    """One cell of a study: the certified metrics of the gains tuned for it, the objective and the gains.

    The tuning is what the study has read: in another process it may have moved.
    """
    with read_once(sources):
        task = read_tuning(tuning, drive.system(), parameters)
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


def _grid_verdict(table: "pd.DataFrame", references: int, checks: "pd.DataFrame | None") -> tuple[str, int]:
    """How many cases fail, never settle or break with their neighbours, and the exit status.

    Of a batch also how many of its cases are certified; where lanes are refuted, that is a failure.
    """
    settling = table[[c for c in table if _metric_name(c) == "SettlingTime"]]
    good = table["error"] == ""
    parts, status = _count_failures(
        table["error"],
        "failed",
        never_settle=int((good & settling.isna().any(axis=1)).sum()),
        break_with_their_neighbours=int((good & table["breaks"]).sum()) if "breaks" in table else 0,
    )
    each = f", each the worst of {references} references" if references > 1 else ""
    verdict = f"{len(table)} cases{each}: {', '.join(parts) or 'all settle'}"
    if checks is None:
        return verdict, status
    differ, certified = checks["case"][~checks["agrees"]].nunique(), checks["case"].nunique()
    lanes = (
        f"{differ} of {certified} certified differ from the lanes" if differ else f"{certified} certified, all agree"
    )
    return f"{verdict}; {lanes}", max(status, ExitStatus.FAILURE) if differ else status


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


def run_sensitivity(job: _Job, computing: Computing) -> int:
    """Tell which tolerances matter for a design; returns the exit status."""
    study, task, parameters = job.study, job.task, job.parameters
    asked, units = read_sensitivity(study, parameters), metric_units(task.loop)
    check_names("metric", study.show, units, f"{study.path}: [metrics] show")
    band, slopes = study.band or task.specification.band, None
    if asked.local:  # at once, as it refuses metrics without a slope
        slopes = local_sensitivity(task.loop, task.references, parameters, asked.spreads, metrics=study.show, band=band)
    labels = [step.label for step in task.references]
    count = asked.count * (len(axis_labels(parameters, asked.spreads)) + 2)
    certify = partial(evaluate, task.loop, task.references, band=band, max_steps=task.max_steps)
    with (
        keep_cases(study, job.outputs, count, computing.resume) as journal,
        computing.open() as executor,
        progress("certifying", quiet=job.quiet) as report_progress,
    ):
        found = sensitivity(
            certify,
            parameters,
            asked.spreads,
            figures=[n if len(labels) == 1 else f"{n}[{label}]" for label in labels for n in study.show],
            count=asked.count,
            seed=asked.seed,
            executor=executor,
            progress=report_progress,
            journal=journal,
        )
    parts, status = _count_failures(found.cases["error"], "failed")
    verdict = f"{len(found.cases)} points: {', '.join(parts) or 'all certified'}"
    report, table = found.summary(), found.table
    tables = {"shares": records(found.table), "figures": records(found.figures), "cases": records(found.cases)}
    if slopes is not None:
        named: dict[Hashable, str] = {"change": "local_change", "relative": "local_relative", "share": "local_share"}
        report, table = report + slopes.summary(), table.join(slopes.table).rename(columns=named)
        tables["slopes"] = records(slopes.table)
    alt = "Share of a metric's variance that each parameter brings, by itself and with others, as bars with intervals."
    written, draw = (table.reset_index(), dict[str, str]()), partial(plot_sensitivity, found, slopes)
    job.finish(verdict, status, report, tables, written, draw, ("Sensitivity", alt))
    if journal is not None and status != ExitStatus.INTERRUPTED:
        journal.delete()
    return status


def run_front(job: _Job) -> int:
    """Tune a loop along a front between two requirements; returns the exit status."""
    study, task, parameters = job.study, job.task, job.parameters
    front_spec = read_pareto(study, bound_units(task.loop))
    first, second, until = _front_requirements(study, front_spec, task)
    free = task.parameters.free_names
    require(len(free) > 0, f"{study.tuning}: no gain is free; mark what to tune with free = true")
    with progress("finding the front's ends", quiet=job.quiet) as report_progress:
        front = pareto_front(
            task.loop,
            task.references,
            parameters,
            minimise=(first, second),
            subject_to=[q for q in task.specification.limits if metric_name(q) != metric_name(second)],
            scenarios=task.scenarios(parameters),
            points=front_spec.points,
            until=until,
            max_steps=task.max_steps,
            progress=report_progress,
        )
    factors = {c: q.metric.factor for q in (first, second) for c in (metric_name(q), f"claimed {metric_name(q)}")}
    factors["limit"], known = second.metric.factor, metric_units(task.loop)
    front = front.assign(**{c: factor * front[c] for c, factor in factors.items() if factor != 1})  # as shown, in %
    pair = {metric_name(q): known[metric_name(q)] for q in (first, second)}
    gains = {n: parameters[n].unit for n in front if n in free}
    parts, status = _count_failures(front["error"], "not certified")
    one = " (one is best by both)" if len(front) == 1 and not parts else ""
    what = f"{len(front)} design{'s' if len(front) > 1 else ''} between {' and '.join(pair)}"
    verdict = f"{what}: {', '.join(parts) or 'all certified'}{one}"
    claimed = {f"claimed {n}": unit for n, unit in pair.items()}
    units = {**pair, **claimed, "limit": pair[metric_name(second)], **gains, "solver_seconds": "s", "seconds": "s"}
    tables = {"designs": records(front), "units": {**pair, **gains}}
    shown, draw = report_front(front, pair, gains), partial(plot_front, front, pair)
    alt = "{} of certified designs over {}; limits at which none was certified are marked.".format(*pair)
    page = ("Pareto front", alt)
    return job.finish(verdict, status, shown, tables, (front, units), draw, page, has_design=False)


def _front_requirements(
    study: Study, front_spec: Pareto, task: Tuning
) -> tuple[Requirement, Requirement, float | None]:
    """The two requirements, the second one bounded where the front begins, and its bound where the front ends."""
    where = f"{study.path}: [pareto]"
    given = {metric_name(q): q for q in (*task.specification.weights, *task.specification.limits)}
    pair = list[Requirement]()
    for key in front_spec.between:  # the tuning's requirement, with its bound; else one without a bound
        kind: Any = REQUIREMENTS_BY_KEY[key]
        message = f"{where} between: the tuning has no bounds for step_envelope; add them under [limits]"
        require(kind is not StepEnvelope or kind.__name__ in given, message)
        plain = partial(kind, task.specification.band) if issubclass(kind, SettlingTime) else kind
        pair.append(given[kind.__name__] if kind.__name__ in given else plain())
    first, second = pair
    ends = {"lower": front_spec.lower, "upper": front_spec.upper}
    begin, end = ("lower", "upper") if second.metric.sense is Sense.AT_LEAST else ("upper", "lower")
    start, until = ends[begin], ends[end]
    loosest = second if start is None else construct_at(lambda: with_user_limit(second, start), f"{where} {begin}")
    if until is not None:
        tightest = construct_at(lambda: with_user_limit(second, until), f"{where} {end}")
        side, unit = "below" if end == "lower" else "above", bound_units(task.loop)[front_spec.between[1]]
        ends_at, begins_at = (write_value(user_limit(q) or math.inf, unit) for q in (tightest, loosest))
        message = f"{where} {end}, {ends_at}, is not {side} the {begins_at} that {study.tuning} allows under [limits]"
        require(upper_limit(tightest) < upper_limit(loosest), message)
    return first, loosest, until


def _count_failures(errors: "pd.Series", word: str, **others: int) -> tuple[list[str], int]:
    """How many cases were interrupted and how many failed, which is called so, with other counts; the exit status."""
    interrupted = int((errors == INTERRUPTED_CASE).sum())
    counts = {"interrupted": interrupted, word: int((errors != "").sum()) - interrupted, **others}
    parts = [f"{count} {what.replace('_', ' ')}" for what, count in counts.items() if count]
    return parts, ExitStatus.INTERRUPTED if interrupted else ExitStatus.FAILURE if parts else ExitStatus.SUCCESS


def report_cases(
    table: "pd.DataFrame",
    axes: Mapping[str, str],
    metrics: Mapping[str, str],
    *,
    most_rows: int = 40,
    most_reasons: int = 5,
) -> Report:
    """A study, a row a case; of many the worst, by the first metric; then the reasons of those that failed."""
    first = next(iter(metrics))
    ordered = table.sort_values(first, ascending=larger_is_better(first), na_position="first", kind="stable")
    shown, rows = table if len(table) <= most_rows else ordered.head(most_rows), []
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
    for reason, count in list(reasons.items())[:most_reasons]:
        lines.append(f"failed ({count} of {len(table)}): {reason}")
    return Report((Table(tuple(map(Column, heads)), tuple(rows)), *map(Line, lines)))


def report_checks(checks: "pd.DataFrame", most: int = 5) -> Report:
    """The certified cases of a batch: the largest difference a metric, and the cases in which lanes are refuted."""
    rows = [(str(m), format_number(float(own["difference"].max()), 2)) for m, own in checks.groupby("metric")]
    lines = [
        Line(f"{row['case']}: {row['metric']} is {row['batch']:.6g} in the lanes, {row['certified']:.6g} certified")
        for row in checks[~checks["agrees"]].head(most).to_dict(orient="records")
    ]
    table = (
        (Table((Column("metric"), Column("largest difference\nfrom the certificate")), tuple(rows)),) if rows else ()
    )
    left = "margins, stick-slip events and what comes after the horizon are not in the lanes: leave out batch for them"
    return Report((*table, *lines, Line(left)))


def report_front(
    table: "pd.DataFrame", requirements: Mapping[str, str], gains: Mapping[str, str], *, most_gains: int = 6
) -> Report:
    """A front, a row a design, of those that are not certified the limit; then the reasons."""
    first, second = requirements
    shown = dict(list(gains.items())[:most_gains])
    relation, rows = ">=" if larger_is_better(second) else "<=", []
    for row in table.to_dict(orient="records"):
        figures = [format_number(row[n], 4) for n in (first, second)]
        if row["error"]:
            word = INTERRUPTED_CASE if row["error"] == INTERRUPTED_CASE else "failed"
            figures = [word, "-" if math.isnan(row["limit"]) else f"{relation} {format_number(row['limit'], 4)}"]
        for gain in (row[n] for n in shown):  # four digits, as gains are rounded, no exponent where it is longer: 68130
            text = format_number(gain, 4)
            figures.append(f"{float(text):.0f}" if 1e4 <= abs(gain) < 1e7 else text)
        rows.append(tuple(figures))
    names = {n: re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=\.)", "\n", n) for n in (*requirements, *shown)}  # narrow lines
    units = {**requirements, **shown}
    heads = [name if units[n] in ("", "1") else f"{name}\n[{units[n]}]" for n, name in names.items()]
    lines = [f"{len(shown)} of {len(gains)} gains; -o FILE writes all"] if len(shown) < len(gains) else []
    failed = table[~table["error"].isin(["", INTERRUPTED_CASE])].to_dict(orient="records")
    lines += [f"failed ({second} {relation} {format_number(row['limit'], 4)}): {row['error']}" for row in failed]
    return Report((Table(tuple(map(Column, heads)), tuple(rows)), *map(Line, lines)))


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
