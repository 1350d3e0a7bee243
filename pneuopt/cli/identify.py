"""`pneuopt identify` and `pneuopt simulate --log`: from logs to parameters, and back to logs."""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.cli.shared import (
    Outputs,
    Writers,
    describe_status,
    file_hashes,
    finish,
    progress,
    stats_and_provenance,
    warn,
    warn_of_status,
    write_csv,
)
from pneuopt.dynamics.system import System
from pneuopt.files.drive import ambient_pressure, read_drive, read_fit, write_fit
from pneuopt.identification.checkup import OTHER_CHECKS, check
from pneuopt.identification.forecast import predict_logs
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult, report_agreement, report_band, report_trail
from pneuopt.identification.select_model import select_model
from pneuopt.logs.doctor import CHECKS, LogFinding
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.declaration import Drive
from pneuopt.models.drive_kinds import DRIVE_KINDS, stick_slip_drive
from pneuopt.models.friction import friction_ladder, usual_unknowns
from pneuopt.plotting import (
    has_friction_map,
    plot_correlation,
    plot_finding,
    plot_fit,
    plot_friction,
    plot_prediction,
    plot_residuals,
)
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.output import records
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.report.fit_page import PageHead, fit_page, prediction_page, refusal_page
from pneuopt.report.tuning_page import summary_page, title_of
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.studies.bootstrap import bootstrap

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure

REFUSAL_FIGURE = "refused"
"""What the name of a refusal's figure ends in: fit.png and fit_refused.png."""


def run_identify(
    drive: Path,
    logs: Sequence[Path],
    outputs: Outputs,
    window: float | None,
    quiet: bool,
    accept: Sequence[str] = (),
    budget: float = math.inf,
    draws: int = 0,
    held_out: Sequence[Path] = (),
    trail: bool = False,
) -> int:
    """Identify from logs, and from simulated ones if draws are asked for; returns the exit status.

    Held-out logs are predicted on the page of --report.
    """
    figures = "friction", "residuals", "correlation", REFUSAL_FIGURE, *CHECKS, *OTHER_CHECKS
    outputs.check(_input_files(drive, [*logs, *held_out]), *figures)
    model, parameters = read_free_drive(drive)
    system = model.system()
    experiments, others = (read_experiments(own, system, parameters, accept) for own in (logs, held_out))
    found = check(system, experiments, parameters, trial=False)
    for sentence in found.warnings:
        warn(f"before the fit: {sentence}")
    warnings.filterwarnings("ignore", message="before the search")  # the check has said it
    names = ", ".join(log.name for log in logs[:3]) + (f" and {len(logs) - 3} more" if len(logs) > 3 else "")
    warned = tuple(f"before the fit: {sentence}" for sentence in found.warnings)
    head = PageHead(f"Identification of {drive.name} from {names}", file_hashes(drive), warned)
    with _report_refusal(outputs, head, experiments), progress("identifying", quiet=quiet) as report_progress:
        method = LeastSquares(progress=report_progress)
        result = identify(
            system, experiments, parameters, method=method, window=window, cpu_seconds=budget, throw=False
        )
    trial, tables = _try_bootstrap(model, experiments, result, draws, quiet)
    verdict, cut = result.verdict, result.window
    tables |= {"estimates": records(result.estimates), "fit": records(result.fit)}
    tables["verdict"] = {**verdict.to_dict(), "table": records(verdict.table)} if verdict is not None else {}
    tables["window"] = asdict(cut) if cut else None
    tables["trail"] = [] if result.trail is None else records(result.trail)
    tried = Report() if result.trail is None or not trail else report_trail(result.trail)
    kept = "with -o fit.toml: keeps the fit, for pneuopt tune"
    hints = [kept if outputs.output is None else f"pneuopt tune {outputs.output} tuning.toml -o tuned.toml"]
    hints += ["with --report FILE.html: a page to hand on"] if outputs.report is None else []
    return finish(
        outputs,
        {} if outputs.output is None else {outputs.output: partial(write_fit, source=drive, result=result)},
        tables | stats_and_provenance(result),
        result.status,
        figures=partial(_fit_figures, system, result, experiments, found.findings),
        report=result.summary() + tried + (trial or Report()),
        page=lambda: fit_page(head, result, experiments, system, held_out=others, findings=found.findings, trial=trial),
        hints=hints,
    )


def _try_bootstrap(
    model: Drive, experiments: Sequence[Experiment], result: IdentificationResult, draws: int, quiet: bool
) -> tuple[Report | None, dict[str, Any]]:
    """What fits of simulated logs show, and their table; nothing without draws, or of a fit that did not converge."""
    if not draws or not result.status.converged:
        return None, {}
    # a log that the smooth model explains to its noise is of an axis that creeps, and not one that sticks
    rig = stick_slip_drive(model) if (result.estimates["bias"] > 0).any() else model
    what = "the drive as fitted" if rig == model else "a drive that truly sticks, as the fit misses the logs"
    with progress("simulating and identifying", quiet=quiet) as report_progress:
        tried = bootstrap(model.system(), experiments, result, rig=rig, count=draws, progress=report_progress)
    return Report((Line(f"simulated with {what}"),)) + tried.summary(), {"bootstrap": records(tried.table)}


def run_select(
    drive: Path, logs: Sequence[Path], outputs: Outputs, window: float | None, quiet: bool, accept: Sequence[str] = ()
) -> int:
    """Choose a friction model by the logs; returns the exit status."""
    remedy = "write the model that is chosen into [friction], and identify again without --select"
    require((outputs.output, outputs.plot) == (None, None), f"--select writes neither -o nor --plot; {remedy}")
    outputs.check(_input_files(drive, logs))
    model, parameters = read_free_drive(drive)
    message = f"{drive}: --select chooses a drive's friction model; this plant is not built from one"
    require(DRIVE_KINDS[model.kind].any_friction, message)
    built: Any = model
    systems = {name: replace(built, friction=law).system() for name, law in friction_ladder().items()}
    free = [n for n in parameters.free_names if not n.startswith("friction.")]
    known = parameters.fixed("friction.*").select(
        n for n in parameters if any(n in s.parameters for s in systems.values())
    )
    experiments = read_experiments(logs, model.system(), known, accept)
    with progress("selecting", quiet=quiet) as report_progress:
        chosen = select_model(
            systems,
            experiments,
            known,
            free=[*free, *usual_unknowns()],
            window=window,
            method=LeastSquares(progress=report_progress),
        )
    tables = {"recommended": chosen.recommended, "reason": chosen.reason, "candidates": records(chosen.table)}
    status = chosen.fits[chosen.recommended].status
    head = PageHead(title_of("Choice of a friction model", drive, logs), file_hashes(drive))
    page = partial(summary_page, head, chosen.summary(), (), experiments)
    return finish(outputs, {}, tables, status, report=chosen.summary(), page=page)


def run_predict(fit: Path, log: Path, window: float | None, outputs: Outputs, quiet: bool = False) -> int:
    """Predict a log in open loop, in windows if asked for; returns the exit status."""
    outputs.check([fit, log, log.with_suffix(".toml")])
    stored = read_fit(fit)
    system, parameters = stored.drive.system(), stored.parameters
    experiment = read_log(log, plant=system, ambient_pressure=ambient_pressure(parameters))
    warn_of_status(stored)
    with progress("predicting", quiet=quiet) as report_progress:
        table, runs = predict_logs(system, experiment, stored, window=window, progress=report_progress)
    writers: Writers = {}
    if outputs.output is not None:
        given = {q.name: experiment.trajectory[q.name] for q in system.inputs}
        columns = {q.name: (q.name, q.unit) for q in (*system.inputs, *system.outputs)}
        bands = {f"{n}_{end}": unit for n, unit in columns.values() for end in ("low", "high")}
        columns |= {n: (n, unit) for n, unit in bands.items() if n in runs[0]}
        writers[outputs.output] = partial(write_csv, run=runs[0].with_columns(given), columns=columns)
    hashes = file_hashes(fit) | {f"sha256[{log.name}]": experiment.sha256}
    tables = {"fit": records(table), "provenance": hashes}
    head = PageHead(f"Prediction of {log.name} by {fit.name}", file_hashes(fit), describe_status(stored))
    page = partial(prediction_page, head, table, runs, [experiment])
    return finish(
        outputs,
        writers,
        tables,
        None,
        figures=lambda: {"": plot_prediction(runs, [experiment], label="predicted")},
        report=report_agreement(table) + report_band(table),
        page=page,
    )


@contextmanager
def _report_refusal(outputs: Outputs, head: PageHead, experiments: Sequence[Experiment]) -> Iterator[None]:
    """Draw what a log is refused for, where figures are wanted; otherwise the message says how to have it drawn."""
    try:
        yield
    except LogError as error:
        page = partial(refusal_page, head, str(error), experiments, error.finding)
        finish(Outputs(None, None, None, outputs.report), {}, {}, None, page=page)
        if error.finding is None or error.finding.evidence is None:
            raise
        if outputs.plot is None:
            raise LogError(f"{error}; --plot refusal.png draws it", error.finding) from None
        figures = {REFUSAL_FIGURE: plot_finding(error.finding)}
        finish(Outputs(None, None, outputs.plot), {}, {}, None, figures=lambda: figures)
        raise


def read_experiments(
    logs: Sequence[Path], plant: System, parameters: ParameterSet, accept: Sequence[str]
) -> list[Experiment]:
    """The logs of a drive; each accepts the named checks."""
    zero = ambient_pressure(parameters)
    return [read_log(path, plant=plant, ambient_pressure=zero).accepting(*accept) for path in logs]


def _input_files(drive: Path, logs: Sequence[Path]) -> list[Path]:
    return [drive, *logs, *(log.with_suffix(".toml") for log in logs)]


def read_free_drive(path: Path) -> tuple[Drive, ParameterSet]:
    """A drive of which something is to be identified."""
    model, parameters = read_drive(path)
    remedy = 'mark what to identify, as in coulomb = { value = "40 N", free = true }'
    require(len(parameters.free_names) > 0, f"{path}: no parameter is free; {remedy}")
    return model, parameters


def _fit_figures(
    system: System, result: IdentificationResult, experiments: Sequence[Experiment], found: Sequence[LogFinding]
) -> dict[str, "Figure"]:
    figures = {
        "": plot_fit(result, experiments),
        "residuals": plot_residuals(list(result.trajectories.values()), experiments),
    }
    if has_friction_map(system):
        figures["friction"] = plot_friction(system, result, experiments)
    if result.estimates["stderr"].notna().any():
        figures["correlation"] = plot_correlation(result)
    return figures | {finding.check: plot_finding(finding) for finding in reversed(found) if finding.evidence}
