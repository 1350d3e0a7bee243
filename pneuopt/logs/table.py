"""`Table`: a log as its file has it: named columns of numbers that have no meaning yet."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require


@dataclass(frozen=True)
class Table:
    """What a reader of one file format returns.

    Parameters
    ----------
    path : Path
        For messages.
    names : sequence of str
        The columns in the file's order; "" for a column without a name.
    first_row : int
        The number that messages give to the row of the first sample.
    read : callable
        Takes names, and returns these columns as floats, each of shape (n,), NaN where a sample is missing. Nothing
        else is parsed, because other columns may hold anything. It raises a `LogError` that names the row and column of
        the first cell that is not a number.

    Raises
    ------
    LogError
        If two columns have the same name.
    """

    path: Path
    names: Sequence[str]
    first_row: int
    read: Callable[[Sequence[str]], Mapping[str, Array]]

    def __post_init__(self) -> None:
        for name in filter(None, self.names):
            once = list(self.names).count(name) == 1
            require(once, f"{self.path}: two columns are named {name!r}; rename one", LogError)
