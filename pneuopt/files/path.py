"""`read_path`: a reference through the points of a table, as a recorder or a cam editor writes it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pneuopt.control.moves import MotionPath
from pneuopt.files.toml import construct_at
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.trajectories import Trajectory

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
    if channel is not None:
        check_names("channel", [channel], log.names, str(path))
    return _make_path(path, log, PATH_CHANNELS if channel is None else (channel,), settings)


def read_path_of(measured: str, path: str | Path, **settings: Any) -> MotionPath:
    """The path that a loop shall follow, from the column of its measured signal's reference, or of the signal itself.

    Parameters
    ----------
    measured : str
        The loop's measured signal.
    path, **settings
        As for `read_path`.
    """
    return _make_path(path, read_log(path).trajectory, (f"{measured}_reference", measured), settings)


def _make_path(path: str | Path, log: Trajectory, channels: Sequence[str], settings: Mapping[str, Any]) -> MotionPath:
    """The path in the first of the channels that the table has."""
    found = [n for n in channels if n in log]
    named = PATH_CHANNELS[1] if PATH_CHANNELS[1] in channels else channels[-1]
    unit = {"position": " [mm]", "speed": " [m/s]"}.get(named, "")
    require(bool(found), f"{path}: no column of a path; name one {named}{unit}")
    points = log[found[0]]
    return construct_at(lambda: MotionPath(log.t - log.t[0], points, name=Path(path).stem, **settings), str(path))
