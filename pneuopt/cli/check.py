"""The command `check`: what was read, assumed and found before a fit, and what the logs identify."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pneuopt.cli.exit_status import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_SUCCESS
from pneuopt.cli.shared import Outputs, finish
from pneuopt.cli.terminal import make_console, show_sentence
from pneuopt.dynamics.system import System
from pneuopt.files.assumptions import read_option_assumptions
from pneuopt.files.drive import ambient_pressure, read_drive
from pneuopt.identification.checks import check_logs
from pneuopt.identification.checkup import LOG_CHECK, MODEL_CHECK, Checkup, check
from pneuopt.logs.doctor import CHECKS
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.plotting import plot_finding, plot_logs
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run_check(drive: Path, logs: Sequence[Path], outputs: Outputs, accept: Sequence[str] = ()) -> int:
    """Check a drive's file and its logs; returns the exit status."""
    outputs.check([drive, *logs, *(log.with_suffix(".toml") for log in logs)], *CHECKS, MODEL_CHECK, LOG_CHECK)
    model, parameters = read_drive(drive)
    system = model.system()
    experiments, errors = _read_all(logs, system, parameters, accept)
    for error in errors:
        show_sentence(make_console(error=True), f"error: {error}")
    if not experiments:
        return EXIT_BAD_INPUT
    found = check(system, experiments, parameters)
    found = replace(found, assumptions=(*found.assumptions, *read_option_assumptions(drive)))
    typer.echo(found.format(make_console().width))
    finish(outputs, {}, found.to_dict(), None, figures=partial(_figures, found))
    if errors:
        return EXIT_BAD_INPUT
    return EXIT_FAILURE if found.is_refused else EXIT_SUCCESS


def _read_all(
    logs: Sequence[Path], system: System, parameters: ParameterSet, accept: Sequence[str]
) -> tuple[list[Experiment], list[str]]:
    """The logs that can be read and belong to the drive, and what is wrong with the others."""
    found: list[Experiment] = []
    errors: list[str] = []
    for path in logs:
        try:
            log = read_log(path, plant=system, ambient_pressure=ambient_pressure(parameters)).accepting(*accept)
        except InputError as error:
            errors.append(str(error))
            continue
        try:
            check_logs(system, log, parameters)
            found.append(log)
        except InputError as error:
            errors.append(f"{error}{_name_unread(log)}")
    return found, errors


def _name_unread(log: Experiment) -> str:
    """The columns among which the missing channel may be."""
    unread = log.source.unread if log.source else ()
    remedy = "a sidecar's [columns] says which channel a column is"
    return f"; columns that are not read: {', '.join(unread)}; {remedy}" if unread else ""


def _figures(found: Checkup) -> dict[str, "Figure"]:
    """The first finding, and each other check's; the logs where nothing is found."""
    drawn = [f for f in found.findings if f.evidence is not None]
    if not drawn:
        return {"": plot_logs(found.logs)}
    first, *others = drawn
    return {"": plot_finding(first)} | {f.check: plot_finding(f) for f in reversed(others) if f.check != first.check}
