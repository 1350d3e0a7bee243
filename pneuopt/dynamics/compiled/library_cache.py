"""Compiled libraries kept on the disk. A file is loaded only if it is whole and this user's own: it runs as our code.

A library is named by what it was made of (source, flags, compiler, CPU) and by the hash of its bytes, so that one that
is damaged, cut or exchanged does not fit its name. Loading such a file ends the process (SIGBUS, SIGSEGV), or worse.
"""

import atexit
import contextlib
import functools
import hashlib
import logging
import os
import shutil
import stat
import tempfile
import time
from pathlib import Path

# Age [s] since its last use at which a library is deleted, half a year. Below, models of last month are compiled anew;
# above, those of old versions stay for nothing.
LARGEST_AGE = 180 * 24 * 3600.0
# Size [bytes] of all libraries above which those that were not used for longest are deleted, some thousand models.
# Below, studies of many models compile them again and again; above, it is much for a cache folder.
LARGEST_SIZE = 200 * 2**20
# Time [s] after which a use is noted again, and a folder in which nothing is compiled any more is deleted, a day.
# Below, libraries are written to at each use; above, the order of their use is lost.
NOTICE_TIME = 24 * 3600.0
COMPILE_FOLDER_PREFIX = "compile-"
logger = logging.getLogger("pneuopt")


def cache_directory() -> Path:
    """Where libraries are kept: ``$PNEUOPT_CACHE`` or the platform's cache folder.

    Where that cannot be written to, or anybody may exchange files in it: a temporary folder, removed at the end.
    """
    try:
        folder = _usual_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_open_to_all(folder):
            return _temporary_folder(f"{folder}: other users may exchange files in it", os.getpid())
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError, ValueError) as error:  # no home is a RuntimeError, a NUL in a name a ValueError
        return _temporary_folder(f"{getattr(error, 'filename', None) or ''}: {error}".lstrip(": "), os.getpid())


def find_library(folder: Path, identity: str) -> Path | None:
    """The library that was made of this, if it is kept, whole and this user's own; others in its place are deleted.

    Parameters
    ----------
    identity : str
        All that the library was made of.
    """
    for path in sorted(folder.glob(f"{_digest(identity)}-*.so")):
        if _is_own(path) and path.name == _library_name(identity, path.read_bytes()):
            _note_use(path)
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
    """Delete libraries that were not used for long, or are too many, and what killed processes left behind.

    Parameters
    ----------
    keep : Path, optional
        A library that stays in any case.
    """
    now, size = time.time(), 0
    for path, entry in cached_libraries(folder).items():
        size += entry.st_size
        if path != keep and (size > LARGEST_SIZE or now - entry.st_mtime > LARGEST_AGE):
            discard_library(path)
    for path in folder.glob(f"{COMPILE_FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):
            if now - path.lstat().st_mtime > NOTICE_TIME:
                shutil.rmtree(path, ignore_errors=True)


def _note_use(path: Path) -> None:
    """Set a library's time to now, once a day."""
    with contextlib.suppress(OSError):
        if time.time() - path.stat().st_mtime > NOTICE_TIME:
            os.utime(path)


def discard_library(path: Path) -> None:
    """Delete a library that cannot be used, if we may."""
    with contextlib.suppress(OSError):
        path.unlink()


def _usual_folder() -> Path:
    chosen = os.environ.get("PNEUOPT_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    home = "AppData/Local" if os.name == "nt" else ".cache"
    return (Path(base) if base else Path.home() / home) / "pneuopt"


@functools.cache
def _temporary_folder(reason: str, process: int) -> Path:
    """One a reason and process: a forked child has its own, since its parent removes the other."""
    logger.warning("the cache of compiled models cannot be written (%s): compiling anew in each run", reason)
    folder = Path(tempfile.mkdtemp(prefix="pneuopt-"))
    atexit.register(_remove_folder, folder, process)
    return folder


def _remove_folder(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


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
