"""Ctrl-C, SIGTERM and the closing of the terminal: a command ends soon, with the best so far, and its files whole.

The first signal raises KeyboardInterrupt, after which a command only writes what it has. A second one within
`PATIENCE` changes nothing, for many press twice; a later one ends the process at once. Where the main thread is in
foreign code that hears no signal, another thread ends the process after `PATIENCE`.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

PATIENCE = 1.7
"""Time that a command may take to end [s]: more looks like a hang; less throws away what it was about to write."""

RETURN = 0.02
"""Time until a lost interruption comes again [s]: less may meet the same destructor; more delays the end."""


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
        if _State.number is None and received[0] in _numbers():
            end_at_once(128 + received[0])


def _numbers() -> set[int]:
    """The signals that end a command here."""
    return {number for number in signal.Signals if signal.getsignal(number) is _interrupt}
