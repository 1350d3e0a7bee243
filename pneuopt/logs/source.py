"""`LogSource`: where a log's channels were read, for whoever checks what a file was taken for."""

from collections.abc import Mapping
from dataclasses import dataclass

from pneuopt.logs.columns import ChannelColumn


@dataclass(frozen=True)
class LogSource:
    """The file, rows and columns of a log.

    Attributes
    ----------
    path : str
        Of the file; a name where the log comes from no file.
    first_row : int
        The number of the row that holds the first sample, as messages count rows; each sample has a row.
    columns : mapping of str to ChannelColumn
        By channel, "time" among them.
    unread : tuple of str
        Columns that are no channel.
    sidecar : str
        The file that says more about the log; empty where there is none.
    sections : tuple of str
        What stands in it.
    """

    path: str
    first_row: int
    columns: Mapping[str, ChannelColumn]
    unread: tuple[str, ...] = ()
    sidecar: str = ""
    sections: tuple[str, ...] = ()
