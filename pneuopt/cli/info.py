"""`pneuopt info`: what is installed, the compiler and its cache, a self-check and the speed."""

import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, requires, version

import numpy as np

from pneuopt.cli.exit_status import EXIT_FAILURE, EXIT_SUCCESS
from pneuopt.cli.terminal import make_console, show_pairs
from pneuopt.dynamics.compiled.library_cache import cache_directory, cached_libraries
from pneuopt.dynamics.compiled.self_check import SelfCheck, check_machine_code
from pneuopt.dynamics.compiled.toolchain import COMPILER_FLAGS, find_compiler
from pneuopt.dynamics.system import discretise, parameter_vector
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck

_REQUIREMENT = re.compile(r"^([\w.-]+)[^;]*(?:;\s*extra\s*==\s*['\"]([\w-]+)['\"])?\s*$")


def run_info() -> int:
    """Show what to quote in a question or a bug report; returns 1 where the self-check fails."""
    compiler, cache = find_compiler(), cache_directory()
    check = _check_itself()
    libraries = cached_libraries(cache)
    size = sum(entry.st_size for entry in libraries.values()) / 1e6
    shown = {
        **package_versions(),
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": f"{platform.platform()}, {os.cpu_count()} CPUs",
        "compiler": f"{compiler}, {compiler.version}" if compiler else "none: models run in the CasADi VM",
        **({"flags": " ".join(COMPILER_FLAGS)} if compiler else {"to add one": 'pip install "pneuopt[compiler]"'}),
        "cache": f"{cache}: {len(libraries)} models, {size:.3g} MB",
        "self-check": _describe_check(check),
        "speed": _describe_speed(check),
    }
    show_pairs(make_console(), shown)
    return EXIT_SUCCESS if check.is_good else EXIT_FAILURE


def package_versions() -> dict[str, str]:
    """The version of each package that pneuopt needs or an extra brings; for those that are not there the extra."""
    found = {"pneuopt": version("pneuopt")}
    for text in requires("pneuopt") or ():  # "numpy>=2.0", "openpyxl>=3.1; extra == 'xlsx'"
        match = _REQUIREMENT.match(text)
        name, extra = match.groups() if match else (text, None)
        try:
            found.setdefault(name, version(name))
        except PackageNotFoundError:
            found.setdefault(name, f'not installed: pip install "pneuopt[{extra}]"' if extra else "MISSING")
    return found


def _check_itself() -> SelfCheck:
    """Of a load that is pushed against friction."""
    system = discretise(ForceDrive(Stribeck()).system(), 1)
    p = parameter_vector(system.parameters, system.parameters)
    return check_machine_code(system.pieces, np.zeros(2), np.full(1, 150.0), p, 1e-3)


def _describe_check(check: SelfCheck) -> str:
    verdict = "good" if check.is_good else "FAILED: please report it, with all of this"
    code = f"machine code differs from the VM by {check.distance:.1g}, " if check.lanes else ""
    return f"{verdict}: {code}derivatives from differences by {check.derivative_error:.1g}"


def _describe_speed(check: SelfCheck) -> str:
    names = {"vm": "in the VM", "scalar": "compiled", "lanes": f"in {check.lanes} lanes"}
    return "ns a step: " + ", ".join(f"{time:.0f} {names[way]}" for way, time in check.nanoseconds.items())
