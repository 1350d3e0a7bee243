"""`compile_library`: C source compiled and loaded as a library, with a cache of binaries by content."""

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

COMPILER_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
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
        warn_once("no C compiler found: models run in the CasADi VM, with the same answers, about ten times slower")
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


def find_compiler() -> str | None:
    """Path of the C compiler that is used: ``$PNEUOPT_CC``, ``$CC``, gcc, clang, cc; None if none is found."""
    chosen = os.environ.get("PNEUOPT_CC", os.environ.get("CC"))
    if chosen is not None:
        return shutil.which(chosen) if chosen else None
    return next(filter(None, map(shutil.which, ("gcc", "clang", "cc"))), None)


def cache_directory() -> Path:
    """Where binaries are kept: ``$PNEUOPT_CACHE`` or the platform's cache folder; a temporary one if unwritable."""
    home = Path.home() / ("AppData/Local" if os.name == "nt" else ".cache")
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME") or home
    folder = Path(os.environ.get("PNEUOPT_CACHE") or Path(base) / "pneuopt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        return _temporary_folder(f"{folder}: {error.strerror or error}")


@functools.cache
def _temporary_folder(reason: str) -> Path:
    logger.warning("the cache of compiled models cannot be written (%s): compiling anew in each run", reason)
    return Path(tempfile.mkdtemp(prefix="pneuopt-"))


def _reason(error: OSError | subprocess.SubprocessError) -> str:
    """The compiler's error text, or the signal that killed it."""
    if isinstance(error, subprocess.CalledProcessError) and not error.stderr:
        code = error.returncode
        return f"it was killed by signal {-code}" if code < 0 else f"it ended with exit status {code}"
    if isinstance(error, subprocess.TimeoutExpired):
        return f"it took more than {error.timeout:g} s"
    return str(getattr(error, "stderr", None) or error)


def _load_library(cc: str, flags: tuple[str, ...], source: str) -> ctypes.CDLL:
    identity = [source, *flags, _compiler_version(cc), platform.processor(), _cpu_identity()]
    name = hashlib.sha256("\0".join(identity).encode()).hexdigest()[:32]
    binary = cache_directory() / f"{name}.so"
    if binary.exists():
        try:
            return ctypes.CDLL(str(binary))
        except OSError:  # damaged on the disk; it is built anew
            logger.debug("%s cannot be loaded, compiling it anew", binary)
    _compile(cc, flags, source, binary)
    return ctypes.CDLL(str(binary))


def _compile(cc: str, flags: tuple[str, ...], source: str, binary: Path) -> None:
    """Compile in a temporary folder, then move the binary: another process may do the same, or this one be killed."""
    with tempfile.TemporaryDirectory(dir=binary.parent) as folder:
        text, product = Path(folder) / "model.c", Path(folder) / binary.name
        text.write_text(source, encoding="utf-8")
        command = [cc, *flags, str(text), "-o", str(product), "-lm"]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=COMPILE_TIMEOUT)
        with contextlib.suppress(PermissionError):  # Windows: another process has just loaded its own
            product.replace(binary)


@functools.cache
def warn_once(message: str) -> None:
    """Warn, but not again in the same words."""
    logger.warning("%s", message)


@functools.cache
def _compiler_version(cc: str) -> str:
    result = subprocess.run([cc, "--version"], capture_output=True, text=True, timeout=30, check=False)
    return cc + result.stdout


@functools.cache
def _cpu_identity() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    return "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
