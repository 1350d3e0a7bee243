"""Reader of logs as text: columns apart by comma, semicolon, tab or white space, with decimal point or comma."""

from collections.abc import Sequence
from pathlib import Path

from pneuopt.logs.layout import MAX_HEAD_ROWS, TOA5, Layout, find_layout, has_table, toa5_layout
from pneuopt.logs.stamps import is_stamp
from pneuopt.logs.table import Table
from pneuopt.logs.text_cells import TextBlock, split_cells
from pneuopt.quantities.errors import LogError, require

_DELIMITERS = (";", "\t", ",", " ")


def read_table(path: Path, raw: bytes) -> Table:
    """Read a text file of which a row names the columns: UTF-8, UTF-16 with its mark, or Windows-1252.

    An empty cell or NaN is a missing sample. One decimal mark holds for all columns that are read. Above the names may
    stand metadata, below them a row of units (`find_layout`). Rows have the numbers that an editor shows.
    """
    return read_text(path, decode(path, raw))


def decode(path: Path, raw: bytes) -> str:
    """The text of a file, its lines apart by a line feed.

    Raises
    ------
    LogError
        If it is no text.
    """
    if raw[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        text = raw.decode("utf-16", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252", errors="replace")
    require("\0" not in text, f"{path}: not a text file; export the log as CSV in UTF-8", LogError)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: Path, text: str) -> Table:
    """Read the text of such a file."""
    block, layout = find_block(path, text)
    return block_table(block, layout)


def find_block(path: Path, text: str) -> tuple[TextBlock, Layout]:
    """The samples of such a text as cells, and how its rows are to be read."""
    lines = text.rstrip("\n ").split("\n")
    require(any(lines), f"{path}: row 1 is empty; it has to name the columns", LogError)
    delimiter = _find_delimiter(path, lines[:MAX_HEAD_ROWS])
    rows = [split_cells(line, delimiter, f"{path}: row {i}") for i, line in enumerate(lines[:MAX_HEAD_ROWS], 1)]
    layout = toa5_layout(rows) if rows[0][0] == TOA5 and len(rows) > 4 else find_layout(rows, str(path))
    names, start = layout.names, layout.start
    first = rows[start] if start < len(rows) else []
    stamps = frozenset(name for name, cell in zip(names, first, strict=False) if name and is_stamp(cell))
    return TextBlock(path, names, lines[start:], delimiter, start + 1, stamps), layout


def block_table(block: TextBlock, layout: Layout) -> Table:
    """The table of such samples."""
    return Table(block.path, block.names, block.first_row, block.columns, layout.units, block.stamps, layout.remarks)


def _find_delimiter(path: Path, lines: Sequence[str]) -> str:
    """The first that gives names and samples below them; else the first that the first line holds."""
    for delimiter in _DELIMITERS:
        if has_table([split_cells(line, delimiter, f"{path}: row {i}") for i, line in enumerate(lines, 1)]):
            return delimiter
    return next((d for d in _DELIMITERS[:-1] if d in lines[0]), ",")
