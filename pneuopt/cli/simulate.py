"""`pneuopt simulate FIT TUNING`: the response of a loop, and whether its certificate holds."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.cli.shared import (
    Outputs,
    Writers,
    describe_status,
    file_hashes,
    finish,
    number_paths,
    read_fit_and_tuning,
    write_csv,
)
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.evaluate import evaluate, metric_limits, relevant_units, report_metrics
from pneuopt.files.drive import StoredFit
from pneuopt.files.tuned import check_certificate
from pneuopt.files.tuning import Tuning
from pneuopt.quantities.output import check_output_paths, records
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Report
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import Page, simulate_responses
from pneuopt.report.tuning_page import LoopView, simulation_page

if TYPE_CHECKING:
    import pandas as pd


def run_simulate(fit: Path, tuning: Path, outputs: Outputs) -> int:
    """Simulate the closed loop of a tuning's file; returns the exit status."""
    outputs.check([fit, tuning], "bode")
    stored, task, parameters = read_fit_and_tuning(fit, tuning)
    found = check_certificate(stored, tuning)
    standing = Report() if found is None else found.report(tuning)
    metrics = task_metrics(task, parameters)
    writers: Writers = {}
    if outputs.output is not None:
        loop, runs = task.loop, list[Trajectory]()
        for found_run in simulate_responses(loop, task.references, parameters):
            run, reference = found_run.run, found_run.reference
            on_wire = run["control"] + task.centre
            runs.append(run.with_columns({"reference": reference.values(run.t), "control": on_wire}))
        paths = number_paths(outputs.output, len(runs))
        check_output_paths(paths, [fit, tuning])
        columns = {"reference": (f"{loop.feedback.name}_reference", loop.feedback.unit)}  # as a log names them
        columns |= {q.name: (q.name, q.unit) for q in loop.plant.outputs}
        columns |= {"control": (loop.command.name, loop.command.unit)}
        writers |= {p: partial(write_csv, run=run, columns=columns) for p, run in zip(paths, runs, strict=True)}
    tables = {"certified": records(metrics.T), "provenance": file_hashes(fit, tuning)}
    tables |= {} if found is None else {"certificate": {"holds": found.holds, "reasons": list(found.reasons)}}
    view, limits = loop_view(task, parameters), metric_limits(task.specification.limits)
    report = standing + report_metrics(metrics, relevant_units(task.loop), title="simulated", limits=limits)
    page = partial(_simulation_page, stored, tuning, task, view, parameters, standing)
    return finish(outputs, writers, tables, None, figures=view.figures, report=report, page=page)


def task_metrics(task: Tuning, parameters: ParameterSet) -> "pd.DataFrame":
    """The metrics of a tuning's loop with these parameters."""
    return evaluate(
        task.loop,
        task.references,
        parameters,
        scenarios=task.scenarios(parameters),
        band=task.specification.band,
        envelope=task.specification.envelope,
        max_steps=task.max_steps,
    )


def loop_view(task: Tuning, parameters: ParameterSet, before: ParameterSet | None = None) -> LoopView:
    """What figures of a tuning's loop are drawn from."""
    complete = task.loop.complete
    earlier = None if before is None else complete(before)
    return LoopView(task.loop, task.references, complete(parameters), earlier, task.specification.band)


def _simulation_page(
    fit: StoredFit, tuning: Path, task: Tuning, view: LoopView, parameters: ParameterSet, standing: Report
) -> Page:
    """The page of a simulated loop, which looks for defects beyond the horizon, too."""
    found = certificate(
        task.loop,
        task.references,
        parameters,
        scenarios=task.scenarios(parameters),
        band=task.specification.band,
        envelope=task.specification.envelope,
    )
    head = PageHead(
        f"Simulation of {fit.path.name} with {tuning.name}", file_hashes(fit.path, tuning), describe_status(fit)
    )
    return simulation_page(head, found, view, metric_limits(task.specification.limits), standing=standing)
