"""`pneuopt study` with a [pareto]: a loop tuned along a front between two requirements."""

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from pneuopt.cli.exit_status import EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_SUCCESS
from pneuopt.cli.shared import (
    Outputs,
    Writers,
    file_hashes,
    finish,
    read_fit_and_tuning,
    warn_of_status,
)
from pneuopt.cli.show_studies import lead_report, report_front, table_writer
from pneuopt.cli.study_pages import front_page
from pneuopt.cli.terminal import progress
from pneuopt.evaluation.evaluate import metric_units
from pneuopt.evaluation.metric import Requirement, Sense
from pneuopt.evaluation.requirements import (
    SettlingTime,
    StepEnvelope,
    metric_name,
    upper_limit,
    user_limit,
    with_user_limit,
)
from pneuopt.files.loop import REQUIREMENTS_BY_KEY, bound_units
from pneuopt.files.study import Pareto, Study, read_pareto
from pneuopt.files.toml import construct_at
from pneuopt.files.tuning import Tuning
from pneuopt.plotting import plot_front
from pneuopt.quantities.errors import require
from pneuopt.quantities.output import records
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.units import write_value
from pneuopt.studies.outcome import INTERRUPTED_CASE
from pneuopt.tuning.pareto import pareto_front

if TYPE_CHECKING:
    import pandas as pd


def run_front(study: Study, outputs: Outputs, quiet: bool) -> int:
    """Tune a loop along a front between two requirements; returns the exit status."""
    _, task, parameters = read_fit_and_tuning(study.drive, study.tuning)
    warn_of_status(study.tuning)
    front_spec = read_pareto(study, bound_units(task.loop))
    first, second, until = _front_requirements(study, front_spec, task)
    free = task.parameters.free_names
    require(len(free) > 0, f"{study.tuning}: no gain is free; mark what to tune with free = true")
    with progress("finding the front's ends", quiet=quiet) as report_progress:
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
    front, known = _convert_to_percent(front, first, second), metric_units(task.loop)
    pair, gains = (
        {metric_name(q): known[metric_name(q)] for q in (first, second)},
        {n: parameters[n].unit for n in front if n in free},
    )
    verdict, status = _front_verdict(front, pair)
    report = lead_report(verdict, status) + report_front(front, pair, gains)
    writers: Writers = {}
    if outputs.output is not None:
        claimed = {f"claimed {n}": unit for n, unit in pair.items()}
        units = {**pair, **claimed, "limit": pair[metric_name(second)], **gains, "solver_seconds": "s", "seconds": "s"}
        writers[outputs.output] = table_writer(outputs.output, front, units)
    hashes = file_hashes(study.path, study.drive, study.tuning)
    tables = {"verdict": verdict, "designs": records(front), "units": {**pair, **gains}, "provenance": hashes}
    stopped = Status(Code.INTERRUPTED, (verdict,)) if status == EXIT_INTERRUPTED else None
    drawn = partial(plot_front, front, pair)
    page = partial(front_page, study, report, drawn, pair)
    finish(outputs, writers, tables, stopped, figures=lambda: {"": drawn()}, report=report, page=page)
    return status


def _front_requirements(
    study: Study, front_spec: Pareto, task: Tuning
) -> tuple[Requirement, Requirement, float | None]:
    """The two requirements, the second one bounded where the front begins, and its bound where the front ends."""
    where = f"{study.path}: [pareto]"
    given = {metric_name(q): q for q in (*task.specification.weights, *task.specification.limits)}
    first, second = (_find_requirement(key, given, task, f"{where} between") for key in front_spec.between)
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


def _find_requirement(key: str, given: Mapping[str, Requirement], task: Tuning, where: str) -> Requirement:
    """The requirement of the tuning, with its bound; else one without a bound."""
    kind: Any = REQUIREMENTS_BY_KEY[key]
    if kind.__name__ in given:
        return given[kind.__name__]
    require(kind is not StepEnvelope, f"{where}: the tuning has no bounds for step_envelope; add them under [limits]")
    plain: Requirement = SettlingTime(task.specification.band) if kind is SettlingTime else kind()
    return plain


def _front_verdict(front: "pd.DataFrame", pair: Mapping[str, str]) -> tuple[str, int]:
    """How many designs are not certified, and the exit status."""
    interrupted = int((front["error"] == INTERRUPTED_CASE).sum())
    failed = int((front["error"] != "").sum()) - interrupted
    parts = [f"{count} {what}" for count, what in ((interrupted, "interrupted"), (failed, "not certified")) if count]
    status = EXIT_INTERRUPTED if interrupted else EXIT_FAILURE if failed else EXIT_SUCCESS
    one = " (one is best by both)" if len(front) == 1 and not parts else ""
    what = f"{len(front)} design{'s' if len(front) > 1 else ''} between {' and '.join(pair)}"
    return f"{what}: {', '.join(parts) or 'all certified'}{one}", status


def _convert_to_percent(front: "pd.DataFrame", first: Requirement, second: Requirement) -> "pd.DataFrame":
    """The front with figures as the metrics are shown, overshoot in percent."""
    factors = {c: q.metric.factor for q in (first, second) for c in (metric_name(q), f"claimed {metric_name(q)}")}
    factors["limit"] = second.metric.factor
    return front.assign(**{c: factor * front[c] for c, factor in factors.items() if factor != 1})
