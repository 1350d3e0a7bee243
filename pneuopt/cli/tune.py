"""`pneuopt tune` and `pneuopt certify`: a loop's gains, found or given, with their certificate."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.cli.run import interruption_status
from pneuopt.cli.shared import (
    BEST_STEM,
    Outputs,
    add_to_stem,
    describe_status,
    file_hashes,
    finish,
    make_console,
    progress,
    read_fit_and_tuning,
    show_output_files,
    show_report,
    show_sentence,
    stats_and_provenance,
    warn,
    write_files,
)
from pneuopt.cli.simulate import loop_view, task_metrics
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY
from pneuopt.evaluation.dither import DitherVerdict, judge_dither
from pneuopt.evaluation.plants import ExpectedPlants, expected_plants
from pneuopt.evaluation.scenarios import Scenarios
from pneuopt.files.drive import StoredFit
from pneuopt.files.rig import read_rig
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import Tuning
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.output import records
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.status import Code
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import Page, report_exports
from pneuopt.report.tuning_page import LoopView, tuning_page
from pneuopt.tuning.result import report_tuning
from pneuopt.tuning.tune import TuningResult, certify, tune, tune_without_dither

if TYPE_CHECKING:
    from rich.console import Console


def run_tune(fit: Path, tuning: Path, rig: Path | None, outputs: Outputs, quiet: bool, structure: bool = False) -> int:
    """Tune a loop, where asked for its structure as well; returns the exit status."""
    job = _read_job(fit, tuning, rig, outputs)
    task, parameters = job.task, job.parameters
    remedy = 'add [minimise] with settling_time = { band = "2 %" }'
    require(bool(task.specification.weights), f"{tuning}: has nothing to minimise; {remedy}")
    require(len(task.parameters.free_names) > 0, f"{tuning}: no gain is free; mark what to tune with free = true")
    with progress("tuning", quiet=quiet) as report_progress:
        result = tune(
            task.loop,
            task.references,
            parameters,
            method=task.method,
            robust=task.robust,
            structure=structure,
            progress=report_progress,
            **job.proof_options(),
        )
    saved = job.save(result)  # before the search without dither, which takes as long
    was = None
    if result.status.converged and result.on_rig is None and interruption_status() is None:
        with suppress(ConvergenceError, InputError, KeyboardInterrupt):  # the loop as given may not be simulated
            was = task_metrics(task, parameters)
    if result.loop is not None:
        task = replace(task, loop=result.loop)
        parameters = result.parameters.with_values(dict(result.given))
        job = replace(job, task=task, parameters=parameters)
    console = make_console()
    show_report(console, report_tuning(result, was=was, source=f"the gains of {tuning}"))
    dither, compared = Report(), dict[str, Any]()
    with suppress(KeyboardInterrupt):
        compared, dither = _compare_dither(console, job, result, quiet)
    title = f"Tuning of {fit.name} by {tuning.name}"
    details = {"stands": f"the gains of {tuning}", "was": was, "dither": dither}
    return job.finish(result, saved, partial(_make_page, job, result, title, details), compared)


def run_certify(fit: Path, tuning: Path, rig: Path | None, outputs: Outputs, quiet: bool) -> int:
    """Certify a loop with the gains that it has, or say what breaks; returns the exit status."""
    job = _read_job(fit, tuning, rig, outputs)
    with progress("certifying", quiet=quiet) as report_progress:
        result = certify(
            job.task.loop, job.task.references, job.parameters, progress=report_progress, **job.proof_options()
        )
    saved = job.save(result)
    show_report(make_console(), report_tuning(result, source=""))
    title = f"Certificate of {tuning.name} with {fit.name}"
    return job.finish(result, saved, partial(_make_page, job, result, title, {"stands": ""}))


@dataclass(frozen=True, eq=False)
class _Job:
    """A loop that is to be certified, the files that it comes from, and those that are to be written."""

    stored: StoredFit  # the plant's file as read
    task: Tuning
    parameters: ParameterSet  # of plant and controller, as given
    fit: Path
    tuning: Path
    rig: Path | None
    outputs: Outputs

    @property
    def inputs(self) -> list[Path]:
        """The files that were read."""
        return [self.fit, self.tuning, *([self.rig] if self.rig is not None else [])]

    def proof_options(self) -> dict[str, Any]:
        """What `tune` and `certify` prove a design by: limits, scenarios, the plants to be expected, the rig."""
        task, parameters, stored = self.task, self.parameters, self.stored
        plants = expected_plants(
            task.loop.complete(parameters),
            stored.covariance,
            estimates=stored.estimates,
            scenarios=task.validation_scenarios(parameters),
        )
        return {
            "minimise": task.specification,
            "scenarios": task.scenarios(parameters),
            "plants": plants,
            "rig": None if self.rig is None else read_rig(self.rig, stored.drive, task.loop),
            "max_steps": task.max_steps,
            "accept": task.accept,
            "throw": False,
        }

    def place(self, result: TuningResult) -> Path | None:
        """Where a certified design is written; the best candidate beside it, which is no input; else nowhere."""
        place = self.outputs.output
        if place is None or result.candidate is None:
            return None
        while not result.status.converged and (place == self.outputs.output or place in self.inputs):
            place = add_to_stem(place, BEST_STEM)
        return place

    def save(self, result: TuningResult) -> tuple[list[Path], list[InputError]]:
        """Write the design, or the best candidate; an interrupted command replaces no file."""
        stopped, place = result.status.code is Code.INTERRUPTED or interruption_status() is not None, self.place(result)
        write = partial(
            write_tuned, source=self.tuning, result=self._with_files(result), wire=self.task.wire, fit=self.stored
        )
        return write_files({place: write} if place is not None else {}, beside=stopped)

    def finish(
        self,
        result: TuningResult,
        saved: tuple[list[Path], list[InputError]],
        page: Callable[[], Page],
        compared: Mapping[str, Any] | None = None,
    ) -> int:
        """Say which files are written, write the others, and say what may come next; returns the exit status."""
        (written, failures), console = saved, make_console()
        show_output_files(console, written)
        output = self.outputs.output
        if output is not None and not result.status.converged and not failures:
            stays = f"{output} stays as it was" if output.exists() else f"{output} is not written"
            beside = f"; pneuopt export refuses {written[0]}, the best candidate" if written else ""
            show_sentence(console, f"{stays}, for no design is certified{beside}")
        hints = [] if self.outputs.report is not None else ["with --report FILE.html: a page to hand on"]
        if output is None:
            hints = ["with -o tuned.toml: keeps the gains, for pneuopt export", *hints]
        elif self.task.loop.pid.sample_time is not None:
            hints = [f"pneuopt export {self.fit} {output} --to st    (for a PLC; or --help)", *hints]
        result = self._with_files(result)
        gains = result.parameters.select(result.parameters.free_names).to_frame()
        tables = {"gains": gains, "claimed": result.claimed.T, "certified": result.certified.T}
        tables |= {"requirements": result.requirements, "relaxations": result.relaxations}
        document: dict[str, Any] = {name: records(table) for name, table in tables.items()} | {"active": result.active}
        document |= {"best": dict(result.best)} if result.best else {}
        if result.status.converged:  # also the certificate's notes and the plants that the design was tried on
            document |= {} if result.certificate is None else {"notes": list(result.certificate.notes)}
            document |= {} if result.validation is None else {"validation": records(result.validation.figures)}
            document |= {} if result.trail is None else {"trail": records(result.trail)}
        document |= {} if result.structures is None else {"structures": records(result.structures)}
        status = finish(
            self.outputs,
            {},
            document | dict(compared or {}) | stats_and_provenance(result),
            result.status,
            figures=self.view(result).figures,
            page=page,
            hints=hints,
        )
        if failures:
            raise failures[0]
        return status

    def view(self, result: TuningResult) -> LoopView:
        """What figures of the result's loop are drawn from, beside the gains before where others were found."""
        changed = result.status.converged and bool(result.given)
        return loop_view(self.task, result.parameters, self.parameters if changed else None)

    def _with_files(self, result: TuningResult) -> TuningResult:
        return replace(result, provenance={**result.provenance, **file_hashes(*self.inputs)})


def _read_job(fit: Path, tuning: Path, rig: Path | None, outputs: Outputs) -> _Job:
    """Read the files, once it is sure that the others can be written."""
    outputs.check([fit, tuning, *([rig] if rig is not None else [])], "bode")
    stored, task, parameters = read_fit_and_tuning(fit, tuning)
    measured, axis = task.loop.feedback.name, task.loop.plant.axis
    if task.loop.sensor is None and axis is not None and stored.noise and measured not in stored.noise:
        unseen = f"the loop sees the {measured} itself, and no log of {fit} holds one: no sensor may give it"
        keys = '[sensor] resolution = "10 um", one count, and filter = "5 ms"'
        warn(f"{tuning}: {unseen}; if a controller differentiates the {axis.position}, write {keys}")
    return _Job(stored, task, parameters, fit, tuning, rig, outputs)


def _make_page(job: _Job, result: TuningResult, title: str, told: Mapping[str, Any]) -> Page:
    """The page of a design, or of what was refused."""
    head = PageHead(title, file_hashes(*job.inputs), warnings=describe_status(job.stored))
    place = job.outputs.output if result.status.converged else None
    task = job.task
    design = (task.loop.controller, result.parameters, task.references, task.centre)
    exports = Report() if place is None else report_exports(*design, job.fit, place)
    return tuning_page(head, result, job.view(result), exports=exports, **told)


def _compare_dither(console: "Console", job: _Job, result: TuningResult, quiet: bool) -> tuple[dict[str, Any], Report]:
    """Show whether a certified design's dither is worth its price; returns the table of that, and what was shown.

    An interrupted command computes nothing more.
    """
    nothing, task = (dict[str, Any](), Report()), job.task
    if not result.status.converged or interruption_status() is not None:
        return nothing
    if result.dither is not None:
        show_report(console, result.dither.summary())
        return {"dither": _dither_record(result.dither, dict(result.rival) or None)}, result.dither.summary()
    if task.loop.dither_period(result.parameters) is not None:
        plants = job.proof_options()["plants"]  # of which the rival makes as much as the design
        rival = tune_rival(console, task, job.parameters, plants, quiet)
        if interruption_status() is not None:
            return nothing
        parameters = result.parameters
        try:
            verdict = judge_dither(task.loop, task.references, parameters, without=rival, band=task.specification.band)
        except ConvergenceError as error:  # of the loop without dither
            unknown = Report((Line(f"no verdict on the dither: {error}"),))
            show_report(console, unknown)
            return {}, unknown
        show_report(console, verdict.summary())
        gains = None if rival is None else {n: rival.value(n) for n in rival.free_names}
        return {"dither": _dither_record(verdict, gains)}, verdict.summary()
    if DITHER_AMPLITUDE in result.parameters.free_names:
        useless = Report((Line("the dither's amplitude is 0: the tuning found no use for it"),))
        show_report(console, useless)
        return {}, useless
    return nothing


def _dither_record(verdict: DitherVerdict, rival: Mapping[str, float] | None) -> dict[str, Any]:
    """What the JSON file says of a dither; `rival` are the other design's parameters."""
    return {"usefulness": verdict.usefulness.value, "reasons": list(verdict.reasons), "rival": rival}


def tune_rival(
    console: "Console", task: Tuning, parameters: ParameterSet, plants: ExpectedPlants | Scenarios, quiet: bool
) -> ParameterSet | None:
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
                robust=task.robust,
                plants=plants,
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
