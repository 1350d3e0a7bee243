"""`Table`: a log as its file has it: named columns of numbers that have no meaning yet."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pneuopt.logs.budget import MAX_COLUMNS, MAX_NAME
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

EMPTY_CELL = "leave the cell empty if the sample is missing, as `pneuopt check --fix FOLDER` does in a copy of the log"
"""What to do about a cell that holds no sample."""


@dataclass(frozen=True)
class Table:
    """What a reader of one file format returns.

    Parameters
    ----------
    path : Path or str
        For messages.
    names : sequence of str
        The columns in the file's order; "" for a column without a name.
    first_row : int
        The number that messages give to the row of the first sample.
    read : callable
        Takes names, and returns these columns as floats, each of shape (n,), NaN where a sample is missing. Nothing
        else is parsed, because other columns may hold anything. It raises a `LogError` that names the row and column of
        the first cell that is not a number.
    units : mapping of str to str
        Units that the file states apart from the names, by column: in a row of units, or as a property.
    stamps : frozenset of str
        The columns of time stamps, which `read` gives in seconds from the first.
    remarks : tuple of str
        What the reader did that the user may want to know, a sentence each: rows that are no samples, say.

    Raises
    ------
    LogError
        If two columns have the same name, or there are more columns, or longer names, than a log has.
    """

    path: Path | str
    names: Sequence[str]
    first_row: int
    read: Callable[[Sequence[str]], Mapping[str, Array]]
    units: Mapping[str, str] = field(default_factory=dict)
    stamps: frozenset[str] = frozenset()
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_columns(self.path, self.names)


def check_columns(path: Path | str, names: Sequence[str]) -> None:
    """Refuse two columns of the same name, and more columns, or longer names, than a log has."""
    n = len(names)
    require(n <= MAX_COLUMNS, f"{path}: {n} columns are more than {MAX_COLUMNS}; export fewer channels", LogError)
    for name, uses in Counter(filter(None, names)).items():
        require(uses == 1, f"{path}: two columns are named {name[:MAX_NAME]!r}; rename one", LogError)
        text = f"{path}: the name of column {name[:20]!r}... has {len(name)} characters; shorten it"
        require(len(name) <= MAX_NAME, text, LogError)
