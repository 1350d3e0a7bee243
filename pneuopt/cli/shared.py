"""What the commands share: the files they read, those they write once everything is computed, and the terminal.

`run_guarded`: runs the command line and survives streams that fail, signals and unforeseen errors.

It imports nothing but the standard library, so that it listens from the first moment on. By Ctrl-C, SIGTERM or the
closing of the terminal a command ends soon, with the best so far, and its files whole: the first signal raises
KeyboardInterrupt, after which a command only writes what it has. A second one within `PATIENCE` changes nothing, for
many press twice; a later one ends the process at once. Where the main thread is in foreign code that hears no signal,
another thread ends the process after `PATIENCE`.
"""

import errno
import hashlib
import io
import math
import os
import platform
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from pneuopt.cli.tolerances import PATIENCE, RETURN, SECONDS_A_LINE
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
    from _typeshed import ReadableBuffer

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
        drawn, missed = _draw(outputs.plot, figures)
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
        show_hints(make_console(), hints)
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


def _draw(path: Path, figures: Figures) -> tuple[list[Path], list[InputError]]:
    """Draw and write the figures; Ctrl-C leaves out those that are not drawn yet."""
    try:
        return write_files(figure_writers(path, figures()))
    except KeyboardInterrupt:
        return [], []


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


def figure_writers(path: Path, figures: Mapping[str, "Figure"]) -> Writers:
    """Each figure in a file of its own, the one without a name at the path itself."""
    places = {name: add_to_stem(path, name) if name else path for name in figures}
    return {places[name]: partial(save_figure, figure) for name, figure in figures.items()}


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
    """Print the latest report on standard error every `SECONDS_A_LINE`, by a thread: a step may take longer."""
    begun, ended, latest, stream = time.monotonic(), threading.Event(), [""], sys.stderr

    def print_latest() -> None:
        while not ended.wait(SECONDS_A_LINE):
            news = f": {latest[0]}" if latest[0] else ""
            with suppress(OSError, ValueError):  # whoever read it has closed the pipe; the work goes on
                print(f"{label}, {time.monotonic() - begun:.0f} s{news}", file=stream, flush=True)

    thread = threading.Thread(target=print_latest, daemon=True)
    thread.start()
    try:
        yield lambda text: latest.__setitem__(0, text)
    finally:
        ended.set()
        thread.join(SECONDS_A_LINE)


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


def show_hints(console: Console, hints: Sequence[str]) -> None:
    """Commands that may come next, a line each."""
    for k, hint in enumerate(hints):
        console.print(Text(f"{'' if k else 'Next:':<5} {hint}"), soft_wrap=True)


def show_pairs(console: Console, pairs: Mapping[str, object]) -> None:
    """Names and their values, a line each."""
    width = max(len(n) for n in pairs)
    for key, value in pairs.items():
        console.print(f"{key:<{width}}  {value}", soft_wrap=True)


def run_guarded(load: Callable[[], Callable[[], object]]) -> NoReturn:
    """Run the command line that `load` imports, and end the process; never with a traceback."""
    streams = _guard_streams()
    listen_to_signals()
    status = _run(load)
    command_is_over()
    stopped = interruption_status()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    errors = [raw.error for raw in streams if raw.fileno() == 1]
    lost = next((e for e in errors if e is not None and e.errno != errno.EPIPE), None)  # EPIPE: its reader just left
    if lost is not None and status == 0 and stopped is None:
        _say(f"error: standard output cannot be written ({lost.strerror}); the files that were asked for are written")
        status = ExitStatus.OUTPUT_LOST
    sys.exit(status if stopped is None else stopped)


class ExitStatus(IntEnum):
    """How a command ends; scripts may rely on these. By SIGTERM it ends with 143."""

    SUCCESS = 0
    FAILURE = 1  # not converged, not certified, no interval that holds; in a study a case failed or never settles
    BAD_INPUT = 2  # something that the user gave cannot be used; Typer's own where an option is wrong
    UNFORESEEN = 70  # an error that nobody foresaw, sysexits' EX_SOFTWARE: one line names a file with the details
    OUTPUT_LOST = 74  # the screen could not be written, sysexits' EX_IOERR; the files that were asked for are
    INTERRUPTED = 130  # Ctrl-C: 128 + the number of SIGINT, as shells have it


class LastingFile(io.FileIO):
    """A stream that may fail: what cannot be written is dropped and the reason kept, so that the work is not lost."""

    error: OSError | None = None

    def write(self, data: "ReadableBuffer", /) -> int:
        """Write what can be written; the rest counts as written."""
        if self.error is None:
            try:
                return super().write(data) or 0
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes


def _run(load: Callable[[], Callable[[], object]]) -> int:
    try:
        load()()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        _say("interrupted: no file was left half-written")
    except BaseException as error:
        if interruption_status() is not None:  # foreign code that turns an interruption into an error of its own
            _say("interrupted: no file was left half-written")
        else:
            frames = traceback.extract_tb(error.__traceback__)
            place = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
            reason = " ".join(f"{type(error).__name__}{place}: {error}".split()).removesuffix(":")
            file = _write_details(error)
            where = f"the details are in {file}; please send it" if file else "run it again with a folder to write to"
            _say(f"error: unforeseen, a bug of pneuopt: {reason[:160]}; {where}")
            return ExitStatus.UNFORESEEN
    return 0


def _guard_streams() -> list[LastingFile]:
    """Standard output and error as streams that may fail; missing ones go nowhere, and so hit no other file."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free, this one
    guarded = []
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is not None and os.name == "nt" and stream.isatty():  # a console, which takes no bytes
            stream.reconfigure(errors="replace")
            continue
        encoding = getattr(stream, "encoding", None) or "utf-8"
        raw = LastingFile(number, "w", closefd=False)
        # a letter that the encoding lacks shows as "?" instead of failing
        text = io.TextIOWrapper(io.BufferedWriter(raw), encoding, errors="replace", line_buffering=raw.isatty())
        setattr(sys, name, text)
        guarded.append(raw)
    return guarded


def _write_details(error: BaseException) -> Path | None:
    """Traceback, versions and command in a file; None where there is no folder for it."""
    try:
        from importlib.metadata import distributions

        versions = sorted({f"{d.name} {d.version}" for d in distributions()})
    except Exception:
        versions = []
    head = [f"command: {sys.argv}", f"folder: {Path.cwd()}", f"python: {sys.version}", platform.platform(), *versions]
    text = "\n".join([*head, "", *traceback.format_exception(error)])
    name = f"pneuopt-error-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
    for folder in (tempfile.gettempdir, Path.cwd):
        try:
            path = Path(folder()) / name
            path.write_text(text, encoding="utf-8", errors="replace")
        except OSError:
            continue
        return path
    return None


def _say(sentence: str) -> None:
    sys.stderr.write(f"{sentence}\n")


class _State:
    """What a process knows of its interruption: the signal, when it came, and whether it has to wait for a file."""

    number: int | None = None
    since: float = 0.0
    is_lost = False
    is_shielded = False
    is_pending = False
    is_over = False


def listen_to_signals() -> None:
    """End this process's command by signals, as the module says; those that it was started without stay ignored."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):  # the last one on Windows, SIGHUP elsewhere
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    heard, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(heard, wake), name="pneuopt-signals", daemon=True).start()
    sys.unraisablehook = _notice_lost


def interruption_status() -> int | None:
    """The exit status of an interrupted command, 128 + the signal's number as shells have it; None: go on."""
    return None if _State.number is None else 128 + _State.number


@contextmanager
def without_interruption() -> Iterator[None]:
    """Let files be written whole: a signal within is heard at the end."""
    _State.is_shielded = True
    try:
        yield
    finally:
        _State.is_shielded = False
        pending, _State.is_pending = _State.is_pending, False
    if pending:
        raise KeyboardInterrupt


def command_is_over() -> None:
    """From now on a signal ends the process at once: there is nothing to keep any more."""
    _State.is_over = True


def end_at_once(status: int) -> None:
    """End the process without a word more: what it wrote is whole, for files are renamed when they are complete."""
    os.write(2, b"interrupted: no file was left half-written\n")
    os._exit(status)


def _interrupt(number: int, _frame: FrameType | None) -> None:
    if _State.is_over:
        os._exit(128 + number)
    if _State.number is not None and not _State.is_lost:
        if time.monotonic() - _State.since > PATIENCE:
            end_at_once(128 + number)
        return
    if not _State.is_lost:
        _State.number, _State.since = number, time.monotonic()
    _State.is_lost = False
    if _State.is_shielded:
        _State.is_pending = True
        return
    raise KeyboardInterrupt


def _notice_lost(unraisable: "sys.UnraisableHookArgs") -> None:
    """Where Python can raise nothing, in a destructor or at an import's end, an interruption comes again soon after."""
    if _State.number is None or not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    _State.is_lost = True
    threading.Thread(target=_send_again, args=(_State.number,), daemon=True).start()


def _send_again(number: int) -> None:
    """Send the signal to the main thread, which is out of the destructor by then, or hears it again."""
    time.sleep(RETURN)
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)


def _watch(heard: socket.socket, _wake: socket.socket) -> None:
    """Wait for a signal; end the process if its main thread has not heard it in time."""
    while (received := heard.recv(1)) and not sys.is_finalizing():
        time.sleep(PATIENCE)
        ends = {number for number in signal.Signals if signal.getsignal(number) is _interrupt}
        if _State.number is None and received[0] in ends:
            end_at_once(128 + received[0])
