"""The package runs on Windows and macOS, by reading: what only some systems have is asked for before it is used."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = (
    "crypt curses fcntl grp nis ossaudiodev posix pty pwd readline resource spwd syslog termios tty "
    "msvcrt winreg winsound"
)
OS = (
    "chown chroot confstr ctermid dup3 fchdir fchmod fchown fdatasync fork forkpty fpathconf fstatvfs getegid geteuid "
    "getgid getgroups getloadavg getpgid getpgrp getpriority getresgid getresuid getsid getuid initgroups killpg "
    "lchflags lchmod lchown lockf major makedev memfd_create minor mkfifo mknod nice openpty pathconf pipe2 "
    "posix_fadvise posix_fallocate posix_spawn posix_spawnp pread preadv pwrite pwritev readv register_at_fork "
    "sched_getaffinity sched_getparam sched_getscheduler sched_setaffinity sched_yield sendfile setegid seteuid setgid "
    "setgroups setpgid setpriority setregid setreuid setsid setuid statvfs sync sysconf tcgetpgrp tcsetpgrp ttyname "
    "uname wait wait3 wait4 waitid writev startfile O_CLOEXEC O_DIRECTORY O_DSYNC O_NOCTTY O_NOFOLLOW O_NONBLOCK "
    "O_SYNC O_BINARY"
)
SIGNAL = (
    "SIGALRM SIGBREAK SIGBUS SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGPROF SIGPWR SIGQUIT SIGSTOP SIGSYS "
    "SIGTRAP SIGTSTP SIGTTIN SIGTTOU SIGURG SIGUSR1 SIGUSR2 SIGVTALRM SIGWINCH SIGXCPU SIGXFSZ CTRL_C_EVENT "
    "CTRL_BREAK_EVENT alarm getitimer pause pthread_kill pthread_sigmask setitimer siginterrupt sigpending "
    "sigtimedwait sigwait sigwaitinfo"
)
OTHERS = {"os": OS, "signal": SIGNAL, "time": "tzset clock_gettime pthread_getcpuclockid", "socket": "AF_UNIX"}
"""Names that Python's documentation gives an availability for which is not everywhere, by module."""
ASKS = ("hasattr(", "getattr(", "AttributeError", "os.name", "sys.platform", "platform.system()")


def find_unguarded(source: str) -> Iterator[str]:
    """Each use of what only some systems have, in a function that does not ask whether it is there."""
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    scopes = [*functions, *(node for node in tree.body if not isinstance(node, (ast.FunctionDef, ast.ClassDef)))]
    asking = {id(inner) for scope in scopes if any(a in ast.unparse(scope) for a in ASKS) for inner in ast.walk(scope)}
    for node in ast.walk(tree):
        if id(node) in asking:
            continue
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in OTHERS.get(node.value.id, "").split():
                yield f"{node.lineno}: {node.value.id}.{node.attr}"
        elif isinstance(node, ast.Import):
            yield from (f"{node.lineno}: import {a.name}" for a in node.names if a.name in MODULES.split())
        elif isinstance(node, ast.ImportFrom):
            names = {a.name for a in node.names}.intersection(OTHERS.get(node.module or "", "").split())
            if names or node.module in MODULES.split():
                yield f"{node.lineno}: from {node.module} import {', '.join(sorted(names))}"
        elif isinstance(node, ast.Call) and [a.value for a in node.args if isinstance(a, ast.Constant)] == ["fork"]:
            yield f"{node.lineno}: {ast.unparse(node)}"


@pytest.mark.parametrize("path", sorted((ROOT / "pneuopt").rglob("*.py")), ids=str)
def test_nothing_is_used_that_only_some_systems_have(path: Path) -> None:
    assert list(find_unguarded(path.read_text("utf-8"))) == []


@pytest.mark.parametrize(
    "source",
    [
        "import fcntl",
        "from os import fork",
        "import os\ndef f():\n    os.getuid()",
        "import signal\nHANDLED = (signal.SIGTERM, signal.SIGHUP)",
        "from multiprocessing import get_context\nget_context('fork')",
        "import os\nif hasattr(os, 'fork'):\n    pass\nos.fork()",
    ],
)
def test_such_a_use_is_found(source: str) -> None:
    assert len(list(find_unguarded(source))) == 1


def test_a_use_that_is_asked_for_is_none() -> None:
    assert not list(find_unguarded("import os\ndef f():\n    if hasattr(os, 'getuid'):\n        os.getuid()"))
    assert not list(find_unguarded("import os, signal\ndef f():\n    os.getpid()\n    signal.SIGINT"))
