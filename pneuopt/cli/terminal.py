"""The terminal: a progress line, how a run ended, the files it wrote, and what every table shares."""

import math
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from pneuopt.quantities.status import Code, ProgressCallback, Status


def make_console(*, error: bool = False) -> Console:
    """Standard output, or standard error; no text is read as markup, because names of columns have brackets."""
    return Console(file=sys.stderr if error else sys.stdout, markup=False, highlight=False, emoji=False)


@contextmanager
def progress(label: str, *, quiet: bool) -> Iterator[ProgressCallback]:
    """Show the latest report and the time in one line; nothing if quiet, or where standard error is no terminal.

    Parameters
    ----------
    label : str
        Shown until there is a report.
    quiet : bool

    Yields
    ------
    callable
        Takes a line of text.
    """
    console = make_console(error=True)
    silent = quiet or not console.is_terminal
    clock = TimeElapsedColumn(table_column=Column(min_width=7))
    news = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    columns = SpinnerColumn(), clock, news
    with Progress(*columns, console=console, transient=True, disable=silent) as bar:
        task = bar.add_task(label, total=None)
        yield lambda text: bar.update(task, description=text)


def show_status(console: Console, status: Status) -> None:
    """How a computation ended: the verdict in bold, then its details, a line each."""
    verdict, *details = str(status).splitlines()
    colour = "yellow" if status.code in (Code.MISFIT, Code.PARTIAL) else "green" if status.converged else "red"
    show_sentence(console, verdict, style=f"bold {colour}")
    for detail in details:
        show_sentence(console, detail.strip(), indent=2)


def show_sentence(console: Console, text: str, *, indent: int = 0, style: str = "") -> None:
    """A sentence in one piece; on a terminal in lines that end between words, the second one indented by two more."""
    lines = [" " * indent + text]
    if console.is_terminal:
        lines = textwrap.wrap(
            lines[0],
            console.width,
            subsequent_indent=" " * (indent + 2),
            break_long_words=False,
            break_on_hyphens=False,
        )
    for line in lines:
        console.print(Text(line, style=style), soft_wrap=True)


def show_output_files(console: Console, paths: Sequence[Any]) -> None:
    """The files that were written."""
    for path in paths:
        console.print(f"wrote {path}", soft_wrap=True)


def show_pairs(console: Console, pairs: Mapping[str, object]) -> None:
    """Names and their values, a line each."""
    width = max(len(n) for n in pairs)
    for key, value in pairs.items():
        console.print(f"{key:<{width}}  {value}", soft_wrap=True)


def new_table(*columns: str) -> Table:
    """An empty table; texts stand left, numbers right."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for column in columns:
        text = column in (
            "parameter",
            "requirement",
            "new plants",
            "relaxed alone",
            "model",
            "contains",
            "log",
            "channel",
            "certified",
            "rejected",
            "best so far",
            "unit",
            "mark",
            "in log",
            "",
        )
        whole = column in ("certified", "rejected", "best so far", "new plants")
        table.add_column(column, justify="left" if text else "right", overflow="fold", no_wrap=whole)
    return table


def format_number(value: float, digits: int) -> str:
    """A number for a table, "-" where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}g}"
