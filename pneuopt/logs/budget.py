"""What a log may cost: bytes, columns and cells are bounded before anything is parsed, and a file is read once."""

from pathlib import Path

from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.source import read_source

MAX_BYTES = 2**29
"""Size of a log's file [byte], 512 MiB: text takes six times as much memory; smaller refuses an hour at 10 kHz."""
MAX_COLUMNS = 4096
"""Columns of a log [1]: more are rows and columns mistaken for each other; fewer refuse large data loggers."""
MAX_CELLS = 50_000_000
"""Samples of all channels [1], 400 MB: more fill the memory of a small machine; fewer refuse an hour at 1 kHz."""
MAX_NAME = 256
"""Length of a column's name [character]: longer ones are no names, and make messages that nobody can read."""


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a whole file, once.

    Parameters
    ----------
    most : int
        Its size [byte] may be.

    Raises
    ------
    LogError
        If it cannot be read, is larger, or is a pipe or a device, which may never end.
    """
    return read_source(path, most, "cut it, or leave out rows and columns", LogError)


def check_cells(path: Path | str, rows: int, columns: int) -> None:
    """Refuse more samples than the memory is meant for."""
    require(
        rows * columns <= MAX_CELLS,
        f"{path}: {rows} rows of {columns} channels are more than {MAX_CELLS:.0e} samples; cut the log, or read fewer "
        "channels or every tenth row",
        LogError,
    )
