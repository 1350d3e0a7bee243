"""Results as text and as files: what prints itself (`Shown`), what can be saved besides (`Result`), and their JSON.

`encode` makes plain JSON values of a result's dataclasses, `decode` makes the result again. A dataclass is an object
with a member a field; a mapping, an object; a sequence, a list; an enumeration, its value; what is not finite, "nan",
"inf" or "-inf". A table is an object with "index" and "columns", lists of [name, kind, values], where kind is
"number", "integer", "flag" or "text", and null is a missing text. Numbers have all their digits.

A file, whole or not at all, has the members "pneuopt", the name of the result's class, "format", 1, "sha256", the
hash of the result's text, and "result". It is for programs to read; what people edit is fit.toml and tuned.toml.
"""

import dataclasses
import hashlib
import json
import math
import types
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from pneuopt.quantities.errors import InputError, PneuoptError, check_names, require
from pneuopt.quantities.output import write_text
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.report import Report

if TYPE_CHECKING:
    import pandas as pd


NOT_SAVED = {"saved": False}
"""Metadata of a dataclass's field that a file leaves out, as it is no data; it comes back as its default."""
FORMAT = 2
"""Version of the file's layout: a file of another one is refused, not misread."""
_NONFINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_PLAIN_TYPES: dict[Any, tuple[type, ...]] = {str: (str,), int: (int,), bool: (bool,), types.NoneType: (types.NoneType,)}
_KIND_TYPES: dict[str, Any] = {"number": float, "integer": int, "flag": bool}


class Shown(ABC):
    """What prints, and shows in a notebook, as its report."""

    @abstractmethod
    def summary(self) -> Report:
        """What there is to know, verdict first: print it, or take its `to_text(width)` or `to_html()`."""

    def __repr__(self) -> str:
        return self.summary().to_text()

    def _repr_html_(self) -> str:
        return self.summary().to_html()


class Result(Shown):
    """What a search or a certificate hands out: it prints, and it can be saved."""

    def row(self) -> dict[str, float | str]:
        """What a study's table shows of it, numbers and text by name; an `InputError` where it has no row."""
        raise InputError(f"a {type(self).__name__} has no row in a study; return numbers or text of it, by name")

    def save(self, path: str | Path) -> None:
        """Write all of it to a file of JSON text, whole or not at all; `load_result` reads it.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        content: dict[str, Any] = encode(self)
        members = ",\n  ".join(f"{_to_json(name)}: {_to_json(value)}" for name, value in content.items())
        head = f'"pneuopt": "{type(self).__name__}", "format": {FORMAT}, "sha256": "{_hash(content)}"'
        write_text(path, f'{{{head}, "result": {{\n  {members}\n}}}}\n')


def read_result(path: str | Path, kinds: dict[str, type]) -> Any:
    """Read a file of one of these kinds, by name; an `InputError` if it is another, damaged, or of another version."""
    remedy = "save the result again"
    try:
        document = json.loads(Path(path).read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name and the folder") from None
    except (ValueError, RecursionError):  # no UTF-8, no JSON, or brackets without end
        raise InputError(f"{path}: not a whole result file; {remedy}") from None
    message = f"{path}: not a result that pneuopt has saved; give a file of `save`"
    require(isinstance(document, dict) and {"pneuopt", "format", "sha256", "result"} <= document.keys(), message)
    version = document["format"]
    require(
        version == FORMAT, f"{path}: has format {version!r}, this pneuopt reads {FORMAT}; install the one that wrote it"
    )
    check_names("result", [str(document["pneuopt"])], kinds, str(path))
    whole = document["sha256"] == _hash(document["result"])
    require(whole, f"{path}: was damaged or changed after it was saved; {remedy}")
    try:
        return decode(kinds[document["pneuopt"]], document["result"])
    except DamagedError as error:
        raise InputError(f"{path}: {error} is not as pneuopt saves it; {remedy}") from None
    except (PneuoptError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: holds no such result ({error}); {remedy}") from None


class DamagedError(ValueError):
    """What was read is not what `encode` makes; the message says where."""


def encode(value: Any) -> Any:
    """Plain values that JSON can hold, from a dataclass and what is in it."""
    import pandas as pd

    if isinstance(value, pd.DataFrame):
        levels = [value.index.get_level_values(k) for k in range(value.index.nlevels)]
        return {
            "index": [_encode_column(level.name, level) for level in levels],
            "columns": [_encode_column(name, column) for name, column in value.items()],
        }
    if isinstance(value, Enum):
        return value.value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: encode(getattr(value, f.name)) for f in _saved_fields(type(value))}
    if isinstance(value, Mapping):
        return {str(k): encode(v) for k, v in value.items()}
    if isinstance(value, frozenset):
        return sorted(encode(v) for v in value)
    if isinstance(value, np.ndarray | Sequence) and not isinstance(value, str):
        return [encode(v) for v in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} is nothing that a result is saved with")


def decode(kind: Any, data: Any, where: str = "result") -> Any:
    """The value of a type, or of an annotation, from what `encode` has made of it; else a `DamagedError` at `where`."""
    import pandas as pd

    origin, arguments = get_origin(kind), get_args(kind)
    if kind is float:
        if isinstance(data, str):
            _expect(data in _NONFINITE, where)
            return _NONFINITE[data]
        _expect(isinstance(data, int | float) and not isinstance(data, bool), where)
        return float(data)
    if kind in _PLAIN_TYPES:
        _expect(type(data) in _PLAIN_TYPES[kind], where)
        return data
    if origin in (Union, types.UnionType):
        return _decode_union(arguments, data, where)
    if kind is pd.DataFrame:
        return _decode_frame(data, where)
    if kind is ParameterSet:
        return ParameterSet(decode(Mapping[str, Parameter], data, where))
    if origin is np.ndarray:
        return np.array(decode(tuple[float, ...], data, where), dtype=float)
    if origin in (tuple, frozenset):
        _expect(isinstance(data, list), where)
        return origin(decode(arguments[0], entry, f"{where}[{k}]") for k, entry in enumerate(data))
    if origin is not None and issubclass(origin, Mapping):
        _expect(isinstance(data, dict), where)
        return {name: decode(arguments[1], entry, f"{where}.{name}") for name, entry in data.items()}
    return _decode_object(kind, data, where)


def _decode_object(kind: Any, data: Any, where: str) -> Any:
    """An enumeration's member, or a dataclass."""
    import pandas as pd

    if isinstance(kind, type) and issubclass(kind, Enum):
        _expect(data in [member.value for member in kind], where)
        return kind(data)
    _expect(isinstance(data, dict), where)
    hints = get_type_hints(kind, localns={"pd": pd})
    known = {f.name: f for f in _saved_fields(kind)}
    unknown = sorted(set(data) - set(known))
    _expect(not unknown, f"{where}.{unknown[0]}" if unknown else where)
    for name, field in known.items():
        optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        _expect(name in data or optional, f"{where}.{name}")
    return kind(**{name: decode(hints[name], entry, f"{where}.{name}") for name, entry in data.items()})


def _saved_fields(kind: Any) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(kind) if f.metadata.get("saved", True)]


def _decode_union(kinds: tuple[Any, ...], data: Any, where: str) -> Any:
    """The first kind that the data are of; the last one's error where they are of none."""
    for kind in kinds[:-1]:
        try:
            return decode(kind, data, where)
        except DamagedError:
            continue
    return decode(kinds[-1], data, where)


def _encode_column(name: Any, column: Any) -> list[Any]:
    kinds = {"f": "number", "i": "integer", "b": "flag"}
    kind = kinds.get(getattr(column.dtype, "kind", ""), "text")
    values = column.tolist()
    if kind == "text":
        values = [None if isinstance(v, float) and math.isnan(v) else v for v in values]
        kind = "flag" if values and all(isinstance(v, bool) for v in values) else kind
    return [name, kind, encode(values)]


def _decode_frame(data: Any, where: str) -> "pd.DataFrame":
    import pandas as pd

    from pneuopt.quantities.frames import WideFrame

    _expect(isinstance(data, dict) and set(data) == {"index", "columns"} and len(data["index"]) > 0, where)
    levels = [_decode_column(level, f"{where}.index") for level in data["index"]]
    columns = [_decode_column(column, f"{where}.columns") for column in data["columns"]]
    lengths = {len(values) for _, values in (*levels, *columns)}
    _expect(len(lengths) == 1, where)
    names = [name for name, _ in levels]
    index = (
        pd.Index(levels[0][1], name=names[0])
        if len(levels) == 1
        else pd.MultiIndex.from_arrays([values for _, values in levels], names=names)
    )
    frame = WideFrame(dict(enumerate(values for _, values in columns)), index=index)
    return frame.set_axis([name for name, _ in columns], axis=1)


def _decode_column(data: Any, where: str) -> tuple[str | None, Any]:
    """Name and values of a column, or of a level of the index."""
    _expect(isinstance(data, list) and len(data) == 3 and isinstance(data[2], list), where)
    name, kind, values = data
    _expect(isinstance(name, str | None), where)
    if kind == "text":
        _expect(all(isinstance(v, str | None) for v in values), f"{where}.{name}")
        return name, [math.nan if v is None else v for v in values]
    _expect(kind in _KIND_TYPES, f"{where}.{name}")
    plain = _KIND_TYPES[kind]
    return name, np.array([decode(plain, v, f"{where}.{name}") for v in values], dtype=plain)


def _expect(condition: bool, where: str) -> None:
    if not condition:
        raise DamagedError(where)


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode("utf-8")).hexdigest()


def _to_json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
