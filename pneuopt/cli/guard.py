"""`run_guarded`: the last that stands between a command and the user: streams that fail, signals, unforeseen errors.

It imports nothing but the standard library, so that it listens from the first moment on.
"""

import errno
import io
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from pneuopt.cli.exit_status import EXIT_OUTPUT_LOST, EXIT_UNFORESEEN
from pneuopt.cli.interruption import command_is_over, interruption_status, listen_to_signals

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

SHOWN_REASON = 160
"""Length of an unforeseen error's words on the screen [character]: more fills it; the file has them all."""


def run_guarded(load: Callable[[], Callable[[], object]]) -> NoReturn:
    """Run the command line and end the process; never a traceback.

    Parameters
    ----------
    load : callable
        Imports the command line and returns it.
    """
    streams = _guard_streams()
    listen_to_signals()
    status = _run(load)
    command_is_over()
    stopped = interruption_status()
    lost = _flush(streams)
    if lost is not None and status == 0 and stopped is None:
        _say(f"error: standard output cannot be written ({lost.strerror}); the files that were asked for are written")
        status = EXIT_OUTPUT_LOST
    sys.exit(status if stopped is None else stopped)


class LastingFile(io.FileIO):
    """A stream that may fail: what cannot be written is dropped and the reason kept, so that the work is not lost.

    Attributes
    ----------
    error : OSError or None
    """

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
            _report_unforeseen(error)
            return EXIT_UNFORESEEN
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


def _flush(streams: list[LastingFile]) -> OSError | None:
    """Write out what is buffered; returns why standard output is lost, but not where its reader just left."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    errors = [raw.error for raw in streams if raw.fileno() == 1]
    return next((e for e in errors if e is not None and e.errno != errno.EPIPE), None)


def _report_unforeseen(error: BaseException) -> None:
    """One line, and a file with the details."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    reason = " ".join(f"{type(error).__name__}{place}: {error}".split()).removesuffix(":")
    file = _write_details(error)
    where = f"the details are in {file}; please send it" if file else "run it again with a folder to write to"
    _say(f"error: unforeseen, a bug of pneuopt: {reason[:SHOWN_REASON]}; {where}")


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
