"""Files written whole or not at all, and refused before the work where they could not be written after it."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, require

if TYPE_CHECKING:
    import pandas as pd


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole or not at all.

    Parameters
    ----------
    path : str or Path
    text : str
        Lines end with a newline character on every system.

    Raises
    ------
    InputError
        If the folder does not exist, or cannot be written to.
    """
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all: a temporary file beside it is written first, and then renamed.

    Parameters
    ----------
    path : str or Path
    content : bytes

    Raises
    ------
    InputError
        If the folder does not exist, or cannot be written to.
    """
    path = Path(path)
    require(path.parent.is_dir(), f"{path}: the folder does not exist; make it first")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); check the folder") from None
    finally:
        part.unlink(missing_ok=True)


def write_records(path: str | Path, frame: "pd.DataFrame") -> None:
    """Write a table as JSON: a list of records, one a row; what is not finite becomes null.

    Parameters
    ----------
    path : str or Path
    frame : DataFrame
        An index that is more than a count goes into each record, as "name" if it has no name of its own.
    """
    write_text(path, _to_json(records(frame)))


def write_json(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a mapping as JSON; what is not finite becomes null, a list of records is a table (`records`).

    Parameters
    ----------
    path : str or Path
    document : mapping
    """
    write_text(path, _to_json(plain_value(document)))


def records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """A table as a list of records, one a row; the index as for `write_records`."""
    import pandas as pd

    if isinstance(frame.index, pd.RangeIndex):
        table = frame
    elif isinstance(frame.index, pd.MultiIndex):
        table = frame.reset_index()
    else:
        table = frame.reset_index(names=str(frame.index.name or "name"))
    return [{str(k): plain_value(v) for k, v in record.items()} for record in table.to_dict(orient="records")]


def plain_value(value: Any) -> Any:
    """Convert to what TOML and JSON can hold: NumPy's scalars to Python's, other objects to text; None is left out.

    Examples
    --------
    >>> plain_value({"a": (1, None, Path("b"))})
    {'a': [1, 'b']}
    """
    if isinstance(value, Mapping):
        return {str(k): plain_value(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [plain_value(v) for v in value if v is not None]
    value = value.item() if hasattr(value, "item") else value
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def check_output_paths(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Refuse outputs that could not be written after minutes of work, or that would overwrite an input.

    Parameters
    ----------
    outputs : iterable of Path or None
        None is an output that is not wanted.
    inputs : iterable of Path

    Raises
    ------
    InputError
        The message names the file and the remedy.
    """
    read = {path.resolve() for path in inputs}
    taken: set[Path] = set()
    for path in (p for p in outputs if p is not None):
        place = path.resolve()
        require(place not in read, f"{path}: is an input of this command; give the output another name")
        require(place not in taken, f"{path}: is named for two outputs; give each a name of its own")
        require(place.parent.is_dir(), f"{path}: the folder does not exist; make it first")
        require(not place.is_dir(), f"{path}: is a folder; name a file in it")
        require(os.access(place.parent, os.W_OK), f"{path}: the folder cannot be written to; choose another")
        taken.add(place)


def _to_json(value: Any) -> str:
    return json.dumps(_null_nonfinite(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _null_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _null_nonfinite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_null_nonfinite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
