"""The terminal: a progress line, reports in colour, and the files that were written."""

import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.status import ProgressCallback

SECONDS_A_LINE = 5.0
"""Time between two lines of progress [s] where there is no terminal: less fills a record, more looks like a hang."""
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
    """Show the latest report and the time: in one line of a terminal, elsewhere in a line every few seconds.

    Parameters
    ----------
    label : str
        Shown until there is a report.
    quiet : bool
        Show nothing.

    Yields
    ------
    callable
        Takes a line of text.
    """
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
