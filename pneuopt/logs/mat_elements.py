"""The variables of a .mat file of version 5 to 7: arrays, texts and structures of them; the rest is left alone.

The format: MathWorks, "MAT-File Format", chapter 1. SciPy's own reader trusts the sizes in a file, as its documentation
warns: some damaged logs end the whole process.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from pneuopt.logs.budget import MAX_BYTES, MAX_COLUMNS
from pneuopt.quantities.errors import InputError, require

MAX_LEVELS = 8
"""Structures in each other [1]: more overflow a stack; MATLAB's own logs have four."""
HEAD_BYTES = 128
"""Length of the file's head [byte]; its last two say the order of bytes."""

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_MATRIX, _COMPRESSED = 14, 15
_STRUCTURE, _CHARACTERS, _NUMERIC = 2, 4, range(6, 16)


class _Element(NamedTuple):
    kind: int
    data: memoryview


class Structure(NamedTuple):
    """A structure, or an array of them.

    Attributes
    ----------
    elements : list of dict
        A field's value by its name.
    """

    elements: list[dict[str, Any]]
    fields: tuple[str, ...]


def has_elements(raw: bytes) -> bool:
    """Whether a file says that it is of version 5 to 7."""
    head = raw[HEAD_BYTES - 4 : HEAD_BYTES]
    return head in {b"\x00\x01IM", b"\x01\x00MI"}


def read_elements(raw: bytes) -> list[tuple[str, Any]]:
    """Read the variables: arrays without dimensions of length one, texts, structures; None for all others.

    Raises
    ------
    InputError
        If sizes, types or nesting contradict each other.
    """
    order = "<" if raw[HEAD_BYTES - 2 : HEAD_BYTES] == b"IM" else ">"
    budget, found = MAX_BYTES, []
    for element in _elements(memoryview(raw)[HEAD_BYTES:], order):
        if element.kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(element.data, budget)
            budget -= len(unpacked)
            require(budget > 0, "it unpacks to more than a log's size")
            found += [_variable(inner, order, 0) for inner in _elements(memoryview(unpacked), order)]
        else:
            found.append(_variable(element, order, 0))
    return found


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """The elements in a row; each is padded to 8 bytes, but compressed ones."""
    at = 0
    while at < len(data):
        require(len(data) - at >= 8, "it ends within a tag")
        kind, size = struct.unpack_from(order + "II", data, at)
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            require(size <= 4, "a short element is too long")
        require(start + size <= len(data), "an element is longer than what holds it")
        yield _Element(kind, data[start : start + size])
        at = start + size if kind == _COMPRESSED else at + 8 * math.ceil((start + size - at) / 8)


def _variable(element: _Element, order: str, level: int) -> tuple[str, Any]:
    require(element.kind == _MATRIX, f"an element of type {element.kind} stands where a variable should")
    require(level < MAX_LEVELS, "it is nested too deep")
    parts = _elements(element.data, order)
    flags = next(parts, None)
    if flags is None:  # an empty cell or field
        return "", None
    require(len(flags.data) == 8, "a variable has no flags")
    word = struct.unpack_from(order + "I", flags.data)[0]
    kind, is_complex = word & 0xFF, bool(word & 0x800)
    if kind not in {_STRUCTURE, _CHARACTERS, *_NUMERIC} or is_complex:
        return "", None
    shape, name = _shape(_next(parts), order), _text(_next(parts), order)
    if kind == _STRUCTURE:
        return name, _structure(parts, math.prod(shape), order, level)
    part = _next(parts)
    return name, _text(part, order) if kind == _CHARACTERS else _array(part, shape, order)


def _shape(dims: _Element, order: str) -> tuple[int, ...]:
    n = len(dims.data) // 4
    require(dims.kind in {5, 6} and 1 <= n <= 32 and len(dims.data) == 4 * n, "an array has no size")
    shape = struct.unpack_from(f"{order}{n}i", dims.data)
    require(min(shape) >= 0 and math.prod(shape) <= MAX_BYTES, "an array has an impossible size")
    return shape


def _array(part: _Element, shape: tuple[int, ...], order: str) -> Any:
    require(part.kind in _NUMBERS, "numbers are none")
    dtype = np.dtype(order + _NUMBERS[part.kind])
    require(len(part.data) == math.prod(shape) * dtype.itemsize, "an array has another size than it says")
    array = np.frombuffer(part.data, dtype).reshape(shape, order="F")
    return array.astype(_NUMBERS[part.kind]).squeeze()


def _text(part: _Element, order: str) -> str:
    require(part.kind in _ENCODINGS, "a text is none")
    encoding = _ENCODINGS[part.kind]
    suffix = "" if encoding in {"latin-1", "utf-8"} else "-le" if order == "<" else "-be"
    return bytes(part.data).decode(encoding + suffix, errors="replace").rstrip("\0")


def _structure(parts: Iterator[_Element], count: int, order: str, level: int) -> Structure:
    length, names = _next(parts), bytes(_next(parts).data)
    require(length.kind == 5 and len(length.data) == 4, "a structure has no fields")
    size = struct.unpack_from(order + "i", length.data)[0]
    require(0 < size <= 64 and len(names) % size == 0, "a structure's fields have no names")
    starts = range(0, len(names), size)
    fields = tuple(names[i : i + size].split(b"\0")[0].decode("latin-1") for i in starts)
    require(not fields or count <= MAX_COLUMNS, "a structure array is too long")
    elements = [
        {field: _variable(_next(parts), order, level + 1)[1] for field in fields} for _ in range(count * bool(fields))
    ]
    return Structure(elements, fields)


def _next(parts: Iterator[_Element]) -> _Element:
    part = next(parts, None)
    if part is None:
        raise InputError("a variable ends too early")
    return part
