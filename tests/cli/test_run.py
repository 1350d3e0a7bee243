"""The last that stands between a command and the user: streams that fail, signals, errors that nobody foresaw."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

posix = pytest.mark.skipif(os.name == "nt", reason="signals, /dev/full and closed descriptors are POSIX")
START = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits it as ignored
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # as does one under nohup
from pneuopt.cli.run import run_guarded
from pneuopt.cli.run import without_interruption
def say_ready():
    os.write(1, b"ready\\n")  # no buffer, which a signal that comes at once would leave full, to be written twice
"""


def guarded(body: str, *, redirect: str = "", settings: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """A process in which `command` is a command; in a shell that redirects its streams."""
    program = f"{START}\n{body}\nrun_guarded(lambda: command)"
    line: Sequence[str] = [sys.executable, "-c", program]
    if redirect:
        line = ["/bin/sh", "-c", f'exec "$@" {redirect}', "sh", *line]
    pipe = subprocess.PIPE
    return subprocess.Popen(line, stdout=pipe, stderr=pipe, text=True, env={**os.environ, **(settings or {})})


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


WRITES = """
from pathlib import Path
def command():
    for k in range(20000):
        print("figures and tables")
    Path("fit.toml").write_text("found")
"""


@posix
@pytest.mark.parametrize(
    ("redirect", "status", "said"),
    [
        (">/dev/full", 74, "standard output cannot be written (No space left on device); the files that were asked"),
        (">&-", 0, ""),
        (">&- 2>&-", 0, ""),
        (">&- 2>&- <&-", 0, ""),
        (">/dev/full 2>/dev/full", 74, ""),
    ],
)
def test_a_screen_that_fails_costs_no_file(
    redirect: str, status: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = ended(guarded(WRITES, redirect=redirect))
    assert code == status
    assert said in err
    assert len(err.splitlines()) == bool(said)
    assert Path("fit.toml").read_text() == "found"


@posix
def test_a_reader_that_leaves_is_nothing_to_speak_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    process = guarded(WRITES)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait(60) == 0
    assert Path("fit.toml").read_text() == "found"


@pytest.mark.parametrize(
    "error", ["ZeroDivisionError('by nought' * 100)", "RecursionError()", "MemoryError()", "BaseException('odd')"]
)
def test_what_nobody_foresaw_is_one_line_and_a_file(error: str, tmp_path: Path) -> None:
    body = f"def command():\n    raise {error}"
    code, out, err = ended(guarded(body, settings={"TMPDIR": str(tmp_path), "TEMP": str(tmp_path)}))
    assert (code, out) == (70, "")
    assert len(err.splitlines()) == 1
    assert "Traceback" not in err
    found = re.search(r"the details are in (\S+); please send it", err)
    assert found is not None, err
    details = Path(found[1]).read_text("utf-8")
    for word in ("Traceback", error.partition("(")[0], "casadi", "command: ['-c']", sys.version.split()[0]):
        assert word in details


def test_a_status_is_handed_on() -> None:
    assert ended(guarded("def command():\n    sys.exit(3)"))[0] == 3
    assert ended(guarded("def command():\n    sys.exit()"))[0] == 0


def interrupt_when_ready(process: subprocess.Popen[str], *pauses: float, number: int = signal.SIGINT) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    for pause in pauses:
        time.sleep(pause)
        process.send_signal(number)


@posix
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_a_command_with_its_status_and_a_line(number: int, status: int) -> None:
    process = guarded("import time\ndef command():\n    say_ready()\n    time.sleep(60)")
    interrupt_when_ready(process, 0.0, number=number)
    assert ended(process) == (status, "", "interrupted: no file was left half-written\n")


@posix
def test_a_file_is_written_whole_before_an_interruption_is_heard() -> None:
    body = """
import time
def command():
    with without_interruption():
        say_ready()
        time.sleep(0.5)
        print("written", flush=True)
    print("never", flush=True)
"""
    process = guarded(body)
    interrupt_when_ready(process, 0.0)
    assert ended(process) == (130, "written\n", "interrupted: no file was left half-written\n")


@posix
def test_pressed_twice_loses_nothing_and_pressed_later_ends_at_once() -> None:
    body = """
import time
def command():
    try:
        say_ready()
        time.sleep(60)
    except KeyboardInterrupt:
        time.sleep(1.0)
        print("kept", flush=True)
        time.sleep(60)
"""
    process = guarded(body)
    interrupt_when_ready(process, 0.0, 0.2, 3.0)
    code, out, _ = ended(process)
    assert (code, out) == (130, "kept\n")


@posix
def test_a_signal_is_heard_where_python_can_raise_nothing() -> None:
    """In a destructor, say, an exception is printed and forgotten."""
    body = """
import time
class Odd:
    def __del__(self):
        say_ready()
        time.sleep(60)
def command():
    Odd()
    time.sleep(60)
"""
    process = guarded(body)
    interrupt_when_ready(process, 0.0)
    assert ended(process) == (130, "", "interrupted: no file was left half-written\n")


@posix
def test_ctrl_c_before_anything_is_imported_says_nothing() -> None:
    program = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Finder:
    def find_spec(self, name, *_):
        if name == "pneuopt.cli.run":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
from pneuopt.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


@posix
def test_foreign_code_that_hears_no_signal_is_ended() -> None:
    """A call of C that returns only when it is done, as a long parse or decomposition does."""
    body = """
import ctypes
def command():
    say_ready()
    ctypes.CDLL(None).pause  # a loop of sleeps, for a signal ends a single one
    wait = ctypes.CDLL(None).pthread_join
    import threading, _thread
    done = ctypes.c_void_p()
    thread = ctypes.c_ulong()
    function = ctypes.CDLL(None).pause
    ctypes.CDLL(None).pthread_create(ctypes.byref(thread), None, ctypes.cast(function, ctypes.c_void_p), None)
    wait(thread, None)
"""
    process = guarded(body)
    interrupt_when_ready(process, 0.3)
    assert ended(process)[0] == 130
