"""`pneuopt track` and `pneuopt next-experiment`: how parameters drift over dated logs, and which run to log next."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.cli.identify import read_experiments, read_free_drive
from pneuopt.cli.init import read_range
from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import (
    Outputs,
    Writers,
    file_hashes,
    finish,
    number_paths,
    progress,
    warn,
    warn_of_status,
    write_csv,
)
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import System
from pneuopt.experiments.design import AOptimal, DOptimal
from pneuopt.experiments.next_experiment import DesignOutlook, next_experiment, predict_loss
from pneuopt.files.drive import read_fit
from pneuopt.files.tuning import read_tuning
from pneuopt.identification.identify import identify
from pneuopt.identification.logged_loop import REFERENCE_CHANNELS
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import track
from pneuopt.logs.read_log import find_date
from pneuopt.plotting import plot_experiment, plot_tracking
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import format_table, records, write_text
from pneuopt.quantities.units import read_value
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import Picture
from pneuopt.report.tuning_page import summary_page, title_of, tracking_picture
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    from datetime import date


@dataclass(frozen=True)
class TrackOptions:
    """What `pneuopt track` is asked for."""

    tuned: Path | None  # the design whose loss is predicted
    parameters: tuple[str, ...]  # empty: all that are free
    dates: str  # one a log, with commas; empty: as the logs say
    drift: float  # for the power calculation [1/week]
    horizon: int  # logs for which the level holds


def run_track(drive: Path, logs: Sequence[Path], options: TrackOptions, outputs: Outputs, quiet: bool = False) -> int:
    """Identify each log alone, and tell whether parameters drift; status 1 if one does, or the design fails."""
    inputs = [drive, *logs, *([options.tuned] if options.tuned else [])]
    outputs.check(inputs)
    model, parameters = read_free_drive(drive)
    system = model.system()
    check_names("parameter", options.parameters, parameters.free_names, f"{drive}: --parameter")
    experiments = read_experiments(logs, system, parameters, ())
    dates: list[str | date] = [text.strip() for text in options.dates.split(",")] if options.dates else []
    given = f"--dates has {len(dates)} dates for {len(logs)} logs; give one a log"
    require(not options.dates or len(dates) == len(logs), given)
    dates = dates or [find_date(path) for path in logs]
    task = read_tuning(options.tuned, system, parameters) if options.tuned else None
    warnings.filterwarnings("ignore", message="before the search")  # each log would say it again
    with progress("identifying", quiet=quiet) as report:
        method, fits = LeastSquares(progress=report), list[IdentificationResult]()
        for log in experiments:
            own = parameters.fixed(*(n for n in log.conditions if n in parameters))
            fits.append(identify(system, [log], own, method=method, explain=False, throw=False))
            if not fits[-1].status.converged:  # it has no interval
                warn(f"{log.name}: {fits[-1].status.verdict}; it does not count")
    found = track(fits, dates, parameters=options.parameters, drift=options.drift, horizon=options.horizon)
    outlook: DesignOutlook | None = None
    if task is not None:
        own = parameters.fixed(*parameters.free_names) | task.parameters
        with progress("certifying", quiet=quiet):
            outlook = predict_loss(found, task.loop, task.references, own, task.specification)
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = partial(write_text, text=format_table(found.history.reset_index()))
    tables = {"drift": records(found.table), "history": records(found.history), "provenance": file_hashes(drive)}
    shown = found.summary()
    if outlook is not None:
        tables["design"] = records(outlook.table)
        shown += outlook.summary()
    head = PageHead(title_of("Tracking", drive, logs), file_hashes(*inputs[:1], *inputs[1 + len(logs) :]))
    page = partial(summary_page, head, shown, [tracking_picture(found)], experiments)
    finish(outputs, writers, tables, None, figures=lambda: {"": plot_tracking(found)}, report=shown, page=page)
    return ExitStatus.FAILURE if found.drifting or (outlook is not None and outlook.fails is not None) else 0


_ALT = "What is played, the signals with limits as predicted, and each parameter's interval now and afterwards."


@dataclass(frozen=True)
class PlannedOptions:
    """What a planned run may do, as the command line says it."""

    duration: str
    sample_time: str  # empty: the controller's
    targets: tuple[str, ...]
    limits: tuple[str, ...]  # "position=20 mm..180 mm"
    noise: tuple[str, ...]  # "position=20 um"
    start: tuple[str, ...]  # "position=100 mm"
    runs: int
    mean: bool  # whether the mean deviation counts (`AOptimal`), not the joint region (`DOptimal`)
    budget: float  # CPU seconds


def run_next_experiment(
    fit: Path, tuning: Path | None, options: PlannedOptions, outputs: Outputs, quiet: bool = False
) -> int:
    """Plan the next run for a fit, in open loop or by a tuning file's loop; returns the exit status."""
    files = [fit, *([tuning] if tuning else [])]
    outputs.check(files)
    stored = read_fit(fit)
    parameters = stored.parameters
    require(len(parameters.free_names) > 0, f"{fit}: no parameter is free; mark what the next run is to tell")
    system: System | ClosedLoop = stored.drive.system()
    plant = system.plant
    if tuning is not None:
        task = read_tuning(tuning, plant, parameters)
        system = task.loop
        parameters = parameters | task.parameters.fixed(*task.parameters.free_names)
    warn_of_status(stored)
    seen = [system.feedback] if isinstance(system, ClosedLoop) else []
    units = {q.name: q.unit for q in (*plant.inputs, *plant.states, *plant.outputs)}
    units |= {REFERENCE_CHANNELS.get(q.name, f"{q.name}_reference"): q.unit for q in seen}
    limits = _split("--limit", options.limits, units, "position=20mm..180mm")
    with progress("planning", quiet=quiet) as report_progress:
        design = next_experiment(
            system,
            parameters,
            duration=read_value(options.duration, "s", where="--duration"),
            sample_time=read_value(options.sample_time, "s", where="--sample-time") if options.sample_time else None,
            limits={n: read_range(text, units[n], f"--limit {n}={text}") for n, text in limits},
            criterion=(AOptimal if options.mean else DOptimal)(*options.targets),
            covariance=stored.covariance,
            noise=_read_pairs("--noise", options.noise, units) or stored.noise,
            start=_read_pairs("--start", options.start, units),
            runs=options.runs,
            cpu_seconds=options.budget,
            progress=report_progress,
        )
    tables = {"design": records(design.table), "provenance": file_hashes(*files), "stats": dict(design.stats)}
    draw, head = partial(plot_experiment, design), PageHead(title_of("Next experiment", fit, ()), file_hashes(*files))
    page = partial(summary_page, head, design.summary(), (Picture(draw, _ALT, _ALT),))
    places = [] if outputs.output is None else number_paths(outputs.output, len(design.runs))
    columns = {design.channel: (design.channel, design.units[design.channel])}  # as `ExperimentDesign.write_csv`
    writers: Writers = {
        p: partial(write_csv, run=r, columns=columns) for p, r in zip(places, design.runs, strict=False)
    }
    return finish(outputs, writers, tables, None, figures=lambda: {"": draw()}, report=design.summary(), page=page)


def _read_pairs(option: str, given: Sequence[str], units: dict[str, str]) -> dict[str, float]:
    """Values from "position=20 um"."""
    pairs = _split(option, given, units, "position=20um")
    return {name: read_value(text.strip(), units[name], where=f"{option} {name}") for name, text in pairs}


def _split(option: str, given: Sequence[str], units: dict[str, str], example: str) -> list[tuple[str, str]]:
    out = []
    for text in given:
        name, sign, value = text.partition("=")
        require(bool(sign), f"{option} {text}: give a signal and its value, as in {example}")
        check_names("signal", [name.strip()], units, option)
        out.append((name.strip(), value))
    return out
