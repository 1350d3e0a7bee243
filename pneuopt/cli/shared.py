"""What the commands share: their input, and the files they write once everything is computed."""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.cli.exit_status import EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_SUCCESS
from pneuopt.cli.terminal import make_console, show_output_files, show_sentence
from pneuopt.files.drive import read_drive, read_marks, read_status
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.plotting import check_figure_path, save_figure
from pneuopt.quantities.output import check_output_paths, write_json, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.tune import TuningResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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

    def check(self, inputs: Sequence[Path], *others: str) -> None:
        """Raise `InputError` for a file that cannot be written, or is an input; `others` name further figures."""
        figures: list[Path] = []
        if self.plot is not None:
            check_figure_path(self.plot)
            figures = [self.plot, *(add_to_stem(self.plot, name) for name in others)]
        check_output_paths([self.output, self.json, *figures], inputs)


def finish(outputs: Outputs, writers: Writers, tables: Mapping[str, Any], status: Status | None) -> int:
    """Write all files and say which; returns the exit status."""
    ended = {"status": {"code": status.code.value, "message": status.message}} if status else {}
    if outputs.json is not None:
        writers = {**writers, outputs.json: partial(write_json, outputs.json, {**ended, **tables})}
    for write in writers.values():
        write()
    show_output_files(make_console(), list(writers))
    if status is None or status.code in (Code.CONVERGED, Code.PARTIAL):
        return EXIT_SUCCESS
    return EXIT_INTERRUPTED if status.code is Code.INTERRUPTED else EXIT_FAILURE


def read_fit_and_tuning(fit: Path, tuning: Path) -> tuple[Tuning, ParameterSet]:
    """Read the loop and its parameters; those of the plant are fixed."""
    model, plant = read_drive(fit)
    task = read_tuning(tuning, model.system(), plant)
    warn_of_status(fit)
    return task, plant.fixed(*plant.free_names) | task.parameters


def warn_of_status(path: Path, what: str = "fit") -> None:
    """Say on standard error if what wrote a file did not converge, or which of its estimates may be biased."""
    status = read_status(path)
    if status is not None and status.code is not Code.CONVERGED:
        warn(f"{path}: its {what} is {status}")
    biased = [n for n, mark in read_marks(path).items() if mark is Mark.BIAS_POSSIBLE]
    if biased and (status is None or status.converged):
        warn(f"{path}: estimates that may be biased by a model error: {', '.join(biased)}")


def warn(message: str) -> None:
    """Say on standard error what does not stop the command."""
    show_sentence(make_console(error=True), f"warning: {message}")


def figure_writers(path: Path, figures: Mapping[str, "Figure"]) -> Writers:
    """Each figure in a file of its own, the one without a name at the path itself."""
    places = {name: add_to_stem(path, name) if name else path for name in figures}
    return {places[name]: partial(save_figure, figure, places[name]) for name, figure in figures.items()}


def add_to_stem(path: Path, name: str) -> Path:
    """fit.png and "friction" make fit_friction.png."""
    return path.with_stem(f"{path.stem}_{name}")


def write_csv(path: Path, run: Trajectory, columns: Columns) -> None:
    """Write a run as a log that can be read again."""
    header = ",".join(["time [s]", *(f"{name} [{unit}]" for name, unit in columns.values())])
    values = np.column_stack([run.t, run.matrix(columns)])
    rows = [",".join("" if math.isnan(v) else f"{v:.9g}" for v in row) for row in values.tolist()]
    write_text(path, "\n".join([header, *rows]) + "\n")


def stats_and_provenance(result: IdentificationResult | TuningResult) -> dict[str, Any]:
    """The statistics and the provenance of a result, which a JSON file holds beside the tables."""
    return {"stats": result.stats, "provenance": result.provenance}


def file_hashes(*paths: Path) -> dict[str, str]:
    """The SHA-256 of each file, for provenance."""
    return {f"sha256[{path.name}]": hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
