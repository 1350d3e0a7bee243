"""A log read in spite of rows and cells that no reader takes, with what was done to them, row by row."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pneuopt.logs.columns import CHANNELS, ChannelColumn, Plant, find_columns, nearest_channel, plant_channels
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.foreign import READERS, parse_log
from pneuopt.logs.read_log import assemble_log, read_sidecar
from pneuopt.logs.table import LogTable, list_rows, read_bytes
from pneuopt.logs.text import block_table, decode, find_block, mend_cells, read_delimited
from pneuopt.logs.tolerances import MAX_MAGNITUDE, MAX_ROWS_OUT
from pneuopt.quantities.arrays import Indices, Mask
from pneuopt.quantities.errors import LogError, require
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import ATMOSPHERE, write_value


@dataclass(frozen=True, eq=False)
class MendedLog:
    """A log whose faults are mended by rule."""

    log: Experiment
    rows: Indices  # the number of each sample's row in the file, (n,)
    changes: tuple[str, ...]  # what was done, a sentence each, with the rows; empty where nothing was


def mend_log(path: str | Path, *, plant: Plant | None = None, ambient_pressure: float = ATMOSPHERE) -> MendedLog:
    """Read a log as `read_log` does, and mend by rule what that refuses; what no rule mends is refused still.

    A name of a column that nearly is a channel is taken for it. Cells that hold no number, or none that a sensor gives,
    are missing samples. Rows of another length, without time, or with a time that repeats or runs backwards, are left
    out.
    """
    path = Path(path)
    raw, beside = read_bytes(path), read_sidecar(path, None, None)
    channels = {**CHANNELS, **({} if plant is None else plant_channels(plant))}
    table = parse_log(path, raw)
    names, entries = list[str](), dict[str, Any]()  # entries for columns whose names nearly are channels
    taken = {n for n in channels if n in beside.columns}
    for name in table.names:
        channel = nearest_channel(name, channels) if name and name not in table.stamps else ""
        if channel and channel not in taken:
            entries[channel] = name
            taken.add(channel)
            names.append(f"column {name!r} is read as the channel {channel!r}")
    beside = beside._replace(columns={**entries, **beside.columns}) if entries else beside
    found, _ = find_columns(table, beside.columns, beside.columns_from, channels)
    changes = dict[str, list[int]]()
    if READERS[path.suffix.lower()] is read_delimited:
        block, layout = find_block(path, decode(path, raw))
        block, changes = mend_cells(block, [column.name for column in found.values()])
        table = block_table(block, layout)
    table, rows = _mend_rows(table, found, changes)
    log = assemble_log(path, raw, table, beside, plant, ambient_pressure)
    return MendedLog(log, rows, (*names, *(f"{list_rows(r)}: {what}" for what, r in changes.items())))


def _mend_rows(
    table: LogTable, found: Mapping[str, ChannelColumn], changes: dict[str, list[int]]
) -> tuple[LogTable, Indices]:
    """The table without rows whose time is missing or does not increase, and without samples of no sensor."""
    columns = {n: np.array(y) for n, y in table.read([c.name for c in found.values()]).items()}
    count = next(iter(columns.values())).size
    rows = table.first_row + np.arange(count)
    for name, y in columns.items():
        wrong = np.abs(y) > MAX_MAGNITUDE
        if wrong.any():
            changes[f"cell of {name!r} emptied, for no sensor gives its value"] = rows[wrong].tolist()
            y[wrong] = np.nan
    t = columns[found["time"].name]
    out = {row for what, r in changes.items() if what.startswith("left out") for row in r}
    missing = np.isnan(t) & ~np.isin(rows, list(out))
    latest = np.maximum.accumulate(np.where(np.isnan(t), -np.inf, t))
    before = np.concatenate([[-np.inf], latest[:-1]])
    for what, mask in {
        "left out, for the time is missing": missing,
        "left out, for the time repeats": t == before,
        "left out, for the time runs backwards": t < before,
    }.items():
        if mask.any():
            changes[what] = rows[mask].tolist()
    kept = np.isfinite(t) & (t > before)
    lost = int(count - kept.sum())
    remedy = "its time is too coarse, or it holds two recordings; export it anew, or cut it"
    require(lost <= MAX_ROWS_OUT * count, f"{table.path}: {lost} of {count} rows would be left out: {remedy}", LogError)
    mended = {n: y[kept] for n, y in columns.items()}
    return replace(table, read=lambda names: {n: mended[n] for n in names}), rows[kept]


def leave_out(mended: MendedLog, lost: Mask, why: str) -> MendedLog:
    """The log without some of its samples, by copy."""
    log = mended.log.trajectory
    part = Trajectory(log.t[~lost], {n: log[n][~lost] for n in log})
    changes = (*mended.changes, f"{list_rows(mended.rows[lost].tolist())}: left out, {why}")
    return MendedLog(replace(mended.log, trajectory=part), mended.rows[~lost], changes)


def empty_cells(mended: MendedLog, channel: str, lost: Mask, why: str) -> MendedLog:
    """The log with some samples of a channel missing, by copy."""
    log = mended.log.trajectory
    part = log.with_columns({channel: np.where(lost, np.nan, log[channel])})
    changes = (*mended.changes, f"{list_rows(mended.rows[lost].tolist())}: cells of {channel} emptied, {why}")
    return MendedLog(replace(mended.log, trajectory=part), mended.rows, changes)


def convert(mended: MendedLog, channel: str, factor: float, offset: float, why: str) -> MendedLog:
    """The log with a channel of ``factor * value + offset``, by copy; a noise that is stated goes with it."""
    log = mended.log.trajectory
    part = log.with_columns({channel: factor * log[channel] + offset})
    noise = {n: sigma * (abs(factor) if n == channel else 1.0) for n, sigma in mended.log.noise.items()}
    how = f"{channel} multiplied by {factor:g}" if factor != 1 else f"{offset:g} added to {channel}"
    changes = (*mended.changes, f"all {len(log)} rows: {how}, {why}")
    return MendedLog(replace(mended.log, trajectory=part, noise=noise), mended.rows, changes)


def write_mended(mended: MendedLog, path: Path, units: Mapping[str, str]) -> dict[Path, str]:
    """The texts of the log, a .csv, and of its sidecar; `units` are those of the parameters in its conditions."""
    log, t = mended.log, mended.log.trajectory
    header = ",".join(["time [s]", *(f"{n} [{log.unit(n) or '1'}]" for n in t)])
    rows = [
        ",".join("" if math.isnan(v) else repr(v) for v in row)
        for row in np.column_stack([t.t, t.matrix(t.names)]).tolist()
    ]
    source = log.source.path if log.source else log.name
    said = [f"Made from {Path(source).name} (sha256 {log.sha256}):", *mended.changes]
    lines = [f"# {''.join(c if c.isprintable() else '?' for c in text)}" for text in said]  # a line's end would end it
    lines += [] if mended.changes else ["# nothing was changed"]
    lines += [f"accept = {list(log.accept)}"] if log.accept else []
    sections = {
        "noise": {n: write_value(s, log.unit(n).partition("(")[0], 12) for n, s in log.noise.items()},
        "conditions": {n: write_value(v, units.get(n, "1"), 12) for n, v in log.conditions.items()},
        "intersample": {n: kind.value for n, kind in log.intersample.items()},
    }
    for section, entries in sections.items():
        lines += ["", f"[{section}]", *(f'"{n}" = "{v}"' for n, v in entries.items())] if entries else []
    return {path: "\n".join([header, *rows]) + "\n", path.with_suffix(".toml"): "\n".join(lines) + "\n"}
