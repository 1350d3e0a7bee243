"""What each command does: read, compute, show, and only then write."""

import hashlib
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.certify import evaluate, respond
from pneuopt.console import (
    SMALLEST_IS_WORST,
    metric_units,
    progress,
    screen,
    show_cases,
    show_estimates,
    show_fit,
    show_gains,
    show_metrics,
    show_rejected,
    show_status,
    show_written,
)
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.errors import ConvergenceError, InputError, check_known, require
from pneuopt.experiments import Experiment, read_log, split
from pneuopt.files import read_drive, read_status, write_fit
from pneuopt.identify import IdentificationResult, identify, predict, validate
from pneuopt.nlp.least_squares import LeastSquares
from pneuopt.nlp.status import Code, Status
from pneuopt.output import check_outputs, records, write_json, write_text
from pneuopt.parameters import ParameterSet
from pneuopt.plotting import (
    Response,
    check_figure_path,
    has_friction_map,
    plot_bode,
    plot_fit,
    plot_friction,
    plot_map,
    plot_prediction,
    plot_steps,
    save_figure,
)
from pneuopt.requirements import SettlingTime
from pneuopt.study import INTERRUPTED as CUT_SHORT
from pneuopt.study import grid, sweep
from pneuopt.studyfile import Axis, read_axes, read_study
from pneuopt.system import System
from pneuopt.trajectories import Trajectory
from pneuopt.tune import TuningResult, tune
from pneuopt.tuningfile import Tuning, read_tuning, write_tuned

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

GOOD, NOT_GOOD, INTERRUPTED = 0, 1, 130
Columns = Mapping[str, tuple[str, str]]
Writers = dict[Path, Callable[[], None]]


@dataclass(frozen=True)
class Outputs:
    """The files that are wanted; `check` refuses early those that could not be written.

    Attributes
    ----------
    output, json, plot : Path or None
    """

    output: Path | None
    json: Path | None
    plot: Path | None

    def check(self, inputs: Sequence[Path], second: str = "") -> None:
        """Raise `InputError` for a file that cannot be written, or is an input; `second` names a second figure."""
        figures: list[Path] = []
        if self.plot is not None:
            check_figure_path(self.plot)
            figures = [self.plot, *([_beside(self.plot, second)] if second else [])]
        check_outputs([self.output, self.json, *figures], inputs)


def run_identify(drive: Path, logs: Sequence[Path], outputs: Outputs, window: float | None, quiet: bool) -> int:
    """Identify from logs; returns the exit status."""
    outputs.check([drive, *logs, *(log.with_suffix(".toml") for log in logs)], "friction")
    model, parameters = read_drive(drive)
    system = model.system()
    remedy = 'mark what to identify, as in coulomb = { value = "40 N", free = true }'
    require(len(parameters.free_names) > 0, f"{drive}: no parameter is free; {remedy}")
    experiments = _experiments(logs, window)
    with progress("identifying", quiet=quiet) as tell:
        result = identify(system, experiments, parameters, method=LeastSquares(progress=tell), throw=False)
    console = screen()
    show_status(console, result.status)
    show_estimates(console, result.estimates)
    show_fit(console, result.fit)
    tables = {"estimates": records(result.estimates), "fit": records(result.fit)}
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = partial(write_fit, outputs.output, drive, result)
    if outputs.plot is not None:
        writers |= _figures(outputs.plot, _fit_figures(system, result, experiments))
    return _finish(outputs, writers, tables | _background(result), result.status)


def run_tune(fit: Path, tuning: Path, outputs: Outputs, quiet: bool) -> int:
    """Tune a loop; returns the exit status."""
    outputs.check([fit, tuning], "bode")
    asked, parameters = _read_loop(fit, tuning)
    remedy = 'add [minimise] with settling_time = { band = "2 %" }'
    require(bool(asked.minimise), f"{tuning}: says nothing to minimise; {remedy}")
    require(len(asked.parameters.free_names) > 0, f"{tuning}: no gain is free; mark what to tune with free = true")
    with progress("tuning", quiet=quiet) as tell:
        result = tune(
            asked.loop,
            asked.references,
            parameters,
            minimise=asked.minimise,
            subject_to=asked.subject_to,
            throw=False,
            progress=tell,
        )
    result = replace(result, provenance={**result.provenance, **_hashes(fit, tuning)})
    console = screen()
    show_status(console, result.status)
    if result.status.converged:
        show_gains(console, parameters, result.parameters)
        show_metrics(console, result.certified, asked.loop, before=_before(asked, parameters), limits=asked.subject_to)
    else:
        show_rejected(console, tuning, result.stats, parameters)
        show_metrics(console, result.certified, asked.loop, title="rejected", limits=asked.subject_to)
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = partial(write_tuned, outputs.output, tuning, result)
    if outputs.plot is not None:
        before_gains = parameters if result.status.converged else None
        writers |= _figures(outputs.plot, _loop_figures(asked, result.parameters, before_gains))
    return _finish(outputs, writers, _tuning_tables(result) | _background(result), result.status)


def run_simulate(fit: Path, tuning: Path, outputs: Outputs) -> int:
    """Simulate the closed loop of a tuning's file; returns the exit status."""
    outputs.check([fit, tuning], "bode")
    asked, parameters = _read_loop(fit, tuning)
    metrics = evaluate(asked.loop, asked.references, parameters, band=_band(asked))
    show_metrics(screen(), metrics, asked.loop, limits=asked.subject_to)
    writers: Writers = {}
    if outputs.output is not None:
        runs = [_with_reference(r) for r in _responses(asked, parameters)]
        paths = _numbered(outputs.output, len(runs))
        check_outputs(paths, [fit, tuning])
        columns = _loop_columns(asked.loop)
        writers |= {p: partial(_write_csv, p, run, columns) for p, run in zip(paths, runs, strict=True)}
    if outputs.plot is not None:
        writers |= _figures(outputs.plot, _loop_figures(asked, parameters, None))
    tables = {"certified": records(metrics.T), "provenance": _hashes(fit, tuning)}
    return _finish(outputs, writers, tables, None)


def run_predict(fit: Path, log: Path, outputs: Outputs) -> int:
    """Predict a log in open loop; returns the exit status."""
    outputs.check([fit, log, log.with_suffix(".toml")])
    model, parameters = read_drive(fit)
    system, experiment = model.system(), read_log(log)
    _warn_of(fit)
    table = validate(system, [experiment], parameters)
    show_fit(screen(), table)
    writers: Writers = {}
    if outputs.output is not None or outputs.plot is not None:
        run = predict(system, experiment, parameters)
        if outputs.plot is not None:
            writers |= _figures(outputs.plot, {"": plot_prediction([run], [experiment], label="predicted")})
        if outputs.output is not None:
            given = {q.name: experiment.trajectory[q.name] for q in system.inputs}
            columns = {q.name: (q.name, q.unit) for q in (*system.inputs, *system.outputs)}
            writers[outputs.output] = partial(_write_csv, outputs.output, run.with_columns(given), columns)
    return _finish(outputs, writers, {"fit": records(table), "provenance": _hashes(fit, log)}, None)


def run_study(file: Path, outputs: Outputs, quiet: bool) -> int:
    """Certify a loop over a grid of parameters; returns the exit status."""
    study = read_study(file)
    outputs.check([file, study.drive, study.tuning])
    count = len(study.axes)
    require(
        outputs.plot is None or count <= 2, f"{file}: --plot draws one or two axes, there are {count}; leave it out"
    )
    asked, parameters = _read_loop(study.drive, study.tuning)
    _warn_of(study.tuning, "tuning")
    axes, units = read_axes(study, parameters), metric_units(asked.loop)
    check_known("metric", study.show, units, f"{file}: [metrics] show")
    try:
        cases = grid(parameters, {axis.name: axis.points for axis in axes})
    except InputError as error:
        raise InputError(f"{file}: [axes] {error}") from None
    certify = partial(evaluate, asked.loop, asked.references, band=study.band or _band(asked))
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
        writers |= _figures(outputs.plot, {"": plot_map(seen, written, metrics)})
    tables = {"verdict": verdict, "cases": records(table), "provenance": _hashes(file, study.drive, study.tuning)}
    _finish(outputs, writers, tables, None)
    return status


def _finish(outputs: Outputs, writers: Writers, tables: Mapping[str, Any], status: Status | None) -> int:
    """Write everything, now that everything is computed."""
    ended = {"status": {"code": status.code.value, "message": status.message}} if status else {}
    if outputs.json is not None:
        writers = {**writers, outputs.json: partial(write_json, outputs.json, {**ended, **tables})}
    for write in writers.values():
        write()
    show_written(screen(), list(writers))
    if status is None or status.converged:
        return GOOD
    return INTERRUPTED if status.code is Code.INTERRUPTED else NOT_GOOD


def _experiments(logs: Sequence[Path], window: float | None) -> list[Experiment]:
    experiments = [read_log(path) for path in logs]
    if window is None:
        return experiments
    require(window > 0, f"--window must be positive, got {window:g} s")
    return [part for e in experiments for part in split(e, window)]


def _read_loop(fit: Path, tuning: Path) -> tuple[Tuning, ParameterSet]:
    """The loop, and all its numbers; of the plant nothing is free."""
    model, plant = read_drive(fit)
    asked = read_tuning(tuning, model.system())
    _warn_of(fit)
    return asked, plant.fixed(*plant.free_names) | asked.parameters


def _warn_of(path: Path, what: str = "fit") -> None:
    status = read_status(path)
    if status is not None and not status.converged:
        warn(f"{path}: its {what} is {status}")


def warn(message: str) -> None:
    """Say on standard error what does not stop the command."""
    screen(error=True).print(f"warning: {message}", soft_wrap=True)


def _band(asked: Tuning) -> float:
    """The settling band that the requirements name; 2 % otherwise."""
    requirements = (*asked.minimise, *asked.subject_to)
    return next((q.band for q in requirements if isinstance(q, SettlingTime)), 0.02)


def _before(asked: Tuning, parameters: ParameterSet) -> "pd.DataFrame | None":
    """The metrics with the gains as given; None where that loop cannot be simulated."""
    try:
        return evaluate(asked.loop, asked.references, parameters, band=_band(asked))
    except (ConvergenceError, InputError):
        return None


def _responses(asked: Tuning, parameters: ParameterSet, before: ParameterSet | None = None) -> list[Response]:
    loop, units = asked.loop, (asked.loop.feedback.unit, asked.loop.command.unit)
    found = []
    for reference in asked.references:
        run = respond(loop, reference, parameters)
        earlier = None if before is None else _response_before(loop, reference, before)
        found.append(Response(run, reference, loop.feedback.name, units, earlier, loop.dither_period(parameters)))
    return found


def _response_before(loop: ClosedLoop, reference: Step, parameters: ParameterSet) -> Trajectory | None:
    try:
        return respond(loop, reference, parameters)
    except (ConvergenceError, InputError):
        return None


def _fit_figures(
    system: System, result: IdentificationResult, experiments: Sequence[Experiment]
) -> dict[str, "Figure"]:
    figures = {"": plot_fit(result, experiments)}
    if has_friction_map(system):
        figures["friction"] = plot_friction(system, result, experiments)
    return figures


def _loop_figures(asked: Tuning, parameters: ParameterSet, before: ParameterSet | None) -> dict[str, "Figure"]:
    """The steps, and the Bode plot about the state in which the first one ends."""
    responses = _responses(asked, parameters, before)
    loop, run = asked.loop, responses[0].run
    x = np.array([run[q.name][-1] for q in loop.plant.states])
    open_loop = loop.open_loop(parameters, x, {loop.command.name: float(run["control"][-1])})
    return {"": plot_steps(responses, band=_band(asked)), "bode": plot_bode(open_loop)}


def _figures(path: Path, figures: Mapping[str, "Figure"]) -> Writers:
    places = {name: _beside(path, name) if name else path for name in figures}
    return {places[name]: partial(save_figure, figure, places[name]) for name, figure in figures.items()}


def _beside(path: Path, name: str) -> Path:
    return path.with_stem(f"{path.stem}_{name}")


def _numbered(path: Path, count: int) -> list[Path]:
    """One file a run: run.csv, or run_1.csv, run_2.csv."""
    return [path] if count == 1 else [_beside(path, str(k)) for k in range(1, count + 1)]


def _loop_columns(loop: ClosedLoop) -> Columns:
    """Columns of a response as a log names them, so that it can be read as one."""
    measured, command = loop.feedback, loop.command
    columns = {"reference": (f"{measured.name}_reference", measured.unit)}
    columns |= {q.name: (q.name, q.unit) for q in loop.plant.outputs}
    return columns | {"control": (command.name, command.unit)}


def _with_reference(response: Response) -> Trajectory:
    run, reference = response.run, response.reference
    return run.with_columns({"reference": np.where(run.t >= reference.at, reference.final, reference.initial)})


def _write_csv(path: Path, run: Trajectory, columns: Columns) -> None:
    header = ",".join(["time [s]", *(f"{name} [{unit}]" for name, unit in columns.values())])
    values = np.column_stack([run.t, run.matrix(columns)])
    rows = [",".join("" if math.isnan(v) else f"{v:.9g}" for v in row) for row in values.tolist()]
    write_text(path, "\n".join([header, *rows]) + "\n")


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


def _tuning_tables(result: TuningResult) -> dict[str, Any]:
    gains = result.parameters.select(result.parameters.free_names).to_frame()
    tables = {"gains": gains, "claimed": result.claimed.T, "certified": result.certified.T}
    return {name: records(table) for name, table in tables.items()} | {"active": result.active}


def _background(result: IdentificationResult | TuningResult) -> dict[str, Any]:
    return {"stats": result.stats, "provenance": result.provenance}


def _hashes(*paths: Path) -> dict[str, str]:
    return {f"sha256[{path.name}]": hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
