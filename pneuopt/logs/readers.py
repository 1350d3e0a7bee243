"""The registry of log formats: one reader a suffix. A new format is a file with a `read_table`, and a row here.

Each reader takes what `read_table` takes, and raises what it raises.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from pneuopt.logs import csv, lvm, mat, mdf, parquet, tdms, xlsx
from pneuopt.logs.table import Table
from pneuopt.quantities.errors import LogError, require

READERS: Mapping[str, Callable[[Path, bytes], Table]] = {
    ".csv": csv.read_table,
    ".txt": csv.read_table,
    ".tsv": csv.read_table,
    ".dat": csv.read_table,
    ".parquet": parquet.read_table,
    ".mat": mat.read_table,
    ".lvm": lvm.read_table,
    ".xlsx": xlsx.read_table,
    ".tdms": tdms.read_table,
    ".mf4": mdf.read_table,
    ".mdf": mdf.read_table,
}
"""The suffix of a file, in lower case, to the function that reads it."""


def read_table(path: Path, raw: bytes) -> Table:
    """Read a log's columns with the reader of its suffix.

    Parameters
    ----------
    path : Path
        Its suffix says the format, and messages name it.
    raw : bytes
        What the file holds.

    Raises
    ------
    LogError
        If no reader has that suffix, or the file is not of that format, is damaged, or holds no samples.
    InputError
        If the library that reads the format is not installed.
    """
    suffix = path.suffix.lower()
    shown = f"{suffix!r} files" if suffix else "a name without suffix"
    require(suffix in READERS, f"{path}: no reader for {shown}; known: {', '.join(READERS)}", LogError)
    return READERS[suffix](path, raw)
