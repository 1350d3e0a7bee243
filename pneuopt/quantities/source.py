"""Files that are read: only regular ones, once, within a budget; TOML within one for its nesting, too."""

import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import accumulate
from pathlib import Path

from pneuopt.quantities.errors import InputError, require

MAX_TOML_BYTES = 2**17
"""Size of a TOML file [byte], 128 KiB: more takes seconds to parse; less refuses the covariance of fifty parameters."""
MAX_NESTING = 64
"""Brackets in brackets of a TOML file [1]: a parser's recursion ends near 300; no file of ours needs ten."""

MAX_REASON = 200
"""Length of another's words in a message [character]: a parser's or a library's own may show the whole file."""

_known: ContextVar[dict[str, bytes] | None] = ContextVar("known", default=None)


def read_source(path: str | Path, most: int, remedy: str, error: type[InputError] = InputError) -> bytes:
    """Read a whole file.

    Parameters
    ----------
    most : int
        Its size [byte] may be.
    remedy : str
        What to do where it is larger, or no file: "cut it".
    error : type
        What is raised.

    Raises
    ------
    InputError
        Or the other error: if it cannot be read, is larger, or is a pipe or a device, which may never end.
    """
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
    """Read a TOML file that no parser chokes on; within `read_once` only the first call reads the file.

    Raises
    ------
    InputError
        As `read_source` does, and for brackets in brackets in brackets.
    """
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

    Parameters
    ----------
    known : mapping of str to bytes, optional
        What was read before, in another process for example.

    Yields
    ------
    dict of str to bytes
        What was read, by absolute path; it grows.
    """
    outer = _known.get()
    own = {**(known or {})} if outer is None or known is not None else outer
    token = _known.set(own)
    try:
        yield own
    finally:
        _known.reset(token)
