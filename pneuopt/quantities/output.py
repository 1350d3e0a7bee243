"""Files written whole or not at all, or refused before the work; files read once, within a budget; one BLAS thread."""

import contextlib
import functools
import json
import math
import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, require

if TYPE_CHECKING:
    import pandas as pd
    from threadpoolctl import ThreadpoolController


MAX_TOML_BYTES = 2**17
"""Size of a TOML file [byte], 128 KiB: more takes seconds to parse; less refuses the covariance of fifty parameters."""
MAX_NESTING = 64
"""Brackets in brackets of a TOML file [1]: a parser's recursion ends near 300; no file of ours needs ten."""
MAX_REASON = 200
"""Length of another's words in a message [character]: a parser's or a library's own may show the whole file."""

_known: ContextVar[dict[str, bytes] | None] = ContextVar("known", default=None)
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
"""What text begins with that a spreadsheet computes; a number is none, it is no text here."""


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, its lines ended by a newline character on every system, whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all: a temporary file beside it is written first, and then renamed.

    A link is followed; a file that is there keeps its mode and owner. An `InputError` where it cannot be written.
    """
    place = _check_place(Path(path))
    part = place.with_name(f".{secrets.token_hex(6)}.part")
    try:
        with part.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        entry = _stat_if_there(place)
        if entry is not None:
            with contextlib.suppress(OSError, AttributeError):  # AttributeError: Windows has no owners
                os.chown(part, entry.st_uid, entry.st_gid)
            part.chmod(stat.S_IMODE(entry.st_mode))
        part.replace(place)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); check the folder") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a mapping as JSON; what is not finite becomes null, a list of records is a table (`records`)."""
    text = json.dumps(_null_nonfinite(plain_value(document)), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, f"{text}\n")


def format_table(frame: "pd.DataFrame") -> str:
    """A table as CSV, without its index; text that a spreadsheet takes for a formula has an apostrophe before it."""
    shown = frame.rename(columns=_quote_formula).map(_quote_formula)
    return str(shown.to_csv(index=False, float_format="%.9g", lineterminator="\n"))


def format_cell(value: Any) -> str:
    """A value as a cell of such a CSV."""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}"
    return "" if value is None else str(_quote_formula(value))


def _quote_formula(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA_STARTS) else cell


def records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """A table as a list of records, one a row; an index that is more than a count goes in, if nameless as "name"."""
    import pandas as pd

    if isinstance(frame.index, pd.RangeIndex):
        table = frame
    elif isinstance(frame.index, pd.MultiIndex):
        table = frame.reset_index()
    else:
        table = frame.reset_index(names=str(frame.index.name or "name"))
    return [{str(k): plain_value(v) for k, v in record.items()} for record in table.to_dict(orient="records")]


def plain_value(value: Any) -> Any:
    """Convert to what TOML and JSON can hold: NumPy's scalars to Python's, other objects to text; None is left out."""
    if isinstance(value, Mapping):
        return {str(k): plain_value(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [plain_value(v) for v in value if v is not None]
    value = value.item() if hasattr(value, "item") else value
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def check_output_paths(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Refuse outputs, None for none, that could not be written after minutes of work, or would overwrite an input."""
    read = {os.path.realpath(path) for path in inputs}
    taken: set[Path] = set()
    for path in (p for p in outputs if p is not None):
        place = _check_place(path)
        require(str(place) not in read, f"{path}: is an input of this command; give the output another name")
        require(place not in taken, f"{path}: is named for two outputs; give each a name of its own")
        require(os.access(place.parent, os.W_OK), f"{path}: the folder cannot be written to; choose another")
        taken.add(place)


def _check_place(path: Path) -> Path:
    """The file that a path names, behind links; refused where a plain file cannot be put in its place."""
    try:
        place = Path(os.path.realpath(path))
        require(place.parent.is_dir(), f"{path}: the folder does not exist; make it first")
        entry = _stat_if_there(place)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{str(path)!r}"[1:-1] + f": cannot be written ({reason}); choose another name") from None
    if entry is not None:
        require(not stat.S_ISDIR(entry.st_mode), f"{path}: is a folder; name a file in it")
        require(stat.S_ISREG(entry.st_mode), f"{path}: is a pipe or a device, no file; name a file")
        require(os.access(place, os.W_OK), f"{path}: is write-protected; choose another name, or unlock it")
    return place


def _stat_if_there(place: Path) -> os.stat_result | None:
    """A file's state; None where it is not there. A name that is too long, or no name, raises."""
    try:
        return place.lstat()
    except FileNotFoundError:
        return None


def _null_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _null_nonfinite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_null_nonfinite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_source(path: str | Path, most: int, remedy: str, error: type[InputError] = InputError) -> bytes:
    """Read a whole file of at most `most` [byte]; `error` says the `remedy` if it is larger, or a pipe or device."""
    path = Path(path)
    try:
        mode = path.stat().st_mode
        usable = stat.S_ISREG(mode) or stat.S_ISDIR(mode)  # the latter fails below, with the system's reason
        require(usable, f"{path}: is a pipe or a device; give the name of a file", error)
        with path.open("rb") as file:
            raw = file.read(most + 1)
    except InputError:
        raise
    except (OSError, ValueError) as failure:  # ValueError: a NUL in the name
        reason = getattr(failure, "strerror", None) or str(failure)
        raise error(f"{str(path)!r}"[1:-1] + f": cannot be read ({reason}); check the name and the folder") from None
    shown = f"{most / 2**20:g} MiB" if most >= 2**20 else f"{most / 2**10:g} KiB"
    require(len(raw) <= most, f"{path}: is larger than {shown}; {remedy}", error)
    return raw


def read_toml_source(path: str | Path) -> bytes:
    """Read a TOML file that no parser chokes on; within `read_once` only the first call reads the file."""
    known = _known.get()
    key = str(Path(path).absolute())
    if known is not None and key in known:
        return known[key]
    raw = read_source(path, MAX_TOML_BYTES, "is it a log, or another file?")
    check_nesting(path, raw)
    if known is not None:
        known[key] = raw
    return raw


def check_nesting(path: str | Path, raw: bytes, error: type[InputError] = InputError) -> None:
    """Refuse TOML whose brackets a parser could not follow."""
    steps = ((letter in b"[{") - (letter in b"]}") for letter in raw)
    depth = max(accumulate(steps, initial=0))
    require(depth <= MAX_NESTING, f"{path}: too many brackets in brackets; no file needs ten", error)


@contextmanager
def read_once(known: Mapping[str, bytes] | None = None) -> Iterator[dict[str, bytes]]:
    """Read each TOML file once within, so that one that is moved or edited during long work changes nothing.

    It yields what was read, by absolute path, and begins with what another process has read, for example.
    """
    outer = _known.get()
    own = {**(known or {})} if outer is None or known is not None else outer
    token = _known.set(own)
    try:
        yield own
    finally:
        _known.reset(token)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use no threads of its own in this process; its setting from before returns at the end.

    BLAS shares products of a few thousand numbers out to all cores, too, and its threads then wait in a loop for the
    next one. An identification took a fifth more CPU time by it, and ended no sooner.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _controller() -> "ThreadpoolController":
    """Of the libraries that are loaded: NumPy's, and SciPy's own."""
    import scipy.linalg  # noqa: F401 - a library that is loaded later is not limited
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
