"""`pneuopt next-experiment`: which run shrinks the asked confidence intervals most, as a CSV for the controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pneuopt.cli.shared import Outputs, Writers, add_to_stem, file_hashes, finish, warn_of_status, write_csv
from pneuopt.cli.terminal import progress
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.system import System
from pneuopt.files.drive import read_fit
from pneuopt.files.tuning import read_tuning
from pneuopt.identification.criteria import AOptimal, DOptimal
from pneuopt.identification.experiment_design import ExperimentDesign
from pneuopt.identification.logged_loop import REFERENCE_CHANNELS
from pneuopt.identification.next_experiment import next_experiment
from pneuopt.plotting import plot_experiment
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import records
from pneuopt.quantities.units import read_value
from pneuopt.report.fit_page import Source
from pneuopt.report.page import Picture
from pneuopt.report.summary_page import summary_page, title_of

_ALT = "What is played, the signals with limits as predicted, and each parameter's interval now and afterwards."


@dataclass(frozen=True)
class PlannedOptions:
    """What a planned run may do, as the command line says it.

    Attributes
    ----------
    duration, sample_time : str
        With their units; an empty sample time is the controller's.
    targets : tuple of str
    limits, noise, start : tuple of str
        "position=20 mm..180 mm", "position=20 um", "position=100 mm".
    runs : int
    mean : bool
        Whether the mean deviation counts (`AOptimal`), not the joint region (`DOptimal`).
    budget : float
        CPU seconds.
    """

    duration: str
    sample_time: str
    targets: tuple[str, ...]
    limits: tuple[str, ...]
    noise: tuple[str, ...]
    start: tuple[str, ...]
    runs: int
    mean: bool
    budget: float


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
    units = _signal_units(plant, system if isinstance(system, ClosedLoop) else None)
    stated = _read_pairs("--noise", options.noise, units)
    with progress("planning", quiet=quiet) as report_progress:
        design = next_experiment(
            system,
            parameters,
            duration=read_value(options.duration, "s", where="--duration"),
            sample_time=read_value(options.sample_time, "s", where="--sample-time") if options.sample_time else None,
            limits=_read_limits(options.limits, units),
            criterion=(AOptimal if options.mean else DOptimal)(*options.targets),
            covariance=stored.covariance,
            noise=stated or stored.noise,
            start=_read_pairs("--start", options.start, units),
            runs=options.runs,
            cpu_seconds=options.budget,
            progress=report_progress,
        )
    tables = {"design": records(design.table), "provenance": file_hashes(*files), "stats": dict(design.stats)}
    draw, source = partial(plot_experiment, design), Source(title_of("Next experiment", fit, ()), file_hashes(*files))
    page = partial(summary_page, source, design.summary(), (Picture(draw, _ALT, _ALT),))
    writers = _writers(design, outputs.output)
    return finish(outputs, writers, tables, None, figures=lambda: {"": draw()}, report=design.summary(), page=page)


def _writers(design: ExperimentDesign, output: Path | None) -> Writers:
    """A file a run, as `ExperimentDesign.write_csv` names them."""
    if output is None:
        return {}
    several, unit = len(design.runs) > 1, design.units[design.channel]
    places = [add_to_stem(output, str(k)) if several else output for k in range(1, len(design.runs) + 1)]
    columns = {design.channel: (design.channel, unit)}
    return {place: partial(write_csv, run=run, columns=columns) for place, run in zip(places, design.runs, strict=True)}


def _signal_units(plant: System, loop: ClosedLoop | None) -> dict[str, str]:
    """The unit of each signal that a limit may name."""
    units = {q.name: q.unit for q in (*plant.inputs, *plant.states, *plant.outputs)}
    if loop is not None:
        seen = loop.feedback
        units[REFERENCE_CHANNELS.get(seen.name, f"{seen.name}_reference")] = seen.unit
    return units


def _read_limits(given: Sequence[str], units: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Limits from "position=20 mm..180 mm"."""
    out = {}
    for name, text in _split("--limit", given, units, "position=20mm..180mm"):
        low, dots, high = text.partition("..")
        require(bool(dots), f"--limit {name}={text}: give both ends, as in position=20mm..180mm")
        low, high = (end.strip() for end in (low, high))
        unit, where = units[name], f"--limit {name}"
        out[name] = (read_value(low, unit, where=where), read_value(high, unit, where=where))
    return out


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
