"""`compile_library`: C source compiled and loaded as a library, from the cache where it was compiled before."""

import contextlib
import ctypes
import functools
import logging
import os
import platform
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from pneuopt.dynamics.compiled.library_cache import (
    COMPILE_FOLDER_PREFIX,
    cache_directory,
    discard_library,
    find_library,
    keep_library,
)
from pneuopt.dynamics.compiled.toolchain import (
    COMPILER_FLAGS,
    LINKER_FLAGS,
    Compiler,
    explain_missing_compiler,
    find_compiler,
)

COMPILE_TIMEOUT = 300  # [s]; below, large models on slow machines fall back to the VM; above, a hung compiler blocks
logger = logging.getLogger("pneuopt")


@functools.cache
def compile_library(source: str, *definitions: str) -> ctypes.CDLL | None:
    """Compile a source, or load its product from the cache; None where that cannot be done, which is said once.

    Parameters
    ----------
    source : str
        The same one, compiled or not, is answered from memory.
    *definitions : str
        Macros, each tried after the one before it failed (``"LANES=1"``); none: the source as it is.
    """
    cc = find_compiler()
    if cc is None:
        warn_once(explain_missing_compiler())
        return None
    detail = ""
    for definition in definitions or ("",):
        try:
            library = _load_library(cc, (*COMPILER_FLAGS, f"-D{definition}") if definition else COMPILER_FLAGS, source)
        except (OSError, subprocess.SubprocessError) as error:
            detail = detail or _reason(error)[:400]
            continue
        if detail:
            warn_once(f"{cc} compiles no SIMD lanes: models run several times slower, with the same answers: {detail}")
        return library
    warn_once(f"compiling with {cc} failed, the CasADi VM runs instead, with the same answers: {detail}")
    return None


def _reason(error: OSError | subprocess.SubprocessError) -> str:
    """The compiler's error text, or the signal that killed it."""
    if isinstance(error, subprocess.CalledProcessError) and not error.stderr:
        code = error.returncode
        return f"it was killed by signal {-code}" if code < 0 else f"it ended with exit status {code}"
    if isinstance(error, subprocess.TimeoutExpired):
        return f"it took more than {error.timeout:g} s"
    return str(getattr(error, "stderr", None) or error)


def _load_library(cc: Compiler, flags: tuple[str, ...], source: str) -> ctypes.CDLL:
    identity = "\0".join([source, *flags, str(cc), cc.identity, platform.processor(), _cpu_identity()])
    folder = cache_directory()
    binary = find_library(folder, identity)
    if binary is not None:
        try:
            return ctypes.CDLL(str(binary))
        except OSError:  # whole, but of a system whose loader has changed
            discard_library(binary)
    return ctypes.CDLL(str(_compile(cc, flags, source, folder, identity)))


def _compile(cc: Compiler, flags: tuple[str, ...], source: str, cache: Path, identity: str) -> Path:
    """Compile in a temporary folder, then move the binary: another process may do the same, or this one be killed."""
    with tempfile.TemporaryDirectory(prefix=COMPILE_FOLDER_PREFIX, dir=cache) as folder:
        text, product = Path(folder) / "model.c", Path(folder) / "model.so"
        text.write_text(source, encoding="utf-8")
        # what zig keeps for all libraries, its C runtime, has its place; what it makes for this one is not wanted
        folders = {"ZIG_GLOBAL_CACHE_DIR": str(cache / "zig"), "ZIG_LOCAL_CACHE_DIR": folder}
        command = [*cc.command, *flags, str(text), "-o", str(product), *LINKER_FLAGS]
        _run_compiler(command, {**folders, **os.environ})
        return keep_library(cache, identity, product)


def _run_compiler(command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    """Run a compiler; where we are interrupted, or it hangs, all its processes end with it."""
    with subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            out, err = process.communicate(timeout=COMPILE_TIMEOUT)
        except BaseException:
            _end_with_children(process)
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, out, err)


def _end_with_children(process: "subprocess.Popen[str]") -> None:
    """Kill a process and those that it started: a compiler is a driver of others, which would go on."""
    kill_group = getattr(os, "killpg", None)  # not on Windows
    with contextlib.suppress(OSError):
        if kill_group is None:
            process.kill()
        else:
            kill_group(process.pid, signal.SIGKILL)
    process.wait()


@functools.cache
def warn_once(message: str) -> None:
    """Warn, but not again in the same words."""
    logger.warning("%s", message)


@functools.cache
def _cpu_identity() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    return "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
