"""What a log may cost: bytes, columns and cells are bounded before anything is parsed, and a file is read once."""

import stat
from pathlib import Path

from pneuopt.quantities.errors import LogError, require

MAX_BYTES = 2**29
"""Size of a log's file [byte], 512 MiB: text takes six times as much memory; smaller refuses an hour at 10 kHz."""
MAX_SIDECAR_BYTES = 2**20
"""Size of a sidecar [byte]: TOML of more takes minutes; smaller refuses comments."""
MAX_COLUMNS = 4096
"""Columns of a log [1]: more are rows and columns mistaken for each other; fewer refuse large data loggers."""
MAX_CELLS = 50_000_000
"""Samples of all channels [1], 400 MB: more fill the memory of a small machine; fewer refuse an hour at 1 kHz."""
MAX_NESTING = 64
"""Brackets in brackets of a sidecar [1]: a parser's recursion ends near 300; no sidecar needs ten."""
MAX_NAME = 256
"""Length of a column's name [character]: longer ones are no names, and make messages that nobody can read."""


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a whole file, once.

    Parameters
    ----------
    path : Path
    most : int
        Its size [byte] may be.

    Returns
    -------
    bytes

    Raises
    ------
    LogError
        If it cannot be read, is larger, or is a pipe or a device, which may never end.
    """
    try:
        mode = path.stat().st_mode
        usable = stat.S_ISREG(mode) or stat.S_ISDIR(mode)  # the latter fails below, with the system's reason
        require(usable, f"{path}: is a pipe or a device; save the log in a file", LogError)
        with path.open("rb") as file:
            raw = file.read(most + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        if isinstance(error, LogError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise LogError(f"{str(path)!r}"[1:-1] + f": cannot be read ({reason}); check the name and the folder") from None
    shown = f"{most / 2**20:g} MiB"
    require(len(raw) <= most, f"{path}: is larger than {shown}; cut it, or leave out rows and columns", LogError)
    return raw


def check_cells(path: Path | str, rows: int, columns: int) -> None:
    """Refuse more samples than the memory is meant for."""
    require(
        rows * columns <= MAX_CELLS,
        f"{path}: {rows} rows of {columns} channels are more than {MAX_CELLS:.0e} samples; cut the log, or read fewer "
        "channels or every tenth row",
        LogError,
    )
