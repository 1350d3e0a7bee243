"""`run_guarded`: runs the command line and survives streams that fail, signals and unforeseen errors.

It imports nothing but the standard library, so that it listens from the first moment on. By Ctrl-C, SIGTERM or the
closing of the terminal a command ends soon, with the best so far, and its files whole: the first signal raises
KeyboardInterrupt, after which a command only writes what it has. A second one within `_State.patience` changes
nothing, for many press twice; a later one ends the process at once. Where the main thread is in foreign code that
hears no signal, another thread ends the process after that time.
"""

import errno
import io
import os
import platform
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


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

    # time that a command may take to end [s]: more looks like a hang; less throws away what it was about to write
    patience = 1.7
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
        if time.monotonic() - _State.since > _State.patience:
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
    _State.is_lost, number, main = True, _State.number, threading.main_thread().ident

    def send_again(after: float = 0.02) -> None:  # [s]: less may meet the same destructor; more delays the end
        time.sleep(after)
        if hasattr(signal, "pthread_kill") and main is not None:
            signal.pthread_kill(main, number)
        else:
            signal.raise_signal(number)

    threading.Thread(target=send_again, daemon=True).start()


def _watch(heard: socket.socket, _wake: socket.socket) -> None:
    """Wait for a signal; end the process if its main thread has not heard it in time."""
    while (received := heard.recv(1)) and not sys.is_finalizing():
        time.sleep(_State.patience)
        ends = {number for number in signal.Signals if signal.getsignal(number) is _interrupt}
        if _State.number is None and received[0] in ends:
            end_at_once(128 + received[0])
