"""`read_path`: a reference through the points of a table, as a recorder or a cam editor writes it."""

from pathlib import Path
from typing import Any

from pneuopt.control.motion_path import MotionPath
from pneuopt.files.toml import construct_at
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import check_names, require

PATH_CHANNELS = ("position_reference", "position", "speed_reference", "speed")
"""Channels that may hold a path, the likelier first."""


def read_path(path: str | Path, *, channel: str | None = None, **settings: Any) -> MotionPath:
    """Read a path from a table of time and position, in any format and with any units that `read_log` takes.

    Parameters
    ----------
    path : str or Path
        Ten points at least; time may begin anywhere.
    channel : str, optional
        The channel that holds the points; by default the first of `PATH_CHANNELS` that the table has.
    **settings
        Fields of `MotionPath`: dwell, start, disturbance; its name is the file's.

    Returns
    -------
    MotionPath

    Raises
    ------
    InputError
        Or its kind; the message names file, row and column.
    """
    log = read_log(path).trajectory
    found = [n for n in PATH_CHANNELS if n in log]
    if channel is not None:
        check_names("channel", [channel], log.names, str(path))
    require(channel is not None or bool(found), f"{path}: no column of a path; name one {PATH_CHANNELS[1]} [mm]")
    points = log[channel or found[0]]
    return construct_at(lambda: MotionPath(log.t - log.t[0], points, name=Path(path).stem, **settings), str(path))
