"""Reader of ASAM's measurement data format (.mf4, .mdf); needs asammdf, the extra `mdf`."""

import io
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pneuopt.logs.arrays import array_table
from pneuopt.logs.budget import check_cells
from pneuopt.logs.layout import plain_unit
from pneuopt.logs.libraries import foreign_code, import_extra
from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

TIME = "time"


def read_table(path: Path, raw: bytes) -> Table:
    """Read an MDF file.

    Parameters
    ----------
    path : Path
        For messages.
    raw : bytes
        A column is a channel, by its name, or as "name (group 2)" where two groups have one of that name; "time" is the
        master of the group that the channels are of.

    Returns
    -------
    Table
        Its first sample is row 1.

    Raises
    ------
    LogError
        If the file is not MDF, or its channels are of groups with different times.
    InputError
        If asammdf is not installed.
    """
    asammdf = import_extra("asammdf", "asammdf", path, "MDF", "mdf")
    with foreign_code(path, "MDF"), asammdf.MDF(io.BytesIO(raw)) as file:
        places = _places(file)
        units = {name: _unit(file, place) for name, place in places.items()}
    names = [TIME, *(name for name in places if name.casefold() != TIME)]
    said = {name: unit for name, unit in units.items() if unit}
    return Table(path, names, 1, partial(_read_columns, path, raw, places, asammdf), {**said, TIME: "s"})


def _places(file: Any) -> dict[str, tuple[int, int]]:
    """Group and index of every channel but the groups' masters, by name."""
    found = [
        (channel.name, group, index)
        for group, entry in enumerate(file.groups)
        for index, channel in enumerate(entry.channels)
        if file.masters_db.get(group) != index
    ]
    uses = Counter(name for name, _, _ in found)
    return {name if uses[name] == 1 else f"{name} (group {g})": (g, i) for name, g, i in found}


def _unit(file: Any, place: tuple[int, int]) -> str:
    said = str(file.get_channel_unit(group=place[0], index=place[1]) or "")
    return plain_unit(said) or said


def _read_columns(
    path: Path, raw: bytes, places: dict[str, tuple[int, int]], asammdf: Any, names: Sequence[str]
) -> dict[str, Array]:
    channels = [name for name in names if name != TIME]
    with foreign_code(path, "MDF"), asammdf.MDF(io.BytesIO(raw)) as file:
        check_cells(path, max(file.groups[places[n][0]].channel_group.cycles_nr for n in channels), len(names))
        signals = {name: file.get(group=places[name][0], index=places[name][1]) for name in channels}
    times = [signal.timestamps for signal in signals.values()]
    text = f"{path}: channels {', '.join(channels)} are of groups with different times; export them at one rate"
    require(all(np.array_equal(t, times[0], equal_nan=True) for t in times), text, LogError)
    columns = {TIME: times[0], **{name: signal.samples for name, signal in signals.items()}}
    return dict(array_table(path, columns, {}).read(names))
