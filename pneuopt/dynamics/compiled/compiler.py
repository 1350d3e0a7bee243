"""`compile_library`: C source compiled and loaded as a library, from the cache where it was compiled before.

First the compiler (`find_compiler`) and its flags, then compiling, then the cache (`cache_directory`, `find_library`).
A file is loaded only if it is whole and this user's own: it runs as our code. It is named by what it was made of
(source, flags, compiler, CPU) and by the hash of its bytes, so that one that is damaged, cut or exchanged does not fit
its name. Loading such a file ends the process (SIGBUS, SIGSEGV), or worse.
"""

import atexit
import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import logging
import os
import platform
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pneuopt.dynamics.tolerances import COMPILE_TIMEOUT, LARGEST_AGE, LARGEST_SIZE, NOTICE_TIME

COMPILERS = ("gcc", "clang", "cc")
# Apple's and other ARM compilers know the machine by another name.
_NATIVE = "-mcpu=native" if platform.machine().lower() in ("arm64", "aarch64") else "-march=native"
# A product and a sum of one expression may become one operation, as gcc does by default: clang's own rule is another.
_ARITHMETIC = ("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast")
# Windows: all code is independent of its place, and the mathematical functions are in the C library.
_LIBRARY = ("-shared",) if os.name == "nt" else ("-shared", "-fPIC")
COMPILER_FLAGS = ("-O2", _NATIVE, *_ARITHMETIC, *_LIBRARY)
LINKER_FLAGS = () if os.name == "nt" else ("-lm",)
# What one line says where models run without a compiler. On data/force_rig a tuning takes three and a fit eight times
# as long; of a pneumatic drive, whose states and sensitivities are many, a fit takes more than twenty times as long.
NO_COMPILER = (
    "models run in the CasADi VM, with the same answers, three to thirty times slower (seconds become minutes); "
    'pip install "pneuopt[compiler]" adds a compiler (100 MB), gcc or clang on the path do as well'
)


@dataclass(frozen=True)
class Compiler:
    """A C compiler."""

    command: tuple[str, ...]  # the program, and the arguments that stand before all others

    def __str__(self) -> str:
        return shlex.join(self.command)

    @property
    def version(self) -> str:
        """The first line of what it says about itself; empty where it says nothing."""
        return next(iter(self.identity.splitlines()), "")

    @property
    def identity(self) -> str:
        """All that it says about itself."""
        return _read_version(self.command)


def find_compiler() -> Compiler | None:
    """The C compiler: of ``$PNEUOPT_CC`` (empty: none), ``$CC``, on the path, or of the extra ``compiler``; or None."""
    chosen = os.environ.get("PNEUOPT_CC")
    if chosen is not None:
        return _parse_command(chosen)
    found = _parse_command(os.environ.get("CC", ""))
    if found is not None:
        return found
    for path in filter(None, map(shutil.which, COMPILERS)):
        # macOS has such a gcc, clang and cc where Apple's tools are not, which only ask to install them
        if not (sys.platform == "darwin" and path.startswith("/usr/bin/")) or _has_apple_tools():
            return Compiler((path,))
    return _packaged_compiler()


def explain_missing_compiler() -> str:
    """Why there is no compiler, what that means, and what to install."""
    chosen = os.environ.get("PNEUOPT_CC")
    reason = f"PNEUOPT_CC={chosen!r} names no program" if chosen else "no C compiler found"
    return f"{reason}: {NO_COMPILER}"


def _parse_command(text: str) -> Compiler | None:
    """A program by its path, which may have blanks, or a command with arguments; None if it is not there."""
    program = shutil.which(text) if text else None
    if program is not None:
        return Compiler((program,))
    try:
        words = [word.strip('"') for word in shlex.split(text, posix=os.name != "nt")]
    except ValueError:  # a quotation that does not end
        return None
    program = shutil.which(words[0]) if words else None
    return None if program is None else Compiler((program, *words[1:]))


@functools.cache
def _has_apple_tools() -> bool:
    try:
        return subprocess.run(["xcode-select", "-p"], capture_output=True, timeout=30, check=False).returncode == 0
    except (OSError, subprocess.SubprocessError):
        return False


@functools.cache
def _packaged_compiler() -> Compiler | None:
    """The compiler of the package ziglang, if that is installed."""
    spec = importlib.util.find_spec("ziglang")
    for folder in (spec and spec.submodule_search_locations) or ():
        program = Path(folder) / ("zig.exe" if os.name == "nt" else "zig")
        if os.access(program, os.X_OK):
            return Compiler((str(program), "cc"))
    return None


@functools.cache
def _read_version(command: tuple[str, ...]) -> str:
    try:
        done = subprocess.run(
            [*command, "--version"], capture_output=True, text=True, errors="replace", timeout=30, check=False
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout


logger = logging.getLogger("pneuopt")


@functools.cache
def compile_library(source: str, *definitions: str) -> ctypes.CDLL | None:
    """Compile a source, or load its product from the cache; None where that cannot be done, which is said once.

    Each definition, a macro as ``LANES=1``, is tried after the one before it failed.
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
    # compile apart, then move the binary: another process may do the same, or this one be killed
    with tempfile.TemporaryDirectory(prefix=COMPILE_FOLDER_PREFIX, dir=folder) as apart:
        text, product = Path(apart) / "model.c", Path(apart) / "model.so"
        text.write_text(source, encoding="utf-8")
        # what zig keeps for all libraries, its C runtime, has its place; what it makes for this one is not wanted
        folders = {"ZIG_GLOBAL_CACHE_DIR": str(folder / "zig"), "ZIG_LOCAL_CACHE_DIR": apart}
        command = [*cc.command, *flags, str(text), "-o", str(product), *LINKER_FLAGS]
        _run_compiler(command, {**folders, **os.environ})
        binary = keep_library(folder, identity, product)
    return ctypes.CDLL(str(binary))


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
            # and those that it started: a compiler is a driver of others, which would go on
            kill_group = getattr(os, "killpg", None)  # not on Windows
            with contextlib.suppress(OSError):
                if kill_group is None:
                    process.kill()
                else:
                    kill_group(process.pid, signal.SIGKILL)
            process.wait()
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, out, err)


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


COMPILE_FOLDER_PREFIX = "compile-"


def cache_directory() -> Path:
    """Where libraries are kept: ``$PNEUOPT_CACHE`` or the platform's cache folder.

    Where that cannot be written to, or anybody may exchange files in it: a temporary folder, removed at the end.
    """
    try:
        base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
        home = "AppData/Local" if os.name == "nt" else ".cache"
        chosen = os.environ.get("PNEUOPT_CACHE")
        folder = Path(chosen) if chosen else (Path(base) if base else Path.home() / home) / "pneuopt"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_open_to_all(folder):
            return _temporary_folder(f"{folder}: other users may exchange files in it", os.getpid())
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError, ValueError) as error:  # no home is a RuntimeError, a NUL in a name a ValueError
        return _temporary_folder(f"{getattr(error, 'filename', None) or ''}: {error}".lstrip(": "), os.getpid())


def find_library(folder: Path, identity: str) -> Path | None:
    """The library that was made of this, if it is kept, whole and this user's own; others in its place are deleted."""
    for path in sorted(folder.glob(f"{_digest(identity)}-*.so")):
        if _is_own(path) and path.name == _library_name(identity, path.read_bytes()):
            with contextlib.suppress(OSError):  # its time becomes now, once a day
                if time.time() - path.stat().st_mtime > NOTICE_TIME:
                    os.utime(path)
            return path
        logger.debug("%s is damaged, or another user's: it is built anew", path)
        discard_library(path)
    return None


def keep_library(folder: Path, identity: str, product: Path) -> Path:
    """Move a library that was just built in `folder` to its place there; its bytes are on the disk before its name."""
    with product.open("r+b") as file:
        content = file.read()
        os.fsync(file.fileno())
    product.chmod(0o600)
    place = folder / _library_name(identity, content)
    with contextlib.suppress(PermissionError):  # Windows: another process has just loaded its own
        product.replace(place)
    trim_cache(folder, keep=place)
    return place


def cached_libraries(folder: Path) -> dict[Path, os.stat_result]:
    """The libraries in a cache, the one that was used last first."""
    found = dict[Path, os.stat_result]()
    for path in folder.glob("*.so"):
        with contextlib.suppress(OSError):  # another process has just deleted it
            found[path] = path.lstat()
    return dict(sorted(found.items(), key=lambda item: -item[1].st_mtime))


def trim_cache(folder: Path, keep: Path | None = None) -> None:
    """Delete libraries, but not `keep`, that are old or too many, and what killed processes left behind."""
    now, size = time.time(), 0
    for path, entry in cached_libraries(folder).items():
        size += entry.st_size
        if path != keep and (size > LARGEST_SIZE or now - entry.st_mtime > LARGEST_AGE):
            discard_library(path)
    for path in folder.glob(f"{COMPILE_FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):
            if now - path.lstat().st_mtime > NOTICE_TIME:
                shutil.rmtree(path, ignore_errors=True)


def discard_library(path: Path) -> None:
    """Delete a library that cannot be used, if we may."""
    with contextlib.suppress(OSError):
        path.unlink()


@functools.cache
def _temporary_folder(reason: str, process: int) -> Path:
    """One a reason and process: a forked child has its own, since its parent removes the other."""
    logger.warning("the cache of compiled models cannot be written (%s): compiling anew in each run", reason)
    folder = Path(tempfile.mkdtemp(prefix="pneuopt-"))

    def remove() -> None:
        if os.getpid() == process:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def _library_name(identity: str, content: bytes) -> str:
    """Names a library's content together with what it was made of: neither can be exchanged alone."""
    checked = hashlib.sha256(identity.encode() + b"\0" + content).hexdigest()[:32]
    return f"{_digest(identity)}-{checked}.so"


def _digest(identity: str) -> str:
    return hashlib.sha256(identity.encode()).hexdigest()[:32]


def _is_own(path: Path) -> bool:
    """Whether a file is a plain one of this user, which no other may write. Windows: its folder is the user's own."""
    try:
        entry = path.lstat()
    except OSError:
        return False
    own = not hasattr(os, "getuid") or (entry.st_uid == os.getuid() and not entry.st_mode & 0o022)
    return stat.S_ISREG(entry.st_mode) and own


def _is_open_to_all(folder: Path) -> bool:
    """Whether any user may rename files in a folder; a sticky one, as /tmp, protects them."""
    if not hasattr(os, "getuid"):
        return False
    entry = folder.stat()
    foreign = entry.st_uid not in (os.getuid(), 0)
    return foreign or bool(entry.st_mode & stat.S_IWOTH and not entry.st_mode & stat.S_ISVTX)
