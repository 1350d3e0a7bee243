"""`pneuopt tune` and `pneuopt simulate`: a loop's gains, and its response."""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.cli.interruption import interruption_status
from pneuopt.cli.shared import (
    Columns,
    Outputs,
    Writers,
    add_to_stem,
    describe_status,
    file_hashes,
    finish,
    read_fit_and_tuning,
    stats_and_provenance,
    write_csv,
    write_files,
)
from pneuopt.cli.terminal import make_console, progress, show_output_files, show_report, show_sentence
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.control.loop import ClosedLoop
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.dither_verdict import judge_dither
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.expected_plants import expected_plants
from pneuopt.evaluation.report import metric_limits, relevant_units, report_metrics
from pneuopt.files.drive import read_covariance, read_drive, read_estimates
from pneuopt.files.rig import read_rig
from pneuopt.files.tuning import Tuning, write_tuned
from pneuopt.plotting import Response
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.output import check_output_paths, records
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.status import Code, ProgressCallback
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.report.fit_page import Source
from pneuopt.report.gains import report_exports
from pneuopt.report.loop_figures import simulate_responses
from pneuopt.report.page import Page
from pneuopt.report.tuning_page import LoopView, simulation_page, tuning_page
from pneuopt.tuning.report import report_tuning
from pneuopt.tuning.tune import TuningResult, tune
from pneuopt.tuning.without_dither import tune_without_dither

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console


def run_tune(fit: Path, tuning: Path, rig: Path | None, outputs: Outputs, quiet: bool) -> int:
    """Tune a loop; returns the exit status."""
    inputs = [fit, tuning, *([rig] if rig is not None else [])]
    outputs.check(inputs, "bode")
    task, parameters = read_fit_and_tuning(fit, tuning)
    remedy = 'add [minimise] with settling_time = { band = "2 %" }'
    require(bool(task.specification.weights), f"{tuning}: has nothing to minimise; {remedy}")
    require(len(task.parameters.free_names) > 0, f"{tuning}: no gain is free; mark what to tune with free = true")
    with progress("tuning", quiet=quiet) as report_progress:
        result = _tune_task(task, parameters, fit, rig, report_progress)
    result = replace(result, provenance={**result.provenance, **file_hashes(*inputs)})
    stopped = result.status.code is Code.INTERRUPTED or interruption_status() is not None
    gains: Writers = {}
    if outputs.output is not None:
        gains[outputs.output] = partial(write_tuned, source=tuning, result=result, wire=task.wire)
    saved, failures = write_files(gains, beside=stopped)  # before the search without dither, which takes as long
    console, shown = make_console(), _design_tables(result)
    was = _initial_metrics(task, parameters) if result.status.converged and result.on_rig is None else None
    show_report(console, report_tuning(result, was=was, source=f"the gains of {tuning}"))
    dither = Report()
    with suppress(KeyboardInterrupt):
        compared, dither = _compare_dither(console, task, parameters, result, quiet)
        shown |= compared
    show_output_files(console, saved)
    view = _view(task, result.parameters, parameters if result.status.converged else None)
    source = Source(f"Tuning of {fit.name} by {tuning.name}", warnings=describe_status(fit))
    place = outputs.output if result.status.converged else None
    exports = Report() if place is None else report_exports(task.loop, fit, place)
    page = partial(
        tuning_page, source, result, view, stands=f"the gains of {tuning}", was=was, dither=dither, exports=exports
    )
    tables = _tuning_tables(result) | shown | stats_and_provenance(result)
    status = finish(
        outputs, {}, tables, result.status, figures=view.figures, page=page, hints=_hints(task, fit, outputs)
    )
    if failures:
        raise failures[0]
    return status


def _hints(task: Tuning, fit: Path, outputs: Outputs) -> list[str]:
    """What to do with a design: take it to a controller, and show it."""
    told = [] if outputs.report is not None else ["with --report FILE.html: a page to hand on"]
    if outputs.output is None:
        return ["with -o tuned.toml: keeps the gains, for pneuopt export", *told]
    command = f"pneuopt export {fit} {outputs.output} --to st    (for a PLC; or --help)"
    return told if task.loop.pid.sample_time is None else [command, *told]


def _tune_task(
    task: Tuning, parameters: ParameterSet, fit: Path, rig: Path | None, report_progress: ProgressCallback
) -> TuningResult:
    """Tune what a file describes, for the plants to be expected of its fit."""
    complete, covariance = task.loop.complete(parameters), read_covariance(fit)
    return tune(
        task.loop,
        task.references,
        parameters,
        minimise=task.specification,
        scenarios=task.scenarios(parameters),
        plants=expected_plants(
            complete, covariance, estimates=read_estimates(fit), scenarios=task.validation_scenarios(parameters)
        ),
        rig=None if rig is None else read_rig(rig, read_drive(fit)[0], task.loop),
        max_steps=task.max_steps,
        accept=task.accept,
        method=task.method,
        throw=False,
        progress=report_progress,
    )


def run_simulate(fit: Path, tuning: Path, outputs: Outputs) -> int:
    """Simulate the closed loop of a tuning's file; returns the exit status."""
    outputs.check([fit, tuning], "bode")
    task, parameters = read_fit_and_tuning(fit, tuning)
    scenarios = task.scenarios(parameters)
    metrics = evaluate(
        task.loop,
        task.references,
        parameters,
        scenarios=scenarios,
        band=task.specification.band,
        envelope=task.specification.envelope,
        max_steps=task.max_steps,
    )
    writers: Writers = {}
    if outputs.output is not None:
        runs = [_as_logged(r, task.centre) for r in simulate_responses(task.loop, task.references, parameters)]
        paths = number_paths(outputs.output, len(runs))
        check_output_paths(paths, [fit, tuning])
        columns = _loop_columns(task.loop)
        writers |= {p: partial(write_csv, run=run, columns=columns) for p, run in zip(paths, runs, strict=True)}
    tables = {"certified": records(metrics.T), "provenance": file_hashes(fit, tuning)}
    view, limits = _view(task, parameters), metric_limits(task.specification.limits)
    report = report_metrics(metrics, relevant_units(task.loop), limits=limits)
    page = partial(_simulation_page, fit, tuning, task, view, parameters)
    return finish(outputs, writers, tables, None, figures=view.figures, report=report, page=page)


def _view(task: Tuning, parameters: ParameterSet, before: ParameterSet | None = None) -> LoopView:
    """What figures of a tuning's loop are drawn from."""
    complete = task.loop.complete
    earlier = None if before is None else complete(before)
    return LoopView(task.loop, task.references, complete(parameters), earlier, task.specification.band)


def _simulation_page(fit: Path, tuning: Path, task: Tuning, view: LoopView, parameters: ParameterSet) -> Page:
    """The page of a simulated loop, which looks for defects beyond the horizon, too."""
    found = certificate(
        task.loop,
        task.references,
        parameters,
        scenarios=task.scenarios(parameters),
        band=task.specification.band,
        envelope=task.specification.envelope,
    )
    source = Source(f"Simulation of {fit.name} with {tuning.name}", file_hashes(fit, tuning), describe_status(fit))
    return simulation_page(source, found, view, metric_limits(task.specification.limits))


def _design_tables(result: TuningResult) -> dict[str, Any]:
    """The tables of a design's certificate and of the plants that it was tried on."""
    if not result.status.converged:
        return {}
    notes = {} if result.certificate is None else {"notes": list(result.certificate.notes)}
    return notes | ({} if result.validation is None else {"validation": records(result.validation.figures)})


def _compare_dither(
    console: "Console", task: Tuning, before: ParameterSet, result: TuningResult, quiet: bool
) -> tuple[dict[str, Any], Report]:
    """Show whether a certified design's dither is worth its price; returns the table of that, and what was shown.

    An interrupted command computes nothing more.
    """
    nothing = dict[str, Any](), Report()
    if not result.status.converged or interruption_status() is not None:
        return nothing
    if task.loop.dither_period(result.parameters) is not None:
        rival = tune_rival(console, task, before, quiet)
        if interruption_status() is not None:
            return nothing
        return _show_dither_verdict(console, task, result.parameters, rival)
    if DITHER_AMPLITUDE in result.parameters.free_names:
        useless = Report((Line("the dither's amplitude is 0: the tuning found no use for it"),))
        show_report(console, useless)
        return {}, useless
    return nothing


def tune_rival(console: "Console", task: Tuning, parameters: ParameterSet, quiet: bool) -> ParameterSet | None:
    """Values tuned without dither, with which the dither is compared; None, and said, where there are none."""
    if not set(parameters.free_names) - {DITHER_AMPLITUDE, DITHER_FREQUENCY}:
        return None
    try:
        with progress("tuning without dither", quiet=quiet) as report_progress:
            rival = tune_without_dither(
                task.loop,
                task.references,
                parameters,
                minimise=task.specification,
                scenarios=task.scenarios(parameters),
                max_steps=task.max_steps,
                accept=task.accept,
                method=task.method,
                throw=False,
                progress=report_progress,
            )
    except InputError as error:  # an encoder's counts may hide the band from a loop without dither
        refused = str(error)
    else:
        if rival.status.converged:
            return rival.parameters
        refused = rival.status.sentences[0]
    show_sentence(console, f"no gains were certified without dither: {refused}")
    return None


def _show_dither_verdict(
    console: "Console", task: Tuning, parameters: ParameterSet, rival: ParameterSet | None
) -> tuple[dict[str, Any], Report]:
    """Show the dither's verdict; returns no table where the loop cannot be simulated without dither."""
    try:
        verdict = judge_dither(task.loop, task.references, parameters, without=rival, band=task.specification.band)
    except ConvergenceError as error:
        unknown = Report((Line(f"no verdict on the dither: {error}"),))
        show_report(console, unknown)
        return {}, unknown
    show_report(console, verdict.summary())
    gains = None if rival is None else {n: rival.value(n) for n in rival.free_names}
    found = {"usefulness": verdict.usefulness.value, "reasons": list(verdict.reasons), "rival": gains}
    return {"dither": found}, verdict.summary()


def _initial_metrics(task: Tuning, parameters: ParameterSet) -> "pd.DataFrame | None":
    """The metrics with the gains as given; None where that loop cannot be simulated, or no time is left for it."""
    if interruption_status() is not None:
        return None
    try:
        return evaluate(
            task.loop,
            task.references,
            parameters,
            scenarios=task.scenarios(parameters),
            band=task.specification.band,
            envelope=task.specification.envelope,
            max_steps=task.max_steps,
        )
    except (ConvergenceError, InputError, KeyboardInterrupt):
        return None


def number_paths(path: Path, count: int) -> list[Path]:
    """One file a run: run.csv, or run_1.csv, run_2.csv."""
    return [path] if count == 1 else [add_to_stem(path, str(k)) for k in range(1, count + 1)]


def _loop_columns(loop: ClosedLoop) -> Columns:
    """Columns of a response as a log names them, so that it can be read as one."""
    measured, command = loop.feedback, loop.command
    columns = {"reference": (f"{measured.name}_reference", measured.unit)}
    columns |= {q.name: (q.name, q.unit) for q in loop.plant.outputs}
    return columns | {"control": (command.name, command.unit)}


def _as_logged(response: Response, centre: float) -> Trajectory:
    """The response with its reference, and with the command that is on the wire."""
    run, reference = response.run, response.reference
    return run.with_columns({"reference": reference.values(run.t), "control": run["control"] + centre})


def _tuning_tables(result: TuningResult) -> dict[str, Any]:
    gains = result.parameters.select(result.parameters.free_names).to_frame()
    tables = {"gains": gains, "claimed": result.claimed.T, "certified": result.certified.T}
    tables |= {"requirements": result.requirements, "relaxations": result.relaxations}
    return {name: records(table) for name, table in tables.items()} | {"active": result.active}
