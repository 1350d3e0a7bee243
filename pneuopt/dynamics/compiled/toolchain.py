"""`find_compiler`: the C compiler that is used, as a command, and the flags that it gets."""

import functools
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

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
    """A C compiler.

    Parameters
    ----------
    command : tuple of str
        The program, and the arguments that stand before all others.
    """

    command: tuple[str, ...]

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
    """The C compiler: of ``$PNEUOPT_CC`` (empty: none), ``$CC``, on the path, or of the extra ``compiler``; or None.

    Both variables hold a program, or a command with arguments (``"python -m ziglang cc"``). On the path are sought
    gcc, clang and cc; the extra is the package ziglang, which holds a clang.
    """
    chosen = os.environ.get("PNEUOPT_CC")
    if chosen is not None:
        return _parse_command(chosen)
    found = _parse_command(os.environ.get("CC", ""))
    if found is not None:
        return found
    on_path = (path for path in map(shutil.which, COMPILERS) if path and not _is_placeholder(path))
    path = next(on_path, None)
    return _packaged_compiler() if path is None else Compiler((path,))


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


def _is_placeholder(path: str) -> bool:
    """Whether a program only asks to install Apple's tools: macOS has such a gcc, clang and cc where they are not."""
    return sys.platform == "darwin" and path.startswith("/usr/bin/") and not _has_apple_tools()


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
