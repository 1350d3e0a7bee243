"""Libraries that read files for us: how to get them, and what to say where they fail."""

import importlib
import logging
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from pneuopt.quantities.errors import InputError, LogError
from pneuopt.quantities.source import MAX_REASON

MAX_SECONDS = 120.0
"""Time for a library [s] in a process of its own: more looks like a hang; less refuses logs of 100 MB."""

Result = TypeVar("Result")


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
        name = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        reason = " ".join(f"{name}{error}".split())[:MAX_REASON]
        traceback.clear_frames(error.__traceback__)  # so that half-made objects die while nobody listens
        text = f"{path}: cannot be read as {kind} ({reason}); save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        logging.root.manager.disable = said
        sys.unraisablehook = unraisable


def run_apart(read: Callable[[Path, bytes], Result], path: Path, raw: bytes, kind: str) -> Result:
    """Run a reader in a process of its own, which a damaged file may end or keep busy, but not ours.

    Raises
    ------
    LogError
        If it does either, or the reader says so.
    """
    import loky

    executor = loky.ProcessPoolExecutor(1, context=loky.backend.get_context("loky"))
    try:
        return cast("Result", executor.submit(read, path, raw).result(MAX_SECONDS))
    except (loky.process_executor.BrokenProcessPool, FutureTimeoutError):
        text = f"{path}: cannot be read as {kind}: the library fails on it; save the log again, or export it as CSV"
        raise LogError(text) from None
    finally:
        executor.shutdown(kill_workers=True)
