"""Reader of LabVIEW's measurement files (.lvm)."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from pneuopt.logs.csv import decode, read_text
from pneuopt.logs.layout import plain_unit
from pneuopt.logs.table import Table
from pneuopt.logs.text_cells import TextBlock
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError, require

_END = "***End_of_Header***"
_TIME = "X_Value"


def read_table(path: Path, raw: bytes) -> Table:
    """Read a measurement file of one segment; one without a head is read as text.

    Its time is the column X_Value, or, with X_Columns "No", X0 and Delta_X. Rows have the numbers that an editor shows.
    """
    text = decode(path, raw)
    lines = text.rstrip("\n ").split("\n")
    ends = [i for i, line in enumerate(lines) if line.strip(" \t,;") == _END]
    if not ends:
        return read_text(path, text)
    segments = f"{path}: has {len(ends) - 1} segments; save one a file, or one header only"
    require(len(ends) == 2, segments, LogError)
    head = ends[1] + 1
    require(head + 1 < len(lines), f"{path}: a header, but no samples; save the log again", LogError)
    delimiter = next((d for d in "\t,;" if d in lines[0]), "\t")
    rows = [[cell.strip() for cell in line.split(delimiter)] for line in lines[: head + 1]]
    keys = {row[0]: row[1:] for row in rows}
    names = _names(rows[head])
    require(_TIME in rows[head], f"{path}: row {head + 1} names no {_TIME}; save the log again", LogError)
    units = _units(names, keys.get("Y_Unit_Label", []))
    samples = [_without_comment(line, delimiter, names) for line in lines[head + 1 :]]
    block = TextBlock(path, names, samples, delimiter, head + 2)
    grid = _grid(path, keys) if keys.get("X_Columns", [""])[0] == "No" else None
    remark = f"rows 1 to {head} are read as the head of a LabVIEW measurement file"
    return Table(path, names, head + 2, partial(_read_columns, block, grid), units, frozenset(), (remark,))


def _names(row: Sequence[str]) -> list[str]:
    """Of the columns: the first X_Value is the time, further ones are those of the channels behind them."""
    names = ["" if name == _TIME else name for name in row]
    names[names.index("") if "" in names else 0] = "time"
    return names[: names.index("Comment")] if "Comment" in names else names[: len(names) - (not names[-1])]


def _units(names: Sequence[str], labels: Sequence[str]) -> dict[str, str]:
    channels = [name for name in names[1:] if name]
    said = {name: plain_unit(label) or label for name, label in zip(channels, labels, strict=False) if label}
    return {**said, "time": "s"}


def _without_comment(line: str, delimiter: str, names: Sequence[str]) -> str:
    """A row without what stands behind its last channel."""
    cells = line.split(delimiter)
    return delimiter.join(cells[: len(names)])


def _grid(path: Path, keys: Mapping[str, Sequence[str]]) -> tuple[float, float]:
    """Start and step [s] of the time of a file that has no column of it."""
    found = []
    for key in ("X0", "Delta_X"):
        texts = {text for text in keys.get(key, []) if text}
        require(len(texts) == 1, f"{path}: the channels differ in {key}; save them at one rate", LogError)
        try:
            found.append(float(texts.pop().replace(",", ".")))
        except ValueError:
            found.append(math.nan)
    require(all(map(math.isfinite, found)), f"{path}: X0 or Delta_X is not a number; save the log again", LogError)
    return found[0], found[1]


def _read_columns(block: TextBlock, grid: tuple[float, float] | None, names: Sequence[str]) -> dict[str, Array]:
    times = [i for i, name in enumerate(block.names) if name in {"time", ""}]
    if grid is not None:
        columns = block.columns([name for name in names if name != "time"])
        time = np.asarray(grid[0] + grid[1] * np.arange(len(block.lines)), dtype=np.float64)
        return {name: time if name == "time" else columns[name] for name in names}
    columns = block.columns(names)
    for i in times[1:]:
        own = TextBlock(block.path, _rename(block.names, i), block.lines, block.delimiter, block.first_row)
        same = np.array_equal(own.columns(["own"])["own"], own.columns(["time"])["time"])
        require(same, f"{block.path}: the channels have times of their own; save them with one X column", LogError)
    return columns


def _rename(names: Sequence[str], index: int) -> list[str]:
    return ["own" if i == index else name for i, name in enumerate(names)]
