"""Where a result comes from: versions and options, as text that goes with it."""

import functools
import platform
from importlib.metadata import PackageNotFoundError, version


def provenance(*options: object) -> dict[str, str]:
    """The versions of Python and of the packages that computed a result, and the options that were used.

    Parameters
    ----------
    *options : dataclass instances
        Their repr is recorded.
    """
    return {
        "pneuopt": _version("pneuopt"),
        "casadi": _version("casadi"),
        "numpy": _version("numpy"),
        "scipy": _version("scipy"),
        "python": platform.python_version(),
        "options": "; ".join(repr(o) for o in options),
    }


@functools.cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
