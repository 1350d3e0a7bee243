"""Reader of ASAM's measurement data format (.mf4, .mdf); needs asammdf, the extra `mdf`."""

import io
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.arrays import array_table
from pneuopt.logs.budget import check_cells
from pneuopt.logs.layout import plain_unit
from pneuopt.logs.libraries import foreign_code, import_extra, run_apart
from pneuopt.logs.table import Table
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

TIME = "time"


def read_table(path: Path, raw: bytes) -> Table:
    """Read an MDF file; its first sample is row 1.

    A column is a channel, by its name, or as "name (group 2)" where two groups have one of that name; "time" is the
    master of the group that the channels are of. Channels of groups with different times are refused.
    """
    import_extra("asammdf", "asammdf", path, "MDF", "mdf")
    log = run_apart(_read_log, path, raw, kind="MDF")
    names = [TIME, *(name for name in log.columns if name.casefold() != TIME)]
    units = {name: plain_unit(unit) or unit for name, unit in log.units.items() if unit}
    return Table(path, names, 1, partial(_read_columns, path, log), {**units, TIME: "s"})


class _Log(NamedTuple):
    """The numbers of a file: columns and units by name, the group of a column, the times of a group."""

    columns: dict[str, Any]
    units: dict[str, str]
    groups: dict[str, int]
    times: dict[int, Any]


def _read_log(path: Path, raw: bytes) -> _Log:
    """Read all channels that hold numbers."""
    import asammdf

    log = _Log({}, {}, {}, {})
    with foreign_code(path, "MDF"), asammdf.MDF(io.BytesIO(raw)) as file:
        places = _places(file)
        rows = [int(file.groups[group].channel_group.cycles_nr) for group, _ in places.values()]
        check_cells(path, sum(rows), 1)
        for name, (group, index) in places.items():
            channel = file.get(group=group, index=index)
            if channel.samples.ndim == 1 and channel.samples.dtype.kind in "fiub":
                log.columns[name], log.units[name] = channel.samples, str(channel.unit or "")
                log.groups[name], log.times[group] = group, channel.timestamps
    return log


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


def _read_columns(path: Path, log: _Log, names: Sequence[str]) -> dict[str, Array]:
    channels = [name for name in names if name != TIME]
    times = [log.times[log.groups[name]] for name in channels]
    text = f"{path}: channels {', '.join(channels)} are of groups with different times; export them at one rate"
    require(all(np.array_equal(t, times[0], equal_nan=True) for t in times), text, LogError)
    columns = {TIME: times[0], **{name: log.columns[name] for name in channels}}
    return dict(array_table(path, columns, {}).read(names))
