"""Libraries that read files for us: how to get them, and what to say where they fail."""

import importlib
import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pneuopt.quantities.errors import InputError, LogError

MAX_REASON = 200
"""Length of a library's own words in a message [character]: more may show the whole file."""


def import_extra(module: str, package: str, path: Path | str, kind: str, extra: str) -> Any:
    """Import the library that reads a kind of file, or say how to get it.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{path}: {kind} needs {package}; run: pip install 'pneuopt[{extra}]'") from None


@contextmanager
def foreign_code(path: Path, kind: str) -> Iterator[None]:
    """Run a library on a file that may be damaged: it stays silent, and whatever it raises becomes a `LogError`."""
    said, logging.root.manager.disable = logging.root.manager.disable, logging.CRITICAL
    unraisable, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except LogError:
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_REASON]
        error.__traceback__ = error.__context__ = None  # so that half-made objects die while nobody listens
        text = f"{path}: cannot be read as {kind} ({reason}); save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        logging.root.manager.disable = said
        sys.unraisablehook = unraisable
