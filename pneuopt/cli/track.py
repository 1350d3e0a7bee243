"""`pneuopt track`: a drive's parameters over dated logs, and what its tuned loop is worth as they drift."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.cli.exit_status import EXIT_FAILURE
from pneuopt.cli.identify import read_experiments, read_free_drive
from pneuopt.cli.shared import Outputs, Writers, file_hashes, finish, warn
from pneuopt.cli.terminal import progress
from pneuopt.dynamics.system import System
from pneuopt.files.tuning import read_tuning
from pneuopt.identification.design_outlook import DesignOutlook, predict_loss
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import track
from pneuopt.logs.dates import find_date
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting import plot_tracking
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import format_table, records, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import ProgressCallback
from pneuopt.report.fit_page import Source
from pneuopt.report.summary_page import summary_page, title_of, tracking_picture
from pneuopt.shooting.least_squares import LeastSquares

if TYPE_CHECKING:
    from datetime import date

    import pandas as pd


@dataclass(frozen=True)
class TrackOptions:
    """What `pneuopt track` is asked for.

    Attributes
    ----------
    tuned : Path or None
        The design whose loss is predicted.
    parameters : tuple of str
        Empty: all that are free.
    dates : str
        One a log, with commas; empty: as the logs say.
    drift : float
        For the power calculation [1/week].
    horizon : int
        Logs for which the level holds.
    """

    tuned: Path | None
    parameters: tuple[str, ...]
    dates: str
    drift: float
    horizon: int


def run_track(drive: Path, logs: Sequence[Path], options: TrackOptions, outputs: Outputs, quiet: bool = False) -> int:
    """Identify each log alone, and tell whether parameters drift; status 1 if one does, or the design fails."""
    inputs = [drive, *logs, *([options.tuned] if options.tuned else [])]
    outputs.check(inputs)
    model, parameters = read_free_drive(drive)
    system = model.system()
    check_names("parameter", options.parameters, parameters.free_names, f"{drive}: --parameter")
    experiments = read_experiments(logs, system, parameters, ())
    dates = _read_dates(logs, options.dates)
    task = read_tuning(options.tuned, system, parameters) if options.tuned else None
    warnings.filterwarnings("ignore", message="before the search")  # each log would say it again
    with progress("identifying", quiet=quiet) as report:
        fits = [_identify_alone(system, log, parameters, report) for log in experiments]
    found = track(fits, dates, parameters=options.parameters, drift=options.drift, horizon=options.horizon)
    outlook: DesignOutlook | None = None
    if task is not None:
        own = parameters.fixed(*parameters.free_names) | task.parameters
        with progress("certifying", quiet=quiet):
            outlook = predict_loss(found, task.loop, task.references, own, task.specification)
    writers: Writers = {}
    if outputs.output is not None:
        writers[outputs.output] = partial(_write_history, table=found.history)
    tables = {"drift": records(found.table), "history": records(found.history), "provenance": file_hashes(drive)}
    shown = found.summary()
    if outlook is not None:
        tables["design"] = records(outlook.table)
        shown += outlook.summary()
    source = Source(title_of("Tracking", drive, logs), file_hashes(*inputs[:1], *inputs[1 + len(logs) :]))
    page = partial(summary_page, source, shown, [tracking_picture(found)], experiments)
    finish(outputs, writers, tables, None, figures=lambda: {"": plot_tracking(found)}, report=shown, page=page)
    return EXIT_FAILURE if found.drifting or (outlook is not None and outlook.fails is not None) else 0


def _identify_alone(
    system: System, log: Experiment, parameters: ParameterSet, report: ProgressCallback
) -> IdentificationResult:
    """The fit of one log; one that does not converge has no interval, and does not count."""
    own = parameters.fixed(*(n for n in log.conditions if n in parameters))
    fit = identify(system, [log], own, method=LeastSquares(progress=report), throw=False)
    if not fit.status.converged:
        warn(f"{log.name}: {fit.status.verdict}; it does not count")
    return fit


def _read_dates(logs: Sequence[Path], given: str) -> "list[str | date]":
    if not given:
        return [find_date(path) for path in logs]
    dates: list[str | date] = [text.strip() for text in given.split(",")]
    require(len(dates) == len(logs), f"--dates has {len(dates)} dates for {len(logs)} logs; give one a log")
    return dates


def _write_history(path: Path, table: "pd.DataFrame") -> None:
    write_text(path, format_table(table.reset_index()))
