"""What the commands share: the files they read, those they write once everything is computed, and the terminal."""

import hashlib
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from pneuopt.cli.run import ExitStatus, interruption_status, without_interruption
from pneuopt.files.drive import StoredFit, read_fit, read_status
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.identification.result import IdentificationResult, Mark
from pneuopt.plotting import check_figure_path, save_figure
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.output import check_output_paths, read_toml_source, write_json, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.status import Code, ProgressCallback, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.report.page import Page, write_page
from pneuopt.tuning.tune import TuningResult

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure


Columns = Mapping[str, tuple[str, str]]
Writers = dict[Path, Callable[[Path], None]]
Figures = Callable[[], Mapping[str, "Figure"]]


BEST_STEM = "best"
"""What the name of a file ends in that holds the best candidate of a tuning that is not certified."""
INTERRUPTED_STEM = "interrupted"
"""What the name of an interrupted command's file ends in where a file is there already."""


@dataclass(frozen=True)
class Outputs:
    """The files that are wanted; `check` refuses early those that could not be written."""

    output: Path | None
    json: Path | None
    plot: Path | None
    report: Path | None = None

    def check(self, inputs: Sequence[Path], *others: str) -> None:
        """Raise `InputError` for a file that cannot be written, or is an input; `others` name further figures."""
        suffix = "" if self.report is None else self.report.suffix.lower()
        remedy = "a report is a page of HTML; name it so, report.html"
        require(self.report is None or suffix in (".html", ".htm"), f"{self.report}: {remedy}")
        figures: list[Path] = []
        if self.plot is not None:
            check_figure_path(self.plot)
            figures = [self.plot, *(add_to_stem(self.plot, name) for name in others)]
        check_output_paths([self.output, self.json, self.report, *figures], inputs)


def finish(
    outputs: Outputs,
    writers: Writers,
    tables: Mapping[str, Any],
    status: Status | None,
    *,
    figures: Figures | None = None,
    report: Report | None = None,
    page: Callable[[], Page] | None = None,
    hints: Sequence[str] = (),
) -> int:
    """Write all files, then show the result and say which are written; returns the exit status.

    Each file is tried, whatever becomes of the others. An interrupted command draws no figures, and replaces no file:
    its own stand beside those that are there.
    """
    ended = {"status": {"code": status.code.value, "message": status.message}} if status else {}
    if outputs.json is not None:
        writers = {**writers, outputs.json: partial(write_json, document={**ended, **tables})}
    interrupted = interruption_status() is not None or (status is not None and status.code is Code.INTERRUPTED)
    written, failures = write_files(writers, beside=interrupted)
    if figures is not None and outputs.plot is not None and not interrupted:
        with suppress(KeyboardInterrupt):  # Ctrl-C leaves out those that are not drawn yet
            plot, named = outputs.plot, figures()
            drawn, missed = write_files(
                {add_to_stem(plot, n) if n else plot: partial(save_figure, f) for n, f in named.items()}
            )
            written, failures = written + drawn, failures + missed
    if page is not None and outputs.report is not None:
        writers = {outputs.report: lambda path: write_page(path, page(), draws=not interrupted)}
        paged, missed = write_files(writers, beside=interrupted)
        written, failures = written + paged, failures + missed
    if report is not None:
        show_report(make_console(), report)
    show_output_files(make_console(), written)
    if failures:
        raise InputError("; ".join(map(str, failures)))
    if status is None or status.code in (Code.CONVERGED, Code.PARTIAL):
        for k, hint in enumerate(hints):
            make_console().print(Text(f"{'' if k else 'Next:':<5} {hint}"), soft_wrap=True)
        return ExitStatus.SUCCESS
    return ExitStatus.INTERRUPTED if interrupted else ExitStatus.FAILURE


def write_files(writers: Writers, *, beside: bool = False) -> tuple[list[Path], list[InputError]]:
    """Try to write each file without interruption; `beside` one that is there already, under a name of its own."""
    written, failures = list[Path](), list[InputError]()
    with without_interruption():
        for path, write in writers.items():
            place = add_to_stem(path, INTERRUPTED_STEM) if beside and path.exists() else path
            try:
                write(place)
                written.append(place)
            except InputError as error:
                failures.append(error)
    return written, failures


def read_fit_and_tuning(path: Path, tuning: Path) -> tuple[StoredFit, Tuning, ParameterSet]:
    """Read a fit, the loop and its parameters; those of the plant are fixed."""
    fit = read_fit(path)
    plant = fit.parameters
    task = read_tuning(tuning, fit.drive.system(), plant)
    warn_of_status(fit)
    return fit, task, plant.fixed(*plant.free_names) | task.parameters


def warn_of_status(file: StoredFit | Path) -> None:
    """Say on standard error what `describe_status` finds."""
    for sentence in describe_status(file):
        warn(sentence)


def describe_status(file: StoredFit | Path) -> tuple[str, ...]:
    """Whether a fit, or the tuning in a file, did not converge, and which estimates may be biased, a sentence each."""
    if isinstance(file, Path):
        status = read_status(file)
        return () if status is None or status.code is Code.CONVERGED else (f"{file}: its tuning is {status}",)
    status, sentences = file.status, list[str]()
    if status is not None and status.code is not Code.CONVERGED:
        sentences.append(f"{file.path}: its fit is {status}")
    biased = [n for n, mark in file.marks.items() if mark is Mark.BIAS_POSSIBLE]
    if biased and (status is None or status.converged):
        sentences.append(f"{file.path}: estimates that may be biased by a model error: {', '.join(biased)}")
    return tuple(sentences)


def warn(message: str) -> None:
    """Say on standard error what does not stop the command."""
    show_sentence(make_console(error=True), f"warning: {message}")


def add_to_stem(path: Path, name: str) -> Path:
    """fit.png and "friction" make fit_friction.png."""
    return path.with_stem(f"{path.stem}_{name}")


def number_paths(path: Path, count: int) -> list[Path]:
    """One file a run: run.csv, or run_1.csv, run_2.csv."""
    return [path] if count == 1 else [add_to_stem(path, str(k)) for k in range(1, count + 1)]


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
    """The SHA-256 of each TOML file as it was read, for provenance."""
    return {f"sha256[{path.name}]": hashlib.sha256(read_toml_source(path)).hexdigest() for path in paths}


def expand_patterns(paths: Sequence[Path]) -> list[Path]:
    """Expand the patterns that the shell has left alone, as on Windows."""
    found: list[Path] = []
    for path in paths:
        is_pattern = any(c in path.name for c in "*?[") and not path.exists()
        found += sorted(path.parent.glob(path.name)) if is_pattern else [path]
    require(bool(found), f"{paths[0]}: no file matches; check the name and the folder")
    return found


@dataclass(frozen=True)
class ScreenStyle:
    """How progress is shown."""

    seconds_a_line: float = 5.0  # where there is no terminal: less fills a record, more looks like a hang


SCREEN = ScreenStyle()
_TONE_STYLES = {
    Tone.PLAIN: "",
    Tone.HEADING: "bold",
    Tone.GOOD: "bold green",
    Tone.DOUBTFUL: "bold yellow",
    Tone.BAD: "bold red",
}


def make_console(*, error: bool = False) -> Console:
    """Standard output, or standard error; no text is read as markup, because names of columns have brackets."""
    plain = bool(os.environ.get("NO_COLOR"))  # https://no-color.org; rich alone would still write bold
    colours: dict[str, Any] = {"color_system": None} if plain else {}
    return Console(file=sys.stderr if error else sys.stdout, markup=False, highlight=False, emoji=False, **colours)


@contextmanager
def progress(label: str, *, quiet: bool) -> Iterator[ProgressCallback]:
    """Yield a function that shows a line of news and the time: in place on a terminal, else every few seconds."""
    console = make_console(error=True)
    if quiet:
        yield lambda _: None
    elif not console.is_terminal or console.is_dumb_terminal or console.color_system is None:
        with _print_lines(label) as report:
            yield report
    else:
        clock = TimeElapsedColumn(table_column=Column(min_width=7))
        news = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        with Progress(SpinnerColumn(), clock, news, console=console, transient=True) as bar:
            task = bar.add_task(label, total=None)
            yield lambda text: bar.update(task, description=text)


@contextmanager
def _print_lines(label: str) -> Iterator[ProgressCallback]:
    """Print the latest report on standard error every `seconds_a_line`, by a thread: a step may take longer."""
    begun, ended, latest, stream = time.monotonic(), threading.Event(), [""], sys.stderr

    def print_latest() -> None:
        while not ended.wait(SCREEN.seconds_a_line):
            news = f": {latest[0]}" if latest[0] else ""
            with suppress(OSError, ValueError):  # whoever read it has closed the pipe; the work goes on
                print(f"{label}, {time.monotonic() - begun:.0f} s{news}", file=stream, flush=True)

    thread = threading.Thread(target=print_latest, daemon=True)
    thread.start()
    try:
        yield lambda text: latest.__setitem__(0, text)
    finally:
        ended.set()
        thread.join(SCREEN.seconds_a_line)


def show_report(console: Console, report: Report) -> None:
    """Print a report as wide as the terminal; in a pipe its sentences in one piece, as a program reads them."""
    for text, tone in report.lines(console.width, sentences=None if console.is_terminal else 0):
        console.print(Text(text, style=_TONE_STYLES[tone]), soft_wrap=True)


def show_sentence(console: Console, text: str, *, indent: int = 0) -> None:
    """A sentence in one piece; on a terminal in lines that end between words, the second one indented by two more."""
    show_report(console, Report((Line(text, indent=indent),)))


def show_output_files(console: Console, paths: Sequence[Any]) -> None:
    """The files that were written."""
    for path in paths:
        console.print(f"wrote {path}", soft_wrap=True)


def show_pairs(console: Console, pairs: Mapping[str, object]) -> None:
    """Names and their values, a line each."""
    width = max(len(n) for n in pairs)
    for key, value in pairs.items():
        console.print(f"{key:<{width}}  {value}", soft_wrap=True)
