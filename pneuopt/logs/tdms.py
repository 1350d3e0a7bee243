"""Reader of National Instruments' TDMS logs; needs npTDMS, the extra `tdms`."""

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

_UNIT_KEYS = ("unit_string", "NI_UnitDescription", "Unit", "unit")
_Grid = tuple[str, float, float]  # when the first sample was taken, its time and the step [s]


def read_table(path: Path, raw: bytes) -> Table:
    """Read a TDMS file; its first sample is row 1.

    A column is a channel, by its name, or as "group/channel" where two groups have one of that name. Without a channel
    "time", the time of the waveforms is; waveforms of different rates are refused.
    """
    nptdms = import_extra("nptdms", "npTDMS", path, "TDMS", "tdms")
    with foreign_code(path, "TDMS"):
        listed = nptdms.TdmsFile.read_metadata(io.BytesIO(raw))
        check_cells(path, sum(len(channel) for group in listed.groups() for channel in group.channels()), 1)
        file = nptdms.TdmsFile.read(io.BytesIO(raw))
        channels = _by_name(file)
        columns = {name: channel[:] for name, channel in channels.items()}
        grids = {name: grid for name, channel in channels.items() if (grid := _grid(channel)) is not None}
    units = {name: unit for name, channel in channels.items() if (unit := _unit(channel))}
    if not grids or any(name.casefold() == "time" for name in columns):
        return array_table(path, columns, units)
    table = array_table(path, {"time": np.zeros(0), **columns}, {**units, "time": "s"})
    return Table(path, table.names, 1, partial(_read_waveforms, table, grids), table.units, table.stamps)


def _by_name(file: Any) -> dict[str, Any]:
    pairs = [(group.name, channel) for group in file.groups() for channel in group.channels() if len(channel)]
    uses = Counter(channel.name for _, channel in pairs)
    return {c.name if uses[c.name] == 1 else f"{group}/{c.name}": c for group, c in pairs}


def _grid(channel: Any) -> _Grid | None:
    properties = channel.properties
    if "wf_increment" not in properties:
        return None
    start = float(properties.get("wf_start_offset", 0.0))
    return str(properties.get("wf_start_time", "")), start, float(properties["wf_increment"])


def _unit(channel: Any) -> str:
    said = next((str(channel.properties[key]) for key in _UNIT_KEYS if channel.properties.get(key)), "")
    return plain_unit(said) or said


def _read_waveforms(table: Table, grids: dict[str, _Grid], names: Sequence[str]) -> dict[str, Array]:
    channels = [name for name in names if name != "time"]
    columns = dict(table.read(channels))
    rates = {grids.get(name) for name in channels}
    text = f"{table.path}: the waveforms of {', '.join(channels)} differ in start or step; export them at one rate"
    require(len(rates) == 1 and None not in rates, text, LogError)
    _, start, step = next(grid for grid in rates if grid is not None)
    time = np.asarray(start + step * np.arange(len(columns[channels[0]])), dtype=np.float64)
    return {name: time if name == "time" else columns[name] for name in names}
