"""The command `check`: what was read, assumed and found before a fit, and what the logs identify."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pneuopt.cli.init import write_files
from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import Outputs, file_hashes, finish, make_console, show_output_files, show_report, show_sentence
from pneuopt.dynamics.system import System
from pneuopt.files.drive import ambient_pressure, read_fit
from pneuopt.identification.checkup import OTHER_CHECKS, check, finding_line
from pneuopt.identification.identifiability import mend_findings
from pneuopt.identification.problem import as_estimation_model, check_logs
from pneuopt.logs.doctor import CHECKS
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.mending import MendedLog, mend_log, write_mended
from pneuopt.logs.read_log import read_log
from pneuopt.plotting import plot_finding, plot_logs
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import Page, Picture
from pneuopt.report.tuning_page import summary_page, title_of

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure


def run_check(
    drive: Path, logs: Sequence[Path], outputs: Outputs, accept: Sequence[str] = (), fix: Path | None = None
) -> int:
    """Check a drive's file and its logs, and mend the logs if there is a folder for it; returns the exit status."""
    outputs.check([drive, *logs, *(log.with_suffix(".toml") for log in logs)], *CHECKS, *OTHER_CHECKS)
    places: dict[Path, Path] = {}  # where each mended log goes
    if fix is not None:
        for log in logs:
            place = fix / f"{log.stem}.csv"
            twice = f"{log}: another log has its name, too; mend one after the other, into two folders"
            require(place not in places.values(), twice)
            for path in (place, place.with_suffix(".toml")):
                require(not path.exists(), f"{path}: is there already, and stays as it is; --fix names another folder")
            places[log] = place
    stored = read_fit(drive)
    system, parameters = stored.drive.system(), stored.parameters
    experiments, errors = _read_all(logs, system, parameters, accept)
    for error in errors:
        show_sentence(make_console(error=True), f"error: {error}")
    status = ExitStatus.BAD_INPUT if errors else ExitStatus.SUCCESS
    if experiments:
        found = check(system, experiments, parameters)
        found = replace(found, assumptions=(*found.assumptions, *stored.assumed_options))
        show_report(make_console(), found.summary())
        shown = [f for f in found.findings if f.evidence is not None]

        def figures() -> dict[str, "Figure"]:
            others = {f.check: plot_finding(f) for f in reversed(shown[1:]) if f.check != shown[0].check}
            return {"": plot_finding(shown[0]) if shown else plot_logs(found.logs), **others}

        def page() -> Page:
            pictures = [Picture(partial(plot_finding, f), f"What shows it: {f.message}", f.message) for f in shown]
            alt = "Every channel that was read, over time."
            pictures += [Picture(partial(plot_logs, found.logs), alt, "The logs as they were read.")]
            unread = tuple(f"not read: {text}" for text in errors)
            head = PageHead(title_of("Check", drive, logs), file_hashes(drive), unread)
            return summary_page(head, found.summary(), pictures, found.logs)

        finish(outputs, {}, found.to_dict(), None, figures=figures, page=page)
        status = status or (ExitStatus.FAILURE if found.is_refused else ExitStatus.SUCCESS)
    return _fix(places, system, parameters, accept) if places else status


def _fix(places: Mapping[Path, Path], system: System, parameters: ParameterSet, accept: Sequence[str]) -> int:
    """Write mended logs, say what was changed, and check them; returns the exit status of that check."""
    zero, units = ambient_pressure(parameters), {n: p.unit for n, p in parameters.items()}
    mended: dict[Path, MendedLog] = {}
    errors: list[InputError] = []
    for path in places:
        try:
            read = mend_log(path, plant=system, ambient_pressure=zero)
            read = replace(read, log=read.log.accepting(*accept))
            mended[path] = mend_findings(as_estimation_model(system), read, parameters, zero)
        except InputError as error:
            errors.append(error)
    files = {p: text for path, log in mended.items() for p, text in write_mended(log, places[path], units).items()}
    write_files(files, force=False)
    for problem in errors:
        show_sentence(make_console(error=True), f"error: not mended: {problem}")
    changes = ((p.name, change) for p, log in mended.items() for change in log.changes or ("nothing to mend",))
    lines = [
        Line(""),
        Line("mended", Tone.HEADING),
        *(Line(f"{name}: {change}", indent=2) for name, change in changes),
    ]
    show_report(make_console(), Report(tuple(lines)))
    show_output_files(make_console(), list(files))
    if not mended:
        return ExitStatus.BAD_INPUT
    left = check(
        system, _read_all([places[path] for path in mended], system, parameters, accept)[0], parameters, trial=False
    )
    verdict = replace(left.headline, text=f"the mended logs: {left.headline.text}")
    show_report(make_console(), Report((verdict, *map(finding_line, left.findings))))
    return ExitStatus.BAD_INPUT if errors else ExitStatus.FAILURE if left.is_refused else ExitStatus.SUCCESS


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
            unread = ", ".join(log.source.unread) if log.source else ""  # the missing channel may be one of them
            message = f"; columns that are not read: {unread}; a sidecar's [columns] says which channel a column is"
            errors.append(f"{error}{message if unread else ''}")
    return found, errors
